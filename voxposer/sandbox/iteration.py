"""Iterators of programs: generators, ``map``, ``filter``, ``zip``, ``enumerate``, ``reversed``, ``iter`` and ``next``.

In: a ``Guard`` and values to loop over. Out: a :class:`~voxposer.sandbox.objects.Stream`, whose items are made as they
are taken, as Python's are. Each item counts as a step, and iterators over iterators count towards the depth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from voxposer.sandbox.guard import Guard, Refusal, kind_of, refuse_kind
from voxposer.sandbox.objects import DType, Function, Stream
from voxposer.sandbox.values import converted, integer, iterate, listed, truth

_NOTHING = object()


# Levels of depth that taking an item from an iterator counts for.
_LEVELS = 2


def stream(guard: Guard, name: str, items: Iterable[Any], levels: int = _LEVELS) -> Stream:
    """An iterator over items, counted as they are taken: a step each, and ``levels`` of depth meanwhile."""
    return Stream(name, _pulled(guard, iter(items), levels))


def _pulled(guard: Guard, items: Iterator[Any], levels: int) -> Iterator[Any]:
    budget = guard.budget
    while True:
        depth = budget.depth
        try:
            budget.step()
            budget.deeper(levels)
            item = next(items)
        except StopIteration:
            return
        finally:
            budget.depth = depth
        yield item


def callable_of(guard: Guard, value: object) -> Callable[..., Any]:
    """What a program gave as a function, ready to be called with evaluated arguments.

    Raises:
        Refusal: it is no function.
    """
    if isinstance(value, Function):
        return value.call
    if isinstance(value, DType):
        return lambda *values: guard.take(converted(guard, value, *values))
    raise Refusal("functions", f"a value of kind {kind_of(value)} is called like a function", TypeError)


def zipped(guard: Guard, *values: object, strict: object = False) -> Stream:
    """``zip``."""
    return stream(guard, "zip", _zip(guard, [iter(iterate(guard, value)) for value in values], truth(guard, strict)))


def _zip(guard: Guard, sources: list[Iterator[Any]], strict: bool) -> Iterator[Any]:
    while sources:
        row: list[Any] = []
        for source in sources:
            item = next(source, _NOTHING)
            if item is not _NOTHING:
                row.append(item)
            elif strict and row:
                raise Refusal("value", "zip(strict=True) of values of different lengths")
            else:
                if strict and any(next(other, _NOTHING) is not _NOTHING for other in sources[1:]):
                    raise Refusal("value", "zip(strict=True) of values of different lengths")
                return
        yield guard.take(tuple(row))


def enumerated(guard: Guard, iterable: object, start: object = 0) -> Stream:
    """``enumerate``."""
    return stream(guard, "enumerate", enumerate(iterate(guard, iterable), integer(start)))


def mapped(guard: Guard, function: object, *values: object) -> Stream:
    """``map``."""
    if not values:
        raise Refusal("types", "map takes a function and at least one value to loop over")
    call, rows = callable_of(guard, function), _zip(guard, [iter(iterate(guard, value)) for value in values], False)
    return stream(guard, "map", (call(*row) for row in rows))


def filtered(guard: Guard, function: object, iterable: object) -> Stream:
    """``filter``."""
    call = None if function is None else callable_of(guard, function)
    return stream(guard, "filter", _filter(guard, call, iterate(guard, iterable)))


def _filter(guard: Guard, call: Callable[..., Any] | None, items: Iterable[Any]) -> Iterator[Any]:
    for item in items:
        guard.budget.step()
        if truth(guard, item if call is None else call(item)):
            yield item


def backwards(guard: Guard, sequence: object) -> Stream:
    """``reversed``."""
    if isinstance(sequence, (set, Stream)):
        refuse_kind(sequence, "a list, tuple, text, range, dictionary or array to reverse")
    if isinstance(sequence, (range, np.ndarray)):
        return stream(guard, "reversed", sequence[::-1])
    return stream(guard, "reversed", listed(guard, sequence)[::-1])


def make_iterator(guard: Guard, value: object) -> Stream:
    """``iter``."""
    return value if isinstance(value, Stream) else stream(guard, "iterator", iterate(guard, value))


def next_item(guard: Guard, iterator: object, default: object = _NOTHING) -> Any:
    """``next``."""
    if not isinstance(iterator, Stream):
        refuse_kind(iterator, "an iterator (write iter(...) around a list)")
    item = next(iterator.items, default)
    if item is _NOTHING:
        raise Refusal("value", "StopIteration: the iterator has no item left", StopIteration)
    return item
