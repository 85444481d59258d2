"""From episode records to the table people read: success rates with Wilson 95 % intervals, by task and for the suite.

Records come in, a :class:`Summary` goes out, and from it a table on the screen, a Markdown page and a JSON object.
A faulted episode counts as a failure. An episode whose batch raised an error has no verdict: it is left out of the rate
and counted beside it, as is one that never ran.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table
from rich.text import Text
from scipy.stats import binomtest

from vecenv_eval.conditions import describe
from vecenv_eval.episodes import Episode
from vecenv_eval.store import Record

CONFIDENCE = 0.95
TOTAL = "all"
STAND_INS = "Files were missing, and something plain stood in for them"
_TEXT = "instruction"
_COLUMNS = ("task", _TEXT, "solved", "rate", "95 % interval", "steps", "faults", "errors", "not run")
# The last columns count what went wrong; on the screen they take room only when something did.
_PROBLEMS = 3


@dataclass(frozen=True, kw_only=True)
class Row:
    """Counts and rates of one task, or of all of them.

    Attributes:
        task: task index, or ``"all"``.
        instruction: its language instruction.
        episodes: episodes with a verdict, faulted ones included.
        successes: those that were solved, in the sense of the protocol.
        first, final: those whose goal held after one of the ticks, and after the last one.
        rate: successes / episodes, None without episodes.
        low, high: Wilson 95 % interval of the rate, None without episodes.
        steps_to_solve: mean control ticks of solved episodes, None without any.
        faults: episodes whose slot was quarantined; they count as failures.
        errors: episodes without a verdict because their batch raised.
        missing: episodes that were planned and never ran.
    """

    task: int | str
    instruction: str
    episodes: int
    successes: int
    first: int
    final: int
    rate: float | None
    low: float | None
    high: float | None
    steps_to_solve: float | None
    faults: int
    errors: int
    missing: int


@dataclass(frozen=True, kw_only=True)
class Summary:
    """An evaluation in numbers.

    Attributes:
        suite, policy: what was evaluated.
        tasks: one row a task.
        total: all tasks pooled.
        steps: control ticks executed, summed over slots.
        setup_s: seconds spent building and placing environments.
        wall_s: seconds spent running episodes, the policy's included.
        steps_per_s: ``steps / wall_s``.
        extras: what the policy reported (``Record.extras``), by name: the mean an episode of what is a number, how
            often each text was reported.
        stand_ins: how many episodes ran with what in place of a missing file.
        conditions: what the episodes ran under, see ``vecenv_eval.conditions``; empty when no environment was made.
    """

    suite: str
    policy: str
    tasks: tuple[Row, ...]
    total: Row
    steps: int
    setup_s: float
    wall_s: float
    steps_per_s: float
    extras: Mapping[str, float | dict[str, int]] = field(default_factory=dict)
    stand_ins: Mapping[str, int] = field(default_factory=dict)
    conditions: Mapping[str, Any] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Every planned episode has a verdict."""
        return not (self.total.errors or self.total.missing)

    def to_dict(self) -> dict[str, Any]:
        """Plain types, ready for JSON."""
        return {**asdict(self), "complete": self.complete, "interval": f"wilson {CONFIDENCE}"}


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """Wilson score interval of a success rate at 95 %.

    Args:
        successes: how many episodes were solved.
        episodes: of how many, at least 1.
    """
    interval = binomtest(successes, episodes).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def summarise(
    records: Iterable[Record],
    planned: Sequence[Episode],
    *,
    suite: str,
    policy: str,
    instructions: Sequence[str],
    conditions: Mapping[str, Any] | None = None,
) -> Summary:
    """Count.

    Args:
        records: one per episode; those of episodes that were not planned are left out.
        planned: every episode the evaluation was asked for.
        suite, policy: names for the heading.
        instructions: instruction of each task of the suite.
        conditions: what the episodes ran under.
    """
    by_key = {record.key: record for record in records}
    wanted = dict.fromkeys(planned)
    found = [by_key[key] for key in wanted if key in by_key]
    tasks = sorted({key.task for key in wanted})
    rows = [
        _row(task, instructions[task], [r for r in found if r.task == task], sum(key.task == task for key in wanted))
        for task in tasks
    ]
    setup_s, wall_s = _seconds(found)
    steps = sum(record.num_steps for record in found)
    return Summary(
        suite=suite,
        policy=policy,
        tasks=tuple(rows),
        total=_row(TOTAL, "", found, len(wanted)),
        steps=steps,
        setup_s=setup_s,
        wall_s=wall_s,
        steps_per_s=steps / wall_s if wall_s else 0.0,
        extras=_extras(found),
        stand_ins=dict(Counter(note for record in found for note in record.stand_ins).most_common()),
        conditions=conditions or {},
    )


def table(summary: Summary) -> Table:
    """The summary as a table for the screen; columns of faults, errors and missing episodes only if there are any."""
    rows = [_cells(row) for row in (*summary.tasks, summary.total)]
    healthy = rows[-1][-_PROBLEMS:] == ["0"] * _PROBLEMS
    shown = len(_COLUMNS) - (_PROBLEMS if healthy else 0)
    title = f"{escape(summary.suite)} · {escape(summary.policy)}"
    result = Table(title=title, caption=escape(describe(summary.conditions)), box=box.SIMPLE_HEAD, pad_edge=False)
    result.collapse_padding = True
    for column in _COLUMNS[:shown]:  # rich narrows only columns that may wrap: here the text, never a number
        result.add_column(column, justify="left" if column == _TEXT else "right", no_wrap=column != _TEXT)
    for cells in rows:
        if cells is rows[-1]:
            result.add_section()
        texts = [Text(cell, no_wrap=True, overflow="ellipsis") for cell in cells[:shown]]
        result.add_row(*texts, style="bold" if cells is rows[-1] else None)
    return result


def markdown(summary: Summary) -> str:
    """The summary as a Markdown page."""
    cells = [_COLUMNS, ["---"] * len(_COLUMNS), *map(_cells, (*summary.tasks, summary.total))]
    lines = [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in cells]
    extras = _extras_lines(summary)
    reported = ["", "Reported by the policy, means an episode and counts:", "", *extras] if extras else []
    title = f"# {summary.suite}, policy {summary.policy}"
    missing = ["", f"{STAND_INS}:", "", *stand_in_lines(summary)] if summary.stand_ins else []
    ran_under = ["", describe(summary.conditions)] if summary.conditions else []
    return "\n".join([title, *ran_under, "", *lines, "", closing_line(summary), *missing, *reported, ""])


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


def stand_in_lines(summary: Summary) -> list[str]:
    """What stood in for missing files, and in how many episodes; one line each."""
    return [f"- {count} episodes: {note}" for note, count in summary.stand_ins.items()]


def _row(task: int | str, instruction: str, records: Sequence[Record], planned: int) -> Row:
    verdicts = [record for record in records if not record.error]
    solved = [record for record in verdicts if record.success]
    low, high = wilson(len(solved), len(verdicts)) if verdicts else (None, None)
    return Row(
        task=task,
        instruction=instruction,
        episodes=len(verdicts),
        successes=len(solved),
        first=sum(record.success_first for record in verdicts),
        final=sum(record.success_final for record in verdicts),
        rate=len(solved) / len(verdicts) if verdicts else None,
        low=low,
        high=high,
        steps_to_solve=sum(r.num_steps for r in solved) / len(solved) if solved else None,
        faults=sum(bool(record.fault) for record in records),
        errors=len(records) - len(verdicts),
        missing=planned - len(records),
    )


def _extras(records: Sequence[Record]) -> dict[str, float | dict[str, int]]:
    """Means of reported numbers, counts of reported words (empty ones left out)."""
    result: dict[str, float | dict[str, int]] = {}
    for name in dict.fromkeys(name for record in records for name in record.extras):
        values = [record.extras[name] for record in records if record.extras.get(name) not in (None, "")]
        numbers = [float(value) for value in values if isinstance(value, int | float)]
        words = Counter(str(value) for value in values if not isinstance(value, int | float))
        result[name] = dict(words.most_common()) if words else sum(numbers) / len(numbers) if numbers else {}
    return result


def _extras_lines(summary: Summary) -> list[str]:
    """What the policy reported, one line a name."""

    def describe_value(value: float | dict[str, int]) -> str:
        return "; ".join(f"{n} x {what}" for what, n in value.items()) if isinstance(value, dict) else f"{value:,.4g}"

    return [f"- {name}: {describe_value(value)}" for name, value in summary.extras.items() if value != {}]


def _seconds(records: Iterable[Record]) -> tuple[float, float]:
    """Seconds of setup and of running; a batch lasts until its last episode ends."""
    setup: dict[tuple[int, int], float] = {}
    wall: dict[tuple[int, int], float] = {}
    for record in records:
        key = (record.run, record.batch)
        setup[key] = max(setup.get(key, 0.0), record.setup_s)
        wall[key] = max(wall.get(key, 0.0), record.wall_s)
    return sum(setup.values()), sum(wall.values())


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
