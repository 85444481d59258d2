"""The results folder of a run whose episodes run in other processes: what arrived is written once.

Reports come in, possibly twice for an episode that ran twice. Every episode keeps its first verdict: a second one and a
later error change nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from vecenv_eval.engines.ray_actor import Report
from vecenv_eval.episodes import Episode
from vecenv_eval.results import POLICY_NAME, count
from vecenv_eval.runner import Evaluation
from vecenv_eval.sink import FolderSink
from vecenv_eval.store import Record, ResultStore
from vecenv_eval.store.files import replace_bytes


class Ledger:
    """Writes reports into a results folder.

    Args:
        store: the results folder.
        evaluation: what is evaluated.

    Attributes:
        causes: what failed, one line each, without repetition.
        verdicts: episodes of this run that have one.
        error_batches: reports of this run that were errors.
    """

    def __init__(self, store: ResultStore, evaluation: Evaluation) -> None:
        self.causes: dict[str, None] = {}
        self.verdicts = self.error_batches = 0
        self._store, self._sink = store, FolderSink(store, evaluation.config)
        self._planned, self._instructions = evaluation.planned, evaluation.suite.instructions
        wanted = frozenset(self._planned)
        self._records = {key: r for key, r in store.records().items() if key in wanted and not r.error}
        self._conditions: dict[str, Any] | None = None
        self._ended: list[Record] = []

    @property
    def missing(self) -> list[Episode]:
        """Planned episodes without a verdict, in order."""
        return [key for key in self._planned if key not in self._records or self._records[key].error]

    @property
    def counts(self) -> dict[str, int]:
        """The counts of :class:`~vecenv_eval.results.Progress`."""
        return {"total": len(self._planned), **count(self._records.values())}

    @property
    def conditions(self) -> Mapping[str, Any]:
        """What the episodes run under; empty until an environment was made."""
        return self._conditions or {}

    def take_ended(self) -> tuple[Record, ...]:
        """The records that were written since the last call."""
        ended, self._ended = tuple(self._ended), []
        return ended

    def receive(self, report: Report) -> None:
        """Write what a report brings that is not there yet."""
        if report.error:
            self._store.log_error(report.error)
        if report.conditions is not None and report.conditions != self._conditions:
            self._conditions = dict(report.conditions)
            self._sink.write_conditions(self._conditions)
        new = [record for record in report.records if self._is_new(record)]
        wanted = {record.key for record in new}
        # Recordings and videos are on the disk before their verdicts: what has a verdict is not run again.
        for demo in report.demos:
            chosen = [each for each in demo.recordings if Episode(demo.suite, demo.task, each.episode) in wanted]
            if chosen:
                self._sink.add_demos(demo.suite, demo.task, demo.instruction, chosen)
        if new:
            for name, content in report.files.items():
                path = self._store.folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                replace_bytes(path, content)
        self._append(new)
        for name, frame in report.live.items():
            with suppress(OSError):  # nothing depends on it
                self._sink.publish(name, frame)

    def fail(self, episode: Episode, cause: str, index: int, batch: int) -> None:
        """Write that an episode has no verdict, and why."""
        record = Record.of_error(episode, self._instructions[episode.task], cause, run=index, batch=batch)
        self._append([record] if self._is_new(record) else [])

    def note(self, cause: str) -> None:
        """Remember what failed, for the end."""
        self.causes[cause] = None

    def log_error(self, text: str) -> None:
        """Add a text to ``errors.log``."""
        self._store.log_error(text)

    def note_policy(self, name: str) -> None:
        """Remember the name of the policy."""
        content = self._store.config()
        if content.get(POLICY_NAME) != name:
            self._store.write_config({**content, POLICY_NAME: name})

    def _is_new(self, record: Record) -> bool:
        known = self._records.get(record.key)
        return known is None or bool(known.error)

    def _append(self, records: Sequence[Record]) -> None:
        if not records:
            return
        self._store.append(records)
        self._ended += records
        self._records.update({record.key: record for record in records})
        for record in records:
            if record.error:
                self.note(record.error)
        self.error_batches += any(record.error for record in records)
        self.verdicts += sum(not record.error for record in records)
