"""A LIBERO task as two pure functions for training loops in JAX: ``reset(rng)`` and ``step(state, action)``.

In: a task, a ``FunctionalConfig``, random keys and actions of one world. Out: ``FunctionalState``, a pytree of stable
structure and dtypes with the fields that Brax and MuJoCo Playground expect. Both functions take one world and go under
``vmap``, ``jit`` and ``scan``; nothing is kept between calls except in the state. ``vecenv.interop.playground`` puts
them into Playground's registry, ``vecenv.interop.gymnasium`` behind ``gymnasium.vector``.

The simulation is that of ``vecenv.make(..., backend="warp" | "jax")``: 25 substeps of controller and physics a step,
50 ms, the same goals and proprioception. ``FunctionalState.data`` holds only what a step needs from the one before. The
memory that MuJoCo Warp needs for the contacts of the whole batch is made inside each step, as large as the batch that
the step is mapped over, so no field names a number of worlds and states may be merged leaf by leaf.

Plain ``jax.jit`` is enough on every device. ``vecenv.libero.functional.jit`` gives the same at the same speed; on a CPU
with jax 0.10 it compiles ``impl="jax"`` with less work.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from mujoco import mjx

from vecenv.libero import contact_memory
from vecenv.libero.functional.config import (
    ACTIONS,
    CONES,
    PIXELS,
    FunctionalConfig,
    FunctionalError,
    Randomization,
    default_config,
    overridden,
)
from vecenv.libero.functional.objectives import Objective
from vecenv.libero.functional.observer import Observer
from vecenv.libero.functional.physics import WorldPhysics
from vecenv.libero.functional.randomize import Randomizer, Variation
from vecenv.libero.functional.starts import Starts
from vecenv.libero.functional.state import FunctionalState
from vecenv.libero.physics.base import SUBSTEPS, Physics
from vecenv.libero.physics.mjx import model as mjx_model
from vecenv.libero.render.raytrace import RayTracer
from vecenv.libero.render.scenery import Scenery
from vecenv.libero.render.sources import visual_source
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks.export import exported_tasks
from vecenv.libero.tasks.sources import Task, installed_tasks
from vecenv.libero.tasks.suites import UnknownTask
from vecenv.util.arrays import AnyArray


class FunctionalLibero:
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
        config_overrides: Mapping[str, object] | None = None,
    ) -> None:
        self.config = overridden(config or default_config(), config_overrides or {})
        self.suite, self.task = suite, task
        folder = self.config.scenes
        sources = installed_tasks(suite) if folder is None else exported_tasks(folder, suite)
        if not 0 <= task < len(sources):
            raise UnknownTask(f"{suite} has tasks 0 to {len(sources) - 1}, not {task}")
        source, problem = sources[task], sources[task].problem()
        self.instruction = source.instruction
        sharing = contact_memory.sharing(sources, problem.scene_key())
        self.scene = _with_cone(_scene(source, sharing, self.config), CONES[self.config.cone])
        budget = self.config.budget or contact_memory.measured_budget(self.scene, sharing)
        iterations = self.config.iterations or mjx_model.usual_iterations(self.config.impl, self.config.geometry)
        built = mjx_model.build(
            self.scene,
            impl=self.config.impl,
            budget=budget,
            iterations=iterations,
            deterministic=self.config.deterministic,
        )
        self.impl, self.budget = built.impl, budget
        self._physics = WorldPhysics(built, self.config.action)
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
        tracer = _tracer(self.scene, problem, self.config) if PIXELS in self.config.observed else None
        self._observer = Observer(self.scene, self._objective, self.config.observed, tracer)
        self._randomizer = _randomizer(self.config.randomization, tracer)
        self._source = problem.source

    # -- the two functions ---------------------------------------------------------------------------------------------

    def reset(self, rng: PRNGKeyArray) -> FunctionalState:
        """Begin an episode in a start drawn with the key ``rng``, and with a variation drawn with it."""
        start = self._starts.stored(rng) if self.config.placement == "stored" else self._starts.regions(rng)
        variation = None if self._randomizer is None else self._randomizer.episode(self._mjx_model, rng)
        data = self._physics.begin(self._model(variation), start)
        data = data.replace(start_height=self._objective.height(data.view), variation=variation)
        zero = jnp.zeros((), jnp.float32)
        return FunctionalState(
            data=data,
            obs=self._observer(data),
            reward=zero,
            done=zero,
            metrics={"success": zero, "fault": zero},
            info={"episode": start.episode},
        )

    def step(self, state: FunctionalState, action: Float[AnyArray, " action_size"]) -> FunctionalState:
        """Advance by one control step, 50 ms.

        Args:
            state: what ``reset`` or ``step`` returned.
            action: [action_size]; clipped to [-1, 1]; non-finite values count as 0.
        """
        model = self._model(state.data.variation)
        data = self._physics.advance(model, state.data, self._prepared(action))
        before, after = state.data.view, data.view
        fault = data.world.fault != 0
        success = self._objective.success(after) & ~fault
        reward = success.astype(jnp.float32)
        if self.config.reward == "shaped":
            gained = self._objective.potential(after) - self._objective.potential(before)
            reward = jnp.where(fault, 0.0, reward + gained.astype(jnp.float32))
        metrics = {"success": success.astype(jnp.float32), "fault": fault.astype(jnp.float32)}
        return FunctionalState(
            data=data,
            obs=self._observer(data),
            reward=reward,
            done=(success | fault).astype(jnp.float32),
            metrics={**state.metrics, **metrics},
            info={**state.info},
        )

    def observe_batch(
        self, physics: Physics, slots: Sequence[int] | None = None
    ) -> Float[np.ndarray, "slots observation_size"]:
        """Observations of a batched environment, as a policy that was trained on this one takes them.

        Args:
            physics: ``env.physics`` of an environment of ``vecenv.make``, of any backend and geometry.
            slots: indices of the slots to observe, which must simulate this scene; None for all.

        Returns:
            A row a slot, in the columns of ``layout``, float32.

        Raises:
            FunctionalError: another scene, or observations with images.
        """
        return self._observer.of_batch(physics, range(physics.num_envs) if slots is None else slots)

    def _model(self, variation: Variation | None) -> mjx.Model:
        """The model of a world with this variation."""
        model = self._mjx_model
        return model if variation is None else model.tree_replace(variation.fields(model))

    def _prepared(self, action: Float[AnyArray, "..."]) -> Float[Array, " action_size"]:
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
    def observation_size(self) -> Any:  # int for one kind of trainer, a dictionary for the other
        """Width of an observation; with images the shapes of its parts, as Brax wants them."""
        return self._observer.size

    @property
    def layout(self) -> Mapping[str, slice]:
        """Columns of an observation by name; metres, radians, wxyz, world frame.

        ``proprio`` is ``joint_pos`` 7, ``joint_vel`` 7, ``finger_pos`` 2, ``finger_vel`` 2, ``eef_pos`` 3 and
        ``eef_quat`` 4, the last two as robosuite's observables report them. ``objects`` is ``target_offset`` 3, from
        the point between the fingertips to the middle of the target's box, then for each object and fixture ``name``
        its position 3 and orientation 4, and ``fixture_joints``.
        """
        return dict(self._observer.layout)

    @property
    def target(self) -> str:
        """Name of the object or fixture to reach or lift."""
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
    def unwrapped(self) -> FunctionalLibero:
        """This environment."""
        return self


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


def _randomizer(config: Randomization | None, tracer: RayTracer | None) -> Randomizer | None:
    if config is None or tracer is None:
        return None if config is None else Randomizer(config)
    return Randomizer(config, len(tracer.scenery.instances), [name or "" for name in tracer.cameras])


def _tracer(scene: Scene, problem: Problem, config: FunctionalConfig) -> RayTracer:
    """Renders the agent's and the wrist's camera."""
    size, file, colors = config.image_size, config.scenery, config.colors
    if file is None:
        scenery = visual_source(config.scenes).scenery(problem, level="fast", colors=colors)
    else:
        scenery = Scenery.load(file)
    scenery.check(scene.model, colors)
    return RayTracer(scenery, height=size, width=size, antialias=config.antialias)
