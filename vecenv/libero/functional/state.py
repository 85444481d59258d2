"""The state of one world: the physics between two steps (``Data``), and what an agent sees of it (``FunctionalState``).

Both are pytrees of stable structure and dtypes. Under ``vmap`` every leaf has a leading axis.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from vecenv.libero.functional.objectives import View
from vecenv.libero.functional.randomize import Variation
from vecenv.libero.physics.mjx.step import World


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Data:
    """The physics of one world between two steps; under ``vmap`` every leaf has a leading axis.

    The names are those of ``mjx.Data``. Kinematics and contact sensors are as of the start of the last substep.

    Attributes:
        qpos: [nq]. qvel: [nv]. time: seconds. ctrl: last actuator commands, [nu].
        qacc_warmstart: where the solver starts, [nv].
        xpos: body positions, world frame, metres, [nbody, 3]. xquat: body orientations, wxyz, [nbody, 4].
        geom_xpos: [ngeom, 3]. geom_xmat: [ngeom, 3, 3]; warp computes those of fixtures only when an episode begins.
        site_xpos: [nsite, 3]. site_xmat: [nsite, 3, 3]. sensordata: contact sensors, [nsensordata].
        world: fixture poses, controller memory, proprioception and faults (``vecenv.libero.physics.mjx.step.World``,
        no ``data``).
        start_height: height of the target's origin when the episode began, metres.
        variation: how the episode's physics and images differ from the scene's; None without randomisation.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    time: Float[Array, ""]
    ctrl: Float[Array, " nu"]
    qacc_warmstart: Float[Array, " nv"]
    xpos: Float[Array, "nbody 3"]
    xquat: Float[Array, "nbody 4"]
    geom_xpos: Float[Array, "ngeom 3"]
    geom_xmat: Float[Array, "ngeom 3 3"]
    site_xpos: Float[Array, "nsite 3"]
    site_xmat: Float[Array, "nsite 3 3"]
    sensordata: Float[Array, " nsensordata"]
    world: World
    start_height: Float[Array, ""]
    variation: Variation | None = None

    def replace(self, **changes: Any) -> Data:
        """A copy with some fields replaced."""
        return dataclasses.replace(self, **changes)

    @property
    def view(self) -> View:
        """What objectives read."""
        return View(
            qpos=self.qpos,
            xpos=self.xpos,
            xquat=self.xquat,
            site_xpos=self.site_xpos,
            site_xmat=self.site_xmat,
            touch=self.sensordata,
            gripper=self.world.gripper,
            start_height=self.start_height,
        )

    @property
    def mocap_pos(self) -> np.ndarray:
        """Mocap bodies: a LIBERO scene has none, [0, 3]. Playground's ``render_array`` asks."""
        return np.zeros((0, 3))

    @property
    def mocap_quat(self) -> np.ndarray:
        """Likewise, [0, 4]."""
        return np.zeros((0, 4))

    @property
    def xfrc_applied(self) -> np.ndarray:
        """Forces on bodies from outside: none, [nbody, 6]."""
        return np.zeros((*self.xpos.shape[:-1], 6))


# Fields that ``mjx.Data`` has too.
_OWN = ("world", "start_height", "variation")
PHYSICS_FIELDS = tuple(field.name for field in dataclasses.fields(Data) if field.name not in _OWN)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FunctionalState:
    """What an agent sees of one world, with the fields of Playground's and Brax's states.

    Attributes:
        data: the physics.
        obs: observation, float32 [n], see ``FunctionalLibero.layout``; with images a dictionary: ``"state"``, that
            vector (if anything but images is observed), ``"pixels/view_0"``, the agent's camera, and
            ``"pixels/view_1"``, the wrist's, float32 [H, W, 3] within [0, 1], as Playground and Brax name and scale
            them.
        reward: float32.
        done: 1 when the objective was achieved or the physics failed, else 0, float32. Time limits are the wrappers'.
        metrics: ``success`` and ``fault`` of this step, 0 or 1, float32; a fault is a non-finite state or exhausted
            contact memory, ends the episode and earns nothing.
        info: ``episode``, the stored start the episode began from, int32; and what wrappers add.
    """

    data: Data
    obs: Any
    reward: Float[Array, ""]
    done: Float[Array, ""]
    metrics: dict[str, jax.Array]
    info: dict[str, Any]

    def replace(self, **changes: Any) -> FunctionalState:
        """A copy with some fields replaced."""
        return dataclasses.replace(self, **changes)

    def tree_replace(self, changes: Mapping[str, Any]) -> FunctionalState:
        """A copy with nested fields replaced: ``{"data.qpos": qpos}``."""
        new = self
        for path, value in changes.items():
            new = _replaced(new, path.split("."), value)
        return new


def _replaced(base: Any, path: Sequence[str], value: Any) -> Any:
    name, *rest = path
    inner = base[name] if isinstance(base, dict) else getattr(base, name)
    changed = {name: _replaced(inner, rest, value) if rest else value}
    if isinstance(base, dict):
        return {**base, **changed}
    return getattr(base, "_replace" if isinstance(base, tuple) else "replace")(**changed)
