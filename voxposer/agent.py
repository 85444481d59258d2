"""The method as a whole, for a batch: language in, each subtask planned on a fresh observation and executed.

An environment that speaks ``vecenv.contract`` and an :class:`~voxposer.language.llm.Llm` come in. In each round
(:meth:`Agent.step`) every slot that has a subtask left plans it on one frozen snapshot: the composer's program asks for
motions, the planner turns the value maps of all slots into paths in one call, and one ``env.step_waypoints`` executes
all plans. Objects that are to be moved without a grasp are pushed, one push a round. A slot whose program fails, or for
which there is no path, is stopped with its cause (``voxposer.slots``) and holds still; the other slots continue.

Nothing that a slot does depends on the others: in a round it executes its own plan and no tick more, so a slot may
begin another episode (:meth:`Agent.begin`) while the others are anywhere in theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vecenv.contract import BatchEnv, Control, PlanControl
from vecenv.manipulation.routes import RouteConfig, Stop
from vecenv.manipulation.world import matrix
from vecenv.observations import ObjectsSnapshot
from voxposer import pushing
from voxposer.interface import Interface
from voxposer.language.llm import Llm
from voxposer.language.lmp import build_lmps
from voxposer.paths import plan_paths
from voxposer.perception.config import HandState, PerceptionConfig
from voxposer.perception.observation import PerceptionError
from voxposer.perception.sight import make_sight
from voxposer.perception.view import Perception
from voxposer.planning import plan as plans
from voxposer.planning.config import PlannerConfig
from voxposer.planning.plan import PlanConfig, PlannedWaypoint, SubtaskPlan
from voxposer.pushing import PushError, PushingConfig, PushSituation, PushTask
from voxposer.quaternions import quaternion
from voxposer.requests import InterfaceError, MotionRequest
from voxposer.sandbox.guard import HostFault
from voxposer.slots import Grasp, Moving, Pushing, Ready, Slot, pending
from voxposer.stops import stops_of, travel


@dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """Options of the agent.

    Attributes:
        perception: how objects are seen.
        route: distances that the hand keeps from the scene.
        plan: how stops become waypoints.
        planner: of paths over voxels.
        push: how objects are pushed.
        passes: how often the whole instruction is planned when it was executed to the end without success.
        max_misses: a plan is abandoned after this many waypoints in a row that could not be reached.
        idle_ticks: ticks that stopped slots wait in a round in which no slot has a plan.
    """

    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    route: RouteConfig = field(default_factory=RouteConfig)
    plan: PlanConfig = field(default_factory=PlanConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    push: PushingConfig = field(default_factory=PushingConfig)
    passes: int = 3
    max_misses: int = 2
    idle_ticks: int = 50


@dataclass(frozen=True)
class PlannedMotion:
    """One motion as it was planned, for display.

    Attributes:
        slot: index of the slot.
        subtask: number of the subtask.
        text: its words.
        request: what the program asked for.
        perception: the snapshot it was planned on.
        path: over voxels, [P, 3].
        stops: the stops of the hand along it.
    """

    slot: int
    subtask: int
    text: str
    request: MotionRequest
    perception: Perception
    path: np.ndarray
    stops: tuple[Stop, ...]


class Agent:
    """VoxPoser for the batch of an environment that was just reset.

    Args:
        env: the environment.
        instructions: of each slot, B strings.
        llm: the language model.
        config: options.
        prompts_dir: folder of prompts to use in place of the package's own.
        on_planned: called with every motion as it is planned.

    Attributes:
        slots: the state of each slot.
        succeeded: which slots have solved their task, bool [B].
    """

    def __init__(
        self,
        env: BatchEnv,
        instructions: Sequence[str],
        llm: Llm,
        config: AgentConfig = AgentConfig(),
        prompts_dir: str | None = None,
        on_planned: Callable[[PlannedMotion], None] | None = None,
    ) -> None:
        self.env, self.config, self._on_planned = env, config, on_planned
        self._llm, self._prompts_dir = llm, prompts_dir
        self._finished, self.succeeded = np.zeros(env.num_envs, bool), np.zeros(env.num_envs, bool)
        self._sight = make_sight(env, config.perception)
        homes = self._sight.begin(range(env.num_envs))
        self.slots = [self._slot(*pair) for pair in zip(instructions, homes, strict=True)]

    @property
    def perception(self) -> str:
        """Where observations come from, in words: ground truth, or which cameras and what segments their images."""
        return self._sight.title

    def begin(self, instructions: Sequence[str], slots: Sequence[int]) -> None:
        """Begin other episodes in some slots, which were just reset; the others continue theirs.

        Args:
            instructions: of every slot of the batch, B strings.
            slots: the slots that begin.
        """
        homes = self._sight.begin(slots)
        for i in slots:
            _release(self.slots[i])
            self.slots[i] = self._slot(instructions[i], homes[i])
            self._finished[i] = self.succeeded[i] = False

    def step(self) -> Control:
        """One round: plan a subtask in every slot that has one left, and execute the plans; stopped slots wait."""
        live = [i for i, slot in enumerate(self.slots) if not self._finished[i] and not slot.cause]
        seen = self._sight.look(live, [slot.grip.closed for slot in self.slots])
        for i in live:
            self._run_programs(self.slots[i], seen.snapshot[i], seen.error[i] or self._sight.unseen(i))
        waypoints = self._plan(live)
        if not any(waypoints):
            return self._record(self._wait())
        waypoints = self._with_waiting(waypoints)
        return self._record(self._execute(plans.stack(waypoints, self.config.plan)))

    def close(self) -> None:
        """Release snapshots and maps; nothing can be planned afterwards."""
        for slot in self.slots:
            _release(slot)

    def _slot(self, instruction: str, home: np.ndarray) -> Slot:
        """A slot whose episode has just begun, with the hand at ``home``, xyz + wxyz, [7]."""
        interface = Interface()
        lmps = build_lmps(interface.functions(), self._llm, self._prompts_dir)
        return Slot(instruction, lmps, interface, home.copy())

    # -- one slot's subtask --------------------------------------------------------------------------------------------

    def _run_programs(self, slot: Slot, snapshot: ObjectsSnapshot | None, missing: str) -> None:
        """Run the programs of the next subtasks until one asks for a motion; ``missing`` says what is not seen."""
        if snapshot is None:
            slot.stop(f"no observation: {missing or 'the slot is not running'}")
            return
        try:
            perception = self._look(slot, snapshot)
            slot.interface.begin(perception)
            if isinstance(slot.phase, Pushing) and pushing.arrived(slot.phase.task, perception):
                slot.enter(pending(slot.phase.requests))
            while isinstance(slot.phase, Ready) and self._has_subtask(slot, perception):
                slot.progress = slot.progress.advanced()
                slot.lmps.composer(slot.progress.text)
                requests = tuple(slot.interface.taken())
                if requests:
                    slot.enter(Moving(requests))
        except (HostFault, PerceptionError, InterfaceError) as error:
            _stop_with(slot, error, missing)

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

    def _has_subtask(self, slot: Slot, perception: Perception) -> bool:
        """Whether a subtask is left; the instruction is planned when none is, as often as allowed."""
        if slot.progress.has_next:
            return True
        if slot.progress.passes >= self.config.passes:
            slot.stop("followed to the end without success")
            return False
        slot.progress = replace(slot.progress, passes=slot.progress.passes + 1)
        slot.lmps.set_context(perception.names)
        slot.progress = replace(slot.progress, subtasks=slot.lmps.plan(slot.instruction), cursor=0)
        if not slot.progress.has_next:
            slot.stop("the planner found nothing to do")
        return slot.progress.has_next

    # -- planning ------------------------------------------------------------------------------------------------------

    def _plan(self, live: Sequence[int]) -> list[list[PlannedWaypoint]]:
        """Waypoints of every slot for the motions that its programs asked for; an empty list where there are none."""
        waypoints: list[list[PlannedWaypoint]] = [[] for _ in self.slots]
        for i in live:
            self._return_hand(self.slots[i])
        while moving := [i for i in live if isinstance(self.slots[i].phase, Moving)]:
            wants = [(self.slots[i].interface, self.slots[i].requests[0]) for i in moving]
            paths = plan_paths(wants, self.config.planner, self.config.route)
            for i, (_, request), path in zip(moving, wants, paths, strict=True):
                waypoints[i] += self._plan_motion(i, request, path)
        self._plan_pushes([i for i in live if isinstance(self.slots[i].phase, Pushing)], waypoints)
        for slot, own in zip(self.slots, waypoints, strict=True):
            slot.counts = replace(slot.counts, waypoints=slot.counts.waypoints + len(own))
        return waypoints

    def _return_hand(self, slot: Slot) -> None:
        """Let planning start at the present pose of the hand, not at the end of what programs asked for."""
        if slot.requests:
            ee = slot.interface.perception.snapshot.ee_pose
            slot.interface.perception.move_hand(ee[:3], matrix(ee[3:]), closed=slot.grip.closed)

    def _plan_motion(
        self, index: int, request: MotionRequest, path: np.ndarray | InterfaceError
    ) -> list[PlannedWaypoint]:
        """Waypoints of a slot's next motion; the hand is then taken to be at its end."""
        slot = self.slots[index]
        perception, rest = slot.interface.perception, slot.requests[1:]
        try:
            if isinstance(path, InterfaceError):
                raise path
            if request.object_centric:
                slot.enter(Pushing(PushTask(request.movable, perception.grid.world(path)), rest))
                return []
            stops = stops_of(request, path, perception, self.config.route, closed=slot.grip.closed)
        except InterfaceError as error:
            _stop_with(slot, error)
            return []
        if request.kind == "path":
            _remember_grasp(slot, request, path[-1])
        if self._on_planned:
            words = slot.progress.text
            number, path = slot.progress.number, np.asarray(path)
            self._on_planned(PlannedMotion(index, number, words, request, perception, path, tuple(stops)))
        slot.enter(pending(rest))
        waypoints = self._waypoints(slot, stops)
        perception.move_hand(stops[-1].pos, matrix(stops[-1].quat), closed=slot.grip.closed)
        return waypoints

    def _waypoints(self, slot: Slot, stops: Sequence[Stop]) -> list[PlannedWaypoint]:
        """Stops as waypoints; the grip after them is recorded."""
        waypoints, closed = plans.expand_flips(stops, slot.grip.closed, slot.progress.number, self.config.plan)
        slot.close_grip(closed)
        return waypoints

    def _plan_pushes(self, pushing_slots: Sequence[int], waypoints: list[list[PlannedWaypoint]]) -> None:
        """The next push of every slot that pushes, searched for all in one call."""
        found = {i: situation for i in pushing_slots if (situation := self._situation(self.slots[i]))}
        pushes = pushing.next_pushes(list(found.values()), self.config.push)
        for i, stops in zip(found, pushes, strict=True):
            slot = self.slots[i]
            perception = slot.interface.perception
            here = Stop(perception.ee.pos, quaternion(perception.ee.rotation), True)
            way = [*travel([here, stops[0]], perception, self.config.route), *stops[1:]]
            waypoints[i] += self._waypoints(slot, way)

    def _situation(self, slot: Slot) -> PushSituation | None:
        """What is known before the next push; None, and the slot stopped, where there is no room for one."""
        assert isinstance(slot.phase, Pushing)
        try:
            return pushing.situation(slot.phase.task, slot.interface.perception, self.config.push)
        except PushError as error:
            _stop_with(slot, error)
            return None

    # -- execution -----------------------------------------------------------------------------------------------------

    def _execute(self, plan: SubtaskPlan) -> PlanControl:
        """Execute a plan to its end; a slot that cannot reach its waypoints resumes at its next change of grip."""
        control = self.env.step_waypoints(plan, max_misses=self.config.max_misses)
        while True:
            missed = plan.valid & (control.waypoint_ticks > 0) & ~control.converged & (plan.hold == 0)
            for slot, count in zip(self.slots, missed.sum(axis=1), strict=True):
                slot.counts = replace(slot.counts, missed=slot.counts.missed + int(count))
            plan = plans.remaining(plan, control.waypoint_ticks)
            plan = plan._replace(valid=plan.valid & ~control.done[:, None])
            if not plan.valid.any():
                return control
            control = self.env.step_waypoints(plan, max_misses=self.config.max_misses)

    def _with_waiting(self, waypoints: Sequence[list[PlannedWaypoint]]) -> list[list[PlannedWaypoint]]:
        """Waypoints with a hold for each slot that was stopped, grip unchanged, so that its budget runs out meanwhile.

        It is no longer than the longest of the plans, of which each waypoint takes a tick or more.
        """
        ticks = max(sum(max(waypoint.hold, 1) for waypoint in own) for own in waypoints)
        held = np.array([0.0, 0, 0, 1, 0, 0, 0])
        return [
            [PlannedWaypoint(held, slot.grip.closed, ticks, -1, 1.0)] if slot.cause and not finished else own
            for slot, own, finished in zip(self.slots, waypoints, self._finished, strict=True)
        ]

    def _wait(self) -> Control:
        """Hold still with the grip unchanged."""
        actions = np.zeros((len(self.slots), self.config.idle_ticks, 7))
        actions[:, :, 6] = np.where([slot.grip.closed for slot in self.slots], 1.0, -1.0)[:, None]
        return self.env.step_continuous(actions)

    def _record(self, control: Control) -> Control:
        self._finished, self.succeeded = control.done, control.success
        return control


def _release(slot: Slot) -> None:
    """Release the snapshot and the maps of a slot."""
    if isinstance(slot.phase, Moving | Pushing):
        slot.enter(Ready())
    slot.interface.end()


def _stop_with(slot: Slot, error: Exception, missing: str = "") -> None:
    cause = f"{type(error).__name__}: {error}"
    slot.stop(f"{missing} ({cause})" if missing else cause)


def _remember_grasp(slot: Slot, request: MotionRequest, end: np.ndarray) -> None:
    """Keep what a path that ends at a voxel [3] closes the hand around, so that the next look can check it."""
    perception = slot.interface.perception
    voxel = np.clip(np.round(end), 0, perception.grid.size - 1).astype(int)
    name = perception.targets.get((int(voxel[0]), int(voxel[1]), int(voxel[2])))
    if name and request.closed_at_end(voxel) and name in perception.snapshot.poses:
        offset = perception.position_of(voxel) - perception.snapshot.poses[name][:3]
        slot.grip = replace(slot.grip, grasp=Grasp(name, offset))
