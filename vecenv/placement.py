"""Task and episode of each slot of a batch, and how they are specified.

Tasks are named by index, range or name, episodes by index, range or count: ``"0,3,5-7"``. ``vecenv.make`` and ``vecenv
eval`` read both with the functions here, so that a specification means the same in either.
"""

from __future__ import annotations

import difflib
import fnmatch
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np

from vecenv.errors import InvalidInput
from vecenv.util import inputs

_T = TypeVar("_T")


class PlacementError(InvalidInput):
    """Tasks or episodes that do not exist or do not fit the batch; the message says which."""


class SpecError(PlacementError):
    """A specification of tasks or episodes cannot be parsed, or names something that does not exist."""


ALL = "all"
# An error lists this many names and counts the rest.
_LISTED = 12
# No index has more digits, and Python reads no number of thousands.
_DIGITS = 18
_RANGE = re.compile(rf"(\d{{1,{_DIGITS}}})(?:\s*-\s*(\d{{1,{_DIGITS}}}))?")


@dataclass(frozen=True)
class Placement:
    """Task and episode of each slot, int [B] each; copies that cannot be written to.

    Raises:
        PlacementError: no slot, not as many episodes as tasks, or something else than indices.
    """

    task: np.ndarray
    episode: np.ndarray

    def __post_init__(self) -> None:
        for name in ("task", "episode"):
            given = inputs.array(getattr(self, name), name, "indices, int [B]", PlacementError, kinds="iu")
            if given.size and (int(given.min()) < 0 or int(given.max()) > inputs.MOST_COUNT):
                raise PlacementError(f"{name}: expected indices, which are at least 0, int [B]")
            own = given.astype(int)
            own.flags.writeable = False
            object.__setattr__(self, name, own)
        if self.task.shape != self.episode.shape or self.task.ndim != 1 or self.task.size == 0:
            raise PlacementError("a batch needs at least one slot, and as many episodes as tasks")

    def __len__(self) -> int:
        return len(self.task)


def integers(value: object, what: str) -> list[int]:
    """One index or several, in any list, range, array or generator.

    Raises:
        PlacementError: something that is no integer, or a mapping, set or text.
    """
    return inputs.integers(value, what, PlacementError)


def _check(values: Iterable[int], count: int, what: str) -> None:
    for value in values:
        if not 0 <= value < count:
            raise PlacementError(f"{what} {value} does not exist; there are {count} (0 to {count - 1})")


def parse_tasks(spec: str, num_tasks: int, names: Sequence[str] = ()) -> tuple[int, ...]:
    """Read task indices: ``"all"``, or indices, ranges and names such as ``"0,3,5-7,widowx_stack_cube"``.

    Args:
        spec: the text. A name may be a substring that only one name has, or a pattern with ``*`` for every name that
            matches; case does not matter, and spaces are underscores.
        num_tasks: number of tasks of the suite.
        names: names of the tasks.

    Raises:
        SpecError: the text cannot be parsed, names a task the suite does not have, or matches several.
    """
    return tuple(range(num_tasks)) if spec.strip() == ALL else _parse_indices(spec, num_tasks, "task", names)


def parse_episodes(spec: str, num_episodes: int, every: int | None = None) -> tuple[int, ...]:
    """Read episode indices: ``"all"``, a bare number for that many from the first on, or a list as for tasks.

    ``"5"`` means episodes 0 to 4; the single episode 5 is ``"5-5"`` or ``"5,"``.

    Args:
        spec: the text.
        num_episodes: number of episodes of the task.
        every: number of episodes of ``"all"``, if a protocol has fewer.

    Raises:
        SpecError: the text cannot be parsed, or names episodes the task does not have.
    """
    text = spec.strip()
    if text == ALL:
        return tuple(range(num_episodes if every is None else every))
    if not text.isdecimal() or len(text) > _DIGITS:
        return _parse_indices(text, num_episodes, "episode")
    if not 1 <= int(text) <= num_episodes:
        raise SpecError(f"{text} episodes asked for: each task has {num_episodes}, ask for 1 to {num_episodes}")
    return tuple(range(int(text)))


def episode_indices(episodes: object, num_episodes: int, every: int | None = None) -> tuple[int, ...]:
    """Episodes as ``vecenv.make`` takes them: None or ``"all"``, a text as for ``parse_episodes``, or indices.

    Raises:
        PlacementError: a bare number, something that is no index, or an episode that does not exist.
    """
    if episodes is None or isinstance(episodes, str):
        return parse_episodes(ALL if episodes is None else episodes, num_episodes, every)
    if isinstance(episodes, np.ndarray) and not episodes.ndim:
        episodes = episodes.item()
    if inputs.is_integer(episodes):
        count = f", or '{episodes}' for the first {episodes}" if int(cast(int, episodes)) > 0 else ""
        raise SpecError(
            f"episodes={episodes}: a bare number used to mean one episode here and a count in `vecenv eval`; "
            f"write [{episodes}] for episode {episodes} alone{count}"
        )
    chosen = integers(episodes, "episode")
    _check(chosen, num_episodes, "episode")
    return tuple(chosen)


def task_indices(tasks: object, names: Sequence[str]) -> tuple[int, ...]:
    """Tasks as ``vecenv.make`` takes them: None for all, a text as for ``parse_tasks``, an index, or several of either.

    Raises:
        PlacementError: another type, a task that does not exist, or a name that matches several.
    """
    if tasks is None or isinstance(tasks, str):
        return parse_tasks(ALL if tasks is None else tasks, len(names), names)
    chosen: list[int] = []
    for task in inputs.items(tasks, "task", PlacementError):
        if isinstance(task, str):
            chosen += parse_tasks(task, len(names), names)
        elif inputs.is_integer(task):
            chosen.append(int(task))
        else:
            raise PlacementError(f"task: {inputs.shown(task)} is not an integer or a name")
    _check(chosen, len(names), "task")
    return tuple(chosen)


def cross(
    tasks: object, episodes: object, *, num_tasks: int, num_episodes: int | Mapping[int, int], every: int | None = None
) -> Placement:
    """Every episode of every task, task by task.

    Args:
        tasks: one index or several.
        episodes: for all tasks, as for ``episode_indices``; or a mapping task -> episodes, none where it has no key.
        num_tasks: number of tasks.
        num_episodes: number of episodes of every task, or a mapping task -> number; tasks left out have none.
        every: number of episodes of ``"all"``, if a protocol has fewer.

    Raises:
        PlacementError: an index that does not exist, episodes of a task that is not among them, or nothing to place.
    """
    task_list = integers(tasks, "task")
    _check(task_list, num_tasks, "task")
    episodes = each_read_once(episodes, task_list)
    pairs: list[tuple[int, int]] = []
    for task in task_list:
        spec = episodes.get(task, ()) if isinstance(episodes, Mapping) else episodes
        there = num_episodes.get(task, 0) if isinstance(num_episodes, Mapping) else num_episodes
        pairs += [(task, episode) for episode in episode_indices(spec, there, every)]
    if not pairs:
        raise PlacementError("no slot to fill: tasks or episodes are empty")
    columns = np.array(pairs)
    return Placement(columns[:, 0], columns[:, 1])


def each_read_once(episodes: object, tasks: Sequence[int]) -> object:
    """Episodes that may be read for one task after the other: generators as lists, also in a mapping.

    Raises:
        PlacementError: a mapping with a key that is none of the tasks.
    """
    if not isinstance(episodes, Mapping):
        return inputs.read_once(episodes)
    for task in episodes:
        if not inputs.is_integer(task) or task not in tasks:
            raise PlacementError(
                f"episodes: {inputs.shown(task)} is none of the tasks, {', '.join(map(str, _some(sorted(set(tasks)))))}"
            )
    return {int(task): inputs.read_once(chosen) for task, chosen in episodes.items()}


def each(tasks: object, episodes: object, current: Placement, *, num_tasks: int, num_episodes: int) -> Placement:
    """One task and one episode per slot; None keeps the current ones, a single number goes to every slot.

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
        if isinstance(value, AbstractSet) and len(value) > 1:
            raise PlacementError(f"{what}: {inputs.shown(value)} is a set, which has no order; expected a list")
        chosen = integers(value, what)
        _check(chosen, count, what)
        if len(chosen) not in (1, len(current)):
            raise PlacementError(
                f"{len(chosen)} {what}s for {len(current)} slots; expected one a slot, or a single one"
            )
        columns.append(np.broadcast_to(np.array(chosen), len(current)).copy())
    return Placement(*columns)


def replaced(chosen: Sequence[int], rows: np.ndarray, current: np.ndarray, what: str) -> list[int]:
    """Indices ``current`` (int [B]) with others in the slots ``rows``: one a slot, or a single one for all of them.

    Args:
        chosen: the others.
        rows: int [n].
        current: of all slots.
        what: what an index is, for messages.

    Raises:
        PlacementError: a number of them other than the number of slots.
    """
    chosen = [*chosen] * len(rows) if len(chosen) == 1 else chosen
    if len(chosen) != len(rows):
        raise PlacementError(f"{len(chosen)} {what}s for {len(rows)} slots; expected one a slot, or a single one")
    merged = current.tolist()
    for row, index in zip(rows.tolist(), chosen, strict=True):
        merged[row] = index
    return merged


def _parse_indices(spec: str, count: int, what: str, names: Sequence[str] = ()) -> tuple[int, ...]:
    parts = [part.strip() for part in spec.split(",") if part.strip()]
    if not parts:
        raise SpecError(f"no {what} named in {spec!r}")
    indices = [index for part in parts for index in _parse_part(part, count, what, names)]
    return tuple(dict.fromkeys(indices))


def _parse_part(part: str, count: int, what: str, names: Sequence[str]) -> Sequence[int]:
    if part in names:
        return (names.index(part),)
    if names and any(character in part for character in "*?["):
        return _matching(part, what, names)
    return _parse_range(part, count, what) if _RANGE.fullmatch(part) else (_named(part, what, names),)


def _matching(pattern: str, what: str, names: Sequence[str]) -> tuple[int, ...]:
    """The names that match a pattern with ``*``, ``?`` and ``[...]``."""
    found = tuple(i for i, name in enumerate(names) if fnmatch.fnmatchcase(_plain(name), _plain(pattern)))
    if not found:
        raise SpecError(f"no {what} matches {pattern!r}; there are {', '.join(_some(names))}")
    return found


def _parse_range(part: str, count: int, what: str) -> range:
    low, _, high = part.partition("-")
    start, stop = int(low), int(high or low)
    if stop < start:
        raise SpecError(f"the range {part!r} of {what}s runs backwards")
    if stop >= count:
        raise SpecError(f"there is no {what} {stop}: the last one is {count - 1}")
    return range(start, stop + 1)


def _named(part: str, what: str, names: Sequence[str]) -> int:
    """Index of the only name that contains this substring."""
    wanted = _plain(part)
    fitting = [name for name in names if _plain(name) == wanted] or [name for name in names if wanted in _plain(name)]
    if len(fitting) == 1:
        return names.index(fitting[0])
    if fitting:
        raise SpecError(f"{what} {part!r} fits {len(fitting)}: {', '.join(_some(fitting))}; write more of the name")
    near = difflib.get_close_matches(part, names, n=3) or list(names)
    close = f"; did you mean {', '.join(_some(near))}?" if near else ""
    raise SpecError(
        f"cannot read {inputs.shown(part)} as {what}s: write indices and ranges such as 0,3,5-7, or 'all'{close}"
    )


def _plain(name: str) -> str:
    return "_".join(name.lower().split())


def _some(names: Sequence[_T]) -> Iterator[_T | str]:
    yield from names[:_LISTED]
    if len(names) > _LISTED:
        yield f"... ({len(names) - _LISTED} more)"
