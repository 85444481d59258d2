"""Gymnasium: images, SIMPLER's tasks, and the registry of ids."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics, RecordVideo, TimeLimit
from support.gymnasium_batch import POOL, SUITE, TASK, actions, assert_same, episodes

import vecenv
from vecenv.interop.gymnasium import Env, GymnasiumError, VectorEnv, env_ids, make_vec, register_envs
from vecenv.interop.ids import NUM_TASKS
from vecenv.libero.render.options import UserCamera
from vecenv.placement import PlacementError

# -- images ------------------------------------------------------------------------------------------------------------

SMALL: dict[str, Any] = {"render": {"height": 32, "width": 48}, "episodes": [0], "task": TASK}


def test_images_and_proprioception_come_in_one_dictionary() -> None:
    env = Env(SUITE, obs="pixels+state", **SMALL)
    assert isinstance(env.observation_space, spaces.Dict)
    assert list(env.observation_space) == ["agentview", "state", "wrist"]
    seen, _ = env.reset()
    assert seen in env.observation_space
    assert (seen["agentview"].shape, seen["agentview"].dtype) == ((32, 48, 3), np.uint8)
    assert (seen["state"].shape, seen["state"].dtype) == ((8,), np.float32)
    images = env.batch.observe_egocentric().images
    np.testing.assert_array_equal(seen["agentview"], images["agentview"][0])
    np.testing.assert_array_equal(seen["wrist"], images["robot0_eye_in_hand_image"][0])
    env.close()


def test_cameras_can_be_chosen_and_others_are_refused_with_those_there_are() -> None:
    eye = UserCamera.looking_at("side", (1.0, 0.5, 1.5), (0.0, 0.0, 1.0))
    envs = make_vec(
        SUITE, obs="pixels", cameras=["side", "birdview"], **{**SMALL, "render": {**SMALL["render"], "cameras": [eye]}}
    )
    observations, _ = envs.reset()
    assert observations in envs.observation_space
    assert set(observations) == {"side", "birdview"}
    envs.close()
    with pytest.raises(GymnasiumError, match="agentview, wrist, birdview"):
        Env(SUITE, obs="pixels", cameras=["front"], **SMALL)


def test_render_shows_the_first_camera() -> None:
    env = Env(SUITE, obs="pixels+state", render_mode="rgb_array", **SMALL)
    seen, _ = env.reset()
    np.testing.assert_array_equal(env.render(), seen["agentview"])
    assert env.metadata["render_fps"] == 20
    env.close()
    silent = Env(SUITE, obs="state", **SMALL)
    assert silent.render() is None
    silent.close()
    with pytest.raises(GymnasiumError, match="'rgb_array' or None"):
        Env(SUITE, render_mode="human", **SMALL)
    envs = make_vec(SUITE, obs="state", render_mode="rgb_array", num_envs=2, **SMALL)
    envs.reset()
    frames = envs.render()
    assert frames is not None
    assert [frame.shape for frame in frames] == [(32, 48, 3)] * 2
    envs.close()


def test_gymnasiums_checker_has_nothing_to_say_about_images() -> None:
    env = gymnasium.make(f"vecenv/{SUITE}-1-v0", obs="pixels+state", render_mode="rgb_array", render=SMALL["render"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


def test_gymnasiums_wrappers_record_videos_and_statistics_and_limit_time(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    env = RecordVideo(
        Env(SUITE, obs="state", render_mode="rgb_array", **SMALL), str(tmp_path / "videos"), disable_logger=True
    )
    env = RecordEpisodeStatistics(TimeLimit(env, 3))
    env.reset(seed=0)
    for action in actions(3, count=1)[:, 0]:
        _, _, _, truncated, info = env.step(action)
    assert truncated
    assert (info["episode"]["l"], info["episode"]["r"]) == (3, 0.0)
    env.close()
    assert [path.suffix for path in (tmp_path / "videos").iterdir()] == [".mp4"]


def test_the_budget_of_an_episode_can_be_given_by_gymnasiums_name() -> None:
    env = Env(SUITE, task=TASK, episodes=[0], max_episode_steps=2)
    env.reset()
    assert [env.step(action)[3] for action in actions(2, count=1)[:, 0]] == [False, True]
    env.close()
    made = gymnasium.make(f"vecenv/{SUITE}-1-v0", max_episode_steps=2)
    made.reset()
    assert [made.step(action)[3] for action in actions(2, count=1)[:, 0]] == [False, True]
    made.close()
    with pytest.raises(GymnasiumError, match="same option"):
        Env(SUITE, max_episode_steps=2, max_steps=3)


# -- SIMPLER -----------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space:UserWarning")
def test_a_simpler_task_has_an_id_and_passes_the_checker(small: Path) -> None:
    pytest.importorskip("sapien")
    options: dict[str, Any] = {"assets": small, "num_threads": 1, "obs": "state", "max_steps": 3}
    env = gymnasium.make("vecenv/simpler_bridge-0-v0", **options)
    check_env(env.unwrapped, skip_render_check=True)
    _, info = env.reset(seed=1)
    assert info["instruction"] == "put the spoon on the towel"
    env.close()
    envs = make_vec("simpler/bridge", task="widowx_spoon_on_towel", num_envs=2, episodes=[3, 5], **options)
    _, infos = envs.reset()
    assert episodes(infos) == [3, 5]
    for action in actions(4, count=2):
        observations, _, _, _, infos = envs.step(action)
        assert observations in envs.observation_space
    assert episodes(infos) == [5, 3]
    with pytest.raises(PlacementError):
        envs.reset(options={"episode": 50})
    envs.close()


def test_simpler_has_no_object_poses_here(small: Path) -> None:
    pytest.importorskip("sapien")
    with pytest.raises(GymnasiumError, match="simpler/bridge has pixels, state, proprio"):
        Env("simpler/bridge", obs="objects", assets=small, num_threads=1)


# -- the registry ------------------------------------------------------------------------------------------------------


def test_every_task_has_an_id() -> None:
    ids = env_ids()
    assert len(ids) == len(set(ids)) == 315
    assert register_envs() == ids
    assert register_envs() == ids
    assert set(ids) <= set(gymnasium.registry)


def test_the_table_of_ids_is_that_of_the_suites() -> None:
    assert {suite: len(vecenv.list_tasks(suite)) for suite in vecenv.list_suites()} == NUM_TASKS
    with pytest.raises(KeyError, match="libero_90"):
        env_ids(["libero_91"])


def test_registering_loads_no_simulator() -> None:
    code = (
        "import sys, vecenv.interop.ids as ids\n"
        "loaded = {name.split('.')[0] for name in sys.modules}\n"
        "print(len(ids.env_ids()), sorted(loaded & {'mujoco', 'jax', 'sapien', 'scipy'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "315 []"


def test_an_id_with_the_modules_name_needs_no_import() -> None:
    code = (
        "import gymnasium, sys\n"
        "name = 'vecenv/libero_object-0-v0'\n"
        "assert name not in gymnasium.registry\n"
        "env = gymnasium.make(f'vecenv.interop.ids:{name}', max_steps=3)\n"
        "print(env.spec.id, env.unwrapped.batch.suite)\n"
        "env.close()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "vecenv/libero_object-0-v0 libero_object"


def test_the_registry_makes_one_batch_or_several_single_environments() -> None:
    register_envs([SUITE])
    options: dict[str, Any] = {"num_envs": 2, "episodes": POOL, "max_steps": 4}
    batch = gymnasium.make_vec(f"vecenv/{SUITE}-1-v0", autoreset_mode="SameStep", **options)
    assert isinstance(batch, VectorEnv)
    assert (batch.num_envs, batch.autoreset_mode) == (2, AutoresetMode.SAME_STEP)
    several = gymnasium.make_vec(f"vecenv/{SUITE}-1-v0", vectorization_mode="sync", **options)
    assert isinstance(several, SyncVectorEnv)
    assert_same(batch.reset(seed=2)[0], several.reset(seed=2)[0])
    batch.close()
    several.close()
