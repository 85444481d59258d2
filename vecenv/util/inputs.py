"""Arguments of callers as arrays, lists and integers of a checked type, or a refusal that says what would be right.

In: whatever a caller gives, and the kind of error to raise. Out: NumPy arrays of the expected kind and shape, lists of
items, Python integers. Generators are read once, and not without end; bytes are no sequence of values; a bool
is not taken for a number, though Python and NumPy say that it is one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from typing import Any

import numpy as np

from vecenv.util.names import shown

# Elements of an argument: more are a mistake, and would be copied.
MOST = 1 << 27
# Entries of a list of slots, tasks or episodes.
MOST_ENTRIES = 1 << 20
# The largest count that every array of this project holds.
MOST_COUNT = 2**31 - 1
_NO_LIST = Mapping | bytes | bytearray | memoryview


def read_once(value: object) -> object:
    """An iterator's items as a list, at most one more than ``MOST_ENTRIES``; anything else as it is."""
    return list(itertools.islice(value, MOST_ENTRIES + 1)) if isinstance(value, Iterator) else value


def items(value: object, what: str, error: type[Exception]) -> list[Any]:
    """What a list, range, array or generator holds, of a set in ascending order; a single value is a list of itself.

    Args:
        value: what a caller gave.
        what: what an entry is, for messages.
        error: raised for a mapping, bytes, and what has too many entries.
    """
    if isinstance(value, _NO_LIST):
        raise error(f"{what}: {shown(value)} is not an integer or a list of them but a {type(value).__name__}")
    if isinstance(value, AbstractSet):
        value = sorted(value, key=lambda each: ("", each) if is_integer(each) else (type(each).__name__, shown(each)))
    if isinstance(value, str) or not isinstance(value, Iterable) or (isinstance(value, np.ndarray) and not value.ndim):
        return [value.item() if isinstance(value, np.ndarray) else value]
    try:
        found = list(itertools.islice(value, MOST_ENTRIES + 1))
    except Exception as problem:
        raise error(f"{what}: {shown(value)} cannot be read: {problem}") from problem
    if len(found) > MOST_ENTRIES:
        raise error(f"{what}: more than {MOST_ENTRIES} entries")
    return found


def is_integer(value: object) -> bool:
    """Whether something is a Python or NumPy integer and no bool; an array of one is none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def integers(value: object, what: str, error: type[Exception]) -> list[int]:
    """One integer or several, as Python's; errors as of ``items``, and for an entry that is no integer."""
    whole: list[int] = []
    for item in items(value, what, error):
        if isinstance(item, np.ndarray) and not item.ndim:
            item = item.item()
        if not is_integer(item):
            raise error(f"{what}: {shown(item)} is not an integer")
        whole.append(int(item))
    return whole


def count(value: object, what: str, error: type[Exception], *, least: int = 0, most: int = MOST_COUNT) -> int:
    """One integer from ``least`` to ``most``, as Python's.

    Raises:
        error: it is none.
    """
    if not is_integer(value) or not least <= int(value) <= most:  # pyright: ignore[reportArgumentType]
        raise error(f"{what}={shown(value)}: expected an integer from {least} to {most}")
    return int(value)  # pyright: ignore[reportArgumentType]


def array(
    value: object,
    what: str,
    right: str,
    error: type[Exception],
    *,
    kinds: str = "iuf",
    fits: Callable[[tuple[int, ...]], bool] = lambda shape: True,
) -> np.ndarray:
    """A caller's array as NumPy's, of its own type and not copied.

    Args:
        value: an array of any library that NumPy reads, nested sequences, a number, or a generator.
        what: its name, for messages.
        right: what is expected, for messages.
        error: raised for what is no such array.
        kinds: NumPy's letters of the kinds of numbers that are taken; ``b`` takes bools as well.
        fits: whether a shape is right.
    """
    if isinstance(value, Mapping | AbstractSet):
        raise error(f"{what}: got a {type(value).__name__}, not numbers; expected {right}")
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise error(f"{what}: some of its numbers are masked; expected {right}")
    try:
        value = read_once(value)
        if "b" not in kinds and _holds_bool(value):
            raise TypeError("bools are no numbers")
        found = np.asarray(value)
    except Exception as problem:  # whatever the object's own conversion raises
        raise error(f"{what}: not numeric or ragged ({problem}); expected {right}") from problem
    if found.dtype.kind not in kinds and found.size:
        raise error(f"{what}: got {found.dtype} values, not numbers; expected {right}")
    if found.size > MOST or not fits(found.shape):
        raise error(f"{what}: got shape {found.shape}; expected {right}")
    return found


def _holds_bool(value: object) -> bool:
    """Whether nested lists hold a bool, which NumPy takes for a number if there are numbers beside it."""
    if isinstance(value, list | tuple):
        return any(map(_holds_bool, value))
    return isinstance(value, bool | np.bool_)


def floats(
    value: object,
    what: str,
    right: str,
    error: type[Exception],
    *,
    kinds: str = "iuf",
    fits: Callable[[tuple[int, ...]], bool] = lambda shape: True,
) -> np.ndarray:
    """``array`` as a float64 array of the function's own; numbers that are too large become infinite."""
    found = array(value, what, right, error, kinds=kinds, fits=fits)
    if found.dtype.kind not in kinds:  # nothing in it
        return np.zeros(found.shape)
    with np.errstate(over="ignore", invalid="ignore"):
        return found.astype(np.float64)


def bools(value: object, what: str, count_: int, error: type[Exception]) -> np.ndarray:
    """One true or false, or one a slot, as bool [B].

    Raises:
        error: anything else.
    """
    right = f"true or false, or {count_} of them"
    found = array(value, what, right, error, kinds="b", fits=lambda shape: shape in ((), (count_,)))
    if found.dtype != bool:
        raise error(f"{what}: got {shown(value)}; expected {right}")
    return np.broadcast_to(found, count_).copy()


def indices(slots: object, count_: int, error: type[Exception], *, as_given: bool = False) -> np.ndarray:
    """Indices of slots, int [n], ascending or in the order they were given, from bool [B], indices, or None for all.

    Raises:
        error: a mask of another length, a slot that does not exist or is named twice, or anything else.
    """
    if slots is None:
        return np.arange(count_)
    right = f"bool [{count_}] or indices from 0 to {count_ - 1}"
    given = array(slots, "slots", right, error, kinds="biu", fits=lambda shape: len(shape) < 2)
    if given.dtype == bool:
        if given.shape != (count_,):
            raise error(f"slots: a mask of shape {list(given.shape)}; expected {right}")
        return np.flatnonzero(given)
    rows = np.atleast_1d(given)
    if _holds_bool(slots):
        raise error(f"slots={shown(slots)}: bools and indices together; expected {right}")
    if rows.size and (int(rows.min()) < 0 or int(rows.max()) >= count_):
        raise error(f"slots={shown(slots)}: there are slots 0 to {count_ - 1}; expected {right}")
    if len(np.unique(rows)) < len(rows):
        raise error(f"slots={shown(slots)}: a slot is named twice")
    return (rows if as_given else np.sort(rows)).astype(int)
