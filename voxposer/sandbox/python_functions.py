"""Python's own functions and the methods of its types as programs may call them, with sizes checked beforehand.

In: a ``Guard`` and values that it has accepted. Out: plain results. ``voxposer.sandbox.vocabulary`` lists what programs
may use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, SupportsIndex

import numpy as np
import numpy.typing as npt

from voxposer.sandbox.guard import Guard, Record, Refusal, kind_of, refuse_kind
from voxposer.sandbox.numpy_functions import round_array
from voxposer.sandbox.operators import arithmetic
from voxposer.sandbox.values import (
    APPENDED_BYTES,
    broadcast,
    digits_of,
    dtype_of,
    integer,
    listed,
    number_of,
    numbers,
    truth,
)

Function = Callable[..., Any]


def comparable(guard: Guard, values: Sequence[Any]) -> list[Any]:
    """Items to put in order: those of one list, or the arguments."""
    items = listed(guard, values[0]) if len(values) == 1 else list(values)
    guard.weigh(items)
    for item in items:
        if isinstance(item, (np.ndarray, Record)):
            refuse_kind(item, "numbers or text to put in order")
    return items


def extreme(choose: Function) -> Function:
    """``min`` or ``max``."""

    def apply(guard: Guard, *values: object) -> Any:
        return choose(comparable(guard, values))

    return apply


def in_order(guard: Guard, value: object, reverse: object = False) -> list[Any]:
    """``sorted``."""
    return sorted(comparable(guard, (value,)), reverse=truth(guard, reverse))


def summed(guard: Guard, value: object, start: object = 0) -> Any:
    """``sum``."""
    total = start
    for item in listed(guard, value):
        total = guard.take(arithmetic(guard, "+", total, item))
    return total


def to_int(guard: Guard, value: object = 0) -> int:
    """``int``."""
    return int(single_number(value))


def to_float(guard: Guard, value: object = 0) -> float:
    """``float``."""
    return float(single_number(value))


def single_number(value: object) -> Any:
    """A number, the only element of an array, or text that says a number."""
    if isinstance(value, np.ndarray) and value.size == 1:
        return value.item()
    return value if kind_of(value) in ("number", "text") else refuse_kind(value, "a number")


def make_range(guard: Guard, *ends: object) -> range:
    """``range``."""
    made = range(*(integer(end) for end in ends))
    for end in (made.start, made.stop, made.step):
        guard.bits(end.bit_length())
    return made


def zipped(guard: Guard, *values: object) -> list[Any]:
    """``zip``, as a list."""
    return list(zip(*(listed(guard, value) for value in values), strict=False))


def enumerated(guard: Guard, value: object, start: object = 0) -> list[Any]:
    """``enumerate``, as a list."""
    return list(enumerate(listed(guard, value), integer(start)))


def absolute(guard: Guard, value: object) -> Any:
    """``abs``."""
    broadcast(guard, numbers(guard, value))
    return abs(numbers(guard, value))


def rounded(guard: Guard, value: object, ndigits: object = None) -> Any:
    """``round`` of a number or an array."""
    if isinstance(value, np.ndarray):
        return round_array(guard, value, 0 if ndigits is None else ndigits)
    return round(number_of(value), None if ndigits is None else digits_of(ndigits))


def ignored_print(guard: Guard, *values: object) -> None:
    """Accepted, because models like to print; it goes nowhere."""


def astype(guard: Guard, value: np.ndarray, dtype: object) -> Any:
    """``array.astype``."""
    guard.room(np.shape(value))
    return np.asarray(value).astype(dtype_of(dtype))[()]


def tolist(guard: Guard, value: npt.ArrayLike) -> Any:
    """``array.tolist``."""
    guard.length(np.size(value))
    return np.asarray(value).tolist()


def array_item(guard: Guard, value: object, *index: object) -> Any:
    """``array.item``."""
    return np.asarray(value).item(*(integer(place) for place in index))


def fill_in_place(guard: Guard, value: np.ndarray, number: object) -> None:
    """``array.fill``."""
    guard.room(value.shape)
    value.fill(number_of(number))


def sort_in_place(guard: Guard, value: np.ndarray, axis: SupportsIndex = -1) -> None:
    """``array.sort``."""
    guard.room(value.shape)
    value.sort(axis=axis)


def append_item(guard: Guard, value: list[Any], item: object) -> None:
    """``list.append``."""
    guard.length(len(value) + 1)
    guard.hold(APPENDED_BYTES)
    value.append(item)


def extend_list(guard: Guard, value: list[Any], items: object) -> None:
    """``list.extend``."""
    more = listed(guard, items)
    guard.length(len(value) + len(more))
    guard.hold(len(more) * APPENDED_BYTES)
    value.extend(more)


def insert_item(guard: Guard, value: list[Any], place: object, item: object) -> None:
    """``list.insert``."""
    guard.length(len(value) + 1)
    guard.hold(APPENDED_BYTES)
    value.insert(integer(place), item)


def pop_item(guard: Guard, value: list[Any], place: object = -1) -> Any:
    """``list.pop``."""
    return value.pop(integer(place))


def sequence_method(name: str) -> Function:
    """A method of lists and tuples that looks for an item."""

    def apply(guard: Guard, value: object, item: object) -> Any:
        guard.weigh(value)
        guard.weigh(item)
        return getattr(value, name)(item)

    return apply


def sort_list(guard: Guard, value: list[Any], reverse: object = False) -> None:
    """``list.sort``."""
    value[:] = in_order(guard, value, reverse)


def replace_text(guard: Guard, value: str, old: str, new: str) -> str:
    """``str.replace``."""
    found = value.count(require_text(old))
    guard.characters(len(value) + found * len(require_text(new)))
    return value.replace(old, new)


def join_text(guard: Guard, value: str, parts: object) -> str:
    """``str.join``."""
    pieces = [require_text(part) for part in listed(guard, parts)]
    guard.characters(sum(len(piece) + len(value) for piece in pieces))
    return value.join(pieces)


def require_text(value: object) -> str:
    """The value, if it is text."""
    return value if isinstance(value, str) else refuse_kind(value, "text")


def text_method(name: str, least: int, most: int) -> Function:
    """A method of text that takes ``least`` to ``most`` texts."""
    function = getattr(str, name)

    def apply(guard: Guard, value: str, *arguments: object) -> Any:
        if not least <= len(arguments) <= most:
            raise Refusal("types", f".{name}() got {len(arguments)} arguments")
        return function(value, *(require_text(argument) for argument in arguments))

    return apply


def split_text(guard: Guard, value: str, sep: object = None) -> list[str]:
    """``str.split``."""
    guard.length(len(value))
    return value.split(None if sep is None else require_text(sep))


def dict_method(name: str) -> Function:
    """``dict.keys``, ``values`` or ``items``, as a list."""
    function: Callable[[Any], Iterable[Any]] = getattr(dict, name)
    return lambda guard, value: list(function(value))
