"""Geometry of the parts of fixtures: which way they open, and what is free inside them.

A :class:`~vecenv.observations.Part` (drawer, door, handle, knob, shelf, top) comes in; directions and boxes come out.
Only surface points, joints and boxes decide; no names of tasks or assets are read.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from vecenv.manipulation.world import SceneGeometry
from vecenv.observations import Part, RegionBox
from voxposer.quaternions import unit

_UP = np.array([0.0, 0.0, 1.0])


def opening_direction(part: Part) -> np.ndarray:
    """Direction in which a part moves when it opens, unit vector [3]: along its slide, or tangential to its hinge.

    For a part that turns about itself (a knob), it is the axis about which it turns counterclockwise to switch on.
    """
    assert part.joint is not None
    if part.joint.kind == "slide" or part.kind == "knob":
        return part.joint.axis.copy()
    middle = (part.cloud.points.min(axis=0) + part.cloud.points.max(axis=0)) / 2
    return unit(np.cross(part.joint.axis, middle - part.joint.anchor))


def outward_direction(part: Part, scene: SceneGeometry) -> np.ndarray:
    """Normal of a part, unit vector [3]: up for tops and knobs, else the direction in which it opens or is left."""
    if part.joint is not None and part.kind != "knob":
        return opening_direction(part)
    if part.kind == "space" and part.box is not None:
        return exit_direction(part, scene)
    return _UP.copy()


def exit_direction(part: Part, scene: SceneGeometry) -> np.ndarray:
    """Direction that leads out of a space, unit vector [3]: up, or to a side where something covers the space.

    A space with a door is left through the door. Otherwise it is the side with the least surface in front of it; among
    equal sides, the one that faces the robot.
    """
    assert part.box is not None
    doors = [p for p in scene.snapshot.parts.values() if p.parent == part.parent and p.kind == "door"]
    if doors:
        shut = (_shut_points(doors[0]).mean(axis=0) - part.box.pos) @ part.box.mat / part.box.half_extents
        axis = int(np.abs(shut).argmax())
        return part.box.mat[:, axis] * np.sign(shut[axis])
    share = _surface_in_box_units(part, scene)
    faces = [(axis, sign) for axis in range(3) for sign in (1.0, -1.0)]
    ways = {face: part.box.mat[:, face[0]] * face[1] for face in faces}
    before = {face: _points_before(share, *face) for face in faces}
    upward = max(faces, key=lambda face: ways[face][2])
    if before[upward] < max(3, 0.008 * len(share)):
        return ways[upward]
    towards = np.zeros(3) if scene.base is None else np.append(scene.base - part.box.pos[:2], 0.0)
    level = [face for face in faces if abs(ways[face][2]) < 0.5]
    return ways[min(level, key=lambda face: (before[face], -float(ways[face] @ towards)))]


def cavity(part: Part, scene: SceneGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner [3] of the free part of a space's box, found from its centre towards each side."""
    assert part.box is not None
    share = _surface_in_box_units(part, scene)
    free = np.ones((2, 3))
    for axis in range(3):
        beside = (np.abs(np.delete(share, axis, axis=1)) < 0.45).all(axis=1)
        for row, sign in enumerate((-1.0, 1.0)):
            ahead = sign * share[beside, axis]
            free[row, axis] = ahead[ahead > 0.1].min(initial=1.0)
    ends = np.stack([-free[0], free[1]]) * part.box.half_extents @ part.box.mat.T + part.box.pos
    return ends.min(axis=0), ends.max(axis=0)


def world_half_extents(region: RegionBox) -> np.ndarray:
    """Half extents of a region along the world's axes, metres, [3]."""
    return np.abs(region.mat) @ region.half_extents


def distance(one: Part, other: Part) -> float:
    """Distance between the centroids of two parts, metres."""
    return float(np.linalg.norm(one.cloud.points.mean(axis=0) - other.cloud.points.mean(axis=0)))


def _shut_points(part: Part) -> np.ndarray:
    """Points of a door in its shut position, [N, 3]."""
    assert part.joint is not None
    turn = Rotation.from_rotvec(-part.joint.opened * part.joint.axis)
    return turn.apply(part.cloud.points - part.joint.anchor) + part.joint.anchor


def _surface_in_box_units(part: Part, scene: SceneGeometry) -> np.ndarray:
    """Surface of the fixture around a space, doors left out, in half extents of the space's box, [N, 3]."""
    assert part.box is not None
    doors = [p.cloud.points for p in scene.snapshot.parts.values() if p.parent == part.parent and p.joint is not None]
    points = _away_from(np.concatenate([scene.points(part.parent), part.cloud.points]), doors)
    return (points - part.box.pos) @ part.box.mat / part.box.half_extents


def _points_before(share: np.ndarray, axis: int, sign: float) -> int:
    """Number of points in front of the middle of one face of a box; coordinates in half extents."""
    ahead = (share[:, axis] * sign > 0.5) & (share[:, axis] * sign < 2.5)
    return int((ahead & (np.abs(np.delete(share, axis, axis=1)) < 0.45).all(axis=1)).sum())


def _away_from(points: np.ndarray, clouds: Sequence[np.ndarray], least: float = 0.02) -> np.ndarray:
    """The points that are farther than a distance from every cloud."""
    for cloud in clouds:
        points = points[np.linalg.norm(points[:, None] - cloud[None, ::2], axis=2).min(axis=1) > least]
    return points
