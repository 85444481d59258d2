"""Operators of the small language: arithmetic, comparisons and signs, with the size of results checked beforehand.

In: a ``Guard``, the operator's symbol and values that the guard has accepted. Out: a plain result, which the
interpreter hands to the guard.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from voxposer.sandbox.formatting import percent
from voxposer.sandbox.guard import Guard, Refusal, kind_of, refuse_kind
from voxposer.sandbox.objects import Stream
from voxposer.sandbox.values import (
    APPENDED_BYTES,
    ENTRY_BYTES,
    broadcast,
    hashable,
    listed,
    number_of,
    numbers,
    require_near,
    require_power,
    truth,
)

# Characters compared that count as one step.
COMPARED_A_STEP = 10_000
# Multiplications of a matrix product that a program may ask for.
_MULTIPLICATIONS = 10**8
_SEQUENCES = (str, list, tuple)


def arithmetic(guard: Guard, symbol: str, left: object, right: object, in_place: bool = False) -> Any:
    """``left symbol right``; in place it changes arrays and lists as Python does.

    Raises:
        Refusal: the result would be too large, or the operator does not fit the values.
    """
    if (_numeric(left) and _numeric(right)) or _mixed(left, right):
        return _numeric_operation(guard, symbol, left, right, in_place)
    if in_place and isinstance(left, list) and symbol in ("+", "*"):
        return _list_in_place(guard, symbol, left, right)
    if symbol == "+" and isinstance(left, _SEQUENCES) and isinstance(right, _SEQUENCES) and type(left) is type(right):
        _require_length(guard, left, len(left) + len(right))
        guard.hold(len(right) * APPENDED_BYTES)
        return (_IN_PLACE if in_place else _OPERATORS)[symbol](left, right)
    if symbol == "*":
        return _repeated(guard, left, right)
    if symbol == "%" and isinstance(left, str):
        return percent(guard, left, right)
    if isinstance(left, (set, dict)) and type(left) is type(right) and symbol in _UNIONS[type(left)]:
        return _united(guard, symbol, left, right, in_place)
    raise Refusal("types", f"{kind_of(left)} {symbol} {kind_of(right)}")


_UNIONS: dict[type, tuple[str, ...]] = {set: ("|", "&", "-", "^"), dict: ("|",)}


def _united(guard: Guard, symbol: str, left: Any, right: Any, in_place: bool) -> Any:
    """An operation of two sets, or the union of two dictionaries."""
    guard.length(len(left) + len(right))
    guard.hold((len(left) + len(right)) * ENTRY_BYTES)
    guard.budget.step((len(left) + len(right)) // 10)
    return (_IN_PLACE if in_place else _OPERATORS)[symbol](left, right)


def _numeric(value: object) -> bool:
    return kind_of(value) in ("number", "array")


def _mixed(left: object, right: object) -> bool:
    """Whether one is an array and the other a list that NumPy would make one."""
    kinds = {kind_of(left), kind_of(right)}
    return "array" in kinds and bool(kinds & {"list", "tuple"})


def _require_length(guard: Guard, like: object, length: int) -> None:
    if isinstance(like, str):
        guard.characters(length)
    else:
        guard.length(length)


def _list_in_place(guard: Guard, symbol: str, left: list[Any], right: object) -> list[Any]:
    """``left += right`` of anything to loop over, and ``left *= right``: the same list, changed."""
    before = len(left)
    if symbol == "+":
        more = listed(guard, right)
        guard.length(before + len(more))
        left.extend(more)
    else:
        left[:] = _repeated(guard, left, right)
    guard.hold(max(len(left) - before, 0) * APPENDED_BYTES)
    return left


def _repeated(guard: Guard, left: object, right: object) -> Any:
    sequence, times = (left, right) if isinstance(left, _SEQUENCES) else (right, left)
    if not isinstance(sequence, _SEQUENCES) or not isinstance(times, (int, np.integer)):
        raise Refusal("types", f"{kind_of(left)} * {kind_of(right)}")
    _require_length(guard, sequence, len(sequence) * max(int(times), 0))
    return sequence * int(times)


def _numeric_operation(guard: Guard, symbol: str, left: object, right: object, in_place: bool) -> Any:
    a, b = numbers(guard, left), numbers(guard, right)
    if symbol == "@":
        return dot(guard, a, b)
    if symbol == "**":
        require_power(guard, a, b)
    broadcast(guard, a, b)
    if symbol in ("%", "//"):
        require_near(guard, a, b)
    table = _IN_PLACE if in_place and isinstance(a, np.ndarray) else _OPERATORS
    return table[symbol](a, b)


_OPERATORS: dict[str, Callable[..., Any]] = {
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
_IN_PLACE: dict[str, Callable[..., Any]] = {
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
_COMPARISONS: dict[str, Callable[..., Any]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "is": operator.is_,
    "is not": operator.is_not,
}


def compare(guard: Guard, symbol: str, left: object, right: object) -> Any:
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
        a, b = numbers(guard, left), numbers(guard, right)
        broadcast(guard, a, b)
        return _COMPARISONS[symbol](a, b)
    return _COMPARISONS[symbol](left, right)


def equal(guard: Guard, left: object, right: object) -> Any:
    """``left == right``, where an array equals what has its shape and its numbers."""
    if isinstance(left, np.ndarray) or isinstance(right, np.ndarray):
        if not isinstance(left, np.ndarray) or not isinstance(right, np.ndarray) or left.shape != right.shape:
            return False
        guard.room(left.shape)
        return np.array_equal(left, right)
    if isinstance(left, str) and isinstance(right, str):
        guard.budget.step(min(len(left), len(right)) // COMPARED_A_STEP)
    return left == right


def _contains(guard: Guard, container: object, item: object) -> bool:
    if isinstance(container, str) and isinstance(item, str):
        return item in container
    if isinstance(container, range):  # which walks through all of it for anything but an int
        number = number_of(item) if kind_of(item) == "number" else math.nan
        return math.isfinite(number) and number == int(number) and int(number) in container
    if isinstance(container, (dict, set)):
        return hashable(guard, item) in container
    if isinstance(container, (list, tuple)):
        return any(item is each or truth(guard, equal(guard, each, item)) for each in container)
    if isinstance(container, Stream):
        return any(truth(guard, equal(guard, each, item)) for each in container.items)
    if isinstance(container, np.ndarray):
        return truth(guard, (container == numbers(guard, item)).any())
    refuse_kind(container, "a list, a dictionary or text")


def power_of(guard: Guard, base: object, exponent: object) -> Any:
    """``pow(base, exponent)``."""
    return arithmetic(guard, "**", base, exponent)


def unary(guard: Guard, symbol: str, value: object) -> Any:
    """``-value``, ``+value``, ``~value`` or ``not value``."""
    if symbol == "not":
        return not truth(guard, value)
    operand = numbers(guard, value) if _numeric(value) else refuse_kind(value, "numbers")
    broadcast(guard, operand)
    if symbol == "~":
        return np.invert(operand) if isinstance(operand, (np.ndarray, np.generic)) else _inverted(operand)
    return -operand if symbol == "-" else +operand


def _inverted(value: int) -> int:
    if isinstance(value, bool):
        raise Refusal("types", "~ of a truth value; write not")
    return ~value


def dot(guard: Guard, a: object, b: object) -> Any:
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
