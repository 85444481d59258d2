"""Nodes over HTTP: what there is, and one call of one of them.

The node sets of ``vecenv.interop.nodes`` and ``voxposer.nodes`` come in. A set is initialised at its first call and
runs on one thread of its own, one call after the other. Arrays and images of the outputs become JSON (``plain``).
"""

from __future__ import annotations

import base64
import importlib
import inspect
import io
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, is_dataclass
from typing import Any

import asyncio
import numpy as np
from fastapi import APIRouter
from pydantic import BaseModel, ValidationError

from vecenv_eval.web.context import Context
from vecenv_eval.web.errors import Refused
from vecenv_eval.web.models import ErrorBody, NodeAnswer, NodeBody, NodeCatalog, NodeRow, PortRow
from vecenv_eval.web.writer import WriterName

# Where node sets come from; a package without them serves none.
PACKAGES = ("vecenv.interop.nodes", "voxposer.nodes")


class NodeHost:
    """Node sets and the threads that they run on.

    Args:
        sets: the node sets by name; those of :data:`PACKAGES` when not given.
    """

    def __init__(self, sets: Mapping[str, Any] | None = None) -> None:
        self.sets = dict(installed_sets() if sets is None else sets)
        self.tools = {tool.node_type: (name, tool) for name, each in self.sets.items() for tool in each.get_tools()}
        self._threads: dict[str, ThreadPoolExecutor] = {}
        self._ready: set[str] = set()
        self._lock = threading.Lock()

    async def run(self, node_type: str, inputs: dict[str, Any], config: dict[str, Any]) -> dict[str, Any]:
        """Call a node on its set's thread."""
        name, tool = self.tools[node_type]
        with self._lock:
            thread = self._threads.setdefault(name, ThreadPoolExecutor(1, thread_name_prefix=f"vecenv-{name}"))
        return await asyncio.get_running_loop().run_in_executor(thread, self._run, name, tool, inputs, config)

    def _run(self, name: str, tool: Any, inputs: dict[str, Any], config: dict[str, Any]) -> dict[str, Any]:
        if name not in self._ready:
            self.sets[name].initialize()
            self._ready.add(name)
        outputs = tool.run(inputs, config)
        return asyncio.run(outputs) if inspect.iscoroutine(outputs) else outputs

    def close(self) -> None:
        """Shut down every set that was initialised, on its thread."""
        with self._lock:
            threads, self._threads = self._threads, {}
        for name, thread in threads.items():
            if name in self._ready:
                thread.submit(self.sets[name].shutdown)
            thread.shutdown(wait=True)
        self._ready.clear()


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
        return NodeCatalog(nodes=[_row(name, tool) for name, tool in nodes.tools.values()])

    @router.post("/nodes/{node_type}", responses={409: {"model": ErrorBody}})
    async def call(node_type: str, body: NodeBody, writer: WriterName = None) -> NodeAnswer:
        """Call a node; what it could not do is its output ``error``."""
        if node_type not in nodes.tools:
            raise Refused(404, f"there is no node {node_type[:64]!r}: GET /api/nodes lists them", "node_type")
        name, tool = nodes.tools[node_type]
        known = {port.name for port in _ports(tool.inputs)}
        if stray := sorted(set(body.inputs) - known):
            raise Refused(422, f"inputs: {node_type} has no port {stray[0][:64]!r}", "inputs")
        config = _config_of(tool, body.config)
        context.writers.claim(f"nodes/{name}", writer)
        return NodeAnswer(outputs=plain(await nodes.run(node_type, body.inputs, config)))

    return router


def _config_of(tool: Any, given: dict[str, Any]) -> dict[str, Any]:
    """A node's config, checked."""
    model = tool.config
    if not (isinstance(model, type) and issubclass(model, BaseModel)):
        return given
    try:
        model.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise Refused(422, f"config.{'.'.join(map(str, first['loc']))}: {first['msg']}", "config") from None
    return given


def _row(name: str, tool: Any) -> NodeRow:
    model = tool.config
    return NodeRow(
        node_type=tool.node_type,
        node_set=name,
        description=(inspect.getdoc(type(tool)) or "").partition("\n")[0],
        inputs=_ports(tool.inputs),
        outputs=_ports(tool.outputs),
        config=model.model_json_schema() if isinstance(model, type) and issubclass(model, BaseModel) else {},
    )


def _ports(ports: Mapping[str, Any] | Sequence[Any]) -> list[PortRow]:
    """Ports as rows: objects with ``name`` and ``type``, or a mapping of names to types."""
    if isinstance(ports, Mapping):
        return [PortRow(name=name, type=str(kind)) for name, kind in ports.items()]
    return [
        PortRow(
            name=port.name,
            type=str(getattr(port, "wire_type", getattr(port, "type", ""))),
            optional=bool(getattr(port, "optional", False)),
            description=str(getattr(port, "description", "")),
        )
        for port in ports
    ]


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
