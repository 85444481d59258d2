"""One GL context that draws tasks: scenes are uploaded when they are first drawn.

In: jobs and their tasks (``vecenv.libero.render.jobs``). Out: the images, in the arrays of the job. MuJoCo's own
renderer draws, so ``lod="exact"`` is upstream's image. A painter belongs to one thread, of this process
(``vecenv.libero.render.gl``) or of a rendering process (``vecenv.libero.render.process_worker``).
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from vecenv.libero.render.commands import draws_in_software
from vecenv.libero.render.composite import Compositor, Layers, Picture, is_worthwhile
from vecenv.libero.render.contexts import ContextLost, GlError, open_context
from vecenv.libero.render.displays import GlContext
from vecenv.libero.render.drawing import Stage
from vecenv.libero.render.jobs import Job, Shot, Task, Wanted, camera_name
from vecenv.libero.render.readback import Readback

_ATTEMPTS = 2
_AS_CODES = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)


class Look(NamedTuple):
    """How a painter draws.

    Attributes:
        gl: ``"egl"`` or ``"osmesa"``.
        height, width: of images, pixels.
        layer_memory: for layers (``vecenv.libero.render.composite``), bytes; 0 for none.
        late_reads: whether images are read back some images later (``vecenv.libero.render.readback``); None: where the
            driver draws in hardware.
    """

    gl: str
    height: int
    width: int
    layer_memory: int = 0
    late_reads: bool | None = None


class Painter:
    """One thread's GL context and its uploaded scenes; only that thread may call the methods.

    Args:
        stages: the scenes by number; some may be added and removed between jobs.
        look: how it draws.

    Attributes:
        in_software: whether the driver draws on the CPU, known once it is open.
    """

    def __init__(self, stages: Mapping[int, Stage], look: Look) -> None:
        self._stages, self._gl = stages, look.gl
        height, width = look.height, look.width
        self._rect, self._aspect = mujoco.MjrRect(0, 0, width, height), width / height
        self._pixels = np.empty((height, width, 3), np.uint8)
        self._depth = np.empty((height, width), np.float32)
        self._window: GlContext | None = None
        self._contexts: dict[int, mujoco.MjrContext] = {}
        self._memory, self._composes = look.layer_memory, False
        self._layers: Layers | None = None
        self._compositors: dict[int, Compositor] = {}
        self._frames: dict[int, list[mujoco.MjvScene]] = {}
        self._late = look.late_reads
        self._readback: Readback | None = None
        self._unread: list[Task] = []
        self.in_software = False

    def open(self) -> None:
        """Create the GL context."""
        self._window = open_context(self._gl, *self._depth.shape)
        self.in_software = draws_in_software()
        self._composes = self._memory > 0 and is_worthwhile()
        if self._late or (self._late is None and not self.in_software):
            self._readback = Readback.where_possible(*self._depth.shape)

    def close(self) -> None:
        """Free everything; errors are ignored, because what GL has lost cannot be freed."""
        for context in self._contexts.values():
            with contextlib.suppress(Exception):
                context.free()
        self._contexts, self._frames, self._compositors, self._layers = {}, {}, {}, None
        self._readback = None
        if self._window is not None:
            with contextlib.suppress(Exception):
                self._window.free()
        self._window = None

    def knows(self, stage: int) -> bool:
        """Whether a scene is uploaded."""
        return stage in self._contexts

    def forget(self, stage: int) -> None:
        """Free an uploaded scene."""
        self._frames.pop(stage, None)
        self._compositors.pop(stage, None)
        if (context := self._contexts.pop(stage, None)) is not None:
            context.free()

    def run(self, job: Job, tasks: Iterable[Task]) -> None:
        """Draw tasks; their images are in the job's arrays then.

        Raises:
            GlError: GL failed, also with a new context.
        """
        try:
            for task in tasks:
                self._attempt(job, [task])
        finally:
            self._attempt(job, [], read=True)

    def _attempt(self, job: Job, tasks: list[Task], *, read: bool = False) -> None:
        """Draw tasks and read all images if asked to; if GL has lost its context, do all again in a new one."""
        for attempt in range(_ATTEMPTS):
            try:
                for task in tasks:
                    self._draw(job, task)
                if self._readback is not None and (read or attempt):
                    self._readback.finish()
                    _check()
                are_read = self._readback is None or read or attempt
                self._unread = [] if are_read else [*self._unread, *tasks]
                return
            except (ContextLost, mujoco.FatalError) as error:
                self.close()
                tasks, self._unread = [*self._unread, *tasks], []
                if attempt + 1 == _ATTEMPTS:
                    raise GlError(f"cannot render: {self._gl} failed {_ATTEMPTS} times ({error})") from error
                self.open()

    def _draw(self, job: Job, task: Task) -> None:
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
        job: Job,
        slot: int,
        picture: Picture | None,
    ) -> None:
        """Draw one frame and deliver its images, turned by 180 degrees against GL's rows from the bottom."""
        if job.wanted.rgb:
            out = job.arrays.rgb[name][slot]
            if picture is not None:
                picture.draw(frame, out)
            else:
                mujoco.mjr_render(self._rect, frame, context)
                if self._readback is not None:
                    self._readback.begin(context, out)
                else:
                    mujoco.mjr_readPixels(self._pixels, None, self._rect, context)
                    out[:] = self._pixels[::-1, ::-1]
            _check()
        if job.wanted.depth or job.wanted.segmentation:
            codes = self._codes(frame, context)
            if job.wanted.depth:
                job.arrays.depth[name][slot] = _metres(self._depth, *stage.clip_planes)[::-1, ::-1]
            if job.wanted.segmentation:
                job.arrays.segmentation[name][slot] = stage.segment(frame, codes)[::-1, ::-1]

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
        raise ContextLost(f"GL error {code:#x}")


def _metres(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Distances of a reversed depth buffer (1 at the near plane, 0 at the far one), float32 [H, W]."""
    return (near * far / (near + depth.astype(float) * (far - near))).astype(np.float32)
