"""The SIMPLER environment: layouts, scenes, controllers and success criteria with the interface of ``vecenv.contract``.

A batch of slots, each with one episode of one task of ``simpler/bridge`` (WidowX, 5 Hz) or ``simpler/google_robot``
(3 Hz). Read ``vecenv/contract.py`` for what the methods promise, ``control/controllers.py`` for how an action becomes
set-points, ``physics/scenes.py`` for physics and ``judge.py`` for success. One robot serves all tasks of a suite, so
actions of the whole batch become set-points in one call; scenes are stepped one by one, in worker processes.

An action is dx dy dz (metres), a rotation vector (radians), and the gripper, in the axes of the robot's base;
``vecenv/actions.py`` has the table of conventions.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from vecenv import actions as action_space
from vecenv import placement as placing
from vecenv.arguments import check_points, checked_state
from vecenv.contract import Control, State
from vecenv.controllers.waypoint import WaypointPlan
from vecenv.observations import Egocentric, Objects, Rendered
from vecenv.simpler import snapshot
from vecenv.simpler.assets import files as assets
from vecenv.simpler.config import CAMERAS, SimplerConfig, SimplerError
from vecenv.simpler.control.controllers import controller
from vecenv.simpler.control.servo import Servo, ServoConfig
from vecenv.simpler.episodes import Episode, prepare, require_drawable
from vecenv.simpler.following import PlanFollower
from vecenv.simpler.judge import Judge, Verdict
from vecenv.simpler.observe import CameraPoses, LazyImages, SimplerEgocentric, SlotFacts
from vecenv.simpler.overlay import ImageBuffer, Images, RenderStyle, RenderSubject
from vecenv.simpler.physics.spec import instances
from vecenv.simpler.published.lists import EpisodeSpec, check_placement, counts, place, scene_of
from vecenv.simpler.published.lists import episodes as published_episodes
from vecenv.simpler.tasks import find_task, list_tasks
from vecenv.simpler.variants import make_variant, varied
from vecenv.simpler.workers import Job, Sizes, Slots, make_slots
from vecenv.slots import SlotBatch
from vecenv.util import inputs

# Largest action: metres, radians, gripper.
ACTION_LIMITS = np.array([1.0, 1.0, 1.0, np.pi / 2, np.pi / 2, np.pi / 2, 1.0])
(_CAMERA,) = CAMERAS
# More objects than any task has.
_MAX_OBJECTS = 8


class SimplerEnv(SlotBatch):
    """A batch of SIMPLER episodes; see ``vecenv.make``.

    ``step_ee_pose`` moves as fast as ``config.servo`` allows; where it holds, it keeps the pose that the last call
    led to. Its poses are those of the tool (WidowX ``ee_gripper_link``, Google Robot ``link_gripper_tcp``).

    Args:
        suite: ``simpler/bridge`` or ``simpler/google_robot``.
        placement: task and episode of each slot.
        config: options.

    Raises:
        SimplerError, AssetsMissing: something the options ask for does not exist.
    """

    _error = SimplerError

    def __init__(self, suite: str, placement: placing.Placement, config: SimplerConfig) -> None:
        super().__init__(suite, len(placement), success=config.success_mode)
        self.config = replace(config, success=config.success_mode)
        self.tasks = list_tasks(suite)
        self.robot = self.tasks[0].robot
        self._root = assets.simpler_root(config.assets)
        self._controller = controller(self.robot, self._root / self.robot.urdf_path(), self.num_envs)
        self._servo = Servo(self._controller, config.servo or ServoConfig.of(self.robot))
        self._slots: Slots | None = make_slots(self._sizes(), self._num_workers())
        # Where objects of an episode came to rest; settling is the most expensive part of a reset.
        self._settled: dict[tuple[int, int], np.ndarray] = {}
        self._drawing_s = 0.0
        self._prepared: dict[tuple[int, int], Episode] = {}
        self._camera_poses = CameraPoses(self.robot, self._root)
        try:
            self._place(placement)
        except BaseException:
            self.close()
            raise

    def _sizes(self) -> Sizes:
        robot = self.robot
        return Sizes(slots=self.num_envs, substeps=robot.substeps, dof=robot.dof, objects=_MAX_OBJECTS)

    def _num_workers(self) -> int:
        return self.config.num_threads or len(os.sched_getaffinity(0))

    # -- placement and lifecycle ---------------------------------------------------------------------------------------

    def _chosen(self, tasks: object, episodes: object) -> placing.Placement:
        most = max(counts(self.config.protocol, self.suite).values())
        limits = {"num_tasks": len(self.tasks), "num_episodes": most}
        placement = placing.each(task_indices(self.suite, tasks), episodes, self._placement, **limits)
        return check_placement(self.config.protocol, self.suite, placement)

    def _task_indices(self, tasks: object) -> Sequence[int]:
        return placing.integers(task_indices(self.suite, tasks), "task")

    def _prepare(self) -> np.ndarray:
        """Episodes and verdicts for the current placement."""
        self._episodes = [self._episode(*self._key(slot)) for slot in range(self.num_envs)]
        self._judges: list[Judge | None] = [None] * self.num_envs
        self._verdicts = [Verdict(False)] * self.num_envs
        return np.array([self.config.max_steps or each.task.max_steps for each in self._episodes])

    def _prepare_slots(self, rows: np.ndarray) -> np.ndarray:
        chosen = {row: self._episode(*self._key(row)) for row in rows.tolist()}
        for row, episode in chosen.items():
            self._episodes[row] = episode
            self._judges[row], self._verdicts[row] = None, Verdict(False)
        return np.array([self.config.max_steps or episode.task.max_steps for episode in chosen.values()])

    def _episode(self, task: int, episode: int) -> Episode:
        key = (task, episode)
        if key not in self._prepared:
            chosen, layout = varied(*scene_of(self._spec(*key)), make_variant(self.config.variant))
            made = prepare(chosen, layout, self._root)
            if self.config.variant is not None:
                require_drawable(made, self._root)
            self._prepared[key] = made
        return self._prepared[key]

    def _spec(self, task: int, episode: int) -> EpisodeSpec:
        return published_episodes(self.config.protocol, self.tasks[task].name)[episode]

    @property
    def specs(self) -> tuple[EpisodeSpec, ...]:
        """For each slot, its episode's row in the published list; ``config.variant`` is applied on top."""
        return tuple(self._spec(*self._key(slot)) for slot in range(self.num_envs))

    def _instruction(self, slot: int) -> str:
        layout = self._episodes[slot].layout
        return layout.second_instruction if self._in_second_half(slot) else layout.instruction

    def _label(self, task: int) -> str:
        return self.tasks[task].name

    @property
    def second_half(self) -> np.ndarray:
        """Slots whose next tick belongs to the second half of a task that has two, bool [B]."""
        return np.array([self._in_second_half(slot) for slot in range(self.num_envs)])

    def _in_second_half(self, slot: int) -> bool:
        judge = self._judges[slot]
        return judge is not None and judge.second_half(int(self._states.steps[slot]) + 1)

    def advance_subtask(self, slots: npt.ArrayLike | None = None) -> None:
        """Begin the second half in slots (bool [B] or indices, all by default) of tasks that have two.

        Raises:
            PlacementError: a mask of another length, or a slot that does not exist.
        """
        self._check_live()
        for slot in self.slot_indices(slots).tolist():
            judge = self._judges[slot]
            if judge is not None:
                judge.advance()

    def _arm(self, stale: np.ndarray) -> None:
        slots = np.flatnonzero(stale)
        settled = self.slots.begin([self._job(int(slot)) for slot in slots])
        for slot in slots:
            self._settled.setdefault(self._key(int(slot)), settled[int(slot)])
            episode = self._episodes[slot]
            self._judges[slot] = Judge(episode.task, episode.roles, self._facts[slot])
            self._verdicts[slot] = Verdict(False)
        self._controller.reset(stale, self._facts["qpos"])
        self._servo.forget(stale)

    def _key(self, slot: int) -> tuple[int, int]:
        return int(self._placement.task[slot]), int(self._placement.episode[slot])

    def _job(self, slot: int) -> Job:
        episode = self._episodes[slot]
        return Job(
            slot=slot,
            spec=episode.spec,
            start=replace(episode.start, settled=self._settled.get(self._key(slot))),
        )

    def close(self) -> None:
        """Release physics and its processes; the environment cannot be used afterwards. Closing twice is harmless."""
        if self._slots is not None:
            self._slots.close()
        self._slots = None
        self._closed = True

    # -- stepping ------------------------------------------------------------------------------------------------------

    def step_continuous(self, actions: npt.ArrayLike) -> Control:
        """Advance by one control tick, or by a chunk of K.

        Args:
            actions: [B, 7] or [B, K, 7], each row dx dy dz (metres), rotation vector (radians), gripper. With K = 0
                nothing moves, and the result says how the slots stand.

        Raises:
            ActionError: not numbers, or another shape.
        """
        self._check_live()
        chunk, sanitized = action_space.continuous(actions, self.num_envs, ACTION_LIMITS)
        chunk[..., 6] = self._native_gripper(chunk[..., 6])
        self._servo.forget(np.full(self.num_envs, chunk.shape[1] > 0))
        before, reward = self._states.steps.copy(), np.zeros(self.num_envs)
        with self._stepping():
            for tick in range(chunk.shape[1]):
                if self.done.all():
                    break
                reward += self._tick(chunk[:, tick], ~self.done)
        return self._control(Control, reward, before, sanitized)

    def _native_gripper(self, values: np.ndarray) -> np.ndarray:
        return values if self.config.gripper == "native" else self._servo.gripper(values)

    def _tick(self, actions: np.ndarray, active: np.ndarray) -> np.ndarray:
        """One control tick of the active slots; returns the rewards [B]."""
        for watcher in self._watchers:
            watcher(actions, active)
        facts = self._facts
        points = self._controller.set_action(actions, facts["qpos"], facts["qvel"], active)
        self.slots.run(active, points.position, points.velocity)
        success = np.zeros(self.num_envs, bool)
        for slot in np.flatnonzero(active):
            success[slot] = self._judge(int(slot))
        return self._book(active, success)

    def _judge(self, slot: int) -> bool:
        """Whether a slot succeeds with the tick that was just run."""
        judge = self._judges[slot]
        if judge is None or self.slots.faults[slot]:
            return False
        self._verdicts[slot] = judge.after(self._facts[slot], int(self._states.steps[slot]) + 1)
        return self._verdicts[slot].success

    def _failures(self) -> Mapping[int, str]:
        return {slot: reason for slot, reason in enumerate(self.slots.faults) if reason}

    def _diagnostics(self) -> dict[str, object]:
        return {"parts": tuple(verdict.parts for verdict in self._verdicts), "stand_ins": self.stand_ins}

    def _tools(self) -> np.ndarray:
        return self._facts["tcp"].copy()

    def _drive(
        self, targets: np.ndarray, hold: np.ndarray, moves: np.ndarray, carry: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        del carry  # the servo always goes on from the reference of the last call
        servo, driving, reward = self._servo, hold == 0, np.zeros(self.num_envs)
        servo.begin(self._facts["tcp"])
        ticks = np.where(driving, servo.config.max_steps, hold)
        going, used, arrived = moves & ~self.done, np.zeros(self.num_envs, int), np.zeros(self.num_envs, bool)
        while going.any():
            actions = servo.actions(targets, driving & going, self._facts)
            reward += self._tick(actions, going)
            used += going
            arrived = servo.arrived(targets, self._facts["tcp"])
            stuck = servo.stuck(targets, self._facts["tcp"], driving & going)
            going = going & ~self.done & (used < ticks) & ~(driving & arrived) & ~stuck
        return reward, arrived

    def _limit_waypoints(self, changes: Mapping[str, Any]) -> Mapping[str, Any]:
        before = self._servo.config
        self._servo.config = replace(before, **changes)
        return {name: getattr(before, name) for name in changes}

    def _follow(self, plan: WaypointPlan, max_misses: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        follower = PlanFollower(self._servo, plan, max_misses)
        reward = follower.run(self._tick, lambda: self._facts, lambda: self.done)
        return reward, follower.converged, follower.ticks

    # -- perception ----------------------------------------------------------------------------------------------------

    def observe_egocentric(self, slots: npt.ArrayLike | None = None) -> Egocentric:
        """What every slot's camera sees now, and its joints; images are rendered when they are first read.

        Args:
            slots: draw these slots only, bool [B] or indices; the images of the others are black. None: all.

        ``state`` is qpos, qvel and base pose (xyz, wxyz), float32 [B, 23] or [B, 29]. The only camera is the
        third-person one, 480 x 640 or 512 x 640; ``wrist_image`` is None. A slot whose physics failed shows black.
        """
        self._check_live()
        facts = self._facts.copy()
        state = np.concatenate([facts["qpos"], facts["qvel"], facts["base"]], axis=1)
        healthy: list[int] = [slot for slot in self.slot_indices(slots).tolist() if not self._states.fault[slot]]
        images = LazyImages(self._draw, {slot: (self._episodes[slot], facts[slot]) for slot in healthy})
        cameras = [episode.task.camera for episode in self._episodes]
        return SimplerEgocentric(
            state=state.astype(np.float32),
            images=Rendered([_CAMERA], lambda _: {_CAMERA: images.read("rgb")}),
            depths=Rendered([_CAMERA], lambda _: {_CAMERA: images.read("depth")}),
            segmentations=Rendered([_CAMERA], lambda _: {_CAMERA: images.read("segmentation")}),
            views={_CAMERA: self._camera_poses.view(cameras, facts)},
            instances=tuple(instances(episode.spec) for episode in self._episodes),
        )

    def _draw(self, slots: SlotFacts, deep: bool) -> Images:
        camera = self._episodes[0].task.camera
        style = RenderStyle(overlay=self.config.overlay, shadows=self.config.shadows)
        buffer = ImageBuffer(slots=self.num_envs, height=camera.height, width=camera.width, deep=deep)
        subjects = {slot: (RenderSubject.of(episode, self._root), facts) for slot, (episode, facts) in slots.items()}
        started = time.perf_counter()
        try:
            return self.slots.draw(style, buffer, subjects)
        finally:
            self._drawing_s += time.perf_counter() - started

    def _images_s(self) -> float:
        return self._drawing_s

    def observe_objects(self, points: str = "surface", slots: npt.ArrayLike | None = None) -> Objects:
        """Ground truth of every slot.

        Args:
            points: ``"surface"``, points on the collision meshes; or ``"aabb"``, on the faces of the box around them.
            slots: of these slots only, bool [B] or indices; the others have no snapshot. None: all.

        Raises:
            SimplerError: another value.
        """
        self._check_live()
        check_points(points, SimplerError)
        wanted = np.isin(np.arange(self.num_envs), self.slot_indices(slots))
        rows = zip(wanted, self._episodes, self._facts, self._states.fault, strict=True)
        return Objects(
            snapshot=tuple(
                snapshot.take(episode, facts, points) if asked and not fault else None
                for asked, episode, facts, fault in rows
            ),
            error=tuple(f"physics failed: {reason}" if reason else "" for reason in self._states.fault),
        )

    @property
    def stand_ins(self) -> tuple[tuple[str, ...], ...]:
        """For each slot, notes about missing files and their stand-ins."""
        return tuple(episode.notes for episode in self._episodes)

    # -- physics state -------------------------------------------------------------------------------------------------

    @property
    def slots(self) -> Slots:
        """The physics of the batch."""
        self._check_open()
        assert self._slots is not None
        return self._slots

    @property
    def _facts(self) -> np.ndarray:
        return self.slots.facts

    @property
    def control_hz(self) -> float:
        """Control ticks a second."""
        return self.robot.control_hz

    def state(self) -> State:
        """Physics state of every slot, a copy: positions are the robot's, the drawers', then xyz + wxyz of the objects;
        velocities the robot's, the drawers', then linear and angular ones of the objects."""
        self._check_live()
        facts = self._facts
        rows = [self._split(slot) for slot in range(self.num_envs)]
        nq, nv = (np.array([len(row[part]) for row in rows]) for part in (0, 1))
        qpos, qvel = (np.zeros((self.num_envs, max(count))) for count in (nq, nv))
        for slot, (position, velocity) in enumerate(rows):
            qpos[slot, : len(position)], qvel[slot, : len(velocity)] = position, velocity
        assert len(facts) == self.num_envs
        return State(qpos=qpos, qvel=qvel, time=self._states.steps / self.robot.control_hz, nq=nq, nv=nv)

    def _split(self, slot: int) -> tuple[np.ndarray, np.ndarray]:
        facts, spec = self._facts[slot], self._episodes[slot].spec
        drawers = slice(None) if spec.cabinet else slice(0)
        count = len(spec.objects)
        positions = [facts["qpos"], facts["drawers"][drawers], facts["objects"][:count].ravel()]
        velocities = [facts["qvel"], facts["drawer_speeds"][drawers], facts["velocities"][:count].ravel()]
        return np.concatenate(positions), np.concatenate(velocities)

    def set_state(self, state: State) -> None:
        """Overwrite the physics state of every slot; step counts, verdicts and the controllers' memory stay.

        Args:
            state: what ``state()`` returned, of the same placement; its ``time`` is that of the step counts, and stays.

        Raises:
            SimplerError: a wrong type or shape, a number that is not finite, or the state of another placement.
        """
        self._check_live()
        if state is None:
            raise SimplerError("set_state: expected what state() returned, a vecenv.contract.State")
        chosen = checked_state(state, {}, self.state(), SimplerError, exactly=True)
        self.slots.restore({slot: self._joined(slot, chosen) for slot in range(self.num_envs)})
        self._quarantine(np.ones(self.num_envs, bool))

    def _joined(self, slot: int, state: State) -> np.ndarray:
        """A slot's row in the order of ``scenes.Scene.state``."""
        spec, qpos, qvel = self._episodes[slot].spec, state.qpos[slot], state.qvel[slot]
        dof, drawers, count = self.robot.dof, 3 if spec.cabinet else 0, len(spec.objects)
        joints = dof + drawers
        poses, speeds = qpos[joints : joints + 7 * count], qvel[joints : joints + 6 * count]
        things = np.concatenate([poses.reshape(-1, 7), speeds.reshape(-1, 6)], axis=1)
        return np.concatenate([qpos[:dof], qvel[:dof], qpos[dof:joints], qvel[dof:joints], things.ravel()])


def task_indices(suite: str, tasks: object) -> object:
    """Indices of tasks given by name, index, or several of either; None stays None."""
    if tasks is None:
        return None
    listed = inputs.items(tasks, "task", placing.PlacementError)
    return [find_task(suite, task).index if isinstance(task, str) else task for task in listed]


def make(
    suite: str, *, tasks: object = None, episodes: object = None, config: SimplerConfig | None = None
) -> SimplerEnv:
    """A batch of SIMPLER episodes; ``vecenv.make`` documents the arguments.

    Raises:
        UnknownSuite, UnknownTask, PlacementError, PublishedError, SimplerError, AssetsMissing: something that does not
            exist.
    """
    config = config or SimplerConfig()
    return SimplerEnv(suite, place(config.protocol, suite, task_indices(suite, tasks), episodes), config)
