"""What the tests of Gymnasium's interfaces share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

SUITE, TASK, COUNT = "libero_object", 1, 3
POOL = (4, 7, 9)
MODES = tuple(AutoresetMode)


def actions(ticks: int, seed: int = 0, count: int = COUNT) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (ticks, count, 7)).astype(np.float32)


def episodes(infos: Mapping[str, Any]) -> list[int | None]:
    return [None if name is None else int(name.rsplit("/", 1)[1]) for name in infos["episode_id"]]


def assert_same(ours: Any, theirs: Any) -> None:
    """Equal to the last bit, with the same names, shapes and types."""
    if isinstance(theirs, Mapping):
        assert set(ours) == set(theirs)
        for name, value in theirs.items():
            assert_same(ours[name], value)
    elif isinstance(theirs, list | tuple) or (isinstance(theirs, np.ndarray) and theirs.dtype == object):
        assert getattr(ours, "dtype", None) == getattr(theirs, "dtype", None)
        for our, their in zip(ours, theirs, strict=True):
            assert_same(our, their)
    elif isinstance(theirs, np.ndarray):
        assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype)
        np.testing.assert_array_equal(ours, theirs)
    else:
        assert ours == theirs
