"""SIMPLER as a node set: the template's verbs and SIMPLER's earlier names over one slot, and a panel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

import vecenv
from vecenv.contract import BatchEnv
from vecenv.interop.nodes.catalog import Selection, SimplerCatalog
from vecenv.interop.nodes.manager import EnvManager, EpisodeInfo
from vecenv.interop.nodes.nodeset import EnvNodeSet
from vecenv.interop.nodes.ports import Port, WireType, port
from vecenv.interop.nodes.texts import read_chunk
from vecenv.interop.nodes.tool import ERROR, Tool, ToolConfig
from vecenv.interop.nodes.verbs import (
    ANY,
    BOOL,
    CHUNK,
    IMAGE,
    IMAGES,
    POSE,
    TEXT,
    TRIGGER,
    ContinuousConfig,
    EnvTool,
    Evaluate,
    ObserveObjects,
    StepContinuous,
    StepEePose,
    StepTool,
    camera_image,
    control_outputs,
    metadata,
    step_chunk,
)

NAME = "env_simpler"
_INSTRUCTION = port("instruction", TEXT, "what a policy is told")
_EPISODE_ID = port("episode_id", TEXT, "split/task/episode")
_PLACE = (port("split", TEXT), port("task_id", TEXT, "name of the task"))
_MAX_STEPS = port("max_steps", ANY, "step budget of the task, control ticks")
# What is seen, besides where it was seen.
_SEEN = (
    port("observation", IMAGES, "the third-person image alone"),
    port("pose", POSE, "always None: nothing navigates"),
    port("agentview_image", IMAGE, "the third-person camera"),
    port("wrist_image", IMAGE, "always None: there is no such camera"),
    port("state", ANY, "float32: joint positions, joint velocities, pose of the base; 23 or 29 numbers"),
)
_BUNDLE = (_INSTRUCTION, _EPISODE_ID, *_SEEN, *_PLACE, _MAX_STEPS)
# The first field of the panel.
_HEAD = "split"
_STEP_INDEX = port("step_index", ANY, "control ticks of the episode so far")
_SUCCESS = port("success", BOOL, "the task is solved after the latest tick")
_REWARD = port("reward", ANY, "of all ticks of this call")


def _seen(env: BatchEnv) -> dict[str, Any]:
    """What the camera sees and the joints, on the manager's thread."""
    seen = env.observe_egocentric()
    rgb, problem = camera_image(seen.images, "agentview")
    return {
        "observation": [] if rgb is None else [rgb],
        "agentview_image": rgb,
        "state": np.array(seen.state[0], np.float32),
        "error": problem,
    }


class ResetConfig(ToolConfig):
    """``observation``: fill the ports of what is seen, as before the verbs were separated; they are None without."""

    observation: bool = False


class Reset(EnvTool):
    """Make the selected episode live: a live one is left alone, a finished one begins again."""

    verb, display_name, family = "reset", "SIMPLER: Reset", "reset"
    inputs: ClassVar[tuple[Port, ...]] = (TRIGGER,)
    outputs: ClassVar[tuple[Port, ...]] = (*_BUNDLE, port("scene_id", TEXT, "name of the task's scene"), ERROR)
    config: ClassVar[type[ToolConfig]] = ResetConfig

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """Metadata of the episode."""
        episode = self.manager.ensure_live()
        seen = self.manager.run(lambda env, _: _seen(env)) if config.observation else {}
        return {**metadata(episode, _HEAD), "scene_id": _scene(episode.selection), **seen}


def _scene(selection: Selection) -> str:
    tasks: Any = vecenv.list_tasks(f"simpler/{selection.head}")
    return next(task.stage.name or "" for task in tasks if task.name == selection.task)


class SimplerStepContinuous(StepContinuous):
    """Advance by one action or a chunk of K, which ends early where the episode does; [] does nothing."""

    display_name = "SIMPLER: Step (continuous)"


class ObserveEgocentric(EnvTool):
    """See what the camera sees, and the joints; nothing advances."""

    verb, display_name, family = "observe_egocentric", "SIMPLER: Observe (egocentric)", "observe"
    inputs: ClassVar[tuple[Port, ...]] = (TRIGGER,)
    outputs: ClassVar[tuple[Port, ...]] = (
        port("rgb", IMAGE, "the third-person camera"),
        *_SEEN,
        port("intrinsics", ANY, "camera matrix [3, 3] of rgb with depth=true, else None"),
        port("depth", WireType.DEPTH, "metres, of rgb, with depth=true, else None"),
        ERROR,
    )

    class _Config(ToolConfig):
        """``depth``: fill ``depth`` and ``intrinsics``, which are None without."""

        depth: bool = False

    config: ClassVar[type[ToolConfig]] = _Config

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One look."""

        def job(env: BatchEnv, episode: EpisodeInfo) -> dict[str, Any]:
            outputs = _seen(env)
            outputs["rgb"] = outputs["agentview_image"]
            if config.depth:
                seen = env.observe_egocentric()
                outputs["depth"], problem = camera_image(seen.depths, "agentview")
                outputs["intrinsics"] = None if seen.intrinsics is None else seen.intrinsics[0].copy()
                outputs["error"] = outputs["error"] or problem
            return outputs

        return self.manager.run(job)


class Step(StepTool):
    """Advance by one action or a chunk of K and look afterwards: the step of before the verbs were separated."""

    verb, display_name, family = "step", "SIMPLER: Step", "step"
    inputs: ClassVar[tuple[Port, ...]] = (CHUNK,)
    outputs: ClassVar[tuple[Port, ...]] = (
        *_BUNDLE,
        port("done", BOOL, "the episode is over"),
        _REWARD,
        _SUCCESS,
        _STEP_INDEX,
        port("truncated", BOOL, "the step budget is spent, or the physics failed"),
        ERROR,
    )
    config: ClassVar[type[ToolConfig]] = ContinuousConfig

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One chunk and one look."""
        actions = read_chunk(given["action"], config.max_chunk_steps)

        def job(env: BatchEnv, episode: EpisodeInfo) -> dict[str, Any]:
            signals = control_outputs(step_chunk(self.manager, env, actions))
            told = {name: signals[name] for name in ("reward", "success", "step_index", "truncated")}
            about = {**metadata(episode, _HEAD), "instruction": env.instructions()[0]}
            return {**about, **_seen(env), **told, "done": signals["terminated"] or signals["truncated"]}

        return self.manager.run(job)

    def _after_error(self, text: str) -> dict[str, Any]:
        flags = self.manager.flags
        told = {"success": flags.success, "step_index": flags.step_index, "truncated": flags.truncated}
        return {"reward": 0.0, "done": flags.terminated or flags.truncated, **told}


class GetObservation(EnvTool):
    """See what the camera sees, with the episode's metadata: the observation of before the verbs were separated."""

    verb, display_name, family = "get_observation", "SIMPLER: Get Observation", "observe"
    inputs: ClassVar[tuple[Port, ...]] = (TRIGGER,)
    outputs: ClassVar[tuple[Port, ...]] = (*_BUNDLE, ERROR)

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One look."""
        return self.manager.run(
            lambda env, episode: {**metadata(episode, _HEAD), "instruction": env.instructions()[0], **_seen(env)}
        )


class EpisodeInformation(EnvTool):
    """Read what the episode is and how far it is; nothing advances and nothing is drawn."""

    verb, display_name, family = "episode_info", "SIMPLER: Episode Info", "info"
    outputs: ClassVar[tuple[Port, ...]] = (
        *_PLACE,
        _EPISODE_ID,
        _INSTRUCTION,
        _MAX_STEPS,
        _STEP_INDEX,
        port("cumulative_reward", ANY, "since the episode began"),
        _SUCCESS,
        port("done", BOOL, "the episode is over"),
        ERROR,
    )

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """Metadata only."""

        def job(env: BatchEnv, episode: EpisodeInfo) -> dict[str, Any]:
            found = env.evaluate()
            return {
                **metadata(episode, _HEAD),
                "instruction": env.instructions()[0],
                "step_index": int(found.num_steps[0]),
                "cumulative_reward": float(found.cumulative_reward[0]),
                "success": bool(found.success[0]),
                "done": bool(env.done[0]),
            }

        return self.manager.run(job)


class SimplerEvaluate(Evaluate):
    """Read the verdict of the episode; run it once, after the loop."""

    display_name, head = "SIMPLER: Evaluate", _HEAD
    outputs: ClassVar[tuple[Port, ...]] = (
        _SUCCESS,
        port("metrics", WireType.METRICS, "success (0 or 1), num_steps, split, task_id, cumulative_reward"),
        ERROR,
    )


class SimplerStepEePose(StepEePose):
    """Drive the tool to an absolute pose, or hold it still while the fingers move; [] does nothing."""

    display_name = "SIMPLER: Step (end-effector pose)"
    origin = "vecenv"


class SimplerObserveObjects(ObserveObjects):
    """Read the ground truth of the scene as one mapping; nothing advances."""

    display_name = "SIMPLER: Observe (objects)"
    origin = "vecenv"


# Grip column of actions: 1 closes and 0 opens, on both robots.
_OPTIONS: Mapping[str, Any] = {"gripper": "binary"}


class EnvSimplerNodeSet(EnvNodeSet):
    """SIMPLER's tools over one slot; all share the process's environments unless a manager is given.

    Args:
        manager: owner of the environments. They stay open when another split is chosen.
    """

    name, display_name = NAME, "SIMPLER"
    python_variable = "SIMPLER_PYTHON"

    def __init__(self, *, manager: EnvManager | None = None) -> None:
        super().__init__(manager or EnvManager.shared(NAME, self.new_manager))

    @staticmethod
    def new_manager() -> EnvManager:
        """A manager with environments of its own."""
        return EnvManager(NAME, SimplerCatalog(), _OPTIONS, keep=True)

    def make_tools(self) -> list[Tool]:
        """The template's verbs, SIMPLER's earlier names, and two additions."""
        kinds = (
            Reset,
            SimplerStepContinuous,
            ObserveEgocentric,
            SimplerEvaluate,
            Step,
            GetObservation,
            EpisodeInformation,
            SimplerStepEePose,
            SimplerObserveObjects,
        )
        return [kind(self.manager) for kind in kinds]

    def budgets(self, head: str) -> dict[str | int, int]:
        """Each task's own, unless ``initialize`` was given one."""
        given = self.manager.options.get("max_steps")
        tasks: Any = vecenv.list_tasks(f"simpler/{head}")
        return {task.name: given or task.max_steps for task in tasks}
