"""Tools of a node set called by their verbs, and what tests call them with."""

from __future__ import annotations

import json
from typing import Any

from vecenv.interop.nodes import NodeSet

# The suite of the first episode, and its step budget.
SUITE, BUDGET = "libero_object", 400
# Images that are drawn fast.
SMALL = {"resolution": 32}
# The action that moves nothing and keeps the gripper open.
STAY = [0.0] * 6 + [-1.0]


class Caller:
    """Runs tools of a node set by their verbs."""

    def __init__(self, nodes: NodeSet) -> None:
        self.nodes = nodes

    def __call__(self, verb: str, action: object = None, **config: Any) -> dict[str, Any]:
        inputs = {} if action is None else {"action": action if isinstance(action, str) else json.dumps(action)}
        tool = self.nodes.tools[f"{self.nodes.name}__{verb}"]
        outputs = tool.run(inputs, config)
        assert set(outputs) == {port.name for port in tool.outputs}
        return outputs
