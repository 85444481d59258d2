"""A results folder, or a folder of them, read for a report; nothing is written and nothing is repaired.

A path comes in; a :class:`Run` goes out: for each suite its records, its numbers and what it ran under. Folders may be
damaged or come from elsewhere, so everything that a report uses is checked here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vecenv_eval.conditions import checked_content
from vecenv_eval.episodes import Episode
from vecenv_eval.report.summary import Row, Summary, summarise
from vecenv_eval.store import CONFIG, SUMMARY, Record, ResultStore, StoreError
from vecenv_eval.store.files import read_json
from vecenv_eval.store.record import MOST_EPISODES

# LIBERO's four suites in the order in which papers print them, under the names they print.
PAPER_NAMES = {
    "libero_spatial": "Spatial",
    "libero_object": "Object",
    "libero_goal": "Goal",
    "libero_10": "Long",
    "libero_90": "LIBERO-90",
}


@dataclass(frozen=True, kw_only=True)
class SuiteRun:
    """One suite of a run.

    Attributes:
        folder: the results folder it is in.
        suite, policy: what was evaluated.
        records: one an episode, by task and episode.
        summary: the numbers.
        config: content of the folder's ``config.json``.
        counted: the folder says which episodes were planned, so that those that never ran are counted.
    """

    folder: Path
    suite: str
    policy: str
    records: tuple[Record, ...]
    summary: Summary
    config: Mapping[str, Any]
    counted: bool

    @property
    def title(self) -> str:
        """The suite's name in papers, else its own."""
        return PAPER_NAMES.get(self.suite, self.suite)

    @property
    def task_mean(self) -> float | None:
        """Mean of the tasks' success rates; the suite's rate unless tasks have unequal numbers of episodes."""
        return mean([row.rate for row in self.summary.tasks])

    def settings(self, name: str) -> Mapping[str, Any]:
        """A part of ``config.json`` (``config``, ``conditions``), empty where there is none."""
        value = self.config.get(name)
        return value if isinstance(value, Mapping) else {}

    @property
    def runs(self) -> tuple[Mapping[str, Any], ...]:
        """What is known about each run on the folder: when, with which versions, on which machine."""
        runs = self.config.get("runs")
        return tuple(run for run in runs if isinstance(run, Mapping)) if isinstance(runs, list) else ()


@dataclass(frozen=True, kw_only=True)
class Run:
    """What one call of ``vecenv report`` reports about.

    Attributes:
        folder: where it was read.
        suites: in the order of papers, then by name.
    """

    folder: Path
    suites: tuple[SuiteRun, ...]

    @property
    def name(self) -> str:
        """The name of the folder."""
        return self.folder.resolve().name

    @property
    def policy(self) -> str:
        """The policy, or all of them."""
        return ", ".join(dict.fromkeys(suite.policy for suite in self.suites))

    @property
    def records(self) -> dict[Episode, Record]:
        """Every record, by episode."""
        return {record.key: record for suite in self.suites for record in suite.records}

    @property
    def average(self) -> float | None:
        """Mean of the suites' success rates, as papers print it."""
        return mean([suite.summary.total.rate for suite in self.suites])


def mean(rates: Sequence[float | None]) -> float | None:
    """The mean of those that are known; None without any."""
    known = [rate for rate in rates if rate is not None]
    return sum(known) / len(known) if known else None


def read_run(folder: Path) -> Run:
    """Read a results folder, or a folder whose folders are results of different suites.

    Raises:
        StoreError: there are no results, they are damaged, or two of them are about the same suite.
    """
    if not folder.is_dir():
        raise StoreError(f"{folder} is not a results folder: there is no such folder")
    inside = [folder] if (folder / CONFIG).is_file() else sorted(path.parent for path in folder.glob(f"*/{CONFIG}"))
    seeds = sorted({path.parent.parent for path in folder.glob(f"*/*/{CONFIG}")})
    if not inside and seeds:
        names = ", ".join(map(str, seeds))
        raise StoreError(f"{folder} holds runs with several seeds: name one, or two to compare them: {names}")
    if not inside:
        raise StoreError(f"{folder} is not a results folder: neither it nor a folder in it has a {CONFIG}")
    found = [suite for each in inside for suite in _read_folder(each)]
    names = [suite.suite for suite in found]
    for suite in found:
        if names.count(suite.suite) > 1:
            two = " and ".join(str(other.folder) for other in found if other.suite == suite.suite)
            raise StoreError(f"{folder} holds several runs of {suite.suite} ({two}): name one of them")
    order = list(PAPER_NAMES)
    key = lambda suite: (order.index(suite.suite) if suite.suite in order else len(order), suite.suite)  # noqa: E731
    return Run(folder=folder, suites=tuple(sorted(found, key=key)))


def _read_folder(folder: Path) -> list[SuiteRun]:
    """The suites in one results folder."""
    store = ResultStore(folder)
    config, records = store.config(), sorted(store.records().values(), key=lambda record: record.key)
    checked_content(config, folder / CONFIG)
    settings = config.get("config")
    if not isinstance(settings, dict) or not isinstance(settings.get("suite"), str):
        raise StoreError(f"{folder / CONFIG} does not say which suite was evaluated")
    policy = str(settings.get("policy") or "the suite's scripted one")
    suites = dict.fromkeys(record.suite for record in records) or {settings["suite"]: None}
    stored = _stored_rows(folder)
    return [
        _suite_run(folder, suite, policy, [r for r in records if r.suite == suite], config, stored if one else None)
        for one in [len(suites) == 1]
        for suite in suites
    ]


def _suite_run(
    folder: Path,
    suite: str,
    policy: str,
    records: Sequence[Record],
    config: Mapping[str, Any],
    stored: Mapping[int, Mapping[str, Any]] | None,
) -> SuiteRun:
    texts = {record.task: record.instruction for record in records}
    conditions = config.get("conditions")
    summary = summarise(
        records,
        [record.key for record in records],
        suite=suite,
        policy=policy,
        instructions=[texts.get(task, "") for task in range(max(texts, default=-1) + 1)],
        conditions=conditions if isinstance(conditions, dict) else {},
    )
    return SuiteRun(
        folder=folder,
        suite=suite,
        policy=policy,
        records=tuple(records),
        summary=summary if stored is None else _with_missing(summary, stored),
        config=config,
        counted=stored is not None,
    )


def _stored_rows(folder: Path) -> dict[int, Mapping[str, Any]] | None:
    """The rows of ``summary.json`` by task, for which episodes were planned; None where they cannot be read."""
    counts = ("episodes", "errors", "missing")
    try:
        found: dict[int, Mapping[str, Any]] = {
            row["task"]: {"instruction": str(row["instruction"]), **{name: row[name] for name in counts}}
            for row in read_json(folder / SUMMARY)["tasks"]
        }
    except (OSError, KeyError, TypeError, StoreError):
        return None
    numbers = [*found, *(row[name] for row in found.values() for name in counts)]
    usable = all(type(number) is int and 0 <= number <= MOST_EPISODES for number in numbers)
    return found if usable else None


def _with_missing(summary: Summary, stored: Mapping[int, Mapping[str, Any]]) -> Summary:
    """Count the episodes that were planned and have no record."""
    rows = {row.task: row for row in summary.tasks}
    for task, planned in stored.items():
        count = planned["episodes"] + planned["errors"] + planned["missing"]
        row = rows.get(task) or _empty_row(task, planned["instruction"])
        rows[task] = replace(row, missing=max(0, count - row.episodes - row.errors))
    tasks = tuple(rows[task] for task in sorted(rows, key=int))
    return replace(summary, tasks=tasks, total=replace(summary.total, missing=sum(row.missing for row in tasks)))


def _empty_row(task: int, instruction: str) -> Row:
    zero = dict.fromkeys(("episodes", "successes", "first", "final", "faults", "errors", "missing"), 0)
    unknown = dict.fromkeys(("rate", "low", "high", "steps_to_solve"))
    return Row(task=task, instruction=instruction, **zero, **unknown)
