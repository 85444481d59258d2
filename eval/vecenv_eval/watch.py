"""Recording episodes while they run: what an episode recorder is, and how it sees every control tick.

An environment that runs and some recorders come in. :func:`watching` calls ``observe`` of each recorder before every
tick of every live slot, whichever verb moves it; whoever runs the episodes calls ``begin`` and ``finish`` around each
episode and ``close`` at the end. ``video.episodes``, ``datasets.lerobot`` and ``demos.record`` have recorders.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vecenv.contract import BatchEnv
from vecenv.observations import Egocentric
from vecenv_eval.episodes import Episode
from vecenv_eval.store import Record


class Observable(Protocol):
    """The part of an environment that shows a tick to recorders."""

    @property
    def control_hz(self) -> float:
        """Control ticks a second."""
        ...

    def observe_egocentric(self, slots: npt.ArrayLike | None = None) -> Egocentric:
        """Cameras and proprioception; images of ``slots`` only, if given."""
        ...


class EpisodeRecorder(Protocol):
    """Sees episodes begin, every tick of the slots that run, and the record of each episode that ends."""

    def begin(self, env: BatchEnv, episodes: Mapping[int, Episode]) -> None:
        """Episodes have begun in some slots, which were just reset.

        What was observed in these slots of an episode that never finished is dropped.

        Args:
            env: the environment.
            episodes: the episode in each of the slots that begin.
        """
        ...

    def observe(self, env: Observable, slots: Sequence[int], actions: np.ndarray) -> None:
        """See one tick before it happens.

        Args:
            env: the environment.
            slots: the slots that move in this tick.
            actions: what is executed, [B, 7].
        """
        ...

    def finish(self, env: BatchEnv, records: Mapping[int, Record]) -> None:
        """Episodes have ended. A slot whose beginning was not seen is passed over.

        Args:
            env: the environment, in which these slots still show the end.
            records: how the episode in each of the slots ended.
        """
        ...

    def close(self) -> None:
        """The run is over; episodes that have not finished are dropped. Closing twice is harmless."""
        ...


@contextmanager
def watching(env: BatchEnv, recorders: Sequence[EpisodeRecorder]) -> Iterator[None]:
    """Let recorders observe every tick inside the context; images are rendered once a tick for all of them."""

    def observe(actions: np.ndarray, active: np.ndarray) -> None:
        slots = np.flatnonzero(active).tolist()
        shared = _OneTick(env, slots)
        for recorder in recorders:
            recorder.observe(shared, slots, actions)

    if not recorders:
        yield
        return
    with env.watched(observe):
        yield


class _OneTick:
    """An environment as it stands at one tick: the slots that move are observed once, however many watchers look."""

    def __init__(self, env: Observable, slots: Sequence[int]) -> None:
        self._env, self._slots = env, slots

    @property
    def control_hz(self) -> float:
        return self._env.control_hz

    def observe_egocentric(self, slots: npt.ArrayLike | None = None) -> Egocentric:
        return self._seen

    @cached_property
    def _seen(self) -> Egocentric:
        return self._env.observe_egocentric(self._slots)
