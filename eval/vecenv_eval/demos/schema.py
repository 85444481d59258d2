"""What a demonstration file holds, as dataclasses: demonstrations as they are read, recordings as they are written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from vecenv_eval.demos.reader import READER
from vecenv_eval.episodes import Episode

SUFFIXES = (".hdf5", ".h5")

# Position [3] in metres and quaternion wxyz [4], world frame.
Pose: TypeAlias = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class StoredStart:
    """A demonstration that begins in a stored state.

    Attributes:
        state: time (seconds), qpos, qvel, float64 [1 + nq + nv].
        fixtures: name -> (position [3] in metres, quaternion wxyz [4]), world frame; None where the file has no MJCF.
    """

    state: np.ndarray
    fixtures: Mapping[str, Pose] | None


@dataclass(frozen=True, kw_only=True)
class MadeStart:
    """A demonstration that begins where ``vecenv.make`` puts an episode.

    Attributes:
        episode: index of the episode.
        options: keyword arguments of ``vecenv.make``, see ``make_options``.
    """

    episode: int
    options: Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class Demo:
    """One recorded sequence of actions.

    Attributes:
        path, name: the file, and the demonstration's name in it.
        suite, task: what it is a demonstration of.
        start: where it begins.
        actions: float64 [T, 7], finite.
        success: the verdict on record, None where there is none.
        second_half: of a SIMPLER task in two halves, whether each action belongs to the second, bool [T]; else None.
        stand_ins: what missing files were replaced by when it was recorded; None where that is not on record.
    """

    path: Path
    name: str
    suite: str
    task: int
    start: StoredStart | MadeStart
    actions: np.ndarray
    success: bool | None
    second_half: np.ndarray | None = None
    stand_ins: tuple[str, ...] | None = None

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def number(self) -> int:
        """The episode on record; else the demonstration's number in its file."""
        if isinstance(self.start, MadeStart):
            return self.start.episode
        return int("".join(filter(str.isdecimal, self.name)))

    @property
    def key(self) -> Episode:
        """Which episode it is."""
        return Episode(self.suite, self.task, self.number)

    def recorded_state(self, ticks: int) -> np.ndarray | None:
        """The state on record after so many ticks: time, qpos, qvel, [1 + nq + nv]; None where there is none.

        Raises:
            DemoError: it is there and cannot be read, or is not finite.
        """
        answer = READER.ask(self.path, "state", name=self.name, ticks=ticks, length=len(self))
        return None if answer.content["state"] is None else answer.arrays[answer.content["state"]]


@dataclass(frozen=True, kw_only=True)
class Recording:
    """One episode of our own, ready to be written.

    Attributes:
        episode: index of the episode.
        success: its verdict.
        fault: why its physics failed, "" when it did not.
        actions: what was executed, [T, 7].
        init_state, final_state: before the first and after the last action, [1 + nq + nv].
        states: before each action, [T, 1 + nq + nv], or None.
        second_half: of a SIMPLER task in two halves, whether each action belongs to the second, bool [T]; None where
            none does.
        options: keyword arguments of ``vecenv.make``, see ``make_options``; plain JSON types.
        instruction: what the policy was told.
        labels: what else identifies the episode, such as its protocol; for readers.
        stand_ins: what missing files were replaced by.
    """

    episode: int
    success: bool
    fault: str
    actions: np.ndarray
    init_state: np.ndarray
    final_state: np.ndarray
    states: np.ndarray | None = None
    second_half: np.ndarray | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    instruction: str = ""
    labels: Mapping[str, str | int] = field(default_factory=dict)
    stand_ins: tuple[str, ...] = ()
