"""Gymnasium ids of all tasks: ``vecenv/<suite>-<task>-v0``. Importing this module registers them, and builds nothing.

Gymnasium 1.0 and later have no plugin entry points; a module in front of an id is what they import before they look::

    gymnasium.make("vecenv.interop.ids:vecenv/libero_object-0-v0")

or import this module once and leave the prefix out. SIMPLER's suites are ``simpler_bridge`` and
``simpler_google_robot`` here, because an id has one slash only.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType

from gymnasium.envs.registration import register, registry

from vecenv.errors import NotFound

_PRO = {
    f"libero_{base}_{change}": 10
    for base in ("spatial", "object", "goal", "10")
    for change in ("lan", "object", "swap", "task")
}
# Written out, so that registering reads no task files; a test compares it with ``vecenv.list_tasks``.
NUM_TASKS: Mapping[str, int] = MappingProxyType(
    {
        "libero_spatial": 10,
        "libero_object": 10,
        "libero_goal": 10,
        "libero_10": 10,
        "libero_90": 90,
        **_PRO,
        "simpler/bridge": 4,
        "simpler/google_robot": 21,
    }
)
"""Suite -> number of its tasks."""
_ENTRY = "vecenv.interop.gymnasium"


class UnknownSuiteId(NotFound, KeyError):
    """No suite has this name; the message lists those that do."""


def env_ids(suites: Iterable[str] | None = None) -> tuple[str, ...]:
    """Ids of the tasks of some suites, all by default: ``"vecenv/<suite>-<task>-v0"``.

    Raises:
        UnknownSuiteId: no such suite.
    """
    return tuple(_id(suite, task) for suite, task in _tasks(suites))


def register_envs(suites: Iterable[str] | None = None) -> tuple[str, ...]:
    """Make ``gymnasium.make`` and ``gymnasium.make_vec`` know the tasks of some suites, all by default.

    Doing it twice is harmless. ``make_vec`` then makes one batch, unless told ``vectorization_mode="sync"``.

    Returns:
        Their ids.
    """
    for suite, task in _tasks(suites):
        if _id(suite, task) not in registry:
            register(
                _id(suite, task),
                entry_point=f"{_ENTRY}:Env",
                vector_entry_point=f"{_ENTRY}:make_vec",
                kwargs={"suite": suite, "task": task},
            )
    return env_ids(suites)


def _tasks(suites: Iterable[str] | None) -> list[tuple[str, int]]:
    chosen = list(NUM_TASKS) if suites is None else list(suites)
    for suite in chosen:
        if suite not in NUM_TASKS:
            raise UnknownSuiteId(f"unknown suite {suite!r}; suites: {', '.join(NUM_TASKS)}")
    return [(suite, task) for suite in chosen for task in range(NUM_TASKS[suite])]


def _id(suite: str, task: int) -> str:
    return f"vecenv/{suite.replace('/', '_')}-{task}-v0"


register_envs()
