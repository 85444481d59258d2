"""GL contexts: which GL library draws, and contexts of it that are current in a thread.

EGL and OSMesa both draw without a display; physics needs neither.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import threading
from collections.abc import Mapping

from vecenv.errors import SimulationError
from vecenv.libero.render.displays import GlContext, egl_context

# The libraries of each GL backend, and how to install one.
PACKAGES: Mapping[str, tuple[tuple[str, ...], str]] = {
    "egl": (("libEGL.so.1", "libEGL.so"), "apt-get install libegl1 libgl1-mesa-dri (Debian, Ubuntu), or a GPU driver"),
    "osmesa": (("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"), "apt-get install libosmesa6 (Debian, Ubuntu)"),
}
_VARIABLE = "MUJOCO_GL"

# EGL's display is opened with the first context, by one thread at a time.
_opening = threading.Lock()


class GlError(SimulationError):
    """No GL is available, or it failed; the message says what would help."""


class ContextLost(SimulationError):
    """GL reported an error: what was uploaded may be lost."""


def available() -> tuple[str, ...]:
    """The GL backends whose library is installed, in order of preference."""
    return tuple(name for name, (libraries, _) in PACKAGES.items() if any(map(_loads, libraries)))


def choose(gl: str | None = None) -> str:
    """The GL backend: as given, else the one that ``MUJOCO_GL`` names, else the first whose library is installed.

    Raises:
        GlError: the backend is unknown, or its library is not installed.
    """
    there, wanted = available(), gl or os.environ.get(_VARIABLE, "").lower().strip()
    if wanted in PACKAGES:
        if wanted not in there:
            raise GlError(
                f"cannot render: lib{wanted.replace('osm', 'OSM').replace('egl', 'EGL')} is not installed; "
                f"{PACKAGES[wanted][1]}. Physics does not need it."
            )
        return wanted
    if gl is not None:
        raise GlError(f"gl={gl!r}: expected one of {', '.join(PACKAGES)}")
    if not there:
        ways = "; or ".join(how for _, how in PACKAGES.values())
        raise GlError(f"cannot render: no GL library is installed; {ways}. Physics does not need it.")
    return there[0]


def open_context(gl: str, height: int, width: int) -> GlContext:
    """A new GL context, current in this thread.

    Raises:
        GlError: the driver gives none.
    """
    try:
        with _opening:
            make = importlib.import_module(f"mujoco.{gl}").GLContext
            context = egl_context(width, height) if gl == "egl" else make(width, height)
        context.make_current()
    except Exception as error:  # whatever PyOpenGL raises for this driver
        other = " or ".join(f"{_VARIABLE}={name}" for name in available() if name != gl)
        hint = f"; a new process may try {other}" if other else ""
        raise GlError(
            f"cannot render: {gl} gives no GL context ({_first_line(error)}); {PACKAGES[gl][1]}{hint}. "
            "`vecenv doctor` shows what works. Physics does not need it."
        ) from error
    return context


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _first_line(error: BaseException) -> str:
    try:
        text = str(error)
    except Exception:  # PyOpenGL's own errors sometimes cannot be printed
        text = ""
    return f"{type(error).__name__}: {text}".splitlines()[0]
