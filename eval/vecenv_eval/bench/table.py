"""The table of a benchmark: printed, and written with the machine and the versions."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from vecenv.doctor import machine, versions
from vecenv.util.tables import from_rows


def publish(rows: Sequence[Mapping[str, object]], title: str, out: Path | None) -> None:
    """Print rows as a table and, where asked, write them with the machine and the versions."""
    Console().print(from_rows(rows, title=title))
    if out is not None:
        content = {"title": title, "machine": machine(), "versions": versions(), "rows": list(rows)}
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(content, indent=1) + "\n")
        print(f"rows in {out}")
