"""Physics of one world as functions that may be mapped over any number of worlds.

In: a scene built for MJX, a start (``starts.Begin``) or the state before a step and an action. Out: ``Data``. MuJoCo
Warp's contact memory belongs to the whole batch: it is made inside each step, as large as the batch that the step is
mapped over. Joint control (``joint_step``) stands beside the operational-space control of the batched environment.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PyTree
from mujoco import mjx

from vecenv.controllers import gripper as gripper_control
from vecenv.controllers import joint as joint_control
from vecenv.controllers import kinematics
from vecenv.libero.functional.starts import Begin
from vecenv.libero.functional.state import PHYSICS_FIELDS, Data
from vecenv.libero.physics.base import OBSERVED_FINGERS, OBSERVED_POSE, SUBSTEPS
from vecenv.libero.physics.mjx import model as mjx_model
from vecenv.libero.physics.mjx import step as mjx_step
from vecenv.libero.physics.mjx.model import System
from vecenv.libero.physics.mjx.step import World
from vecenv.libero.robot import ARM_DOFS, ROBOT_DOFS
from vecenv.libero.tasks import settled as settled_starts
from vecenv.util.arrays import AnyArray
from vecenv.util.mapped import Sized


@dataclass(frozen=True)
class _Filled:
    """An array of one value, made where it is used rather than kept."""

    shape: tuple[int, ...]
    dtype: np.dtype
    value: float | int | bool


def _recipe(data: mjx.Data) -> Callable[[], mjx.Data]:
    """Makes a copy of some data inside a trace; large uniform arrays do not become constants of the program."""
    leaves, treedef = jax.tree.flatten(data)
    kept = [_filled_or_kept(np.asarray(leaf)) for leaf in leaves]

    def make() -> mjx.Data:
        made = [jnp.full(x.shape, x.value, x.dtype) if isinstance(x, _Filled) else jnp.asarray(x) for x in kept]
        return jax.tree.unflatten(treedef, made)

    return make


def _filled_or_kept(array: np.ndarray) -> np.ndarray | _Filled:
    uniform = array.size > 0 and bool((array == array.flat[0]).all())
    return _Filled(array.shape, array.dtype, array.flat[0].item()) if uniform else array


class WorldPhysics:
    """Begins and advances worlds of one scene.

    Args:
        built: the scene.
        action: a key of ``config.ACTIONS``.
    """

    def __init__(self, built: mjx_model.Build, action: str) -> None:
        self._built = built
        limits = built.scene.model.jnt_range[:ARM_DOFS].T.astype(np.float32)
        self._act = mjx_step.control_step if action == "osc" else functools.partial(joint_step, limits=limits)
        self._blanks: dict[int, Callable[[], mjx.Data]] = {}
        # Only warp's contact memory is shared by a batch, and only jax can be differentiated.
        sized = built.impl == "warp"
        self.begin = self._sized(self._begin) if sized else functools.partial(self._alone, self._begin)
        self.advance = self._sized(self._advance) if sized else functools.partial(self._alone, self._advance)

    def _sized(self, function: Callable[..., Data]) -> Callable[..., Data]:
        return Sized(function, lambda num_worlds: self._blank(num_worlds)())

    def _alone(self, function: Callable[..., Data], *args: PyTree) -> Data:
        return function(self._blank(1)(), *args)

    def _blank(self, num_worlds: int) -> Callable[[], mjx.Data]:
        if num_worlds not in self._blanks:
            with jax.ensure_compile_time_eval():
                self._blanks[num_worlds] = _recipe(self._built.blank(num_worlds))
        return self._blanks[num_worlds]

    def _system(self, model: mjx.Model) -> System:
        return self._built.system._replace(model=model)

    def _begin(self, blank: mjx.Data, model: mjx.Model, start: Begin) -> Data:
        system = self._system(model)
        world = mjx_step.new_world(system, blank)._replace(body_pos=start.body_pos, body_quat=start.body_quat)
        time = jnp.asarray(settled_starts.TIME, start.qpos.dtype)
        return _kept(mjx_step.start_world(system, world, start.qpos, start.qvel, time, jnp.asarray(True)))

    def _advance(self, blank: mjx.Data, model: mjx.Model, data: Data, action: Float[Array, " n"]) -> Data:
        full = blank.replace(**{name: getattr(data, name) for name in PHYSICS_FIELDS})
        after = self._act(self._system(model), data.world._replace(data=full), action)
        return _kept(after).replace(start_height=data.start_height, variation=data.variation)


def _kept(world: World) -> Data:
    """What a step needs from the one before."""
    physics = {name: getattr(world.data, name) for name in PHYSICS_FIELDS}
    return Data(**physics, world=world._replace(data=None), start_height=jnp.zeros_like(world.data.qpos[0]))


def joint_step(system: System, world: World, action: Float[AnyArray, "8"], *, limits: Float[AnyArray, "2 7"]) -> World:
    """One control step of one world under joint control: 25 substeps, 50 ms.

    Args:
        system: what worlds share.
        world: the world.
        action: [8], finite, within [-1, 1]: seven joints (``vecenv.controllers.joint``), gripper (+1 closes).
        limits: lower and upper joint limits, radians, [2, 7].
    """
    with jax.default_matmul_precision("highest"):
        return _joint_step(system, world, jnp.asarray(action, world.gripper.dtype), jnp.asarray(limits))


def _joint_step(system: System, world: World, action: Float[Array, "8"], limits: Float[Array, "2 7"]) -> World:
    model = system.model.replace(body_pos=world.body_pos, body_quat=world.body_quat)
    goal = joint_control.set_goal(world.data.qpos[:ARM_DOFS], action[:ARM_DOFS], limits.astype(action.dtype))

    def advance(carry: tuple[mjx.Data, Float[Array, "2"], Int[Array, ""]], _: None) -> tuple[Any, Any]:
        data, fingers, fault = carry
        robot = data.qpos[:ROBOT_DOFS]
        arm = kinematics.arm_state(system.chain, robot, data.qvel[:ROBOT_DOFS])
        seen = (*kinematics.hand_pose(system.chain, robot), robot[ARM_DOFS:])
        fingers = gripper_control.integrate(fingers, action[ARM_DOFS])
        ctrl = jnp.concatenate([joint_control.torques(arm, goal), gripper_control.command(fingers)])
        data = mjx_step.substep(model, data.replace(ctrl=ctrl.astype(data.ctrl.dtype)))
        return (data, fingers, fault | mjx_step.overflow_bits(data)), seen

    carry = (world.data, world.gripper, jnp.zeros((), jnp.int32))
    (data, fingers, fault), (pos, quat, finger_pos) = lax.scan(advance, carry, None, SUBSTEPS)
    fault = fault | jnp.where(mjx_step.is_stable(data), 0, mjx_step.UNSTABLE)
    return world._replace(
        data=data,
        gripper=fingers,
        stale=jnp.zeros_like(world.stale),
        eef_pos=pos[OBSERVED_POSE],
        eef_quat=quat[OBSERVED_POSE],
        fingers=finger_pos[OBSERVED_FINGERS],
        fault=world.fault | fault.astype(jnp.int32),
    )
