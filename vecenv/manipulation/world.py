"""Geometry of one snapshot for planning: where objects are, how high they are, and rotations of hands.

An :class:`~vecenv.observations.ObjectsSnapshot` comes in; :class:`SceneGeometry` answers the questions of grasping,
placing and moving (points of objects and of everything else, the ground, the tallest point along a line). Hands are
rotation matrices whose third column points out of the palm and whose second is the closing direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vecenv.manipulation.grasps import Gripper
from vecenv.observations import ObjectsSnapshot, RegionBox

# The hand pointing down with the fingers closing along world y, as a Panda starts.
HOME_ROTATION = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Margins of picking, carrying and placing. Metres unless noted.

    Attributes:
        gripper: shape of the hand.
        above: the least height over a grasp or a target from which the hand comes straight down.
        over_obstacles: vertical distance kept over obstacles in that corridor.
        corridor: half width of the corridor around a straight move.
        neighbours: points farther than this from a grasp or target are ignored.
        narrow: half opening of a half-closed hand.
        narrow_ticks: ticks of closing that take an open hand there.
        least_room: least room for the hand between neighbours, where there is a choice.
        ample_room: more room than this is no better.
        room_scale: room that is worth one point of score.
        lack_scale: lacking this much room costs one point more.
        turn_scale: turning the hand this much costs one point, radians.
        easy_reach: horizontal distance from the robot's base up to which a hand can point down with ease.
        reach_scale: distance beyond that costs one point.
        retry_radius: a grasp this close to one that failed is taken last.
        touchdown: gap left under an object when it is released.
        support_radius: points this close horizontally rest on one another.
        high_cost: cost per metre of coming to rest higher than the target's floor, on something else.
        stacked: what comes to rest this much higher than a container's floor stands on something else in it.
        stacked_cost: cost of that in addition.
        tipped_cost: cost instead, where it tips over because its middle is not above what carries it.
        aside_scale: distance from the middle of a container that costs one point.
        drop_cost: cost per metre of releasing above the height of rest because the hand has no room.
        widest_turn: hands turn no further than this from home, radians.
        overhang_scale: sticking out this much of a box to fit in costs one point.
        grasp_tilts: of a hand from the vertical, tried where no upright one has room to grasp, radians.
        place_tilts: of a hand that leans away from the robot to put something down where an upright one does not reach,
            radians.
        too_tall: what stands higher than its space by more than this is laid down in it, if it tips over easily.
        highest_drop: for that it is let go of at most this high above its rest.
        tipped: for that it leans this much more than where it would begin to tip over, radians.
        spare_reach: a hand that leans to put something down keeps this far from the end of the reach, where it can.
        rim_scale: at a rim, standing out this much further is worth one point.
        tilt_scale: at a rim, and where it leans to put something down, leaning this much more costs one point, radians.
        entry_tilts: of a hand that enters a space from a side, from the vertical, radians.
        edge_inside: the middle of what it holds is at least so far inside the space.
        short_scale: stopping this far before the middle of the space costs one point.
        tipping: what turns by one radian when it is let go of costs as much as stopping so far before the middle.
        least_lift: the hand rises at least this much with what it holds.
        retreat: the hand backs off this far after releasing.
    """

    gripper: Gripper = field(default_factory=Gripper)
    above: float = 0.06
    over_obstacles: float = 0.03
    corridor: float = 0.11
    neighbours: float = 0.22
    narrow: float = 0.021
    narrow_ticks: int = 4
    least_room: float = 0.004
    ample_room: float = 0.02
    room_scale: float = 0.01
    lack_scale: float = 0.002
    turn_scale: float = 2.0
    easy_reach: float = 0.70
    reach_scale: float = 0.015
    retry_radius: float = 0.012
    touchdown: float = 0.004
    support_radius: float = 0.008
    high_cost: float = 40.0
    stacked: float = 0.02
    stacked_cost: float = 6.0
    tipped_cost: float = 4.0
    aside_scale: float = 0.02
    drop_cost: float = 10.0
    widest_turn: float = 1.75
    overhang_scale: float = 0.005
    grasp_tilts: tuple[float, ...] = ()
    place_tilts: tuple[float, ...] = (0.2, 0.35, 0.5, 0.7)
    too_tall: float = 0.03
    highest_drop: float = 0.08
    tipped: float = 0.3
    spare_reach: float = 0.04
    rim_scale: float = 0.001
    tilt_scale: float = 0.2
    entry_tilts: tuple[float, ...] = (1.4, 1.1, 0.8)
    edge_inside: float = 0.02
    short_scale: float = 0.1
    tipping: float = 0.05
    least_lift: float = 0.08
    retreat: float = 0.08


class SceneGeometry:
    """The geometry of one snapshot.

    Args:
        snapshot: ground truth of one slot.
        config: margins.
        base: position of the robot's base, [2], None to ignore reach.

    Attributes:
        walls: extra points on drawers, handles, doors and knobs, which are sampled too sparsely.
    """

    def __init__(self, snapshot: ObjectsSnapshot, config: Margins, base: np.ndarray | None = None) -> None:
        self.snapshot, self.config = snapshot, config
        self.base = base
        drawers = [region for region in snapshot.regions.values() if region.axis is not None]
        moving = [part.cloud.points for part in snapshot.parts.values() if part.joint is not None]
        self.walls = np.concatenate([np.zeros((0, 3)), *(_walls(region) for region in drawers), *moving])
        named = sum(len(cloud.points) for cloud in snapshot.objects.values())
        self.scenery = snapshot.scene.points[named:]
        self._scenery_up = self.scenery[snapshot.scene.normals[named:, 2] > 0.9]
        self.hand = snapshot.ee_pose[:3]
        self.hand_rotation = matrix(snapshot.ee_pose[3:])

    def points(self, name: str) -> np.ndarray:
        """Surface points of one object, metres, [N, 3]."""
        return self.snapshot.objects[name].points

    def others(self, *names: str) -> np.ndarray:
        """Surface points of everything but ``names``, [N, 3]."""
        clouds = [cloud.points for name, cloud in self.snapshot.objects.items() if name not in names]
        return np.concatenate([*clouds, self.scenery])

    def ground(self, xy: np.ndarray) -> float:
        """Height of the table or floor around a position [2], metres."""
        up = self._scenery_up
        near = up[np.linalg.norm(up[:, :2] - xy, axis=1) < 0.2]
        return float(near[:, 2].max()) if len(near) else float(self.scenery[:, 2].min())

    def tallest(self, start: np.ndarray, end: np.ndarray, *ignored: str) -> float:
        """Height of the highest point in the corridor between two positions, metres."""
        points = self.others(*ignored)
        way = end[:2] - start[:2]
        share = np.clip((points[:, :2] - start[:2]) @ way / max(float(way @ way), 1e-9), 0, 1)
        near = np.linalg.norm(points[:, :2] - start[:2] - share[:, None] * way, axis=1) < self.config.corridor
        return float(points[near, 2].max(initial=-np.inf))


def _walls(region: RegionBox) -> np.ndarray:
    """Points on the four upright sides of a drawer, from the box around what it holds."""
    assert region.axis is not None
    up = float(np.abs(region.mat[2]) @ region.half_extents)
    side = np.cross([0.0, 0.0, 1.0], region.axis)
    along = float(np.abs(region.mat.T @ region.axis) @ region.half_extents)
    across = float(np.abs(region.mat.T @ side) @ region.half_extents)
    ticks = np.arange(-1.0, 1.01, 0.125)
    rim = [
        [*((along + out) * sign * region.axis + across * t * side for sign in (-1, 1) for t in ticks)]
        + [*(along * t * region.axis + (across + out) * sign * side for sign in (-1, 1) for t in ticks)]
        for out in (0.0, 0.006, 0.012)
    ]
    levels = np.linspace(-up, up, 4)[:, None] * np.array([0.0, 0.0, 1.0])
    return region.pos + (np.concatenate(rim)[:, None] + levels).reshape(-1, 3)


def matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a unit quaternion wxyz."""
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def down_facing(axis: np.ndarray) -> np.ndarray:
    """Rotations of a hand that points down and closes along ``axis`` [K, 3], turned from home as little as possible."""
    y = np.where((axis[:, 1] > 0)[:, None], -axis, axis)
    z = np.broadcast_to([0.0, 0.0, -1.0], y.shape)
    return np.stack([np.cross(y, z), y, z], axis=2)


def yaw(rotation: np.ndarray) -> np.ndarray:
    """Angle by which down-facing hands [..., 3, 3] are turned from home about the vertical, radians."""
    return np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])


def spun(rotation: np.ndarray, angle: float) -> np.ndarray:
    """A rotation followed by a turn about the vertical."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ rotation


def leaning(angle: float) -> np.ndarray:
    """Rotation [3, 3] that takes a hand which points down to one whose fingers lead along world x, by an angle."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])


def around(xy: np.ndarray, points: np.ndarray, radius: float) -> np.ndarray:
    """The points within a horizontal distance."""
    return points[np.linalg.norm(points[:, :2] - xy, axis=1) < radius]


def upright(rotation: np.ndarray) -> np.ndarray:
    """The down-facing hand next to a nearly down-facing one."""
    y = rotation[:, 1] * [1.0, 1.0, 0.0]
    y /= max(float(np.linalg.norm(y)), 1e-9)
    z = np.array([0.0, 0.0, -1.0])
    return np.stack([np.cross(y, z), y, z], axis=1)


def pinching(towards: np.ndarray, tilt: float, length: np.ndarray, current: np.ndarray) -> np.ndarray:
    """A hand that leads with its fingers ``towards``, tilted from the vertical, and closes across ``length``.

    Args:
        towards: horizontal unit vector [3].
        tilt: radians; 0 points down, pi / 2 along ``towards``.
        length: direction of the bar to hold, [3].
        current: the hand's present rotation, [3, 3].

    Returns:
        The rotation [3, 3] nearest to home, of equals the one nearest to the current one.
    """
    lies = abs(length[2]) < np.sqrt(0.5)
    return _leading(towards, tilt, current, upright_closing=lies)


def tilted(towards: np.ndarray, tilt: float, current: np.ndarray) -> np.ndarray:
    """A hand tilted in the same way that closes horizontally, across ``towards``, [3, 3]."""
    return _leading(towards, tilt, current, upright_closing=False)


def _leading(towards: np.ndarray, tilt: float, current: np.ndarray, *, upright_closing: bool) -> np.ndarray:
    z = np.sin(tilt) * towards - np.cos(tilt) * np.array([0.0, 0.0, 1.0])
    side = np.cross([0.0, 0.0, 1.0], towards)
    across = np.cross(z, side) if upright_closing else side
    hands = [np.stack([np.cross(y, z), y, z], axis=1) for y in (across, -across)]
    return max(hands, key=lambda hand: float(np.trace(hand @ (HOME_ROTATION + 0.1 * current).T)))
