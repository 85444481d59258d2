"""Values that language programs hold: observations of objects, and value maps that are not evaluated yet.

In: fields of an object at one moment, or a function that finds the object again. Out: records that programs of
``voxposer.sandbox`` may read.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, overload

import numpy as np

from voxposer.sandbox.guard import Opaque, Record, RecordList


class Observation(Record, Mapping[str, Any]):
    """Observation of an object at one moment: fields such as ``position``, ``aabb`` and ``normal``.

    Reading a field gives a copy of an array, list or dictionary. Fields whose names start with an underscore are for
    the host alone. Observations are compared by identity.
    """

    def __init__(self, fields: Mapping[str, Any]) -> None:
        self._fields = dict(fields)

    def fields(self) -> Collection[str]:
        """The names that programs may read."""
        return [name for name in self._fields if not name.startswith("_")]

    def __getitem__(self, name: str, /) -> Any:
        value = self._fields[name]
        return copy.deepcopy(value) if isinstance(value, (np.ndarray, list, dict)) else value

    def __getattr__(self, name: str) -> Any:
        fields = self.__dict__.get("_fields", {})
        if name not in fields:
            raise AttributeError(f"the observation has no {name!r}; it has {', '.join(sorted(fields))}")
        return self[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)

    def __str__(self) -> str:
        return str(self._fields.get("name", "observation"))


class DynamicObservation(Record):
    """An object whose fields are always current: each read runs the program that finds it again."""

    def __init__(self, now: Callable[[], Observation]) -> None:
        self._now = now

    def __call__(self) -> Observation:
        """The present observation."""
        return self._now()

    def fields(self) -> Collection[str]:
        """The names that programs may read."""
        return self._now().fields()

    def __getitem__(self, name: str, /) -> Any:
        return self._now()[name]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._now(), name)

    def __str__(self) -> str:
        return str(self._now())


class DynamicObservations(RecordList):
    """Several objects whose fields are always current."""

    def __init__(self, now: Callable[[], Sequence[Observation]]) -> None:
        self._now = now

    def __call__(self) -> list[Observation]:
        """The present observations."""
        return list(self._now())

    def __len__(self) -> int:
        return len(self._now())

    def __iter__(self) -> Iterator[DynamicObservation]:
        return (self[place] for place in range(len(self)))

    @overload
    def __getitem__(self, index: int) -> DynamicObservation: ...
    @overload
    def __getitem__(self, index: slice) -> list[DynamicObservation]: ...
    def __getitem__(self, index: int | slice) -> DynamicObservation | list[DynamicObservation]:
        if isinstance(index, slice):
            return [self[place] for place in range(*index.indices(len(self)))]
        if not -len(self) <= index < len(self):
            raise IndexError(f"{index} is not among {len(self)} observations")
        return DynamicObservation(lambda: self._now()[index])


class LazyMap(Opaque):
    """A map of the voxel grid, still a program: calling it runs the program on what is there now.

    Attributes:
        lmp: which LMP wrote it.
        query: what it was asked.
    """

    def __init__(self, lmp: str, query: str, now: Callable[[], np.ndarray]) -> None:
        self.lmp, self.query, self._now = lmp, query, now

    def __call__(self) -> np.ndarray:
        """The map, float64: ``[N, N, N]``, or ``[N, N, N, 4]`` (quaternions wxyz) for rotations.

        Raises:
            LmpError: the program breaks a rule, or made something else.
        """
        return self._now()
