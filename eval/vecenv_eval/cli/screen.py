"""What ``vecenv eval`` shows people: bars on a terminal, a line from time to time elsewhere, tables at the end.

The same methods as :class:`~vecenv_eval.cli.json_lines.JsonLines` come in. A terminal or pipe that goes away ends the
output, not the evaluation.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from datetime import timedelta
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn
from rich.progress import Progress as Bars
from rich.text import Text

from vecenv_eval.campaign import CampaignSummary, Leg
from vecenv_eval.campaign import table as campaign_table
from vecenv_eval.pace import Pace, Rates
from vecenv_eval.report import STAND_INS, closing_line, sanitized_line, stand_in_lines, table
from vecenv_eval.results import resume_command

if TYPE_CHECKING:
    from vecenv_eval.config import EvalConfig
    from vecenv_eval.results import EvalResult, Progress

# Without a terminal a line is printed each time this share of the episodes has ended, or so many seconds have passed.
_SHARE, _SECONDS = 0.1, 60.0
_PER_SECOND = 4
_BAR_WIDTH = 16


class _OpenConsole(Console):
    """A console whose reader may go away: rich would end the process."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def _while_there(method: Callable[..., None]) -> Callable[..., None]:
    """Method that does nothing once the output is gone."""

    @wraps(method)
    def guarded(self: Screen, *arguments: Any) -> None:
        if self.gone:
            return
        try:
            method(self, *arguments)
        except (OSError, ValueError):
            self.gone = True

    return guarded


class Screen:
    """Prints for people.

    Args:
        stream: where to; standard output when not given.
        quiet: print nothing but the path of the results folder.
        console: used instead of one on the stream.
        clock: seconds, monotonic.

    Attributes:
        gone: the output cannot be written any more.
    """

    def __init__(
        self,
        stream: TextIO | None = None,
        *,
        quiet: bool = False,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.gone, self._quiet, self._clock = False, quiet, clock
        self._console = console or _OpenConsole(file=stream or sys.stdout, quiet=quiet)
        self._legs: list[Leg] = []
        self._waiting: list[int] = []
        self._pace = Pace(clock)
        self._view: _Live | _Lines | None = None

    @_while_there
    def begin(self, config: EvalConfig, folder: Path, legs: Sequence[Leg], num_episodes: Sequence[int]) -> None:
        """Settings were checked, the runs are about to begin."""
        self._legs, self._waiting = list(legs), list(num_episodes)
        if self._quiet:
            return
        names = [_name(leg) for leg in legs]
        kind = _Live if self._console.is_terminal else _Lines
        self._view = kind(self._console, names, num_episodes, self._clock)

    @_while_there
    def progress(self, leg: Leg, now: Progress) -> None:
        """A run reports."""
        if self._view is not None:
            index = self._legs.index(leg)
            self._view.update(index, now, self._pace.update(now, waiting=sum(self._waiting[index + 1 :])))

    @_while_there
    def result(self, leg: Leg, result: EvalResult) -> None:
        """A run has ended: print its table, and what went wrong."""
        if self._view is not None and leg is self._legs[-1]:
            self._view.close()
        if len(self._legs) > 1:
            self._console.print(_name(leg), style="bold", markup=False, highlight=False)
        print_result(self._console, result)

    @_while_there
    def campaign(self, summary: CampaignSummary) -> None:
        """All runs have ended."""
        self.close()
        self._console.print(campaign_table(summary))

    @_while_there
    def failed(self, message: str, status: int) -> None:
        """The command ends because something is wrong, which is said on standard error."""
        self.close()

    @_while_there
    def end(self, status: int, folder: Path) -> None:
        """The command ends."""
        self.close()
        print(folder, file=self._console.file, flush=True)

    @_while_there
    def close(self) -> None:
        """Stop the bars, which leaves the terminal as it was; closing twice is harmless."""
        if self._view is not None:
            self._view.close()


def print_result(console: Console, result: EvalResult) -> None:
    """Print how a run ended: its table, what is wrong, and how to go on."""
    summary = result.summary
    plain: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
    console.print(table(summary))
    console.print(closing_line(summary), highlight=False, soft_wrap=True)
    if summary.sanitized:
        console.print(sanitized_line(summary), style="yellow", **plain)
    if summary.stand_ins:
        console.print(f"{STAND_INS}:", style="yellow")
    for line in stand_in_lines(summary):
        console.print(line, **plain)
    for cause in result.causes:
        console.print(f"error that ended episodes: {cause}", style="red", **plain)
    if not result.ok:
        console.print(f"Episodes lack a verdict; to run them: {resume_command(result.folder)}", **plain)


class _Live:
    """Bars on a terminal: all runs, if there are several, and the one that runs, with a line about it."""

    def __init__(
        self, console: Console, names: Sequence[str], num_episodes: Sequence[int], clock: Callable[[], float]
    ) -> None:
        del clock  # rich has its own
        self._names, self._num_episodes = names, num_episodes
        columns = (
            TextColumn("{task.description}"),
            BarColumn(_BAR_WIDTH),
            MofNCompleteColumn(),
            TextColumn("{task.fields[said]}"),
        )
        self._bars = Bars(*columns, console=console)
        self._whole: TaskID | None = None
        if len(names) > 1:
            self._whole = self._bars.add_task(f"all {len(names)} runs", total=sum(num_episodes), said="")
        self._run = self._bars.add_task("starting", total=None, said="")
        self._about = Text("", style="dim")
        self._live = Live(Group(self._bars, self._about), console=console, refresh_per_second=_PER_SECOND)
        self._live.start()

    def update(self, index: int, now: Progress, rates: Rates) -> None:
        ended, left = now.done + now.errors, _time_left(rates)
        solved = _solved(rates)
        several = self._whole is not None
        which = f" ({index + 1}/{len(self._names)})" if several else ""
        self._bars.update(
            self._run,
            description=f"{self._names[index]}{which}",
            total=now.total,
            completed=ended,
            said=solved if several else ", ".join(filter(None, (solved, left))),
        )
        if self._whole is not None:
            before = sum(self._num_episodes[:index])
            self._bars.update(self._whole, completed=before + ended, said=left)
        self._about.plain = _about(now, rates)

    def close(self) -> None:
        self._live.stop()


class _Lines:
    """Progress for logs: a line per stream of episodes, per tenth of the episodes, and at least one a minute."""

    def __init__(
        self, console: Console, names: Sequence[str], num_episodes: Sequence[int], clock: Callable[[], float]
    ) -> None:
        self._console, self._names, self._clock = console, names, clock
        self._index, self._next, self._printed_at = -1, 0.0, clock()

    def update(self, index: int, now: Progress, rates: Rates) -> None:
        if index != self._index:
            self._index, self._next = index, _SHARE
        ended, moment = now.done + now.errors, self._clock()
        if now.setting_up or ended >= self._next * now.total or moment - self._printed_at >= _SECONDS:
            said = ", ".join(filter(None, (_about(now, rates), _solved(rates), _time_left(rates))))
            name = f"{self._names[index]}: " if len(self._names) > 1 else ""
            self._console.print(
                f"{name}{ended}/{now.total} episodes, {said}", highlight=False, markup=False, soft_wrap=True
            )
            self._next, self._printed_at = ended / max(1, now.total) + _SHARE, moment

    def close(self) -> None:
        pass


def _about(now: Progress, rates: Rates) -> str:
    """The stream that runs, what went wrong so far, and the speed."""
    stream = f"stream {now.batch + 1}/{now.num_batches}"
    problems = [f"{count} {what}" for count, what in ((now.faults, "faulted"), (now.errors, "in error")) if count]
    if now.setting_up:
        return ", ".join([f"{stream}: setting up", *problems])
    speed = [] if rates.episodes_per_s is None else [f"{rates.episodes_per_s:.3g} episodes/s"]
    return f"{stream}: " + ", ".join(
        [f"{now.successes} solved", *problems, *speed, f"{rates.steps_per_s:,.0f} steps/s"]
    )


def _solved(rates: Rates) -> str:
    return "" if rates.success_rate is None else f"{rates.success_rate:.1%} success"


def _time_left(rates: Rates) -> str:
    return "" if not rates.seconds_left else f"{timedelta(seconds=round(rates.seconds_left))} left"


def _name(leg: Leg) -> str:
    return leg.suite if leg.seed is None else f"{leg.suite}, seed {leg.seed}"
