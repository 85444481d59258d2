"""LIBERO behind Gymnasium's interfaces: its checker passes, and a batch behaves as its own vector environment does."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation
from support.gymnasium_batch import COUNT, MODES, POOL, SUITE, TASK, actions, assert_same, episodes

import vecenv
from vecenv.actions import ActionError
from vecenv.interop.gymnasium import Env, GymnasiumError, VectorEnv, make_vec, register_envs
from vecenv.libero.env import LiberoEnv
from vecenv.placement import PlacementError


def vector(**options: Any) -> VectorEnv:
    return make_vec(SUITE, **{"task": TASK, "num_envs": COUNT, "episodes": POOL, "max_steps": 4, **options})


@pytest.fixture
def envs() -> Iterator[VectorEnv]:
    envs = vector()
    yield envs
    envs.close()


def solve(batch: Any, slots: Sequence[int]) -> None:
    """Overwrite the state so that the target object floats just above the floor of the basket."""
    state, snapshots = batch.state(), batch.observe_objects().snapshot
    for slot in slots:
        snapshot = snapshots[slot]
        assert snapshot is not None
        _, target, region = snapshot.goal[0]
        address = batch.mj_model.joint(f"{target}_joint0").qposadr[0]
        state.qpos[slot, address : address + 3] = snapshot.regions[region].pos
    batch.set_state(state)


# -- a batch and Gymnasium's own vector environment --------------------------------------------------------------------


class Pair:
    """A batch, and as many single environments in ``SyncVectorEnv``, driven alike."""

    def __init__(self, mode: AutoresetMode) -> None:
        def single() -> Env:
            return Env(SUITE, task=TASK, episodes=POOL, max_steps=4)

        self.ours = vector(autoreset_mode=mode)
        self.theirs = SyncVectorEnv([single] * COUNT, autoreset_mode=mode)

    def call(self, verb: str, *args: Any, **kwargs: Any) -> Any:
        ours = getattr(self.ours, verb)(*args, **_copied(kwargs))
        assert_same(list(ours), list(getattr(self.theirs, verb)(*args, **_copied(kwargs))))
        return ours

    def solve(self, slot: int) -> None:
        solve(self.ours.batch, [slot])
        for index, env in enumerate(self.theirs.envs):
            batch = env.unwrapped.batch  # type: ignore[attr-defined]
            solve(batch, [0] if index == slot else [])

    def close(self) -> None:
        self.ours.close()
        self.theirs.close()


def _copied(kwargs: dict[str, Any]) -> dict[str, Any]:
    return {name: dict(value) if isinstance(value, dict) else value for name, value in kwargs.items()}


@pytest.fixture(params=MODES, ids=lambda mode: mode.value)
def pair(request: pytest.FixtureRequest) -> Iterator[Pair]:
    pair = Pair(request.param)
    yield pair
    pair.close()


def test_every_step_is_that_of_gymnasiums_own_vector_environment(pair: Pair) -> None:
    pair.call("reset", seed=11)
    ended = np.zeros(COUNT, bool)
    kinds = []
    for tick, action in enumerate(actions(8)):
        if tick == 1:
            pair.solve(1)
        _, _, terminated, truncated, _ = pair.call("step", action)
        ended = terminated | truncated
        kinds += [("terminated", tick)] if terminated.any() else []
        kinds += [("truncated", tick)] if truncated.any() else []
        if ended.any() and pair.ours.autoreset_mode is AutoresetMode.DISABLED:
            pair.call("reset", options={"reset_mask": ended})
    assert kinds[:2] == [("terminated", 1), ("truncated", 3)]
    assert len(kinds) > 2
    pair.call("reset")
    pair.call("reset", seed=[3, None, 5])


def test_spaces_and_metadata_are_those_of_gymnasiums_own(pair: Pair) -> None:
    for name in ("single_action_space", "action_space", "single_observation_space", "observation_space", "num_envs"):
        assert getattr(pair.ours, name) == getattr(pair.theirs, name)
    assert pair.ours.metadata == pair.theirs.metadata
    observations, _ = pair.call("reset", seed=0)
    assert observations in pair.ours.observation_space
    assert pair.ours.np_random_seed == pair.theirs.np_random_seed == (0, 1, 2)
    assert len(pair.ours.np_random) == COUNT


def test_wrong_arguments_are_refused_as_gymnasiums_own_refuses_them(pair: Pair) -> None:
    mask = np.ones(COUNT, bool)
    for wrong, error in (
        ({"options": {"reset_mask": mask.tolist()}}, TypeError),
        ({"options": {"reset_mask": mask.astype(int)}}, TypeError),
        ({"options": {"reset_mask": mask[:-1]}}, ValueError),
        ({"options": {"reset_mask": ~mask}}, ValueError),
        ({"seed": [1]}, ValueError),
    ):
        for envs in (pair.ours, pair.theirs):
            with pytest.raises(error):
                envs.reset(**_copied(wrong))  # type: ignore[arg-type]


# -- autoreset ---------------------------------------------------------------------------------------------------------


def run_out(envs: VectorEnv) -> tuple[Any, ...]:
    """Step until the budget of all episodes ends."""
    results = [envs.step(action) for action in actions(4)]
    assert results[-1][3].all()
    return results[-1]


def test_with_next_step_the_terminal_observation_stays_for_one_call() -> None:
    envs = vector()
    envs.reset()
    assert run_out(envs)[-1]["step_index"].tolist() == [4, 4, 4]
    observations, reward, terminated, truncated, infos = envs.step(actions(1)[0])
    assert not np.concatenate([reward, terminated, truncated]).any()
    assert episodes(infos) == [7, 9, 4]
    assert "step_index" not in infos
    again, _ = envs.reset(options={"episode": [7, 9, 4]})
    assert_same(observations, again)
    envs.close()


def test_with_same_step_the_terminal_observation_is_in_the_infos() -> None:
    envs, plain = vector(autoreset_mode="SameStep"), vector(autoreset_mode="Disabled")
    envs.reset()
    plain.reset()
    observations, _, _, _, infos = run_out(envs)
    terminal, *_, said = run_out(plain)
    for slot in range(COUNT):
        assert_same(infos["final_obs"][slot], {name: values[slot] for name, values in terminal.items()})
    assert_same(infos["final_info"], said)
    assert episodes(infos) == [7, 9, 4]
    _, _, _, truncated, infos = envs.step(actions(1)[0])
    assert not truncated.any()
    assert infos["step_index"].tolist() == [1, 1, 1]
    assert "final_obs" not in infos
    assert observations["proprio"].shape == (COUNT, 8)
    envs.close()
    plain.close()


def test_with_disabled_an_ended_episode_waits_for_a_reset() -> None:
    envs = vector(autoreset_mode="Disabled")
    envs.reset()
    solve(envs.batch, [2])
    _, reward, terminated, _, _ = envs.step(actions(1)[0])
    assert (reward.tolist(), terminated.tolist()) == ([0, 0, 1], [False, False, True])
    with pytest.raises(ResetNeeded, match=r"\[2\]"):
        envs.step(actions(1)[0])
    _, infos = envs.reset(options={"reset_mask": terminated})
    assert infos["_episode_id"].tolist() == [False, False, True]
    assert episodes(infos) == [None, None, 4]
    _, _, _, _, infos = envs.step(actions(1)[0])
    assert infos["step_index"].tolist() == [2, 2, 1]
    envs.close()


def test_a_broken_world_ends_its_own_episode_and_is_replaced() -> None:
    envs = vector(max_steps=50)
    envs.reset()
    state = envs.batch.state()
    state.qvel[1] = 1e9
    envs.batch.set_state(state)
    observations, _, terminated, truncated, infos = envs.step(actions(1)[0])
    assert (terminated.tolist(), truncated.tolist()) == ([False] * 3, [False, True, False])
    assert [bool(fault) for fault in infos["fault"]] == [False, True, False]
    assert observations in envs.observation_space
    _, _, _, _, infos = envs.step(actions(1)[0])
    _, _, terminated, truncated, infos = envs.step(actions(1)[0])
    assert not (terminated | truncated).any()
    assert infos["fault"].tolist() == ["", "", ""]
    envs.close()


# -- which episode comes next ------------------------------------------------------------------------------------------


def test_every_episode_comes_once_before_any_comes_again(envs: VectorEnv) -> None:
    assert [episodes(envs.reset()[1]) for _ in range(4)] == [[4, 7, 9], [7, 9, 4], [9, 4, 7], [4, 7, 9]]


def test_a_seed_decides_the_orders() -> None:
    envs = vector(episodes=range(20))

    def orders(seed: int) -> np.ndarray:
        first = episodes(envs.reset(seed=seed)[1])
        return np.array([first] + [episodes(envs.reset()[1]) for _ in range(19)])

    once, again, other = orders(5), orders(5), orders(6)
    np.testing.assert_array_equal(once, again)
    np.testing.assert_array_equal(np.sort(once, axis=0).T, [np.arange(20)] * COUNT)
    assert (once[:, 0] != once[:, 1]).any()
    # A sub-environment's order hangs on its own seed: here the second of seed 5 is the first of seed 6.
    np.testing.assert_array_equal(once[:, 1], other[:, 0])
    envs.close()


def test_an_episode_can_be_asked_for(envs: VectorEnv) -> None:
    assert episodes(envs.reset(options={"episode": 13})[1]) == [13, 13, 13]
    assert episodes(envs.reset(options={"episode": [1, 2, 3]})[1]) == [1, 2, 3]
    # Asking changes nothing about what comes otherwise.
    assert episodes(envs.reset()[1]) == [4, 7, 9]
    for wrong in (50, [1, 2]):
        with pytest.raises(PlacementError):
            envs.reset(options={"episode": wrong})


def test_a_batch_of_several_tasks_and_scenes_keeps_its_tasks() -> None:
    batch = vecenv.make(SUITE, tasks=[0, 2], episodes={0: [1, 2], 2: [5]}, max_steps=2)
    assert isinstance(batch, LiberoEnv)
    envs = VectorEnv(batch, obs="objects")
    observations, infos = envs.reset()
    assert observations in envs.observation_space
    names = ["libero_object/0/1", "libero_object/0/2", "libero_object/2/5"]
    assert infos["episode_id"].tolist() == names
    assert infos["instruction"][0] != infos["instruction"][2]
    assert set(envs.layouts[0]) != set(envs.layouts[2])
    names = [name for _ in range(3) for name in envs.step(actions(1)[0])[-1].get("episode_id", [])]
    assert names == ["libero_object/0/2", "libero_object/0/1", "libero_object/2/5"]
    envs.close()


# -- one environment ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("obs", ["proprio", ("proprio", "objects")])
def test_gymnasiums_checker_has_nothing_to_say(obs: Any) -> None:
    register_envs([SUITE])
    env = gymnasium.make(f"vecenv/{SUITE}-1-v0", max_steps=20, obs=obs)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


def test_observations_say_where_things_are() -> None:
    env = Env(SUITE, task=TASK, episodes=[6])
    seen, info = env.reset()
    assert info["episode_id"] == f"{SUITE}/{TASK}/6"
    (snapshot,) = env.batch.observe_objects().snapshot
    assert snapshot is not None
    for name, pose in snapshot.poses.items():
        np.testing.assert_allclose(seen["objects"][env.layout[name]], pose, atol=1e-6)
    np.testing.assert_allclose(seen["proprio"], env.batch.observe_egocentric().state[0])
    env.close()


def test_drawers_are_observed() -> None:
    env = Env("libero_goal", task=0, episodes=[0], obs="objects")
    seen: Any = env.reset()[0]
    batch: Any = env.batch
    (group,) = batch.physics.groups
    joints = [group.scene.model.joint(joint).qposadr[0] for entity in group.scene.fixtures for joint in entity.joints]
    assert joints
    np.testing.assert_allclose(seen[env.layout["fixture_joints"]], group.qpos[0, joints], atol=1e-6)
    env.close()


def test_gymnasiums_wrappers_apply() -> None:
    env = FlattenObservation(Env(SUITE, task=TASK, episodes=[0]))
    observation, _ = env.reset(seed=0)
    assert observation.shape == env.observation_space.shape
    env.close()


def test_actions_that_are_no_numbers_are_mended_and_wrong_shapes_refused(envs: VectorEnv) -> None:
    with pytest.raises(ResetNeeded):
        envs.step(np.zeros((COUNT, 7)))
    envs.reset()
    action = np.zeros((COUNT, 7))
    action[1, 0] = np.nan
    assert envs.step(action)[-1]["sanitized"].tolist() == [False, True, False]
    with pytest.raises(ActionError):
        envs.step(np.zeros((COUNT, 6)))


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: vector(obs="depths"), GymnasiumError),
        (lambda: vector(obs=()), GymnasiumError),
        (lambda: vector(num_envs=0), GymnasiumError),
        (lambda: vector(episodes=[50]), PlacementError),
        (lambda: vector(autoreset_mode="never"), ValueError),
    ],
)
def test_options_that_do_not_exist_are_refused(make: Callable[[], Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        make()


def test_a_reset_option_that_does_not_exist_is_refused(envs: VectorEnv) -> None:
    with pytest.raises(GymnasiumError, match="'start'"):
        envs.reset(options={"start": 1})


def test_closing_twice_is_harmless(envs: VectorEnv) -> None:
    envs.reset()
    envs.close()
    envs.close()
    assert envs.closed
