"""How replays went: both verdicts of each demonstration, how far states differ, and how often the verdicts agree.

Outcomes come in; a table, a sentence and plain types for JSON go out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vecenv.util.tables import Column, FittedTable
from vecenv_eval.demos.hdf5 import Unreadable
from vecenv_eval.report import CONFIDENCE, wilson


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How one demonstration went.

    Attributes:
        path, name: the file, and the demonstration's name in it.
        suite, task: what it is a demonstration of.
        recorded: the verdict on record, None where there is none.
        replayed: the verdict of the replay, at or before the last action.
        length: actions on record.
        ticks: control ticks executed; fewer than ``length`` when it was solved before.
        qpos_error, qvel_error: largest difference from the state on record (metres and radians; per second) after
            ``ticks``, or before the last action where the file has no later one; None where it has none.
        fault: why the physics failed, "" when it did not.
        note: what a reader should know about the comparison.
    """

    path: Path
    name: str
    suite: str
    task: int
    recorded: bool | None
    replayed: bool
    length: int
    ticks: int
    qpos_error: float | None
    qvel_error: float | None
    fault: str = ""
    note: str = ""

    @property
    def agrees(self) -> bool | None:
        """Whether the verdicts are the same; None without one on record."""
        return None if self.recorded is None else self.recorded == self.replayed


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """Every outcome, and what could not be replayed."""

    outcomes: tuple[Outcome, ...]
    problems: tuple[Unreadable, ...]

    @property
    def compared(self) -> int:
        """Demonstrations with a verdict on record."""
        return sum(outcome.recorded is not None for outcome in self.outcomes)

    @property
    def agreeing(self) -> int:
        """Those whose replay came to the same."""
        return sum(outcome.agrees is True for outcome in self.outcomes)

    @property
    def ok(self) -> bool:
        """Every demonstration was replayed, and verdicts were compared and agree."""
        return not self.problems and 0 < self.compared == self.agreeing

    def to_dict(self) -> dict[str, Any]:
        """Plain types, ready for JSON."""
        low, high = wilson(self.agreeing, self.compared) if self.compared else (None, None)
        return {
            "compared": self.compared,
            "agreeing": self.agreeing,
            "low": low,
            "high": high,
            "interval": f"wilson {CONFIDENCE}",
            "ok": self.ok,
            "demos": [{**vars(o), "path": str(o.path), "agrees": o.agrees} for o in self.outcomes],
            "problems": [{**vars(p), "path": str(p.path)} for p in self.problems],
        }


def table(report: ReplayReport) -> FittedTable:
    """The outcomes as a table for the screen; with file names where a task has several files."""
    named = {outcome.path: (outcome.suite, outcome.task) for outcome in report.outcomes}
    several = len(set(named.values())) < len(named)
    columns = [Column("task", key=True), Column("demo", key=True, justify="right")]
    columns += [Column(name, justify="right") for name in ("recorded", "replayed", "ticks", "max |dq|")]
    columns += [Column(name, text=True) for name in (*(["file"] if several else []), "note")]
    return FittedTable(
        columns=columns,
        rows=[_cells(outcome, several) for outcome in report.outcomes],
        styles={number: "red" for number, outcome in enumerate(report.outcomes) if outcome.agrees is False},
    )


def _cells(outcome: Outcome, named: bool) -> list[str]:
    return [
        f"{outcome.suite}/{outcome.task}",
        outcome.name,
        _verdict(outcome.recorded),
        _verdict(outcome.replayed),
        f"{outcome.ticks}/{outcome.length}",
        "-" if outcome.qpos_error is None else f"{outcome.qpos_error:.1e}",
        *([outcome.path.name] if named else []),
        "; ".join(filter(None, (outcome.fault, outcome.note))),
    ]


def closing_line(report: ReplayReport) -> str:
    """How often the verdicts agree, in a sentence."""
    without = len(report.outcomes) - report.compared
    rest = "".join(
        f", {count} {what}"
        for count, what in ((without, "without a verdict on record"), (len(report.problems), "not replayed"))
        if count
    )
    if not report.compared:
        return f"no verdicts to compare{rest}"
    low, high = wilson(report.agreeing, report.compared)
    return f"verdicts agree: {report.agreeing}/{report.compared} (95 % interval {low:.1%}-{high:.1%}){rest}"


def _verdict(success: bool | None) -> str:
    return "?" if success is None else "solved" if success else "failed"
