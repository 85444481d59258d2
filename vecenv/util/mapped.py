"""Functions of one world that know how many worlds ``vmap`` maps them over.

In: a function of one world, and what it needs for a batch of a given size: MuJoCo Warp's contact memory, a render
context. Out: a function of one world for any nesting of ``vmap``, which prepares for the whole batch once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PyTree


class Sized:
    """A function of one world that knows how many worlds it is mapped over.

    Args:
        function: ``function(prepared, *args)`` of one world, mapped over its arguments but not over ``prepared``.
        prepare: ``prepare(num_worlds)`` makes what that many worlds share; called while tracing.
    """

    def __init__(self, function: Callable[..., Any], prepare: Callable[[int], Any]) -> None:
        self._function, self._prepare = function, prepare

    def __call__(self, *args: PyTree) -> PyTree:
        """The function of one world, or under ``vmap`` of many."""

        @jax.custom_batching.custom_vmap
        def one(*args: PyTree) -> PyTree:
            return self._function(self._prepare(1), *args)

        @one.def_vmap
        def _(size: int, batched: Sequence[PyTree], *args: PyTree) -> PyTree:
            return _all_batched(self._many(size, _axes(batched))(*args))

        return one(*args)

    def _many(self, size: int, axes: tuple[PyTree, ...]) -> Callable[..., Any]:
        """The function of ``size`` worlds on leading axes; those of further ``vmap``s are folded into them."""

        @jax.custom_batching.custom_vmap
        def many(*args: PyTree) -> PyTree:
            def one(*args: PyTree) -> PyTree:
                return self._function(self._prepare(size), *args)

            return jax.vmap(one, in_axes=axes, axis_size=size)(*args)

        @many.def_vmap
        def _(outer: int, batched: Sequence[PyTree], *args: PyTree) -> PyTree:
            folded = jax.tree.map(
                lambda x, inner, now: _fold(x, inner is not None, now, outer, size),
                args,
                axes,
                tuple(batched),
                is_leaf=lambda x: x is None,
            )
            either = jax.tree.map(
                lambda inner, now: 0 if now or inner is not None else None,
                axes,
                tuple(batched),
                is_leaf=lambda x: x is None,
            )
            out = self._many(outer * size, either)(*folded)
            return _all_batched(jax.tree.map(lambda x: x.reshape(outer, size, *x.shape[1:]), out))

        return many


def _axes(batched: Sequence[PyTree]) -> tuple[PyTree, ...]:
    return jax.tree.map(lambda mapped: 0 if mapped else None, tuple(batched))


def _all_batched(out: PyTree) -> tuple[PyTree, PyTree]:
    return out, jax.tree.map(lambda _: True, out)


def _fold(x: jax.Array, inner: bool, outer: bool, outer_size: int, inner_size: int) -> jax.Array:
    """Merge leading axes of ``outer_size`` and ``inner_size`` into one; an axis that is missing is broadcast."""
    if not inner and not outer:
        return x
    if not outer:
        x = jnp.broadcast_to(x, (outer_size, *x.shape))
    if not inner:
        x = jnp.broadcast_to(x[:, None], (outer_size, inner_size, *x.shape[1:]))
    return x.reshape(outer_size * inner_size, *x.shape[2:])
