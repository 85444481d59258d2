"""The verbs of an environment as tools: reset, step, observe, evaluate, over one slot of a batch.

Shared by LIBERO and SIMPLER; ``libero.py`` and ``simpler.py`` add the ports that are their own. A step returns control
signals and no observation, an observation advances nothing, and each call is one job on the manager's thread.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, cast

import numpy as np
from pydantic import Field

from vecenv.contract import BatchEnv, Control, EePoseControl
from vecenv.errors import VecenvError
from vecenv.interop.nodes.manager import EnvManager, EpisodeInfo
from vecenv.interop.nodes.ports import Port, WireType, port
from vecenv.interop.nodes.snapshots import snapshot_to_dict
from vecenv.interop.nodes.texts import EePoseText, read_chunk, read_ee_pose
from vecenv.interop.nodes.tool import ERROR, Tool, ToolConfig, described
from vecenv.slots import SlotBatch

ANY, TEXT, BOOL = WireType.ANY, WireType.TEXT, WireType.BOOL
IMAGE, IMAGES, POSE = WireType.IMAGE, WireType.IMAGES, WireType.POSE

TRIGGER = port("trigger", ANY, "read for its arrival only", optional=True)
CHUNK = port("action", TEXT, "JSON: a 7-vector, or a list of K of them")
WAYPOINT = port("action", TEXT, 'JSON: an 8-vector, or {"pose": 8-vector, "hold_steps": N}; [] moves nothing')
# What every step returns, in the order of the template.
CONTROL = (
    port("reward", ANY, "of all ticks of this call"),
    port("terminated", BOOL, "the task is solved"),
    port("truncated", BOOL, "the step budget is spent, or the physics failed"),
    port("info", ANY, "diagnostics of this call, and the other signals again"),
    port("success", BOOL, "the goal held after the latest tick"),
    port("step_index", ANY, "control ticks of the episode so far"),
)
MOTION = (
    port("converged", BOOL, "position and rotation within tolerance"),
    port("final_pose", POSE, "of the hand when the call ended, xyz in metres and wxyz, world frame"),
    port("step_count", ANY, "control ticks of this call"),
)


class EnvTool(Tool):
    """A tool that works on an environment."""

    def __init__(self, manager: EnvManager) -> None:
        super().__init__(manager.name)
        self.manager = manager


class EvaluateConfig(ToolConfig):
    """``post_loop`` is for whoever runs the graph: the tool fires after the loop. It changes nothing here."""

    post_loop: bool = False


def metadata(episode: EpisodeInfo, head: str) -> dict[str, Any]:
    """What a reset says about an episode; ``head`` names the first field of the panel, suite or split."""
    chosen = episode.selection
    return {
        "instruction": episode.instruction,
        "episode_id": f"{chosen.head}/{chosen.task}/{chosen.episode}",
        head: chosen.head,
        "task_id": chosen.task,
        "max_steps": episode.max_steps,
    }


class Evaluate(EnvTool):
    """Read the verdict of the episode; run it once, after the loop. Families name it, its ports and ``head``."""

    verb, family = "evaluate", "evaluate"
    inputs: ClassVar[tuple[Port, ...]] = (TRIGGER,)
    config: ClassVar[type[ToolConfig]] = EvaluateConfig
    # The first field of the panel: suite or split.
    head: ClassVar[str]

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """The verdict."""

        def job(env: BatchEnv, episode: EpisodeInfo) -> dict[str, Any]:
            found = env.evaluate()
            success = bool(found.success[0])
            metrics = {
                "success": float(success),
                "num_steps": int(found.num_steps[0]),
                self.head: episode.selection.head,
                "task_id": episode.selection.task,
                "cumulative_reward": float(found.cumulative_reward[0]),
            }
            return {"success": success, "metrics": metrics}

        return self.manager.run(job)


class ContinuousConfig(ToolConfig):
    """``max_chunk_steps``: rows of a chunk that are executed, the first ones; 0 for all."""

    max_chunk_steps: int = Field(default=0, ge=0)


class EePoseConfig(ToolConfig):
    """Limits of one call: ``max_steps`` control ticks; reached within ``pos_tol_m`` metres, ``rot_tol_rad`` radians."""

    max_steps: int = Field(default=100, ge=1, le=100_000)
    pos_tol_m: float = Field(default=0.01, gt=0, le=10)
    rot_tol_rad: float = Field(default=0.10, gt=0, le=10)


class ObjectsConfig(ToolConfig):
    """``points``: samples of true surfaces, or of the boxes around objects."""

    points: Literal["surface", "aabb"] = "surface"


class StepTool(EnvTool):
    """A tool that returns control signals; after an error they are those of the latest step, and the reward is 0."""

    def _after_error(self, text: str) -> dict[str, Any]:
        signals = vars(self.manager.flags)
        return {"reward": 0.0, **signals, "info": {"reward": 0.0, **signals, "error": text}}


class StepContinuous(StepTool):
    """Advance by one action or a chunk of K, which ends early where the episode does; [] does nothing."""

    verb, display_name, family = "step_continuous", "Step (continuous)", "step"
    inputs: ClassVar[tuple[Port, ...]] = (CHUNK,)
    outputs: ClassVar[tuple[Port, ...]] = (*CONTROL, ERROR)
    config: ClassVar[type[ToolConfig]] = ContinuousConfig

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One chunk."""
        actions = read_chunk(given["action"], config.max_chunk_steps)
        return self.manager.run(lambda env, episode: control_outputs(step_chunk(self.manager, env, actions)))


def step_chunk(manager: EnvManager, env: BatchEnv, actions: np.ndarray) -> Control:
    """Execute a chunk [K, 7] on the manager's thread; without rows nothing moves."""
    if not len(actions):
        return manager.stepped(env.step_ee_pose(()))
    left = np.nan_to_num(actions[-1, 6], nan=0.0)
    return manager.stepped(env.step_continuous(actions[None]), bool(left > 0))


class StepEePose(StepTool):
    """Drive the hand to an absolute pose, or hold it still while the fingers move; [] does nothing."""

    verb, display_name, family = "step_ee_pose", "Step (end-effector pose)", "step"
    inputs: ClassVar[tuple[Port, ...]] = (WAYPOINT,)
    outputs: ClassVar[tuple[Port, ...]] = (*CONTROL, *MOTION, ERROR)
    config: ClassVar[type[ToolConfig]] = EePoseConfig

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One waypoint."""
        wanted = read_ee_pose(given["action"])
        return self.manager.run(lambda env, episode: motion_outputs(step_pose(self.manager, env, wanted, config)))


def step_pose(manager: EnvManager, env: BatchEnv, wanted: EePoseText, config: EePoseConfig) -> EePoseControl:
    """Follow one waypoint on the manager's thread, within the limits of a config."""
    if wanted.pose is None:
        control = env.step_ee_pose(())
        manager.stepped(control)
        return control
    limits = {"max_steps": config.max_steps, "pos_tol": config.pos_tol_m, "rot_tol": config.rot_tol_rad}
    with cast(SlotBatch, env).waypoint_limits(**limits):
        control = env.step_ee_pose(wanted.pose[None], wanted.hold_steps, carry=wanted.carry)
    manager.stepped(control, bool(wanted.pose[7] > 0.5))
    return control


class ObserveObjects(EnvTool):
    """Read the ground truth of the scene as one mapping; nothing advances."""

    verb, display_name, family = "observe_objects", "Observe (objects)", "observe"
    inputs: ClassVar[tuple[Port, ...]] = (TRIGGER,)
    outputs: ClassVar[tuple[Port, ...]] = (
        port("snapshot", ANY, "names, points, poses, regions, parts, the scene, the hand, the workspace"),
        ERROR,
    )
    config: ClassVar[type[ToolConfig]] = ObjectsConfig

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One snapshot."""

        def job(env: BatchEnv, episode: EpisodeInfo) -> dict[str, Any]:
            seen = env.observe_objects(config.points)
            snapshot = seen.snapshot[0]
            return {"snapshot": snapshot and snapshot_to_dict(snapshot), "error": seen.error[0]}

        return self.manager.run(job)


# -- outputs -----------------------------------------------------------------------------------------------------------


def control_outputs(control: Control) -> dict[str, Any]:
    """The control ports of a batch of one; ``info`` has the signals again and what the environment adds."""
    signals = {
        "reward": float(control.reward[0]),
        "terminated": bool(control.terminated[0]),
        "truncated": bool(control.truncated[0]),
        "success": bool(control.success[0]),
        "step_index": int(control.step_index[0]),
    }
    return {**signals, "info": {**signals, **{name: _plain(each[0]) for name, each in control.info.items()}}}


def motion_outputs(control: EePoseControl) -> dict[str, Any]:
    """The ports of ``step_ee_pose``."""
    motion = {
        "converged": bool(control.converged[0]),
        "final_pose": np.array(control.final_pose[0], float),
        "step_count": int(control.step_count[0]),
        "error": control.error[0],
    }
    outputs = control_outputs(control)
    told = {**motion, "final_pose": motion["final_pose"].tolist()}
    return {**outputs, "info": {**outputs["info"], **told}, **motion}


def camera_image(images: Mapping[str, np.ndarray], name: str) -> tuple[np.ndarray | None, str]:
    """The image of a camera of the only slot, or None and why there is none."""
    try:
        return np.asarray(images[name][0]), ""
    except VecenvError as error:
        return None, described(error)


def _plain(value: Any) -> Any:
    """A value of ``info`` for JSON."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list | tuple) else value
