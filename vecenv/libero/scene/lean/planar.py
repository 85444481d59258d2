"""Geometry in the plane for the fits of lean geometry: convex hulls, polygons and turns about z."""

from __future__ import annotations

import numpy as np


def convex_hull(points: np.ndarray) -> np.ndarray:
    """Corners of the convex hull of points in the plane, counterclockwise (Andrew's monotone chain), [n, 2]."""
    ordered = sorted({(round(float(x), 9), round(float(y), 9)) for x, y in points})
    halves = []
    for sequence in (ordered, ordered[::-1]):
        chain: list[tuple[float, float]] = []
        for point in sequence:
            while len(chain) > 1 and _cross(chain[-2], chain[-1], point) <= 0:
                chain.pop()
            chain.append(point)
        halves += chain[:-1]
    return np.array(halves)


def polygon_area(corners: np.ndarray) -> float:
    """Area of a polygon given counterclockwise, [n, 2]."""
    x, y = corners.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _cross(o: tuple[float, float], a: tuple[float, float], b: tuple[float, float]) -> float:
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


def in_polygon(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Whether points [n, 2] lie within a convex polygon given counterclockwise."""
    edge = np.roll(corners, -1, axis=0) - corners
    offset = points[:, None] - corners
    return np.all(edge[:, 0] * offset[..., 1] - edge[:, 1] * offset[..., 0] >= -1e-9, axis=1)


def polygon_scale(sides: int) -> float:
    """Apothem of the regular polygon whose outline lies at distance 1 from its centre, averaged over all directions."""
    angle = np.pi / sides
    return angle / np.log(np.tan(angle / 2 + np.pi / 4))


def turn_z(angle: float) -> np.ndarray:
    """Rotation about z by an angle in radians, [3, 3]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
