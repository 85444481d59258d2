"""Ways to take hold of a thing with a parallel gripper, from points on its surface; the best that the arm can follow.

In: surface points of the thing, and what the hand is to do with it afterwards. Out: a ``Grasp``, the tool's pose.
Alternatives differ in where the hand comes from, how it is turned about that direction, and which finger is left; each
is rehearsed, including what follows, because a hand turned by half a turn holds a thing equally well but may not be
able to carry it to where it belongs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vecenv.observations import PointCloud
from vecenv.simpler.control.rotations import rotvec_from_rotation
from vecenv_eval.policies.simpler.reach import Arm, Hand

_TILTS = np.deg2rad([0.0, 10.0, 20.0, 30.0, 45.0])
_AZIMUTHS = np.linspace(0, 2 * np.pi, 8, endpoint=False)
_ROLLS = np.linspace(0, np.pi, 12, endpoint=False)
# Part of the thing that lies between the fingers, half its length, metres.
_SLAB = 0.015
_FEWEST = 8
# Points so near to the outermost one are what a finger meets, metres.
_SKIN = 0.006
# Fingers stay so far above what the thing stands on, metres.
_GROUND = 0.003
# So many alternatives are rehearsed at once, and so many times if none will do.
_REHEARSED, _ROUNDS = 48, 12
# Of those, so many are followed exactly; every stop that is not reached costs this.
_FOLLOWED, _UNREACHED = 8, 3.0
# A grasp with this much room at the joints' limits is as good as one with more, radians.
_ROOMY = 0.15
# What it costs to have no room at all.
_STRAIN = 3.0


@dataclass(frozen=True)
class Grasp:
    """A pose of the tool.

    Attributes:
        position: metres, world frame, [3]. rotation: [3, 3]. approach: where the hand comes from, unit vector [3].
        room: at the joints' limits, radians, as ``Arm.rehearse`` has it.
        cost: the less the better; up to about 2 it holds.
    """

    position: np.ndarray
    rotation: np.ndarray
    approach: np.ndarray
    room: float
    cost: float


@dataclass(frozen=True)
class _Offers:
    position: np.ndarray
    rotation: np.ndarray
    approach: np.ndarray
    opening: np.ndarray
    width: np.ndarray
    square: np.ndarray


# From positions [C, 3], rotations [C, 3, 3] and approaches [C, 3] of a grasp to the stops of the tool, [C, T, 3].
Course = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def choose(
    arm: Arm,
    qpos: np.ndarray,
    base: np.ndarray,
    cloud: PointCloud,
    ground: float,
    course: Course,
    failed: Sequence[Grasp] = (),
) -> Grasp | None:
    """The best grasp of a thing; None when it is too wide everywhere.

    Args:
        arm: the arm. qpos: its joints. base: its root's world pose.
        cloud: surface samples of the thing, world frame.
        ground: height of what it stands on, metres.
        course: what the tool does with it.
        failed: grasps that did not hold.
    """
    offers = _offers(arm.hand, cloud, ground)
    cost = _cost(arm, qpos, base, offers, failed)
    ranked = np.argsort(cost, kind="stable")[: _REHEARSED * _ROUNDS]
    ranked = ranked[np.isfinite(cost[ranked])]
    found: list[Grasp] = []
    for begin in range(0, len(ranked), _REHEARSED):
        best = ranked[begin : begin + _REHEARSED]
        stops, turns = course(offers.position[best], offers.rotation[best], offers.approach[best])
        room, _ = arm.rehearse(qpos, base, stops, turns)
        some = np.argsort(cost[best] + _strain(room), kind="stable")[:_FOLLOWED]
        room, reached = arm.follow(qpos, base, stops[some], turns[some])
        total = cost[best[some]] + _strain(room) + _UNREACHED * (stops.shape[1] - reached)
        one = int(np.argmin(total))
        at = best[some[one]]
        pose = offers.position[at], offers.rotation[at], offers.approach[at]
        found.append(Grasp(*pose, room=float(room[one]), cost=float(total[one])))
        if room[one] >= _ROOMY and reached[one] == stops.shape[1]:
            break
    return min(found, key=lambda grasp: grasp.cost, default=None)


def _strain(room: np.ndarray) -> np.ndarray:
    """What it costs to have so little room, [C]."""
    return _STRAIN * np.clip(_ROOMY - np.maximum(room, -10.0), 0.0, None) / _ROOMY


def approaches() -> np.ndarray:
    """Unit vectors that point down, or down at a slant, [A, 3]."""
    tilt, azimuth = (grid.ravel() for grid in np.meshgrid(_TILTS[1:], _AZIMUTHS, indexing="ij"))
    slanted = [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)]
    return np.concatenate([[[0.0, 0.0, -1.0]], np.stack(slanted, axis=1)])


def _offers(hand: Hand, cloud: PointCloud, ground: float) -> _Offers:
    """Every alternative, both ways round."""
    down = approaches()
    across = np.cross(down, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(down, across)
    turn = np.concatenate([_ROLLS, _ROLLS + np.pi])[None, :, None]
    opening = (np.cos(turn) * across[:, None] + np.sin(turn) * other[:, None]).reshape(-1, 3)
    approach = np.repeat(down, turn.shape[1], axis=0)
    position, width, square = _centred(cloud, approach, opening)
    depth = np.interp(width, *hand.depth)
    position = position + np.minimum(depth, hand.palm - _reach(cloud.points, approach))[:, None] * approach
    # The lowest corner of the fingers is at the tip of the tool, or beside it when the hand slants.
    slant = np.sqrt(1 - approach[:, 2] ** 2)
    low = position[:, 2] + hand.tip * approach[:, 2] - hand.edge * slant
    position -= np.minimum(low - ground - _GROUND, 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
    return _Offers(position, hand.rotation(approach, opening), approach, opening, width, square)


def _centred(cloud: PointCloud, approach: np.ndarray, opening: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre of what lies between the fingers [C, 3], its width [C], and how squarely they meet it, [C]: 1 flat on."""
    points = cloud.points
    along = np.cross(approach, opening)
    middle = [_middle(points @ axis.T) for axis in (along, approach)]
    inside = np.abs(points @ along.T - middle[0]) <= _SLAB
    inside |= inside.sum(axis=0) < _FEWEST
    sideways, facing = points @ opening.T, cloud.normals @ opening.T
    high = np.where(inside, sideways, -np.inf).max(axis=0)
    low = np.where(inside, sideways, np.inf).min(axis=0)
    square = np.minimum(
        _mean(facing, inside & (sideways > high - _SKIN)), _mean(-facing, inside & (sideways < low + _SKIN))
    )
    parts = zip((along, approach, opening), (*middle, (high + low) / 2), strict=True)
    return np.sum([axis * value[:, None] for axis, value in parts], axis=0), high - low, square


def _reach(points: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Half of how long the points are along axes [C, 3], [C]."""
    along = points @ axes.T
    return (along.max(axis=0) - along.min(axis=0)) / 2


def _mean(values: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    return (values * chosen).sum(axis=0) / chosen.sum(axis=0)


def _middle(values: np.ndarray) -> np.ndarray:
    return (values.max(axis=0) + values.min(axis=0)) / 2


def _cost(arm: Arm, qpos: np.ndarray, base: np.ndarray, offers: _Offers, failed: Sequence[Grasp]) -> np.ndarray:
    """The less the better: narrow, upright, square, near to how the hand is turned, unlike what has failed; [C]."""
    _, facing = arm.tool(qpos, base)
    turn = np.linalg.norm(rotvec_from_rotation(offers.rotation @ facing.T), axis=1)
    tilt = np.arccos(np.clip(-offers.approach[:, 2], -1, 1))
    cost = 0.5 * turn + tilt + offers.width / arm.hand.widest
    cost += 6.0 * (1 - offers.square) + 2.5 * np.abs(offers.opening[:, 2])
    for grasp in failed:
        unlike = np.linalg.norm(rotvec_from_rotation(offers.rotation @ grasp.rotation.T), axis=1)
        cost += np.maximum(0.0, 1.0 - unlike / 0.5)
    return np.where(offers.width <= arm.hand.widest, cost, np.inf)
