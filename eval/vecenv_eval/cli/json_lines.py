"""``vecenv eval --json``: events as lines on standard output, and nothing else there.

What an evaluation reports comes in through the methods of :class:`JsonLines`; ``vecenv_eval.events`` has the schema.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TextIO

import vecenv
from vecenv_eval import events
from vecenv_eval.campaign import CampaignSummary, Leg
from vecenv_eval.config import EvalConfig
from vecenv_eval.pace import Pace, Rates
from vecenv_eval.results import EvalResult, Progress

# Progress is reported at most this often, seconds.
INTERVAL_S = 1.0


class JsonLines:
    """Writes events; a reader that goes away ends the writing, not the evaluation.

    Args:
        stream: where lines go.
        clock: seconds, monotonic.
    """

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream: TextIO | None = stream
        self._clock = clock
        self._pace = Pace(clock)
        self._folder: str | None = None
        self._leg: Leg | None = None
        self._last: tuple[Progress, Rates] | None = None  # a report that was not written yet
        self._written_at = float("-inf")
        self._told_conditions = False

    def begin(self, config: EvalConfig, folder: Path, legs: Sequence[Leg], num_episodes: Sequence[int]) -> None:
        """Settings were checked, the runs are about to begin."""
        self._folder = str(folder)
        runs = [
            events.Run(suite=leg.suite, seed=leg.seed, folder=str(leg.folder), episodes=count)
            for leg, count in zip(legs, num_episodes, strict=True)
        ]
        version = vecenv.__version__
        self._write(events.Start(version=version, folder=str(folder), config=config.to_dict(), runs=tuple(runs)))

    def progress(self, leg: Leg, now: Progress) -> None:
        """A run reports."""
        if leg is not self._leg:
            self._leg, self._pace, self._told_conditions = leg, Pace(self._clock), False
            self._written_at = float("-inf")
        if now.conditions and not self._told_conditions:
            self._told_conditions = True
            self._write(events.Conditions(suite=leg.suite, seed=leg.seed, conditions=now.conditions))
        for record in now.ended:
            self._write(events.EpisodeEvent(suite=leg.suite, seed=leg.seed, record=asdict(record)))
        self._last = now, self._pace.update(now)
        if self._clock() - self._written_at >= INTERVAL_S:
            self._write_progress(leg)

    def result(self, leg: Leg, result: EvalResult) -> None:
        """A run has ended."""
        self._write_progress(leg)
        for cause in result.causes:
            self._write(events.ErrorEvent(message=cause, suite=leg.suite, seed=leg.seed))
        self._write(
            events.SummaryEvent(
                suite=leg.suite,
                seed=leg.seed,
                folder=str(result.folder),
                complete=result.ok,
                interrupted=result.interrupted,
                summary=result.summary.to_dict(),
            )
        )

    def campaign(self, summary: CampaignSummary) -> None:
        """All runs have ended."""
        self._write(events.CampaignEvent(summary=asdict(summary)))

    def failed(self, message: str, status: int) -> None:
        """The command ends because something is wrong; the message, where there is one, is an event of its own."""
        if message:
            self._write(events.ErrorEvent(message=message))
        self._write(events.End(status=status, folder=self._folder))

    def end(self, status: int, folder: Path) -> None:
        """The command ends."""
        self._write(events.End(status=status, folder=str(folder)))

    def _write_progress(self, leg: Leg) -> None:
        if self._last is None:
            return
        (now, rates), self._last = self._last, None
        self._written_at = self._clock()
        self._write(
            events.ProgressEvent(
                suite=leg.suite,
                seed=leg.seed,
                total=now.total,
                done=now.done,
                successes=now.successes,
                faults=now.faults,
                errors=now.errors,
                **asdict(rates),
                stream=now.batch + 1,
                num_streams=now.num_batches,
                setting_up=now.setting_up,
            )
        )

    def _write(self, event: events.Event) -> None:
        if self._stream is None:
            return
        try:
            self._stream.write(event.line() + "\n")
            self._stream.flush()
        except (OSError, ValueError):  # whoever read them is gone, or the disk is full
            self._stream = None


@contextmanager
def own_stdout() -> Iterator[TextIO]:
    """Standard output for the caller alone; what others write there, C libraries too, goes to standard error."""
    out = sys.stdout
    out.flush()
    with ExitStack() as stack:
        stack.enter_context(redirect_stdout(sys.stderr))
        try:
            number, error = out.fileno(), sys.stderr.fileno()
        except (OSError, ValueError):  # not a file: a test's, or a notebook's
            yield out
            return
        own = os.dup(number)
        stream = os.fdopen(own, "w", encoding="utf-8")
        os.dup2(error, number)
        try:
            yield stream
        finally:
            os.dup2(own, number)
            with suppress(OSError):  # nobody reads it any more
                stream.close()
