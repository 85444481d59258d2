"""What every environment does alike with its slots: the methods of ``vecenv.contract`` that depend on no simulator.

A subclass of :class:`SlotBatch` supplies the simulator. How the slots stand, and the rules about finished and
quarantined ones, are in ``vecenv.slot_states``; who may use a batch, and for how long, in ``vecenv.lifetime``.
"""

from __future__ import annotations

import logging
import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from vecenv import actions as action_space
from vecenv import placement as placing
from vecenv.contract import FIRST, Control, EePoseControl, Metrics, PlanControl, ResetInfo, Timings, Watcher
from vecenv.controllers.waypoint import WaypointPlan
from vecenv.lifetime import Closeable
from vecenv.placement import Placement, PlacementError
from vecenv.slot_states import SlotStates
from vecenv.util import inputs

log = logging.getLogger(__name__)
_Kind = TypeVar("_Kind", bound=Control)
_Result = TypeVar("_Result")
# Tasks that ``repr`` names before it only counts them.
_LISTED = 8
# Where a batch is before it is placed.
_NOWHERE = Placement(np.zeros(1, int), np.zeros(1, int))


class SlotBatch(Closeable):
    """A batch of slots, each with one episode of one task; a subclass supplies the simulator and the other methods.

    Args:
        suite: the suite the tasks are of.
        num_envs: slots, B.
        success: ``"first"`` ends an episode when its goal first holds; ``"final"`` runs it until the budget is spent.
    """

    def __init__(self, suite: str, num_envs: int, *, success: str = FIRST) -> None:
        super().__init__()
        self.suite, self.num_envs = suite, num_envs
        self._until_success = success == FIRST
        self._watchers: list[Watcher] = []
        self._placement = _NOWHERE
        self._physics_s = 0.0

    # -- supplied by the simulator -------------------------------------------------------------------------------------

    @abstractmethod
    def _chosen(self, tasks: object, episodes: object) -> Placement:
        """The present placement with other tasks and episodes, as ``set_episodes`` takes them."""

    @abstractmethod
    def _prepare(self) -> np.ndarray:
        """Get ready for ``_placement``, or raise and change nothing; returns the step budget of each slot, int [B]."""

    @abstractmethod
    def _arm(self, stale: np.ndarray) -> None:
        """Put the slots ``stale`` (bool [B]) at the start of their episodes, or raise and change nothing."""

    @abstractmethod
    def _instruction(self, slot: int) -> str:
        """The current instruction of a slot."""

    @abstractmethod
    def _label(self, task: int) -> str:
        """Name of a task in ``episode_id``."""

    @abstractmethod
    def _failures(self) -> Mapping[int, str]:
        """Slot -> why its physics failed; healthy slots are left out."""

    @abstractmethod
    def _drive(
        self, targets: np.ndarray, hold: np.ndarray, moves: np.ndarray, carry: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Drive the slots ``moves`` (bool [B]) to ``targets`` [B, 8], or hold them for ``hold`` ticks (int [B]).

        The servo goes on in the slots ``carry`` (bool [B]) where the last call left it.

        Returns:
            Rewards [B], and which slots reached their target, bool [B].
        """

    @abstractmethod
    def _follow(self, plan: WaypointPlan, max_misses: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Follow a plan.

        Returns:
            Rewards [B]; for each waypoint, whether it was reached, bool [B, T], and its ticks, int [B, T].
        """

    @abstractmethod
    def _tools(self) -> np.ndarray:
        """Poses of the end effectors, xyz (metres) and wxyz, world frame, [B, 7], a copy."""

    def _diagnostics(self) -> dict[str, Any]:
        """Additional entries of ``info``."""
        return {}

    # -- episodes ------------------------------------------------------------------------------------------------------

    @property
    def placement(self) -> Placement:
        """Task and episode of each slot."""
        return self._placement

    def set_episodes(
        self, *, tasks: object = None, episodes: object = None, slots: npt.ArrayLike | None = None
    ) -> None:
        """Choose what each slot runs next; ``reset`` makes it live.

        Args:
            tasks: task of each slot, by index or name (B of them, or one for all); None keeps them.
            episodes: episode of each slot (B of them, or one for all); None keeps them.
            slots: slots that ``tasks`` and ``episodes`` are for, bool [B] or indices in the same order; the other slots
                continue their episodes. None: all of them. In LIBERO a slot's new task must share its scene.

        Raises:
            PlacementError, UnknownTask: something that does not exist, or a wrong number of them.
            ValueError: a subclass; a task of another scene while other slots continue.
        """
        self._check_open()
        if slots is None:
            self._place(self._chosen(tasks, episodes))
            return
        rows = inputs.indices(slots, self.num_envs, PlacementError, as_given=True)
        if len(rows):
            self._replace(
                rows, self._chosen(self._of_all(tasks, rows, "task"), self._of_all(episodes, rows, "episode"))
            )

    def slot_indices(self, slots: npt.ArrayLike | None) -> np.ndarray:
        """Indices of slots, ascending, from bool [B], indices, or None for all.

        Raises:
            PlacementError: a mask of another length, or a slot that does not exist.
        """
        return inputs.indices(slots, self.num_envs, PlacementError)

    def _task_indices(self, tasks: object) -> Sequence[int]:
        """Tasks as ``set_episodes`` takes them, as indices."""
        return placing.integers(tasks, "task")

    def _of_all(self, given: object, rows: np.ndarray, what: str) -> object:
        """A value for each of B slots: ``given`` for the slots ``rows``, the current one for the others."""
        if given is None:
            return None
        chosen = self._task_indices(given) if what == "task" else placing.integers(given, what)
        return placing.replaced(chosen, rows, getattr(self._placement, what), what)

    def _replace(self, rows: np.ndarray, placement: Placement) -> None:
        """Place other episodes in some slots; the others keep their state."""
        with self._placed_at(placement):
            max_steps = self._prepare_slots(rows)
        self._states.replace(rows, max_steps)

    @contextmanager
    def _placed_at(self, placement: Placement) -> Iterator[None]:
        """Inside, ``placement`` is the batch's; afterwards too, unless something was raised."""
        before, self._placement = self._placement, placement
        try:
            yield
        except BaseException:
            self._placement = before
            raise

    def _prepare_slots(self, rows: np.ndarray) -> np.ndarray:
        """Prepare the new episodes of some slots, or raise and change nothing; returns their budgets, int [n]."""
        raise self._error("this environment cannot place single slots: leave slots out")

    def _place(self, placement: Placement) -> None:
        with self._placed_at(placement):
            max_steps = self._prepare()
        self._states = SlotStates(max_steps, until_success=self._until_success)

    def reset(self) -> ResetInfo:
        """Make every slot live: finished slots start their episode again, live ones are not changed.

        A slot whose physics fails here is done before its first tick; the log has a warning with the cause.

        Returns:
            Episode metadata of every slot; no observation.
        """
        self._check_open()
        stale = ~self._states.live | self.done
        if stale.any():
            with self._stepping():
                self._arm(stale)
            self._states.begin(stale, self._failures())
            self._warn_of_failed_starts(stale)
        tasks, episodes = self._placement.task, self._placement.episode
        info = ResetInfo(
            instruction=self.instructions(),
            episode_id=tuple(
                f"{self.suite}/{self._label(int(task))}/{episode}"
                for task, episode in zip(tasks, episodes, strict=True)
            ),
            suite=self.suite,
            task_id=tasks.copy(),
            max_steps=self._states.max_steps.copy(),
        )
        return self._delivered(info)

    def _warn_of_failed_starts(self, stale: np.ndarray) -> None:
        causes = Counter(self._states.fault[slot] for slot in np.flatnonzero(stale) if self._states.fault[slot])
        for cause, count in causes.items():
            message = "%r: %d of %d slots failed in reset and are done before their first tick: %s"
            log.warning(message, self, count, self.num_envs, cause)

    def end_episodes(self, slots: Any) -> None:
        """End the episodes of some slots: truncated, they ignore further steps and cost nothing until ``reset``.

        Args:
            slots: bool [B] or indices.

        Raises:
            PlacementError: a mask of another length, or a slot that does not exist.
        """
        self._check_live()
        self._states.end(self.slot_indices(slots))

    def instructions(self) -> tuple[str, ...]:
        """The current instruction of each slot; SIMPLER tasks in two halves have two, one after the other."""
        return tuple(self._instruction(slot) for slot in range(self.num_envs))

    @property
    def max_steps(self) -> np.ndarray:
        """Step budget of each slot in control ticks, int [B], a copy."""
        return self._states.max_steps.copy()

    @property
    def ee_poses(self) -> np.ndarray:
        """Poses of the end effectors, xyz (metres) and wxyz, world frame, [B, 7], a copy; placed slots only."""
        self._check_live()
        return self._tools()

    @property
    def timings(self) -> Timings:
        """Seconds spent so far in physics and in rendering images."""
        return Timings(physics_s=self._physics_s, images_s=self._images_s())

    def _images_s(self) -> float:
        """Seconds spent rendering images."""
        return 0.0

    @contextmanager
    def _stepping(self) -> Iterator[None]:
        """Add the time spent inside to that of physics."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self._physics_s += time.perf_counter() - started

    # -- stepping ------------------------------------------------------------------------------------------------------

    def step_ee_pose(
        self,
        poses: npt.ArrayLike | Mapping[str, object] | None,
        hold_steps: npt.ArrayLike = 0,
        *,
        carry: npt.ArrayLike = False,
        slots: npt.ArrayLike | None = None,
    ) -> EePoseControl:
        """Drive each end effector to an absolute pose, or hold it while the gripper moves.

        Every slot moves on its own until it is within tolerance, finished, or out of ticks; it uses at least one tick,
        so the gripper command is always executed. ``hold_steps`` > 0 skips the drive: that many ticks without motion.
        Poses are of the frame that ``observe_objects`` reports as ``ee_pose``; the class says which that is.

        Args:
            poses: [B, 8] xyz (metres), wxyz, grip (1 closed, 0 open), world frame; empty for a no-op. Also a mapping
                with ``pose``, ``hold_steps``, ``carry`` and ``slots``, all but the first optional.
            hold_steps: ticks to hold, one number or [B].
            carry: go on with the motion of the last ``step_ee_pose`` or ``step_waypoints`` without slowing down, bool
                or bool [B]. The servo's reference, which leads the hand by up to 25 mm, then stays where that call
                left it, and waypoints followed one call each take the ticks of one ``step_waypoints``. Without it, and
                after any other kind of step, the reference starts at the hand. SIMPLER's servo always carries on.
            slots: drive these only, bool [B] or indices; the others stand still. None: all.

        Raises:
            ActionError: not numbers, another shape, or another key.
            PlacementError: ``slots`` that do not exist.
        """
        self._check_live()
        given: dict[str, Any] = {"pose": (), "hold_steps": hold_steps, "carry": carry, "slots": slots}
        given |= action_space.ee_pose_fields(poses)
        targets, moves, errors = action_space.ee_poses(given["pose"], self.num_envs)
        hold = action_space.hold_steps(given["hold_steps"], self.num_envs)
        carries = action_space.flags(given["carry"], self.num_envs, "carry")
        if given["slots"] is not None:
            moves = moves & np.isin(np.arange(self.num_envs), self.slot_indices(given["slots"]))
        before = self._states.steps.copy()
        with self._stepping():
            reward, arrived = self._drive(targets, hold, moves, carries)
        return self._control(
            EePoseControl,
            reward,
            before,
            converged=arrived & moves,
            final_pose=self._tools(),
            step_count=self._states.steps - before,
            error=errors,
        )

    def step_waypoints(self, plan: object, max_misses: int | None = None) -> PlanControl:
        """Follow a plan of waypoints, each slot its own, in one call.

        A slot goes from waypoint to waypoint as ``step_ee_pose`` does, without stopping, and ends at the end of its
        plan, on success, when its budget is spent, or after ``max_misses`` waypoints in a row out of reach.

        Args:
            plan: anything with ``poses`` [B, T, 7] (xyz in metres, wxyz, world frame), ``grip`` [B, T] (1 closed, 0
                open), ``hold`` int [B, T] (ticks without motion in place of the drive; 0 drives) and ``valid``
                bool [B, T] (the others are skipped).
            max_misses: at least 1; None for no limit.

        Raises:
            ActionError: not numbers, another shape, or another key.
        """
        self._check_live()
        checked, errors = action_space.plan(plan, self.num_envs)
        if max_misses is not None:
            max_misses = inputs.count(max_misses, "max_misses", action_space.ActionError, least=1)
        before = self._states.steps.copy()
        with self._stepping():
            reward, arrived, ticks = self._follow(checked, max_misses)
        return self._control(
            PlanControl,
            reward,
            before,
            converged=arrived,
            waypoint_ticks=ticks,
            final_pose=self._tools(),
            error=errors,
        )

    @contextmanager
    def waypoint_limits(
        self, *, max_steps: int | None = None, pos_tol: float | None = None, rot_tol: float | None = None
    ) -> Iterator[None]:
        """While inside, ``step_ee_pose`` and ``step_waypoints`` have other limits; None keeps the configured one.

        Args:
            max_steps: control ticks a waypoint may take.
            pos_tol: metres within which it is reached.
            rot_tol: radians within which it is reached.
        """
        given = {"max_steps": max_steps, "pos_tol": pos_tol, "rot_tol": rot_tol}
        before = self._limit_waypoints({name: value for name, value in given.items() if value is not None})
        try:
            yield
        finally:
            self._limit_waypoints(before)

    def _limit_waypoints(self, changes: Mapping[str, Any]) -> Mapping[str, Any]:
        """Change fields of the follower's config; returns what they were."""
        raise self._error(f"this environment cannot change {', '.join(changes)}")

    @contextmanager
    def watched(self, watcher: Watcher) -> Iterator[None]:
        """While inside, ``watcher(actions [B, 7], active bool [B])`` is called before every tick of an episode.

        It is called for every stepping method, ``step_ee_pose`` included; settling is not part of an episode.

        Raises:
            ValueError: a subclass; something that cannot be called.
        """
        if not callable(watcher):
            raise self._error(f"watched({inputs.shown(watcher)}): expected a function of actions and active slots")
        self._watchers.append(watcher)
        try:
            yield
        finally:
            self._watchers.remove(watcher)

    def _book(self, ticks: np.ndarray, success: np.ndarray, solved: np.ndarray | None = None) -> np.ndarray:
        """Update steps, success and rewards after ticks.

        Args:
            ticks: how many it took, int or bool [B].
            success: whether its goal held after the last of them, bool [B].
            solved: whether its goal held after any of them, bool [B]; as ``success`` where each took one at most.

        Returns:
            Rewards, [B]: 1 where the goal held for the first time in the episode.
        """
        return self._states.book(ticks, success, self._failures(), solved)

    def _quarantine(self, among: np.ndarray) -> None:
        """End those of the slots ``among`` (bool [B]) whose physics failed."""
        self._states.quarantine(among, self._failures())

    def _control(
        self,
        kind: type[_Kind],
        reward: np.ndarray,
        before: np.ndarray,
        sanitized: np.ndarray | None = None,
        **extra: np.ndarray | tuple[str, ...],
    ) -> _Kind:
        """The return value of a step: ``before`` are the step counts before it; ``sanitized`` is False unless given."""
        info = {
            "sanitized": np.zeros(self.num_envs, bool) if sanitized is None else sanitized,
            "fault": tuple(self._states.fault),
            "ticks": self._states.steps - before,
            **self._diagnostics(),
        }
        control = kind(
            reward=reward,
            terminated=self._states.terminated.copy(),
            truncated=self._states.truncated.copy(),
            success=self._states.success.copy(),
            step_index=self._states.steps.copy(),
            info=info,
            **extra,
        )
        return self._delivered(control)

    def _delivered(self, result: _Result) -> _Result:
        """What a method returns, in the arrays that the caller wants; NumPy's unless a subclass offers others."""
        return result

    # -- verdicts ------------------------------------------------------------------------------------------------------

    def evaluate(self) -> Metrics:
        """The verdict of each slot as of its last executed tick."""
        self._check_open()
        metrics = Metrics(
            success=self._states.success.copy(),
            num_steps=self._states.steps.copy(),
            suite=self.suite,
            task_id=self._placement.task.copy(),
            cumulative_reward=self._states.reward.copy(),
            success_first=self._states.solved.copy(),
            success_final=self._states.success.copy(),
        )
        return self._delivered(metrics)

    @property
    def done(self) -> np.ndarray:
        """Slots that have finished their episode, bool [B]."""
        return self._states.done

    def __repr__(self) -> str:
        about = [f"{self.num_envs} slot{'' if self.num_envs == 1 else 's'}"]
        if self._closed:
            about.append("closed")
        elif self._states.live.all():
            about.append(f"{int((~self.done).sum())} running, {int(self._states.success.sum())} successful")
        else:
            about.append("waiting for reset()")
        labels = list(dict.fromkeys(self._label(int(task)) for task in self._placement.task))
        tasks = ", ".join(labels if len(labels) <= _LISTED else [*labels[:_LISTED], f"... ({len(labels)} in all)"])
        return f"<{type(self).__name__} {self.suite}, tasks {tasks}: {'; '.join(about)}>"

    def _check_live(self) -> None:
        self._check_open()
        if not self._states.live.all():
            raise self._error("call reset() first; it starts the placed episodes")
