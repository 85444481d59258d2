"""The raw paths of ``planner`` on a CPU: the same cost volumes and the same descent, as loops that numba compiles.

In: NumPy arrays, B slots. Out: raw paths, lengths and faults, and the targets that paths end on. The voxels are those
of ``planner``'s JAX functions and of SciPy: distances are exact, and each sum is taken in the same order, without
fast-math and fused multiplication.

Faster than XLA's loops for three reasons. A blur goes through the volume plane by plane, which stays in a core's
cache. Rows in which nothing is occupied are skipped, exactly, since they would add zero. And each core works on
a different slot.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numba
import numpy as np

from vecenv.util.compiled import compile_function, part
from vecenv.util.cores import usable_cores
from voxposer.planning import maps
from voxposer.planning.config import Fault, PlannerConfig, neighbour_offsets

# Rows of the volume blurred together: longer inner loops, and still in a core's cache.
_STRIP = 4


def descend(
    start: np.ndarray, target: np.ndarray, obstacle: np.ndarray, planar: np.ndarray, config: PlannerConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Raw paths.

    Args:
        start: [B, 3]; rounded and moved into the grid.
        target: [B, N, N, N], targets equal 1.
        obstacle: [B, N, N, N].
        planar: bool [B], the path keeps its height.
        config: the planner's numbers.

    Returns:
        Voxels int32 [B, max_steps + 1, 3], the last one repeated; lengths int32 [B]; ``Fault`` int32 [B].
    """
    slots, size = len(start), target.shape[-1]
    raw = np.zeros((slots, config.max_steps + 1, 3), np.int32)
    length, fault = np.ones(slots, np.int32), np.zeros(slots, np.int32)
    finite = np.asarray(np.isfinite(start).all(-1))
    raw[:] = np.clip(np.round(np.where(finite[:, None], start, 0)), 0, size - 1)[:, None]
    kernels, half = _kernels(), maps.gaussian_weights(config.obstacle_map_gaussian_sigma)
    weights = float(config.target_map_weight), float(config.obstacle_map_weight)
    offsets, fold = neighbour_offsets(size), _fold(size, len(half) - 1)

    def one(i: int) -> None:
        wanted = np.ascontiguousarray(target[i], np.float64)
        avoided = np.ascontiguousarray(obstacle[i], np.float64)
        cost = np.empty((size, size, size))
        fault[i] = kernels.cost(wanted, avoided, half, fold, *weights, cost) if finite[i] else Fault.NOT_FINITE
        if fault[i] == Fault.NONE:
            length[i] = kernels.walk(cost, raw[i], bool(planar[i]), offsets, float(config.stop_threshold))

    _over_cores(one, slots)
    return raw, length, fault


def walk(cost: np.ndarray, raw: np.ndarray, config: PlannerConfig) -> int:
    """Descend a cost volume.

    Args:
        cost: [N, N, N], left as it is.
        raw: int32 [L, 3], the start in its first row; the voxels of the path are written into it.
        config: the planner's numbers.

    Returns:
        The number of voxels.
    """
    volume = np.array(cost, np.float64, order="C")
    return _kernels().walk(volume, raw, False, neighbour_offsets(cost.shape[-1]), float(config.stop_threshold))


def ends(target: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The target voxels int32 [B, 3] nearest to ``last`` [B, 3], and whether paths have to be led there, bool [B]."""
    size = target.shape[-1]
    voxel = np.clip(np.round(last), 0, size - 1).astype(np.int64)
    end, snap = np.zeros((len(last), 3), np.int32), np.zeros(len(last), bool)
    kernel = _kernels().nearest

    def one(i: int) -> None:
        snap[i] = target[i][tuple(voxel[i])] == 0
        if snap[i]:
            kernel(np.ascontiguousarray(target[i], np.float64), voxel[i], end[i])

    _over_cores(one, len(last))
    return end, snap


def _fold(size: int, radius: int) -> np.ndarray:
    """Which sample lies at -radius to size + radius when a line is reflected at its ends, [size + 2 radius]."""
    at = np.arange(-radius, size + radius) % (2 * size)
    return np.where(at < size, at, 2 * size - 1 - at)


def _over_cores(work: Callable[[int], None], slots: int) -> None:
    threads = min(usable_cores(), slots)
    if threads <= 1:
        for i in range(slots):
            work(i)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, range(slots)))


# ----------------------------------------------------------------------------------------------------------------------
# Kernels, compiled when first called. numba widens small integers, so distances are float32, exact up to 2^24.


@part
def _finite(volume: np.ndarray) -> bool:
    broken = 0
    for value in volume.ravel():
        # NaN for NaN and infinity, which equals nothing.
        broken |= int(value - value != 0)
    return broken == 0


@part
def _blur(volume: np.ndarray, half: np.ndarray, fold: np.ndarray, out: np.ndarray) -> None:
    """``gaussian_blur`` of [N, N, N]: axis 0, then 1, then 2; ``fold`` [N + 2 radius] says where samples are."""
    n = volume.shape[0]
    low, high = _occupied_heights(volume)
    across, live, taps = high - low, np.empty(n, np.bool_), np.empty(len(half), np.int64)
    # Heights at which everything is zero stay zero until axis 2 is blurred.
    slab, strip, plane = np.empty((n, n, across)), np.empty((n, _STRIP * across)), np.empty((n, across))
    for x in range(n):
        for y in range(n):
            for z in range(across):
                slab[x, y, z] = volume[x, y, low + z]
    flat = slab.reshape(n, n * across)
    for first in range(0, flat.shape[1], strip.shape[1]):
        columns = min(strip.shape[1], flat.shape[1] - first)
        if _find_live(flat, first, columns, live):
            _blur_rows(flat, first, columns, half, fold, live, taps, strip)
            for x in range(n):
                for c in range(columns):
                    flat[x, first + c] = strip[x, c]
    turned, line = np.zeros((n, n)), np.empty((n, n))
    for x in range(n):
        if _find_live(slab[x], 0, across, live):
            _blur_rows(slab[x], 0, across, half, fold, live, taps, plane)
            for y in range(n):
                for z in range(across):
                    turned[low + z, y] = plane[y, z]
            _find_live(turned, 0, n, live)
            _blur_rows(turned, 0, n, half, fold, live, taps, line)
            for y in range(n):
                for z in range(n):
                    out[x, y, z] = line[z, y]
        else:
            for y in range(n):
                for z in range(n):
                    out[x, y, z] = 0.0


@part
def _blur_rows(
    source: np.ndarray,
    first: int,
    columns: int,
    half: np.ndarray,
    fold: np.ndarray,
    live: np.ndarray,
    taps: np.ndarray,
    out: np.ndarray,
) -> None:
    """Correlate some columns of ``source`` [n, m] along axis 0 into ``out`` [n, columns], outermost taps first.

    ``live`` [n] says which rows are not all zero; the others are left out. ``taps`` [radius + 1] is scratch.
    """
    radius, last = len(half) - 1, first + columns
    for i in range(out.shape[0]):
        centre, count = i + radius, 0
        for k in range(radius, 0, -1):
            if live[fold[centre - k]] or live[fold[centre + k]]:
                taps[count] = k
                count += 1
        row, here = out[i], source[i, first:last]
        for c in range(columns):
            row[c] = here[c] * half[0]
        whole = count - count % 4
        # Four at a time: the running sum stays in a register.
        for at in range(0, whole, 4):
            p, q, r, s = taps[at], taps[at + 1], taps[at + 2], taps[at + 3]
            p0, p1 = source[fold[centre - p], first:last], source[fold[centre + p], first:last]
            q0, q1 = source[fold[centre - q], first:last], source[fold[centre + q], first:last]
            r0, r1 = source[fold[centre - r], first:last], source[fold[centre + r], first:last]
            s0, s1 = source[fold[centre - s], first:last], source[fold[centre + s], first:last]
            u, v, w, x = half[p], half[q], half[r], half[s]
            for c in range(columns):
                total = row[c] + (p0[c] + p1[c]) * u
                total = total + (q0[c] + q1[c]) * v
                total = total + (r0[c] + r1[c]) * w
                row[c] = total + (s0[c] + s1[c]) * x
        for at in range(whole, count):
            p = taps[at]
            p0, p1, u = source[fold[centre - p], first:last], source[fold[centre + p], first:last], half[p]
            for c in range(columns):
                row[c] += (p0[c] + p1[c]) * u


@part
def _find_live(source: np.ndarray, first: int, columns: int, live: np.ndarray) -> bool:
    """Write which rows of some columns of ``source`` [n, m] are not all zero; whether any is not."""
    some = False
    for i in range(len(live)):
        count, row = 0, source[i, first : first + columns]
        for c in range(columns):
            count += int(row[c] != 0)
        live[i] = count > 0
        some |= count > 0
    return some


@part
def _occupied_heights(volume: np.ndarray) -> Any:
    """First index along the last axis with something other than zero, and one more than the last such index."""
    n = volume.shape[0]
    some = np.zeros(n, np.int8)
    for x in range(n):
        for y in range(n):
            for z in range(n):
                some[z] |= np.int8(volume[x, y, z] != 0)
    low, high = 0, n
    while low < n - 1 and not some[low]:
        low += 1
    while high > low + 1 and not some[high - 1]:
        high -= 1
    return low, high


@part
def _squares(target: np.ndarray, out: np.ndarray) -> bool:
    """``squared_distance`` to the voxels of [N, N, N] that equal 1; False if there are none."""
    n = target.shape[0]
    planes, rows, columns = np.zeros(n, np.bool_), np.zeros(n, np.bool_), _STRIP * n
    lines, strip = np.empty((n, n), np.float32), np.empty((n, columns), np.float32)
    for x in range(n):
        for y in range(n):
            rows[y] = _line_squares(target[x, y], lines[y])
            planes[x] |= rows[y]
        if rows.any():
            _spread(lines, 0, n, rows, out[x])
    flat = out.reshape(n, n * n)
    for first in range(0, n * n, columns):
        count = min(columns, n * n - first)
        _spread(flat, first, count, planes, strip)
        for x in range(n):
            for c in range(count):
                flat[x, first + c] = strip[x, c]
    return bool(planes.any())


@part
def _line_squares(target: np.ndarray, out: np.ndarray) -> bool:
    """Squared distances along a line [n]; False, and nothing written, without a target on it."""
    last, n = -1, len(out)
    for z in range(n):
        if target[z] == 1:
            for back in range(0 if last == -1 else (last + z + 1) // 2, z):
                out[back] = (z - back) * (z - back)
            last = z
        if last != -1:
            out[z] = (z - last) * (z - last)
    return last != -1


@part
def _spread(rows: np.ndarray, first: int, columns: int, live: np.ndarray, out: np.ndarray) -> None:
    """``out[i] = min over live j of rows[j] + (i - j)²`` for some columns of ``rows`` [n, m]; ``out`` [n, columns]."""
    for i in range(out.shape[0]):
        best = out[i]
        for c in range(columns):
            best[c] = np.float32(np.inf)
        for j in range(len(live)):
            if not live[j]:
                continue
            step, row = np.float32((i - j) * (i - j)), rows[j, first : first + columns]
            for c in range(columns):
                there = row[c] + step
                best[c] = there if there < best[c] else best[c]


def _cost(
    target: np.ndarray,
    obstacle: np.ndarray,
    half: np.ndarray,
    fold: np.ndarray,
    weight: float,
    obstacle_weight: float,
    out: np.ndarray,
) -> int:
    """``cost_map`` into ``out`` [N, N, N], or why there is none."""
    n = out.shape[0]
    if not (_finite(target) and _finite(obstacle)):
        return 2
    squares = np.empty((n, n, n), np.float32)
    if not _squares(target, squares):
        return 1
    _blur(obstacle, half, fold, out)
    lows, highs, fars = np.full(n, np.inf), np.full(n, -np.inf), np.zeros(n, np.float32)
    for x in range(n):
        for y in range(n):
            for z in range(n):
                a, b = out[x, y, z], squares[x, y, z]
                lows[z] = a if a < lows[z] else lows[z]
                highs[z] = a if a > highs[z] else highs[z]
                fars[z] = b if b > fars[z] else fars[z]
    # A constant map stays as it is.
    farthest = math.sqrt(max(np.float64(fars.max()), 1.0))
    shift = lows.min() if highs.max() != lows.min() else 0.0
    span = highs.max() - lows.min() if highs.max() != lows.min() else 1.0
    lows[:], highs[:] = np.inf, -np.inf
    for x in range(n):
        for y in range(n):
            for z in range(n):
                distance = math.sqrt(np.float64(squares[x, y, z])) / farthest
                total = distance * weight + (out[x, y, z] - shift) / span * obstacle_weight
                out[x, y, z] = total
                lows[z] = total if total < lows[z] else lows[z]
                highs[z] = total if total > highs[z] else highs[z]
    least, most = lows.min(), highs.max()
    if most != least:
        for x in range(n):
            for y in range(n):
                for z in range(n):
                    out[x, y, z] = (out[x, y, z] - least) / (most - least)
    return 0


def _walk(cost: np.ndarray, raw: np.ndarray, planar: bool, offsets: np.ndarray, threshold: float) -> int:
    """``_descend`` for one slot: writes the path into ``raw`` [L, 3], whose first row is the start, and ``cost``."""
    length = 1
    here = np.empty(3, np.int64)
    while length < len(raw):
        for axis in range(3):
            here[axis] = raw[length - 1, axis]
        choice, _ = _cheapest(cost, here, planar, offsets)
        cost[here[0], here[1], here[2]] += 1
        for axis in range(3):
            here[axis] += offsets[choice, axis]
            raw[length, axis] = here[axis]
        length += 1
        _, least = _cheapest(cost, here, False, offsets)
        if not least < cost[here[0], here[1], here[2]] + threshold:
            break
    for i in range(length, len(raw)):
        for axis in range(3):
            raw[i, axis] = here[axis]
    return length


@part
def _cheapest(cost: np.ndarray, here: np.ndarray, planar: bool, offsets: np.ndarray) -> Any:
    """First of the cheapest neighbours, as a row of ``offsets``, and its cost."""
    size, choice, least = cost.shape[0], -1, np.inf
    # A voxel at a border is its own neighbour, because offsets that leave the grid are clipped to it.
    own = False
    for axis in range(2 if planar else 3):
        own |= here[axis] == 0 or here[axis] == size - 1
    for k in range(len(offsets)):
        x, y, z = here[0] + offsets[k, 0], here[1] + offsets[k, 1], here[2] + offsets[k, 2]
        inside = 0 <= x < size and 0 <= y < size and 0 <= z < size
        if not inside or (planar and offsets[k, 2] != 0) or (k == len(offsets) // 2 and not own):
            continue
        if cost[x, y, z] < least:
            choice, least = k, cost[x, y, z]
    return choice, least


def _nearest(target: np.ndarray, voxel: np.ndarray, end: np.ndarray) -> None:
    """Write the first of the target voxels nearest to ``voxel`` into ``end``; nothing if there is none."""
    size, least = target.shape[0], 3 * target.shape[0] ** 2
    for x in range(size):
        for y in range(size):
            across = (x - voxel[0]) ** 2 + (y - voxel[1]) ** 2
            if across >= least:
                continue
            for z in range(size):
                squared = across + (z - voxel[2]) ** 2
                if squared < least and target[x, y, z] == 1:
                    least = squared
                    end[0], end[1], end[2] = x, y, z


class _Kernels(NamedTuple):
    cost: Callable[..., int]
    walk: Callable[..., int]
    nearest: Callable[..., None]


@functools.cache
def _kernels() -> _Kernels:
    """Compiled once a machine, in about ten seconds, and read from numba's cache afterwards."""
    volume, f8, i8 = numba.float64[:, :, ::1], numba.float64, numba.int64
    raw, offsets, voxel = numba.int32[:, ::1], numba.int64[:, ::1], numba.int64[::1]
    return _Kernels(
        compile_function(i8(volume, volume, numba.float64[::1], numba.int64[::1], f8, f8, volume), _cost),
        compile_function(i8(volume, raw, numba.boolean, offsets, f8), _walk),
        compile_function(numba.void(volume, voxel, numba.int32[::1]), _nearest),
    )
