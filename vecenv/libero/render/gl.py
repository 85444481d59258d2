"""Images of a batch in GL, drawn by threads of this process or by processes.

In: a stage per scene (``vecenv.libero.render.drawing``), a shot per slot, cameras. Out: arrays [B, H, W, ...] of
colours, depths and instances, and the cameras' poses. Each thread or process has one GL context
(``vecenv.libero.render.painter``), uploads a scene the first time it draws it, and prefers scenes that it has uploaded.
MuJoCo releases Python's lock while it draws, so threads draw in parallel where the driver lets them: Mesa's software GL
does. The contexts of one process wait for each other in drivers of GPUs, where processes draw
(``vecenv.libero.render.processes``).
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import threading
import weakref
from collections import deque
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from vecenv.libero.render.composite import LAYER_MEMORY
from vecenv.libero.render.contexts import PACKAGES, GlError, available, choose, open_context
from vecenv.libero.render.drawing import Stage
from vecenv.libero.render.jobs import (
    Arrays,
    Frames,
    Job,
    Layout,
    Shot,
    Task,
    Wanted,
    camera_name,
    check_request,
)
from vecenv.libero.render.options import UserCamera, check_numbers
from vecenv.libero.render.painter import Look, Painter
from vecenv.libero.render.processes import Processes
from vecenv.libero.render.worker import Worker
from vecenv.util.cores import usable_cores

__all__ = [
    "PACKAGES",
    "Frames",
    "GlError",
    "GlRenderer",
    "Shot",
    "Wanted",
    "available",
    "camera_name",
    "choose",
    "open_context",
]

_COLORS = Wanted()


class GlRenderer:
    """Renders batches; safe to use from several threads, one call at a time each.

    Args:
        stages: the scenes.
        height, width: of the images, pixels.
        num_threads: threads of this process that draw. If the driver gives fewer contexts, fewer draw.
        num_processes: processes that draw in place of threads, fewer if the driver gives fewer contexts. With neither
            number, threads draw where the driver draws in software, one per core; where it draws in hardware,
            processes, one per slot and at most one per core, or for a single slot threads.
        gl: ``"egl"``, ``"osmesa"`` or None (``choose``).
        layer_memory: for stored images of what stands still (``vecenv.libero.render.composite``), bytes; with 0 every
            image is drawn whole.
        late_reads: whether colours are read back some images later (``vecenv.libero.render.readback``); None: where the
            driver draws in hardware.

    Raises:
        GlError: no GL is available, or no process can be started.
        RenderError: both numbers are given.
    """

    def __init__(
        self,
        stages: Sequence[Stage],
        *,
        height: int = 256,
        width: int = 256,
        num_threads: int | None = None,
        num_processes: int | None = None,
        gl: str | None = None,
        layer_memory: int = LAYER_MEMORY,
        late_reads: bool | None = None,
    ) -> None:
        check_numbers(num_threads, num_processes)
        self.stages, self.height, self.width = tuple(stages), height, width
        self.gl = choose(gl)
        self._look = Look(self.gl, height, width, layer_memory, late_reads)
        self._calls = threading.Lock()
        self._made_in, self._closed = os.getpid(), False
        self._threads: _Threads | None = None
        self._processes: Processes | None = None
        if num_processes is not None:
            self._processes, self._chooses = Processes(self.stages, self._look, num_processes), False
        else:
            self._threads = _Threads(dict(enumerate(self.stages)), self._look, num_threads)
            self._chooses = num_threads is None and not self._threads.in_software
        _live.add(self)
        _close_at_exit()

    @property
    def num_threads(self) -> int:
        """The number of threads that draw; fewer than requested if the driver ran out of contexts."""
        return 0 if self._threads is None else self._threads.count

    @property
    def num_processes(self) -> int:
        """The number of processes that draw."""
        return 0 if self._processes is None else self._processes.count

    @property
    def pids(self) -> tuple[int, ...]:
        """Ids of the processes that draw."""
        return () if self._processes is None else self._processes.pids

    def render(
        self,
        shots: Sequence[Shot],
        cameras: Sequence[str | UserCamera],
        wanted: Wanted = _COLORS,
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
            GlError: GL failed, also with new contexts; a process ended twice; or the renderer is closed.
        """
        names = tuple(camera_name(camera) for camera in cameras)
        layout = Layout(names, wanted, len(shots), self.height, self.width)
        check_request(self.stages, shots, cameras, layout, out or {})
        given = {name: array for name, array in (out or {}).items() if name in names and wanted.rgb}
        by_slot = dict(enumerate(shots))
        with self._calls:
            if self._closed:
                raise GlError("the renderer is closed")
            if os.getpid() != self._made_in:
                raise GlError(f"the renderer was made in process {self._made_in}: it does not survive a fork")
            self._choose(layout)
            if self._processes is not None:
                job = self._processes.draw(by_slot, cameras, layout)
                for name, array in given.items():
                    array[:] = job.arrays.rgb[name]
                    job.arrays.rgb[name] = array
            else:
                assert self._threads is not None
                arrays = Arrays.new(layout)
                arrays.rgb.update(given)
                job = Job.of(by_slot, cameras, layout, arrays)
                self._threads.draw(job)
        return job.frames()

    def use(self, stages: Sequence[Stage]) -> bool:
        """Render other scenes from now on; False if that takes a new renderer, because threads draw."""
        with self._calls:
            if self._processes is None:
                return False
            self._processes.use(stages)
            self.stages = tuple(stages)
            return True

    def close(self) -> None:
        """Free the contexts, and end the threads and processes. Closing twice is harmless."""
        with self._calls:
            self._closed = True
            threads, processes = self._threads, self._processes
            self._threads = self._processes = None
        for team in (threads, processes):
            if team is not None:
                team.close()
        _live.discard(self)

    def _choose(self, layout: Layout) -> None:
        """Where the choice is free, start as many threads or processes as a call needs."""
        if not self._chooses:
            return
        cores = usable_cores()
        if self._processes is not None:
            self._processes.grow(min(cores, layout.slots))
        elif layout.slots > 1 and cores > 1:
            self._processes = Processes(self.stages, self._look, min(cores, layout.slots))
            threads, self._threads = self._threads, None
            if threads is not None:
                threads.close()
        elif self._threads is not None:
            self._threads.grow(min(cores, len(layout.names)))


class _Threads:
    """Threads that draw.

    Args:
        stages: the scenes by number.
        look: how they draw; its memory for layers is that of all together.
        count: how many; None for one per core where the driver draws in software, and one where it does not.

    Attributes:
        in_software: whether the driver draws on the CPU.
    """

    def __init__(self, stages: Mapping[int, Stage], look: Look, count: int | None) -> None:
        self._stages, self._threads = stages, list[_Thread]()
        self._most = count or usable_cores()
        self._look = look._replace(layer_memory=look.layer_memory // self._most)
        self.grow(1)
        self.in_software = self._threads[0].painter.in_software
        if count is not None or self.in_software:
            self.grow(self._most)

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self._threads)

    def grow(self, count: int) -> None:
        """Start threads until there are so many, or the driver gives no more contexts.

        Raises:
            GlError: it gives none at all.
        """
        while len(self._threads) < min(count, self._most):
            thread = _Thread(Painter(self._stages, self._look))
            try:
                thread.run(thread.painter.open).result()
            except GlError:
                thread.stop()
                if not self._threads:
                    raise
                self._most = len(self._threads)
                return
            self._threads.append(thread)

    def draw(self, job: Job) -> None:
        """Draw a job."""
        shares = [deque(share) for share in job.shares(len(self._threads))]
        running = [
            thread.run(thread.painter.run, job, _own_then_known(thread.painter, job, shares, number))
            for number, thread in enumerate(self._threads)
        ]
        errors = [error for future in running if (error := future.exception()) is not None]
        if errors:
            raise errors[0]

    def close(self) -> None:
        """Free the contexts and end the threads."""
        for thread in self._threads:
            thread.stop()


def _own_then_known(painter: Painter, job: Job, shares: Sequence[deque[Task]], own: int) -> Iterator[Task]:
    """A thread's own share, then tasks of other shares whose scenes are uploaded there already."""
    with contextlib.suppress(IndexError):
        while True:
            yield shares[own].popleft()
    for share in shares:
        with contextlib.suppress(IndexError):
            while painter.knows(job.shots[share[-1].slot].stage):
                yield share.pop()


class _Thread(Worker):
    """A thread with a painter, which only it uses."""

    def __init__(self, painter: Painter) -> None:
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
