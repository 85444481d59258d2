"""Depth images of simple shapes, traced by formulas: what the tests of perception from cameras look at."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from voxposer.perception.cameras import DepthView

# A shape: distance along rays from a point [3] in directions [N, 3] to its surface, infinite where it is missed, [N].
Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]


def floor(height: float = 0.0) -> Shape:
    """A level plane."""
    return lambda eye, ways: np.where(ways[:, 2] < 0, (height - eye[2]) / np.minimum(ways[:, 2], -1e-9), np.inf)


def block(low: Sequence[float], high: Sequence[float]) -> Shape:
    """A box between two corners."""

    def trace(eye: np.ndarray, ways: np.ndarray) -> np.ndarray:
        safe = np.where(np.abs(ways) < 1e-9, 1e-9, ways)
        ends = np.stack([(np.array(low) - eye) / safe, (np.array(high) - eye) / safe])
        enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
        return np.where((enter < leave) & (enter > 0), enter, np.inf)

    return trace


def can(x: float, y: float, radius: float, low: float, high: float) -> Shape:
    """An upright cylinder."""

    def trace(eye: np.ndarray, ways: np.ndarray) -> np.ndarray:
        start, way = eye[:2] - [x, y], ways[:, :2]
        a, b, c = (way**2).sum(axis=1), way @ start, start @ start - radius**2
        inside = b**2 - a * c
        side = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / np.maximum(a, 1e-12), np.inf)
        height = eye[2] + side * ways[:, 2]
        side = np.where((side > 0) & (height > low) & (height < high), side, np.inf)
        top = (high - eye[2]) / np.where(np.abs(ways[:, 2]) < 1e-9, 1e-9, ways[:, 2])
        on_top = np.linalg.norm(start + top[:, None] * way, axis=1) < radius
        return np.minimum(side, np.where(on_top & (top > 0), top, np.inf))

    return trace


def view(eye: Sequence[float], target: Sequence[float], shapes: Sequence[Shape], *, side: int = 160) -> DepthView:
    """What a camera sees of shapes; the label of a pixel is the index of its shape. Field of view 45 degrees."""
    pos = np.array(eye, float)
    ahead = np.array(target, float) - pos
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    mat = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    focal = side / 2 / np.tan(np.radians(22.5))
    middle = (side - 1) / 2
    intrinsics = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    y, x = np.mgrid[:side, :side]
    local = np.stack([x.ravel(), y.ravel(), np.ones(side * side)], axis=1) @ np.linalg.inv(intrinsics).T
    ways = local @ mat.T
    depths = np.stack([shape(pos, ways) for shape in shapes])
    depth = depths.min(axis=0)
    return DepthView(
        camera="camera",
        intrinsics=intrinsics,
        pos=pos,
        mat=mat,
        depth=depth.reshape(side, side),
        points=(pos + ways * np.where(np.isfinite(depth), depth, 0.0)[:, None]).reshape(side, side, 3),
        labels=depths.argmin(axis=0).reshape(side, side),
    )
