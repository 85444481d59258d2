"""Compiled kinematics of a chain of joints: forward kinematics, Jacobian, and closed-loop inverse kinematics (CLIK).

In and out: the arrays of ``chain.Chain``, written in place. The inverse kinematics is the iteration that SAPIEN runs on
Pinocchio (its example "Inverse kinematics (clik)"; damped pseudo-inverse, Wampler 1986). One slot takes tens of
iterations, each far cheaper than a call into an array library, so numba compiles them, once a machine. Everything is
float64, one slot at a time; ``frame`` is [4, 3]: rows 0 to 2 the rotation, row 3 the position.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
from numba import types

from vecenv.util.compiled import compile_function, part

_R1, _R2, _R3 = (types.Array(types.float64, n, "C", readonly=True) for n in (1, 2, 3))
_W2, _W3 = (types.Array(types.float64, n, "C") for n in (2, 3))
_FLAGS, _WRITE_FLAGS = types.Array(types.boolean, 1, "C", readonly=True), types.Array(types.boolean, 1, "C")
_CHAIN = (types.Array(types.intp, 1, "C", readonly=True), _R2, _R3, _R2, _FLAGS)


@functools.cache
def forward_kernel() -> Callable[..., None]:
    """``_forward``, compiled."""
    return compile_function(types.void(*_CHAIN, _R1, _R2, _R2, _W2, _W3, _W3), _forward)


@functools.cache
def inverse_kernel() -> Callable[..., None]:
    """``_inverse``, compiled."""
    return compile_function(types.void(*_CHAIN, _R2, _R3, _R1, types.intp, _W2, _WRITE_FLAGS), _inverse)


def _forward(
    columns: np.ndarray,
    fixed_pos: np.ndarray,
    fixed_rot: np.ndarray,
    axis: np.ndarray,
    slides: np.ndarray,
    tip_pos: np.ndarray,
    tip_rot: np.ndarray,
    qpos: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
    jacobian: np.ndarray,
) -> None:
    """See ``Chain.pose`` and ``Chain.jacobian``."""
    frame, origins, axes = np.empty((4, 3)), np.empty((columns.size, 3)), np.empty((columns.size, 3))
    for i in range(len(qpos)):
        _follow(columns, fixed_pos, fixed_rot, axis, slides, qpos[i], frame, origins, axes)
        _attach(frame, tip_pos, tip_rot)
        for row in range(3):
            position[i, row] = frame[3, row]
            for column in range(3):
                rotation[i, row, column] = frame[row, column]
        _fill_jacobian(frame, origins, axes, slides, jacobian[i])


def _inverse(
    columns: np.ndarray,
    fixed_pos: np.ndarray,
    fixed_rot: np.ndarray,
    axis: np.ndarray,
    slides: np.ndarray,
    target_pos: np.ndarray,
    target_rot: np.ndarray,
    numbers: np.ndarray,
    max_iterations: int,
    qpos: np.ndarray,
    converged: np.ndarray,
) -> None:
    """See ``Chain.solve``; ``numbers`` are the tolerance, the damping and the step."""
    count = columns.size
    frame, origins, axes = np.empty((4, 3)), np.empty((count, 3)), np.empty((count, 3))
    jacobian, system, error = np.empty((6, count)), np.empty((6, 6)), np.empty(6)
    for i in range(len(qpos)):
        for iteration in range(max_iterations + 1):
            _follow(columns, fixed_pos, fixed_rot, axis, slides, qpos[i], frame, origins, axes)
            if _pose_error(frame, target_pos[i], target_rot[i], error) < numbers[0]:
                converged[i] = True
                break
            if iteration < max_iterations:
                _fill_jacobian(frame, origins, axes, slides, jacobian)
                _damped_system(jacobian, numbers[1], system)
                _solve_in_place(system, error)
                for j in range(count):
                    total = 0.0
                    for row in range(6):
                        total += jacobian[row, j] * error[row]
                    qpos[i, columns[j]] -= numbers[2] * total


@part
def _follow(
    columns: np.ndarray,
    fixed_pos: np.ndarray,
    fixed_rot: np.ndarray,
    axis: np.ndarray,
    slides: np.ndarray,
    q: np.ndarray,
    frame: np.ndarray,
    origins: np.ndarray,
    axes: np.ndarray,
) -> None:
    """Frame of the last joint, and every joint's position and axis in the root's frame."""
    turn = np.empty((3, 3))
    for row in range(4):
        for column in range(3):
            frame[row, column] = 1.0 if row == column else 0.0
    for j in range(columns.size):
        _attach(frame, fixed_pos[j], fixed_rot[j])
        x, y, z = axis[j, 0], axis[j, 1], axis[j, 2]
        for row in range(3):
            axes[j, row] = frame[row, 0] * x + frame[row, 1] * y + frame[row, 2] * z
        value = float(q[columns[j]])
        if slides[j]:
            for row in range(3):
                frame[3, row] += value * axes[j, row]
        else:
            _rotation_about(axis[j], value, turn)
            _turn(frame, turn)
        for row in range(3):
            origins[j, row] = frame[3, row]


@part
def _attach(frame: np.ndarray, position: np.ndarray, rotation: np.ndarray) -> None:
    for row in range(3):
        frame[3, row] += frame[row, 0] * position[0] + frame[row, 1] * position[1] + frame[row, 2] * position[2]
    _turn(frame, rotation)


@part
def _turn(frame: np.ndarray, rotation: np.ndarray) -> None:
    for row in range(3):
        a, b, c = frame[row, 0], frame[row, 1], frame[row, 2]
        for column in range(3):
            frame[row, column] = a * rotation[0, column] + b * rotation[1, column] + c * rotation[2, column]


@part
def _rotation_about(axis: np.ndarray, angle: float, out: np.ndarray) -> None:
    """Rodrigues' formula."""
    x, y, z = axis[0], axis[1], axis[2]
    c, s = math.cos(angle), math.sin(angle)
    d = 1.0 - c
    out[0, 0], out[0, 1], out[0, 2] = c + x * x * d, x * y * d - z * s, x * z * d + y * s
    out[1, 0], out[1, 1], out[1, 2] = y * x * d + z * s, c + y * y * d, y * z * d - x * s
    out[2, 0], out[2, 1], out[2, 2] = z * x * d - y * s, z * y * d + x * s, c + z * z * d


@part
def _fill_jacobian(
    frame: np.ndarray, origins: np.ndarray, axes: np.ndarray, slides: np.ndarray, out: np.ndarray
) -> None:
    """Linear and angular velocity of the frame's origin, root axes."""
    for j in range(slides.size):
        ax, ay, az = axes[j, 0], axes[j, 1], axes[j, 2]
        if slides[j]:
            out[0, j], out[1, j], out[2, j] = ax, ay, az
            out[3, j] = out[4, j] = out[5, j] = 0.0
        else:
            x, y, z = frame[3, 0] - origins[j, 0], frame[3, 1] - origins[j, 1], frame[3, 2] - origins[j, 2]
            out[0, j], out[1, j], out[2, j] = ay * z - az * y, az * x - ax * z, ax * y - ay * x
            out[3, j], out[4, j], out[5, j] = ax, ay, az


@part
def _pose_error(frame: np.ndarray, target_pos: np.ndarray, target_rot: np.ndarray, error: np.ndarray) -> float:
    """Twist that takes the target to the frame in unit time, in root axes at the frame's origin; and its length.

    It is the logarithm of target⁻¹ frame (Lynch and Park 2017, section 3.3.3), which is the same in the frame's axes as
    in the target's, turned into the root's. The length does not depend on the axes.
    """
    w, x, y, z = _quaternion_between(frame, target_rot)
    sine = math.sqrt(x * x + y * y + z * z)
    half = math.atan2(sine, w)
    scale = 2.0 * half / sine if sine > 0.0 else 2.0
    x, y, z = x * scale, y * scale, z * scale  # rotation vector, in the frame's axes
    # The displacement, in the target's axes.
    d = np.empty(3)
    for row in range(3):
        d[row] = 0.0
        for k in range(3):
            d[row] += target_rot[k, row] * (frame[3, k] - target_pos[k])
    # alpha = half / tan(half); beta = (1 - alpha) / angle².
    if half > 1e-4:
        alpha = half / math.tan(half) if half < math.pi / 2 - 1e-12 else 0.0
        beta = (1.0 - alpha) / (4.0 * half * half)
    else:
        alpha, beta = 1.0 - half * half / 3.0, 1.0 / 12.0
    along = beta * (x * d[0] + y * d[1] + z * d[2])
    u = alpha * d[0] - 0.5 * (y * d[2] - z * d[1]) + along * x
    v = alpha * d[1] - 0.5 * (z * d[0] - x * d[2]) + along * y
    t = alpha * d[2] - 0.5 * (x * d[1] - y * d[0]) + along * z
    for row in range(3):
        error[row] = frame[row, 0] * u + frame[row, 1] * v + frame[row, 2] * t
        error[3 + row] = frame[row, 0] * x + frame[row, 1] * y + frame[row, 2] * z
    return math.sqrt(u * u + v * v + t * t + x * x + y * y + z * z)


@part
def _quaternion_between(frame: np.ndarray, target_rot: np.ndarray) -> tuple[float, float, float, float]:
    """Unit quaternion with w >= 0 of target_rotᵀ frame; Shepperd's method, as in ``controllers/rotations.py``."""
    m = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            m[row, column] = 0.0
            for k in range(3):
                m[row, column] += target_rot[k, row] * frame[k, column]
    xx, yy, zz = m[0, 0], m[1, 1], m[2, 2]
    a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    d, e, f = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    sizes = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    if sizes[0] >= max(sizes[1], sizes[2], sizes[3]):
        w, x, y, z = sizes[0], a, b, c
    elif sizes[1] >= max(sizes[2], sizes[3]):
        w, x, y, z = a, sizes[1], d, e
    elif sizes[2] >= sizes[3]:
        w, x, y, z = b, d, sizes[2], f
    else:
        w, x, y, z = c, e, f, sizes[3]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        length = -length
    return w / length, x / length, y / length, z / length


@part
def _damped_system(jacobian: np.ndarray, damping: float, out: np.ndarray) -> None:
    """J Jᵀ + damping."""
    for row in range(6):
        for column in range(row + 1):
            total = damping if row == column else 0.0
            for j in range(jacobian.shape[1]):
                total += jacobian[row, j] * jacobian[column, j]
            out[row, column] = out[column, row] = total


@part
def _solve_in_place(system: np.ndarray, right: np.ndarray) -> None:
    """Solve a positive definite system by its LDLᵀ factorisation; both arguments are overwritten."""
    n = right.size
    for k in range(n):
        for row in range(k + 1, n):
            factor = system[row, k] / system[k, k]
            for column in range(k + 1, row + 1):
                system[row, column] -= factor * system[column, k]
        for row in range(k + 1, n):
            system[row, k] /= system[k, k]
    for row in range(n):
        for k in range(row):
            right[row] -= system[row, k] * right[k]
    for row in range(n):
        right[row] /= system[row, row]
    for row in range(n - 1, -1, -1):
        for k in range(row + 1, n):
            right[row] -= system[k, row] * right[k]
