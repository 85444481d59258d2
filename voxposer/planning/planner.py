# ruff: noqa: F722  (shapes in annotations)
"""The path planner: greedy descent through a cost volume, smoothed, cut, spaced out and ended on a target.

In, for each slot: the voxel to start from, a target map, an obstacle map, and whether an object is to be moved rather
than the hand. Out: ``Paths``, voxel units, padded tensors with their lengths. It is the planner of VoxPoser
(huangwl18/VoxPoser @ e3a4c9e, ``planners.py``), one slot as exact as the other: the raw path visits the same voxels as
NumPy and SciPy's would, which takes float64, SciPy's order of summation and NumPy's first of several minima.

``optimize_paths`` is one jitted function for any device, and may be traced into a larger one, if that is compiled with
float64 enabled (JAX cannot lower float64 within a float32 function). Called with concrete arrays on a CPU it does the
descent in ``planner_numba``, which finds the same voxels several times faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, Num, Shaped

from voxposer.planning import maps, planner_numba
from voxposer.planning.config import Fault, PlannerConfig, neighbour_offsets, reach

# A bend sharper than ``max_curvature`` counts from this waypoint on, and the path ends at this share of the way to it.
_FIRST_BEND = 5
_KEPT_OF_BEND = 0.9
# From this size on a step of 2 % of the side is a voxel or more.
_SMALLEST_GRID = 50
# Slots whose maps are in memory at once, outside a CPU.
_SLOTS_AT_ONCE = 64

Result = TypeVar("Result")


class Paths(NamedTuple):
    """What ``optimize_paths`` returns, voxel units; behind its length a path repeats its last entry.

    Attributes:
        raw: voxels of the descent, the start first, int32 [B, max_steps + 1, 3].
        raw_length: how many there are, int32 [B]; 0 for a slot with a fault.
        path: waypoints, float32 [B, max_steps + 2, 3], within the grid.
        path_length: how many there are, int32 [B]; 0 for a slot with a fault.
        fault: ``Fault`` of each slot, int32 [B].
    """

    raw: Int[Array, "B steps 3"]
    raw_length: Int[Array, " B"]
    path: Float[Array, "B waypoints 3"]
    path_length: Int[Array, " B"]
    fault: Int[Array, " B"]


def optimize_paths(
    start: Num[maps.AnyArray, "B 3"],
    target: Shaped[maps.AnyArray, "B N N N"],
    obstacle: Shaped[maps.AnyArray, "B N N N"],
    object_centric: Shaped[maps.AnyArray, " B"],
    config: PlannerConfig = PlannerConfig(),  # noqa: B008  (frozen)
    *,
    engine: Literal["auto", "jax", "numba"] = "auto",
) -> Paths:
    """A path for every slot.

    Args:
        start: voxel to start from, [B, 3]; rounded and moved into the grid if need be.
        target: [B, N, N, N] with N >= 50; targets are the voxels equal to 1.
        obstacle: [B, N, N, N], what to keep away from (``maps.preprocess_avoidance``). Give float64 where the values
            are not exact in float32: the last bits decide between equally good ways.
        object_centric: bool [B], an object is pushed: the path keeps the start's height, and skips waypoints.
        config: the planner's numbers.
        engine: ``"jax"``: one jitted function, on the device of its arguments. ``"numba"``: the descent as compiled
            loops on the CPU's cores. ``"auto"``: numba for concrete arrays if JAX runs on a CPU, otherwise JAX.

    Returns:
        The paths. A slot without a target or with a map that is not finite has length 0 and says so in ``fault``; the
        others are not affected.

    Raises:
        ValueError: shapes that don't fit together, a grid too small to have neighbours, or tracing without float64.
    """
    arrays = _checked(start, target, obstacle, object_centric)
    traced = any(isinstance(array, Tracer) for array in arrays)
    if engine == "numba" and traced:
        raise ValueError("the numba engine needs concrete arrays, not traced ones")
    if traced and jnp.zeros(0).dtype != jnp.float64:
        raise ValueError("optimize_paths is float64: trace functions that call it within jax.enable_x64(True)")
    # Only what happens in here is float64; the caller's own precision stays what it was.
    with jax.enable_x64(True):
        if engine == "numba" or (engine == "auto" and not traced and _on_cpu(arrays)):
            return _with_numba(*arrays, config)
        return _with_jax(*arrays, config)


def descend_value(
    start: np.ndarray, value: np.ndarray, config: PlannerConfig
) -> tuple[Int[np.ndarray, "steps 3"], Float[np.ndarray, "waypoints 3"]]:
    """The planner's descent of a map that is a cost already, such as a cost to go, and its smoothed path.

    Args:
        start: voxel to start from, [3].
        value: what each voxel costs, [N, N, N], finite; about 1 at the start and least at the goal.
        config: the planner's numbers. The path is neither cut before bends nor led to a target.

    Returns:
        Voxels of the descent, and waypoints.
    """
    raw = np.tile(np.asarray(start, np.int32), (config.max_steps + 1, 1))
    length = planner_numba.walk(value, raw, config)
    with jax.enable_x64(True):
        shape = replace(config, max_curvature=math.inf)
        path, count = _shape(jnp.asarray(raw[None]), jnp.asarray([length], jnp.int32), shape, value.shape[-1])
    return raw[:length], np.asarray(path[0, : int(count[0])], float)


def _checked(
    start: npt.ArrayLike, target: npt.ArrayLike, obstacle: npt.ArrayLike, object_centric: npt.ArrayLike
) -> tuple[Any, Any, Any, Any]:
    arrays = tuple(x if isinstance(x, jax.Array) else np.asarray(x) for x in (start, target, obstacle, object_centric))
    slots, size = arrays[0].shape[:1], arrays[1].shape[-1:]
    wanted = {"start": (*slots, 3), "target": (*slots, *size * 3), "obstacle": (*slots, *size * 3)}
    for (name, shape), array in zip((wanted | {"object_centric": slots}).items(), arrays, strict=True):
        if array.shape != shape or not slots:
            raise ValueError(f"{name} must have shape {list(shape)}, got {list(array.shape)}")
    if size[0] < _SMALLEST_GRID:
        raise ValueError(f"a grid of {size[0]} voxels a side has no neighbours within 2 %: {_SMALLEST_GRID} or more")
    return cast(tuple[Any, Any, Any, Any], arrays)


def _on_cpu(arrays: Sequence[maps.AnyArray]) -> bool:
    placed = [device.platform for array in arrays if isinstance(array, jax.Array) for device in array.devices()]
    return all(platform == "cpu" for platform in placed or [jax.default_backend()])


# ----------------------------------------------------------------------------------------------------------------------
# The two engines of the raw path.


def _with_numba(
    start: Num[maps.AnyArray, "B 3"],
    target: Shaped[maps.AnyArray, "B N N N"],
    obstacle: Shaped[maps.AnyArray, "B N N N"],
    planar: Shaped[maps.AnyArray, " B"],
    config: PlannerConfig,
) -> Paths:
    target, obstacle, planar = np.asarray(target), np.asarray(obstacle), np.asarray(planar, bool)
    raw, length, fault = planner_numba.descend(np.asarray(start), target, obstacle, planar, config)
    path, path_length = _shape(raw, length, config, target.shape[-1])
    end, snap = planner_numba.ends(target, np.asarray(_last(path, path_length)))
    return _finish(raw, length, fault, path, path_length, end, snap, planar, config, target.shape[-1])


@partial(jax.jit, static_argnames="config")
def _with_jax(
    start: Num[maps.AnyArray, "B 3"],
    target: Shaped[maps.AnyArray, "B N N N"],
    obstacle: Shaped[maps.AnyArray, "B N N N"],
    planar: Shaped[maps.AnyArray, " B"],
    config: PlannerConfig,
) -> Paths:
    plan = partial(_plan, config=config)
    arrays = start, target, obstacle, planar.astype(bool)
    return lax.platform_dependent(*arrays, cpu=partial(_in_parts, plan, 1), default=partial(_in_parts, plan, None))


def _in_parts(plan: Callable[..., Result], at_once: int | None, *arrays: jax.Array) -> Result:
    """Apply ``plan`` to some slots after the other, which bounds the memory."""
    slots = len(arrays[0])
    if not slots:
        return jax.tree.map(lambda x: x[:0], plan(*(jnp.zeros((1, *array.shape[1:]), array.dtype) for array in arrays)))
    at_once = min(at_once or _SLOTS_AT_ONCE, slots)
    whole = slots // at_once * at_once
    parts = []
    if whole:
        stacked = [array[:whole].reshape(-1, at_once, *array.shape[1:]) for array in arrays]
        done = lax.map(lambda part: plan(*part), stacked)
        parts.append(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), done))
    if whole < slots:
        parts.append(plan(*(array[whole:] for array in arrays)))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def _plan(start: jax.Array, target: jax.Array, obstacle: jax.Array, planar: jax.Array, config: PlannerConfig) -> Paths:
    size = target.shape[-1]
    obstacle = obstacle.astype(jnp.float64)
    fault = _faults(start, target, obstacle)
    voxel = jnp.clip(jnp.round(jnp.nan_to_num(start)), 0, size - 1).astype(jnp.int32)
    raw, length = _descend(voxel, cost_map(target == 1, obstacle, config), planar, config)
    path, path_length = _shape(raw, length, config, size)
    end, snap = _ends(target, _last(path, path_length))
    return _finish(raw, length, fault, path, path_length, end, snap, planar, config, size)


def _faults(
    start: Num[Array, "B 3"], target: Shaped[Array, "B N N N"], obstacle: Float[Array, "B N N N"]
) -> Int[Array, " B"]:
    volume = (-3, -2, -1)
    finite = jnp.isfinite(start).all(-1) & jnp.isfinite(target).all(volume) & jnp.isfinite(obstacle).all(volume)
    lost = ~(target == 1).any(volume)
    return jnp.where(finite, jnp.where(lost, Fault.NO_TARGET, Fault.NONE), Fault.NOT_FINITE).astype(jnp.int32)


def cost_map(
    target: Bool[Array, "*batch N N N"], obstacle: Float[Array, "*batch N N N"], config: PlannerConfig
) -> Float[Array, "*batch N N N"]:
    """What a voxel costs: far from ``target`` (bool) and near to ``obstacle``, [..., N, N, N] in [0, 1]."""
    far = maps.normalize(jnp.sqrt(maps.squared_distance(target).astype(obstacle.dtype)))
    near = maps.normalize(maps.gaussian_blur(obstacle, config.obstacle_map_gaussian_sigma))
    zero = maps.opaque_zero(obstacle)
    weighted = (far, config.target_map_weight), (near, config.obstacle_map_weight)
    far, near = (maps.rounded(volume * weight, zero) for volume, weight in weighted)
    return maps.normalize(far + near)


class _Descent(NamedTuple):
    """Where a descent is: steps taken, voxel [G, 3], still moving [G], costs around [G, K], and what it wrote."""

    step: jax.Array
    here: jax.Array
    active: jax.Array
    around: jax.Array
    cost: jax.Array
    raw: jax.Array
    length: jax.Array


def _surroundings(padded: Float[Array, "B P P P"], here: Int[Array, "B 3"], margin: int) -> Float[Array, "B K"]:
    """Costs around voxels, from volumes padded by ``margin``, in the order of ``neighbour_offsets``."""
    block = (2 * margin + 1,) * 3
    return jax.vmap(lambda cost, at: lax.dynamic_slice(cost, at, block))(padded, here).reshape(len(here), -1)


def _descend(
    start: Int[Array, "B 3"], cost: Float[Array, "B N N N"], planar: Bool[Array, " B"], config: PlannerConfig
) -> tuple[Int[Array, "B steps 3"], Int[Array, " B"]]:
    """Raw paths int32 [G, max_steps + 1, 3] and their lengths [G], all slots in step.

    A batched loop written out: under ``vmap`` every step would copy the volumes to select the slots still moving.
    """
    size, margin = cost.shape[-1], reach(cost.shape[-1])
    offsets = jnp.asarray(neighbour_offsets(size), jnp.int32)
    middle, slots = len(offsets) // 2, jnp.arange(len(start))
    level = jnp.asarray(offsets[:, 2] == 0)
    # Beyond the border everything costs infinitely much, which is as good as not being there.
    padded = jnp.pad(cost, [(0, 0), *[(margin, margin)] * 3], constant_values=jnp.inf)

    def candidates(around: jax.Array, here: jax.Array, flat: jax.Array) -> jax.Array:
        # Upstream takes out the voxel itself before clipping to the grid, and clipping at a border brings it back.
        edge = (here == 0) | (here == size - 1)
        own = edge[:, :2].any(-1) | (edge[:, 2] & ~flat)
        allowed = (level[None] | ~flat[:, None]) & ((jnp.arange(len(offsets)) != middle)[None] | own[:, None])
        return jnp.where(allowed, around, jnp.inf)

    def step(d: _Descent) -> _Descent:
        choice = jnp.argmin(candidates(d.around, d.here, planar), axis=-1)
        there = jnp.where(d.active[:, None], d.here + offsets[choice], d.here)
        x, y, z = (d.here + margin).T
        cost = d.cost.at[slots, x, y, z].add(d.active.astype(d.cost.dtype), unique_indices=True)
        around = _surroundings(cost, there, margin)
        worth = candidates(around, there, jnp.zeros_like(planar)) < around[:, middle, None] + config.stop_threshold
        raw = lax.dynamic_update_index_in_dim(d.raw, there, d.step + 1, 1)
        length = jnp.where(d.active, d.step + 2, d.length)
        return _Descent(d.step + 1, there, d.active & worth.any(-1), around, cost, raw, length)

    raw = jnp.broadcast_to(start[:, None], (len(start), config.max_steps + 1, 3))
    first = _Descent(
        step=jnp.zeros((), jnp.int32),
        here=start,
        active=jnp.ones(len(start), bool),
        around=_surroundings(padded, start, margin),
        cost=padded,
        raw=raw,
        length=jnp.ones(len(start), jnp.int32),
    )
    end = lax.while_loop(lambda d: (d.step < config.max_steps) & d.active.any(), step, first)
    behind = jnp.arange(raw.shape[1])[None] >= end.length[:, None]
    return jnp.where(behind[..., None], end.here[:, None], end.raw), end.length


def _ends(target: Shaped[Array, "B N N N"], last: Float[Array, "B 3"]) -> tuple[Int[Array, "B 3"], Bool[Array, " B"]]:
    """The target voxel nearest to ``last`` [G, 3], the first of several, and whether the path has to be led there."""
    size = target.shape[-1]
    voxel = jnp.clip(jnp.round(last), 0, size - 1).astype(jnp.int32)
    x, y, z = ((jnp.arange(size)[None] - voxel[:, i, None]).astype(jnp.int64) ** 2 for i in range(3))
    squares = x[:, :, None, None] + y[:, None, :, None] + z[:, None, None, :]
    # Distance first, then place in the grid, in one number: its minimum is the first of the nearest.
    place = jnp.arange(size**3).reshape(1, size, size, size)
    key = jnp.where(target == 1, squares * size**3 + place, jnp.iinfo(jnp.int64).max).min((1, 2, 3))
    end = jnp.stack(jnp.unravel_index(key % size**3, (size, size, size)), axis=-1)
    on_target = target[jnp.arange(len(voxel)), voxel[:, 0], voxel[:, 1], voxel[:, 2]] != 0
    return end, ~on_target


# ----------------------------------------------------------------------------------------------------------------------
# From the raw path to waypoints; all of it on [B, L, 3] arrays, a slot at a time under vmap.


@partial(jax.jit, static_argnames=("config", "size"))
def _shape(raw: jax.Array, length: jax.Array, config: PlannerConfig, size: int) -> tuple[jax.Array, jax.Array]:
    """Smoothed, cut and spaced-out paths float64 [B, L, 3], and their lengths [B]."""

    def one(raw: jax.Array, length: jax.Array) -> tuple[jax.Array, jax.Array]:
        path = smooth(raw.astype(jnp.float64), length, config.savgol_window_size, config.savgol_polyorder)
        length = _cut(path, length, config.max_curvature)
        return _space_out(path, length, int(config.target_spacing * size / 100))

    return jax.vmap(one)(raw, length)


@partial(jax.jit, static_argnames=("config", "size"))
def _finish(
    raw: jax.Array,
    raw_length: jax.Array,
    fault: jax.Array,
    path: jax.Array,
    length: jax.Array,
    end: jax.Array,
    snap: jax.Array,
    planar: jax.Array,
    config: PlannerConfig,
    size: int,
) -> Paths:
    """Lead each path to its ``end`` [B, 3] where ``snap`` [B] says so, thin out those of objects, and pack up."""

    def one(
        path: jax.Array, length: jax.Array, last: jax.Array, end: jax.Array, snap: jax.Array, planar: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        height = jnp.where(planar, jnp.clip(jnp.round(last[2]), 0, size - 1), end[2])
        path = jnp.concatenate([path, path[-1:]])
        behind = (jnp.arange(len(path)) >= length)[:, None]
        path = jnp.where(snap & behind, end.at[2].set(height), path)
        length = length + snap
        thinned, count = _every(path, length, config.pushing_skip_per_k)
        return jnp.where(planar, thinned, path), jnp.where(planar, count, length)

    path, length = jax.vmap(one)(path, length, _last(path, length), end.astype(path.dtype), snap, planar)
    sound = fault == Fault.NONE
    path = jnp.where(sound[:, None, None], jnp.clip(path, 0, size - 1), raw[:, :1])
    raw = jnp.where(sound[:, None, None], raw, raw[:, :1])
    raw_length, length = (jnp.where(sound, x, 0).astype(jnp.int32) for x in (raw_length, length))
    return Paths(raw, raw_length, path.astype(jnp.float32), length, fault)


def smooth(path: Float[Array, "L 3"], length: Int[Array, ""], window: int, degree: int) -> Float[Array, "L 3"]:
    """SciPy's ``savgol_filter(path[:length], min(length, window), min(degree, ...))``, its ``"interp"`` ends included.

    With an even window the inner waypoints are estimates half a sample further on, as SciPy's are.

    Args:
        path: [L, 3], of which ``length`` count.
        length: at least 1.
        window: samples a polynomial is fitted to; fewer if the path is shorter.
        degree: of the polynomial; lower if the samples don't determine it.

    Returns:
        [L, 3]; behind ``length`` it repeats the last entry.
    """
    fitted, inner = (jnp.asarray(table, path.dtype) for table in _savgol_tables(window, degree))
    width = jnp.minimum(length, window)
    half, i = width // 2, jnp.minimum(jnp.arange(len(path)), length - 1)
    head, tail = i < half, i >= length - half
    begin = jnp.where(head, 0, jnp.where(tail, length - width, i - (width - 1) // 2))
    rows = jnp.where((head | tail)[:, None], fitted[width, jnp.clip(i - begin, 0, window - 1)], inner[width])
    samples = path[jnp.minimum(begin[:, None] + jnp.arange(window)[None], len(path) - 1)]
    return (rows[..., None] * samples).sum(axis=1)


def _savgol_tables(window: int, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """For each width: weights that evaluate the fit at every sample [w, i, :], and in the middle [w, :]."""
    fitted, inner = np.zeros((window + 1, window, window)), np.zeros((window + 1, window))
    for width in range(1, window + 1):
        # Centred and scaled, so that the powers are well conditioned.
        at = (np.arange(width) - (width - 1) / 2) / max(width - 1, 1)
        powers = at[:, None] ** np.arange(min(degree, width - 1) + 1)
        solve = np.linalg.pinv(powers)
        fitted[width, :width, :width] = powers @ solve
        inner[width, :width] = solve[0]
    return fitted, inner


def _gradient(path: Float[Array, "L 3"], length: Int[Array, ""]) -> Float[Array, "L 3"]:
    """``np.gradient`` of the first ``length`` entries along axis 0."""
    i = jnp.arange(len(path))
    before, after = jnp.maximum(i - 1, 0), jnp.minimum(i + 1, length - 1)
    return (path[after] - path[before]) / jnp.maximum(after - before, 1)[:, None]


def _cut(path: Float[Array, "L 3"], length: Int[Array, ""], sharpest: float) -> Int[Array, ""]:
    """Length of a path [L, 3] that ends shortly before its first bend sharper than ``sharpest``."""
    velocity = _gradient(path, length)
    turn = jnp.cross(velocity, _gradient(velocity, length))
    curvature = jnp.sqrt((turn**2).sum(-1)) / ((velocity**2).sum(-1)) ** 1.5
    i = jnp.arange(len(path))
    # A NaN, where the path stands still, is not a bend: comparisons with it are False.
    sharp = (curvature > sharpest) & (i >= _FIRST_BEND) & (i < length)
    kept = jnp.asarray([int(_KEPT_OF_BEND * k) for k in range(len(path))], length.dtype)
    return jnp.where(sharp.any(), kept[jnp.argmax(sharp)], length)


def _space_out(
    path: Float[Array, "L 3"], length: Int[Array, ""], spacing: int
) -> tuple[Float[Array, "L 3"], Int[Array, ""]]:
    """Of the inner waypoints keep every k-th, so that they lie about ``spacing`` apart, and both ends."""
    inner = length - 2
    gap = jnp.sqrt(((path[1:] - path[:-1]) ** 2).sum(-1))
    k = jnp.arange(len(gap))
    total = jnp.where((k >= 1) & (k < inner), gap, 0).sum()
    mean = total / jnp.maximum(inner - 1, 1)
    ratio = jnp.round(spacing / jnp.where(total > 0, mean, 1))
    skip = jnp.where((inner > 1) & (total > spacing), jnp.maximum(ratio, 1), 1).astype(length.dtype)
    count = jnp.maximum(-(-inner // skip), 0)
    i = jnp.arange(len(path))
    source = jnp.where(i == 0, 0, jnp.where(i <= count, 1 + (i - 1) * skip, length - 1))
    return path[source], count + 2


def _every(path: Float[Array, "L 3"], length: Int[Array, ""], k: int) -> tuple[Float[Array, "L 3"], Int[Array, ""]]:
    """``path[k:-1:k]`` and the last waypoint, which is repeated behind."""
    count = jnp.maximum(length - 2, 0) // k
    i = jnp.arange(len(path))
    return path[jnp.where(i < count, jnp.minimum((i + 1) * k, length - 1), length - 1)], count + 1


def _last(path: Float[Array, "B L 3"], length: Int[Array, " B"]) -> Float[Array, "B 3"]:
    """Where each path ends, [B, 3], the nearest billionth of a voxel.

    The window is a few samples of whole numbers, so a smoothed path does end half-way between voxels, up to the
    rounding of the fit. Upstream leaves the choice to that rounding.
    """
    return jnp.round(path[jnp.arange(len(path)), length - 1], 9)
