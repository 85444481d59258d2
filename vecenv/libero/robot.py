"""The robot of every LIBERO scene, robosuite 1.4.0's Panda: names in the compiled model, home pose, joint properties.

Scenes, physics and controllers all take these facts from here. ``panda_chain`` reads the constants that
``vecenv.controllers.kinematics`` computes with.
"""

from __future__ import annotations

import mujoco
import numpy as np

from vecenv.controllers.chain import chain_from_model
from vecenv.controllers.kinematics import NUM_BODIES, Chain
from vecenv.controllers.osc import NUM_JOINTS

# The arm's joints, then the fingers', are the first of every scene: so many positions, velocities and actuators.
ARM_DOFS = NUM_JOINTS
ROBOT_DOFS = NUM_BODIES

# Pose at reset, radians.
HOME_QPOS = np.array([0.0, -1.61037389e-01, 0.0, -2.44459747, 0.0, 2.22675220, np.pi / 4])
# N m s/rad and N m of the arm's joints.
ARM_DAMPING = (0.1, 0.1, 0.1, 0.1, 0.1, 0.01, 0.01)
ARM_FRICTIONLOSS = 0.1

ARM_JOINTS = tuple(f"robot0_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
GRIP_SITE = "gripper0_grip_site"
HAND_BODY = "robot0_right_hand"
BASE_BODY = "robot0_base"


def panda_chain(model: mujoco.MjModel) -> Chain:
    """The constants of the arm and its fingers in a compiled scene, float64 NumPy arrays.

    Raises:
        ValueError: the robot is not the first thing in the model, or is built otherwise; the message says how.
    """
    return chain_from_model(model, arm_joints=ARM_JOINTS, finger_joints=FINGER_JOINTS, site=GRIP_SITE, hand=HAND_BODY)
