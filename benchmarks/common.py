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


def fill_table(name: str, results: Path, page: Path) -> str:
    """Put the rows of a results file as a Markdown table between ``<!-- name -->`` and ``<!-- end name -->`` of a page.

    Returns:
        The table.

    Raises:
        SystemExit: there are no results yet, or the page has no such place.
    """
    if not results.is_file():
        raise SystemExit(f"{results}: no such file; run the benchmark first")
    rows = json.loads(results.read_text())["rows"]
    columns = list(rows[0])
    lines = [columns, ["---"] * len(columns), *([show(row[column]) for column in columns] for row in rows)]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    before, opening, rest = page.read_text().partition(f"<!-- {name} -->\n")
    _, closing, after = rest.partition(f"<!-- end {name} -->")
    if not (opening and closing):
        raise SystemExit(f"{page}: no place for the table: <!-- {name} --> and <!-- end {name} -->")
    page.write_text(f"{before}{opening}{table}\n{closing}{after}")
    return table


def show(value: object) -> str:
    """A cell: small floats in scientific notation, others with three significant digits."""
    if isinstance(value, float):
        return f"{value:.1e}" if value and abs(value) < 1e-2 else f"{value:.3g}"
    return str(value)
