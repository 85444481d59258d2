"""What the 3-D view shows of one slot, taken on the environment's thread and drawn on another.

In: an environment and a slot. Out: a :class:`Look`, a copy that costs microseconds to take, from which bodies and their
poses are made later. LIBERO's slots are the meshes of the scene as images show them, or the collision geoms where
meshes are missing. Of any other environment with ``observe_objects``, such as SIMPLER, the objects are points on their
surfaces, and the end effector is a set of axes.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from vecenv.contract import BatchEnv
from vecenv.errors import VecenvError
from vecenv.libero.env import LiberoEnv
from vecenv.libero.render.cameras import stage_of
from vecenv.libero.render.culling import DRAWN_GROUPS
from vecenv.libero.render.options import RenderConfig
from vecenv.libero.render.sources import visual_source
from vecenv.libero.scene.bddl import Problem
from vecenv_eval.web.shapes3d import glb_of_bodies

# Walls would stand between the viewer and what is to be seen; "published_skin" doubles them.
_HIDDEN = ("wall", "published_skin")
_COLLISION_GROUP = 0
POINTS_NOTE = (
    "Objects are points on their collision meshes and the end effector is a set of axes: SAPIEN's scenes live in "
    "worker processes, which send the poses of objects and of the hand, but not those of the robot's links."
)


@dataclass(frozen=True)
class Body:
    """Something that moves as a whole, in its own frame: a binary glTF, or points [n, 3] in metres."""

    name: str
    glb: bytes | None = None
    points: np.ndarray | None = None


@dataclass(frozen=True)
class Model:
    """The bodies of a scene.

    Attributes:
        bodies: what is drawn.
        note: one sentence about what is not, "" for nothing.
    """

    bodies: tuple[Body, ...]
    note: str = ""


class Look(Protocol):
    """A slot at one moment."""

    @property
    def key(self) -> object:
        """Looks with equal keys show the same bodies; hashable."""
        ...

    def model(self) -> Model:
        """The bodies; may take seconds, and may be called on any thread."""
        ...

    def poses(self) -> Mapping[str, np.ndarray]:
        """Poses of bodies by name, xyz + wxyz, world frame, [7]; ``"hand"`` is the end effector's, if it is known."""
        ...


def look(env: BatchEnv, slot: int) -> Look | None:
    """A slot as it is now; None where the environment does not say, or the slot's physics has failed.

    To be called on the environment's thread.
    """
    if isinstance(env, LiberoEnv):
        return _libero(env, slot)
    return _points(env, slot)


# -- LIBERO ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _MujocoLook:
    """A slot of LIBERO."""

    env: LiberoEnv
    problem: Problem
    physics: mujoco.MjModel
    qpos: np.ndarray
    body_pos: np.ndarray
    body_quat: np.ndarray
    hand: np.ndarray

    @property
    def key(self) -> object:
        """The scene's key: tasks that share a scene share its bodies."""
        return self.problem.scene_key()

    def model(self) -> Model:
        """The bodies as images show them; their collision geoms where meshes or textures are missing."""
        config, note = self.env.config, ""
        try:
            render = config.render
            assert isinstance(render, RenderConfig)  # the environment has filled it in
            source = visual_source(config.scenes)
            shown = stage_of(self.problem, self.physics, render.lod, render.colors, source).model
            groups: tuple[int, ...] = DRAWN_GROUPS
        except VecenvError as error:
            note = f"Collision geometry is shown: {error}"
            shown, groups = self.physics, (_COLLISION_GROUP,)
        found = glb_of_bodies(shown, groups, _HIDDEN)
        return Model(tuple(Body(_body_name(body), glb=glb) for body, glb in found.items()), note)

    def poses(self) -> Mapping[str, np.ndarray]:
        """Forward kinematics of a copy of the physics model, which has the bodies of the visual one."""
        model, data = _posed(self.physics)
        model.body_pos[:], model.body_quat[:], data.qpos[:] = self.body_pos, self.body_quat, self.qpos
        mujoco.mj_kinematics(model, data)
        poses = np.concatenate([data.xpos, data.xquat], axis=1)
        return {_body_name(body): poses[body] for body in range(model.nbody)} | {"hand": self.hand}


@functools.lru_cache(maxsize=2)
def _posed(physics: mujoco.MjModel) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A copy of a model whose bodies may be moved; for the one thread that draws."""
    model = copy.copy(physics)
    return model, mujoco.MjData(model)


def _body_name(body: int) -> str:
    return f"bodies/{body}"


def _libero(env: LiberoEnv, slot: int) -> Look:
    group = env.physics.groups[int(env.scene_index[slot])]
    shown = group.shown()
    row = int(np.flatnonzero(shown.slots == slot)[0])
    qpos, pos, quat = (np.array(array[row], float) for array in (shown.qpos, shown.body_pos, shown.body_quat))
    hand = np.concatenate([each[slot] for each in env.physics.eef()])
    return _MujocoLook(env, env.problem(slot), group.scene.model, qpos, pos, quat, hand)


# -- anything that observes objects ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _PointsLook:
    """A slot of which the surfaces of its objects are known: points of bodies in the world, and the bodies' poses."""

    key: object
    clouds: Mapping[str, np.ndarray]
    at: Mapping[str, np.ndarray]
    hand: np.ndarray

    def model(self) -> Model:
        """Each body's points in its own frame."""
        bodies = [Body(name, points=_into(self.at[name], points)) for name, points in self.clouds.items()]
        return Model(tuple(bodies), POINTS_NOTE)

    def poses(self) -> Mapping[str, np.ndarray]:
        """Of the bodies and of the hand."""
        return {**self.at, "hand": self.hand}


def _points(env: BatchEnv, slot: int) -> Look | None:
    snapshot = env.observe_objects(slots=[slot]).snapshot[slot]
    if snapshot is None:
        return None
    sliding = {name: part for name, part in snapshot.parts.items() if part.joint is not None}
    moving = [part.cloud.points for part in sliding.values()]
    clouds, at = {}, {}
    for name, cloud in snapshot.objects.items():
        clouds[f"objects/{name}"] = _without(cloud.points, moving)
        at[f"objects/{name}"] = np.asarray(snapshot.poses[name], float)
    for name, part in sliding.items():
        assert part.joint is not None
        clouds[f"parts/{name}"] = part.cloud.points
        at[f"parts/{name}"] = np.append(part.joint.axis * part.joint.opened, (1.0, 0.0, 0.0, 0.0))
    around = _without(snapshot.scene.points, [cloud.points for cloud in snapshot.objects.values()])
    clouds["surroundings"], at["surroundings"] = around, np.array([0.0, 0, 0, 1, 0, 0, 0])
    key = (env.suite, tuple((name, len(points)) for name, points in clouds.items()))
    return _PointsLook(key, clouds, at, np.asarray(snapshot.ee_pose, float))


def _without(points: np.ndarray, others: list[np.ndarray]) -> np.ndarray:
    """Points that are in none of some other clouds."""
    known = {row.tobytes() for other in others for row in np.ascontiguousarray(other, float)}
    return points[[row.tobytes() not in known for row in np.ascontiguousarray(points, float)]]


def _into(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points of the world in the frame of a pose."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, np.asarray(pose[3:7], float))
    return (points - pose[:3]) @ rotation.reshape(3, 3)
