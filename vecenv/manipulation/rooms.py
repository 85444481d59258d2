"""Room around a hand, and what it carries, at every node of a lattice of its positions: a configuration-space map.

The solids of a hand (:func:`hand_solids`, :func:`load_solids`), its rotation and obstacle points come in. Out comes,
for each position of the grip site on a :class:`Lattice`, the smallest distance between the solids and an obstacle,
negative where they overlap (:func:`room_map`). :func:`dense_surface` fills the gaps between sparse surface samples.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import KDTree

from vecenv.manipulation.grasps import Gripper
from vecenv.observations import PointCloud
from vecenv.util.compiled import compile_function

# Hands whose axis has at most this vertical component point down.
_UPRIGHT = -0.98
# Neighbours of a surface sample between which others are added.
_NEIGHBOURS = 10
# Slices of what a hand carries.
_SLICES = 5


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


def load_solids(points: np.ndarray, axes: np.ndarray, hand: np.ndarray, rotation: np.ndarray) -> list[Solid]:
    """Boxes around what a hand carries: slices across its first axis, each as wide and high as the object is there.

    Args:
        points: its surface, world frame, [N, 3].
        axes: its own axes, along which the boxes lie, columns, world frame, [3, 3].
        hand: position of the grip site, [3].
        rotation: of the hand, [3, 3].
    """
    local, turn = (points - hand) @ axes, rotation.T @ axes
    edges = np.linspace(local[:, 0].min(), local[:, 0].max(), _SLICES + 1)
    solids = []
    for first, last in itertools.pairwise(edges):
        part = local[(local[:, 0] >= first - 1e-9) & (local[:, 0] <= last + 1e-9)]
        if len(part):
            low, high = np.array([first, *part[:, 1:].min(axis=0)]), np.array([last, *part[:, 1:].max(axis=0)])
            solids.append(Solid(turn @ ((low + high) / 2), (high - low) / 2, turn))
    return solids


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
        float32 [lattice.shape], metres: the largest coordinate difference, in a solid's axes, between it and the
        nearest obstacle; at most ``margin``, negative where an obstacle is inside. Coarse solids count within half of
        ``margin``.
    """
    room = np.full(lattice.shape, margin, np.float32)
    # Below the highest obstacle of a column others say nothing more about a palm that comes from above.
    cell = [0.010, 0.010, np.inf] if rotation[2, 2] < _UPRIGHT else [0.010, 0.010, 0.010]
    thinned, fine = _thinned(obstacles, np.array(cell)), _thinned(obstacles, np.full(3, 0.005))
    for solid in solids:
        axes, centre = np.ascontiguousarray(rotation @ solid.axes), rotation @ solid.centre
        points, within = (thinned, margin / 2) if solid.coarse else (fine, margin)
        _kernel()(room, lattice.origin, lattice.step, points, axes, centre, solid.half, float(within))
    return room


def outside(
    points: np.ndarray, solids: Sequence[Solid], position: np.ndarray, rotation: np.ndarray, least: float
) -> np.ndarray:
    """Which points [N, 3] are at least so far from the solids of a hand at a pose ([3] and [3, 3]), bool [N]."""
    free = np.ones(len(points), bool)
    for solid in solids:
        local = (points - position - rotation @ solid.centre) @ (rotation @ solid.axes)
        free &= (np.abs(local) - solid.half).max(axis=1) >= least
    return free


def dense_surface(cloud: PointCloud, pitch: float = 0.011) -> np.ndarray:
    """Surface samples, with more of them between neighbours in a plane that lie farther apart than ``pitch``, [M, 3].

    Nothing is added beyond the samples, so that rims and openings stay where they are.
    """
    points, normals = cloud.points, cloud.normals
    if len(points) <= _NEIGHBOURS:
        return points
    far, near = KDTree(points).query(points, k=_NEIGHBOURS + 1)
    spacing = float(np.median(np.asarray(far)[:, 6])) * np.sqrt(np.pi / 6)
    if spacing < pitch:
        return points
    first, last = np.repeat(np.arange(len(points)), _NEIGHBOURS), np.asarray(near)[:, 1:].ravel()
    apart = np.asarray(far)[:, 1:].ravel()
    way = points[last] - points[first]
    level = np.abs(np.einsum("ij,ij->i", way, normals[first])) < 0.15 * apart + 0.001
    alike = np.einsum("ij,ij->i", normals[first], normals[last]) > 0.9
    chosen = (first < last) & level & alike & (apart > pitch) & (apart < 1.8 * spacing)
    filled = [points]
    for count in range(1, int(1.8 * spacing / pitch) + 1):
        rows = chosen & (apart > count * pitch)
        filled.append(points[first[rows]] + way[rows] * (count * pitch / apart[rows])[:, None])
    return np.concatenate(filled)


def compile_kernels() -> None:
    """As of ``vecenv.manipulation.reach``."""
    _kernel()


def _thinned(points: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """The highest point of each cell of some extents [3]."""
    if not len(points):
        return np.zeros((0, 3))
    descending = points[np.argsort(-points[:, 2], kind="stable")]
    x, y, z = (np.round(descending / cell).astype(np.int64) + (1 << 20)).T
    _, first = np.unique((x << 42) | (y << 21) | z, return_index=True)
    return np.ascontiguousarray(descending[first], float)


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
    signature = numba.void(numba.float32[:, :, ::1], vector, vector, table, table, vector, vector, numba.float64)
    return compile_function(signature, _carve)
