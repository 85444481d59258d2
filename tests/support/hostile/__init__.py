"""Programs that try to get out of the sandbox or to use up the machine, by what they use for it, and who watches them.

``tests/data/hostile`` has a file for each construct: the rule that programs break, "" for those that run to their end,
and the programs. The long ones of ``sources`` are made by ``support.hostile.sources``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from support.hostile.sources import SOURCES
from support.paths import DATA

# Construct -> the world of ``support.hostile.child`` that its programs run in.
WORLDS: Mapping[str, str] = {
    **dict.fromkeys(("attributes", "names", "text", "numbers", "containers"), "things"),
    **dict.fromkeys(("functions", "arrays", "indexing", "sources"), "things"),
    "host": "robot",
}
# Rules of which a program may break one or another first, as its machine is fast.
LIMITS = frozenset({"steps", "time", "memory", "calls", "size", "nesting"})


def programs(construct: str) -> dict[str, str]:
    """Source -> the rule that it breaks, of one construct."""
    by_rule = json.loads((DATA / "hostile" / f"{construct}.json").read_text())
    made = {source: rule for rule, source in SOURCES} if construct == "sources" else {}
    return made | {source: rule for rule, sources in by_rule.items() for source in sources}


def heavy(world: str) -> list[str]:
    """Programs that use as much of the limits of production as they can."""
    return json.loads((DATA / "hostile" / "heavy.json").read_text())[world]
