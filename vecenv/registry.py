"""Which benchmark a suite belongs to: the one table that leads from a suite's name to the package that runs it.

A family is a module with the functions of ``Family``. The table names modules instead of importing them, so that
``import vecenv`` loads neither MuJoCo nor SAPIEN, and so that nothing here depends on what lies above it. To add a
benchmark, write such a module and add a line.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol, cast

from vecenv.errors import InvalidInput, MissingDependency
from vecenv.util.names import shown

if TYPE_CHECKING:
    from vecenv.contract import BatchEnv

FAMILIES: Mapping[str, str] = MappingProxyType({"libero": "vecenv.libero.family", "simpler": "vecenv.simpler.family"})
"""Family -> the module that implements it. Suites are named ``family/suite``; LIBERO's have no prefix."""
_WITHOUT_PREFIX = "libero"


class OptionError(InvalidInput):
    """An option of ``make`` that this kind of suite does not have, or of a wrong type; the message names both."""


class ExtraMissing(MissingDependency):
    """A suite needs packages that are not installed; the message has the pip command."""


class TaskInfo(Protocol):
    """What every task says of itself; families add more."""

    @property
    def index(self) -> int:
        """Position in its suite."""
        ...

    @property
    def name(self) -> str:
        """Name in its suite."""
        ...

    @property
    def instruction(self) -> str:
        """What a policy is told."""
        ...


class Family(Protocol):
    """A benchmark: the functions that its module has."""

    def list_suites(self) -> tuple[str, ...]:
        """Names of its suites."""
        ...

    def list_tasks(self, suite: str) -> Sequence[TaskInfo]:
        """The tasks of a suite in upstream's order; an unknown suite is a ``KeyError`` that lists those there are."""
        ...

    def eval_metadata(self, suite: str, protocol: str) -> dict[str, object]:
        """What an evaluation of a suite consists of."""
        ...

    def config_type(self) -> type:
        """The frozen dataclass of its options."""
        ...

    def make(self, suite: str, tasks: object, episodes: object, config: object) -> BatchEnv:
        """An environment; ``config`` is an instance of ``config_type()``."""
        ...


def family_name(suite: str) -> str:
    """Which benchmark a suite belongs to by its name: ``"simpler"`` for ``simpler/...``, else ``"libero"``.

    Raises:
        OptionError: the name is no text.
    """
    if not isinstance(suite, str):
        raise OptionError(f"suite={shown(suite)}: expected the name of a suite, such as 'libero_goal'")
    prefix = suite.split("/")[0]
    return prefix if prefix in FAMILIES else _WITHOUT_PREFIX


def family(name: str) -> Family:
    """The module of a family.

    Raises:
        OptionError: there is no such family.
    """
    if not isinstance(name, str) or name not in FAMILIES:
        raise OptionError(f"family={shown(name)}: expected one of {', '.join(FAMILIES)}, or None for all suites")
    return cast(Family, importlib.import_module(FAMILIES[name]))


def family_of(suite: str) -> Family:
    """The module of the family that a suite belongs to."""
    return family(family_name(suite))
