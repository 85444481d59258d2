"""From episode records to numbers: success rates with Wilson 95 % intervals, by task and for the suite.

Records come in, a :class:`Summary` goes out, ready for JSON; ``tables`` writes it for the screen and for documents.
A faulted episode counts as a failure. An episode that an error ended has no verdict: it is left out of the rate and
counted beside it, as is one that never ran.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from scipy.stats import binomtest

from vecenv_eval.episodes import Episode
from vecenv_eval.store import Record

CONFIDENCE = 0.95
TOTAL = "all"
# A value that a policy reports as None.
UNKNOWN = "unknown"


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
        errors: episodes without a verdict, because an error ended them.
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
class PartRow:
    """One intermediate result of a task's success check (``Record.parts``), over the task's episodes.

    Attributes:
        task: task index.
        name: upstream's name of it.
        episodes: episodes with a verdict that have it.
        held: those in which it held after the last tick; None for a number.
        share: held / episodes; None for a number.
        mean: mean of a number after the last tick; None for what holds or does not.
    """

    task: int
    name: str
    episodes: int
    held: int | None
    share: float | None
    mean: float | None


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
            often each text was reported, and how often a value was reported as unknown.
        stand_ins: how many episodes ran with what in place of a missing file.
        conditions: what the episodes ran under, see ``vecenv_eval.conditions``; empty when no environment was made.
        parts: the intermediate results of the success check, task by task; SIMPLER's tasks have some.
        sanitized: episodes with actions that were not finite or out of range, and were changed.
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
    parts: tuple[PartRow, ...] = ()
    sanitized: int = 0

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
        parts=tuple(part for task in tasks for part in _parts(task, [r for r in found if r.task == task])),
        sanitized=sum(bool(record.sanitized) for record in found),
    )


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
    """Means of reported numbers, counts of reported words (empty ones left out) and of values that are not known."""
    result: dict[str, float | dict[str, int]] = {}
    for name in dict.fromkeys(name for record in records for name in record.extras):
        values = [record.extras[name] for record in records if record.extras.get(name) not in (None, "")]
        numbers = [float(value) for value in values if isinstance(value, int | float)]
        words = Counter(str(value) for value in values if not isinstance(value, int | float))
        unknown = sum(name in record.extras and record.extras[name] is None for record in records)
        result[name] = dict(words.most_common()) if words else sum(numbers) / len(numbers) if numbers else {}
        if unknown:
            result[f"{name} ({UNKNOWN})" if values else name] = {UNKNOWN: unknown}
    return result


def _parts(task: int, records: Sequence[Record]) -> list[PartRow]:
    """What the success check found on the way, over the episodes of a task that have a verdict."""
    verdicts = [record.parts for record in records if not record.error]
    rows = []
    for name in dict.fromkeys(name for parts in verdicts for name in parts):
        values = [parts[name] for parts in verdicts if parts.get(name) is not None]
        if values and all(isinstance(value, bool) for value in values):
            held = sum(map(bool, values))
            share, mean = held / len(values), None
        else:
            held = share = None
            mean = sum(map(float, values)) / len(values) if values else None
        rows.append(PartRow(task=task, name=name, episodes=len(values), held=held, share=share, mean=mean))
    return rows


def _seconds(records: Sequence[Record]) -> tuple[float, float]:
    """Seconds of setup and of running.

    Slots that are placed together note the same setup. Shares of policy, physics and images add up to the time of
    running; of a stream without them, the time is that until its last episode ended.
    """
    setup = {(record.run, record.batch, record.setup_s) for record in records}
    shares: dict[tuple[int, int], float] = {}
    wall: dict[tuple[int, int], float] = {}
    for record in records:
        key = (record.run, record.batch)
        shares[key] = shares.get(key, 0.0) + record.policy_s + record.physics_s + record.images_s
        wall[key] = max(wall.get(key, 0.0), record.wall_s)
    return sum(seconds for *_, seconds in setup), sum(shares[key] or wall[key] for key in wall)
