"""Arithmetic on arrays whose batch axes come last, and how it is handed to XLA: shared by ``osc`` and ``kinematics``.

In: arrays [components, ...batch]. Out: the same; every operation is elementwise over the batch, so no slot affects
another and nothing is left to a matrix unit, which may round float32 to TF32. Long chains of such operations are cut
into stages (``stage``), which matters on a CPU only (``fenced_on_cpu``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Float, PyTree


def fenced_on_cpu(function: Callable[..., Any], *args: PyTree, **options: object) -> PyTree:
    """Call ``function(*args, fence=..., **options)``, with ``fence`` True where the program is compiled for a CPU."""
    fenced, plain = (partial(function, fence=fence, **options) for fence in (True, False))
    return lax.platform_dependent(*args, cpu=fenced, default=plain)


def stage(fence: bool, function: Callable[..., Any], *args: PyTree) -> PyTree:
    """Apply ``function`` to arrays; with ``fence``, as a call that XLA compiles on its own.

    XLA's CPU fusion copies a cheap producer into each of its consumers, and along a chain of eliminations that repeats
    the first steps thousands of times. ``optimization_barrier`` is removed before fusion runs; a call that may not be
    inlined stays. The controller's torques of 512 slots take 0.5 ms instead of 2, and compiling them 1 s instead of 5.
    """
    if not fence:
        return function(*args)

    def without_mark(*args: PyTree) -> PyTree:
        with set_xla_metadata(inlineable=None):
            return function(*args)

    with set_xla_metadata(inlineable="false"):
        return jax.jit(without_mark)(*args)


def sum_rows(x: Float[Array, "k ..."]) -> Float[Array, "..."]:
    """Sum of [k, ...] over axis 0 in a fixed order, elementwise over the rest."""
    total = x[0]
    for i in range(1, x.shape[0]):
        total = total + x[i]
    return total


def cross(a: Float[Array, "3 *#B"], b: Float[Array, "3 *#B"]) -> Float[Array, "3 *#B"]:
    """Cross product of [3, ...] with [3, ...]."""
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
