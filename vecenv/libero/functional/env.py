"""A LIBERO task as two pure functions for training loops in JAX: ``reset(rng)`` and ``step(state, action)``.

In: a task, a ``FunctionalConfig``, random keys and actions of one world. Out: ``State``, a pytree of stable structure
and dtypes with the fields that Brax and MuJoCo Playground expect. Both functions take one world and go under ``vmap``,
``jit`` and ``scan``; nothing is kept between calls but in the state. ``vecenv.interop.playground`` puts them into
Playground's registry, ``vecenv.interop.gymnasium`` behind ``gymnasium.vector``.

What is simulated is what ``vecenv.make(..., backend="warp" | "jax")`` simulates: 25 substeps of controller and physics
a step, 50 ms, the same goals and proprioception. ``State.data`` holds only what a step needs from the one before; the
memory that MuJoCo Warp needs for the contacts of the whole batch is made inside each step, as large as the batch that
the step is mapped over, so no field names a number of worlds and states may be merged leaf by leaf.

On a CPU, jit with ``vecenv.libero.functional.jit``: ``jax.jit`` with the options that ``impl="jax"`` needs there. Where
somebody else calls ``jax.jit``, set ``XLA_FLAGS=--xla_cpu_use_fusion_emitters=false`` before JAX starts.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from mujoco import mjx

from vecenv.controllers import gripper as gripper_control
from vecenv.controllers import joint as joint_control
from vecenv.controllers import kinematics
from vecenv.errors import InvalidInput
from vecenv.libero.functional.objectives import OBJECTIVES, Objective, View
from vecenv.libero.functional.starts import Begin, Starts
from vecenv.libero.physics import budgets
from vecenv.libero.physics.base import OBSERVED_FINGERS, OBSERVED_POSE, SUBSTEPS
from vecenv.libero.physics.base import Start as PhysicsStart
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.mjx import model as mjx_model
from vecenv.libero.physics.mjx import step as mjx_step
from vecenv.libero.physics.mjx.model import System
from vecenv.libero.physics.mjx.options import jit
from vecenv.libero.physics.mjx.step import World
from vecenv.libero.render.options import COLORS, LARGEST_SIDE, POLICY_CAMERAS
from vecenv.libero.render.raytrace import RayTracer
from vecenv.libero.render.scenery import Scenery, installed_scenery
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.contacts import CONTACTS, Contacts
from vecenv.libero.scene.lean.geometry import PROFILES
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks import fixtures as fixture_poses
from vecenv.libero.tasks import settled as settled_starts
from vecenv.libero.tasks.export import exported_tasks
from vecenv.libero.tasks.sources import Task, installed_tasks
from vecenv.libero.tasks.suites import NUM_EPISODES, UnknownTask
from vecenv.util.mapped import Sized

__all__ = ["Data", "FunctionalConfig", "FunctionalError", "LiberoEnv", "State", "default_config", "jit", "randomize"]

ACTIONS = {"osc": 7, "joint": 8}
OBSERVATIONS = ("proprio", "objects", "pixels")
_PIXELS = "pixels"
CONES = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}
REWARDS = ("sparse", "shaped")
PLACEMENTS = ("stored", "regions")
# Starts of a scene on which its memory is measured; the same as for vecenv.make, so that both share the result.
_BUDGET_STARTS = 64
# Joints of the arm and its fingers, the first of a scene.
_ROBOT = 9


class FunctionalError(InvalidInput):
    """An option that this environment cannot honour; the message says what would be right."""


@dataclass(frozen=True, kw_only=True)
class FunctionalConfig:
    """Options of a functional environment.

    Attributes:
        impl: ``"warp"``, ``"jax"``, or None: warp where JAX runs on CUDA and jax elsewhere.
        geometry: ``"exact"``, upstream's collision geoms, or ``"lean"``, at most 24 fitted ones.
        contacts: ``"published"``, those of the MuJoCo that LIBERO comes from, or ``"current"``.
        scenes: a folder that ``vecenv compile`` wrote, in place of the installed packages.
        budget: contact and constraint memory of a world; None measures the scene once and remembers it.
        iterations: solver iterations and line-search steps a substep at most; None for those of ``vecenv.make``.
        cone: friction cones: ``"elliptic"`` as upstream; or ``"pyramidal"``, with which derivatives of ``impl="jax"``
            are finite (MJX's elliptic ones are NaN wherever nothing slips): forwards (``jax.jvp``, ``jax.jacfwd``)
            with any ``iterations``, backwards (``jax.grad``) with ``(1, n)``.
        action: ``"osc"``, seven numbers in [-1, 1] as upstream takes them (position, rotation vector, gripper: positive
            closes); or ``"joint"``, eight: by how much each joint's target leads the joint (1 is 0.05 rad), gripper.
        action_scale: factor on the arm's part of an action, in (0, 1].
        obs: what observations hold, one name or several: ``"proprio"``, ``"objects"``, see ``LiberoEnv.layout``; and
            ``"pixels"``, ray-traced camera images, which need ``warp`` and make observations dictionaries.
        image_size: height and width of the images, pixels.
        scenery: what there is to see, a file that ``vecenv.libero.render.scenery.Scenery.save`` wrote; None compiles it
            from the installed packages.
        colors: how textures look in images: ``"published"``, as in LIBERO's demonstrations, or ``"current"``, as the
            installed MuJoCo shows them; see ``vecenv.libero.render.options.RenderConfig``. A scenery file must have the
            same.
        reward: ``"sparse"``, 1 in the step that succeeds; or ``"shaped"``, that plus the change of the objective's
            potential.
        objective: ``"goal"``, ``"reach"`` or ``"lift"``; defined in ``vecenv.libero.functional.objectives``.
        target: what to reach or lift; None for the first object the task is about.
        reach_distance: metres between the fingertips' middle and the target's box that count as reached.
        lift_height: metres above its start that the target must be lifted.
        placement: ``"stored"``, each episode begins in one of the task's settled starts, drawn at every reset; or
            ``"regions"``, fixtures and objects are also moved to places drawn from their BDDL regions.
        episodes: stored starts to draw from, for example to hold some back for evaluation; None for all 50.
        episode_length: steps after which training wrappers should end an episode; the environment itself counts none.
    """

    impl: str | None = None
    geometry: str = "exact"
    contacts: Contacts = "published"
    scenes: str | None = None
    budget: Budget | None = None
    iterations: tuple[int, int] | None = None
    cone: str = "elliptic"
    action: str = "osc"
    action_scale: float = 1.0
    obs: str | Sequence[str] = ("proprio", "objects")
    image_size: int = 64
    scenery: str | None = None
    colors: str = "published"
    reward: str = "sparse"
    objective: str = "goal"
    target: str | None = None
    reach_distance: float = 0.02
    lift_height: float = 0.05
    placement: str = "stored"
    episodes: tuple[int, ...] | None = None
    episode_length: int = 500

    def __post_init__(self) -> None:
        options = {
            "geometry": PROFILES,
            "contacts": CONTACTS,
            "cone": tuple(CONES),
            "action": tuple(ACTIONS),
            "colors": COLORS,
            "reward": REWARDS,
            "objective": OBJECTIVES,
            "placement": PLACEMENTS,
        }
        for name, allowed in options.items():
            if getattr(self, name) not in allowed:
                raise FunctionalError(f"{name}={getattr(self, name)!r}: expected one of {', '.join(allowed)}")
        for name in self.observed:
            if name not in OBSERVATIONS:
                raise FunctionalError(f"obs={name!r}: expected some of {', '.join(OBSERVATIONS)}")
        if not 1 <= self.image_size <= LARGEST_SIDE:
            raise FunctionalError(f"image_size={self.image_size}: expected 1 to {LARGEST_SIDE}")
        if not 0 < self.action_scale <= 1:
            raise FunctionalError(f"action_scale={self.action_scale}: expected more than 0 and at most 1")
        if self.iterations is not None and (len(self.iterations) != 2 or min(self.iterations) < 1):
            raise FunctionalError(f"iterations={self.iterations}: expected two numbers of at least 1")
        if self.episode_length < 1 or self.reach_distance < 0 or self.lift_height <= 0:
            raise FunctionalError(
                f"episode_length={self.episode_length}, reach_distance={self.reach_distance}, "
                f"lift_height={self.lift_height}: expected >= 1, >= 0 and > 0"
            )

    @property
    def observed(self) -> tuple[str, ...]:
        """``obs`` as a tuple.

        Raises:
            FunctionalError: it is empty.
        """
        names = (self.obs,) if isinstance(self.obs, str) else tuple(self.obs)
        if not names or len(set(names)) != len(names):
            raise FunctionalError(f"obs={self.obs!r}: expected some of {', '.join(OBSERVATIONS)}, each once")
        return names


def default_config() -> FunctionalConfig:
    """The default options."""
    return FunctionalConfig()


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
    """

    qpos: jax.Array
    qvel: jax.Array
    time: jax.Array
    ctrl: jax.Array
    qacc_warmstart: jax.Array
    xpos: jax.Array
    xquat: jax.Array
    geom_xpos: jax.Array
    geom_xmat: jax.Array
    site_xpos: jax.Array
    site_xmat: jax.Array
    sensordata: jax.Array
    world: World
    start_height: jax.Array

    def replace(self, **changes: Any) -> Data:
        """A copy with some fields replaced."""
        return dataclasses.replace(self, **changes)

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


_PHYSICS = tuple(field.name for field in dataclasses.fields(Data) if field.name not in ("world", "start_height"))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class State:
    """What an agent sees of one world, with the fields of Playground's and Brax's states.

    Attributes:
        data: the physics.
        obs: observation, float32 [n], see ``LiberoEnv.layout``; with images a dictionary: ``"state"``, that vector (if
            anything but images is observed), ``"pixels/view_0"``, the agent's camera, and ``"pixels/view_1"``, the
            wrist's, float32 [H, W, 3] within [0, 1], as Playground and Brax name and scale them.
        reward: float32.
        done: 1 when the objective was achieved or the physics failed, else 0, float32. Time limits are the wrappers'.
        metrics: ``success`` and ``fault`` of this step, 0 or 1, float32; a fault is a non-finite state or exhausted
            contact memory, ends the episode and earns nothing.
        info: ``episode``, the stored start the episode began from, int32; and what wrappers add.
    """

    data: Data
    obs: Any
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, Any]

    def replace(self, **changes: Any) -> State:
        """A copy with some fields replaced."""
        return dataclasses.replace(self, **changes)

    def tree_replace(self, changes: Mapping[str, Any]) -> State:
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


# ---------------------------------------------------------------------------------------------------------------------
# Physics of one world, with contact memory for as many as it is mapped over.


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


class _Physics:
    """Begins and advances worlds of one scene.

    Args:
        built: the scene.
        action: a key of ``ACTIONS``.
    """

    def __init__(self, built: mjx_model.Build, action: str) -> None:
        self._built = built
        limits = built.scene.model.jnt_range[:7].T.astype(np.float32)
        self._act = mjx_step.control_step if action == "osc" else functools.partial(joint_step, limits=limits)
        self._blanks: dict[int, Callable[[], mjx.Data]] = {}
        # Only warp's contact memory is shared by a batch, and only jax can be differentiated.
        sized = built.impl == "warp"
        self.begin = self._sized(self._begin) if sized else functools.partial(self._alone, self._begin)
        self.advance = self._sized(self._advance) if sized else functools.partial(self._alone, self._advance)

    def _sized(self, function: Callable[..., Data]) -> Callable[..., Data]:
        return Sized(function, lambda num_worlds: self._blank(num_worlds)())

    def _alone(self, function: Callable[..., Data], *args: Any) -> Data:
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

    def _advance(self, blank: mjx.Data, model: mjx.Model, data: Data, action: jax.Array) -> Data:
        full = blank.replace(**{name: getattr(data, name) for name in _PHYSICS})
        after = self._act(self._system(model), data.world._replace(data=full), action)
        return _kept(after).replace(start_height=data.start_height)


def _kept(world: World) -> Data:
    """What a step needs from the one before."""
    physics = {name: getattr(world.data, name) for name in _PHYSICS}
    return Data(**physics, world=world._replace(data=None), start_height=jnp.zeros_like(world.data.qpos[0]))


def joint_step(system: System, world: World, action: jax.Array, *, limits: Any) -> World:
    """One control step of one world under joint control: 25 substeps, 50 ms.

    Args:
        system: what worlds share.
        world: the world.
        action: [8], finite, within [-1, 1]: seven joints (``vecenv.controllers.joint``), gripper (+1 closes).
        limits: lower and upper joint limits, radians, [2, 7].
    """
    with jax.default_matmul_precision("highest"):
        return _joint_step(system, world, jnp.asarray(action, world.gripper.dtype), jnp.asarray(limits))


def _joint_step(system: System, world: World, action: jax.Array, limits: jax.Array) -> World:
    model = system.model.replace(body_pos=world.body_pos, body_quat=world.body_quat)
    goal = joint_control.set_goal(world.data.qpos[:7], action[:7], limits.astype(action.dtype))

    def advance(carry: tuple[mjx.Data, jax.Array, jax.Array], _: None) -> tuple[Any, Any]:
        data, fingers, fault = carry
        robot = data.qpos[:_ROBOT]
        arm = kinematics.arm_state(system.chain, robot, data.qvel[:_ROBOT])
        seen = (*kinematics.hand_pose(system.chain, robot), robot[7:])
        fingers = gripper_control.integrate(fingers, action[7])
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


# ---------------------------------------------------------------------------------------------------------------------
# The environment.


class LiberoEnv:
    """One LIBERO task as pure functions of one world.

    Args:
        suite: one of ``vecenv.list_suites()``.
        task: index of the task in the suite.
        config: options; None for ``default_config()``.
        config_overrides: options that replace those of ``config``.

    Raises:
        UnknownSuite, UnknownTask: no such task.
        FunctionalError: an option that does not exist or cannot be honoured.
        ObjectiveError, StartError, SceneError, GoalError, MjxError: the task does not offer what the options ask for.
    """

    def __init__(
        self,
        suite: str,
        *,
        task: int,
        config: FunctionalConfig | None = None,
        config_overrides: Mapping[str, Any] | None = None,
    ) -> None:
        self.config = _overridden(config or default_config(), config_overrides or {})
        self.suite, self.task = suite, task
        folder = self.config.scenes
        sources = installed_tasks(suite) if folder is None else exported_tasks(folder, suite)
        if not 0 <= task < len(sources):
            raise UnknownTask(f"{suite} has tasks 0 to {len(sources) - 1}, not {task}")
        source, problem = sources[task], sources[task].problem()
        self.instruction = source.instruction
        sharing = _sharing(sources, problem)
        self.scene = _with_cone(_scene(source, sharing, self.config), CONES[self.config.cone])
        budget = self.config.budget or _measured(self.scene, sharing)
        iterations = self.config.iterations or mjx_model.usual_iterations(self.config.impl, self.config.geometry)
        built = mjx_model.build(self.scene, impl=self.config.impl, budget=budget, iterations=iterations)
        self.impl, self.budget = built.impl, budget
        self._physics = _Physics(built, self.config.action)
        # Playground's wrapper for domain randomisation puts another model here while it traces.
        self._mjx_model = built.system.model
        self._starts = Starts(self.scene, problem, source.settled(), self.config.episodes)
        self._objective = Objective(
            self.scene,
            problem,
            self.config.objective,
            target=self.config.target,
            reach_distance=self.config.reach_distance,
            lift_height=self.config.lift_height,
        )
        self._observer = _Observer(self.scene, self._objective, self.config.observed)
        self._tracer = self._made_tracer(problem) if _PIXELS in self.config.observed else None
        self._source = problem.source

    # -- the two functions ---------------------------------------------------------------------------------------------

    def reset(self, rng: jax.Array) -> State:
        """Begin an episode in a start drawn with the key ``rng``."""
        start = self._starts.stored(rng) if self.config.placement == "stored" else self._starts.regions(rng)
        data = self._physics.begin(self._mjx_model, start)
        data = data.replace(start_height=self._objective.height(_view(data)))
        zero = jnp.zeros((), jnp.float32)
        return State(
            data=data,
            obs=self._observed(data),
            reward=zero,
            done=zero,
            metrics={"success": zero, "fault": zero},
            info={"episode": start.episode},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Advance by one control step, 50 ms.

        Args:
            state: what ``reset`` or ``step`` returned.
            action: [action_size]; clipped to [-1, 1], what is no number counts as 0.
        """
        data = self._physics.advance(self._mjx_model, state.data, self._prepared(action))
        before, after = _view(state.data), _view(data)
        fault = data.world.fault != 0
        success = self._objective.success(after) & ~fault
        reward = success.astype(jnp.float32)
        if self.config.reward == "shaped":
            gained = self._objective.potential(after) - self._objective.potential(before)
            reward = jnp.where(fault, 0.0, reward + gained.astype(jnp.float32))
        metrics = {"success": success.astype(jnp.float32), "fault": fault.astype(jnp.float32)}
        return State(
            data=data,
            obs=self._observed(data),
            reward=reward,
            done=(success | fault).astype(jnp.float32),
            metrics={**state.metrics, **metrics},
            info={**state.info},
        )

    def _made_tracer(self, problem: Problem) -> RayTracer:
        size, file, colors = self.config.image_size, self.config.scenery, self.config.colors
        scenery = installed_scenery(problem, colors=colors) if file is None else Scenery.load(file)
        scenery.check(self.scene.model, colors)
        return RayTracer(scenery, height=size, width=size)

    def _observed(self, data: Data) -> Any:
        vector = self._observer(data) if self._observer.size else None
        if self._tracer is None:
            return vector
        rgb = self._tracer.look(data.xpos, data.xquat, data.qpos).rgb
        assert rgb is not None
        views = {f"{_PIXELS}/view_{camera}": image / jnp.float32(255) for camera, image in enumerate(rgb)}
        return views if vector is None else {"state": vector, **views}

    def _prepared(self, action: jax.Array) -> jax.Array:
        action = jnp.asarray(action, jnp.result_type(float))
        if action.shape != (self.action_size,):
            raise FunctionalError(
                f"action has shape {action.shape}; expected ({self.action_size},) for action={self.config.action!r}. "
                "For a batch of worlds use jax.vmap(env.step)"
            )
        action = jnp.clip(jnp.nan_to_num(action, nan=0.0, posinf=0.0, neginf=0.0), -1, 1)
        return action.at[:-1].multiply(self.config.action_scale)

    # -- what trainers ask for -----------------------------------------------------------------------------------------

    @property
    def action_size(self) -> int:
        """Width of an action."""
        return ACTIONS[self.config.action]

    @property
    def observation_size(self) -> Any:
        """Width of an observation; with images the shapes of its parts, as Brax wants them."""
        if self._tracer is None:
            return self._observer.size
        views = {f"{_PIXELS}/view_{view}": (*[self.config.image_size] * 2, 3) for view in range(len(POLICY_CAMERAS))}
        return {**({"state": (self._observer.size,)} if self._observer.size else {}), **views}

    @property
    def layout(self) -> Mapping[str, slice]:
        """Where what is in an observation: name -> columns, in metres, radians, wxyz, world frame.

        ``proprio`` is ``joint_pos`` 7, ``joint_vel`` 7, ``finger_pos`` 2, ``finger_vel`` 2, ``eef_pos`` 3 and
        ``eef_quat`` 4, the last two as robosuite's observables report them. ``objects`` is ``target_offset`` 3, from
        the point between the fingertips to the middle of the target's box, then for each object and fixture ``name``
        its position 3 and orientation 4, and ``fixture_joints``.
        """
        return dict(self._observer.layout)

    @property
    def target(self) -> str:
        """What the agent is to reach or lift."""
        return self._objective.target

    @property
    def dt(self) -> float:
        """Seconds of a step."""
        return SUBSTEPS * self.sim_dt

    @property
    def sim_dt(self) -> float:
        """Seconds of a substep."""
        return float(self.scene.model.opt.timestep)

    @property
    def n_substeps(self) -> int:
        """Substeps of a step."""
        return SUBSTEPS

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The compiled model; fixtures stand elsewhere, see ``Data.world``."""
        return self.scene.model

    @property
    def mjx_model(self) -> mjx.Model:
        """The model on the device."""
        return self._mjx_model

    @property
    def xml_path(self) -> str:
        """The task file; the MJCF is made from it in memory."""
        return self._source

    @property
    def unwrapped(self) -> LiberoEnv:
        """This environment."""
        return self


def _overridden(config: FunctionalConfig, overrides: Mapping[str, Any]) -> FunctionalConfig:
    known = [field.name for field in dataclasses.fields(config)]
    unknown = sorted(set(overrides) - set(known))
    if unknown:
        raise FunctionalError(f"no option {unknown[0]!r}; options: {', '.join(known)}")
    return dataclasses.replace(config, **overrides)


def _sharing(sources: Sequence[Task], problem: Problem) -> list[Task]:
    """The suite's tasks in the scene of one of them."""
    return [task for task in sources if task.problem().scene_key() == problem.scene_key()]


def _scene(source: Task, sharing: Sequence[Task], config: FunctionalConfig) -> Scene:
    lean_for = tuple(task.problem() for task in sharing) if config.geometry == "lean" else None
    return source.scene(goals.contact_pairs([source.problem()]), lean_for, config.contacts)


def _with_cone(scene: Scene, cone: mujoco.mjtCone) -> Scene:
    """The scene with these friction cones."""
    if scene.model.opt.cone == cone:
        return scene
    model = copy.copy(scene.model)
    model.opt.cone = cone
    return dataclasses.replace(scene, model=model)


def _measured(scene: Scene, sharing: Sequence[Task]) -> Budget:
    """Memory measured on the settled starts of these tasks, which share the scene."""
    each = -(-_BUDGET_STARTS // len(sharing))
    episodes = np.linspace(0, NUM_EPISODES - 1, min(each, NUM_EPISODES)).astype(int)
    return budgets.cached(scene, _joined([_central_start(task, scene, episodes) for task in sharing]))


def _central_start(task: Task, scene: Scene, episodes: np.ndarray) -> PhysicsStart:
    starts = task.settled()
    bodies, pos, quat = fixture_poses.poses(
        task.problem(), scene, "center", keys=[(0, "", 0, 0)] * len(episodes), slots=range(len(episodes))
    )
    return PhysicsStart(
        qpos=starts.qpos[episodes],
        qvel=starts.qvel[episodes],
        bodies=bodies,
        body_pos=pos,
        body_quat=quat,
        settled=True,
    )


def _joined(starts: Sequence[PhysicsStart]) -> PhysicsStart:
    names = ("qpos", "qvel", "body_pos", "body_quat")
    arrays: dict[str, Any] = {name: np.concatenate([getattr(start, name) for start in starts]) for name in names}
    return PhysicsStart(**arrays, bodies=starts[0].bodies, settled=True)


def _view(data: Data) -> View:
    return View(
        qpos=data.qpos,
        xpos=data.xpos,
        xquat=data.xquat,
        site_xpos=data.site_xpos,
        site_xmat=data.site_xmat,
        touch=data.sensordata,
        gripper=data.world.gripper,
        start_height=data.start_height,
    )


class _Observer:
    """Puts observations of one world together.

    Attributes:
        layout: name -> columns.
        size: their number.
    """

    def __init__(self, scene: Scene, objective: Objective, names: Sequence[str]) -> None:
        self._objective = objective
        self._bodies = np.array([scene.model.body(entity.root_body).id for entity in scene.entities.values()])
        self._joints = _fixture_joints(scene)
        widths: dict[str, int] = {}
        if "proprio" in names:
            widths |= {"joint_pos": 7, "joint_vel": 7, "finger_pos": 2, "finger_vel": 2, "eef_pos": 3, "eef_quat": 4}
        if "objects" in names:
            widths |= {"target_offset": 3, **dict.fromkeys(scene.entities, 7), "fixture_joints": len(self._joints)}
        ends = np.cumsum(list(widths.values()))
        self.layout = {
            name: slice(int(end) - width, int(end)) for (name, width), end in zip(widths.items(), ends, strict=True)
        }
        self.size = int(ends[-1]) if widths else 0
        self._names = names

    def __call__(self, data: Data) -> jax.Array:
        """The observation of one world, float32 [size]; numbers that are none are 0."""
        parts = [*(self._proprio(data) if "proprio" in self._names else ())]
        parts += self._objects(data) if "objects" in self._names else ()
        return jnp.nan_to_num(jnp.concatenate(parts).astype(jnp.float32), posinf=0.0, neginf=0.0)

    def _proprio(self, data: Data) -> list[jax.Array]:
        fingers = slice(7, _ROBOT)
        world = data.world
        return [data.qpos[:7], data.qvel[:7], world.fingers, data.qvel[fingers], world.eef_pos, world.eef_quat]

    def _objects(self, data: Data) -> list[jax.Array]:
        poses = jnp.concatenate([data.xpos[self._bodies], data.xquat[self._bodies]], axis=1)
        return [self._objective.offset(_view(data)), poses.reshape(-1), data.qpos[self._joints]]


def _fixture_joints(scene: Scene) -> np.ndarray:
    """Addresses in qpos of the joints of fixtures, int [J]."""
    joints = [scene.model.joint(joint) for entity in scene.fixtures for joint in entity.joints]
    return np.array([joint.qposadr[0] for joint in joints], int)


# ---------------------------------------------------------------------------------------------------------------------
# Domain randomisation.


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


def randomize(model: mjx.Model, rng: jax.Array, config: Randomization = Randomization()) -> tuple[mjx.Model, mjx.Model]:
    """Vary a model for each of n worlds, as Brax's and Playground's ``randomization_fn``.

    The controllers keep the nominal arm: what they compensate is off by as much as the arm was varied.

    Args:
        model: ``env.mjx_model``.
        rng: keys, [n, ...].
        config: how much.

    Returns:
        The model with a leading axis n on what varies, and which leaves have it: ``in_axes`` for ``vmap``.
    """
    varied = jax.vmap(functools.partial(_varied, model, config=config))(rng)
    axes = jax.tree.map(lambda _: None, model)
    return model.tree_replace(varied), axes.tree_replace(dict.fromkeys(varied, 0))


def _varied(model: mjx.Model, rng: jax.Array, *, config: Randomization) -> dict[str, jax.Array]:
    """Fields of one world."""
    keys = dict(zip((field.name for field in dataclasses.fields(config)), jax.random.split(rng, 6), strict=True))

    def factor(name: str, shape: tuple[int, ...] = ()) -> jax.Array:
        low, high = getattr(config, name)
        return jax.random.uniform(keys[name], shape, minval=low, maxval=high)

    mass = factor("mass", (model.nbody,))
    fingers = jnp.where(jnp.arange(model.nu) >= 7, factor("gripper"), 1.0)[:, None]
    return {
        "geom_friction": model.geom_friction * jnp.stack([factor("friction"), *[jnp.ones(())] * 2]),
        "body_mass": model.body_mass * mass,
        "body_inertia": model.body_inertia * mass[:, None],
        "dof_damping": model.dof_damping * factor("damping", (model.nv,)),
        "dof_armature": model.dof_armature * factor("armature", (model.nv,)),
        "dof_frictionloss": model.dof_frictionloss * factor("frictionloss", (model.nv,)),
        "actuator_gainprm": model.actuator_gainprm * fingers,
        "actuator_biasprm": model.actuator_biasprm * fingers,
    }
