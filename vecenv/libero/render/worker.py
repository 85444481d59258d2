"""A thread that runs calls one after the other: a GL context may be used by one thread only."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future

# A future, a function and its arguments.
_Call = tuple[Future[object], Callable[..., object], tuple[object, ...]]


class Worker:
    """A thread that runs calls until it is stopped.

    Args:
        name: of the thread.
        at_end: what it calls last.
    """

    def __init__(self, name: str, at_end: Callable[[], object]) -> None:
        self._at_end = at_end
        self._calls: queue.SimpleQueue[_Call | None] = queue.SimpleQueue()
        # A daemon thread: at exit, Python waits for other threads before a renderer can be closed.
        self._thread = threading.Thread(target=self._loop, name=name, daemon=True)
        self._thread.start()

    def run(self, call: Callable[..., object], *arguments: object) -> Future[object]:
        """Call in this thread."""
        future: Future[object] = Future()
        self._calls.put((future, call, arguments))
        return future

    def stop(self) -> None:
        """End the thread after the calls that it has got."""
        self._calls.put(None)
        self._thread.join()

    def _loop(self) -> None:
        while (call := self._calls.get()) is not None:
            _answer(*call)
        self._at_end()


def _answer(future: Future[object], call: Callable[..., object], arguments: Iterable[object]) -> None:
    try:
        future.set_result(call(*arguments))
    except BaseException as error:
        future.set_exception(error)
