"""The controllers of the native backend: ``osc`` and ``gripper`` for arms whose state is in a simulator's arrays.

In: views of the simulator's arrays (``ArmViews``), and once per control tick the actions. Out: actuator commands,
written into the simulator's control array before each physics substep. It is the controller of ``osc.py``, which cites
the method, as a loop over slots that numba compiles (``osc_kernels``): a call into XLA between two substeps of a
threaded simulator costs far more than the arithmetic does. A slot takes about half a microsecond on the calling thread,
and nothing is allocated. A broken slot does not affect any other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vecenv.controllers.gripper import PANDA_GRIPPER, GripperConfig
from vecenv.controllers.osc import NUM_JOINTS, OSC_POSE, OscConfig
from vecenv.controllers.osc_kernels import (
    ARM_FIELDS,
    ARM_SIZE,
    EEF_MAT,
    EEF_POS,
    MEMORY,
    SETTINGS,
    WORK,
    XANCHOR,
    compiled,
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
            fingers at 0. Its joint angles are the posture that the null-space torques pull towards.
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
        self, views: ArmViews, home: npt.ArrayLike, config: OscConfig = OSC_POSE, gripper: GripperConfig = PANDA_GRIPPER
    ) -> None:
        count = len(views.ctrl)
        for name, width in {**ARM_FIELDS, "ctrl": NUM_JOINTS + 2}.items():
            _require(name, getattr(views, name), (count, width))
        self._views = views
        self._home = np.array(home, np.float64)
        _require("home", self._home, (ARM_SIZE,))
        self._settings = _settings(config, gripper)
        self._work = np.zeros(1, WORK)
        self._take_actions, self._command = compiled()
        self.memory = np.zeros(count, MEMORY)
        self.rearm(np.arange(count))

    def rearm(self, rows: np.ndarray, *, fresh: bool = True) -> None:
        """Set these slots, int [k], to their state after a reset: goal at the home pose, fingers in the middle.

        A ``fresh`` slot uses the home arm in its next substep: after ``reset(); set_init_state()`` robosuite's
        controller computes the goal and the torques of the first substep from the arm of the reset, and only the bias
        torques are read from the simulator.
        """
        self.memory["goal_pos"][rows] = self._home[EEF_POS:EEF_MAT]
        self.memory["goal_mat"][rows] = self._home[EEF_MAT:XANCHOR]
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
    """The settings of the compiled functions, one record [1]."""
    settings = np.zeros(1, SETTINGS)
    settings["kp"], settings["kd"] = config.kp, 2 * math.sqrt(config.kp) * config.damping_ratio
    settings["joint_kp"], settings["joint_kd"] = config.nullspace_kp, 2 * math.sqrt(config.nullspace_kp)
    settings["max_delta_pos"], settings["max_delta_ori"] = config.max_delta_pos, config.max_delta_ori
    settings["torque_limit"] = config.torque_limit
    low, high = np.array(gripper.ctrl_low), np.array(gripper.ctrl_high)
    settings["finger_middle"], settings["finger_half"] = 0.5 * (high + low), 0.5 * (high - low)
    # The fingers move in opposite directions: closing lowers the first target and raises the second.
    settings["finger_speed"] = -gripper.speed, gripper.speed
    return settings
