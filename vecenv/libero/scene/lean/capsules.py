"""Capsules in the place of the robot's links and fingers.

In: solids of one body, in that body's frame, metres. Out: one capsule.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vecenv.libero.scene.lean.boxes import bound
from vecenv.libero.scene.lean.solids import Solid, capsule


def long_capsule(solids: Sequence[Solid]) -> Solid:
    """A capsule along the longest side of the solids' box, as long as it, with the mean of its other half sides."""
    around = bound(solids)
    short, middle, long = np.argsort(around.size)
    radius = float(around.size[[short, middle]].mean())
    axis = around.mat[:, long] * max(around.size[long] - radius, 0.0)
    return capsule(around.pos - axis, around.pos + axis, radius)


# The end of a solid is this share of its length; it is an edge, not a tip, when it is that much longer than wide.
_END = 0.25
_EDGE = 1.5


def end_capsule(solids: Sequence[Solid], end: np.ndarray, inner: np.ndarray | None = None) -> Solid:
    """A capsule that fits one end of the solids: as thick as the end is, flush with it, and not beyond its sides.

    Where the end is an edge (a palm) the capsule lies along it; where it is a tip (a finger) it runs to the other end.

    Args:
        solids: the solids that it replaces.
        end: direction of the end, along an axis of the body, [3].
        inner: likewise a side with which a finger is flush all along; None for its middle.
    """
    points = np.concatenate([solid.extreme_points() for solid in solids])
    height = points @ end
    span = height.max() - height.min()
    tip, other = points[height > height.max() - _END * span], points[height < height.min() + _END * span]
    low, high = tip.min(axis=0), tip.max(axis=0)
    lateral = np.flatnonzero(end == 0.0)
    wide, narrow = sorted(lateral, key=lambda axis: low[axis] - high[axis])
    radius = float(high[narrow] - low[narrow]) / 2
    middle = (low + high) / 2 * (end == 0.0) + end * (height.max() - radius)
    if high[wide] - low[wide] > _EDGE * (high[narrow] - low[narrow]):
        along = np.eye(3)[wide] * ((high[wide] - low[wide]) / 2 - radius)
        return capsule(middle - along, middle + along, radius)
    start = (other.min(axis=0) + other.max(axis=0)) / 2 * (end == 0.0) + end * (height.min() + radius)
    if inner is not None:
        start += inner * ((other @ inner).max() - radius - start @ inner)
        middle = middle + inner * ((tip @ inner).max() - radius - middle @ inner)
    return capsule(start, middle, radius)
