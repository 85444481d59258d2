"""Values as text: ``str``, ``repr``, f-strings, ``str.format`` and ``%``.

In: a ``Guard`` and values that it has accepted. Out: text of a bounded length that is the same in every process. A
format may set a fill, an alignment, a sign, a width, a precision and a type, the numbers with two digits at most;
fields of ``str.format`` are values and not walks to their attributes or items.
"""

from __future__ import annotations

import re
import string
from typing import Any

import numpy as np

from voxposer.sandbox.guard import Guard, Opaque, Record, RecordList, Refusal, kind_of, refuse_kind
from voxposer.sandbox.objects import DType, Error, ErrorType, Function, Stream, TypeName

# Numbers in one piece of text.
_PRINTED = 1000
_FORMAT = re.compile(r"([^{}]?[<>^=])?[-+ ]?#?0?\d{0,2}[,_]?(\.\d{1,2})?[bdeEfFgGosxX%]?")
_PERCENT = re.compile(
    r"%(?:\((?P<key>[^()]*)\))?(?P<flags>[-+ 0#]*)(?P<width>\*|\d*)(?P<digits>\.\*|\.\d*)?(?P<type>.|$)", re.S
)
_PERCENT_TYPES = "sdifFgGeExXrou"


def text(guard: Guard, value: object) -> str:
    """``str(value)``; NumPy's numbers look like Python's.

    Raises:
        Refusal: it would be too long, or the value has no text.
    """
    _require_short(guard, value)
    made = str(_plain(guard, value))
    guard.characters(len(made))
    return made


def representation(guard: Guard, value: object) -> str:
    """``repr(value)``."""
    _require_short(guard, value)
    made = str(_plain(guard, value)) if isinstance(value, Record) else repr(_plain(guard, value))
    guard.characters(len(made))
    return made


def formatted(guard: Guard, value: object, spec: str, conversion: str = "") -> str:
    """``format(value, spec)``, after ``!s`` or ``!r``.

    Raises:
        Refusal: the format is not plain, or given for something other than a number or text.
    """
    if conversion not in ("", "s", "r"):
        raise Refusal("formats", f"the conversion !{conversion}; write !r, !s or none")
    if conversion == "r":
        value = representation(guard, value)
    elif conversion == "s" or not spec:
        value = text(guard, value)
    if not spec:
        return str(value)
    if not _FORMAT.fullmatch(spec):
        raise Refusal("formats", f"the format {spec[:40]!r}; write one such as .2f, 5d or >10, with two digits at most")
    if kind_of(value) not in ("number", "text"):
        raise Refusal(
            "types", f"the format {spec!r} for a value of kind {kind_of(value)}; format its numbers one by one"
        )
    made = format(value.item() if isinstance(value, np.generic) else value, spec)  # pyright: ignore[reportArgumentType]
    guard.characters(len(made))
    return made


def format_text(guard: Guard, template: str, /, *values: object, **named: object) -> str:
    """``template.format(*values, **named)``, whose fields are numbers, names or nothing."""
    pieces: list[str] = []
    automatic = 0
    for literal, name, spec, conversion in string.Formatter().parse(template):
        pieces.append(literal)
        if name is None:
            continue
        if name == "":
            name, automatic = str(automatic), automatic + 1
        value = _argument(name, values, named)
        if spec and "{" in spec:
            spec, automatic = _nested(guard, spec, values, named, automatic)
        pieces.append(formatted(guard, value, spec or "", conversion or ""))
        guard.budget.step()
    guard.characters(sum(len(piece) for piece in pieces))
    return "".join(pieces)


def _nested(
    guard: Guard, spec: str, values: tuple[object, ...], named: dict[str, object], automatic: int
) -> tuple[str, int]:
    """A format with the fields inside it replaced, and the number of the next automatic field."""
    pieces: list[str] = []
    for literal, name, inner, _ in string.Formatter().parse(spec):
        pieces.append(literal)
        if name is None:
            continue
        if inner:
            raise Refusal("formats", "a format inside a format inside a format")
        if name == "":
            name, automatic = str(automatic), automatic + 1
        pieces.append(text(guard, _argument(name, values, named)))
    return "".join(pieces), automatic


def _argument(name: str, values: tuple[object, ...], named: dict[str, object]) -> object:
    if not re.fullmatch(r"\w+", name):
        raise Refusal("formats", f"the field {name[:40]!r} walks to an attribute or item; give that value to format()")
    if not name.isdecimal():
        if name not in named:
            raise Refusal("value", f"format() is not given {name[:40]!r}", KeyError)
        return named[name]
    if len(name) > 4 or int(name) >= len(values):
        raise Refusal("value", f"format() is given {len(values)} values, not one numbered {name[:40]}", IndexError)
    return values[int(name)]


def percent(guard: Guard, template: str, given: object) -> str:
    """``template % given``."""
    values = list(given) if isinstance(given, tuple) else [given]
    pieces: list[str] = []
    end = taken = 0
    named = False
    for found in _PERCENT.finditer(template):
        pieces.append(template[end : found.start()])
        end = found.end()
        guard.budget.step()
        if found[0] == "%%":
            pieces.append("%")
            continue
        named = named or found["key"] is not None
        if named:
            value = _by_key(found["key"], given)
        elif taken < len(values):
            value, taken = values[taken], taken + 1
        else:
            raise Refusal("types", f"a format with more than the {len(values)} values given after %")
        pieces.append(_percent_piece(guard, found, value))
    if not named and taken < len(values) and not isinstance(given, (dict, list, range)):
        raise Refusal("types", f"{len(values)} values after % for a format with {taken} places")
    pieces.append(template[end:])
    guard.characters(sum(len(piece) for piece in pieces))
    return "".join(pieces)


def _by_key(key: str | None, given: object) -> object:
    if key is None or not isinstance(given, dict):
        raise Refusal("types", "a format with %(name)s takes a dictionary after %, and names alone")
    if key not in given:
        raise Refusal("value", f"the dictionary after % has no {key[:40]!r}", KeyError)
    return given[key]


def _percent_piece(guard: Guard, found: re.Match[str], value: object) -> str:
    width, digits, kind = found["width"], (found["digits"] or "")[1:], found["type"]
    if kind not in _PERCENT_TYPES or kind == "" or "*" in width + digits or max(len(width), len(digits)) > 2:
        shown = found[0][:40]
        raise Refusal("formats", f"the format {shown!r}; write one such as %s, %d or %.2f, with two digits at most")
    if kind in "sr":
        value = text(guard, value) if kind == "s" else representation(guard, value)
    elif kind_of(value) != "number":
        refuse_kind(value, f"a number for %{kind}")
    plain = value.item() if isinstance(value, np.generic) else value
    return f"%{found['flags']}{width}{found['digits'] or ''}{'s' if kind == 'r' else kind}" % (plain,)


def _require_short(guard: Guard, value: object) -> None:
    """Refuse to print what would be long, before it is printed."""
    weight = guard.weigh(value)
    guard.characters(weight.characters)
    if weight.numbers > _PRINTED:
        raise Refusal("size", f"{weight.numbers} numbers as text; {_PRINTED} are allowed")
    guard.budget.step(weight.numbers)


def _plain(guard: Guard, value: object) -> Any:
    """A value whose ``str`` reveals no more than a program may know, and is the same each time."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(guard, item) for item in value)
    if isinstance(value, dict):
        return {_plain(guard, key): _plain(guard, item) for key, item in value.items()}
    if isinstance(value, set):
        return _Shown("{" + ", ".join(sorted(repr(_plain(guard, item)) for item in value)) + "}") if value else set()
    if isinstance(value, Record):
        return guard.host("the observation", str, value)
    if isinstance(value, Error):
        return _Shown(value.text)
    if isinstance(value, (RecordList, Opaque, Function, Stream, ErrorType, DType, TypeName)):
        refuse_kind(value, "something with a text")
    return value


class _Shown:
    """Something whose text and representation are given."""

    def __init__(self, shown: str) -> None:
        self._shown = shown

    def __repr__(self) -> str:
        return self._shown
