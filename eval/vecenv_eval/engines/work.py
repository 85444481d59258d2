"""The episodes that wait for workers, and which of them a worker gets next.

Episodes come in; :meth:`WorkQueue.take` gives a worker a unit of one scene's episodes. A worker stays with the scene it
holds while episodes of it wait, then takes part of what another scene still has. Units shrink as the queue empties, so
that all workers finish at about the same time.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Hashable, Iterable

from vecenv_eval.episodes import Episode, Suite

# Each worker gets about this many units of the episodes that wait.
_UNITS_PER_WORKER = 2


class WorkQueue:
    """Episodes that wait, by scene.

    Args:
        suite: the suite, for which tasks share a scene.
        episodes: what is to run.
        workers: how many workers take units.
        unit: episodes of a unit; None for a share of those that wait.
        shrink: whether that share is taken again for every unit, or once for all. Environments whose build takes
            minutes keep their size instead.
    """

    def __init__(
        self, suite: Suite, episodes: Iterable[Episode], *, workers: int, unit: int | None = None, shrink: bool = True
    ) -> None:
        self._suite, self._workers = suite, max(1, workers)
        self._waiting: dict[Hashable, deque[Episode]] = {}
        self._alone: deque[Episode] = deque()
        for episode in episodes:
            self._waiting.setdefault(self.scene_of(episode), deque()).append(episode)
        self._unit = unit if unit is not None or shrink else self._share()

    def __len__(self) -> int:
        return len(self._alone) + sum(map(len, self._waiting.values()))

    def scene_of(self, episode: Episode) -> Hashable:
        """The scene of an episode."""
        return self._suite.scenes[episode.task]

    @property
    def units(self) -> int:
        """About how many units the episodes that wait are."""
        size = self._unit or self._share()
        return len(self._alone) + sum(-(-len(episodes) // size) for episodes in self._waiting.values())

    def take(self, scene: Hashable | None = None, held: Collection[Hashable] = ()) -> tuple[Episode, ...]:
        """The next unit: episodes of one scene; none when nothing waits.

        Args:
            scene: the scene that the worker holds, None for none.
            held: the scenes that the other workers hold, one entry a worker.
        """
        waiting = {each: len(episodes) for each, episodes in self._waiting.items() if episodes}
        if not waiting:
            return (self._alone.popleft(),) if self._alone else ()
        if scene is None or scene not in waiting:
            holders = Counter(held)
            scene = max(waiting, key=lambda each: waiting[each] / (1 + holders[each]))
        queue = self._waiting[scene]
        return tuple(queue.popleft() for _ in range(self._even(len(queue))))

    def put_back(self, episodes: Collection[Episode]) -> None:
        """Episodes of a unit that did not run: they are the next of their scene."""
        for episode in reversed(list(episodes)):
            self._waiting.setdefault(self.scene_of(episode), deque()).appendleft(episode)

    def put_alone(self, episode: Episode) -> None:
        """An episode that is to be a unit of its own, after the others."""
        self._alone.append(episode)

    def _share(self) -> int:
        return max(1, -(-len(self) // (_UNITS_PER_WORKER * self._workers)))

    def _even(self, count: int) -> int:
        """The size of the next unit of a scene, of which ``count`` episodes wait: all units of it about alike."""
        return -(-count // -(-count // (self._unit or self._share())))
