"""Whatever a caller gives to an environment is taken for what it says or refused, and a refusal changes nothing."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.calls import NEVER, VERBS, plan, told

import vecenv
from vecenv.contract import State
from vecenv.errors import VecenvError
from vecenv.placement import Placement, PlacementError

B = 2
BRIDGE = "simpler/bridge"


@pytest.fixture(scope="module", params=["libero_object", BRIDGE])
def env(request: pytest.FixtureRequest, small: Path) -> Iterator[Any]:
    if request.param == BRIDGE:
        pytest.importorskip("sapien")
        made: Any = vecenv.make(BRIDGE, task=0, episodes=[0, 1], assets=small, num_threads=1)
    else:
        made = vecenv.make(request.param, task=0, episodes=[0, 1], num_threads=1)
    made.reset()
    made.step_continuous(np.full((B, 2, 7), 0.1))
    yield made
    made.close()


@pytest.mark.parametrize("verb", VERBS)
def test_what_no_verb_takes_is_refused_by_a_sentence_and_changes_nothing(env: Any, verb: str) -> None:
    for name, value in NEVER.items():
        if name in VERBS[verb].takes:
            continue
        before = told(env)
        with pytest.raises(VecenvError) as raised:
            VERBS[verb].verb(env, value())
        said = str(raised.value)
        assert said
        assert len(said) < 2000, name
        assert told(env) == before, name


@pytest.mark.parametrize("verb", ["end_episodes(slots)", "step_ee_pose(slots)", "observe_objects(slots)"])
@pytest.mark.parametrize("slots", [[-1], [B], [0, 0], [[0]], [0.0], np.array([0.0]), [True], [True] * 3, ["0"], "0"])
def test_slots_that_are_none_are_refused(env: Any, verb: str, slots: Any) -> None:
    before = told(env)
    with pytest.raises(PlacementError, match="slots"):
        VERBS[verb].verb(env, slots)
    assert told(env) == before


@pytest.mark.parametrize("slots", [np.int64(1), [1], (1,), range(1, 2), np.array([False, True]), [False, True]])
def test_slots_are_any_indices_or_a_mask(env: Any, slots: Any) -> None:
    assert [each is not None for each in env.observe_objects(slots=slots).snapshot] == [False, True]
    assert [each is not None for each in env.observe_objects(slots=(i for i in [1])).snapshot] == [False, True]


def test_a_mapping_of_a_pose_has_known_keys_and_a_pose(env: Any) -> None:
    with pytest.raises(ValueError, match="unknown key 'holds'; expected pose, hold_steps, carry, slots"):
        env.step_ee_pose({"pose": [], "holds": 3})
    with pytest.raises(ValueError, match="a mapping without 'pose'"):
        env.step_ee_pose({"hold_steps": 3})
    with pytest.raises(ValueError, match="plan: unknown key 'girp'; expected poses, grip, hold, valid"):
        env.step_waypoints(plan(env, "girp", np.zeros((B, 1))))


def test_a_state_of_other_scenes_is_refused_and_says_so(env: Any) -> None:
    state = env.state()
    before = told(env)
    with pytest.raises(VecenvError, match="the state of other scenes: nq is"):
        env.set_state(dataclasses.replace(state, nq=state.nq + 1))
    assert isinstance(state, State)
    assert told(env) == before


def test_episodes_go_to_slots_in_the_order_they_are_named_in(env: Any) -> None:
    before = env.placement.episode.tolist()
    env.set_episodes(episodes=[7, 8], slots=[1, 0])
    assert env.placement.episode.tolist() == [8, 7]
    env.set_episodes(episodes=before)
    env.reset()


def test_a_placement_cannot_be_written_to_from_outside(env: Any) -> None:
    with pytest.raises(ValueError, match="read-only"):
        env.placement.task[0] = 1


@pytest.mark.parametrize(
    ("task", "episode"),
    [([0.5], [0]), ([True], [0]), (["0"], [0]), ([-1], [0]), ([0], [0, 1]), ([], []), ([[0]], [[0]]), ([2**40], [0])],
)
def test_a_placement_is_made_of_indices(task: Any, episode: Any) -> None:
    with pytest.raises(PlacementError):
        Placement(task, episode)


def test_a_placement_that_fails_leaves_the_batch_where_it_was() -> None:
    pose = ([0.0, 0.0, 0.9], [1.0, 0.0, 0.0, 0.0])
    with vecenv.make("libero_goal", task=0, episodes=[0, 1], cameras=["agentview"], num_threads=1) as env:
        env.reset()
        env.step_continuous(np.full((B, 2, 7), 0.1))
        before = told(env)
        for wrong in ({"tasks": 99}, {"episodes": [0, 99]}, {"episodes": [0, 1, 2]}, {"tasks": ["no such task", 0]}):
            with pytest.raises(VecenvError):
                env.set_episodes(**wrong)
            with pytest.raises(VecenvError):
                env.set_episodes(slots=[1], **wrong)
        assert told(env) == before
    for poses in ({"wooden_cabinet_1": ([0.0, 0.0], pose[1])}, {"wooden_cabinet_1": 3}, {"flat_stove_1": ("a", "b")}):
        with pytest.raises(VecenvError, match="fixtures"):
            vecenv.make("libero_goal", task=0, episodes=[0, 1], fixtures=poses)
    with pytest.raises(VecenvError, match="3 rows"):
        vecenv.make("libero_goal", task=0, episodes=[0, 1], fixtures={"flat_stove_1": (np.zeros((3, 3)), pose[1])})


def test_a_scene_that_cannot_be_made_leaves_the_batch_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """The physics of the present scene is given up only when that of the next one stands."""
    with vecenv.make("libero_10", task=0, episodes=[0, 1], num_threads=1) as env:
        env.reset()
        before = told(env)

        def no_physics(*_: object, **__: object) -> None:
            raise VecenvError("no memory")

        monkeypatch.setattr("vecenv.libero.env.make_physics", no_physics)
        with pytest.raises(VecenvError, match="no memory"):
            env.set_episodes(tasks=[0, 2])
        assert told(env) == before
        assert (env.step_continuous(np.zeros((B, 7))).step_index == 1).all()


def test_a_reset_that_fails_starts_no_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    from vecenv.libero import starts

    with vecenv.make("libero_object", tasks=[0, 1], episodes=[0], num_threads=1, max_steps=1) as env:
        env.reset()
        env.step_continuous(np.zeros((B, 7)))
        before, start_of = told(env), starts.start_of
        calls = itertools.count()

        def second_fails(*args: Any, **options: Any) -> Any:
            if next(calls):
                raise starts.StoredStartsError("no starts")
            return start_of(*args, **options)

        monkeypatch.setattr(starts, "start_of", second_fails)
        with pytest.raises(VecenvError, match="no starts"):
            env.reset()
        assert told(env) == before


# -- make --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suite", ["libero_object", BRIDGE])
def test_what_make_takes_nowhere_is_refused_there(suite: str, small: Path) -> None:
    if suite == BRIDGE:
        pytest.importorskip("sapien")
    usual: dict[str, Any] = {"task": 0, "episodes": [0], **({"assets": small} if suite == BRIDGE else {})}
    config = vecenv.registry.family_of(suite).config_type()
    names = [field.name for field in dataclasses.fields(config)]
    for name, (label, value) in itertools.product(
        ["suite", "task", "tasks", "episodes", "config", *names], NEVER.items()
    ):
        options = {**usual, "suite": suite, name: value()}
        if name == "tasks":
            del options["task"]
        if (name, label) in {("seed", "too large")}:
            continue
        with pytest.raises(VecenvError) as raised:
            vecenv.make(options.pop("suite"), **options).close()
        assert len(str(raised.value)) < 2000, (name, label)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"max_steps": 10**30}, "max_steps=.*at least 1, at most 2147483647"),
        ({"num_threads": 10**6}, "num_threads=1000000: need at least 1, at most 4096"),
        ({"seed": -1}, "seed=-1: need at least 0"),
        ({"num_devices": 2}, "num_devices=2: for the backends of MJX"),
        ({"waypoint": {"pos_tol": float("nan")}}, "pos_tol=nan: expected a finite number"),
        ({"waypoint": {"pos_tol": -0.1}}, "pos_tol=-0.1: expected a number greater than 0"),
        ({"waypoint": {"max_steps": 0}}, "max_steps=0: need at least 1"),
        ({"render": {"num_threads": 0}}, "num_threads=0: need at least 1"),
        ({"episodes": {0: [0], 7: [1]}}, "episodes: 7 is none of the tasks, 0"),
        ({"episodes": {True: [0]}}, "episodes: True is none of the tasks"),
        ({"episodes": "9" * 5000}, "cannot read"),
        ({"task": "9" * 5000}, "cannot read"),
        ({"task": [0, 1]}, "several go into tasks"),
        ({"episodes": range(10**12)}, "more than 1048576 entries"),
    ],
)
def test_sizes_and_signs_of_options_are_checked(options: dict[str, Any], says: str) -> None:
    with pytest.raises(VecenvError, match=says):
        vecenv.make("libero_object", **{"task": 0, "episodes": [0], **options})


@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        ("LiberoConfig", {"max_steps": 1.5}),
        ("LiberoConfig", {"max_steps": True}),
        ("LiberoConfig", {"deterministic": "no"}),
        ("LiberoConfig", {"contacts": "usual"}),
        ("SimplerConfig", {"shadows": 1}),
        ("SimplerConfig", {"max_steps": "60"}),
        ("RenderConfig", {"height": 64.0}),
        ("RenderConfig", {"antialias": "yes"}),
    ],
)
def test_a_config_checks_its_fields_however_it_is_made(kind: str, fields: dict[str, Any]) -> None:
    with pytest.raises(VecenvError, match=next(iter(fields))):
        getattr(vecenv, kind)(**fields)


def test_numpy_scalars_are_numbers() -> None:
    config = vecenv.LiberoConfig(max_steps=np.int64(3), deterministic=np.bool_(True))  # type: ignore[arg-type]
    assert type(config.max_steps) is int
    assert config.deterministic is True


@pytest.mark.parametrize("suite", ["libero_object", BRIDGE])
def test_generators_are_read_once_and_serve_every_task(suite: str, small: Path) -> None:
    options: dict[str, Any] = {"assets": small, "num_threads": 1} if suite == BRIDGE else {}
    with vecenv.make(suite, tasks=iter([1, 0]), episodes=(i for i in (2, 3)), **options) as env:
        assert env.placement.task.tolist() == [1, 1, 0, 0]
        assert env.placement.episode.tolist() == [2, 3, 2, 3]


def test_visual_options_are_numbers_and_visual_options() -> None:
    from vecenv.libero.render.options import CameraShift, RenderError, UserCamera, VisualOptions

    for wrong in (
        {"light": np.nan},
        {"light_color": (1, 1)},
        {"colors": {"robot": "red"}},
        {"cameras": {"agentview": 3}},
    ):
        with pytest.raises(RenderError):
            VisualOptions(**wrong)  # type: ignore[arg-type]
    with pytest.raises(RenderError, match="pos"):
        CameraShift(pos=(0.0, np.nan, 0.0))
    with pytest.raises(RenderError, match="fovy"):
        UserCamera(name="side", pos=[0, 0, 1], quat=[1, 0, 0, 0], fovy="wide")  # type: ignore[arg-type]
    with vecenv.make("libero_object", task=0, episodes=[0, 1], num_threads=1) as env:
        for value in (3, "dark", [VisualOptions()], [None, None]):
            with pytest.raises(RenderError):
                env.set_visuals(value)  # type: ignore[attr-defined]
