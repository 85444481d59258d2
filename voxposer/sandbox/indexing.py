"""Reading, writing and deleting places in arrays, lists and dictionaries, leniently where an array is a map.

In: a ``Guard``, a value and an index that a program wrote. Out: what is there, or the place changed. What an index
would select is counted before NumPy gets it: a few integers can ask for terabytes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from voxposer.sandbox.guard import ELEMENTS_A_STEP, Guard, RecordList, Refusal, refuse_kind
from voxposer.sandbox.values import APPENDED_BYTES, ENTRY_BYTES, hashable, integer, known, listed, number_of, numbers


def subscript(guard: Guard, value: object, index: object) -> Any:
    """``value[index]``; see ``voxel_index`` for maps."""
    if isinstance(value, np.ndarray):
        place = _array_index(guard, value, index)
        return _seen(guard, value[place]) if _is_basic(place) else guard.take(value[place])
    if isinstance(value, dict):
        return value[known(guard, value, index)]
    place = index if isinstance(index, slice) else integer(index)
    if isinstance(value, RecordList):
        return guard.host("the list of observations", value.__getitem__, place)
    if isinstance(value, (list, tuple, str, range)):
        return guard.take(value[place]) if isinstance(place, slice) else value[place]
    refuse_kind(value, "something to index")


def _seen(guard: Guard, view: npt.ArrayLike) -> Any:
    """A part of an array that shares its memory."""
    guard.room((1,) * np.ndim(view))
    return view


def assign(guard: Guard, value: object, index: object, item: object) -> None:
    """``value[index] = item``."""
    if isinstance(value, np.ndarray):
        place, content = _array_index(guard, value, index), numbers(guard, item)
        if isinstance(content, np.ndarray) and content.size == 1:
            content = content.reshape(())  # one number fits anywhere
        if _is_basic(place):
            guard.budget.step(np.size(value[place]) // ELEMENTS_A_STEP)
        value[place] = content
    elif isinstance(value, dict):
        value[hashable(guard, index)] = item
        guard.length(len(value))
        guard.hold(ENTRY_BYTES)
    elif isinstance(value, list) and isinstance(index, slice):
        items = listed(guard, item)
        guard.length(len(value) + len(items))
        guard.hold(len(items) * APPENDED_BYTES)
        value[index] = items
    elif isinstance(value, list):
        value[integer(index)] = item
    else:
        refuse_kind(value, "an array, a dictionary or a list to assign to")


def delete(guard: Guard, value: object, index: object) -> None:
    """``del value[index]``."""
    if isinstance(value, dict):
        del value[known(guard, value, index)]
    elif isinstance(value, list):
        guard.budget.step(len(value) // 100)
        del value[index if isinstance(index, slice) else integer(index)]
    else:
        refuse_kind(value, "a list or a dictionary to delete from")


def _is_basic(index: object) -> bool:
    """Whether an index selects without copying."""
    parts = index if isinstance(index, tuple) else (index,)
    return not any(isinstance(part, np.ndarray) for part in parts)


def _array_index(guard: Guard, value: np.ndarray, index: object) -> Any:
    """The index NumPy gets; refused if it would select more than an array may hold."""
    place = voxel_index(guard, value, index) if value.ndim >= 3 else _plain_index(guard, index)
    if not _is_basic(place):
        guard.room((_selected(value.shape, place if isinstance(place, tuple) else (place,)),), value.itemsize)
    return place


def _plain_index(guard: Guard, index: object) -> Any:
    if isinstance(index, tuple):
        return tuple(_plain_part(guard, part) for part in index)
    return _plain_part(guard, index)


def _plain_part(guard: Guard, part: object) -> Any:
    """One part of an index: as it is where NumPy makes a view of it, else as an array, which is counted."""
    if part is None or part is Ellipsis or isinstance(part, slice):
        return part
    if isinstance(part, (bool, np.bool_)):
        return np.asarray(part)
    if isinstance(part, (int, np.integer)):
        return part
    return np.asarray(numbers(guard, part))


def _selected(shape: tuple[int, ...], index: tuple[Any, ...]) -> int:
    """Elements that an index with arrays in it selects, slices taken for all they could select."""
    picks: list[tuple[int, ...]] = []
    rest, axis = 1, 0
    for part in _without_ellipsis(index, len(shape)):
        end = axis + _dimensions(part)
        if isinstance(part, np.ndarray):
            picks.append((int(np.count_nonzero(part)),) if part.dtype == bool else part.shape)
        elif isinstance(part, slice):
            rest *= max(math.prod(shape[axis:end]), 1)
        axis = end
    return math.prod(np.broadcast_shapes(*picks)) * rest * math.prod(shape[axis:])


def _without_ellipsis(parts: tuple[Any, ...], dimensions: int) -> tuple[Any, ...]:
    """An index with the slices that an ellipsis in it stands for."""
    place = next((place for place, part in enumerate(parts) if part is Ellipsis), None)
    if place is None:
        return parts
    others = parts[:place] + parts[place + 1 :]
    missing = max(dimensions - sum(_dimensions(part) for part in others), 0)
    return parts[:place] + (slice(None),) * missing + parts[place + 1 :]


def _dimensions(part: object) -> int:
    """Dimensions of an array that a part of an index stands for."""
    if part is None:
        return 0
    return part.ndim if isinstance(part, np.ndarray) and part.dtype == bool else 1


def voxel_index(guard: Guard, value: np.ndarray, index: object) -> Any:
    """An index into a map (three or more dimensions) made to fit, as upstream's ``VoxelIndexingWrapper`` does.

    Fractions are rounded, what lies beyond the end becomes the last voxel, what is negative the first one (but -1 stays
    the last), a slice from a negative start begins at 0, or is empty if its end is negative too, and an array or list
    of coordinates is taken for a tuple of them. Arrays of truth values of the map's shape select as usual.
    """
    if isinstance(index, (list, np.ndarray)):
        places = numbers(guard, index)
        if places.dtype == bool:
            return places
        if places.ndim > 1 or places.size > value.ndim:
            raise Refusal("types", "a map takes x, y, z, slices or an array of truth values as its index")
        index = tuple(places[None].ravel().tolist())
    parts = index if isinstance(index, tuple) else (index,)
    lengths = iter(value.shape)
    parts = _without_ellipsis(parts, value.ndim)
    return tuple(None if part is None else _voxel(guard, part, next(lengths, 0)) for part in parts)


def _voxel(guard: Guard, part: object, length: int) -> Any:
    if isinstance(part, slice):
        return _voxel_slice(part)
    places = numbers(guard, part)
    if np.ndim(places):
        if np.isnan(places).any():
            raise Refusal("value", "an index that is not a number (NaN)")
        return places if places.dtype == bool else np.clip(np.round(places), 0, length - 1).astype(np.int64)
    place = round(number_of(places[()] if isinstance(places, np.ndarray) else places))
    return min(place if place == -1 else max(place, 0), length - 1)


def _voxel_slice(part: slice) -> slice:
    start, stop, step = (None if end is None else round(number_of(end)) for end in (part.start, part.stop, part.step))
    if start is not None and start < 0 and stop is not None:
        return slice(0, max(stop, 0), step)
    return slice(start, stop, step)
