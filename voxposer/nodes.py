"""VoxPoser as eight tools: the layer of ``voxposer.runtime`` and ``voxposer.episode`` behind ports (docs/nodes.md).

An episode's language programs and what they know stay in this process, behind the text ``runtime_handle`` that
``voxposer__init`` returns. Everything else on the wires is plain: a snapshot as ``observe_objects`` returns it,
subtasks as texts, waypoints as lists of mappings, actions as JSON. Planning reads the snapshot that it is given and
nothing else; no tool here touches an environment. The dispenser's cursor and the carried grip belong to a node of a
graph.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from vecenv.interop.nodes import NodeError, NodeSet, Tool, ToolConfig, WireType, snapshot_from_dict
from vecenv.interop.nodes.ports import Port, port, whole_number
from vecenv.interop.nodes.tool import ERROR, Memories
from voxposer.episode import (
    MAX_SUBTASKS,
    MAX_WAYPOINTS,
    Dispensed,
    WaypointDispenser,
    check_done,
    check_waypoint_done,
    expand_for_settle,
    plan_executor,
)
from voxposer.node_episodes import NAME, RuntimeManager
from voxposer.node_wires import (
    expanded_of_rows,
    grip_of,
    identity_of,
    rows_of_expanded,
    rows_of_trajectory,
    trajectory_of_rows,
    waypoint_of,
)
from voxposer.planning.plan import HOLD_TICKS, PlanConfig

ANY, TEXT, BOOL = WireType.ANY, WireType.TEXT, WireType.BOOL
# Options that name files or addresses, or go to the provider as they are: whoever runs the process gives them.
_NOT_IN_GRAPHS = ("replay", "prompts_dir", "cache", "api_base", "options")
_HANDLE = port("runtime_handle", TEXT, "of the episode, from voxposer__init")
_SNAPSHOT = port("snapshot", ANY, "of the present scene, from observe_objects")


class VoxPoserTool(Tool):
    """A tool of VoxPoser."""

    family = "method"

    def __init__(self, manager: RuntimeManager) -> None:
        super().__init__(NAME)
        self.manager = manager

    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """On the manager's thread."""
        return self.manager.worker.call(lambda: self.work(given, config, node))

    def work(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """What the tool does; outputs by port."""
        raise NotImplementedError


# -- planning ----------------------------------------------------------------------------------------------------------


class InitConfig(ToolConfig):
    """Which model writes the programs, how it is asked, and sizes of planning.

    ``load_cache``: answers that were kept are used again, and new ones kept. ``options``: any other option of VoxPoser
    by its name (``vecenv voxposer``'s, such as ``{"planner.max_steps": 200}``); files, addresses and arguments of the
    provider are for ``initialize`` only.
    """

    model: str = "offline/libero"
    temperature: float = Field(default=0.0, ge=0)
    max_tokens: int = Field(default=512, ge=1)
    load_cache: bool = True
    map_size: int = Field(default=100, ge=1, le=200)
    num_waypoints_per_plan: int = Field(default=10_000, ge=1)
    max_plan_iter: int = Field(default=1, ge=1)
    options: dict[str, Any] = Field(default_factory=dict)

    def settings(self) -> dict[str, Any]:
        """What was given, as options of ``voxposer.settings``.

        Raises:
            NodeError: an option that graphs cannot give.
        """
        names = {"load_cache": "cache", "map_size": "perception.map_size"}
        for name in self.options:
            if name.split(".")[0] in _NOT_IN_GRAPHS or name in names.values():
                raise NodeError(f"config.options.{name[:80]} is not taken from a graph; give it to initialize()")
        fields = self.model_fields_set - {"options"}
        return {**{names.get(name, name): getattr(self, name) for name in fields}, **self.options}


class Init(VoxPoserTool):
    """Open an episode on its first snapshot: seven language programs and what they will know; once an episode."""

    verb, display_name = "init", "VoxPoser: Init"
    inputs: ClassVar[tuple[Port, ...]] = (
        _SNAPSHOT,
        port("episode_id", TEXT, "name of the episode, by which saved replies are found", optional=True),
    )
    outputs: ClassVar[tuple[Port, ...]] = (port("runtime_handle", TEXT, "of the episode"), ERROR)
    config: ClassVar[type[ToolConfig]] = InitConfig

    def work(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """A handle."""
        options = config.settings()
        return {"runtime_handle": self.manager.init(given["snapshot"], options, given["episode_id"] or "")}


class PlannerLmp(VoxPoserTool):
    """Split an instruction into subtasks with the planner program; none of them is executed."""

    verb, display_name = "planner_lmp", "VoxPoser: Planner"
    inputs: ClassVar[tuple[Port, ...]] = (_HANDLE, port("instruction", TEXT))
    outputs: ClassVar[tuple[Port, ...]] = (
        port("subtask_list", WireType.TEXTS, "in order"),
        port("subtask_count", ANY, "how many"),
        ERROR,
    )

    def work(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """Subtasks."""
        handle = given["runtime_handle"]
        subtasks = self.manager.runtimes(handle).planner([handle], [given["instruction"]])
        return {
            "subtask_list": list(subtasks.subtask_list[0]),
            "subtask_count": int(subtasks.subtask_count[0]),
            "error": subtasks.error[0],
        }


class PlanSubtask(VoxPoserTool):
    """Plan one subtask on a snapshot: its programs ask for motions, and value maps become waypoints."""

    verb, display_name = "plan_subtask", "VoxPoser: Plan Subtask"
    inputs: ClassVar[tuple[Port, ...]] = (
        _HANDLE,
        port("subtask_list", WireType.TEXTS, "from voxposer__planner_lmp"),
        port("subtask_index", ANY, "0 at first, then next_subtask_index"),
        _SNAPSHOT,
        port("last_gripper", ANY, "grip that the latest waypoint left, from expand_for_settle", optional=True),
    )
    outputs: ClassVar[tuple[Port, ...]] = (
        port("trajectory", ANY, "list of waypoints: pose (8-vector), velocity, final, motion"),
        port("n_waypoints", ANY, "how many"),
        port("subtask_text", TEXT, "the subtask in words"),
        port("next_subtask_index", ANY, "index to plan next; the same while the subtask is unfinished"),
        port("movable_name", TEXT, "what the last motion moves"),
        port("object_centric", BOOL, "whether that is an object, to be pushed"),
        port("prev_gripper", ANY, "whether the grip is closed before the first waypoint"),
        ERROR,
    )

    def work(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """A trajectory; none after an error, and then no subtask is left either."""
        handle = given["runtime_handle"]
        runtimes = self.manager.runtimes(handle)
        index = whole_number("input 'subtask_index'", given["subtask_index"])
        snapshot = snapshot_from_dict(given["snapshot"])
        if given["last_gripper"] is not None:
            runtimes.set_gripper([handle], grip_of(given["last_gripper"], "last_gripper"))
        planned = runtimes.plan_subtask([handle], [given["subtask_list"]], index, [snapshot])
        return {
            "trajectory": rows_of_trajectory(planned.trajectory, f"{handle}/{planned.trajectory.identity[0]}"),
            "n_waypoints": int(planned.n_waypoints[0]),
            "subtask_text": planned.subtask_text[0],
            "next_subtask_index": int(planned.next_subtask_index[0]),
            "movable_name": planned.movable_name[0],
            "object_centric": bool(planned.object_centric[0]),
            "prev_gripper": bool(planned.prev_gripper[0]),
            "error": planned.error[0],
        }


# -- following ---------------------------------------------------------------------------------------------------------


class ExpandConfig(ToolConfig):
    """``settle_steps``: ticks of a hold; ``settle``: repeats of a motion's end; ``max_waypoints``: None keeps all."""

    settle_steps: int = Field(default=HOLD_TICKS, ge=1, le=10_000)
    settle: int = Field(default=PlanConfig().settle, ge=0, le=1000)
    max_waypoints: int | None = Field(default=None, ge=1)


class ExpandForSettle(VoxPoserTool):
    """Split every change of the grip: drive there with the grip as it was, then hold while the fingers move."""

    verb, display_name = "expand_for_settle", "VoxPoser: Expand for Settle"
    inputs: ClassVar[tuple[Port, ...]] = (
        port("trajectory", ANY, "from voxposer__plan_subtask, or a list of 8-vectors"),
        port("prev_gripper", ANY, "grip before the first waypoint; the one carried here otherwise", optional=True),
    )
    outputs: ClassVar[tuple[Port, ...]] = (
        port("expanded", ANY, "list of waypoints: pose (8-vector), hold_steps"),
        port("n_in", ANY, "waypoints of the trajectory"),
        port("n_out", ANY, "waypoints to follow"),
        port("n_holds_inserted", ANY, "changes of the grip"),
        port("last_gripper", ANY, "whether the grip is closed after the last waypoint"),
        ERROR,
    )
    config: ClassVar[type[ToolConfig]] = ExpandConfig

    def __init__(self, manager: RuntimeManager) -> None:
        super().__init__(manager)
        self._carried: Memories[bool] = Memories()

    def work(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """Waypoints to follow; the grip after them is carried to the next trajectory of this node."""
        rows = given["trajectory"]
        trajectory = trajectory_of_rows(rows)
        carried = given["prev_gripper"]
        closed = self._carried.get(node, False) if carried is None else grip_of(carried, "prev_gripper")
        plan = PlanConfig(hold_ticks=config.settle_steps, settle=config.settle)
        expanded = expand_for_settle(trajectory, closed, plan, max_waypoints=config.max_waypoints)
        last = bool(expanded.last_gripper[0])
        self._carried.put(node, last)
        return {
            "expanded": rows_of_expanded(expanded, identity_of(rows)),
            "n_in": int(expanded.n_in[0]),
            "n_out": int(expanded.n_out[0]),
            "n_holds_inserted": int(expanded.n_holds_inserted[0]),
            "last_gripper": last,
        }

    def forget(self, node: str | None = None) -> None:
        """Forget the carried grip: an episode begins with open fingers."""
        self._carried.forget(node)


@dataclass(frozen=True)
class _Cursor:
    """Where a node is in its trajectory."""

    dispenser: WaypointDispenser
    identity: str
    number: int


class DispenseConfig(ToolConfig):
    """``max_misses``: waypoints in a row that were not reached, after which it goes on at the next change of the grip.

    Counted where ``converged`` is wired. None: every waypoint is handed out.
    """

    max_misses: int | None = Field(default=2, ge=1)


class DispenseWaypoint(VoxPoserTool):
    """Hand out the next waypoint of a trajectory; another trajectory begins at its first."""

    verb, display_name = "dispense_waypoint", "VoxPoser: Dispense Waypoint"
    inputs: ClassVar[tuple[Port, ...]] = (
        port("trajectory", ANY, "what expand_for_settle returned as expanded"),
        port("converged", BOOL, "whether the waypoint before was reached, from step_ee_pose", optional=True),
    )
    outputs: ClassVar[tuple[Port, ...]] = (
        port("waypoint", ANY, "pose (8-vector), hold_steps and carry; None if none is left"),
        port("cursor", ANY, "index of the next waypoint"),
        port("done", BOOL, "none is left after this one"),
        port("progress", ANY, "share that was handed out, 0 to 1"),
        ERROR,
    )
    config: ClassVar[type[ToolConfig]] = DispenseConfig

    def __init__(self, manager: RuntimeManager) -> None:
        super().__init__(manager)
        self._cursors: Memories[_Cursor | None] = Memories()

    def work(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """One waypoint."""
        rows, converged = given["trajectory"], given["converged"]
        identity = f"{identity_of(rows)}/{config.max_misses}"
        cursor = self._cursors.get(node, None)
        if cursor is None or cursor.identity != identity:
            cursor = _Cursor(WaypointDispenser(config.max_misses), identity, 0 if cursor is None else cursor.number + 1)
        self._cursors.put(node, cursor)
        reached = None if converged is None else np.array([converged])
        found = cursor.dispenser.dispense(expanded_of_rows(rows, cursor.number), reached)
        waypoint = {
            "pose": found.waypoint[0].tolist(),
            "hold_steps": int(found.hold_steps[0]),
            "carry": bool(found.carry[0]),
        }
        return {
            "waypoint": waypoint if found.has_waypoint[0] else None,
            "cursor": int(found.cursor[0]),
            "done": bool(found.done[0]),
            "progress": float(found.progress[0]),
        }

    def forget(self, node: str | None = None) -> None:
        """Forget the cursor."""
        self._cursors.forget(node)


class ExecutorConfig(ToolConfig):
    """``carry``: whether actions may say that the servo carries on from the waypoint before, as ours understands."""

    carry: bool = True


class PlanExecutor(VoxPoserTool):
    """Write a waypoint as an action of step_ee_pose: an 8-vector, or an object with pose and hold_steps."""

    verb, display_name = "plan_executor", "VoxPoser: Plan Executor"
    inputs: ClassVar[tuple[Port, ...]] = (
        port("waypoint", ANY, "from voxposer__dispense_waypoint; none gives []", optional=True),
    )
    outputs: ClassVar[tuple[Port, ...]] = (
        port("action", TEXT, "JSON for step_ee_pose"),
        port("has_action", BOOL, "whether there was a waypoint"),
        ERROR,
    )
    config: ClassVar[type[ToolConfig]] = ExecutorConfig

    def work(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """An action as text."""
        waypoint = waypoint_of(given["waypoint"], "waypoint")
        if waypoint is None:
            return {"action": "[]", "has_action": False}
        pose, hold, carry = waypoint
        carries, yes = np.array([carry and config.carry]), np.array([True])
        dispensed = Dispensed(pose[None], np.array([hold]), carries, yes, np.zeros(1, int), yes, np.ones(1))
        action, has_action = plan_executor(dispensed)
        values = action["pose"][0].tolist()
        more = {"hold_steps": int(action["hold_steps"][0])} if action["hold_steps"][0] else {}
        more |= {"carry": True} if action["carry"][0] else {}
        return {
            "action": json.dumps({"pose": values, **more} if more else values),
            "has_action": bool(has_action[0]),
        }

    def _after_error(self, text: str) -> dict[str, Any]:
        return {"action": "[]"}


# -- when to stop ------------------------------------------------------------------------------------------------------


class CheckWaypointDone(VoxPoserTool):
    """Say whether the inner loop ends: success, or no waypoint left."""

    verb, display_name = "check_waypoint_done", "VoxPoser: Check Waypoint Done"
    inputs: ClassVar[tuple[Port, ...]] = (
        port("cursor_done", BOOL, "from voxposer__dispense_waypoint"),
        port("episode_success", BOOL, "from step_ee_pose"),
        port("truncated", BOOL, "the environment has ended the episode", optional=True),
    )
    outputs: ClassVar[tuple[Port, ...]] = (port("done", BOOL), port("reason", TEXT, "empty while it goes on"), ERROR)

    def work(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """Done or not."""
        ended = check_waypoint_done(given["cursor_done"], given["episode_success"], truncated=bool(given["truncated"]))
        return {"done": bool(ended.done[0]), "reason": ended.reason[0]}

    def _after_error(self, text: str) -> dict[str, Any]:
        return {"done": True, "reason": text}


class CheckDone(VoxPoserTool):
    """Say whether the outer loop ends: success, the environment's step budget spent, or all subtasks complete."""

    verb, display_name = "check_done", "VoxPoser: Check Done"
    inputs: ClassVar[tuple[Port, ...]] = (
        port("subtask_index", ANY, "of the next subtask"),
        port("subtask_count", ANY, "from voxposer__planner_lmp"),
        port("episode_success", BOOL, "from step_ee_pose"),
        port("step_index", ANY, "control ticks of the episode so far"),
        port("max_steps", ANY, "step budget of the environment"),
    )
    outputs: ClassVar[tuple[Port, ...]] = (port("done", BOOL), port("reason", TEXT, "empty while it goes on"), ERROR)

    def work(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """Done or not."""
        names = ("subtask_index", "subtask_count", "step_index", "max_steps")
        index, count, step, budget = (whole_number(f"input {name!r}", given[name]) for name in names)
        ended = check_done(index, count, given["episode_success"], step, budget)
        return {"done": bool(ended.done[0]), "reason": ended.reason[0]}

    def _after_error(self, text: str) -> dict[str, Any]:
        return {"done": True, "reason": text}


class VoxPoserNodeSet(NodeSet):
    """VoxPoser's tools; all share the process's open episodes unless a manager is given.

    Args:
        manager: where episodes are open.
    """

    name, display_name = NAME, "VoxPoser"

    def __init__(self, *, manager: RuntimeManager | None = None) -> None:
        self.manager = manager or RuntimeManager.shared()
        kinds = (
            Init,
            PlannerLmp,
            PlanSubtask,
            ExpandForSettle,
            DispenseWaypoint,
            PlanExecutor,
            CheckWaypointDone,
            CheckDone,
        )
        self._tools: list[Tool] = [kind(self.manager) for kind in kinds]

    def get_tools(self) -> list[Tool]:
        """The eight tools."""
        return list(self._tools)

    def initialize(self, **options: Any) -> None:
        """Take options for the episodes to come: any of ``vecenv voxposer``'s.

        Raises:
            InvalidInput: there is no such option, or a value cannot be used.
        """
        self.manager.initialize(**options)

    def shutdown(self) -> None:
        """Release all open episodes."""
        self.manager.shutdown()
        for tool in self._tools:
            tool.forget()

    def get_eval_metadata(self) -> dict[str, Any]:
        """Budgets of the two loops of the published graph."""
        return {
            "step_budgets": {"subtasks": MAX_SUBTASKS, "waypoints": MAX_WAYPOINTS},
            "observes": "observe_objects",
            "steps": "step_ee_pose",
        }


def node_sets() -> dict[str, NodeSet]:
    """VoxPoser's node set by its name; its tools share open episodes with whoever calls this in the process."""
    return {NAME: VoxPoserNodeSet()}
