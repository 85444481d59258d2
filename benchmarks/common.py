"""What every benchmark here does the same way: find the peers, print one table, write one set of rows."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).resolve().parent / "results"
# Upstream's environments are built by the same module that the tests use.
sys.path.insert(0, str(ROOT / "tests"))


def report(
    name: str, rows: Sequence[Mapping[str, object]], *, title: str, notes: Mapping[str, object] | None = None
) -> Path:
    """Print rows as a table and write them, with the machine and the versions, to ``results/{name}.json``."""
    from rich.console import Console
    from rich.table import Table

    from vecenv.doctor import machine, versions

    table = Table(title=title)
    for column in rows[0]:
        table.add_column(column, justify="left" if isinstance(rows[0][column], str) else "right")
    for row in rows:
        table.add_row(*(show(value) for value in row.values()))
    Console(width=160).print(table)
    path = RESULTS / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    content = {
        "benchmark": name,
        "command": " ".join(["python", *sys.argv]),
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
        "versions": versions(),
        **(notes or {}),
        "rows": list(rows),
    }
    path.write_text(json.dumps(content, indent=1) + "\n")
    print(f"rows in {path.relative_to(ROOT)}")
    return path


def show(value: object) -> str:
    """A cell: small floats in scientific notation, others with three significant digits."""
    if isinstance(value, float):
        return f"{value:.1e}" if value and abs(value) < 1e-2 else f"{value:.3g}"
    return str(value)
