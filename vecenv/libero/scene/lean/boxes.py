"""Boxes in the place of many solids: bounding boxes, blocks with the outline's area, greedy merging, round columns.

In: solids of one body, in that body's frame, metres. Out: one box or a few. Every fit is a deterministic formula.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vecenv.libero.scene.lean.planar import convex_hull, in_polygon, polygon_scale, turn_z
from vecenv.libero.scene.lean.solids import Solid, box, ticks, union_distance

# Of a solid, how much must lie within another for it to be left out before merging.
_COVERED = 0.95
# Points by which volumes are compared, and cells along the longer side of a cross-section.
_VOLUME_POINTS = 300
_SECTION_CELLS = 60


def bound(solids: Sequence[Solid], mat: np.ndarray | None = None) -> Solid:
    """The smallest box around solids, oriented as ``mat`` or, without it, as the largest of them."""
    mat = largest(solids).mat if mat is None else mat
    local = np.concatenate([solid.extreme_points() for solid in solids]) @ mat
    low, high = local.min(axis=0), local.max(axis=0)
    return box(mat @ (low + high) / 2, mat, (high - low) / 2)


def largest(solids: Sequence[Solid]) -> Solid:
    """The solid with the largest box."""
    return max(solids, key=lambda solid: float(np.prod(solid.half_extents)))


def block(solids: Sequence[Solid], up: int | None = None) -> Solid:
    """One box with the height of the solids along an axis of their body and the area of their outline seen along it.

    Args:
        solids: the solids that it replaces.
        up: index of the body's axis, 0 to 2; None for the axis across which the outline fills its box best.
    """
    around = bound(solids, None if up is None else upright(largest(solids).mat, up))
    axes = range(3) if up is None else [2]
    shares = {axis: outline_share(solids, around, axis) for axis in axes}
    axis = max(shares, key=lambda a: shares[a])
    size = around.size * np.where(np.arange(3) == axis, 1.0, np.sqrt(shares[axis]))
    return replace(around, size=size)


def upright(mat: np.ndarray, up: int) -> np.ndarray:
    """The rotation nearest to an orientation whose z is the body's axis ``up``."""
    z = np.eye(3)[up]
    side = mat[:, np.argmin(np.abs(mat[up]))]
    x = side - z * side[up]
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def outline_share(solids: Sequence[Solid], around: Solid, axis: int) -> float:
    """How much of a box's face the outline of the solids seen along ``axis`` fills."""
    keep = [i for i in range(3) if i != axis]
    half = around.size[keep]
    marks = [ticks(h, 2 * half.max() / _SECTION_CELLS) for h in half]
    grid = np.stack(np.meshgrid(*marks, indexing="ij"), axis=-1).reshape(-1, 2)
    filled = np.zeros(len(grid), bool)
    for solid in solids:
        corners = ((solid.extreme_points() - around.pos) @ around.mat)[:, keep]
        filled |= in_polygon(grid, convex_hull(corners))
    return max(float(filled.mean()), 1e-3)


def merge(solids: Sequence[Solid], count: int, up: int | None = None) -> list[Solid]:
    """At most ``count`` boxes: solids are joined two by two, each time those whose common box adds the least space.

    ``up`` is the body's axis along which heights are kept, as for :func:`block`.
    """
    if count == 1:
        return [_joined(solids, up)]
    clusters = [[solid] for solid in _uncovered(solids)]
    cost = {pair: _added_space(clusters, pair) for pair in itertools.combinations(range(len(clusters)), 2)}
    alive = set(range(len(clusters)))
    while len(alive) > count:
        first, second = min(cost, key=lambda pair: cost[pair])
        clusters.append(clusters[first] + clusters[second])
        alive -= {first, second}
        cost = {pair: value for pair, value in cost.items() if alive.issuperset(pair)}
        joined = len(clusters) - 1
        cost |= {(other, joined): _added_space(clusters, (other, joined)) for other in sorted(alive)}
        alive.add(joined)
    return [_joined(clusters[index], up) for index in sorted(alive)]


def _joined(cluster: Sequence[Solid], up: int | None) -> Solid:
    return bound(cluster) if len(cluster) == 1 else block(cluster, up)


def _uncovered(solids: Sequence[Solid]) -> list[Solid]:
    """The solids, largest first, without those that lie within a larger one."""
    kept: list[Solid] = []
    for solid in sorted(solids, key=lambda s: -float(np.prod(s.half_extents))):
        inside = _volume_points(bound([solid]))
        if not any((other.distance(inside) <= 1e-4).mean() > _COVERED for other in kept):
            kept.append(solid)
    return kept


def _added_space(clusters: Sequence[Sequence[Solid]], pair: tuple[int, int]) -> float:
    """Space within the common box of two clusters that neither of them fills, cubic metres."""
    solids = [*clusters[pair[0]], *clusters[pair[1]]]
    around = bound(solids)
    empty = union_distance(solids, _volume_points(around)) > 0
    return float(empty.mean() * np.prod(2 * around.size))


def _volume_points(around: Solid) -> np.ndarray:
    """Evenly spread points within a box (a Kronecker sequence), body frame."""
    golden = 1.22074408460575947536  # root of x^4 = x + 1: the three-dimensional golden ratio
    unit = (0.5 + np.arange(1, _VOLUME_POINTS + 1)[:, None] * golden ** -np.arange(1.0, 4.0)) % 1.0
    return around.pos + ((2 * unit - 1) * around.size) @ around.mat.T


def column(solids: Sequence[Solid], up: int, blades: int = 2) -> list[Solid]:
    """A solid, round column as ``blades`` crossed boxes whose corners form a regular polygon.

    With two blades the outline is that of a plus, its convex hull a regular octagon: flat for a gripper in eight
    directions, and flat on top and bottom.

    Args:
        solids: the solids that it replaces.
        up: index of the body's axis along the column.
        blades: boxes; their polygon has ``4 * blades`` sides.
    """
    mat = upright(np.eye(3), up)
    around = bound(solids, mat)
    share = outline_share(solids, around, axis=2)
    radius = np.sqrt(share * 4 * around.size[0] * around.size[1] / np.pi)
    sides = 4 * blades
    outer = radius * polygon_scale(sides) / np.cos(np.pi / sides)
    half = outer * np.array([np.cos(np.pi / sides), np.sin(np.pi / sides)])
    turns = [turn_z(k * np.pi / blades) for k in range(blades)]
    return [box(around.pos, mat @ turn, np.array([*half, around.size[2]])) for turn in turns]
