"""How fast an evaluation runs and when it will be done, for whoever shows or logs it.

The reports of a run come in (:class:`~vecenv_eval.results.Progress`); episodes and control steps a second, the success
rate so far and the seconds that are left go out. Time counts from the first report, setting up included.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from vecenv_eval.results import Progress


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Rates at one moment of a run.

    Attributes:
        success_rate: share of the episodes with a verdict that were solved, None without any.
        episodes_per_s: episodes that ended in this run a second, None before the first.
        steps_per_s: control steps a second, summed over slots, while episodes ran.
        seconds_left: until every episode has ended, if the rest is as fast; None before the first has.
    """

    success_rate: float | None
    episodes_per_s: float | None
    steps_per_s: float
    seconds_left: float | None


class Pace:
    """The rates of one run, or of several that follow each other.

    Args:
        clock: seconds, monotonic.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._begun: float | None = None
        self._ended = 0

    def update(self, now: Progress, waiting: int = 0) -> Rates:
        """Take in a report.

        Args:
            now: the report.
            waiting: episodes of runs that have not begun.
        """
        moment = self._clock()
        if self._begun is None:
            self._begun = moment
        self._ended += len(now.ended)
        seconds = moment - self._begun
        speed = self._ended / seconds if self._ended and seconds > 0 else None
        left = now.total - now.done - now.errors + waiting
        return Rates(
            success_rate=now.successes / now.done if now.done else None,
            episodes_per_s=speed,
            steps_per_s=now.steps / now.seconds if now.seconds else 0.0,
            seconds_left=None if speed is None else left / speed,
        )
