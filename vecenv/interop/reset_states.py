"""The order in which RLinf's LIBERO environment goes through the episodes of a suite, for the same seeds.

In: tasks, seed, rank. Out: ids of reset states; id ``i`` is episode ``i % 50`` of task ``i // 50``. Follows
``rlinf/envs/libero/libero_env.py`` of RLinf a3816b5: training draws at random, or goes through shuffled ids; evaluation
goes through all ids once, first episode of each task first, spread over the processes one by one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vecenv.errors import InvalidInput
from vecenv.libero.tasks.suites import NUM_EPISODES


class ResetStateError(InvalidInput):
    """A task or reset state that does not exist; the message says which there are."""


class ResetStates:
    """Ids of reset states in RLinf's order.

    Args:
        num_tasks: tasks of the suite.
        tasks: those to go through; None for all.
        only: the one id there is; None for all.
        seed: of random draws.
        rank: of this process among ``processes``.
        processes: over which ids are spread.
        evaluating: whether every id comes once, and -1 after the last.
        ordered: whether training goes through shuffled ids instead of drawing at random.

    Raises:
        ResetStateError: a task or id that does not exist.

    Attributes:
        total: how many ids there are, those of tasks left out included.
    """

    def __init__(
        self,
        *,
        num_tasks: int,
        tasks: Sequence[int] | None = None,
        only: int | None = None,
        seed: int = 0,
        rank: int = 0,
        processes: int = 1,
        evaluating: bool = False,
        ordered: bool = False,
    ) -> None:
        self.total = num_tasks * NUM_EPISODES
        self._only, self._rank, self._processes = only, rank, processes
        self._evaluating, self._ordered = evaluating, ordered or evaluating
        if only is not None:
            self.split(np.array([only]))
        self._chosen = None if tasks is None else _ids_of(tasks, num_tasks)
        self._rng, self._shuffling = np.random.default_rng(seed), np.random.default_rng(0)
        self._order, self._at = self._ordering(), 0

    def draw(self, count: int) -> np.ndarray:
        """The next ids, int [count]; at the end of an evaluation -1 for those that are left over."""
        if not self._ordered:
            return self.random(count)
        if self._only is not None:
            return np.full(count, self._only)
        if self._evaluating:
            found = np.full(count, -1)
            coming = self._order[self._at : self._at + count]
            found[: len(coming)] = coming
            self._at += len(coming)
            return found
        if self._at + count > len(self._order):
            self._order, self._at = self._ordering(), 0
        self._at += count
        return self._order[self._at - count : self._at]

    def random(self, count: int) -> np.ndarray:
        """Ids drawn at random, with replacement, int [count]."""
        if self._only is not None:
            return np.full(count, self._only)
        if self._chosen is None:
            return self._rng.integers(low=0, high=self.total, size=(count,))
        return self._chosen[self._rng.integers(low=0, high=len(self._chosen), size=(count,))]

    def rewind(self) -> None:
        """Go through the ids from the first on again."""
        self._at = 0

    def split(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Task and episode of each id, int [n] each.

        Raises:
            ResetStateError: an id that does not exist; -1 stands for an environment for which there was none left.
        """
        wrong = ids[(ids < 0) | (ids >= self.total)]
        if len(wrong):
            left = ": more environments than reset states, make fewer" if wrong[0] == -1 else ""
            raise ResetStateError(f"reset state {wrong[0]} does not exist; there are 0 to {self.total - 1}{left}")
        return ids // NUM_EPISODES, ids % NUM_EPISODES

    def _ordering(self) -> np.ndarray:
        """The ids of this process in order."""
        if self._evaluating:
            ids = np.arange(self.total).reshape(-1, NUM_EPISODES).T.ravel() if self._chosen is None else self._chosen
            return ids[self._rank :: self._processes]
        ids = np.arange(self.total) if self._chosen is None else self._chosen.copy()
        self._shuffling.shuffle(ids)
        if len(ids) < self._processes:
            ids = np.tile(ids, self._processes // len(ids) + 1)
        return ids[: len(ids) - len(ids) % self._processes].reshape(self._processes, -1)[self._rank]


def _ids_of(tasks: Sequence[int], num_tasks: int) -> np.ndarray:
    for task in tasks:
        if isinstance(task, bool) or not isinstance(task, int | np.integer) or not 0 <= task < num_tasks:
            raise ResetStateError(f"task_id_filter: {task!r} is no task; there are 0 to {num_tasks - 1}")
    return np.concatenate([np.arange(task * NUM_EPISODES, (task + 1) * NUM_EPISODES) for task in sorted(set(tasks))])
