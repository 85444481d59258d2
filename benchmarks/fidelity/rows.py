"""Rows of results: read from files, merged, written, and printed in short."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fidelity.jobs import EARLIER
from fidelity.measures import Row
from vecenv.doctor import machine, versions

NAME = "mjx_fidelity"


def key_of(row: Row) -> tuple[str, ...]:
    """``Job.key`` of a row."""
    return (row["kind"], row["scene"], row["backend"], row["geometry"])


def contacts_of(rows: Sequence[Row]) -> set[str]:
    """The contacts that rows were measured with."""
    return {row.get("contacts", EARLIER) for row in rows}


def line(row: Row) -> str:
    """A row in short."""
    head = " ".join((row["kind"], row["scene"], row["backend"], row["geometry"]))
    if "error" in row:
        return f"{head}: {row['error']}"
    found = row["replay" if row["kind"] == "replay" else "closed"]
    text = f"{head}: native {found['native']}, here {found['here']} of {row['episodes']}"
    text += f", only native {found['only native']}, only here {found['only here']}"
    if row["kind"] == "replay":
        text += f", settle apart {row['settle']['apart']}"
    return f"{text}, faults {sum(found['faults'].values())}, {row['ticks']} ticks, {row['seconds']}"


def read_rows(paths: Sequence[Path]) -> list[Row]:
    """The rows of results files; a file that is not there has none, and a later one's row takes an earlier one's place.

    A row with an error takes no other's place.
    """
    rows: dict[tuple[str, ...], Row] = {}
    for path in paths:
        for row in json.loads(path.read_text())["rows"] if path.is_file() else ():
            if "error" not in row or key_of(row) not in rows:
                rows[key_of(row)] = row
    return list(rows.values())


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a results file, all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"benchmark": NAME, **conditions(), "rows": list(rows)}
    half = path.with_suffix(".part")
    half.write_text(json.dumps(content, indent=1) + "\n")
    half.replace(path)


@functools.cache
def conditions() -> dict[str, Any]:
    """Command, date, machine and versions."""
    command = " ".join(["python", *sys.argv])
    return {
        "command": command,
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
        "versions": versions(),
    }
