"""HDF5 files read in a process of their own, because the HDF5 library can crash or hang over a damaged file.

A request goes to the reading process (``vecenv_eval.demos.child``) and an answer comes back, plain values and arrays;
neither side unpickles anything. A request that is not answered in time, or whose process dies, is a
:class:`~vecenv_eval.demos.hdf5.DemoError` that names the file, and the next request starts another process.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from vecenv.assets import AssetsMissing
from vecenv_eval.demos.hdf5 import DemoError

# Seconds for one request, and for the start of the process, whose imports may come over a slow network.
DEADLINE_S, START_S = 60.0, 300.0
# Bytes of an answer.
_MOST_BYTES = 1 << 30


@dataclass(frozen=True)
class Answer:
    """What the reading process answered.

    Attributes:
        content: plain values.
        arrays: what the plain values refer to by position.
    """

    content: dict[str, Any]
    arrays: tuple[np.ndarray, ...]


class Reader:
    """A process that reads HDF5 files; it is started when it is first asked, and ends with this one."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._owner = os.getpid()
        self._lock = threading.Lock()

    def ask(self, path: Path, what: str, deadline_s: float | None = None, **arguments: Any) -> Answer:
        """Ask the reading process something about a file.

        Args:
            path: the file.
            what: a request that ``vecenv_eval.demos.child`` knows.
            deadline_s: seconds that it may take, `DEADLINE_S` by default.
            **arguments: of the request, ready for JSON.

        Raises:
            DemoError: the file cannot be used, or the process crashed or took too long over it.
            AssetsMissing: files of a simulator are needed for it.
        """
        limit = DEADLINE_S if deadline_s is None else deadline_s
        with self._lock:
            request = {"what": what, "path": str(path.absolute()), "shown": str(path), "seconds": math.ceil(limit) + 5}
            try:
                process = self._start(path)
                assert process.stdin is not None
                assert process.stdout is not None
                until = time.monotonic() + limit
                process.stdin.write(json.dumps(request | arguments).encode() + b"\n")
                process.stdin.flush()
                answer = _receive(process.stdout, until)
            except TimeoutError:
                self._kill()
                raise DemoError(f"{path}: not read within {limit:g} s: it is damaged, or made to take long") from None
            except (OSError, EOFError, ValueError):
                raise DemoError(f"{path}: {_death(self._kill())}") from None
            except BaseException:  # Ctrl-C: what the process would still answer belongs to nobody
                self._kill()
                raise
        if (missing := answer.content.get("missing")) is not None:
            raise AssetsMissing(*missing)
        if (error := answer.content.get("error")) is not None:
            raise DemoError(error)
        return answer

    def close(self) -> None:
        """End the process; the next request starts another one."""
        with self._lock:
            self._kill()

    def _start(self, path: Path) -> subprocess.Popen[bytes]:
        """The process, ready for a request.

        Raises:
            DemoError: it cannot be started, which is not the file's fault.
        """
        if self._owner != os.getpid():  # a fork's answers would mix with its parent's
            self._owner, self._process = os.getpid(), None
        if self._process is None or self._process.poll() is not None:
            environment = {
                **os.environ,
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                "HDF5_PLUGIN_PRELOAD": "::",  # no filter is loaded because a file names it
                **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
            }
            self._process = subprocess.Popen(  # nosec B603 # a module of vecenv, in this Python
                [sys.executable, "-P", "-m", "vecenv_eval.demos.child"],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
            assert self._process.stdout is not None
            try:
                _receive(self._process.stdout, time.monotonic() + START_S)
            except (TimeoutError, EOFError, ValueError):
                raise DemoError(
                    f"{path}: the process that reads HDF5 files does not start (exit status {self._kill()})"
                ) from None
        return self._process

    def _kill(self) -> int:
        """End the process; gives its exit status."""
        process, self._process = self._process, None
        if process is None or self._owner != os.getpid():
            return 0
        try:
            status = process.wait(0.5)  # one that crashed is about to say how
        except subprocess.TimeoutExpired:
            process.kill()
            status = process.wait()
        for pipe in (process.stdin, process.stdout):
            try:
                if pipe is not None:
                    pipe.close()
            except OSError:
                pass
        return status


def _death(status: int) -> str:
    """How a process ended that should have answered."""
    if status >= 0:
        return f"reading it ended the HDF5 library (exit status {status})"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = str(-status)
    return f"reading it crashed the HDF5 library ({name})"


def _receive(stream: IO[bytes], until: float) -> Answer:
    """One answer: a line of JSON, and the bytes of the arrays that it lists.

    Raises:
        TimeoutError: it is not there in time.
        EOFError: the process ended.
        ValueError: it is no answer.
    """
    head = _read(stream, 8, until)
    size = int.from_bytes(head, "big")
    if size > _MOST_BYTES:
        raise ValueError("the answer is too long")
    content = json.loads(_read(stream, size, until))
    arrays = []
    for dtype, shape in content.pop("arrays", ()):
        kind = np.dtype(dtype)
        if kind.hasobject:
            raise ValueError("the answer holds objects")
        count = math.prod(shape) * kind.itemsize
        if not 0 <= count <= _MOST_BYTES:
            raise ValueError("the answer is too long")
        arrays.append(np.frombuffer(_read(stream, count, until), kind).reshape(shape))
    return Answer(content, tuple(arrays))


def _read(stream: IO[bytes], count: int, until: float) -> bytearray:
    """So many bytes from a pipe, at once or not at all."""
    content, handle = bytearray(), stream.fileno()
    while len(content) < count:
        left = until - time.monotonic()
        ready, _, _ = select.select([handle], [], [], max(0.0, left))
        if not ready:
            raise TimeoutError
        if not (piece := os.read(handle, min(count - len(content), 1 << 20))):
            raise EOFError
        content += piece
    return content


def pack(content: dict[str, Any], arrays: Sequence[np.ndarray]) -> bytes:
    """An answer as it is sent, which :meth:`Reader.ask` reads."""
    arrays = [np.ascontiguousarray(array) for array in arrays]
    listed = [[array.dtype.str, array.shape] for array in arrays]
    head = json.dumps({**content, "arrays": listed}).encode()
    return b"".join([len(head).to_bytes(8, "big"), head, *(array.tobytes() for array in arrays)])


READER = Reader()
atexit.register(READER.close)
