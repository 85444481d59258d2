"""Kinematic trees that XLA compiles level by level: with ``impl="jax"``, plain ``jax.jit`` on a CPU is enough.

The CPU compiler of jaxlib 0.10 fuses the whole of ``mjx.kinematics`` into loops in which each body computes all its
ancestors again: of this robot seconds a call, after a minute of compilation. MJX goes through the tree with one
function (``scan._nvmap``, a call a level). Inside :func:`level_by_level`, the results of a level are behind an
``optimization_barrier``; outside, and for every other user of MJX in the process, the function is MJX's own. A barrier
changes no value, and has rules for ``vmap``, ``jvp`` and ``grad``.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import jax
from jax import lax

from vecenv.libero.physics import private
from vecenv.libero.physics.mjx.options import MjxError, with_barriers

_ACTIVE: ContextVar[bool] = ContextVar("vecenv_level_by_level", default=False)


@contextmanager
def level_by_level() -> Iterator[None]:
    """MJX functions traced inside are compiled level by level where JAX runs on a CPU.

    Raises:
        MjxError: the installed MJX goes through trees in another way.
    """
    _install()
    token = _ACTIVE.set(with_barriers() and _runs_on_cpu())
    try:
        yield
    finally:
        _ACTIVE.reset(token)


def _runs_on_cpu() -> bool:
    device = jax.config.values.get("jax_default_device")
    return (getattr(device, "platform", device) or jax.default_backend()) == "cpu"


@functools.cache
def _install() -> None:
    """Put the choice between both ways into MJX, once a process."""
    scan = private.jax_scan
    current = getattr(scan, "_nvmap", None)
    callers = [getattr(scan, name, None) for name in ("body_tree", "flat")]
    if not inspect.isfunction(current) or not all(_refers_to_nvmap(caller) for caller in callers):
        raise MjxError(
            f"mujoco-mjx {private.installed_version()} goes through kinematic trees in another way than the version "
            f"that this vecenv was tested with ({private.TESTED}): install that one"
        )
    if not hasattr(current, "__wrapped__"):
        scan._nvmap = _fenced(current)


def _refers_to_nvmap(function: Any) -> bool:
    return inspect.isfunction(function) and "_nvmap" in function.__code__.co_names


def _fenced(current: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(current)
    def nvmap(*args: Any) -> Any:
        found = current(*args)
        return behind_barrier(found) if _ACTIVE.get() else found

    return nvmap


def behind_barrier(tree: Any) -> Any:
    """The arrays of a tree, which XLA does not simplify together with what uses them."""
    leaves, structure = jax.tree.flatten(tree)
    moving = [index for index, leaf in enumerate(leaves) if isinstance(leaf, jax.Array) and leaf.size > 0]
    if moving:
        for index, leaf in zip(moving, lax.optimization_barrier([leaves[index] for index in moving]), strict=True):
            leaves[index] = leaf
    return jax.tree.unflatten(structure, leaves)
