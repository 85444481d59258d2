"""Pull and push drawers with closed fingers, where the arm can: waypoints from a drawer's shape.

In: a drawer as a ``Part`` (surface points, joint), and the arm's posture. Out: waypoints. Above the front of each of
the cabinet's drawers is a gap of 10 cm; slanting fingers reach through it, press on the front's upper edge from behind,
and take it along. Where along the edge and at which angles is decided by rehearsing all of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vecenv.observations import Part, PartJoint
from vecenv.simpler.control.rotations import rotvec_from_rotation
from vecenv_eval.policies.simpler.reach import Arm, Waypoint, pose, through

# Angles of the closed fingers, radians: below the horizontal, and sideways.
_HOOK_PITCHES = np.deg2rad([25.0, 30.0, 35.0])
_PUSH_PITCHES = np.deg2rad([0.0, 20.0, 40.0])
_YAWS = np.deg2rad([-20.0, -10.0, 0.0, 10.0, 20.0])
# Where along the front, as a share of half its width.
_PLACES = (-0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6)
# Fingertips come this far below the edge (more than a stop's tolerance); the hand starts this far before it, and
# presses this deep, metres.
_HOOKED, _BEFORE, _PRESS = 0.02, 0.18, 0.005
# They come from so far above where they then are, metres; the second time higher: an arm that reaches far sags.
_OVERS = (0.025, 0.035)
# Two stops on the way in, as shares of it that are left. From the second on the hand moves level, because the arm sags
# below a straight line, by about this much (metres).
_ENTRY, _SAGS = (1.0, 0.3), 0.02
# The hand ends this far above the edge, metres.
_LEAVE = 0.06
# Fingers may slip this far before they take the drawer along, metres.
_SLACK = 0.06
# Pushing begins this far before the front, and ends this far beyond closed.
_AWAY, _BEYOND = 0.06, 0.01
# Sideways angles and places off the middle cost as much as this much room at the joints' limits, radians.
_PREFER_STRAIGHT, _PREFER_MIDDLE = 1.0, 0.2
# So does every radian that the hand is turned on the way there.
_PREFER_NEAR = 0.15
# So many of the best are followed exactly; every stop that is not reached costs as much as this, radians.
_FOLLOWED, _UNREACHED = 16, 1.0
# More room than this is no better, radians.
_ROOM_ENOUGH = 0.3


@dataclass(frozen=True, kw_only=True)
class _Facing:
    """One way to face a drawer: angles, where along its front, approach [3] and rotation [3, 3] of the hand."""

    pitch: float
    yaw: float
    place: float
    approach: np.ndarray
    turn: np.ndarray


def hook_and_pull(
    arm: Arm, qpos: np.ndarray, base: np.ndarray, drawer: Part, opened: float, before: int
) -> list[Waypoint]:
    """Open a drawer until its joint is at ``opened``, metres; the hand ends where it can leave upwards.

    ``before`` is how often that was tried before.
    """
    joint, edge, clear = _joint(drawer), _upper_edge(drawer), _OVERS[before % len(_OVERS)]

    def way(facing: _Facing) -> list[np.ndarray]:
        behind = (_HOOKED + arm.hand.thickness / np.cos(facing.pitch)) / np.tan(facing.pitch)
        tip = np.array([edge[0, 0] - behind, _along(edge, facing.place), edge[1, 2] - _HOOKED])
        at = tip - arm.hand.tip * facing.approach
        over, pressed = at + [0, 0, clear], at - [0, 0, _PRESS]
        pulled = pressed + (opened + _SLACK - joint.opened) * joint.axis
        begin, outside = (over - share * _BEFORE * facing.approach for share in _ENTRY)
        inside = np.array([*outside[:2], over[2] + _SAGS])
        return [begin, inside, over, at, pulled, pulled + [0, 0, _LEAVE]]

    stops, turn = _best(arm, qpos, base, _HOOK_PITCHES, way)
    return through(stops, turn, 1.0)


def push(arm: Arm, qpos: np.ndarray, base: np.ndarray, drawer: Part) -> list[Waypoint]:
    """Close a drawer."""
    joint, edge = _joint(drawer), _upper_edge(drawer)

    def way(facing: _Facing) -> list[np.ndarray]:
        tip = np.array([edge[1, 0], _along(edge, facing.place), edge[1, 2] - 2 * arm.hand.thickness])
        at = tip - arm.hand.tip * facing.approach
        return [at + _AWAY * joint.axis, at, at - (joint.opened + _BEYOND) * joint.axis]

    stops, turn = _best(arm, qpos, base, _PUSH_PITCHES, way)
    return [*through(stops, turn, 1.0), Waypoint(pose(stops[-1], turn), 1.0, hold=3)]


def opening(drawer: Part) -> np.ndarray:
    """Middle of the part of a drawer that is out, at the height of its front's upper edge, [3]."""
    joint, edge = _joint(drawer), _upper_edge(drawer)
    back = np.array([edge[0, 0], edge[:, 1].mean(), edge[1, 2]])
    return back - joint.opened / 2 * joint.axis


def contains(drawer: Part, point: np.ndarray) -> bool:
    """Whether a point is inside a drawer."""
    assert drawer.box is not None, "a drawer has a box"
    return bool((np.abs(point - drawer.box.pos) < drawer.box.half_extents).all())


def _best(
    arm: Arm,
    qpos: np.ndarray,
    base: np.ndarray,
    pitches: np.ndarray,
    way: Callable[[_Facing], list[np.ndarray]],
) -> tuple[np.ndarray, np.ndarray]:
    """Stops [T, 3] and rotation [3, 3] of the way that leaves most room, among all ways to face a drawer."""
    facings = [_facing(arm, *each) for each in itertools.product(pitches, _YAWS, _PLACES, (1.0, -1.0))]
    ways, turns = np.array([way(each) for each in facings]), np.array([each.turn for each in facings])
    room, _ = arm.rehearse(qpos, base, ways, np.repeat(turns[:, None], ways.shape[1], axis=1))
    _, now = arm.tool(qpos, base)
    far = np.linalg.norm(rotvec_from_rotation(turns @ now.T), axis=1)
    dear = np.array([_PREFER_STRAIGHT * abs(each.yaw) + _PREFER_MIDDLE * abs(each.place) for each in facings])
    dear += _PREFER_NEAR * far
    best = np.argsort(dear - np.minimum(room, _ROOM_ENOUGH), kind="stable")[:_FOLLOWED]
    room, reached = arm.follow(qpos, base, ways[best], np.repeat(turns[best, None], ways.shape[1], axis=1))
    worth = np.minimum(room, _ROOM_ENOUGH) - dear[best] - _UNREACHED * (ways.shape[1] - reached)
    one = best[int(np.argmax(worth))]
    return ways[one], turns[one]


def _facing(arm: Arm, pitch: float, yaw: float, place: float, flip: float) -> _Facing:
    """Against the drawers' axis, which is x; the hand opens sideways, either way round."""
    approach = np.array([-np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])
    opening = flip * np.cross([0.0, 0.0, 1.0], approach)
    turn = arm.hand.rotation(approach, opening / np.linalg.norm(opening))
    return _Facing(pitch=pitch, yaw=yaw, place=place, approach=approach, turn=turn)


def _joint(drawer: Part) -> PartJoint:
    assert drawer.joint is not None, "a drawer has a joint"
    return drawer.joint


def _upper_edge(drawer: Part) -> np.ndarray:
    """Lower and upper corner of the drawer's highest points: its front's upper edge, [2, 3]."""
    points = drawer.cloud.points
    top = points[points[:, 2] > points[:, 2].max() - 1e-3]
    return np.stack([top.min(axis=0), top.max(axis=0)])


def _along(edge: np.ndarray, place: float) -> float:
    return float(edge[:, 1].mean() + place * (edge[1, 1] - edge[0, 1]) / 2)
