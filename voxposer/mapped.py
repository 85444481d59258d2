"""Paths over configuration-space maps: value maps that know the hand, what it carries, and the height of everything.

In: a view of the scene, and the pose that the hand is to reach. Out: a path of the planner that is followed as it is
(``route.mode="map"``), and where along it the hand turns. Three maps are made for each motion:

* avoidance: the room around the hand and its load at every voxel (``vecenv.manipulation.rooms``), once as the hand is
  rotated at the start and once as at the goal, plus what the program wants to avoid, as a price per metre;
* rotation: the start's in the zone that the hand must leave before it has room to turn, the goal's elsewhere;
* affordance: the cost to go to the goal over those prices (``voxposer.planning.cost_to_go``), which has no other
  minimum.

Voxels are 1 cm wide and a grasp leaves a few millimetres, so the maps' voxels are moved to have one exactly at the
start and, outside that zone, one exactly at the goal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation, Slerp

from vecenv.manipulation import rooms
from vecenv.manipulation.reach import PandaArm
from vecenv.manipulation.rooms import Lattice, Solid
from vecenv.manipulation.routes import RouteConfig, Stop
from vecenv.manipulation.world import matrix
from voxposer.perception.view import Perception
from voxposer.planning.config import PlannerConfig
from voxposer.planning.cost_to_go import cost_to_go, flood
from voxposer.planning.planner import descend_value
from voxposer.requests import InterfaceError

# Voxels are twice as fine in height as across: every other layer is computed.
_LAYERS = 2
# Samples of the descent that are smoothed together: bends at a grasp are sharp.
_WINDOW = 6
# How often a path is planned again around places that the arm cannot reach, and how far from those, metres.
_REPLANS, _AVOIDED = 2, 0.04
# Distance of the places that are tried where a goal is out of reach, metres.
_TRIED = 0.02
# Points that would be nearer to a hand that is where it is do not count, metres.
_CONTACT = 0.002
# Rotations that differ by less need no room to turn, radians.
_TURNED = 0.3
# Waypoints over which a path goes over from the start's voxels to the goal's.
_BLEND = 6


class OutOfReach(InterfaceError):
    """The arm cannot take the pose that a motion is to end with."""


@dataclass(frozen=True)
class MappedPath:
    """A path and its rotations.

    Attributes:
        path: over voxels, the start first and the exact goal last, [P, 3].
        turn: index of the first waypoint with the goal's rotation.
        value: the affordance map that was descended: cost to go, 1 at the start, 2 where none is known, [N, N, N].
        avoidance: what a metre costs beyond a free one, from 0 to 1, which is ``route.hit_price`` and more, [N, N, N].
        room: least room around hand and load on the way, metres.
    """

    path: np.ndarray
    turn: int
    value: np.ndarray
    avoidance: np.ndarray
    room: float


def plan_mapped(
    perception: Perception,
    goal: Stop,
    *,
    closed: bool,
    avoidance: np.ndarray | None,
    planner: PlannerConfig,
    route: RouteConfig,
    exact: bool = True,
) -> MappedPath:
    """The way of the hand from where it is to a goal.

    Args:
        perception: the view, the hand where the motion starts.
        goal: the pose to reach.
        closed: the grip on the way.
        avoidance: what else to keep away from, 0 to 1, [N, N, N].
        planner: numbers of the planner.
        route: distances to keep, and prices.
        exact: the goal is a grasp or a place; otherwise it may give way to obstacles by ``route.freed``, and to what
            the arm can reach by ``route.nearer``. A place gives way to that alone, by ``route.aside``.

    Raises:
        OutOfReach: the arm cannot take the goal.
    """
    if not exact:
        goal = _within_reach(perception, goal, route.nearer)
    elif closed and perception.held:  # a place, not a grasp
        goal = _within_reach(perception, goal, route.aside, level=True)
    maps = _maps(perception, goal, closed=closed, avoidance=avoidance, route=route, exact=exact)
    found, price = None, maps.price
    for _ in range(_REPLANS + 1):
        value = cost_to_go(price, maps.lattices[0].step, maps.end, maps.start)
        found = _followed(perception, maps, value, planner, np.clip((price - 1) / route.hit_price, 0, 1))
        found, beyond = _turned_within_reach(perception, found, maps, route)
        if not len(beyond):
            break
        price = price + route.hit_price * _near_any(maps.lattices[0], beyond)
    assert found is not None
    return found


@dataclass(frozen=True)
class _Maps:
    """The maps of a motion.

    Attributes:
        lattices: with a node exactly at the start, and with one exactly at the goal.
        rotations: of the hand at the start and at the goal, [3, 3] each.
        start, end: the nodes of start and goal.
        goal: position of the goal, [3].
        zone: where the hand has the start's rotation, and the start's lattice counts, bool [X, Y, Z].
        room: around hand and load, metres, float32 [X, Y, Z].
        either: the same with the start's rotation and with the goal's, each everywhere.
        price: of a metre, float32 [X, Y, Z].
    """

    lattices: tuple[Lattice, Lattice]
    rotations: tuple[np.ndarray, np.ndarray]
    start: tuple[int, int, int]
    end: tuple[int, int, int]
    goal: np.ndarray
    zone: np.ndarray
    room: np.ndarray
    either: tuple[np.ndarray, np.ndarray]
    price: np.ndarray


def _maps(
    perception: Perception,
    goal: Stop,
    *,
    closed: bool,
    avoidance: np.ndarray | None,
    route: RouteConfig,
    exact: bool,
) -> _Maps:
    """The maps of a motion; see :func:`plan_mapped`."""
    held = perception.held if closed else ""
    scene = _Surroundings(perception, held, closed, route)
    here, there = (perception.ee.pos, perception.ee.rotation), (goal.pos, matrix(goal.quat))
    lattice = _lattice(perception)
    at_start, at_goal = _anchored(lattice, here[0]), _anchored(lattice, there[0])
    start, end = at_start.index(here[0]), at_goal.index(there[0])
    leaving = scene.room(at_start, here[1], here)
    coming = scene.room(at_goal, there[1], there if exact else here)
    if not exact and coming[end] < 0:
        end = _freed(at_goal, end, coming, route)
        there = (at_goal.origin + np.array(end) * at_goal.step, there[1])
    turning = _while_turning(scene, at_goal, here, there[1], coming)
    extra = np.zeros(lattice.shape, np.float32) if avoidance is None else avoidance[:, :, ::_LAYERS]
    leave, come = (
        _price(room if held else _with_own_axis(room, at, *pose, route), extra, route)
        for room, at, pose in ((leaving, at_start, here), (coming, at_goal, there))
    )
    free = np.minimum(np.minimum(leaving, coming), turning) >= route.turning
    cost, cheapest = flood(leave, lattice.step, start, free)
    zone = cost < cheapest if np.isfinite(cheapest) else np.isfinite(cost) & (leaving > coming)
    return _Maps(
        lattices=(at_start, at_goal),
        rotations=(here[1], there[1]),
        start=start,
        end=end,
        goal=there[0],
        zone=zone,
        room=np.where(zone, leaving, coming),
        either=(leaving, coming),
        price=np.where(zone, leave, come),
    )


def _lattice(perception: Perception) -> Lattice:
    """The lattice on the centres of the view's voxels."""
    grid = perception.grid
    return Lattice(grid.lo, _voxel(perception) * [1, 1, _LAYERS], (grid.size, grid.size, -(-grid.size // _LAYERS)))


def _voxel(perception: Perception) -> np.ndarray:
    """Distances of the centres of voxels, metres, [3]."""
    grid = perception.grid
    return (grid.hi - grid.lo) / (grid.size - 1)


def _turned_within_reach(
    perception: Perception, found: MappedPath, maps: _Maps, route: RouteConfig
) -> tuple[MappedPath, np.ndarray]:
    """A path on which the hand turns where the arm can, and where there is room; and what it still cannot take.

    Returns:
        The path, and the positions on it that the arm cannot take, its ends left out, [K, 3]; none for an arm that is
        not known.

    Raises:
        OutOfReach: the arm cannot take the goal.
    """
    base = perception.snapshot.panda_base
    if base is None:
        return found, np.zeros((0, 3))
    way, arm = perception.grid.world(found.path), PandaArm(base)
    first, last = maps.rotations
    turned = np.where((np.arange(len(way)) < found.turn)[:, None, None], first, last)
    reached = arm.reaches(way, turned)
    if not reached[-1]:
        at = ", ".join(f"{x:.2f}" for x in way[-1])
        raise OutOfReach(f"the arm has no joint angles for the goal of a motion, the hand at {at}")
    if not reached.all():
        lacks = [~arm.reaches(way, np.broadcast_to(rotation, (len(way), 3, 3))) for rotation in (first, last)]
        turn = _best_turn(found, maps, lacks, route)
        found, reached = replace(found, turn=turn), ~np.where(np.arange(len(way)) < turn, *lacks)
    return found, way[1:-1][~reached[1:-1]]


def _best_turn(found: MappedPath, maps: _Maps, lacks: list[np.ndarray], route: RouteConfig) -> int:
    """The waypoint nearest to a path's turn at which the arm misses the fewest waypoints when the hand turns there.

    Args:
        found: the path, over P waypoints.
        maps: of the motion.
        lacks: which waypoints it cannot take with the start's rotation and with the goal's, bool [P] each.
        route: how much room is needed to turn.
    """
    shape = np.array(maps.room.shape)
    nodes = np.clip(np.round(found.path / [1, 1, _LAYERS]), 0, shape - 1).astype(int)
    cramped = [room[tuple(nodes.T)] < route.turning for room in maps.either]
    best, least = found.turn, np.inf
    for turn in sorted(range(len(nodes)), key=lambda turn: abs(turn - found.turn)):
        # What would be passed with the other rotation than planned needs room for it.
        if cramped[0][found.turn : turn].any() or cramped[1][turn : found.turn].any():
            continue
        missed = int(lacks[0][:turn].sum() + lacks[1][turn:].sum())
        if missed < least:
            best, least = turn, missed
    return best


def _within_reach(perception: Perception, goal: Stop, most: float, *, level: bool = False) -> Stop:
    """A goal, or where the arm cannot take it, the nearest one in the workspace that it can; the same without one.

    Args:
        perception: the view.
        goal: the pose to reach.
        most: how far it may move, metres.
        level: it moves horizontally.
    """
    base, rotation = perception.snapshot.panda_base, matrix(goal.quat)
    if base is None or PandaArm(base).reaches(goal.pos[None], rotation[None])[0]:
        return goal
    ticks = np.arange(-most, most + _TRIED / 2, _TRIED)
    moves = np.stack(np.meshgrid(ticks, ticks, [0.0] if level else ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    far = np.linalg.norm(moves, axis=1)
    for move in moves[np.argsort(far, kind="stable")][: int((far <= most).sum())]:
        at = goal.pos + move
        inside = (at >= perception.grid.lo).all() and (at <= perception.grid.hi).all()
        if inside and PandaArm(base).reaches(at[None], rotation[None])[0]:
            return replace(goal, pos=at)
    return goal


def _near_any(lattice: Lattice, places: np.ndarray) -> np.ndarray:
    """Which nodes of a lattice are near some places [K, 3], bool [X, Y, Z]."""
    nodes = np.stack(np.meshgrid(*(np.arange(n) for n in lattice.shape), indexing="ij"), axis=-1)
    far = KDTree(places).query((lattice.origin + nodes * lattice.step).reshape(-1, 3), distance_upper_bound=_AVOIDED)[0]
    return np.isfinite(far).reshape(lattice.shape)


def _freed(lattice: Lattice, end: tuple[int, int, int], room: np.ndarray, route: RouteConfig) -> tuple[int, int, int]:
    """The node with room nearest to one without; the same one if there is none near."""
    there = np.argwhere(room >= route.turning)
    far = np.linalg.norm((there - np.array(end)) * lattice.step, axis=1)
    if not len(there) or far.min() > route.freed:
        return end
    x, y, z = there[int(far.argmin())]
    return int(x), int(y), int(z)


class _Surroundings:
    """The room around one hand, with its load, in one scene."""

    def __init__(self, perception: Perception, held: str, closed: bool, route: RouteConfig) -> None:
        snapshot, margins = perception.snapshot, perception.config.margins
        self._margin = route.margin
        opening = float(snapshot.gripper[0] - snapshot.gripper[1]) if closed else None
        self._solids: list[Solid] = rooms.hand_solids(margins.gripper, opening=opening)
        if held:
            axes, rotation = matrix(snapshot.poses[held][3:]), matrix(snapshot.ee_pose[3:])
            points = snapshot.objects[held].points
            self._solids += rooms.load_solids(points, axes, snapshot.ee_pose[:3], rotation)
        clouds = [rooms.dense_surface(cloud) for name, cloud in snapshot.objects.items() if name != held]
        moving = [rooms.dense_surface(part.cloud) for part in snapshot.parts.values() if part.joint is not None]
        self._points = np.concatenate([*clouds, *moving, perception.scene.walls])
        self._ground = perception.scene.ground(perception.ee.pos[:2])

    def room(self, lattice: Lattice, rotation: np.ndarray, known: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Room at each node, metres.

        Args:
            lattice: positions of the hand.
            rotation: of the hand, [3, 3].
            known: position [3] and rotation [3, 3] of a hand that is possible: points that would be inside it lie on
                surfaces that are not quite where samples and boxes say, and do not count.
        """
        points = self._points[rooms.outside(self._points, self._solids, *known, _CONTACT)]
        found = rooms.room_map(lattice, self._solids, rotation, points, self._margin)
        heights = lattice.origin[2] + np.arange(lattice.shape[2]) * lattice.step[2]
        over = heights + rooms.lowest(self._solids, rotation) - self._ground
        return np.minimum(found, over.astype(np.float32))


def _while_turning(
    scene: _Surroundings, lattice: Lattice, here: tuple[np.ndarray, np.ndarray], last: np.ndarray, otherwise: np.ndarray
) -> np.ndarray:
    """Room of a hand half-way between two rotations; ``otherwise`` where they hardly differ."""
    between = Rotation.from_matrix(np.stack([here[1], last]))
    if (between[0].inv() * between[1]).magnitude() < _TURNED:
        return otherwise
    return scene.room(lattice, Slerp([0, 1], between)([0.5]).as_matrix()[0], here)


def _anchored(lattice: Lattice, position: np.ndarray) -> Lattice:
    """The lattice moved so that a position is one of its nodes."""
    node = np.array(lattice.index(position))
    return lattice.shifted(
        np.clip(position - lattice.origin - node * lattice.step, -lattice.step / 2, lattice.step / 2)
    )


def _with_own_axis(
    room: np.ndarray, lattice: Lattice, position: np.ndarray, rotation: np.ndarray, route: RouteConfig
) -> np.ndarray:
    """Room, with ``route.margin`` on the line on which a hand comes to a position, or goes, along its own axis."""
    axis = rotation[:, 2]
    x, y, z = (lattice.origin[k] + np.arange(lattice.shape[k]) * lattice.step[k] - position[k] for k in range(3))
    offset = x[:, None, None], y[None, :, None], z[None, None, :]
    back = -sum(part * share for part, share in zip(offset, axis, strict=True))
    square = sum(part**2 for part in offset) - back**2
    near = (back >= -1e-6) & (back <= route.approach) & (square <= (0.6 * float(lattice.step.max())) ** 2)
    return np.where(near & (room > -route.touch), route.margin, room)


def _price(room: np.ndarray, avoided: np.ndarray, route: RouteConfig) -> np.ndarray:
    """Of a metre: 1 where there is room enough, more nearer to obstacles, most inside them."""
    near = np.clip(1 - room / route.margin, 0, 1)
    inside = np.maximum(-room, 0)
    price = 1 + route.near_price * near**2 + (room < 0) * route.hit_price + route.deep_price * inside
    return (price + route.hit_price * avoided).astype(np.float32)


def _followed(
    perception: Perception, maps: _Maps, value: np.ndarray, planner: PlannerConfig, avoidance: np.ndarray
) -> MappedPath:
    """The planner's descent of a value map, from voxels to positions."""
    grid = perception.grid
    full = _every_layer(value, value[maps.start], grid.size)
    # The goal costs 0, and what is next to it little in comparison with a way that has to touch something.
    window = min(planner.savgol_window_size, _WINDOW)
    first = np.array(maps.start) * [1, 1, _LAYERS]
    _, path = descend_value(first, full, replace(planner, savgol_window_size=window, stop_threshold=0.0))
    nodes = np.clip(np.round(path / [1, 1, _LAYERS]), 0, np.array(value.shape) - 1).astype(int)
    inside = maps.zone[tuple(nodes.T)]
    turn = int(np.flatnonzero(inside)[-1]) + 1 if inside.any() else 0
    share = np.clip((np.arange(len(path)) - turn + 1) / _BLEND, 0, 1)[:, None]
    step = _voxel(perception)
    shifts = [(lattice.origin - grid.lo) / step for lattice in maps.lattices]
    moved = path + (1 - share) * shifts[0] + share * shifts[1]
    moved[0] = (perception.ee.pos - grid.lo) / step
    moved = np.concatenate([moved, ((maps.goal - grid.lo) / step)[None]])
    avoided = np.repeat(avoidance, _LAYERS, axis=2)[:, :, : grid.size]
    return MappedPath(moved, turn, full, avoided, float(maps.room[tuple(nodes.T)].min()))


def _every_layer(value: np.ndarray, most: float, size: int) -> np.ndarray:
    """Costs to go at all voxels, 1 at the start and 2 where none is known, float64 [N, N, N]."""
    full = np.repeat(value, _LAYERS, axis=2)[:, :, :size].astype(float)
    full[:, :, 1:-1:_LAYERS] = (full[:, :, 0:-2:_LAYERS] + full[:, :, 2::_LAYERS]) / 2
    return np.where(np.isfinite(full), full / (float(most) or 1.0), 2.0)
