"""Actions that have been received and not executed yet, a queue for each slot."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from vecenv.contract import ACTION_DIM


class ActionQueues:
    """One queue of actions a slot.

    Args:
        num_slots: B.
    """

    def __init__(self, num_slots: int) -> None:
        self._queues: tuple[deque[np.ndarray], ...] = tuple(deque() for _ in range(num_slots))

    def __len__(self) -> int:
        return len(self._queues)

    @property
    def empty(self) -> np.ndarray:
        """Which slots have no action left, bool [B]."""
        return np.array([not queue for queue in self._queues])

    def fill(self, slot: int, chunk: np.ndarray) -> None:
        """Replace what a slot has left by a chunk [K, 7]."""
        self._queues[slot].clear()
        self._queues[slot].extend(chunk)

    def clear(self, slots: Iterable[int]) -> None:
        """Drop what some slots have left."""
        for slot in slots:
            self._queues[slot].clear()

    def pop(self, slots: Iterable[int]) -> np.ndarray:
        """The next action of some slots, zeros elsewhere, float64 [B, 7]."""
        actions = np.zeros((len(self), ACTION_DIM))
        for slot in slots:
            actions[slot] = self._queues[slot].popleft()
        return actions
