"""Poses of the bodies of one world for the ray tracer, computed where its images are made.

In: a physics model, a world's joint positions and the poses of its bodies in their parents. Out: the bodies' poses in
the world frame, those of ``mj_kinematics``, in single precision. A function of one world, for ``vmap`` and ``jit``. The
tree is taken level by level; bodies of a level with the same kinds of joints are computed together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from vecenv.libero.render.options import RenderError
from vecenv.util.rotations import quat_mul, quat_normalize, rotate

_FREE, _BALL, _SLIDE, _HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "BALL", "SLIDE", "HINGE")
)
# Numbers in qpos of a joint of each kind.
_WIDTH = {_FREE: 7, _BALL: 4, _SLIDE: 1, _HINGE: 1}


@dataclass(frozen=True)
class _Alike:
    """Bodies of one level that have the same kinds of joints.

    Attributes:
        bodies: their ids, [n].
        parents: rows of their parents among the bodies of the level above, [n].
        kinds: kinds of their joints, in order, J of them.
        joints: ids of these joints, [n, J].
    """

    bodies: np.ndarray
    parents: np.ndarray
    kinds: tuple[int, ...]
    joints: np.ndarray


class BodyPoses:
    """The forward kinematics of a model.

    Args:
        model: the physics model.

    Raises:
        RenderError: the model has mocap bodies, whose poses are not joints'.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        if model.nmocap:
            raise RenderError("ray-traced images need a scene without mocap bodies")
        self._model = model
        self._levels = _levels(model)
        order = np.concatenate([[0], *(alike.bodies for level in self._levels for alike in level)])
        self._order = np.argsort(order)

    def __call__(self, qpos: jax.Array, body_pos: jax.Array, body_quat: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Poses of the bodies of one world.

        Args:
            qpos: [nq].
            body_pos: positions of the bodies in their parents, metres, [nbody, 3].
            body_quat: orientations likewise, wxyz, [nbody, 4].

        Returns:
            Positions, metres, [nbody, 3], and orientations wxyz, [nbody, 4], world frame, float32.
        """
        qpos, body_pos, body_quat = (jnp.asarray(array, jnp.float32) for array in (qpos, body_pos, body_quat))
        pos, quat = jnp.zeros((1, 3), jnp.float32), jnp.asarray([[1, 0, 0, 0]], jnp.float32)
        every = [(pos, quat)]
        for level in self._levels:
            found = [self._placed(alike, pos, quat, qpos, body_pos, body_quat) for alike in level]
            pos, quat = (jnp.concatenate(parts) for parts in zip(*found, strict=True))
            every.append((pos, quat))
        pos, quat = (jnp.concatenate(parts)[self._order] for parts in zip(*every, strict=True))
        return pos, quat

    def _placed(
        self, alike: _Alike, pos: jax.Array, quat: jax.Array, qpos: jax.Array, body_pos: jax.Array, body_quat: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Poses of some bodies from those of the level above."""
        model, above = self._model, quat[alike.parents]
        pos = pos[alike.parents] + rotate(above, body_pos[alike.bodies])
        quat = quat_mul(above, body_quat[alike.bodies])
        for kind, joint in zip(alike.kinds, alike.joints.T, strict=True):
            moved = qpos[model.jnt_qposadr[joint][:, None] + np.arange(_WIDTH[kind])]
            axis, at = (jnp.asarray(array[joint], jnp.float32) for array in (model.jnt_axis, model.jnt_pos))
            if kind == _FREE:
                pos, quat = moved[:, :3], moved[:, 3:]
            elif kind == _SLIDE:
                zero = jnp.asarray(model.qpos0[model.jnt_qposadr[joint]], jnp.float32)[:, None]
                pos = pos + rotate(quat, axis) * (moved - zero)
            else:
                anchor = pos + rotate(quat, at)
                quat = quat_mul(quat, self._turn(kind, joint, moved, axis))
                pos = anchor - rotate(quat, at)
        return pos, quat_normalize(quat)[0]

    def _turn(self, kind: int, joint: np.ndarray, moved: jax.Array, axis: jax.Array) -> jax.Array:
        """Rotations of ball joints or hinges, wxyz."""
        if kind == _BALL:
            return quat_normalize(moved)[0]
        half = (moved - jnp.asarray(self._model.qpos0[self._model.jnt_qposadr[joint]], jnp.float32)[:, None]) / 2
        return jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], axis=1)


def _levels(model: mujoco.MjModel) -> Sequence[Sequence[_Alike]]:
    """The bodies below the world by their depth."""
    levels: list[list[_Alike]] = []
    above = [0]
    while True:
        bodies = [body for body in range(1, model.nbody) if int(model.body_parentid[body]) in above]
        if not bodies:
            return levels
        kinds: dict[tuple[int, ...], list[int]] = {}
        for body in bodies:
            kinds.setdefault(tuple(int(model.jnt_type[joint]) for joint in _joints(model, body)), []).append(body)
        level = [
            _Alike(
                bodies=np.array(alike),
                parents=np.array([above.index(int(model.body_parentid[body])) for body in alike]),
                kinds=kind,
                joints=np.array([_joints(model, body) for body in alike], int).reshape(len(alike), len(kind)),
            )
            for kind, alike in kinds.items()
        ]
        levels.append(level)
        above = [body for alike in level for body in alike.bodies.tolist()]


def _joints(model: mujoco.MjModel, body: int) -> list[int]:
    first = int(model.body_jntadr[body])
    return list(range(first, first + int(model.body_jntnum[body])))
