"""Contacts of two boxes as MuJoCo 2.3 to 3.3 computed them, in JAX: static shapes, for ``jit``, ``vmap`` and ``grad``.

The method and the halved depth of face contacts are those of ``vecenv.libero.physics.colliders.boxbox``, which explains
them. Here all candidates of a pair are computed at once and masked: 16 crossings of edges, 4 corners of the face, 4
corners of the other box, for a face and for two edges. A pair has eight rows; those without a contact are ``NOTHING``
metres apart. ``vecenv.libero.physics.colliders.boxbox_warp`` explains what single precision requires.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

MOST = 8
# Distance of a row without a contact, metres.
NOTHING = 1.0
_PARALLEL = 1e-10
_EDGE_NOISE = 5e-8
_TINY = 1e-12
_OUTSIDE = 1.01
# Rows: the axes of the frame of the faces +x +y +z -x -y -z of a box; the third points out of it.
_FRAMES = np.zeros((6, 3, 3), np.float32)
for _face, (_axes, _signs) in enumerate(
    [
        ([2, 1, 0], [-1, 1, 1]),
        ([0, 2, 1], [1, -1, 1]),
        ([0, 1, 2], [1, 1, 1]),
        ([2, 1, 0], [1, 1, -1]),
        ([0, 2, 1], [1, 1, -1]),
        ([0, 1, 2], [-1, 1, -1]),
    ]
):
    _FRAMES[_face, range(3), _axes] = _signs
# The four corners of a rectangle, and the coordinates (q, 1 - q) and sides at which its borders lie.
_CORNERS = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]], np.float32)
_SIDES = np.array([-1, 1], np.float32)


class Box(NamedTuple):
    """A box: centre [3], rotation to the world frame [3, 3] and half sizes [3]; metres."""

    pos: jax.Array
    mat: jax.Array
    size: jax.Array


class PairKey(Protocol):
    """MJX's key of a group of geom pairs: ``data_ids`` are the meshes of the two geoms, -1 for other geoms."""

    data_ids: tuple[int, int]


class _Found(NamedTuple):
    """Candidates in a frame: positions [24, 3], depths [24], and which of them count."""

    points: jax.Array
    depth: jax.Array
    valid: jax.Array


def collider(model: mjx.Model, data: mjx.Data, key: PairKey, geom: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A collision function of MJX: distances [8 N], positions [8 N, 3], frames [8 N, 3, 3] of pairs of geoms [N, 2]."""
    first, second = (Box(data.geom_xpos[g], data.geom_xmat[g], model.geom_size[g]) for g in geom.T)
    margin = model.geom_margin[geom].sum(-1)
    dist, pos, normal = jax.vmap(box_box)(first, second, margin)
    frame = jnp.repeat(jax.vmap(contact_frame)(normal), MOST, axis=0)
    return dist.reshape(-1), pos.reshape(-1, 3), frame


collider.ncon = MOST  # type: ignore[attr-defined]


def contact_frame(normal: jax.Array) -> jax.Array:
    """Rows: a unit normal and two tangents, as MuJoCo chooses them, [3, 3]."""
    upright = jnp.abs(normal[1]) < 0.5
    helper = jnp.where(upright, jnp.array([0.0, 1, 0]), jnp.array([0.0, 0, 1]))
    tangent = helper - normal * (normal * helper).sum()
    tangent = tangent / jnp.sqrt((tangent * tangent).sum())
    return jnp.stack([normal, tangent, jnp.cross(normal, tangent)])


def box_box(first: Box, second: Box, margin: jax.Array | float = 0.0) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distances [8], positions [8, 3] and the normal [3], from the first box to the second, of two boxes' contacts.

    Args:
        first, second: the boxes.
        margin: contacts up to this distance are reported, metres.
    """
    rot = _times(first.mat.T, second.mat)
    gap = second.pos - first.pos
    centre2, centre1 = _turn(first.mat.T, gap), -_turn(second.mat.T, gap)
    apart, face, edges, axis = _least_overlap(first.size, second.size, rot, centre2, centre1, margin)
    on_edges, on_second = edges >= 0, face >= 6

    def swapped(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(on_second, b, a)

    by_face, face_normal = _face_contacts(
        _one_of(_FRAMES, face % 6),
        swapped(first.size, second.size),
        swapped(second.size, first.size),
        swapped(rot, rot.T),
        swapped(centre2, centre1),
        margin,
    )
    by_edge, edge_normal = _edge_contacts(jnp.maximum(edges, 0), first.size, second.size, rot, centre2, axis, margin)
    found = jax.tree.map(lambda a, b: jnp.where(on_edges, a, b), by_edge, by_face)
    # Edges and faces of the first box are in its frame, faces of the second in that of the second.
    own = jax.tree.map(lambda a, b: jnp.where(on_second & ~on_edges, b, a), first, second)
    normal = _turn(own.mat, jnp.where(on_edges, edge_normal, jnp.where(on_second, -face_normal, face_normal)))
    points = (own.mat * found.points[:, None]).sum(-1) + own.pos
    valid = found.valid & ~apart & _good(points, first, second, margin)
    valid &= ~_repeated(points, valid)
    return *_first_rows(points, found.depth, valid), normal


def _good(points: jax.Array, first: Box, second: Box, margin: jax.Array | float) -> jax.Array:
    """Points that are not outside one box unless they are well inside the other, bool [24]."""
    out, inside = [], []
    for box in (first, second):
        place = jnp.abs(((points - box.pos)[:, :, None] * box.mat).sum(1))
        reach = box.size + margin
        out.append((place > reach * _OUTSIDE).any(-1))
        inside.append((place < reach / _OUTSIDE).all(-1))
    return ~((out[0] & ~inside[1]) | (out[1] & ~inside[0]))


def _repeated(points: jax.Array, valid: jax.Array) -> jax.Array:
    """Points that are repeated among the later valid ones, bool [24]."""
    again = (points[:, None] == points[None]).all(-1)
    return (jnp.triu(again, 1) & valid).any(-1)


def _first_rows(points: jax.Array, depth: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Distances [8] and positions [8, 3] of the first eight valid candidates."""
    row = jnp.where(valid, jnp.cumsum(valid) - 1, MOST)
    chosen = row == jnp.arange(MOST)[:, None]
    dist = jnp.where(chosen, depth, 0).sum(-1)
    pos = jnp.where(chosen[..., None], points, 0).sum(1)
    return jnp.where(chosen.any(-1), dist, NOTHING), pos


def _times(a: jax.Array, b: jax.Array) -> jax.Array:
    """A product of 3 x 3 matrices, in full precision on every device."""
    return (a[:, :, None] * b[None]).sum(1)


def _turn(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """A product of a matrix and a vector, in full precision on every device."""
    return (matrix * vector).sum(-1)


def _one_of(constants: np.ndarray, index: jax.Array) -> jax.Array:
    """An entry of an array of constants."""
    chosen = jnp.arange(len(constants)) == index
    return jnp.where(chosen.reshape(-1, *[1] * (constants.ndim - 1)), constants, 0).sum(0)


def _safe(value: jax.Array, fine: jax.Array) -> jax.Array:
    """A number to divide by or to take the root of; 1 where it is not usable."""
    return jnp.where(fine, value, 1)


# ---------------------------------------------------------------------------------------------------------------------
# Separating axes.


def _least_overlap(
    size1: jax.Array,
    size2: jax.Array,
    rot: jax.Array,
    centre2: jax.Array,
    centre1: jax.Array,
    margin: jax.Array | float,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Whether the boxes are apart; the number of the best face; that of the pair of edges or -1, and their axis."""
    turned = jnp.abs(rot)
    overlap1 = size1 + (turned * size2).sum(1) - jnp.abs(centre2)
    overlap2 = size2 + (turned * size1[:, None]).sum(0) - jnp.abs(centre1)
    faces = jnp.stack([overlap1, overlap2], 1).reshape(-1)  # in MuJoCo's order: the first of equals is chosen
    best = jnp.argmin(faces)
    centres = jnp.stack([centre2, centre1], 1).reshape(-1)
    face = best // 2 + 6 * (best % 2) + 3 * _one_row(centres < 0, best)

    across = jnp.cross(jnp.eye(3, dtype=rot.dtype)[:, None], rot.T[None])  # edge i of the first, k of the second
    square = (across * across).sum(-1)
    fine = square > _PARALLEL
    scale = 1 / jnp.sqrt(_safe(square, fine))
    across = across * scale[..., None]
    # Along the axis, axis a of the second box is as long as rot[i, b], where k, a and b are all different.
    others = [
        turned[:, (k + 2) % 3] * size2[(k + 1) % 3] + turned[:, (k + 1) % 3] * size2[(k + 2) % 3] for k in range(3)
    ]
    overlap = (size1 * jnp.abs(across)).sum(-1) + jnp.stack(others, 1) * scale
    overlap = overlap - jnp.abs((centre2 * across).sum(-1))
    apart = (faces < -margin).any() | (fine & (overlap < -margin)).any()
    noisy = jnp.where(fine, overlap + _EDGE_NOISE * (size1.sum() + size2.sum()) * scale, jnp.inf).reshape(-1)
    edge = jnp.argmin(noisy)
    edges = jnp.where(_one_row(noisy, edge) < faces.min(), edge, -1)
    return apart, face, edges, _one_row(across.reshape(9, 3), edge)


def _one_row(rows: jax.Array, index: jax.Array) -> jax.Array:
    """A row of an array."""
    chosen = (jnp.arange(len(rows)) == index).reshape(-1, *[1] * (rows.ndim - 1))
    return jnp.where(chosen, rows, jnp.zeros_like(rows)).sum(0).astype(jnp.result_type(rows.dtype, jnp.int32))


def _sides(corner: jax.Array, first: jax.Array, second: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Origins and steps of the four sides of a parallelogram, [4, 3] each; the first alone is an edge."""
    return jnp.stack([corner, corner, corner + first, corner + second]), jnp.stack([first, second, second, first])


def _crossings(origin: jax.Array, step: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where four lines cross the borders of a rectangle: how far along, where along the border, and whether; [4, 2, 2].

    The axes are the line, the coordinate that the border fixes, and its side.
    """
    fine = jnp.abs(step[:, :2]) > _TINY
    border = half[:2, None] * _SIDES
    t = (border - origin[:, :2, None]) / _safe(step[:, :2], fine)[..., None]
    where = origin[:, 1::-1, None] + step[:, 1::-1, None] * t
    valid = fine[..., None] & (t >= 0) & (t <= 1) & (jnp.abs(where) <= half[1::-1, None])
    return t, where, valid


# ---------------------------------------------------------------------------------------------------------------------
# A face of one box and the lowest vertex, edge or face of the other.


def _face_contacts(
    frame: jax.Array,
    size: jax.Array,
    other_size: jax.Array,
    other_axes: jax.Array,
    other_centre: jax.Array,
    margin: jax.Array | float,
) -> tuple[_Found, jax.Array]:
    """Candidates on a face of a box, their depth halved, and the face's normal; in the frame of the box."""
    axes, half = _times(frame, other_axes), jnp.abs(_turn(frame, size))
    corner = _turn(frame, other_centre) - jnp.array([0, 0, 1]) * half[2]
    steps = axes * jnp.where(axes[2] < 0, other_size, -other_size)
    corner = corner + steps.sum(1)
    flat = jnp.abs(axes[2]) < 0.5
    one, other = flat & (jnp.cumsum(flat) == 1), flat & (jnp.cumsum(flat) == 2)
    first, second = (-2 * jnp.where(chosen, steps, 0).sum(1) for chosen in (one, other))
    is_edge, is_face = one.any(), other.any()

    origin, step = _sides(corner, first, second)
    t, _, crossed = _crossings(origin, step, half)
    crossed &= jnp.stack([is_edge, is_face, is_face, is_face])[:, None, None]
    crossings = origin[:, None, None] + step[:, None, None] * t[..., None]

    below = half[:2] * _CORNERS
    area = first[0] * second[1] - second[0] * first[1]
    x, y = (below - corner[:2]).T / _safe(area, is_face & (area != 0))
    u, v = x * second[1] - y * second[0], y * first[0] - x * first[1]
    heights = corner[2] + u * first[2] + v * second[2]
    corners = jnp.concatenate([below, heights[:, None]], 1)
    inside = is_face & (u > 0) & (v > 0) & (u < 1) & (v < 1)

    vertices = jnp.stack([corner, corner + first, corner + second, corner + first + second])
    above = (jnp.abs(vertices[:, :2]) < half[:2]).all(-1) & jnp.stack([is_edge, is_edge, is_face, is_face])
    above = above.at[0].set(True)

    points = jnp.concatenate([crossings.reshape(16, 3), corners, vertices])
    valid = jnp.concatenate([crossed.reshape(16), inside, above]) & (points[:, 2] <= margin)
    depth = 0.5 * points[:, 2]
    points = jnp.concatenate([points[:, :2], (depth + half[2])[:, None]], 1)
    return _Found((points[:, :, None] * frame).sum(1), depth, valid), frame[2]


# ---------------------------------------------------------------------------------------------------------------------
# Two edges.


def _edge_contacts(
    edges: jax.Array,
    size1: jax.Array,
    size2: jax.Array,
    rot: jax.Array,
    centre2: jax.Array,
    axis: jax.Array,
    margin: jax.Array | float,
) -> tuple[_Found, jax.Array]:
    """Candidates about edge ``edges // 3`` of the first box and ``edges % 3`` of the second, and the normal."""
    e1, e2 = edges // 3, edges % 3
    away = (centre2 * axis).sum() < 0
    sign = jnp.where(away, -1.0, 1.0)
    beside1, beside2 = _one_row(rot.T, e2), _one_row(rot, e1)
    _, face1 = _along_and_face(e1, beside1)
    along2, face2 = _along_and_face(e2, beside2)
    frame = _one_of(_FRAMES, jnp.where((_one_row(axis, face1) > 0) != away, face1, face1 + 3))
    half, across = jnp.abs(_turn(frame, size1)), _turn(frame, axis)
    usable = jnp.abs(across[2]) >= _TINY

    # The second box's face: both ends of the edge, then both of the opposite one; and the same, projected.
    axes = _times(frame, rot) * size2
    along, face, edge = (_one_row(axes.T, k) for k in (along2, face2, e2))
    centre = _turn(frame, centre2) - jnp.array([0, 0, 1]) * half[2] + face * _corner_side(beside2, e2, face2, away)
    along = along * _corner_side(beside2, e2, along2, away)
    quad = jnp.stack([centre + along + edge, centre + along - edge, centre - along + edge, centre - along - edge])
    slope = 1 / _safe(across[2], usable)
    flat = quad - across * (quad[:, 2:] * slope)
    rise = slope * sign

    lines = _edge_lines(quad, flat, half, rise, margin)
    crossed = lines.valid.any()
    corners = _edge_corners(quad, flat, half, crossed, margin)
    have = crossed | corners.valid.any()
    vertices = _edge_vertices(quad, flat, half, rise, crossed, have, margin)
    found = jax.tree.map(lambda *parts: jnp.concatenate(parts), lines, corners, vertices)
    points = ((found.points + jnp.array([0, 0, 1]) * half[2])[:, :, None] * frame).sum(1)
    # Without a crossing the boxes do not overlap: what seems deep is rounding, see ``boxbox_warp``.
    sound = crossed | (found.depth >= 0)
    return _Found(points, found.depth, found.valid & usable & sound), axis * sign


def _along_and_face(edge: jax.Array, beside: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The other axes of a box; the second is the normal of the face next to the edge, less parallel to the other's."""
    low, high = jnp.where(edge == 0, 1, 0), jnp.where(edge == 2, 1, 2)
    low, high = jnp.where(edge == 2, high, low), jnp.where(edge == 2, low, high)
    other_way = jnp.abs(_one_row(beside, low)) < jnp.abs(_one_row(beside, high))
    return jnp.where(other_way, high, low), jnp.where(other_way, low, high)


def _corner_side(beside: jax.Array, e2: jax.Array, k: jax.Array, away: jax.Array) -> jax.Array:
    """On which side along its axis k the second box's edge lies, 1 or -1."""
    positive = (_one_row(beside, 3 - k - e2) > 0) != away
    return jnp.where(positive != ((k - e2 + 3) % 3 == 1), 1.0, -1.0)


def _edge_lines(
    quad: jax.Array, flat: jax.Array, half: jax.Array, rise: jax.Array, margin: jax.Array | float
) -> _Found:
    """Where the projected sides cross the borders of the rectangle, 16 candidates."""
    origin, step = _sides(quad[0], quad[1] - quad[0], quad[2] - quad[0])
    t, where, valid = _crossings(*_sides(flat[0], flat[1] - flat[0], flat[2] - flat[0]), half)
    above = origin[:, None, None] + step[:, None, None] * t[..., None]
    valid &= above[..., 2] * rise <= margin
    border = jnp.broadcast_to(half[:2, None] * _SIDES, t.shape)
    on_first = jnp.stack([border[:, 0], where[:, 0]], -1)
    on_second = jnp.stack([where[:, 1], border[:, 1]], -1)
    below = jnp.concatenate([jnp.stack([on_first, on_second], 1), jnp.zeros_like(t)[..., None]], -1)
    points = 0.5 * (above + below)
    return _Found(points.reshape(16, 3), (above[..., 2] * rise).reshape(16), valid.reshape(16))


def _edge_corners(
    quad: jax.Array, flat: jax.Array, half: jax.Array, crossed: jax.Array, margin: jax.Array | float
) -> _Found:
    """The rectangle's corners inside the projected face, or next to it where no side crosses the rectangle."""
    first, second = flat[1] - flat[0], flat[2] - flat[0]
    # MuJoCo 3.3.0 divides by the last corner's squared gap from the second corner on, see
    # ``vecenv.libero.physics.colliders.boxbox``.
    area = first[0] * second[1] - second[0] * first[1]
    found = []
    for corner in _CORNERS:
        below = jnp.concatenate([half[:2] * corner, jnp.zeros(1, half.dtype)])
        x, y = below[0] - flat[0, 0], below[1] - flat[0, 1]
        divisor = _safe(area, area != 0)
        u, v = (x * second[1] - y * second[0]) / divisor, (y * first[0] - x * first[1]) / divisor
        out_u, out_v = (u < 0) | (u > 1), (v < 0) | (v > 1)
        skipped = jnp.where(crossed, out_u | out_v, out_u & out_v)
        u, v = jnp.clip(u, 0, 1), jnp.clip(v, 0, 1)
        above = quad[0] * (1 - u - v) + quad[1] * u + quad[2] * v
        gap = ((below - above) ** 2).sum()
        area = jnp.where(skipped, area, gap)
        valid = ~skipped & ~((above[2] > 0) & (gap > margin * margin))
        found.append(_Found(0.5 * (below + above), _signed_root(gap, above[2]), valid))
    return jax.tree.map(lambda *parts: jnp.stack(parts), *found)


def _edge_vertices(
    quad: jax.Array,
    flat: jax.Array,
    half: jax.Array,
    rise: jax.Array,
    crossed: jax.Array,
    have: jax.Array,
    margin: jax.Array | float,
) -> _Found:
    """The second box's corners above the rectangle, or near it where no side crosses the rectangle."""
    place = flat[:, :2]
    outside = jnp.abs(place) > half[:2]
    skipped = jnp.where(crossed, outside.any(-1), have & outside.all(-1))
    near = jnp.clip(place, -half[:2], half[:2])
    height = quad[:, 2]
    gap = ((place - near) ** 2).sum(-1) + (height * rise) ** 2
    valid = ~skipped & ~((height > 0) & (gap > margin * margin))
    points = 0.5 * jnp.concatenate([near + quad[:, :2], height[:, None]], 1)
    return _Found(points, _signed_root(gap, height), valid)


def _signed_root(square: jax.Array, sign: jax.Array) -> jax.Array:
    """A root with a sign, whose derivative at 0 is 0."""
    root = jnp.where(square > 0, jnp.sqrt(_safe(square, square > 0)), 0)
    return jnp.where(sign < 0, -root, root)
