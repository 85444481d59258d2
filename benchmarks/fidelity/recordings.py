"""What native MuJoCo did in the episodes of a suite: actions, verdicts and where objects were, one file a suite."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

# Ticks of holding still after the recorded end: time for a late verdict, and how much is kept of a failed end.
GRACE = 20


class RecordingError(RuntimeError):
    """A recording is missing, or does not belong to the scenes it is compared with."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What native MuJoCo did in N episodes of a suite; positions are those of movable objects, metres, world frame.

    Attributes:
        suite: the suite.
        task, episode: which start, int [N].
        length: control ticks of the episode, int [N].
        success: whether it ended solved, bool [N].
        actions: the actions of all episodes, one episode after the other, float32 [sum of lengths, 7].
        start: positions at the start, [N, M, 3], NaN past a scene's last object.
        settled: after 50 idle ticks from the start, [N, M, 3].
        end: at the end of the episode, [N, M, 3].
        notes: how it was recorded.
    """

    suite: str
    task: np.ndarray
    episode: np.ndarray
    length: np.ndarray
    success: np.ndarray
    actions: np.ndarray
    start: np.ndarray
    settled: np.ndarray
    end: np.ndarray
    notes: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write it, compressed."""
        arrays = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        text = json.dumps({"suite": self.suite, "notes": self.notes})
        np.savez_compressed(path, about=np.array(text), **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, folder: Path, suite: str) -> Recording:
        """Read the recording of a suite; raises `RecordingError`."""
        path = recording_path(folder, suite)
        if not path.is_file():
            raise RecordingError(f"{path}: no such file; `mjx_fidelity.py record --suite {suite}` writes it")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays.pop("about")))
        return cls(suite=about["suite"], notes=about["notes"], **arrays)

    def played(self, row: int) -> np.ndarray:
        """Actions of one episode, [K, 7]."""
        first = int(self.length[:row].sum())
        return self.actions[first : first + self.length[row]]

    def within(self, ticks: int) -> Recording:
        """The same episodes, ended after so many ticks at most: what was solved later is not solved."""
        late = self.length > ticks
        return replace(
            self,
            length=np.minimum(self.length, ticks),
            success=self.success & ~late,
            actions=np.concatenate([self.played(row)[:ticks] for row in range(len(self.task))]),
            end=np.where(late[:, None, None], np.nan, self.end),
        )

    def rows(self, tasks: Sequence[int], limit: int | None = None) -> np.ndarray:
        """Rows of these tasks, task by task, at most so many each."""
        return np.concatenate([np.flatnonzero(self.task == task)[:limit] for task in tasks])


def recording_path(folder: Path, suite: str) -> Path:
    """Where a suite's recording lies."""
    return folder / f"{suite}.npz"


def joined(parts: Sequence[Recording]) -> Recording:
    """The recordings of a suite's scenes as one."""
    widest = max(part.start.shape[1] for part in parts)

    def join(name: str) -> np.ndarray:
        arrays = [getattr(part, name) for part in parts]
        return np.concatenate([widened(a, widest) if a.ndim == 3 else a for a in arrays])

    names = [name for name, value in vars(parts[0]).items() if isinstance(value, np.ndarray)]
    return Recording(suite=parts[0].suite, notes=parts[0].notes, **{name: join(name) for name in names})


def widened(positions: np.ndarray, objects: int) -> np.ndarray:
    """Positions [N, m, 3] with NaN up to so many objects."""
    missing = objects - positions.shape[1]
    return np.pad(positions, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)


def kept_length(actions: np.ndarray, grace: int = GRACE) -> int:
    """How many of the actions [K, 7] of a failed episode to keep: not the same last one again and again."""
    differs = np.flatnonzero((actions != actions[-1]).any(axis=1))
    first_of_last = 0 if not len(differs) else int(differs[-1]) + 1
    return min(len(actions), first_of_last + grace)
