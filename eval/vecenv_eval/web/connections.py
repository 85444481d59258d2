"""How many connections there may be, and how long one may take to say what it wants.

uvicorn counts requests; a client that connects and stays silent, or sends its headers one byte at a time, is none. The
class here closes such connections.
"""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

# Seconds that a connection may take for the headers of its first request.
HEADERS_S = 15.0


def connection_class(most: int) -> type[asyncio.Protocol]:
    """A protocol for uvicorn that closes connections beyond ``most``, and silent ones."""
    is_open: set[Any] = set()

    class Connection(H11Protocol):
        """An HTTP connection that is counted and timed."""

        def connection_made(self, transport: Any) -> None:
            """A client connects."""
            self._silent: asyncio.TimerHandle | None = None
            if len(is_open) >= most:
                transport.abort()
                return
            is_open.add(self)
            super().connection_made(transport)
            self._silent = self.loop.call_later(HEADERS_S, self._give_up)

        def connection_lost(self, exc: Exception | None) -> None:
            """It is gone."""
            if self not in is_open:
                return
            is_open.discard(self)
            self._heard()
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            """Something arrives; once the headers are there, the application's own limits hold."""
            super().data_received(data)
            if self._is_busy():
                self._heard()
            elif self._silent is None and self in is_open:
                self._silent = self.loop.call_later(HEADERS_S, self._give_up)

        def handle_websocket_upgrade(self, event: h11.Request) -> None:
            """From here on it is a WebSocket, which the application counts."""
            is_open.discard(self)
            self._heard()
            super().handle_websocket_upgrade(event)

        def _is_busy(self) -> bool:
            return self.cycle is not None and not self.cycle.response_complete

        def _heard(self) -> None:
            if self._silent is not None:
                self._silent.cancel()
                self._silent = None

        def _give_up(self) -> None:
            self._silent = None
            if not self._is_busy() and not self.transport.is_closing():
                self.transport.close()

    return Connection
