"""The operators, functions and methods that model-written programs may use, each with its size checked beforehand.

In: a ``Guard`` and values it has accepted. Out: a plain result, which the interpreter hands to the guard. NumPy is
here as a closed list: nothing that reads or writes files, takes a function, a dtype by name or an ``out`` array.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from voxposer.sandbox.guard import (
    DType,
    Guard,
    Opaque,
    Record,
    RecordList,
    Refusal,
    kind_of,
    refuse_kind,
    require_numbers,
)

Function = Callable[..., Any]

# Work of a matrix product a program may ask for, in multiplications.
_MULTIPLICATIONS = 10**8
# Digits that round() may be asked for.
_DIGITS = 20
# Numbers in one piece of text.
_PRINTED = 1000
# Bytes counted for an item put into a list.
APPENDED_BYTES = 16

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
CONSTANTS: Mapping[str, Any] = MappingProxyType(
    {"pi": math.pi, "e": math.e, "inf": math.inf, "nan": math.nan, "newaxis": None}
)


# Operators


def arithmetic(guard: Guard, symbol: str, left: Any, right: Any, in_place: bool = False) -> Any:
    """``left symbol right``; in place it changes arrays and lists as Python does.

    Raises:
        Refusal: the result would be too large, or the operator does not fit the values.
    """
    if (_numeric(left) and _numeric(right)) or _mixed(left, right):
        return _numeric_operation(guard, symbol, left, right, in_place)
    if symbol == "+" and _same_sequence(left, right):
        _require_length(guard, left, len(left) + len(right))
        guard.hold(len(right) * APPENDED_BYTES)
        return (operator.iadd if in_place else operator.add)(left, right)
    if symbol == "*":
        return _repeated(guard, left, right)
    raise Refusal("types", f"{kind_of(left)} {symbol} {kind_of(right)}")


def _numeric(value: Any) -> bool:
    return kind_of(value) in ("number", "array")


def _mixed(left: Any, right: Any) -> bool:
    """Whether one is an array and the other a list that NumPy would make one."""
    kinds = {kind_of(left), kind_of(right)}
    return "array" in kinds and bool(kinds & {"list", "tuple"})


def _same_sequence(left: Any, right: Any) -> bool:
    return type(left) is type(right) and isinstance(left, (str, list, tuple))


def _require_length(guard: Guard, like: Any, length: int) -> None:
    if isinstance(like, str):
        guard.characters(length)
    else:
        guard.length(length)


def _repeated(guard: Guard, left: Any, right: Any) -> Any:
    sequence, times = (left, right) if isinstance(left, (str, list, tuple)) else (right, left)
    if not isinstance(sequence, (str, list, tuple)) or not isinstance(times, (int, np.integer)):
        raise Refusal("types", f"{kind_of(left)} * {kind_of(right)}")
    _require_length(guard, sequence, len(sequence) * max(int(times), 0))
    return sequence * int(times)


def _numeric_operation(guard: Guard, symbol: str, left: Any, right: Any, in_place: bool) -> Any:
    left, right = numbers(guard, left), numbers(guard, right)
    if symbol == "@":
        return dot(guard, left, right)
    if symbol == "**":
        _require_power(guard, left, right)
    broadcast(guard, left, right)
    table = _IN_PLACE if in_place and isinstance(left, np.ndarray) else _OPERATORS
    return table[symbol](left, right)


def _require_power(guard: Guard, base: Any, exponent: Any) -> None:
    if isinstance(base, int) and isinstance(exponent, int) and exponent > 0 and abs(base) > 1:
        guard.bits(int(exponent * math.log2(abs(base))))


_OPERATORS: dict[str, Function] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "//": operator.floordiv,
    "%": operator.mod,
    "**": operator.pow,
    "&": operator.and_,
    "|": operator.or_,
    "^": operator.xor,
}
_IN_PLACE: dict[str, Function] = {
    "+": operator.iadd,
    "-": operator.isub,
    "*": operator.imul,
    "/": operator.itruediv,
    "//": operator.ifloordiv,
    "%": operator.imod,
    "**": operator.ipow,
    "&": operator.iand,
    "|": operator.ior,
    "^": operator.ixor,
}
_COMPARISONS: dict[str, Function] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "is": operator.is_,
    "is not": operator.is_not,
}


def compare(guard: Guard, symbol: str, left: Any, right: Any) -> Any:
    """``left symbol right``: element by element for arrays."""
    guard.weigh(left)
    guard.weigh(right)
    if symbol in ("in", "not in"):
        return _contains(guard, right, left) == (symbol == "in")
    if symbol in ("is", "is not"):
        return _COMPARISONS[symbol](left, right)
    if isinstance(left, np.ndarray) or isinstance(right, np.ndarray):
        if left is None or right is None:
            return symbol == "!="
        left, right = numbers(guard, left), numbers(guard, right)
        broadcast(guard, left, right)
    return _COMPARISONS[symbol](left, right)


def _contains(guard: Guard, container: Any, item: Any) -> bool:
    if isinstance(container, str) and isinstance(item, str):
        return item in container
    if isinstance(container, range):  # which walks through all of it for anything but an int
        return _is_whole(item) and int(item) in container
    if isinstance(container, (list, tuple, dict)):
        return item in container
    refuse_kind(container, "a list, a dictionary or text")


def _is_whole(value: Any) -> bool:
    return kind_of(value) == "number" and math.isfinite(value) and value == int(value)


def unary(guard: Guard, symbol: str, value: Any) -> Any:
    """``-value``, ``+value``, ``~value`` or ``not value``."""
    if symbol == "not":
        return not truth(guard, value)
    value = numbers(guard, value) if _numeric(value) else refuse_kind(value, "numbers")
    broadcast(guard, value)
    if symbol == "~":
        return np.invert(value) if isinstance(value, (np.ndarray, np.generic)) else _inverted(value)
    return -value if symbol == "-" else +value


def _inverted(value: Any) -> int:
    if isinstance(value, bool):
        raise Refusal("types", "~ of a truth value; write not")
    return ~value


def truth(guard: Guard, value: Any) -> bool:
    """What ``if value:`` goes by.

    Raises:
        Refusal: it is an array of several elements.
    """
    if isinstance(value, np.ndarray) and value.size != 1:
        raise Refusal("types", f"an array of {value.size} elements is neither true nor false; use .any() or .all()")
    if isinstance(value, RecordList):
        return _length(guard, value) > 0
    return True if isinstance(value, (Record, Opaque)) else bool(value)


# Values made ready for NumPy, and sizes foreseen


def numbers(guard: Guard, value: Any) -> Any:
    """A number or array as it is; a list of numbers as an array."""
    kind = kind_of(value)
    if kind in ("list", "tuple", "range"):
        return array(guard, value)
    return value if kind in ("number", "array") else refuse_kind(value, "numbers")


def broadcast(guard: Guard, *values: Any) -> None:
    """Refuse an operation whose result would be too large."""
    guard.room(np.broadcast_shapes(*(np.shape(value) for value in values)))


def array(guard: Guard, value: Any, dtype: DType | None = None) -> np.ndarray:
    """``np.array`` of numbers, lists of them or arrays."""
    if kind_of(value) not in ("number", "array", "list", "tuple", "range"):
        refuse_kind(value, "numbers")
    weight = guard.weigh(value)
    if not weight.kinds <= {"number", "array", "range"}:
        raise Refusal("types", f"an array of {' and '.join(sorted(weight.kinds))}; only numbers are allowed")
    guard.room((weight.numbers,))
    made = np.array(value)
    require_numbers(made)
    return made if dtype is None else made.astype(_dtype(dtype))


def _dtype(dtype: Any) -> type[np.generic]:
    if not isinstance(dtype, DType):
        raise Refusal("types", f"a dtype is one of {', '.join(DTYPES)}")
    return dtype.dtype


def _shape(guard: Guard, shape: Any) -> tuple[int, ...]:
    lengths = shape if isinstance(shape, (tuple, list)) else (shape,)
    return tuple(operator.index(length) for length in lengths)


def _count(value: Any) -> int:
    """A number of things that is asked for."""
    return max(operator.index(value), 0)


# Functions of NumPy


def _elementwise(name: str, arity: int) -> Function:
    function = getattr(np, name)

    def apply(guard: Guard, *values: Any) -> Any:
        if len(values) != arity:
            raise Refusal("types", f"np.{name} takes {arity} argument{'s'[: arity > 1]}, got {len(values)}")
        operands = [numbers(guard, value) for value in values]
        if name == "power":
            _require_power(guard, *operands)
        broadcast(guard, *operands)
        return function(*operands)

    return apply


def _reduction(name: str) -> Function:
    function = getattr(np, name)

    def apply(guard: Guard, a: Any, axis: Any = None, keepdims: Any = None) -> Any:
        values = numbers(guard, a)
        broadcast(guard, values)
        extra = {} if keepdims is None else {"keepdims": bool(keepdims)}
        return function(values, axis=axis, **extra)

    return apply


def _filled(value: float) -> Function:
    def apply(guard: Guard, shape: Any, dtype: Any = DTYPES["float"]) -> np.ndarray:
        lengths = _shape(guard, shape)
        guard.room(lengths)
        return np.full(lengths, value, _dtype(dtype))

    return apply


def _filled_like(value: float) -> Function:
    def apply(guard: Guard, a: Any, dtype: Any = None) -> np.ndarray:
        like = np.asarray(numbers(guard, a))
        guard.room(like.shape)
        return np.full(like.shape, value, like.dtype if dtype is None else _dtype(dtype))

    return apply


def _full(guard: Guard, shape: Any, fill_value: Any, dtype: Any = None) -> np.ndarray:
    lengths = _shape(guard, shape)
    guard.room(lengths)
    return np.full(lengths, numbers(guard, fill_value), None if dtype is None else _dtype(dtype))


def _full_like(guard: Guard, a: Any, fill_value: Any) -> np.ndarray:
    like = np.asarray(numbers(guard, a))
    guard.room(like.shape)
    return np.full(like.shape, numbers(guard, fill_value), like.dtype)


def _eye(guard: Guard, n: Any) -> np.ndarray:
    guard.room((_count(n), _count(n)))
    return np.eye(_count(n))


def _arange(guard: Guard, start: Any, stop: Any = None, step: Any = 1) -> np.ndarray:
    first, last = (0, start) if stop is None else (start, stop)
    first, last, stride = (number_of(value) for value in (first, last, step))
    if not all(math.isfinite(value) for value in (first, last, stride)) or stride == 0:
        raise Refusal("value", "np.arange of infinitely many numbers")
    guard.room((max(math.ceil((last - first) / stride), 0),))
    return np.arange(first, last, stride)


def _linspace(guard: Guard, start: Any, stop: Any, num: Any = 50, endpoint: Any = True) -> np.ndarray:
    ends = numbers(guard, start), numbers(guard, stop)
    guard.room((_count(num), *np.broadcast_shapes(*(np.shape(end) for end in ends))))
    return np.linspace(*ends, _count(num), endpoint=bool(endpoint))


def number_of(value: Any) -> int | float:
    """A number as Python's own."""
    if kind_of(value) != "number":
        refuse_kind(value, "a number")
    return value.item() if isinstance(value, np.generic) else value


def _indices(guard: Guard, dimensions: Any) -> np.ndarray:
    lengths = _shape(guard, dimensions)
    guard.room((len(lengths), *lengths))
    return np.indices(lengths)


def _meshgrid(guard: Guard, *values: Any, indexing: Any = "xy") -> list[np.ndarray]:
    axes = [np.atleast_1d(numbers(guard, value)) for value in values]
    guard.room((len(axes), *(axis.size for axis in axes)))
    return list(np.meshgrid(*axes, indexing=indexing))


def _norm(guard: Guard, x: Any, ord: Any = None, axis: Any = None, keepdims: Any = False) -> Any:
    values = np.asarray(numbers(guard, x))
    if ord is not None and (kind_of(ord) != "number" or (values.ndim != 1 and not isinstance(axis, (int, np.integer)))):
        raise Refusal("value", "np.linalg.norm takes an order for vectors only")
    broadcast(guard, values)
    return np.linalg.norm(values, ord=ord, axis=axis, keepdims=bool(keepdims))


def dot(guard: Guard, a: Any, b: Any) -> Any:
    """``np.dot`` of numbers, vectors or matrices."""
    left, right = np.asarray(numbers(guard, a)), np.asarray(numbers(guard, b))
    if left.ndim > 2 or right.ndim > 2:
        raise Refusal("value", "products of arrays with more than two dimensions")
    shared = left.shape[-1] if left.ndim and right.ndim else 1
    work = left.size * right.size // max(shared, 1)
    if work > _MULTIPLICATIONS:
        raise Refusal("steps", f"a product of {work} multiplications; {_MULTIPLICATIONS} are allowed")
    guard.room(left.shape[:-1] + right.shape[1:])
    guard.budget.step(work // 1000)
    return np.dot(left, right)


def _cross(guard: Guard, a: Any, b: Any) -> np.ndarray:
    left, right = numbers(guard, a), numbers(guard, b)
    broadcast(guard, left, right)
    return np.cross(left, right)


def _outer(guard: Guard, a: Any, b: Any) -> np.ndarray:
    left, right = np.asarray(numbers(guard, a)), np.asarray(numbers(guard, b))
    guard.room((left.size, right.size))
    return np.outer(left, right)


def _joined(name: str, with_axis: bool) -> Function:
    function = getattr(np, name)

    def apply(guard: Guard, arrays: Any, **options: Any) -> np.ndarray:
        if not set(options) <= ({"axis"} if with_axis else set()):
            raise Refusal("types", f"np.{name} takes arrays{' and axis' if with_axis else ''}")
        parts = [numbers(guard, part) for part in _listed(guard, arrays)]
        guard.room((sum(np.size(part) for part in parts),))
        return function(parts, **options)

    if not with_axis:
        return apply
    return lambda guard, arrays, axis=0: apply(guard, arrays, axis=axis)


def _where(guard: Guard, condition: Any, *values: Any) -> Any:
    if not values:
        return _places("nonzero")(guard, condition)
    if len(values) != 2:
        raise Refusal("types", "np.where takes a condition, or a condition and two values")
    operands = [numbers(guard, value) for value in (condition, *values)]
    broadcast(guard, *operands)
    return np.where(*operands)


def _places(name: str) -> Function:
    """nonzero or argwhere: as many integers as the array has dimensions, for each element at most."""
    function = getattr(np, name)

    def apply(guard: Guard, a: Any) -> Any:
        values = np.atleast_1d(numbers(guard, a))
        guard.room((int(np.count_nonzero(values)), values.ndim))
        return function(values)

    return apply


def _clip(guard: Guard, a: Any, a_min: Any = None, a_max: Any = None) -> Any:
    ends = [None if end is None else numbers(guard, end) for end in (a_min, a_max)]
    values = numbers(guard, a)
    broadcast(guard, values, *(end for end in ends if end is not None))
    return np.clip(values, *ends)


def _round(guard: Guard, a: Any, decimals: Any = 0) -> Any:
    values = numbers(guard, a)
    broadcast(guard, values)
    return np.round(np.asarray(values), _digits(decimals))[()]


def _digits(value: Any) -> int:
    digits = operator.index(value)
    if abs(digits) > _DIGITS:
        raise Refusal("size", f"rounding to {digits} digits; {_DIGITS} are allowed")
    return digits


def _unravel_index(guard: Guard, index: Any, shape: Any) -> tuple[Any, ...]:
    places = numbers(guard, index)
    lengths = _shape(guard, shape)
    guard.room((*np.shape(places), max(len(lengths), 1)))
    return tuple(np.unravel_index(places, lengths))


def _all_close(name: str) -> Function:
    function = getattr(np, name)

    def apply(guard: Guard, a: Any, b: Any, rtol: Any = 1e-5, atol: Any = 1e-8) -> Any:
        left, right = numbers(guard, a), numbers(guard, b)
        broadcast(guard, left, right)
        return function(left, right, rtol=number_of(rtol), atol=number_of(atol))

    return apply


def _array_equal(guard: Guard, a: Any, b: Any) -> bool:
    left, right = np.asarray(numbers(guard, a)), np.asarray(numbers(guard, b))
    guard.room((max(left.size, right.size),))
    return bool(np.array_equal(left, right))


def _rearranged(name: str, *parameters: str) -> Function:
    """A function of one array that moves its elements, with parameters that are numbers or tuples of them."""
    function = getattr(np, name)

    def apply(guard: Guard, a: Any, *values: Any, **named: Any) -> Any:
        options = dict(zip(parameters, values, strict=False)) | named
        if len(values) > len(parameters) or not set(options) <= set(parameters):
            raise Refusal("types", f"np.{name} takes an array and {', '.join(parameters)}")
        made = numbers(guard, a)
        broadcast(guard, made)
        return function(made, **options)

    return apply


def _reshape(guard: Guard, a: Any, *shape: Any) -> np.ndarray:
    lengths = _shape(guard, shape[0] if len(shape) == 1 else shape)
    values = np.asarray(numbers(guard, a))
    guard.room(values.shape)
    return values.reshape(lengths)


def _interp(guard: Guard, x: Any, xp: Any, fp: Any) -> Any:
    places, knots, values = (numbers(guard, value) for value in (x, xp, fp))
    broadcast(guard, places)
    return np.interp(places, knots, values)


def _diff(guard: Guard, a: Any, axis: Any = -1) -> np.ndarray:
    values = numbers(guard, a)
    broadcast(guard, values)
    return np.diff(values, axis=axis)


def _copy(guard: Guard, a: Any) -> np.ndarray:
    values = np.asarray(numbers(guard, a))
    guard.room(values.shape, values.itemsize)
    return values.copy()


_UNARY = """abs absolute fabs sqrt square exp log sin cos tan arcsin arccos arctan deg2rad rad2deg radians degrees floor
ceil rint sign isnan isfinite negative logical_not"""
_BINARY = """add subtract multiply divide floor_divide maximum minimum arctan2 power mod hypot logical_and logical_or
logical_xor equal not_equal less less_equal greater greater_equal"""
_REDUCTIONS = """sum mean min max amin amax std var prod any all median"""

NUMPY: Mapping[str, Function] = MappingProxyType(
    {name: _elementwise(name, 1) for name in _UNARY.split()}
    | {name: _elementwise(name, 2) for name in _BINARY.split()}
    | {name: _reduction(name) for name in _REDUCTIONS.split()}
    | {name: _rearranged(name, "axis", "keepdims") for name in ("argmin", "argmax", "count_nonzero")}
    | {name: _rearranged(name, "axis") for name in ("cumsum", "sort", "argsort", "flip", "squeeze", "expand_dims")}
    | {name: _all_close(name) for name in ("allclose", "isclose")}
    | {name: _places(name) for name in ("nonzero", "argwhere")}
    | {name: _joined(name, with_axis=True) for name in ("concatenate", "stack")}
    | {name: _joined(name, with_axis=False) for name in ("vstack", "hstack")}
    | {name: function for name in ("array", "asarray") for function in (array,)}
    | {name: _filled(0.0) for name in ("zeros", "empty")}
    | {
        "ones": _filled(1.0),
        "full": _full,
        "zeros_like": _filled_like(0.0),
        "ones_like": _filled_like(1.0),
        "full_like": _full_like,
        "eye": _eye,
        "arange": _arange,
        "linspace": _linspace,
        "indices": _indices,
        "meshgrid": _meshgrid,
        "copy": _copy,
        "linalg.norm": _norm,
        "dot": dot,
        "matmul": dot,
        "cross": _cross,
        "outer": _outer,
        "where": _where,
        "clip": _clip,
        "round": _round,
        "around": _round,
        "unravel_index": _unravel_index,
        "array_equal": _array_equal,
        "reshape": _reshape,
        "ravel": _rearranged("ravel"),
        "transpose": _rearranged("transpose", "axes"),
        "roll": _rearranged("roll", "shift", "axis"),
        "diff": _diff,
        "interp": _interp,
    }
)


# Python's own functions


def hashable(guard: Guard, key: Any) -> Any:
    """A dictionary key: text, a number, None, or a tuple of them."""
    guard.weigh(key)
    if not isinstance(key, tuple) and kind_of(key) not in ("text", "number", "None"):
        refuse_kind(key, "text or a number as the key")
    return key


def iterate(guard: Guard, value: Any) -> Sequence[Any]:
    """What a loop over the value runs through; ranges, lists and arrays as they are.

    Raises:
        Refusal: nothing to loop over.
    """
    if isinstance(value, dict):
        return list(value)
    if isinstance(value, np.ndarray) and value.ndim == 0:
        refuse_kind(value[()], "something to loop over")
    if isinstance(value, RecordList):
        return guard.host("the list of observations", list, value)
    if isinstance(value, (list, tuple, str, range, np.ndarray)):
        return value  # pyright: ignore[reportReturnType]  (an array is a sequence of its rows)
    refuse_kind(value, "something to loop over")


def _listed(guard: Guard, value: Any) -> list[Any]:
    items = iterate(guard, value)
    guard.length(len(items))
    return list(items)


def _comparable(guard: Guard, values: Sequence[Any]) -> list[Any]:
    items = _listed(guard, values[0]) if len(values) == 1 else list(values)
    guard.weigh(items)
    for item in items:
        if isinstance(item, (np.ndarray, Record)):
            refuse_kind(item, "numbers or text to put in order")
    return items


def _extreme(choose: Function) -> Function:
    def apply(guard: Guard, *values: Any) -> Any:
        return choose(_comparable(guard, values))

    return apply


def _sorted(guard: Guard, value: Any, reverse: Any = False) -> list[Any]:
    return sorted(_comparable(guard, (value,)), reverse=truth(guard, reverse))


def _sum(guard: Guard, value: Any, start: Any = 0) -> Any:
    total = start
    for item in _listed(guard, value):
        total = guard.take(arithmetic(guard, "+", total, item))
    return total


def _int(guard: Guard, value: Any = 0) -> int:
    return int(_one(value))


def _float(guard: Guard, value: Any = 0) -> float:
    return float(_one(value))


def _one(value: Any) -> Any:
    """A number, the only element of an array, or text that says a number."""
    if isinstance(value, np.ndarray) and value.size == 1:
        return value.item()
    return value if kind_of(value) in ("number", "text") else refuse_kind(value, "a number")


def _length(guard: Guard, value: Any) -> int:
    if isinstance(value, RecordList):
        return guard.host("the list of observations", len, value)
    if isinstance(value, (str, list, tuple, dict, range, np.ndarray)):
        return len(value)
    refuse_kind(value, "something with a length")


def _range(guard: Guard, *ends: Any) -> range:
    made = range(*(operator.index(end) for end in ends))
    for end in (made.start, made.stop, made.step):
        guard.bits(end.bit_length())
    return made


def _zip(guard: Guard, *values: Any) -> list[Any]:
    return list(zip(*(_listed(guard, value) for value in values), strict=False))


def _enumerate(guard: Guard, value: Any, start: Any = 0) -> list[Any]:
    return list(enumerate(_listed(guard, value), operator.index(start)))


def _absolute(guard: Guard, value: Any) -> Any:
    broadcast(guard, numbers(guard, value))
    return abs(numbers(guard, value))


def _rounded(guard: Guard, value: Any, ndigits: Any = None) -> Any:
    if isinstance(value, np.ndarray):
        return _round(guard, value, 0 if ndigits is None else ndigits)
    return round(number_of(value), None if ndigits is None else _digits(ndigits))


def _print(guard: Guard, *values: Any) -> None:
    """Accepted, because models like to print; it goes nowhere."""


BUILTINS: Mapping[str, Function] = MappingProxyType(
    {
        "abs": _absolute,
        "all": lambda guard, value: all(truth(guard, item) for item in _listed(guard, value)),
        "any": lambda guard, value: any(truth(guard, item) for item in _listed(guard, value)),
        "bool": truth,
        "enumerate": _enumerate,
        "float": _float,
        "int": _int,
        "len": _length,
        "list": lambda guard, value=(): _listed(guard, value),
        "max": _extreme(max),
        "min": _extreme(min),
        "print": _print,
        "range": _range,
        "reversed": lambda guard, value: _listed(guard, value)[::-1],
        "round": _rounded,
        "sorted": _sorted,
        "str": lambda guard, value="": text(guard, value),
        "sum": _sum,
        "tuple": lambda guard, value=(): tuple(_listed(guard, value)),
        "zip": _zip,
    }
)


# Text


def text(guard: Guard, value: Any, spec: str = "") -> str:
    """``str(value)``, or a number in a format such as ``.2f``; NumPy's numbers look like Python's.

    Raises:
        Refusal: it would be too long, or a format is given for something other than a number or text.
    """
    weight = guard.weigh(value)
    guard.characters(weight.characters)
    if weight.numbers > _PRINTED:
        raise Refusal("size", f"{weight.numbers} numbers as text; {_PRINTED} are allowed")
    guard.budget.step(weight.numbers)
    if spec:
        if kind_of(value) not in ("number", "text"):
            refuse_kind(value, "a number or text to format")
        return format(value.item() if isinstance(value, np.generic) else value, spec)
    made = str(_plain(guard, value))
    guard.characters(len(made))
    return made


def _plain(guard: Guard, value: Any) -> Any:
    """A value whose ``str`` says no more than a program may know, and the same each time."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(guard, item) for item in value)
    if isinstance(value, dict):
        return {key: _plain(guard, item) for key, item in value.items()}
    if isinstance(value, Record):
        return guard.host("the observation", str, value)
    if isinstance(value, (RecordList, Opaque)):
        refuse_kind(value, "something with a text")
    return value


# Methods and attributes


def _of_self(name: str) -> Function:
    """A method that is a function of NumPy with the array first."""
    return NUMPY[name]


def _astype(guard: Guard, value: np.ndarray, dtype: Any) -> Any:
    guard.room(np.shape(value))
    return np.asarray(value).astype(_dtype(dtype))[()]


def _tolist(guard: Guard, value: Any) -> Any:
    guard.length(np.size(value))
    return np.asarray(value).tolist()


def _item(guard: Guard, value: Any, *index: Any) -> Any:
    return np.asarray(value).item(*(operator.index(place) for place in index))


def _transposed(guard: Guard, value: Any, *axes: Any) -> Any:
    return NUMPY["transpose"](guard, value, axes or None)


def _filling(guard: Guard, value: np.ndarray, number: Any) -> None:
    guard.room(value.shape)
    value.fill(number_of(number))


def _sorting(guard: Guard, value: np.ndarray, axis: Any = -1) -> None:
    guard.room(value.shape)
    value.sort(axis=axis)


def _appended(guard: Guard, value: list[Any], item: Any) -> None:
    guard.length(len(value) + 1)
    guard.hold(APPENDED_BYTES)
    value.append(item)


def _extended(guard: Guard, value: list[Any], items: Any) -> None:
    more = _listed(guard, items)
    guard.length(len(value) + len(more))
    guard.hold(len(more) * APPENDED_BYTES)
    value.extend(more)


def _inserted(guard: Guard, value: list[Any], place: Any, item: Any) -> None:
    guard.length(len(value) + 1)
    guard.hold(APPENDED_BYTES)
    value.insert(operator.index(place), item)


def _popped(guard: Guard, value: list[Any], place: Any = -1) -> Any:
    return value.pop(operator.index(place))


def _finding(name: str) -> Function:
    def apply(guard: Guard, value: Any, item: Any) -> Any:
        guard.weigh(value)
        guard.weigh(item)
        return getattr(value, name)(item)

    return apply


def _list_sort(guard: Guard, value: list[Any], reverse: Any = False) -> None:
    value[:] = _sorted(guard, value, reverse)


def _replaced(guard: Guard, value: str, old: str, new: str) -> str:
    found = value.count(_require_text(old))
    guard.characters(len(value) + found * len(_require_text(new)))
    return value.replace(old, new)


def _glued(guard: Guard, value: str, parts: Any) -> str:
    pieces = [_require_text(part) for part in _listed(guard, parts)]
    guard.characters(sum(len(piece) + len(value) for piece in pieces))
    return value.join(pieces)


def _require_text(value: Any) -> str:
    return value if isinstance(value, str) else refuse_kind(value, "text")


def _of_text(name: str, least: int, most: int) -> Function:
    function = getattr(str, name)

    def apply(guard: Guard, value: str, *arguments: Any) -> Any:
        if not least <= len(arguments) <= most:
            raise Refusal("types", f".{name}() got {len(arguments)} arguments")
        return function(value, *(_require_text(argument) for argument in arguments))

    return apply


def _split(guard: Guard, value: str, sep: Any = None) -> list[str]:
    guard.length(len(value))
    return value.split(None if sep is None else _require_text(sep))


def _of_dict(name: str) -> Function:
    function: Callable[[Any], Iterable[Any]] = getattr(dict, name)
    return lambda guard, value: list(function(value))


_SHARED = """min max mean sum std var prod any all argmin argmax argsort cumsum round clip dot squeeze reshape ravel
nonzero copy"""

METHODS: Mapping[str, Mapping[str, Function]] = MappingProxyType(
    {
        "array": {name: _of_self(name) for name in _SHARED.split()}
        | {
            "astype": _astype,
            "flatten": lambda guard, value: _copy(guard, value).ravel(),
            "tolist": _tolist,
            "item": _item,
            "transpose": _transposed,
            "fill": _filling,
            "sort": _sorting,
        },
        "list": {
            "append": _appended,
            "extend": _extended,
            "insert": _inserted,
            "pop": _popped,
            "remove": _finding("remove"),
            "index": _finding("index"),
            "count": _finding("count"),
            "reverse": lambda guard, value: value.reverse(),
            "sort": _list_sort,
            "copy": lambda guard, value: _listed(guard, value),
        },
        "tuple": {"index": _finding("index"), "count": _finding("count")},
        "dictionary": {
            "keys": _of_dict("keys"),
            "values": _of_dict("values"),
            "items": _of_dict("items"),
            "get": lambda guard, value, key, default=None: value.get(hashable(guard, key), default),
        },
        "text": {name: _of_text(name, 0, 0) for name in ("lower", "upper", "title", "capitalize")}
        | {name: _of_text(name, 0, 1) for name in ("strip", "lstrip", "rstrip")}
        | {name: _of_text(name, 1, 1) for name in ("startswith", "endswith", "count", "find")}
        | {"split": _split, "replace": _replaced, "join": _glued},
        "number": {"item": _item, "tolist": _tolist, "astype": _astype}
        | {name: _of_self(name) for name in ("copy", "round", "clip", "any", "all", "sum", "min", "max", "mean")},
    }
)
ATTRIBUTES: Mapping[str, Function] = MappingProxyType(
    {
        "shape": lambda value: value.shape,
        "ndim": lambda value: value.ndim,
        "size": lambda value: value.size,
        "T": lambda value: value.T,
    }
)
