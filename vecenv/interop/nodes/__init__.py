"""LIBERO and SIMPLER as sets of tools for graphs and servers: ports, JSON actions, panels (docs/nodes.md).

:func:`node_sets` has the two node sets of this process. A tool takes and returns mappings of ports, never raises, and
describes itself as data; nothing here knows HTTP. ``voxposer.nodes`` has VoxPoser's.
"""

from __future__ import annotations

from vecenv.errors import MissingDependency
from vecenv.util.extras import how_to_install, is_installed

if not is_installed("pydantic"):
    raise MissingDependency(how_to_install("pydantic"), name="pydantic")

from vecenv.interop.nodes.libero import EnvLiberoNodeSet
from vecenv.interop.nodes.manager import EnvManager
from vecenv.interop.nodes.nodeset import EnvNodeSet, NodeSet
from vecenv.interop.nodes.panel import EnvPanel, PanelResponse
from vecenv.interop.nodes.ports import NodeError, Port, WireType
from vecenv.interop.nodes.simpler import EnvSimplerNodeSet
from vecenv.interop.nodes.snapshots import snapshot_from_dict, snapshot_to_dict
from vecenv.interop.nodes.tool import Tool, ToolConfig

__all__ = [
    "EnvLiberoNodeSet",
    "EnvManager",
    "EnvNodeSet",
    "EnvPanel",
    "EnvSimplerNodeSet",
    "NodeError",
    "NodeSet",
    "PanelResponse",
    "Port",
    "Tool",
    "ToolConfig",
    "WireType",
    "node_sets",
    "snapshot_from_dict",
    "snapshot_to_dict",
]


def node_sets() -> dict[str, NodeSet]:
    """The node sets of environments by name. They share one environment each with whoever calls this in the process."""
    sets: tuple[NodeSet, ...] = (EnvLiberoNodeSet(), EnvSimplerNodeSet())
    return {each.name: each for each in sets}
