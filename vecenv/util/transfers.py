"""Between the host's memory and that of the device: results as JAX arrays, and images as NumPy arrays.

In: what a method returns, with NumPy arrays; or JAX arrays. Out: the same with JAX arrays; or NumPy arrays.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import SingleDeviceSharding

_Result = TypeVar("_Result")


def put(result: _Result) -> _Result:
    """A dataclass whose NumPy arrays, those in its dictionaries too, are JAX arrays on the default device."""
    fields = {field.name: getattr(result, field.name) for field in dataclasses.fields(cast(Any, result))}
    return dataclasses.replace(cast(Any, result), **{name: _put(value) for name, value in fields.items()})


def _put(value: object) -> object:
    if isinstance(value, np.ndarray):
        return jnp.asarray(value)
    return {name: _put(each) for name, each in value.items()} if isinstance(value, dict) else value


def fetch(arrays: Sequence[jax.Array]) -> list[np.ndarray]:
    """Arrays as NumPy arrays of the caller's own, which may be written to.

    From a GPU they come through page-locked memory, several times as fast, and the NumPy arrays are that memory: it is
    used again once they are gone.
    """
    return [_owned(array) for array in [_page_locked(array) for array in arrays]]


def _page_locked(array: jax.Array) -> jax.Array:
    """Start the copy of an array to page-locked memory of the host; on a CPU the array itself."""
    device, *others = array.sharding.device_set
    if device.platform == "cpu":
        return array
    if others:  # one device at a time: NumPy arrays are in one piece
        array.copy_to_host_async()
        return array
    return jax.device_put(array, SingleDeviceSharding(device, memory_kind="pinned_host"))


def _owned(array: jax.Array) -> np.ndarray:
    if array.sharding.memory_kind != "pinned_host":
        return np.array(array)
    return np.asarray(_Held(array.block_until_ready()))


class _Held:
    """An array in the host's memory for NumPy, which keeps it, and with it the memory, as long as a view exists."""

    def __init__(self, array: jax.Array) -> None:
        self._array = array
        self.__array_interface__ = {
            "version": 3,
            "shape": array.shape,
            "typestr": np.dtype(array.dtype).str,
            "data": (array.unsafe_buffer_pointer(), False),
        }
