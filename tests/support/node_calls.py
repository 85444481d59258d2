"""Tools of a node set called by their verbs."""

from __future__ import annotations

import json
from typing import Any

from vecenv.interop.nodes import NodeSet


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
