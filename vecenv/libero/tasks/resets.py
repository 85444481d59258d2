"""Upstream's resets replayed: every number they draw from NumPy's legacy generator, in upstream's order.

In: a task, its compiled scene and a seed. Out: reset by reset, where upstream puts fixtures and objects. Stored init
states say where objects are, but not where fixtures stand, and that depends on all that was drawn before. A reset
draws, in this order (robosuite 1.4.0, ``environments`` and ``robots``; LIBERO, ``envs/bddl_base_domain.py`` and
``envs/regions``):

1. seven normal numbers, the noise of the arm's joints, of magnitude 0 in LIBERO;
2. joint positions of what ``:init`` opens, closes and turns on or off. The list of these grows by one copy at every
   model load, that is at the construction of the environment and at every reset, and is drawn from end to end;
3. the things on the table or floor, in the order of ``:init``: a rectangle of the region, x and y, again until nothing
   placed before is too near, then an angle about each axis;
4. what stands on or lies in a region of another thing, then what stands on another thing.

A reset that finds no room in 5,000 tries is abandoned, and the next one begins where the generator stopped. The
generator is a separate ``RandomState``; the global one is neither read nor advanced.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import mujoco
import numpy as np

from vecenv.errors import InvalidInput
from vecenv.libero.scene import catalog
from vecenv.libero.scene.bddl import Predicate, Problem, Region
from vecenv.libero.scene.scene import Entity, Scene
from vecenv.protocols import ResetPoint

Pose: TypeAlias = tuple[np.ndarray, np.ndarray]
"""World position [3] in metres and quaternion wxyz [4]."""

_TRIES = 5000
# Upstream tries without limit; a task that fails this often has no room.
_ATTEMPTS = 20
_ARM_JOINTS = 7
_ABOVE = 0.01
# Workspaces whose sampler keeps the whole object inside the rectangle (``TableRegionSampler``); the others keep its
# centre inside (``Libero100TableRegionSampler``).
_WHOLE_INSIDE = frozenset(
    {"libero_tabletop_manipulation", "libero_floor_manipulation", "libero_coffee_table_manipulation"}
)
_JOINT_RANGES = {"open": "open_range", "close": "close_range", "turnon": "on_range", "turnoff": "off_range"}
_AXES = ("x", "y", "z")


class ResetError(InvalidInput):
    """A task that upstream could not reset; the message names it and what is wrong."""


@dataclass(frozen=True, kw_only=True)
class _Joints:
    """Joints that one predicate of ``:init`` sets: addresses in qpos, and the bounds of the draw."""

    qpos: tuple[int, ...]
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class _Sampler:
    """One of upstream's samplers and the thing it places.

    Attributes:
        thing: what it places.
        rectangles: x0, y0, x1, y1 in the frame of ``origin``, metres.
        turns: axes and bounds of the angles that are drawn.
        inset: what the rectangle shrinks by on each side, metres.
        apart: whether it is drawn again when too near to something.
        origin: world position that the rectangle is relative to, with the offset in height.
        reference: the thing it is placed on, whose position is added; None on the table.
        on_top: whether the reference's height is added too.
        site: site of the region of the reference, whose position is added; None without.
    """

    thing: Entity
    rectangles: tuple[tuple[float, float, float, float], ...]
    turns: tuple[catalog.Turn, ...]
    inset: float = 0.0
    apart: bool = True
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    reference: Entity | None = None
    on_top: bool = True
    site: int | None = None


class Resets(Iterator[dict[str, Pose]]):
    """The resets of one upstream environment after ``env.seed(seed)``, first to last, without end.

    Each item maps the names of what the reset places to their poses; fixtures not placed by ``:init`` are left out.

    Args:
        problem, scene: the task and its compiled scene, which is read only.
        seed: an integer from 0 to 2**32 - 1.
        unseeded: resets between the construction of the environment and the seed.

    Raises:
        ResetError: ``:init`` has a predicate that upstream cannot set up.
    """

    def __init__(self, problem: Problem, scene: Scene, seed: int, *, unseeded: int = 0) -> None:
        self._rng = np.random.RandomState(seed)
        self._loads = 1 + unseeded
        self._source = problem.source
        self._scene = scene
        self._joints = tuple(_joints(problem, scene))
        self._samplers = tuple(_samplers(problem, scene))
        self._data = mujoco.MjData(scene.model) if any(s.site is not None for s in self._samplers) else None

    def __next__(self) -> dict[str, Pose]:
        for _ in range(_ATTEMPTS):
            self._loads += 1
            placed = self._attempt()
            if placed is not None:
                return placed
        raise ResetError(f"{self._source}: {_ATTEMPTS} resets in a row found no room for what :init places")

    def _attempt(self) -> dict[str, Pose] | None:
        self._rng.randn(_ARM_JOINTS)
        self._set_joints()
        placed: dict[str, tuple[Entity, Pose]] = {}
        for sampler in self._samplers:
            pose = self._sample(sampler, placed)
            if pose is None:
                return None
            placed[sampler.thing.name] = (sampler.thing, pose)
        return {name: pose for name, (_, pose) in placed.items()}

    def _set_joints(self) -> None:
        """Draw joint positions, and bring the model that site positions are read from up to them."""
        for _ in range(self._loads):
            for joints in self._joints:
                position = self._rng.uniform(high=joints.high, low=joints.low)
                if self._data is not None:
                    self._data.qpos[list(joints.qpos)] = position
        if self._data is not None:
            mujoco.mj_kinematics(self._scene.model, self._data)

    def _sample(self, sampler: _Sampler, placed: Mapping[str, tuple[Entity, Pose]]) -> Pose | None:
        """A pose for one thing; None when there is no room."""
        base = self._base(sampler, placed)
        thing = sampler.thing
        for _ in range(_TRIES):
            x0, y0, x1, y1 = sampler.rectangles[self._rng.randint(len(sampler.rectangles))]
            x = self._rng.uniform(high=x1 - sampler.inset, low=x0 + sampler.inset) + base[0]
            y = self._rng.uniform(high=y1 - sampler.inset, low=y0 + sampler.inset) + base[1]
            pos = np.array([x, y, base[2] - thing.bottom_z])
            if not (sampler.apart and _too_near(thing, pos, placed)):
                return pos, self._quat(sampler)
        return None

    def _base(self, sampler: _Sampler, placed: Mapping[str, tuple[Entity, Pose]]) -> np.ndarray:
        base = np.array(sampler.origin)
        if sampler.reference is None:
            return base
        if sampler.reference.name not in placed:
            raise ResetError(
                f"{self._source}: :init places {sampler.thing.name} on {sampler.reference.name}, which is not placed"
            )
        pos, quat = placed[sampler.reference.name][1]
        base = base + pos + [0.0, 0.0, sampler.reference.top_z if sampler.on_top else 0.0]
        if sampler.site is None:
            return base
        assert self._data is not None
        # Upstream turns the site's world position, not its place in the reference.
        return base + _matrix(quat) @ self._data.site_xpos[sampler.site]

    def _quat(self, sampler: _Sampler) -> np.ndarray:
        """An orientation. Upstream reads what samplers of movable objects return as xyzw for wxyz; so does this."""
        angles = [self._rng.uniform(high=high, low=low) for _, low, high in sampler.turns]
        if sampler.thing.fixture:
            return np.array([math.cos(angles[0] / 2), 0.0, 0.0, math.sin(angles[0] / 2)])
        single = [_xyzw(axis, angle) for (axis, _, _), angle in zip(sampler.turns, angles, strict=True)]
        if len(single) == 1:
            return single[0]
        quat = np.array([0.0, 0.0, 0.0, 1.0])
        for turn in single:
            quat = _product(turn, quat)
        return quat


def placed_at(problem: Problem, scene: Scene, points: Sequence[ResetPoint]) -> list[dict[str, Pose]]:
    """What each of these resets places, by name; resets of one seed are replayed once.

    Raises:
        ResetError: ``:init`` has a predicate that upstream cannot set up.
    """
    wanted: dict[tuple[int, int], set[int]] = {}
    for point in points:
        wanted.setdefault((point.seed, point.unseeded), set()).add(point.resets)
    found: dict[ResetPoint, dict[str, Pose]] = {}
    for (seed, unseeded), numbers in wanted.items():
        resets = Resets(problem, scene, seed, unseeded=unseeded)
        for number in range(1, max(numbers) + 1):
            placed = next(resets)
            if number in numbers:
                found[ResetPoint(seed=seed, unseeded=unseeded, resets=number)] = placed
    return [found[point] for point in points]


# -- the samplers of a task --------------------------------------------------------------------------------------------


def _joints(problem: Problem, scene: Scene) -> Iterator[_Joints]:
    """What ``:init`` opens, closes or switches (``OpenCloseSampler``, ``TurnOnOffSampler``)."""
    for predicate in problem.init:
        if predicate.name not in _JOINT_RANGES:
            continue
        name = predicate.args[0]
        region = scene.regions.get(name)
        owner = scene.entities.get(name if region is None or region.parent is None else region.parent)
        if owner is None:
            raise ResetError(f"{problem.source}: :init has ({predicate.name} {name}), which has no joints")
        bounds = getattr(catalog.articulation(owner.category), _JOINT_RANGES[predicate.name])
        if bounds is None:
            raise ResetError(f"{problem.source}: :init has ({predicate.name} {name}), but a {owner.category} cannot")
        joints = owner.joints if region is None else region.joints
        addresses = tuple(int(scene.model.joint(joint).qposadr[0]) for joint in joints)
        yield _Joints(qpos=addresses, low=bounds[0], high=bounds[1])


def _samplers(problem: Problem, scene: Scene) -> Iterator[_Sampler]:
    """The samplers of ``:init`` in the order in which a reset runs them."""
    regions = {region.name: region for region in problem.regions}
    on_table: list[_Sampler] = []
    in_regions: dict[str, list[_Sampler]] = {"on": [], "in": []}
    on_things: list[_Sampler] = []
    movable = {thing.name for thing in scene.objects}
    for predicate in problem.init:
        if predicate.name not in ("on", "in") or len(predicate.args) != 2:
            continue
        place = predicate.args[1]
        if predicate.name == "on" and place in movable:
            on_things.append(_on_thing(_thing(predicate, problem, scene), scene.entities[place]))
        elif place in regions and (predicate.name == "in" or regions[place].target in scene.entities):
            in_regions[predicate.name].append(_on_region(predicate, regions[place], problem, scene))
        elif predicate.name == "on" and place in regions:
            on_table.append(_on_table(predicate, regions[place], problem, scene))
    yield from on_table
    yield from in_regions["on"]
    yield from in_regions["in"]
    yield from on_things


def _thing(predicate: Predicate, problem: Problem, scene: Scene) -> Entity:
    thing = scene.entities.get(predicate.args[0])
    if thing is None:
        raise ResetError(f"{problem.source}: :init places {predicate.args[0]}, which is no object or fixture")
    return thing


def _turns(thing: Entity) -> tuple[catalog.Turn, ...]:
    turns = catalog.TURNS.get(thing.category.lower())
    if turns is None:
        known = ", ".join(sorted(catalog.TURNS))
        raise ResetError(f"{thing.name}: how upstream turns {thing.category!r} is not known; known: {known}")
    return turns


def _on_table(predicate: Predicate, region: Region, problem: Problem, scene: Scene) -> _Sampler:
    """``MultiRegionRandomSampler`` for a fixture, the workspace's own sampler for an object."""
    thing = _thing(predicate, problem, scene)
    if not region.ranges:
        raise ResetError(f"{thing.name} is placed in region {region.name!r}, which gives no rectangle (:ranges)")
    x, y, z = scene.arena.workspace_offset
    if thing.fixture:
        return _Sampler(
            thing=thing,
            rectangles=region.ranges,
            turns=(("z", min(region.yaw), max(region.yaw)),),
            apart=False,
            origin=(x, y, scene.arena.fixture_z + z),
        )
    return _Sampler(
        thing=thing,
        rectangles=region.ranges,
        turns=_turns(thing),
        inset=thing.radius if problem.name in _WHOLE_INSIDE else 0.0,
        origin=(x, y, _ABOVE + z),
    )


def _on_region(predicate: Predicate, region: Region, problem: Problem, scene: Scene) -> _Sampler:
    """``SiteRegionRandomSampler`` for On, ``InSiteRegionRandomSampler`` for In."""
    thing = _thing(predicate, problem, scene)
    site, target = scene.regions.get(region.name), scene.entities.get(region.target)
    if site is None or target is None or thing.fixture:
        raise ResetError(
            f"{problem.source}: :init has ({predicate.name} {thing.name} {region.name}), which it cannot do"
        )
    common = {"thing": thing, "turns": _turns(thing), "reference": target, "site": scene.model.site(site.name).id}
    if predicate.name == "in":
        return _Sampler(rectangles=((0.0, 0.0, 0.0, 0.0),), on_top=False, **common)
    x, y = site.size[0] / 2, site.size[1] / 2
    return _Sampler(rectangles=((-x, -y, x, y),), inset=thing.radius, **common)


def _on_thing(thing: Entity, reference: Entity) -> _Sampler:
    """``ObjectBasedSampler``."""
    return _Sampler(
        thing=thing,
        rectangles=((0.0, 0.0, 0.0, 0.0),),
        turns=_turns(thing),
        apart=False,
        origin=(0.0, 0.0, _ABOVE),
        reference=reference,
    )


# -- geometry as upstream does it --------------------------------------------------------------------------------------


def _too_near(thing: Entity, pos: np.ndarray, placed: Mapping[str, tuple[Entity, Pose]]) -> bool:
    """Whether upstream counts a thing as overlapping something placed before."""
    for other, (where, _) in placed.values():
        near = math.hypot(pos[0] - where[0], pos[1] - where[1]) <= other.radius + thing.radius
        if near and pos[2] - where[2] <= other.top_z - thing.bottom_z:
            return True
    return False


def _xyzw(axis: str, angle: float) -> np.ndarray:
    quat = np.array([0.0, 0.0, 0.0, math.cos(angle / 2)])
    quat[_AXES.index(axis)] = math.sin(angle / 2)
    return quat


def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Product of two quaternions xyzw, rounded to float32 as robosuite's ``quat_multiply`` does."""
    vector = first[3] * second[:3] + second[3] * first[:3] + np.cross(first[:3], second[:3])
    return np.append(vector, first[3] * second[3] - first[:3] @ second[:3]).astype(np.float32)


def _matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion wxyz, rounded to single precision where robosuite's compiled ``quat2mat`` is."""
    single = np.asarray(quat, np.float32)
    scale = math.sqrt(2.0 / float(np.dot(single, single)))
    scaled = (single.astype(float) * scale).astype(np.float32)
    p = np.outer(scaled, scaled)
    d = p.diagonal().astype(float)
    rows = [
        [1.0 - d[2] - d[3], p[1, 2] - p[3, 0], p[1, 3] + p[2, 0]],
        [p[1, 2] + p[3, 0], 1.0 - d[1] - d[3], p[2, 3] - p[1, 0]],
        [p[1, 3] - p[2, 0], p[2, 3] + p[1, 0], 1.0 - d[1] - d[2]],
    ]
    return np.array(rows, float)
