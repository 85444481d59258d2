# ruff: noqa: F722  (shapes in annotations)
"""Value maps: points to voxels and back, and the operations on volumes that the planner uses.

In: points in metres (world frame) with the corners of a workspace, or volumes [..., N, N, N]. Out: voxel indices,
occupancy, distances, blurred and scaled volumes. Everything takes leading batch axes, and volumes may be traced by JAX.

The last bit of the cost decides between two voxels of nearly equal cost, so these operations give the same bits as
SciPy: squared distances are integers, and the blur sums its taps in SciPy's order, with products rounded before
they are added. Where float64 is not enabled they give the float32 counterpart.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import lax
from jaxtyping import Array, Bool, Float, Integer, Num, Shaped

AnyArray = Array | np.ndarray

# Loop bodies repeated so often per pass over memory; measured on a CPU, where more costs compile time and cache misses.
_TAPS_AT_ONCE = 20
_ROWS_AT_ONCE = 10
# Where the scene is no obstacle: upstream's shares of the grid's side, around targets and around the hand.
_CLEAR_OF_TARGET = 0.15
_CLEAR_OF_START = 0.1


def to_voxel(
    points: Num[AnyArray, "*batch 3"],
    lower: Num[AnyArray, "*#batch 3"],
    upper: Num[AnyArray, "*#batch 3"],
    size: int = 100,
) -> Any:
    """Indices of the voxels that points lie in.

    The corners of the workspace are the *centres* of the first and last voxels, and points outside go to the nearest
    voxel (upstream's ``pc2voxel``; single precision as there).

    Args:
        points: [..., 3] metres, world frame, NumPy or JAX.
        lower: the workspace's lower corner, [3] or broadcasting against ``points``.
        upper: its upper corner.
        size: voxels a side, N.

    Returns:
        int32 [..., 3] of the same kind as ``points``.

    Raises:
        ValueError: no extent between the corners, or NumPy points that are not finite.
    """
    xp = _namespace(points)
    points, lower, upper = (xp.asarray(x, dtype="float32") for x in (points, lower, upper))
    _require_bounds(points, lower, upper)
    lower, upper = _of_rank(points.ndim, lower, upper)
    fraction = (xp.clip(points, lower, upper) - lower) / (upper - lower)
    return xp.round(fraction * (size - 1)).astype("int32")


def to_world(
    voxels: Num[AnyArray, "*batch 3"],
    lower: Num[AnyArray, "*#batch 3"],
    upper: Num[AnyArray, "*#batch 3"],
    size: int = 100,
) -> Any:
    """Centres of voxels in the world frame, float32 [..., 3] metres; ``voxels`` [..., 3] may lie between centres."""
    xp = _namespace(voxels)
    voxels, lower, upper = (xp.asarray(x, dtype="float32") for x in (voxels, lower, upper))
    lower, upper = _of_rank(voxels.ndim, lower, upper)
    return voxels / (size - 1) * (upper - lower) + lower


@partial(jax.jit, static_argnames="size")
def voxelize(
    points: Num[AnyArray, "*batch M 3"],
    lower: Num[AnyArray, "*#batch 3"],
    upper: Num[AnyArray, "*#batch 3"],
    size: int = 100,
    valid: Bool[AnyArray, "*#batch M"] | None = None,
) -> Bool[Array, "*batch N N N"]:
    """Which voxels hold a point.

    Args:
        points: [..., M, 3] metres, world frame.
        lower: the workspace's lower corner, [3] or [..., 3].
        upper: its upper corner.
        size: voxels a side, N.
        valid: bool [..., M], False for padding; all points when None. Points with NaN or infinity never count.

    Returns:
        bool [..., N, N, N].
    """
    points = jnp.asarray(points)
    lower, upper = (jnp.broadcast_to(jnp.asarray(x), (*points.shape[:-2], 3))[..., None, :] for x in (lower, upper))
    usable = jnp.isfinite(points).all(-1)
    usable = usable if valid is None else usable & jnp.broadcast_to(valid, usable.shape)
    x, y, z = jnp.moveaxis(to_voxel(jnp.where(usable[..., None], points, lower), lower, upper, size), -1, 0)
    flat = jnp.where(usable, (x * size + y) * size + z, size**3).reshape(-1, points.shape[-2])
    slots = jnp.arange(len(flat))[:, None]
    grid = jnp.zeros((len(flat), size**3), bool).at[slots, flat].set(True, mode="drop")
    return grid.reshape(*points.shape[:-2], size, size, size)


def squared_distance(occupied: Bool[Array, "*batch N M K"]) -> Integer[Array, "*batch N M K"]:
    """Squared distance in voxels from every voxel to the nearest occupied one, exactly.

    One min-plus product per axis (Felzenszwalb and Huttenlocher's decomposition without its envelope: at these sizes
    comparing all pairs along a line is faster, because it vectorises).

    Args:
        occupied: bool [..., N, M, K].

    Returns:
        uint16 where the largest sum fits, else int32, of the same shape. A volume with nothing occupied has
        ``unreachable(shape)`` everywhere, which is larger than any distance.
    """
    shape = occupied.shape[-3:]
    far = unreachable(shape)
    dtype = jnp.uint16 if far + (max(shape) - 1) ** 2 < 2**16 else jnp.int32
    squares = jnp.where(occupied, 0, far).astype(dtype)
    for axis in (-3, -2, -1):
        squares = _min_plus(squares, axis)
    return squares


def unreachable(shape: tuple[int, ...]) -> int:
    """The value of ``squared_distance`` in an empty volume: one more than any squared distance."""
    return sum((n - 1) ** 2 for n in shape) + 1


def distance_transform(occupied: Shaped[AnyArray, "*batch N M K"]) -> Float[Array, "*batch N M K"]:
    """Euclidean distance in voxels to the nearest occupied voxel, [..., N, M, K]; infinity if nothing is occupied."""
    squares = squared_distance(jnp.asarray(occupied, bool))
    root = jnp.sqrt(squares.astype(_float()))
    return jnp.where(squares < unreachable(squares.shape[-3:]), root, jnp.inf)


def gaussian_blur(
    volume: Num[AnyArray, "*batch N M K"], sigma: float, truncate: float = 4.0
) -> Float[Array, "*batch N M K"]:
    """SciPy's ``gaussian_filter`` of [..., N, M, K] volumes: reflected at the borders, cut off at ``truncate`` sigmas.

    Bit for bit so in float64, where SciPy itself was built without fused multiplication (its x86-64 wheels).
    """
    volume = jnp.asarray(volume, _float())
    zero = opaque_zero(volume)
    for axis in (-3, -2, -1):
        volume = _correlate(volume, gaussian_weights(sigma, truncate), axis, zero)
    return volume


def gaussian_weights(sigma: float, truncate: float = 4.0) -> Float[np.ndarray, " taps"]:
    """One half of the kernel, centre first, [radius + 1]; the whole kernel sums to 1. Sigma 0 gives the identity."""
    radius = int(truncate * sigma + 0.5)
    if radius == 0:
        return np.ones(1)
    whole = np.exp(-0.5 / (sigma * sigma) * np.arange(-radius, radius + 1) ** 2)
    return (whole / whole.sum())[radius:]


def normalize(volume: Float[Array, "*batch N M K"]) -> Float[Array, "*batch N M K"]:
    """Each volume of [..., N, M, K] scaled to [0, 1]; a constant one stays as it is."""
    low, high = (f(volume, axis=(-3, -2, -1), keepdims=True) for f in (jnp.min, jnp.max))
    flat = high == low
    # XLA turns a division by one number into a multiplication by its reciprocal, which rounds differently. Numbers that
    # depend on the voxel, as far as XLA can see, it divides by.
    span = rounded(jnp.where(flat, 1, high - low), jnp.isnan(volume).astype(_bits(volume.dtype)))
    return jnp.where(flat, volume, (volume - low) / span)


def preprocess_avoidance(
    avoidance: Float[AnyArray, "*batch N N N"],
    scene: Shaped[AnyArray, "*batch N N N"],
    affordance: Shaped[AnyArray, "*batch N N N"],
    *,
    movable: Shaped[AnyArray, "*batch N N N"] | None = None,
    start: Num[AnyArray, "*batch 3"] | None = None,
) -> Float[AnyArray, "*batch N N N"]:
    """Add the scene's occupancy to an avoidance map, except near the targets and the moving object.

    Upstream's ``_preprocess_avoidance_map``: the scene does not count closer than 15 % of the side to a target voxel,
    nor closer than that to the moving object's voxels; for the hand, which has no occupancy, it does not count in a box
    of 10 % to either side. One difference: upstream's box vanishes when it reaches beyond the lower border of the grid
    (a negative index in a Python slice), here it is cut off there.

    Args:
        avoidance: [..., N, N, N].
        scene: occupancy of the scene, [..., N, N, N], bool or 0/1.
        affordance: [..., N, N, N]; targets are the voxels equal to 1. Without any, the scene counts everywhere.
        movable: occupancy of the moving object, [..., N, N, N], or None.
        start: voxel of the hand, [..., 3], where there is no ``movable``.

    Returns:
        [..., N, N, N] in [0, 1], NumPy if ``avoidance`` is, of its precision.

    Raises:
        ValueError: neither or both of ``movable`` and ``start``.
    """
    if (movable is None) == (start is None):
        raise ValueError("preprocess_avoidance needs either movable (occupancy) or start (voxel)")
    xp = _namespace(avoidance)
    # NumPy maps are float64; only masks go through JAX, which keeps their precision whatever JAX's own setting.
    clear = _clearance(affordance == 1, movable if movable is None else movable == 1, start)
    obstacle = xp.where(xp.asarray(clear), 0, xp.asarray(scene).astype(avoidance.dtype))
    return xp.clip(avoidance + obstacle, 0, 1)


@jax.jit
def _clearance(
    targets: Bool[Array, "*batch N N N"],
    movable: Bool[Array, "*batch N N N"] | None,
    start: Num[Array, "*batch 3"] | None,
) -> Bool[Array, "*batch N N N"]:
    size = targets.shape[-1]
    within = int(_CLEAR_OF_TARGET * size) ** 2
    clear = squared_distance(targets) < within
    if movable is not None:
        return clear | (squared_distance(movable) < within)
    voxel = jnp.asarray(start)[..., None]
    offset = _of_rank(voxel.ndim, jnp.arange(size))[0] - voxel
    reach = int(_CLEAR_OF_START * size)
    inside = (offset >= -reach) & (offset < reach)
    return clear | (inside[..., 0, :, None, None] & inside[..., 1, None, :, None] & inside[..., 2, None, None, :])


def opaque_zero(volume: jax.Array) -> jax.Array:
    """An integer 0, as wide as the floats, that a compiler cannot fold: it would be 1 if there were a NaN."""
    return jnp.isnan(jnp.max(volume)).astype(_bits(volume.dtype))


def rounded(product: jax.Array, zero: jax.Array) -> jax.Array:
    """The rounded product, protected from compilers that would fuse it with an addition.

    Args:
        product: any floats.
        zero: an ``opaque_zero``; flipping none of the bits leaves the value and hides where it came from.
    """
    bits = lax.bitcast_convert_type(product, zero.dtype) ^ zero
    return lax.bitcast_convert_type(bits, product.dtype)


def _correlate(volume: jax.Array, half: np.ndarray, axis: int, zero: jax.Array) -> jax.Array:
    """A symmetric kernel along an axis, from the outermost pair of taps inwards, as SciPy's ``NI_Correlate1D`` adds."""
    radius, n, axis = len(half) - 1, volume.shape[axis], axis % volume.ndim
    pad = [(radius, radius) if i == axis else (0, 0) for i in range(volume.ndim)]
    padded, weights = jnp.pad(volume, pad, mode="symmetric"), jnp.asarray(half, volume.dtype)

    def tap(i: jax.Array, total: jax.Array) -> jax.Array:
        pair = lax.dynamic_slice_in_dim(padded, i, n, axis) + lax.dynamic_slice_in_dim(padded, 2 * radius - i, n, axis)
        return total + rounded(pair * weights[radius - i], zero)

    centre = rounded(volume * weights[0], zero)
    return lax.fori_loop(0, radius, tap, centre, unroll=min(_TAPS_AT_ONCE, max(radius, 1)))


def _min_plus(squares: jax.Array, axis: int) -> jax.Array:
    """``out[i] = min over j of squares[j] + (i - j)²`` along an axis."""
    n, axis = squares.shape[axis], axis % squares.ndim
    at = jnp.arange(n)
    table = ((at[:, None] - at[None]) ** 2).astype(squares.dtype)
    column = [n if i == axis else 1 for i in range(squares.ndim)]

    def row(j: jax.Array, best: jax.Array) -> jax.Array:
        line = lax.dynamic_slice_in_dim(squares, j, 1, axis)
        return jnp.minimum(best, line + lax.dynamic_index_in_dim(table, j, keepdims=False).reshape(column))

    most = jnp.full_like(squares, jnp.iinfo(squares.dtype).max)
    return lax.fori_loop(0, n, row, most, unroll=min(_ROWS_AT_ONCE, n))


def _of_rank(rank: int, *arrays: AnyArray) -> tuple[Any, ...]:
    """Arrays with leading axes of length 1, so that they have this rank."""
    return tuple(array.reshape((1,) * (rank - array.ndim) + array.shape) for array in arrays)


def _float() -> Any:
    return jnp.zeros(0).dtype


def _bits(dtype: npt.DTypeLike) -> Any:
    return jnp.int64 if dtype == jnp.float64 else jnp.int32


def _namespace(array: object) -> Any:
    return jnp if isinstance(array, jax.Array) else np


def _require_bounds(points: object, lower: object, upper: object) -> None:
    if isinstance(lower, np.ndarray) and isinstance(upper, np.ndarray) and not (upper > lower).all():
        raise ValueError(f"a workspace needs upper > lower on every axis, got {lower.tolist()} and {upper.tolist()}")
    if isinstance(points, np.ndarray) and not np.isfinite(points).all():
        raise ValueError(f"{int((~np.isfinite(points)).any(-1).sum())} of the points are not finite")
