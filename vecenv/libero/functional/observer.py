"""Observations of one world: a vector of proprioception and object poses, and ray-traced camera images.

In: a scene, an objective and which observations are wanted; later a world's ``Data``. Out: a float32 vector, or with
images a dictionary of it and the images, under the names that Playground and Brax use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vecenv.libero.functional.config import PIXELS
from vecenv.libero.functional.objectives import Objective
from vecenv.libero.functional.randomize import Look
from vecenv.libero.functional.state import Data
from vecenv.libero.render.options import POLICY_CAMERAS
from vecenv.libero.render.raytrace import RayTracer, Style
from vecenv.libero.robot import ARM_DOFS, ROBOT_DOFS
from vecenv.libero.scene.scene import Scene
from vecenv.util.rotations import quat_to_mat, rotvec_to_quat

_PROPRIO = {"joint_pos": 7, "joint_vel": 7, "finger_pos": 2, "finger_vel": 2, "eef_pos": 3, "eef_quat": 4}


class Observer:
    """Puts observations of one world together.

    Args:
        scene: the compiled scene.
        objective: what the agent is to achieve; it names the target.
        names: which parts, some of ``config.OBSERVATIONS``.
        tracer: renders the images; None without images.

    Attributes:
        layout: name -> columns of the vector.
        width: number of columns; 0 when only images are observed.
    """

    def __init__(self, scene: Scene, objective: Objective, names: Sequence[str], tracer: RayTracer | None) -> None:
        self._objective, self._names, self._tracer = objective, names, tracer
        self._bodies = np.array([scene.model.body(entity.root_body).id for entity in scene.entities.values()])
        self._joints = _fixture_joints(scene)
        widths: dict[str, int] = {}
        if "proprio" in names:
            widths |= _PROPRIO
        if "objects" in names:
            widths |= {"target_offset": 3, **dict.fromkeys(scene.entities, 7), "fixture_joints": len(self._joints)}
        ends = np.cumsum(list(widths.values()))
        self.layout: Mapping[str, slice] = {
            name: slice(int(end) - width, int(end)) for (name, width), end in zip(widths.items(), ends, strict=True)
        }
        self.width = int(ends[-1]) if widths else 0

    @property
    def size(self) -> int | dict[str, tuple[int, ...]]:
        """Width of an observation; with images the shapes of its parts, as Brax wants them."""
        if self._tracer is None:
            return self.width
        shape = (self._tracer.height, self._tracer.width, 3)
        views = {f"{PIXELS}/view_{view}": shape for view in range(len(POLICY_CAMERAS))}
        return {**({"state": (self.width,)} if self.width else {}), **views}

    def __call__(self, data: Data) -> Float[Array, " n"] | dict[str, Float[Array, "..."]]:
        """The observation of one world: float32 [width], or with images a dictionary."""
        vector = self._vector(data) if self.width else None
        if self._tracer is None:
            assert vector is not None
            return vector
        look = None if data.variation is None else data.variation.look
        style = None if look is None else _style(self._tracer.plain_style, look)
        rgb = self._tracer.look(data.xpos, data.xquat, data.qpos, style).rgb
        assert rgb is not None
        views = {f"{PIXELS}/view_{camera}": image / jnp.float32(255) for camera, image in enumerate(rgb)}
        return views if vector is None else {"state": vector, **views}

    def _vector(self, data: Data) -> Float[Array, " n"]:
        """Proprioception and objects, float32 [width]; non-finite values are set to 0."""
        parts = [*(self._proprio(data) if "proprio" in self._names else ())]
        parts += self._objects(data) if "objects" in self._names else ()
        return jnp.nan_to_num(jnp.concatenate(parts).astype(jnp.float32), posinf=0.0, neginf=0.0)

    def _proprio(self, data: Data) -> list[Float[Array, " _"]]:
        arm, fingers, world = slice(0, ARM_DOFS), slice(ARM_DOFS, ROBOT_DOFS), data.world
        return [data.qpos[arm], data.qvel[arm], world.fingers, data.qvel[fingers], world.eef_pos, world.eef_quat]

    def _objects(self, data: Data) -> list[Float[Array, " _"]]:
        poses = jnp.concatenate([data.xpos[self._bodies], data.xquat[self._bodies]], axis=1)
        return [self._objective.offset(data.view), poses.reshape(-1), data.qpos[self._joints]]


def _style(plain: Style, look: Look) -> Style:
    """The ray tracer's style of a look."""
    turn = quat_to_mat(rotvec_to_quat(look.camera_turn))
    ones = jnp.ones(3, jnp.float32)
    return plain._replace(
        light=look.light * ones, lamps=look.light_shift, colors=look.color, pos=look.camera_pos, turn=turn
    )


def _fixture_joints(scene: Scene) -> Int[np.ndarray, " J"]:
    """Addresses in qpos of the joints of fixtures, int [J]."""
    joints = [scene.model.joint(joint) for entity in scene.fixtures for joint in entity.joints]
    return np.array([joint.qposadr[0] for joint in joints], int)
