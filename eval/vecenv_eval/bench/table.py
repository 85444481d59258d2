"""The table of a benchmark: printed, and written with the machine and the versions."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from vecenv.doctor import machine, versions


def publish(rows: Sequence[Mapping[str, object]], title: str, out: Path | None) -> None:
    """Print rows as a table and, where asked, write them with the machine and the versions."""
    table = Table(title=title)
    for column in rows[0]:
        table.add_column(column)
    for row in rows:
        table.add_row(*(f"{value:.2f}" if isinstance(value, float) else str(value) for value in row.values()))
    Console().print(table)
    if out is not None:
        content = {"title": title, "machine": machine(), "versions": versions(), "rows": list(rows)}
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(content, indent=1) + "\n")
        print(f"rows in {out}")
