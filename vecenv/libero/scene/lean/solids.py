"""Convex solids of which things are made: boxes, capsules, cylinders and hulls of meshes.

In: shapes in the frame of the body that carries them, metres. Out: their corners, distances from points, points on the
outer surface of a union of them, and how far two unions are apart.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vecenv.errors import InvalidInput

BOX, CAPSULE, CYLINDER, HULL = "box", "capsule", "cylinder", "hull"

# Corner signs of a box, [8, 3].
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_ROUND_SIDES = 24


class FitError(InvalidInput):
    """Solids to which a shape cannot be fitted; the message says why."""


@dataclass(frozen=True)
class Solid:
    """A convex solid in its body's frame.

    Attributes:
        kind: ``BOX`` (half extents), ``CAPSULE`` and ``CYLINDER`` (radius, half length, 0; along the local z) or
            ``HULL`` (half extents of its box).
        pos: centre, metres, [3].
        mat: rotation, [3, 3].
        size: see ``kind``, metres, [3].
        points: corners of a hull in the body's frame, [n, 3].
    """

    kind: str
    pos: np.ndarray
    mat: np.ndarray
    size: np.ndarray
    points: np.ndarray | None = None

    @property
    def half_extents(self) -> np.ndarray:
        """Half extents of the box around it, in its own frame, [3]."""
        if self.kind in (BOX, HULL):
            return self.size
        ends = self.size[1] + (self.size[0] if self.kind == CAPSULE else 0.0)
        return np.array([self.size[0], self.size[0], ends])

    def extreme_points(self) -> np.ndarray:
        """Points whose convex hull it is (round ones as polygons around them), body frame, [n, 3]."""
        if self.points is not None:
            return self.points
        if self.kind == BOX:
            return self.pos + (_CORNERS * self.size) @ self.mat.T
        return self.pos + _round_points(self) @ self.mat.T

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance of body-frame points [n, 3] from its surface, negative inside, [n]; hulls count as their box."""
        local = (points - self.pos) @ self.mat
        if self.kind == CAPSULE:
            local[:, 2] -= np.clip(local[:, 2], -self.size[1], self.size[1])
            return np.linalg.norm(local, axis=1) - self.size[0]
        if self.kind == CYLINDER:
            local = np.stack([np.linalg.norm(local[:, :2], axis=1), local[:, 2]], axis=1)
            return _box_distance(local, self.size[:2])
        return _box_distance(local, self.size)

    def turned(self, mat: np.ndarray) -> Solid:
        """The same solid with its body's frame rotated by ``mat`` [3, 3]."""
        points = None if self.points is None else self.points @ mat.T
        return replace(self, pos=mat @ self.pos, mat=mat @ self.mat, points=points)


def box(pos: np.ndarray, mat: np.ndarray, size: np.ndarray) -> Solid:
    """A box: centre [3], rotation [3, 3], half extents [3]."""
    return Solid(BOX, np.asarray(pos, float), np.asarray(mat, float), np.asarray(size, float))


def capsule(start: np.ndarray, end: np.ndarray, radius: float) -> Solid:
    """A capsule around the segment from ``start`` to ``end``, [3] each."""
    axis = np.asarray(end, float) - start
    half = float(np.linalg.norm(axis)) / 2
    return Solid(CAPSULE, (np.asarray(start) + end) / 2, _frame_along(axis), np.array([radius, half, 0.0]))


def _frame_along(axis: np.ndarray) -> np.ndarray:
    """A rotation whose z is ``axis``, [3, 3]; the identity for a vector of length 0."""
    length = np.linalg.norm(axis)
    if length == 0.0:
        return np.eye(3)
    z = axis / length
    x = np.eye(3)[np.argmin(np.abs(z))]
    y = np.cross(z, x)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _box_distance(local: np.ndarray, half: np.ndarray) -> np.ndarray:
    gap = np.abs(local) - half
    return np.linalg.norm(np.maximum(gap, 0.0), axis=1) + np.minimum(gap.max(axis=1), 0.0)


def _round_points(solid: Solid) -> np.ndarray:
    """Points of a capsule or cylinder in its own frame, [n, 3]."""
    angle = np.arange(_ROUND_SIDES) * 2 * np.pi / _ROUND_SIDES
    radius, half = solid.size[:2]
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(_ROUND_SIDES, half)], axis=1)
    rings = [ring, ring * [1, 1, -1]]
    if solid.kind == CAPSULE:
        rings.append(np.array([[0, 0, half + radius], [0, 0, -half - radius]]))
    return np.concatenate(rings)


def union_distance(solids: Sequence[Solid], points: np.ndarray) -> np.ndarray:
    """Distance of body-frame points [n, 3] from a union of solids, negative inside any of them, [n]."""
    return np.min([solid.distance(points) for solid in solids], axis=0)


def surface_points(solids: Sequence[Solid], spacing: float = 0.002) -> np.ndarray:
    """Points spread evenly over the outer surface of a union of solids, body frame, [n, 3]."""
    kept = []
    for index, solid in enumerate(solids):
        points = _own_surface(solid, spacing)
        others = [other for i, other in enumerate(solids) if i != index]
        if others:
            points = points[union_distance(others, points) > -1e-4]
        kept.append(points)
    return np.concatenate(kept)


def _own_surface(solid: Solid, spacing: float) -> np.ndarray:
    flat = solid.kind in (BOX, HULL)
    local = _box_surface(solid.size, spacing) if flat else _round_surface(solid, spacing)
    return solid.pos + local @ solid.mat.T


def _box_surface(half: np.ndarray, spacing: float) -> np.ndarray:
    faces = []
    for axis in range(3):
        u, v = (half[i] for i in range(3) if i != axis)
        grid = np.stack(np.meshgrid(ticks(u, spacing), ticks(v, spacing), indexing="ij"), axis=-1).reshape(-1, 2)
        faces += [np.insert(grid, axis, side * half[axis], axis=1) for side in (-1.0, 1.0)]
    return np.concatenate(faces)


def ticks(half: float, spacing: float) -> np.ndarray:
    """Middles of equal cells over [-half, half]."""
    count = max(1, round(2 * half / spacing))
    return (np.arange(count) + 0.5) * (2 * half / count) - half


def _round_surface(solid: Solid, spacing: float) -> np.ndarray:
    radius, half = solid.size[:2]
    count = max(8, round(2 * np.pi * radius / spacing))
    angle = np.arange(count) * 2 * np.pi / count
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    rings = [radius * circle + [0, 0, z] for z in ticks(half, spacing)] if half else []
    for share in ticks(0.5, spacing / radius) + 0.5:
        if solid.kind == CAPSULE:
            cap = radius * (np.cos(share * np.pi / 2) * circle + [0, 0, np.sin(share * np.pi / 2)]) + [0, 0, half]
        else:
            cap = radius * share * circle + [0, 0, half]
        rings += [cap, cap * [1, 1, -1]]
    return np.concatenate(rings)


def gaps(solids: Sequence[Solid], others: Sequence[Solid], spacing: float = 0.002) -> np.ndarray:
    """How far points spread evenly over the outer surface of solids are from the surface of others, metres, [n]."""
    return np.abs(union_distance(others, surface_points(solids, spacing)))
