"""Where an environment's tasks come from: the installed packages, or a folder that ``vecenv compile`` wrote.

An environment gets a task's goal, starts and scene through :class:`Task`, which is the same for both:
``installed_tasks`` here reads the packages and compiles, ``vecenv.libero.tasks.export`` reads the folder.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.cache import cached_scene
from vecenv.libero.scene.contacts import Contacts
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks import settled
from vecenv.libero.tasks.settled import SettledStarts
from vecenv.libero.tasks.suites import TaskSpec, list_tasks


@runtime_checkable
class Task(Protocol):
    """One task of a suite, as an environment needs it."""

    @property
    def name(self) -> str:
        """Upstream's task name."""
        ...

    @property
    def instruction(self) -> str:
        """The instruction that a policy receives."""
        ...

    def problem(self) -> Problem:
        """The parsed task file."""
        ...

    def init_states(self) -> np.ndarray:
        """The stored init states [50, 1 + nq + nv], rows of time (seconds), qpos, qvel."""
        ...

    def settled(self) -> SettledStarts:
        """The init states at rest."""
        ...

    def scene(
        self,
        contact_pairs: tuple[tuple[str, str], ...],
        lean_for: tuple[Problem, ...] | None = None,
        contacts: Contacts = "published",
    ) -> Scene:
        """The compiled scene, the same object whenever it is the same.

        Tasks of one ``problem().scene_key()`` share a scene.

        Args:
            contact_pairs: things whose contacts its sensors count; it may have more.
            lean_for: all tasks of the suite that share it, to fit lean collision geoms for; None keeps upstream's.
            contacts: ``"published"`` or ``"current"``, see ``vecenv.libero.scene.contacts``.
        """
        ...


@dataclass(frozen=True)
class InstalledTask:
    """A task read from the installed packages; its scene is compiled here, or comes from the cache on disk."""

    spec: TaskSpec

    @property
    def name(self) -> str:
        """See `Task`."""
        return self.spec.name

    @property
    def instruction(self) -> str:
        """See `Task`."""
        return self.spec.instruction

    def problem(self) -> Problem:
        """See `Task`."""
        return self.spec.problem()

    def init_states(self) -> np.ndarray:
        """See `Task`."""
        return self.spec.init_states()

    def settled(self) -> SettledStarts:
        """See `Task`."""
        return settled.load(self.spec)

    def scene(
        self,
        contact_pairs: tuple[tuple[str, str], ...],
        lean_for: tuple[Problem, ...] | None = None,
        contacts: Contacts = "published",
    ) -> Scene:
        """See `Task`."""
        return compiled(self.problem(), contact_pairs, lean_for, contacts)


def installed_tasks(suite: str) -> tuple[InstalledTask, ...]:
    """The tasks of a suite in upstream's order; errors of ``suites.list_tasks``."""
    return tuple(InstalledTask(spec) for spec in list_tasks(suite))


@functools.lru_cache(maxsize=64)
def compiled(
    problem: Problem,
    contact_pairs: tuple[tuple[str, str], ...],
    lean_for: tuple[Problem, ...] | None = None,
    contacts: Contacts = "published",
) -> Scene:
    """A problem's scene, the same object for the same arguments."""
    return cached_scene(problem, contact_pairs=contact_pairs, lean_for=lean_for, contacts=contacts)
