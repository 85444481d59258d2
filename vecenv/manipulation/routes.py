"""Turns a path over voxels into a route of the hand that keeps clear of the scene.

Positions of a planned path come in, with the hand's rotation and grip at each; a few :class:`Stop` s go out. The greedy
planner treats the hand as a point; its size is considered here. A hand that travels (open, or holding a movable object)
leaves backwards along its axis, passes over everything within reach of the path, and approaches its goal along its own
axis, from above unless it is tilted. A hand in contact (closed on nothing, to push; closed on a fixture, to pull)
follows the path unchanged. The decision uses the geometry of surface points only.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from vecenv.manipulation.world import SceneGeometry, around

# Hands whose axis has at most this vertical component point down.
_UPRIGHT = -0.98
# How a planned path becomes a route.
RouteMode = Literal["raised", "planned", "map"]
# Distances by which a hand moves an object aside from under an overhang, metres.
_ASIDE = (0.02, 0.04, 0.06, 0.08, 0.10, 0.12)


@dataclass(frozen=True, kw_only=True)
class RouteConfig:
    """Distances that a hand keeps. Metres unless noted.

    Attributes:
        mode: ``"raised"``: a hand that travels is rerouted over surface points, whatever the planner's path (this
            module). ``"planned"``: it follows the planner's path. ``"map"``: it follows the planner's path over
            configuration-space maps of hand and load (``voxposer.mapped``).
        over: vertical room over whatever lies on the way.
        corridor: half width of what counts as on the way.
        approach: the least distance from which a goal is approached along the hand's axis.
        here: goals nearer than this, horizontally, are approached straight.
        along: a tilted hand that moves backwards along its axis, by this cosine, needs no detour.
        straight: travelling hands may deviate this much from the planned path, horizontally.
        bend: hands in contact may deviate this much from it.
        level: a closed, empty hand is in contact if its goal is higher or lower by at most this share of the distance
        work_reach: and at most this far away.
        step: distance of the samples at which obstacles on the way are looked for.
        exact: a path that is followed as planned is thinned out to stops from which it deviates at most this much.
        margin: in maps, room around hand and load beyond which more is no better.
        turning: in maps, room with which a hand may turn.
        touch: in maps, a hand that comes or goes along its own axis may be so far inside something: samples of surfaces
            and voxels are not exact.
        little: in maps, a goal that is nearer than this does not give way to obstacles.
        freed: in maps, a goal that is neither grasp nor place gives way to obstacles by at most this much.
        nearer: in maps, a goal that is neither grasp nor place gives way to the arm's reach by at most this much.
        aside: in maps, a place that the arm cannot reach moves horizontally by at most this much.
        near_price: in maps, price of a metre that touches something, beyond that of a free one, which is 1.
        hit_price: in maps, price of a metre inside something or where the program wants none.
        deep_price: in maps, price of a metre for each metre of depth inside something.

    Raises:
        ValueError: there is no such mode.
    """

    mode: RouteMode = "map"
    over: float = 0.03
    corridor: float = 0.11
    approach: float = 0.06
    here: float = 0.02
    along: float = 0.65
    straight: float = 0.02
    bend: float = 0.02
    level: float = 0.25
    work_reach: float = 0.35
    step: float = 0.03
    exact: float = 0.003
    margin: float = 0.035
    turning: float = 0.012
    touch: float = 0.006
    little: float = 0.05
    freed: float = 0.12
    nearer: float = 0.18
    aside: float = 0.07
    near_price: float = 15.0
    hit_price: float = 50.0
    deep_price: float = 4000.0

    def __post_init__(self) -> None:
        if self.mode not in get_args(RouteMode):
            raise ValueError(f"mode must be one of {', '.join(get_args(RouteMode))}, got {self.mode!r}")


@dataclass(frozen=True)
class Stop:
    """One stop of the hand.

    Attributes:
        pos: of the grip site, metres, world frame, [3].
        quat: of the hand, wxyz, [4].
        closed: grip on arrival.
        velocity: share of full speed on the way there.
        final: the end of a path, which the hand reaches exactly.
    """

    pos: np.ndarray
    quat: np.ndarray
    closed: bool
    velocity: float = 1.0
    final: bool = False


def is_contact_move(
    start: np.ndarray, goal: np.ndarray, *, closed: bool, held: str, attached: str, config: RouteConfig
) -> bool:
    """Whether a motion is one in contact: closed on a fixture; or closed, empty, and nearly level."""
    if not closed or held:
        return False
    if attached:
        return True
    way = goal - start
    across = float(np.linalg.norm(way[:2]))
    return abs(way[2]) <= config.level * across and across <= config.work_reach


def work_route(stops: Sequence[Stop], config: RouteConfig = RouteConfig()) -> list[Stop]:
    """A path as planned, without redundant stops."""
    return [stops[i] for i in corners(np.array([stop.pos for stop in stops]), config.bend, _marks(stops))]


def planned_route(stops: Sequence[Stop], config: RouteConfig = RouteConfig()) -> list[Stop]:
    """A path exactly as planned: stops that lie on the lines between others are left out, and the first."""
    kept = corners(np.array([stop.pos for stop in stops]), config.exact, _marks(stops))
    return [stops[i] for i in kept if i] or [stops[-1]]


def travel_route(
    stops: Sequence[Stop], axes: tuple[np.ndarray, np.ndarray], world: SceneGeometry, held: str, config: RouteConfig
) -> list[Stop]:
    """A path raised over the scene.

    Args:
        stops: along the path: the first is where the hand is, the last its goal; rotations and grips as wanted there.
        axes: direction of the fingers at the start and at the goal, unit vectors [3].
        world: the scene, the hand at its start.
        held: the object in the hand, "" for none.
        config: margins.
    """
    aside = _from_under(world, held, stops[0].pos) if held else np.zeros(3)
    if not aside.any():
        return _raised(stops, axes, world, held, config)
    clear = replace(stops[0], pos=stops[0].pos + aside)
    goal = stops[-1]
    if np.linalg.norm((goal.pos - stops[0].pos)[:2]) < config.here:
        goal = replace(goal, pos=goal.pos + aside)
    return [clear, *_raised([clear, *stops[1:-1], goal], axes, world, held, config)]


def _raised(
    stops: Sequence[Stop], axes: tuple[np.ndarray, np.ndarray], world: SceneGeometry, held: str, config: RouteConfig
) -> list[Stop]:
    """The way of a hand over which nothing hangs at its start."""
    start, goal = stops[0], stops[-1]
    if _direct(goal.pos - start.pos, axes, config):
        return [goal]
    hangs = _hangs(world, start.pos, held) + config.over
    leave, come = start.pos - config.approach * axes[0], goal.pos - config.approach * axes[1]
    path = np.array([leave, *(stop.pos for stop in stops[1:-1]), come])
    height = _tallest(world, path, held, config) + hangs
    begin = _leave(start, leave, axes[0], height, crowded=_crowded(world, start.pos, held, config))
    end = _come(goal, come, axes[1], height, closed=stops[-2].closed)
    middle = [replace(s, pos=np.array([*s.pos[:2], max(s.pos[2], height)]), quat=goal.quat) for s in stops[1:-1]]
    whole = [*begin, *middle, *end[::-1]]
    keep = corners(np.array([stop.pos for stop in whole]), config.straight, _marks(whole))
    return [whole[i] for i in keep]


def _from_under(world: SceneGeometry, held: str, hand: np.ndarray) -> np.ndarray:
    """The shortest level move [3] after which what is held can go straight up; zero if it can, or if there is none."""
    thing = world.points(held)[::2] - world.hand + hand
    near = np.concatenate([world.others(held), world.walls])
    near = near[np.linalg.norm(near[:, :2] - thing[:, :2].mean(axis=0), axis=1) < _ASIDE[-1] + 0.12]
    above = near[near[:, 2] > thing[:, 2].min() + 0.015]
    level = near[near[:, 2] > thing[:, 2].min() + 0.005]
    if not _under(thing, above):
        return np.zeros(3)
    for far in _ASIDE:
        for angle in np.arange(16) * np.pi / 8:
            move = far * np.array([np.cos(angle), np.sin(angle), 0.0])
            hits = (np.linalg.norm(thing[None] + share * move - level[:, None], axis=2) < 0.008 for share in (0.5, 1))
            if not _under(thing + move, above) and not any(hit.any() for hit in hits):
                return move
    return np.zeros(3)


def _under(thing: np.ndarray, points: np.ndarray) -> bool:
    """Whether one of some points is straight above a point of an object."""
    if not len(points):
        return False
    apart = np.linalg.norm(thing[:, None, :2] - points[None, :, :2], axis=2)
    return bool(((apart < 0.012) & (points[None, :, 2] > thing[:, None, 2] + 0.005)).any())


def _direct(way: np.ndarray, axes: tuple[np.ndarray, np.ndarray], config: RouteConfig) -> bool:
    """Whether a motion needs no detour: up or down, or a tilted hand that backs off or comes nearer on its axis."""
    if axes[0] @ axes[1] < 0.95:
        return False
    along = float(way @ axes[0]) / max(float(np.linalg.norm(way)), 1e-9)
    tilted = axes[0][2] > _UPRIGHT
    return bool(np.linalg.norm(way[:2]) < config.here) or (tilted and (along < -config.along or along > 0.95))


def _leave(start: Stop, away: np.ndarray, axis: np.ndarray, height: float, *, crowded: bool) -> list[Stop]:
    """From the present position up to a height: straight, but backwards first where a tilted hand is among objects."""
    if axis[2] < _UPRIGHT or not crowded:
        return [replace(start, pos=_at(start.pos, height))]
    return [replace(start, pos=away), replace(start, pos=_at(away, height))]


def _come(goal: Stop, before: np.ndarray, axis: np.ndarray, height: float, *, closed: bool) -> list[Stop]:
    """To a goal, last stop first: along the hand's axis, from above where that is not upright; gripping at the end."""
    approach = replace(goal, pos=before, closed=closed, final=False)
    above = replace(approach, pos=_at(before, height))
    if axis[2] < _UPRIGHT:
        return [goal, replace(above, pos=_at(goal.pos, float(above.pos[2])))]
    return [goal, approach, above] if above.pos[2] > before[2] + 0.01 else [goal, approach]


def _at(pos: np.ndarray, height: float) -> np.ndarray:
    """The same place, raised to a height if it is below."""
    return np.array([pos[0], pos[1], max(height, float(pos[2]))])


def _crowded(world: SceneGeometry, hand: np.ndarray, held: str, config: RouteConfig) -> bool:
    """Whether something is within the hand's reach."""
    return bool((np.linalg.norm(world.others(held) - hand, axis=1) < config.approach).any())


def _hangs(world: SceneGeometry, hand: np.ndarray, held: str) -> float:
    """How far the lowest of the hand and what it holds is below the grip site."""
    tip = world.config.gripper.tip
    return max(tip, float(world.hand[2] - world.points(held)[:, 2].min())) if held else tip


def _tallest(world: SceneGeometry, path: np.ndarray, held: str, config: RouteConfig) -> float:
    """Height of the highest point within the corridor around a path, [P, 3]."""
    points = world.others(held)
    highest = -np.inf
    for a, b in itertools.pairwise(path):
        way = (b - a)[:2]
        share = np.clip((points[:, :2] - a[:2]) @ way / max(float(way @ way), 1e-9), 0, 1)
        near = np.linalg.norm(points[:, :2] - a[:2] - share[:, None] * way, axis=1) < config.corridor
        highest = max(highest, float(points[near, 2].max(initial=-np.inf)))
    return highest if np.isfinite(highest) else float(around(path[-1][:2], points, 0.5)[:, 2].max(initial=path[-1][2]))


def _marks(stops: Sequence[Stop]) -> np.ndarray:
    """Stops that may not be left out: the last, and those where the grip or the rotation changes, bool [n]."""
    marks = np.zeros(len(stops), bool)
    marks[-1] = True
    for i in range(1, len(stops)):
        turned = abs(float(stops[i].quat @ stops[i - 1].quat)) < 0.9999
        marks[i - 1] |= stops[i].closed != stops[i - 1].closed or turned
    return marks


def corners(path: np.ndarray, tolerance: float, marked: np.ndarray) -> list[int]:
    """Indices of the points that describe a path to within a tolerance (Douglas and Peucker), marked ones included.

    Args:
        path: points [n, 3].
        tolerance: largest distance of a point left out from the lines between those kept, metres.
        marked: bool [n], points to keep in any case.
    """
    keep = marked.copy()
    keep[[0, -1]] = True
    fixed = np.flatnonzero(keep)
    for first, last in itertools.pairwise(fixed):
        _split(path, int(first), int(last), tolerance, keep)
    return [int(i) for i in np.flatnonzero(keep)]


def _split(path: np.ndarray, first: int, last: int, tolerance: float, keep: np.ndarray) -> None:
    if last <= first + 1:
        return
    way, rest = path[last] - path[first], path[first + 1 : last] - path[first]
    share = np.clip(rest @ way / max(float(way @ way), 1e-12), 0, 1)
    far = np.linalg.norm(rest - share[:, None] * way, axis=1)
    worst = int(far.argmax())
    if far[worst] > tolerance:
        keep[first + 1 + worst] = True
        _split(path, first, first + 1 + worst, tolerance, keep)
        _split(path, first + 1 + worst, last, tolerance, keep)
