"""Objects without masks: clusters of points over the table, named by their size and colour.

The views of one slot, the names of what may be there and the memory of the slot come in; the same views with a name for
each pixel go out. The table is the plane that was found, the robot what is connected to its hand or stands at its base,
and every other cluster is one thing. A cluster where a remembered object was is that object. The others get the names
that are left, one each, so that sizes and colours fit the catalogue best (``catalogue.json``, by category; made by
``scripts/object_catalogue.py`` from reference views). A name that nothing fits is not found.

Things that touch are one cluster, equal things are told apart by where they were first found only, and what is flatter
than 8 mm is not told from the table.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from scipy.ndimage import label
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from vecenv.observations import PointCloud
from voxposer.perception import points as clouds
from voxposer.perception.cameras import DepthView
from voxposer.perception.colors import hsv
from voxposer.perception.seen import ROBOT, LabelledView, Proprioception, SceneMemory, table_height

# Lowest height over the table at which something is told from it, metres.
_OVER_TABLE = 0.008
# Edge of the voxels that make up clusters, in pixels at the distance of things: what is further apart is two things.
_PIXELS_APART = 2.0
# A point this close to a remembered one shows the same object, metres.
_SAME = 0.010
# What is this close to the hand, or horizontally to the robot's base, belongs to the robot, metres.
_HAND, _BASE = 0.07, 0.22
# Least number of voxels of a thing.
_LEAST = 8
# A cluster with this share of its points where an object was seen is that object.
_OVERLAP = 0.3
# Costs above this do not fit: the sum of logarithms of three sizes' ratios, and a distance of colours of 0 to 1.
_MISFIT = 0.9
_HUES, _GREYS = 12, 4


@dataclass(frozen=True)
class Appearance:
    """What an object looks like.

    Attributes:
        size: longer and shorter horizontal extent, and height, metres, [3].
        colors: histogram of hues, then of greys, which adds up to 1, [16].
    """

    size: np.ndarray
    colors: np.ndarray

    def cost(self, other: Appearance) -> float:
        """How badly another appearance fits, 0 for the same."""
        sizes = np.abs(np.log(np.maximum(self.size, 0.005) / np.maximum(other.size, 0.005))).sum()
        return float(sizes / 3 + np.abs(self.colors - other.colors).sum() / 2)


def appearance(cloud: np.ndarray, colors: np.ndarray, table: float) -> Appearance:
    """The appearance of seen points [N, 3] with their colours, uint8 [N, 3], over a table at a height, metres."""
    spread = cloud[:, :2] - cloud[:, :2].mean(axis=0)
    _, axes = np.linalg.eigh(spread.T @ spread)
    across, along = np.ptp(spread @ axes, axis=0)
    return Appearance(np.array([along, across, float(cloud[:, 2].max()) - table]), histogram(colors))


def histogram(colors: np.ndarray) -> np.ndarray:
    """Shares of hues of the pixels with a colour, then of brightnesses of those without, of uint8 [N, 3]."""
    hue, saturation, value = hsv(colors[None])
    colored = (saturation > 0.3) & (value > 0.15)
    hues = np.histogram(hue[colored], bins=_HUES, range=(0, 1))[0]
    greys = np.histogram(value[~colored], bins=_GREYS, range=(0, 1))[0]
    return np.concatenate([hues, greys]) / max(len(colors), 1)


def category(name: str) -> str:
    """The category of an instance: its name without its number."""
    return re.sub(r"_\d+$", "", name)


@cache
def catalogue() -> Mapping[str, Appearance]:
    """Appearances by category."""
    text = resources.files("voxposer.perception").joinpath("catalogue.json").read_text(encoding="utf-8")
    return {
        name: Appearance(np.array(entry["size"]), np.array(entry["colors"]))
        for name, entry in json.loads(text)["categories"].items()
    }


class GeometrySegments:
    """Names for pixels by geometry."""

    def label(
        self, views: Sequence[DepthView], names: Sequence[str], memory: SceneMemory, robot: Proprioception
    ) -> list[LabelledView]:
        """The views with a name for each pixel; see the module.

        Raises:
            NotSeen: no table is seen.
        """
        table = memory.table
        if table is None:
            table = table_height(memory.inside(clouds.joined([_all(view) for view in views])))
        above = [self._above(view, table, memory) for view in views]
        points = np.concatenate([view.points[rows] for view, rows in zip(views, above, strict=True)])
        owner = np.concatenate([np.full(int(rows.sum()), i) for i, rows in enumerate(above)])
        colors = np.concatenate([_colors(view)[rows] for view, rows in zip(views, above, strict=True)])
        wanted = [name for name in names if name not in ("", ROBOT)]
        pairs = [(view, rows) for view, rows in zip(views, above, strict=True) if rows.any()]
        size = max((_PIXELS_APART * _pixel_size(view, rows) for view, rows in pairs), default=0.0)
        labels = self._named(points, colors, table, wanted, size, memory, robot)
        known = ("", None, *wanted)
        found = []
        for i, (view, rows) in enumerate(zip(views, above, strict=True)):
            image = np.zeros(rows.shape, int)
            image[rows] = labels[owner == i]
            found.append(LabelledView(view, image, known))
        return found

    def _above(self, view: DepthView, table: float, memory: SceneMemory) -> np.ndarray:
        """Pixels that show something over the table, within the workspace, bool [H, W]."""
        low, high = memory.bounds()
        over = view.points[..., 2] > table + _OVER_TABLE
        inside = ((view.points[..., :2] > low[:2]) & (view.points[..., :2] < high[:2])).all(axis=2)
        return view.valid & over & inside

    def _named(
        self,
        points: np.ndarray,
        colors: np.ndarray,
        table: float,
        names: Sequence[str],
        size: float,
        memory: SceneMemory,
        robot: Proprioception,
    ) -> np.ndarray:
        """Index into ("", None, *names) of each point, int [N]; clusters are made of voxels of a size, metres."""
        labels = np.zeros(len(points), int)
        if not len(points):
            return labels
        cluster = _clusters(points, size)
        own = np.unique(cluster[_near_robot(points, memory.base, robot)])
        labels[np.isin(cluster, own)] = 1
        free = []
        for number in np.unique(cluster[~np.isin(cluster, own)]):
            rows = np.flatnonzero(cluster == number)
            if len(np.unique(np.floor(points[rows] / size), axis=0)) < _LEAST:
                continue
            known = _remembered(points[rows], names, memory)
            labels[rows] = known
            if not known.any():
                free.append(rows)
        held = None if memory.held is None else memory.held[0]
        left = [name for name in names if name not in memory.seen and name != held]
        for rows, name in _assigned(free, left, points, colors, table):
            labels[rows] = 2 + names.index(name)
        return labels


def _assigned(
    free: Sequence[np.ndarray], names: Sequence[str], points: np.ndarray, colors: np.ndarray, table: float
) -> list[tuple[np.ndarray, str]]:
    """Clusters, as rows of points, with the names that fit them best, one each."""
    listed = [name for name in names if name in catalogue() or category(name) in catalogue()]
    if not free or not listed:
        return []
    seen = [appearance(points[rows], colors[rows], table) for rows in free]
    costs = np.array([[catalogue()[category(name)].cost(one) for name in listed] for one in seen])
    pairs = zip(*linear_sum_assignment(costs), strict=True)
    return [(free[i], listed[j]) for i, j in pairs if costs[i, j] < _MISFIT]


def _remembered(points: np.ndarray, names: Sequence[str], memory: SceneMemory) -> np.ndarray:
    """Index of the remembered object at each point of a cluster, counted from 2; all 0 where too few are at any."""
    distances = [
        KDTree(memory.seen[name].points).query(points)[0] if name in memory.seen else np.full(len(points), np.inf)
        for name in names
    ]
    nearest = np.min(distances, axis=0) if distances else np.full(len(points), np.inf)
    if (nearest < _SAME).mean() < _OVERLAP:
        return np.zeros(len(points), int)
    return 2 + np.argmin(distances, axis=0)


def _pixel_size(view: DepthView, rows: np.ndarray) -> float:
    """What a pixel covers at the distance of what some pixels show, metres."""
    return float(np.median(view.depth[rows]) / abs(view.intrinsics[0, 0]))


def _clusters(points: np.ndarray, size: float) -> np.ndarray:
    """Number of the cluster of each of many points: those of voxels that touch belong together."""
    cells = np.floor((points - points.min(axis=0)) / size).astype(int)
    taken = np.zeros(cells.max(axis=0) + 1, bool)
    taken[tuple(cells.T)] = True
    numbers = np.zeros(taken.shape, int)
    label(taken, np.ones((3, 3, 3)), output=numbers)
    return numbers[tuple(cells.T)]


def _near_robot(points: np.ndarray, base: np.ndarray, robot: Proprioception) -> np.ndarray:
    """Points at the hand, over it, or at the robot's base, bool [N]."""
    hand = np.linalg.norm(points - robot.ee_pose[:3], axis=1) < _HAND
    return hand | (np.linalg.norm(points[:, :2] - base, axis=1) < _BASE)


def _all(view: DepthView) -> PointCloud:
    return PointCloud(view.points[view.valid], view.normals[view.valid])


def _colors(view: DepthView) -> np.ndarray:
    assert view.colors is not None, "geometry needs the colours of pixels"
    return view.colors
