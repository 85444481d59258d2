"""The layer between plans and verdicts: trajectories, changes of the grip, waypoints one at a time, done checks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from support.voxposer_world import HOME

from voxposer.episode import (
    ALL_SUBTASKS,
    ERROR,
    EXHAUSTED,
    STEP_BUDGET,
    SUBTASK_BUDGET,
    SUCCESS,
    WAYPOINT_BUDGET,
    Expanded,
    TrajectoryError,
    WaypointDispenser,
    check_done,
    check_waypoint_done,
    expand_for_settle,
    plan_executor,
    scattered,
    trajectory_of,
)
from voxposer.planning.plan import PlanConfig

PLAIN = PlanConfig(settle=0)


def waypoints(*grips: int, high: float = 0.4) -> np.ndarray:
    """Waypoints 1 cm apart with these grips, [T, 8]."""
    rows = [[0.01 * t, 0.0, high, *HOME[3:], grip] for t, grip in enumerate(grips)]
    return np.array(rows).reshape(-1, 8)


def expanded(*slots: Sequence[int], identity: int = 1, config: PlanConfig = PLAIN, **options: Any) -> Expanded:
    return expand_for_settle(trajectory_of([waypoints(*own) for own in slots], 0, identity), config=config, **options)


# -- changes of the grip -----------------------------------------------------------------------------------------------


def test_a_change_of_the_grip_becomes_a_drive_with_the_old_grip_and_a_hold() -> None:
    found = expanded((0, 0, 1, 1))
    plan = found.plan
    assert plan.grip[0, :5].tolist() == [0, 0, 0, 1, 1]
    assert plan.hold[0, :5].tolist() == [0, 0, 0, 60, 0]
    np.testing.assert_array_equal(plan.poses[0, 2], plan.poses[0, 3])
    assert (found.n_in[0], found.n_out[0], found.n_holds_inserted[0]) == (4, 5, 1)
    assert found.last_gripper[0]


def test_the_grip_continues_from_subtask_to_subtask() -> None:
    first = expanded((0, 1))
    second = expanded((1, 1), prev_gripper=first.last_gripper)
    assert second.n_holds_inserted[0] == 0
    assert expanded((1, 1)).n_holds_inserted[0] == 1  # from an open hand
    assert expanded((), prev_gripper=[True]).last_gripper[0]


def test_the_hand_settles_at_the_end_of_a_motion_and_before_a_change_of_the_grip() -> None:
    found = expanded((0, 1, 1), config=PlanConfig(settle=2, hold_ticks=7))
    assert found.plan.hold[0, : found.n_out[0]].tolist() == [0, 0, 0, 0, 7, 0, 0, 0]


def test_slots_are_expanded_as_alone_and_may_be_empty() -> None:
    both = expanded((0, 1, 0), ())
    alone = expanded((0, 1, 0))
    np.testing.assert_array_equal(both.plan.poses[0], alone.plan.poses[0])
    assert both.n_out.tolist() == [alone.n_out[0], 0]
    assert not both.plan.valid[1].any()


def test_a_budget_of_waypoints_cuts_the_trajectory_and_its_last_grip() -> None:
    found = expanded((0, 0, 1), max_waypoints=3)
    assert found.n_out[0] == 3
    assert not found.last_gripper[0]


def test_rows_of_some_slots_are_scattered_over_a_batch() -> None:
    whole = scattered([(np.array([2, 0]), expanded((0, 1), (0, 0, 0)))], 3, PLAIN)
    assert whole.n_out.tolist() == [3, 0, 3]
    assert whole.plan.hold[2, :3].tolist() == [0, 0, 60]
    assert whole.plan.valid.sum(axis=1).tolist() == [3, 0, 3]


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ([[0.0] * 7], r"slot 1: got shape \[1, 7\]; expected \[T, 8\]"),
        ([[np.nan] * 8], "slot 1: waypoint 0 is not finite"),
        ([["a"] * 8], "slot 1: not numbers"),
    ],
)
def test_waypoints_that_are_no_trajectory_are_refused(rows: Any, says: str) -> None:
    with pytest.raises(TrajectoryError, match=says):
        trajectory_of([waypoints(0), rows])


def test_one_value_for_each_slot_or_for_all() -> None:
    with pytest.raises(TrajectoryError, match="one for each of 2 slots"):
        expanded((0, 0), (0, 0), prev_gripper=[True, False, True])


# -- one waypoint at a time --------------------------------------------------------------------------------------------


def test_a_cursor_hands_out_every_waypoint_once() -> None:
    plan, dispenser = expanded((0, 1), (0, 0, 0, 0)), WaypointDispenser()
    given = [dispenser.dispense(plan) for _ in range(5)]
    assert [each.cursor.tolist() for each in given] == [[1, 1], [2, 2], [3, 3], [3, 4], [3, 4]]
    assert [each.has_waypoint.tolist() for each in given] == [
        [True] * 2,
        [True] * 2,
        [True] * 2,
        [False, True],
        [False] * 2,
    ]
    assert [each.done.tolist() for each in given] == [[False] * 2, [False] * 2, [True, False], [True] * 2, [True] * 2]
    assert given[1].progress.tolist() == [2 / 3, 0.5]
    assert [int(each.hold_steps[0]) for each in given] == [0, 0, 60, 0, 0]
    np.testing.assert_array_equal(given[3].waypoint[1], waypoints(0, 0, 0, 0)[3])


def test_a_new_trajectory_starts_at_its_first_waypoint_even_if_it_is_equal() -> None:
    dispenser = WaypointDispenser()
    dispenser.dispense(expanded((0, 0), (0, 0)))
    new = expanded((0, 0), (0, 0))._replace(identity=np.array([1, 2]))
    assert dispenser.dispense(new).cursor.tolist() == [2, 1]  # the second slot's is another one


def test_the_servo_carries_on_from_the_second_waypoint_of_a_trajectory() -> None:
    dispenser = WaypointDispenser()
    carried = [dispenser.dispense(expanded((0, 0), identity=n)).carry[0] for n in (1, 1, 2, 2)]
    assert carried == [False, True, False, True]


def test_after_too_many_misses_a_slot_goes_on_at_its_next_change_of_the_grip() -> None:
    plan, dispenser = expanded((0, 0, 0, 0, 1, 1), (0, 0, 0, 0, 0, 0)), WaypointDispenser(max_misses=2)
    converged = None
    for _ in range(3):
        given = dispenser.dispense(plan, converged)
        converged = [False, False]
    assert given.cursor.tolist() == [6, 6]  # the first slot skips to its hold, the second has none and ends
    assert given.hold_steps[0] == 60
    assert not given.carry[0]
    assert given.has_waypoint.tolist() == [True, False]


def test_a_waypoint_that_is_reached_starts_the_count_of_misses_anew() -> None:
    plan, dispenser = expanded((0,) * 6), WaypointDispenser(max_misses=2)
    for converged in (None, [False], [True], [False], [True], [False]):
        assert dispenser.dispense(plan, converged).has_waypoint.all()


def test_an_action_drives_only_the_slots_that_have_a_waypoint() -> None:
    plan, dispenser = expanded((0, 0), (0,)), WaypointDispenser()
    dispenser.dispense(plan)
    action, has_action = plan_executor(dispenser.dispense(plan))
    assert has_action.tolist() == action["slots"].tolist() == [True, False]
    np.testing.assert_array_equal(action["pose"][0], waypoints(0, 0)[1])
    assert action["carry"][0]


# -- done checks -------------------------------------------------------------------------------------------------------


def test_a_subtask_ends_with_success_its_trajectory_or_a_budget() -> None:
    found = check_waypoint_done([False, True, True, False], [False, False, True, False], waypoints=[79, 1, 1, 80])
    assert found.reason == ("", EXHAUSTED, SUCCESS, WAYPOINT_BUDGET)
    assert found.done.tolist() == [False, True, True, True]
    assert check_waypoint_done([False], [False], truncated=[True]).reason == (STEP_BUDGET,)
    assert not check_waypoint_done([False], [False], waypoints=10_000, max_waypoints=None).done.any()


def test_an_episode_ends_with_success_all_subtasks_or_a_budget() -> None:
    found = check_done([1, 3, 3, 0], [3, 3, 3, 3], [False, False, True, False], [5, 5, 5, 2500], 2500)
    assert found.reason == ("", ALL_SUBTASKS, SUCCESS, STEP_BUDGET)
    assert check_done([0], [3], [False], truncated=True).reason == (STEP_BUDGET,)
    assert check_done([0], [3], [False], failed=[True]).reason == (ERROR,)
    assert check_done([0], [9], [False], rounds=8).reason == (SUBTASK_BUDGET,)
    assert check_done([0], [9], [False], rounds=8, max_subtasks=None).reason == ("",)


def test_one_episode_is_a_batch_of_one() -> None:
    assert check_done(3, 3, False).done.shape == (1,)
    assert check_waypoint_done(True, False).reason == (EXHAUSTED,)
