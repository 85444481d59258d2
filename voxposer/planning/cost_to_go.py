"""Cost to go: what is left to pay from every voxel to the goal, when each voxel has a price per metre.

Prices over a lattice come in; a value map goes out whose only local minimum is the goal, so that the planner's greedy
descent follows a cheapest path. The search is A* from the goal towards the start (Hart, Nilsson and Raphael 1968);
voxels that it did not settle have no value.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import numba
import numpy as np

from vecenv.util.compiled import compile_function


def cost_to_go(
    price: np.ndarray, step: np.ndarray, goal: tuple[int, int, int], start: tuple[int, int, int]
) -> np.ndarray:
    """Cost of the cheapest way from each node to the goal.

    Args:
        price: of a metre at each node, positive, float32 [X, Y, Z].
        step: distances of nodes along the axes, metres, [3].
        goal: a node.
        start: a node; nodes that cannot lie on a cheapest way from there may be left out.

    Returns:
        float32 [X, Y, Z], infinite where nothing was found out.
    """
    ends = np.zeros(price.shape, bool)
    ends[start] = True
    return _searched(price, step, goal, ends, start)[0]


def flood(
    price: np.ndarray, step: np.ndarray, start: tuple[int, int, int], ends: np.ndarray
) -> tuple[np.ndarray, float]:
    """Cost of the cheapest way from a node to each other that costs less than the cheapest of some ends.

    Args:
        price: of a metre, positive, float32 [X, Y, Z].
        step: distances of nodes, metres, [3].
        start: a node.
        ends: bool [X, Y, Z].

    Returns:
        Costs float32 [X, Y, Z], infinite beyond; and the cost of the cheapest end, infinite if there is none.
    """
    return _searched(price, step, start, ends, None)


def _searched(
    price: np.ndarray,
    step: np.ndarray,
    source: tuple[int, int, int],
    ends: np.ndarray,
    aim: tuple[int, int, int] | None,
) -> tuple[np.ndarray, float]:
    value = np.full(price.shape, np.inf, np.float32)
    prices = np.ascontiguousarray(price, np.float32)
    ahead = 0.0 if aim is None else float(prices.min())
    towards = np.array(source if aim is None else aim)
    found = _kernel()(
        prices, np.asarray(step, float), np.array(source), np.ascontiguousarray(ends), towards, ahead, value
    )
    return value, float(found)


@numba.njit(error_model="numpy", nogil=True, inline="always")
def _push(keys: np.ndarray, nodes: np.ndarray, count: int, key: float, node: int) -> int:
    i = count
    while i > 0 and keys[(i - 1) // 2] > key:
        keys[i], nodes[i] = keys[(i - 1) // 2], nodes[(i - 1) // 2]
        i = (i - 1) // 2
    keys[i], nodes[i] = key, node
    return count + 1


@numba.njit(error_model="numpy", nogil=True, inline="always")
def _pop(keys: np.ndarray, nodes: np.ndarray, count: int) -> int:
    """Remove the first entry of the heap, which the caller has read; the number that is left."""
    count -= 1
    key, node, i = keys[count], nodes[count], 0
    while True:
        child = 2 * i + 1
        if child >= count:
            break
        if child + 1 < count and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i], nodes[i] = keys[child], nodes[child]
        i = child
    keys[i], nodes[i] = key, node
    return count


def _search(
    price: np.ndarray,
    step: np.ndarray,
    source: np.ndarray,
    ends: np.ndarray,
    aim: np.ndarray,
    ahead: float,
    value: np.ndarray,
) -> float:
    """Settle nodes in ascending cost plus ``ahead`` a metre to ``aim``, up to the first end; its cost."""
    nx, ny, nz = price.shape
    keys, nodes = np.empty(1 << 16, np.float32), np.empty(1 << 16, np.int64)
    done = np.zeros(price.shape, np.bool_)
    value[source[0], source[1], source[2]] = 0
    count = _push(keys, nodes, 0, 0.0, (source[0] * ny + source[1]) * nz + source[2])
    found = np.inf
    while count:
        node = nodes[0]
        count = _pop(keys, nodes, count)
        z, y, x = node % nz, node // nz % ny, node // (nz * ny)
        if done[x, y, z]:
            continue
        done[x, y, z] = True
        here, own = value[x, y, z], price[x, y, z]
        if ends[x, y, z]:
            found = float(here)
            break
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    i, j, k = x + dx, y + dy, z + dz
                    if not (0 <= i < nx and 0 <= j < ny and 0 <= k < nz) or done[i, j, k]:
                        continue
                    far = np.sqrt((dx * step[0]) ** 2 + (dy * step[1]) ** 2 + (dz * step[2]) ** 2)
                    cost = np.float32(here + far * (own + price[i, j, k]) / 2)
                    if cost < value[i, j, k]:
                        value[i, j, k] = cost
                        a, b, c = (i - aim[0]) * step[0], (j - aim[1]) * step[1], (k - aim[2]) * step[2]
                        if count == len(keys):
                            keys, nodes = np.concatenate((keys, keys)), np.concatenate((nodes, nodes))
                        left = ahead * np.sqrt(a * a + b * b + c * c)
                        count = _push(keys, nodes, count, cost + left, (i * ny + j) * nz + k)
    for x in range(nx):
        for y in range(ny):
            for z in range(nz):
                if not done[x, y, z]:
                    value[x, y, z] = np.inf
    return found


@functools.cache
def _kernel() -> Callable[..., float]:
    volume, vector, node = numba.float32[:, :, ::1], numba.float64[::1], numba.int64[::1]
    ends = numba.boolean[:, :, ::1]
    return compile_function(numba.float64(volume, vector, node, ends, node, numba.float64, volume), _search)
