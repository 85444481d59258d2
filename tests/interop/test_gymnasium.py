"""LIBERO behind Gymnasium's interfaces: its checker passes, and a batch behaves as its own vector environment does."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation, RecordEpisodeStatistics, RecordVideo, TimeLimit

import vecenv
from vecenv.actions import ActionError
from vecenv.interop.gymnasium import Env, GymnasiumError, VectorEnv, env_ids, make_vec, register_envs
from vecenv.interop.ids import NUM_TASKS
from vecenv.libero.env import LiberoEnv
from vecenv.libero.render.options import UserCamera
from vecenv.placement import PlacementError

SUITE, TASK, COUNT = "libero_object", 1, 3
POOL = (4, 7, 9)
MODES = tuple(AutoresetMode)


def vector(**options: Any) -> VectorEnv:
    return make_vec(SUITE, **{"task": TASK, "num_envs": COUNT, "episodes": POOL, "max_steps": 4, **options})


@pytest.fixture
def envs() -> Iterator[VectorEnv]:
    envs = vector()
    yield envs
    envs.close()


def actions(ticks: int, seed: int = 0, count: int = COUNT) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (ticks, count, 7)).astype(np.float32)


def episodes(infos: Mapping[str, Any]) -> list[int | None]:
    return [None if name is None else int(name.rsplit("/", 1)[1]) for name in infos["episode_id"]]


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


def assert_same(ours: Any, theirs: Any) -> None:
    """Equal to the last bit, with the same names, shapes and types."""
    if isinstance(theirs, Mapping):
        assert set(ours) == set(theirs)
        for name, value in theirs.items():
            assert_same(ours[name], value)
    elif isinstance(theirs, list | tuple) or (isinstance(theirs, np.ndarray) and theirs.dtype == object):
        assert getattr(ours, "dtype", None) == getattr(theirs, "dtype", None)
        for our, their in zip(ours, theirs, strict=True):
            assert_same(our, their)
    elif isinstance(theirs, np.ndarray):
        assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype)
        np.testing.assert_array_equal(ours, theirs)
    else:
        assert ours == theirs


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
