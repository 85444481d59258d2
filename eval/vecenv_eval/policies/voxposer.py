"""``voxposer``: the language-driven planner as a policy of the harness.

It follows the instruction of each slot with ``voxposer.agent`` and reports, an episode: subtasks, waypoints, questions
to the language model and their cost, and why a failed one failed. A slot whose episode has ended begins the next one in
the agent's next round, while the others are between subtasks of theirs. The model is ``offline/libero`` unless another
is named: a rule-based writer of programs, no language model at all. The policy's name says which it was.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vecenv.contract import BatchEnv, Control, ResetInfo
from vecenv.errors import InvalidInput
from voxposer.agent import Agent, AgentConfig
from voxposer.language.llm import Llm, LlmConfig
from voxposer.perception.config import CAMERAS, CameraConfig, PerceptionConfig
from voxposer.simpler_scene import hands
from voxposer.slots import Slot


class VoxPoserPolicy:
    """VoxPoser for a batch of slots.

    Args:
        model: litellm's name of the model that writes the programs.
        prompts_dir: a folder of prompts to use in place of the package's own.
        passes: how often an instruction is planned again after it was followed to the end without success.
        api_base: address of the model's provider, litellm's own by default.
        perception: ``"ground_truth"``, the simulator's objects; or ``"camera"``, depth images.
        segmentation: of camera images: ``"renderer"``, its instance masks; or ``"geometry"``, none.
        cameras: of ``perception="camera"``, their names, with commas; by default agentview, and wrist where there is
            one.

    Attributes:
        name: how the policy is called in results, the model and the perception included.
        agent: what drives the present batch.
    """

    def __init__(
        self,
        model: str = "offline/libero",
        prompts_dir: str | None = None,
        passes: int = 3,
        api_base: str | None = None,
        perception: str = "ground_truth",
        segmentation: str = "renderer",
        cameras: str | None = None,
    ) -> None:
        names = None if cameras is None else tuple(name.strip() for name in cameras.split(","))
        camera = CameraConfig(cameras=names, segmentation=segmentation)
        seeing = PerceptionConfig(source=perception, camera=camera)
        if perception != "camera" and (cameras is not None or segmentation != CameraConfig().segmentation):
            raise InvalidInput("segmentation and cameras are options of perception=camera")
        self.config = AgentConfig(passes=passes, perception=seeing)
        writer = f"{model}{', rule-based' if model.startswith('offline/') else ''}"
        self.name = f"voxposer ({writer}; perception: {seeing.title})"
        self._llm = Llm(LlmConfig(model=model, api_base=api_base))
        self._prompts_dir = prompts_dir
        self.agent: Agent | None = None

    def needed_cameras(self) -> tuple[str, ...]:
        """The cameras whose depth images are read; none with ground truth."""
        seeing = self.config.perception
        return (seeing.camera.cameras or CAMERAS[:1]) if seeing.source == "camera" else ()

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Begin with a freshly placed batch, and let go of the one before."""
        if self.agent is not None:
            self.agent.close()
        seen, config = hands(env, info.suite, self.config)
        self.agent = Agent(seen, info.instruction, self._llm, config, self._prompts_dir)

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Begin other episodes in some slots while the others continue theirs."""
        del env
        assert self.agent is not None, "call reset() first"
        self.agent.begin(info.instruction, slots.tolist())

    def act(self, env: BatchEnv) -> Control:
        """Plan and follow the next subtask of every slot."""
        del env
        assert self.agent is not None, "call reset() first"
        return self.agent.step()

    def extras(self, slot: int) -> dict[str, Any]:
        """What happened in a slot: counts, cost, and the cause if it failed."""
        assert self.agent is not None, "call reset() first"
        return report(self.agent, slot)


def report(agent: Agent, index: int) -> dict[str, Any]:
    """Subtasks, waypoints, questions to the model, tokens, cost and cause of one slot, by name.

    What the cache answered costs nothing: a question that several slots ask is paid by the first.
    """
    slot = agent.slots[index]
    calls = slot.lmps.trace
    paid = [call for call in calls if not call.cached]
    return {
        "perception": agent.perception,
        "subtasks": slot.progress.begun,
        "passes": slot.progress.passes,
        "waypoints": slot.counts.waypoints,
        "missed_waypoints": slot.counts.missed,
        "empty_grasps": slot.counts.empty_grasps,
        "llm_calls": len(calls),
        "llm_cached": sum(call.cached for call in calls),
        "llm_tokens": sum(call.prompt_tokens + call.completion_tokens for call in paid),
        "llm_cost_usd": sum(call.cost_usd or 0.0 for call in paid),
        "cause": cause(slot) if not agent.succeeded[index] else "",
    }


def cause(slot: Slot) -> str:
    """Why a slot failed, in a few words that can be counted."""
    if not slot.cause:
        return f"out of ticks at: {kind(slot.progress.text)}"
    return slot.cause.split(":")[0] if slot.cause.startswith("LmpError") else slot.cause


def kind(subtask: str) -> str:
    """The first two words of a subtask: what it does, without what it does it to."""
    return " ".join(subtask.split()[:2])
