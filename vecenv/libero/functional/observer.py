"""Observations of one world: a vector of proprioception and object poses, and ray-traced camera images.

In: a scene, an objective and which observations are wanted; later a world's ``Data``. Out: a float32 vector, or with
images a dictionary of it and the images, under the names that Playground and Brax use. A batch of ``vecenv.make`` is
observed in the same way, so that a policy learnt here acts there.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from vecenv.libero.functional.config import PIXELS, FunctionalError
from vecenv.libero.functional.objectives import Objective, View
from vecenv.libero.functional.randomize import Look
from vecenv.libero.functional.state import Data
from vecenv.libero.physics.base import Physics
from vecenv.libero.render.options import POLICY_CAMERAS
from vecenv.libero.render.raytrace import RayTracer, Style
from vecenv.libero.robot import ARM_DOFS, ROBOT_DOFS
from vecenv.libero.scene.scene import Scene
from vecenv.util.rotations import quat_to_mat, rotvec_to_quat

_PROPRIO = {"joint_pos": 7, "joint_vel": 7, "finger_pos": 2, "finger_vel": 2, "eef_pos": 3, "eef_quat": 4}


class Robot(NamedTuple):
    """What is observed of the robot besides positions; as robosuite's observables report it.

    Attributes:
        qvel: velocities of all joints, [nv].
        fingers: finger positions, metres, [2].
        eef_pos: position of the end effector, metres, world frame, [3].
        eef_quat: orientation of the hand, wxyz, [4].
    """

    qvel: Float[Array, " nv"]
    fingers: Float[Array, "2"]
    eef_pos: Float[Array, "3"]
    eef_quat: Float[Array, "4"]


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
        self._model, self._objective, self._names, self._tracer = scene.model, objective, names, tracer
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
        world = data.world
        robot = Robot(data.qvel, world.fingers, world.eef_pos, world.eef_quat)
        vector = self._vector(data.view, robot) if self.width else None
        if self._tracer is None:
            assert vector is not None
            return vector
        look = None if data.variation is None else data.variation.look
        style = None if look is None else _style(self._tracer.plain_style, look)
        rgb = self._tracer.look(data.xpos, data.xquat, data.qpos, style).rgb
        assert rgb is not None
        views = {f"{PIXELS}/view_{camera}": image / jnp.float32(255) for camera, image in enumerate(rgb)}
        return views if vector is None else {"state": vector, **views}

    def of_batch(self, physics: Physics, slots: Sequence[int]) -> Float[np.ndarray, "slots width"]:
        """The vectors of some slots of a batch; NumPy, float32.

        Raises:
            FunctionalError: images are observed, or one of the slots simulates another scene.
        """
        if self._tracer is not None:
            raise FunctionalError(f"obs={self._names}: of a batch only vectors can be observed, not {PIXELS!r}")
        made = np.zeros((physics.num_envs, self.width), np.float32)
        for number, group in enumerate(physics.groups):
            rows = np.flatnonzero(np.isin(group.slots, slots))
            if len(rows) and not _alike(group.scene.model, self._model):
                raise FunctionalError(
                    f"slot {group.slots[rows[0]]} simulates another scene, with {', '.join(group.scene.entities)}"
                )
            if len(rows):
                made[group.slots[rows]] = self._vectors(*_views(physics, number, rows))
        return made[list(slots)]

    @functools.cached_property
    def _vectors(self) -> jax.stages.Wrapped:
        return jax.jit(jax.vmap(self._vector))

    def _vector(self, view: View, robot: Robot) -> Float[Array, " n"]:
        """Proprioception and objects, float32 [width]; non-finite values are set to 0."""
        parts = [*(_proprio(view, robot) if "proprio" in self._names else ())]
        parts += self._objects(view) if "objects" in self._names else ()
        return jnp.nan_to_num(jnp.concatenate(parts).astype(jnp.float32), posinf=0.0, neginf=0.0)

    def _objects(self, view: View) -> list[Float[Array, " _"]]:
        poses = jnp.concatenate([view.xpos[self._bodies], view.xquat[self._bodies]], axis=1)
        return [self._objective.offset(view), poses.reshape(-1), view.qpos[self._joints]]


def _proprio(view: View, robot: Robot) -> list[Float[Array, " _"]]:
    arm, fingers = slice(0, ARM_DOFS), slice(ARM_DOFS, ROBOT_DOFS)
    return [view.qpos[arm], robot.qvel[arm], robot.fingers, robot.qvel[fingers], robot.eef_pos, robot.eef_quat]


def _views(physics: Physics, number: int, rows: np.ndarray) -> tuple[View, Robot]:
    """What is observed of some slots of a group, float32; leaves have a leading axis."""
    group = physics.groups[number]
    slots, none = group.slots[rows], np.zeros(len(rows))
    view: dict[str, Any] = {
        "qpos": group.qpos[rows],
        "xpos": group.xpos[rows],
        "xquat": group.xquat[rows],
        "site_xpos": group.site_xpos[rows],
        "site_xmat": group.site_xmat[rows].reshape(len(rows), -1, 3, 3),
        "touch": group.touch[rows],
        "gripper": np.stack([none, none], axis=1),
        "start_height": none,
    }
    robot: list[Any] = [group.qvel[rows], physics.fingers[slots], physics.eef_pos[slots], physics.eef_quat[slots]]
    return jax.tree.map(lambda x: np.asarray(x, np.float32), (View(**view), Robot(*robot)))


@functools.lru_cache(maxsize=64)
def _alike(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Whether two models have the same bodies, joints and sites; their geoms may differ."""

    def names(model: mujoco.MjModel) -> list[list[str]]:
        parts = ((model.nbody, model.body), (model.njnt, model.joint), (model.nsite, model.site))
        return [[part(index).name for index in range(count)] for count, part in parts]

    return one is other or names(one) == names(other)


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
