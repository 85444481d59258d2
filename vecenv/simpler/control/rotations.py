"""Rotations of batches in NumPy: matrices, quaternions (wxyz) and rotation vectors, with any leading axes.

SciPy's ``Rotation`` is not used on batches because it raises on NaN and on zero quaternions: one slot whose physics
failed would stop the whole batch. Here such rows give NaN and the other rows are not affected.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation


def rotation_from_rpy(rpy: npt.ArrayLike) -> np.ndarray:
    """Matrix [3, 3] of URDF's roll, pitch and yaw (about the fixed x, y and z axes, in that order), radians."""
    return Rotation.from_euler("xyz", rpy).as_matrix()


def rotation_from_rotvec(rotvec: npt.ArrayLike) -> np.ndarray:
    """Matrices [..., 3, 3] of rotation vectors [..., 3] (axis times angle, radians)."""
    vector = np.asarray(rotvec, np.float64)
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    # sin(half) / angle, whose limit at 0 is 1/2; np.sinc is sin(pi x) / (pi x).
    return rotation_from_quat(np.concatenate([np.cos(half), vector * np.sinc(half / np.pi) / 2], axis=-1))


def rotvec_from_rotation(rotation: npt.ArrayLike) -> np.ndarray:
    """Rotation vectors [..., 3] of matrices [..., 3, 3], the shorter way round."""
    quat = quat_from_rotation(rotation)
    sine = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quat[..., :1])
    return quat[..., 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2)


def rotation_from_quat(quat: npt.ArrayLike) -> np.ndarray:
    """Matrices [..., 3, 3] of quaternions wxyz [..., 4], which need not have unit length."""
    q = np.asarray(quat, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quat_from_rotation(rotation: npt.ArrayLike) -> np.ndarray:
    """Unit quaternions wxyz [..., 4] with w >= 0 of matrices [..., 3, 3]; Shepperd's method."""
    m = np.asarray(rotation, np.float64)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = ([m[..., i, j] for j in range(3)] for i in range(3))
    rows = [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
    ]
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(np.stack([rows[i][i] for i in range(4)], axis=-1), axis=-1)
    quat = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.where(quat[..., :1] < 0, -quat, quat)
