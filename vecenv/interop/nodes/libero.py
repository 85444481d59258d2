"""LIBERO as a node set: eight tools over one slot of a batch, and a panel of suite, task and episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, ClassVar, cast

import numpy as np
from pydantic import Field

import vecenv
from vecenv.contract import BatchEnv
from vecenv.interop.nodes.catalog import LIBERO_SUITES, LiberoCatalog
from vecenv.interop.nodes.manager import EnvManager, EpisodeInfo
from vecenv.interop.nodes.nodeset import EnvNodeSet
from vecenv.interop.nodes.ports import Port, WireType, port
from vecenv.interop.nodes.texts import EePoseText
from vecenv.interop.nodes.tool import ERROR, Tool, ToolConfig
from vecenv.interop.nodes.verbs import (
    ANY,
    BOOL,
    CONTROL,
    IMAGE,
    IMAGES,
    MOTION,
    POSE,
    TEXT,
    TRIGGER,
    EePoseConfig,
    EnvTool,
    Evaluate,
    ObserveObjects,
    StepContinuous,
    StepEePose,
    StepTool,
    camera_image,
    metadata,
    motion_outputs,
    step_pose,
)
from vecenv.protocols import DEFAULT
from vecenv.slots import SlotBatch

NAME = "env_libero"
# The first field of the panel.
_HEAD = "suite"
# Ticks that fingers get to close.
_CLOSE_TICKS = 60


class Reset(EnvTool):
    """Make the selected episode live: a live one is left alone, a finished one begins again; no observation."""

    verb, display_name, family = "reset", "LIBERO: Reset", "reset"
    inputs: ClassVar[tuple[Port, ...]] = (TRIGGER,)
    outputs: ClassVar[tuple[Port, ...]] = (
        port("instruction", TEXT, "what a policy is told"),
        port("episode_id", TEXT, "suite/task/episode"),
        port("suite", TEXT),
        port("task_id", ANY, "index of the task in its suite"),
        port("max_steps", ANY, "step budget, control ticks"),
        ERROR,
    )

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """Metadata of the episode."""
        return metadata(self.manager.ensure_live(), _HEAD)


class EgocentricConfig(ToolConfig):
    """``resolution``: side of images, pixels. ``depth``: fill ``depth`` and ``intrinsics``, which are None without."""

    resolution: int = Field(default=256, ge=16, le=2048)
    depth: bool = False


class ObserveEgocentric(EnvTool):
    """See what the cameras see, turned by 180 degrees as training data are, and proprioception; nothing advances."""

    verb, display_name, family = "observe_egocentric", "LIBERO: Observe (egocentric)", "observe"
    inputs: ClassVar[tuple[Port, ...]] = (TRIGGER,)
    outputs: ClassVar[tuple[Port, ...]] = (
        port("rgb", IMAGE, "the third-person camera"),
        port("agentview_image", IMAGE, "the same"),
        port("wrist_image", IMAGE, "the camera in the hand"),
        port("state", ANY, "float32 [8]: position, axis-angle, two finger positions"),
        port("observation", IMAGES, "third-person, wrist"),
        port("pose", POSE, "always None: nothing navigates"),
        port("intrinsics", ANY, "camera matrix [3, 3] of rgb with depth=true, else None"),
        port("depth", WireType.DEPTH, "metres, of rgb, with depth=true, else None"),
        ERROR,
    )
    config: ClassVar[type[ToolConfig]] = EgocentricConfig

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One look."""

        def job(env: BatchEnv, episode: EpisodeInfo) -> dict[str, Any]:
            size = (config.resolution, config.resolution)
            seen = env.observe_egocentric(image_size=size)  # pyright: ignore[reportCallIssue]
            rgb, problem = camera_image(seen.images, "agentview")
            wrist, other = camera_image(seen.images, "wrist")
            depth, missing = camera_image(seen.depths, "agentview") if config.depth else (None, "")
            return {
                "rgb": rgb,
                "agentview_image": rgb,
                "wrist_image": wrist,
                "state": np.array(seen.state[0], np.float32),
                "observation": [image for image in (rgb, wrist) if image is not None],
                "intrinsics": None if seen.intrinsics is None or not config.depth else seen.intrinsics[0].copy(),
                "depth": depth,
                "error": problem or other or missing,
            }

        return self.manager.run(job)


class LiberoEvaluate(Evaluate):
    """Read the verdict of the episode; run it once, after the loop."""

    display_name, head = "LIBERO: Evaluate", _HEAD
    outputs: ClassVar[tuple[Port, ...]] = (
        port("success", BOOL, "the goal held after the latest tick"),
        port("metrics", WireType.METRICS, "success (0 or 1), num_steps, suite, task_id, cumulative_reward"),
        ERROR,
    )


class ResetToHome(StepTool):
    """Drive the hand to where it was when the episode began, fingers as they are; for trying things out."""

    verb, display_name, family = "reset_to_home", "LIBERO: Reset to home", "extra"
    inputs: ClassVar[tuple[Port, ...]] = (TRIGGER,)
    outputs: ClassVar[tuple[Port, ...]] = (*CONTROL, *MOTION, ERROR)
    config: ClassVar[type[ToolConfig]] = EePoseConfig

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One motion, which takes control ticks of the episode."""

        def job(env: BatchEnv, episode: EpisodeInfo) -> dict[str, Any]:
            pose = np.append(episode.home, float(self.manager.closed_grip))
            return motion_outputs(step_pose(self.manager, env, EePoseText(pose), config))

        return self.manager.run(job)


class CloseGripperConfig(ToolConfig):
    """``hold_steps``: control ticks that the fingers get."""

    hold_steps: int = Field(default=_CLOSE_TICKS, ge=1, le=10_000)


class CloseGripper(StepTool):
    """Close the fingers and hold the hand still meanwhile; for trying things out."""

    verb, display_name, family = "close_gripper", "LIBERO: Close gripper", "extra"
    inputs: ClassVar[tuple[Port, ...]] = (TRIGGER,)
    outputs: ClassVar[tuple[Port, ...]] = (*CONTROL, *MOTION, ERROR)
    config: ClassVar[type[ToolConfig]] = CloseGripperConfig

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One hold, which takes control ticks of the episode."""

        def job(env: BatchEnv, episode: EpisodeInfo) -> dict[str, Any]:
            pose = np.append(cast(SlotBatch, env).ee_poses[0], 1.0)
            return motion_outputs(step_pose(self.manager, env, EePoseText(pose, config.hold_steps), EePoseConfig()))

        return self.manager.run(job)


@lru_cache
def _budget(suite: str, protocol: str) -> int:
    return vecenv.eval_metadata(suite, protocol)["max_steps"]


class EnvLiberoNodeSet(EnvNodeSet):
    """LIBERO's tools over one slot.

    Args:
        suites: suites that the panel offers; LIBERO's own five unless given. With a choice of its own, or a manager, a
            node set has an environment of its own; otherwise all share the process's one.
        manager: owner of the environment.
    """

    name, display_name = NAME, "LIBERO"
    python_variable = "LIBERO_PYTHON"

    def __init__(self, suites: Sequence[str] | None = None, *, manager: EnvManager | None = None) -> None:
        if manager is None and suites is not None:
            manager = EnvManager(NAME, LiberoCatalog(suites))
        super().__init__(manager or EnvManager.shared(NAME, lambda: EnvManager(NAME, LiberoCatalog(LIBERO_SUITES))))

    def make_tools(self) -> list[Tool]:
        """Four verbs and two helpers."""
        kinds = (
            Reset,
            StepContinuous,
            StepEePose,
            ObserveEgocentric,
            ObserveObjects,
            LiberoEvaluate,
            ResetToHome,
            CloseGripper,
        )
        return [kind(self.manager) for kind in kinds]

    def budgets(self, head: str) -> dict[str | int, int]:
        """The same for all tasks: what ``initialize`` was given, or the protocol's."""
        options = self.manager.options
        most = options.get("max_steps") or _budget(head, options.get("protocol", DEFAULT))
        return {choice.value: most for choice in self.manager.catalog.tasks(head)}
