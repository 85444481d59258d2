"""A batch over several devices of one host: each device runs the whole compiled function on its own rows.

In: arrays sharded by their first axis, or replicated. Out: arrays sharded likewise. Devices exchange nothing, so a loop
ends on a device when its own rows have stopped. Every device has its own executable and its own thread: XLA's
partitioner crashes on Warp's calls (segmentation fault in the compiler; jax 0.11.2, warp-lang 1.18.0), and a
thread that waits for a loop's condition on one device must not keep the other devices waiting.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree


def replicated(mesh: Mesh) -> NamedSharding:
    """The sharding of arrays that are the same on every device."""
    return NamedSharding(mesh, PartitionSpec())


def over_rows(mesh: Mesh) -> NamedSharding:
    """The sharding of arrays whose first axis is split evenly over the devices."""
    return NamedSharding(mesh, PartitionSpec(mesh.axis_names[0]))


class Spread:
    """A function of rows, run on every device of a mesh.

    Args:
        function: a compiled function, which runs on the device of its arguments. Every output has rows first.
        mesh: the devices, one axis.
        shared: how many of the first arguments are the same for all rows.
    """

    def __init__(self, function: Callable[..., Any], mesh: Mesh, shared: int) -> None:
        self._function, self._shared, self._count = function, shared, mesh.size
        self._replicated, self._rows = replicated(mesh), over_rows(mesh)
        self._threads = ThreadPoolExecutor(mesh.size, thread_name_prefix="vecenv-device")

    def __call__(self, *args: PyTree) -> PyTree:
        """Call the function; arguments on other devices are copied to the right ones first."""
        put = [jax.device_put(arg, self._replicated) for arg in args[: self._shared]]
        put += [jax.device_put(arg, self._rows) for arg in args[self._shared :]]
        shares = [_share(put, index) for index in range(self._count)]
        return self._join(list(self._threads.map(lambda share: self._function(*share), shares)))

    def _join(self, parts: Sequence[PyTree]) -> PyTree:
        """Arrays over all devices from what each device computed; nothing is copied."""

        def join(*shares: jax.Array) -> jax.Array:
            shape = (sum(share.shape[0] for share in shares), *shares[0].shape[1:])
            return jax.make_array_from_single_device_arrays(shape, self._rows, list(shares))

        return jax.tree.map(join, *parts)


def _share(tree: PyTree, index: int) -> PyTree:
    """The part of sharded arrays that one device holds."""
    return jax.tree.map(lambda array: array.addressable_shards[index].data, tree)
