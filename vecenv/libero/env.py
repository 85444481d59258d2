"""The LIBERO environment: suites, scenes, physics, controller and goals behind the verbs of ``vecenv.contract``.

A batch of slots, each with one episode of one task of a suite. Tasks of one scene share a compiled model and differ in
their start states, goals and instructions, which are data. Read ``vecenv/contract.py`` for what the verbs promise and
``vecenv/libero/physics/native.py`` for what happens in a control step.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar, cast

import mujoco
import numpy as np
import numpy.typing as npt

from vecenv import actions as action_space
from vecenv import placement as placing
from vecenv import protocols
from vecenv.arguments import check_points, checked_state
from vecenv.contract import Control, State
from vecenv.controllers import waypoint
from vecenv.libero import contact_memory, observe, starts
from vecenv.libero.config import LiberoConfig, LiberoError
from vecenv.libero.physics.base import SETTLE_ACTION, Group, Physics, Start
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.build import make_physics
from vecenv.libero.render.cameras import CameraRig, options_of
from vecenv.libero.render.options import RenderConfig, VisualOptions
from vecenv.libero.render.sources import visual_source
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import Problem, SceneKey
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks import fixtures as fixture_poses
from vecenv.libero.tasks.export import exported_tasks
from vecenv.libero.tasks.sources import Task, installed_tasks
from vecenv.libero.tasks.suites import NUM_EPISODES
from vecenv.observations import Egocentric, Objects
from vecenv.slots import SlotBatch
from vecenv.util.transfers import put

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class _TaskData:
    """What one task adds to its scene."""

    source: Task
    problem: Problem
    scene: int


class LiberoEnv(SlotBatch):
    """A batch of LIBERO episodes; see ``vecenv.make``.

    ``step_ee_pose`` moves at most 5 mm and 0.05 rad a tick (``config.waypoint``). Its poses are those of the grip
    site's position and the hand's orientation.

    Args:
        suite: one of ``vecenv.list_suites()``.
        tasks: the tasks of the suite, installed or exported.
        placement: task and episode of each slot.
        config: options.

    Raises:
        LiberoError, SceneError, GoalError, FixtureError, TaskDataError, UnknownCamera: an option names something that
            does not exist.
    """

    _error = LiberoError

    def __init__(self, suite: str, tasks: Sequence[Task], placement: placing.Placement, config: LiberoConfig) -> None:
        self._rules = config.rules(suite)
        super().__init__(suite, len(placement), success=self._rules.success)
        self.config = replace(config, **vars(self._rules))
        self._sources = tasks
        self._physics: Physics | None = None
        self._on_device = config.arrays == "jax"
        self._cameras = self._rig(self._rules.render)
        # Another one for images of another size, made when they are first asked for.
        self._resized: CameraRig | None = None
        try:
            self._place(placement)
        except BaseException:
            self.close()
            raise

    # -- placement and lifecycle ---------------------------------------------------------------------------------------

    def _chosen(self, tasks: object, episodes: object) -> placing.Placement:
        counts = {"num_tasks": len(self._sources), "num_episodes": NUM_EPISODES}
        indices = None if tasks is None else self._task_indices(tasks)
        return placing.each(indices, episodes, self._placement, **counts)

    def _task_indices(self, tasks: object) -> Sequence[int]:
        return placing.task_indices(tasks, [source.name for source in self._sources])

    def _prepare(self) -> np.ndarray:
        """Scenes, physics and goal tables for the current placement; physics that still fits is reused."""
        keys = list(dict.fromkeys(self._sources[int(i)].problem().scene_key() for i in np.unique(self._placement.task)))
        # Every task of the suite that shares a scene, so that a slot may change its task without another model.
        every = {index: source.problem() for index, source in enumerate(self._sources)}
        problems = {index: problem for index, problem in every.items() if problem.scene_key() in keys}
        scenes = [self._scene(key, problems, self.config.geometry) for key in keys]
        fixture_poses.check(self._rules.fixtures, scenes, self.num_envs)
        if self.config.cameras is not None:  # a camera that does not exist is refused before anything runs
            self._cameras.names([scene.model for scene in scenes])
        tasks = {
            i: _TaskData(self._sources[i], problem, keys.index(problem.scene_key())) for i, problem in problems.items()
        }
        scene_of_slot = np.array([tasks[int(task)].scene for task in self._placement.task])
        physics = self._physics
        if physics is None or not physics.serves(scenes, scene_of_slot):
            physics = make_physics(
                scenes,
                scene_of_slot,
                backend=self.config.backend,
                geometry=self.config.geometry,
                num_threads=self.config.num_threads,
                num_devices=self.config.num_devices,
                deterministic=self.config.deterministic,
                budgets=[self._budget_of(key, scene) for key, scene in zip(keys, scenes, strict=True)],
            )
        try:
            tables = [self._goal_table(group, tasks) for group in physics.groups]
        except BaseException:
            if physics is not self._physics:
                physics.close()
            raise
        # Nothing above has changed the batch, nothing below fails.
        if physics is not self._physics:
            self._close_physics()
            self._physics = physics
        physics.set_goals(tables)
        self._tasks, self._scene_of_slot = tasks, scene_of_slot
        # Where the servo's references ended; NaN where there is none to carry on from.
        self._references = np.full((self.num_envs, 7), np.nan)
        return np.full(self.num_envs, self._rules.max_steps)

    def _prepare_slots(self, rows: np.ndarray) -> np.ndarray:
        for row in rows.tolist():
            task = int(self._placement.task[row])
            if task not in self._tasks or self._tasks[task].scene != self._scene_of_slot[row]:
                raise LiberoError(
                    f"{self.suite} task {task} ({self._sources[task].name}) is in another scene than slot {row}: "
                    "while other slots continue, a slot changes to tasks of its own scene only"
                )
        self.physics.set_goals([self._goal_table(group, self._tasks) for group in self.physics.groups])
        return np.full(len(rows), self._rules.max_steps)

    def _scene(self, key: SceneKey, problems: Mapping[int, Problem], geometry: str) -> Scene:
        """The scene of this key, for those of the problems that share it."""
        sharing = {i: problem for i, problem in problems.items() if problem.scene_key() == key}
        lean_for = None
        if geometry == "lean":
            everywhere = (task.problem() for task in self._sources)
            lean_for = tuple(problem for problem in everywhere if problem.scene_key() == key)
        return self._sources[min(sharing)].scene(goals.contact_pairs(sharing.values()), lean_for, self.config.contacts)

    def _exact_scene(self, group: Group) -> Scene:
        """A group's scene with upstream's collision geoms, also when its physics uses lean ones."""
        if self.config.geometry == "exact":
            return group.scene
        problems = {i: task.problem for i, task in self._tasks.items()}
        key = problems[int(self._placement.task[group.slots[0]])].scene_key()
        return self._scene(key, problems, "exact")

    def _budget_of(self, scene_key: SceneKey, scene: Scene) -> Budget | None:
        """Memory on MJX: as configured, or measured on such starts of all the suite's tasks in the scene."""
        if self.config.backend == "native" or self.config.budget is not None:
            return self.config.budget
        sharing = contact_memory.sharing(self._sources, scene_key)
        return contact_memory.measured_budget(scene, sharing, self._rules.start)

    def _goal_table(self, group: Group, tasks: Mapping[int, _TaskData]) -> goals.GoalTable:
        chosen = self._placement.task[group.slots]
        present = [task for task, data in tasks.items() if data.scene == tasks[int(chosen[0])].scene]
        rows = [present.index(int(task)) for task in chosen]
        return goals.build_table([tasks[task].problem for task in present], group.scene, rows)

    def _instruction(self, slot: int) -> str:
        return self._tasks[int(self._placement.task[slot])].source.instruction

    def _label(self, task: int) -> str:
        return str(task)

    def _arm(self, stale: np.ndarray) -> None:
        jobs: list[tuple[Group, np.ndarray, Start]] = []  # made before the first is used: making one may fail
        for group in self.physics.groups:
            for task in np.unique(self._placement.task[group.slots]):
                slots = group.slots[(self._placement.task[group.slots] == task) & stale[group.slots]]
                if len(slots):
                    jobs.append((group, slots, self._start(group.scene, int(task), slots)))
        self._references[stale] = np.nan
        for group, slots, start in jobs:
            self.physics.place(group, slots, start)
        settle = np.tile(SETTLE_ACTION, (self.num_envs, 1))
        for _ in range(self._rules.settle_steps if self._rules.start == "raw" else 0):
            self.physics.control_step(settle, stale)

    def _start(self, scene: Scene, task: int, slots: np.ndarray) -> Start:
        data, episodes = self._tasks[task], self._placement.episode[slots]
        keys = [(self._rules.seed, self.suite, task, int(episode)) for episode in episodes]
        try:
            return starts.start_of(data.source, scene, self.config, self._rules, episodes, slots, keys)
        except starts.StoredStartsError as error:
            raise LiberoError(f"{self.suite} task {task} ({data.source.name}): {error}") from error

    def close(self) -> None:
        """Release physics and renderer; the environment cannot be used afterwards. Closing twice is harmless."""
        self._close_physics()
        self._cameras.close()
        if self._resized is not None:
            self._resized.close()
        self._closed = True

    def _close_physics(self) -> None:
        if self._physics is not None:
            self._physics.close()
        self._physics = None

    def _delivered(self, result: _Result) -> _Result:
        return put(result) if self._on_device else result

    # -- stepping ------------------------------------------------------------------------------------------------------

    def step_continuous(self, actions: npt.ArrayLike) -> Control:
        """Advance by one control tick, or by a chunk of K.

        Args:
            actions: [B, 7] or [B, K, 7], each row dx dy dz, axis-angle rotation, gripper (+1 closes), in [-1, 1].
                With K = 0 nothing moves, and the result says how the slots stand.

        Raises:
            ActionError: not numbers, or another shape.
        """
        self._check_live()
        chunk, sanitized = action_space.continuous(actions, self.num_envs)
        before = self._states.steps.copy()
        until = self._until_success
        with self._stepping():
            ran = self.physics.run(chunk, ~self.done, self._ticks_left, self._watchers, until_success=until)
        self._references[ran.ticks > 0] = np.nan
        return self._control(Control, self._book(ran.ticks, ran.success, ran.solved), before, sanitized)

    def _images_s(self) -> float:
        return self._cameras.seconds + (0.0 if self._resized is None else self._resized.seconds)

    @property
    def _ticks_left(self) -> np.ndarray:
        return self._states.max_steps - self._states.steps

    def _failures(self) -> Mapping[int, str]:
        return self.physics.faults

    def _drive(
        self, targets: np.ndarray, hold: np.ndarray, moves: np.ndarray, carry: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        poses = waypoint.Pose(targets[:, None, :3], targets[:, None, 3:7])
        plan = waypoint.WaypointPlan(poses, targets[:, 7:], hold[:, None], moves[:, None])
        reward, arrived, _ = self._follow(plan, carry=carry)
        return reward, arrived[:, 0]

    def _follow(
        self, plan: waypoint.WaypointPlan, max_misses: int | None = None, carry: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        followed = self.physics.follow(
            plan,
            ~self.done,
            self._ticks_left,
            self.config.waypoint,
            max_misses=max_misses,
            watchers=self._watchers,
            until_success=self._until_success,
            reference=None if carry is None else np.where(carry[:, None], self._references, np.nan),
        )
        moved = followed.ticks > 0
        self._references[moved] = followed.reference[moved]
        reward = self._book(followed.ticks, followed.success, followed.solved)
        return reward, followed.converged, followed.waypoint_ticks

    def _limit_waypoints(self, changes: Mapping[str, Any]) -> Mapping[str, Any]:
        before = self.config.waypoint
        self.config = replace(self.config, waypoint=replace(before, **changes))
        return {name: getattr(before, name) for name in changes}

    def _tools(self) -> np.ndarray:
        return np.concatenate(self.physics.eef(), axis=1)

    # -- perception ----------------------------------------------------------------------------------------------------

    def observe_egocentric(
        self, slots: npt.ArrayLike | None = None, image_size: tuple[int, int] | None = None
    ) -> Egocentric:
        """Proprioception of every slot, and what its cameras see now; images are rendered when they are read.

        Args:
            slots: draw the images of these slots only, bool [B] or indices; those of the others are black. None: all.
            image_size: height and width in pixels, None for those of ``config.render``. Such images must be read before
                others of yet another size are asked for.

        Reading one raises ``GlError`` where there is no GL, ``SceneError`` or ``AssetsMissing`` where the meshes and
        textures are missing, and ``ExportError`` where ``config.scenes`` was exported without such images.
        """
        self._check_live()
        groups = self.physics.groups
        problems = [self._tasks[int(self._placement.task[group.slots[0]])].problem for group in groups]
        seen = self._sized(image_size).capture(groups, problems, self.slot_indices(slots))
        in_jax = self._on_device and self._rules.render.engine == "raytrace"
        return self._delivered(
            Egocentric(
                state=observe.proprioception(self.physics),
                images=cast(Any, seen.images_device) if in_jax else seen.images,
                depths=cast(Any, seen.depths_device) if in_jax else seen.depths,
                segmentations=cast(Any, seen.segmentations_device) if in_jax else seen.segmentations,
                images_device=seen.images_device,
                depths_device=seen.depths_device,
                segmentations_device=seen.segmentations_device,
                views=seen.views,
                instances=seen.instances,
            )
        )

    def _rig(self, render: RenderConfig) -> CameraRig:
        return CameraRig(render, self.num_envs, self.config.cameras, visual_source(self.config.scenes))

    def _sized(self, image_size: tuple[int, int] | None) -> CameraRig:
        """The cameras that make images of a size; one more size than the configured is kept ready."""
        height, width = image_size or (self._rules.render.height, self._rules.render.width)
        wanted = replace(self._rules.render, height=height, width=width)
        if wanted == self._cameras.config:
            return self._cameras
        if self._resized is None or self._resized.config != wanted:
            if self._resized is not None:
                self._resized.close()
                self._cameras.seconds += self._resized.seconds
            self._resized = self._rig(wanted)
        self._resized.options = self._cameras.options
        return self._resized

    def set_visuals(self, options: VisualOptions | Sequence[VisualOptions]) -> None:
        """Change the appearance of slots from the next observation on: light, viewpoints, colours, textures.

        Physics is unaffected.

        Args:
            options: one for all slots, or B of them; ``VisualOptions()`` is upstream's look.

        Raises:
            RenderError: not as many as slots. A name that a scene does not have is found when an image is read.
        """
        self._check_open()
        self._cameras.options = options_of(options, self.num_envs)

    def observe_objects(self, points: str = "surface", slots: npt.ArrayLike | None = None) -> Objects:
        """Ground truth of every slot.

        Parts are those of upstream's collision geometry, also with lean geometry.

        Args:
            points: ``"surface"``, true surface points of the collision geometry (at least 200 a thing, always the same
                ones); or ``"aabb"``, points on the faces of the box around it.
            slots: of these slots only, bool [B] or indices; the others have no snapshot. None: all.

        Raises:
            LiberoError: another value.
            ExportError: lean scenes come from a folder that has no exact ones.
        """
        self._check_live()
        check_points(points, LiberoError)
        problems = [self._tasks[int(task)].problem for task in self._placement.task]
        return observe.objects(
            self.physics.groups, self._exact_scene, problems, self._states.fault, points, self.slot_indices(slots)
        )

    def check_success(self) -> np.ndarray:
        """Whether each slot's goal holds in its present state, bool [B]; unlike ``evaluate`` not tied to a tick."""
        self._check_live()
        with contextlib.ExitStack() as refreshed:
            for group in self.physics.groups:
                refreshed.enter_context(group.refreshed(contacts=True))
            return self.physics.judge()

    # -- physics state -------------------------------------------------------------------------------------------------

    @property
    def physics(self) -> Physics:
        """The physics of the batch."""
        if self._physics is None:
            raise LiberoError("the environment is closed")
        return self._physics

    def problem(self, slot: int) -> Problem:
        """The parsed BDDL problem of a slot's task."""
        return self._tasks[int(self._placement.task[slot])].problem

    @property
    def mj_models(self) -> tuple[mujoco.MjModel, ...]:
        """The compiled models, one a scene; ``scene_index`` says which slot uses which."""
        return tuple(group.scene.model for group in self.physics.groups)

    @property
    def scene_index(self) -> np.ndarray:
        """Index into ``mj_models`` of each slot, int [B]."""
        index = np.zeros(self.num_envs, int)
        for number, group in enumerate(self.physics.groups):
            index[group.slots] = number
        return index

    @property
    def mj_model(self) -> mujoco.MjModel:
        """The compiled model of a batch with a single scene.

        Raises:
            LiberoError: the batch has several scenes; use ``mj_models``.
        """
        if len(self.mj_models) != 1:
            raise LiberoError(f"this batch has {len(self.mj_models)} scenes; use mj_models and scene_index")
        return self.mj_models[0]

    @property
    def control_hz(self) -> float:
        """Control ticks a second."""
        return 20

    def state(self) -> State:
        """Physics state of every slot, a copy."""
        self._check_live()
        return self._delivered(self._state_now())

    def _state_now(self) -> State:
        groups = self.physics.groups
        nq, nv = np.zeros(self.num_envs, int), np.zeros(self.num_envs, int)
        qpos = np.zeros((self.num_envs, max(group.scene.model.nq for group in groups)))
        qvel = np.zeros((self.num_envs, max(group.scene.model.nv for group in groups)))
        time = np.zeros(self.num_envs)
        for group in groups:
            model, slots = group.scene.model, group.slots
            nq[slots], nv[slots], time[slots] = model.nq, model.nv, group.time
            qpos[slots, : model.nq], qvel[slots, : model.nv] = group.qpos, group.qvel
        return State(qpos=qpos, qvel=qvel, time=time, nq=nq, nv=nv)

    def set_state(
        self,
        state: State | None = None,
        *,
        qpos: npt.ArrayLike | None = None,
        qvel: npt.ArrayLike | None = None,
        time: npt.ArrayLike | None = None,
    ) -> None:
        """Overwrite the physics state of every slot; step counts, verdicts and the controller's memory stay.

        Args:
            state: what ``state()`` returned; or the arrays one by one, of which None leaves the present values:
            qpos: [B, >= nq]. qvel: [B, >= nv]. time: seconds, [B].

        Raises:
            LiberoError: a wrong type or shape, a number that is not finite, or the state of other scenes.
        """
        self._check_live()
        given = {"qpos": qpos, "qvel": qvel, "time": time}
        if state is not None and any(array is not None for array in given.values()):
            raise LiberoError("set_state: give a state, or the arrays one by one")
        chosen = checked_state(state, given, self._state_now(), LiberoError)
        for group in self.physics.groups:
            model, slots = group.scene.model, group.slots
            qpos, qvel = chosen.qpos[slots, : model.nq], chosen.qvel[slots, : model.nv]
            self.physics.write_state(group, qpos, qvel, chosen.time[slots])
        self._references[:] = np.nan
        self._quarantine(np.ones(self.num_envs, bool))


def make(suite: str, *, tasks: object = None, episodes: object = None, config: LiberoConfig | None = None) -> LiberoEnv:
    """A batch of LIBERO episodes; ``vecenv.make`` documents the arguments."""
    config = config or LiberoConfig()
    sources = installed_tasks(suite) if config.scenes is None else exported_tasks(config.scenes, suite)
    placement = placing.cross(
        placing.task_indices(tasks, [source.name for source in sources]),
        episodes,
        num_tasks=len(sources),
        num_episodes=NUM_EPISODES,
        every=protocols.protocol(config.protocol).episodes,
    )
    return LiberoEnv(suite, sources, placement, config)
