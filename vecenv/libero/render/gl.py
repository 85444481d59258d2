"""Images of a batch in GL: a few threads, each with one GL context, render slots one by one.

In: a stage per scene (``vecenv.libero.render.drawing``), a shot per slot, cameras. Out: arrays [B, H, W, ...] of
colours, depths and instances, and the cameras' poses. MuJoCo's own renderer draws, so ``lod="exact"`` is upstream's
image. It releases Python's lock while it draws, so threads draw in parallel and no environment needs a process of its
own. A thread uploads a scene the first time it draws it, and prefers scenes that it has uploaded.

EGL and OSMesa both draw without a display; physics needs neither.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import importlib
import itertools
import os
import threading
import weakref
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from vecenv.errors import SimulationError
from vecenv.libero.render.composite import LAYER_MEMORY, Compositor, Layers, Picture, is_worthwhile
from vecenv.libero.render.culling import View
from vecenv.libero.render.displays import GlContext, egl_context
from vecenv.libero.render.drawing import Pose, Stage, camera_view
from vecenv.libero.render.options import RenderError, UserCamera, VisualOptions
from vecenv.libero.render.worker import Worker
from vecenv.observations import CameraView
from vecenv.util.cores import usable_cores

# The libraries of each GL backend, and how to install one.
PACKAGES: Mapping[str, tuple[tuple[str, ...], str]] = {
    "egl": (("libEGL.so.1", "libEGL.so"), "apt-get install libegl1 libgl1-mesa-dri (Debian, Ubuntu), or a GPU driver"),
    "osmesa": (("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"), "apt-get install libosmesa6 (Debian, Ubuntu)"),
}
_VARIABLE = "MUJOCO_GL"
_ATTEMPTS = 2
_AS_CODES = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)

# EGL's display is opened with the first context, by one thread at a time.
_opening = threading.Lock()


class GlError(SimulationError):
    """No GL is available, or it failed; the message says what would help."""


class _ContextLost(Exception):
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


@dataclass(frozen=True)
class Shot:
    """What to render of one slot: the index of its stage, its pose, and its visual options."""

    stage: int
    pose: Pose
    options: VisualOptions = field(default_factory=VisualOptions)


@dataclass(frozen=True)
class Wanted:
    """Which images of a camera to render."""

    rgb: bool = True
    depth: bool = False
    segmentation: bool = False


@dataclass(frozen=True)
class Frames:
    """Images of B slots by camera, as delivered: rows from the top, mirrored.

    Attributes:
        rgb: uint8 [B, H, W, 3].
        depth: metres from the camera's plane, float32 [B, H, W].
        segmentation: index into the stage's ``instances``, int16 [B, H, W].
        views: where the cameras are.
    """

    rgb: Mapping[str, np.ndarray]
    depth: Mapping[str, np.ndarray]
    segmentation: Mapping[str, np.ndarray]
    views: Mapping[str, CameraView]


class GlRenderer:
    """Renders batches; safe to use from several threads, one call at a time each.

    Args:
        stages: the scenes.
        height, width: of the images, pixels.
        num_threads: rendering threads; None for one per core. If the driver gives fewer contexts, fewer threads run.
        gl: ``"egl"``, ``"osmesa"`` or None (``choose``).
        layer_memory: for stored images of what stands still (``vecenv.libero.render.composite``), bytes; with 0 every
            image is drawn whole.

    Raises:
        GlError: no GL is available.
    """

    def __init__(
        self,
        stages: Sequence[Stage],
        *,
        height: int = 256,
        width: int = 256,
        num_threads: int | None = None,
        gl: str | None = None,
        layer_memory: int = LAYER_MEMORY,
    ) -> None:
        self.stages, self.height, self.width = tuple(stages), height, width
        self.gl = choose(gl)
        self._calls = threading.Lock()
        self._threads: list[_Thread] = []
        failures: list[GlError] = []
        count = num_threads or usable_cores()
        for _ in range(count):
            thread = _Thread(_Painter(self.stages, self.gl, height, width, layer_memory // count))
            try:
                thread.run(thread.painter.open).result()
                self._threads.append(thread)
            except GlError as error:
                thread.stop()
                failures.append(error)
                break
        if not self._threads:
            raise failures[0]
        _live.add(self)
        _close_at_exit()

    @property
    def num_threads(self) -> int:
        """The number of threads; fewer than requested if the driver ran out of contexts."""
        return len(self._threads)

    def render(
        self,
        shots: Sequence[Shot],
        cameras: Sequence[str | UserCamera],
        wanted: Wanted = Wanted(),
        out: Mapping[str, np.ndarray] | None = None,
    ) -> Frames:
        """Render every slot through every camera.

        Args:
            shots: one per slot.
            cameras: names of the scenes' cameras, ``"wrist"``, or user cameras.
            wanted: which images.
            out: colour arrays to fill, by camera, uint8 [B, H, W, 3]; new ones are made for the others.

        Raises:
            RenderError: a scene does not have a camera, instance, material or texture, or an array has the wrong shape.
            GlError: GL failed, also with new contexts; or the renderer is closed.
        """
        job = _Job.of(self, shots, cameras, wanted, out or {})
        with self._calls:
            if not self._threads:
                raise GlError("the renderer is closed")
            self._distribute(job)
        return job.frames()

    def close(self) -> None:
        """Free the contexts and end the threads. Closing twice is harmless."""
        with self._calls:
            threads, self._threads = self._threads, []
        for thread in threads:
            thread.stop()
        _live.discard(self)

    def _distribute(self, job: _Job) -> None:
        order = sorted(range(len(job.shots)), key=lambda slot: job.shots[slot].stage)
        # With few slots a task is one image, so that every thread gets one.
        each = 1 if len(order) < 2 * len(self._threads) else len(job.cameras)
        tasks = [
            _Task(slot, range(first, min(first + each, len(job.cameras))))
            for slot in order
            for first in range(0, len(job.cameras), each)
        ]
        bounds = np.linspace(0, len(tasks), len(self._threads) + 1).astype(int)
        shares = [deque(tasks[low:high]) for low, high in itertools.pairwise(bounds.tolist())]
        running = [
            thread.run(_run_tasks, thread.painter, job, shares, number) for number, thread in enumerate(self._threads)
        ]
        errors = [error for future in running if (error := future.exception()) is not None]
        if errors:
            raise errors[0]


@dataclass(frozen=True)
class _Task:
    """Some cameras of one slot."""

    slot: int
    cameras: range


@dataclass
class _Job:
    """One call of ``render``."""

    shots: Sequence[Shot]
    cameras: Sequence[str | UserCamera]
    wanted: Wanted
    rgb: dict[str, np.ndarray]
    depth: dict[str, np.ndarray]
    segmentation: dict[str, np.ndarray]
    views: dict[str, list[View | None]]

    @classmethod
    def of(
        cls,
        renderer: GlRenderer,
        shots: Sequence[Shot],
        cameras: Sequence[str | UserCamera],
        wanted: Wanted,
        out: Mapping[str, np.ndarray],
    ) -> _Job:
        for stage, options in {(shot.stage, id(shot.options)): (shot.stage, shot.options) for shot in shots}.values():
            renderer.stages[stage].check(cameras, options)
        names = [camera_name(camera) for camera in cameras]
        size = (len(shots), renderer.height, renderer.width)
        for name, array in out.items():
            if array.shape != (*size, 3) or array.dtype != np.uint8:
                raise RenderError(f"out[{name!r}] is {array.dtype} {array.shape}; expected uint8 {(*size, 3)}")
        return cls(
            shots=shots,
            cameras=cameras,
            wanted=wanted,
            rgb={n: out[n] if n in out else np.empty((*size, 3), np.uint8) for n in names if wanted.rgb},
            depth={n: np.empty(size, np.float32) for n in names if wanted.depth},
            segmentation={n: np.empty(size, np.int16) for n in names if wanted.segmentation},
            views={n: [None] * len(shots) for n in names},
        )

    def frames(self) -> Frames:
        height, width = next(iter((*self.rgb.values(), *self.depth.values(), *self.segmentation.values()))).shape[1:3]
        views = {
            name: camera_view([view for view in row if view is not None], height, width)
            for name, row in self.views.items()
            if row
        }
        return Frames(self.rgb, self.depth, self.segmentation, views)


def camera_name(camera: str | UserCamera) -> str:
    """The name of a camera in the images."""
    return camera if isinstance(camera, str) else camera.name


def _run_tasks(painter: _Painter, job: _Job, shares: Sequence[deque[_Task]], own: int) -> None:
    """Draw the thread's own share, then tasks of other shares whose scenes are uploaded here already."""
    with contextlib.suppress(IndexError):
        while True:
            painter.draw(job, shares[own].popleft())
    for share in shares:
        with contextlib.suppress(IndexError):
            while painter.knows(job.shots[share[-1].slot].stage):
                painter.draw(job, share.pop())


class _Painter:
    """One thread's GL context and its uploaded scenes; only that thread may call the methods."""

    def __init__(self, stages: Sequence[Stage], gl: str, height: int, width: int, memory: int) -> None:
        self._stages, self._gl = stages, gl
        self._rect, self._aspect = mujoco.MjrRect(0, 0, width, height), width / height
        self._pixels = np.empty((height, width, 3), np.uint8)
        self._depth = np.empty((height, width), np.float32)
        self._window: GlContext | None = None
        self._contexts: dict[int, mujoco.MjrContext] = {}
        self._memory, self._composes = memory, False
        self._layers: Layers | None = None
        self._compositors: dict[int, Compositor] = {}
        self._frames: dict[int, list[mujoco.MjvScene]] = {}

    def open(self) -> None:
        """Create the GL context."""
        self._window = open_context(self._gl, *self._depth.shape)
        self._composes = self._memory > 0 and is_worthwhile()

    def close(self) -> None:
        """Free everything; errors are ignored, because what GL has lost cannot be freed."""
        for context in self._contexts.values():
            with contextlib.suppress(Exception):
                context.free()
        self._contexts, self._frames, self._compositors, self._layers = {}, {}, {}, None
        if self._window is not None:
            with contextlib.suppress(Exception):
                self._window.free()
        self._window = None

    def knows(self, stage: int) -> bool:
        """Whether a scene is uploaded."""
        return stage in self._contexts

    def draw(self, job: _Job, task: _Task) -> None:
        """Draw a task; if GL has lost its context, create a new one and try again."""
        for attempt in range(_ATTEMPTS):
            try:
                self._draw(job, task)
                return
            except (_ContextLost, mujoco.FatalError) as error:
                self.close()
                if attempt + 1 == _ATTEMPTS:
                    raise GlError(f"cannot render: {self._gl} failed {_ATTEMPTS} times ({error})") from error
                self.open()

    def _draw(self, job: _Job, task: _Task) -> None:
        shot = job.shots[task.slot]
        stage, context = self._stages[shot.stage], self._context(shot.stage)
        frames = self._frames_for(shot.stage, len(task.cameras))
        cameras = [job.cameras[index] for index in task.cameras]
        names = [camera_name(camera) for camera in cameras]
        pictures = self._pictures(task.slot, names, shot, job.wanted)
        sights = stage.fill(
            frames, cameras, shot.pose, shot.options, slot=task.slot, aspect=self._aspect,
            choices=[picture.choose for picture in pictures],
        )  # fmt: skip
        for frame, name, sight, picture in itertools.zip_longest(frames, names, sights, pictures):
            job.views[name][task.slot] = sight.view
            self._shoot(stage, context, frame, name, job, task.slot, picture)

    def _pictures(self, slot: int, names: Sequence[str], shot: Shot, wanted: Wanted) -> list[Picture]:
        """The images of a slot that are composed of layers; none if MuJoCo draws them."""
        if not self._composes or wanted != Wanted():
            return []
        if shot.stage not in self._compositors:
            self._layers = self._layers or Layers(*self._depth.shape, self._memory)
            self._compositors[shot.stage] = Compositor(
                self._stages[shot.stage], self._context(shot.stage), self._layers, *self._depth.shape
            )
        return [self._compositors[shot.stage].picture(slot, name, shot.options) for name in names]

    def _shoot(
        self,
        stage: Stage,
        context: mujoco.MjrContext,
        frame: mujoco.MjvScene,
        name: str,
        job: _Job,
        slot: int,
        picture: Picture | None,
    ) -> None:
        """Draw one frame and deliver its images, turned by 180 degrees against GL's rows from the bottom."""
        if job.wanted.rgb:
            if picture is None:
                mujoco.mjr_render(self._rect, frame, context)
                mujoco.mjr_readPixels(self._pixels, None, self._rect, context)
                job.rgb[name][slot] = self._pixels[::-1, ::-1]
            else:
                picture.draw(frame, job.rgb[name][slot])
            _check()
        if job.wanted.depth or job.wanted.segmentation:
            codes = self._codes(frame, context)
            if job.wanted.depth:
                job.depth[name][slot] = _metres(self._depth, *stage.clip_planes)[::-1, ::-1]
            if job.wanted.segmentation:
                job.segmentation[name][slot] = stage.segment(frame, codes)[::-1, ::-1]

    def _codes(self, frame: mujoco.MjvScene, context: mujoco.MjrContext) -> np.ndarray:
        """MuJoCo's segment codes [H, W]; depth comes with them, undisturbed by antialiasing."""
        frame.flags[list(map(int, _AS_CODES))] = 1
        mujoco.mjr_render(self._rect, frame, context)
        mujoco.mjr_readPixels(self._pixels, self._depth, self._rect, context)
        frame.flags[list(map(int, _AS_CODES))] = 0
        _check()
        return self._pixels.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)

    def _context(self, stage: int) -> mujoco.MjrContext:
        """The scene's context; from then on its framebuffer is drawn into, which ``mjr_render`` does not see to."""
        if stage not in self._contexts:
            self._contexts[stage] = self._stages[stage].context(*self._depth.shape)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._contexts[stage])
        return self._contexts[stage]

    def _frames_for(self, stage: int, count: int) -> list[mujoco.MjvScene]:
        frames = self._frames.setdefault(stage, [])
        while len(frames) < count:
            frames.append(self._stages[stage].new_frame())
        return frames[:count]


def _check() -> None:
    code = mujoco.mjr_getError()
    if code:
        raise _ContextLost(f"GL error {code:#x}")


def _metres(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Distances of a reversed depth buffer (1 at the near plane, 0 at the far one), float32 [H, W]."""
    return (near * far / (near + depth.astype(float) * (far - near))).astype(np.float32)


class _Thread(Worker):
    """A thread with a painter, which only it uses."""

    def __init__(self, painter: _Painter) -> None:
        super().__init__("vecenv-gl", painter.close)
        self.painter = painter


_live: weakref.WeakSet[GlRenderer] = weakref.WeakSet()


@functools.cache
def _close_at_exit() -> None:
    """Close open renderers at exit; registered after the first context, to run before PyOpenGL ends its display."""
    atexit.register(_close_all)


def _close_all() -> None:
    for renderer in list(_live):
        renderer.close()
