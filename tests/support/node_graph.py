"""VoxPoser's two-scope graph over LIBERO, every edge of it a port of a tool."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from vecenv.interop.nodes import NodeSet
from voxposer.episode import MAX_SUBTASKS, MAX_WAYPOINTS


class Verdict(NamedTuple):
    success: bool
    ticks: int
    reason: str
    longest: int


class Graph:
    """Runs tools by name; an error of any of them fails, unless it is listed in ``errors``.

    Args:
        sets: the node sets.
        wired: whether the dispenser hears if its waypoints were reached, as the batched agent does.
        through_json: everything on a wire goes through JSON text, as between processes.
    """

    def __init__(self, *sets: NodeSet, wired: bool = True, through_json: bool = False) -> None:
        self._tools = {name: tool for each in sets for name, tool in each.tools.items()}
        self._wired, self._through_json = wired, through_json
        self.errors: list[str] = []
        self.snapshots: list[Mapping[str, Any]] = []

    def call(self, name: str, config: Mapping[str, Any] | None = None, **inputs: Any) -> dict[str, Any]:
        if self._through_json:
            inputs = json.loads(json.dumps(inputs, default=np.ndarray.tolist))
        outputs = self._tools[name].run(inputs, config)
        if outputs["error"]:
            self.errors.append(f"{name}: {outputs['error']}")
        return outputs

    def run(self) -> Verdict:
        """Reset, observe, init and plan; then subtasks outside, waypoints inside; evaluate once after the loop."""
        episode = self.call("env_libero__reset")
        first = self.call("env_libero__observe_objects")["snapshot"]
        handle = self.call("voxposer__init", snapshot=first)["runtime_handle"]
        planned = self.call("voxposer__planner_lmp", runtime_handle=handle, instruction=episode["instruction"])
        index, last, reason, longest = 0, None, "", 0
        for _ in range(MAX_SUBTASKS):
            subtask = self.call(
                "voxposer__plan_subtask",
                runtime_handle=handle,
                subtask_list=planned["subtask_list"],
                subtask_index=index,
                snapshot=self.call("env_libero__observe_objects")["snapshot"],
                last_gripper=last,
            )
            index = subtask["next_subtask_index"]
            expanded = self.call(
                "voxposer__expand_for_settle",
                {"max_waypoints": MAX_WAYPOINTS},
                trajectory=subtask["trajectory"],
                prev_gripper=subtask["prev_gripper"],
            )
            last, longest = expanded["last_gripper"], max(longest, expanded["n_out"])
            signals = self.follow(expanded["expanded"])
            ended = self.call(
                "voxposer__check_done",
                subtask_index=index,
                subtask_count=planned["subtask_count"],
                episode_success=signals["terminated"],
                step_index=signals["step_index"],
                max_steps=episode["max_steps"],
            )
            reason = ended["reason"]
            if ended["done"]:
                break
        verdict = self.call("env_libero__evaluate", {"post_loop": True})
        return Verdict(verdict["success"], verdict["metrics"]["num_steps"], reason, longest)

    def follow(self, expanded: Any) -> dict[str, Any]:
        """The inner loop: signals of its last step."""
        signals: dict[str, Any] = {"converged": None}
        for _ in range(MAX_WAYPOINTS):
            converged = {"converged": signals["converged"]} if self._wired and signals["converged"] is not None else {}
            given = self.call("voxposer__dispense_waypoint", trajectory=expanded, **converged)
            action = self.call("voxposer__plan_executor", waypoint=given["waypoint"])["action"]
            signals = self.call("env_libero__step_ee_pose", action=action)
            ended = self.call(
                "voxposer__check_waypoint_done", cursor_done=given["done"], episode_success=signals["terminated"]
            )
            if ended["done"]:
                break
        return signals
