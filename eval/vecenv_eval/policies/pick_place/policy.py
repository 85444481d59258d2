"""``pick_place``: a policy with ground truth that solves LIBERO tasks by picking things up and putting them down.

It sees the environment through its public verbs only. Planning happens slot by slot from ``observe_objects``: which
goal predicate is next (``goals``), how to hold the object and where to put it (``vecenv.manipulation.placing``), how to
get it there (``transfer``), how to operate drawers and knobs (``fixtures``). Moving happens for the whole batch at once
from ``observe_egocentric().state`` (``motion``). After a lift the object must be in the hand; if it is not, another
grasp is tried, a few times. What the policy cannot do it leaves alone and lists in ``unsupported``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vecenv.contract import BatchEnv, ResetInfo
from vecenv.manipulation.placing import Grasped, choose_grasp
from vecenv.manipulation.world import Margins, SceneGeometry
from vecenv.observations import ObjectsSnapshot
from vecenv_eval.policies.pick_place import fixtures, goals, transfer
from vecenv_eval.policies.pick_place.fixtures import DrawerHandle
from vecenv_eval.policies.pick_place.goals import Predicate
from vecenv_eval.policies.pick_place.motion import MotionConfig, WaypointFollower


@dataclass(frozen=True, kw_only=True)
class PickPlaceConfig:
    """Options of the policy.

    Attributes:
        transfer: margins of picking and placing.
        motion: how waypoints are followed.
        handle: how drawers are handled.
        knob_turn: how far knobs are turned at once, radians.
        attempts: how often a slot may start again before it gives up.
        at_rest: things that move less than this between two looks are at rest, metres.
        patience: looks after which a slot plans although things still move.
        home_reach: how far the hand is before the robot's base when an episode begins, metres.
        plan_every: slots that need a plan wait for each other up to this many ticks (at least 2), to share one look.
        followed: an object counts as held when it has risen at least this share of what the hand has risen.
    """

    transfer: Margins = field(default_factory=Margins)
    motion: MotionConfig = field(default_factory=MotionConfig)
    handle: DrawerHandle = field(default_factory=DrawerHandle)
    knob_turn: float = 1.0
    attempts: int = 6
    at_rest: float = 0.002
    patience: int = 10
    home_reach: float = 0.45
    plan_every: int = 4
    followed: float = 0.2


@dataclass
class _Slot:
    """Where one slot stands.

    Attributes:
        held: the object believed to be in the hand.
        predicate: what it was picked for.
        grasp: how it was grasped.
        before: pose of its origin before it was lifted.
        failed: per object, grasps that did not hold, relative to its origin.
        tried: predicates about joints that were worked on.
        attempts: picks begun so far.
        done: nothing more will be tried, and why.
        seen: where the movable things were when the slot was last looked at, [n, 3].
        waited: looks since things were at rest.
    """

    held: str = ""
    predicate: Predicate = ()
    grasp: Grasped | None = None
    before: np.ndarray = field(default_factory=lambda: np.zeros(7))
    failed: dict[str, list[np.ndarray]] = field(default_factory=dict)
    tried: set[Predicate] = field(default_factory=set)
    attempts: int = 0
    done: str = ""
    seen: np.ndarray | None = None
    waited: int = 0

    def moved(self, snapshot: ObjectsSnapshot, at_rest: float) -> bool:
        """Whether a movable thing has moved since the last look (a first look cannot tell)."""
        pos = np.array([snapshot.poses[name][:3] for name in snapshot.movable]).reshape(-1, 3)
        seen, self.seen = self.seen, pos
        return seen is None or bool((np.linalg.norm(pos - seen, axis=1) > at_rest).any())


class PickPlacePolicy:
    """Ground-truth pick and place for a batch of slots.

    Args:
        config: options.

    Attributes:
        name: how the policy is called in results.
        unsupported: slot and reason for every slot whose goal it has no plan for, as of now.
    """

    name = "pick_place"

    def __init__(self, config: PickPlaceConfig | None = None) -> None:
        self.config = config or PickPlaceConfig()
        self._slots: list[_Slot] = []
        self._follower = WaypointFollower(0, self.config.motion)
        self._ticks = np.zeros(0, int)
        self._base = np.zeros((0, 2))

    @property
    def unsupported(self) -> tuple[tuple[int, str], ...]:
        """Slot and reason for every slot that is left alone."""
        return tuple((i, slot.done) for i, slot in enumerate(self._slots) if slot.done)

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Look at every slot; plans begin when a second look shows that things are at rest."""
        del info
        self._slots = [_Slot() for _ in range(env.num_envs)]
        self._follower = WaypointFollower(env.num_envs, self.config.motion)
        self._ticks = np.zeros(env.num_envs, int)
        self._base = np.zeros((env.num_envs, 2))
        self._begin_slots(env, np.arange(env.num_envs))

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Likewise for the slots that begin."""
        del info
        for slot in slots.tolist():
            self._slots[slot] = _Slot()
        self._follower.clear(slots)
        self._ticks[slots] = 0
        self._begin_slots(env, slots)

    def _begin_slots(self, env: BatchEnv, slots: np.ndarray) -> None:
        hand = env.observe_egocentric().state[slots, :2].astype(float)
        self._base[slots] = hand - self.config.home_reach * np.array([1.0, 0.0])
        self._plan(env, np.isin(np.arange(env.num_envs), slots))

    def act(self, env: BatchEnv) -> np.ndarray:
        """Actions of this tick, [B, 7]."""
        # Every slot counts its own ticks, so that its plans do not depend on the batch around it.
        waiting = self._follower.finished & (self._ticks % self.config.plan_every == 1)
        if waiting.any():
            waiting &= ~self._settled(env)
            if waiting.any():
                self._plan(env, waiting)
        self._ticks += 1
        return self._follower.act(env.observe_egocentric().state)

    def _settled(self, env: BatchEnv) -> np.ndarray:
        """Slots that need no more plans: solved or given up."""
        return env.evaluate().success | np.array([bool(slot.done) for slot in self._slots])

    def _plan(self, env: BatchEnv, waiting: np.ndarray) -> None:
        snapshots = env.observe_objects(slots=waiting).snapshot
        for i in np.flatnonzero(waiting):
            snapshot, slot = snapshots[i], self._slots[i]
            if snapshot is None:
                slot.done = "no ground truth: the slot's physics failed"
            elif self._at_rest(slot, snapshot):
                self._plan_slot(int(i), slot, SceneGeometry(snapshot, self.config.transfer, self._base[i]))

    def _at_rest(self, slot: _Slot, snapshot: ObjectsSnapshot) -> bool:
        """Whether things lie still; or the hand has hold of one of them, or this has been waited for long enough."""
        moved = slot.moved(snapshot, self.config.at_rest)
        slot.waited = slot.waited + 1 if moved and not slot.held else 0
        return slot.waited == 0 or slot.waited > self.config.patience

    def _plan_slot(self, i: int, slot: _Slot, world: SceneGeometry) -> None:
        """Put the object down if it came along; else begin with the first goal predicate that does not hold."""
        if slot.held and self._came_along(slot, world):
            target = goals.target_of(slot.predicate, world)
            if not isinstance(target, str):
                self._follower.load(i, transfer.place(world, slot.held, target))
                slot.held = ""
                return
        if slot.held and slot.grasp is not None:
            slot.failed.setdefault(slot.held, []).append(slot.grasp.pos - slot.before[:3])
            slot.held = ""
        self._begin(i, slot, world)

    def _came_along(self, slot: _Slot, world: SceneGeometry) -> bool:
        assert slot.grasp is not None
        risen = world.snapshot.poses[slot.held][2] - slot.before[2]
        return risen > self.config.followed * (world.hand[2] - slot.grasp.pos[2])

    def _begin(self, i: int, slot: _Slot, world: SceneGeometry) -> None:
        predicate = self._next(slot, world)
        if predicate is None or slot.attempts >= self.config.attempts:
            slot.done = f"gave up after {slot.attempts} attempts"
            return
        slot.attempts += 1
        if goals.shut(predicate, world):
            predicate = ("open", predicate[2])
        if predicate[0] in goals.PLACING and len(predicate) == 3:
            self._begin_transfer(i, slot, world, predicate)
        else:
            self._begin_fixture(i, slot, world, predicate)

    def _begin_fixture(self, i: int, slot: _Slot, world: SceneGeometry, predicate: Predicate) -> None:
        region = world.snapshot.regions.get(predicate[1])
        if predicate[0] == "close" and region is not None and region.axis is not None:
            plan = fixtures.close_drawer(world, region, self.config.handle)
        elif predicate[0] == "open" and region is not None and region.axis is not None:
            plan = fixtures.open_drawer(world, region, self.config.handle)
        elif predicate[0] in ("turnon", "turnoff"):
            turn = self.config.knob_turn if predicate[0] == "turnon" else -self.config.knob_turn
            plan = fixtures.turn_knob(world, predicate[1], turn)
        else:
            plan = f"no plan for {predicate[0]}"
        if isinstance(plan, str):
            slot.done = plan
            return
        slot.tried.add(predicate)
        self._follower.load(i, plan)

    def _begin_transfer(self, i: int, slot: _Slot, world: SceneGeometry, predicate: Predicate) -> None:
        name = predicate[1]
        target = goals.target_of(predicate, world)
        if isinstance(target, str):
            slot.done = target
            return
        grasp = choose_grasp(world, name, slot.failed.get(name, ()))
        if grasp is None:
            slot.done = f"{name} offers nothing to hold"
            return
        self._follower.load(i, transfer.pick(world, name, grasp, target.xy[0]))
        slot.held, slot.predicate, slot.grasp = name, predicate, grasp
        slot.before = world.snapshot.poses[name].copy()

    def _next(self, slot: _Slot, world: SceneGeometry) -> Predicate | None:
        """The first predicate that neither holds nor was worked on; when none is left, all of them count again."""
        ordered = goals.in_order(world.snapshot.goal)
        missing = [p for p in ordered if p not in slot.tried and not goals.holds(p, world.snapshot)]
        if not missing:
            slot.tried.clear()
            missing = [p for p in ordered if not goals.holds(p, world.snapshot)]
        return missing[0] if missing else next((p for p in reversed(ordered) if p[0] in goals.PLACING), None)
