"""From paths to plans: grip flips, the way around things, thinning, and what is left of a plan that was given up."""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.voxposer_world import HOME, box, snapshot

from vecenv import actions
from vecenv.manipulation.routes import RouteConfig, Stop, corners, is_contact_move, travel_route, work_route
from vecenv.manipulation.world import Margins, SceneGeometry
from voxposer.planning.plan import PlanConfig, PlannedWaypoint, expand_flips, remaining, slowed, stack

pytestmark = pytest.mark.usefixtures("no_rank_promotion")

DOWN = np.array([0.0, 1.0, 0.0, 0.0])
CONFIG = PlanConfig(settle=2, lengths=4)


def stop(x: float, z: float = 0.3, *, closed: bool = False, final: bool = False, velocity: float = 1.0) -> Stop:
    return Stop(np.array([x, 0.0, z]), DOWN, closed, velocity, final)


def row(x: float, *, closed: bool = False, hold: int = 0) -> PlannedWaypoint:
    return PlannedWaypoint(np.array([x, 0, 0.3, *DOWN]), closed, hold, 0, 1.0)


# -- grip --------------------------------------------------------------------------------------------------------------


def test_a_grip_change_is_reached_with_the_old_grip_then_held() -> None:
    rows, closed = expand_flips([stop(0.1), stop(0.2, closed=True), stop(0.3, closed=True)], False, 5, CONFIG)
    assert closed
    flip = next(i for i, r in enumerate(rows) if r.hold)
    assert not any(r.closed for r in rows[:flip])
    assert all(r.closed for r in rows[flip:])
    assert rows[flip].hold == 60
    assert [r.hold for r in rows if r.hold] == [60]
    np.testing.assert_allclose(rows[flip].pose, rows[flip - 1].pose)
    assert {r.subtask for r in rows} == {5}


def test_the_grip_carries_over_from_one_plan_to_the_next() -> None:
    rows, closed = expand_flips([stop(0.1, closed=True)], True, 0, CONFIG)
    assert closed
    assert all(r.closed and not r.hold for r in rows)
    rows, closed = expand_flips([stop(0.1)], closed, 0, CONFIG)
    assert not closed
    assert sum(r.hold > 0 for r in rows) == 1


def test_the_end_of_a_path_is_repeated_to_reach_it_exactly() -> None:
    rows, _ = expand_flips([stop(0.1), stop(0.2, final=True)], False, 0, CONFIG)
    assert [r.pose[0] for r in rows] == [0.1, 0.2, 0.2, 0.2]


@given(st.lists(st.booleans(), min_size=1, max_size=8), st.booleans())
def test_every_grip_change_is_held_once_and_nothing_else(grips: list[bool], before: bool) -> None:
    rows, after = expand_flips([stop(0.01 * i, closed=g) for i, g in enumerate(grips)], before, 0, CONFIG)
    flips = sum(a != b for a, b in zip([before, *grips[:-1]], grips, strict=True))
    assert sum(r.hold > 0 for r in rows) == flips
    assert after == grips[-1]
    seen = before
    for r in rows:
        assert r.closed == seen or r.hold
        seen = r.closed


def test_slow_motions_have_closely_spaced_waypoints() -> None:
    quick, slow = ([stop(0.0), stop(0.1, velocity=v)] for v in (1.0, 0.2))
    assert len(slowed(quick)) == 2
    xs = np.array([s.pos[0] for s in slowed(slow)])
    assert np.diff(xs).max() == pytest.approx(0.001)
    assert xs[-1] == 0.1


# -- tensors -----------------------------------------------------------------------------------------------------------


def test_a_plan_is_a_pytree_that_step_waypoints_takes() -> None:
    plan = stack([[row(0.1), row(0.2, closed=True, hold=60)], []], CONFIG)
    assert plan.poses.shape == (2, 4, 7)
    assert [leaf.shape[:2] for leaf in jax.tree.leaves(plan)] == [(2, 4)] * 6
    assert plan.valid.tolist() == [[True, True, False, False], [False] * 4]
    checked, errors = actions.plan(plan, 2)
    assert errors == ("", "")
    np.testing.assert_array_equal(checked.valid, plan.valid)
    np.testing.assert_array_equal(checked.hold[0], [0, 60, 0, 0])


def test_an_empty_plan_is_valid() -> None:
    assert not stack([[], []], CONFIG).valid.any()


def test_a_stuck_hand_resumes_at_the_next_grip_change() -> None:
    rows = [row(0.1), row(0.2), row(0.3), row(0.3, closed=True, hold=60), row(0.5, closed=True)]
    plan = stack([rows, rows], PlanConfig(lengths=1))
    ticks = np.array([[20, 100, 0, 0, 0], [20, 5, 5, 60, 30]])
    np.testing.assert_array_equal(remaining(plan, ticks).valid, [[0, 0, 0, 1, 1], [0] * 5])
    assert not remaining(plan, np.array([[20, 100, 100, 60, 100]] * 2)).valid.any()


# -- the way there -----------------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=2, max_size=30), st.floats(0.01, 0.3))
def test_thinning_keeps_the_ends_and_the_tolerance(points: list[tuple[float, float, float]], tolerance: float) -> None:
    path = np.array(points)
    kept = corners(path, tolerance, np.zeros(len(path), bool))
    assert kept[0] == 0
    assert kept[-1] == len(path) - 1
    for a, b in itertools.pairwise(kept):
        way, rest = path[b] - path[a], path[a + 1 : b] - path[a]
        share = np.clip(rest @ way / max(float(way @ way), 1e-12), 0, 1)
        assert (np.linalg.norm(rest - share[:, None] * way, axis=1) <= tolerance + 1e-9).all()


def tower_world() -> SceneGeometry:
    """A tower of 25 cm between the hand and a place behind it."""
    return SceneGeometry(
        snapshot({"tower_1": box((0.03, 0.03, 0.125), (0.2, 0, 0.125))}, ee_pose=HOME * [1, 1, 0.25, 1, 1, 1, 1]),
        Margins(),
    )


def travel(stops: list[Stop], world: SceneGeometry, held: str = "") -> list[Stop]:
    down = np.array([0.0, 0.0, -1.0])
    return travel_route(stops, (down, down), world, held, RouteConfig())


def test_a_travelling_hand_passes_over_obstacles() -> None:
    stops = [stop(0.0, 0.1), stop(0.2, 0.1), stop(0.4, 0.05, final=True)]
    route = travel(stops, tower_world())
    assert route[0].pos[0] == 0.0  # up first
    above = [s for s in route if 0.05 < s.pos[0] < 0.35] + [route[0], route[-2]]
    assert min(s.pos[2] for s in above) > 0.25 + Margins().gripper.tip
    np.testing.assert_allclose(route[-1].pos, [0.4, 0, 0.05])
    np.testing.assert_allclose(route[-2].pos[:2], [0.4, 0])  # and straight down at the end
    assert route[-1].final
    assert not any(s.final for s in route[:-1])


def test_what_hangs_from_the_hand_clears_obstacles_too() -> None:
    world = SceneGeometry(
        snapshot(
            {"tower_1": box((0.03, 0.03, 0.125), (0.2, 0, 0.125)), "bottle_1": box((0.02, 0.02, 0.1), (0, 0, 0.1))},
            ee_pose=np.array([0, 0, 0.19, *DOWN]),
        ),
        Margins(),
    )
    stops = [stop(0.0, 0.19, closed=True), stop(0.2, 0.19, closed=True), stop(0.4, 0.3, closed=True, final=True)]
    top = max(s.pos[2] for s in travel(stops, world, "bottle_1"))
    assert top > 0.25 + 0.18


def test_the_grip_closes_at_the_goal_and_not_above_it() -> None:
    stops = [stop(0.0, 0.1), stop(0.2, 0.1), stop(0.4, 0.05, closed=True, final=True)]
    assert [s.closed for s in travel(stops, tower_world())][:-1] == [False] * (len(travel(stops, tower_world())) - 1)


def test_straight_up_is_no_detour() -> None:
    route = travel([stop(0.2, 0.1), stop(0.2, 0.15), stop(0.2, 0.2, final=True)], tower_world())
    assert len(route) == 1


def test_an_object_under_an_overhang_is_moved_aside_before_lifting() -> None:
    plank = box((0.1, 0.1, 0.01), (0.0, 0.11, 0.15), 2000)
    things = {"plank_1": plank, "cube_1": box((0.02, 0.02, 0.02), (0, 0, 0.03))}
    world = SceneGeometry(snapshot(things, ee_pose=np.array([0, 0, 0.05, *DOWN])), Margins())
    ups = [stop(0.0, 0.05, closed=True), stop(0.0, 0.1, closed=True), stop(0.0, 0.2, closed=True, final=True)]
    route = travel(ups, world, "cube_1")
    assert route[0].pos[2] == pytest.approx(0.05)
    assert route[0].pos[1] < -0.015  # out from under the plank, whose edge is at y = 0.01
    np.testing.assert_allclose(route[-1].pos[:2], route[0].pos[:2])
    assert len(travel(ups, world)) == 1  # an empty hand goes straight up


def test_a_tilted_hand_comes_along_its_own_axis() -> None:
    tilt = np.array([0.8, 0.0, -0.6])
    quat = np.array([np.cos(1.107), 0.0, np.sin(1.107), 0.0])
    goal = replace(stop(0.4, 0.1, final=True), quat=quat)
    route = travel_route([stop(0.0, 0.1), goal], (np.array([0, 0, -1.0]), tilt), tower_world(), "", RouteConfig())
    before = route[-2].pos - goal.pos
    np.testing.assert_allclose(before / np.linalg.norm(before), -tilt, atol=1e-6)


def test_only_a_closed_empty_hand_is_in_contact() -> None:
    start, level, down = np.array([0, 0, 0.2]), np.array([0.15, 0, 0.2]), np.array([0.15, 0, 0.05])
    options = {"held": "", "attached": "", "config": RouteConfig()}
    assert is_contact_move(start, level, closed=True, **options)
    assert not is_contact_move(start, level, closed=False, **options)
    assert not is_contact_move(start, down, closed=True, **options)
    assert is_contact_move(start, down, closed=True, **{**options, "attached": "cabinet_1"})
    assert not is_contact_move(start, level, closed=True, **{**options, "held": "cube_1"})


def test_a_hand_in_contact_follows_its_path() -> None:
    bent = [stop(0.0), stop(0.1), Stop(np.array([0.1, 0.1, 0.3]), DOWN, True, 1.0, True)]
    assert [tuple(s.pos) for s in work_route(bent)] == [tuple(s.pos) for s in bent]
    straight = [stop(0.0), stop(0.1, 0.301), stop(0.2, final=True)]
    assert len(work_route(straight)) == 2
