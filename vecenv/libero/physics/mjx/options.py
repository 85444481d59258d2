"""Where MJX runs: the implementation, and the options and cache that JAX compiles with.

In: an implementation by name, or none. Out: ``"warp"`` (MuJoCo Warp, on NVIDIA GPUs or a CPU) or ``"jax"`` (pure JAX),
and ``jit``, which compiles anything that contains a physics step.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Literal, TypeAlias

import jax
import numpy as np

from vecenv.errors import InvalidInput
from vecenv.util import caching

Impl: TypeAlias = Literal["jax", "warp"]
# The bit of a Warp model's disable flags, which MuJoCo does not use, that selects deterministic steps.
DETERMINISTIC = 1 << 29


class MjxError(InvalidInput):
    """A backend, device or scene that MJX cannot serve; the message says what would be right."""


def resolve_impl(impl: str | None = None) -> Impl:
    """The implementation to use: the given one, or ``"warp"`` where JAX runs on CUDA and ``"jax"`` elsewhere.

    Raises:
        MjxError: an unknown name, or warp is not installed.
    """
    if impl is None:
        device = jax.devices()[0]
        impl = "warp" if device.platform in ("gpu", "cuda") and _has_warp() else "jax"
    if impl not in ("jax", "warp"):
        raise MjxError(f"impl={impl!r}: expected 'jax' or 'warp'")
    if impl == "warp" and not _has_warp():
        raise MjxError("backend 'warp' needs MuJoCo Warp: pip install 'vecenv[warp]'")
    return "warp" if impl == "warp" else "jax"


def is_deterministic(model: Any) -> bool:
    """Whether an MJX model, or one of MuJoCo Warp, is stepped deterministically, see ``deterministic``."""
    return bool(int(model.opt.disableflags) & DETERMINISTIC)


def _has_warp() -> bool:
    return importlib.util.find_spec("warp") is not None


def compiler_options(platform: str | None = None) -> dict[str, Any]:
    """Options for ``jax.jit`` of anything that contains ``mjx.step`` or the controller.

    On a CPU, the fusion emitters of the XLA in jax 0.10 recompute a kinematic chain again and again: ``mjx.kinematics``
    of this robot takes seconds a call with them and 0.6 ms without. ``vecenv.libero.physics.mjx.fusion`` is another way
    to prevent that, for plain ``jax.jit``. jax 0.11 has neither the problem nor the option.
    """
    chosen = platform or jax.devices()[0].platform
    return dict(_CPU_OPTIONS) if chosen == "cpu" and _knows_cpu_options() else {}


_CPU_OPTIONS = {"xla_cpu_use_fusion_emitters": False}


@functools.cache
def _knows_cpu_options() -> bool:
    """Whether this jaxlib accepts the options."""
    cpu = jax.devices("cpu")[0]
    try:
        jax.jit(lambda x: x, compiler_options=_CPU_OPTIONS)(jax.device_put(np.zeros(1), cpu))
    except jax.errors.JaxRuntimeError:
        return False
    return True


def jit(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """``jax.jit`` with ``compiler_options`` for the default device.

    Plain ``jax.jit`` gives the same values at the same speed. On a CPU with jax 0.10, this one compiles faster, because
    with these options no barriers are needed between the levels of kinematic trees
    (``vecenv.libero.physics.mjx.fusion``).
    """
    chosen = compiler_options()
    return jax.jit(_traced_without_barriers(function) if chosen else function, compiler_options=chosen, **options)


def _traced_without_barriers(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def traced(*args: Any, **options: Any) -> Any:
        with without_barriers():
            return function(*args, **options)

    return traced


_BARRIERS: ContextVar[bool] = ContextVar("vecenv_barriers", default=True)


@contextmanager
def without_barriers() -> Iterator[None]:
    """What is traced inside has no barriers between the levels of kinematic trees."""
    token = _BARRIERS.set(False)
    try:
        yield
    finally:
        _BARRIERS.reset(token)


def with_barriers() -> bool:
    """Whether functions that are traced now get barriers, as they do outside of ``without_barriers``."""
    return _BARRIERS.get()


def remember_compilations() -> None:
    """Turn JAX's persistent compilation cache on, in the user's cache folder, unless a folder was already chosen.

    XLA's own caches of autotuning stay off: with them the keys of programs hold the folder's path (jax 0.10.2), and a
    folder that was copied elsewhere, or mounted there, would be of no use.
    """
    folder = caching.folder("jax")
    if jax.config.values.get("jax_compilation_cache_dir") is None and folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
