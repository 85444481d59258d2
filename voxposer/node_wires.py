"""Waypoints on the wires of VoxPoser's tools: lists of plain mappings, and the arrays of ``voxposer.episode``.

A waypoint is an 8-vector (xyz in metres, wxyz, grip 1 closed and 0 open, world frame) or a mapping with it as ``pose``.
A trajectory's mappings also have ``velocity``, ``final`` and ``motion``, expanded ones ``hold_steps``; all have
``plan``, which says what plan they are of. What does not fit is one sentence that names the waypoint.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from vecenv.interop.nodes import NodeError
from vecenv.interop.nodes.ports import whole_number
from vecenv.manipulation.routes import Stop
from voxposer.episode import Expanded, Trajectory, trajectory_of_stops
from voxposer.planning.plan import PlanConfig, PlannedWaypoint, stack

# Most waypoints of a list: more than any plan has.
MOST_WAYPOINTS = 100_000
_WIDTH = 8
_TRAJECTORY = ("pose", "velocity", "final", "motion", "plan")
_EXPANDED = ("pose", "hold_steps", "carry", "plan")


class Waypoint(NamedTuple):
    """``pose`` [8], ``hold_steps`` (0 drives), ``carry``: the servo goes on from the waypoint before."""

    pose: np.ndarray
    hold_steps: int
    carry: bool


def rows_of_trajectory(trajectory: Trajectory, plan: str) -> list[dict[str, Any]]:
    """The waypoints of the only slot of a trajectory; ``plan`` is a name of its own for it."""
    return [
        {
            "pose": trajectory.waypoints[0, t].tolist(),
            "velocity": float(trajectory.velocity[0, t]),
            "final": bool(trajectory.final[0, t]),
            "motion": int(trajectory.motion[0, t]),
            "plan": plan,
        }
        for t in np.flatnonzero(trajectory.valid[0])
    ]


def trajectory_of_rows(value: object) -> Trajectory:
    """The trajectory that a list of waypoints holds. Of 8-vectors: one motion at full speed.

    Raises:
        NodeError: something else.
    """
    rows = _rows(value)
    stops: list[tuple[int, Stop]] = []
    for t, row in enumerate(rows):
        given = _fields(row, t, _TRAJECTORY)
        pose = _pose(given, t)
        velocity = _number(given.get("velocity", 1.0), f"waypoint {t}: velocity")
        final = _flag(given.get("final", t == len(rows) - 1), f"waypoint {t}: final")
        motion = whole_number(f"waypoint {t}: motion", given.get("motion", 0))
        stops.append((motion, Stop(pose[:3], pose[3:7], bool(pose[7] > 0.5), velocity, final)))
    motions = [[stop for _, stop in own] for _, own in itertools.groupby(stops, key=lambda pair: pair[0])]
    return trajectory_of_stops([motions], 0, 0)


def rows_of_expanded(expanded: Expanded, plan: str) -> list[dict[str, Any]]:
    """The waypoints to follow of the only slot."""
    found = expanded.plan
    return [
        {
            "pose": [*np.asarray(found.poses[0, t]).tolist(), float(found.grip[0, t])],
            "hold_steps": int(found.hold[0, t]),
            "plan": plan,
        }
        for t in np.flatnonzero(np.asarray(found.valid[0]))
    ]


def expanded_of_rows(value: object, number: int) -> Expanded:
    """What a list of waypoints to follow holds, for a dispenser; ``number`` is its identity.

    Raises:
        NodeError: something else.
    """
    waypoints = [_waypoint(row, t) for t, row in enumerate(_rows(value))]
    planned = [PlannedWaypoint(each.pose[:7], bool(each.pose[7] > 0.5), each.hold_steps, 0, 1.0) for each in waypoints]
    count, last = np.array([len(planned)]), bool(planned and planned[-1].closed)
    holds = np.array([sum(each.hold > 0 for each in planned)])
    return Expanded(stack([planned], PlanConfig()), np.array([number]), count, count, holds, np.array([last]))


def waypoint_of(value: object, name: str) -> Waypoint | None:
    """One waypoint to follow; None for none, an empty list included.

    Raises:
        NodeError: something else.
    """
    if value is None or (isinstance(value, list | tuple) and not value):
        return None
    if not isinstance(value, Mapping | list | tuple | np.ndarray):
        raise NodeError(f"input {name!r}: got a {type(value).__name__}; expected an 8-vector or a mapping with pose")
    return _waypoint(value, 0)


def identity_of(value: object) -> str:
    """What tells a list of waypoints from others: the name of its plan, or what is in it."""
    rows = _rows(value)
    if rows and isinstance(rows[0], Mapping) and isinstance(rows[0].get("plan"), str):
        return rows[0]["plan"].encode(errors="replace").decode()
    return hashlib.sha256(json.dumps(rows, default=_plain).encode()).hexdigest()


def grip_of(value: object, name: str) -> bool:
    """Whether a grip is closed: a flag, or a number from 0, open, to 1, closed.

    Raises:
        NodeError: something else.
    """
    if isinstance(value, bool | np.bool_):
        return bool(value)
    return _number(value, f"input {name!r}") > 0.5


def _rows(value: object) -> list[Any]:
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, list | tuple):
        raise NodeError(f"input 'trajectory': got a {type(value).__name__}; expected a list of waypoints")
    if len(value) > MOST_WAYPOINTS:
        raise NodeError(f"input 'trajectory': {len(value):,} waypoints; at most {MOST_WAYPOINTS:,} are read")
    return list(value)


def _fields(row: object, t: int, known: tuple[str, ...]) -> Mapping[str, Any]:
    given = row if isinstance(row, Mapping) else {"pose": row}
    if unknown := [name for name in given if name not in known]:
        raise NodeError(f"waypoint {t}: unknown key {str(unknown[0])[:80]!r}; expected {', '.join(known)}")
    return given


def _waypoint(row: object, t: int) -> Waypoint:
    given = _fields(row, t, _EXPANDED)
    hold = whole_number(f"waypoint {t}: hold_steps", given.get("hold_steps", 0))
    return Waypoint(_pose(given, t), hold, _flag(given.get("carry", False), f"waypoint {t}: carry"))


def _pose(given: Mapping[str, Any], t: int) -> np.ndarray:
    try:
        pose = np.array(given.get("pose"))
    except (TypeError, ValueError, RecursionError):
        pose = np.array(None)
    if pose.shape != (_WIDTH,) or pose.dtype.kind not in "iuf":
        raise NodeError(f"waypoint {t}: expected {_WIDTH} numbers (xyz in metres, wxyz, grip)")
    if not np.isfinite(pose).all():
        raise NodeError(f"waypoint {t} is not finite")
    return pose.astype(float)


def _flag(value: object, where: str) -> bool:
    if not isinstance(value, bool | np.bool_):
        raise NodeError(f"{where}: got a {type(value).__name__}; expected true or false")
    return bool(value)


def _number(value: object, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not np.isfinite(value):
        raise NodeError(f"{where}: got a {type(value).__name__}; expected a finite number")
    return float(value)


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)
