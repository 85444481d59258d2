"""Frozen config dataclasses from keyword arguments: every field by its name and of its type, or a refusal.

In: a dataclass, perhaps an instance to start from, and fields by name; a nested dataclass may be given as a mapping of
its fields. Out: an instance. dacite does the type checks.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Mapping
from typing import Literal, TypeVar, get_args, get_origin, get_type_hints

import dacite
import numpy as np

_T = TypeVar("_T")
# Module names before the names of types in dacite's messages.
_MODULES = re.compile(r"\b(?:[a-z_]+\.)+(?=[A-Z])")


def build(
    kind: type[_T], fields: Mapping[str, object], base: _T | None = None, *, what: str, error: type[Exception]
) -> _T:
    """An instance of ``kind`` with ``fields`` set; the others are those of ``base``, or at their defaults.

    Args:
        kind: a dataclass.
        fields: name -> value.
        base: what to start from; None for the defaults.
        what: what the fields are options of, for messages.
        error: raised for a name that ``kind`` does not have, and for a value of a wrong type.
    """
    known = field_names(kind)
    unknown = [name for name in fields if name not in known]
    if unknown:
        close = difflib.get_close_matches(unknown[0], known, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        given = ", ".join(f"{name}={fields[name]!r}" for name in unknown)
        raise error(f"{what} has no option {given}{hint}; its own: {', '.join(known)}")
    hints = get_type_hints(kind)
    plain = {name: _plain(name, value, hints[name], what, error) for name, value in fields.items()}
    start = {} if base is None else {name: getattr(base, name) for name in known}
    try:
        return dacite.from_dict(kind, {**start, **plain}, dacite.Config(strict=True))
    except dacite.DaciteError as problem:
        raise error(f"{what}: {_MODULES.sub('', str(problem))}") from problem


def field_names(kind: type) -> tuple[str, ...]:
    """The fields of a dataclass that its constructor takes, in their order."""
    return tuple(field.name for field in dataclasses.fields(kind) if field.init)


def _plain(name: str, value: object, hint: object, what: str, error: type[Exception]) -> object:
    """NumPy scalars as Python's; a bool is not taken for a number, though Python says that it is one."""
    if isinstance(value, np.generic):
        value = value.item()
    choices = get_args(hint) if get_origin(hint) is Literal else ()
    if choices and value not in choices:
        raise error(f"{what}: {name}={value!r} is not available; available: {', '.join(map(str, choices))}")
    if isinstance(value, bool) and "bool" not in str(hint) and "Any" not in str(hint):
        raise error(f"{what}: {name}={value!r}: expected {getattr(hint, '__name__', hint)}, not a bool")
    return value
