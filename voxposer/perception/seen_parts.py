"""Parts of objects as far as seen points show them: the inside of a container, the top of a fixture, an open drawer.

The seen and completed surface of one object comes in; :class:`~vecenv.observations.Part` s without joints go out, named
as ground truth names them: ``<object>_inside``, ``<object>_top``, ``<object>_<level>_drawer``. A drawer is found only
when it is open, by what sticks out of the fixture; its level is its height on the fixture, in thirds. Handles, doors,
knobs and closed drawers are not found.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_closing, binary_opening
from scipy.spatial import ConvexHull, QhullError

from vecenv.observations import Part, PointCloud, RegionBox
from voxposer.perception.config import PerceptionConfig
from voxposer.perception.points import clusters, kept, middle_of

# A rim, a top and a floor are level within this, metres.
_LEVEL = 0.012
# Thickness of what a container stands on, where its floor is not seen.
_FLOOR = 0.01
# The least number of points by which a wall, floor or drawer is found.
_ENOUGH = 12
# Cells in which a level surface is told from a rim: a surface is at least three of them broad, metres.
_CELL = 0.015
# An open drawer is at least this wide, metres.
_DRAWER_WIDTH = 0.10
_LEVELS = ("bottom", "middle", "top")


def parts_of(name: str, cloud: PointCloud, *, fixed: bool, table: float, config: PerceptionConfig) -> dict[str, Part]:
    """The parts of an object that its points show.

    Args:
        name: of the object.
        cloud: its surface.
        fixed: whether it is a fixture.
        table: height of the table, metres.
        config: options.
    """
    if not fixed:
        inside = _inside(name, cloud, config.camera.hollow)
        return {} if inside is None else {f"{name}_inside": inside}
    parts = {}
    top = _top(name, cloud)
    if top is not None:
        parts[f"{name}_top"] = top
        drawer = _open_drawer(name, cloud, top, table, config.camera.sticks_out)
        parts.update(drawer)
    return parts


def _inside(name: str, cloud: PointCloud, least_depth: float) -> Part | None:
    """The space inside a container: within the walls that face its axis, from floor to rim; None if it has none.

    Where no floor is seen it lies 1 cm over the container's underside.
    """
    points, normals = cloud.points, cloud.normals
    bottom, rim = float(points[:, 2].min()), float(points[:, 2].max())
    middle = middle_of(points)
    out = points[:, :2] - middle
    facing = -(normals[:, :2] * out).sum(axis=1) / np.maximum(np.linalg.norm(out, axis=1), 1e-6)
    wall = (facing > 0.6) & (np.abs(normals[:, 2]) < 0.6) & (points[:, 2] < rim - 0.005)
    deep = wall & (points[:, 2] < rim - 0.7 * least_depth)
    upper = points[points[:, 2] > rim - 0.25 * (rim - bottom), :2] - middle
    if deep.sum() < _ENOUGH or rim - bottom < least_depth:
        return None
    hull = _outline(points[points[:, 2] > rim - 0.25 * (rim - bottom), :2])
    if hull is None:
        return None
    _, axes, _ = hull
    local = out @ axes
    half = np.array([_wall_distance(local[wall], normals[wall, :2] @ axes, axis) for axis in (0, 1)])
    outer = np.abs(upper @ axes).max(axis=0)
    half = np.where(np.isfinite(half), half, outer - _LEVEL)
    if half.min() < 0.02:
        return None
    floor = (normals[:, 2] > 0.8) & (np.abs(local) < 0.8 * half).all(axis=1) & (points[:, 2] < rim - least_depth)
    low = float(np.median(points[floor, 2])) if floor.sum() >= _ENOUGH else bottom + _FLOOR
    turn = np.eye(3)
    turn[:2, :2] = axes
    box = RegionBox(np.append(middle, (low + rim) / 2), turn, np.append(half, (rim - low) / 2), parent=name)
    inner = wall | floor
    return Part(name, "space", kept(cloud, inner), box)


def _wall_distance(local: np.ndarray, normals: np.ndarray, axis: int) -> float:
    """Distance from the middle of the walls that face along an axis; infinite where too little of them is seen."""
    along = np.abs(normals[:, axis]) > 0.8
    return float(np.percentile(np.abs(local[along, axis]), 20)) if along.sum() >= _ENOUGH else np.inf


def _top(name: str, cloud: PointCloud) -> Part | None:
    """The level surface of a fixture that is largest, as a flat box; None if there is none."""
    up = np.flatnonzero(cloud.normals[:, 2] > 0.9)
    if len(up) < _ENOUGH:
        return None
    heights = cloud.points[up, 2]
    near = np.abs(heights[:, None] - heights[None]) < _LEVEL
    level = up[near[near.sum(axis=1).argmax()]]
    level = level[_is_broad(cloud.points[level, :2])]
    if len(level) < _ENOUGH:
        return None
    found = _outline(cloud.points[level, :2])
    if found is None:
        return None
    centre, axes, half = found
    turn = np.eye(3)
    turn[:2, :2] = axes
    height = float(np.median(cloud.points[level, 2]))
    return Part(
        name, "top", kept(cloud, level), RegionBox(np.append(centre, height), turn, np.append(half, 0.001), name)
    )


def _is_broad(xy: np.ndarray) -> np.ndarray:
    """Which of some level points [N, 2] lie in a surface broader than a rim, bool [N]."""
    cell = np.floor((xy - xy.min(axis=0)) / _CELL).astype(int) + 1
    taken = np.zeros(cell.max(axis=0) + 2, bool)
    taken[tuple(cell.T)] = True
    return binary_opening(binary_closing(taken), np.ones((3, 3)))[tuple(cell.T)]


def _open_drawer(name: str, cloud: PointCloud, top: Part, table: float, least: float) -> dict[str, Part]:
    """What sticks out of a fixture's outline, if it is as wide as a drawer; at most one."""
    assert top.box is not None
    local = (cloud.points - top.box.pos) @ top.box.mat
    beyond = (np.abs(local[:, :2]) - top.box.half_extents[:2]).max(axis=1)
    rows = np.flatnonzero((beyond > 0.02) & (local[:, 2] < 0.02))
    if len(rows) < _ENOUGH or beyond[rows].max() < least:
        return {}
    label = clusters(cloud.points[rows], 0.03)
    largest = rows[label == np.bincount(label).argmax()]
    low, high = local[largest].min(axis=0), local[largest].max(axis=0)
    if beyond[largest].max() < least or (high - low)[:2].max() < _DRAWER_WIDTH:
        return {}
    centre = top.box.pos + (low + high) / 2 @ top.box.mat.T
    share = (centre[2] - table) / max(float(top.box.pos[2]) - table, 1e-6)
    level = _LEVELS[int(np.clip(share * 3, 0, 2))]
    box = RegionBox(centre, top.box.mat, (high - low) / 2, parent=name)
    return {f"{name}_{level}_drawer": Part(name, "drawer", kept(cloud, largest), box)}


def _outline(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The smallest rectangle around points [N, 2], None for a line: centre, axes in columns [2, 2], half extents."""
    try:
        corners = xy[ConvexHull(xy).vertices]
    except (QhullError, ValueError):
        return None
    edges = np.roll(corners, -1, axis=0) - corners
    angles = np.unique(np.round(np.arctan2(edges[:, 1], edges[:, 0]) % (np.pi / 2), 4))
    best = None
    for angle in angles:
        axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        local = corners @ axes
        low, high = local.min(axis=0), local.max(axis=0)
        area = float(np.prod(high - low))
        if best is None or area < best[0]:
            best = area, (low + high) / 2 @ axes.T, axes, (high - low) / 2
    return None if best is None else best[1:]
