"""One job for each slot, side by side where the slots wait for a language model.

Functions come in, one a slot; all have returned when :meth:`Turns.run` does. One of them runs at a time, so they may
share what is not made for threads, and nothing depends on their order; inside :meth:`Turns.aside`, where a job waits
for the model, others go on.
"""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Iterator, Sequence

from voxposer.sandbox.guard import HostFault


class TurnsOver(HostFault):
    """Another job has failed: this one is not to go on."""


class Turns:
    """Runs jobs in threads that take turns.

    Args:
        most: jobs that may be under way at once; 1 runs them in the caller's thread, one after the other.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._turn = threading.Lock()
        self._over = threading.Event()

    def run(self, jobs: Sequence[Callable[[], None]]) -> None:
        """Run jobs to their end. What one raises is raised here at once; the others end where they next wait."""
        if self._most == 1 or len(jobs) < 2:
            for job in jobs:
                job()
            return
        self._turn, self._over = threading.Lock(), threading.Event()  # of a run that failed, jobs may still wait
        waiting: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        ended: queue.SimpleQueue[BaseException | None] = queue.SimpleQueue()
        for job in jobs:
            waiting.put(job)
        for _ in range(min(self._most, len(jobs))):
            # Daemons: a job that waits for a model that never answers does not keep the program from ending.
            threading.Thread(target=_work, args=(waiting, ended, self._turn, self._over), daemon=True).start()
        try:
            for _ in jobs:
                error = ended.get()
                if error is not None:
                    raise error
        finally:
            self._over.set()
            with self._turn:  # whatever still ran now waits, or has ended
                pass

    @contextlib.contextmanager
    def aside(self) -> Iterator[None]:
        """Let other jobs run while this one waits.

        Raises:
            TurnsOver: another job has failed meanwhile.
        """
        turn, over = self._turn, self._over
        if not turn.locked():  # one job at a time, in the caller's thread
            yield
            return
        turn.release()
        try:
            yield
        finally:
            turn.acquire()
            if over.is_set():
                raise TurnsOver("another slot has ended the run")


def _work(
    waiting: queue.SimpleQueue[Callable[[], None]],
    ended: queue.SimpleQueue[BaseException | None],
    turn: threading.Lock,
    over: threading.Event,
) -> None:
    """Run jobs until none is left."""
    while not over.is_set():
        try:
            job = waiting.get_nowait()
        except queue.Empty:
            return
        try:
            with turn:
                if not over.is_set():
                    job()
            ended.put(None)
        except BaseException as error:
            ended.put(error)
