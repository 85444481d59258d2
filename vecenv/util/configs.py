"""Frozen config dataclasses from keyword arguments: every field by its name and of its type, or a refusal.

In: a dataclass, perhaps an instance to start from, and fields by name; a nested dataclass may be given as a mapping of
its fields. Out: an instance. dacite does the type checks.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Mapping, Sequence
from typing import Literal, TypeVar, get_args, get_origin, get_type_hints

import dacite
import numpy as np
from dacite.types import is_instance

from vecenv.util import inputs

_T = TypeVar("_T")
# Characters of a message of dacite, which shows the whole value; module names before the names of types in it.
_LONGEST = 500
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
        given = ", ".join(f"{name}={inputs.shown(fields[name])}" for name in unknown)
        raise error(f"{what} has no option {given}{hint}; its own: {', '.join(known)}")
    hints = get_type_hints(kind)
    plain = {name: _plain(name, value, hints[name], what, error) for name, value in fields.items()}
    start = {} if base is None else {name: getattr(base, name) for name in known}
    try:
        return dacite.from_dict(kind, {**start, **plain}, dacite.Config(strict=True))
    except dacite.DaciteError as problem:
        raise error(f"{what}: {_said(problem)}") from problem


def _said(problem: dacite.DaciteError) -> str:
    """The message of one of dacite's errors without module names; of a value that shows itself badly, its field."""
    try:
        said = _MODULES.sub("", str(problem))
    except Exception:
        said = f'wrong value type for field "{getattr(problem, "field_path", "")}"'
    return said if len(said) <= _LONGEST else said[:_LONGEST] + " ..."


def field_names(kind: type) -> tuple[str, ...]:
    """The fields of a dataclass that its constructor takes, in their order."""
    return tuple(field.name for field in dataclasses.fields(kind) if field.init)


def _plain(name: str, value: object, hint: object, what: str, error: type[Exception]) -> object:
    """NumPy scalars as Python's; a bool is not taken for a number, though Python says that it is one."""
    if isinstance(value, np.generic):
        value = value.item()
    choices = get_args(hint) if get_origin(hint) is Literal else ()
    if choices and not (isinstance(value, str) and value in choices):
        given = inputs.shown(value)
        raise error(f"{what}: {name}={given} is not available; available: {', '.join(map(str, choices))}")
    if isinstance(value, bool) and "bool" not in str(hint) and "Any" not in str(hint):
        raise error(f"{what}: {name}={value!r}: expected {getattr(hint, '__name__', hint)}, not a bool")
    return value


def vector(value: object, what: str, error: type[Exception]) -> tuple[float, float, float]:
    """Three finite numbers as a tuple; raises ``error`` where they are none."""
    right = "three finite numbers"
    found = inputs.floats(value, what, right, error, fits=lambda shape: shape == (3,))
    if not np.isfinite(found).all():
        raise error(f"{what}: expected {right}")
    x, y, z = found.tolist()
    return x, y, z


def check(
    instance: object,
    error: type[Exception],
    *,
    positive: Sequence[str] = (),
    vectors: Sequence[str] = (),
    ranges: Mapping[str, tuple[int, int]] | None = None,
) -> None:
    """Check the fields of a frozen dataclass, in its ``__post_init__``; NumPy scalars become Python's.

    Args:
        instance: the dataclass.
        error: raised for a field of a wrong type, for a number that is not finite, and for what the others say.
        positive: fields that are greater than 0.
        vectors: fields of three numbers, which become tuples.
        ranges: by field, the least and the largest integer; None is left to the field's type.
    """
    kind = type(instance)
    what, hints = kind.__name__, get_type_hints(kind)
    for name in field_names(kind):
        given = getattr(instance, name)
        value = vector(given, f"{what}: {name}", error) if name in vectors else given
        value = _plain(name, value, hints[name], what, error)
        if not is_instance(value, hints[name]):
            expected = _MODULES.sub("", str(getattr(hints[name], "__name__", "") or hints[name]))
            raise error(f"{what}: {name}={inputs.shown(value)}: expected {expected}")
        if isinstance(value, float) and not math.isfinite(value):
            raise error(f"{what}: {name}={value}: expected a finite number")
        if name in positive and value is not None and not value > 0:  # type: ignore[operator]
            raise error(f"{what}: {name}={value}: expected a number greater than 0")
        least, most = (ranges or {}).get(name, (None, None))
        if least is not None and most is not None and value is not None and not least <= value <= most:  # type: ignore[operator]
            raise error(f"{what}: {name}={inputs.shown(value)}: need at least {least}, at most {most}")
        if value is not given:
            object.__setattr__(instance, name, value)
