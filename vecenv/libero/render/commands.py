"""The OpenGL commands that ``vecenv.libero.render.canvas`` uses, without PyOpenGL's checks of every call.

An image takes some hundred short commands, and PyOpenGL's checks would take longer than they do. Commands that may
draw release Python's lock, the others keep it: releasing it costs more than they do. ``mujoco.mjr_getError`` reports
errors afterwards.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Mapping
from typing import Any, TypeAlias

_INT, _UINT, _FLOAT, _BOOL, _AT = (ctypes.c_int, ctypes.c_uint, ctypes.c_float, ctypes.c_ubyte, ctypes.c_void_p)
_DOUBLE = ctypes.c_double

# Names without their "gl", and the types of their arguments.
_SHORT: dict[str, tuple[Any, ...]] = {
    "BindFramebuffer": (_UINT, _UINT),
    "BindRenderbuffer": (_UINT, _UINT),
    "BindTexture": (_UINT, _UINT),
    "ActiveTexture": (_UINT,),
    "BlendFunc": (_UINT, _UINT),
    "ClearStencil": (_INT,),
    "ClipPlane": (_UINT, _AT),
    "Color4f": (_FLOAT,) * 4,
    "ColorMask": (_BOOL,) * 4,
    "DeleteLists": (_UINT, _INT),
    "DepthFunc": (_UINT,),
    "DepthMask": (_BOOL,),
    "DepthRange": (_DOUBLE, _DOUBLE),
    "Disable": (_UINT,),
    "Enable": (_UINT,),
    "EndList": (),
    "FramebufferRenderbuffer": (_UINT,) * 4,
    "FrontFace": (_UINT,),
    "GenFramebuffers": (_INT, _AT),
    "GenRenderbuffers": (_INT, _AT),
    "Lightfv": (_UINT, _UINT, _AT),
    "LoadIdentity": (),
    "Materialf": (_UINT, _UINT, _FLOAT),
    "Materialfv": (_UINT, _UINT, _AT),
    "MatrixMode": (_UINT,),
    "MultMatrixf": (_AT,),
    "NewList": (_UINT, _UINT),
    "PopMatrix": (),
    "PushMatrix": (),
    "RenderbufferStorageMultisample": (_UINT, _INT, _UINT, _INT, _INT),
    "Scissor": (_INT,) * 4,
    "Scalef": (_FLOAT,) * 3,
    "StencilFunc": (_UINT, _INT, _UINT),
    "StencilOp": (_UINT,) * 3,
    "TexGenfv": (_UINT, _UINT, _AT),
    "Translatef": (_FLOAT,) * 3,
    "Vertex3f": (_FLOAT,) * 3,
    "Begin": (_UINT,),
    "End": (),
}
_LONG: dict[str, tuple[Any, ...]] = {
    "BlitFramebuffer": (_INT,) * 8 + (_UINT, _UINT),
    "CallList": (_UINT,),
    "Clear": (_UINT,),
}
_VALUED: dict[str, tuple[Any, ...]] = {
    "CheckFramebufferStatus": (_UINT, _UINT),
    "GenLists": (_UINT, _INT),
}
# What ``vecenv.libero.render.readback`` uses; those that may wait for the GPU release the lock.
_READING_SHORT: dict[str, tuple[Any, ...]] = {
    "BindBuffer": (_UINT, _UINT),
    "BindFramebuffer": (_UINT, _UINT),
    "BufferData": (_UINT, ctypes.c_ssize_t, _AT, _UINT),
    "DrawBuffer": (_UINT,),
    "GenBuffers": (_INT, _AT),
    "ReadBuffer": (_UINT,),
}
_READING_LONG: dict[str, tuple[Any, ...]] = {
    "BlitFramebuffer": (_INT,) * 8 + (_UINT, _UINT),
    "Flush": (),
    "GetBufferSubData": (_UINT, ctypes.c_ssize_t, ctypes.c_ssize_t, _AT),
    "ReadPixels": (_INT,) * 4 + (_UINT, _UINT, _AT),
}
_Table: TypeAlias = Mapping[str, tuple[Any, ...]]
_STRING = 0x1F01  # GL_RENDERER
# The drivers that draw on the CPU.
_SOFTWARE = ("llvmpipe", "softpipe", "swrast")


class Commands:
    """The commands as methods; OpenGL's ``glCallList`` is ``CallList``."""

    def __init__(self, short: _Table, long: _Table, valued: _Table | None = None) -> None:
        for name, types in short.items():
            setattr(self, name, ctypes.PYFUNCTYPE(None, *types)(_address(f"gl{name}")))
        for name, types in long.items():
            setattr(self, name, ctypes.CFUNCTYPE(None, *types)(_address(f"gl{name}")))
        for name, (result, *types) in (valued or {}).items():
            setattr(self, name, ctypes.PYFUNCTYPE(result, *types)(_address(f"gl{name}")))

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"no GL command {name!r}")


@functools.cache
def commands() -> Commands:
    """The commands of the GL library that PyOpenGL has loaded; there must be a context.

    Raises:
        AttributeError: the library lacks one.
    """
    return Commands(_SHORT, _LONG, _VALUED)


@functools.cache
def reading_commands() -> Commands:
    """The commands for reading images back later; there must be a context.

    Raises:
        AttributeError: the library lacks one.
    """
    return Commands(_READING_SHORT, _READING_LONG)


def renderer_name() -> str:
    """The driver's name of what draws in the context of this thread, such as ``"llvmpipe (LLVM 15.0.6, 256 bits)"``."""
    found = ctypes.PYFUNCTYPE(ctypes.c_char_p, _UINT)(_address("glGetString"))(_STRING)
    return (found or b"").decode(errors="replace")


def draws_in_software() -> bool:
    """Whether the driver of this thread's context draws on the CPU."""
    return renderer_name().startswith(_SOFTWARE)


def _address(name: str) -> int:
    from OpenGL import platform

    library: Any = platform.PLATFORM
    address = ctypes.cast(library.GL[name], ctypes.c_void_p).value  # AttributeError if there is none
    assert address is not None
    return address
