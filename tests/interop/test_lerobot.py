"""What LeRobot reads of an environment, as its ``rollout`` and ``preprocess_observation`` do (LeRobot 0.6.1)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vecenv.interop.lerobot import LeRobotError, LeRobotOptions, LeRobotVectorEnv, make_envs

SUITE, COUNT, SIDE = "libero_object", 2, 32
OPTIONS = LeRobotOptions(height=SIDE, width=SIDE, episode_length=3)


@pytest.fixture
def env() -> Iterator[LeRobotVectorEnv]:
    env = make_envs(SUITE, num_envs=COUNT, tasks=[1], options=OPTIONS)[SUITE][1]
    yield env
    env.close()


def zeros() -> np.ndarray:
    return np.zeros((COUNT, 7), np.float32)


def episodes(infos: dict[str, Any]) -> list[int]:
    return [int(name.rsplit("/", 1)[1]) for name in infos["episode_id"]]


def solve(env: LeRobotVectorEnv, slot: int) -> None:
    """Overwrite the state so that the target object floats just above the floor of the basket."""
    batch: Any = env._batch
    state, snapshot = batch.state(), batch.observe_objects().snapshot[slot]
    _, target, region = snapshot.goal[0]
    address = batch.mj_model.joint(f"{target}_joint0").qposadr[0]
    state.qpos[slot, address : address + 3] = snapshot.regions[region].pos
    batch.set_state(state)


def test_environments_come_by_suite_and_task_and_nothing_is_built_before_reset() -> None:
    envs = make_envs("libero_object, libero_10", num_envs=3, tasks=[0, 4])
    assert {suite: list(tasks) for suite, tasks in envs.items()} == {"libero_object": [0, 4], "libero_10": [0, 4]}
    env = envs["libero_10"][4]
    assert (env.num_envs, env._batch) == (3, None)
    assert env.call("_max_episode_steps") == (520,) * 3
    assert len(make_envs("libero_goal", num_envs=1)["libero_goal"]) == 10


@pytest.mark.parametrize(
    ("suite", "steps"), [("libero_spatial", 280), ("libero_object", 280), ("libero_goal", 300), ("libero_90", 400)]
)
def test_budgets_are_lerobots(suite: str, steps: int) -> None:
    assert make_envs(suite, num_envs=1, tasks=[0])[suite][0].get_attr("_max_episode_steps") == (steps,)


def test_observations_are_what_preprocess_observation_takes(env: LeRobotVectorEnv) -> None:
    seen, infos = env.reset(seed=[1000, 1001], options={"lerobot_new_rollout": True})
    assert seen in env.observation_space
    pixels: Any = seen["pixels"]
    assert {name: (image.shape, image.dtype.name) for name, image in pixels.items()} == {
        "image": ((COUNT, SIDE, SIDE, 3), "uint8"),
        "image2": ((COUNT, SIDE, SIDE, 3), "uint8"),
    }
    state: Any = seen["agent_pos"]
    assert (state.shape, state.dtype.name) == ((COUNT, 8), "float32")
    assert infos["is_success"].tolist() == [False, False]
    np.testing.assert_array_equal(np.stack(env.render()), pixels["image"])
    assert env.call("task_description") == ("pick up the cream cheese and place it in the basket",) * COUNT
    assert env.call("task") == ("pick_up_the_cream_cheese_and_place_it_in_the_basket",) * COUNT
    assert env.unwrapped.metadata["render_fps"] == 20
    with pytest.raises(AttributeError, match="task_id"):
        env.call("nothing")


def test_an_episode_that_ended_stays_as_it_is_and_success_is_in_the_infos(env: LeRobotVectorEnv) -> None:
    env.reset()
    _, _, _, _, infos = env.step(zeros())
    assert infos["is_success"].tolist() == [False, False]
    assert "final_info" not in infos
    solve(env, 0)
    solved, reward, terminated, truncated, infos = env.step(zeros())
    assert (reward.tolist(), terminated.tolist(), truncated.tolist()) == ([1, 0], [True, False], [False, False])
    assert infos["final_info"]["is_success"].tolist() == [True, False]
    later, reward, terminated, truncated, infos = env.step(zeros())
    assert (reward.tolist(), terminated.tolist(), truncated.tolist()) == ([0, 0], [True, False], [False, True])
    assert infos["is_success"].tolist() == [True, False]
    before, after = np.asarray(solved["agent_pos"]), np.asarray(later["agent_pos"])
    np.testing.assert_array_equal(before[0], after[0])


def test_each_reset_goes_on_to_the_next_episodes_also_after_close(env: LeRobotVectorEnv) -> None:
    assert episodes(env.reset(seed=[1000, 1001])[1]) == [0, 1]
    assert episodes(env.reset(seed=[1002, 1003])[1]) == [2, 3]
    assert env._seed == 1000
    env.close()
    with pytest.raises(LeRobotError, match="reset"):
        env.step(zeros())
    assert episodes(env.reset()[1]) == [4, 5]


def test_simplers_tasks_have_their_own_camera_and_rate(small: Path) -> None:
    pytest.importorskip("sapien")
    fields = {"assets": small, "num_threads": 1}
    env = make_envs("simpler/bridge", num_envs=1, tasks=[0], options=LeRobotOptions(fields=fields))["simpler/bridge"][0]
    space: Any = env.single_observation_space
    assert {name: box.shape for name, box in space["pixels"].items()} == {"image": (480, 640, 3)}
    assert space["agent_pos"].shape == (23,)
    assert (env.call("_max_episode_steps"), env.metadata["render_fps"]) == ((60,), 5)


def test_what_does_not_exist_is_refused() -> None:
    with pytest.raises(LeRobotError, match="pixels, pixels_agent_pos"):
        LeRobotOptions(obs_type="state")
    with pytest.raises(LeRobotError, match="at least 1"):
        make_envs(SUITE, num_envs=0)
    with pytest.raises(KeyError, match="libero_object"):
        make_envs("libero_objects", num_envs=1)
