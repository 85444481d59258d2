"""The one thread that a simulator lives on.

MuJoCo's GL contexts and SAPIEN's scenes belong to the thread that made them. A :class:`Worker` has a single thread and
runs every call on it, one after the other, whichever thread asks; it is also how tools take turns.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from vecenv.interop.nodes.ports import NodeError

_Result = TypeVar("_Result")


class Worker:
    """Runs calls on a thread of its own; it starts with the first call.

    Args:
        name: of the thread.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._lock = threading.Lock()
        self._executor: ThreadPoolExecutor | None = None
        self._thread, self._process = 0, 0
        self._closed = False

    @property
    def thread(self) -> int:
        """Identifier of the thread (``threading.get_ident``), 0 before the first call."""
        return self._thread

    def submit(self, job: Callable[[], _Result]) -> Future[_Result]:
        """Run a job on the thread; on the thread itself, at once.

        Raises:
            NodeError: it was shut down, or this process is a fork of the one that the thread is in.
        """
        if threading.get_ident() == self._thread:
            done: Future[_Result] = Future()
            done.set_result(job())
            return done
        with self._lock:
            return self._started().submit(job)

    def call(self, job: Callable[[], _Result]) -> _Result:
        """Run a job on the thread and wait for its result; what it raises is raised here."""
        return self.submit(job).result()

    def open(self) -> None:
        """Allow calls again after :meth:`shutdown`."""
        with self._lock:
            self._closed = False

    def shutdown(self, last: Callable[[], object]) -> None:
        """Run a last job on the thread, if it ever started, and end it. A second call does nothing."""
        with self._lock:
            self._closed, executor = True, self._executor
            self._executor = None
            ours = self._process == os.getpid()
        if executor is not None and ours:
            try:
                executor.submit(last).result()
            finally:
                executor.shutdown()
                self._thread = 0

    def _started(self) -> ThreadPoolExecutor:
        if self._closed:
            raise NodeError(f"{self.name} is shut down: call initialize() first")
        if self._executor is None:
            self._process = os.getpid()
            self._executor = ThreadPoolExecutor(1, self.name, initializer=self._note_thread)
        elif self._process != os.getpid():
            raise NodeError(
                f"{self.name} runs on a thread of process {self._process}, and this is its fork {os.getpid()}: "
                "start processes with multiprocessing.get_context('spawn')"
            )
        return self._executor

    def _note_thread(self) -> None:
        self._thread = threading.get_ident()
