"""The method as a whole, for a batch: language in, subtask after subtask planned on fresh ground truth and followed.

An environment that speaks ``vecenv.contract`` and an :class:`~voxposer.language.llm.Llm` come in. Each round
(:meth:`Agent.step`) every slot that has a subtask left plans it on one frozen snapshot: the composer's program asks for
motions, the planner turns all slots' value maps into paths in one call, and one ``env.step_waypoints`` follows all
plans. Things that shall move themselves are pushed: look, find the best push, push, look again. A slot whose program
fails, or that has nothing to hold on to, is left alone with the cause on record, and the others go on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from vecenv.contract import BatchEnv, Control, ObjectsSnapshot, PlanControl
from vecenv.manipulation.routes import RouteConfig, Stop, travel_route, work_route
from vecenv.manipulation.world import matrix
from voxposer import pushing
from voxposer.interface import Interface, InterfaceError, Request
from voxposer.language.llm import Llm
from voxposer.language.lmp import Lmps, build_lmps, run_planner
from voxposer.perception import Hand, Perception, PerceptionConfig, PerceptionError, quaternion
from voxposer.planning import plan as plans
from voxposer.planning.plan import PlanConfig, Row
from voxposer.planning.planner import PlannerConfig
from voxposer.pushing import PushError, Pushing, PushingConfig, Sight
from voxposer.sandbox.guard import HostFault
from voxposer.steps import plan_paths, touches

# The end of a path begins this many voxels before it: a grip that changes here changes at the end.
_END = 3.0


@dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """Options of the agent.

    Attributes:
        perception: how things are seen.
        route: how far the hand keeps from things.
        plan: how stops become waypoints.
        planner: of paths over voxels.
        push: how things are pushed.
        passes: how often the whole instruction is planned anew when it was followed to the end without success.
        max_misses: a plan is gone on with after this many waypoints in a row that could not be reached.
        idle_ticks: ticks that slots without a plan wait at once.
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
class Planned:
    """One motion as it was planned, for people to look at.

    Attributes:
        slot: whose.
        subtask: number of the subtask.
        text: its words.
        request: what the program asked for.
        perception: the snapshot it was planned on.
        path: over voxels, [P, 3].
        stops: what became of it.
    """

    slot: int
    subtask: int
    text: str
    request: Request
    perception: Perception
    path: np.ndarray
    stops: tuple[Stop, ...]


@dataclass
class Slot:
    """Where one slot stands.

    Attributes:
        instruction: what it was told.
        lmps: its language programs.
        interface: the functions that they call.
        home: pose of the hand when the episode began, [7].
        subtasks: what the planner made of the instruction.
        cursor: the next one.
        queue: motions asked for and not yet planned.
        pushing: what is being pushed where.
        passes: how often the instruction was planned.
        closed: the last grip command.
        cause: why nothing more is tried, "" while something is.
        grasped: name and place of the last grasp, relative to the thing's origin.
        failed: by name, such places of grasps that did not hold.
        waypoints: waypoints planned.
        missed: waypoints given up.
        empty_hands: grasps that did not hold.
        done_subtasks: subtasks begun.
        last: the latest subtask.
    """

    instruction: str
    lmps: Lmps
    interface: Interface
    home: np.ndarray
    subtasks: tuple[str, ...] = ()
    cursor: int = 0
    queue: list[Request] = field(default_factory=list)
    pushing: Pushing | None = None
    passes: int = 0
    closed: bool = False
    cause: str = ""
    grasped: tuple[str, np.ndarray] | None = None
    failed: dict[str, list[np.ndarray]] = field(default_factory=dict)
    waypoints: int = 0
    missed: int = 0
    empty_hands: int = 0
    done_subtasks: int = 0
    last: str = ""


class Agent:
    """VoxPoser for the batch of an environment that was just reset.

    Args:
        env: the environment.
        instructions: what each slot is told, B strings.
        llm: the language model.
        config: options.
        prompts_dir: prompts to use in place of the package's own.
        on_planned: called with every motion as it is planned.

    Attributes:
        slots: where each slot stands.
        succeeded: which have solved their task, bool [B].
    """

    def __init__(
        self,
        env: BatchEnv,
        instructions: Sequence[str],
        llm: Llm,
        config: AgentConfig = AgentConfig(),
        prompts_dir: str | None = None,
        on_planned: Callable[[Planned], None] | None = None,
    ) -> None:
        self.env, self.config, self._on_planned = env, config, on_planned
        self._finished, self.succeeded = np.zeros(env.num_envs, bool), np.zeros(env.num_envs, bool)
        self.slots: list[Slot] = []
        for instruction, snapshot in zip(instructions, env.observe_objects().snapshot, strict=True):
            interface = Interface()
            home = np.zeros(7) if snapshot is None else snapshot.ee_pose.copy()
            lmps = build_lmps(interface.functions(), llm, prompts_dir)
            self.slots.append(Slot(instruction, lmps, interface, home))

    def step(self) -> Control:
        """One round: plan a subtask in every slot that has one left, and follow the plans; or wait."""
        snapshots = self.env.observe_objects().snapshot
        live = [i for i, slot in enumerate(self.slots) if not self._finished[i] and not slot.cause]
        for i in live:
            self._ask(self.slots[i], snapshots[i])
        rows = self._plan(live)
        if not any(rows):
            return self._book(self._wait())
        return self._book(self._follow(plans.stack(rows, self.config.plan)))

    def close(self) -> None:
        """Let go of snapshots and maps; nothing can be planned afterwards."""
        for slot in self.slots:
            slot.queue, slot.pushing = [], None
            slot.interface.end()

    # -- one slot's subtask --------------------------------------------------------------------------------------------

    def _ask(self, slot: Slot, snapshot: ObjectsSnapshot | None) -> None:
        """Let the programs of the next subtasks run until one asks for a motion."""
        if snapshot is None:
            slot.cause = "no ground truth: the slot's physics failed"
            return
        try:
            perception = self._look(slot, snapshot)
            slot.interface.begin(perception)
            if slot.pushing and pushing.arrived(slot.pushing, perception):
                slot.pushing = None
            while not slot.pushing and not slot.queue and self._next(slot, perception):
                slot.last = slot.subtasks[slot.cursor]
                slot.cursor += 1
                slot.done_subtasks += 1
                slot.lmps.composer(slot.last)
                slot.queue = slot.interface.taken()
        except (HostFault, PerceptionError, InterfaceError) as error:
            self._give_up(slot, error)

    def _give_up(self, slot: Slot, error: Exception) -> None:
        slot.cause = f"{type(error).__name__}: {error}"
        slot.queue, slot.pushing = [], None

    def _look(self, slot: Slot, snapshot: ObjectsSnapshot) -> Perception:
        hand = Hand(snapshot.ee_pose, slot.home, slot.closed)
        perception = Perception(snapshot, hand, self.config.perception, slot.failed)
        if slot.grasped and slot.closed:
            name, place = slot.grasped
            if name in snapshot.movable and perception.held != name:
                slot.failed.setdefault(name, []).append(place)
                slot.empty_hands += 1
        slot.grasped = None
        return perception

    def _next(self, slot: Slot, perception: Perception) -> bool:
        """Whether a subtask is left; the instruction is planned when none is, as often as allowed."""
        if slot.cursor < len(slot.subtasks):
            return True
        if slot.passes >= self.config.passes:
            slot.cause = "followed to the end without success"
            return False
        slot.passes += 1
        slot.lmps.set_context(perception.names)
        slot.subtasks, slot.cursor = run_planner(slot.lmps, slot.instruction), 0
        if not slot.subtasks:
            slot.cause = "the planner found nothing to do"
        return bool(slot.subtasks)

    # -- planning ------------------------------------------------------------------------------------------------------

    def _plan(self, live: Sequence[int]) -> list[list[Row]]:
        """Waypoints of every slot for what its programs asked for; none where nothing was."""
        rows: list[list[Row]] = [[] for _ in self.slots]
        for i in live:
            self._hand_back(self.slots[i])
        while asking := [i for i in live if self.slots[i].queue and not self.slots[i].pushing]:
            wants = [(self.slots[i].interface, self.slots[i].queue.pop(0)) for i in asking]
            for i, want, path in zip(
                asking, wants, plan_paths(wants, self.config.planner, self.config.route), strict=True
            ):
                rows[i] += self._rows(self.slots[i], want[1], path)
        self._plan_pushes([i for i in live if self.slots[i].pushing], rows)
        for slot, own in zip(self.slots, rows, strict=True):
            slot.waypoints += len(own)
        return rows

    def _hand_back(self, slot: Slot) -> None:
        """The hand counts as being where it is, no longer at the end of what programs asked for."""
        if slot.queue:
            ee = slot.interface.perception.snapshot.ee_pose
            slot.interface.perception.move_hand(ee[:3], matrix(ee[3:]), closed=slot.closed)

    def _plan_pushes(self, slots: Sequence[int], rows: list[list[Row]]) -> None:
        """The next push of every slot that pushes, found for all in one call."""
        seen = {i: sight for i in slots if (sight := self._sight(self.slots[i]))}
        for i, stops in zip(seen, pushing.next_pushes(list(seen.values()), self.config.push), strict=True):
            slot = self.slots[i]
            ee = slot.interface.perception.ee
            here = Stop(ee.pos, quaternion(ee.rotation), True)
            way = [*self._travel(slot, [here, stops[0]]), *stops[1:]]
            own, slot.closed = plans.expand_flips(way, slot.closed, slot.done_subtasks - 1, self.config.plan)
            rows[i] += own

    def _sight(self, slot: Slot) -> Sight | None:
        assert slot.pushing is not None
        try:
            return pushing.sight(slot.pushing, slot.interface.perception, self.config.push)
        except PushError as error:
            self._give_up(slot, error)
            return None

    def _rows(self, slot: Slot, request: Request, path: np.ndarray | InterfaceError) -> list[Row]:
        """Waypoints of one motion; the hand then counts as being at its end."""
        try:
            if isinstance(path, InterfaceError):
                raise path
            if request.object_centric:
                slot.pushing = Pushing(request.movable, slot.interface.perception.grid.world(path))
                return []
            stops = self._stops(slot, request, path)
        except InterfaceError as error:
            self._give_up(slot, error)
            return []
        if self._on_planned:
            number, path = slot.done_subtasks - 1, np.asarray(path)
            perception = slot.interface.perception
            self._on_planned(
                Planned(self.slots.index(slot), number, slot.last, request, perception, path, tuple(stops))
            )
        rows, slot.closed = plans.expand_flips(stops, slot.closed, slot.done_subtasks - 1, self.config.plan)
        slot.interface.perception.move_hand(stops[-1].pos, matrix(stops[-1].quat), closed=slot.closed)
        return rows

    def _stops(self, slot: Slot, request: Request, path: np.ndarray) -> list[Stop]:
        perception = slot.interface.perception
        ee = perception.ee
        here = Stop(ee.pos, quaternion(ee.rotation), slot.closed)
        if request.kind == "stay":
            voxel = perception.grid.voxel(ee.pos)
            quat, closed = request.rotation_at(voxel), request.closed_at_end(voxel)
            return [Stop(ee.pos, quat, closed, request.velocity_at(voxel), final=True)]
        if request.kind == "home":
            home = perception.hand.home
            return self._travel(slot, [here, Stop(home[:3], home[3:], slot.closed, final=True)])
        touching = touches(perception, request, self.config.route)
        stops = along(request, path, perception)
        stops[0] = Stop(here.pos, here.quat, stops[0].closed, stops[0].velocity)
        self._remember(slot, stops[-1], path[-1])
        return work_route(stops, self.config.route) if touching else self._travel(slot, stops)

    def _travel(self, slot: Slot, stops: list[Stop]) -> list[Stop]:
        perception = slot.interface.perception
        axes = matrix(stops[0].quat)[:, 2], matrix(stops[-1].quat)[:, 2]
        held = perception.held if stops[0].closed else ""
        return travel_route(stops, axes, perception.world, held, self.config.route)

    def _remember(self, slot: Slot, end: Stop, voxel: np.ndarray) -> None:
        """What the path closes the hand around, so that the next look can tell whether it holds."""
        perception = slot.interface.perception
        x, y, z = (int(index) for index in np.round(voxel))
        name = perception.targets.get((x, y, z))
        if name and end.closed and name in perception.snapshot.poses:
            slot.grasped = name, end.pos - perception.snapshot.poses[name][:3]

    # -- following -----------------------------------------------------------------------------------------------------

    def _follow(self, plan: plans.Plan) -> PlanControl:
        """Follow a plan to its end; where a slot cannot get through, it goes on behind that."""
        control = self.env.step_waypoints(plan, max_misses=self.config.max_misses)
        while True:
            given_up = plan.valid & (control.waypoint_ticks > 0) & ~control.converged & (plan.hold == 0)
            for slot, count in zip(self.slots, given_up.sum(axis=1), strict=True):
                slot.missed += int(count)
            plan = plans.remaining(plan, control.waypoint_ticks)
            plan = plan._replace(valid=plan.valid & ~control.done[:, None])
            if not plan.valid.any():
                return control
            control = self.env.step_waypoints(plan, max_misses=self.config.max_misses)

    def _wait(self) -> Control:
        """Nothing is left to do: hold still, the grip as it is."""
        actions = np.zeros((len(self.slots), self.config.idle_ticks, 7))
        actions[:, :, 6] = np.where([slot.closed for slot in self.slots], 1.0, -1.0)[:, None]
        return self.env.step_continuous(actions)

    def _book(self, control: Control) -> Control:
        self._finished, self.succeeded = control.done, control.success
        return control


def along(request: Request, path: np.ndarray, perception: Perception) -> list[Stop]:
    """The stops of a path over voxels [P, 3], each with the rotation, velocity and grip of its maps.

    A grip that changes within 3 voxels of the end changes at the end: a hand that closes around something must be there
    first.
    """
    size = perception.grid.size
    voxels = np.clip(np.round(path), 0, size - 1).astype(int)
    closed = [request.closed_at(voxel) for voxel in voxels]
    closed[-1] = request.closed_at_end(voxels[-1])
    far = np.flatnonzero(np.linalg.norm(voxels - voxels[-1], axis=1) > _END)
    before = closed[int(far[-1])] if len(far) else closed[0]
    for i in range(int(far[-1]) + 1 if len(far) else 1, len(voxels) - 1):
        closed[i] = before
    stops = [
        Stop(perception.grid.world(at), request.rotation_at(voxel), grip, request.velocity_at(voxel))
        for at, voxel, grip in zip(path, voxels, closed, strict=True)
    ]
    end = stops[-1]
    stops[-1] = Stop(perception.position_of(voxels[-1]), end.quat, end.closed, end.velocity, final=True)
    return stops
