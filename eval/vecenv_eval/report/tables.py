"""A summary as a table, on the screen and in Markdown.

A :class:`~vecenv_eval.report.summary.Summary` comes in and a table goes out: what ``vecenv eval`` prints and writes.
``run_tables`` writes whole runs, of several suites, for ``vecenv report``.
"""

from __future__ import annotations

from vecenv.util.tables import Column, FittedTable
from vecenv_eval.conditions import describe
from vecenv_eval.report.summary import PartRow, Row, Summary

STAND_INS = "Files were missing, and something plain stood in for them"
PARTS = "Intermediate results of the success check after the last tick, by upstream's names:"
_PART_COLUMNS = ("task", "result", "held", "share")
_TEXT = "instruction"
_COLUMNS = ("task", _TEXT, "solved", "rate", "95 % interval", "steps", "faults", "errors", "not run")
# The last columns count what went wrong; on the screen they take room only when something did.
_PROBLEMS = 3


def table(summary: Summary) -> FittedTable:
    """The summary as a table for the screen; columns of faults, errors and missing episodes only if there are any."""
    rows = [_cells(row) for row in (*summary.tasks, summary.total)]
    healthy = rows[-1][-_PROBLEMS:] == ["0"] * _PROBLEMS
    shown = _COLUMNS[: len(_COLUMNS) - (_PROBLEMS if healthy else 0)]
    return FittedTable(
        columns=[
            Column(name, text=name == _TEXT, key=name == "task", justify="left" if name == _TEXT else "right")
            for name in shown
        ],
        rows=[cells[: len(shown)] for cells in rows],
        title=f"{summary.suite} · {summary.policy}",
        caption=describe(summary.conditions),
        total=True,
    )


def markdown(summary: Summary) -> str:
    """The summary as a Markdown page."""
    cells = [_COLUMNS, ["---"] * len(_COLUMNS), *map(_cells, (*summary.tasks, summary.total))]
    lines = [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in cells]
    extras = _extras_lines(summary)
    reported = ["", "Reported by the policy, means an episode and counts:", "", *extras] if extras else []
    title = f"# {summary.suite}, policy {summary.policy}"
    missing = ["", f"{STAND_INS}:", "", *stand_in_lines(summary)] if summary.stand_ins else []
    ran_under = ["", describe(summary.conditions)] if summary.conditions else []
    parts = ["", PARTS, "", *_parts_lines(summary)] if summary.parts else []
    sanitized = ["", sanitized_line(summary)] if summary.sanitized else []
    after = [*sanitized, *parts, *missing, *reported]
    return "\n".join([title, *ran_under, "", *lines, "", closing_line(summary), *after, ""])


def closing_line(summary: Summary) -> str:
    """What went wrong and how long it took, in two sentences."""
    total = summary.total
    return (
        f"{total.episodes} episodes ({total.faults} faulted), {total.errors} errors, {total.missing} not run. "
        f"{_verdicts(total)}"
        f"{summary.steps:,} control steps in {summary.wall_s:.1f} s "
        f"({summary.steps_per_s:,.0f} steps/s, policy included), after {summary.setup_s:.1f} s of setup."
    )


def _verdicts(total: Row) -> str:
    """Both verdicts in a sentence, where they differ."""
    if total.first == total.final:
        return ""
    return f"The goal held at some tick in {total.first} and at the last tick in {total.final} of them. "


def sanitized_line(summary: Summary) -> str:
    """How many episodes had actions that were not executed as they were, in a sentence; "" for none."""
    if not summary.sanitized:
        return ""
    return f"Sanitised actions in {summary.sanitized} episodes: not finite (set to 0) or out of range (clipped)."


def stand_in_lines(summary: Summary) -> list[str]:
    """What stood in for missing files, and in how many episodes; one line each."""
    return [f"- {count} episodes: {note}" for note, count in summary.stand_ins.items()]


def part_cells(row: PartRow) -> tuple[str, str, str, str]:
    """One intermediate result: task, name, in how many episodes it held, and its share, or the mean of a number."""
    if row.share is None:
        return str(row.task), row.name, f"{row.episodes}", "-" if row.mean is None else f"mean {row.mean:.4g}"
    return str(row.task), row.name, f"{row.held}/{row.episodes}", f"{row.share:.1%}"


def _parts_lines(summary: Summary) -> list[str]:
    """The intermediate results as a table."""
    cells = [_PART_COLUMNS, ["---"] * len(_PART_COLUMNS), *map(part_cells, summary.parts)]
    return [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in cells]


def _extras_lines(summary: Summary) -> list[str]:
    """What the policy reported, one line a name."""

    def describe_value(value: float | dict[str, int]) -> str:
        return "; ".join(f"{n} x {what}" for what, n in value.items()) if isinstance(value, dict) else f"{value:,.4g}"

    return [f"- {name}: {describe_value(value)}" for name, value in summary.extras.items() if value != {}]


def _cells(row: Row) -> list[str]:
    rate = "-" if row.rate is None else f"{row.rate:.1%}"
    interval = "-" if row.low is None or row.high is None else f"{row.low:.1%}-{row.high:.1%}"
    steps = "-" if row.steps_to_solve is None else f"{row.steps_to_solve:.0f}"
    solved = f"{row.successes}/{row.episodes}"
    return [
        str(row.task),
        row.instruction,
        solved,
        rate,
        interval,
        steps,
        *map(str, (row.faults, row.errors, row.missing)),
    ]
