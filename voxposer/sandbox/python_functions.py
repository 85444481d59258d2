"""Python's own functions and the methods of its types as programs may call them, with sizes checked beforehand.

In: a ``Guard`` and values that it has accepted. Out: plain results. ``voxposer.sandbox.vocabulary`` lists what programs
may use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, SupportsIndex

import numpy as np
import numpy.typing as npt

from voxposer.sandbox.guard import Guard, Refusal, refuse_kind
from voxposer.sandbox.iteration import callable_of
from voxposer.sandbox.numpy_functions import round_array
from voxposer.sandbox.objects import DType, Error, ErrorType, TypeName
from voxposer.sandbox.objects import Function as FunctionValue
from voxposer.sandbox.operators import COMPARED_A_STEP, arithmetic, equal
from voxposer.sandbox.values import (
    APPENDED_BYTES,
    ENTRY_BYTES,
    broadcast,
    count_of,
    digits_of,
    dtype_of,
    hashable,
    in_set_order,
    integer,
    known,
    listed,
    number_of,
    numbers,
    truth,
)

Function = Callable[..., Any]


def comparable(guard: Guard, values: Sequence[Any]) -> list[Any]:
    """Items to put in order: those of one list, or the arguments."""
    items = listed(guard, values[0]) if len(values) == 1 else list(values)
    _require_comparable(guard, items)
    return items


def _require_comparable(guard: Guard, items: list[Any]) -> None:
    weight = guard.weigh(items)
    wrong = weight.kinds - {"number", "text", "None"}
    if wrong:
        raise Refusal(
            "types", f"values of kind {', '.join(sorted(wrong))} put in order; give a key=, such as a position"
        )
    guard.budget.step(len(items) + weight.characters // 100)


def _keyed(guard: Guard, items: list[Any], key: object) -> list[Any]:
    """What items are put in order by."""
    if key is None:
        keys = items
    else:
        call = callable_of(guard, key)
        keys = [_scalar(call(item)) for item in items]
    _require_comparable(guard, keys)
    return keys


def _scalar(value: Any) -> Any:
    """The number in an array of one element, so that it can be compared."""
    return value.item() if isinstance(value, np.ndarray) and value.size == 1 else value


_NO_DEFAULT = object()


def extreme(choose: Function) -> Function:
    """``min`` or ``max``."""

    def apply(guard: Guard, *values: object, key: object = None, default: object = _NO_DEFAULT) -> Any:
        items = listed(guard, values[0]) if len(values) == 1 else list(values)
        if not items and default is not _NO_DEFAULT:
            return default
        keys = _keyed(guard, items, key)
        return items[choose(range(len(items)), key=keys.__getitem__)]

    return apply


def in_order(guard: Guard, iterable: object, key: object = None, reverse: object = False) -> list[Any]:
    """``sorted``."""
    items = listed(guard, iterable)
    keys = _keyed(guard, items, key)
    places = sorted(range(len(items)), key=keys.__getitem__, reverse=truth(guard, reverse))
    return [items[place] for place in places]


def summed(guard: Guard, value: object, start: object = 0) -> Any:
    """``sum``."""
    total = start
    if isinstance(start, str):
        raise Refusal("types", "sum of text; write ''.join(...)")
    for item in listed(guard, value):
        guard.budget.step()
        total = guard.take(arithmetic(guard, "+", total, item))
    return total


def make_range(guard: Guard, *ends: object) -> range:
    """``range``."""
    made = range(*(integer(end) for end in ends))
    for end in (made.start, made.stop, made.step):
        guard.bits(end.bit_length())
    if abs(made.stop - made.start) // abs(made.step) > _FAR:
        raise Refusal("size", f"a range of more than {_FAR} numbers")
    return made


# Numbers in a range: as many as Python can count.
_FAR = 2**62


def absolute(guard: Guard, value: object) -> Any:
    """``abs``."""
    broadcast(guard, numbers(guard, value))
    return abs(numbers(guard, value))


def rounded(guard: Guard, value: object, ndigits: object = None) -> Any:
    """``round`` of a number or an array."""
    if isinstance(value, np.ndarray):
        return round_array(guard, value, 0 if ndigits is None else ndigits)
    return round(number_of(value), None if ndigits is None else digits_of(ndigits))


def ignored_print(guard: Guard, *values: object, sep: object = " ", end: object = "", flush: object = False) -> None:
    """Accepted, because models like to print; it goes nowhere."""


def is_instance(guard: Guard, value: object, of: object) -> bool:
    """``isinstance`` of the types that programs can name."""
    types = of if isinstance(of, tuple) else (of,)
    return any(_is_of(value, kind) for kind in types)


def _is_of(value: object, kind: object) -> bool:
    if isinstance(kind, ErrorType):
        return isinstance(value, Error) and issubclass(value.python, kind.python)
    name = kind.name if isinstance(kind, (DType, TypeName, FunctionValue)) else ""
    if name not in _TYPES:
        raise Refusal("types", f"isinstance takes types: {', '.join(_TYPES)}")
    return isinstance(value, _TYPES[name])


_TYPES: dict[str, tuple[type, ...]] = {
    "int": (int,),
    "float": (float,),
    "bool": (bool,),
    "str": (str,),
    "list": (list,),
    "tuple": (tuple,),
    "dict": (dict,),
    "set": (set,),
    "range": (range,),
    "np.ndarray": (np.ndarray,),
    "np.integer": (np.integer,),
    "np.floating": (np.floating,),
    "np.generic": (np.generic,),
    "np.number": (np.number,),
    "np.bool_": (np.bool_,),
    "np.int64": (np.int64,),
    "np.int32": (np.int32,),
    "np.float64": (np.float64,),
    "np.float32": (np.float32,),
}


def is_callable(guard: Guard, value: object) -> bool:
    """``callable``."""
    return isinstance(value, (FunctionValue, DType, ErrorType))


def make_dict(guard: Guard, given: object = (), /, **named: object) -> dict[Any, Any]:
    """``dict``."""
    made: dict[Any, Any] = {}
    update_dict(guard, made, given, **named)
    return made


def update_dict(guard: Guard, value: dict[Any, Any], given: object = (), /, **named: object) -> None:
    """``dict.update``."""
    pairs = list(given.items()) if isinstance(given, dict) else [listed(guard, pair) for pair in listed(guard, given)]
    guard.length(len(value) + len(pairs) + len(named))
    guard.hold((len(pairs) + len(named)) * ENTRY_BYTES)
    guard.budget.step((len(pairs) + len(named)) // 10)
    for pair in pairs:
        if len(pair) != 2:
            raise Refusal("value", f"{len(pair)} values where a key and a value belong")
        value[hashable(guard, pair[0])] = pair[1]
    value.update(named)


def make_set(guard: Guard, iterable: object = ()) -> set[Any]:
    """``set``."""
    return {hashable(guard, item) for item in listed(guard, iterable)}


def set_method(name: str) -> Function:
    """A method of sets that takes other values to loop over: union and the like."""
    function = getattr(set, name)

    def apply(guard: Guard, value: set[Any], *others: object) -> Any:
        given = [make_set(guard, other) for other in others]
        guard.length(len(value) + sum(len(other) for other in given))
        guard.budget.step((len(value) + sum(len(other) for other in given)) // 10)
        guard.hold(sum(len(other) for other in given) * ENTRY_BYTES)
        return function(value, *given)

    return apply


def set_item_method(name: str) -> Function:
    """A method of sets that takes one item: add, discard, remove."""
    function = getattr(set, name)

    def apply(guard: Guard, value: set[Any], item: object) -> None:
        guard.length(len(value) + 1)
        guard.hold(ENTRY_BYTES)
        function(value, hashable(guard, item))

    return apply


def pop_from_set(guard: Guard, value: set[Any]) -> Any:
    """``set.pop``: the first in the order of ``iterate``."""
    if not value:
        raise Refusal("value", "pop from an empty set", KeyError)
    item = in_set_order(value)[0]
    value.discard(item)
    return item


def deep_copy(guard: Guard, value: object) -> Any:
    """``copy.deepcopy`` of numbers, text, arrays, lists, tuples, dictionaries and sets."""
    guard.weigh(value)
    return _copied(guard, value)


def shallow_copy(guard: Guard, value: object) -> Any:
    """``copy.copy``."""
    if isinstance(value, np.ndarray):
        return _copied(guard, value)
    return value.copy() if isinstance(value, (list, dict, set)) else value


def _copied(guard: Guard, value: Any) -> Any:
    if isinstance(value, np.ndarray):
        guard.room(value.shape, value.itemsize)
        return guard.take(value.copy())
    if isinstance(value, (list, tuple)):
        return guard.take(type(value)(_copied(guard, item) for item in value))
    if isinstance(value, dict):
        return guard.take({key: _copied(guard, item) for key, item in value.items()})
    return guard.take(set(value)) if isinstance(value, set) else value


def astype(guard: Guard, value: np.ndarray, dtype: object) -> Any:
    """``array.astype``."""
    guard.room(np.shape(value))
    return np.asarray(value).astype(dtype_of(dtype))[()]


def tolist(guard: Guard, value: npt.ArrayLike) -> Any:
    """``array.tolist``."""
    guard.length(np.prod(np.maximum(np.shape(value), 1), dtype=float))
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
    guard.order(value.size)
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
    guard.budget.step(len(value) // 100)
    return value.pop(integer(place))


def clear(guard: Guard, value: Any) -> None:
    """``clear`` of a list, dictionary or set."""
    value.clear()


def pop_key(guard: Guard, value: dict[Any, Any], key: object, default: object = _NO_DEFAULT) -> Any:
    """``dict.pop``."""
    return value.pop(known(guard, value, key)) if default is _NO_DEFAULT else value.pop(hashable(guard, key), default)


def set_default(guard: Guard, value: dict[Any, Any], key: object, default: object = None) -> Any:
    """``dict.setdefault``."""
    guard.length(len(value) + 1)
    guard.hold(ENTRY_BYTES)
    return value.setdefault(hashable(guard, key), default)


def places_of(guard: Guard, value: Sequence[Any], item: object) -> Iterator[int]:
    """The places at which an item is in a list or tuple."""
    guard.weigh(value)
    guard.weigh(item)
    return (place for place, each in enumerate(value) if each is item or truth(guard, equal(guard, each, item)))


def index_of(guard: Guard, value: Sequence[Any], item: object) -> int:
    """``list.index`` and ``tuple.index``."""
    place = next(places_of(guard, value, item), None)
    if place is None:
        raise Refusal("value", "the item is not in it", ValueError)
    return place


def count_in(guard: Guard, value: Sequence[Any], item: object) -> int:
    """``list.count`` and ``tuple.count``."""
    return sum(1 for _ in places_of(guard, value, item))


def remove_item(guard: Guard, value: list[Any], item: object) -> None:
    """``list.remove``."""
    del value[index_of(guard, value, item)]


def sort_list(guard: Guard, value: list[Any], *, key: object = None, reverse: object = False) -> None:
    """``list.sort``."""
    value[:] = in_order(guard, value, key, reverse)


def replace_text(guard: Guard, value: str, old: str, new: str, count: object = -1) -> str:
    """``str.replace``."""
    found = value.count(require_text(old))
    guard.characters(len(value) + found * len(require_text(new)))
    return value.replace(old, new, integer(count))


def join_text(guard: Guard, value: str, parts: object) -> str:
    """``str.join``."""
    pieces = [require_text(part) for part in listed(guard, parts)]
    guard.characters(sum(len(piece) + len(value) for piece in pieces) - (len(value) if pieces else 0))
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
        given = [_texts(argument) if name in _SEVERAL else require_text(argument) for argument in arguments]
        length = sum(len(item) for item in given)
        guard.budget.step(len(value) * max(length, 1) // COMPARED_A_STEP)
        return function(value, *given)

    return apply


# Methods that take a tuple of texts as well.
_SEVERAL = ("startswith", "endswith")


def _texts(value: object) -> str | tuple[str, ...]:
    return tuple(require_text(item) for item in value) if isinstance(value, tuple) else require_text(value)


def padding(name: str) -> Function:
    """``ljust``, ``rjust``, ``center`` or ``zfill``."""
    function = getattr(str, name)

    def apply(guard: Guard, value: str, width: object, *fill: object) -> str:
        guard.characters(count_of(width))
        return function(value, integer(width), *(require_text(character) for character in fill))

    return apply


def split_text(guard: Guard, value: str, sep: object = None, maxsplit: object = -1) -> list[str]:
    """``str.split``."""
    guard.length(len(value))
    return value.split(None if sep is None else require_text(sep), integer(maxsplit))


def dict_method(name: str) -> Function:
    """``dict.keys``, ``values`` or ``items``, as a list."""
    function: Callable[[Any], Iterable[Any]] = getattr(dict, name)

    def apply(guard: Guard, value: dict[Any, Any]) -> list[Any]:
        guard.budget.step(len(value) // 10)
        return list(function(value))

    return apply
