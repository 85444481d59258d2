"""Where an episode begins, drawn inside ``jit``: a stored settled start, or things moved about within their regions.

In: a scene, a task and its settled starts. Out: a pure function from a key to the state of one world. ``stored`` picks
one of the starts. ``regions`` picks one too and moves every fixture and object that the task's ``:init`` puts on the
table or floor to a place drawn uniformly from its BDDL rectangles, fixtures with a yaw of their range, as upstream's
samplers do. Heights, the orientations of objects and joint positions stay those of the settled start: at rest on a flat
table is at rest anywhere on it, so nothing has to settle again. What stands on a fixture or an object moves along.

Objects keep clear of each other and of fixtures: of ``LAYOUTS`` draws of all places, the first without an overlap seen
from above is taken, else the one that overlaps least. Upstream draws again until circles do not overlap, but of radii
(2.5 cm for a plate) that let things collide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vecenv.errors import InvalidInput
from vecenv.libero.scene import surface
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import Entity, Scene
from vecenv.libero.tasks import fixtures
from vecenv.libero.tasks.fixtures import FixturePlacement
from vecenv.libero.tasks.settled import SettledStarts
from vecenv.util.arrays import AnyArray
from vecenv.util.rotations import quat_conjugate, quat_mul, rotate

LAYOUTS = 64
# Round things are taken this much smaller: bowls and plates flare, and where their rims would meet there is still room
# (in libero_spatial task 0 bowl and plate come to rest 11.1 cm apart; their radii add up to 12.4 cm).
_FLARE = 0.9


class StartError(InvalidInput):
    """Starts that cannot be drawn; the message says why."""


class Begin(NamedTuple):
    """The state in which an episode of one world begins.

    Attributes:
        qpos: [nq]. qvel: [nv].
        body_pos: positions of all bodies in their parents, metres, [nbody, 3].
        body_quat: orientations likewise, wxyz, [nbody, 4].
        episode: index of the stored start it is, or was made from, int32.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    body_pos: Float[Array, "nbody 3"]
    body_quat: Float[Array, "nbody 4"]
    episode: Int[Array, ""]


@dataclass(frozen=True, kw_only=True)
class _Thing:
    """An object or fixture that is placed on the table or floor.

    Attributes:
        entity: which.
        placement: its rectangles; for objects ``origin`` gives no height.
        carried: the objects that move along with it.
    """

    entity: Entity
    placement: FixturePlacement
    carried: tuple[Entity, ...]


class _Footprints(NamedTuple):
    """What things cover seen from above: rectangles, and circles with the same centres.

    Attributes:
        centre: from the root body's origin, metres, [..., 2].
        half: half sides of the rectangle, metres, [..., 2].
        radius: of the circle, metres, [...].
    """

    centre: Float[AnyArray, "*n 2"]
    half: Float[AnyArray, "*n 2"]
    radius: Float[AnyArray, "*n"]


class _Layout(NamedTuple):
    """Places of n things: ``spot`` of the root body's origin, metres, [..., n, 2], and ``yaw``, radians, [..., n]."""

    spot: Float[Array, "*n 2"]
    yaw: Float[Array, "*n"]


class Starts:
    """The starts of one task.

    Args:
        scene: the compiled scene.
        problem: the task.
        settled: its settled starts.
        episodes: which of them are used; None for all.

    Raises:
        StartError: an episode that does not exist, starts of another scene, or a region without a rectangle.
    """

    def __init__(
        self, scene: Scene, problem: Problem, settled: SettledStarts, episodes: Sequence[int] | None = None
    ) -> None:
        model = scene.model
        chosen = np.arange(len(settled.qpos)) if episodes is None else np.asarray(episodes, int).reshape(-1)
        if not len(chosen) or chosen.min() < 0 or chosen.max() >= len(settled.qpos):
            raise StartError(f"episodes={episodes}: expected at least one of 0 to {len(settled.qpos) - 1}")
        if (settled.qpos.shape[1], settled.qvel.shape[1]) != (model.nq, model.nv):
            raise StartError(
                f"{problem.source}: starts of {settled.qpos.shape[1]} + {settled.qvel.shape[1]} numbers, but the scene "
                f"has {model.nq} positions and {model.nv} velocities"
            )
        self._scene = scene
        self._episodes = chosen.astype(np.int32)
        self._qpos, self._qvel = settled.qpos[chosen], settled.qvel[chosen]
        self._body_pos, self._body_quat = _central(scene, problem)
        self._things = _things(scene, problem)
        self._footprints = self._measured()

    def _measured(self) -> _Footprints:
        """Footprints of the things in each of the starts, [E, n, ...]."""
        data = mujoco.MjData(self._scene.model)
        rows = []
        for qpos in self._qpos:
            data.qpos[:] = qpos
            mujoco.mj_kinematics(self._scene.model, data)
            rows.append([_footprint(self._scene, data, thing.entity) for thing in self._things])
        return _Footprints(*(np.array([[print_[k] for print_ in row] for row in rows]) for k in range(3)))

    def stored(self, rng: PRNGKeyArray) -> Begin:
        """One of the settled starts, each as likely as any other."""
        return self._row(jax.random.randint(rng, (), 0, len(self._episodes)))

    def _row(self, row: Int[Array, ""]) -> Begin:
        return Begin(
            qpos=_real(self._qpos)[row],
            qvel=_real(self._qvel)[row],
            body_pos=_real(self._body_pos),
            body_quat=_real(self._body_quat),
            episode=jnp.asarray(self._episodes)[row],
        )

    def regions(self, rng: PRNGKeyArray) -> Begin:
        """A settled start whose fixtures and objects were moved to places drawn from their regions."""
        first, second = jax.random.split(rng)
        row = jax.random.randint(first, (), 0, len(self._episodes))
        begin = self._row(row)
        if not self._things:
            return begin
        layout = self._clear_layout(second, row)
        for index, thing in enumerate(self._things):
            move = self._move_fixture if thing.entity.fixture else self._move_object
            begin = move(begin, thing, layout.spot[index], layout.yaw[index])
        return begin

    def _clear_layout(self, rng: PRNGKeyArray, row: Int[Array, ""]) -> _Layout:
        """The first of many draws in which nothing overlaps, else the one that overlaps least."""
        layouts = jax.vmap(self._layout)(jax.random.split(rng, LAYOUTS))
        footprints = jax.tree.map(lambda x: _real(x)[row], self._footprints)
        fixed = np.array([thing.entity.fixture for thing in self._things])
        first, second = np.triu_indices(len(fixed), 1)
        matters = ~(fixed[first] & fixed[second])
        overlap = jax.vmap(lambda layout: _overlaps(footprints, layout, first[matters], second[matters]))(layouts)
        best = jnp.argmin(jnp.sum(overlap, axis=-1))
        return jax.tree.map(lambda x: x[best], layouts)

    def _layout(self, rng: PRNGKeyArray) -> _Layout:
        keys = jax.random.split(rng, len(self._things))
        places = [_draw(thing.placement, key) for thing, key in zip(self._things, keys, strict=True)]
        return _Layout(*(jnp.stack(parts) for parts in zip(*places, strict=True)))

    def _move_fixture(self, begin: Begin, thing: _Thing, spot: Float[Array, "2"], yaw: Float[Array, ""]) -> Begin:
        body = thing.placement.body
        old_pos, old_quat = begin.body_pos[body], begin.body_quat[body]
        pos = jnp.concatenate([spot, _real(thing.placement.origin[2:])])
        zero = jnp.zeros_like(yaw)
        quat = jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)])
        turn = quat_mul(quat, quat_conjugate(old_quat))
        qpos = begin.qpos
        for entity in thing.carried:
            at = self._scene.model.joint(entity.joints[0]).qposadr[0]
            qpos = qpos.at[at : at + 3].set(pos + rotate(turn, qpos[at : at + 3] - old_pos))
            qpos = qpos.at[at + 3 : at + 7].set(quat_mul(turn, qpos[at + 3 : at + 7]))
        moved = begin._replace(
            qpos=qpos, body_pos=begin.body_pos.at[body].set(pos), body_quat=begin.body_quat.at[body].set(quat)
        )
        return self._at_rest(moved, thing.carried)

    def _move_object(self, begin: Begin, thing: _Thing, spot: Float[Array, "2"], yaw: Float[Array, ""]) -> Begin:
        del yaw  # an object's orientation is that of the settled start
        at = self._scene.model.joint(thing.entity.joints[0]).qposadr[0]
        shift, qpos = spot - begin.qpos[at : at + 2], begin.qpos
        moving = (thing.entity, *thing.carried)
        for entity in moving:
            at = self._scene.model.joint(entity.joints[0]).qposadr[0]
            qpos = qpos.at[at : at + 2].add(shift)
        return self._at_rest(begin._replace(qpos=qpos), moving)

    def _at_rest(self, begin: Begin, entities: Sequence[Entity]) -> Begin:
        qvel = begin.qvel
        for entity in entities:
            at = self._scene.model.joint(entity.joints[0]).dofadr[0]
            qvel = qvel.at[at : at + 6].set(0.0)
        return begin._replace(qvel=qvel)


def _central(scene: Scene, problem: Problem) -> tuple[Float[np.ndarray, "nbody 3"], Float[np.ndarray, "nbody 4"]]:
    """Body positions and orientations with the fixtures at the centres of their regions, where the starts settled."""
    pos, quat = np.array(scene.model.body_pos), np.array(scene.model.body_quat)
    for placement in fixtures.placements(problem, scene).values():
        pos[placement.body], quat[placement.body] = placement.pose(np.full(3, 0.5))
    return pos, quat


def _things(scene: Scene, problem: Problem) -> tuple[_Thing, ...]:
    """What ``:init`` puts on the table or floor, in its order."""
    regions = {region.name: region for region in problem.regions}
    known = fixtures.placements(problem, scene)
    supports: dict[str, str] = {}
    for predicate in problem.init:
        if predicate.name not in ("on", "in") or predicate.args[0] not in scene.entities:
            continue
        name, place = predicate.args
        owner = regions[place].target if place in regions else place
        if owner in scene.entities:
            supports[name] = owner
        elif name not in known and place in regions:
            known[name] = _rectangles(scene, name, regions[place].ranges)
    return tuple(
        _Thing(
            entity=scene.entities[name],
            placement=placement,
            carried=tuple(scene.entities[other] for other in supports if _stands_on(other, name, supports)),
        )
        for name, placement in known.items()
    )


def _rectangles(scene: Scene, name: str, ranges: tuple[tuple[float, float, float, float], ...]) -> FixturePlacement:
    if not ranges:
        raise StartError(f"{name} is placed in a region that gives no rectangle (:ranges)")
    body = scene.model.body(scene.entities[name].root_body).id
    return FixturePlacement(body=body, ranges=ranges, yaw=(0.0, 0.0), origin=scene.arena.workspace_offset)


def _stands_on(name: str, below: str, supports: dict[str, str]) -> bool:
    """Whether ``below`` carries ``name``, directly or through others."""
    for _ in supports:
        if name not in supports:
            return False
        name = supports[name]
        if name == below:
            return True
    return False


def _footprint(
    scene: Scene, data: mujoco.MjData, entity: Entity
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"], float]:
    """Centre [2], half sides [2] and radius of what a thing covers; a fixture's as seen in its own frame."""
    body = scene.model.body(entity.root_body).id
    corners, _ = surface.entity_corners(scene, entity.name).world(data.xpos[None], data.xmat[None])
    local = corners[0] - data.xpos[body]
    if entity.fixture:
        local = local @ data.xmat[body].reshape(3, 3)
    low, high = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    centre, half = (low + high) / 2, (high - low) / 2
    radius = float(np.linalg.norm(local[:, :2] - centre, axis=1).max())
    is_round = np.linalg.norm(half) > 1.2 * radius
    return centre, half, radius * (_FLARE if is_round else 1.0)


def _draw(placement: FixturePlacement, rng: PRNGKeyArray) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """A place [2] and yaw, uniform in one of the rectangles."""
    which, where = jax.random.split(rng)
    ranges = _real(placement.ranges)
    low, high = jnp.split(ranges[jax.random.randint(which, (), 0, len(ranges))], 2)
    u = jax.random.uniform(where, (3,), ranges.dtype)
    least, most = min(placement.yaw), max(placement.yaw)
    return _real(placement.origin[:2]) + low + u[:2] * (high - low), least + u[2] * (most - least)


def _overlaps(
    footprints: _Footprints, layout: _Layout, first: Int[np.ndarray, " pairs"], second: Int[np.ndarray, " pairs"]
) -> Float[Array, " pairs"]:
    """By how much pairs of things overlap, metres, [pairs]; 0 where rectangles or circles lie apart."""
    cos, sin = jnp.cos(layout.yaw), jnp.sin(layout.yaw)
    axes = jnp.stack([jnp.stack([cos, sin], -1), jnp.stack([-sin, cos], -1)], -2)
    middle = layout.spot + jnp.sum(axes * footprints.centre[..., None], axis=-2)
    apart = middle[..., second, :] - middle[..., first, :]
    gaps = [jnp.sqrt(jnp.sum(apart**2, -1)) - footprints.radius[first] - footprints.radius[second]]
    for owner in (first, second):
        for k in range(2):
            along = axes[..., owner, k, :]
            reach = sum(_reach(axes[..., i, :, :], jnp.asarray(footprints.half)[i], along) for i in (first, second))
            gaps.append(jnp.abs(jnp.sum(apart * along, -1)) - reach)
    return jnp.maximum(-jnp.max(jnp.stack(gaps), axis=0), 0.0)


def _reach(
    axes: Float[Array, "pairs 2 2"], half: Float[Array, "pairs 2"], along: Float[Array, "pairs 2"]
) -> Float[Array, " pairs"]:
    """How far rectangles extend from their middles along a direction, metres."""
    return jnp.sum(half * jnp.abs(jnp.sum(axes * along[..., None, :], -1)), -1)


def _real(values: AnyArray | Sequence[Sequence[float]] | Sequence[float]) -> Float[Array, "..."]:
    """As floats of JAX's default width."""
    return jnp.asarray(values, jnp.result_type(float))
