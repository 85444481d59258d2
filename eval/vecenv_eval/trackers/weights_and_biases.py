"""Weights & Biases: a run of the project ``vecenv`` (or ``WANDB_PROJECT``), its files in ``DIR/wandb``.

``WANDB_MODE=offline`` writes the files only; ``wandb sync`` uploads them later.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import wandb  # pyright: ignore[reportMissingImports]

from vecenv_eval.trackers import PROJECT, TrackedRun

# The horizontal axis of every chart: episodes that have ended.
_STEP = "ended"


class WandbTracker:
    """A run whose axis is the episodes that have ended; wandb's own steps could not go back on a resume."""

    def start(self, run: TrackedRun) -> None:
        """Begin the run, or continue it; what is printed is not captured."""
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT") or PROJECT,
            id=run.id,
            name=run.name,
            group=run.group or None,
            dir=str(run.folder),
            config=dict(run.config),
            resume="allow",
            settings=wandb.Settings(console="off"),
        )
        self._run.define_metric(_STEP)
        self._run.define_metric("*", step_metric=_STEP)

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Log numbers; wandb sends them from a process of its own."""
        self._run.log({**values, _STEP: step})

    def video(self, name: str, path: Path, step: int) -> None:
        """Log a copy of the file."""
        self._run.log({name: wandb.Video(str(path), caption=name, format="mp4"), _STEP: step})

    def summary(self, values: Mapping[str, float], text: str, step: int) -> None:
        """Put the final numbers into the run's summary, and the report into its notes."""
        self._run.summary.update(dict(values))
        self._run.notes = text

    def close(self, ok: bool) -> None:
        """End the run."""
        self._run.finish(exit_code=0 if ok else 1)
