"""Experiment trackers: what ``--track wandb``, ``trackio`` and ``tensorboard`` log while an evaluation runs.

The reports of a run come in; :class:`Tracking` turns them into a few numbers now and then and hands them to each
:class:`Tracker` that was asked for. A tracker writes beside the results and decides nothing: one that cannot start, or
fails later, costs a warning in the log, after which it is no longer called.
"""

from __future__ import annotations

import importlib
import logging
import sys
import time
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

from vecenv.util.extras import how_to_install, is_installed
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.episodes import Episode
from vecenv_eval.pace import Pace
from vecenv_eval.report import markdown
from vecenv_eval.results import EvalResult, Progress, campaign_of
from vecenv_eval.store import Record, ResultStore
from vecenv_eval.video.episodes import video_path

# The class behind each of ``config.TRACKERS``, and the module it needs.
_KINDS = {
    "tensorboard": ("vecenv_eval.trackers.tensorboard:TensorBoardTracker", "tensorboardX"),
    "trackio": ("vecenv_eval.trackers.trackio:TrackioTracker", "trackio"),
    "wandb": ("vecenv_eval.trackers.weights_and_biases:WandbTracker", "wandb"),
}
PROJECT = "vecenv"
# Numbers are logged at most this often, seconds.
INTERVAL_S = 2.0
# Most videos of failures of one run that are handed on.
MOST_VIDEOS = 20
# Key of ``config.json``: by it a resumed run is found again.
TRACKING_ID = "tracking_id"
_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TrackedRun:
    """What a tracker is told about a run when it starts.

    Attributes:
        folder: the results folder.
        name: for people.
        id: the same whenever the folder is resumed, 32 hexadecimal digits.
        group: name of the campaign it belongs to, "" for none.
        config: settings and conditions, plain values.
    """

    folder: Path
    name: str
    id: str
    group: str
    config: Mapping[str, Any]


class Tracker(Protocol):
    """Where numbers go. Whatever a method raises ends the tracking, not the run."""

    def start(self, run: TrackedRun) -> None:
        """Begin a run, or continue the one with this id."""
        ...

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log numbers by name; ``step`` is how many episodes have ended."""
        ...

    def video(self, name: str, path: Path, step: int) -> None:
        """Log the mp4 of an episode; a tracker that takes none ignores it."""
        ...

    def summary(self, values: Mapping[str, float], text: str, step: int) -> None:
        """Log the final numbers, and the report as Markdown."""
        ...

    def close(self, ok: bool) -> None:
        """End the run; ``ok`` if every episode has a verdict."""
        ...


def require(names: Sequence[str]) -> None:
    """Refuse trackers whose package is not installed.

    Raises:
        ConfigError: names the package and how to install it.
    """
    for name in names:
        _, module = _KINDS[name]
        if not is_installed(module):
            raise ConfigError(f"--track {name}: {how_to_install(module)}")


def make_tracker(name: str) -> Tracker:
    """The tracker called ``name``, one of ``config.TRACKERS``; its package is imported."""
    module, _, attribute = _KINDS[name][0].partition(":")
    return getattr(importlib.import_module(module), attribute)()


class Tracking:
    """The trackers of one run; used as a context, which ends their runs.

    They start with the first report that is not of setting up, when the conditions are known, so that a run that is
    refused leaves nothing behind.

    Args:
        config: what is evaluated; ``config.trackers`` are used.
        store: the results folder.
        clock: seconds, monotonic.
    """

    def __init__(self, config: EvalConfig, store: ResultStore, clock: Callable[[], float] = time.monotonic) -> None:
        self._config, self._store, self._clock = config, store, clock
        self._pace = Pace(clock)
        self._trackers: dict[str, Tracker] = {}
        self._records: dict[Episode, Record] = {}
        self._ended: list[Record] = []
        self._started = self._ok = False
        self._logged_at = float("-inf")
        self._videos = self._step = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._each(lambda tracker: tracker.close(self._ok))

    def progress(self, now: Progress) -> None:
        """Take in a report; numbers are logged when episodes have ended, but not more often than ``INTERVAL_S``."""
        if not self._config.trackers or (now.setting_up and not now.ended):
            return
        self._start(now.conditions)
        rates = self._pace.update(now)
        self._records.update({record.key: record for record in now.ended})
        self._ended += now.ended
        self._step = now.done + now.errors
        self._log_videos(now.ended)
        moment = self._clock()
        if now.ended and (moment - self._logged_at >= INTERVAL_S or self._step == now.total):
            self._logged_at = moment
            counts = {"episodes": now.done, "successes": now.successes, "faults": now.faults, "errors": now.errors}
            speed = {"episodes_per_s": rates.episodes_per_s, "steps_per_s": rates.steps_per_s}
            values = counts | speed | _success(self._records.values()) | _seconds(self._ended)
            found = {name: float(value) for name, value in values.items() if value is not None}
            self._each(lambda tracker: tracker.log(found, self._step))

    def end(self, result: EvalResult) -> None:
        """The run has ended: log the final numbers."""
        if not self._config.trackers:
            return
        self._start(result.summary.conditions)
        self._ok = result.ok
        total, summary = result.summary.total, result.summary
        names = ("rate", "low", "high", "steps_to_solve", "episodes", "successes", "faults", "errors", "missing")
        values = {f"final/{name}": getattr(total, name) for name in names}
        values |= {f"final/{name}": getattr(summary, name) for name in ("wall_s", "setup_s", "steps", "steps_per_s")}
        found = {name: float(value) for name, value in values.items() if value is not None}
        text = markdown(summary)
        self._each(lambda tracker: tracker.summary(found, text, self._step))

    def _start(self, conditions: Mapping[str, Any]) -> None:
        if self._started:
            return
        self._started = True
        self._records = self._store.records()
        self._step = len(self._records)
        run = self._run(conditions)
        for name in self._config.trackers:
            try:
                self._trackers[name] = make_tracker(name)
            except Exception as error:  # whatever importing a package raises
                _stopped(name, error)
        self._each(lambda tracker: tracker.start(run))

    def _run(self, conditions: Mapping[str, Any]) -> TrackedRun:
        content = self._store.config()
        if TRACKING_ID not in content:
            content = {**content, TRACKING_ID: uuid.uuid4().hex}
            self._store.write_config(content)
        folder = self._store.folder.resolve()
        campaign = campaign_of(folder)
        return TrackedRun(
            folder=folder,
            name=folder.name if campaign is None else f"{campaign.name}/{folder.relative_to(campaign)}",
            id=content[TRACKING_ID],
            group="" if campaign is None else campaign.name,
            config={**self._config.to_dict(), "conditions": dict(conditions)},
        )

    def _log_videos(self, ended: Sequence[Record]) -> None:
        for record in ended:
            path = video_path(self._store.folder, record.key)
            if self._videos < MOST_VIDEOS and not record.success and path.exists():
                self._videos += 1
                name = f"failure/{record.task}/{record.episode}"
                self._each(lambda tracker, name=name, path=path: tracker.video(name, path, self._step))

    def _each(self, call: Callable[[Tracker], None]) -> None:
        """Call every tracker; one that raises is dropped. What they print goes to standard error."""
        for name, tracker in list(self._trackers.items()):
            try:
                with redirect_stdout(sys.stderr):
                    call(tracker)
            except Exception as error:  # whatever a tracker raises must not cost an episode
                del self._trackers[name]
                _stopped(name, error)


def _stopped(name: str, error: Exception) -> None:
    cause = " ".join(f"{type(error).__name__}: {error}".split())
    _log.warning("tracking with %s has stopped, the evaluation goes on: %s", name, cause)


def _success(records: Iterable[Record]) -> dict[str, float]:
    """Success rates so far: of all episodes, of each task and of each suite."""
    counts: dict[str, list[bool]] = {}
    for record in records:
        if not record.error:
            for name in ("", f"task/{record.task}/", f"suite/{record.suite}/"):
                counts.setdefault(f"{name}success_rate", []).append(record.success)
    return {name: sum(verdicts) / len(verdicts) for name, verdicts in counts.items()}


def _seconds(ended: Sequence[Record]) -> dict[str, float]:
    """Mean seconds an episode of this run took in the policy, in physics and in rendering."""
    verdicts = [record for record in ended if not record.error]
    names = ("policy_s", "physics_s", "images_s")
    return {f"time/{name}": sum(getattr(r, name) for r in verdicts) / len(verdicts) for name in names if verdicts}
