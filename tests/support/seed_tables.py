"""The published tables of nodes, read from text files in which rows may run over several lines."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

WIRE_TYPES = ("ANY", "TEXT", "BOOL", "IMAGE", "POSE", "DEPTH", "LIST[IMAGE]", "LIST[TEXT]", "METRICS")
# The ports that "the four control ports" stands for.
CONTROL = ("reward", "terminated", "truncated", "info")
_PARENTHESES = re.compile(r"\(([^()]*)\)")


class Table(NamedTuple):
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]


class PublishedPort(NamedTuple):
    type: str | None
    optional: bool


def tables(text: str) -> Iterator[Table]:
    """Every table with a header and a line of dashes; cells are separated by "|", rows by the number of columns."""
    lines = [line.strip().replace("`", "") for line in text.splitlines()]
    for at, line in enumerate(lines):
        if not re.fullmatch(r"\|(-+\|)+", line):
            continue
        header = _cells(lines[at - 1])
        cells: list[str] = []
        for below in lines[at + 1 :]:
            # A table ends where a whole number of rows is followed by a line without cells.
            if "|" not in below and len(cells) % len(header) == 0:
                break
            cells += _cells(below)
        yield Table(tuple(header), [tuple(row) for row in _grouped(cells, len(header))])


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.removeprefix("|").removesuffix("|").split("|")] if line.strip("|") else [""]


def _grouped(cells: list[str], width: int) -> Iterator[list[str]]:
    for start in range(0, len(cells) - width + 1, width):
        yield cells[start : start + width]


def ports(cell: str, bundles: Mapping[str, Mapping[str, PublishedPort]]) -> dict[str, PublishedPort]:
    """The ports of a cell such as "a, b (TEXT), c (ANY, optional)"; ``bundles`` are names for several ports."""
    found: dict[str, PublishedPort] = {}
    for name, several in bundles.items():
        if name in cell:
            found |= several
            cell = cell.replace(name, "")
    cell = cell.split("—")[0] if "(" not in cell else cell
    for part in re.split(r"[,+](?![^()]*\))", cell):
        note = " ".join(_PARENTHESES.findall(part))
        name = _PARENTHESES.sub("", part).split("—")[0].strip().removeprefix("extras ").strip()
        if re.fullmatch(r"[a-z_0-9]+", name):
            found[name] = PublishedPort(_type(note), "optional" in note)
    if together := re.search(r"\(all ([A-Z]+)", cell):
        before = cell[: together.start()]
        for name in re.findall(r"[a-z_]+", before):
            found[name] = PublishedPort(together[1], False)
    return found


def _type(note: str) -> str | None:
    first = re.match(r"[A-Z]+(\[[A-Z]+\])?", note)
    return first[0] if first and first[0] in WIRE_TYPES else None
