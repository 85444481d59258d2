"""Watching episodes while they run: what a watcher is, and how it sees every control tick.

An environment that runs and some watchers come in. :func:`watching` calls ``observe`` of each watcher before every tick
of every live slot, whichever verb moves it; whoever runs the episodes calls ``finish`` with each record and ``close``
at the end. ``video.episodes`` and ``datasets.lerobot`` have watchers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from vecenv.contract import BatchEnv
from vecenv.observations import Egocentric
from vecenv_eval.store import Record


class Observable(Protocol):
    """The part of an environment that watchers use."""

    @property
    def control_hz(self) -> float:
        """Control ticks a second."""
        ...

    def observe_egocentric(self, slots: npt.ArrayLike | None = None) -> Egocentric:
        """Cameras and proprioception; images of ``slots`` only, if given."""
        ...


class EpisodeWatcher(Protocol):
    """Sees every tick of the slots that run, and the record of each episode that ends."""

    def observe(self, env: Observable, slots: Sequence[int], actions: np.ndarray) -> None:
        """See one tick before it happens.

        Args:
            env: the environment.
            slots: the slots that move in this tick.
            actions: what is executed, [B, 7].
        """
        ...

    def finish(self, slot: int, record: Record) -> None:
        """The episode in a slot has ended; what is observed there next belongs to another one."""
        ...

    def close(self) -> None:
        """The run is over; episodes that have not finished are dropped. Closing twice is harmless."""
        ...


@contextmanager
def watching(env: BatchEnv, watchers: Sequence[EpisodeWatcher]) -> Iterator[None]:
    """Let watchers observe every tick inside the context; images are rendered once a tick for all of them."""

    def observe(actions: np.ndarray, active: np.ndarray) -> None:
        slots = np.flatnonzero(active).tolist()
        shared = _OneTick(env, slots)
        for watcher in watchers:
            watcher.observe(shared, slots, actions)

    if not watchers:
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
