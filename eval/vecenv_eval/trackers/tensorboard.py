"""TensorBoard: event files in the results folder, ``DIR/tensorboard``; a resumed run adds a file to them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from tensorboardX import SummaryWriter

from vecenv_eval.trackers import TrackedRun

FOLDER = "tensorboard"


class TensorBoardTracker:
    """Writes scalars and texts with tensorboardX; TensorBoard shows no mp4, so videos are left out."""

    def start(self, run: TrackedRun) -> None:
        """Open an event file, and write the settings as text."""
        self._writer = SummaryWriter(logdir=str(run.folder / FOLDER))
        settings = json.dumps(dict(run.config), indent=4, default=str)
        self._writer.add_text("config", "\n".join(f"    {line}" for line in settings.splitlines()))

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Write scalars, on the disk when this returns."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()

    def video(self, name: str, path: Path, step: int) -> None:
        """Do nothing."""

    def summary(self, values: Mapping[str, float], text: str, step: int) -> None:
        """Write the final scalars and the report."""
        self._writer.add_text("report", text, step)
        self.log(values, step)

    def close(self, ok: bool) -> None:
        """Close the event file."""
        self._writer.close()
