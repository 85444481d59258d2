"""Values of a program made ready for NumPy and Python: converted, counted and refused where they do not fit.

In: a ``Guard`` and a value that it has accepted. Out: the value in the form that an operation needs, its size checked
before anything is allocated.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from types import MappingProxyType
from typing import Any, SupportsIndex, cast

import numpy as np
import numpy.typing as npt

from voxposer.sandbox.guard import (
    ARRAY_BYTES,
    Guard,
    Opaque,
    Record,
    RecordList,
    Refusal,
    kind_of,
    refuse_kind,
    require_numbers,
)
from voxposer.sandbox.objects import DType, Error, ErrorType, Function, Stream, TypeName

# Largest number of digits for round().
_DIGITS = 20
# Characters of text that is read as an integer.
_DIGITS_READ = 200
# Axes that one call may name, and the largest number of one.
_AXES, _LARGEST_AXIS = 8, 2**31 - 1
# Remainders that are computed without a look at the numbers, and bits between numbers and divisors of all of them.
_FEW, _REMAINDER_BITS = 10_000, 2**28
# Values in a tuple that is a key.
_IN_KEY = 32
# Bytes counted for an item put into a list, and into a dictionary or a set.
APPENDED_BYTES, ENTRY_BYTES = 16, 100

DTYPES: Mapping[str, DType] = MappingProxyType(
    {
        name: DType(name, dtype)
        for name, dtype in {
            "int": np.int64,
            "float": np.float64,
            "bool": np.bool_,
            "np.int64": np.int64,
            "np.int32": np.int32,
            "np.float64": np.float64,
            "np.float32": np.float32,
            "np.bool_": np.bool_,
        }.items()
    }
)


def numbers(guard: Guard, value: object) -> Any:
    """A number or array as it is; a list of numbers as an array."""
    kind = kind_of(value)
    if kind in ("list", "tuple", "range"):
        return array(guard, value)
    if kind == "iterator":
        refuse_kind(value, "numbers (write list(...) around an iterator)")
    return value if kind in ("number", "array") else refuse_kind(value, "numbers")


def broadcast(guard: Guard, *values: npt.ArrayLike) -> None:
    """Refuse an operation whose result would be too large."""
    guard.room(np.broadcast_shapes(*(np.shape(value) for value in values)))


def array(guard: Guard, value: object, dtype: DType | None = None) -> np.ndarray:
    """``np.array`` of numbers, lists of them or arrays."""
    if kind_of(value) not in ("number", "array", "list", "tuple", "range"):
        refuse_kind(value, "numbers")
    weight = guard.weigh(value)
    if not weight.kinds <= {"number", "array", "range"}:
        raise Refusal("types", f"an array of {' and '.join(sorted(weight.kinds))}; only numbers are allowed")
    guard.room((weight.numbers,))
    if not isinstance(value, np.ndarray):
        if "range" in weight.kinds and not isinstance(value, range):  # whose numbers NumPy takes one by one
            guard.length(weight.numbers)
        guard.hold(8 * weight.numbers)  # several lists may become arrays before they are put together
    made = np.arange(value.start, value.stop, value.step) if isinstance(value, range) else np.array(value)
    require_numbers(made)
    return made if dtype is None else made.astype(dtype_of(dtype))


def dtype_of(dtype: object) -> type[np.generic]:
    """The number type that a program named."""
    if not isinstance(dtype, DType):
        raise Refusal("types", f"a dtype is one of {', '.join(DTYPES)}")
    return dtype.dtype


def shape_of(guard: Guard, shape: object) -> tuple[int, ...]:
    """A shape given as an integer, a list or a tuple."""
    lengths = shape if isinstance(shape, (tuple, list)) else (shape,)
    return tuple(integer(length) for length in lengths)


def integer(value: object) -> int:
    """``operator.index(value)``.

    Raises:
        TypeError: the value is not an integer.
    """
    return operator.index(cast(SupportsIndex, value))


def axis_of(value: object) -> int | tuple[int, ...] | None:
    """An axis, several axes, or a shift along each: an integer, a few of them, or None."""
    if value is None:
        return None
    if isinstance(value, (tuple, list)):
        if len(value) > _AXES:
            raise Refusal("size", f"{len(value)} axes; {_AXES} are allowed")
        return tuple(one_axis(item) for item in value)
    return one_axis(value)


def one_axis(value: object) -> int:
    """An axis, or a shift along one."""
    number = integer(value)
    if abs(number) > _LARGEST_AXIS:
        raise Refusal("value", f"an axis or a shift of {number}")
    return number


def count_of(value: object) -> int:
    """A requested count, at least 0."""
    return max(integer(value), 0)


def number_of(value: object) -> int | float:
    """A number as Python's own."""
    if kind_of(value) != "number":
        refuse_kind(value, "a number")
    return value.item() if isinstance(value, np.generic) else cast(float, value)


def single_number(value: object) -> Any:
    """A number, the only element of an array, or text that says a number."""
    if isinstance(value, np.ndarray) and value.size == 1:
        return value.item()
    return value if kind_of(value) in ("number", "text") else refuse_kind(value, "a number")


def to_int(guard: Guard, value: object = 0) -> int:
    """``int``."""
    given = single_number(value)
    if isinstance(given, str) and len(given) > _DIGITS_READ:
        raise Refusal("size", f"an integer of {len(given)} characters; {_DIGITS_READ} are allowed")
    made = int(given)
    guard.bits(made.bit_length())
    return made


def to_float(guard: Guard, value: object = 0) -> float:
    """``float``."""
    return float(single_number(value))


def converted(guard: Guard, dtype: DType, *values: object) -> Any:
    """A number type that is called: ``int(x)``, ``float(x)``, ``bool(x)``, ``np.float32(x)``."""
    if dtype.name in _PLAIN:
        return _PLAIN[dtype.name](guard, *values)
    if len(values) != 1:
        raise Refusal("types", f"{dtype.name} takes one value")
    given = numbers(guard, values[0])
    guard.room(np.shape(given))
    return np.asarray(given).astype(dtype.dtype)[()]


_PLAIN: dict[str, Callable[..., Any]] = {
    "int": to_int,
    "float": to_float,
    "bool": lambda guard, value=False: truth(guard, value),
}


def digits_of(value: object) -> int:
    """A number of digits, within bounds."""
    digits = integer(value)
    if abs(digits) > _DIGITS:
        raise Refusal("size", f"rounding to {digits} digits; {_DIGITS} are allowed")
    return digits


def require_power(guard: Guard, base: object, exponent: object) -> None:
    """Refuse a power of integers that would be too large."""
    if isinstance(base, int) and isinstance(exponent, int) and exponent > 0 and abs(base) > 1:
        guard.bits(int(exponent * math.log2(abs(base))))


def require_near(guard: Guard, dividend: npt.ArrayLike, divisor: npt.ArrayLike) -> None:
    """Refuse remainders that take long: C's ``fmod`` subtracts once for each bit between the two exponents."""
    a, b = np.asarray(dividend), np.asarray(divisor)
    elements = math.prod(np.broadcast_shapes(a.shape, b.shape))
    if elements < _FEW or "f" not in a.dtype.kind + b.dtype.kind:
        return
    largest, smallest = _magnitudes(a)[1], _magnitudes(b)[0]
    bits = math.frexp(largest)[1] - math.frexp(smallest)[1] if largest and smallest else 0
    if elements * bits > _REMAINDER_BITS:
        raise Refusal("steps", f"{elements} remainders of numbers up to {largest:g} by numbers down to {smallest:g}")


def _magnitudes(values: np.ndarray) -> tuple[float, float]:
    """The smallest and the largest magnitude of an array's finite numbers other than 0; 0 and 0 if it has none."""
    sizes = np.abs(values)
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    return (float(sizes.min()), float(sizes.max())) if sizes.size else (0.0, 0.0)


def truth(guard: Guard, value: object) -> bool:
    """The truth value of ``if value:``.

    Raises:
        Refusal: it is an array of several elements.
    """
    kind_of(value)
    if isinstance(value, np.ndarray) and value.size != 1:
        raise Refusal("types", f"an array of {value.size} elements is neither true nor false; use .any() or .all()")
    if isinstance(value, RecordList):
        return length_of(guard, value) > 0
    always = (Record, Opaque, Function, Stream, Error, ErrorType, DType, TypeName)
    return isinstance(value, always) or bool(value)


def hashable(guard: Guard, key: object) -> Any:
    """A key or an item of a set: text, a number, None, or a tuple of a few of them."""
    weight = guard.weigh(key)
    guard.characters(weight.characters)
    if isinstance(key, tuple):
        if not weight.kinds <= {"text", "number", "None"} or _holds_unhashable(key):
            raise Refusal("types", "a tuple as a key holds text, numbers and None only")
        if weight.numbers > _IN_KEY:
            raise Refusal("size", f"a tuple of {weight.numbers} values as a key; {_IN_KEY} are allowed")
        guard.remember_key(key)
    elif kind_of(key) not in ("text", "number", "None"):
        refuse_kind(key, "text or a number as the key")
    return key


def known(guard: Guard, dictionary: Mapping[Any, Any], key: object) -> Any:
    """A key that a dictionary has.

    Raises:
        Refusal: it has no such key.
    """
    if hashable(guard, key) not in dictionary:
        raise Refusal("value", f"the dictionary has no key {key!r:.80}", KeyError)
    return key


def _holds_unhashable(key: tuple[Any, ...]) -> bool:
    return any(
        isinstance(item, (list, dict, set)) or (isinstance(item, tuple) and _holds_unhashable(item)) for item in key
    )


def iterate(guard: Guard, value: object) -> Iterable[Any]:
    """What a loop over the value runs through; ranges, lists and arrays as they are, sets in order of size or spelling.

    Raises:
        Refusal: nothing to loop over.
    """
    if isinstance(value, Stream):
        return value.items
    if isinstance(value, dict):
        return list(value)
    if isinstance(value, set):
        return in_set_order(value)
    if isinstance(value, np.ndarray) and value.ndim == 0:
        refuse_kind(value[()], "something to loop over")
    if isinstance(value, RecordList):
        return guard.host("the list of observations", list, value)
    if isinstance(value, (list, tuple, str, range, np.ndarray)):
        return value
    refuse_kind(value, "something to loop over")


def in_set_order(items: set[Any]) -> list[Any]:
    """The items of a set in an order that is the same in every process: None, NaN, numbers by size, text by spelling,
    tuples item by item."""
    return sorted(items, key=_rank)


def _rank(item: Any) -> tuple[Any, ...]:
    """What items of a set are put in order by: it holds them, and copies nothing."""
    if item is None:
        return (0,)
    if isinstance(item, str):
        return (3, item)
    if isinstance(item, tuple):
        return (4, *map(_rank, item))
    return (2, item) if item == item else (1,)


def counted(guard: Guard, value: object) -> Iterator[Any]:
    """What a loop over the value runs through, each item a step: for loops that Python runs, not the program."""
    for item in iterate(guard, value):
        if not isinstance(value, Stream):  # which counts its items itself
            guard.budget.step()
        yield item


def listed(guard: Guard, value: object) -> list[Any]:
    """The items of a value as a new list."""
    items = iterate(guard, value)
    if isinstance(items, Sized):
        guard.length(len(items))
        if isinstance(items, np.ndarray) and items.ndim > 1:
            guard.hold(len(items) * ARRAY_BYTES)
        return list(items)
    made: list[Any] = []
    for item in items:
        guard.length(len(made) + 1)
        made.append(item)
    return made


def length_of(guard: Guard, value: object) -> int:
    """``len(value)``."""
    if isinstance(value, RecordList):
        return guard.host("the list of observations", len, value)
    if isinstance(value, (str, list, tuple, dict, set, range, np.ndarray)):
        return len(value)
    refuse_kind(value, "something with a length")
