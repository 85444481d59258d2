"""A report as text: two tables, and after them what is missing with the way to get it."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape

from vecenv.doctor.installed import DISTRIBUTION, installed_version
from vecenv.doctor.report import Check, Package, Report
from vecenv.util.tables import Column, FittedTable

_COLORS = {"missing": "red", "absent": "yellow"}


def print_report(report: Report, console: Console) -> None:
    """Print the report as text: versions, probes, and last what is missing and how to install it."""
    console.print(_version_table(report.packages))
    console.print(_check_table(report.checks))
    missing = [check for check in report.checks if not check.ok]
    for check in missing:
        kind = "[red]needed[/]" if check.core else "optional"
        how = check.fix or "nothing to install; see the detail above"
        console.print(f"{kind} · {escape(check.name)}: {escape(how)}", highlight=False, soft_wrap=True)
    lacking = "[red]The packages and files marked needed are missing.[/]"
    console.print("Everything the core needs is there." if report.ok else lacking)


def _version_table(rows: tuple[Package, ...]) -> FittedTable:
    return FittedTable(
        columns=[Column("package", key=True), Column("version"), Column("wanted"), Column("for")],
        rows=[(p.name, p.version or "missing", p.wanted, p.group) for p in rows],
        title=f"{DISTRIBUTION} {installed_version(DISTRIBUTION)}",
        styles={number: "red" for number, p in enumerate(rows) if not p.ok},
    )


def _check_table(checks: tuple[Check, ...]) -> FittedTable:
    marks = ["ok" if check.ok else "missing" if check.core else "absent" for check in checks]
    return FittedTable(
        columns=[Column("", key=True), Column("what", key=True), Column("found", text=True)],
        rows=[(mark, check.name, check.detail) for mark, check in zip(marks, checks, strict=True)],
        title="This machine",
        styles={number: _COLORS[mark] for number, mark in enumerate(marks) if mark in _COLORS},
    )
