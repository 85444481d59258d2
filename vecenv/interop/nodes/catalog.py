"""Which episodes a node set can place: the cascade of its panel as data, from the registry of suites.

A :class:`Catalog` has three levels: the head (LIBERO's suites, SIMPLER's splits), the tasks of a head, the episodes of
a task. A :class:`Selection` is one choice on each. Nothing here loads a simulator.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import vecenv
from vecenv.interop.nodes.ports import NodeError

EPISODE = "episode_index"
TASK = "task_id"
LIBERO_SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
_SIMPLER = "simpler/"
# Of the suites of both families.
_EPISODES = 50
_FIRST_SEED = 2022


class Choice(NamedTuple):
    """A value that a field may have, and what people read."""

    value: str | int
    label: str


@dataclass(frozen=True)
class Selection:
    """An episode by the values of the panel's fields: the head, the task's index in LIBERO or its name, the episode."""

    head: str
    task: str | int
    episode: int


class Catalog(ABC):
    """The cascade of a node set.

    Attributes:
        fields: names of the three levels.
        aliases: other names that the levels are known by.
        family: of suites, for ``vecenv``.
    """

    fields: ClassVar[tuple[str, str, str]]
    aliases: ClassVar[Mapping[str, str]] = MappingProxyType({})
    family: ClassVar[str]

    @property
    @abstractmethod
    def heads(self) -> tuple[str, ...]:
        """Values of the first level."""

    @abstractmethod
    def suite(self, head: str) -> str:
        """The suite of a head, for ``vecenv.make``."""

    @abstractmethod
    def tasks(self, head: str) -> list[Choice]:
        """Values of the second level."""

    @abstractmethod
    def head_label(self, head: str) -> str:
        """What people read."""

    def episodes(self, selection: Selection) -> list[Choice]:
        """Values of the third level."""
        del selection
        return [Choice(number, str(number)) for number in range(_EPISODES)]

    def first(self) -> Selection:
        """What is selected at the start."""
        return self.beginning(self.heads[0])

    def beginning(self, head: str) -> Selection:
        """The first episode of the first task of a head."""
        return Selection(head, self.tasks(head)[0].value, 0)

    def task_index(self, selection: Selection) -> int:
        """Index of the selected task in its suite."""
        return [choice.value for choice in self.tasks(selection.head)].index(selection.task)

    def snapshot(self, selection: Selection) -> dict[str, str | int]:
        """A selection by the names of the fields."""
        return dict(zip(self.fields, (selection.head, selection.task, selection.episode), strict=True))

    def choices(self, level: int, selection: Selection) -> list[Choice]:
        """What the field of a level offers, given what is selected above it."""
        if level == 0:
            return [Choice(head, self.head_label(head)) for head in self.heads]
        return self.tasks(selection.head) if level == 1 else self.episodes(selection)

    def changed(self, selection: Selection, name: str, value: Any) -> Selection:
        """The selection with another value of a field; the fields below it begin anew.

        Raises:
            NodeError: there is no such field, or it does not offer the value.
        """
        name = self.aliases.get(name, name) if isinstance(name, str) else name
        if name not in self.fields:
            raise NodeError(f"field {str(name)[:80]!r} does not exist; fields: {', '.join(self.fields)}")
        level = self.fields.index(name)
        value = _chosen(name, value, [choice.value for choice in self.choices(level, selection)])
        if level == 0:
            return self.beginning(value)
        if level == 1:
            return Selection(selection.head, value, 0)
        return Selection(selection.head, selection.task, value)


def _chosen(name: str, value: Any, there: Sequence[str | int]) -> Any:
    """One of the values of a field; a number may come as text, as forms of pages send it."""
    if isinstance(value, bool):
        found = []
    else:
        found = [each for each in there if value == each or (isinstance(each, int) and value == str(each))]
    if not found:
        shown = ", ".join(map(str, there)) if len(there) <= 30 else f"{there[0]} to {there[-1]}"
        raise NodeError(f"{name}={str(value)[:80]!r} does not exist; there are {shown}")
    return found[0]


class LiberoCatalog(Catalog):
    """Suites of LIBERO: suite, task index, episode.

    Args:
        suites: which; the published five unless given. LIBERO-PRO's are suites as well.
    """

    fields = ("suite", TASK, EPISODE)
    aliases = MappingProxyType({"split": "suite"})
    family = "libero"

    def __init__(self, suites: Sequence[str] = LIBERO_SUITES) -> None:
        known = vecenv.list_suites(self.family)
        if unknown := [suite for suite in suites if suite not in known]:
            raise NodeError(f"there is no suite {unknown[0]!r}; LIBERO's: {', '.join(known)}")
        if not suites:
            raise NodeError("suites is empty; name at least one")
        self._suites = tuple(dict.fromkeys(suites))

    @property
    def heads(self) -> tuple[str, ...]:
        """Suites."""
        return self._suites

    def suite(self, head: str) -> str:
        """The head itself."""
        return head

    def head_label(self, head: str) -> str:
        """With the number of tasks."""
        return f"{head} ({len(vecenv.list_tasks(head))} tasks)"

    def tasks(self, head: str) -> list[Choice]:
        """Indices, with the instructions."""
        return [Choice(task.index, f"{task.index}: {task.instruction}") for task in vecenv.list_tasks(head)]


class SimplerCatalog(Catalog):
    """Splits of SIMPLER: split, task name, episode."""

    fields = ("split", TASK, EPISODE)
    family = "simpler"

    @property
    def heads(self) -> tuple[str, ...]:
        """``bridge`` and ``google_robot``."""
        return tuple(suite.removeprefix(_SIMPLER) for suite in vecenv.list_suites(self.family))

    def suite(self, head: str) -> str:
        """The suite of a split."""
        return _SIMPLER + head

    def head_label(self, head: str) -> str:
        """With the number of tasks."""
        return f"{head} ({len(vecenv.list_tasks(self.suite(head)))} tasks)"

    def tasks(self, head: str) -> list[Choice]:
        """Names, with the instructions."""
        return [Choice(task.name, f"{task.name}: {task.instruction}") for task in vecenv.list_tasks(self.suite(head))]

    def episodes(self, selection: Selection) -> list[Choice]:
        """Episodes, with their seeds."""
        return [Choice(number, f"{number} (seed {_FIRST_SEED + number})") for number in range(_EPISODES)]
