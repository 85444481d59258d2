"""Room around a hand, and what it carries, at every node of a lattice of its positions: a configuration-space map.

The solids of a hand (:func:`hand_solids`, :func:`load_solid`), its rotation and obstacle points come in. Out comes, for
each position of the grip site on a :class:`Lattice`, the smallest distance between the solids and an obstacle, negative
where they overlap (:func:`room_map`). :func:`dense_surface` fills the gaps between sparse surface samples.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import cKDTree

from vecenv.manipulation.grasps import Gripper
from vecenv.observations import PointCloud
from vecenv.util.compiled import compile_function


@dataclass(frozen=True)
class Solid:
    """A box fixed to a hand.

    Attributes:
        centre: in the hand's frame, metres, [3].
        half: half extents, [3].
        axes: columns are the box's axes in the hand's frame, [3, 3].
        coarse: it is so large that thinned obstacle points are enough.
    """

    centre: np.ndarray
    half: np.ndarray
    axes: np.ndarray
    coarse: bool = False


@dataclass(frozen=True)
class Lattice:
    """Positions of the grip site: ``origin`` [3] of the first, distances ``step`` [3], metres, and their ``shape``."""

    origin: np.ndarray
    step: np.ndarray
    shape: tuple[int, int, int]

    def index(self, position: np.ndarray) -> tuple[int, int, int]:
        """The node nearest to a position [3]; at the border for positions outside."""
        node = np.clip(np.round((position - self.origin) / self.step), 0, np.array(self.shape) - 1)
        return int(node[0]), int(node[1]), int(node[2])

    def shifted(self, shift: np.ndarray) -> Lattice:
        """The lattice moved by ``shift`` [3]."""
        return Lattice(self.origin + shift, self.step, self.shape)


def hand_solids(gripper: Gripper, *, opening: float | None = None, reach: float = 0.28) -> list[Solid]:
    """Fingers, palm and wrist of a hand; as in ``grasps.room_around``.

    Args:
        gripper: the gripper.
        opening: distance between the pads of a closed hand, metres; None for the open hand.
        reach: of the hand and wrist behind the grip site.
    """
    tip, width, thick = gripper.tip, gripper.finger_half_width, (gripper.half_reach - gripper.half_opening) / 2
    inner = gripper.half_opening if opening is None else opening / 2
    fingers = [
        _box((-width, sign * (inner + thick) - thick, -gripper.palm), (width, sign * (inner + thick) + thick, tip))
        for sign in (-1, 1)
    ]
    along, across = gripper.palm_half
    back = min(gripper.wrist, reach)
    solids = [*fingers, _box((-across, -along, -back), (across, along, -gripper.palm), coarse=True)]
    if back < reach:
        along, across = gripper.wrist_half
        solids.append(_box((-across, -along, -reach), (across, along, -back), coarse=True))
    return solids


def _box(low: Sequence[float], high: Sequence[float], *, coarse: bool = False) -> Solid:
    lower, upper = np.array(low), np.array(high)
    return Solid((lower + upper) / 2, (upper - lower) / 2, np.eye(3), coarse)


def load_solid(points: np.ndarray, axes: np.ndarray, hand: np.ndarray, rotation: np.ndarray) -> Solid:
    """The box around what a hand carries.

    Args:
        points: its surface, world frame, [N, 3].
        axes: its own axes, along which the box lies, columns, world frame, [3, 3].
        hand: position of the grip site, [3].
        rotation: of the hand, [3, 3].
    """
    local = (points - hand) @ axes
    low, high = local.min(axis=0), local.max(axis=0)
    return Solid(rotation.T @ axes @ ((low + high) / 2), (high - low) / 2, rotation.T @ axes)


def lowest(solids: Sequence[Solid], rotation: np.ndarray) -> float:
    """Height of the lowest point of solids relative to the grip site, metres."""
    bottoms = []
    for solid in solids:
        axes = rotation @ solid.axes
        bottoms.append(float((rotation @ solid.centre)[2] - np.abs(axes[2]) @ solid.half))
    return min(bottoms)


def room_map(
    lattice: Lattice, solids: Sequence[Solid], rotation: np.ndarray, obstacles: np.ndarray, margin: float
) -> np.ndarray:
    """Room around a hand at each node of a lattice.

    Args:
        lattice: positions of the grip site.
        solids: the hand, and what it carries.
        rotation: of the hand, [3, 3].
        obstacles: points [N, 3], metres, world frame.
        margin: room beyond this is not told apart.

    Returns:
        float32 [lattice.shape], metres: the largest coordinate difference, in a solid's axes, between it and the nearest
        obstacle; at most ``margin``, negative where an obstacle is inside.
    """
    room = np.full(lattice.shape, margin, np.float32)
    thinned = _thinned(obstacles, 0.010)
    fine = _thinned(obstacles, 0.004)
    for solid in solids:
        axes, centre = np.ascontiguousarray(rotation @ solid.axes), rotation @ solid.centre
        points = thinned if solid.coarse else fine
        _kernel()(room, lattice.origin, lattice.step, points, axes, centre, solid.half, float(margin))
    return room


def dense_surface(cloud: PointCloud, pitch: float = 0.011) -> np.ndarray:
    """Surface samples, with more of them in the tangent planes where they lie farther apart than ``pitch``, [M, 3]."""
    points, normals = cloud.points, cloud.normals
    if len(points) < 8:
        return points
    far = cKDTree(points).query(points, k=7)[0][:, -1]
    spacing = float(np.median(far)) * np.sqrt(np.pi / 6)
    reach = 0.55 * spacing
    count = int(reach / pitch)
    if not count:
        return points
    ticks = np.arange(-count, count + 1) * pitch
    u, v = (grid.ravel() for grid in np.meshgrid(ticks, ticks))
    near = np.hypot(u, v) <= reach
    side = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    up = np.cross(normals, side)
    spread = u[near][:, None, None] * side + v[near][:, None, None] * up
    return (points + spread).reshape(-1, 3)


def _thinned(points: np.ndarray, size: float) -> np.ndarray:
    """One point of each cube."""
    if not len(points):
        return np.zeros((0, 3))
    _, first = np.unique(np.round(points / size).astype(np.int64), axis=0, return_index=True)
    return np.ascontiguousarray(points[first], float)


def _carve(
    room: np.ndarray,
    origin: np.ndarray,
    step: np.ndarray,
    points: np.ndarray,
    axes: np.ndarray,
    centre: np.ndarray,
    half: np.ndarray,
    margin: float,
) -> None:
    """Lower ``room`` [X, Y, Z] to the distances between points and one box, at the nodes within ``margin`` of it."""
    first, last, local = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3)
    for n in range(len(points)):
        inside = True
        for d in range(3):
            extent = 0.0
            for k in range(3):
                extent += abs(axes[d, k]) * (half[k] + margin)
            middle = points[n, d] - centre[d] - origin[d]
            first[d] = max(int(np.ceil((middle - extent) / step[d])), 0)
            last[d] = min(int(np.floor((middle + extent) / step[d])), room.shape[d] - 1)
            inside &= first[d] <= last[d]
        if not inside:
            continue
        a, b, c = axes[2, 0] * step[2], axes[2, 1] * step[2], axes[2, 2] * step[2]
        for i in range(first[0], last[0] + 1):
            dx = points[n, 0] - centre[0] - origin[0] - i * step[0]
            for j in range(first[1], last[1] + 1):
                dy = points[n, 1] - centre[1] - origin[1] - j * step[1]
                dz = points[n, 2] - centre[2] - origin[2] - first[2] * step[2]
                for k in range(3):
                    local[k] = axes[0, k] * dx + axes[1, k] * dy + axes[2, k] * dz
                x, y, z = local[0], local[1], local[2]
                for m in range(first[2], last[2] + 1):
                    apart = max(abs(x) - half[0], abs(y) - half[1], abs(z) - half[2])
                    if apart < room[i, j, m]:
                        room[i, j, m] = apart
                    x, y, z = x - a, y - b, z - c


@functools.cache
def _kernel() -> Callable[..., None]:
    vector, table = numba.float64[::1], numba.float64[:, ::1]
    signature = numba.void(
        numba.float32[:, :, ::1], vector, vector, table, table, vector, vector, numba.float64
    )
    return compile_function(signature, _carve)
