"""Contacts of a mesh on a plane as MuJoCo 2.3 to 3.3 chose them, in JAX, for ``jit``, ``vmap`` and ``grad``.

The method is that of ``vecenv.libero.physics.colliders.planemesh``. A pair has three rows; those without a contact are
``NOTHING`` metres apart. Only the choice of the lowest vertex loops; derivatives do not go through it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vecenv.libero.physics.colliders.boxbox_jax import NOTHING, PairKey, contact_frame

MOST = 3
_APART = 0.3


class Hull(NamedTuple):
    """A mesh's convex hull: vertices [n, 3], metres; neighbours of each in MuJoCo's order [n, most], -1 for none."""

    vertices: np.ndarray
    neighbours: np.ndarray


def hull_of(model: mujoco.MjModel | mjx.Model, mesh: int) -> Hull | None:
    """The hull of a mesh of a model, MuJoCo's or MJX's; None where it has none."""
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        return None
    count, faces = (int(n) for n in model.mesh_graph[start : start + 2])
    begins, ids, edges = np.split(model.mesh_graph[start + 2 : start + 2 + 3 * (count + faces)], [count, 2 * count])
    ends = np.flatnonzero(edges < 0)
    ends = ends[np.searchsorted(ends, begins)]
    neighbours = np.full((count, int((ends - begins).max())), -1, np.int32)
    for row, first, last in zip(neighbours, begins, ends, strict=True):
        row[: last - first] = edges[first:last]
    return Hull(model.mesh_vert[int(model.mesh_vertadr[mesh]) + ids], neighbours)


def collider(without_hull: Callable[..., Any]) -> Callable[..., Any]:
    """A collision function of MJX: distances [3 N], positions [3 N, 3], frames [3 N, 3, 3] of pairs of geoms [N, 2].

    Args:
        without_hull: MJX's own, of which meshes without a hull get the three deepest contacts.
    """

    def collide(
        model: mjx.Model, data: mjx.Data, key: PairKey, geom: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        hull = hull_of(model, key.data_ids[1])
        if hull is None:
            return _deepest(without_hull(model, data, key, geom), len(geom))
        plane, mesh = geom.T
        normal = data.geom_xmat[plane][:, :, 2]
        dist, pos = jax.vmap(lambda *pair: plane_mesh(hull, *pair))(
            normal,
            data.geom_xpos[plane],
            data.geom_xpos[mesh],
            data.geom_xmat[mesh],
            model.geom_rbound[mesh],
            model.geom_margin[geom].sum(-1),
        )
        frame = jnp.repeat(jax.vmap(contact_frame)(normal), MOST, axis=0)
        return dist.reshape(-1), pos.reshape(-1, 3), frame

    collide.ncon = MOST  # type: ignore[attr-defined]
    return collide


def plane_mesh(
    hull: Hull,
    normal: jax.Array,
    at: jax.Array,
    pos: jax.Array,
    mat: jax.Array,
    radius: jax.Array | float,
    margin: jax.Array | float = 0.0,
) -> tuple[jax.Array, jax.Array]:
    """Distances [3] and positions [3, 3] of the contacts of a mesh on a plane.

    Args:
        hull: the mesh's hull.
        normal, at: the plane's unit normal [3] and a point of it [3], metres.
        pos, mat: the mesh's position [3], metres, and rotation to the world frame [3, 3].
        radius: its bounding radius, metres.
        margin: contacts up to this distance are reported, metres.
    """
    vertices, neighbours = jnp.asarray(hull.vertices, pos.dtype), jnp.asarray(hull.neighbours)
    lowest = _lowest(vertices, neighbours, -(mat * normal[:, None]).sum(0))
    beside = neighbours[lowest]
    chosen = jnp.concatenate([lowest[None], beside])
    places = (mat * vertices[chosen][:, None]).sum(-1) + pos
    height = ((places - at) * normal).sum(-1)
    points = places - 0.5 * height[:, None] * normal
    gap = jax.lax.stop_gradient(((places[1:] - points[0]) ** 2).sum(-1))
    first = height[0] <= margin
    others = first & (beside >= 0) & (height[1:] <= margin) & (jnp.sqrt(gap) >= _APART * radius)
    valid = jnp.concatenate([first[None], others])
    rows = jnp.argsort(~valid, stable=True)[:MOST]
    counts = jnp.arange(MOST) < valid.sum()
    return jnp.where(counts, height[rows], NOTHING), points[rows]


def _deepest(found: tuple[jax.Array, jax.Array, jax.Array], pairs: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The deepest contacts of each pair, of more."""
    each = [part.reshape(pairs, -1, *part.shape[1:]) for part in found]
    order = jnp.argsort(each[0], axis=1)[:, :MOST]
    dist, pos, frame = (jax.vmap(lambda rows, which: rows[which])(part, order) for part in each)
    return dist.reshape(-1), pos.reshape(-1, 3), frame.reshape(-1, 3, 3)


def _lowest(vertices: jax.Array, neighbours: jax.Array, down: jax.Array) -> jax.Array:
    """Number of the hull's vertex furthest along a direction, reached from the first along its edges."""
    vertices, down = jax.lax.stop_gradient(vertices), jax.lax.stop_gradient(down)

    def climb(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        _, now, value = state
        beside = neighbours[now]
        values = jnp.where(beside >= 0, (vertices[beside] * down).sum(-1), -jnp.inf)
        best = values.argmax()
        higher = values[best] > value
        return now, jnp.where(higher, beside[best], now), jnp.where(higher, values[best], value)

    start = jnp.int32(-1), jnp.int32(0), (vertices[0] * down).sum()
    return jax.lax.while_loop(lambda state: state[0] != state[1], climb, start)[1]
