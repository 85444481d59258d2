"""Worker processes: when one dies or hangs, the next call starts another, so a scene that fails costs only itself."""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

from fidelity.measures import Row


class Worker:
    """A process that calls a function again and again; when it dies or hangs, the next call starts another.

    Args:
        function: importable by name; takes and returns what can be pickled.
        gpu: the only GPU it sees; None leaves that alone.
    """

    def __init__(self, function: Callable[..., Row], gpu: int | None = None) -> None:
        self._function, self._gpu = function, gpu
        self._child: tuple[SpawnProcess, Connection] | None = None

    def call(self, arguments: tuple[object, ...], seconds: float) -> Row:
        """The function's result, or a row with ``error``: what it raised, how it died, or that time ran out."""
        process, pipe = self._running()
        try:
            pipe.send(arguments)
            if pipe.poll(max(seconds, 0)):
                return pipe.recv()
            reason = f"no result after {seconds:.0f} s"
        except (EOFError, OSError):
            process.join()
            reason = f"the process died with exit code {process.exitcode}"
        self.close()
        return {"error": reason}

    def _running(self) -> tuple[SpawnProcess, Connection]:
        if self._child is None:
            context = multiprocessing.get_context("spawn")
            pipe, theirs = context.Pipe()
            process = context.Process(target=serve, args=(self._function, theirs, self._gpu), daemon=True)
            process.start()
            theirs.close()
            self._child = process, pipe
        return self._child

    def close(self) -> None:
        """End the process."""
        if self._child is not None:
            process, pipe = self._child
            process.kill()
            process.join()
            pipe.close()
        self._child = None


def serve(function: Callable[..., Row], pipe: Connection, gpu: int | None) -> None:
    """Answer calls until the other end is gone."""
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # several processes share a GPU
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = str(gpu)
    if importlib.util.find_spec("warp") is not None:
        import warp

        warp.config.log_level = warp.LOG_WARNING  # or it prints a line for each of its hundreds of kernels
    while True:
        try:
            arguments = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send(function(*arguments))
        except Exception as error:  # whatever a scene raises concerns this scene only
            traceback.print_exc()
            pipe.send({"error": f"{type(error).__name__}: {error}".splitlines()[0]})
