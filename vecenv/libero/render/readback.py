"""Images that are read back from a GPU some images later, so that drawing the next ones need not wait for them.

``mujoco.mjr_readPixels`` waits until the GPU has drawn. Here an image goes to one of a few pixel buffers in the GPU's
own time, and from there to its array when its buffer is needed again or all are asked for. The pixels are those of
``mjr_readPixels``: the same samples are resolved into the same framebuffer.
"""

from __future__ import annotations

import ctypes
from collections import deque
from typing import Any

import mujoco
import numpy as np

from vecenv.libero.render.commands import reading_commands

# Images that may be on their way.
DEPTH = 8

_PIXEL_PACK, _STREAM_READ = 0x88EB, 0x88E1
_FRAMEBUFFER, _READ, _DRAW, _COLOR0 = 0x8D40, 0x8CA8, 0x8CA9, 0x8CE0
_COLOR_BIT, _NEAREST = 0x4000, 0x2600
_RGBA, _UNSIGNED_BYTE = 0x1908, 0x1401


class Readback:
    """The pixel buffers of one GL context; they are freed with it.

    Args:
        height, width: of images, pixels.
        depth: images that may be on their way.

    Raises:
        AttributeError: the GL library lacks a command.
    """

    def __init__(self, height: int, width: int, depth: int = DEPTH) -> None:
        self._gl: Any = reading_commands()
        # Four bytes a pixel: GPUs keep colours so, and some read three bytes a pixel slowly.
        self._pixels = np.empty((height, width, 4), np.uint8)
        numbers = (ctypes.c_uint * depth)()
        self._gl.GenBuffers(depth, ctypes.addressof(numbers))
        self._free, self._begun = deque(numbers), deque[tuple[int, np.ndarray]]()
        for number in numbers:
            self._gl.BindBuffer(_PIXEL_PACK, number)
            self._gl.BufferData(_PIXEL_PACK, self._pixels.nbytes, None, _STREAM_READ)
        self._gl.BindBuffer(_PIXEL_PACK, 0)

    @classmethod
    def where_possible(cls, height: int, width: int) -> Readback | None:
        """Buffers of this thread's context; None if its library has none."""
        try:
            return cls(height, width)
        except AttributeError:
            return None

    def begin(self, context: mujoco.MjrContext, out: np.ndarray) -> None:
        """Read what is drawn in MuJoCo's framebuffer into ``out``, as delivered, uint8 [H, W, 3], by ``finish``."""
        if not self._free:
            self._take_oldest()
        buffer, gl = self._free.popleft(), self._gl
        height, width = self._pixels.shape[:2]
        source = context.offFBO
        if context.offSamples:
            source, corners = context.offFBO_r, (0, 0, width, height)
            gl.BindFramebuffer(_READ, context.offFBO)
            gl.ReadBuffer(_COLOR0)
            gl.BindFramebuffer(_DRAW, source)
            gl.DrawBuffer(_COLOR0)
            gl.BlitFramebuffer(*corners, *corners, _COLOR_BIT, _NEAREST)
        gl.BindFramebuffer(_READ, source)
        gl.ReadBuffer(_COLOR0)
        gl.BindBuffer(_PIXEL_PACK, buffer)
        gl.ReadPixels(0, 0, width, height, _RGBA, _UNSIGNED_BYTE, None)
        # MuJoCo reads other images into memory, and draws into what is bound.
        gl.BindBuffer(_PIXEL_PACK, 0)
        gl.BindFramebuffer(_FRAMEBUFFER, context.offFBO)
        gl.Flush()
        self._begun.append((buffer, out))

    def finish(self) -> None:
        """Wait for all images that were begun."""
        while self._begun:
            self._take_oldest()

    def _take_oldest(self) -> None:
        buffer, out = self._begun.popleft()
        self._gl.BindBuffer(_PIXEL_PACK, buffer)
        self._gl.GetBufferSubData(_PIXEL_PACK, 0, self._pixels.nbytes, self._pixels.ctypes.data)
        self._gl.BindBuffer(_PIXEL_PACK, 0)
        out[:] = self._pixels[::-1, ::-1, :3]
        self._free.append(buffer)
