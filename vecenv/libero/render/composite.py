"""Images of which only that is drawn which has moved since the last one.

In: what a camera of a slot sees, image after image. Out: the same image, to the bit, as ``mujoco.mjr_render`` draws of
it. What stands still in front of a camera that stands still (``vecenv.libero.render.stillness``) is drawn by MuJoCo
once, into a layer: colour and depth of every sample. Of the next images, a layer gives all but the rectangle around
what has moved; in there, its samples are copied into the framebuffer and what has moved is drawn over them
(``vecenv.libero.render.canvas``). A mirror is drawn after everything else, and with it only what it shows, while MuJoCo
draws everything twice.

A layer of 256 x 256 pixels takes 3.3 MB. Where the memory for layers is used up, or an image has something that a
canvas does not draw (transparent things, shadows), MuJoCo draws the whole image.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import mujoco
import numpy as np

from vecenv.libero.render import commands
from vecenv.libero.render.canvas import Canvas, Look
from vecenv.libero.render.drawing import Sight, Stage
from vecenv.libero.render.options import VisualOptions
from vecenv.libero.render.stillness import Plan, Stillness

# Memory for the layers of all threads of a renderer, bytes.
LAYER_MEMORY = 256 << 20
# Slots have other options each, at most so many sets of looks are kept.
_KEPT_OPTIONS = 256

_FRAMEBUFFER, _READ, _DRAW, _RENDERBUFFER = 0x8D40, 0x8CA8, 0x8CA9, 0x8D41
_COLOR0, _DEPTH_STENCIL = 0x8CE0, 0x821A
_RGBA8, _DEPTH32F_STENCIL8 = 0x8058, 0x8CAD
_SCISSOR_TEST = 0x0C11
_ALL_BITS, _NEAREST = 0x4000 | 0x0100 | 0x0400, 0x2600
_BYTES_A_SAMPLE = 12
_REFLECTION = mujoco.mjtRndFlag.mjRND_REFLECTION
_ITEMS = (mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_SITE)


def is_worthwhile() -> bool:
    """Whether the driver of this thread's context draws on the CPU and has all commands.

    GPUs draw a scene faster than Python lists what has moved.
    """
    try:
        commands.commands()
        return commands.draws_in_software()
    except AttributeError:
        return False


class Layer(NamedTuple):
    """What stands still: a framebuffer with every sample, and the image of it as delivered, uint8 [H, W, 3]."""

    framebuffer: int
    pixels: np.ndarray


class Looks(NamedTuple):
    """The looks of items under some visual options; which are known and which a canvas draws, bool [items]."""

    by_item: dict[int, Look]
    known: np.ndarray
    drawable: np.ndarray


class Layers:
    """The layers of one GL context, each of one camera of one slot.

    Args:
        height, width: pixels.
        memory: that they may take together, bytes.
    """

    def __init__(self, height: int, width: int, memory: int) -> None:
        self._gl: Any = commands.commands()
        self._size, self._memory = (width, height), memory
        self._free: dict[int, list[Layer]] = {}
        self._specks: dict[int, int] = {}

    def take(self, samples: int) -> Layer | None:
        """A layer with so many samples a pixel; None if the memory is used up."""
        if self._free.get(samples):
            return self._free[samples].pop()
        width, height = self._size
        size = width * height * (max(samples, 1) * _BYTES_A_SAMPLE + 3)
        if size > self._memory:
            return None
        self._memory -= size
        return Layer(self._made(samples, width, height), np.zeros((height, width, 3), np.uint8))

    def give_back(self, layer: Layer, samples: int) -> None:
        """Let another camera have a layer."""
        self._free.setdefault(samples, []).append(layer)

    def speck(self, samples: int) -> int:
        """A framebuffer of one pixel."""
        if samples not in self._specks:
            self._specks[samples] = self._made(samples, 1, 1)
        return self._specks[samples]

    def _made(self, samples: int, width: int, height: int) -> int:
        gl, numbers = self._gl, (ctypes.c_uint * 3)()
        gl.GenFramebuffers(1, ctypes.addressof(numbers))
        gl.GenRenderbuffers(2, ctypes.addressof(numbers) + 4)
        layer, color, depth = numbers
        gl.BindFramebuffer(_FRAMEBUFFER, layer)
        for buffer, kind, place in ((color, _RGBA8, _COLOR0), (depth, _DEPTH32F_STENCIL8, _DEPTH_STENCIL)):
            gl.BindRenderbuffer(_RENDERBUFFER, buffer)
            gl.RenderbufferStorageMultisample(_RENDERBUFFER, samples, kind, width, height)
            gl.FramebufferRenderbuffer(_FRAMEBUFFER, place, _RENDERBUFFER, buffer)
        return int(layer)


class Compositor:
    """Draws the images of one scene in one thread.

    Args:
        stage: the scene.
        context: it, uploaded to this thread's GL context.
        layers: of the GL context.
        height, width: of images, pixels.

    Attributes:
        whole: the whole image.
    """

    def __init__(self, stage: Stage, context: mujoco.MjrContext, layers: Layers, height: int, width: int) -> None:
        self._gl: Any = commands.commands()
        self._context, self._canvas, self._layers = context, Canvas(context), layers
        self._has_shadows, self._num_geoms, self._boxes = stage.has_shadows, stage.model.ngeom, stage.boxes
        self.whole = mujoco.MjrRect(0, 0, width, height)
        self._num_items = stage.model.ngeom + stage.model.nsite
        self._looks: list[tuple[VisualOptions, Looks]] = []
        self._histories: dict[tuple[int, str], Stillness] = {}
        self._held: dict[tuple[int, str], Layer] = {}

    def picture(self, slot: int, camera: str, options: VisualOptions) -> Picture:
        """The next image of a camera of a slot."""
        return Picture(self, (slot, camera), options)

    def looks(self, options: VisualOptions) -> Looks:
        """The looks of items that are known so far."""
        for known, looks in self._looks:
            if known is options or known == options:
                return looks
        if len(self._looks) == _KEPT_OPTIONS:
            self._looks.pop(0)
        self._looks.append((options, Looks({}, *np.zeros((2, self._num_items), bool))))
        return self._looks[-1][1]

    def learn(self, looks: Looks, frame: mujoco.MjvScene) -> None:
        """Add the looks of what is in a frame."""
        for geom in frame.geoms[: frame.ngeom]:
            if geom.objtype in _ITEMS:
                item = geom.objid + (self._num_geoms if geom.objtype == mujoco.mjtObj.mjOBJ_SITE else 0)
                look = looks.by_item.setdefault(item, Look.of(geom))
                looks.known[item], looks.drawable[item] = True, look.is_supported

    def can_draw(self, sight: Sight, looks: Looks, items: np.ndarray) -> bool:
        """Whether a canvas draws these items of an image."""
        return sight.is_opaque and not self._has_shadows and bool((looks.drawable | ~items).all())

    def plan(self, key: tuple[int, str], sight: Sight, options: VisualOptions) -> tuple[Plan, Layer | None]:
        """How to draw an image, and its layer."""
        history = self._histories.setdefault(key, Stillness())
        plan = history.plan(sight, options)
        if plan.held is None:
            self._release(key)
            return plan, None
        if key not in self._held:
            layer = self._layers.take(self._context.offSamples)
            if layer is None:
                history.forget()
                return Plan(), None
            self._held[key] = layer
        return plan, self._held[key]

    def drop(self, key: tuple[int, str]) -> None:
        """Forget what a camera of a slot has seen."""
        self._histories.pop(key, None)
        self._release(key)

    def _release(self, key: tuple[int, str]) -> None:
        if key in self._held:
            self._layers.give_back(self._held.pop(key), self._context.offSamples)

    def draw(self, frame: mujoco.MjvScene, framebuffer: int | None = None) -> None:
        """Let MuJoCo draw a frame, into its own framebuffer or another."""
        # ``mjr_render`` draws into what is bound.
        self._gl.BindFramebuffer(_FRAMEBUFFER, self._context.offFBO if framebuffer is None else framebuffer)
        mujoco.mjr_render(self.whole, frame, self._context)

    def prepare(self, frame: mujoco.MjvScene) -> None:
        """Let MuJoCo set the lights and the camera of a frame without items; its framebuffer stays as it is."""
        self.draw(frame, self._layers.speck(self._context.offSamples))

    def copy(self, layer: int, area: mujoco.MjrRect) -> None:
        """Copy a part of a layer into MuJoCo's framebuffer, sample by sample."""
        gl, target = self._gl, self._context.offFBO
        corners = area.left, area.bottom, area.left + area.width, area.bottom + area.height
        gl.BindFramebuffer(_READ, layer)
        gl.BindFramebuffer(_DRAW, target)
        gl.BlitFramebuffer(*corners, *corners, _ALL_BITS, _NEAREST)
        gl.BindFramebuffer(_FRAMEBUFFER, target)

    def read(self, area: mujoco.MjrRect, out: np.ndarray) -> None:
        """Put a part of the image where it belongs in a delivered one, uint8 [H, W, 3]."""
        height, width = out.shape[:2]
        pixels = np.empty((area.height, area.width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, area, self._context)
        rows = slice(height - area.bottom - area.height, height - area.bottom)
        columns = slice(width - area.left - area.width, width - area.left)
        out[rows, columns] = pixels[::-1, ::-1]

    @contextmanager
    def within(self, area: mujoco.MjrRect) -> Iterator[None]:
        """Inside the context, only this part of the framebuffer is drawn."""
        self._gl.Scissor(area.left, area.bottom, area.width, area.height)
        self._gl.Enable(_SCISSOR_TEST)
        yield
        self._gl.Disable(_SCISSOR_TEST)

    def draw_items(self, frame: mujoco.MjvScene, looks: Looks, items: np.ndarray, sight: Sight) -> None:
        """Draw items over the framebuffer."""
        numbers = np.flatnonzero(items)
        if len(numbers):
            self._canvas.switch(frame, on=True)
            self._canvas.draw([looks.by_item[item] for item in numbers.tolist()], sight.poses[numbers])
            self._canvas.switch(frame, on=False)

    def draw_mirror(self, frame: mujoco.MjvScene, looks: Looks, sight: Sight) -> None:
        """Draw what the mirror shows."""
        shown = sight.reflected.copy()
        shown[sight.mirror] = False
        numbers = np.flatnonzero(shown)
        area = self.area(sight, np.zeros_like(shown))
        # llvmpipe draws some samples of pixels at the edge of the scissor's rectangle and does not clear them.
        with self.within(_grown(area, 2)):
            self._canvas.clear_stencil()
        with self.within(area):
            self._canvas.reflect(
                frame,
                (looks.by_item[sight.mirror], sight.poses[sight.mirror], sight.reflectance),
                [looks.by_item[item] for item in numbers.tolist()],
                sight.poses[numbers],
            )

    def area(self, sight: Sight, items: np.ndarray) -> mujoco.MjrRect:
        """The part of the image that items and the mirror may cover."""
        covered = items.copy()
        if sight.mirror >= 0:
            covered[sight.mirror] = True
        if not covered.any():
            return mujoco.MjrRect(0, 0, 1, 1)
        found = self._boxes.area(sight.poses, covered, sight.view, (self.whole.height, self.whole.width))
        return found or self.whole


def _grown(area: mujoco.MjrRect, margin: int) -> mujoco.MjrRect:
    """A rectangle with so many pixels more on each side, which may lie outside the image."""
    return mujoco.MjrRect(area.left - margin, area.bottom - margin, area.width + 2 * margin, area.height + 2 * margin)


class Picture:
    """One image: ``choose`` says what MuJoCo gets to draw, ``draw`` draws the image."""

    def __init__(self, compositor: Compositor, key: tuple[int, str], options: VisualOptions) -> None:
        self._on, self._key, self._options = compositor, key, options
        self._looks = compositor.looks(options)
        self._sight: Sight | None = None
        self._chosen = np.zeros(0, bool)
        self._plan, self._layer, self._is_plain = Plan(), None, True

    def choose(self, sight: Sight) -> np.ndarray:
        """The items that MuJoCo draws, bool [items]."""
        self._sight = sight
        self._chosen = self._choose(sight)
        return self._chosen

    def _choose(self, sight: Sight) -> np.ndarray:
        on = self._on
        if not self._looks.by_item:
            return sight.drawable  # what is out of sight changes no pixel, and all looks are known from then on
        own = sight.reflected if sight.mirror >= 0 else np.zeros_like(sight.shown)
        if not on.can_draw(sight, self._looks, own):
            on.drop(self._key)
            return sight.shown
        self._is_plain = False
        self._plan, self._layer = on.plan(self._key, sight, self._options)
        held = self._plan.held
        if held is not None and not on.can_draw(sight, self._looks, sight.in_image & ~held):
            on.drop(self._key)
            self._plan, held = Plan(), None
        if held is None:
            return sight.in_image
        return held if self._plan.is_new else np.zeros_like(held)

    def draw(self, frame: mujoco.MjvScene, out: np.ndarray) -> None:
        """Draw the image; ``frame`` has what ``choose`` has returned. ``out`` is as delivered, uint8 [H, W, 3]."""
        sight, on, layer = self._sight, self._on, self._layer
        assert sight is not None, "choose comes first"
        has_mirror = sight.mirror >= 0 and not self._is_plain
        frame.flags[_REFLECTION] = not has_mirror
        area = on.whole
        if self._plan.held is None or layer is None:
            if (self._chosen & ~self._looks.known).any():
                on.learn(self._looks, frame)
            on.draw(frame)
        else:
            moved = sight.in_image & ~self._plan.held
            area = on.area(sight, moved)
            self._copy_layer(frame, layer, area, out)
            with on.within(area):
                on.draw_items(frame, self._looks, moved, sight)
        if has_mirror:
            on.draw_mirror(frame, self._looks, sight)
        frame.flags[_REFLECTION] = True
        on.read(area, out)

    def _copy_layer(self, frame: mujoco.MjvScene, layer: Layer, area: mujoco.MjrRect, out: np.ndarray) -> None:
        """Copy the layer into the image, and within an area into the framebuffer; draw it first if it is new."""
        on = self._on
        if self._plan.is_new:
            on.draw(frame, layer.framebuffer)
            on.copy(layer.framebuffer, on.whole)
            on.read(on.whole, out)
            layer.pixels[:] = out
        else:
            on.prepare(frame)
            on.copy(layer.framebuffer, area)
            out[:] = layer.pixels
