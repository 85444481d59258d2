"""A tool: one node of a graph, with ports, options as data, and a call that never raises.

A subclass names its ports and options and writes :meth:`Tool.execute`. :meth:`Tool.run` checks what it is given, runs
it, and turns whatever goes wrong into the text of the output ``error``; all other outputs are there as well, empty.
"""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, ClassVar, Generic, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from vecenv.errors import VecenvError
from vecenv.interop.nodes.ports import NodeError, Port, WireType, check_inputs, neutral, port

ERROR = port("error", WireType.TEXT, "why there is no result; empty if there is one")
_log = logging.getLogger(__name__)
_State = TypeVar("_State")
# Longest text of an error, and how many nodes of graphs a tool remembers.
_LONGEST_ERROR, _MOST_NODES = 600, 256


class ToolConfig(BaseModel):
    """Options of a tool; each has a default, other names are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Tool(ABC):
    """A tool of a node set.

    Attributes:
        verb: what comes after ``__`` in its name.
        display_name: its name for people.
        family: ``reset``, ``step``, ``observe``, ``evaluate``, ``info``, ``extra`` or ``method``.
        inputs: ports that it reads.
        outputs: ports that it writes; the last is ``error`` unless it stands elsewhere.
        config: the pydantic model of its options.
        origin: ``"seed"`` for a tool of the published surface, ``"vecenv"`` for an addition.
    """

    verb: ClassVar[str]
    display_name: ClassVar[str]
    family: ClassVar[str]
    inputs: ClassVar[tuple[Port, ...]] = ()
    outputs: ClassVar[tuple[Port, ...]] = (ERROR,)
    config: ClassVar[type[ToolConfig]] = ToolConfig
    origin: ClassVar[str] = "seed"

    def __init__(self, prefix: str) -> None:
        self.node_type = f"{prefix}__{self.verb}"

    @property
    def description(self) -> str:
        """What it does, in a sentence."""
        return (type(self).__doc__ or "").strip().split("\n\n")[0].replace("\n    ", " ")

    def describe(self) -> dict[str, Any]:
        """The tool as data for JSON: its name, ports, and the JSON schema of its options."""
        return {
            "node_type": self.node_type,
            "display_name": self.display_name,
            "family": self.family,
            "origin": self.origin,
            "description": self.description,
            "inputs": [each.model_dump(mode="json") for each in self.inputs],
            "outputs": [each.model_dump(mode="json") for each in self.outputs],
            "config": self.config.model_json_schema(),
        }

    def run(self, inputs: object = None, config: object = None, *, node: str = "") -> dict[str, Any]:
        """Run the tool and wait; nothing is raised.

        Args:
            inputs: values by port; optional ports may be left out.
            config: options by name; None for the defaults.
            node: which node of a graph this is. Tools that remember something remember it for each node on its own.

        Returns:
            A value for each output; ``error`` is empty if the tool did what it was asked.
        """
        try:
            given = check_inputs(self.inputs, {} if inputs is None else inputs)
            outputs = self.execute(given, self._options(config), node)
        except Exception as error:
            if not isinstance(error, VecenvError):
                _log.warning("%s failed", self.node_type, exc_info=True)
            return {**self._empty(), **self._after_error(described(error)), ERROR.name: described(error)}
        return {**self._empty(), **outputs}

    async def run_async(self, inputs: object = None, config: object = None, *, node: str = "") -> dict[str, Any]:
        """The same for an event loop, which goes on meanwhile."""
        return await asyncio.to_thread(self.run, inputs, config, node=node)

    @abstractmethod
    def execute(self, given: Mapping[str, Any], config: Any, node: str) -> dict[str, Any]:
        """Do the work: outputs by port. What is raised becomes the text of ``error``.

        Args:
            given: the value of every input port, None for an optional one that is left open.
            config: an instance of :attr:`config`.
            node: which node of a graph it is.
        """

    def forget(self, node: str | None = None) -> None:
        """Forget what nodes remember: of one, or of all; called when another episode begins."""
        del node

    def _options(self, config: object) -> ToolConfig:
        if isinstance(config, self.config):
            return config
        if config is not None and not isinstance(config, Mapping):
            raise NodeError(f"config: got a {type(config).__name__}; expected a mapping from options to values")
        try:
            return self.config.model_validate({} if config is None else dict(config))
        except ValidationError as error:
            raise NodeError(_what_is_wrong(error, self.config)) from None

    def _empty(self) -> dict[str, Any]:
        return {each.name: neutral(each.type) for each in self.outputs}

    def _after_error(self, text: str) -> dict[str, Any]:
        """Outputs that are known although the tool failed."""
        del text
        return {}


class Memories(Generic[_State]):
    """What each node of a graph remembers; the nodes that were used longest ago are forgotten first."""

    def __init__(self) -> None:
        self._states: OrderedDict[str, _State] = OrderedDict()

    def get(self, node: str, default: _State) -> _State:
        """What a node remembers, or ``default``."""
        return self._states.get(node, default)

    def put(self, node: str, state: _State) -> None:
        """Remember something."""
        self._states[node] = state
        self._states.move_to_end(node)
        while len(self._states) > _MOST_NODES:
            self._states.popitem(last=False)

    def forget(self, node: str | None) -> None:
        """Forget one node, or all."""
        if node is None:
            self._states.clear()
        else:
            self._states.pop(node, None)


def described(error: BaseException) -> str:
    """An error as one text: its message, and the kind of one that was not raised on purpose."""
    text = str(error) if isinstance(error, VecenvError) else f"{type(error).__name__}: {error}"
    text = text.encode(errors="replace").decode()  # a server could not send half a surrogate pair
    return text if len(text) <= _LONGEST_ERROR else f"{text[:_LONGEST_ERROR]} ..."


def _what_is_wrong(error: ValidationError, config: type[ToolConfig]) -> str:
    first = error.errors(include_url=False, include_input=False)[0]
    name = ".".join(map(str, first["loc"]))[:80]
    if first["type"] == "extra_forbidden":
        return f"config.{name} does not exist; options: {', '.join(config.model_fields) or 'none'}"
    return f"config.{name}: {first['msg']}"
