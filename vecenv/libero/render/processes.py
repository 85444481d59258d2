"""Rendering processes: drivers of GPUs let the contexts of one process wait for each other, those of several less.

In: shots and cameras. Out: images in memory that this process shares with those that draw, so they are not copied; it
is used again when the arrays are gone. A process gets a scene when it first draws it. Shared memory has no name, and a
process ends when its caller does, so nothing stays behind.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import mmap
import os
import signal
import socket
import subprocess
import sys
import weakref
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from multiprocessing import reduction
from multiprocessing.connection import Connection
from typing import Any

import mujoco
import numpy as np

from vecenv.errors import VecenvError
from vecenv.libero.render.contexts import GlError
from vecenv.libero.render.drawing import Stage
from vecenv.libero.render.jobs import Arrays, Job, Layout, Shot, Task
from vecenv.libero.render.options import UserCamera
from vecenv.libero.render.painter import Look
from vecenv.libero.render.process_worker import Request, SentStage
from vecenv.util.cores import usable_cores

_log = logging.getLogger(__name__)

_MODULE = "vecenv.libero.render.process_worker"
# Memory that nothing uses is kept for later calls, so many pieces.
_SPARE = 4
# Seconds that a process has to end by itself.
_PATIENCE = 10.0


class _Gone(GlError):
    """A process has ended; the message says how."""


class Processes:
    """Processes that draw, each with one GL context.

    Args:
        stages: the scenes.
        look: how they draw; its memory for layers is that of all together.
        count: how many; fewer if the driver gives fewer contexts.

    Raises:
        GlError: none can be started, or the driver gives no context.
    """

    def __init__(self, stages: Sequence[Stage], look: Look, count: int) -> None:
        if not hasattr(os, "memfd_create"):
            raise GlError("rendering processes need Linux; set num_threads in place of num_processes")
        self._look, self._stages = look, dict[int, Stage]()
        self._numbers, self._order = itertools.count(), list[int]()
        self.use(stages)
        self._count, self._most = 0, sys.maxsize
        self._workers: list[_Worker] = []
        self._memories = _Memories()
        self._end = weakref.finalize(self, _end, self._workers, os.getpid())
        self.grow(count)

    @property
    def count(self) -> int:
        """How many processes draw."""
        return self._count

    @property
    def pids(self) -> tuple[int, ...]:
        """Ids of the processes that run."""
        return tuple(worker.pid for worker in self._workers)

    def grow(self, count: int) -> None:
        """Start processes until there are so many, or the driver gives no more contexts."""
        count = min(count, self._most)
        look = self._look._replace(layer_memory=self._look.layer_memory // max(count, 1))
        started: list[_Worker] = []
        with self._all_or_none():
            while len(self._workers) < count:
                started.append(_Worker(look, count))
                self._workers.append(started[-1])
            for worker in started:
                self._open(worker)
        self._count = len(self._workers)

    def use(self, stages: Sequence[Stage]) -> None:
        """Draw these scenes from now on; processes keep those of them that they have, and forget the others."""
        known = {stage: number for number, stage in self._stages.items()}
        self._order = [known[stage] if stage in known else next(self._numbers) for stage in stages]
        self._stages = dict(zip(self._order, stages, strict=True))

    def _open(self, worker: _Worker) -> None:
        try:
            worker.opened()
        except GlError as error:
            self._workers.remove(worker)
            worker.close()
            if not self._workers:
                raise
            _log.warning("%s; fewer processes draw", error)
            self._most = len(self._workers)

    def draw(self, shots: Mapping[int, Shot], cameras: Sequence[str | UserCamera], layout: Layout) -> Job:
        """Draw every slot through every camera. A process that ends meanwhile is replaced once.

        Raises:
            GlError: GL failed, also with new contexts; or a process and its replacement ended.
        """
        if len(self._workers) < self._count:
            self.grow(self._count)
        memory, root = self._memories.take(layout.bytes)
        numbered = {slot: replace(shot, stage=self._order[shot.stage]) for slot, shot in shots.items()}
        job = Job.of(numbered, cameras, layout, Arrays.over(root, layout))
        shares = {index: tasks for index, tasks in enumerate(job.shares(len(self._workers))) if tasks}
        errors: list[VecenvError] = []
        with self._all_or_none():
            lost = self._ask(job, layout, memory, shares, errors)
            for index, error in lost.items():
                _log.warning("%s; another one draws its images", error)
                self._replace(index)
            if lost:
                lost = self._ask(job, layout, memory, {index: shares[index] for index in lost}, errors)
            if lost:
                raise GlError(f"cannot render: {next(iter(lost.values()))}, and so did the one before it")
        if errors:
            raise errors[0]
        return job

    def close(self) -> None:
        """End the processes. Closing twice is harmless."""
        self._end()

    def _ask(
        self,
        job: Job,
        layout: Layout,
        memory: _Memory,
        shares: Mapping[int, Sequence[Task]],
        errors: list[VecenvError],
    ) -> dict[int, _Gone]:
        """Let processes draw their shares, and add what fails to ``errors``; returns which processes have ended."""
        lost: dict[int, _Gone] = {}
        with contextlib.ExitStack() as files:
            models: dict[int, int] = {}
            for index, tasks in shares.items():
                worker, drawn = self._workers[index], {task.slot: job.shots[task.slot] for task in tasks}
                missing = sorted({shot.stage for shot in drawn.values()} - worker.stages)
                for stage in missing:
                    if stage not in models:
                        models[stage] = files.enter_context(_file_of(self._stages[stage]))
                request = Request(
                    stages=[_sent(stage, self._stages[stage]) for stage in missing],
                    used=frozenset(self._stages),
                    memory=memory.number,
                    memories=self._memories.numbers,
                    is_new=memory.number not in worker.memories,
                    layout=layout,
                    cameras=job.cameras,
                    tasks=tasks,
                    shots=drawn,
                )
                try:
                    worker.send(request, [models[stage] for stage in missing], memory.handle)
                except _Gone as error:
                    lost[index] = error
        for index in sorted(shares.keys() - lost.keys()):
            try:
                job.add_views(self._workers[index].receive())
            except _Gone as error:
                lost[index] = error
            except VecenvError as error:
                self._workers[index].stages.clear()  # which of them it has got is not known
                errors.append(error)
        return lost

    def _replace(self, index: int) -> None:
        self._workers[index].close()
        look = self._look._replace(layer_memory=self._look.layer_memory // self._count)
        self._workers[index] = _Worker(look, self._count)
        self._workers[index].opened()

    @contextlib.contextmanager
    def _all_or_none(self) -> Iterator[None]:
        """After an error inside, end all processes, whose answers nobody may have read; the next call starts others."""
        try:
            yield
        except BaseException:
            _end(self._workers, os.getpid(), at_once=True)
            raise


class _Worker:
    """A rendering process and the socket to it.

    Attributes:
        stages, memories: the numbers of those it has.
    """

    def __init__(self, look: Look, count: int) -> None:
        self.stages: set[int] = set()
        self.memories: frozenset[int] = frozenset()
        mine, theirs = socket.socketpair()
        with theirs:
            command = [sys.executable, "-m", _MODULE, str(theirs.fileno()), str(os.getpid())]
            try:
                self._process = subprocess.Popen(  # nosec B603 # a module of vecenv, in this Python
                    command, pass_fds=(theirs.fileno(),), env=_environment(look.gl, count), stdin=subprocess.DEVNULL
                )
            except OSError as error:
                mine.close()
                raise GlError(
                    f"cannot start a rendering process ({error}); with num_threads this process draws"
                ) from error
        self._pipe = Connection(mine.detach())
        self._look = look

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    def opened(self) -> None:
        """Wait until it has a GL context.

        Raises:
            GlError: the driver gives none, or the process ends.
        """
        try:
            self._pipe.send(self._look)
            self.receive()
        except (_Gone, OSError) as error:
            raise GlError(f"cannot render: {self._how()} before it had a GL context") from error

    def send(self, request: Request, models: Sequence[int], memory: int) -> None:
        """Send a request and the files that belong to it."""
        try:
            self._pipe.send(request)
            for handle in (*models, *([memory] if request.is_new else ())):
                reduction.send_handle(self._pipe, handle, self.pid)
        except OSError as error:
            raise _Gone(self._how()) from error
        self.stages = (self.stages & request.used) | {sent.number for sent in request.stages}
        self.memories = (self.memories & request.memories) | {request.memory}

    def receive(self) -> Any:
        """The answer to the last request.

        Raises:
            _Gone: the process has ended.
            VecenvError: drawing failed.
        """
        try:
            worked, answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise _Gone(self._how()) from error
        if worked:
            return answer
        raise answer if isinstance(answer, VecenvError) else GlError(f"a rendering process failed:\n{answer}")

    def _how(self) -> str:
        try:
            status = self._process.wait(timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            return f"rendering process {self.pid} closed its socket"
        if status >= 0:
            return f"rendering process {self.pid} ended with exit status {status}"
        name = signal.Signals(-status).name
        hint = "; the machine may be out of memory" if name == "SIGKILL" else ""
        return f"rendering process {self.pid} was ended by {name}{hint}"

    def leave(self, *, at_once: bool = False) -> None:
        """Close this end of the socket; the process ends once no fork of its caller has that end open."""
        self._pipe.close()
        if at_once:
            self._process.kill()
        self._process.poll()

    def close(self) -> None:
        """End the process and wait for it."""
        self.leave()
        try:
            self._process.wait(timeout=_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _end(workers: list[_Worker], owner: int, *, at_once: bool = False) -> None:
    """End processes, if this one has started them."""
    ended, workers[:] = list(workers), []
    for worker in ended:
        worker.leave(at_once=at_once and os.getpid() == owner)
    if os.getpid() == owner:
        for worker in ended:
            worker.close()


def _environment(gl: str, count: int) -> dict[str, str]:
    """A rendering process's environment: this process's module path, its share of the cores, and no GPU for JAX."""
    paths = [path for path in sys.path if path]
    share = usable_cores() // count
    usual = {"LP_NUM_THREADS": str(share if share > 1 else 0)}
    own = {"PYTHONPATH": os.pathsep.join(paths), "MUJOCO_GL": gl, "OMP_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    return {**usual, **os.environ, **own}


def _sent(number: int, stage: Stage) -> SentStage:
    scene = stage.scene
    return SentStage(number, scene.problem_name, scene.arena, dict(scene.entities), stage.grid)


@contextlib.contextmanager
def _file_of(stage: Stage) -> Iterator[int]:
    """The handle of a file in memory with a stage's model, which processes read."""
    size = mujoco.mj_sizeModel(stage.model)
    handle = os.memfd_create("vecenv-scene")
    try:
        os.ftruncate(handle, size)
        stage.save_model(np.frombuffer(mmap.mmap(handle, size), np.uint8))
        yield handle
    finally:
        os.close(handle)


class _Memory:
    """Memory that processes share, by handle."""

    def __init__(self, number: int, size: int) -> None:
        self.number, self.size = number, size
        self.handle = os.memfd_create("vecenv-images")
        weakref.finalize(self, os.close, self.handle)
        os.ftruncate(self.handle, size)
        self._map = mmap.mmap(self.handle, size)

    def root(self) -> np.ndarray:
        """All of it, uint8; views of it keep it alive."""
        return np.frombuffer(self._map, np.uint8)


class _Memories:
    """Memory for the images of calls; a piece is free again when no array shows it."""

    def __init__(self) -> None:
        self._numbers = itertools.count()
        self._free: list[_Memory] = []
        self._used: dict[int, _Memory] = {}
        # Filled whenever arrays are collected, in any thread.
        self._returned: deque[int] = deque()

    @property
    def numbers(self) -> frozenset[int]:
        """Of all that there are."""
        return frozenset((*self._used, *(memory.number for memory in self._free)))

    def take(self, size: int) -> tuple[_Memory, np.ndarray]:
        """Memory of at least so many bytes, and all of it, uint8; it is in use until no view of that is left."""
        while self._returned:
            self._free.append(self._used.pop(self._returned.popleft()))
        size = max(size, 1)
        fitting = [memory for memory in self._free if size <= memory.size <= 2 * size]
        if fitting:
            found = min(fitting, key=lambda memory: memory.size)
            self._free.remove(found)
        else:
            found = _Memory(next(self._numbers), size)
        self._free = self._free[-_SPARE:]
        self._used[found.number] = found
        root = found.root()
        weakref.finalize(root, self._returned.append, found.number).atexit = False
        return found, root
