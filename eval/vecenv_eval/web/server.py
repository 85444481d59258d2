"""Runs an application: on an address until it is stopped, or in a thread for as long as a ``with`` block lasts.

Port 0 takes a free one; :attr:`Server.url` has it.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import uvicorn
from fastapi import FastAPI

from vecenv.errors import ServiceError
from vecenv_eval.web.connections import connection_class
from vecenv_eval.web.context import Context
from vecenv_eval.web.settings import ServeSettings

# Seconds that open requests are given when the server stops.
_GRACE_S = 3


class ServerError(ServiceError):
    """The server cannot listen, or did not start."""


class _Uvicorn(uvicorn.Server):
    """Says that it is to stop when it is told to, so that nothing waits for a run that will not go on."""

    def __init__(self, config: uvicorn.Config, on_exit: Callable[[], None]) -> None:
        super().__init__(config)
        self._on_exit = on_exit

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """SIGINT or SIGTERM has come."""
        self._on_exit()
        super().handle_exit(sig, frame)


class Server:
    """An application on an address.

    Args:
        app: the application, as ``app.create_app`` makes it.
        port: TCP port; 0 for a free one.

    Attributes:
        port: the port that it listens on.

    Raises:
        ServerError: it cannot listen there.
    """

    def __init__(self, app: FastAPI, port: int = 0) -> None:
        settings: ServeSettings = app.state.context.settings
        self._host = settings.host
        self._socket = _listen(settings.host, port)
        self.port: int = self._socket.getsockname()[1]
        context: Context = app.state.context
        self._context = context
        self._server = _Uvicorn(
            uvicorn.Config(
                app,
                http=connection_class(settings.max_connections),
                ws="websockets-sansio",
                ws_max_size=4 * settings.max_message,
                ws_max_queue=4,
                ws_per_message_deflate=False,  # images are compressed already
                access_log=False,  # web.access has one without queries
                log_config=None,
                log_level="warning",
                server_header=False,
                proxy_headers=False,
                timeout_graceful_shutdown=_GRACE_S,
                timeout_keep_alive=15,
            ),
            context.shut,
        )

    @property
    def url(self) -> str:
        """Where it is: ``"http://127.0.0.1:8000"``."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{host}:{self.port}"

    @property
    def streams(self) -> int:
        """Readers of the stream that are connected."""
        return self._context.streams

    def run(self) -> None:
        """Serve until SIGINT or SIGTERM, in the main thread."""
        try:
            self._server.run(sockets=[self._socket])
        finally:
            self._socket.close()

    def on_start(self, on_start: Callable[[], None]) -> None:
        """Call a function once requests are answered."""

        def wait() -> None:
            while not self._server.started and not self._server.should_exit:
                time.sleep(0.02)
            if self._server.started:
                on_start()

        threading.Thread(target=wait, daemon=True, name="vecenv-started").start()

    def stop(self) -> None:
        """Have :meth:`run` return."""
        self._server.should_exit = True


@contextmanager
def running(app: FastAPI, port: int = 0) -> Iterator[Server]:
    """Serve in a thread while inside, for tests and notebooks.

    Raises:
        ServerError: it cannot listen, or did not start.
    """
    server = Server(app, port)
    started = threading.Event()
    server.on_start(started.set)
    thread = threading.Thread(target=server.run, name="vecenv-server", daemon=True)
    thread.start()
    try:
        if not started.wait(20):
            raise ServerError("the server did not start within 20 s")
        yield server
    finally:
        server.stop()
        thread.join(20)


def _listen(host: str, port: int) -> socket.socket:
    """A listening socket."""
    name = host.strip("[]")
    try:
        family, kind, proto, _, address = socket.getaddrinfo(name, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, proto)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(512)
    except (OSError, OverflowError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ServerError(f"cannot listen on {host}:{port}: {reason}") from None
    return listening
