"""SIGTERM, with which schedulers and containers end a process, treated as Ctrl-C: what runs is ended in order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

# Exit statuses as shells have them: 128 and the number of the signal.
INTERRUPTED, TERMINATED = 130, 143


class Terminated(KeyboardInterrupt):
    """SIGTERM came."""


@dataclass
class Stop:
    """How a command is stopped.

    Attributes:
        status: its exit status if it is.
    """

    status: int = INTERRUPTED


@contextmanager
def stopping() -> Iterator[Stop]:
    """Inside the context, SIGTERM raises `Terminated` in the main thread, unless it is handled or ignored already."""
    stop = Stop()

    def terminate(number: int, frame: FrameType | None) -> None:
        stop.status = TERMINATED
        raise Terminated("SIGTERM")

    usual = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or usual is not signal.SIG_DFL:
        yield stop
        return
    signal.signal(signal.SIGTERM, terminate)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGTERM, usual)
