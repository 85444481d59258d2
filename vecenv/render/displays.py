"""EGL contexts that draw beside each other in Mesa's software GL.

llvmpipe fills triangles for one context of a display at a time, whatever thread it is of: two threads then keep 1.2
cores busy (``LP_NUM_THREADS=0``) to 1.6. A context on another display does not wait. In: nothing. Out: contexts like
MuJoCo's; where GL is Mesa's software, every other one is on a second display. Pictures are the same.
"""

from __future__ import annotations

import atexit
import ctypes
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from vecenv.machine import usable_cores

_SURFACELESS = 0x31DD  # EGL_PLATFORM_SURFACELESS_MESA
_SOFTWARE = b"swrast"
_THREADS = "LP_NUM_THREADS"
_numbers = itertools.count()
_second: list[Any] = []


def egl_context(width: int, height: int) -> Any:
    """A new ``mujoco.egl.GLContext``; one thread at a time may ask."""
    from mujoco import egl

    with _shared_cores():
        first = egl.GLContext(width, height)
        if next(_numbers) % 2 == 0 or not _is_software(egl.EGL_DISPLAY):
            return first
        display = _second_display()
    if display is None:
        return first
    first.free()
    return _on(display)


@contextmanager
def _shared_cores() -> Iterator[None]:
    """While a display is made: the threads that Mesa fills triangles with, its share of the cores.

    With one or two cores none: the thread that draws does it. What the user says about it counts.
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


def _on(display: Any) -> Any:
    """A context on a display of our own, with the methods of MuJoCo's."""
    from mujoco import egl
    from OpenGL import EGL

    class Context:
        """An EGL context."""

        def __init__(self) -> None:
            self._context: Any = None
            configs, found = (EGL.EGLConfig * 1)(), ctypes.c_long()
            EGL.eglReleaseThread()
            EGL.eglChooseConfig(display, egl.EGL_ATTRIBUTES, configs, 1, found)
            EGL.eglBindAPI(EGL.EGL_OPENGL_API)
            self._context = EGL.eglCreateContext(display, configs[0], EGL.EGL_NO_CONTEXT, None)
            if not self._context:
                raise RuntimeError("Cannot create an EGL context.")

        def make_current(self) -> None:
            """Of this thread."""
            if not EGL.eglMakeCurrent(display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, self._context):
                raise RuntimeError("Failed to make the EGL context current.")

        def free(self) -> None:
            """Release it; twice is harmless."""
            if self._context:
                EGL.eglMakeCurrent(display, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)
                EGL.eglDestroyContext(display, self._context)
                EGL.eglReleaseThread()
            self._context = None

    return Context()


def _second_display() -> Any:
    """A display of Mesa's software GL besides MuJoCo's; None if there is none."""
    if not _second:
        _second.append(_made_display())
    return _second[0]


def _made_display() -> Any:
    from OpenGL import EGL

    get = ctypes.CDLL("libEGL.so.1").eglGetPlatformDisplay
    get.restype, get.argtypes = ctypes.c_void_p, [ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p]
    address = get(_SURFACELESS, None, None)
    if not address:
        return None
    display = ctypes.cast(ctypes.c_void_p(address), EGL.EGLDisplay)
    if not EGL.eglInitialize(display, None, None) or not _is_software(display):
        return None
    atexit.register(EGL.eglTerminate, display)
    return display


def _is_software(display: Any) -> bool:
    """Whether Mesa's driver of an initialised display is its software one."""
    library = ctypes.CDLL("libEGL.so.1")
    library.eglGetProcAddress.restype, library.eglGetProcAddress.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    address = library.eglGetProcAddress(b"eglGetDisplayDriverName")
    if not address:
        return False
    name = ctypes.CFUNCTYPE(ctypes.c_char_p, ctypes.c_void_p)(address)(ctypes.cast(display, ctypes.c_void_p))
    return name == _SOFTWARE
