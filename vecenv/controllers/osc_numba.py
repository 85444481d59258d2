"""The controllers of the native backend: ``osc`` and ``gripper`` once more, for arms that live in a simulator's memory.

In: views into the simulator's arrays (``ArmViews``), and once per control tick the actions. Out: actuator commands,
written into the simulator's control array before each physics substep. It is the controller of ``osc.py``, which says
where the method comes from, as a loop over slots that numba compiles: between two substeps of a threaded simulator a
call into XLA costs far more than its arithmetic, and a plain function does not. A slot takes about half a microsecond
on the calling thread, and nothing is allocated.

Everything is float64. Each slot is computed on its own, in one order, without fast-math and fused multiplications: its
bits depend neither on the batch nor on the width of the machine's vectors, and a broken slot touches no other.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types

from vecenv.controllers.gripper import PANDA_GRIPPER, GripperConfig
from vecenv.controllers.osc import NUM_JOINTS, OSC_POSE, OscConfig
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
_QPOS, _QVEL, _EEF_POS, _EEF_MAT, _XANCHOR, _XAXIS, _MASS, _BIAS = (
    sum(list(ARM_FIELDS.values())[:i]) for i in range(len(ARM_FIELDS))
)
# Below this squared ratio to its own length a Gram-Schmidt remainder is rounding; osc.py uses the same.
_RANK_TOLERANCE = 1e-15

# What the controllers of a slot remember; see ``Controllers.memory``.
MEMORY = np.dtype(
    [("goal_pos", "f8", 3), ("goal_mat", "f8", 9), ("fingers", "f8", 2), ("grip", "f8"), ("fresh", "?")], align=True
)
_SETTINGS = np.dtype(
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
_WORK = np.dtype(
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


class ArmViews(NamedTuple):
    """Live float64 arrays of n simulations that the controllers read, world frame, SI units; they write only ``ctrl``.

    Attributes:
        qpos: joint angles, [n, 7].
        qvel: joint velocities, [n, 7].
        eef_pos: position of the grip site, [n, 3].
        eef_mat: orientation of the grip site, row-major, [n, 9].
        xanchor: joint anchors, [n, 21]. All joints are hinges.
        xaxis: joint axes, [n, 21].
        mass_lower: lower triangle of the arm's joint-space inertia, row by row, [n, 28].
        bias: gravity and velocity-product torques, [n, 7].
        ctrl: actuator commands, seven torques and two finger targets, [n, 9].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    eef_pos: np.ndarray
    eef_mat: np.ndarray
    xanchor: np.ndarray
    xaxis: np.ndarray
    mass_lower: np.ndarray
    bias: np.ndarray
    ctrl: np.ndarray

    def rows(self) -> np.ndarray:
        """The arms as they are now, a copy, [n, 103]; the columns are ``ARM_FIELDS``."""
        return np.concatenate([getattr(self, name) for name in ARM_FIELDS], axis=1)


class Controllers:
    """The controllers of n slots of one scene.

    Args:
        views: the simulator's arrays.
        home: the arm at reset, [103] in the order of ``ARM_FIELDS``: joints at robosuite's ``init_qpos``, at rest,
            fingers at 0. Its joint angles are the posture the arm is drawn to.
        config: the arm controller.
        gripper: the gripper.

    Attributes:
        memory: what each slot remembers between substeps, a structured array [n]: ``goal_pos`` [3] in metres and
            ``goal_mat`` [9], world frame; ``fingers`` [2], integrated finger targets in [-1, 1]; ``grip``, the gripper
            action of the present tick; ``fresh``, whether the slot has not acted since it was rearmed.

    Raises:
        ValueError: a view has the wrong shape or is not float64.
    """

    def __init__(
        self, views: ArmViews, home: Any, config: OscConfig = OSC_POSE, gripper: GripperConfig = PANDA_GRIPPER
    ) -> None:
        count = len(views.ctrl)
        for name, width in {**ARM_FIELDS, "ctrl": NUM_JOINTS + 2}.items():
            _require(name, getattr(views, name), (count, width))
        self._views = views
        self._home = np.array(home, np.float64)
        _require("home", self._home, (ARM_SIZE,))
        self._settings = _settings(config, gripper)
        self._work = np.zeros(1, _WORK)
        self._take_actions, self._command = _compiled()
        self.memory = np.zeros(count, MEMORY)
        self.rearm(np.arange(count))

    def rearm(self, rows: np.ndarray, *, fresh: bool = True) -> None:
        """Put these slots, int [k], back to what they are after a reset: goal at the home pose, fingers in the middle.

        A ``fresh`` slot still believes to be at home in its next substep: after ``reset(); set_init_state()``
        robosuite's controller computes the goal and the torques of the first substep from the arm of the reset, and
        only the bias torques are read from the simulator.
        """
        self.memory["goal_pos"][rows] = self._home[_EEF_POS:_EEF_MAT]
        self.memory["goal_mat"][rows] = self._home[_EEF_MAT:_XANCHOR]
        self.memory["fingers"][rows] = 0.0
        self.memory["grip"][rows] = 0.0
        self.memory["fresh"][rows] = fresh

    def take_actions(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Begin a control tick: turn the actions of the active slots into goals.

        Goals are relative to where the arm *is*. The orientation goal is kept when all three rotation components are
        exactly 0. Slots that are not active keep their goals and finger targets.

        Args:
            actions: policy actions, float64 [n, 7]: position, rotation vector, gripper (+1 closes); the first six are
                clipped to [-1, 1].
            active: bool [n].

        Raises:
            ValueError: a shape or dtype does not match.
        """
        _require("actions", actions, (len(self.memory), 7))
        self._check(active)
        pose = self._views.eef_pos, self._views.eef_mat
        self._take_actions(self.memory, self._home, self._settings, self._work, active, actions, *pose)

    def command(self, active: np.ndarray) -> None:
        """Before a physics substep: write the commands of the active slots, bool [n], into ``ctrl``.

        Raises:
            ValueError: the shape or dtype of ``active`` does not match.
        """
        self._check(active)
        self._command(self.memory, self._home, self._settings, self._work, active, *self._views)

    def _check(self, active: np.ndarray) -> None:
        if active.shape != self.memory.shape or active.dtype != np.bool_:
            raise ValueError(f"active must be bool [{len(self.memory)}], got {active.dtype} {list(active.shape)}")


def _require(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype != np.float64:
        raise ValueError(f"{name} must be float64 {list(shape)}, got {array.dtype} {list(array.shape)}")


def _settings(config: OscConfig, gripper: GripperConfig) -> np.ndarray:
    """The numbers the compiled functions use, one record [1]."""
    settings = np.zeros(1, _SETTINGS)
    settings["kp"], settings["kd"] = config.kp, 2 * math.sqrt(config.kp) * config.damping_ratio
    settings["joint_kp"], settings["joint_kd"] = config.nullspace_kp, 2 * math.sqrt(config.nullspace_kp)
    settings["max_delta_pos"], settings["max_delta_ori"] = config.max_delta_pos, config.max_delta_ori
    settings["torque_limit"] = config.torque_limit
    low, high = np.array(gripper.ctrl_low), np.array(gripper.ctrl_high)
    settings["finger_middle"], settings["finger_half"] = 0.5 * (high + low), 0.5 * (high - low)
    # The fingers move in opposite directions: closing lowers the first target and raises the second.
    settings["finger_speed"] = -gripper.speed, gripper.speed
    return settings


# ---------------------------------------------------------------------------------------------------------------------
# Compiling. Both functions are compiled once a machine, in a few seconds, and read from numba's cache afterwards.

# Any strides: a view of one simulation counts as contiguous, one of several does not, and both are to use one function.
_READ = types.Array(types.float64, 2, "A", readonly=True)
_WRITE = types.Array(types.float64, 2, "A")
_COMMON = (
    types.Array(numba.from_dtype(MEMORY), 1, "C"),
    types.Array(types.float64, 1, "C", readonly=True),
    types.Array(numba.from_dtype(_SETTINGS), 1, "C"),
    types.Array(numba.from_dtype(_WORK), 1, "C"),
    types.Array(types.boolean, 1, "A", readonly=True),
)


@functools.cache
def _compiled() -> tuple[Callable[..., None], Callable[..., None]]:
    """``_take_actions`` and ``_command``, compiled."""
    return (
        compile_function(types.void(*_COMMON, _READ, _READ, _READ), _take_actions),
        compile_function(types.void(*_COMMON, *[_READ] * len(ARM_FIELDS), _WRITE), _command),
    )


# ---------------------------------------------------------------------------------------------------------------------
# Compiled code, one slot at a time. Sums are taken in the order of ``osc.py``.


def _take_actions(
    memory: Any, home: Any, settings: Any, work: Any, active: Any, actions: Any, eef_pos: Any, eef_mat: Any
) -> None:
    """See ``Controllers.take_actions``."""
    for i in range(active.size):
        if active[i]:
            arm, slot = work[0].arm, memory[i]
            if slot.fresh:
                _copy(home, arm, 0, _XANCHOR)
            else:
                _copy(eef_pos[i], arm, _EEF_POS, 3)
                _copy(eef_mat[i], arm, _EEF_MAT, 9)
            _next_goal(slot, arm, actions[i], settings[0])
            slot.grip = actions[i, 6]


def _command(
    memory: Any,
    home: Any,
    settings: Any,
    work: Any,
    active: Any,
    qpos: Any,
    qvel: Any,
    eef_pos: Any,
    eef_mat: Any,
    xanchor: Any,
    xaxis: Any,
    mass_lower: Any,
    bias: Any,
    ctrl: Any,
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
                _copy(eef_pos[i], arm, _EEF_POS, 3)
                _copy(eef_mat[i], arm, _EEF_MAT, 9)
                _copy(xanchor[i], arm, _XANCHOR, 21)
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
        slot.goal_pos[i] = arm[_EEF_POS + i] + _clip(action[i], -1.0, 1.0) * settings.max_delta_pos
    if x == 0 and y == 0 and z == 0:
        return
    turn = _robosuite_rotation(x, y, z)
    for i in range(3):
        for j in range(3):
            total = turn[i][0] * arm[_EEF_MAT + j]
            total += turn[i][1] * arm[_EEF_MAT + 3 + j]
            total += turn[i][2] * arm[_EEF_MAT + 6 + j]
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
    rx = arm[_EEF_POS] - arm[_XANCHOR + 3 * j]
    ry = arm[_EEF_POS + 1] - arm[_XANCHOR + 3 * j + 1]
    rz = arm[_EEF_POS + 2] - arm[_XANCHOR + 3 * j + 2]
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
        gap = slot.goal_pos[c] - work.arm[_EEF_POS + c]
        columns[c, _SIDE] = settings.kp * gap - settings.kd * work.velocity[c]
        turning[c, _SIDE] = 0.5 * settings.kp * turn[c] - settings.kd * work.velocity[3 + c]
    for c in range(3, 7):
        columns[c, _SIDE] = 0.0


@part
def _turn_between(arm, goal_mat):
    """Sum of the cross products of the axes of hand and goal: twice the rotation between them, while it is small."""
    x = y = z = 0.0
    for i in range(3):
        ax, ay, az = arm[_EEF_MAT + i], arm[_EEF_MAT + 3 + i], arm[_EEF_MAT + 6 + i]
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
