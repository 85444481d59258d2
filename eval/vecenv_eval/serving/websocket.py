"""A websocket server around a policy: subclasses say what is done with a connection.

Any number of connections is served; the policy runs in a thread of its own (``Batcher``), so pings are answered
meanwhile.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
from collections.abc import Callable, Mapping

from vecenv.errors import MissingDependency
from vecenv_eval.serving.batcher import Batcher
from vecenv_eval.serving.policy import Served

try:
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response
except ImportError as error:
    raise MissingDependency("websockets is not installed: pip install 'vecenv[clients]'") from error


class WebSocketServer:
    """Serves a policy until it is stopped.

    Args:
        served: the policy.
        host: address to listen on.
        port: TCP port; 0 for any that is free.
    """

    scheme = "ws"
    # Path and body of the answer that says that the server is up.
    health: Mapping[str, str] = {}

    def __init__(self, served: Served, host: str = "127.0.0.1", port: int = 8000) -> None:
        self._served, self._host, self._port = served, host, port
        self._batcher = Batcher(served)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stopped = asyncio.Event()

    def run(self, ready: Callable[[int], None] = lambda port: None) -> None:
        """Serve until ``stop`` is called; ``ready`` is called with the port once connections are accepted."""
        asyncio.run(self._run(ready))

    def stop(self) -> None:
        """Close all connections and end ``run``; may be called from any thread, once ``ready`` has been called."""
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._stopped.set)

    async def talk(self, connection: ServerConnection) -> None:
        """Serve one connection until it is closed, which may be by raising ``ConnectionClosed``."""
        raise NotImplementedError

    async def _run(self, ready: Callable[[int], None]) -> None:
        self._loop = asyncio.get_running_loop()
        with self._batcher:
            async with serve(
                self._handle,
                self._host,
                self._port,
                compression=None,
                max_size=None,
                ping_interval=None,
                process_request=self._answer_health,
            ) as server:
                ready(next(iter(server.sockets)).getsockname()[1])
                await self._stopped.wait()

    async def _handle(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            await self.talk(connection)

    def _answer_health(self, connection: ServerConnection, request: Request) -> Response | None:
        body = self.health.get(request.path)
        return None if body is None else connection.respond(http.HTTPStatus.OK, body)
