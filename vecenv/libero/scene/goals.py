"""LIBERO goals as data: a table of predicate parameters a slot, evaluated by one vectorised function of physics state.

In: a BDDL goal (a conjunction of predicates) and the scene it is about. Out: rows of a :class:`GoalTable`, and
:func:`evaluate`, which turns a table and the batch's kinematics into one bool a slot. The function is written against
an array namespace, so NumPy and JAX give the same verdicts. Predicates are upstream's, quirks included
(``libero/envs/predicates``, ``object_states``, ``objects/site_object.py``):

* ``On(a, object)``: the object's origin is not above a's, they touch, and they are within 3 cm horizontally.
* ``On(a, region)``: a's origin lies within the region's footprint, from 5 mm below its top to 10 cm above it; where the
  region belongs to an object or fixture, a must also touch that. The offset is rotated by the site's matrix itself,
  not by its transpose.
* ``In(a, region)``: a's origin lies within the axis-aligned box around the rotated half extents, 1 cm lower at the
  bottom.
* ``Open`` holds when any joint is open, ``Close`` when all joints are closed; likewise ``TurnOn`` and ``TurnOff``.
* ``Up(a)``: a's origin, or the region's centre, is at least 1 m above the world's origin.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import mujoco
import numpy as np

from vecenv.errors import InvalidInput
from vecenv.libero.scene import catalog
from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.scene.bddl import Predicate, Problem
from vecenv.libero.scene.scene import Entity, RegionSite, Scene, contact_sensor_name, zone_site
from vecenv.util.arrays import AnyArray

TRUE, FALSE, UP, UP_REGION, IN_REGION, ON_REGION, ON_OBJECT, ANY_JOINT, ALL_JOINTS = range(9)

ON_TOP_RADIUS = 0.03
UP_HEIGHT = 1.0
_REGION_BELOW = 0.005
_REGION_ABOVE = 0.10
_BOX_BELOW = 0.01


class GoalError(InvalidInput):
    """A goal cannot be evaluated in its scene; the message names the predicate and what would be right."""


class GoalTable(NamedTuple):
    """Parameters of P predicates in each of n slots; slots with fewer are padded with TRUE.

    Attributes:
        kind: which predicate, int [n, P].
        body: body id of the thing the predicate is about, int [n, P].
        reference: body id of the object it is related to, int [n, P].
        site: site id of the region, or -1 for a zone on the table or floor, int [n, P].
        zone_pos: world position of such a zone, metres, [n, P, 3].
        zone_mat: its world rotation, [n, P, 3, 3].
        size: half extents of the region, metres, [n, P, 3].
        touch: index of the contact sensor that must report a contact, or -1, int [n, P].
        joint: addresses in qpos of up to J joints, int [n, P, J].
        joint_sign, joint_bound: a joint passes when ``sign * qpos > bound``, [n, P, J].
        joint_inclusive: ``>=`` instead of ``>``, bool [n, P, J].
        joint_used: which of the J entries exist, bool [n, P, J].
    """

    kind: AnyArray
    body: AnyArray
    reference: AnyArray
    site: AnyArray
    zone_pos: AnyArray
    zone_mat: AnyArray
    size: AnyArray
    touch: AnyArray
    joint: AnyArray
    joint_sign: AnyArray
    joint_bound: AnyArray
    joint_inclusive: AnyArray
    joint_used: AnyArray


@dataclass(frozen=True, kw_only=True)
class _Row:
    """One predicate of one task."""

    kind: int
    body: int = 0
    reference: int = 0
    site: int = -1
    zone_pos: np.ndarray | None = None
    zone_mat: np.ndarray | None = None
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    touch: int = -1
    joints: tuple[int, ...] = ()
    test: catalog.JointTest | None = None


def contact_pairs(problems: Iterable[Problem]) -> tuple[tuple[str, str], ...]:
    """The pairs of things whose contacts these tasks' goals test, each pair and the whole sorted by name."""
    return tuple(sorted({pair for problem in problems for pair in _contact_pairs(problem)}))


def _contact_pairs(problem: Problem) -> Iterator[tuple[str, str]]:
    owners = {region.name: region.target for region in problem.regions}
    arena = ARENAS.get(problem.name)
    things = {i.name for i in (*problem.objects, *problem.fixtures) if arena and i.name != arena.workspace}
    for predicate in problem.goal:
        if predicate.name == "on" and len(predicate.args) == 2:
            first, second = predicate.args[0], owners.get(predicate.args[1], predicate.args[1])
            if first in things and second in things:
                yield min(first, second), max(first, second)


def build_table(problems: Sequence[Problem], scene: Scene, slots: Sequence[int]) -> GoalTable:
    """Goal parameters of every slot of one scene.

    Args:
        problems: the tasks that occur in the scene.
        scene: the scene, compiled with the contact sensors that these goals need.
        slots: for each slot, which of ``problems`` it runs, length n.

    Returns:
        A table of NumPy arrays with leading axis n.

    Raises:
        GoalError: a predicate names something the scene lacks, or is not defined for it.
    """
    rows = [[_row(predicate, problem, scene) for predicate in problem.goal] for problem in problems]
    width = max((len(r) for r in rows), default=1) or 1
    joints = max((len(row.joints) for r in rows for row in r), default=1) or 1
    tables = [_pack(r, width, joints) for r in rows]
    return GoalTable(*(np.stack([getattr(tables[s], field) for s in slots]) for field in GoalTable._fields))


def _pack(rows: Sequence[_Row], width: int, joints: int) -> GoalTable:
    padded = [*rows, *[_Row(kind=TRUE)] * (width - len(rows))]
    used = np.array([[j < len(row.joints) for j in range(joints)] for row in padded])
    sign, bound, inclusive = zip(*(_joint_test(row) for row in padded), strict=True)
    spread = np.ones((1, joints))
    return GoalTable(
        kind=np.array([row.kind for row in padded]),
        body=np.array([row.body for row in padded]),
        reference=np.array([row.reference for row in padded]),
        site=np.array([row.site for row in padded]),
        zone_pos=np.array([np.zeros(3) if row.zone_pos is None else row.zone_pos for row in padded]),
        zone_mat=np.array([np.eye(3) if row.zone_mat is None else row.zone_mat for row in padded]),
        size=np.array([row.size for row in padded]),
        touch=np.array([row.touch for row in padded]),
        joint=np.array([[*row.joints, *[0] * (joints - len(row.joints))] for row in padded]),
        joint_sign=np.array(sign)[:, None] * spread,
        joint_bound=np.array(bound)[:, None] * spread,
        joint_inclusive=np.array(inclusive)[:, None] & (spread > 0),
        joint_used=used,
    )


def _joint_test(row: _Row) -> tuple[float, float, bool]:
    return (1.0, 0.0, False) if row.test is None else row.test.sign_form()


def _row(predicate: Predicate, problem: Problem, scene: Scene) -> _Row:
    context = _Context(predicate, problem, scene)
    builders = {
        "true": lambda: _Row(kind=TRUE),
        "false": lambda: _Row(kind=FALSE),
        "printjointstate": lambda: _Row(kind=TRUE),
        "up": context.up,
        "in": context.inside,
        "on": context.on,
        "open": lambda: context.joints("is_open", ANY_JOINT),
        "close": lambda: context.joints("is_close", ALL_JOINTS),
        "turnon": lambda: context.joints("turn_on", ANY_JOINT),
        "turnoff": lambda: context.joints("turn_off", ALL_JOINTS),
    }
    if predicate.name not in builders:
        raise context.error(f"is not a LIBERO predicate; known: {', '.join(builders)}")
    return builders[predicate.name]()


class _Context:
    """Resolves the names of one predicate against the scene."""

    def __init__(self, predicate: Predicate, problem: Problem, scene: Scene) -> None:
        self.predicate, self.problem, self.scene = predicate, problem, scene

    def error(self, reason: str) -> GoalError:
        text = f"({' '.join((self.predicate.name, *self.predicate.args))})"
        return GoalError(f"{self.problem.source}: goal {text} {reason}")

    def args(self, count: int) -> tuple[str, ...]:
        if len(self.predicate.args) != count:
            raise self.error(f"takes {count} argument(s), got {len(self.predicate.args)}")
        return self.predicate.args

    def entity(self, name: str) -> Entity:
        if name not in self.scene.entities:
            raise self.error(f"names {name!r}, which is no object or fixture of the scene")
        return self.scene.entities[name]

    def body(self, name: str) -> int:
        return self.scene.model.body(self.entity(name).root_body).id

    def region(self, name: str) -> RegionSite | None:
        """The region, with the task's own rectangle when it is a zone on the table or floor."""
        arena = self.scene.arena
        for region in self.problem.regions:
            if region.name == name and arena.workspace in name:
                return zone_site(region, arena)
        return self.scene.regions.get(name)

    def place(self, region: RegionSite) -> dict[str, Any]:
        """Site id, or fixed world frame, and size of a region."""
        if region.parent is not None:
            return {"site": self.scene.model.site(region.name).id, "size": region.size}
        pos, mat = _static_frame(self.scene.model, region.body)
        return {"zone_pos": pos + mat @ np.array(region.pos), "zone_mat": mat, "size": region.size}

    def touch(self, first: str, second: str) -> int:
        for name in (first, second):
            self.entity(name)
        sensor = mujoco.mj_name2id(self.scene.model, mujoco.mjtObj.mjOBJ_SENSOR, contact_sensor_name(first, second))
        if sensor < 0:
            raise self.error(f"needs the contacts of {first!r} and {second!r}; compile the scene with that pair")
        return int(self.scene.model.sensor_adr[sensor])

    def up(self) -> _Row:
        (name,) = self.args(1)
        region = self.region(name)
        return _Row(kind=UP, body=self.body(name)) if region is None else _Row(kind=UP_REGION, **self.place(region))

    def inside(self) -> _Row:
        name, container = self.args(2)
        region = self.region(container)
        if region is None:
            raise self.error(f"needs a region to be in; {container!r} is not one (upstream has no test for objects)")
        return _Row(kind=IN_REGION, body=self.body(name), **self.place(region))

    def on(self) -> _Row:
        name, support = self.args(2)
        region = self.region(support)
        if region is None:
            return _Row(
                kind=ON_OBJECT, body=self.body(name), reference=self.body(support), touch=self.touch(name, support)
            )
        touch = -1 if region.parent is None else self.touch(name, region.parent)
        return _Row(kind=ON_REGION, body=self.body(name), touch=touch, **self.place(region))

    def joints(self, test: str, kind: int) -> _Row:
        (name,) = self.args(1)
        region = self.scene.regions.get(name)
        if region is not None and test not in ("is_open", "is_close"):
            raise self.error("is defined for fixtures, not for their regions")
        owner = self.entity(name if region is None or region.parent is None else region.parent)
        names = owner.joints if region is None else region.joints
        joint_test: catalog.JointTest | None = getattr(catalog.articulation(owner.category), test)
        if joint_test is None:
            raise self.error(f"is not defined for a {owner.category}")
        if not owner.fixture and region is None:
            raise self.error("is defined for fixtures and for regions, not for movable objects")
        addresses = tuple(int(self.scene.model.joint(joint).qposadr[0]) for joint in names)
        return _Row(kind=kind, joints=addresses, test=joint_test)


def _static_frame(model: mujoco.MjModel, body: str) -> tuple[np.ndarray, np.ndarray]:
    """World position [3] and rotation [3, 3] of a body that is fixed to the world."""
    element = model.body(body)
    if element.parentid[0] != 0 or element.dofnum[0] != 0:
        raise GoalError(f"body {body!r} is not fixed to the world")
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, element.quat)
    return np.array(element.pos), mat.reshape(3, 3)


def evaluate(
    table: GoalTable,
    *,
    xpos: AnyArray,
    site_xpos: AnyArray,
    site_xmat: AnyArray,
    qpos: AnyArray,
    touch: AnyArray,
    xp: ModuleType = np,
) -> Any:
    """Whether each slot's goal holds.

    Args:
        table: goal parameters, leading axis n.
        xpos: body positions, world frame, metres, [n, nbody, 3].
        site_xpos: site positions, [n, nsite, 3].
        site_xmat: site rotations, [n, nsite, 9] or [n, nsite, 3, 3].
        qpos: joint positions, [n, nq].
        touch: contact sensors, counts of contacts, [n, nsensordata].
        xp: array namespace, ``numpy`` or ``jax.numpy``.

    Returns:
        bool [n].
    """
    return xp.all(
        predicates(table, xpos=xpos, site_xpos=site_xpos, site_xmat=site_xmat, qpos=qpos, touch=touch, xp=xp), axis=-1
    )


def predicates(
    table: GoalTable,
    *,
    xpos: AnyArray,
    site_xpos: AnyArray,
    site_xmat: AnyArray,
    qpos: AnyArray,
    touch: AnyArray,
    xp: ModuleType = np,
) -> Any:
    """Each predicate by itself, bool [n, P]; arguments as for :func:`evaluate`."""
    n = table.kind.shape[0]
    slot = xp.arange(n)[:, None]
    pos = xpos[slot, table.body]
    is_zone = (table.site < 0)[..., None]
    site = xp.maximum(table.site, 0)
    frame_pos = xp.where(is_zone, table.zone_pos, site_xpos[slot, site])
    mats = site_xmat.reshape(n, -1, 3, 3)
    frame_mat = xp.where(is_zone[..., None], table.zone_mat, mats[slot, site])
    touching = _touching(table, touch, slot, xp)
    opened = _joint_tests(table, qpos, xp)
    values = (
        (TRUE, xp.ones(table.kind.shape, bool)),
        (UP, pos[..., 2] >= UP_HEIGHT),
        (UP_REGION, frame_pos[..., 2] >= UP_HEIGHT),
        (IN_REGION, _in_region(pos, frame_pos, frame_mat, table.size, xp)),
        (ON_REGION, _on_region(pos, frame_pos, frame_mat, table.size, xp) & touching),
        (ON_OBJECT, _on_object(pos, xpos[slot, table.reference], xp) & touching),
        (ANY_JOINT, xp.any(opened & table.joint_used, axis=-1)),
        (ALL_JOINTS, xp.all(opened | ~table.joint_used, axis=-1)),
    )
    result = xp.zeros(table.kind.shape, bool)
    for kind, value in values:
        result = result | ((table.kind == kind) & value)
    return result


def _touching(table: GoalTable, touch: AnyArray, slot: AnyArray, xp: ModuleType) -> Any:
    if touch.shape[-1] == 0:
        return table.touch < 0
    return (table.touch < 0) | (touch[slot, xp.maximum(table.touch, 0)] > 0)


def _joint_tests(table: GoalTable, qpos: AnyArray, xp: ModuleType) -> Any:
    n = table.kind.shape[0]
    value = table.joint_sign * qpos[xp.arange(n)[:, None, None], table.joint]
    return xp.where(table.joint_inclusive, value >= table.joint_bound, value > table.joint_bound)


def _rotated(mat: AnyArray, vector: AnyArray, xp: ModuleType) -> Any:
    """``mat @ vector``, [..., 3]; a GPU may multiply matrices in TF32, off by a millimetre, so JAX sums by hand."""
    if xp is np:
        return (mat @ vector[..., None])[..., 0]
    return xp.sum(mat * vector[..., None, :], axis=-1)


def _in_region(pos: AnyArray, frame_pos: AnyArray, frame_mat: AnyArray, size: AnyArray, xp: ModuleType) -> Any:
    """Upstream's ``in_box``: an axis-aligned box around the rotated half extents."""
    extent = xp.abs(_rotated(frame_mat, size, xp))
    below = xp.array([[[0.0, 0.0, _BOX_BELOW]]], dtype=extent.dtype)
    return xp.all((pos > frame_pos - extent - below) & (pos < frame_pos + extent), axis=-1)


def _on_region(pos: AnyArray, frame_pos: AnyArray, frame_mat: AnyArray, size: AnyArray, xp: ModuleType) -> Any:
    """Upstream's ``under``: within the footprint, just above the region."""
    delta = _rotated(frame_mat, pos - frame_pos, xp)
    height = delta[..., 2]
    top = size[..., 2]
    inside = xp.all(xp.abs(delta[..., :2]) < size[..., :2], axis=-1)
    return inside & (top - _REGION_BELOW < height) & (height < top + _REGION_ABOVE)


def _on_object(pos: AnyArray, reference: AnyArray, xp: ModuleType) -> Any:
    """Upstream's ``check_ontop`` of two objects, contact excluded."""
    gap = xp.sqrt(xp.sum((reference[..., :2] - pos[..., :2]) ** 2, axis=-1))
    return (reference[..., 2] <= pos[..., 2]) & (gap < ON_TOP_RADIUS)
