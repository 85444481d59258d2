"""VoxPoser's planner and its pushing search in NumPy and SciPy, one slot at a time, to hold ``voxposer`` against.

Written from the description of upstream's ``planners.py``, ``interfaces.py``, ``controllers.py`` and
``dynamics_models.py`` (huangwl18/VoxPoser @ e3a4c9e): the same library calls on the same numbers in the same order,
because a difference in the last bit can decide which of two voxels costs less. Plain and slow on purpose; tests and
benchmarks import it, the package does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.signal import savgol_filter

from voxposer.planning.config import PlannerConfig


def normalize(volume: np.ndarray) -> np.ndarray:
    """Scaled to [0, 1], or as it is when constant."""
    span = volume.max() - volume.min()
    return volume if span == 0 else (volume - volume.min()) / span


def cost_map(target: np.ndarray, obstacle: np.ndarray, config: PlannerConfig) -> np.ndarray:
    """What a voxel costs before the path has been anywhere, [N, N, N] in [0, 1]."""
    far = normalize(np.asarray(distance_transform_edt(1 - target)))
    near = normalize(gaussian_filter(obstacle, sigma=config.obstacle_map_gaussian_sigma))
    return normalize(far * config.target_map_weight + near * config.obstacle_map_weight)


def neighbours(voxel: np.ndarray, size: int, planar: bool) -> np.ndarray:
    """The voxels one step may reach, sorted, [K, 3]."""
    reach = int(2 * size / 100)
    steps = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(steps, steps, [0] if planar else steps, indexing="ij"), axis=-1).reshape(-1, 3)
    offsets = offsets[np.any(offsets != 0, axis=1)]
    return np.unique(np.clip(voxel + offsets, 0, size - 1), axis=0)


def raw_path(start: np.ndarray, cost: np.ndarray, planar: bool, config: PlannerConfig) -> np.ndarray:
    """Greedy descent, [L, 3] voxels."""
    cost, here = cost.copy(), start.copy()
    path = [here]
    for _ in range(config.max_steps):
        around = neighbours(here, len(cost), planar)
        there = around[np.argmin(cost[tuple(around.T)])]
        cost[tuple(here)] += 1
        path.append(there)
        here = there
        around = neighbours(here, len(cost), planar=False)
        if not np.any(cost[tuple(around.T)] < cost[tuple(here)] + config.stop_threshold):
            break
    return np.array(path)


def curvature(path: np.ndarray) -> np.ndarray:
    """Curvature [L] of a path [L, 3], 0 where it stands still."""
    x, y, z = (np.gradient(axis) for axis in path.T)
    xx, yy, zz = np.gradient(x), np.gradient(y), np.gradient(z)
    with np.errstate(all="ignore"):
        bend = np.sqrt((yy * x - xx * y) ** 2 + (zz * x - xx * z) ** 2 + (zz * y - yy * z) ** 2)
        bend = bend / np.power(x**2 + y**2 + z**2, 3 / 2)
    return np.where(np.isnan(bend), 0, bend)


def smooth_and_cut(path: np.ndarray, config: PlannerConfig) -> np.ndarray:
    """Savitzky-Golay, then nothing from shortly before the first sharp bend on."""
    window = min(len(path), config.savgol_window_size)
    path = np.asarray(savgol_filter(path, window, min(config.savgol_polyorder, window - 1), axis=0))
    sharp = np.where(curvature(path)[5:] > config.max_curvature)[0]
    return path[: int(0.9 * (sharp[0] + 5))] if len(sharp) else path


def space_out(path: np.ndarray, size: int, config: PlannerConfig) -> np.ndarray:
    """Drop inner waypoints that lie closer than the wanted spacing."""
    inner = path[1:-1]
    if len(inner) > 1:
        gaps = np.linalg.norm(np.diff(inner, axis=0), axis=1)
        spacing = int(config.target_spacing * size / 100)
        if gaps.sum() > spacing:
            inner = inner[:: max(int(np.round(spacing / gaps.mean())), 1)]
    return np.concatenate([path[:1], inner, path[-1:]])


def end_on_target(path: np.ndarray, target: np.ndarray, planar: bool) -> np.ndarray:
    """Append the nearest target voxel unless the path ends on one."""
    # To nine digits first: a path may end exactly half-way between voxels, and upstream lets LAPACK's rounding choose.
    last = path[-1].round(9).round().clip(0, len(target) - 1).astype(int)
    if target[tuple(last)] != 0:
        return path
    voxels = np.argwhere(target == 1)
    nearest = voxels[np.argmin(np.linalg.norm(voxels - last, axis=1))]
    if planar:
        nearest[2] = last[2]
    return np.append(path, [nearest], axis=0)


def optimize_path(
    start: np.ndarray, target: np.ndarray, obstacle: np.ndarray, object_centric: bool, config: PlannerConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Raw [L, 3] and finished [P, 3] path of one slot, voxel units."""
    raw = raw_path(start, cost_map(target, obstacle, config), object_centric, config)
    path = space_out(smooth_and_cut(raw, config), len(target), config)
    path = end_on_target(path, target, object_centric)
    if object_centric:
        every = config.pushing_skip_per_k
        path = np.concatenate([path[every:-1:every], path[-1:]])
    return raw, path.clip(0, len(target) - 1)


def preprocess_avoidance(
    avoidance: np.ndarray,
    scene: np.ndarray,
    affordance: np.ndarray,
    *,
    movable: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Avoidance plus the scene's occupancy, which is left out near targets and near the thing that moves."""
    size = len(scene)
    scene = scene.astype(float)
    scene[np.asarray(distance_transform_edt(1 - affordance)) < int(0.15 * size)] = 0
    if movable is not None:
        scene[np.asarray(distance_transform_edt(1 - movable)) < int(0.15 * size)] = 0
    elif start is not None:
        reach = int(0.1 * size)
        # Upstream does not clip the lower end, and a negative one selects nothing; the package does.
        box = tuple(slice(max(at - reach, 0), at + reach) for at in start)
        scene[box] = 0
    return np.clip(avoidance + scene, 0, 1)


@dataclass(frozen=True)
class Candidates:
    """Pushes to choose from: contact [S, 3], unit direction [S, 3], distance [S]."""

    contact: np.ndarray
    direction: np.ndarray
    distance: np.ndarray


def sample_pushes(points: np.ndarray, target: np.ndarray, count: int, rng: np.random.Generator) -> Candidates:
    """Contacts from the cloud [M, 3], directions from there to the target, distances between -2 and 9 cm."""
    contact = points[rng.integers(0, len(points), count)]
    way = target - contact
    length = np.linalg.norm(way, axis=1, keepdims=True)
    direction = np.divide(way, length, out=np.zeros_like(way), where=length > 1e-6)
    return Candidates(contact, direction, rng.uniform(-0.02, 0.09, count))


def push_costs(points: np.ndarray, target: np.ndarray, pushes: Candidates, block: int = 2000) -> np.ndarray:
    """Costs [S] as upstream computes them: every sample moves a copy of the whole cloud, then measures its mean."""
    clouds = np.repeat(points[None], len(pushes.distance), axis=0)
    moved = np.concatenate(
        [_push(clouds[at : at + block], pushes, slice(at, at + block)) for at in range(0, len(pushes.distance), block)]
    )
    return np.array([np.linalg.norm(cloud.mean(axis=0) - target) for cloud in moved])


def _push(clouds: np.ndarray, pushes: Candidates, part: slice) -> np.ndarray:
    contact, direction, distance = pushes.contact[part], pushes.direction[part], pushes.distance[part].copy()
    outward = np.sum((clouds.mean(axis=1) - contact) * direction, axis=1) < 0
    distance[outward] = 0
    return clouds + (distance[:, None] * direction)[:, None, :]


@dataclass(frozen=True)
class Problem:
    """What a planner is asked: start [3], target and obstacle [N, N, N], whether an object is moved."""

    start: np.ndarray
    target: np.ndarray
    obstacle: np.ndarray
    object_centric: bool


def random_problem(rng: np.random.Generator, size: int = 100) -> Problem:
    """A start, targets and obstacles of one of several kinds, ties and borders included."""
    obstacle = _OBSTACLES[rng.integers(len(_OBSTACLES))](rng, size)
    target = np.zeros((size,) * 3)
    for _ in range(rng.integers(1, 4)):
        _paint(target, rng, size, int(rng.choice([1, 1, 2, size // 8])))
    return Problem(rng.integers(0, size, 3), target, obstacle, bool(rng.random() < 0.3))


def stack(problems: list[Problem]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The arguments of ``optimize_paths`` for some problems."""
    names = ("start", "target", "obstacle", "object_centric")
    start, target, obstacle, moved = (np.stack([getattr(problem, name) for problem in problems]) for name in names)
    return start, target, obstacle, moved


def _paint(volume: np.ndarray, rng: np.random.Generator, size: int, side: int, value: float = 1.0) -> None:
    corner, extent = rng.integers(0, size, 3), rng.integers(1, side + 1, 3)
    volume[tuple(slice(at, at + by) for at, by in zip(corner, extent, strict=True))] = value


def _nothing(rng: np.random.Generator, size: int) -> np.ndarray:
    return np.zeros((size,) * 3)


def _boxes(rng: np.random.Generator, size: int) -> np.ndarray:
    volume = _nothing(rng, size)
    for _ in range(rng.integers(1, 9)):
        _paint(volume, rng, size, size // 3, float(rng.choice([0.1, 0.5, 1.0])))
    return volume


def _table(rng: np.random.Generator, size: int) -> np.ndarray:
    """Things on a table, symmetric about planes, so that ways to either side cost the same."""
    volume, level = _nothing(rng, size), size // 5
    volume[:, :, level] = 1
    for _ in range(rng.integers(1, 6)):
        x, y = rng.integers(size // 5, size - size // 5, 2)
        wide, high = rng.integers(2, size // 8), rng.integers(2, size // 4)
        volume[x - wide : x + wide + 1, y - wide : y + wide + 1, level : level + high] = 1
    return volume


def _noise(rng: np.random.Generator, size: int) -> np.ndarray:
    return rng.random((size,) * 3) ** 8


_OBSTACLES = (_nothing, _boxes, _boxes, _table, _table, _table, _noise)
