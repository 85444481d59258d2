"""A node set: the tools of an environment or a method, its panel, and how they are started and ended."""

from __future__ import annotations

import os
import sys
from abc import ABC, abstractmethod
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Literal

from vecenv.interop.nodes.manager import EnvManager
from vecenv.interop.nodes.panel import EnvPanel
from vecenv.interop.nodes.tool import Tool


class NodeSet(ABC):
    """Tools that belong together.

    Attributes:
        name: what stands before ``__`` in the names of its tools.
        display_name: its name for people.
        parallelism: ``"replicated"``, a simulator keeps a state and each worker of an evaluation needs one of its own;
            or ``"shared"``.
        default_per_step_budget_sec: seconds that one call may take before whoever runs a graph should worry.
        python_variable: environment variable with the interpreter for a process of its own; None if it needs none.
    """

    name: ClassVar[str]
    display_name: ClassVar[str]
    parallelism: ClassVar[Literal["replicated", "shared"]] = "shared"
    default_per_step_budget_sec: ClassVar[float] = 30.0
    python_variable: ClassVar[str | None] = None

    @property
    def server_python(self) -> str | None:
        """The interpreter for a process of its own: that of ``python_variable``, or this one; None if it needs none."""
        return None if self.python_variable is None else os.environ.get(self.python_variable) or sys.executable

    @property
    def panel(self) -> EnvPanel | None:
        """The panel; None for a method, which has no episodes of its own."""
        return None

    @abstractmethod
    def get_tools(self) -> list[Tool]:
        """The tools, always the same ones."""

    @property
    def tools(self) -> MappingProxyType[str, Tool]:
        """The tools by their ``node_type``."""
        return MappingProxyType({tool.node_type: tool for tool in self.get_tools()})

    @abstractmethod
    def initialize(self, **options: Any) -> None:
        """Get ready; an option that does not exist is an error. Without it, the first call of a tool does it."""

    @abstractmethod
    def shutdown(self) -> None:
        """Release everything; tools answer with an error until :meth:`initialize`."""

    @abstractmethod
    def get_eval_metadata(self) -> dict[str, Any]:
        """What an evaluation can run with it, as data for JSON."""

    def on_signal(self, name: str, snapshot: dict[str, str | int] | None = None) -> None:
        """Hear of a signal of a panel: with ``episode_reset``, tools forget what belongs to an episode."""
        del snapshot
        if name == "episode_reset":
            for tool in self.get_tools():
                tool.forget()

    def describe(self) -> dict[str, Any]:
        """The node set as data for JSON: its name, tools, and what it says about itself."""
        return {
            "name": self.name,
            "display_name": self.display_name,
            "parallelism": self.parallelism,
            "default_per_step_budget_sec": self.default_per_step_budget_sec,
            "tools": [tool.describe() for tool in self.get_tools()],
            "eval": self.get_eval_metadata(),
        }


class EnvNodeSet(NodeSet):
    """The node set of an environment.

    Args:
        manager: owner of the environment.
    """

    parallelism = "replicated"

    def __init__(self, manager: EnvManager) -> None:
        self.manager = manager

    @abstractmethod
    def make_tools(self) -> list[Tool]:
        """The tools, made once."""

    @abstractmethod
    def budgets(self, head: str) -> dict[str | int, int]:
        """Step budget of each task of a suite or split, control ticks."""

    @cached_property
    def _tools(self) -> list[Tool]:
        return self.make_tools()

    @cached_property
    def _panel(self) -> EnvPanel:
        return EnvPanel(self.manager, lambda selection: self.budgets(selection.head).get(selection.task))

    @property
    def panel(self) -> EnvPanel:
        """Which episode runs."""
        return self._panel

    def get_tools(self) -> list[Tool]:
        """The tools."""
        return list(self._tools)

    def initialize(self, **options: Any) -> None:
        """Take options of ``vecenv.make`` for the environments to come.

        Raises:
            OptionError: an option that suites of this kind do not have, or a value of a wrong type.
        """
        self.manager.initialize(**options)

    def shutdown(self) -> None:
        """Close the environment and end its thread."""
        self.manager.shutdown()

    def get_eval_metadata(self) -> dict[str, Any]:
        """What an evaluation can place, and what it measures.

        Returns:
            ``splits``; ``episode_counts`` and ``tasks`` of each; ``fields`` of the panel; ``metrics``; ``step_budget``,
            control ticks of the longest episode, and ``step_budgets`` of each split and task;
            ``default_per_step_budget_sec`` and ``parallelism``.
        """
        catalog = self.manager.catalog
        tasks = {head: [choice.value for choice in catalog.tasks(head)] for head in catalog.heads}
        budgets = {head: {str(task): most for task, most in self.budgets(head).items()} for head in catalog.heads}
        return {
            "splits": list(catalog.heads),
            "tasks": tasks,
            "episode_counts": {
                head: len(own) * len(catalog.episodes(catalog.beginning(head))) for head, own in tasks.items()
            },
            "fields": list(catalog.fields),
            "metrics": ["success", "num_steps", "cumulative_reward"],
            "step_budget": max(most for own in budgets.values() for most in own.values()),
            "step_budgets": budgets,
            "default_per_step_budget_sec": self.default_per_step_budget_sec,
            "parallelism": self.parallelism,
        }
