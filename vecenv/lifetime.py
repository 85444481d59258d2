"""A running simulator serves the process that made it, until it is closed, and is never copied."""

from __future__ import annotations

import os
from abc import ABC
from typing import ClassVar, NoReturn, Self, SupportsIndex


class Closeable(ABC):
    """A context manager that holds a running simulator; it refuses other processes, pickling and copying."""

    # Raised by calls that are not possible in the present state.
    _error: ClassVar[type[ValueError]]

    def __init__(self) -> None:
        self._closed = False
        self._process = os.getpid()

    def close(self) -> None:
        """Release the simulator; closing twice is harmless."""
        self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise self._error(
            f"{type(self).__name__} cannot be pickled or copied: it holds a running simulator. Send a function that "
            "makes one, such as functools.partial(vecenv.make, suite, tasks=..., episodes=...), and call it in the "
            "process that uses it; to save the physics use state() and set_state()"
        )

    def _check_open(self) -> None:
        if self._closed:
            raise self._error("the environment is closed")
        if os.getpid() != self._process:
            raise self._error(
                f"the environment was made in process {self._process} and this is process {os.getpid()}: its threads "
                "and renderer do not survive a fork. Call vecenv.make in the process that uses it, or start processes "
                "with multiprocessing.get_context('spawn')"
            )
