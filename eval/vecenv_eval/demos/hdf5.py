"""HDF5 from untrusted files, read defensively.

No link is followed out of the file, sizes are checked before anything is read, and nothing is unpickled or evaluated.
Whatever is wrong becomes a :class:`DemoError` that names the file and the demonstration.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from h5py import h5o  # pyright: ignore[reportAttributeAccessIssue]

from vecenv.assets import AssetsMissing
from vecenv.errors import InvalidInput

# Far beyond any demonstration; a file that asks for more is damaged or hostile.
_MAX_COLUMNS = 10_000
_MAX_CHUNK_BYTES = 1 << 28
_MOST_TEXT = 1 << 25
# Metres, radians, their rates and seconds of any state; beyond it, simulations overflow.
MOST_STATE = 1e6
# What h5py and NumPy raise over a file that is damaged or holds something else.
DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, OverflowError, MemoryError, RecursionError)

Kind = TypeVar("Kind", h5py.Group, h5py.Dataset)


class DemoError(InvalidInput):
    """A demonstration file, or one demonstration in it, cannot be used; the message names both and what is wrong."""


@dataclass(frozen=True, kw_only=True)
class Unreadable:
    """A file, or a demonstration in it, that cannot be used.

    Attributes:
        path: the file.
        name: the demonstration, "" when it is the file.
        reason: what is wrong, without either name.
    """

    path: Path
    name: str
    reason: str

    def __str__(self) -> str:
        return ": ".join(filter(None, (str(self.path), self.name, self.reason)))


class Opened:
    """A file open for reading; whatever is wrong with it becomes a `DemoError` that names it."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> h5py.File:
        try:
            self._file = h5py.File(self._path, "r")
        except DAMAGE as error:
            raise DemoError(f"{self._path}: not a readable HDF5 file: {error_reason(error)}") from None
        return self._file

    def __exit__(self, *_: object) -> None:
        try:
            self._file.close()
        except DAMAGE as error:
            raise DemoError(f"{self._path}: {error_reason(error)}") from None


class Errors:
    """Puts the file's name, and the demonstration's, before what goes wrong inside."""

    def __init__(self, path: Path, name: str = "") -> None:
        self._path, self._name = path, name

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, DAMAGE) and not isinstance(error, AssetsMissing):
            raise DemoError(str(Unreadable(path=self._path, name=self._name, reason=error_reason(error)))) from None


def error_reason(error: BaseException) -> str:
    """What went wrong, in one line."""
    text = " ".join(str(error).split()) or "no reason given"
    return text if isinstance(error, DemoError) else f"{type(error).__name__}: {text}"


def member(group: h5py.Group, name: str, kind: type[Kind]) -> Kind:
    """A group or dataset that lies in the file itself."""
    what = "group" if kind is h5py.Group else "dataset"
    if name not in group:
        raise DemoError(f"it has no {what} {name!r}")
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise DemoError(f"{name!r} is a link to somewhere else")
    member = group[name]
    if not isinstance(member, kind):
        raise DemoError(f"{name!r} is not a {what}")
    if (count := h5o.get_info(member.id).rc) != 1:
        raise DemoError(f"{name!r} has {count} links to it, which no {what} of a demonstration has")
    return member


def numeric_dataset(group: h5py.Group, name: str) -> h5py.Dataset:
    """A numeric dataset that lies in the file itself and can be read in pieces of a reasonable size."""
    dataset = member(group, name, h5py.Dataset)
    if dataset.external or dataset.is_virtual:
        raise DemoError(f"{name}: its numbers are in another file")
    if dataset.dtype.kind not in "fiub":
        raise DemoError(f"{name}: expected numbers, got {dataset.dtype}")
    if math.prod(dataset.chunks or ()) * dataset.dtype.itemsize > _MAX_CHUNK_BYTES:
        raise DemoError(f"{name}: its chunks of {shape_text(dataset.chunks)} are too large to read")
    return dataset


def vector_attribute(group: h5py.Group, name: str) -> np.ndarray:
    """An attribute of numbers, float64 [1 + nq + nv]."""
    value = np.asarray(attribute(group, name))
    if value.dtype.kind not in "fiu" or value.ndim != 1 or len(value) > _MAX_COLUMNS:
        raise DemoError(
            f"attribute {name}: expected numbers [1 + nq + nv], got {value.dtype} {shape_text(value.shape)}"
        )
    return value.astype(float)


def attribute(group: h5py.Group, name: str) -> Any:
    """An attribute, None where there is none; nothing larger than a text may be is read."""
    if name not in group.attrs:
        return None
    about = group.attrs.get_id(name)
    if (size := about.get_storage_size()) > _MOST_TEXT or math.prod(about.shape) > _MOST_TEXT:
        raise DemoError(f"attribute {name}: {size:,} bytes, more than {_MOST_TEXT:,}")
    return group.attrs[name]


def require_finite(name: str, values: np.ndarray) -> np.ndarray:
    """The values; raises `DemoError` when one is not finite, or so large that a simulation of it overflows."""
    if not np.isfinite(values).all():
        raise DemoError(f"{name}: holds a value that is not finite")
    if (most := float(np.abs(values).max(initial=0.0))) > MOST_STATE:
        raise DemoError(f"{name}: holds {most:g}, more than {MOST_STATE:g}")
    return values


def text_attribute(group: h5py.Group, name: str) -> str | None:
    """An attribute of text; None where there is none."""
    value = attribute(group, name)
    if isinstance(value, bytes):
        value = value.decode()
    if value is not None and not isinstance(value, str):
        raise DemoError(f"attribute {name}: expected text, got {type(value).__name__}")
    if value is not None and len(value) > _MOST_TEXT:
        raise DemoError(f"attribute {name}: {len(value):,} characters, more than {_MOST_TEXT:,}")
    return value


def json_attribute(group: h5py.Group, name: str) -> dict[str, Any]:
    """An attribute that holds a JSON object."""
    try:
        value = json.loads(text_attribute(group, name) or "")
    except (ValueError, RecursionError) as error:
        raise DemoError(f"attribute {name}: not JSON: {error}") from None
    if not isinstance(value, dict):
        raise DemoError(f"attribute {name}: expected a JSON object, got {type(value).__name__}")
    return value


def shape_text(shape: Sequence[int] | None) -> str:
    """A shape for messages: ``"[3, 7]"``."""
    return f"[{', '.join(map(str, shape or ()))}]"


def states_dataset(group: h5py.Group, ticks: int) -> h5py.Dataset:
    """The states of a demonstration with so many actions, one row an action, checked but not read."""
    dataset = numeric_dataset(group, "states")
    if dataset.ndim != 2 or dataset.shape[0] != ticks or dataset.shape[1] > _MAX_COLUMNS:
        raise DemoError(f"states: expected one row an action, [{ticks}, 1 + nq + nv], got {shape_text(dataset.shape)}")
    return dataset
