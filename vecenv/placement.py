"""Which (task, episode) sits in which slot of a batch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


class PlacementError(ValueError):
    """Tasks or episodes that do not exist or do not fit the batch; the message says which."""


@dataclass(frozen=True)
class Placement:
    """Task and episode of each slot, int [B] each."""

    task: np.ndarray
    episode: np.ndarray

    def __post_init__(self) -> None:
        if self.task.shape != self.episode.shape or self.task.ndim != 1 or self.task.size == 0:
            raise PlacementError("a batch needs at least one slot, and as many episodes as tasks")

    def __len__(self) -> int:
        return len(self.task)


def _ints(value: Any, what: str) -> list[int]:
    try:
        items: list[Any] = [value] if isinstance(value, Mapping) else list(value)
    except TypeError:
        items = [value]
    for item in items:
        if isinstance(item, bool) or not isinstance(item, int | np.integer):
            raise PlacementError(f"{what}: {item!r} is not an integer")
    return [int(item) for item in items]


def _check(values: Iterable[int], count: int, what: str) -> None:
    for value in values:
        if not 0 <= value < count:
            raise PlacementError(f"{what} {value} does not exist; there are {count} (0 to {count - 1})")


def cross(tasks: Any, episodes: Any, *, num_tasks: int, num_episodes: int) -> Placement:
    """Every episode of every task, task by task.

    Args:
        tasks: one index or several.
        episodes: one index or several, for all tasks; or a mapping task -> indices.
        num_tasks, num_episodes: how many there are.

    Raises:
        PlacementError: an index that does not exist, or nothing to place.
    """
    task_list = _ints(tasks, "task")
    _check(task_list, num_tasks, "task")
    pairs: list[tuple[int, int]] = []
    for task in task_list:
        chosen = _ints(episodes.get(task, ()) if isinstance(episodes, Mapping) else episodes, "episode")
        _check(chosen, num_episodes, "episode")
        pairs += [(task, episode) for episode in chosen]
    if not pairs:
        raise PlacementError("no slot to fill: tasks or episodes are empty")
    columns = np.array(pairs)
    return Placement(columns[:, 0], columns[:, 1])


def each(tasks: Any, episodes: Any, current: Placement, *, num_tasks: int, num_episodes: int) -> Placement:
    """One task and one episode a slot; None keeps the current ones, a single number goes to every slot.

    Raises:
        PlacementError: an index that does not exist, or a number of entries other than the number of slots.
    """
    columns = []
    for what, value, kept, count in (
        ("task", tasks, current.task, num_tasks),
        ("episode", episodes, current.episode, num_episodes),
    ):
        if value is None:
            columns.append(kept)
            continue
        chosen = _ints(value, what)
        _check(chosen, count, what)
        if len(chosen) not in (1, len(current)):
            raise PlacementError(
                f"{len(chosen)} {what}s for {len(current)} slots; expected one a slot, or a single one"
            )
        columns.append(np.broadcast_to(np.array(chosen), len(current)).copy())
    return Placement(*columns)
