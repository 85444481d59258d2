"""Operations on seen points: fusing the views of several cameras, outliers, and simple completion of what is unseen.

In and out: :class:`~vecenv.observations.PointCloud` s, metres, world frame, z up. Nothing here knows names or masks.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from vecenv.observations import PointCloud
from voxposer.perception.cameras import DepthView

# A surface this close to an object, horizontally, is what it stands on, metres.
_BESIDE = 0.03
# Shares of an object's height, from its top, whose middle may be its axis.
_SHARES = (0.2, 0.1, 0.35, 0.5, 0.75, 1.0)
NO_POINTS = PointCloud(np.zeros((0, 3)), np.zeros((0, 3)))


def joined(clouds: Sequence[PointCloud]) -> PointCloud:
    """Several clouds as one."""
    if not clouds:
        return NO_POINTS
    return PointCloud(np.concatenate([c.points for c in clouds]), np.concatenate([c.normals for c in clouds]))


def kept(cloud: PointCloud, rows: np.ndarray) -> PointCloud:
    """Some of a cloud's points, by index or mask."""
    return PointCloud(cloud.points[rows], cloud.normals[rows])


def thinned(cloud: PointCloud, size: float, most: int | None = None) -> PointCloud:
    """One point for each voxel and side: the mean of those that face to the same of six directions.

    The two faces of a thin wall therefore stay apart.

    Args:
        cloud: any number of points.
        size: edge of a voxel, metres; enlarged until at most ``most`` points are left.
        most: of points that are left; None for any number.
    """
    if not len(cloud.points):
        return cloud
    while True:
        small = _thinned(cloud, size)
        if most is None or len(small.points) <= most:
            return small
        size *= 1.15


def _thinned(cloud: PointCloud, size: float) -> PointCloud:
    main = np.abs(cloud.normals).argmax(axis=1)
    side = 2 * main + (np.take_along_axis(cloud.normals, main[:, None], axis=1)[:, 0] > 0)
    keys = np.concatenate([np.floor(cloud.points / size).astype(np.int64), side[:, None]], axis=1)
    _, cell, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(cell, values[:, axis], len(counts)) for axis in range(3)]
        return np.stack(sums, axis=1) / counts[:, None]

    normals = mean(cloud.normals)
    return PointCloud(mean(cloud.points), normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9))


def without_outliers(cloud: PointCloud, radius: float, least_share: float) -> PointCloud:
    """The clusters of a cloud that have at least a share of the largest one's points.

    Args:
        cloud: the cloud.
        radius: points within this distance of each other belong to one cluster, metres.
        least_share: of the number of points of the largest cluster.
    """
    if len(cloud.points) < 2:
        return cloud
    label = clusters(cloud.points, radius)
    counts = np.bincount(label)
    return kept(cloud, counts[label] >= max(least_share * counts.max(), 2))


def clusters(points: np.ndarray, radius: float) -> np.ndarray:
    """Number of the cluster of each point [N, 3], int [N]: chains of points within a distance of each other."""
    pairs = KDTree(points).query_pairs(radius, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    return connected_components(links, directed=False)[1]


def fused(old: PointCloud, new: PointCloud, apart: float) -> PointCloud:
    """The new points, and the old ones farther than a distance from all of them."""
    if not len(old.points) or not len(new.points):
        return new if len(new.points) else old
    away = KDTree(new.points).query(old.points)[0] > apart
    return joined([new, kept(old, away)])


def seen_through(points: np.ndarray, views: Sequence[DepthView], tolerance: float) -> np.ndarray:
    """Which points [N, 3] a camera sees through, so that nothing is there, bool [N]."""
    free = np.zeros(len(points), bool)
    for view in views:
        free |= view.sees_through(points, tolerance)
    return free


def middle_of(points: np.ndarray) -> np.ndarray:
    """Middle of the box around points [N, 3], horizontally, [2]."""
    return (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2


def axis_of(points: np.ndarray, bottom: float, views: Sequence[DepthView], tolerance: float) -> np.ndarray:
    """Where the vertical axis of an object is, about which half a turn changes nothing, [2].

    From a camera above it, the upper side of an object is seen whole and its sides are not. Tried are the middles of
    upper shares of the object, the top alone to all of it; the best turns most points onto seen ones, and fewest to
    where cameras see that nothing is.

    Args:
        points: what is seen of the object, [N, 3].
        bottom: height of what carries it, metres.
        views: of the cameras now.
        tolerance: of distances, metres.
    """
    top, tree = float(points[:, 2].max()), KDTree(points)
    best, middle = -np.inf, middle_of(points)
    for share in _SHARES:
        tried = middle_of(points[points[:, 2] >= top - max(share * (top - bottom), 0.008)])
        turned = _half_turn(points, tried)
        met = tree.query(turned)[0] < tolerance
        score = float(met.mean() - seen_through(turned, views, tolerance).mean())
        if score > best + 0.01:
            best, middle = score, tried
    return middle


def _half_turn(points: np.ndarray, axis: np.ndarray) -> np.ndarray:
    return np.append(2 * axis, 0.0) + points * [-1.0, -1.0, 1.0]


def support_under(points: np.ndarray, others: PointCloud, table: float) -> float:
    """Height of what carries an object, metres.

    It is the highest of other points under its middle; where none are seen, the height of level surfaces around it;
    else the table.

    Args:
        points: of the object, [N, 3].
        others: what is seen of everything else.
        table: its height, metres.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    reach = 0.45 * float((high - low)[:2].min())
    below = kept(others, others.points[:, 2] < low[2] + 0.01)
    under = np.linalg.norm(below.points[:, :2] - (low + high)[:2] / 2, axis=1) < reach
    if under.any():
        return max(table, float(below.points[under, 2].max()))
    level = below.points[below.normals[:, 2] > 0.9]
    if not len(level):
        return table
    beside = KDTree(points[:, :2]).query(level[:, :2])[0] < _BESIDE
    return max(table, float(np.percentile(level[beside, 2], 75))) if beside.any() else table


def completed(cloud: PointCloud, bottom: float, views: Sequence[DepthView], tolerance: float) -> PointCloud:
    """A seen surface with its unseen sides and underside, by two assumptions.

    An object looks the same after half a turn about a vertical axis (:func:`axis_of`); what that adds is left
    out where a camera sees that nothing is there. And it extends straight down to what carries it.

    Args:
        cloud: what is seen of the object.
        bottom: height of what carries it, metres.
        views: of the cameras now.
        tolerance: a camera sees through a point this far in front of what it sees, metres.
    """
    axis = axis_of(cloud.points, bottom, views, tolerance)
    turned = PointCloud(_half_turn(cloud.points, axis), cloud.normals * [-1.0, -1.0, 1.0])
    turned = kept(turned, ~seen_through(turned.points, views, tolerance))
    whole = joined([cloud, turned])
    return joined([whole, _down_to(whole, bottom)])


def _down_to(cloud: PointCloud, bottom: float, step: float = 0.008) -> PointCloud:
    """Walls below the lowest points of the sides, and an underside."""
    low = float(cloud.points[:, 2].min())
    foot = kept(cloud, cloud.points[:, 2] < low + max(0.2 * float(np.ptp(cloud.points[:, 2])), 0.008))
    sides = kept(foot, np.abs(foot.normals[:, 2]) < 0.7)
    layers = [
        PointCloud(np.column_stack([sides.points[:, :2], np.full(len(sides.points), height)]), sides.normals)
        for height in np.arange(bottom, low - step / 2, step)
    ]
    under = np.column_stack([foot.points[:, :2], np.full(len(foot.points), min(bottom, low))])
    return joined([*layers, PointCloud(under, np.tile([0.0, 0.0, -1.0], (len(under), 1)))])
