"""Objects that are moved without a grasp: model-predictive pushes along a planned path, one per snapshot.

A :class:`PushTask` (the object and its path) and a fresh view of it come in; the stops of one push each go out, for all
slots that push, in one call of the search. The loop is upstream's (``interfaces.py``, ``execute``): it ends when the
object is within a centimetre of the end of its path, and waypoints of the path that lie behind it are skipped.

What is pushed may be a part that hangs on a joint: a drawer, a door or its handle. Its path is the joint's, as far as
the target and the joint's travel allow (:class:`~voxposer.joint_motion.JointMotion`). A joint that is to be pushed to
its end is pushed a little beyond it, so that it closes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import numpy as np
from scipy.spatial import KDTree

from vecenv.errors import VecenvError
from vecenv.manipulation.reach import PandaArm
from vecenv.manipulation.routes import Stop
from vecenv.observations import PointCloud
from voxposer.joint_motion import JointMotion
from voxposer.perception.view import Perception
from voxposer.planning.push import Push, PushConfig, best_push, push_waypoints

# Largest vertical part of the way of something that level pushes can move.
_LEVEL = 0.3
# Pushes searched for at once: one shape, one compilation.
CHUNK = 8


class PushError(VecenvError, RuntimeError):
    """An object cannot be pushed where it should go."""


@dataclass(frozen=True, kw_only=True)
class PushingConfig:
    """How objects are pushed. Metres unless noted.

    Attributes:
        push: options of the search, and of the motion where there is ample room.
        starts: distance before the contact at which a push may start, and the slant of the fingers, radians, best
            first. Where the scene behind leaves no room, the hand leans over the object and reaches behind it.
        near: an object this close to the end of its path has arrived.
        near_end: a joint that is pushed to its end has arrived when this close to it.
        beyond: a joint is pushed this far beyond its end.
        most: largest number of pushes for one path.
        over_ground: the grip site stays this far above the table.
        reach: horizontal distance from the robot's base that a hand pointing down can reach.
        slanted_reach: reduction of the reach for a hand whose fingers are level.
        moved: a push that moved the object less than this has failed.
        elsewhere: the next push touches at least this far from a failed one.
        detour: how far an object is pushed aside that cannot be pushed along its path.
        detours: angles between that and the straight line, tried in turn to either side, radians.
        facing: smallest cosine between a face and the push against it.
        room: room that the hand needs around it where a push starts.
        part_margin: surface this close to a pushed part belongs to it.
        body: the closed hand in its own frame (x, y across the fingers, z out of them), lower and upper corners of the
            fingers, the palm, and the wrist, which reaches to either side.
    """

    push: PushConfig = field(default_factory=lambda: PushConfig(push_speed=0.5, retreat_speed=1.0))
    starts: tuple[tuple[float, float], ...] = (
        (0.08, np.pi / 4),
        (0.05, np.pi / 4),
        (0.08, 0.0),
        (0.05, 0.0),
        (0.05, -0.5),
        (0.03, -0.5),
        (0.02, -0.5),
        (0.03, -0.8),
    )
    near: float = 0.01
    near_end: float = 0.003
    beyond: float = 0.02
    most: int = 12
    over_ground: float = 0.02
    reach: float = 0.80
    slanted_reach: float = 0.12
    moved: float = 0.008
    elsewhere: float = 0.03
    detour: float = 0.07
    detours: tuple[float, ...] = (0.3, 0.6, 0.9, 1.2, 1.5)
    facing: float = 0.3
    room: float = 0.004
    part_margin: float = 0.015
    body: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...] = (
        ((-0.0105, -0.027, -0.031), (0.0105, 0.027, 0.0095)),
        ((-0.032, -0.104, -0.14), (0.032, 0.104, -0.031)),
        ((-0.100, -0.060, -0.28), (0.100, 0.060, -0.14)),
    )


@dataclass
class PushTask:
    """An object or a part that is pushed along a path.

    Attributes:
        name: of the object, or of the part.
        way: waypoints of its centre, world frame, metres, [P, 3]; the last is the goal. Of a part, they are on the way
            of its joint.
        joint_goal: of a part, how far its joint is to be open, metres or radians; None for an object.
        cursor: index of the next waypoint.
        pushes: number of pushes so far.
        begun: the object's centre before the latest push and the contact of that push, [3] each.
        failed: contacts of pushes that did not move it, relative to its centre, [3] each.
    """

    name: str
    way: np.ndarray
    joint_goal: float | None = None
    cursor: int = 0
    pushes: int = 0
    begun: tuple[np.ndarray, np.ndarray] | None = None
    failed: list[np.ndarray] = field(default_factory=list)


def task_of(name: str, path: np.ndarray, perception: Perception) -> PushTask:
    """The task of pushing an object along a path [P, 3], or a part to where its joint comes nearest to the path's end.

    Raises:
        PushError: the joint moves up or down, which level pushes do not do.
    """
    motion = motion_of(perception, name)
    if motion is None:
        return PushTask(name, path)
    if abs(motion.way[2]) > _LEVEL:
        raise PushError(f"{name} moves up or down, and pushes are level")
    goal = motion.value_at(path[-1])
    return PushTask(name, motion.centres(goal), goal)


def cloud_of(perception: Perception, name: str) -> PointCloud:
    """Surface of an object or a part."""
    part = perception.snapshot.parts.get(name)
    return perception.snapshot.objects[name] if part is None else part.cloud


def motion_of(perception: Perception, name: str) -> JointMotion | None:
    """How a part moves, None for an object."""
    part = perception.snapshot.parts.get(name)
    return None if part is None or part.joint is None else JointMotion.of(part, part.joint)


def arrived(task: PushTask, perception: Perception, config: PushingConfig = PushingConfig()) -> bool:
    """Whether the object is at its goal, or was pushed often enough; waypoints that it has passed are skipped."""
    centre = cloud_of(perception, task.name).points.mean(axis=0)
    _learn(task, centre, config)
    if task.joint_goal is not None:
        return _joint_arrived(task, perception, config)
    left = (task.way[-1] - centre)[:2]
    if np.linalg.norm(left) <= config.near or task.pushes >= config.most:
        return True
    last = len(task.way) - 1
    while task.cursor < last and left @ (task.way[task.cursor] - centre)[:2] <= config.near**2:
        task.cursor += 1
    return False


def _joint_arrived(task: PushTask, perception: Perception, config: PushingConfig) -> bool:
    """Whether a part's joint is where it should be: to the millimetre at its end, where the last pushes do little."""
    motion = motion_of(perception, task.name)
    assert motion is not None
    assert task.joint_goal is not None
    left = motion.metres(task.joint_goal - motion.opened)
    near = config.near_end if motion.is_end(task.joint_goal) and len(task.failed) < 2 else config.near
    task.way = motion.centres(task.joint_goal)
    task.cursor = 0
    return abs(left) <= near or task.pushes >= config.most


def _learn(task: PushTask, centre: np.ndarray, config: PushingConfig) -> None:
    """Record a failed push, so that the next one differs: another contact, or an earlier waypoint."""
    if task.begun is None:
        return
    before, contact = task.begun
    task.begun = None
    if np.linalg.norm((centre - before)[:2]) < config.moved:
        task.failed.append(contact - before)
        task.cursor = max(task.cursor - 1, 0)
    else:
        task.failed.clear()


@dataclass(frozen=True)
class PushSituation:
    """The input of the search for a push.

    Attributes:
        task: the object and its path.
        perception: the present snapshot.
        lowest: height below which the grip site must not go, metres.
        free: points at which the hand has room to push, bool [M].
        goal: where to push the centre, [3].
        ways: of a part, the direction in which each of its points moves, [M, 3]; None for an object.
        carried: of a part, how far its centre moves for each metre that a point moves, [M, 3]; None for an object.
    """

    task: PushTask
    perception: Perception
    lowest: float
    free: np.ndarray
    goal: np.ndarray
    ways: np.ndarray | None = None
    carried: np.ndarray | None = None


def situation(task: PushTask, perception: Perception, config: PushingConfig) -> PushSituation:
    """Where an object can be pushed: to its next waypoint, else to the first later one, else to one side.

    The cursor of the task moves to the waypoint that is chosen.

    Raises:
        PushError: the hand has no room to begin any push.
    """
    centre = cloud_of(perception, task.name).points.mean(axis=0)
    lowest = perception.scene.ground(centre[:2]) + config.over_ground
    if task.joint_goal is not None:
        return _joint_situation(task, perception, lowest, config)
    for cursor in range(task.cursor, len(task.way)):
        free = _touchable(task, perception, task.way[cursor], lowest, config)
        if free.any():
            task.cursor = cursor
            return PushSituation(task, perception, lowest, free, task.way[cursor])
    for goal in _detours(centre, task.way[-1], config):
        free = _touchable(task, perception, goal, lowest, config)
        if free.any():
            task.cursor = max(task.cursor - 1, 0)
            return PushSituation(task, perception, lowest, free, goal)
    raise PushError(f"the hand has no room to begin a push of {task.name}")


def _joint_situation(task: PushTask, perception: Perception, lowest: float, config: PushingConfig) -> PushSituation:
    """Where a part can be pushed: along its joint, and a little beyond where that ends."""
    motion = motion_of(perception, task.name)
    assert motion is not None
    assert task.joint_goal is not None
    left = motion.metres(task.joint_goal - motion.opened)
    sign = 1.0 if left >= 0 else -1.0
    ways, carried = motion.ways(cloud_of(perception, task.name).points, sign)
    free = _touchable(task, perception, task.way[-1], lowest, config, ways)
    if not free.any():
        raise PushError(f"the hand has no room to begin a push of {task.name} {'open' if sign > 0 else 'shut'}")
    reach = abs(left) + (config.beyond if motion.is_end(task.joint_goal) else 0.0)
    goal = motion.centre + sign * min(reach, config.push.max_distance) * motion.way
    return PushSituation(task, perception, lowest, free, goal, ways, carried)


def _detours(centre: np.ndarray, end: np.ndarray, config: PushingConfig) -> list[np.ndarray]:
    """Goals to either side of the straight line, the smallest deviation first, [3] each."""
    ahead = (end - centre) * [1.0, 1.0, 0.0]
    ahead /= max(float(np.linalg.norm(ahead)), 1e-6)
    aside = np.array([-ahead[1], ahead[0], 0.0])
    turns = [sign * angle for angle in config.detours for sign in (1, -1)]
    return [centre + config.detour * (np.cos(turn) * ahead + np.sin(turn) * aside) for turn in turns]


def next_pushes(situations: Sequence[PushSituation], config: PushingConfig) -> list[list[Stop]]:
    """The stops of the best push for each slot: over the start, start, end, back, up."""
    found: list[list[Stop]] = []
    for first in range(0, len(situations), CHUNK):
        found += _searched(situations[first : first + CHUNK], config)
    return found


def _searched(situations: Sequence[PushSituation], config: PushingConfig) -> list[list[Stop]]:
    clouds = [cloud_of(situation.perception, situation.task.name) for situation in situations]
    most = max(len(cloud.points) for cloud in clouds)

    def stacked(rows: Sequence[np.ndarray]) -> np.ndarray:
        filled = [np.concatenate([row, np.repeat(row[-1:], most - len(row), axis=0)]) for row in rows]
        return _padded(np.stack(filled), CHUNK - len(situations))

    push = best_push(
        stacked([cloud.points for cloud in clouds]),
        _padded(np.stack([s.goal for s in situations]), CHUNK - len(situations)),
        jax.vmap(jax.random.key)(_padded(np.array([s.task.pushes for s in situations]), CHUNK - len(situations))),
        config.push,
        valid=_padded(np.stack([np.arange(most) < len(cloud.points) for cloud in clouds]), CHUNK - len(situations)),
        normals=stacked([cloud.normals for cloud in clouds]),
        touchable=stacked([s.free for s in situations]),
        lowest=_padded(np.array([s.lowest for s in situations]), CHUNK - len(situations)),
        ways=stacked([_zero_or(s.ways, cloud.points) for s, cloud in zip(situations, clouds, strict=True)]),
        carried=stacked([_zero_or(s.carried, cloud.points) for s, cloud in zip(situations, clouds, strict=True)]),
    )
    for i, s in enumerate(situations):
        s.task.begun = clouds[i].points.mean(axis=0), np.asarray(push.contact[i], float)
        s.task.pushes += 1
        s.task.cursor = min(s.task.cursor + 1, len(s.task.way) - 1)
    return [_way(i, push, s, config) for i, s in enumerate(situations)]


def _zero_or(rows: np.ndarray | None, like: np.ndarray) -> np.ndarray:
    return np.zeros_like(like) if rows is None else rows.astype(like.dtype)


def _way(slot: int, push: Push, situation: PushSituation, config: PushingConfig) -> list[Stop]:
    """The stops of a slot's push, from the first of the starts that has room."""
    contact, ahead = np.asarray(push.contact[slot], float), np.asarray(push.direction[slot], float)
    perception, name, ground = situation.perception, situation.task.name, situation.lowest
    fitting = [s for s in config.starts if _fits(perception, name, contact[None], ahead[None], ground, s, config)[0]]
    distance, slant = (fitting or config.starts)[0]
    chosen = replace(config.push, start_distance=distance, slant=slant)
    one = Push(*(value[slot : slot + 1] for value in push))
    way = push_waypoints(one, chosen, hand=perception.snapshot.ee_pose[3:])
    return _stops(np.asarray(way.pose[0]), np.asarray(way.velocity[0]))


def _touchable(
    task: PushTask,
    perception: Perception,
    target: np.ndarray,
    lowest: float,
    config: PushingConfig,
    ways: np.ndarray | None = None,
) -> np.ndarray:
    """Points that face away from a target and from which a push to it has room to start, bool [M].

    ``ways`` are the directions [M, 3] of pushes at them that do not go straight to the target.
    """
    cloud = cloud_of(perception, task.name)
    ahead = (target - cloud.points if ways is None else ways) * [1.0, 1.0, 0.0]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-6)
    rows = np.flatnonzero((cloud.normals * ahead).sum(axis=1) < -config.facing)
    touchable = np.zeros(len(cloud.points), bool)
    if not len(rows):
        return touchable
    ahead = ahead[rows]
    met = cloud.points[rows] - _reach_back(cloud.points, rows, ahead, lowest, config)[:, None] * ahead
    name = task.name
    room = np.any([_fits(perception, name, met, ahead, lowest, start, config) for start in config.starts], axis=0)
    for place in task.failed:
        room &= np.linalg.norm((met - cloud.points.mean(axis=0) - place)[:, :2], axis=1) > config.elsewhere
    touchable[rows] = room
    return touchable


def _reach_back(
    points: np.ndarray, rows: np.ndarray, ahead: np.ndarray, lowest: float, config: PushingConfig
) -> np.ndarray:
    """Distance behind each of some points at which a hand from behind first meets the object, metres, [len(rows)]."""
    touched = np.maximum(points[rows], [-np.inf, -np.inf, lowest])
    offset = points[None] - touched[:, None]
    back = -np.einsum("ijk,ik->ij", offset, ahead)
    aside = np.linalg.norm((offset + back[..., None] * ahead[:, None])[..., :2], axis=2)
    met = (aside <= config.push.hand_width / 2) & (offset[..., 2] > -config.push.tip)
    return np.where(met & (back < config.push.start_distance), back, 0.0).max(axis=1)


def _fits(
    perception: Perception,
    name: str,
    contacts: np.ndarray,
    ahead: np.ndarray,
    lowest: float,
    start: tuple[float, float],
    config: PushingConfig,
) -> np.ndarray:
    """Whether pushes of an object at ``contacts`` [M, 3] along ``ahead`` [M, 3] have room, bool [M].

    ``start`` is the distance before the contact at which the hand starts, and its slant. The whole hand needs room
    there; on the way to the contact its fingers need room, the pushed object ignored. A part does not move aside, so
    the wrist that pushes it must also keep its distance from the robot's base.
    """
    distance, slant = start
    begin = _raised(contacts - distance * ahead, lowest)
    hands = _hands(ahead, slant)
    around = _obstacles(perception, (), contacts, lowest, config)
    hit = _meets(around, begin, hands, config.body, config.room)
    others = _obstacles(perception, (name,), contacts, lowest, config)
    for share in (0.5, 0.2):
        free = ~hit
        between = _raised(contacts[free] - share * distance * ahead[free], lowest)
        hit[free] = _meets(others, between, hands[free], config.body[:1], 0.0)
    reach = config.reach - config.slanted_reach * max(np.sin(slant), 0.0)
    if name in perception.snapshot.parts:
        wrist = begin - perception.config.wrist_back * hands[:, :, 2] - perception.base
        hit |= np.linalg.norm(wrist[:, :2], axis=1) < perception.config.nearest
    fits = ~hit & (np.linalg.norm((begin - perception.base)[:, :2], axis=1) < reach)
    fits[fits] = _reached(perception, begin[fits], hands[fits])
    return fits


def _reached(perception: Perception, positions: np.ndarray, hands: np.ndarray) -> np.ndarray:
    """Whether the arm has joint angles for hands at positions [M, 3], [M, 3, 3]; one a 2 cm cell is tried."""
    base = perception.snapshot.panda_base
    if base is None or not len(positions):
        return np.ones(len(positions), bool)
    _, first, cell = np.unique(np.round(positions / 0.02).astype(int), axis=0, return_index=True, return_inverse=True)
    return PandaArm(base).reaches(positions[first], hands[first])[cell.ravel()]


def _raised(points: np.ndarray, lowest: float) -> np.ndarray:
    return np.maximum(points, [-np.inf, -np.inf, lowest])


def _hands(ahead: np.ndarray, slant: float) -> np.ndarray:
    """Rotations of hands whose fingers point down, slanted towards ``ahead``, [M, 3, 3]."""
    up = np.array([0.0, 0.0, 1.0])
    out, left = np.sin(slant) * ahead - np.cos(slant) * up, np.cross(up, ahead)
    return np.stack([np.cross(left, out), left, out], axis=2)


def _obstacles(
    perception: Perception, ignored: tuple[str, ...], contacts: np.ndarray, lowest: float, config: PushingConfig
) -> np.ndarray:
    """Surface above the table within reach of a hand at one of the contacts, [N, 3]."""
    points = np.concatenate([perception.scene.others(*ignored), perception.scene.walls])
    points = points[np.linalg.norm((points - contacts.mean(axis=0))[:, :2], axis=1) < 0.4]
    for name in ignored:
        if name in perception.snapshot.parts:
            part = KDTree(perception.snapshot.parts[name].cloud.points)
            points = points[part.query(points)[0] > config.part_margin]
    return _thinned(points[points[:, 2] > lowest - config.over_ground + 0.005])


def _meets(
    points: np.ndarray,
    at: np.ndarray,
    hands: np.ndarray,
    boxes: Sequence[tuple[tuple[float, ...], tuple[float, ...]]],
    room: float,
) -> np.ndarray:
    """Whether points [N, 3] lie in one of a hand's boxes, or nearer to it than ``room``, for each hand, bool [M]."""
    local = hands.swapaxes(1, 2) @ (points.T[None] - at[..., None])  # [M, 3, N], the hands' axes second
    hit = np.zeros(len(at), bool)
    for low, high in boxes:
        inside = np.ones((len(at), len(points)), bool)
        for axis in range(3):
            along = local[:, axis]
            inside &= (along > low[axis] - room) & (along < high[axis] + room)
        hit |= inside.any(axis=1)
    return hit


def _thinned(points: np.ndarray) -> np.ndarray:
    """One point of each cubic centimetre."""
    _, first = np.unique(np.round(points / 0.01).astype(int), axis=0, return_index=True)
    return points[first]


def _stops(poses: np.ndarray, velocity: np.ndarray) -> list[Stop]:
    return [
        Stop(pose[:3].astype(float), pose[3:].astype(float), True, float(v))
        for pose, v in zip(poses, velocity, strict=True)
    ]


def _padded(rows: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([rows, np.repeat(rows[-1:], count, axis=0)])
