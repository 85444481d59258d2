"""Which episodes an evaluation runs, and in which batches.

Specifications as a person writes them (``"0,3,5-7"``) come in; out go :class:`Batch` objects: rectangles of tasks times
episodes, at most ``num_envs`` slots each, tasks that share a scene side by side, without what has already been done.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise, product

ALL = "all"
# Most episodes that run at once, where neither the user nor the suite says otherwise.
MAX_SLOTS = 256


class SpecError(ValueError):
    """A specification of tasks or episodes cannot be read, or asks for something that does not exist."""


@dataclass(frozen=True, order=True)
class Episode:
    """One episode of one task."""

    suite: str
    task: int
    episode: int

    @property
    def id(self) -> str:
        """``"{suite}/{task}/{episode}"``, the name environments use."""
        return f"{self.suite}/{self.task}/{self.episode}"

    @classmethod
    def from_id(cls, text: str) -> Episode:
        """Read back :attr:`id`; a suite may itself hold slashes."""
        suite, task, episode = text.rsplit("/", 2)
        return cls(suite, int(task), int(episode))


@dataclass(frozen=True)
class Suite:
    """What the harness knows about a suite.

    Attributes:
        name: name of the suite.
        instructions: language instruction of each task.
        scenes: what each task needs built; tasks with equal entries share it.
        num_episodes: episodes of each task.
        tasks: name of each task, by which it may be asked for; may be empty.
        max_slots: most episodes to run at once unless told otherwise.
    """

    name: str
    instructions: tuple[str, ...]
    scenes: tuple[Hashable, ...]
    num_episodes: int
    tasks: tuple[str, ...] = ()
    max_slots: int = MAX_SLOTS


@dataclass(frozen=True)
class Batch:
    """A rectangle of episodes that run together: every task times every episode, tasks slowest.

    Attributes:
        suite: name of the suite.
        tasks: task indices.
        episodes: episode indices, the same for each task.
    """

    suite: str
    tasks: tuple[int, ...]
    episodes: tuple[int, ...]

    @property
    def slots(self) -> tuple[Episode, ...]:
        """The episode in each slot."""
        return tuple(Episode(self.suite, t, e) for t, e in product(self.tasks, self.episodes))

    def __len__(self) -> int:
        return len(self.tasks) * len(self.episodes)


def parse_tasks(spec: str, num_tasks: int, names: Sequence[str] = ()) -> tuple[int, ...]:
    """Read task indices: ``"all"``, or indices, ranges and names such as ``"0,3,5-7,widowx_stack_cube"``.

    Args:
        spec: the text.
        num_tasks: how many tasks the suite has.
        names: what they are called.

    Raises:
        SpecError: the text cannot be read, or names a task the suite does not have.
    """
    return tuple(range(num_tasks)) if spec.strip() == ALL else _parse_indices(spec, num_tasks, "task", names)


def parse_episodes(spec: str, num_episodes: int) -> tuple[int, ...]:
    """Read episode indices: ``"all"``, a bare number for that many from the first on, or a list as for tasks.

    ``"5"`` means episodes 0 to 4; the single episode 5 is ``"5-5"`` or ``"5,"``.

    Raises:
        SpecError: the text cannot be read, or asks for episodes the task does not have.
    """
    text = spec.strip()
    if text == ALL:
        return tuple(range(num_episodes))
    if not text.isdecimal():
        return _parse_indices(text, num_episodes, "episode")
    if not 1 <= int(text) <= num_episodes:
        raise SpecError(f"{text} episodes asked for: each task has {num_episodes}, ask for 1 to {num_episodes}")
    return tuple(range(int(text)))


def plan(
    suite: Suite,
    tasks: Sequence[int],
    episodes: Sequence[int],
    *,
    num_envs: int,
    done: Collection[Episode] = (),
) -> list[Batch]:
    """Split episodes into batches of at most ``num_envs`` slots, of sizes as equal as possible.

    Args:
        suite: the suite, for which tasks share a scene.
        tasks: task indices; in the plan they are ordered by scene.
        episodes: episode indices.
        num_envs: most slots in a batch.
        done: episodes to leave out.
    """
    if num_envs < 1:
        raise SpecError(f"num_envs must be at least 1, not {num_envs}")
    done = frozenset(done)
    todo = [(t, tuple(e for e in episodes if Episode(suite.name, t, e) not in done)) for t in _by_scene(suite, tasks)]
    batches = []
    for missing, group in groupby(todo, key=lambda row: row[1]):
        if missing:
            batches += _rectangles(suite.name, [t for t, _ in group], missing, num_envs)
    return batches


def _by_scene(suite: Suite, tasks: Sequence[int]) -> list[int]:
    """Tasks with those that share a scene side by side, scenes in order of their first task."""
    first: dict[Hashable, int] = {}
    for position, task in enumerate(tasks):
        first.setdefault(suite.scenes[task], position)
    return sorted(tasks, key=lambda task: first[suite.scenes[task]])


def _rectangles(suite: str, tasks: Sequence[int], episodes: Sequence[int], num_envs: int) -> Iterator[Batch]:
    for some_tasks in _even_chunks(tasks, max(1, num_envs // len(episodes))):
        for some_episodes in _even_chunks(episodes, num_envs):
            yield Batch(suite, some_tasks, some_episodes)


def _even_chunks(items: Sequence[int], most: int) -> Iterator[tuple[int, ...]]:
    """Split into as few chunks of at most ``most`` as possible, their sizes differing by at most one."""
    count = -(-len(items) // most)
    bounds = [len(items) * i // count for i in range(count + 1)]
    for start, stop in pairwise(bounds):
        yield tuple(items[start:stop])


def _parse_indices(spec: str, count: int, what: str, names: Sequence[str] = ()) -> tuple[int, ...]:
    parts = [part.strip() for part in spec.split(",") if part.strip()]
    if not parts:
        raise SpecError(f"no {what} named in {spec!r}")
    indices = [index for part in parts for index in _parse_part(part, count, what, names)]
    return tuple(dict.fromkeys(indices))


def _parse_part(part: str, count: int, what: str, names: Sequence[str]) -> Sequence[int]:
    return (names.index(part),) if part in names else _parse_range(part, count, what, names)


def _parse_range(part: str, count: int, what: str, names: Sequence[str]) -> range:
    low, dash, high = part.partition("-")
    if not low.strip().isdecimal() or (dash and not high.strip().isdecimal()):
        near = difflib.get_close_matches(part, names, n=3)
        close = f"; did you mean {', '.join(near)}?" if near else ""
        raise SpecError(f"cannot read {part!r} as {what}s: write indices and ranges such as 0,3,5-7, or 'all'{close}")
    start, stop = int(low), int(high) if dash else int(low)
    if stop < start:
        raise SpecError(f"the range {part!r} of {what}s runs backwards")
    if stop >= count:
        raise SpecError(f"there is no {what} {stop}: the last one is {count - 1}")
    return range(start, stop + 1)
