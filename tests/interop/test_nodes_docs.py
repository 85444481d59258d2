"""docs/nodes.md: its examples print what it says, and its table lists the ports and options that there are."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Mapping
from typing import Any

import pytest
from support.paths import REPOSITORY

from vecenv.interop.nodes import NodeSet, Tool, node_sets
from vecenv.interop.nodes import manager as manager_module
from voxposer import node_episodes
from voxposer import nodes as voxposer_nodes

PAGE = REPOSITORY / "docs" / "nodes.md"
TEXT = PAGE.read_text()
FENCES = re.findall(r"^```(\w+)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
SETS: Mapping[str, NodeSet] = {**node_sets(), **voxposer_nodes.node_sets()}


def test_the_examples_print_what_the_page_says(monkeypatch: pytest.MonkeyPatch) -> None:
    # With environments of their own, so that nothing is left over for other tests.
    monkeypatch.setattr(manager_module.EnvManager, "_shared", {})
    monkeypatch.setattr(node_episodes.RuntimeManager, "_shared", None)
    namespace: dict[str, Any] = {}
    for (kind, body), (next_kind, expected) in zip(FENCES[::2], FENCES[1::2], strict=True):
        assert (kind, next_kind) == ("python", "text")
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(body, str(PAGE), "exec"), namespace)
        assert printed.getvalue() == expected


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


ROWS = {cells(line)[0].strip("`"): cells(line)[1:] for line in TEXT.splitlines() if re.match(r"\| `\w+__\w+` \|", line)}


@pytest.mark.parametrize(
    "tool", [tool for nodes in SETS.values() for tool in nodes.get_tools()], ids=lambda tool: tool.node_type
)
def test_the_table_lists_every_tool(tool: Tool) -> None:
    inputs, outputs, options = (re.sub(r"[`]", "", cell) for cell in ROWS[tool.node_type])
    assert inputs == ", ".join(port.name + "?" * port.optional for port in tool.inputs)
    assert outputs == ", ".join(port.name for port in tool.outputs if port.name != "error")
    assert options == ", ".join(f"{name}={value!r}" for name, value in tool.config().model_dump().items())


def test_the_table_lists_no_tool_that_there_is_not() -> None:
    assert set(ROWS) == {name for nodes in SETS.values() for name in nodes.tools}
