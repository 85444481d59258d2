"""Quaternions wxyz as language programs use them (upstream's names), and their conversion from matrices.

In and out: NumPy arrays in the world frame. The formulas are written out rather than taken from a library: published
verdicts depend on their last bits.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vecenv.manipulation.world import matrix
from voxposer.arguments import number, numbers
from voxposer.requests import InterfaceError


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion wxyz [4] of a rotation matrix [3, 3], w not negative."""
    m = np.asarray(rotation, float)
    four = 1 + np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) @ np.diag(m)
    skew = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    largest = int(four.argmax())
    q = np.empty(4)
    q[largest] = four[largest]
    if largest == 0:
        q[1:] = skew
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0], q[1 + j], q[1 + k] = skew[i], m[j, i] + m[i, j], m[k, i] + m[i, k]
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


def unit(vector: np.ndarray) -> np.ndarray:
    """The vector [3] scaled to length 1; zero for one that is shorter than 1e-6."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-6 else np.zeros(3)


def pointat2quat(vector: npt.ArrayLike) -> np.ndarray:
    """Rotation wxyz [4] of a hand whose fingers point along ``vector`` [3], its x axis as near world x as it can be."""
    z = unit(numbers(vector, "vector", (3,)))
    if not z.any():
        raise InterfaceError("vector: a direction needs a length")
    aside = np.array([0.0, 1.0, 0.0]) if abs(z[0]) > 0.99 else np.array([1.0, 0.0, 0.0])
    y = unit(np.cross(z, aside))
    return quaternion(np.stack([np.cross(y, z), y, z], axis=1))


def qmult(q: npt.ArrayLike, r: npt.ArrayLike) -> np.ndarray:
    """Product of quaternions wxyz: first ``r``, then ``q``."""
    return _product(numbers(q, "q", (4,)), numbers(r, "r", (4,)))


def _product(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    a, b, c, d = q
    w, x, y, z = r
    return np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def qinverse(q: npt.ArrayLike) -> np.ndarray:
    """Inverse of a quaternion wxyz."""
    quat = numbers(q, "q", (4,))
    return quat * [1, -1, -1, -1] / max(float(quat @ quat), 1e-12)


def euler2quat(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Quaternion wxyz of turns about the world's x, then y, then z axis, radians."""
    angles = [number(angle, name) for angle, name in ((roll, "roll"), (pitch, "pitch"), (yaw, "yaw"))]
    turns = [np.array([np.cos(a / 2), 0.0, 0.0, 0.0]) for a in angles]
    for i, angle in enumerate(angles):
        turns[i][1 + i] = np.sin(angle / 2)
    return _product(turns[2], _product(turns[1], turns[0]))


def quat2euler(quat: npt.ArrayLike) -> np.ndarray:
    """Roll, pitch, yaw [3] in radians of a quaternion wxyz, the inverse of :func:`euler2quat`."""
    q = numbers(quat, "quat", (4,))
    length = np.linalg.norm(q)
    if length < 1e-6:
        raise InterfaceError("quat: a quaternion of length zero is no rotation")
    m = matrix(q / length)
    pitch = np.arcsin(np.clip(-m[2, 0], -1.0, 1.0))
    return np.array([np.arctan2(m[2, 1], m[2, 2]), pitch, np.arctan2(m[1, 0], m[0, 0])])
