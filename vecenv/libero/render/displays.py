"""EGL contexts that draw in parallel in Mesa's software GL.

llvmpipe fills triangles for one context of a display at a time, whichever thread uses it: two threads then keep 1.2
(``LP_NUM_THREADS=0``) to 1.6 cores busy. A context on another display does not wait. Out: contexts with the methods of
MuJoCo's; with Mesa's software GL, every other one is on a second display. The images are the same.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol, TypeAlias

from vecenv.util.cores import usable_cores

_SURFACELESS = 0x31DD  # EGL_PLATFORM_SURFACELESS_MESA
_SOFTWARE = b"swrast"
_THREADS = "LP_NUM_THREADS"
_CType: TypeAlias = type[ctypes.c_void_p | ctypes.c_char_p | ctypes.c_uint]
_numbers = itertools.count()


def egl_context(width: int, height: int) -> GlContext:
    """A new EGL context; not thread-safe."""
    from mujoco import egl

    second = next(_numbers) % 2 == 1
    with _shared_cores():
        # MuJoCo opens its display with its first context.
        display = _second_display() if second and egl.EGL_DISPLAY is not None else None
        return egl.GLContext(width, height) if display is None else _Context(display)


@contextmanager
def _shared_cores() -> Iterator[None]:
    """While a display is opened, set the number of threads that Mesa fills triangles with to its share of the cores.

    With one or two cores there are none: the drawing thread fills them. A value set by the user is kept.
    """
    if _THREADS in os.environ:
        yield
        return
    cores = usable_cores()
    os.environ[_THREADS] = str(cores // 2 if cores > 2 else 0)
    try:
        yield
    finally:
        del os.environ[_THREADS]


class GlContext(Protocol):
    """A GL context, as ``mujoco.egl.GLContext`` is one."""

    def make_current(self) -> None:
        """Make it the context of this thread."""
        ...

    def free(self) -> None:
        """Release it."""
        ...


class _Context:
    """A context on the second display."""

    def __init__(self, display: ctypes.c_void_p) -> None:
        from mujoco import egl
        from OpenGL import EGL

        self._egl, self._display, self._context = EGL, display, None
        configs, found = (EGL.EGLConfig * 1)(), ctypes.c_long()
        EGL.eglReleaseThread()
        EGL.eglChooseConfig(display, egl.EGL_ATTRIBUTES, configs, 1, found)
        EGL.eglBindAPI(EGL.EGL_OPENGL_API)
        self._context = EGL.eglCreateContext(display, configs[0], EGL.EGL_NO_CONTEXT, None)
        if not self._context:
            raise RuntimeError("Cannot create an EGL context.")

    def make_current(self) -> None:
        """Make it the context of this thread."""
        if not self._current(self._context):
            raise RuntimeError("Failed to make the EGL context current.")

    def free(self) -> None:
        """Release it. Freeing twice is harmless."""
        if self._context:
            self._current(self._egl.EGL_NO_CONTEXT)
            self._egl.eglDestroyContext(self._display, self._context)
            self._egl.eglReleaseThread()
        self._context = None

    def _current(self, context: ctypes.c_void_p | None) -> Any:
        nothing = self._egl.EGL_NO_SURFACE
        return self._egl.eglMakeCurrent(self._display, nothing, nothing, context)


@functools.cache
def _second_display() -> Any:
    """A second display of Mesa's software GL; None if MuJoCo's is of another driver, or there is no second one."""
    from mujoco import egl
    from OpenGL import EGL

    get = _procedure(b"eglGetPlatformDisplay", ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)
    address = get(_SURFACELESS, None, None) if get is not None and _is_software(egl.EGL_DISPLAY) else None
    if not address:
        return None
    display = ctypes.cast(ctypes.c_void_p(address), EGL.EGLDisplay)
    if not EGL.eglInitialize(display, None, None) or not _is_software(display):
        return None
    atexit.register(EGL.eglTerminate, display)
    return display


def _is_software(display: ctypes.c_void_p) -> bool:
    """Whether Mesa's driver of an initialised display is its software one."""
    name = _procedure(b"eglGetDisplayDriverName", ctypes.c_char_p, ctypes.c_void_p)
    return name is not None and name(ctypes.cast(display, ctypes.c_void_p)) == _SOFTWARE


def _procedure(name: bytes, result: _CType, *arguments: _CType) -> Any:
    """A function of the EGL library that PyOpenGL has loaded, by name; None if the library lacks it."""
    from OpenGL import platform

    library: Any = platform.PLATFORM
    find = library.EGL["eglGetProcAddress"]  # [] gives a copy that PyOpenGL does not share
    find.restype, find.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    address = find(name)
    return ctypes.CFUNCTYPE(result, *arguments)(address) if address else None
