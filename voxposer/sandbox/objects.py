"""Values of programs that Python itself has no safe kind for: functions, iterators, errors, modules and types.

Plain records: a program can call, loop over, raise or name them, but read nothing of them. What they do is in
``voxposer.sandbox.definitions``, ``iteration`` and ``statements``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Function:
    """Something to call: a program's own function, one of the vocabulary's or one of the host's.

    Attributes:
        name: for messages.
        call: takes the evaluated arguments.
    """

    name: str
    call: Callable[..., Any]


@dataclass(frozen=True, eq=False)
class Stream:
    """An iterator: a generator, or what ``map``, ``filter``, ``zip``, ``enumerate``, ``reversed`` and ``iter`` make.

    Attributes:
        name: for messages.
        items: the items that are left; steps and depth are counted as they are taken.
    """

    name: str
    items: Iterator[Any]


@dataclass(frozen=True)
class ErrorType:
    """A class of errors by its name, such as ``ValueError``.

    Attributes:
        python: Python's class, which only decides what catches what.
    """

    python: type[BaseException]

    @property
    def name(self) -> str:
        """Its name in programs."""
        return self.python.__name__


@dataclass(frozen=True, eq=False)
class Error:
    """An error that a program made, or caught.

    Attributes:
        python: Python's class of it.
        text: its message.
    """

    python: type[BaseException]
    text: str


@dataclass(frozen=True)
class Module:
    """A module by its name: what it has is looked up in the vocabulary, or, for ``given``, in the given functions."""

    name: str


class DType:
    """A number type, such as ``int`` in ``x.astype(int)`` and in ``int(x)``."""

    def __init__(self, name: str, dtype: type[np.generic]) -> None:
        self.name, self.dtype = name, dtype


@dataclass(frozen=True)
class TypeName:
    """A type that programs name in ``isinstance`` only, such as ``np.ndarray``."""

    name: str


# Classes of errors that programs may name. ``BaseException`` catches what ``Exception`` does: limits are not errors.
ERRORS: Mapping[str, type[BaseException]] = MappingProxyType(
    {
        kind.__name__: kind
        for kind in (
            *(BaseException, Exception, ArithmeticError, AssertionError, AttributeError, IndexError, KeyError),
            *(LookupError, NameError, NotImplementedError, OverflowError, RuntimeError, StopIteration, TypeError),
            *(UnboundLocalError, ValueError, ZeroDivisionError),
        )
    }
)


def error_class(error: BaseException) -> type[BaseException] | None:
    """The class by which programs may catch an error of Python; None for exhausted memory or nesting."""
    if isinstance(error, (MemoryError, RecursionError)) or not isinstance(error, Exception):
        return None
    return next(kind for kind in type(error).__mro__ if ERRORS.get(kind.__name__) is kind)
