"""Two ways to follow the expanded trajectories of a batch: the whole plan in one call, or one waypoint a call.

In: an environment and what ``voxposer.episode.expand_for_settle`` returned. Out: :class:`Followed`. On native physics
both ways take the same ticks and end in the same states, bit for bit, because ``step_ee_pose`` can carry on from the
waypoint before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np

from vecenv.contract import BatchEnv, Control
from voxposer.episode import Expanded, WaypointDispenser, check_waypoint_done, plan_executor
from voxposer.planning import plan as plans

Following = Literal["plan", "waypoint"]


class Followed(NamedTuple):
    """``control`` of the last call, with the rewards of all, and the waypoints that were ``missed``, int [B]."""

    control: Control
    missed: np.ndarray


def follow_plan(env: BatchEnv, expanded: Expanded, max_misses: int | None) -> Followed:
    """Follow whole plans with ``env.step_waypoints``; see :data:`FOLLOW`."""
    plan, missed, reward = expanded.plan, np.zeros(env.num_envs, int), np.zeros(env.num_envs)
    while True:
        control = env.step_waypoints(plan, max_misses=max_misses)
        reward = reward + control.reward
        out_of_reach = plan.valid & (control.waypoint_ticks > 0) & ~control.converged & (plan.hold == 0)
        missed += np.asarray(out_of_reach).sum(axis=1)
        plan = plans.remaining(plan, control.waypoint_ticks)
        plan = plan._replace(valid=plan.valid & ~control.done[:, None])
        if not plan.valid.any():
            return Followed(replace(control, reward=reward), missed)


def follow_waypoints(env: BatchEnv, expanded: Expanded, max_misses: int | None) -> Followed:
    """Follow waypoint by waypoint with ``env.step_ee_pose``; see :data:`FOLLOW`."""
    dispenser, converged = WaypointDispenser(max_misses), None
    missed, reward = np.zeros(env.num_envs, int), np.zeros(env.num_envs)
    while True:
        given = dispenser.dispense(expanded, converged)
        action, has_action = plan_executor(given)
        control = env.step_ee_pose(dict(action))
        reward = reward + control.reward
        moved = control.step_count > 0
        missed += has_action & moved & ~control.converged & (given.hold_steps == 0)
        # A waypoint that was refused, or whose episode is over, was not out of reach.
        converged = control.converged | ~moved
        ended = check_waypoint_done(given.done, control.terminated, truncated=control.truncated, max_waypoints=None)
        if ended.done.all():
            return Followed(replace(control, reward=reward), missed)


# How a plan is followed -> function of the environment, the plan, and after how many waypoints in a row that were not
# reached a slot goes on at its next change of the grip.
FOLLOW: Mapping[Following, Callable[[BatchEnv, Expanded, int | None], Followed]] = MappingProxyType(
    {"plan": follow_plan, "waypoint": follow_waypoints}
)
