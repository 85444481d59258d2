"""Batched rotations: quaternions (wxyz, unit), rotation matrices and rotation vectors (axis times angle, radians).

Every function takes arrays with any leading batch axes and returns arrays with the same leading axes. They are pure
JAX, keep the dtype of their input, and have finite gradients everywhere, the identity and half turns included. Products
are written out term by term: an accelerator's matrix unit would round float32 3x3 products to TF32.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from vecenv.util.arrays import AnyArray


def require_tail(name: str, array: AnyArray, tail: tuple[int, ...]) -> None:
    """Check the trailing axes of an array.

    Args:
        name: what to call the array in the error.
        array: any array.
        tail: the trailing shape it must have.

    Raises:
        ValueError: the shape does not end in ``tail``.
    """
    if array.ndim < len(tail) or array.shape[array.ndim - len(tail) :] != tail:
        wanted = ", ".join(["...", *map(str, tail)])
        raise ValueError(f"{name} must have shape [{wanted}], got {list(array.shape)}")


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Inner product of vectors [..., n] over the last axis, summed in order."""
    total = a[..., 0] * b[..., 0]
    for i in range(1, a.shape[-1]):
        total = total + a[..., i] * b[..., i]
    return total


def safe_norm(v: ArrayLike) -> jax.Array:
    """Euclidean length of vectors [..., n], with gradient 0 (not NaN) at the zero vector."""
    v = jnp.asarray(v)
    squared = dot(v, v)
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1)), 0)


def matmul(a: jax.Array, b: jax.Array) -> jax.Array:
    """Matrix product of [..., 3, 3] with [..., 3, 3]."""
    rows = a[..., :, 0, None] * b[..., None, 0, :]
    for k in range(1, 3):
        rows = rows + a[..., :, k, None] * b[..., None, k, :]
    return rows


def quat_normalize(quat: ArrayLike) -> tuple[jax.Array, jax.Array]:
    """Scale quaternions to unit length.

    Args:
        quat: [..., 4], any length.

    Returns:
        Unit quaternions [..., 4] and a bool mask [...] of the ones that had a direction. A quaternion without one
        (zero, or holding NaN or infinity) becomes the identity and is False in the mask.
    """
    quat = jnp.asarray(quat)
    require_tail("quat", quat, (4,))
    finite = jnp.isfinite(quat).all(-1, keepdims=True)
    largest = jnp.max(jnp.abs(jnp.where(finite, quat, 0)), axis=-1, keepdims=True)
    valid = largest > 0
    # Dividing by the largest entry first keeps the squared length clear of underflow and overflow.
    scaled = jnp.where(valid, quat, _identity_like(quat)) / jnp.where(valid, largest, 1)
    return scaled / jnp.sqrt(dot(scaled, scaled))[..., None], valid[..., 0]


def _identity_like(quat: jax.Array) -> jax.Array:
    return jnp.zeros_like(quat).at[..., 0].set(1)


def quat_mul(a: ArrayLike, b: ArrayLike) -> jax.Array:
    """Hamilton product of wxyz quaternions [..., 4]: the rotation b followed by a."""
    a, b = jnp.asarray(a), jnp.asarray(b)
    require_tail("a", a, (4,))
    require_tail("b", b, (4,))
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quat_conjugate(quat: ArrayLike) -> jax.Array:
    """Inverse rotation of unit wxyz quaternions [..., 4]."""
    quat = jnp.asarray(quat)
    require_tail("quat", quat, (4,))
    return jnp.concatenate([quat[..., :1], -quat[..., 1:]], axis=-1)


def rotate(quat: ArrayLike, v: ArrayLike) -> jax.Array:
    """Vectors [..., 3] turned by unit wxyz quaternions [..., 4]."""
    quat, v = jnp.asarray(quat), jnp.asarray(v)
    require_tail("quat", quat, (4,))
    require_tail("v", v, (3,))
    twice = 2 * jnp.cross(quat[..., 1:], v)
    return v + quat[..., :1] * twice + jnp.cross(quat[..., 1:], twice)


def quat_to_mat(quat: ArrayLike) -> jax.Array:
    """Rotation matrices [..., 3, 3] of unit wxyz quaternions [..., 4]."""
    quat = jnp.asarray(quat)
    require_tail("quat", quat, (4,))
    w, x, y, z = (quat[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def mat_to_quat(mat: ArrayLike) -> jax.Array:
    """Unit wxyz quaternions [..., 4] with w >= 0 of rotation matrices [..., 3, 3].

    Shepperd's method: four times the outer product q qᵀ is linear in the matrix; its row with the largest diagonal
    entry is normalised, so nothing small is ever divided by.
    """
    mat = jnp.asarray(mat)
    require_tail("mat", mat, (3, 3))
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = ([mat[..., i, j] for j in range(3)] for i in range(3))
    rows = [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
    ]
    outer = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    best = jnp.argmax(jnp.stack([rows[i][i] for i in range(4)], axis=-1), axis=-1)
    quat, _ = quat_normalize(jnp.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :])
    return jnp.where(quat[..., :1] < 0, -quat, quat)


def rotvec_to_quat(rotvec: ArrayLike) -> jax.Array:
    """Unit wxyz quaternions [..., 4] of rotation vectors [..., 3]."""
    rotvec = jnp.asarray(rotvec)
    require_tail("rotvec", rotvec, (3,))
    angle = safe_norm(rotvec)[..., None]
    moving = angle > 0
    # sin(angle / 2) / angle, whose limit at 0 is 1/2.
    scale = jnp.where(moving, jnp.sin(angle / 2) / jnp.where(moving, angle, 1), 0.5)
    return jnp.concatenate([jnp.cos(angle / 2), rotvec * scale], axis=-1)


def quat_to_rotvec(quat: ArrayLike) -> jax.Array:
    """Rotation vectors [..., 3] of unit wxyz quaternions [..., 4], the shorter way round (angle at most pi).

    At exactly half a turn both ways are equally long and the quaternion's own axis is taken.
    """
    quat = jnp.asarray(quat)
    require_tail("quat", quat, (4,))
    quat = jnp.where(quat[..., :1] < 0, -quat, quat)
    sine = safe_norm(quat[..., 1:])[..., None]
    moving = sine > 0
    angle = 2 * jnp.arctan2(sine, quat[..., :1])
    # angle / sin(angle / 2), whose limit at 0 is 2.
    return quat[..., 1:] * jnp.where(moving, angle / jnp.where(moving, sine, 1), 2)


def rotation_between(current: ArrayLike, target: ArrayLike) -> jax.Array:
    """Rotation that takes ``current`` to ``target``, in the world frame.

    Args:
        current: unit quaternions [..., 4].
        target: unit quaternions [..., 4].

    Returns:
        Rotation vectors [..., 3] of ``R_target R_currentᵀ``, the shorter way round.
    """
    return quat_to_rotvec(quat_mul(target, quat_conjugate(current)))
