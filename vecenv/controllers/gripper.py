"""The Panda gripper's command: an integrated position target for the two fingers.

In: the sign of the policy's gripper action, once per physics substep. Out: the integrated state of each slot and the
two position-actuator commands. robosuite 1.4.0 calls this ``PandaGripper.format_action`` and
``Manipulator.grip_action``. +1 closes, -1 opens, 0 keeps the target. A state of 0 (the start of an episode) is a
half-open hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float, Real

from vecenv.util.arrays import AnyArray
from vecenv.util.rotations import require_tail


@dataclass(frozen=True, kw_only=True)
class GripperConfig:
    """Numbers of the PandaGripper.

    Attributes:
        speed: change of the state per physics substep.
        ctrl_low: lower end of each finger's actuator range, metres.
        ctrl_high: upper end of each finger's actuator range, metres.
    """

    speed: float = 0.01
    ctrl_low: tuple[float, float] = (0.0, -0.04)
    ctrl_high: tuple[float, float] = (0.04, 0.0)


PANDA_GRIPPER = GripperConfig()
# The fingers move in opposite directions: closing lowers the first target and raises the second.
_CLOSING = (-1.0, 1.0)


def integrate(
    state: Float[AnyArray, "*#B 2"], action: Real[AnyArray, "*#B"], config: GripperConfig = PANDA_GRIPPER
) -> Float[Array, "... 2"]:
    """Advance the gripper state by one physics substep.

    Args:
        state: normalised finger targets, [..., 2] in [-1, 1]; zeros at the start of an episode.
        action: gripper action, [...]; only its sign counts.
        config: the gripper.

    Returns:
        The next state, [..., 2].

    Raises:
        ValueError: ``state`` does not end in 2.
    """
    state, action = jnp.asarray(state), jnp.asarray(action)
    require_tail("gripper state", state, (2,))
    step = [config.speed * side for side in _CLOSING]
    direction = jnp.sign(action).astype(state.dtype)
    return jnp.clip(state + jnp.stack([speed * direction for speed in step], axis=-1), -1, 1)


def command(state: Float[AnyArray, "*B 2"], config: GripperConfig = PANDA_GRIPPER) -> Float[Array, "*B 2"]:
    """Position targets of the finger actuators.

    Args:
        state: normalised finger targets, [..., 2] in [-1, 1].
        config: the gripper.

    Returns:
        Actuator commands in metres, [..., 2], within the actuator ranges.

    Raises:
        ValueError: ``state`` does not end in 2.
    """
    state = jnp.asarray(state)
    require_tail("gripper state", state, (2,))
    middle = [0.5 * (high + low) for low, high in zip(config.ctrl_low, config.ctrl_high, strict=True)]
    half = [0.5 * (high - low) for low, high in zip(config.ctrl_low, config.ctrl_high, strict=True)]
    return jnp.stack([middle[i] + half[i] * state[..., i] for i in range(2)], axis=-1)
