"""LeRobot itself evaluates a policy on vecenv: its plugin discovery, its ``make_env`` and its evaluation loop.

Needs LeRobot (Python 3.12) and ``packages/lerobot_env_vecenv`` installed, otherwise skipped::

    pip install 'lerobot[dataset]' && pip install --no-deps -e packages/lerobot_env_vecenv
    pytest tests/interop/test_lerobot_eval.py
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot")
pytest.importorskip("lerobot_env_vecenv")
pytestmark = pytest.mark.heavy

import torch  # noqa: E402
from lerobot.configs import FeatureType  # noqa: E402
from lerobot.envs import close_envs, env_to_policy_features, make_env, make_env_config  # noqa: E402
from lerobot.policies.act.configuration_act import ACTConfig  # noqa: E402
from lerobot.policies.act.modeling_act import ACTPolicy  # noqa: E402
from lerobot.policies.factory import make_pre_post_processors  # noqa: E402
from lerobot.scripts.lerobot_eval import eval_policy_all  # noqa: E402
from lerobot.utils.import_utils import register_third_party_plugins  # noqa: E402

OPTIONS: dict[str, Any] = {
    "task": "libero_object",
    "task_ids": [0, 2],
    "episode_length": 4,
    "observation_height": 64,
    "observation_width": 64,
}
SIDE = 64


def config(**options: Any) -> Any:
    register_third_party_plugins()
    return make_env_config("vecenv", **{**OPTIONS, **options})


def policy(env_config: Any) -> ACTPolicy:
    """ACT with random weights for the features of the environment."""
    features = env_to_policy_features(env_config)
    torch.manual_seed(0)
    chosen = ACTConfig(
        input_features={key: feature for key, feature in features.items() if feature.type is not FeatureType.ACTION},
        output_features={key: feature for key, feature in features.items() if feature.type is FeatureType.ACTION},
        pretrained_backbone_weights=None,
        device="cpu",
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        use_vae=False,
        chunk_size=4,
        n_action_steps=2,
        push_to_hub=False,
    )
    return ACTPolicy(chosen)


def evaluate(env_config: Any, episodes: int, sub_envs: int, **options: Any) -> tuple[dict[str, Any], dict[Any, Any]]:
    acting = policy(env_config)
    before, after = make_pre_post_processors(acting.config)
    env_before, env_after = env_config.get_env_processors()
    envs = make_env(env_config, n_envs=sub_envs)
    report = eval_policy_all(
        envs, acting, env_before, env_after, before, after, n_episodes=episodes, start_seed=1000, **options
    )
    return report, envs


def test_the_features_are_those_that_liberos_checkpoints_have() -> None:
    found = {key: (feature.type.value, tuple(feature.shape)) for key, feature in _features(config()).items()}
    assert found == {
        "action": ("ACTION", (7,)),
        "observation.images.image": ("VISUAL", (3, SIDE, SIDE)),
        "observation.images.image2": ("VISUAL", (3, SIDE, SIDE)),
        "observation.state": ("STATE", (8,)),
    }


def _features(env_config: Any) -> dict[str, Any]:
    return env_to_policy_features(env_config)


def test_lerobots_evaluation_runs_every_task_and_writes_videos(tmp_path: Path) -> None:
    report, envs = evaluate(config(), episodes=3, sub_envs=2, max_episodes_rendered=2, videos_dir=tmp_path)
    assert [(entry["task_group"], entry["task_id"]) for entry in report["per_task"]] == [
        ("libero_object", 0),
        ("libero_object", 2),
    ]
    assert report["overall"]["n_episodes"] == 6
    assert report["overall"]["pc_success"] == 0.0
    assert len(list(tmp_path.rglob("*.mp4"))) == 4
    close_envs(envs)


def test_success_reaches_lerobots_report(monkeypatch: pytest.MonkeyPatch) -> None:
    env_config = config(task_ids=[0])
    monkeypatch.setattr("vecenv.interop.lerobot.LeRobotVectorEnv.step", _solving_step())
    report, _ = evaluate(env_config, episodes=2, sub_envs=2)
    assert report["overall"]["pc_success"] == 50.0
    assert report["overall"]["avg_sum_reward"] == 0.5


def _solving_step() -> Any:
    """``step`` that puts the target object of sub-environment 0 into the basket before the second tick."""
    from vecenv.interop.lerobot import LeRobotVectorEnv

    step, ticks = LeRobotVectorEnv.step, iter(range(100))

    def solving(self: LeRobotVectorEnv, actions: np.ndarray) -> Any:
        batch: Any = self._live()
        if next(ticks) == 1:
            state, snapshot = batch.state(), batch.observe_objects().snapshot[0]
            _, target, region = snapshot.goal[0]
            address = batch.mj_model.joint(f"{target}_joint0").qposadr[0]
            state.qpos[0, address : address + 3] = snapshot.regions[region].pos
            batch.set_state(state)
        return step(self, np.zeros_like(actions))

    return solving


def test_the_command_line_knows_the_environment(tmp_path: Path) -> None:
    env_config, checkpoint = config(), tmp_path / "checkpoint"
    acting = policy(env_config)
    acting.save_pretrained(checkpoint)
    for processor in make_pre_post_processors(acting.config):
        processor.save_pretrained(checkpoint)
    command = [
        *(sys.executable, "-m", "lerobot.scripts.lerobot_eval", f"--policy.path={checkpoint}", "--policy.device=cpu"),
        *("--env.type=vecenv", "--env.task=libero_object", "--env.task_ids=[1]", "--env.episode_length=3"),
        *(f"--env.observation_height={SIDE}", f"--env.observation_width={SIDE}"),
        *("--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={tmp_path / 'out'}"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    report = json.loads((tmp_path / "out" / "eval_info.json").read_text())
    assert report["overall"]["n_episodes"] == 2
