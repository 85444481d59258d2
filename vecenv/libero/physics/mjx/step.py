"""One world of a scene on MJX and its control step: 25 substeps of controller and physics in one scan.

In: what all worlds share (``System``), and one world's state, fixture poses and controller memory (``World``). Out: the
same after a control step. The functions are pure functions of one world, for ``vmap``, ``jit``, ``scan`` and ``grad``.

When each value is read follows robosuite 1.4.0, as in ``vecenv.libero.physics.native``: goals see the kinematics and
contacts at the start of the last substep, proprioception is the sample of the 24th.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from mujoco import mjx

from vecenv.controllers import gripper as gripper_control
from vecenv.controllers import kinematics, osc, waypoint
from vecenv.libero.physics import newton
from vecenv.libero.physics.base import OBSERVED_FINGERS, OBSERVED_POSE, SUBSTEPS
from vecenv.libero.physics.mjx.blocks import for_worlds
from vecenv.libero.physics.mjx.fusion import level_by_level
from vecenv.libero.physics.mjx.model import ROBOT_JOINTS, System
from vecenv.libero.physics.mjx.options import is_deterministic
from vecenv.libero.scene import goals
from vecenv.util.rotations import quat_to_mat

# Gripper targets after a quarter of a second of the action -1.
_OPEN = (1.0, -1.0)
# Velocities from here on are what MuJoCo's mj_checkVel calls unstable.
_HUGE = mujoco.mjMAXVAL


class World(NamedTuple):
    """One world; under ``vmap`` every leaf has a leading axis.

    Attributes:
        data: physics state and, as of the last substep's start, kinematics and contacts.
        body_pos: body positions in their parents, metres, [nbody, 3]; fixtures differ between worlds.
        body_quat: likewise, wxyz, [nbody, 4].
        goal: the arm controller's goal.
        gripper: integrated finger targets, [2].
        stale: the controller still sees the arm of the reset, bool.
        eef_pos: end-effector position as robosuite's observables report it, metres, [3].
        eef_quat: hand orientation likewise, wxyz, [4].
        fingers: finger positions likewise, metres, [2].
        seen_qpos: positions as camera images show them, those of ``eef_pos``, [nq].
        fault: bits of ``FAULTS``, 0 while healthy, int32.
    """

    data: mjx.Data
    body_pos: jax.Array
    body_quat: jax.Array
    goal: osc.OscGoal
    gripper: jax.Array
    stale: jax.Array
    eef_pos: jax.Array
    eef_quat: jax.Array
    fingers: jax.Array
    seen_qpos: jax.Array
    fault: jax.Array


# Bits of World.fault and what they mean. The first five are MuJoCo Warp's own (mujoco_warp OverflowType); those that
# only say that a solver stopped at its iteration limit are no fault.
FAULTS = {
    1 << 0: "more constraint rows than the budget njmax",
    1 << 1: "more constraint Jacobian entries than the budget",
    1 << 2: "more candidate pairs in the batch than the budget naconmax",
    1 << 3: "more contacts than the budget (naconmax for the batch on warp, max_contact_points on jax)",
    1 << 6: "more contacts for a contact sensor than it can match",
    1 << 30: "non-finite or huge state",
}
UNSTABLE = 1 << 30
_CROWDED = 1 << 3
_WARP_BITS = sum(bit for bit in FAULTS if bit != UNSTABLE)


def fault_text(bits: int) -> str:
    """The bits of ``World.fault`` in words."""
    return "; ".join(text for bit, text in FAULTS.items() if bits & bit)


def new_world(system: System, blank: mjx.Data) -> World:
    """A world at the model's initial state, its controller as after a reset."""
    model, home = system.model, system.home
    return World(
        data=blank,
        body_pos=model.body_pos,
        body_quat=model.body_quat,
        goal=osc.hold_goal(home),
        gripper=jnp.zeros(2, home.qpos.dtype),
        stale=jnp.ones((), bool),
        eef_pos=jnp.zeros(3, home.qpos.dtype),
        eef_quat=jnp.zeros(4, home.qpos.dtype),
        fingers=jnp.zeros(2, home.qpos.dtype),
        seen_qpos=jnp.zeros_like(blank.qpos),
        fault=jnp.zeros((), jnp.int32),
    )


def start_world(
    system: System, world: World, qpos: jax.Array, qvel: jax.Array, time: jax.Array, settled: jax.Array
) -> World:
    """The world at the start of an episode.

    Args:
        system: what worlds share.
        world: any world of the scene, with the fixture poses of the episode.
        qpos: [nq]. qvel: [nv]. time: seconds.
        settled: bool; see ``vecenv.libero.physics.base.Start``.
    """
    fresh = new_world(system, world.data)
    data = cleared(world.data, qpos, qvel, time)
    opened = jnp.asarray(_OPEN, fresh.gripper.dtype)
    world = fresh._replace(
        data=_placed(system, world._replace(data=data)),
        body_pos=world.body_pos,
        body_quat=world.body_quat,
        gripper=jnp.where(settled, opened, 0.0),
        stale=~jnp.asarray(settled),
    )
    return observe(system, world)


def cleared(data: mjx.Data, qpos: jax.Array, qvel: jax.Array, time: jax.Array) -> mjx.Data:
    """Data with this state; controls, warm start and overflow bits are reset."""
    update = {
        "qpos": jnp.asarray(qpos, data.qpos.dtype),
        "qvel": jnp.asarray(qvel, data.qvel.dtype),
        "time": jnp.asarray(time, data.time.dtype).reshape(data.time.shape),
        "ctrl": jnp.zeros_like(data.ctrl),
        "qacc_warmstart": jnp.zeros_like(data.qacc_warmstart),
    }
    if data.impl == mjx.Impl.WARP:
        update["_impl.overflow"] = jnp.zeros_like(data._impl.overflow)
    return data.tree_replace(update)


def sensed(system: System, data: mjx.Data) -> mjx.Data:
    """Data whose contact sensors hold the number of contacts, with ``impl="jax"`` too."""
    if system.touching is None or not system.touching.shape[0]:
        return data
    contact = data._impl.contact
    if contact.dist.shape[0] == 0:
        return data.replace(sensordata=jnp.zeros_like(data.sensordata))
    first, second = (system.touching[:, :, contact.geom[:, side]] for side in (0, 1))
    between = (first[:, 0] & second[:, 1]) | (first[:, 1] & second[:, 0])
    found = between & (contact.dist < contact.includemargin)
    return data.replace(sensordata=found.sum(1).astype(data.sensordata.dtype))


def forward(system: System, world: World) -> mjx.Data:
    """Data with kinematics, contacts and contact sensors of the current state."""
    model = _own_model(system, world)
    with jax.default_matmul_precision("highest"):
        if world.data.impl == mjx.Impl.WARP:
            return mjx.forward(model, world.data)
        with level_by_level():
            return sensed(system, mjx.collision(model, mjx.kinematics(model, world.data)))


def _placed(system: System, world: World) -> mjx.Data:
    """``forward`` for bodies that may have moved.

    Warp computes geoms that are fixed to the world once, when data is made, wherever ``body_pos`` puts their bodies
    later: a fixture would collide where the model has it. Here they follow their bodies.
    """
    data = forward(system, world)
    if data.impl != mjx.Impl.WARP:
        return data
    model = system.model
    body = np.asarray(model.geom_bodyid)
    fixed = (np.asarray(model.body_weldid)[body] == 0)[:, None]
    carried = for_worlds(_carried, is_deterministic(model))
    pose = data.xpos[body], data.xmat.reshape(-1, 3, 3)[body]
    pos, mat = carried((model.geom_pos, model.geom_quat), pose)
    xpos = jnp.where(fixed, pos, data.geom_xpos)
    xmat = jnp.where(fixed[..., None], mat, data.geom_xmat.reshape(-1, 3, 3)).reshape(data.geom_xmat.shape)
    return forward(system, world._replace(data=data.replace(geom_xpos=xpos, geom_xmat=xmat)))


_Pose: TypeAlias = tuple[jax.Array, jax.Array]


def _carried(geoms: _Pose, bodies: _Pose) -> _Pose:
    """Positions [ngeom, 3] and rotations [ngeom, 3, 3] of geoms, from those in their bodies and of the bodies."""
    pos, turned = bodies
    own = jax.vmap(quat_to_mat)(geoms[1])
    return pos + (turned * geoms[0][:, None]).sum(-1), (turned[..., None] * own[:, None]).sum(-2)


def _own_model(system: System, world: World) -> mjx.Model:
    return system.model.replace(body_pos=world.body_pos, body_quat=world.body_quat)


def observe(system: System, world: World) -> World:
    """The world with its proprioception taken from the current state."""
    robot = world.data.qpos[:ROBOT_JOINTS]
    pos, quat = for_worlds(kinematics.hand_pose, is_deterministic(system.model))(system.chain, robot)
    return world._replace(eef_pos=pos, eef_quat=quat, fingers=robot[7:], seen_qpos=world.data.qpos)


# Data, finger targets and fault bits between substeps.
_Carry: TypeAlias = tuple[mjx.Data, jax.Array, jax.Array]


def control_step(system: System, world: World, action: jax.Array, active: ArrayLike = True) -> World:
    """One control step of one world: 25 substeps of controller and physics, 50 ms.

    Args:
        system: what worlds share.
        world: the world.
        action: [7], finite, within [-1, 1]: position, rotation vector, gripper (+1 closes).
        active: False keeps the state, controller and proprioception as they are.
    """
    with jax.default_matmul_precision("highest"):
        return _control_step(system, world, jnp.asarray(action, world.gripper.dtype), jnp.asarray(active))


def _control_step(system: System, world: World, action: jax.Array, active: jax.Array) -> World:
    model = _own_model(system, world)
    goal = _new_goal(system, world, action)
    commands = for_worlds(_commands, is_deterministic(system.model))

    def advance(carry: _Carry, index: jax.Array) -> tuple[_Carry, tuple[jax.Array, ...]]:
        data, fingers, fault = carry
        robot, speed = data.qpos[:ROBOT_JOINTS], data.qvel[:ROBOT_JOINTS]
        stale = world.stale & (index == 0)
        pose, ctrl, fingers = commands((system.chain, system.home), (robot, speed, goal, stale, fingers, action[6]))
        seen = (*pose, robot[7:], data.qpos)
        data = substep(model, data.replace(ctrl=ctrl.astype(data.ctrl.dtype)))
        return (data, fingers, fault | overflow_bits(data)), seen

    carry = (world.data, world.gripper, jnp.zeros((), jnp.int32))
    (data, fingers, fault), seen = lax.scan(advance, carry, jnp.arange(SUBSTEPS))
    data, fault = sensed(system, data), fault | jnp.where(is_stable(data), 0, UNSTABLE)
    pos, quat, finger_pos, qpos = seen
    after = world._replace(
        goal=goal,
        gripper=fingers,
        stale=jnp.zeros_like(world.stale),
        eef_pos=pos[OBSERVED_POSE],
        eef_quat=quat[OBSERVED_POSE],
        fingers=finger_pos[OBSERVED_FINGERS],
        seen_qpos=qpos[OBSERVED_POSE],
        fault=world.fault | fault.astype(jnp.int32),
    )
    small = jax.tree.map(
        lambda new, old: jnp.where(active, new, old), after._replace(data=None), world._replace(data=None)
    )
    return small._replace(data=_keep_state(active, data, world.data))


_Arm: TypeAlias = tuple[kinematics.Chain, osc.ArmState]


def _commands(shared: _Arm, world: tuple[Any, ...]) -> tuple[_Pose, jax.Array, jax.Array]:
    """Pose of the hand, controls [9] and finger targets [2] of a substep.

    Args:
        shared: the arm's constants, and the arm at home.
        world: joint positions and velocities [9], goal, whether the controller still sees the arm of the reset, finger
            targets [2], and the gripper's action.
    """
    chain, home = shared
    robot, speed, goal, stale, fingers, grip = world
    arm = kinematics.arm_state(chain, robot, speed)
    torque = osc.torques(_as_remembered(home, arm, stale), goal, home.qpos)
    fingers = gripper_control.integrate(fingers, grip)
    ctrl = jnp.concatenate([torque, gripper_control.command(fingers)])
    return kinematics.hand_pose(chain, robot), ctrl, fingers


def substep(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """``mjx.step`` without sensors; with ``impl="jax"`` the constraints are solved by
    ``vecenv.libero.physics.newton``."""
    if data.impl == mjx.Impl.WARP:
        return mjx.step(model, data)
    with level_by_level():
        for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration, newton.solve):
            data = stage(model, data)
    # In jaxlib 0.10, threads of XLA's pool wait for parts of a batched Cholesky factorisation that the same pool has
    # yet to compute. On two threads, the solver's factorisation and the integrator's, which is independent of it,
    # deadlock when they run at the same time. Adding 0 x acceleration makes the integrator wait for the solver; XLA
    # does not fold it away, because the acceleration may be non-finite.
    with level_by_level():
        return mjx.euler(model, data.tree_replace({"_impl.M": data._impl.M + 0 * data.qacc[:1]}))


STATE = (
    "qpos",
    "qvel",
    "time",
    "qacc_warmstart",
    "ctrl",
    "xpos",
    "xquat",
    "xmat",
    "site_xpos",
    "site_xmat",
    "sensordata",
)


def _keep_state(active: jax.Array, new: mjx.Data, old: mjx.Data) -> mjx.Data:
    """``new`` where active; else the state and kinematics of ``old`` (every step recomputes the rest)."""
    kept = {name: jnp.where(active, getattr(new, name), getattr(old, name)) for name in STATE}
    return new.replace(**kept)


def _new_goal(system: System, world: World, action: jax.Array) -> osc.OscGoal:
    robot, speed = world.data.qpos[:ROBOT_JOINTS], world.data.qvel[:ROBOT_JOINTS]
    goal_of = for_worlds(_goal_of, is_deterministic(system.model))
    return goal_of((system.chain, system.home), (robot, speed, world.stale, world.goal, action[:6]))


def _goal_of(shared: _Arm, world: tuple[Any, ...]) -> osc.OscGoal:
    """The goal after an action, from joint positions and velocities [9], ``World.stale``, the goal before, and it."""
    robot, speed, stale, goal, action = world
    arm = kinematics.arm_state(shared[0], robot, speed)
    return osc.set_goal(_as_remembered(shared[1], arm, stale), goal, action)


def _as_remembered(home: osc.ArmState, arm: osc.ArmState, stale: jax.Array) -> osc.ArmState:
    """The arm as the controller sees it: while stale, that of the reset, except for the bias torques."""
    chosen = jax.tree.map(lambda reset, now: jnp.where(stale, reset, now), home, arm)
    return chosen._replace(bias=arm.bias)


def overflow_bits(data: mjx.Data) -> jax.Array:
    """Bits of ``FAULTS`` that this substep set, int32."""
    if data.impl == mjx.Impl.WARP:
        return (data._impl.overflow.reshape(-1)[0] & _WARP_BITS).astype(jnp.int32)
    contact = data._impl.contact
    if contact.dist.shape[0] == 0:
        return jnp.zeros((), jnp.int32)
    full = [jnp.all(contact.dist[contact.dim == dim] < 0) for dim in np.unique(contact.dim)]
    return jnp.where(jnp.stack(full).any(), _CROWDED, 0).astype(jnp.int32)


def is_stable(data: mjx.Data) -> jax.Array:
    """Whether positions and velocities are finite and not huge, bool."""
    state = jnp.concatenate([data.qpos, data.qvel])
    return jnp.all(jnp.isfinite(state) & (jnp.abs(state) < _HUGE))


def judge(system: System, world: World, goal: goals.GoalTable) -> jax.Array:
    """Whether the goal of one world holds for the kinematics and contacts of the last call, bool.

    Args:
        system: what worlds share.
        world: the world.
        goal: its row of a goal table, without the leading axis.
    """
    data = world.data
    seen = {name: getattr(data, name) for name in ("xpos", "site_xpos", "site_xmat", "qpos")}
    return for_worlds(_holds, is_deterministic(system.model))((), (goal, seen | {"touch": data.sensordata}))


def _holds(_: tuple[()], world: tuple[goals.GoalTable, dict[str, jax.Array]]) -> jax.Array:
    """Whether a goal holds, bool, from its row and what ``goals.evaluate`` sees of one world."""
    goal, seen = jax.tree.map(lambda x: x[None], world)
    return goals.evaluate(goal, **seen, xp=jnp)[0]


def eef(world: World, grip_site: int, hand_body: int) -> waypoint.Pose:
    """End-effector position and hand orientation by the kinematics of the last call."""
    return waypoint.Pose(world.data.site_xpos[..., grip_site, :], world.data.xquat[..., hand_body, :])
