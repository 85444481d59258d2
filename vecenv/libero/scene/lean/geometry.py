"""Geometry profiles: upstream's collision geoms as they are (``exact``), or at most 24 simple ones a scene (``lean``).

In: a scene's source and what its tasks do with its things. Out: a compiled scene with the same bodies, joints, sites,
masses, inertias, actuators and sensors, bit for bit, but other collision geoms. MJX evaluates every pair of geoms that
could collide, so their number decides what a step costs. How much detail a thing gets depends on its use in the tasks:
what is picked up or filled gets the shape that this needs, then more detail while the budget lasts; bystanders become
one or two boxes. The shapes are data (``vecenv.libero.scene.lean.recipes``), the fits are in
``vecenv.libero.scene.lean.fits``. The result is a pure function of the source and :func:`demands`;
:func:`lean_key` names what else it depends on.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeAlias

import mujoco
import numpy as np

from vecenv.libero.scene import catalog, contacts
from vecenv.libero.scene.bddl import Predicate, Problem
from vecenv.libero.scene.lean import boxes
from vecenv.libero.scene.lean import solids as shapes
from vecenv.libero.scene.lean.detail import Module, Part, count
from vecenv.libero.scene.lean.recipes import ROBOT_ARM, ROBOT_HAND, recipe
from vecenv.libero.scene.lean.solids import Solid
from vecenv.libero.scene.scene import Entity, Scene, SceneError, SceneSource

PROFILES = ("exact", "lean")
# Increased whenever the same source and demands give another lean scene.
VERSION = 2
MAX_GEOMS = 24

# What may collide with what, as bits of contype and conaffinity. Parts of the surroundings do not collide with each
# other, except a drawer's front with the cabinet's frame that stops it; nor do parts of the robot, except the two pads.
# Pads collide with what they can grasp; for the rest, the fingers that enclose them are enough. The arm collides with
# surroundings only.
_SCENERY, _OBJECT, _PAD, _STOP, _MOVING = 1, 2, 4, 8, 16
_BITS = {
    "scenery": (_SCENERY, 0),
    "moving": (_SCENERY | _MOVING, 0),
    "frame": (_SCENERY | _STOP, 0),
    "front": (_SCENERY | _MOVING, _STOP),
    "object": (_OBJECT, _SCENERY | _OBJECT),
    "gripper": (0, _SCENERY | _OBJECT),
    "pad": (_PAD, _MOVING | _OBJECT | _PAD),
    "arm": (0, _SCENERY),
}

Demands: TypeAlias = Mapping[str, frozenset[str]]


# -- what tasks do with things -----------------------------------------------------------------------------------------


def demands(problems: Iterable[Problem]) -> Demands:
    """How tasks use each object and fixture, by name; those that no task uses are left out.

    ``held``: it is put somewhere. ``bears``: something is put or lies on it. ``filled:<region>``: something is put or
    lies in that region. ``worked:<region>``: the region's door or drawer, or with no region the thing's own joint, is
    opened, closed or turned. ``open:<region>``: it stands open at the beginning.
    """
    found: dict[str, set[str]] = {}
    for problem in problems:
        for predicate in problem.init:
            _note(found, problem, predicate, begins=True)
        for predicate in problem.goal:
            _note(found, problem, predicate, begins=False)
    return {name: frozenset(asked) for name, asked in sorted(found.items())}


def _note(found: dict[str, set[str]], problem: Problem, predicate: Predicate, *, begins: bool) -> None:
    if predicate.name in ("in", "on") and len(predicate.args) == 2:
        thing, place = predicate.args
        owner, region = _owner(problem, place)
        found.setdefault(owner, set()).add(f"filled:{region}" if predicate.name == "in" else "bears")
        if not begins:
            found.setdefault(thing, set()).add("held")
            if predicate.name == "in" and _shut(problem, owner, place):
                found[owner].add(f"worked:{region}")
    elif predicate.name in ("open", "close", "turnon", "turnoff"):
        owner, region = _owner(problem, predicate.args[0])
        if not begins:
            found.setdefault(owner, set()).add(f"worked:{region}")
        elif predicate.name == "open":
            found.setdefault(owner, set()).add(f"open:{region}")


def _shut(problem: Problem, owner: str, place: str) -> bool:
    """Whether a place must be opened before something can be put there."""
    categories = {fixture.name: fixture.category for fixture in problem.fixtures}
    opens = catalog.articulation(categories.get(owner, "")).is_open is not None
    opened = {what for predicate in problem.init if predicate.name == "open" for what in predicate.args}
    return opens and not opened & {owner, place}


def _owner(problem: Problem, place: str) -> tuple[str, str]:
    """The thing that a place belongs to, and what the place is called there ("" for the thing itself)."""
    for region in problem.regions:
        if region.name == place:
            return region.target, place.removeprefix(f"{region.target}_")
    return place, ""


# -- how the budget is spent -------------------------------------------------------------------------------------------

# The name under which plans list the robot's parts.
ROBOT = "robot"


@dataclass(frozen=True)
class Plan:
    """What a lean scene is made of.

    Attributes:
        parts: the parts of each thing, by name; the robot's under ``ROBOT``.
        count: geoms at most, the support of everything included.
        short: things that got less detail than the tasks need.
    """

    parts: Mapping[str, tuple[Part, ...]]
    count: int
    short: tuple[str, ...]


def plan(scene: Scene, asked: Demands, budget: int = MAX_GEOMS) -> Plan:
    """Spend the budget: first what the tasks need, then the wrist, then more detail of what they need.

    What no task needs stays at its coarsest, however much is left: every geom costs time.

    Raises:
        SceneError: the coarsest level of everything exceeds the budget.
    """
    owners = [(e.name, module) for e in scene.entities.values() for module in _modules(scene, e, asked)]
    owners.append((ROBOT, Module(ROBOT_ARM, 0, True)))
    chosen = [0] * len(owners)
    spent = 1 + count(ROBOT_HAND) + sum(count(module.levels[0]) for _, module in owners)
    if spent > budget:
        raise SceneError(f"{spent} geoms are the least that this scene can be made of; the budget is {budget}")
    for _, index, level in sorted(_upgrades(owners)):
        levels = owners[index][1].levels
        extra = count(levels[level]) - count(levels[level - 1])
        if chosen[index] == level - 1 and spent + extra <= budget:
            chosen[index], spent = level, spent + extra
    parts: dict[str, tuple[Part, ...]] = {ROBOT: ROBOT_HAND}
    for (name, module), level in zip(owners, chosen, strict=True):
        parts[name] = (*parts.get(name, ()), *module.levels[level])
    short = [name for (name, module), level in zip(owners, chosen, strict=True) if level < module.wanted]
    return Plan(MappingProxyType(parts), spent, tuple(dict.fromkeys(short)))


def _modules(scene: Scene, entity: Entity, asked: Demands) -> tuple[Module, ...]:
    solids = len(entity_geoms(scene.model, entity))
    return recipe(entity.category, solids).modules(asked.get(entity.name, frozenset())) if solids else ()


def _upgrades(owners: Sequence[tuple[str, Module]]) -> list[tuple[float, int, int]]:
    """Every step to a finer level: its rank (lower comes first), the index of its module, the level."""
    steps = []
    for index, (name, module) in enumerate(owners):
        for level in range(1, len(module.levels) if module.needed else 1):
            beyond = max(0, level - module.wanted)
            steps.append((beyond - 0.5 if name == ROBOT else beyond, index, level))
    return steps


# -- the scene ---------------------------------------------------------------------------------------------------------


def lean_key(asked: Demands) -> str:
    """What a lean scene depends on besides its source, as text: the version of these fits and the demands."""
    return json.dumps(["lean", VERSION, {name: sorted(what) for name, what in sorted(asked.items())}])


def lean_scene(source: SceneSource, asked: Demands, exact: Scene | None = None) -> Scene:
    """The scene with at most ``MAX_GEOMS`` collision geoms, mostly boxes, and pairs that matter.

    Bodies, joints, sites, actuators, sensors, masses and inertias are those of the exact scene, bit for bit. The table
    becomes the plane of its top: what falls off its edge stays at that height.

    Args:
        source: the scene's source.
        asked: what the tasks do with its things, see :func:`demands`.
        exact: ``source.compile()``, if already compiled.

    Raises:
        SceneError: MuJoCo refuses the model, or a thing does not look as its recipe expects.
    """
    exact = source.compile() if exact is None else exact
    return _Rebuild(source, exact).scene(plan(exact, asked))


@dataclass(frozen=True)
class Fitted:
    """What became of a part.

    Attributes:
        body: id of the body that carries it.
        solids: the geoms that stand for it, in the body's frame.
        like: id of the geom of the exact scene whose contact parameters they take.
        meets: what they collide with, a row of the table at the top of this module.
    """

    body: int
    solids: tuple[Solid, ...]
    like: int
    meets: str


def fit_part(scene: Scene, name: str, part: Part) -> Fitted:
    """Fit one part of a thing.

    Args:
        scene: the exact scene.
        name: of the thing, or ``ROBOT``.
        part: which of its geoms, and how.

    Raises:
        SceneError: the thing does not look as the part expects.
    """
    body = _part_body(scene, name, part)
    geoms = _part_geoms(scene.model, name, part, body)
    solids = [solid_of(scene.model, geom) for geom in geoms]
    like = geoms[int(np.argmax([np.prod(solid.half_extents) for solid in solids]))]
    try:
        made = tuple(part.fit(solids))
    except shapes.FitError as error:
        raise SceneError(f"{name}: {error}") from error
    return Fitted(body, made, like, part.meets or _meets(scene, name, body))


def _part_body(scene: Scene, name: str, part: Part) -> int:
    if part.body is not None:
        return scene.model.body(part.body if name == ROBOT else f"{name}_{part.body}").id
    return int(scene.model.geom_bodyid[entity_geoms(scene.model, scene.entities[name])[0]])


def _part_geoms(model: mujoco.MjModel, name: str, part: Part, body: int) -> list[int]:
    geoms = _colliding(model, body)
    named = {model.geom(g).name: g for g in geoms}
    for suffix in part.geoms:
        if f"{name}_{suffix}" not in named:
            raise SceneError(f"{name} has no collision geom {suffix!r}, which its recipe names")
    return [named[f"{name}_{suffix}"] for suffix in part.geoms] or geoms


def _meets(scene: Scene, name: str, body: int) -> str:
    if name != ROBOT:
        if not scene.entities[name].fixture:
            return "object"
        return "moving" if scene.model.body_dofnum[body] else "scenery"
    label = scene.model.body(body).name
    if label.startswith("gripper0_"):
        return "pad" if label.endswith("_tip") else "gripper"
    return "arm"


class _Rebuild:
    """Replaces the collision geoms of one scene."""

    def __init__(self, source: SceneSource, exact: Scene) -> None:
        self.source, self.exact = source, exact
        self.model = exact.model
        self.spec = mujoco.MjSpec.from_string(source.xml)
        self.made: dict[str, list[str]] = {}

    def scene(self, plan: Plan) -> Scene:
        support = self._support()
        lean = {name: [self._fitted(name, part) for part in parts] for name, parts in plan.parts.items()}
        self._clear()
        self._add_support(*support)
        for name, parts in lean.items():
            for part in parts:
                self._add(name, part)
        self._keep_masses()
        self._drop_meshes()
        try:
            model = self.spec.compile()
        except ValueError as error:
            raise SceneError(f"{self.source.origin}: MuJoCo rejects the lean scene: {error}") from error
        contacts.remark(model)
        entities = {
            name: replace(entity, contact_geoms=tuple(self.made.get(name, ())))
            for name, entity in self.exact.entities.items()
        }
        return replace(self.exact, model=model, entities=MappingProxyType(entities))

    def _fitted(self, name: str, part: Part) -> Fitted:
        try:
            return fit_part(self.exact, name, part)
        except SceneError as error:
            raise SceneError(f"{self.source.origin}: {error}") from error

    def _support(self) -> tuple[int, np.ndarray, np.ndarray, int]:
        """Body, middle and half size of the top of table or floor, and the geom that is its largest part."""
        body = self.model.body(self.exact.arena.table_body).id
        geoms = [g for b in self._carried(body) for g in _colliding(self.model, b)]
        if self.model.geom_type[geoms[0]] == mujoco.mjtGeom.mjGEOM_PLANE:
            return body, self.model.geom_pos[geoms[0]].copy(), self.model.geom_size[geoms[0]].copy(), geoms[0]
        like = max(geoms, key=lambda g: float(_level_area(solid_of(self.model, g))))
        body = int(self.model.geom_bodyid[like])
        top = boxes.bound([solid_of(self.model, like)], np.eye(3))
        pos = top.pos + [0.0, 0.0, top.size[2]]
        return body, pos, np.array([*top.size[:2], 0.01]), like

    def _carried(self, body: int) -> list[int]:
        """A fixed body and those fixed to it."""
        weld = self.model.body_weldid
        return [b for b in range(body, self.model.nbody) if weld[b] == weld[body] and self._below(b, body)]

    def _below(self, body: int, root: int) -> bool:
        while body > root:
            body = int(self.model.body_parentid[body])
        return body == root

    def _clear(self) -> None:
        """Remove the hidden collision geoms; visible geoms stay, but no longer collide."""
        for geom in list(self.spec.geoms):
            if not (geom.contype or geom.conaffinity):
                continue
            if geom.group == 0:
                self.spec.delete(geom)
            else:
                geom.contype = geom.conaffinity = 0

    def _add_support(self, body: int, pos: np.ndarray, size: np.ndarray, like: int) -> None:
        name = self.model.body(body).name
        plane = self._geom(body, f"{name or 'world'}_support", like, "scenery")
        plane.type, plane.pos, plane.size = mujoco.mjtGeom.mjGEOM_PLANE, pos, size

    def _add(self, name: str, part: Fitted) -> None:
        for solid in part.solids:
            owner = self.model.body(part.body).name if name == ROBOT else name
            label = f"{owner}_lean{len(self.made.setdefault(owner, []))}"
            geom = self._geom(part.body, label, part.like, part.meets)
            geom.type = _TYPES[solid.kind]
            geom.pos, geom.size = solid.pos, solid.size
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, solid.mat.ravel())
            geom.quat = quat
            self.made[owner].append(label)

    def _geom(self, body: int, name: str, like: int, meets: str) -> mujoco.MjsGeom:
        """A new geom with another one's contact parameters."""
        model, geom = self.model, self.spec.bodies[body].add_geom(name=name)
        geom.contype, geom.conaffinity = _BITS[meets]
        geom.group = 0
        geom.condim, geom.priority = int(model.geom_condim[like]), int(model.geom_priority[like])
        geom.friction, geom.solmix = model.geom_friction[like], float(model.geom_solmix[like])
        geom.solref, geom.solimp = model.geom_solref[like], model.geom_solimp[like]
        margin = float(model.geom_margin[like])
        geom.margin = 0.0 if margin == contacts.MESH_MARGIN else margin  # no mesh replaces a mesh
        geom.gap = float(model.geom_gap[like])
        return geom

    def _keep_masses(self) -> None:
        """Set every body's inertia, and the scene's extent, to the values computed from the exact geoms."""
        for index, body in enumerate(self.spec.bodies):
            if index:
                body.explicitinertial = True
                body.mass, body.inertia = float(self.model.body_mass[index]), self.model.body_inertia[index]
                body.ipos, body.iquat = self.model.body_ipos[index], self.model.body_iquat[index]
        for name in ("center", "extent", "meanmass", "meansize"):
            setattr(self.spec.stat, name, getattr(self.model.stat, name))

    def _drop_meshes(self) -> None:
        used = {geom.meshname for geom in self.spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH}
        for mesh in list(self.spec.meshes):
            if mesh.name not in used:
                self.spec.delete(mesh)


_TYPES = {shapes.BOX: mujoco.mjtGeom.mjGEOM_BOX, shapes.CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE}


def _level_area(solid: Solid) -> float:
    """Area of a solid's box seen from above."""
    around = boxes.bound([solid], np.eye(3))
    return float(around.size[0] * around.size[1])


def _colliding(model: mujoco.MjModel, body: int) -> list[int]:
    """Collision geoms of a body."""
    first = model.body_geomadr[body]
    geoms = range(first, first + model.body_geomnum[body])
    return [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]


def entity_geoms(model: mujoco.MjModel, entity: Entity) -> list[int]:
    """Collision geoms of a thing and of what moves on it."""
    root = model.body(entity.root_body).id
    bodies = np.flatnonzero(model.body_rootid == root)
    return [g for body in bodies for g in _colliding(model, int(body))]


def solid_of(model: mujoco.MjModel, geom: int) -> Solid:
    """A geom of a compiled model as a solid in its body's frame.

    Raises:
        SceneError: it is neither box, sphere, capsule, cylinder nor mesh.
    """
    pos, mat, size = model.geom_pos[geom].copy(), np.zeros(9), model.geom_size[geom].copy()
    mujoco.mju_quat2Mat(mat, model.geom_quat[geom])
    mat = mat.reshape(3, 3)
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return Solid(shapes.BOX, pos, mat, size)
    if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE):
        half = size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
        return Solid(shapes.CAPSULE, pos, mat, np.array([size[0], half, 0.0]))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return Solid(shapes.CYLINDER, pos, mat, size)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _hull(model, geom, pos, mat)
    raise SceneError(f"geom {model.geom(geom).name!r} is a {kind.name}, which no fit supports")


def _hull(model: mujoco.MjModel, geom: int, pos: np.ndarray, mat: np.ndarray) -> Solid:
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    local = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
    low, high = local.min(axis=0), local.max(axis=0)
    centre = pos + mat @ ((low + high) / 2)
    return Solid(shapes.HULL, centre, mat, (high - low) / 2, points=pos + local @ mat.T)
