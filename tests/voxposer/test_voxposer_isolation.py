"""What goes wrong in one slot, in its program or in planning what it asked for, stops that slot and no other."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import pytest
from support.scripted import ScriptedLlm
from support.voxposer_world import HOME, Obedient, box, snapshot

from vecenv.contract import BatchEnv
from voxposer import pushing
from voxposer.agent import Agent, AgentConfig
from voxposer.paths import each_alone
from voxposer.slots import Slot

THINGS = {"cube_1": box((0.02, 0.02, 0.02), (0.2, 0.1, 0.02)), "plate_1": box((0.07, 0.07, 0.02), (0, 0, 0.02))}
GOOD = "execute(parse_query_obj('gripper'), affordance_map=get_affordance_map('above'))"
PUSH = "execute(parse_query_obj('plate'), affordance_map=get_affordance_map('aside'))"
PROGRAMS = {
    "gripper": "ret_val = detect('gripper')",
    "plate": "ret_val = detect('plate_1')",
    "above": "m = get_empty_affordance_map()\nx, y, z = detect('gripper').position\nm[x, y, z + 5] = 1\nret_val = m",
    "aside": "m = get_empty_affordance_map()\nx, y, z = detect('plate_1').position\nm[x + 20, y, z] = 1\nret_val = m",
    "doubled": "x = [0]\nfor i in range(60): x = [x, x]\nret_val = x",
    "number": "ret_val = np.array(5)",
}


def acting(*composers: str, **options: Any) -> tuple[Agent, Obedient]:
    """An agent with a slot for each program of a composer."""
    env = Obedient(*(snapshot(THINGS) for _ in composers))
    queries = [f"slot {number}" for number in range(len(composers))]
    written = dict(zip(queries, composers, strict=True))
    script = {
        **dict.fromkeys(("parse_query_obj", "get_affordance_map", "get_velocity_map"), lambda query: PROGRAMS[query]),
        "planner": lambda query: f'composer("{query}")',
        "composer": lambda query: written[query],
    }
    config = AgentConfig(passes=1, repairs=0, **options)
    return Agent(cast(BatchEnv, env), queries, ScriptedLlm(script), config), env


def moved(env: Obedient, slot: int) -> bool:
    return bool(np.abs(env.snapshots[slot].ee_pose[:3] - HOME[:3]).max() > 0.01)


ATTACKS = (
    "m = get_affordance_map('above')\nexecute({'name': 'plate_1', 'position': [1, 2], 'occupancy_map': m}, m)",
    "execute({'name': 'gripper', 'position': [1, 2, 3]}, get_affordance_map('above'))",
    "execute(parse_query_obj('doubled'), get_affordance_map('above'))",
    "execute(parse_query_obj('gripper'), get_affordance_map('doubled'))",
    "execute(parse_query_obj('gripper'), get_affordance_map('number'))",
    "v = get_empty_velocity_map()\nv[:] = -1\nexecute(parse_query_obj('gripper'), None, None, None, v)",
    "x = 1\x0cy = (",
    "raise ValueError('a' * 9999)",
    "while True: pass",
    "get_affordance_map(parse_query_obj('gripper'))",
    "for i in range(60): reset_to_default_pose()",
)


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_hostile_program_ends_its_own_slot_with_a_cause(attack: str) -> None:
    agent, env = acting(attack, GOOD)
    agent.step()
    assert agent.slots[0].cause.startswith("LmpError: ")
    assert len(agent.slots[0].cause) < 2001
    assert " at 0x" not in agent.slots[0].cause
    assert not agent.slots[0].requests
    assert not agent.slots[0].interface.requests
    assert not agent.slots[1].cause
    assert moved(env, 1)
    assert not moved(env, 0)


def fails_first(function: Callable[..., Any], error: Exception, chosen: Callable[..., bool]) -> Callable[..., Any]:
    """A function that raises where arguments are chosen."""

    def failing(*arguments: Any, **named: Any) -> Any:
        if chosen(*arguments, **named):
            raise error
        return function(*arguments, **named)

    return failing


@pytest.mark.parametrize(
    "place", ["voxposer.motions.stops_of", "voxposer.paths.plan_mapped", "voxposer.motions._remember_grasp"]
)
@pytest.mark.parametrize("error", [ZeroDivisionError("no room"), AssertionError(), MemoryError(), KeyError("x" * 9999)])
def test_an_unexpected_error_of_planning_stops_its_own_slot(
    place: str, error: Exception, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    agent, env = acting(GOOD, GOOD)
    unlucky: list[Slot] = [agent.slots[0]]

    def of_first(*arguments: Any, **_: Any) -> bool:
        ours = unlucky[0].interface.perception
        return any(value is ours or value is unlucky[0] for value in arguments)

    module, _, name = place.rpartition(".")
    target = __import__(module, fromlist=[name])
    monkeypatch.setattr(target, name, fails_first(getattr(target, name), error, of_first))
    with caplog.at_level(logging.ERROR):
        agent.step()
    assert type(error).__name__ in agent.slots[0].cause
    assert len(agent.slots[0].cause) < 2001
    assert caplog.records  # this package is to blame, so it says where
    assert not agent.slots[1].cause
    assert moved(env, 1)


def test_an_unexpected_error_in_a_program_stops_its_own_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    from voxposer.language.lmp import Lmps

    agent, env = acting(GOOD, GOOD)
    composer = Lmps.composer
    monkeypatch.setattr(Lmps, "composer", fails_first(composer, OSError("x"), lambda lmps, query: query == "slot 0"))
    agent.step()
    assert agent.slots[0].cause == "OSError: x"
    assert moved(env, 1)


def test_a_push_that_cannot_be_searched_stops_its_own_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    agent, env = acting(PUSH, GOOD)
    monkeypatch.setattr(
        pushing, "next_pushes", fails_first(pushing.next_pushes, RuntimeError("shape"), lambda *_: True)
    )
    agent.step()
    assert agent.slots[0].cause == "RuntimeError: shape"
    assert not agent.slots[1].cause
    assert moved(env, 1)


def test_a_motion_to_nowhere_stops_its_own_slot(monkeypatch: pytest.MonkeyPatch) -> None:
    agent, env = acting(GOOD, GOOD)
    from voxposer import motions

    plan = motions.stops_of

    def astray(request: Any, path: np.ndarray, perception: Any, route: Any, *, closed: bool) -> Any:
        stops = plan(request, path, perception, route, closed=closed)
        if perception is agent.slots[0].interface.perception:
            stops[-1].pos[0] = np.nan
        return stops

    monkeypatch.setattr(motions, "stops_of", astray)
    agent.step()
    assert "not finite" in agent.slots[0].cause
    assert moved(env, 1)
    assert np.isfinite(env.snapshots[0].ee_pose).all()


def test_rows_that_fail_together_are_tried_alone() -> None:
    asked: list[list[int]] = []

    def inverses(rows: Sequence[int]) -> list[float]:
        asked.append(list(rows))
        return [1 / row for row in rows]

    found = each_alone(inverses, [1, 0, 2])
    assert [found[0], type(found[1]), found[2]] == [1.0, ZeroDivisionError, 0.5]
    assert asked == [[1, 0, 2], [1], [0], [2]]
    assert each_alone(inverses, []) == []
    assert each_alone(inverses, [4, 5]) == [0.25, 0.2]
    assert asked[4:] == [[4, 5]]
