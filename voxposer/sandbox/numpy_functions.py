"""Functions of NumPy as programs may call them: closed signatures, sizes checked before anything is allocated.

In: a ``Guard`` and values that it has accepted. Out: what NumPy returns. Nothing here reads or writes files, takes a
function, a dtype by name or an ``out`` array. ``voxposer.sandbox.vocabulary`` lists what programs may use.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, SupportsIndex

import numpy as np

from voxposer.sandbox.guard import Guard, Refusal, kind_of
from voxposer.sandbox.values import (
    DTYPES,
    axis_of,
    broadcast,
    count_of,
    digits_of,
    dtype_of,
    listed,
    number_of,
    numbers,
    one_axis,
    require_near,
    require_power,
    shape_of,
)

Function = Callable[..., Any]

# Rows of a matrix to invert, and points that np.interp may look among.
_MATRIX, _KNOTS = 100, 10_000


def elementwise(name: str, arity: int) -> Function:
    """A function of NumPy that works element by element on ``arity`` operands."""
    function = getattr(np, name)

    def apply(guard: Guard, *values: object) -> Any:
        if len(values) != arity:
            raise Refusal("types", f"np.{name} takes {arity} argument{'s'[: arity > 1]}, got {len(values)}")
        operands = [numbers(guard, value) for value in values]
        if name == "power":
            require_power(guard, *operands)
        broadcast(guard, *operands)
        if name in _REMAINDERS:
            require_near(guard, *operands)
        try:
            return function(*operands)
        except TypeError:
            kinds = " and ".join(str(np.asarray(operand).dtype) for operand in operands)
            raise Refusal("types", f"np.{name} is not made for {kinds}") from None

    return apply


# Functions that compute remainders.
_REMAINDERS = ("mod", "remainder", "floor_divide")
# Reductions that need a number at least.
_OF_SOME = ("mean", "std", "var", "median", "ptp")


def reduction(name: str) -> Function:
    """A reduction of NumPy over all axes or one."""
    function = getattr(np, name)

    def apply(guard: Guard, a: object, axis: object = None, *, keepdims: object = None) -> Any:
        values = numbers(guard, a)
        broadcast(guard, values)
        if np.size(values) == 0 and name in _OF_SOME:
            raise Refusal("value", f"the {name} of no numbers")
        if name == "median":
            guard.order(np.size(values))
        extra = {} if keepdims is None else {"keepdims": bool(keepdims)}
        return function(values, axis=axis_of(axis), **extra)

    return apply


def filled(value: float) -> Function:
    """``np.zeros``, ``np.ones``: an array of one value."""

    def apply(guard: Guard, shape: object, dtype: object = DTYPES["float"]) -> np.ndarray:
        lengths = shape_of(guard, shape)
        guard.room(lengths)
        return np.full(lengths, value, dtype_of(dtype))

    return apply


def filled_like(value: float) -> Function:
    """``np.zeros_like``, ``np.ones_like``: an array of one value, of the shape of another."""

    def apply(guard: Guard, a: object, dtype: object = None) -> np.ndarray:
        like = np.asarray(numbers(guard, a))
        guard.room(like.shape)
        return np.full(like.shape, value, like.dtype if dtype is None else dtype_of(dtype))

    return apply


def full(guard: Guard, shape: object, fill_value: object, dtype: object = None) -> np.ndarray:
    """``np.full``."""
    lengths = shape_of(guard, shape)
    guard.room(lengths)
    return np.full(lengths, numbers(guard, fill_value), None if dtype is None else dtype_of(dtype))


def full_like(guard: Guard, a: object, fill_value: object) -> np.ndarray:
    """``np.full_like``."""
    like = np.asarray(numbers(guard, a))
    guard.room(like.shape)
    return np.full(like.shape, numbers(guard, fill_value), like.dtype)


def eye(guard: Guard, n: object) -> np.ndarray:
    """``np.eye`` of one size."""
    guard.room((count_of(n), count_of(n)))
    return np.eye(count_of(n))


def arange(guard: Guard, start: object, stop: object = None, step: object = 1) -> np.ndarray:
    """``np.arange``."""
    first, last = (0, start) if stop is None else (start, stop)
    first, last, stride = (number_of(value) for value in (first, last, step))
    if not all(math.isfinite(value) for value in (first, last, stride)) or stride == 0:
        raise Refusal("value", "np.arange of infinitely many numbers")
    guard.room((max(math.ceil((last - first) / stride), 0),))
    return np.arange(first, last, stride)


def linspace(guard: Guard, start: object, stop: object, num: object = 50, endpoint: object = True) -> np.ndarray:
    """``np.linspace``."""
    ends = numbers(guard, start), numbers(guard, stop)
    guard.room((count_of(num), *np.broadcast_shapes(*(np.shape(end) for end in ends))))
    return np.linspace(*ends, count_of(num), endpoint=bool(endpoint))


def indices(guard: Guard, dimensions: object) -> np.ndarray:
    """``np.indices``."""
    lengths = shape_of(guard, dimensions)
    guard.room((len(lengths), *lengths))
    return np.indices(lengths)


def meshgrid(guard: Guard, *values: object, indexing: Literal["xy", "ij"] = "xy") -> list[np.ndarray]:
    """``np.meshgrid``."""
    axes = [np.atleast_1d(numbers(guard, value)) for value in values]
    guard.room((len(axes), *(axis.size for axis in axes)))
    return list(np.meshgrid(*axes, indexing=indexing))


def norm(
    guard: Guard, x: object, ord: float | None = None, axis: SupportsIndex | None = None, keepdims: object = False
) -> Any:
    """``np.linalg.norm``; an order is for vectors only."""
    values = np.asarray(numbers(guard, x))
    if ord is not None and (kind_of(ord) != "number" or (values.ndim != 1 and not isinstance(axis, (int, np.integer)))):
        raise Refusal("value", "np.linalg.norm takes an order for vectors only")
    broadcast(guard, values)
    return np.linalg.norm(values, ord=ord, axis=axis_of(axis), keepdims=bool(keepdims))


def cross(guard: Guard, a: object, b: object) -> np.ndarray:
    """``np.cross``."""
    left, right = np.asarray(numbers(guard, a)), np.asarray(numbers(guard, b))
    if left.shape[-1:] != (3,) or right.shape[-1:] != (3,):
        raise Refusal("value", f"np.cross of shapes {left.shape} and {right.shape}; it takes vectors of 3 numbers")
    broadcast(guard, left, right)
    return np.cross(left, right)


def outer(guard: Guard, a: object, b: object) -> np.ndarray:
    """``np.outer``."""
    left, right = np.asarray(numbers(guard, a)), np.asarray(numbers(guard, b))
    guard.room((left.size, right.size))
    return np.outer(left, right)


def joining(name: str, with_axis: bool) -> Function:
    """``np.stack`` and the like, with or without an axis."""
    function = getattr(np, name)

    def apply(guard: Guard, arrays: object, **options: object) -> np.ndarray:
        if not set(options) <= ({"axis"} if with_axis else set()):
            raise Refusal("types", f"np.{name} takes arrays{' and axis' if with_axis else ''}")
        items = listed(guard, arrays)
        guard.room((guard.weigh(items).numbers,))
        parts = [numbers(guard, part) for part in items]
        return function(parts, **{key: axis_of(value) for key, value in options.items()})

    if not with_axis:
        return apply
    return lambda guard, arrays, axis=0: apply(guard, arrays, axis=axis)


def where(guard: Guard, condition: object, *values: object) -> Any:
    """``np.where``, with a condition alone or with two values."""
    if not values:
        return positions("nonzero")(guard, condition)
    if len(values) != 2:
        raise Refusal("types", "np.where takes a condition, or a condition and two values")
    operands = [numbers(guard, value) for value in (condition, *values)]
    broadcast(guard, *operands)
    return np.where(*operands)


def positions(name: str) -> Function:
    """nonzero or argwhere: as many integers as the array has dimensions, for each element at most."""
    function = getattr(np, name)

    def apply(guard: Guard, a: object) -> Any:
        values = np.atleast_1d(numbers(guard, a))
        guard.room((int(np.count_nonzero(values)), values.ndim))
        return function(values)

    return apply


def clip(guard: Guard, a: object, a_min: object = None, a_max: object = None) -> Any:
    """``np.clip``."""
    ends = [None if end is None else numbers(guard, end) for end in (a_min, a_max)]
    values = numbers(guard, a)
    broadcast(guard, values, *(end for end in ends if end is not None))
    return np.clip(values, *ends)


def round_array(guard: Guard, a: object, decimals: object = 0) -> Any:
    """``np.round``."""
    values = numbers(guard, a)
    broadcast(guard, values)
    return np.round(np.asarray(values), digits_of(decimals))[()]


def unravel_index(guard: Guard, index: object, shape: object) -> tuple[Any, ...]:
    """``np.unravel_index``."""
    places = numbers(guard, index)
    lengths = shape_of(guard, shape)
    guard.room((*np.shape(places), max(len(lengths), 1)))
    return tuple(np.unravel_index(places, lengths))


def closeness(name: str) -> Function:
    """``np.allclose`` or ``np.isclose``."""
    function = getattr(np, name)

    def apply(guard: Guard, a: object, b: object, rtol: object = 1e-5, atol: object = 1e-8) -> Any:
        left, right = numbers(guard, a), numbers(guard, b)
        broadcast(guard, left, right)
        return function(left, right, rtol=number_of(rtol), atol=number_of(atol))

    return apply


def array_equal(guard: Guard, a: object, b: object) -> bool:
    """``np.array_equal``."""
    left, right = np.asarray(numbers(guard, a)), np.asarray(numbers(guard, b))
    guard.room((max(left.size, right.size),))
    return bool(np.array_equal(left, right))


def rearranging(name: str, *parameters: str) -> Function:
    """A function of one array that moves its elements, with parameters that are numbers or tuples of them."""
    function = getattr(np, name)

    def apply(guard: Guard, a: object, *values: object, **named: object) -> Any:
        options = dict(zip(parameters, values, strict=False)) | named
        if len(values) > len(parameters) or not set(options) <= set(parameters):
            raise Refusal("types", f"np.{name} takes an array{''.join(f' and {each}' for each in parameters)}")
        options = {key: bool(value) if key == "keepdims" else axis_of(value) for key, value in options.items()}
        made = numbers(guard, a)
        broadcast(guard, made)
        return function(made, **options)

    return apply


def ordering(name: str) -> Function:
    """``np.sort`` or ``np.argsort``."""
    function = getattr(np, name)

    def apply(guard: Guard, a: object, axis: object = -1) -> np.ndarray:
        values = np.asarray(numbers(guard, a))
        guard.room(values.shape)
        guard.order(values.size)
        return function(values, axis=None if axis is None else one_axis(axis))

    return apply


def reshape(guard: Guard, a: object, *shape: object) -> np.ndarray:
    """``np.reshape``."""
    lengths = shape_of(guard, shape[0] if len(shape) == 1 else shape)
    values = np.asarray(numbers(guard, a))
    guard.room(values.shape)
    return values.reshape(lengths)


def interp(guard: Guard, x: object, xp: object, fp: object) -> Any:
    """``np.interp``."""
    places, knots, values = (numbers(guard, value) for value in (x, xp, fp))
    broadcast(guard, places)
    if np.size(knots) > _KNOTS:
        raise Refusal("size", f"np.interp among {np.size(knots)} points; {_KNOTS} are allowed")
    guard.order(np.size(places))
    return np.interp(places, knots, values)


def diff(guard: Guard, a: object, axis: object = -1) -> np.ndarray:
    """``np.diff``."""
    values = numbers(guard, a)
    broadcast(guard, values)
    return np.diff(values, axis=one_axis(axis))


def copy_array(guard: Guard, a: object) -> np.ndarray:
    """``np.copy``."""
    values = np.asarray(numbers(guard, a))
    guard.room(values.shape, values.itemsize)
    return values.copy()


def tile(guard: Guard, a: object, reps: object) -> np.ndarray:
    """``np.tile``."""
    values = np.asarray(numbers(guard, a))
    times = shape_of(guard, reps)
    guard.room((values.size, *(max(time, 0) for time in times)))
    return np.tile(values, times)


def repeat(guard: Guard, a: object, repeats: object, axis: object = None) -> np.ndarray:
    """``np.repeat`` by one number."""
    values, times = np.asarray(numbers(guard, a)), count_of(repeats)
    guard.room((values.size, times))
    return np.repeat(values, times, axis=None if axis is None else one_axis(axis))


def append(guard: Guard, arr: object, values: object, axis: object = None) -> np.ndarray:
    """``np.append``."""
    parts = [np.asarray(numbers(guard, part)) for part in (arr, values)]
    if axis is None:
        parts = [part.ravel() for part in parts]
    return joining("concatenate", with_axis=True)(guard, parts, axis=0 if axis is None else axis)


def unique(guard: Guard, ar: object, axis: object = None) -> np.ndarray:
    """``np.unique``, the values alone."""
    values = np.asarray(numbers(guard, ar))
    guard.room(values.shape)
    guard.order(values.size)
    # Counting takes NumPy's way of sorting: its hash table for integers takes ten times as long, and more memory.
    return np.unique(values, return_counts=True, axis=None if axis is None else one_axis(axis))[0]


def isin(guard: Guard, element: object, test_elements: object) -> np.ndarray:
    """``np.isin``."""
    values, among = np.asarray(numbers(guard, element)), np.asarray(numbers(guard, test_elements))
    guard.room((values.size + among.size,))
    guard.order(values.size + among.size)
    return np.isin(values, among, kind="sort")


def swapaxes(guard: Guard, a: object, axis1: object, axis2: object) -> np.ndarray:
    """``np.swapaxes``."""
    return np.swapaxes(np.asarray(numbers(guard, a)), one_axis(axis1), one_axis(axis2))


def average(guard: Guard, a: object, axis: object = None, weights: object = None) -> Any:
    """``np.average``."""
    values = numbers(guard, a)
    given = None if weights is None else np.asarray(numbers(guard, weights))
    broadcast(guard, values)
    return np.average(values, axis=axis_of(axis), weights=given)


def percentile(guard: Guard, a: object, q: object, axis: object = None) -> Any:
    """``np.percentile``."""
    values, shares = np.asarray(numbers(guard, a)), np.asarray(numbers(guard, q))
    guard.room((values.size, shares.size))
    guard.order(values.size)
    return np.percentile(values, shares, axis=axis_of(axis))


def inverse(guard: Guard, a: object) -> np.ndarray:
    """``np.linalg.inv`` of one small matrix."""
    matrix = np.asarray(numbers(guard, a), float)
    if matrix.ndim != 2 or len(matrix) > _MATRIX:
        raise Refusal("size", f"np.linalg.inv takes one matrix of at most {_MATRIX} rows")
    return np.linalg.inv(matrix)


def grid(guard: Guard, index: object, *, sparse: bool) -> Any:
    """``np.mgrid[index]``, or ``np.ogrid[index]`` where ``sparse``; slices with a start, a stop and a step."""
    axes = [_grid_axis(guard, part) for part in (index if isinstance(index, tuple) else (index,))]
    guard.room((len(axes), *(axis.size for axis in axes)) if not sparse else (sum(axis.size for axis in axes),))
    if not isinstance(index, tuple):
        return axes[0]
    made = np.meshgrid(*axes, indexing="ij", sparse=sparse)
    return tuple(made) if sparse else np.stack(made)


def _grid_axis(guard: Guard, part: object) -> np.ndarray:
    if not isinstance(part, slice) or part.stop is None:
        raise Refusal("types", "np.mgrid and np.ogrid take slices with an end, such as np.mgrid[0:100, 0:100, 0:100]")
    return arange(guard, 0 if part.start is None else part.start, part.stop, 1 if part.step is None else part.step)


def shape(guard: Guard, a: object) -> tuple[int, ...]:
    """``np.shape``."""
    return np.shape(numbers(guard, a))
