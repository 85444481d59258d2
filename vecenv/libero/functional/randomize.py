"""Domain randomisation: what differs between worlds, drawn from a key inside ``jit``.

In: a ``Randomization``, a scene's model and a key. Out: ``Variation``, what one world draws for one episode, which the
environment keeps in its state (``FunctionalConfig.randomization``); and ``randomize``, a model varied for each of many
worlds once and for all, as Brax's and Playground's ``randomization_fn``. Controllers keep the nominal arm: what they
compensate is off by as much as the arm was varied.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray, UInt32
from mujoco import mjx

from vecenv.libero.functional.config import FACTORS, SPREADS, FunctionalError, Randomization
from vecenv.libero.robot import ARM_DOFS

# Told apart from the keys that ``jax.random.split`` makes, which are those of small numbers: an episode begins in the
# same start with randomisation and without.
_EPISODE, _LOOK = 0x76617279, 0x6C6F6F6B
_USUAL = Randomization()


class Look(NamedTuple):
    """How the images of one world differ, with C cameras and a scenery of I instances; under ``vmap`` every leaf has a
    leading axis.

    Attributes:
        light: scale of all light.
        light_shift: moves all lamps, metres, world frame, [3].
        color: scales of red, green and blue of each of the scenery's instances, [I, 3]; the first, whatever is no
            object, fixture or robot, keeps its colours.
        camera_pos: moves each camera in its own frame (x right, y up, looking along -z), metres, [C, 3].
        camera_turn: rotation vector of each camera in that frame, radians, [C, 3].
    """

    light: jax.Array
    light_shift: jax.Array
    color: jax.Array
    camera_pos: jax.Array
    camera_turn: jax.Array


class Variation(NamedTuple):
    """How one world differs from its scene during an episode; under ``vmap`` every leaf has a leading axis.

    Attributes:
        friction: factor on the sliding friction of all geoms.
        mass: factors on mass and inertia of each body, [nbody].
        damping, armature, frictionloss: factors on those of each degree of freedom, [nv].
        gripper: factor on stiffness and damping of the finger actuators.
        look: how images differ; None when no images are observed, or when they do not differ.
    """

    friction: jax.Array
    mass: jax.Array
    damping: jax.Array
    armature: jax.Array
    frictionloss: jax.Array
    gripper: jax.Array
    look: Look | None = None

    def fields(self, model: mjx.Model) -> dict[str, Float[Array, "..."]]:
        """The fields of a world's model that differ from ``model``."""
        fingers = jnp.where(jnp.arange(model.nu) >= ARM_DOFS, self.gripper, 1.0)[:, None]
        factors = {
            "geom_friction": jnp.stack([self.friction, *[jnp.ones_like(self.friction)] * 2])[None],
            "body_mass": self.mass,
            "body_inertia": self.mass[:, None],
            "dof_damping": self.damping,
            "dof_armature": self.armature,
            "dof_frictionloss": self.frictionloss,
            "actuator_gainprm": fingers,
            "actuator_biasprm": fingers,
        }
        nominal = {name: jnp.asarray(getattr(model, name)) for name in factors}
        return {name: nominal[name] * factor.astype(nominal[name].dtype) for name, factor in factors.items()}


class Randomizer:
    """Draws what differs in the worlds of one scene.

    Args:
        config: how much.
        instances: number of the scenery's instances.
        cameras: names of the cameras that are rendered.
    """

    def __init__(self, config: Randomization, instances: int = 0, cameras: Sequence[str] = ()) -> None:
        self._config, self._instances = config, instances
        self._moving = np.array([name in config.cameras for name in cameras], np.float32).reshape(-1, 1)

    def episode(self, model: mjx.Model, rng: PRNGKeyArray) -> Variation:
        """What one world draws for the episode that begins with the key ``rng``."""
        own = jax.random.fold_in(rng, _EPISODE)
        look = self._look(jax.random.fold_in(own, _LOOK)) if self._config.visual else None
        return _physics(model, own, self._config)._replace(look=look)

    def _look(self, rng: PRNGKeyArray) -> Look:
        keys = dict(zip(SPREADS, jax.random.split(rng, len(SPREADS)), strict=True))

        def within(name: str, shape: tuple[int, ...]) -> Float[Array, "..."]:
            spread = getattr(self._config, name)
            return jax.random.uniform(keys[name], shape, jnp.float32, -spread, spread)

        coloured, moving = np.arange(self._instances)[:, None] > 0, jnp.asarray(self._moving)
        return Look(
            light=1 + within("light", ()),
            light_shift=within("light_shift", (3,)),
            color=1 + jnp.where(coloured, within("color", (self._instances, 3)), 0.0),
            camera_pos=moving * within("camera_pos", (len(moving), 3)),
            camera_turn=moving * within("camera_turn", (len(moving), 3)),
        )


def _physics(model: mjx.Model, rng: PRNGKeyArray, config: Randomization) -> Variation:
    """The factors of one world."""
    keys: dict[str, jax.Array] = dict(zip(FACTORS, jax.random.split(rng, len(FACTORS)), strict=True))
    bodies, dofs = (model.nbody,), (model.nv,)

    def factor(name: str, shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        low, high = getattr(config, name)
        return jax.random.uniform(keys[name], shape, minval=low, maxval=high)

    return Variation(
        friction=factor("friction"),
        mass=factor("mass", bodies),
        damping=factor("damping", dofs),
        armature=factor("armature", dofs),
        frictionloss=factor("frictionloss", dofs),
        gripper=factor("gripper"),
    )


def randomize(
    model: mjx.Model, rng: Key[Array, " n"] | UInt32[Array, "n 2"], config: Randomization = _USUAL
) -> tuple[mjx.Model, mjx.Model]:
    """Vary a model for each of n worlds, as Brax's and Playground's ``randomization_fn``: their physics, for all
    episodes.

    Where the environment has a ``FunctionalConfig.randomization`` too, factors multiply.

    Args:
        model: ``env.mjx_model``.
        rng: n keys.
        config: how much.

    Returns:
        The model with a leading axis n on what varies, and which leaves have it: ``in_axes`` for ``vmap``.

    Raises:
        FunctionalError: ``config`` varies images, which are no part of the model.
    """
    if config.visual:
        raise FunctionalError(
            f"randomize varies physics, not {', '.join(config.visual)}: images differ with "
            "FunctionalConfig(randomization=...)"
        )
    varied = jax.vmap(lambda key: _physics(model, key, config).fields(model))(rng)
    axes = jax.tree.map(lambda _: None, model)
    return model.tree_replace(varied), axes.tree_replace(dict.fromkeys(varied, 0))
