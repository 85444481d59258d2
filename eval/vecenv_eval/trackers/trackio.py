"""Trackio: a local database (``TRACKIO_DIR``), or wherever its own environment variables send the numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import trackio

from vecenv_eval.trackers import PROJECT, TrackedRun

# Runs are found again by their name, so it carries this many digits of the id.
_DIGITS = 8


class TrackioTracker:
    """A run of the project ``vecenv``."""

    def start(self, run: TrackedRun) -> None:
        """Begin the run, or continue it; the machine itself is not measured."""
        self._run = trackio.init(
            project=PROJECT,
            name=f"{run.name}-{run.id[:_DIGITS]}",
            group=run.group or None,
            config=dict(run.config),
            resume="allow",
            embed=False,
            auto_log_gpu=False,
            auto_log_cpu=False,
        )

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log numbers; trackio writes them from a thread of its own."""
        self._run.log(dict(values), step=step)

    def video(self, name: str, path: Path, step: int) -> None:
        """Log a copy of the file."""
        self._run.log({name: trackio.Video(path, caption=name)}, step=step)

    def summary(self, values: Mapping[str, float], text: str, step: int) -> None:
        """Log the final numbers and the report."""
        self._run.log({**values, "report": trackio.Markdown(text)}, step=step)

    def close(self, ok: bool) -> None:
        """Wait until everything is written."""
        trackio.finish()  # not the run's own method: at the exit of the process it would be finished again
