"""What a panel offers: suites, their tasks, and policies; from the registry, so that nothing is listed twice."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import vecenv
from vecenv.util.names import unknown
from vecenv_eval.panel.state import SessionError
from vecenv_eval.policies import BUILTIN

# What a policy is, for people; those behind servers need an address, so only trusted clients may name them.
DESCRIPTIONS = {
    "gr00t": "a GR00T policy server",
    "openpi": "an openpi policy server",
    "pick_place": "scripted pick and place, made for LIBERO",
    "random": "uniformly random actions",
    "simpler_scripted": "scripted, made for SIMPLER",
    "starvla": "a StarVLA policy server",
    "vla-eval": "a server of vla-evaluation-harness",
    "voxposer": "programs over value maps (rules write them unless a language model is named)",
    "zero": "holds still",
}
SERVERS = frozenset({"gr00t", "openpi", "starvla", "vla-eval"})


@dataclass(frozen=True, kw_only=True)
class SuiteEntry:
    """A suite; ``label`` is for people."""

    name: str
    family: str
    num_tasks: int
    label: str


@dataclass(frozen=True, kw_only=True)
class TaskEntry:
    """A task: its index (its name in SIMPLER), what a policy is told, and how many episodes it has."""

    task: int | str
    label: str
    instruction: str
    num_episodes: int


@functools.cache
def suites() -> tuple[SuiteEntry, ...]:
    """Every suite that is installed here."""
    return tuple(
        SuiteEntry(name=name, family=vecenv.family(name), num_tasks=count, label=f"{name} ({count} tasks)")
        for name in vecenv.list_suites()
        for count in [len(vecenv.list_tasks(name))]
    )


@functools.cache
def tasks(suite: str) -> tuple[TaskEntry, ...]:
    """The tasks of a suite, in its order.

    Raises:
        SessionError: there is no such suite.
    """
    check_suite(suite)
    per_task = vecenv.eval_metadata(suite)["episodes_per_task"]
    named = vecenv.family(suite) != "libero"
    rows = []
    for index, task in enumerate(vecenv.list_tasks(suite)):
        episodes = per_task if isinstance(per_task, int) else per_task[index]
        key = task.name if named else index
        rows.append(
            TaskEntry(
                task=key, label=f"{key}: {task.instruction}", instruction=task.instruction, num_episodes=int(episodes)
            )
        )
    return tuple(rows)


def check_suite(suite: str) -> None:
    """Refuse a suite that does not exist.

    Raises:
        SessionError: with the names that come close.
    """
    known = vecenv.list_suites()
    if suite not in known:
        raise SessionError(unknown("suite", suite, known))


def task_index(suite: str, task: int | str) -> int:
    """Index of a task given by index, by its digits, or by name.

    Raises:
        SessionError: there is no such suite or task.
    """
    there = tasks(suite)
    names = [each.name for each in vecenv.list_tasks(suite)]
    if isinstance(task, str) and task in names:
        return names.index(task)
    if isinstance(task, str) and not (task.isascii() and task.isdecimal() and len(task) < 10):
        raise SessionError(f"{suite} has no task {task!r}: it has 0 to {len(there) - 1}, or a task's name")
    if not 0 <= int(task) < len(there):
        raise SessionError(f"{suite} has no task {task}: it has 0 to {len(there) - 1}")
    return int(task)


def policies(*, trusted: bool) -> dict[str, str]:
    """Policies by name, with a description.

    Args:
        trusted: those behind servers too, and one's own by ``module:Class``.
    """
    rows = {name: DESCRIPTIONS.get(name, name) for name in BUILTIN if trusted or name not in SERVERS}
    return rows | ({"module:Class": "your own, as for vecenv eval"} if trusted else {})
