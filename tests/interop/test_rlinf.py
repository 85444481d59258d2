"""RLinf's interface for LIBERO: shapes, rewards, metrics and resets, as its workers read them (RLinf a3816b5).

The expected rewards and flags were recorded from RLinf's own methods over a scripted simulator.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from vecenv.interop.rlinf import RLinfEnv, RLinfError  # noqa: E402

SUITE, COUNT, SIDE = "libero_object", 2, 16
# examples/embodiment/config/env/libero_object.yaml, as far as the environment reads it.
CONFIG: dict[str, Any] = {
    "task_suite_name": SUITE,
    "auto_reset": False,
    "ignore_terminations": False,
    "max_episode_steps": 4,
    "use_fixed_reset_state_ids": True,
    "use_ordered_reset_state_ids": False,
    "use_rel_reward": True,
    "reward_coef": 5.0,
    "reset_gripper_open": True,
    "is_eval": False,
    "seed": 0,
    "group_size": 1,
    "specific_reset_id": 52,
    "init_params": {"camera_heights": SIDE, "camera_widths": SIDE},
    "video_cfg": {"save_video": False},
}


def made(**options: Any) -> RLinfEnv:
    return RLinfEnv({**CONFIG, **options}, COUNT, 0, 1, None)


@pytest.fixture
def env() -> Iterator[RLinfEnv]:
    env = made()
    yield env
    env.close()


def zeros(*lead: int) -> Any:
    return torch.zeros(*lead, 7)


def solve(env: RLinfEnv, slot: int) -> None:
    """Overwrite the state so that the target object floats just above the floor of the basket."""
    (part,) = env.batch._parts
    batch: Any = part.env
    state, snapshot = batch.state(), batch.observe_objects().snapshot[slot]
    _, target, region = snapshot.goal[0]
    address = batch.mj_model.joint(f"{target}_joint0").qposadr[0]
    state.qpos[slot, address : address + 3] = snapshot.regions[region].pos
    batch.set_state(state)


def test_observations_have_rlinfs_keys_shapes_and_types(env: RLinfEnv) -> None:
    assert env.is_start
    obs: Any
    obs, infos = env.reset()
    assert not env.is_start
    assert infos == {}
    assert {name: (tuple(obs[name].shape), obs[name].dtype) for name in ("main_images", "wrist_images", "states")} == {
        "main_images": ((COUNT, SIDE, SIDE, 3), torch.uint8),
        "wrist_images": ((COUNT, SIDE, SIDE, 3), torch.uint8),
        "states": ((COUNT, 8), torch.float32),
    }
    assert obs["task_descriptions"] == ["pick up the cream cheese and place it in the basket"] * COUNT
    assert (env.task_ids.tolist(), env.trial_ids.tolist()) == ([1, 1], [2, 2])
    assert env.total_num_group_envs == 500


def test_a_step_rewards_changes_and_counts_until_success(env: RLinfEnv) -> None:
    env.reset()
    env.step(zeros(COUNT))
    solve(env, 0)
    _, reward, terminated, truncated, infos = env.step(zeros(COUNT))
    assert (reward.dtype, reward.tolist()) == (torch.float32, [5.0, 0.0])
    assert (terminated.tolist(), truncated.tolist()) == ([True, False], [False, False])
    episode = infos["episode"]
    assert episode["success_once"].tolist() == [True, False]
    assert episode["return"].tolist() == [5.0, 0.0]
    assert episode["reward"].tolist() == [2.5, 0.0]
    _, reward, *_, infos = env.step(zeros(COUNT))
    assert infos["episode"]["return"].tolist() == [5.0, 0.0]
    _, _, _, truncated, infos = env.step(zeros(COUNT))
    assert truncated.tolist() == [True, True]
    assert infos["episode"]["episode_len"].tolist() == [4, 4]


def test_a_chunk_reports_every_tick_and_with_ignored_terminations_the_last() -> None:
    env = made(ignore_terminations=True)
    env.reset()
    solve(env, 1)
    obs, reward, terminated, truncated, infos = env.chunk_step(zeros(COUNT, 4))
    assert (len(obs), len(infos), tuple(reward.shape)) == (4, 4, (COUNT, 4))
    assert reward[1, 0] == 5.0
    assert terminated.tolist() == [[False] * 4] * 2
    assert truncated.tolist() == [[False, False, False, True]] * 2
    assert infos[-1]["episode"]["success_once"].tolist() == [False, True]
    assert "success_at_end" in infos[-1]["episode"]
    env.close()


def test_auto_reset_begins_other_episodes_and_keeps_the_last_observation() -> None:
    env = made(auto_reset=True, specific_reset_id=None, task_id_filter=[0, 2], use_fixed_reset_state_ids=False)
    env.reset()
    before = env.task_ids.tolist(), env.trial_ids.tolist()
    obs, _, _, truncated, infos = env.chunk_step(zeros(COUNT, 4))
    assert truncated[:, -1].tolist() == [True, True]
    assert (env.task_ids.tolist(), env.trial_ids.tolist()) != before
    assert env.elapsed_steps.tolist() == [0, 0]
    assert infos[-1]["_final_info"].tolist() == [True, True]
    assert infos[-1]["final_info"]["episode"]["episode_len"].tolist() == [4, 4]
    assert not torch.equal(infos[-1]["final_observation"]["states"], obs[-1]["states"])
    env.close()


def test_some_environments_are_reset_to_other_tasks_while_others_continue(env: RLinfEnv) -> None:
    env.reset()
    env.step(zeros(COUNT))
    obs, _ = env.reset(env_idx=[1], reset_state_ids=[160])
    assert (env.task_ids.tolist(), env.trial_ids.tolist()) == ([1, 3], [2, 10])
    assert env.elapsed_steps.tolist() == [1, 0]
    assert obs["task_descriptions"][0] != obs["task_descriptions"][1]
    env.step(zeros(COUNT))


def test_an_evaluation_counts_each_episode_once() -> None:
    options = {"auto_reset": True, "is_eval": True, "specific_reset_id": None, "task_id_filter": [4]}
    env = RLinfEnv({**CONFIG, **options, "max_episode_steps": 1}, COUNT, seed_offset=3, total_num_processes=10)
    env.reset()
    for _ in range(3):
        env.chunk_step(zeros(COUNT, 1))
    assert env._task_success_stats == {4: {"success": 0, "total": 5}}
    *_, truncated, infos = env.chunk_step(zeros(COUNT, 1))
    assert not truncated.any()
    assert not infos[-1]["_final_info"].any()
    env.close()


def test_environments_of_a_group_begin_alike() -> None:
    env = made(group_size=2, specific_reset_id=None)
    env.reset()
    assert len(set(zip(env.task_ids.tolist(), env.trial_ids.tolist(), strict=True))) == 1
    env.update_reset_state_ids()
    assert len(set(env.reset_state_ids.tolist())) == 1
    env.close()


def test_options_that_cannot_be_honoured_are_refused() -> None:
    with pytest.raises(RLinfError, match="reset_gripper_open"):
        made(reset_gripper_open=False)
    with pytest.raises(RLinfError, match="group_size=3"):
        made(group_size=3)


def test_actions_may_be_arrays(env: RLinfEnv) -> None:
    env.reset()
    _, reward, *_ = env.step(np.zeros((COUNT, 7)))
    assert reward.tolist() == [0.0, 0.0]
