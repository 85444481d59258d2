"""What programs give to the functions that move the robot: only observations made by perception, only values in
range."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from support.scripted import ScriptedLlm
from support.voxposer_world import HOME, Obedient, box, snapshot

from vecenv.contract import BatchEnv
from voxposer.agent import Agent, AgentConfig
from voxposer.interface import MOST_MOTIONS, Interface, normalize_map, normalize_vector
from voxposer.language.observations import DynamicObservations
from voxposer.perception.config import HandState
from voxposer.perception.view import Perception
from voxposer.quaternions import euler2quat, pointat2quat, qmult
from voxposer.requests import InterfaceError

CUBE = {"cube_1": box((0.02, 0.02, 0.02), (0.2, 0.1, 0.02))}
SHAPE = (100, 100, 100)


def begin() -> Interface:
    interface = Interface()
    interface.begin(Perception(snapshot(CUBE), HandState(HOME, HOME, False)))
    return interface


def target() -> np.ndarray:
    volume = np.zeros(SHAPE)
    volume[70, 60, 30] = 1
    return volume


POSING = {"name": "cube_1", "position": [1, 2], "occupancy_map": np.ones(SHAPE)}


@pytest.mark.parametrize("movable", [POSING, "gripper", None, 3, {"name": "gripper", "position": [1, 2, 3]}])
@pytest.mark.usefixtures("unchecked_shapes")
def test_only_an_observation_is_moved(movable: Any) -> None:
    with pytest.raises(InterfaceError, match="movable: expected an observation from parse_query_obj or detect, got"):
        begin().execute(movable, target())


@pytest.mark.usefixtures("unchecked_shapes")
def test_several_things_are_moved_one_by_one() -> None:
    interface = begin()
    several = cast(Any, DynamicObservations(lambda: [interface.detect("cube_1"), interface.detect("gripper")]))
    with pytest.raises(InterfaceError, match="2 things; call execute for each"):
        interface.execute(several, target())


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("rotation_map", np.full((*SHAPE, 4), 1e300), "rotation map holds values that are not finite in single"),
        ("velocity_map", np.full(SHAPE, np.inf), "velocity map holds values that are not finite in single"),
        ("velocity_map", np.full(SHAPE, -0.5), "velocity map holds values below 0"),
        ("velocity_map", np.full(SHAPE, "fast"), "velocity map: expected numbers, got an array"),
        ("avoidance_map", [[1], [1, 2]], "avoidance map: expected numbers in rows of one length, got a list of 2"),
        ("velocity_map", np.full(SHAPE, 1e39), "velocity map holds values that are not finite in single"),
        ("gripper_map", np.full(SHAPE, np.nan), "gripper map holds values that are not finite in single"),
        ("avoidance_map", np.full(SHAPE, -1e200), "avoidance map holds values that are not finite in single"),
        ("affordance_map", np.full(SHAPE, 1e100), "affordance map holds values that are not finite in single"),
    ],
)
def test_maps_beyond_single_precision_are_refused(name: str, value: np.ndarray, says: str) -> None:
    interface = begin()
    with pytest.raises(InterfaceError, match=says):
        interface.execute(interface.detect("gripper"), **{"affordance_map": target(), name: value})


def test_a_long_quaternion_is_a_rotation_still() -> None:
    interface = begin()
    quats = np.full((*SHAPE, 4), 1e30)
    quats[0, 0, 0] = [1, 0, 0, 0]
    interface.execute(interface.detect("gripper"), target(), rotation_map=quats)
    np.testing.assert_allclose(interface.requests[0].rotation_at(np.array([70, 60, 30])), [0.5] * 4)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("cm", [1e300, float("inf"), float("nan"), "10", [1, 2], True])
def test_distances_are_numbers_of_a_workspace(cm: Any) -> None:
    interface = begin()
    for direction in ("x", np.array([0.0, 0.0, 1.0])):
        with pytest.raises(InterfaceError, match="cm: expected a number"):
            interface.cm2index(cm, direction)
    with pytest.raises(InterfaceError, match="index: expected a number"):
        interface.index2cm(cm)


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("value", [1e300, float("nan"), "abcd", None, np.zeros((4, 9, 1)), [[1], [1, 2]], {"w": 1}])
def test_rotations_are_made_of_finite_numbers_of_one_shape(value: Any) -> None:
    with pytest.raises(InterfaceError, match=r"^q: expected"):
        qmult([value] * 4 if isinstance(value, float) else value, [1, 0, 0, 0])
    with pytest.raises(InterfaceError, match=r"^roll: expected a number"):
        euler2quat(value, 0, 0)
    with pytest.raises(InterfaceError, match=r"^vector: expected"):
        pointat2quat([value] * 3 if isinstance(value, float) else value)


def test_a_subtask_has_so_many_motions() -> None:
    interface = begin()
    for _ in range(MOST_MOTIONS):
        interface.reset_to_default_pose()
    with pytest.raises(InterfaceError, match="more than 50 motions"):
        interface.reset_to_default_pose()
    with pytest.raises(InterfaceError, match="more than 50 motions"):
        interface.execute(interface.detect("gripper"), target())
    interface.restart()
    interface.reset_to_default_pose()


def test_the_maps_of_a_motion_count_for_the_program_that_asked() -> None:
    interface = begin()
    kept = interface.functions()["execute"](interface.detect("gripper"), target(), target())
    assert kept == interface.requests[0].nbytes > 5 * 10**6


def test_a_motion_keeps_no_array_that_its_program_can_change() -> None:
    interface = begin()
    maps = {"affordance_map": target(), "avoidance_map": target(), "gripper_map": target(), "velocity_map": target()}
    maps |= {"rotation_map": np.concatenate([np.ones((50, 100, 100, 4)), np.full((50, 100, 100, 4), 2.0)])}
    for dtype in (np.float64, np.float32):
        given = {name: value.astype(dtype) for name, value in maps.items()}
        interface.execute(interface.detect("gripper"), **given)
        kept = [value for value in vars(interface.requests[-1]).values() if isinstance(value, np.ndarray)]
        assert not any(np.shares_memory(mine, theirs) for mine in given.values() for theirs in kept)


def test_vectors_and_maps_are_scaled_as_upstreams_helpers_do() -> None:
    np.testing.assert_allclose(normalize_vector([3, 0, 4]), [0.6, 0, 0.8])
    np.testing.assert_allclose(normalize_vector([[0, 0, 2], [0, 0, 0]]), [[0, 0, 1], [0, 0, 0]])
    np.testing.assert_allclose(normalize_map([1, 3, 2]), [0, 1, 0.5])
    np.testing.assert_allclose(normalize_map([2, 2]), [2, 2])
    with pytest.raises(InterfaceError, match="expected 3 numbers or rows of 3 numbers, got 3"):
        normalize_vector(3)


GOOD = {
    "planner": 'composer("move up")',
    "composer": "execute(parse_query_obj('gripper'), affordance_map=get_affordance_map('above'))",
    "parse_query_obj": "ret_val = detect('gripper')",
    "get_affordance_map": (
        "affordance_map = get_empty_affordance_map()\nx, y, z = parse_query_obj('gripper').position\n"
        "affordance_map[x, y, z + 5] = 1\nret_val = affordance_map"
    ),
}
POSED = "m = get_affordance_map('above')\nexecute({'name': 'cube_1', 'position': [1, 2], 'occupancy_map': m}, m)"


@pytest.mark.parametrize(
    ("composer", "says"),
    [
        (POSED, "expected an observation"),
        (
            "execute(parse_query_obj('gripper'), affordance_map=get_affordance_map('above'), rotation_map=zeros())",
            "zeros",
        ),
        (
            "m = get_empty_rotation_map()\nm[:] = 0\nexecute(detect('gripper'), get_affordance_map('a'), None, m)",
            "length zero",
        ),
        (
            "m = get_empty_rotation_map()\nm[:] = 1e300\nexecute(detect('gripper'), get_affordance_map('a'), None, m)",
            "single precision",
        ),
        (
            "m = get_empty_velocity_map()\nm[:] = np.inf\nexecute(detect('gripper'), None, None, None, m)",
            "single precision",
        ),
        (
            "m = get_empty_affordance_map()\nm[0, 0, 0] = 1\nexecute(detect('cube_1'), m[:50])",
            "expected (100, 100, 100)",
        ),
        ("execute(detect('table'), get_affordance_map('a'))", "it is fixed"),
        ("try:\n    execute(None)\nexcept Exception as e:\n    raise ValueError(str(e))", "expected an observation"),
    ],
)
def test_a_program_that_asks_for_what_cannot_be_planned_stops_its_own_slot(composer: str, says: str) -> None:
    env = Obedient(snapshot(CUBE), snapshot(CUBE))
    asked: list[str] = []

    def answer(query: str) -> str:
        asked.append(query)
        return composer if query == "bad" else GOOD["composer"]

    script = {**GOOD, "planner": lambda query: f'composer("{query}")', "composer": answer}
    acting = Agent(cast(BatchEnv, env), ("bad", "good"), ScriptedLlm(script), AgentConfig(passes=1))
    acting.step()
    assert says in acting.slots[0].cause
    assert len(acting.slots[0].cause) < 1000
    assert not acting.slots[1].cause
    assert env.snapshots[1].ee_pose[2] > HOME[2]
