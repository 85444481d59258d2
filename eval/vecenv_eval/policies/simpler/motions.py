"""How each family of SIMPLER's tasks is solved with ground truth: scripts that yield waypoints and get a new look.

A script is a generator: it yields a list of ``Waypoint`` for its own slot, and is sent a ``Look`` at what came of it.
It ends when it has done what it can; the policy starts it again while the task is not solved. Geometry comes from the
look alone; constants here are of the gripper or of a family, never of an episode.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from vecenv.observations import ObjectsSnapshot
from vecenv_eval.policies.simpler import drawers
from vecenv_eval.policies.simpler.grasps import Grasp, choose
from vecenv_eval.policies.simpler.reach import Arm, Waypoint, pose, through

# Above a thing before it is grasped, and above everything while it is carried, metres.
_ABOVE, _CARRIED = 0.08, 0.10
# An object has come along when it has risen by this share of what the hand has.
_FOLLOWED = 0.5
# Between a thing and what it is lowered onto, metres: contact ends the rest.
_GAP = 0.004
# Between a thing and what it is set beside, metres.
_BESIDE = 0.02
# A drawer is pulled open so far, metres.
_OPENED = 0.21
# What is put into a drawer goes in at most so far beside its middle, metres.
_ASIDE = 0.15
# A grasp that costs more than this (``grasps``) is not tried where a thing can be pushed as well.
_DOUBTFUL = 2.0
# Pushing: fingers come down so far behind a thing, and move so high above what it stands on, metres; angles from the
# vertical and sideways that are tried, radians; room that is enough, radians, and what an angle costs.
_BEHIND, _SKIMMING = 0.05, 0.02
_SWEEP_TILTS, _SWEEP_AZIMUTHS = np.deg2rad([0.0, 10.0, 20.0, 30.0, 40.0]), np.deg2rad([-40.0, -20.0, 0.0, 20.0, 40.0])
_ROOM_ENOUGH, _PREFER_UPRIGHT = 0.2, 0.3


@dataclass(frozen=True)
class Look:
    """One slot now: ground truth, the joints ``qpos`` [N], and the root's world pose ``base`` [7]."""

    snapshot: ObjectsSnapshot
    qpos: np.ndarray
    base: np.ndarray

    def points(self, name: str) -> np.ndarray:
        """Points on the surface of a thing, [n, 3]."""
        return self.snapshot.objects[name].points

    def low(self, name: str) -> np.ndarray:
        """Lower corner of the box around a thing, [3]."""
        return self.points(name).min(axis=0)

    def high(self, name: str) -> np.ndarray:
        """Upper corner, [3]."""
        return self.points(name).max(axis=0)

    def middle(self, name: str) -> np.ndarray:
        """Centre of the box around a thing, [3]."""
        return (self.low(name) + self.high(name)) / 2


@dataclass
class Memory:
    """What a slot remembers between attempts: grasps that did not hold, and how often a drawer was pulled."""

    failed: list[Grasp] = field(default_factory=list)
    pulls: int = 0


Script: TypeAlias = Generator[list[Waypoint], Look, None]
# Part of a script that ends with a thing in the hand, and a look at it; or with None.
Taking: TypeAlias = Generator[list[Waypoint], Look, Look | None]


def put_on(arm: Arm, look: Look, memory: Memory) -> Script:
    """Set the source onto the target: ``("on", source, target)``."""
    _, source, target = look.snapshot.goal[0]
    middle, half = look.middle(source), look.middle(source) - look.low(source)
    place = look.middle(target)
    place[2] = look.high(target)[2] + half[2] + _GAP
    taken = yield from _take(arm, look, memory, source, place - middle)
    if taken is None:
        return
    here, turn = arm.tool(taken.qpos, taken.base)
    place[2] += taken.middle(source)[2] - taken.low(source)[2] - half[2]
    there = here + place - taken.middle(source)
    yield from _set_down(np.array([*there[:2], max(here[2], there[2] + _ABOVE / 2)]), there, turn)


def lift(arm: Arm, look: Look, memory: Memory) -> Script:
    """Lift the source off everything: ``("lifted", source)``."""
    _, source = look.snapshot.goal[0]
    taken = yield from _take(arm, look, memory, source, np.array([0, 0, _CARRIED]))
    if taken is None:
        return
    here, turn = arm.tool(taken.qpos, taken.base)
    yield [*through([here + [0, 0, _CARRIED]], turn, 1.0), Waypoint(pose(here, turn), 1.0, hold=5)]


def move_near(arm: Arm, look: Look, memory: Memory) -> Script:
    """Carry the source towards the target until it is near: ``("near", source, target)``."""
    _, source, target = look.snapshot.goal[0]
    taken = yield from _take(arm, look, memory, source, _beside(look, source, target))
    if taken is None:
        return
    here, turn = arm.tool(taken.qpos, taken.base)
    way = _beside(taken, source, target)
    down = [0, 0, look.middle(source)[2] - taken.middle(source)[2] + _GAP]
    yield from _set_down(here + [*way[:2], 0.0], here + way + down, turn)


def _beside(look: Look, source: str, target: str) -> np.ndarray:
    """The way that brings the source next to the target, on the side where it is, [3]."""
    way = look.middle(target)[:2] - look.middle(source)[:2]
    distance = np.linalg.norm(way)
    radii = [np.linalg.norm((look.high(name) - look.low(name))[:2]) / 2 for name in (source, target)]
    return np.array([*way * max(distance - sum(radii) - _BESIDE, 0.0) / max(distance, 1e-9), 0.0])


def open_drawer(arm: Arm, look: Look, memory: Memory) -> Script:
    """Hook closed fingers behind the upper edge of the drawer's front and pull: ``("open", drawer)``.

    The handles are only drawn: upstream's cabinet has no collision shapes there.
    """
    yield _pull(arm, look, memory, look.snapshot.goal[0][-1])


def close_drawer(arm: Arm, look: Look, memory: Memory) -> Script:
    """Push the drawer's front with closed fingers: ``("close", drawer)``."""
    del memory
    drawer = look.snapshot.parts[look.snapshot.goal[0][-1]]
    yield drawers.push(arm, look.qpos, look.base, drawer)


def put_in(arm: Arm, look: Look, memory: Memory) -> Script:
    """Open the drawer, then drop the source into it: ``("in", source, drawer)``. Stays when it is in."""
    _, source, name = look.snapshot.goal[0]
    drawer = look.snapshot.parts[name]
    assert drawer.joint is not None, "a drawer has a joint"
    if drawers.contains(drawer, look.middle(source)):
        yield [Waypoint(look.snapshot.ee_pose, 0.0, hold=5)]
        return
    if drawer.joint.opened < _OPENED / 2:
        look = yield _pull(arm, look, memory, name)
    middle, half = look.middle(source), look.middle(source) - look.low(source)
    place = drawers.opening(look.snapshot.parts[name])
    place[1] = np.clip(middle[1], place[1] - _ASIDE, place[1] + _ASIDE)
    place[2] += half[2] + _GAP
    grasp = _choose(arm, look, memory, source, place - middle)
    if grasp is None or grasp.cost > _DOUBTFUL:
        pushing, reached = _sweep(arm, look, source, place)
        if reached or grasp is None:
            yield pushing
            return
    taken = yield from _hold(arm, look, memory, source, grasp)
    if taken is None:
        return
    here, turn = arm.tool(taken.qpos, taken.base)
    there = here + place - taken.middle(source)
    yield from _set_down(np.array([*there[:2], here[2]]), there, turn)


def _pull(arm: Arm, look: Look, memory: Memory, name: str) -> list[Waypoint]:
    memory.pulls += 1
    return drawers.hook_and_pull(arm, look.qpos, look.base, look.snapshot.parts[name], _OPENED, memory.pulls - 1)


def _sweep(arm: Arm, look: Look, name: str, place: np.ndarray) -> tuple[list[Waypoint], bool]:
    """Push a thing with closed fingers, from behind, over the edge of what it stands on, towards ``place`` [3]; and
    whether the arm can."""
    low, high = look.low(name), look.high(name)
    behind = np.array([low[0] - _BEHIND, (low[1] + high[1]) / 2, low[2] + _SKIMMING])
    end = np.array([place[0], *behind[1:]])
    stops = [*_first(arm, look, name), behind + [0, 0, high[2] - low[2] + _ABOVE], behind, end]
    tilts, azimuths = (grid.ravel() for grid in np.meshgrid(_SWEEP_TILTS, _SWEEP_AZIMUTHS))
    approach = np.stack([-np.sin(tilts) * np.cos(azimuths), np.sin(tilts) * np.sin(azimuths), -np.cos(tilts)], axis=1)
    opening = np.cross([1.0, 0.0, 0.0], approach)
    opening = np.concatenate([opening, -opening]) / np.linalg.norm(np.tile(opening, (2, 1)), axis=1, keepdims=True)
    turns = arm.hand.rotation(np.concatenate([approach, approach]), opening)
    ways = np.repeat(np.array(stops)[None], len(turns), axis=0)
    room, reached = arm.follow(look.qpos, look.base, ways, np.repeat(turns[:, None], len(stops), axis=1))
    worth = np.minimum(room, _ROOM_ENOUGH) - _PREFER_UPRIGHT * np.tile(tilts, 2) + reached
    best = int(np.argmax(worth))
    return through(stops, turns[best], 1.0), bool(reached[best] == len(stops))


def _take(arm: Arm, look: Look, memory: Memory, name: str, way: np.ndarray) -> Taking:
    """Take hold of a thing that is then to be moved by ``way`` [3], and lift it; None when that does not work."""
    grasp = _choose(arm, look, memory, name, way)
    return None if grasp is None else (yield from _hold(arm, look, memory, name, grasp))


def _hold(arm: Arm, look: Look, memory: Memory, name: str, grasp: Grasp) -> Taking:
    """``_take`` with a grasp; one that does not hold is remembered."""
    lifted = yield _pick(arm, look, name, grasp)
    if lifted.middle(name)[2] - look.middle(name)[2] > _FOLLOWED * _CARRIED:
        return lifted
    memory.failed.append(grasp)
    return None


def _choose(arm: Arm, look: Look, memory: Memory, name: str, carried: np.ndarray) -> Grasp | None:
    """A grasp of a thing that can be lifted and then moved by ``carried`` [3]."""

    def course(position: np.ndarray, rotation: np.ndarray, approach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        before, lifted = position - _ABOVE * approach, position + [0, 0, _CARRIED]
        end = position + carried
        over = np.concatenate([end[:, :2], np.maximum(lifted[:, 2:], end[:, 2:] + _ABOVE / 2)], axis=1)
        stops = np.stack(
            [*(np.broadcast_to(stop, position.shape) for stop in first), before, position, lifted, over, end], 1
        )
        return stops, np.repeat(rotation[:, None], stops.shape[1], axis=1)

    first, ground = _first(arm, look, name), look.low(name)[2]
    return choose(arm, look.qpos, look.base, look.snapshot.objects[name], ground, course, memory.failed)


def _first(arm: Arm, look: Look, name: str) -> list[np.ndarray]:
    """A hand that is lower than a thing rises before it goes there: positions [3], none or one."""
    here, _ = arm.tool(look.qpos, look.base)
    clear = look.high(name)[2] + _ABOVE
    return [np.array([*here[:2], clear])] if here[2] < look.low(name)[2] else []


def _pick(arm: Arm, look: Look, name: str, grasp: Grasp) -> list[Waypoint]:
    """Go there from where the grasp comes from, close, lift."""
    at, turn = grasp.position, grasp.rotation
    here = pose(at, turn)
    return [
        *through([*_first(arm, look, name), at - _ABOVE * grasp.approach, at], turn, 0.0),
        Waypoint(here, 0.0, hold=arm.hand.settle_ticks),
        Waypoint(here, 1.0, hold=arm.hand.close_ticks),
        *through([at + [0, 0, _CARRIED]], turn, 1.0),
    ]


def _set_down(over: np.ndarray, there: np.ndarray, turn: np.ndarray) -> Script:
    """Go there [3] from above, open, rise again."""
    at = pose(there, turn)
    yield [*through([over, there], turn, 1.0), Waypoint(at, 1.0, hold=1), Waypoint(at, 0.0, hold=3)]
    yield through([over], turn, 0.0)


SCRIPTS: dict[str, Callable[[Arm, Look, Memory], Script]] = {
    "on": put_on,
    "lifted": lift,
    "near": move_near,
    "open": open_drawer,
    "close": close_drawer,
    "in": put_in,
}
"""By the first word of a goal."""
