"""The compiled functions of ``osc_numba`` (one for a control tick, one for a substep) and the layout of their arrays.

In: views of a simulator's arrays, one record of settings, and the memory of each slot. Out: goals and actuator
commands, written in place. The computation is that of ``osc.py``, in float64. Each slot is computed on its own, in one
order, without fast-math and fused multiplications: its bits depend neither on the batch nor on the width of the
machine's vectors. Numba checks only this file for changes before it reads its cache, so all parts are here.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numba
import numpy as np
from numba import types

from vecenv.controllers.osc import NUM_JOINTS
from vecenv.util.compiled import compile_function, part

# Fields of an arm written as one row, in order, with their widths.
ARM_FIELDS = {
    "qpos": 7,
    "qvel": 7,
    "eef_pos": 3,
    "eef_mat": 9,
    "xanchor": 21,
    "xaxis": 21,
    "mass_lower": 28,
    "bias": 7,
}
ARM_SIZE = sum(ARM_FIELDS.values())
# Where they start.
_QPOS, _QVEL, EEF_POS, EEF_MAT, XANCHOR, _XAXIS, _MASS, _BIAS = (
    sum(list(ARM_FIELDS.values())[:i]) for i in range(len(ARM_FIELDS))
)
# Below this squared ratio to its own length a Gram-Schmidt remainder is rounding; osc.py uses the same.
_RANK_TOLERANCE = 1e-15

# What the controllers of a slot remember; see ``Controllers.memory``.
MEMORY = np.dtype(
    [("goal_pos", "f8", 3), ("goal_mat", "f8", 9), ("fingers", "f8", 2), ("grip", "f8"), ("fresh", "?")], align=True
)
SETTINGS = np.dtype(
    [
        ("kp", "f8"),
        ("kd", "f8"),
        ("joint_kp", "f8"),
        ("joint_kd", "f8"),
        ("max_delta_pos", "f8"),
        ("max_delta_ori", "f8"),
        ("torque_limit", "f8", NUM_JOINTS),
        ("finger_speed", "f8", 2),
        ("finger_middle", "f8", 2),
        ("finger_half", "f8", 2),
    ],
    align=True,
)
# Scratch of one slot. A row of "columns" or "turning": a vector [7], its right-hand side, its inverse squared length.
_SIDE, _INVERSE = 7, 8
WORK = np.dtype(
    [
        ("arm", "f8", ARM_SIZE),
        ("velocity", "f8", 6),
        ("acceleration", "f8", NUM_JOINTS),
        ("table", "f8", (NUM_JOINTS, 14)),
        ("columns", "f8", (7, 9)),
        ("turning", "f8", (3, 9)),
        ("floor", "f8", 6),
        ("parts", "f8", 6),
    ],
    align=True,
)


# ---------------------------------------------------------------------------------------------------------------------
# Compiling. Both functions are compiled once a machine, in a few seconds, and read from numba's cache afterwards.

# Any strides: a view of one simulation is contiguous, one of several is not, and both use the same function.
_READ = types.Array(types.float64, 2, "A", readonly=True)
_WRITE = types.Array(types.float64, 2, "A")
_COMMON = (
    types.Array(numba.from_dtype(MEMORY), 1, "C"),
    types.Array(types.float64, 1, "C", readonly=True),
    types.Array(numba.from_dtype(SETTINGS), 1, "C"),
    types.Array(numba.from_dtype(WORK), 1, "C"),
    types.Array(types.boolean, 1, "A", readonly=True),
)


@functools.cache
def compiled() -> tuple[Callable[..., None], Callable[..., None]]:
    """``_take_actions`` and ``_command``, compiled."""
    return (
        compile_function(types.void(*_COMMON, _READ, _READ, _READ), _take_actions),
        compile_function(types.void(*_COMMON, *[_READ] * len(ARM_FIELDS), _WRITE), _command),
    )


# ---------------------------------------------------------------------------------------------------------------------
# Compiled code, one slot at a time. Sums are taken in the order of ``osc.py``.


def _take_actions(
    memory: np.ndarray,
    home: np.ndarray,
    settings: np.ndarray,
    work: np.ndarray,
    active: np.ndarray,
    actions: np.ndarray,
    eef_pos: np.ndarray,
    eef_mat: np.ndarray,
) -> None:
    """See ``Controllers.take_actions``."""
    for i in range(active.size):
        if active[i]:
            arm, slot = work[0].arm, memory[i]
            if slot.fresh:
                _copy(home, arm, 0, XANCHOR)
            else:
                _copy(eef_pos[i], arm, EEF_POS, 3)
                _copy(eef_mat[i], arm, EEF_MAT, 9)
            _next_goal(slot, arm, actions[i], settings[0])
            slot.grip = actions[i, 6]


def _command(
    memory: np.ndarray,
    home: np.ndarray,
    settings: np.ndarray,
    work: np.ndarray,
    active: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    eef_pos: np.ndarray,
    eef_mat: np.ndarray,
    xanchor: np.ndarray,
    xaxis: np.ndarray,
    mass_lower: np.ndarray,
    bias: np.ndarray,
    ctrl: np.ndarray,
) -> None:
    """See ``Controllers.command``."""
    for i in range(active.size):
        if active[i]:
            arm, slot = work[0].arm, memory[i]
            if slot.fresh:
                _copy(home, arm, 0, _BIAS)
                slot.fresh = False
            else:
                _copy(qpos[i], arm, _QPOS, 7)
                _copy(qvel[i], arm, _QVEL, 7)
                _copy(eef_pos[i], arm, EEF_POS, 3)
                _copy(eef_mat[i], arm, EEF_MAT, 9)
                _copy(xanchor[i], arm, XANCHOR, 21)
                _copy(xaxis[i], arm, _XAXIS, 21)
                _copy(mass_lower[i], arm, _MASS, 28)
            _copy(bias[i], arm, _BIAS, 7)
            _torques(slot, home, settings[0], work[0], ctrl[i])
            _finger_targets(slot, settings[0], ctrl[i])


@part
def _copy(source, target, first, count):
    for i in range(count):
        target[first + i] = source[i]


@part
def _clip(x, low, high):
    """NaN stays NaN."""
    return high if x > high else low if x < low else x


@part
def _next_goal(slot, arm, action, settings):
    """``osc.set_goal``: the goal from the arm's pose and the clipped action."""
    x = _clip(action[3], -1.0, 1.0) * settings.max_delta_ori
    y = _clip(action[4], -1.0, 1.0) * settings.max_delta_ori
    z = _clip(action[5], -1.0, 1.0) * settings.max_delta_ori
    for i in range(3):
        slot.goal_pos[i] = arm[EEF_POS + i] + _clip(action[i], -1.0, 1.0) * settings.max_delta_pos
    if x == 0 and y == 0 and z == 0:
        return
    turn = _robosuite_rotation(x, y, z)
    for i in range(3):
        for j in range(3):
            total = turn[i][0] * arm[EEF_MAT + j]
            total += turn[i][1] * arm[EEF_MAT + 3 + j]
            total += turn[i][2] * arm[EEF_MAT + 6 + j]
            slot.goal_mat[3 * i + j] = total


@part
def _single(x):
    """Rounded to float32."""
    return np.float64(np.float32(x))


@part
def _robosuite_rotation(x, y, z):
    """``osc._robosuite_rotation``: rotation matrix of a rotation vector, rounded to float32 where robosuite does."""
    angle = math.sqrt(x * x + y * y + z * z)
    length = angle if angle > 0 else 1.0
    sine = math.sin(angle / 2)
    w = _single(math.cos(angle / 2))
    x, y, z = _single(x / length * sine), _single(y / length * sine), _single(z / length * sine)
    squared_norm = _single(_single(w * w) + _single(x * x) + _single(y * y) + _single(z * z))
    scale = math.sqrt(2 / squared_norm)
    w, x, y, z = _single(w * scale), _single(x * scale), _single(y * scale), _single(z * scale)
    xx, yy, zz = _single(x * x), _single(y * y), _single(z * z)
    xy, xz, yz = _single(x * y), _single(x * z), _single(y * z)
    wx, wy, wz = _single(w * x), _single(w * y), _single(w * z)
    return (
        (1 - yy - zz, _single(xy - wz), _single(xz + wy)),
        (_single(xy + wz), 1 - xx - zz, _single(yz - wx)),
        (_single(xz - wy), _single(yz + wx), 1 - xx - yy),
    )


@part
def _finger_targets(slot, settings, ctrl):
    """``gripper.integrate`` and ``gripper.command``."""
    direction = 1.0 if slot.grip > 0 else -1.0 if slot.grip < 0 else 0.0
    for i in range(2):
        slot.fingers[i] = _clip(slot.fingers[i] + settings.finger_speed[i] * direction, -1.0, 1.0)
        ctrl[NUM_JOINTS + i] = settings.finger_middle[i] + settings.finger_half[i] * slot.fingers[i]


@part
def _torques(slot, home, settings, work, ctrl):
    """``osc.torques`` of the arm in ``work.arm``, into the first seven of ``ctrl``."""
    _fill_table(home, settings, work)
    _eliminate(work)
    _fill_systems(slot, settings, work)
    _orthogonalise(work.columns, work.floor, 6, 7)
    _orthogonalise(work.turning, work.floor[3:], 3, 3)
    total = work.columns[6]
    # The posture's free part. Rounding leaves up to a condition number of the projection behind: project a second time.
    for k in range(6):
        work.parts[k] = _dot(work.columns[k], total) * work.columns[k, _INVERSE]
    for k in range(6):
        _add(total, work.columns[k], -work.parts[k])
    _solve(work.columns, work.parts)
    _solve(work.turning, work.parts[3:])
    for k in range(3):
        _add(total, work.columns[k], work.parts[k])
    for k in range(3):
        _add(total, work.turning[k], work.parts[3 + k])
    _finish(work, settings, ctrl)


@part
def _fill_table(home, settings, work):
    """Lay out [M | Jᵀ | M a], M's upper triangle only, and the arm's velocity at the grip site."""
    arm, table, velocity = work.arm, work.table, work.velocity
    velocity[:] = 0.0
    for j in range(NUM_JOINTS):
        _fill_jacobian_column(arm, table, j)
        for c in range(6):
            velocity[c] += table[j, NUM_JOINTS + c] * arm[_QVEL + j]
        for i in range(j + 1):
            table[i, j] = arm[_MASS + j * (j + 1) // 2 + i]
        work.acceleration[j] = settings.joint_kp * (home[j] - arm[_QPOS + j]) - settings.joint_kd * arm[_QVEL + j]
    for i in range(NUM_JOINTS):
        total = table[0, i] * work.acceleration[0]
        for j in range(1, NUM_JOINTS):
            total += table[min(i, j), max(i, j)] * work.acceleration[j]
        table[i, 13] = total


@part
def _fill_jacobian_column(arm, table, j):
    """Column j of the Jacobian: ``axis x (eef - anchor)``, then the axis."""
    x, y, z = arm[_XAXIS + 3 * j], arm[_XAXIS + 3 * j + 1], arm[_XAXIS + 3 * j + 2]
    rx = arm[EEF_POS] - arm[XANCHOR + 3 * j]
    ry = arm[EEF_POS + 1] - arm[XANCHOR + 3 * j + 1]
    rz = arm[EEF_POS + 2] - arm[XANCHOR + 3 * j + 2]
    table[j, 7], table[j, 8], table[j, 9] = y * rz - z * ry, z * rx - x * rz, x * ry - y * rx
    table[j, 10], table[j, 11], table[j, 12] = x, y, z


@part
def _eliminate(work):
    """Eliminate M's lower triangle (it is positive definite: no pivoting) and scale: [Lᵀ | X | Lᵀ a]."""
    table = work.table
    for k in range(NUM_JOINTS - 1):
        for i in range(k + 1, NUM_JOINTS):
            ratio = table[k, i] / table[k, k]
            for j in range(i, 14):
                table[i, j] -= ratio * table[k, j]
    for k in range(NUM_JOINTS):
        scale = 1 / math.sqrt(table[k, k])
        for j in range(k, 14):
            table[k, j] *= scale


@part
def _fill_systems(slot, settings, work):
    """The columns of X and Lᵀ a with their right-hand sides, and the lengths under which a remainder is rounding."""
    columns, turning = work.columns, work.turning
    for c in range(NUM_JOINTS):
        for i in range(NUM_JOINTS):
            columns[c, i] = work.table[i, NUM_JOINTS + c]
    for c in range(6):
        work.floor[c] = _RANK_TOLERANCE * _dot(columns[c], columns[c])
    turn = _turn_between(work.arm, slot.goal_mat)
    for c in range(3):
        _copy(columns[3 + c], turning[c], 0, NUM_JOINTS)
        gap = slot.goal_pos[c] - work.arm[EEF_POS + c]
        columns[c, _SIDE] = settings.kp * gap - settings.kd * work.velocity[c]
        turning[c, _SIDE] = 0.5 * settings.kp * turn[c] - settings.kd * work.velocity[3 + c]
    for c in range(3, 7):
        columns[c, _SIDE] = 0.0


@part
def _turn_between(arm, goal_mat):
    """Sum of the cross products of the axes of hand and goal: twice the rotation between them, while it is small."""
    x = y = z = 0.0
    for i in range(3):
        ax, ay, az = arm[EEF_MAT + i], arm[EEF_MAT + 3 + i], arm[EEF_MAT + 6 + i]
        bx, by, bz = goal_mat[i], goal_mat[3 + i], goal_mat[6 + i]
        x += ay * bz - az * by
        y += az * bx - ax * bz
        z += ax * by - ay * bx
    return x, y, z


@part
def _orthogonalise(columns, floor, count, total):
    """Modified Gram-Schmidt over the first ``count`` of ``total`` columns, right-hand sides included."""
    for k in range(count):
        pivot = columns[k]
        squared = _dot(pivot, pivot)
        pivot[_INVERSE] = 1 / squared if squared > floor[k] else 0.0
        for c in range(k + 1, total):
            ratio = _dot(pivot, columns[c]) * pivot[_INVERSE]
            for i in range(8):
                columns[c, i] -= pivot[i] * ratio


@part
def _solve(basis, parts):
    """``osc._solutions``: components of the shortest solution along three directions."""
    parts[2] = basis[2, _SIDE] * basis[2, _INVERSE]
    parts[1] = (basis[1, _SIDE] - _dot(basis[1], basis[2]) * parts[2]) * basis[1, _INVERSE]
    left = basis[0, _SIDE] - _dot(basis[0], basis[1]) * parts[1]
    parts[0] = (left - _dot(basis[0], basis[2]) * parts[2]) * basis[0, _INVERSE]


@part
def _dot(a, b):
    total = a[0] * b[0]
    for i in range(1, NUM_JOINTS):
        total += a[i] * b[i]
    return total


@part
def _add(vector, direction, factor):
    for i in range(NUM_JOINTS):
        vector[i] += direction[i] * factor


@part
def _finish(work, settings, ctrl):
    """Torques ``L whitened + bias``, clipped."""
    whitened = work.columns[6]
    for i in range(NUM_JOINTS):
        total = work.table[0, i] * whitened[0]
        for k in range(1, i + 1):
            total += work.table[k, i] * whitened[k]
        ctrl[i] = _clip(total + work.arm[_BIAS + i], -settings.torque_limit[i], settings.torque_limit[i])
