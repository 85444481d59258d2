# ruff: noqa: F722  (shapes in annotations)
"""Steps of an episode between a plan and its verdict, as functions of arrays with one row for each slot.

A :class:`Trajectory` comes in, as ``voxposer.runtime`` plans it for a subtask. :func:`expand_for_settle` splits its
changes of the grip, :class:`WaypointDispenser` hands its waypoints out one at a time, :func:`plan_executor` turns one
into an action of ``env.step_ee_pose``, :func:`check_waypoint_done` says when a subtask's waypoints are followed, and
:func:`check_done` when the episode is over. One episode alone is a batch of one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypedDict

import numpy as np
import numpy.typing as npt
from jaxtyping import Bool, Float, Int

from vecenv.errors import InvalidInput
from vecenv.manipulation.routes import Stop
from voxposer.planning.plan import PlanConfig, PlannedWaypoint, SubtaskPlan, expand_flips, stack

# Budgets of the two loops: subtasks of an episode, and waypoints of a subtask.
MAX_SUBTASKS = 8
MAX_WAYPOINTS = 80
# An identity turned into a quaternion: what a row without a waypoint holds.
_NOWHERE = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
_POSE_DIM = 8


class TrajectoryError(InvalidInput):
    """Waypoints that are no trajectory; the message names the slot and says what is expected."""


class Trajectory(NamedTuple):
    """Waypoints of a subtask in each of B slots, before changes of the grip are expanded; T each, padded.

    Attributes:
        waypoints: xyz in metres, wxyz, grip (1 closed, 0 open), world frame, [B, T, 8].
        velocity: share of full speed, [B, T].
        final: the end of a motion, at which the hand settles, bool [B, T].
        motion: number of the motion within the subtask, from 0, int [B, T]; a subtask may have several.
        valid: bool [B, T]; the others are padding.
        subtask: number of the subtask in the episode, int [B].
        identity: a number of its own for each trajectory of a slot, int [B].
    """

    waypoints: Float[np.ndarray, "B T 8"]
    velocity: Float[np.ndarray, "B T"]
    final: Bool[np.ndarray, "B T"]
    motion: Int[np.ndarray, "B T"]
    valid: Bool[np.ndarray, "B T"]
    subtask: Int[np.ndarray, " B"]
    identity: Int[np.ndarray, " B"]

    @property
    def n_waypoints(self) -> Int[np.ndarray, " B"]:
        """Waypoints of each slot, int [B]."""
        return self.valid.sum(axis=1)


def trajectory_of_stops(
    motions: Sequence[Sequence[Sequence[Stop]]], subtask: npt.ArrayLike, identity: npt.ArrayLike
) -> Trajectory:
    """The trajectories of B slots from the stops of their motions.

    Args:
        motions: of each slot, the motions of its subtask in order, each a list of stops; a slot may have none.
        subtask: number of the subtask, int [B].
        identity: of the trajectory, int [B].
    """
    rows = [[(number, stop) for number, motion in enumerate(own) for stop in motion] for own in motions]
    shape = len(rows), max([1, *map(len, rows)])
    result = Trajectory(
        waypoints=np.tile(_NOWHERE, (*shape, 1)),
        velocity=np.ones(shape),
        final=np.zeros(shape, bool),
        motion=np.full(shape, -1),
        valid=np.zeros(shape, bool),
        subtask=_column(subtask, shape[0], int),
        identity=_column(identity, shape[0], int),
    )
    for slot, own in enumerate(rows):
        for t, (number, stop) in enumerate(own):
            result.waypoints[slot, t] = [*stop.pos, *stop.quat, stop.closed]
            result.velocity[slot, t], result.final[slot, t] = stop.velocity, stop.final
            result.motion[slot, t], result.valid[slot, t] = number, True
    return result


def trajectory_of(
    waypoints: Sequence[npt.ArrayLike], subtask: npt.ArrayLike = 0, identity: npt.ArrayLike = 0
) -> Trajectory:
    """The trajectories of B slots from plain 8-vectors, as a planner of one's own may give them.

    Each slot's waypoints are one motion at full speed; the hand settles at the last.

    Args:
        waypoints: of each slot, [T, 8] xyz in metres, wxyz, grip (1 closed, 0 open), world frame; empty for none.
        subtask: number of the subtask, one number or int [B].
        identity: of the trajectory, one number or int [B].

    Raises:
        TrajectoryError: another shape, or numbers that are not finite.
    """
    return trajectory_of_stops([_stops(slot, own) for slot, own in enumerate(waypoints)], subtask, identity)


def _stops(slot: int, waypoints: npt.ArrayLike) -> list[list[Stop]]:
    try:
        rows = np.asarray(waypoints, float)
    except (TypeError, ValueError) as error:
        raise TrajectoryError(f"trajectory of slot {slot}: not numbers, or ragged ({error})") from error
    if rows.size == 0:
        return []
    if rows.ndim != 2 or rows.shape[1] != _POSE_DIM:
        raise TrajectoryError(f"trajectory of slot {slot}: got shape {list(rows.shape)}; expected [T, {_POSE_DIM}]")
    if not np.isfinite(rows).all():
        bad = int(np.argwhere(~np.isfinite(rows))[0, 0])
        raise TrajectoryError(f"trajectory of slot {slot}: waypoint {bad} is not finite")
    last = len(rows) - 1
    return [[Stop(row[:3], row[3:7], bool(row[7] > 0.5), final=t == last) for t, row in enumerate(rows)]]


# -- changes of the grip -----------------------------------------------------------------------------------------------


class Expanded(NamedTuple):
    """What :func:`expand_for_settle` returns.

    Attributes:
        plan: the waypoints to follow, which ``env.step_waypoints`` takes as they are.
        identity: of the trajectory, int [B].
        n_in: waypoints of the trajectory, int [B].
        n_out: waypoints to follow, int [B].
        n_holds_inserted: changes of the grip, int [B].
        last_gripper: grip after the last waypoint (1 closed, 0 open), bool [B]; pass it on as ``prev_gripper``.
    """

    plan: SubtaskPlan
    identity: Int[np.ndarray, " B"]
    n_in: Int[np.ndarray, " B"]
    n_out: Int[np.ndarray, " B"]
    n_holds_inserted: Int[np.ndarray, " B"]
    last_gripper: Bool[np.ndarray, " B"]


def expand_for_settle(
    trajectory: Trajectory,
    prev_gripper: npt.ArrayLike = False,
    config: PlanConfig = PlanConfig(),  # noqa: B008  (frozen)
    *,
    max_waypoints: int | None = None,
) -> Expanded:
    """Split every change of the grip: drive there with the grip as it was, then hold still while the fingers move.

    Args:
        trajectory: of each slot.
        prev_gripper: whether the grip is closed before the first waypoint, one value or bool [B]:
            ``last_gripper`` of the call before, or ``prev_gripper`` of ``plan_subtask``.
        config: ``hold_ticks`` is the length of a hold (60), ``settle`` how often the end of a motion is repeated.
        max_waypoints: keep no more than this many of each slot; None for all.
    """
    count = len(trajectory.valid)
    closed = _column(prev_gripper, count, bool)
    rows = [_expanded(trajectory, slot, bool(closed[slot]), config)[:max_waypoints] for slot in range(count)]
    return Expanded(
        plan=stack(rows, config),
        identity=trajectory.identity,
        n_in=trajectory.n_waypoints,
        n_out=np.array([len(own) for own in rows], int),
        n_holds_inserted=np.array([sum(row.hold > 0 for row in own) for own in rows], int),
        last_gripper=np.array([own[-1].closed if own else was for own, was in zip(rows, closed, strict=True)], bool),
    )


def scattered(parts: Sequence[tuple[np.ndarray, Expanded]], count: int, config: PlanConfig) -> Expanded:
    """One row for each of ``count`` slots, from expanded trajectories of some of them.

    Args:
        parts: indices of slots, int [n], and their expanded trajectories. Where a slot is named twice, the later one
            counts; a slot that is not named has no waypoint.
        count: B.
        config: how plans are padded.
    """
    width = max([config.lengths, *(part.plan.valid.shape[1] for _, part in parts)])
    plan = stack([[]] * count, replace(config, lengths=width))
    identity, n_in, n_out, n_holds = np.zeros((4, count), int)
    whole = Expanded(plan, identity, n_in, n_out, n_holds, np.zeros(count, bool))
    for rows, part in parts:
        for ours, theirs in zip(whole.plan, part.plan, strict=True):
            ours[rows, : theirs.shape[1]] = theirs
        for ours, theirs in zip(whole[1:], part[1:], strict=True):
            ours[rows] = theirs
    return whole


def _expanded(trajectory: Trajectory, slot: int, closed: bool, config: PlanConfig) -> list[PlannedWaypoint]:
    """The waypoints to follow of one slot, motion by motion."""
    rows: list[PlannedWaypoint] = []
    steps = np.flatnonzero(trajectory.valid[slot]).tolist()
    for _, own in itertools.groupby(steps, key=lambda t: trajectory.motion[slot, t]):
        stops = [_stop(trajectory, slot, t) for t in own]
        waypoints, closed = expand_flips(stops, closed, int(trajectory.subtask[slot]), config)
        rows += waypoints
    return rows


def _stop(trajectory: Trajectory, slot: int, t: int) -> Stop:
    row = trajectory.waypoints[slot, t]
    velocity, final = float(trajectory.velocity[slot, t]), bool(trajectory.final[slot, t])
    return Stop(row[:3], row[3:7], bool(row[7] > 0.5), velocity, final)


# -- one waypoint at a time --------------------------------------------------------------------------------------------


class Dispensed(NamedTuple):
    """One waypoint for each slot.

    Attributes:
        waypoint: xyz in metres, wxyz, grip (1 closed, 0 open), world frame, [B, 8].
        hold_steps: ticks without motion in place of the drive, int [B]; 0 drives.
        carry: the servo carries on from the waypoint before, bool [B].
        has_waypoint: bool [B]; False where the trajectory is exhausted.
        cursor: index of the next waypoint, int [B].
        done: no waypoint is left after this one, bool [B].
        progress: share of the trajectory that was handed out, [B] in 0..1; 1 for an empty one.
    """

    waypoint: Float[np.ndarray, "B 8"]
    hold_steps: Int[np.ndarray, " B"]
    carry: Bool[np.ndarray, " B"]
    has_waypoint: Bool[np.ndarray, " B"]
    cursor: Int[np.ndarray, " B"]
    done: Bool[np.ndarray, " B"]
    progress: Float[np.ndarray, " B"]


class WaypointDispenser:
    """A cursor over expanded trajectories, one for each slot.

    A slot whose trajectory has another ``identity`` than in the call before starts at its first waypoint.

    Args:
        max_misses: after this many waypoints in a row that were not reached, a slot goes on at its next change of the
            grip, or ends if there is none: the waypoints before it are out of reach, but the hand can still close or
            open where it is. None: every waypoint is handed out. Needs ``converged`` in every call.
    """

    def __init__(self, max_misses: int | None = None) -> None:
        self._max_misses = max_misses
        self.reset()

    def reset(self) -> None:
        """Forget all trajectories."""
        self._identity = np.zeros(0, int)
        self._index = np.zeros(0, int)
        self._given = np.zeros(0, int)
        self._misses = np.zeros(0, int)
        self._carry = np.zeros(0, bool)

    def dispense(self, expanded: Expanded, converged: npt.ArrayLike | None = None) -> Dispensed:
        """The next waypoint of every slot.

        Args:
            expanded: what :func:`expand_for_settle` returned.
            converged: whether the waypoint that was handed out before was reached, bool [B] (``step_ee_pose`` returns
                it). It counts in slots whose trajectory is the same as before.
        """
        plan, count = expanded.plan, np.asarray(expanded.plan.valid).sum(axis=1)
        self._begin(expanded.identity)
        if converged is not None and self._max_misses is not None:
            self._learn(np.asarray(plan.hold), count, _column(converged, len(count), bool), self._max_misses)
        rows, has = np.arange(len(count)), self._index < count
        at = np.where(has, self._index, 0)
        waypoint = np.concatenate([np.asarray(plan.poses)[rows, at], np.asarray(plan.grip)[rows, at, None]], axis=1)
        carry = has & self._carry
        self._given = np.where(has, self._index, -1)
        self._index, self._carry = self._index + has, self._carry | has
        return Dispensed(
            waypoint=np.where(has[:, None], waypoint, _NOWHERE),
            hold_steps=np.where(has, np.asarray(plan.hold)[rows, at], 0),
            carry=carry,
            has_waypoint=has,
            cursor=self._index.copy(),
            done=self._index >= count,
            progress=np.where(count > 0, self._index / np.maximum(count, 1), 1.0),
        )

    def _begin(self, identity: np.ndarray) -> None:
        """Start new trajectories at their first waypoint."""
        if len(identity) != len(self._identity):
            self._identity = np.asarray(identity).copy()
            new = np.ones(len(identity), bool)
            self._index, self._given, self._misses = (np.zeros(len(identity), int) for _ in range(3))
            self._carry = np.zeros(len(identity), bool)
        else:
            new = self._identity != identity
            self._identity = np.asarray(identity).copy()
        self._index[new], self._given[new], self._misses[new], self._carry[new] = 0, -1, 0, False

    def _learn(self, hold: np.ndarray, count: np.ndarray, converged: np.ndarray, max_misses: int) -> None:
        """Count waypoints in a row that were not reached, and skip to the next hold after too many."""
        for slot in np.flatnonzero(self._given >= 0):
            if hold[slot, self._given[slot]]:
                continue
            self._misses[slot] = 0 if converged[slot] else self._misses[slot] + 1
            if self._misses[slot] >= max_misses:
                ahead = np.flatnonzero(hold[slot, self._index[slot] : count[slot]])
                self._index[slot] = self._index[slot] + ahead[0] if len(ahead) else count[slot]
                self._misses[slot], self._carry[slot] = 0, False


class EePoseAction(TypedDict):
    """An action of ``env.step_ee_pose``: ``pose`` [B, 8], ``hold_steps`` int [B], ``carry`` and ``slots`` bool [B]."""

    pose: np.ndarray
    hold_steps: np.ndarray
    carry: np.ndarray
    slots: np.ndarray


def plan_executor(dispensed: Dispensed) -> tuple[EePoseAction, Bool[np.ndarray, " B"]]:
    """The action of ``env.step_ee_pose`` for the waypoints that were handed out.

    Returns:
        The action, in which slots without a waypoint stand still; and which slots have one, bool [B].
    """
    action = EePoseAction(
        pose=dispensed.waypoint,
        hold_steps=dispensed.hold_steps,
        carry=dispensed.carry,
        slots=dispensed.has_waypoint,
    )
    return action, dispensed.has_waypoint


# -- when to stop ------------------------------------------------------------------------------------------------------

SUCCESS = "success"
EXHAUSTED = "trajectory exhausted"
WAYPOINT_BUDGET = "waypoint budget spent"
STEP_BUDGET = "env step budget spent"
ERROR = "error"
ALL_SUBTASKS = "all subtasks complete"
SUBTASK_BUDGET = "subtask budget spent"


class Done(NamedTuple):
    """Whether a loop ends: ``done`` bool [B], and ``reason``, B strings, "" where it goes on."""

    done: Bool[np.ndarray, " B"]
    reason: tuple[str, ...]


def check_waypoint_done(
    cursor_done: npt.ArrayLike,
    episode_success: npt.ArrayLike,
    *,
    truncated: npt.ArrayLike = False,
    waypoints: npt.ArrayLike = 0,
    max_waypoints: int | None = MAX_WAYPOINTS,
) -> Done:
    """Whether the loop over a subtask's waypoints ends: success, budgets spent, or no waypoint left.

    Args:
        cursor_done: no waypoint is left, bool [B] (``Dispensed.done``).
        episode_success: bool [B].
        truncated: the environment has ended the episode, bool [B].
        waypoints: waypoints of this subtask that were followed, int [B].
        max_waypoints: budget of those; None for none.
    """
    count = _rows(cursor_done)
    most = np.inf if max_waypoints is None else max_waypoints
    return _first_reason(
        count,
        (SUCCESS, episode_success),
        (STEP_BUDGET, truncated),
        (EXHAUSTED, cursor_done),
        (WAYPOINT_BUDGET, _column(waypoints, count, float) >= most),
    )


def check_done(
    subtask_index: npt.ArrayLike,
    subtask_count: npt.ArrayLike,
    episode_success: npt.ArrayLike,
    step_index: npt.ArrayLike = 0,
    max_steps: npt.ArrayLike = np.inf,
    *,
    truncated: npt.ArrayLike = False,
    failed: npt.ArrayLike = False,
    rounds: npt.ArrayLike = 0,
    max_subtasks: int | None = MAX_SUBTASKS,
) -> Done:
    """Whether the episode is over: success, the environment's budget spent, an error, all subtasks, or their budget.

    Args:
        subtask_index: index of the next subtask, int [B].
        subtask_count: how many there are, int [B].
        episode_success: bool [B].
        step_index: control ticks executed, int [B].
        max_steps: the environment's budget of them, int [B].
        truncated: the environment has ended the episode for any other reason, bool [B].
        failed: nothing more can be planned after an error, bool [B].
        rounds: how often a subtask was planned and followed in this episode, int [B].
        max_subtasks: budget of those; None for none.
    """
    count = _rows(subtask_index)
    index, total = _column(subtask_index, count, int), _column(subtask_count, count, int)
    steps, budget = _column(step_index, count, float), _column(max_steps, count, float)
    most = np.inf if max_subtasks is None else max_subtasks
    return _first_reason(
        count,
        (SUCCESS, episode_success),
        (STEP_BUDGET, _column(truncated, count, bool) | (steps >= budget)),
        (ERROR, failed),
        (ALL_SUBTASKS, index >= total),
        (SUBTASK_BUDGET, _column(rounds, count, float) >= most),
    )


def _first_reason(count: int, *causes: tuple[str, npt.ArrayLike]) -> Done:
    """For each slot the first of the causes that holds."""
    holds = [(reason, _column(where, count, bool)) for reason, where in causes]
    reasons = tuple(next((reason for reason, where in holds if where[slot]), "") for slot in range(count))
    return Done(np.array([bool(reason) for reason in reasons], bool), reasons)


def _rows(value: npt.ArrayLike) -> int:
    return np.atleast_1d(np.asarray(value)).shape[0]


def _column(value: npt.ArrayLike, count: int, kind: type) -> np.ndarray:
    """One value a slot, [B], from one for all or B of them."""
    array = np.asarray(value, kind)
    if array.shape not in ((), (1,), (count,)):
        raise TrajectoryError(f"got shape {list(array.shape)}; expected one value, or one for each of {count} slots")
    return np.broadcast_to(array, count).copy()
