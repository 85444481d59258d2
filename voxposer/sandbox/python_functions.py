"""Python's own functions and the methods of its types as programs may call them, with sizes checked beforehand.

In: a ``Guard`` and values that it has accepted. Out: plain results. ``voxposer.sandbox.vocabulary`` lists what programs
may use.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from voxposer.sandbox.guard import Guard, Record, Refusal, kind_of, refuse_kind
from voxposer.sandbox.numpy_functions import round_array
from voxposer.sandbox.operators import arithmetic
from voxposer.sandbox.values import (
    APPENDED_BYTES,
    broadcast,
    digits_of,
    dtype_of,
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

    def apply(guard: Guard, *values: Any) -> Any:
        return choose(comparable(guard, values))

    return apply


def in_order(guard: Guard, value: Any, reverse: Any = False) -> list[Any]:
    """``sorted``."""
    return sorted(comparable(guard, (value,)), reverse=truth(guard, reverse))


def summed(guard: Guard, value: Any, start: Any = 0) -> Any:
    """``sum``."""
    total = start
    for item in listed(guard, value):
        total = guard.take(arithmetic(guard, "+", total, item))
    return total


def to_int(guard: Guard, value: Any = 0) -> int:
    """``int``."""
    return int(single_number(value))


def to_float(guard: Guard, value: Any = 0) -> float:
    """``float``."""
    return float(single_number(value))


def single_number(value: Any) -> Any:
    """A number, the only element of an array, or text that says a number."""
    if isinstance(value, np.ndarray) and value.size == 1:
        return value.item()
    return value if kind_of(value) in ("number", "text") else refuse_kind(value, "a number")


def make_range(guard: Guard, *ends: Any) -> range:
    """``range``."""
    made = range(*(operator.index(end) for end in ends))
    for end in (made.start, made.stop, made.step):
        guard.bits(end.bit_length())
    return made


def zipped(guard: Guard, *values: Any) -> list[Any]:
    """``zip``, as a list."""
    return list(zip(*(listed(guard, value) for value in values), strict=False))


def enumerated(guard: Guard, value: Any, start: Any = 0) -> list[Any]:
    """``enumerate``, as a list."""
    return list(enumerate(listed(guard, value), operator.index(start)))


def absolute(guard: Guard, value: Any) -> Any:
    """``abs``."""
    broadcast(guard, numbers(guard, value))
    return abs(numbers(guard, value))


def rounded(guard: Guard, value: Any, ndigits: Any = None) -> Any:
    """``round`` of a number or an array."""
    if isinstance(value, np.ndarray):
        return round_array(guard, value, 0 if ndigits is None else ndigits)
    return round(number_of(value), None if ndigits is None else digits_of(ndigits))


def ignored_print(guard: Guard, *values: Any) -> None:
    """Accepted, because models like to print; it goes nowhere."""


def astype(guard: Guard, value: np.ndarray, dtype: Any) -> Any:
    """``array.astype``."""
    guard.room(np.shape(value))
    return np.asarray(value).astype(dtype_of(dtype))[()]


def tolist(guard: Guard, value: Any) -> Any:
    """``array.tolist``."""
    guard.length(np.size(value))
    return np.asarray(value).tolist()


def array_item(guard: Guard, value: Any, *index: Any) -> Any:
    """``array.item``."""
    return np.asarray(value).item(*(operator.index(place) for place in index))


def fill_in_place(guard: Guard, value: np.ndarray, number: Any) -> None:
    """``array.fill``."""
    guard.room(value.shape)
    value.fill(number_of(number))


def sort_in_place(guard: Guard, value: np.ndarray, axis: Any = -1) -> None:
    """``array.sort``."""
    guard.room(value.shape)
    value.sort(axis=axis)


def append_item(guard: Guard, value: list[Any], item: Any) -> None:
    """``list.append``."""
    guard.length(len(value) + 1)
    guard.hold(APPENDED_BYTES)
    value.append(item)


def extend_list(guard: Guard, value: list[Any], items: Any) -> None:
    """``list.extend``."""
    more = listed(guard, items)
    guard.length(len(value) + len(more))
    guard.hold(len(more) * APPENDED_BYTES)
    value.extend(more)


def insert_item(guard: Guard, value: list[Any], place: Any, item: Any) -> None:
    """``list.insert``."""
    guard.length(len(value) + 1)
    guard.hold(APPENDED_BYTES)
    value.insert(operator.index(place), item)


def pop_item(guard: Guard, value: list[Any], place: Any = -1) -> Any:
    """``list.pop``."""
    return value.pop(operator.index(place))


def sequence_method(name: str) -> Function:
    """A method of lists and tuples that looks for an item."""

    def apply(guard: Guard, value: Any, item: Any) -> Any:
        guard.weigh(value)
        guard.weigh(item)
        return getattr(value, name)(item)

    return apply


def sort_list(guard: Guard, value: list[Any], reverse: Any = False) -> None:
    """``list.sort``."""
    value[:] = in_order(guard, value, reverse)


def replace_text(guard: Guard, value: str, old: str, new: str) -> str:
    """``str.replace``."""
    found = value.count(require_text(old))
    guard.characters(len(value) + found * len(require_text(new)))
    return value.replace(old, new)


def join_text(guard: Guard, value: str, parts: Any) -> str:
    """``str.join``."""
    pieces = [require_text(part) for part in listed(guard, parts)]
    guard.characters(sum(len(piece) + len(value) for piece in pieces))
    return value.join(pieces)


def require_text(value: Any) -> str:
    """The value, if it is text."""
    return value if isinstance(value, str) else refuse_kind(value, "text")


def text_method(name: str, least: int, most: int) -> Function:
    """A method of text that takes ``least`` to ``most`` texts."""
    function = getattr(str, name)

    def apply(guard: Guard, value: str, *arguments: Any) -> Any:
        if not least <= len(arguments) <= most:
            raise Refusal("types", f".{name}() got {len(arguments)} arguments")
        return function(value, *(require_text(argument) for argument in arguments))

    return apply


def split_text(guard: Guard, value: str, sep: Any = None) -> list[str]:
    """``str.split``."""
    guard.length(len(value))
    return value.split(None if sep is None else require_text(sep))


def dict_method(name: str) -> Function:
    """``dict.keys``, ``values`` or ``items``, as a list."""
    function: Callable[[Any], Iterable[Any]] = getattr(dict, name)
    return lambda guard, value: list(function(value))
