"""Domain randomisation: a model varied for each of many worlds, as Brax's and Playground's ``randomization_fn``."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PRNGKeyArray, UInt32
from mujoco import mjx

from vecenv.libero.functional.config import FunctionalError
from vecenv.libero.robot import ARM_DOFS


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """How much ``randomize`` varies a model: for each quantity the lower and upper factor, drawn uniformly.

    Attributes:
        friction: sliding friction of all geoms, one factor a world.
        mass: mass and inertia of each movable object and each link of the robot, a factor each.
        damping: damping of each joint.
        armature: rotor inertia of each joint.
        frictionloss: dry friction of each joint.
        gripper: strength of the finger actuators (their stiffness and damping), one factor a world.
    """

    friction: tuple[float, float] = (0.7, 1.3)
    mass: tuple[float, float] = (0.8, 1.2)
    damping: tuple[float, float] = (0.7, 1.3)
    armature: tuple[float, float] = (0.95, 1.05)
    frictionloss: tuple[float, float] = (0.7, 1.3)
    gripper: tuple[float, float] = (0.8, 1.2)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            low, high = getattr(self, field.name)
            if not 0 < low <= high:
                raise FunctionalError(f"{field.name}=({low}, {high}): expected 0 < lower <= upper factor")


def randomize(
    model: mjx.Model, rng: Key[Array, " n"] | UInt32[Array, "n 2"], config: Randomization = Randomization()
) -> tuple[mjx.Model, mjx.Model]:
    """Vary a model for each of n worlds, as Brax's and Playground's ``randomization_fn``.

    The controllers keep the nominal arm: what they compensate is off by as much as the arm was varied.

    Args:
        model: ``env.mjx_model``.
        rng: n keys.
        config: how much.

    Returns:
        The model with a leading axis n on what varies, and which leaves have it: ``in_axes`` for ``vmap``.
    """
    varied = jax.vmap(functools.partial(_varied, model, config=config))(rng)
    axes = jax.tree.map(lambda _: None, model)
    return model.tree_replace(varied), axes.tree_replace(dict.fromkeys(varied, 0))


def _varied(model: mjx.Model, rng: PRNGKeyArray, *, config: Randomization) -> dict[str, Float[Array, "..."]]:
    """Fields of one world."""
    keys = dict(zip((field.name for field in dataclasses.fields(config)), jax.random.split(rng, 6), strict=True))

    def factor(name: str, shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        low, high = getattr(config, name)
        return jax.random.uniform(keys[name], shape, minval=low, maxval=high)

    mass = factor("mass", (model.nbody,))
    fingers = jnp.where(jnp.arange(model.nu) >= ARM_DOFS, factor("gripper"), 1.0)[:, None]
    return {
        "geom_friction": model.geom_friction * jnp.stack([factor("friction"), *[jnp.ones(())] * 2])[None],
        "body_mass": model.body_mass * mass,
        "body_inertia": model.body_inertia * mass[:, None],
        "dof_damping": model.dof_damping * factor("damping", (model.nv,)),
        "dof_armature": model.dof_armature * factor("armature", (model.nv,)),
        "dof_frictionloss": model.dof_frictionloss * factor("frictionloss", (model.nv,)),
        "actuator_gainprm": model.actuator_gainprm * fingers,
        "actuator_biasprm": model.actuator_biasprm * fingers,
    }
