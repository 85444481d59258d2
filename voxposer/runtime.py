"""The planning half of the method, one episode behind each handle: language in, trajectories out; nothing is driven.

:meth:`Runtimes.init` opens an episode on its first snapshot and returns a handle. :meth:`Runtimes.planner` splits an
instruction into subtasks, :meth:`Runtimes.plan_subtask` plans one of them on a fresh snapshot: its program asks for
motions, and the value maps of all slots become paths in one call (``voxposer.motions``). Whoever follows the
trajectories (``voxposer.agent``, or a loop of one's own over ``voxposer.episode``) decides when. All methods take one
row for each slot.

An object that is to be moved without a grasp is pushed, one push for each call of ``plan_subtask``: the index of the
next subtask stays where it is until the object has arrived. A slot whose program fails, or for which there is no path,
is stopped with its cause (``voxposer.failures``); one whose questions the model does not answer is stopped without a
verdict (``Slot.error``). The programs of a call are run side by side, so that slots wait for a model together.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from vecenv.errors import InvalidInput
from vecenv.manipulation import reach, rooms
from vecenv.observations import ObjectsSnapshot
from voxposer import pushing
from voxposer.episode import trajectory_of_stops
from voxposer.failures import end_with, stop_with
from voxposer.interface import Interface
from voxposer.language.llm import Llm
from voxposer.language.lmp import build_lmps
from voxposer.language.lmp_config import Call, LmpError
from voxposer.motions import MotionPlanner
from voxposer.perception.config import HandState
from voxposer.perception.view import Perception
from voxposer.planned import PlannedMotion, PlannedSubtasks, Subtasks
from voxposer.runtime_config import RuntimeConfig
from voxposer.slots import Latest, Moving, Pushing, Ready, Slot, pending
from voxposer.turns import Turns

# Episodes that are open at once.
MOST_EPISODES = 4096
# A motion has reached its targets within this many voxels, as upstream's ``execute`` has it.
_REACHED = 2.0


class HandleError(InvalidInput):
    """A handle of no open episode, or too many open episodes; the message says which."""


class Runtimes:
    """Open episodes by handle, each with its language programs and what it knows about its hand.

    Args:
        llm: the language model.
        config: options.
        prompts_dir: folder of prompts to use in place of the package's own.
        on_planned: called with every motion as it is planned, its ``slot`` being the row of the call. Motions keep
            their maps, 8 MB and more each, for as long as they are referred to.
        most: episodes that may be open at once.
    """

    def __init__(
        self,
        llm: Llm,
        config: RuntimeConfig = RuntimeConfig(),  # noqa: B008  (frozen)
        *,
        prompts_dir: str | None = None,
        on_planned: Callable[[PlannedMotion], None] | None = None,
        most: int = MOST_EPISODES,
    ) -> None:
        # The time limit of programs counts computing in their host functions, and is not for compilers.
        reach.compile_kernels()
        rooms.compile_kernels()
        self.config = config
        self._llm, self._prompts_dir, self._most = llm, prompts_dir, most
        self._motions = MotionPlanner(config, on_planned)
        self._slots: dict[str, Slot] = {}
        self._turns = Turns(1 if self.rule_based else llm.config.concurrency)
        self._identity = 0

    def __len__(self) -> int:
        return len(self._slots)

    @property
    def rule_based(self) -> bool:
        """Whether rules write the programs, and no language model."""
        return self._llm.config.is_rule_base

    # -- handles -------------------------------------------------------------------------------------------------------

    def init(
        self,
        snapshots: Sequence[ObjectsSnapshot | None],
        episodes: Sequence[str] = (),
        homes: npt.ArrayLike | None = None,
    ) -> list[str]:
        """Open an episode for each snapshot, which was taken before its first tick.

        Args:
            snapshots: one an episode; None where there is none yet.
            episodes: their names, by which saved replies are found; may be empty.
            homes: poses of the hands, xyz + wxyz, [B, 7]; those of the snapshots if not given.

        Returns:
            Handles. An episode keeps its snapshot and its programs until :meth:`release`.

        Raises:
            HandleError: more would be open than ``most``.
        """
        if len(self) + len(snapshots) > self._most:
            raise HandleError(f"{len(self)} episodes are open, and {self._most} may be: release some first")
        handles = [secrets.token_hex(8) for _ in snapshots]
        if homes is None:
            homes = [np.zeros(7) if seen is None else seen.ee_pose for seen in snapshots]
        wanted = zip(snapshots, episodes or ("",) * len(handles), np.asarray(homes, float), strict=True)
        opened = [self._opened(*each) for each in wanted]
        self._slots |= dict(zip(handles, opened, strict=True))
        return handles

    def release(self, handles: Iterable[str]) -> None:
        """Close episodes; their snapshots and maps are freed, and their handles are of no use any more.

        Raises:
            HandleError: no open episode has one of the handles.
        """
        for handle in handles:
            release(self.slot(handle))
            del self._slots[handle]

    def slot(self, handle: str) -> Slot:
        """The state of an episode, for reading.

        Raises:
            HandleError: no open episode has the handle.
        """
        if handle not in self._slots:
            raise HandleError(f"no open episode has the handle {handle!r}: it was released, or is of another process")
        return self._slots[handle]

    def _opened(self, snapshot: ObjectsSnapshot | None, episode: str, home: np.ndarray) -> Slot:
        interface = Interface()
        lmps = build_lmps(
            interface.functions(),
            self._llm.for_episode(episode),
            self._prompts_dir,
            self.config.limits,
            self.config.lmps,
            repairs=self.config.repairs,
            undo=interface.restart,
            aside=self._turns.aside,
        )
        return Slot("", lmps, interface, home.copy(), snapshot=snapshot)

    # -- language ------------------------------------------------------------------------------------------------------

    def planner(self, handles: Sequence[str], instructions: Sequence[str]) -> Subtasks:
        """Split instructions into subtasks, given the names of what the latest snapshot shows.

        Raises:
            HandleError: no open episode has one of the handles.
            LlmError: the model can be asked in no slot, whatever is tried (``permanent``).
        """
        slots = [self.slot(handle) for handle in handles]
        self._together(slots, [partial(self._split, *pair) for pair in zip(slots, instructions, strict=True)])
        lists = tuple(slot.progress.subtasks for slot in slots)
        return Subtasks(lists, np.array([*map(len, lists)], int), tuple(slot.cause for slot in slots))

    def _split(self, slot: Slot, instruction: str) -> None:
        slot.instruction = instruction
        if slot.cause:
            return
        slot.progress = replace(slot.progress, passes=slot.progress.passes + 1, subtasks=(), cursor=0)
        if slot.snapshot is None:
            slot.stop(f"no observation: {slot.missing or 'the slot is not running'}")
            return
        try:
            slot.lmps.set_context((*slot.snapshot.names, *slot.snapshot.parts))
            if slot.interface.snapshot is None:
                self._observe(slot, slot.snapshot)  # a planner's program may look before it plans
            if slot.cause:
                return
            subtasks = _planned(slot, instruction)
            slot.progress = replace(slot.progress, subtasks=subtasks, first=slot.progress.first or subtasks)
            if not slot.progress.has_next:
                slot.stop("the planner found nothing to do")
        except Exception as error:
            end_with(slot, error)

    def _together(self, slots: Sequence[Slot], jobs: Sequence[Callable[[], None]]) -> None:
        """Run a job for each slot, side by side where they wait for a model."""
        asked = [len(slot.lmps.trace) for slot in slots]
        self._turns.run(jobs)
        if not self.rule_based:
            _settle([call for slot, first in zip(slots, asked, strict=True) for call in slot.lmps.trace[first:]])

    # -- looking -------------------------------------------------------------------------------------------------------

    def observe(self, handles: Sequence[str], snapshots: Sequence[ObjectsSnapshot | None]) -> None:
        """Show fresh snapshots to episodes, which check whether their latest grasps hold.

        ``plan_subtask`` does it with the snapshots that it is given, once each.

        Raises:
            HandleError: no open episode has one of the handles.
        """
        for handle, snapshot in zip(handles, snapshots, strict=True):
            slot = self.slot(handle)
            if not slot.cause and (snapshot is None or snapshot is not slot.interface.snapshot):
                self._observe(slot, snapshot)

    def _observe(self, slot: Slot, snapshot: ObjectsSnapshot | None) -> None:
        slot.snapshot = snapshot
        if snapshot is None:
            slot.stop(f"no observation: {slot.missing or 'the slot is not running'}")
            return
        try:
            perception, again = self._look(slot, snapshot), isinstance(slot.phase, Moving) and slot.phase.iterations
            if again:
                perception.exact |= slot.interface.perception.exact
                perception.targets |= slot.interface.perception.targets
            slot.interface.begin(perception)
            if isinstance(slot.phase, Pushing) and pushing.arrived(slot.phase.task, perception):
                slot.enter(pending(slot.phase.requests))
            if again:
                self._end_motion(slot)
        except Exception as error:
            stop_with(slot, error)

    def _end_motion(self, slot: Slot) -> None:
        """End a motion that may be planned again, if the hand has reached its targets or it was planned enough."""
        assert isinstance(slot.phase, Moving)
        targets, perception = slot.requests[0].targets, slot.interface.perception
        assert targets is not None
        gap = np.linalg.norm(np.argwhere(targets) - perception.grid.voxel(perception.ee.pos), axis=1).min()
        if gap <= _REACHED or slot.phase.iterations >= self.config.max_plan_iter:
            slot.enter(pending(slot.requests[1:]))

    def _look(self, slot: Slot, snapshot: ObjectsSnapshot) -> Perception:
        """The slot's view of a snapshot, after checking whether the latest grasp holds."""
        failed = slot.grip.failed
        hand = HandState(snapshot.ee_pose, slot.home, slot.grip.closed)
        perception = Perception(snapshot, hand, self.config.perception, failed)
        grasp = slot.grip.grasp
        empty = grasp is not None and slot.grip.closed and grasp.name in snapshot.movable
        empty = empty and grasp is not None and perception.held != grasp.name
        slot.grip = slot.grip.checked(held=not empty)
        if empty:
            slot.counts = replace(slot.counts, empty_grasps=slot.counts.empty_grasps + 1)
            # An episode's first failed grasp is avoided from the next round on, later ones at once.
            if failed:
                perception.grasp_finder.failed = slot.grip.failed
        return perception

    # -- planning ------------------------------------------------------------------------------------------------------

    def plan_subtask(
        self,
        handles: Sequence[str],
        subtask_list: Sequence[Sequence[str]],
        subtask_index: npt.ArrayLike,
        snapshots: Sequence[ObjectsSnapshot | None],
    ) -> PlannedSubtasks:
        """Plan a subtask in every slot, on a snapshot of its present state.

        Programs that ask for no motion are followed by the next subtask's in the same call.

        Args:
            handles: of the episodes.
            subtask_list: of each, what ``planner`` returned.
            subtask_index: of each, the subtask to plan, int [B]: 0, then ``next_subtask_index``. Where another index is
                given, an unfinished subtask is abandoned.
            snapshots: of each, the present state; None where the physics failed.

        Raises:
            HandleError: no open episode has one of the handles.
            LlmError: the model can be asked in no slot, whatever is tried (``permanent``).
        """
        slots = [self.slot(handle) for handle in handles]
        self.observe(handles, snapshots)
        indices = np.broadcast_to(np.asarray(subtask_index, int), len(slots)).tolist()
        wanted = zip(slots, map(tuple, subtask_list), indices, strict=True)
        self._together(slots, [partial(self._run_programs, *each) for each in wanted])
        before = np.array([slot.grip.closed for slot in slots], bool)
        motions = self._motions.plan(slots)
        for slot, own, closed in zip(slots, motions, before, strict=True):
            slot.progress = replace(slot.progress, unfinished=_unfinished(slot))
            if slot.cause and own:
                own.clear()
                slot.close_grip(bool(closed))
        numbers = self._identity + np.arange(1, len(slots) + 1)
        self._identity += len(slots)
        trajectory = trajectory_of_stops(motions, [slot.progress.number for slot in slots], numbers)
        return PlannedSubtasks(
            trajectory=trajectory,
            n_waypoints=trajectory.n_waypoints,
            subtask_text=tuple(slot.progress.text for slot in slots),
            next_subtask_index=np.array([_next_index(slot) for slot in slots], int),
            movable_name=tuple(slot.latest.movable for slot in slots),
            object_centric=np.array([slot.latest.object_centric for slot in slots], bool),
            prev_gripper=before,
            error=tuple(slot.cause for slot in slots),
        )

    def set_gripper(self, handles: Sequence[str], closed: npt.ArrayLike) -> None:
        """Tell episodes what the last waypoint that was followed commanded, where that was not the trajectory's last.

        Args:
            handles: of the episodes.
            closed: bool [B].
        """
        for handle, grip in zip(handles, np.broadcast_to(np.asarray(closed, bool), len(handles)), strict=True):
            self.slot(handle).close_grip(bool(grip))

    def _run_programs(self, slot: Slot, subtasks: tuple[str, ...], index: int) -> None:
        """Run the programs of subtasks, from ``index`` on, until one asks for a motion."""
        if slot.cause:
            return
        slot.resume(subtasks, index)
        try:
            while isinstance(slot.phase, Ready) and slot.progress.has_next:
                slot.progress = slot.progress.advanced()
                first = len(slot.lmps.trace)
                slot.lmps.composer(slot.progress.text)
                slot.latest = Latest(calls=range(first, len(slot.lmps.trace)))
                requests = tuple(slot.interface.taken())
                if requests:
                    slot.enter(Moving(requests))
        except Exception as error:
            end_with(slot, error)


def release(slot: Slot) -> None:
    """Release the snapshot and the maps of a slot."""
    if isinstance(slot.phase, Moving | Pushing):
        slot.enter(Ready())
    slot.interface.end()
    slot.snapshot = None


def _next_index(slot: Slot) -> int:
    """Index to plan next: of the present subtask while it is unfinished, past the last in a slot that is stopped."""
    if slot.cause:
        return len(slot.progress.subtasks)
    return slot.progress.cursor if slot.progress.unfinished is None else slot.progress.unfinished


def _unfinished(slot: Slot) -> int | None:
    """Index of the subtask of which motions are left to plan, None for none."""
    return slot.progress.cursor - 1 if isinstance(slot.phase, Moving | Pushing) else None


def _planned(slot: Slot, instruction: str) -> tuple[str, ...]:
    """The subtasks of an instruction.

    What it presupposes, "the bowl in the drawer", need not be so any more when it is planned again: where the program
    raises an error then, or finds nothing to do, the subtasks are those of the first pass.
    """
    try:
        return slot.lmps.plan(instruction) or slot.progress.first
    except LmpError as error:
        if error.rule != "raised" or not slot.progress.first:
            raise
        return slot.progress.first


def _settle(calls: Sequence[Call]) -> None:
    """Let the first of the equal questions of a round be the one that was paid, whichever happened to be asked first.

    Args:
        calls: the questions of all slots, slot by slot.
    """
    equal: dict[str, list[Call]] = {}
    for call in calls:
        if call.reply is not None:
            equal.setdefault(json.dumps([*map(dict, call.messages)]), []).append(call)
    for same in equal.values():
        paid = sum(not call.cached for call in same)
        for number, call in enumerate(same):
            call.cached = number >= paid
