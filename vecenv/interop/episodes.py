"""Batches whose slots begin and end episodes independently of each other, as Gymnasium's sub-environments do.

In: a batch and the episodes its slots go through. Out: starts, ticks, and what the infos say about them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

import vecenv
from vecenv import placement
from vecenv.contract import Control
from vecenv.interop.observing import Batch, GymnasiumError, Observer

EpisodeChoice: TypeAlias = "str | Iterable[int] | Mapping[int, str | Iterable[int]] | None"
"""Episodes as ``vecenv.make`` takes them: for all tasks, or task -> episodes; None for the usual ones."""


class Rotation:
    """Which episode of a task a slot plays next.

    Args:
        pool: the episodes.
        first: the one to begin with.
    """

    def __init__(self, pool: Sequence[int], first: int) -> None:
        start = list(pool).index(first) if first in pool else 0
        self._order, self._rng = [*pool[start:], *pool[:start]], None
        self._coming: list[int] = []

    def seed(self, rng: np.random.Generator) -> None:
        """Begin anew, in orders drawn from ``rng``."""
        self._rng, self._coming = rng, []

    def next(self) -> int:
        """The next episode."""
        if not self._coming:
            order = self._order if self._rng is None else self._rng.permutation(sorted(self._order))
            self._coming = [int(episode) for episode in order]
        return self._coming.pop(0)


class EpisodeSlots:
    """A batch whose slots begin and end episodes independently of each other.

    Args:
        env: the batch.
        episodes: those to go through, for all tasks or by task; None for those that were placed.
        obs, cameras: see ``Observer``.
    """

    def __init__(
        self,
        env: Batch,
        episodes: EpisodeChoice,
        obs: str | Sequence[str] | None,
        cameras: Sequence[str] | None = None,
    ) -> None:
        self.env, self.observe = env, Observer(env, obs, cameras)
        placed = env.placement
        self._rotations = [
            Rotation(_pool(env, int(task), episodes), int(first))
            for task, first in zip(placed.task, placed.episode, strict=True)
        ]

    def seed(self, slot: int, rng: np.random.Generator) -> None:
        """Let ``rng`` decide in which order a slot plays its episodes."""
        self._rotations[slot].seed(rng)

    def begin(self, mask: np.ndarray, episode: npt.ArrayLike | None = None) -> dict[str, np.ndarray]:
        """Begin the next or the given episode in some slots; the others continue. Returns their infos."""
        slots = np.flatnonzero(mask)
        chosen = self._next(slots) if episode is None else self._given(episode)[slots].tolist()
        self.env.set_episodes(episodes=chosen, slots=slots)
        info = self.env.reset()
        return {"episode_id": np.array(info.episode_id, object), "instruction": np.array(info.instruction, object)}

    def _next(self, slots: np.ndarray) -> list[int]:
        return [self._rotations[slot].next() for slot in slots]

    def _given(self, episode: npt.ArrayLike) -> np.ndarray:
        placed, counts = self.env.placement, num_episodes(self.env.suite, _protocol(self.env))
        chosen = placement.each(None, episode, placed, num_tasks=len(counts), num_episodes=max(counts))
        for task, wanted in zip(placed.task, chosen.episode, strict=True):
            last = counts[int(task)] - 1
            if wanted > last:
                raise placement.PlacementError(f"episode {wanted} of task {task} does not exist; there are 0 to {last}")
        return chosen.episode

    def step(self, actions: npt.ArrayLike) -> tuple[Control, dict[str, np.ndarray]]:
        """One tick; finished slots ignore it. Returns its infos as well."""
        control = self.env.step_continuous(actions)
        return control, {
            "success": control.success,
            "is_success": control.success.copy(),
            "step_index": control.step_index,
            "sanitized": control.info["sanitized"],
            "fault": np.array(control.info["fault"], object),
        }


def num_episodes(suite: str, protocol: str) -> tuple[int, ...]:
    """How many episodes each task of a suite has: in LIBERO its stored starts, in SIMPLER what the protocol lists."""
    tasks = len(vecenv.list_tasks(suite))
    if vecenv.family(suite) == "libero":
        from vecenv.libero.tasks.suites import NUM_EPISODES

        return (NUM_EPISODES,) * tasks
    counts = vecenv.eval_metadata(suite, protocol)["episodes_per_task"]
    return (counts,) * tasks if isinstance(counts, int) else tuple(int(count) for count in counts)


def check_options(options: Mapping[str, Any] | None, known: tuple[str, ...]) -> Mapping[str, Any]:
    """Options of ``reset``.

    Raises:
        GymnasiumError: one that does not exist.
    """
    for name in options or {}:
        if name not in known:
            raise GymnasiumError(f"reset option {name!r} does not exist; options: {', '.join(known)}")
    return options or {}


def _protocol(env: Batch) -> str:
    return env.config.protocol


def _pool(env: Batch, task: int, episodes: EpisodeChoice) -> list[int]:
    """Episodes of one task."""
    placed = env.placement
    if episodes is None:
        return list(dict.fromkeys(placed.episode[placed.task == task].tolist()))
    counts = dict(enumerate(num_episodes(env.suite, _protocol(env))))
    return placement.cross(task, episodes, num_tasks=len(counts), num_episodes=counts).episode.tolist()
