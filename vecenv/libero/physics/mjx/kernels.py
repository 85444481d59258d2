"""Warp's kernels, compiled on all cores when a program that calls MuJoCo Warp is traced.

MuJoCo Warp makes about a hundred kernels for the sizes of a scene, and Warp compiles each when it is first launched:
one after another, in the first step, without a word. Here the calls of MuJoCo Warp that JAX traces are run once more on
uninitialised arrays of the same shapes, with launches that only note their kernel. Those that Warp's cache lacks are
then compiled by as many threads as there are cores, and the logger of this module says what is compiled and how far it
is. Nothing else changes: a kernel that was not noted is compiled when it is launched.

In: nothing; ``install`` is called before MJX is used. Out: kernels in Warp's cache, which is in vecenv's cache folder.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

from vecenv.libero.physics import private
from vecenv.util import caching
from vecenv.util.cores import usable_cores

log = logging.getLogger(__name__)
# Functions whose calls are run ahead, by the start of their module's name.
_OURS = "mujoco.mjx.warp."
# Seconds between two reports.
_REPORT = 5.0
_VARIABLE = "WARP_CACHE_PATH"
_lock = threading.Lock()
# In a thread that notes kernels: the list of them.
_noting = threading.local()


class Kernels(NamedTuple):
    """Kernels that Warp compiles together: a module of Warp, the device, and the threads of a block."""

    module: Any
    device: Any
    block_dim: int


def choose_cache() -> None:
    """Let Warp keep compiled kernels in vecenv's cache folder, unless a folder was already chosen.

    ``WARP_CACHE_PATH`` and ``warp.config.kernel_cache_dir`` choose one, and so does whoever started Warp before.
    """
    import warp as wp

    folder = caching.folder("warp")
    if wp.config.kernel_cache_dir is None and _VARIABLE not in os.environ and folder is not None:
        with contextlib.suppress(OSError):  # a folder that cannot be written is no error, as for other caches
            folder.mkdir(parents=True, exist_ok=True)
            wp.config.kernel_cache_dir = str(folder)


@functools.cache
def install() -> None:
    """Compile kernels ahead from now on, in this process; where Warp is another than was tested, a warning says so."""
    choose_cache()
    try:
        callable_type = private.FfiCallable
    except ImportError as error:
        log.warning("kernels are compiled one after another when they are launched: %s", error)
        return
    traced = callable_type.__call__
    seen: set[Any] = set()

    @functools.wraps(traced)
    def call(self: Any, *args: Any, **options: Any) -> Any:
        result = traced(self, *args, **options)
        if self.func.__module__.startswith(_OURS):
            _ahead(self, args, options, seen)
        return result

    callable_type.__call__ = call


def _ahead(callable_: Any, args: Sequence[Any], options: dict[str, Any], seen: set[Any]) -> None:
    """Compile the kernels of a call that is traced, once for the same shapes."""
    try:
        key = (id(callable_), *(_static(value) for value in args))
        if key in seen:
            return
        seen.add(key)
        noted = _noted(callable_, args, options)
        missing = [kernels for kernels in noted if not is_cached(kernels)]
    except Exception as error:  # whatever another version of Warp does differently, or too little memory
        said = f"{type(error).__name__}: {' '.join(str(error).split())}"
        log.warning("kernels of %s are compiled one after another when they are launched: %s", callable_.name, said)
        return
    compile_kernels(missing, cached=len(noted) - len(missing))


def _static(value: Any) -> Any:
    return (value.shape, str(value.dtype)) if hasattr(value, "shape") else value


def _noted(callable_: Any, args: Sequence[Any], options: dict[str, Any]) -> list[Kernels]:
    """The kernels that a call launches, in that order."""
    import jax
    import warp as wp

    device = wp.device_from_jax(jax.devices()[0])
    dims = options.get("output_dims") or callable_.output_dims
    with wp.ScopedDevice(device), _note() as noted:
        arrays = [_argument(arg, value, device) for arg, value in zip(callable_.input_args, args, strict=True)]
        arrays += [_empty(arg, _shape(dims, arg), device) for arg in callable_.output_args]
        callable_.func(*arrays)
    # What is no launch, such as a new bounding box of a tree, did run, on Warp's stream: JAX's does not wait for it.
    wp.synchronize_device(device)
    return list({(id(each.module), each.block_dim): each for each in noted}.values())


def _shape(dims: Any, arg: Any) -> tuple[int, ...]:
    """Shape of an output, which ``output_dims`` gives by name, or for all."""
    shape = dims[arg.name] if isinstance(dims, dict) else dims
    return (shape,) if isinstance(shape, int) else tuple(shape)


def _argument(arg: Any, value: Any, device: Any) -> Any:
    if not arg.is_array:
        return arg.type(value)
    shape = tuple(value.shape[: value.ndim - arg.dtype_ndim])
    while len(shape) > arg.type.ndim:
        shape = (shape[0] * shape[1], *shape[2:])
    return _empty(arg, shape, device)


def _empty(arg: Any, shape: tuple[int, ...], device: Any) -> Any:
    import warp as wp

    return wp.empty(shape, dtype=arg.type.dtype, device=device)


@contextlib.contextmanager
def _note() -> Iterator[list[Kernels]]:
    """Within the context, launches of this thread note their kernel and do nothing; other threads' are as ever."""
    import warp as wp

    noted: list[Kernels] = []

    def load(original: Callable[..., Any], module: Any, device: Any, block_dim: int | None = None, **more: Any) -> Any:
        if not module.kernels:  # a module that only holds the function that is called
            return original(module, device, block_dim, **more)
        width = module.options["block_dim"] if block_dim is None else block_dim
        noted.append(Kernels(module, wp.get_device(device), width))
        return None  # Warp launches nothing then

    def once(original: Callable[..., Any], condition: Any, while_body: Any, stream: Any = None, **kwargs: Any) -> None:
        while_body(**kwargs)

    def both(
        original: Callable[..., Any], condition: Any, on_true: Any = None, on_false: Any = None, **kwargs: Any
    ) -> None:
        kwargs.pop("stream", None)
        for branch in (on_true, on_false):
            if branch is not None:
                branch(**kwargs)

    def suggested(original: Callable[..., Any], kernel: Any, device: Any = None) -> tuple[int, int]:
        place = wp.get_device(device)
        kernel.module.load(place)  # asking loads the kernel, with threads of its own
        return (256, 1) if place.is_cuda else original(kernel, device)

    def nothing(original: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
        """Sorts and sums of what no kernel has written."""

    replaced = [(wp.Module, "load", load), (wp, "capture_while", once), (wp, "capture_if", both)]
    replaced += [(wp, "get_suggested_block_size", suggested)]
    replaced += [(wp.utils, name, nothing) for name in ("segmented_sort_pairs", "radix_sort_pairs", "array_scan")]
    with _lock, contextlib.ExitStack() as stack:
        for owner, name, replacement in replaced:
            stack.enter_context(_replaced(owner, name, replacement))
        _noting.here = True
        try:
            yield noted
        finally:
            _noting.here = False


@contextlib.contextmanager
def _replaced(owner: Any, name: str, replacement: Callable[..., Any]) -> Iterator[None]:
    """A function replaced for this thread; the replacement gets the original as its first argument."""
    original = getattr(owner, name)

    @functools.wraps(original)
    def chosen(*args: Any, **kwargs: Any) -> Any:
        if getattr(_noting, "here", False):
            return replacement(original, *args, **kwargs)
        return original(*args, **kwargs)

    setattr(owner, name, chosen)
    try:
        yield
    finally:
        setattr(owner, name, original)


def is_cached(kernels: Kernels) -> bool:
    """Whether Warp's cache has these kernels for this device; damaged ones are removed with a warning."""

    if (kernels.device.context, kernels.block_dim) in kernels.module.execs:
        return True
    path = _file(kernels)
    seal = path.with_name(f"{path.name}.sha256")
    try:
        sound = hashlib.sha256(path.read_bytes()).hexdigest() == seal.read_text()
    except FileNotFoundError:
        return path.exists()  # what others compiled has no checksum
    except (OSError, ValueError) as error:
        sound, why = False, str(error)
    else:
        why = "its checksum is another"
    if not sound:
        caching.damaged(path, why)
        with contextlib.suppress(OSError):
            path.unlink()
    return sound


def _file(kernels: Kernels) -> Path:
    """Where Warp's cache has these kernels for this device, or would have them."""
    import warp as wp

    folder = Path(str(wp.config.kernel_cache_dir)) / kernels.module.get_module_identifier(kernels.block_dim)
    return folder / kernels.module._get_compile_output_name(kernels.device, block_dim=kernels.block_dim)


def compile_kernels(missing: Sequence[Kernels], *, cached: int = 0, threads: int | None = None) -> None:
    """Compile and load kernels, and say how far it is.

    Args:
        missing: the kernels.
        cached: how many others need no compiling.
        threads: that compile; None for one per core.

    Raises:
        Exception: whatever Warp raises where a kernel cannot be compiled.
    """
    if not missing:
        return
    count, started, said = len(missing), time.monotonic(), time.monotonic()
    workers = min(count, threads or usable_cores())
    log.info("compiling %d kernels of MuJoCo Warp, %d at once (%d are cached)", count, workers, cached)
    with _silent(), ThreadPoolExecutor(workers) as pool:
        running = [pool.submit(each.module.load, each.device, each.block_dim) for each in missing]
        for done, future in enumerate(as_completed(running), start=1):
            future.result()
            if time.monotonic() - said >= _REPORT:
                said = time.monotonic()
                log.info("compiled %d of %d kernels, %.0f s", done, count, said - started)
    for each in missing:
        with contextlib.suppress(OSError):
            path = _file(each)
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            caching.write_file(path.with_name(f"{path.name}.sha256"), digest.encode())
    log.info("compiled %d kernels in %.1f s", count, time.monotonic() - started)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keeps Warp from printing a line for each kernel."""
    import warp as wp

    before = wp.config.log_level
    wp.config.log_level = max(before, wp.LOG_WARNING)
    try:
        yield
    finally:
        wp.config.log_level = before
