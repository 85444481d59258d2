# ruff: noqa: F722  (shapes in annotations)
"""Plans of a batch of hands, as tensors that ``env.step_waypoints`` executes in one call.

:class:`Stop` s of each slot come in (``vecenv.manipulation.routes``); a :class:`SubtaskPlan` goes out, a pytree of
arrays. Changes of the grip are expanded: fingers need physics ticks to move, so the hand first drives to the place of
the change with the previous grip, then holds still while the fingers move. The grip carries over from plan to plan.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Int, Num

from vecenv.manipulation.routes import Stop

AnyArray = Array | np.ndarray
# Ticks that fingers get to open or to close.
HOLD_TICKS = 60


@dataclass(frozen=True, kw_only=True)
class PlanConfig:
    """How stops become waypoints.

    Attributes:
        hold_ticks: ticks of standing still while the fingers move.
        settle: how often the end of a path is repeated. The follower leaves a waypoint within its tolerance (1 cm) and
            each repetition is at least one more tick towards the exact place. Upstream repeats it twice.
        full_speed: metres a tick that the follower moves at most. It knows no velocity, but takes at least a tick for
            each waypoint, so a slower way is one with waypoints close together.
        slowest: velocities below this count as this.
        lengths: plans are padded to a multiple of this many waypoints: few shapes, few compilations.
    """

    hold_ticks: int = HOLD_TICKS
    settle: int = 8
    full_speed: float = 0.005
    slowest: float = 0.1
    lengths: int = 16


class PlannedWaypoint(NamedTuple):
    """One waypoint: ``pose`` xyz + wxyz [7], ``closed``, ``hold`` ticks (0 drives), ``subtask``, ``velocity``."""

    pose: np.ndarray
    closed: bool
    hold: int
    subtask: int
    velocity: float


class SubtaskPlan(NamedTuple):
    """Waypoints of B slots, T each; a pytree.

    Attributes:
        poses: xyz in metres + wxyz, world frame, [B, T, 7].
        grip: 1 closed, 0 open, [B, T].
        hold: ticks without motion in place of the drive, int [B, T]; 0 drives.
        valid: bool [B, T]; the others are skipped.
        subtask: which subtask of the episode a waypoint belongs to, int [B, T].
        velocity: share of full speed that the velocity map asks for, [B, T].
    """

    poses: Num[AnyArray, "B T 7"]
    grip: Num[AnyArray, "B T"]
    hold: Int[AnyArray, "B T"]
    valid: Bool[AnyArray, "B T"]
    subtask: Int[AnyArray, "B T"]
    velocity: Num[AnyArray, "B T"]


def expand_flips(
    stops: Sequence[Stop], closed: bool, subtask: int = 0, config: PlanConfig = PlanConfig()
) -> tuple[list[PlannedWaypoint], bool]:
    """Waypoints of stops, each grip flip split in two: drive there with the grip as it was, then hold while it changes.

    Args:
        stops: in order.
        closed: the grip before the first.
        subtask: number to mark the waypoints with.
        config: how long a hold is.

    Returns:
        The waypoints, and the grip after the last.
    """
    rows: list[PlannedWaypoint] = []
    for stop in slowed(stops, config):
        pose = np.concatenate([stop.pos, stop.quat])
        drive = PlannedWaypoint(pose, closed, 0, subtask, stop.velocity)
        rows += [drive] * (1 + config.settle if stop.final or stop.closed != closed else 1)
        if stop.closed != closed:
            closed = stop.closed
            rows.append(drive._replace(closed=closed, hold=config.hold_ticks))
    return rows, closed


def slowed(stops: Sequence[Stop], config: PlanConfig = PlanConfig()) -> list[Stop]:
    """The stops, with more stops between those that are approached slowly."""
    result = list(stops[:1])
    for before, stop in itertools.pairwise(stops):
        if stop.velocity < 1:
            step = config.full_speed * max(stop.velocity, config.slowest)
            count = int(np.linalg.norm(stop.pos - before.pos) / step)
            between = (before.pos + (stop.pos - before.pos) * t for t in np.arange(1, count) / max(count, 1))
            result += [replace(stop, pos=pos, closed=before.closed, final=False) for pos in between]
        result.append(stop)
    return result


def stack(rows: Sequence[Sequence[PlannedWaypoint]], config: PlanConfig = PlanConfig()) -> SubtaskPlan:
    """The plan of a batch from the waypoints of each slot; a slot may have none."""
    length = max([1, *map(len, rows)])
    shape = (len(rows), -(-length // config.lengths) * config.lengths)
    plan = SubtaskPlan(
        poses=np.tile(np.array([0.0, 0, 0, 1, 0, 0, 0]), (*shape, 1)),
        grip=np.zeros(shape),
        hold=np.zeros(shape, int),
        valid=np.zeros(shape, bool),
        subtask=np.full(shape, -1),
        velocity=np.ones(shape),
    )
    for slot, own in enumerate(rows):
        for t, row in enumerate(own):
            plan.poses[slot, t], plan.grip[slot, t], plan.hold[slot, t] = row.pose, row.closed, row.hold
            plan.valid[slot, t], plan.subtask[slot, t], plan.velocity[slot, t] = True, row.subtask, row.velocity
    return plan


def remaining(plan: SubtaskPlan, ticks: Int[np.ndarray, "B T"]) -> SubtaskPlan:
    """The rest of a plan after some slots gave up.

    A slot gives up after several waypoints in a row that it could not reach. It resumes at the next change of
    the grip: the waypoints before it are out of reach, but the hand can still close or open where it is.

    Args:
        plan: the plan.
        ticks: ticks spent on each waypoint, int [B, T].
    """
    valid = plan.valid & (ticks == 0)
    for slot in np.flatnonzero(valid.any(axis=1)):
        done = np.flatnonzero(ticks[slot])
        if len(done):
            holds = np.flatnonzero(valid[slot] & (plan.hold[slot] > 0) & (np.arange(valid.shape[1]) > done[-1]))
            valid[slot, : holds[0] if len(holds) else None] = False
    return plan._replace(valid=valid)
