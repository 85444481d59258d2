"""Grasping an object among its neighbours, and putting it down: candidate poses, their cost, and the height of rest.

A :class:`~vecenv.manipulation.world.SceneGeometry` whose hand holds an object and a :class:`Target` come in; the pose
of the hand at the release comes out (:func:`put_down`). Heights come from surface points of the object,
of what it will rest on, and of what the open hand must not touch. :func:`choose_grasp` gives the grasp at the start of
a transfer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vecenv.manipulation.entering import put_in
from vecenv.manipulation.grasps import Grasps, Gripper, clearance, find_grasps
from vecenv.manipulation.laying import laid_down
from vecenv.manipulation.reach import PandaArm
from vecenv.manipulation.rims import find_rim_grasps
from vecenv.manipulation.targets import Target, can_take, rest_move
from vecenv.manipulation.world import Margins, SceneGeometry, around, down_facing, leaning, spun, upright, yaw


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


def choose_grasp(
    world: SceneGeometry, name: str, failed: Sequence[np.ndarray] = (), *, narrow: bool = True
) -> Grasped | None:
    """The best grasp of an object among its neighbours, or None when it offers nothing to hold.

    The open hand is tried first, pointing down; where neighbours leave it no room, the hand with half-closed fingers
    and the hand that leans to some side. A dish without faces to hold is taken by its rim.

    Args:
        world: the scene.
        name: the object.
        failed: positions of grasps that failed, relative to the object's origin, world axes.
        narrow: the fingers may go in half closed; False where they can only be opened and closed.
    """
    wide = _best_grasp(world, name, failed, world.config.gripper)
    if wide is not None and wide[1] > world.config.least_room:
        return wide[0]
    rim = wide is None and _rim_grasp(world, name, failed)
    if rim:
        return rim
    half_closed = narrow and _best_grasp(world, name, failed, world.config.gripper.narrowed(world.config.narrow))
    for tilt in world.config.grasp_tilts if wide is None or wide[1] < 0 else ():
        leant = _tilted_grasp(world, name, failed, tilt)
        if leant is not None:
            return leant
    found = [option for option in (wide, half_closed) if option]
    return max(found, key=lambda option: option[1])[0] if found else None


def _best_grasp(
    world: SceneGeometry, name: str, failed: Sequence[np.ndarray], gripper: Gripper
) -> tuple[Grasped, float] | None:
    """The best grasp of a hand opened so far, and its room."""
    config = world.config
    cloud = world.snapshot.objects[name]
    grasps = find_grasps(cloud.points, cloud.normals, gripper)
    if not len(grasps):
        return None
    others = np.concatenate([world.others(name), world.walls])
    near = around(cloud.points.mean(axis=0)[:2], others, config.neighbours)
    room = clearance(grasps, near, gripper)
    rotations = down_facing(grasps.axis)
    score = grasps.score + np.minimum(room, config.ample_room) / config.room_scale
    lacking = np.maximum(config.least_room - room, 0.0)
    score = score - np.where(lacking > 0, 10.0 + lacking / config.lack_scale, 0.0)
    score = score - np.abs(yaw(rotations)) / config.turn_scale - _reach_cost(world, grasps.pos)
    origin = world.snapshot.poses[name][:3]
    for pos in failed:
        score = score - 5.0 * (np.linalg.norm(grasps.pos - origin - pos, axis=1) < config.retry_radius)
    best = _first_reached(world, score, grasps.pos, rotations)
    narrow = gripper.half_opening < config.gripper.half_opening
    return Grasped(grasps.pos[best], rotations[best], float(grasps.width[best]), narrow), float(room[best])


def _tilted_grasp(world: SceneGeometry, name: str, failed: Sequence[np.ndarray], tilt: float) -> Grasped | None:
    """The best grasp with room of a hand that leans so far to one of eight sides, radians; None if there is none.

    In the frame of such a hand it points down, so that everything is as for an upright one.
    """
    config, cloud = world.config, world.snapshot.objects[name]
    middle = cloud.points.mean(axis=0)
    near = around(middle[:2], np.concatenate([world.others(name), world.walls]), config.neighbours)
    near = np.concatenate([near, _table_under(world, middle)])
    best, highest = None, -np.inf
    for heading in np.arange(8) * np.pi / 4:
        frame = spun(leaning(tilt), heading) @ spun(np.eye(3), -heading)
        grasps = find_grasps(cloud.points @ frame, cloud.normals @ frame, config.gripper)
        room = clearance(grasps, near @ frame, config.gripper)
        rotations = frame @ down_facing(grasps.axis)
        pos = grasps.pos @ frame.T
        score = grasps.score + np.minimum(room, config.ample_room) / config.room_scale
        score = score - np.abs(yaw(rotations)) / config.turn_scale - _reach_cost(world, pos)
        for place in failed:
            tried = np.linalg.norm(pos - world.snapshot.poses[name][:3] - place, axis=1) < config.retry_radius
            score = score - 5.0 * tried
        score = np.where(room > config.least_room, score, -np.inf)
        i = _first_reached(world, score, pos, rotations) if len(score) else -1
        if i >= 0 and score[i] > highest:
            best, highest = Grasped(pos[i], rotations[i], float(grasps.width[i])), float(score[i])
    return best


def _rim_grasp(world: SceneGeometry, name: str, failed: Sequence[np.ndarray]) -> Grasped | None:
    """The best grasp of a dish by its rim that has room and that the arm can take; None if there is none."""
    config, points = world.config, world.points(name)
    grasps = find_rim_grasps(points, config.gripper)
    if not len(grasps):
        return None
    near = around(points.mean(axis=0)[:2], np.concatenate([world.others(name), world.walls]), config.neighbours)
    near = near[near[:, 2] > points[:, 2].min() + config.least_room]
    hands = zip(grasps.pos, grasps.rotation, strict=True)
    rooms = np.array([_room_ahead(*hand, near, config.gripper) for hand in hands])
    score = grasps.far / config.rim_scale + np.minimum(rooms, config.ample_room) / config.room_scale
    score = score - np.abs(yaw(grasps.rotation)) / config.turn_scale - _reach_cost(world, grasps.pos)
    score = score - grasps.tilt / config.tilt_scale
    for place in failed:
        tried = np.linalg.norm(grasps.pos - world.snapshot.poses[name][:3] - place, axis=1) < config.retry_radius
        score = score - 5.0 * tried
    fits = rooms > config.least_room
    if not fits.any():
        return None
    i = _first_reached(world, np.where(fits, score, -np.inf), grasps.pos, grasps.rotation)
    return Grasped(grasps.pos[i], grasps.rotation[i], config.gripper.half_opening)


def _room_ahead(pos: np.ndarray, rotation: np.ndarray, obstacles: np.ndarray, gripper: Gripper) -> float:
    """Room around an open hand at a pose and on its way there along its own axis, metres."""
    local = (obstacles - pos) @ rotation @ down_facing(np.array([[0.0, 1.0, 0.0]]))[0].T
    here = Grasps(np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]), np.zeros(1), np.zeros(1))
    return float(clearance(here, local, gripper)[0])


def _first_reached(world: SceneGeometry, score: np.ndarray, pos: np.ndarray, rotations: np.ndarray) -> int:
    """Row of the best hand that the arm can take; of the best one if it can take none, or if the arm is not known."""
    best = int(score.argmax())
    if world.snapshot.panda_base is None:
        return best
    arm = PandaArm(world.snapshot.panda_base)
    for i in np.argsort(-score, kind="stable"):
        if np.isneginf(score[i]):
            break
        if arm.reaches(pos[i][None], rotations[i][None])[0]:
            return int(i)
    return best


def _table_under(world: SceneGeometry, middle: np.ndarray) -> np.ndarray:
    """Points 1 cm apart on the table around a place, [N, 3]: of the whole scene's samples too few lie there."""
    ticks = np.arange(-0.16, 0.161, 0.01)
    x, y = np.meshgrid(ticks, ticks)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, world.ground(middle[:2]))], axis=1) + [*middle[:2], 0.0]


def _reach_cost(world: SceneGeometry, pos: np.ndarray) -> np.ndarray:
    if world.base is None:
        return np.zeros(len(pos))
    far = np.linalg.norm(pos[:, :2] - world.base, axis=1) - world.config.easy_reach
    return np.maximum(far, 0) / world.config.reach_scale


def carry_height(world: SceneGeometry, name: str, hand: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Height of the hand at which an object held at ``hand`` passes over everything between two places."""
    hangs = hand[2] - min(world.points(name)[:, 2].min(), hand[2] - world.config.gripper.tip)
    return world.tallest(start, end, name) + hangs + world.config.over_obstacles


def put_down(world: SceneGeometry, name: str, target: Target) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] and rotation [3, 3] of the hand when it lets go."""
    if target.entry is not None:
        return put_in(world, name, target, target.entry)
    rotation = upright(world.hand_rotation) if world.hand_rotation[2, 2] < -0.98 else world.hand_rotation
    laid = laid_down(world, name, target)
    if laid is not None:
        return laid
    best, lowest = (world.hand, rotation), np.inf
    for angle in _turns(world, name, target, rotation):
        places, costs = _with_corners(world, name, target, spun(np.eye(3), angle))
        for xy, cost in zip(places, costs + abs(angle) / world.config.turn_scale, strict=True):
            if cost >= lowest:  # costs ascend and nothing makes them less
                break
            end, extra = _put_down_at(world, name, target, xy, spun(np.eye(3), angle))
            if cost + extra < lowest:
                best, lowest = (end, spun(rotation, angle)), cost + extra
    return best if can_take(world, *best) else _put_down_leaning(world, name, target, best)


def put_in_corner(
    world: SceneGeometry, name: str, target: Target, middle: np.ndarray, rotation: np.ndarray
) -> np.ndarray:
    """Position [3] of the hand that puts an object into a corner of a box that is open to above.

    Of the corners that the arm can take, it is the one that costs least, as in :func:`put_down`; of equals the one
    farthest from the robot, so that what comes next does not have to pass over it.

    Args:
        world: the scene.
        name: the held object.
        target: the box to fit in.
        middle: position of the hand, [3], where none is possible.
        rotation: of the hand, [3, 3].
    """
    if target.centre is None or target.half is None or target.entry is not None:
        return middle
    turn = rotation @ world.hand_rotation.T
    options = []
    for corner in _corners(world, name, target, turn):
        at, cost = _put_down_at(world, name, target, corner, turn)
        far = 0.0 if world.base is None else float(np.linalg.norm(at[:2] - world.base))
        options.append((round(cost, 2), -far, at))
    for _, _, at in sorted(options, key=lambda option: option[:2]):
        if can_take(world, at, rotation):
            return at
    return middle


def _corners(world: SceneGeometry, name: str, target: Target, turn: np.ndarray) -> np.ndarray:
    """Places of an object's origin, turned by ``turn`` [3, 3], in the corners of a box, [4, 2]; [0, 2] if none fits."""
    if target.centre is None or target.half is None:
        return np.zeros((0, 2))
    hung = ((world.points(name) - world.snapshot.poses[name][:3]) @ turn.T)[:, :2]
    low, high = target.centre - target.half - hung.min(axis=0), target.centre + target.half - hung.max(axis=0)
    if (high < low).any():
        return np.zeros((0, 2))
    inset = np.clip((high - low) / 2, 0.0, world.config.touchdown)
    ends = np.stack([low + inset, high - inset])
    return np.stack([ends[[0, 0, 1, 1], 0], ends[[0, 1, 0, 1], 1]], axis=1)


def _with_corners(world: SceneGeometry, name: str, target: Target, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The candidates of a target with the corners of its box, [M, 2], and what each costs, ascending, [M]."""
    corners = _corners(world, name, target, turn)
    if not len(corners):
        return target.xy, target.cost
    far = np.linalg.norm(corners - target.xy[0], axis=1) / world.config.aside_scale
    places, costs = np.concatenate([target.xy, corners]), np.concatenate([target.cost, far])
    order = np.argsort(costs, kind="stable")
    return places[order], costs[order]


def _put_down_leaning(
    world: SceneGeometry, name: str, target: Target, upright_hand: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`put_down` where the arm cannot take the pose: hand and object lean away from the robot.

    Let go, the object tips back on its base. Leans that leave the arm some reach come first: an arm that is stretched
    out swings its elbow past straight, where it no longer folds.
    """
    pos, rotation = upright_hand
    if world.base is None:
        return upright_hand
    out = np.append(pos[:2] - world.base, 0.0) / max(float(np.linalg.norm(pos[:2] - world.base)), 1e-9)
    heading = float(np.arctan2(out[1], out[0]))
    turn = rotation @ world.hand_rotation.T
    options = []
    for tilt in world.config.place_tilts:
        lean = spun(leaning(tilt), heading) @ spun(np.eye(3), -heading)
        for xy, cost in zip(target.xy, target.cost + tilt / world.config.tilt_scale, strict=True):
            end, extra = _put_down_at(world, name, target, xy, lean @ turn)
            options.append((cost + extra, end, lean @ rotation))
    options.sort(key=lambda option: option[0])
    for spare in (world.config.spare_reach, 0.0):
        for _, end, hand in options:
            if can_take(world, end, hand, spare):
                return end, hand
    return upright_hand


def _turns(world: SceneGeometry, name: str, target: Target, rotation: np.ndarray) -> list[float]:
    """Angles by which the hand may turn what it holds: none, and those that align it with a box it must fit in."""
    if target.half is None:
        return [0.0]
    spread = world.points(name)[:, :2] - world.points(name)[:, :2].mean(axis=0)
    _, vectors = np.linalg.eigh(spread.T @ spread)
    aligned = -np.arctan2(vectors[1, 1], vectors[0, 1]) + np.arange(-2, 3) * np.pi / 2
    now = float(yaw(rotation))
    return [0.0, *(float(angle) for angle in aligned if abs(now + angle) < world.config.widest_turn)]


def _put_down_at(
    world: SceneGeometry, name: str, target: Target, xy: np.ndarray, turn: np.ndarray
) -> tuple[np.ndarray, float]:
    """Position of the hand [3] that puts the origin over ``xy``, turned by ``turn`` [3, 3]; and what that costs."""
    config = world.config
    middle = xy - (turn @ (world.snapshot.poses[name][:3] - world.hand))[:2]
    moved = (world.points(name) - world.hand) @ turn.T + np.append(middle, world.hand[2])
    near, walls = (
        around(middle, cloud, config.neighbours) for cloud in (world.others(name, *target.ignored), world.walls)
    )
    resting = world.hand[2] + rest_move(moved, near, target.floor, config)
    axis = (turn @ upright(world.hand_rotation))[:, 1]
    height = _with_room(np.append(middle, resting), axis, np.concatenate([near, walls]), config)
    moved = moved + [0.0, 0.0, resting - world.hand[2]]
    sits = max(float(moved[:, 2].min()) - target.floor, 0.0)
    cost = (
        _height_cost(sits, moved, near, config, contained=target.half is not None)
        + config.drop_cost * (height - resting)
        + _overhang(moved, target) / config.overhang_scale
    )
    return np.append(middle, height), cost


def _height_cost(sits: float, points: np.ndarray, obstacles: np.ndarray, config: Margins, *, contained: bool) -> float:
    """What it costs that an object comes to rest so high over the floor of its target, metres.

    In a container it stands beside other things if it can, else it tips over into what room there is.
    """
    if not contained or sits <= config.stacked:
        return config.high_cost * sits
    if _tips(points, obstacles, config):
        return config.tipped_cost
    return config.stacked_cost + config.high_cost * sits


def _tips(points: np.ndarray, obstacles: np.ndarray, config: Margins) -> bool:
    """Whether points that were brought to rest tip over: their middle is not above what carries them."""
    middle = points.mean(axis=0)[:2]
    low, high = points[:, :2].min(axis=0) - config.support_radius, points[:, :2].max(axis=0) + config.support_radius
    below = obstacles[((obstacles[:, :2] > low) & (obstacles[:, :2] < high)).all(axis=1)]
    apart = np.linalg.norm(points[:, None, :2] - below[None, :, :2], axis=2)
    under = np.where(apart < config.support_radius, points[:, None, 2], np.inf).min(axis=0, initial=np.inf)
    carrying = below[(under - below[:, 2] < 2 * config.touchdown)][:, :2] - middle
    if not len(carrying):
        return False
    headings = np.arange(24) * np.pi / 12
    ahead = carrying @ np.stack([np.cos(headings), np.sin(headings)])
    return float(ahead.max(axis=0).min()) < -config.touchdown


def _overhang(points: np.ndarray, target: Target) -> float:
    """How far points stick out of the box they must fit in, horizontally."""
    if target.half is None or target.centre is None:
        return 0.0
    return float((np.abs(points[:, :2] - target.centre) - target.half).max(initial=0.0))


def _with_room(hand: np.ndarray, axis: np.ndarray, obstacles: np.ndarray, config: Margins) -> float:
    """The lowest height from ``hand`` upward at which the open hand touches nothing."""
    heights = hand[2] + np.arange(0.0, 0.16, 0.01)
    pos = np.stack([np.full_like(heights, hand[0]), np.full_like(heights, hand[1]), heights], axis=1)
    hands = Grasps(pos, np.tile(axis, (len(heights), 1)), np.zeros(len(heights)), np.zeros(len(heights)))
    room = clearance(hands, obstacles, config.gripper)
    return float(heights[int(np.argmax(room > 0.002))]) if (room > 0.002).any() else float(heights[-1])
