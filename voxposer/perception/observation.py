"""Observations with fields that are computed on reading, and snapshots whose arrays are read-only.

In: what is known of an object, and functions for the expensive rest. Out: a :class:`LazyObservation` that programs read
like any other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vecenv.errors import NotFound
from vecenv.observations import ObjectsSnapshot
from voxposer.language.observations import Observation


class PerceptionError(NotFound):
    """No object has this name, or the object does not have the requested field."""


class LazyObservation(Observation):
    """An observation whose expensive fields are computed when they are read.

    Args:
        values: fields that are known.
        later: functions that compute the other fields, by name.
    """

    def __init__(self, values: Mapping[str, Any], later: Mapping[str, Callable[[], Any]]) -> None:
        super().__init__({**values, **dict.fromkeys(later)})
        self._later = dict(later)

    def __getitem__(self, name: str, /) -> Any:
        return self._later[name]() if name in self._later else super().__getitem__(name)

    def updated(self, values: Mapping[str, Any]) -> LazyObservation:
        """The same observation with some known fields added or replaced."""
        known = {key: self[key] for key in self if key not in self._later}
        return LazyObservation({**known, **values}, self._later)


def freeze(snapshot: ObjectsSnapshot) -> None:
    """Make every array of a snapshot read-only."""
    for value in _arrays(snapshot):
        value.flags.writeable = False


def _arrays(value: object) -> list[np.ndarray]:
    """Every array in nested dataclasses and mappings."""
    if isinstance(value, np.ndarray):
        return [value]
    if dataclasses.is_dataclass(value):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return [array for item in value.values() for array in _arrays(item)] if isinstance(value, Mapping) else []
