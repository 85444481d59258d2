"""One writer an environment: who may change it is the client that asked first, until it lets go or falls silent."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Annotated

from fastapi import Header

from vecenv_eval.web.errors import Refused

# The header that names a client; any text of its own making, a UUID for example.
WriterName = Annotated[
    str | None,
    Header(
        alias="X-Writer", min_length=8, max_length=64, pattern=r"^[A-Za-z0-9_-]+$", description="Name of the client"
    ),
]


class Writers:
    """Who holds which environment.

    Args:
        timeout_s: seconds of silence after which a client loses what it holds.
        clock: seconds.
    """

    def __init__(self, timeout_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._timeout_s, self._clock = timeout_s, clock
        self._lock = threading.Lock()
        self._held: dict[str, tuple[str, float]] = {}

    def claim(self, what: str, name: str | None) -> None:
        """Be the writer of an environment from now on.

        Args:
            what: the environment.
            name: the client's ``X-Writer``.

        Raises:
            Refused: 400 without a name, 409 while another client holds it.
        """
        if name is None:
            raise Refused(400, "a request that changes something needs the header X-Writer: <uuid>", "X-Writer")
        with self._lock:
            holder = self._holder(what)
            if holder not in (None, name):
                left = self._timeout_s - (self._clock() - self._held[what][1])
                raise Refused(
                    409,
                    f"another client drives this: try again when it has let go, or after {max(1, round(left))} s of "
                    "its silence",
                    "X-Writer",
                )
            self._held[what] = (name, self._clock())

    def touch(self, name: str | None) -> None:
        """A client has shown itself: what it holds stays its own. Nothing comes of None, a client without a name."""
        if name is None:
            return
        with self._lock:
            for what in [each for each in tuple(self._held) if self._holder(each) == name]:
                self._held[what] = (self._held[what][0], self._clock())

    def release(self, name: str | None) -> None:
        """A client lets go of everything that it holds."""
        with self._lock:
            self._held = {what: held for what, held in self._held.items() if held[0] != name}

    def holds(self, what: str, name: str | None) -> bool:
        """Whether a client holds an environment."""
        with self._lock:
            return name is not None and self._holder(what) == name

    def is_held(self, what: str) -> bool:
        """Whether any client does."""
        with self._lock:
            return self._holder(what) is not None

    def _holder(self, what: str) -> str | None:
        held = self._held.get(what)
        if held is None or self._clock() - held[1] > self._timeout_s:
            self._held.pop(what, None)
            return None
        return held[0]
