"""Memory of a process that runs many files of tests: what is freed goes back to the system."""

from __future__ import annotations

import ctypes
import gc
import sys

import jax
import psutil

# Allocations of this many bytes and more, such as the arenas of simulations (16 MB each), are mappings of their own,
# which end when they are freed. glibc raises its own limit to 32 MB, and then 1024 simulations leave 21 GB behind.
MAPPED = 4 * 2**20
# Bytes by which a process may grow before compiled programs are dropped.
GROWTH = 512 * 2**20
_M_MMAP_THRESHOLD = -3
_held = 0


def _libc() -> ctypes.CDLL | None:
    return ctypes.CDLL(None) if sys.platform == "linux" else None


def map_large_allocations() -> None:
    """Have large allocations mapped on their own; does nothing where the C library is not glibc."""
    if hasattr(libc := _libc(), "mallopt"):
        libc.mallopt(_M_MMAP_THRESHOLD, MAPPED)  # pyright: ignore[reportOptionalMemberAccess]


def give_back() -> None:
    """Drop the programs that JAX compiled, and free pages, if this process has grown much since the last time."""
    global _held
    process = psutil.Process()
    if process.memory_info().rss < _held + GROWTH:
        return
    jax.clear_caches()
    gc.collect()
    if hasattr(libc := _libc(), "malloc_trim"):
        libc.malloc_trim(0)  # pyright: ignore[reportOptionalMemberAccess]
    _held = process.memory_info().rss
