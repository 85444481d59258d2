"""Plan how one object is picked up and where it is put down, as waypoints, from one snapshot of ground truth.

A pick goes above the chosen grasp, straight down, closes, and lifts clear of everything between here and the target. A
place goes above the target, lowers until the object rests (or as far as the open hand has room), opens and backs off.
Heights come from surface points: of the object, of what it will rest on, and of what lies on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from eval.policies.grasp import Grasps, Gripper, clearance, find_grasps
from eval.policies.pick_place_motion import CLOSE, HOLD, OPEN, Waypoint
from vecenv.contract import ObjectsSnapshot, RegionBox

# The hand pointing down with the fingers closing along world y, as a Panda starts.
HOME_ROTATION = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class TransferConfig:
    """Margins of a transfer. Metres unless noted.

    Attributes:
        gripper: shape of the hand.
        above: the least height over a grasp or a target from which the hand comes straight down.
        over_obstacles: vertical room over whatever lies on the way.
        corridor: half width of what counts as on the way.
        neighbours: points farther than this from a grasp or target are not looked at.
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
        high_cost: coming to rest higher than the target's floor, on something else, costs this much a metre.
        drop_cost: letting go above the place of rest, for want of room for the hand, costs this much a metre.
        widest_turn: hands turn no further than this from home, radians.
        overhang_scale: sticking out this much of a box to fit in costs one point.
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
    drop_cost: float = 10.0
    widest_turn: float = 1.75
    overhang_scale: float = 0.005
    least_lift: float = 0.08
    retreat: float = 0.08


@dataclass(frozen=True)
class Target:
    """Where an object's origin may go.

    Attributes:
        xy: candidates, world frame, [M, 2].
        cost: what each costs, ascending, [M].
        floor: height that carries it whatever the points say, metres.
        ignored: things whose points are no obstacle.
        centre, half: a box to fit in, horizontally, [2] each; None where there is none.
    """

    xy: np.ndarray
    cost: np.ndarray
    floor: float
    ignored: tuple[str, ...] = ()
    centre: np.ndarray | None = None
    half: np.ndarray | None = None


@dataclass(frozen=True)
class Grasped:
    """The grasp a pick was planned with.

    Attributes:
        pos: of the grip site, [3].
        rotation: of the hand, [3, 3].
        width: thickness of what is held, metres.
        narrow: the fingers go in half closed.
    """

    pos: np.ndarray
    rotation: np.ndarray
    width: float
    narrow: bool = False


class World:
    """One snapshot, as planning looks at it.

    Args:
        snapshot: ground truth of one slot.
        config: margins.
        base: where the robot stands, [2], None where reach does not matter.

    Attributes:
        walls: points on the walls of drawers, of which surface samples have too few.
    """

    def __init__(self, snapshot: ObjectsSnapshot, config: TransferConfig, base: np.ndarray | None = None) -> None:
        self.snapshot, self.config = snapshot, config
        self.base = base
        drawers = [region for region in snapshot.regions.values() if region.axis is not None]
        self.walls = np.concatenate([np.zeros((0, 3)), *(_walls(region) for region in drawers)])
        named = sum(len(cloud.points) for cloud in snapshot.objects.values())
        self.scenery = snapshot.scene.points[named:]
        self._scenery_up = self.scenery[snapshot.scene.normals[named:, 2] > 0.9]
        self.hand = snapshot.ee_pose[:3]
        self.hand_rotation = matrix(snapshot.ee_pose[3:])

    def points(self, name: str) -> np.ndarray:
        """Surface points of one thing, [N, 3]."""
        return self.snapshot.objects[name].points

    def others(self, *names: str) -> np.ndarray:
        """Surface points of everything but ``names``, [N, 3]."""
        clouds = [cloud.points for name, cloud in self.snapshot.objects.items() if name not in names]
        return np.concatenate([*clouds, self.scenery])

    def ground(self, xy: np.ndarray) -> float:
        """Height of the table or floor around a place."""
        up = self._scenery_up
        near = up[np.linalg.norm(up[:, :2] - xy, axis=1) < 0.2]
        return float(near[:, 2].max()) if len(near) else float(self.scenery[:, 2].min())

    def tallest(self, start: np.ndarray, end: np.ndarray, *ignored: str) -> float:
        """Height of the tallest thing on the straight way between two places."""
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


def choose_grasp(world: World, name: str, failed: Sequence[np.ndarray] = ()) -> Grasped | None:
    """The best grasp of an object among its neighbours, or None when it offers nothing to hold.

    The open hand is tried first; where neighbours leave it no room, the hand with half-closed fingers too.

    Args:
        world: the scene.
        name: the object.
        failed: positions of grasps that were tried in vain, relative to the object's origin, world axes.
    """
    wide = _best_grasp(world, name, failed, world.config.gripper)
    if wide is not None and wide[1] > world.config.least_room:
        return wide[0]
    narrow = _best_grasp(world, name, failed, world.config.gripper.narrowed(world.config.narrow))
    found = [option for option in (wide, narrow) if option is not None]
    return max(found, key=lambda option: option[1])[0] if found else None


def _best_grasp(
    world: World, name: str, failed: Sequence[np.ndarray], gripper: Gripper
) -> tuple[Grasped, float] | None:
    """The best grasp of a hand opened so far, and its room."""
    config = world.config
    cloud = world.snapshot.objects[name]
    grasps = find_grasps(cloud.points, cloud.normals, gripper)
    if not len(grasps):
        return None
    others = np.concatenate([world.others(name), world.walls])
    near = _around(cloud.points.mean(axis=0)[:2], others, config.neighbours)
    room = clearance(grasps, near, gripper)
    rotations = down_facing(grasps.axis)
    score = grasps.score + np.minimum(room, config.ample_room) / config.room_scale
    lacking = np.maximum(config.least_room - room, 0.0)
    score = score - np.where(lacking > 0, 10.0 + lacking / config.lack_scale, 0.0)
    score = score - np.abs(yaw(rotations)) / config.turn_scale - _reach_cost(world, grasps)
    origin = world.snapshot.poses[name][:3]
    for pos in failed:
        score = score - 5.0 * (np.linalg.norm(grasps.pos - origin - pos, axis=1) < config.retry_radius)
    best = int(score.argmax())
    narrow = gripper.half_opening < config.gripper.half_opening
    return Grasped(grasps.pos[best], rotations[best], float(grasps.width[best]), narrow), float(room[best])


def _reach_cost(world: World, grasps: Grasps) -> np.ndarray:
    if world.base is None:
        return np.zeros(len(grasps))
    far = np.linalg.norm(grasps.pos[:, :2] - world.base, axis=1) - world.config.easy_reach
    return np.maximum(far, 0) / world.config.reach_scale


def pick(world: World, name: str, grasp: Grasped, towards: np.ndarray) -> list[Waypoint]:
    """Waypoints that take hold of an object and lift it for a transfer.

    Args:
        world: the scene.
        name: the object.
        grasp: how to hold it.
        towards: where it will go, [2] or [3].
    """
    config, rotation = world.config, grasp.rotation
    over = world.tallest(world.hand, grasp.pos) + config.gripper.tip + config.over_obstacles
    over = max(over, grasp.pos[2] + config.above)
    height = carry_height(world, name, grasp.pos, grasp.pos, towards)
    above = _at(grasp.pos, over)
    halfway = [Waypoint(above, rotation, CLOSE, ticks=config.narrow_ticks)] if grasp.narrow else []
    grip = HOLD if grasp.narrow else OPEN
    return [
        *_rise(world, over, OPEN),
        Waypoint(above, rotation, OPEN, tolerance=0.012, turn_tolerance=0.12),
        *halfway,
        Waypoint(grasp.pos, rotation, grip, tolerance=0.004, turn_tolerance=0.06),
        Waypoint(grasp.pos, rotation, CLOSE, fingers=True),
        Waypoint(_at(grasp.pos, max(height, grasp.pos[2] + config.least_lift)), rotation, CLOSE, tolerance=0.025),
    ]


def carry_height(world: World, name: str, hand: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Height of the hand at which an object held at ``hand`` passes over everything between two places."""
    hangs = hand[2] - min(world.points(name)[:, 2].min(), hand[2] - world.config.gripper.tip)
    return world.tallest(start, end, name) + hangs + world.config.over_obstacles


def place(world: World, name: str, target: Target) -> list[Waypoint]:
    """Waypoints that put down an object that is in the hand.

    Args:
        world: the scene, the object held.
        name: the object.
        target: where its origin may go.
    """
    config = world.config
    end, rotation = _put_down(world, name, target)
    over = max(carry_height(world, name, world.hand, world.hand, end), end[2] + 0.02)
    return [
        *_rise(world, over, CLOSE),
        Waypoint(_at(end, over), rotation, CLOSE, tolerance=0.012, turn_tolerance=0.12),
        Waypoint(end, rotation, CLOSE, tolerance=0.005, speed=0.8),
        Waypoint(end, rotation, OPEN, fingers=True),
        Waypoint(_at(end, end[2] + config.retreat), rotation, OPEN, tolerance=0.03),
    ]


def _put_down(world: World, name: str, target: Target) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] and rotation [3, 3] of the hand when it lets go."""
    rotation = _upright(world.hand_rotation)
    best, lowest = (world.hand, rotation), np.inf
    for angle in _turns(world, name, target, rotation):
        for xy, cost in zip(target.xy, target.cost + abs(angle) / world.config.turn_scale, strict=True):
            if cost >= lowest:  # costs ascend and nothing makes them less
                break
            end, extra = _put_down_at(world, name, target, xy, angle)
            if cost + extra < lowest:
                best, lowest = (end, spun(rotation, angle)), cost + extra
    return best


def _turns(world: World, name: str, target: Target, rotation: np.ndarray) -> list[float]:
    """Angles by which the hand may turn what it holds: none, and those that align it with a box it must fit in."""
    if target.half is None:
        return [0.0]
    spread = world.points(name)[:, :2] - world.points(name)[:, :2].mean(axis=0)
    _, vectors = np.linalg.eigh(spread.T @ spread)
    aligned = -np.arctan2(vectors[1, 1], vectors[0, 1]) + np.arange(-2, 3) * np.pi / 2
    now = float(yaw(rotation))
    return [0.0, *(float(angle) for angle in aligned if abs(now + angle) < world.config.widest_turn)]


def _put_down_at(world: World, name: str, target: Target, xy: np.ndarray, angle: float) -> tuple[np.ndarray, float]:
    """Position of the hand [3] that puts the origin over ``xy``, turned by ``angle``; and what that costs."""
    config = world.config
    turn = spun(np.eye(3), angle)
    middle = xy - (turn @ (world.snapshot.poses[name][:3] - world.hand))[:2]
    moved = (world.points(name) - world.hand) @ turn.T + np.append(middle, world.hand[2])
    near, walls = (
        _around(middle, cloud, config.neighbours) for cloud in (world.others(name, *target.ignored), world.walls)
    )
    resting = world.hand[2] + _rest(moved, near, target.floor, config)
    axis = (turn @ _upright(world.hand_rotation))[:, 1]
    height = _with_room(np.append(middle, resting), axis, np.concatenate([near, walls]), config)
    sits = resting - world.hand[2] + world.points(name)[:, 2].min() - target.floor
    cost = (
        config.high_cost * max(sits, 0.0)
        + config.drop_cost * (height - resting)
        + _overhang(moved, target) / config.overhang_scale
    )
    return np.append(middle, height), cost


def _overhang(points: np.ndarray, target: Target) -> float:
    """How far points stick out of the box they must fit in, horizontally."""
    if target.half is None or target.centre is None:
        return 0.0
    return float((np.abs(points[:, :2] - target.centre) - target.half).max(initial=0.0))


def spun(rotation: np.ndarray, angle: float) -> np.ndarray:
    """A rotation followed by a turn about the vertical."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ rotation


def _around(xy: np.ndarray, points: np.ndarray, radius: float) -> np.ndarray:
    """The points within a horizontal distance."""
    return points[np.linalg.norm(points[:, :2] - xy, axis=1) < radius]


def _rest(points: np.ndarray, obstacles: np.ndarray, floor: float, config: TransferConfig) -> float:
    """Vertical move that brings points to rest on obstacles or on the floor, nearly touching."""
    lift = floor - points[:, 2].min()
    low, high = points[:, :2].min(axis=0) - config.support_radius, points[:, :2].max(axis=0) + config.support_radius
    obstacles = obstacles[((obstacles[:, :2] > low) & (obstacles[:, :2] < high)).all(axis=1)]
    if len(obstacles):
        apart = np.linalg.norm(points[:, None, :2] - obstacles[None, :, :2], axis=2)
        under = np.where(apart < config.support_radius, points[:, None, 2], np.inf).min(axis=0)
        lift = max(lift, float((obstacles[:, 2] - under).max()))
    return lift + config.touchdown


def _with_room(hand: np.ndarray, axis: np.ndarray, obstacles: np.ndarray, config: TransferConfig) -> float:
    """The lowest height from ``hand`` upward at which the open hand touches nothing."""
    heights = hand[2] + np.arange(0.0, 0.16, 0.01)
    pos = np.stack([np.full_like(heights, hand[0]), np.full_like(heights, hand[1]), heights], axis=1)
    hands = Grasps(pos, np.tile(axis, (len(heights), 1)), np.zeros(len(heights)), np.zeros(len(heights)))
    room = clearance(hands, obstacles, config.gripper)
    return float(heights[int(np.argmax(room > 0.002))]) if (room > 0.002).any() else float(heights[-1])


def _upright(rotation: np.ndarray) -> np.ndarray:
    """The down-facing hand next to a nearly down-facing one."""
    y = rotation[:, 1] * [1.0, 1.0, 0.0]
    y /= max(float(np.linalg.norm(y)), 1e-9)
    z = np.array([0.0, 0.0, -1.0])
    return np.stack([np.cross(y, z), y, z], axis=1)


def _rise(world: World, height: float, grip: float) -> list[Waypoint]:
    """Straight up first, where the hand is well below the height at which it will travel."""
    if world.hand[2] > height - 0.04:
        return []
    return [Waypoint(_at(world.hand, height), _upright(world.hand_rotation), grip, tolerance=0.03, turn_tolerance=0.5)]


def _at(pos: np.ndarray, height: float) -> np.ndarray:
    """The same place at another height."""
    return np.array([pos[0], pos[1], height])
