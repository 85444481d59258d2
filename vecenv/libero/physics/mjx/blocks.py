"""Functions of worlds that XLA compiles for one number of worlds, whatever the batch: the same bits in any batch.

XLA decides by the size of arrays which operations it joins in one kernel, and joined ones round less (a product and a
sum become one operation). So an elementwise function of a batch may differ in the last bit between batches of different
sizes. In deterministic programs such functions are computed in blocks of a fixed number of worlds, the last one filled
up; a block of a GPU is so large that a usual batch is one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import PyTree

from vecenv.controllers._batch_last import fenced_on_cpu, stage

# Worlds of a block.
ON_CPU, ON_ACCELERATOR = 8, 4096


def by_blocks(function: Callable[[PyTree, PyTree], PyTree], shared: PyTree, rows: PyTree) -> PyTree:
    """``function(shared, rows)``, computed in blocks of rows.

    Args:
        function: a function of batches that treats every row alike.
        shared: arrays that all rows share.
        rows: leaves [n, ...].

    Returns:
        What the function returns, leaves [n, ...].
    """
    size = ON_CPU if jax.devices()[0].platform == "cpu" else ON_ACCELERATOR
    n = jax.tree.leaves(rows)[0].shape[0]
    count = -(-n // size)

    def filled(x: jax.Array) -> jax.Array:
        more = jnp.broadcast_to(x[:1], (count * size - n, *x.shape[1:]))
        return jnp.concatenate([x, more]).reshape(count, size, *x.shape[1:])

    def alone(shared: PyTree, rows: PyTree, *, fence: bool) -> PyTree:
        return stage(fence, function, shared, rows)

    def block(rows: PyTree) -> PyTree:
        # Nothing of a block is computed outside it, or together with what surrounds it.
        return lax.optimization_barrier(fenced_on_cpu(alone, *lax.optimization_barrier((shared, rows))))

    found = lax.map(block, jax.tree.map(filled, rows))
    return jax.tree.map(lambda x: x.reshape(count * size, *x.shape[2:])[:n], found)


def for_worlds(function: Callable[[PyTree, PyTree], PyTree], deterministic: bool) -> Callable[[Any, Any], Any]:
    """A function of what worlds share and of one world; under ``vmap`` it is computed by blocks if deterministic.

    Args:
        function: ``(shared, world) -> result``.
        deterministic: False returns the function itself.
    """
    if not deterministic:
        return function
    one = custom_vmap(function)

    @one.def_vmap
    def batch(size: int, batched: tuple[PyTree, PyTree], shared: PyTree, world: PyTree) -> tuple[PyTree, PyTree]:
        def whole(x: jax.Array, has_rows: bool) -> jax.Array:
            return x if has_rows else jnp.broadcast_to(x, (size, *jnp.shape(x)))

        if any(jax.tree.leaves(batched[0])):  # not shared after all: constants that a training loop randomises
            rows = jax.tree.map(whole, (shared, world), batched)
            found = by_blocks(lambda _, rows: jax.vmap(function)(*rows), (), rows)
        else:
            rows = jax.tree.map(whole, world, batched[1])
            found = by_blocks(jax.vmap(function, in_axes=(None, 0)), shared, rows)
        return found, jax.tree.map(lambda _: True, found)

    return one
