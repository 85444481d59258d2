"""``voxposer``: the language-driven planner as a policy of the harness.

It follows the instruction of each slot with ``voxposer.agent`` and reports, an episode: subtasks, waypoints, questions
to the language model and their cost, and why a failed one failed. A slot whose episode has ended begins the next one in
the agent's next round, while the others are between subtasks of theirs. The model is ``offline/libero`` unless another
is named: a rule-based writer of programs, no language model at all. The policy's name says which it was.

An episode whose model could not be asked has no verdict (:meth:`VoxPoserPolicy.episode_error`); a model that can be
asked in no episode ends the run (``PolicyUnavailable``). Every question and reply of an episode is its log, from which
``replay=FOLDER`` answers without the model.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from vecenv.contract import BatchEnv, Control, ResetInfo
from vecenv.errors import InvalidFile, InvalidInput
from vecenv_eval.policies import PolicyError, PolicyUnavailable
from voxposer.agent import Agent, PlannedMotion
from voxposer.language.lmp_config import Call
from voxposer.language.replies import LlmError, Usage
from voxposer.language.saved import to_lines
from voxposer.perception.config import CAMERAS
from voxposer.settings import Settings
from voxposer.simpler_scene import hands
from voxposer.slots import Slot

_log = logging.getLogger(__name__)


class VoxPoserPolicy:
    """VoxPoser for a batch of slots.

    Args:
        **options: see :class:`voxposer.settings.Settings`: ``model``, ``temperature``, ``passes``, ``replay``,
            ``planner.max_steps``, ...

    Attributes:
        name: how the policy is called in results, the model and the perception included.
        settings: the options.
        agent: what drives the present batch.
        on_planned: called with every motion as it is planned, if set before ``reset``.

    Raises:
        PolicyError: there is no such option, or its value cannot be used.
    """

    def __init__(self, **options: Any) -> None:
        try:
            self.settings = Settings.of(options)
            self._llm = self.settings.open_llm()
        except (InvalidInput, InvalidFile) as error:
            raise PolicyError(str(error)) from error
        seeing = self.settings.agent_config().perception
        self.name = f"voxposer ({self.settings.writer}; perception: {seeing.title})"
        self.agent: Agent | None = None
        self.on_planned: Callable[[PlannedMotion], None] | None = None
        self._episodes: tuple[str, ...] = ()

    def needed_cameras(self) -> tuple[str, ...]:
        """The cameras whose depth images are read; none with ground truth."""
        seeing = self.settings.agent_config().perception
        return (seeing.camera.cameras or CAMERAS[:1]) if seeing.source == "camera" else ()

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Begin with a freshly placed batch, and let go of the one before."""
        if self.agent is not None:
            self.agent.close()
        seen, robot = hands(env, info.suite, self.settings.agent_config())
        config = robot if seen is env else self.settings.agent_config(robot)
        self._episodes = info.episode_id
        self.agent = Agent(
            seen,
            info.instruction,
            self._llm,
            config,
            self.settings.prompts_dir,
            self.on_planned,
            episodes=info.episode_id,
        )

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Begin other episodes in some slots while the others continue theirs."""
        del env
        assert self.agent is not None, "call reset() first"
        self._episodes = info.episode_id
        self.agent.begin(info.instruction, slots.tolist(), info.episode_id)

    def act(self, env: BatchEnv) -> Control:
        """Plan and follow the next subtask of every slot.

        Raises:
            PolicyUnavailable: no model can be asked: no or a wrong key, no credit, an unknown model, no saved reply.
        """
        del env
        assert self.agent is not None, "call reset() first"
        try:
            return self.agent.step()
        except LlmError as error:
            raise PolicyUnavailable(str(error)) from error

    def episode_error(self, slot: int) -> str:
        """Why the episode in a slot has no verdict: the model could not be asked; "" if it could."""
        return self.agent.error(slot) if self.agent is not None else ""

    def extras(self, slot: int) -> dict[str, Any]:
        """What happened in a slot: counts, cost, and the cause if it failed."""
        assert self.agent is not None, "call reset() first"
        return report(self.agent, slot) | {"writer": self.settings.writer}

    def episode_log(self, slot: int) -> list[dict[str, Any]]:
        """Every question of a slot and its reply."""
        return [] if self.agent is None else to_lines(self._episodes[slot], self.agent.slots[slot].lmps.trace)

    def close(self) -> None:
        """Ask nothing again, say what was paid for, and release snapshots and maps."""
        self._llm.close()
        if not self.settings.llm.is_rule_base:
            _log.info("%s: %s", self.settings.writer, spent(self._llm.usage))
        if self.agent is not None:
            self.agent.close()


def spent(usage: Usage) -> str:
    """What a run paid for, in a sentence; tokens and price are not shown as 0 where they are not known."""
    tokens = f"{usage.prompt_tokens + usage.completion_tokens:,} tokens" if usage.uncounted < usage.calls else "tokens"
    price = f"{usage.cost_usd:.4f} US dollars" if usage.unpriced < usage.calls else "price"
    if usage.uncounted:
        tokens += f" (unknown for {usage.uncounted} answers)"
    if usage.unpriced:
        price += f" (unknown for {usage.unpriced} answers)"
    paid = f", {tokens}, {price}" if usage.calls else ""
    return f"{usage.calls} answers of the model, {usage.retries} attempts repeated, {usage.cached} cached answers{paid}"


def report(agent: Agent, index: int) -> dict[str, Any]:
    """Subtasks, waypoints, questions, cause and, of a language model, repairs, tokens and price of one slot, by name.

    Tokens and price are those of all its answers, also of those that came from the cache and cost nothing this time:
    they are the same in any batch.
    """
    slot = agent.slots[index]
    calls = slot.lmps.trace
    return {
        "perception": agent.perception,
        "subtasks": slot.progress.begun,
        "passes": slot.progress.passes,
        "waypoints": slot.counts.waypoints,
        "missed_waypoints": slot.counts.missed,
        "empty_grasps": slot.counts.empty_grasps,
        "questions": sum(not call.repair for call in calls),
        **({} if agent.rule_based else _of_model(calls)),
        "cause": cause(slot) if not agent.succeeded[index] else "",
    }


def _of_model(calls: Sequence[Call]) -> dict[str, Any]:
    """What a language model took; None is unknown, because the provider or litellm does not say."""
    answered = [call for call in calls if call.reply is not None]
    tokens = [count for call in answered for count in (call.prompt_tokens, call.completion_tokens)]
    return {
        "repairs": sum(bool(call.repair) for call in calls),
        "llm_tokens": _sum(tokens),
        "llm_cost_usd": _sum([call.cost_usd for call in answered]),
    }


def _sum(values: Sequence[float | None]) -> float | None:
    """The sum, None if a value is unknown."""
    known = [value for value in values if value is not None]
    return sum(known) if len(known) == len(values) else None


def cause(slot: Slot) -> str:
    """Why a slot failed, in a few words that can be counted."""
    if not slot.cause:
        return f"out of ticks at: {kind(slot.progress.text)}"
    return slot.cause.split(":")[0] if slot.cause.startswith("LmpError") else slot.cause


def kind(subtask: str) -> str:
    """The first two words of a subtask: what it does, without what it does it to."""
    return " ".join(subtask.split()[:2])
