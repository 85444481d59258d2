"""MJX physics: a LIBERO scene stepped inside ``jax.jit``, on MuJoCo Warp (NVIDIA GPUs, or a CPU) or in pure JAX.

In: a scene, and for every world its state, fixture poses and controller memory (``World``). Out: the same after a
control step. ``control_step`` is a pure function of one world, for ``vmap``, ``jit``, ``scan`` and ``grad``: 25
substeps of controller and ``mjx.step`` in one scan. ``MjxPhysics`` keeps a batch of worlds behind the interface of
``vecenv.libero.physics.base``; chunks of actions and plans of waypoints then run in one compiled call, without the
host.

What is read when follows robosuite 1.4.0, as in ``vecenv.libero.physics.native``: goals see the kinematics and contacts
at the start of the last substep, proprioception is the sample of the 24th.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jax.sharding import Mesh
from mujoco import mjx

from vecenv.controllers import gripper as gripper_control
from vecenv.controllers import kinematics, osc, waypoint
from vecenv.errors import InvalidInput
from vecenv.libero.physics import budgets, newton
from vecenv.libero.physics.base import OBSERVED_FINGERS, OBSERVED_POSE, SUBSTEPS, Followed, Physics, Ran, Start, Watcher
from vecenv.libero.physics.mjx import contacts as mjx_contacts
from vecenv.libero.robot import HOME_QPOS, panda_chain
from vecenv.libero.scene import cache, contacts, goals
from vecenv.libero.scene.scene import Scene
from vecenv.util.devices import Spread, replicated
from vecenv.util.rotations import quat_to_mat

Impl: TypeAlias = Literal["jax", "warp"]

# Joints of the arm and its fingers, the first of a scene.
_ROBOT = 9
# Gripper targets after a quarter of a second of the action -1.
_OPEN = (1.0, -1.0)
_TOLERANCES = ("tolerance", "ls_tolerance")
# Velocities from here on are what MuJoCo's mj_checkVel calls unstable.
_HUGE = mujoco.mjMAXVAL


class MjxError(InvalidInput):
    """A backend, device or scene that MJX cannot serve; the message says what would be right."""


class System(NamedTuple):
    """What every world of a scene shares.

    Attributes:
        model: the MJX model.
        chain: constants of the arm.
        home: the arm as the controller first sees it in upstream's reset: at home, at rest, fingers at 0.
        touching: geoms of the two things whose contacts each sensor counts, bool [nsensordata, 2, ngeom]; only for
            ``impl="jax"``, which knows no contact sensors of subtrees.
    """

    model: mjx.Model
    chain: kinematics.Chain
    home: osc.ArmState
    touching: jax.Array | None = None


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
        fault: bits of ``Fault``, 0 while healthy, int32.
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
_UNSTABLE = 1 << 30
_CROWDED = 1 << 3
_WARP_BITS = sum(bit for bit in FAULTS if bit != _UNSTABLE)


def resolve_impl(impl: str | None = None) -> Impl:
    """The implementation to use: as asked, or ``"warp"`` where JAX runs on CUDA and ``"jax"`` elsewhere.

    Raises:
        MjxError: an unknown name, or warp is not installed.
    """
    if impl is None:
        device = jax.devices()[0]
        impl = "warp" if device.platform in ("gpu", "cuda") and _has_warp() else "jax"
    if impl not in ("jax", "warp"):
        raise MjxError(f"impl={impl!r}: expected 'jax' or 'warp'")
    if impl == "warp" and not _has_warp():
        raise MjxError("backend 'warp' needs MuJoCo Warp: pip install 'vecenv[warp]'")
    return "warp" if impl == "warp" else "jax"


def _has_warp() -> bool:
    return importlib.util.find_spec("warp") is not None


def compiler_options(platform: str | None = None) -> dict[str, Any]:
    """Options for ``jax.jit`` of anything that contains ``mjx.step`` or the controller.

    On a CPU, the fusion emitters of the XLA in jax 0.10 recompute a kinematic chain again and again: ``mjx.kinematics``
    of this robot takes 0.8 s a call with them and 0.6 ms without. jax 0.11 has neither the trap nor the option.
    """
    chosen = platform or jax.devices()[0].platform
    return dict(_OPTIONS) if chosen == "cpu" and _has_option() else {}


_OPTIONS = {"xla_cpu_use_fusion_emitters": False}


@functools.cache
def _has_option() -> bool:
    """Whether this jaxlib knows the option."""
    cpu = jax.devices("cpu")[0]
    try:
        jax.jit(lambda x: x, compiler_options=_OPTIONS)(jax.device_put(np.zeros(1), cpu))
    except jax.errors.JaxRuntimeError:
        return False
    return True


def jit(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """``jax.jit`` with ``compiler_options`` for the default device."""
    return jax.jit(function, compiler_options=compiler_options(), **options)


@dataclass(frozen=True, eq=False, kw_only=True)
class Build:
    """A scene made ready for MJX.

    Attributes:
        scene: the scene.
        model: its model, with the budgets that ``impl="jax"`` reads.
        impl: which implementation.
        budget: sizes of the contact and constraint memory.
        system: what worlds share, on the device.
    """

    scene: Scene
    model: mujoco.MjModel
    impl: Impl
    budget: budgets.Budget
    system: System

    def blank(self, num_worlds: int) -> mjx.Data:
        """Data of one world, with room for the contacts of ``num_worlds``."""
        sizes = self.budget.warp_sizes(num_worlds) if self.impl == "warp" else {}
        return mjx.make_data(self.model, impl=self.impl, **sizes)


def usual_iterations(impl: str | None, geometry: str) -> tuple[int, int]:
    """Newton iterations and line-search steps of a substep at most; upstream's are 100 and 50.

    On warp a batch waits for its slowest world, and 99 in 100 worlds are done after two or three iterations. On jax
    both end when the batch is done; with 4 and 8, cans that rest roll off by centimetres (libero_object, lean).
    """
    if resolve_impl(impl) == "jax":
        return (20, 20)
    return (4, 8) if geometry == "lean" else (10, 20)


def build(
    scene: Scene, *, impl: str | None = None, budget: budgets.Budget, iterations: tuple[int, int] | None = None
) -> Build:
    """Put a scene on the device.

    Args:
        scene: a compiled scene.
        impl: ``"jax"``, ``"warp"`` or None, see ``resolve_impl``.
        budget: sizes of the contact and constraint memory.
        iterations: solver iterations and line-search steps at most; None for ``usual_iterations`` of exact geometry.

    Raises:
        MjxError: see ``resolve_impl``; or the integrator is another; or the arm does not come first.
        MjxContactsError: the scene has published contacts, and this MJX cannot give them.
    """
    chosen = resolve_impl(impl)
    _remember_compilations()
    if [*scene.arm_qpos, *scene.finger_qpos] != list(range(_ROBOT)):
        raise MjxError("the arm and its fingers must be the scene's first joints")
    if scene.model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        raise MjxError("the scene's integrator must be Euler")
    model = budget.limited(scene.model)
    model.opt.iterations, model.opt.ls_iterations = iterations or usual_iterations(chosen, "exact")
    # Single precision never gets as close as published contacts ask of native physics.
    model.opt.tolerance, model.opt.ls_tolerance = (contacts.OPTIONS["current"][name] for name in _TOLERANCES)
    touching = _without_contact_sensors(model) if chosen == "jax" else None
    put = mjx_contacts.put_model(model, impl=chosen)
    if chosen == "warp":
        put = put.replace(opt=put.opt.tree_replace({"_impl.warn_overflow": 0}))
    chain = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), panda_chain(scene.model))
    home_qpos = jnp.array([*HOME_QPOS, 0.0, 0.0], jnp.result_type(float))
    home = jax.jit(kinematics.arm_state)(chain, home_qpos, jnp.zeros_like(home_qpos))
    return Build(scene=scene, model=model, impl=chosen, budget=budget, system=System(put, chain, home, touching))


def _without_contact_sensors(model: mujoco.MjModel) -> jax.Array:
    """Make clocks of a model's contact sensors; returns what they watched, see ``System.touching``."""
    ancestors = [_ancestors(model, int(body)) for body in model.geom_bodyid]
    watched = np.zeros((model.nsensordata, 2, model.ngeom), bool)
    for sensor in np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT):
        row = watched[model.sensor_adr[sensor]]
        roots = model.sensor_objid[sensor], model.sensor_refid[sensor]
        for side, root in enumerate(roots):
            row[side] = [root in above for above in ancestors]
        model.sensor_type[sensor] = mujoco.mjtSensor.mjSENS_CLOCK
        model.sensor_needstage[sensor] = mujoco.mjtStage.mjSTAGE_POS
        model.sensor_objtype[sensor] = model.sensor_reftype[sensor] = mujoco.mjtObj.mjOBJ_UNKNOWN
        model.sensor_objid[sensor] = model.sensor_refid[sensor] = -1
    return jnp.asarray(watched)


def _ancestors(model: mujoco.MjModel, body: int) -> set[int]:
    """A body and those above it, the world left out."""
    found = set()
    while body > 0:
        found.add(body)
        body = int(model.body_parentid[body])
    return found


def _sensed(system: System, data: mjx.Data) -> mjx.Data:
    """Data whose contact sensors hold the numbers of contacts, also with ``impl="jax"``."""
    if system.touching is None or not system.touching.shape[0]:
        return data
    contact = data._impl.contact
    if contact.dist.shape[0] == 0:
        return data.replace(sensordata=jnp.zeros_like(data.sensordata))
    first, second = (system.touching[:, :, contact.geom[:, side]] for side in (0, 1))
    between = (first[:, 0] & second[:, 1]) | (first[:, 1] & second[:, 0])
    found = between & (contact.dist < contact.includemargin)
    return data.replace(sensordata=found.sum(1).astype(data.sensordata.dtype))


def _remember_compilations() -> None:
    """Turn JAX's persistent compilation cache on, in the user's cache folder, unless a folder was already chosen."""
    folder = cache.folder()
    if jax.config.values.get("jax_compilation_cache_dir") is None and folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder.with_name("jax")))


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
    data = _cleared(world.data, qpos, qvel, time)
    opened = jnp.asarray(_OPEN, fresh.gripper.dtype)
    world = fresh._replace(
        data=_placed(system, world._replace(data=data)),
        body_pos=world.body_pos,
        body_quat=world.body_quat,
        gripper=jnp.where(settled, opened, 0.0),
        stale=~jnp.asarray(settled),
    )
    return observe(system, world)


def _cleared(data: mjx.Data, qpos: jax.Array, qvel: jax.Array, time: jax.Array) -> mjx.Data:
    """Data with this state and nothing left of what came before."""
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


def forward(system: System, world: World) -> mjx.Data:
    """Kinematics, contacts and contact sensors of the present state."""
    model = _own_model(system, world)
    with jax.default_matmul_precision("highest"):
        if world.data.impl == mjx.Impl.WARP:
            return mjx.forward(model, world.data)
        return _sensed(system, mjx.collision(model, mjx.kinematics(model, world.data)))


def _placed(system: System, world: World) -> mjx.Data:
    """``forward`` after bodies may have been moved.

    Warp computes geoms that are fixed to the world once, when data is made, wherever ``body_pos`` puts their bodies
    later: a fixture would collide where the model has it. Here they follow their bodies.
    """
    data = forward(system, world)
    if data.impl != mjx.Impl.WARP:
        return data
    model = system.model
    body = np.asarray(model.geom_bodyid)
    fixed = (np.asarray(model.body_weldid)[body] == 0)[:, None]
    turned = data.xmat.reshape(-1, 3, 3)[body]
    own = jax.vmap(quat_to_mat)(model.geom_quat)
    pos = data.xpos[body] + (turned * model.geom_pos[:, None]).sum(-1)
    mat = (turned[..., None] * own[:, None]).sum(-2)
    xpos = jnp.where(fixed, pos, data.geom_xpos)
    xmat = jnp.where(fixed[..., None], mat, data.geom_xmat.reshape(-1, 3, 3)).reshape(data.geom_xmat.shape)
    return forward(system, world._replace(data=data.replace(geom_xpos=xpos, geom_xmat=xmat)))


def _own_model(system: System, world: World) -> mjx.Model:
    return system.model.replace(body_pos=world.body_pos, body_quat=world.body_quat)


def observe(system: System, world: World) -> World:
    """The world with its proprioception taken from the present state."""
    robot = world.data.qpos[:_ROBOT]
    pos, quat = kinematics.hand_pose(system.chain, robot)
    return world._replace(eef_pos=pos, eef_quat=quat, fingers=robot[7:], seen_qpos=world.data.qpos)


def control_step(system: System, world: World, action: jax.Array, active: Any = True) -> World:
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

    def advance(carry: tuple[mjx.Data, jax.Array, jax.Array], index: jax.Array) -> tuple[Any, Any]:
        data, fingers, fault = carry
        robot, speed = data.qpos[:_ROBOT], data.qvel[:_ROBOT]
        arm = kinematics.arm_state(system.chain, robot, speed)
        seen = (*kinematics.hand_pose(system.chain, robot), robot[7:], data.qpos)
        seen_by_controller = _as_remembered(system, arm, world.stale & (index == 0))
        torque = osc.torques(seen_by_controller, goal, system.home.qpos)
        fingers = gripper_control.integrate(fingers, action[6])
        ctrl = jnp.concatenate([torque, gripper_control.command(fingers)])
        data = substep(model, data.replace(ctrl=ctrl.astype(data.ctrl.dtype)))
        return (data, fingers, fault | _overflow(data)), seen

    carry = (world.data, world.gripper, jnp.zeros((), jnp.int32))
    (data, fingers, fault), seen = lax.scan(advance, carry, jnp.arange(SUBSTEPS))
    data, fault = _sensed(system, data), fault | jnp.where(_stable(data), 0, _UNSTABLE)
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


def substep(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """``mjx.step`` without sensors; with ``impl="jax"`` the constraints are solved by
    ``vecenv.libero.physics.newton``."""
    if data.impl == mjx.Impl.WARP:
        return mjx.step(model, data)
    for stage in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration, newton.solve):
        data = stage(model, data)
    # jaxlib 0.10 lets threads of XLA's pool wait for parts of a batched Cholesky factorisation that the same pool has
    # yet to do: when the integrator's, which needs nothing of the solver's, runs beside it on two threads, nobody is
    # left and the call never ends. So it is told to wait (0 x acceleration is not folded away: it may not be finite).
    return mjx.euler(model, data.tree_replace({"_impl.M": data._impl.M + 0 * data.qacc[:1]}))


_STATE = (
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
    """``new`` where active; else the state and the kinematics of ``old`` (the rest is computed anew by any step)."""
    kept = {name: jnp.where(active, getattr(new, name), getattr(old, name)) for name in _STATE}
    return new.replace(**kept)


def _new_goal(system: System, world: World, action: jax.Array) -> osc.OscGoal:
    arm = kinematics.arm_state(system.chain, world.data.qpos[:_ROBOT], world.data.qvel[:_ROBOT])
    return osc.set_goal(_as_remembered(system, arm, world.stale), world.goal, action[:6])


def _as_remembered(system: System, arm: osc.ArmState, stale: jax.Array) -> osc.ArmState:
    """The arm as the controller sees it: of the reset while stale, all but the bias torques."""
    chosen = jax.tree.map(lambda home, now: jnp.where(stale, home, now), system.home, arm)
    return chosen._replace(bias=arm.bias)


def _overflow(data: mjx.Data) -> jax.Array:
    """Bits of ``FAULTS`` that this substep set, int32."""
    if data.impl == mjx.Impl.WARP:
        return (data._impl.overflow.reshape(-1)[0] & _WARP_BITS).astype(jnp.int32)
    contact = data._impl.contact
    if contact.dist.shape[0] == 0:
        return jnp.zeros((), jnp.int32)
    full = [jnp.all(contact.dist[contact.dim == dim] < 0) for dim in np.unique(contact.dim)]
    return jnp.where(jnp.stack(full).any(), _CROWDED, 0).astype(jnp.int32)


def _stable(data: mjx.Data) -> jax.Array:
    state = jnp.concatenate([data.qpos, data.qvel])
    return jnp.all(jnp.isfinite(state) & (jnp.abs(state) < _HUGE))


def judge(world: World, goal: goals.GoalTable) -> jax.Array:
    """Whether the goal of one world holds on the kinematics and contacts of the last call, bool.

    Args:
        world: the world.
        goal: its row of a goal table, without the leading axis.
    """
    data = world.data
    row = jax.tree.map(lambda x: x[None], goal)
    return goals.evaluate(
        row,
        xpos=data.xpos[None],
        site_xpos=data.site_xpos[None],
        site_xmat=data.site_xmat[None],
        qpos=data.qpos[None],
        touch=data.sensordata[None],
        xp=jnp,
    )[0]


def eef(world: World, grip_site: int, hand_body: int) -> waypoint.Pose:
    """End-effector position and hand orientation on the kinematics of the last call."""
    return waypoint.Pose(world.data.site_xpos[..., grip_site, :], world.data.xquat[..., hand_body, :])


# ---------------------------------------------------------------------------------------------------------------------
# Loops over control steps of a batch of worlds.


class Loop(NamedTuple):
    """A batch whose worlds stop one by one.

    Attributes:
        worlds: the batch, leaves [n, ...].
        going: worlds that still move, bool [n].
        ticks: control steps taken, int [n].
        success: goal held after the last tick, bool [n].
        solved: goal held after one of the ticks, bool [n].
    """

    worlds: World
    going: jax.Array
    ticks: jax.Array
    success: jax.Array
    solved: jax.Array


def _tick(
    system: System,
    table: goals.GoalTable,
    limit: jax.Array,
    loop: Loop,
    actions: jax.Array,
    moved: jax.Array,
    until_success: bool,
) -> Loop:
    worlds = jax.vmap(control_step, in_axes=(None, 0, 0, 0))(system, loop.worlds, actions, moved)
    healthy = worlds.fault == 0
    success = jnp.where(moved, jax.vmap(judge)(worlds, table) & healthy, loop.success)
    solved, ticks = loop.solved | success, loop.ticks + moved
    going = loop.going & healthy & (ticks < limit)
    return Loop(worlds, going & ~solved if until_success else going, ticks, success, solved)


def _begin(worlds: World, active: jax.Array, limit: jax.Array) -> Loop:
    none = jnp.zeros(active.shape, jnp.int32)
    return Loop(worlds, active & (limit > 0), none, jnp.zeros(active.shape, bool), jnp.zeros(active.shape, bool))


def run_chunk(
    system: System,
    table: goals.GoalTable,
    worlds: World,
    chunk: jax.Array,
    active: jax.Array,
    limit: jax.Array,
    *,
    until_success: bool = True,
) -> Loop:
    """Execute a chunk of actions, [n, K, 7]; a world stops at its own success (or not), fault or limit.

    Stops as a whole when no world moves any more.
    """

    def running(carry: tuple[Loop, jax.Array]) -> jax.Array:
        return carry[0].going.any() & (carry[1] < chunk.shape[1])

    def body(carry: tuple[Loop, jax.Array]) -> tuple[Loop, jax.Array]:
        loop, k = carry
        return _tick(system, table, limit, loop, chunk[:, k], loop.going, until_success), k + 1

    return lax.while_loop(running, body, (_begin(worlds, active, limit), jnp.zeros((), jnp.int32)))[0]


class Trace(NamedTuple):
    """What a follower did, tick by tick, for at most N ticks: ``actions`` [n, N, 7] and who ``moved`` [n, N]."""

    actions: jax.Array
    moved: jax.Array


def follow_plan(
    system: System,
    table: goals.GoalTable,
    worlds: World,
    plan: waypoint.WaypointPlan,
    active: jax.Array,
    limit: jax.Array,
    max_misses: jax.Array,
    *,
    sites: tuple[int, int],
    config: waypoint.WaypointConfig,
    traced: int = 0,
    until_success: bool = True,
) -> tuple[Loop, waypoint.Progress, Trace]:
    """Follow plans of waypoints; a world stops at the end of its plan, and at its own success, fault or limit.

    Args:
        system: what worlds share.
        table: goals, leading axis n.
        worlds: the batch.
        plan: T waypoints a world.
        active: who takes part, bool [n].
        limit: control steps each world may still take, int [n].
        max_misses: waypoints in a row that may run out of ticks before a world gives up.
        sites: ids of the grip site and the hand body.
        config: tolerances and speeds.
        traced: ticks to record.
        until_success: False goes on after success.
    """
    current = eef(worlds, *sites)
    progress = waypoint.begin_plan(plan, current)
    trace = Trace(jnp.zeros((*active.shape, traced, 7)), jnp.zeros((*active.shape, traced), bool))

    def moving(loop: Loop, progress: waypoint.Progress) -> jax.Array:
        return loop.going & waypoint.unfinished(plan, progress) & (progress.misses < max_misses)

    def body(carry: Any) -> Any:
        loop, progress, trace, count = carry
        moved = moving(loop, progress)
        actions, progress = waypoint.plan_action(plan, progress, eef(loop.worlds, *sites), config)
        loop = _tick(system, table, limit, loop, actions, moved, until_success)
        progress = waypoint.plan_advance(plan, progress, eef(loop.worlds, *sites), moved, config)
        if traced:
            trace = Trace(trace.actions.at[:, count].set(actions), trace.moved.at[:, count].set(moved))
        return loop, progress, trace, count + 1

    carry = (_begin(worlds, active, limit), progress, trace, jnp.zeros((), jnp.int32))
    loop, progress, trace, _ = lax.while_loop(lambda c: moving(c[0], c[1]).any(), body, carry)
    return loop, progress, trace


# ---------------------------------------------------------------------------------------------------------------------
# The backend.


class _Compiled:
    """The compiled functions of one scene.

    With several devices, each runs its share of the worlds by itself: nothing is exchanged, and a loop over ticks ends
    on a device when its own worlds have stopped.

    Args:
        built: the scene.
        mesh: the devices, one axis; None for the default device.
    """

    def __init__(self, built: Build, mesh: Mesh | None) -> None:
        self._mesh = mesh
        self._sites = (built.scene.grip_site, built.scene.hand_body)
        self.create = self._compile(_create, shared=2)
        self.start = self._compile(_start)
        self.write = self._compile(_write)
        self.forward = self._compile(jax.vmap(forward, in_axes=(None, 0)))
        self._run = {
            mode: self._compile(functools.partial(run_chunk, until_success=mode), donate_argnums=(2,))
            for mode in (True, False)
        }
        self._follow: dict[Any, Callable[..., Any]] = {}

    def run(self, until_success: bool) -> Callable[..., Any]:
        """``run_chunk``, which ends at success or not; each is compiled when it is first called."""
        return self._run[until_success]

    def follow(self, config: waypoint.WaypointConfig, traced: int, until_success: bool) -> Callable[..., Any]:
        """``follow_plan`` with these settings."""
        key = (config, traced, until_success)
        if key not in self._follow:
            settings = {"config": config, "traced": traced, "until_success": until_success}
            function = functools.partial(_follow, sites=self._sites, **settings)
            self._follow[key] = self._compile(function, shared=2, donate_argnums=(3,))
        return self._follow[key]

    def _compile(self, function: Callable[..., Any], *, shared: int = 1, **options: Any) -> Callable[..., Any]:
        """Jit a function whose first ``shared`` arguments are the same for all worlds."""
        compiled = jit(function, **options)
        return compiled if self._mesh is None else Spread(compiled, self._mesh, shared)


def _create(system: System, blank: mjx.Data, qpos: jax.Array) -> World:
    """Worlds at these positions, [n, nq]."""
    return jax.vmap(lambda row: new_world(system, blank.replace(qpos=row)))(qpos)


def _start(
    system: System, worlds: World, mask: jax.Array, bodies: tuple[jax.Array, jax.Array], start: tuple[Any, ...]
) -> World:
    """Begin episodes in the worlds of the mask, bool [n]."""
    pos = jnp.where(mask[:, None, None], bodies[0], worlds.body_pos)
    quat = jnp.where(mask[:, None, None], bodies[1], worlds.body_quat)
    placed = worlds._replace(body_pos=pos, body_quat=quat)
    fresh = jax.vmap(start_world, in_axes=(None, 0, 0, 0, 0, 0))(system, placed, *start)
    return _merge(mask, fresh, worlds)


def _write(system: System, worlds: World, qpos: jax.Array, qvel: jax.Array, time: jax.Array) -> World:
    """Overwrite the state of every world."""

    def one(world: World, qpos: jax.Array, qvel: jax.Array, time: jax.Array) -> World:
        data = _cleared(world.data, qpos, qvel, time)
        written = world._replace(data=forward(system, world._replace(data=data)))
        written = written._replace(fault=jnp.where(_stable(written.data), 0, _UNSTABLE).astype(jnp.int32))
        return observe(system, written)

    return jax.vmap(one)(worlds, qpos, qvel, time)


def _follow(
    system: System,
    max_misses: jax.Array,
    table: goals.GoalTable,
    worlds: World,
    plan: waypoint.WaypointPlan,
    active: jax.Array,
    limit: jax.Array,
    **options: Any,
) -> tuple[Loop, waypoint.Progress, Trace]:
    return follow_plan(system, table, worlds, plan, active, limit, max_misses, **options)


def _merge(mask: jax.Array, new: World, old: World) -> World:
    """``new`` where the mask, bool [n], holds. Of the data only the state counts; a step computes the rest."""

    def choose(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    small = jax.tree.map(choose, new._replace(data=None), old._replace(data=None))
    kept = {name: choose(getattr(new.data, name), getattr(old.data, name)) for name in _STATE}
    return small._replace(data=new.data.replace(**kept))


class MjxGroup:
    """The slots of one scene on the device; NumPy copies are fetched when asked for."""

    def __init__(self, built: Build, slots: np.ndarray, mesh: Mesh | None) -> None:
        self.scene, self.slots, self.built = built.scene, slots, built
        self.compiled = _compiled(built, mesh)
        devices = 1 if mesh is None else mesh.size
        # Every device takes as many worlds; those past the last slot never move.
        self.num_worlds = -(-len(slots) // devices) * devices
        self.system, blank = built.system, built.blank(self.num_worlds // devices)
        if mesh is not None:
            self.system, blank = jax.device_put((self.system, blank), replicated(mesh))
        qpos = self.put(np.tile(np.asarray(blank.qpos), (len(slots), 1)))
        self.worlds: World = self.compiled.create(self.system, blank, qpos)
        self.table: goals.GoalTable | None = None
        self._fresh: mjx.Data | None = None
        self._fetched: dict[str, np.ndarray] = {}

    def replace(self, worlds: World) -> None:
        """The batch after a call."""
        self.worlds, self._fresh, self._fetched = worlds, None, {}

    def put(self, array: Any) -> jax.Array:
        """A row a slot becomes a row a world: floats (32 bits unless x64 is on), int32 or bool."""
        array = np.asarray(array)
        missing = self.num_worlds - len(self.slots)
        array = np.concatenate([array, np.repeat(array[-1:], missing, axis=0)]) if missing else array
        if array.dtype.kind == "f":
            return jnp.asarray(array, jnp.result_type(float))
        return jnp.asarray(array, jnp.int32 if array.dtype.kind in "iu" else bool)

    def put_mask(self, mask: np.ndarray) -> jax.Array:
        """Which slots take part, bool [n]; worlds past the last slot never do."""
        return jnp.asarray(np.concatenate([mask, np.zeros(self.num_worlds - len(self.slots), bool)]))

    def get(self, array: Any) -> np.ndarray:
        """Rows of the slots."""
        return np.asarray(array)[: len(self.slots)]

    def _fetch(self, name: str) -> np.ndarray:
        if name not in self._fetched:
            source = self._fresh if self._fresh is not None else self.worlds.data
            self._fetched[name] = self.get(getattr(source, name)).astype(float)
        return self._fetched[name]

    @property
    def qpos(self) -> np.ndarray:
        """[n, nq]."""
        return self._fetch("qpos")

    @property
    def seen_qpos(self) -> np.ndarray:
        """[n, nq]: as camera images show them."""
        return self.get(self.worlds.seen_qpos).astype(float)

    @property
    def qvel(self) -> np.ndarray:
        """[n, nv]."""
        return self._fetch("qvel")

    @property
    def time(self) -> np.ndarray:
        """Simulated seconds, [n]."""
        return self._fetch("time").reshape(len(self.slots))

    @property
    def xpos(self) -> np.ndarray:
        """[n, nbody, 3]."""
        return self._fetch("xpos")

    @property
    def xquat(self) -> np.ndarray:
        """[n, nbody, 4]."""
        return self._fetch("xquat")

    @property
    def xmat(self) -> np.ndarray:
        """[n, nbody, 9]."""
        return self._fetch("xmat").reshape(len(self.slots), -1, 9)

    @property
    def site_xpos(self) -> np.ndarray:
        """[n, nsite, 3]."""
        return self._fetch("site_xpos")

    @property
    def site_xmat(self) -> np.ndarray:
        """[n, nsite, 9]."""
        return self._fetch("site_xmat").reshape(len(self.slots), -1, 9)

    @property
    def touch(self) -> np.ndarray:
        """[n, nsensordata]."""
        return self._fetch("sensordata")

    def expand(self, field: str) -> np.ndarray:
        """``body_pos`` or ``body_quat`` of every slot, a copy, [n, nbody, ...]."""
        return self.get(getattr(self.worlds, field)).astype(float)

    def refresh_kinematics(self) -> None:
        """Bring the kinematics up to the present state."""
        self.refresh_all()

    def refresh_all(self) -> None:
        """Bring kinematics, contacts and contact sensors up to the present state."""
        self._fresh, self._fetched = self.compiled.forward(self.system, self.worlds), {}


@functools.lru_cache(maxsize=64)
def _compiled(built: Build, mesh: Mesh | None) -> _Compiled:
    return _Compiled(built, mesh)


class MjxPhysics(Physics):
    """A batch of worlds on MJX, slots in the caller's order.

    Args:
        builds: distinct scenes, made ready.
        scene_of_slot: index into ``builds`` of each slot, int [B].
        num_devices: spread every scene's slots over this many devices.

    Raises:
        MjxError: there are not that many devices.
    """

    def __init__(self, builds: Sequence[Build], scene_of_slot: np.ndarray, num_devices: int = 1) -> None:
        self.num_envs = len(scene_of_slot)
        mesh = _mesh(num_devices)
        used = [(built, np.flatnonzero(scene_of_slot == index)) for index, built in enumerate(builds)]
        self._groups = [MjxGroup(built, slots, mesh) for built, slots in used if len(slots)]
        self.faults: dict[int, str] = {}

    @property
    def groups(self) -> Sequence[MjxGroup]:
        """The slots by scene."""
        return self._groups

    @property
    def eef_pos(self) -> np.ndarray:
        """End-effector position as robosuite's observables report it, metres, [B, 3]."""
        return self._gather("eef_pos", 3)

    @property
    def eef_quat(self) -> np.ndarray:
        """Hand orientation likewise, wxyz, [B, 4]."""
        return self._gather("eef_quat", 4)

    @property
    def fingers(self) -> np.ndarray:
        """The two finger positions likewise, metres, [B, 2]."""
        return self._gather("fingers", 2)

    def _gather(self, name: str, width: int) -> np.ndarray:
        out = np.zeros((self.num_envs, width))
        for group in self._groups:
            out[group.slots] = group.get(getattr(group.worlds, name))
        return out

    def set_goals(self, tables: Sequence[goals.GoalTable]) -> None:
        """The goals of the slots, one table a group, rows in the order of its slots."""
        super().set_goals(tables)
        for group, table in zip(self._groups, tables, strict=True):
            group.table = jax.tree.map(group.put, table)

    def place(self, group: MjxGroup, slots: np.ndarray, start: Start) -> None:
        """Begin an episode in ``slots``, all of ``group``: physics state, fixture poses, controller memory."""
        n = len(group.slots)
        rows = np.searchsorted(group.slots, slots)
        mask = np.zeros(n, bool)
        mask[rows] = True
        for slot in slots.tolist():
            self.faults.pop(slot, None)
        bodies = _spread_bodies(group.built.scene.model, n, rows, start)
        qpos, qvel = np.array(group.qpos), np.array(group.qvel)
        qpos[rows], qvel[rows] = start.qpos, start.qvel
        state = (qpos, qvel, np.full(n, start.time), np.full(n, start.settled))
        arrays = jax.tree.map(group.put, (bodies, state))
        group.replace(group.compiled.start(group.system, group.worlds, group.put_mask(mask), *arrays))
        self._collect_faults()

    def write_state(self, group: MjxGroup, qpos: np.ndarray, qvel: np.ndarray, time: np.ndarray) -> None:
        """Overwrite the physics state of a group ([n, nq], [n, nv], seconds [n]); the controller keeps its memory."""
        arrays = map(group.put, (qpos, qvel, time))
        group.replace(group.compiled.write(group.system, group.worlds, *arrays))
        self._collect_faults()

    def control_step(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Advance the active slots by one control step: 25 substeps, 50 ms."""
        self.run(actions[:, None], active, np.ones(self.num_envs, int))

    def run(
        self,
        chunk: np.ndarray,
        active: np.ndarray,
        limit: np.ndarray,
        watchers: Sequence[Watcher] = (),
        *,
        until_success: bool = True,
    ) -> Ran:
        """Execute a chunk of actions in one compiled call a scene; see ``Physics.run``.

        Watchers are called afterwards, in the order of the ticks.
        """

        def call(group: MjxGroup) -> tuple[Loop, None]:
            rows = group.put(chunk[group.slots]), group.put_mask(active[group.slots]), group.put(limit[group.slots])
            return group.compiled.run(until_success)(group.system, _table(group), group.worlds, *rows), None

        ran, _ = self._each(active, call)
        for k in range(chunk.shape[1]):
            moved = ran.ticks > k
            for watcher in watchers if moved.any() else ():
                watcher(chunk[:, k], moved)
        return ran

    def follow(
        self,
        plan: waypoint.WaypointPlan,
        active: np.ndarray,
        limit: np.ndarray,
        config: waypoint.WaypointConfig,
        *,
        max_misses: int | None = None,
        watchers: Sequence[Watcher] = (),
        until_success: bool = True,
    ) -> Followed:
        """Follow plans in one compiled call a scene; see ``Physics.follow``.

        Watchers are called afterwards, in the order of the ticks.
        """
        longest = np.where(plan.valid, np.where(plan.hold > 0, plan.hold, config.max_steps), 0).sum(1)
        traced = int(min(longest.max(initial=0), limit.max(initial=0))) if watchers else 0
        misses = jnp.int32(2**30 if max_misses is None else max_misses)

        def call(group: MjxGroup) -> tuple[Loop, Any]:
            own = jax.tree.map(lambda x: group.put(np.asarray(x)[group.slots]), plan)
            rows = own, group.put_mask(active[group.slots]), group.put(limit[group.slots])
            follow = group.compiled.follow(config, traced, until_success)
            loop, *rest = follow(group.system, misses, _table(group), group.worlds, *rows)
            return loop, rest

        ran, results = self._each(active, call)
        converged = np.zeros(plan.valid.shape, bool)
        ticks = np.zeros(plan.valid.shape, int)
        for group, (progress, _) in results:
            converged[group.slots], ticks[group.slots] = group.get(progress.converged), group.get(progress.ticks)
        _replay(watchers, traced, self.num_envs, [(group, trace) for group, (_, trace) in results])
        return Followed(**vars(ran), converged=converged, waypoint_ticks=ticks)

    def _each(self, active: np.ndarray, call: Callable[[MjxGroup], Any]) -> tuple[Ran, list[tuple[MjxGroup, Any]]]:
        """Call for every group with an active slot; all are under way before the first result is waited for."""
        calls = [(group, call(group)) for group in self._groups if active[group.slots].any()]
        ran = Ran(*(np.zeros(self.num_envs, kind) for kind in (int, bool, bool)))
        for group, (loop, _) in calls:
            group.replace(loop.worlds)
            for name, array in vars(ran).items():
                array[group.slots] = group.get(getattr(loop, name))
        self._collect_faults()
        return ran, [(group, extra) for group, (_, extra) in calls]

    def _collect_faults(self) -> None:
        for group in self._groups:
            bits = group.get(group.worlds.fault)
            for row in np.flatnonzero(bits):
                self.faults.setdefault(int(group.slots[row]), fault_text(int(bits[row])))

    def close(self) -> None:
        """Let go of the batch."""
        self._groups = []


def fault_text(bits: int) -> str:
    """What the bits of ``World.fault`` say."""
    return "; ".join(text for bit, text in FAULTS.items() if bits & bit)


def _table(group: MjxGroup) -> goals.GoalTable:
    if group.table is None:
        raise MjxError("set_goals comes first")
    return group.table


def _mesh(num_devices: int) -> Mesh | None:
    available = jax.devices()
    if not 1 <= num_devices <= len(available):
        raise MjxError(f"num_devices={num_devices}: JAX sees {len(available)} ({available[0].platform})")
    return None if num_devices == 1 else Mesh(np.array(available[:num_devices]), ("worlds",))


def _spread_bodies(model: mujoco.MjModel, n: int, rows: np.ndarray, start: Start) -> tuple[np.ndarray, np.ndarray]:
    """Body positions [n, nbody, 3] and orientations [n, nbody, 4] with the start's poses in its rows."""
    pos, quat = np.tile(model.body_pos, (n, 1, 1)), np.tile(model.body_quat, (n, 1, 1))
    if len(start.bodies):
        pos[rows[:, None], start.bodies] = start.body_pos
        quat[rows[:, None], start.bodies] = start.body_quat
    return pos, quat


def _replay(watchers: Sequence[Watcher], count: int, num_envs: int, traces: list[tuple[MjxGroup, Trace]]) -> None:
    """Tell the watchers what was done."""
    if not watchers:
        return
    actions, moved = np.zeros((num_envs, count, 7)), np.zeros((num_envs, count), bool)
    for group, trace in traces:
        actions[group.slots], moved[group.slots] = group.get(trace.actions), group.get(trace.moved)
    for k in np.flatnonzero(moved.any(axis=0)):
        for watcher in watchers:
            watcher(actions[:, k], moved[:, k])
