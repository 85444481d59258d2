"""The method as a whole, for a batch: language in, each subtask planned on a fresh observation and executed.

An environment that speaks ``vecenv.contract`` and an :class:`~voxposer.language.llm.Llm` come in. In each round
(:meth:`Agent.step`) every slot that has a subtask left plans it on one frozen snapshot (``voxposer.runtime``), and one
``env.step_waypoints`` executes all plans; with ``follow="waypoint"``, one ``env.step_ee_pose`` executes a waypoint of
each. A slot that is stopped holds still, and the other slots continue; one whose questions the model does not answer
ends at once, without a verdict (:meth:`Agent.error`).

Nothing that a slot does depends on the others: in a round it executes its own plan and no tick more, so a slot may
begin another episode (:meth:`Agent.begin`) while the others are anywhere in theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vecenv.contract import BatchEnv, Control
from vecenv.errors import InvalidInput
from vecenv.observations import ObjectsSnapshot
from voxposer.episode import (
    ALL_SUBTASKS,
    SUBTASK_BUDGET,
    Expanded,
    check_done,
    expand_for_settle,
    scattered,
)
from voxposer.following import FOLLOW, Following
from voxposer.language.llm import Llm
from voxposer.perception.sight import make_sight
from voxposer.planned import PlannedMotion
from voxposer.runtime import Runtimes
from voxposer.runtime_config import RuntimeConfig
from voxposer.slots import FOLLOWED, Slot

__all__ = ["Agent", "AgentConfig", "PlannedMotion"]


@dataclass(frozen=True, kw_only=True)
class AgentConfig(RuntimeConfig):
    """Options of the agent: those of planning, here without budgets of subtasks and waypoints, and these.

    Attributes:
        passes: how often the whole instruction is planned when it was executed to the end without success.
        max_misses: a plan is abandoned after this many waypoints in a row that could not be reached.
        idle_ticks: ticks that stopped slots wait in a round in which no slot has a plan.
        wait: a slot that is stopped holds still until the environment's budget is spent, and may still be solved by
            what moves on its own. False ends its episode at once.
        follow: ``"plan"`` executes a whole plan in one call, ``"waypoint"`` one waypoint a call.
    """

    max_subtasks: int | None = None
    max_waypoints: int | None = None
    passes: int = 3
    max_misses: int = 2
    idle_ticks: int = 50
    wait: bool = True
    follow: Following = "plan"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.follow not in FOLLOW:
            raise InvalidInput(f"follow={self.follow!r}: expected one of {', '.join(FOLLOW)}")


class Agent:
    """VoxPoser for the batch of an environment that was just reset.

    Args:
        env: the environment.
        instructions: of each slot, B strings.
        llm: the language model.
        config: options.
        prompts_dir: folder of prompts to use in place of the package's own.
        on_planned: called with every motion as it is planned.
        episodes: name of the episode in each slot, by which saved replies are found; may be empty.

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
        episodes: Sequence[str] = (),
    ) -> None:
        self.env, self.config, self._on_planned = env, config, on_planned
        count = env.num_envs
        planned = self._planned if on_planned else None
        self._runtimes = Runtimes(llm, config, prompts_dir=prompts_dir, on_planned=planned, most=count)
        self._finished, self.succeeded = np.zeros(count, bool), np.zeros(count, bool)
        self._rounds, self._live = np.zeros(count, int), np.zeros(0, int)
        self._subtasks: list[tuple[str, ...]] = [()] * count
        self._index = np.zeros(count, int)
        self._instructions = list(instructions)
        self._sight = make_sight(env, config.perception)
        homes = self._sight.begin(range(count))
        self._handles = self._runtimes.init([None] * count, episodes, homes)
        self.slots = [self._opened(*pair) for pair in zip(self._handles, instructions, strict=True)]

    @property
    def perception(self) -> str:
        """Where observations come from, in words: ground truth, or which cameras and what segments their images."""
        return self._sight.title

    @property
    def rule_based(self) -> bool:
        """Whether rules write the programs, and no language model."""
        return self._runtimes.rule_based

    def begin(self, instructions: Sequence[str], slots: Sequence[int], episodes: Sequence[str] = ()) -> None:
        """Begin other episodes in some slots, which were just reset; the others continue theirs.

        Args:
            instructions: of every slot of the batch, B strings.
            slots: the slots that begin.
        """
        homes = self._sight.begin(slots)
        for i in slots:
            self._runtimes.release([self._handles[i]])
            (self._handles[i],) = self._runtimes.init([None], [episodes[i]] if episodes else (), homes[[i]])
            self.slots[i] = self._opened(self._handles[i], instructions[i])
            self._instructions[i], self._subtasks[i] = instructions[i], ()
            self._index[i] = self._rounds[i] = 0
            self._finished[i] = self.succeeded[i] = False

    def step(self) -> Control:
        """One round: plan a subtask in every slot that has one left, and execute the plans; stopped slots wait.

        Raises:
            LlmError: the model can be asked in no slot, whatever is tried (``permanent``).
        """
        live = [i for i, slot in enumerate(self.slots) if not self._finished[i] and not slot.cause]
        seen = self._sight.look(live, [slot.grip.closed for slot in self.slots])
        for i in live:
            self.slots[i].missing = seen.error[i] or self._sight.unseen(i)
        expanded = self._plan(live, seen.snapshot)
        ended = [i for i in live if self.slots[i].error or (self.slots[i].cause and not self.config.wait)]
        if ended:
            self.env.end_episodes(ended)
        if not expanded.plan.valid.any():
            return self._record(self._wait())
        followed = FOLLOW[self.config.follow](self.env, self._with_waiting(expanded), self.config.max_misses)
        for slot, missed in zip(self.slots, followed.missed.tolist(), strict=True):
            slot.counts = replace(slot.counts, missed=slot.counts.missed + missed)
        return self._record(followed.control)

    def error(self, index: int) -> str:
        """Why the episode in a slot ends without a verdict: the model could not be asked; "" if it could."""
        return self.slots[index].error

    def close(self) -> None:
        """Release snapshots and maps; nothing can be planned afterwards."""
        self._runtimes.release(self._handles)
        self._handles = []

    def _opened(self, handle: str, instruction: str) -> Slot:
        """The state of an episode that has just begun."""
        slot = self._runtimes.slot(handle)
        slot.instruction = instruction
        return slot

    def _planned(self, motion: PlannedMotion) -> None:
        """Name the slot of a motion, which was planned as one row of a call."""
        assert self._on_planned is not None
        self._on_planned(replace(motion, slot=int(self._live[motion.slot])))

    # -- planning ------------------------------------------------------------------------------------------------------

    def _plan(self, live: Sequence[int], snapshots: Sequence[ObjectsSnapshot | None]) -> Expanded:
        """Waypoints of every slot; an instruction whose subtasks are used up is split again, as often as allowed."""
        self._runtimes.observe([self._handles[i] for i in live], [snapshots[i] for i in live])
        parts: list[tuple[np.ndarray, Expanded]] = []
        while live := self._with_subtasks(live):
            self._live = rows = np.array(live)
            planned = self._runtimes.plan_subtask(
                [self._handles[i] for i in live],
                [self._subtasks[i] for i in live],
                self._index[rows],
                [snapshots[i] for i in live],
            )
            self._index[rows] = planned.next_subtask_index
            expanded = expand_for_settle(
                planned.trajectory, planned.prev_gripper, self.config.plan, max_waypoints=self.config.max_waypoints
            )
            self._runtimes.set_gripper([self._handles[i] for i in live], expanded.last_gripper)
            parts.append((rows, expanded))
            for i, count in zip(live, expanded.n_out.tolist(), strict=True):
                slot = self.slots[i]
                slot.counts = replace(slot.counts, waypoints=slot.counts.waypoints + count)
            self._rounds[rows] += 1
            live = rows[planned.n_waypoints == 0].tolist()
        return scattered(parts, self.env.num_envs, self.config.plan)

    def _with_subtasks(self, live: Sequence[int]) -> list[int]:
        """The slots that have a subtask left; the others are split again or stopped, for the reason of the layer."""
        rows = np.array(live, int)
        counts = np.array([len(self._subtasks[i]) for i in live], int)
        failed = [bool(self.slots[i].cause) for i in live]
        most = self.config.max_subtasks
        checked = check_done(
            self._index[rows], counts, False, failed=failed, rounds=self._rounds[rows], max_subtasks=most
        )
        again = []
        for i, reason in zip(live, checked.reason, strict=True):
            if reason == ALL_SUBTASKS and self._may_split_again(i):
                again.append(i)
            elif reason == SUBTASK_BUDGET:
                self.slots[i].stop(SUBTASK_BUDGET)
        lists, _, _ = self._runtimes.planner([self._handles[i] for i in again], [self._instructions[i] for i in again])
        for i, subtasks in zip(again, lists, strict=True):
            self._subtasks[i], self._index[i] = subtasks, 0
        return [i for i in live if not self.slots[i].cause]

    def _may_split_again(self, i: int) -> bool:
        """Whether a slot's instruction is split into subtasks once more; the slot is stopped if not."""
        most = self.config.max_subtasks
        if self.slots[i].progress.passes >= self.config.passes:
            self.slots[i].stop(FOLLOWED)
        elif most is not None and self._rounds[i] >= most:
            self.slots[i].stop(SUBTASK_BUDGET)
        return not self.slots[i].cause

    # -- waiting -------------------------------------------------------------------------------------------------------

    def _with_waiting(self, expanded: Expanded) -> Expanded:
        """With a hold for each slot that was stopped, grip unchanged, so that its budget runs out meanwhile.

        It is no longer than the longest of the plans, of which each waypoint takes a tick or more.
        """
        plan = expanded.plan
        ticks = int(np.where(plan.valid, np.maximum(plan.hold, 1), 0).sum(axis=1).max())
        for i, slot in enumerate(self.slots):
            if slot.cause and not self._finished[i]:
                plan.valid[i], plan.valid[i, 0] = False, True
                plan.grip[i, 0], plan.hold[i, 0] = slot.grip.closed, ticks
        return expanded

    def _wait(self) -> Control:
        """Hold still with the grip unchanged."""
        actions = np.zeros((len(self.slots), self.config.idle_ticks, 7))
        actions[:, :, 6] = np.where([slot.grip.closed for slot in self.slots], 1.0, -1.0)[:, None]
        return self.env.step_continuous(actions)

    def _record(self, control: Control) -> Control:
        self._finished, self.succeeded = control.done, control.success
        return control
