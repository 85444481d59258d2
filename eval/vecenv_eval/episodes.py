"""Which episodes an evaluation runs, and in which streams.

Specifications as a person writes them (``"0,3,5-7"``) come in; out go :class:`Stream` objects, without what has already
been done: at most ``num_envs`` slots each, in which an episode follows when one ends. For policies that cannot begin
single slots there are :class:`Batch` objects, rectangles of tasks times episodes, which nothing follows.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, product
from typing import TypeVar

from vecenv.placement import ALL, SpecError, parse_episodes, parse_tasks

__all__ = [
    "ALL",
    "MAX_SLOTS",
    "Batch",
    "Episode",
    "SpecError",
    "Stream",
    "Suite",
    "parse_episodes",
    "parse_tasks",
    "plan",
    "shard",
    "streams",
]

_Item = TypeVar("_Item")
# Scenes of a suite that run side by side; drawing one takes up to 0.9 GB.
MAX_SCENES = 5
# Most episodes that run at once, where neither the user nor the suite sets another number.
MAX_SLOTS = 256


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
        num_episodes: episodes that can be run, one number for all tasks or one a task (0 where there are none).
        every: how many of them ``"all"`` runs; None for all.
        tasks: name of each task, by which it may be asked for; may be empty.
        max_slots: most episodes to run at once by default.
        cameras: names of the cameras in the scene of each task; empty where they are not known.
    """

    name: str
    instructions: tuple[str, ...]
    scenes: tuple[Hashable, ...]
    num_episodes: int | tuple[int, ...]
    every: int | None = None
    tasks: tuple[str, ...] = ()
    max_slots: int = MAX_SLOTS
    cameras: tuple[tuple[str, ...], ...] = ()

    def episodes_of(self, task: int) -> int:
        """How many episodes of a task can be run."""
        return self.num_episodes if isinstance(self.num_episodes, int) else self.num_episodes[task]


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


def plan(
    suite: Suite,
    tasks: Sequence[int],
    episodes: Sequence[int] | Mapping[int, Sequence[int]],
    *,
    num_envs: int,
    done: Collection[Episode] = (),
) -> list[Batch]:
    """Split episodes into batches of at most ``num_envs`` slots, of sizes as equal as possible.

    Args:
        suite: the suite, for which tasks share a scene.
        tasks: task indices; in the plan they are ordered by scene.
        episodes: episode indices, for all tasks or by task.
        num_envs: most slots in a batch.
        done: episodes to leave out.
    """
    if num_envs < 1:
        raise SpecError(f"num_envs must be at least 1, not {num_envs}")
    done = frozenset(done)
    wanted = episodes if isinstance(episodes, Mapping) else dict.fromkeys(tasks, episodes)
    todo = [(t, tuple(e for e in wanted[t] if Episode(suite.name, t, e) not in done)) for t in _by_scene(suite, tasks)]
    batches = []
    for missing, group in groupby(todo, key=lambda row: row[1]):
        if missing:
            batches += _rectangles(suite.name, [t for t, _ in group], missing, num_envs)
    return batches


def shard(
    suite: Suite, tasks: Sequence[int], episodes: Mapping[int, Sequence[int]], part: int, parts: int
) -> dict[int, tuple[int, ...]]:
    """Part ``part`` of ``parts`` of an evaluation's episodes, by task; tasks without any are left out.

    The parts are disjoint, together they are the whole, and their sizes differ by one episode at most. The episodes of
    a scene stay together: there are at most ``parts - 1`` scenes of which more than one part has episodes.

    Args:
        suite: the suite, for which tasks share a scene.
        tasks: task indices.
        episodes: episode indices by task.
        part, parts: which part, 1 <= part <= parts.
    """
    whole = [(task, episode) for task in _by_scene(suite, tasks) for episode in episodes[task]]
    start, stop = len(whole) * (part - 1) // parts, len(whole) * part // parts
    chosen: dict[int, tuple[int, ...]] = {}
    for task, episode in whole[start:stop]:
        chosen[task] = (*chosen.get(task, ()), episode)
    return {task: chosen[task] for task in tasks if task in chosen}


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


def _even_chunks(items: Sequence[_Item], most: int) -> Iterator[tuple[_Item, ...]]:
    """Split into as few chunks of at most ``most`` as possible, their sizes differing by at most one."""
    count = -(-len(items) // most)
    for i in range(count):
        yield tuple(items[len(items) * i // count : len(items) * (i + 1) // count])


@dataclass(frozen=True)
class Stream:
    """Episodes that run in one environment: those that its slots begin with, and those that follow.

    Attributes:
        suite: name of the suite.
        first: the episode that each slot begins with, tasks side by side.
        waiting: scene -> episodes of its tasks that follow, as slots of the scene end.
    """

    suite: str
    first: tuple[Episode, ...]
    waiting: Mapping[Hashable, tuple[Episode, ...]] = field(default_factory=dict)

    @classmethod
    def of(cls, batch: Batch) -> Stream:
        """A batch, which nothing follows."""
        return cls(batch.suite, batch.slots)

    @property
    def tasks(self) -> tuple[int, ...]:
        """The tasks that slots begin with, each once, in the order of the slots."""
        return tuple(dict.fromkeys(episode.task for episode in self.first))

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """All of them."""
        return (*self.first, *(episode for waiting in self.waiting.values() for episode in waiting))

    def __len__(self) -> int:
        return len(self.episodes)


def streams(
    suite: Suite,
    tasks: Sequence[int],
    episodes: Mapping[int, Sequence[int]],
    *,
    num_envs: int,
    done: Collection[Episode] = (),
) -> list[Stream]:
    """Put episodes into streams of at most ``num_envs`` slots and ``MAX_SCENES`` scenes each.

    A scene gets slots in proportion to its episodes, and at least one.

    Args:
        suite: the suite, for which tasks share a scene.
        tasks: task indices; they are ordered by scene.
        episodes: episode indices by task.
        num_envs: most slots of a stream.
        done: episodes to leave out.
    """
    if num_envs < 1:
        raise SpecError(f"num_envs must be at least 1, not {num_envs}")
    done = frozenset(done)
    todo: dict[Hashable, list[Episode]] = {}
    for task in _by_scene(suite, tasks):
        missing = [each for each in (Episode(suite.name, task, e) for e in episodes[task]) if each not in done]
        if missing:
            todo.setdefault(suite.scenes[task], []).extend(missing)
    return [_stream(suite, some, todo, num_envs) for some in _even_chunks(list(todo), min(MAX_SCENES, num_envs))]


def _stream(suite: Suite, scenes: Sequence[Hashable], todo: Mapping[Hashable, list[Episode]], num_envs: int) -> Stream:
    counts = _shares([len(todo[scene]) for scene in scenes], num_envs)
    first = [episode for scene, count in zip(scenes, counts, strict=True) for episode in todo[scene][:count]]
    waiting = {scene: tuple(todo[scene][count:]) for scene, count in zip(scenes, counts, strict=True)}
    return Stream(suite.name, tuple(first), waiting)


def _shares(wanted: Sequence[int], most: int) -> list[int]:
    """Slots of each scene: all that are wanted if they fit, else in proportion, one at least, ``most`` together."""
    if sum(wanted) <= most:
        return list(wanted)
    shares = [max(1, count * most // sum(wanted)) for count in wanted]
    while sum(shares) > most:
        shares[shares.index(max(shares))] -= 1
    while sum(shares) < most:
        shares[max(range(len(wanted)), key=lambda i: wanted[i] / shares[i])] += 1
    return shares
