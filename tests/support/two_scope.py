"""VoxPoser as two loops over the layer: subtasks outside, waypoints inside, and one evaluation at the end."""

from __future__ import annotations

from vecenv.contract import BatchEnv
from voxposer.episode import (
    MAX_SUBTASKS,
    MAX_WAYPOINTS,
    Expanded,
    WaypointDispenser,
    check_done,
    check_waypoint_done,
    expand_for_settle,
    plan_executor,
)
from voxposer.runtime import Runtimes


def run_two_scopes(env: BatchEnv, runtimes: Runtimes, max_misses: int = 2) -> tuple[bool, int, str]:
    """One episode of an environment of one slot: its verdict, its ticks, and why the outer loop ended."""
    info = env.reset()
    (handle,) = runtimes.init(env.observe_objects().snapshot)
    subtasks = runtimes.planner([handle], info.instruction)
    index, reason, plan = [0], "", runtimes.config.plan
    for _ in range(MAX_SUBTASKS):
        snapshot = env.observe_objects().snapshot
        planned = runtimes.plan_subtask([handle], subtasks.subtask_list, index, snapshot)
        index = planned.next_subtask_index
        success, steps = follow(env, expand_for_settle(planned.trajectory, planned.prev_gripper, plan), max_misses)
        ended = check_done(index, subtasks.subtask_count, success, steps, info.max_steps)
        (reason,) = ended.reason
        if ended.done.all():
            break
    found = env.evaluate()
    runtimes.release([handle])
    return bool(found.success[0]), int(found.num_steps[0]), reason


def follow(env: BatchEnv, expanded: Expanded, max_misses: int) -> tuple[bool, int]:
    """The inner loop: whether the episode is solved, and its ticks."""
    dispenser, converged = WaypointDispenser(max_misses), None
    success, steps = False, 0
    for _ in range(MAX_WAYPOINTS):
        given = dispenser.dispense(expanded, converged)
        action, _ = plan_executor(given)
        control = env.step_ee_pose(dict(action))
        converged, success, steps = control.converged, bool(control.terminated[0]), int(control.step_index[0])
        if check_waypoint_done(given.done, success).done.all():
            break
    return success, steps
