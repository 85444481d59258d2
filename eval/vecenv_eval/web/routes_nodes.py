"""Nodes over HTTP: what there is, one call of one of them, and the panels of node sets.

The node sets of ``vecenv.interop.nodes`` and ``voxposer.nodes`` come in. The calls of a set wait for one another; a set
has environments of its own, which the session does not see. Arrays and images of the outputs become JSON
(:func:`plain`).
"""

from __future__ import annotations

import asyncio
import base64
import importlib
import io
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, is_dataclass
from typing import Any, TypeVar

import numpy as np
from fastapi import APIRouter
from pydantic import BaseModel, ValidationError

from vecenv_eval.web.context import Context
from vecenv_eval.web.errors import Refused
from vecenv_eval.web.models import (
    CONFLICT,
    NodeAnswer,
    NodeBody,
    NodeCatalog,
    NodeRow,
    NodeSetRow,
    PanelAction,
    PanelAnswer,
    PanelField,
    PanelFields,
)
from vecenv_eval.web.permissions import check_node_config
from vecenv_eval.web.writer import WriterName

# Where node sets come from; a package without them serves none.
PACKAGES = ("vecenv.interop.nodes", "voxposer.nodes")
# Calls of a set that may wait, and seconds that a set is given to shut down.
_MOST_WAITING, _SHUTDOWN_S = 8, 10.0
_Result = TypeVar("_Result")


class NodeHost:
    """Node sets and the threads that they are called on.

    Args:
        sets: the node sets by name; those of :data:`PACKAGES` when not given.
    """

    def __init__(self, sets: Mapping[str, Any] | None = None) -> None:
        self.sets = dict(installed_sets() if sets is None else sets)
        self.tools = {tool.node_type: (name, tool) for name, each in self.sets.items() for tool in each.get_tools()}
        self._threads: dict[str, ThreadPoolExecutor] = {}
        self._waiting = dict.fromkeys(self.sets, 0)

    async def call(self, name: str, function: Callable[..., _Result], *arguments: Any) -> _Result:
        """Call a function of a set on its thread.

        Raises:
            Refused: too many calls of the set wait already.
        """
        if self._waiting[name] >= _MOST_WAITING:
            raise Refused(503, f"{_MOST_WAITING} calls of {name} wait already", retry_after="1")
        thread = self._threads.setdefault(name, ThreadPoolExecutor(1, thread_name_prefix=f"vecenv-{name}"))
        self._waiting[name] += 1
        try:
            # A call goes on when its client has left: what it does to an environment is not half done.
            return await asyncio.shield(asyncio.get_running_loop().run_in_executor(thread, function, *arguments))
        finally:
            self._waiting[name] -= 1

    def close(self) -> None:
        """Shut down every set that was called."""
        threads, self._threads = self._threads, {}
        for name, thread in threads.items():
            thread.shutdown(wait=False, cancel_futures=True)
            ending = threading.Thread(target=self.sets[name].shutdown, daemon=True, name=f"vecenv-{name}-end")
            ending.start()
            ending.join(_SHUTDOWN_S)


def installed_sets() -> dict[str, Any]:
    """The node sets of the packages that have some."""
    sets: dict[str, Any] = {}
    for package in PACKAGES:
        try:
            module = importlib.import_module(package)
        except ModuleNotFoundError as error:
            if error.name is None or not package.startswith(error.name):
                raise
            continue
        sets |= module.node_sets()
    return sets


def nodes_router(context: Context, host: NodeHost | None = None) -> APIRouter:
    """The routes of the nodes.

    Args:
        context: what routes share.
        host: the nodes; those that are installed when not given.
    """
    router = APIRouter(prefix="/api", tags=["nodes"])
    nodes = host or NodeHost()
    context.on_close(nodes.close)

    @router.get("/nodes")
    def catalog() -> NodeCatalog:
        """Every node with its ports and the schema of its config."""
        rows = [NodeRow(node_set=name, **_described(tool)) for name, tool in nodes.tools.values()]
        sets = [
            NodeSetRow(name=name, display_name=each.display_name, has_panel=each.panel is not None)
            for name, each in nodes.sets.items()
        ]
        return NodeCatalog(nodes=rows, sets=sets)

    @router.post("/nodes/{node_type}", responses=CONFLICT)
    async def call(node_type: str, body: NodeBody, writer: WriterName = None) -> NodeAnswer:
        """Call a node; why it could not do something is its output ``error``."""
        if node_type not in nodes.tools:
            raise Refused(404, f"there is no node {node_type[:64]!r}: GET /api/nodes lists them", "node_type")
        name, tool = nodes.tools[node_type]
        known = [port.name for port in tool.inputs]
        if stray := [each for each in body.inputs if each not in known]:
            raise Refused(422, f"inputs: {node_type} has no port {stray[0][:64]!r}: {', '.join(known)}", "inputs")
        _check_config(tool.config, body.config)
        check_node_config(body.config, context.settings)
        context.writers.claim(f"nodes/{name}", writer)
        outputs = await nodes.call(name, lambda: plain(tool.run(body.inputs, body.config, node=body.node)))
        return NodeAnswer(outputs=outputs)

    def panel_of(node_set: str) -> Any:
        panel = nodes.sets[node_set].panel if node_set in nodes.sets else None
        if panel is None:
            raise Refused(404, f"there is no node set {node_set[:64]!r} with a panel", "node_set")
        return panel

    @router.get("/panels/{node_set}")
    async def fields(node_set: str) -> PanelFields:
        """The fields of a node set's panel, with what they offer."""
        panel = panel_of(node_set)
        return PanelFields(fields=[each.model_dump() for each in await nodes.call(node_set, panel.fields)])

    @router.post("/panels/{node_set}/fields", responses=CONFLICT)
    async def choose(node_set: str, body: PanelField, writer: WriterName = None) -> PanelAnswer:
        """Choose a value; the episode is placed."""
        panel = panel_of(node_set)
        context.writers.claim(f"nodes/{node_set}", writer)
        return _answer(await nodes.call(node_set, panel.set_field, body.name, body.value))

    @router.post("/panels/{node_set}/actions", responses=CONFLICT)
    async def act(node_set: str, body: PanelAction, writer: WriterName = None) -> PanelAnswer:
        """Play, pause, stop or reset."""
        panel = panel_of(node_set)
        context.writers.claim(f"nodes/{node_set}", writer)
        return _answer(await nodes.call(node_set, panel.action, body.action))

    return router


def _described(tool: Any) -> dict[str, Any]:
    """A tool as a row of the catalogue."""
    known = tool.describe()
    return {name: known[name] for name in ("node_type", "display_name", "description", "inputs", "outputs", "config")}


def _answer(response: Any) -> PanelAnswer:
    """What a panel answers; what it could not do is refused."""
    values = response.model_dump()
    if error := values.pop("error", ""):
        raise Refused(422, error)
    return PanelAnswer(**values)


def _check_config(model: type[BaseModel], given: dict[str, Any]) -> None:
    try:
        model.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise Refused(422, f"config.{'.'.join(map(str, first['loc']))[:80]}: {first['msg']}", "config") from None


def plain(value: Any) -> Any:
    """A value of a port as JSON: images as PNG, arrays as nested lists, numbers that are not finite as null."""
    if isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] in (1, 3, 4):
        return {"type": "image/png", "base64": base64.b64encode(_png(value)).decode()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(each) for each in value]
    if isinstance(value, BaseModel):
        return plain(value.model_dump())
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    return value if value is None or isinstance(value, str | bool | int) else str(value)


def _png(image: np.ndarray) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image[..., 0] if image.shape[2] == 1 else image).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()
