"""Joint-space control of the Panda arm: robosuite 1.4.0's ``JOINT_POSITION`` in JAX, with the joints' own limits.

In: once per control tick an action for the seven joints, which sets target angles relative to where the joints are;
for each physics substep the arm's ``ArmState``. Out: joint torques, a spring and damper through the mass matrix with
gravity and velocity products compensated. Pure functions with any leading batch axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from vecenv.controllers.osc import OSC_POSE, ArmState
from vecenv.util.arrays import AnyArray
from vecenv.util.rotations import require_tail


@dataclass(frozen=True, kw_only=True)
class JointConfig:
    """Gains and limits; the defaults are robosuite's ``joint_position.json`` and the Panda's actuators.

    Attributes:
        kp: stiffness, 1/s².
        damping_ratio: 1 is critical damping.
        max_delta: radians a full action moves a target from where the joint is.
        torque_limit: largest torque of each joint, N·m.
    """

    kp: float = 50.0
    damping_ratio: float = 1.0
    max_delta: float = 0.05
    torque_limit: tuple[float, ...] = OSC_POSE.torque_limit


JOINT_POSITION = JointConfig()


def set_goal(
    qpos: Float[AnyArray, "*#B 7"],
    action: Float[AnyArray, "*#B 7"],
    limits: Float[AnyArray, "2 7"],
    config: JointConfig = JOINT_POSITION,
) -> Float[Array, "... 7"]:
    """Target angles, radians, [..., 7].

    Args:
        qpos: joint angles, radians, [..., 7].
        action: fractions of ``max_delta``, clipped to [-1, 1], [..., 7].
        limits: lower and upper joint limits, radians, [2, 7]; robosuite has none here.
        config: the controller.

    Raises:
        ValueError: a shape does not match.
    """
    require_tail("qpos", qpos, (7,))
    require_tail("action", action, (7,))
    require_tail("limits", limits, (2, 7))
    target = qpos + config.max_delta * jnp.clip(action, -1, 1)
    low, high = (jnp.broadcast_to(limit, target.shape) for limit in limits)
    return jnp.clip(target, low, high)


def torques(
    arm: ArmState, goal: Float[AnyArray, "*B 7"], config: JointConfig = JOINT_POSITION
) -> Float[Array, "... 7"]:
    """Torques that pull the joints to their targets, clipped to the limits, N·m, [..., 7].

    Args:
        arm: the arm; only ``qpos``, ``qvel``, ``mass_matrix`` and ``bias`` are read.
        goal: target angles, radians, [..., 7].
        config: the controller.
    """
    damping = 2 * math.sqrt(config.kp) * config.damping_ratio
    acceleration = config.kp * (goal - arm.qpos) - damping * arm.qvel
    # Summed by hand: a GPU may multiply matrices in TF32.
    raw = jnp.sum(arm.mass_matrix * acceleration[..., None, :], axis=-1) + arm.bias
    limit = jnp.broadcast_to(jnp.asarray(config.torque_limit, raw.dtype), raw.shape)
    return jnp.clip(raw, -limit, limit)
