"""SIMPLER's 25 tasks by suite, name and index.

In: a suite (``simpler/bridge``, ``simpler/google_robot``) and a task's name or index. Out: a ``SimplerTask``. Which
object stands where in an episode is in ``layouts.py``. Nothing here needs SAPIEN or assets.
"""

from __future__ import annotations

import difflib
import functools
import operator
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import SupportsIndex

from vecenv.errors import NotFound
from vecenv.simpler.task_spec import BRIDGE, GOOGLE, SimplerTask
from vecenv.simpler.task_table import ROWS

SUITES: tuple[str, ...] = (BRIDGE, GOOGLE)
NUM_EPISODES = 50
"""Episodes of every task."""
FIRST_SEED = 2022
"""Episode e has seed ``FIRST_SEED + e``."""


class UnknownSuite(NotFound, KeyError):
    """No SIMPLER suite has this name; the message lists those that exist."""

    def __str__(self) -> str:
        return str(self.args[0])


class UnknownTask(NotFound):
    """A suite has no task of this name or index; the message gives the nearest or the valid range."""


def _suite_tasks(suite: str) -> tuple[SimplerTask, ...]:
    rows = [row for row in ROWS if row["suite"] == suite]
    return tuple(SimplerTask(index=index, **row) for index, row in enumerate(rows))


TASKS: Mapping[str, SimplerTask] = MappingProxyType(
    {task.name: task for suite in SUITES for task in _suite_tasks(suite)}
)
"""All 25 tasks by name, suite by suite."""


@functools.cache
def list_tasks(suite: str) -> tuple[SimplerTask, ...]:
    """Tasks of a suite in upstream's order.

    Raises:
        UnknownSuite: no such suite.
    """
    if suite not in SUITES:
        raise UnknownSuite(f"no suite {suite!r}; SIMPLER's suites: {', '.join(SUITES)}")
    return tuple(task for task in TASKS.values() if task.suite == suite)


def find_task(suite: str, which: str | SupportsIndex) -> SimplerTask:
    """One task of a suite, by upstream's name or by index.

    Raises:
        UnknownSuite: no such suite.
        UnknownTask: no such task; negative indices are not counted from the end.
    """
    tasks = list_tasks(suite)
    if isinstance(which, str):
        return _by_name(suite, which, tasks)
    place = operator.index(which)
    if not 0 <= place < len(tasks):
        raise UnknownTask(f"{suite} has tasks 0 to {len(tasks) - 1}, not {place}")
    return tasks[place]


def _by_name(suite: str, name: str, tasks: Iterable[SimplerTask]) -> SimplerTask:
    names = {task.name: task for task in tasks}
    if name not in names:
        near = difflib.get_close_matches(name, names, n=3) or names
        raise UnknownTask(f"{suite} has no task {name!r}: did you mean {', '.join(near)}?")
    return names[name]
