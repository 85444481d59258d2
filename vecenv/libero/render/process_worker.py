"""A rendering process: it draws what ``vecenv.libero.render.processes`` sends, into memory shared with the sender.

In: requests over a socket, with handles of scenes and of memory. Out: images in that memory, and where the cameras
were. It is started as a module, so the caller's script is not imported again, and ends when the caller does.
"""

from __future__ import annotations

import mmap
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection
from types import MappingProxyType

import mujoco
import numpy as np

from vecenv.errors import VecenvError
from vecenv.libero.render.commands import renderer_name
from vecenv.libero.render.culling import View
from vecenv.libero.render.drawing import Stage
from vecenv.libero.render.jobs import Arrays, Job, Layout, Shot, Task
from vecenv.libero.render.options import UserCamera
from vecenv.libero.render.painter import Look, Painter
from vecenv.libero.scene.arenas import Arena
from vecenv.libero.scene.scene import Entity, Scene

# Seconds between looks at whether the caller is still there: a fork of it keeps its end of the socket open.
_PARENT_CHECK = 2.0


@dataclass(frozen=True)
class SentStage:
    """A stage without its model, which is sent as the handle of a file.

    Attributes:
        number: of the stage in requests.
        problem_name, arena, entities: of its scene.
        grid: of its positions, see ``Stage``.
    """

    number: int
    problem_name: str
    arena: Arena
    entities: dict[str, Entity]
    grid: float

    def load(self, handle: int) -> Stage:
        """The stage; the file is read, not kept."""
        scene = Scene(
            problem_name=self.problem_name,
            model=mujoco.MjModel.from_binary_path(f"/proc/self/fd/{handle}"),
            arena=self.arena,
            entities=MappingProxyType(self.entities),
            regions=MappingProxyType({}),
        )
        return Stage(scene, self.grid)


@dataclass(frozen=True)
class Request:
    """What a process is to draw; handles of ``stages`` follow it, then that of the memory if it is new.

    Attributes:
        stages: those that are new to the process. used: the numbers of all that may be drawn later.
        memory: number of the memory that images go to. memories: the numbers that are still in use.
        is_new: whether the process has not got this memory.
        layout: of the memory.
        cameras: of all tasks.
        tasks: what to draw.
        shots: by slot, those of the tasks.
    """

    stages: Sequence[SentStage]
    used: frozenset[int]
    memory: int
    memories: frozenset[int]
    is_new: bool
    layout: Layout
    cameras: Sequence[str | UserCamera]
    tasks: Sequence[Task]
    shots: dict[int, Shot]


class _Server:
    """What a process keeps between requests."""

    def __init__(self, pipe: Connection, look: Look) -> None:
        self._pipe, self._stages = pipe, dict[int, Stage]()
        self.painter = Painter(self._stages, look)
        self._memories: dict[int, mmap.mmap] = {}

    def answer(self, request: Request) -> dict[str, list[View | None]]:
        """Draw; returns the views by camera and slot."""
        handles = [reduction.recv_handle(self._pipe) for _ in range(len(request.stages) + request.is_new)]
        try:
            self._take(request, handles)
        finally:
            for handle in handles:
                os.close(handle)
        memory = np.frombuffer(self._memories[request.memory], np.uint8)
        arrays = Arrays.over(memory, request.layout)
        job = Job.of(request.shots, request.cameras, request.layout, arrays)
        self.painter.run(job, request.tasks)
        return job.views

    def _take(self, request: Request, handles: Sequence[int]) -> None:
        for number in self._memories.keys() - request.memories:
            del self._memories[number]
        if request.is_new:
            self._memories[request.memory] = mmap.mmap(handles[-1], os.fstat(handles[-1]).st_size)
        for number in self._stages.keys() - request.used:
            self.painter.forget(number)
            del self._stages[number]
        for sent, handle in zip(request.stages, handles, strict=False):
            self._stages[sent.number] = sent.load(handle)


def _serve(pipe: Connection, parent: int) -> None:
    """Answer requests until the caller closes its end, or is gone."""
    server = _Server(pipe, pipe.recv())
    try:
        server.painter.open()
    except VecenvError as error:
        pipe.send((False, error))
        return
    pipe.send((True, renderer_name()))
    try:
        while True:
            while not pipe.poll(_PARENT_CHECK):
                if os.getppid() != parent:
                    return
            pipe.send(_answer(server, pipe.recv()))
    finally:
        server.painter.close()


def _answer(server: _Server, request: Request) -> tuple[bool, object]:
    """Whether the request succeeded, and its views; else its error, or the traceback of one that is no vecenv error."""
    try:
        return True, server.answer(request)
    except VecenvError as error:
        return False, error
    except Exception:
        return False, traceback.format_exc()


def main() -> None:
    """Serve the socket and the caller that the command line names."""
    # Ctrl-C reaches all processes of a terminal; the caller decides what ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        _serve(Connection(int(sys.argv[1])), int(sys.argv[2]))
    except (EOFError, OSError):
        return  # the caller has closed its end


if __name__ == "__main__":
    main()
