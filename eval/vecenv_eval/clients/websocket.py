"""One websocket connection to a policy server: it opens when it is needed and again when it is lost.

Proxies are not used and keep-alive pings are off, because servers that compute in their event loop do not answer pings.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import TypeVar

from tenacity import Retrying, retry_if_exception_type, stop_after_attempt, wait_random_exponential

from vecenv.errors import MissingDependency
from vecenv_eval.clients.config import ServerConfig
from vecenv_eval.clients.errors import PolicyServerError, last_line

try:
    from websockets.exceptions import ConnectionClosed, InvalidMessage, WebSocketException
    from websockets.sync.client import ClientConnection, connect
except ImportError as error:
    raise MissingDependency("websockets is not installed: pip install 'vecenv[clients]'") from error

_Answer = TypeVar("_Answer")
# What a new attempt may cure: nobody listens yet, the server went away, or it died during the handshake.
_LOST = (OSError, ConnectionClosed, InvalidMessage)


class Exchange:
    """Messages over an open connection.

    Args:
        connection: the open connection.
        server: protocol and address, for messages.
        timeout_s: seconds to wait for a message.
    """

    def __init__(self, connection: ClientConnection, server: str, timeout_s: float) -> None:
        self._connection, self._server, self._timeout_s = connection, server, timeout_s

    def send(self, message: bytes) -> None:
        """Send a binary message."""
        self._connection.send(message)

    def receive(self) -> bytes:
        """Wait for a binary message.

        Raises:
            PolicyServerError: none came in time, or a text message, with which servers report a traceback.
        """
        try:
            message = self._connection.recv(timeout=self._timeout_s)
        except TimeoutError:
            raise PolicyServerError(self._server, f"no answer within timeout_s={self._timeout_s:g} seconds") from None
        if isinstance(message, str):
            raise PolicyServerError(self._server, f"it reports an error: {last_line(message)}")
        return message


class WebSocketLink:
    """A connection that is opened when it is needed.

    Args:
        config: address, time-outs and retries.
        server: protocol and address, for messages.
        greet: what is said whenever a connection has been opened.

    Attributes:
        opened: how many connections have been opened so far; a change means that the server knows nothing of us.
    """

    def __init__(self, config: ServerConfig, server: str, greet: Callable[[Exchange], None]) -> None:
        self._config, self._server, self._greet = config, server, greet
        self._connection: ClientConnection | None = None
        self._open_connections = ExitStack()
        self.opened = 0

    def converse(self, talk: Callable[[Exchange], _Answer]) -> _Answer:
        """Exchange messages; ``talk`` is called again from its beginning when the connection was lost.

        Raises:
            PolicyServerError: no connection, no answer in time, or an error reported by the server. The connection is
                closed then, so that a late answer is never taken for another one.
        """
        retrying = Retrying(
            stop=stop_after_attempt(self._config.attempts),
            wait=wait_random_exponential(multiplier=self._config.first_wait_s, max=self._config.longest_wait_s),
            retry=retry_if_exception_type(_LOST),
            reraise=True,
        )
        try:
            return retrying(lambda: self._attempt(talk))
        except _LOST as error:
            cause = f"no connection after {self._config.attempts} attempts: {type(error).__name__}: {error}"
            raise PolicyServerError(self._server, cause) from error
        except (WebSocketException, ValueError) as error:
            raise PolicyServerError(self._server, f"{type(error).__name__}: {error}") from error

    def close(self) -> None:
        """Close the connection if it is open."""
        self._connection = None
        self._open_connections.close()

    def _attempt(self, talk: Callable[[Exchange], _Answer]) -> _Answer:
        try:
            if self._connection is None:
                self._connection = self._open()
                self._greet(self._exchange(self._connection))
                self.opened += 1
            return talk(self._exchange(self._connection))
        except BaseException:
            self.close()
            raise

    def _open(self) -> ClientConnection:
        key = self._config.api_key
        opening = connect(
            self._config.websocket_url,
            additional_headers={"Authorization": f"Api-Key {key}"} if key else None,
            compression=None,
            max_size=None,
            open_timeout=self._config.connect_timeout_s,
            close_timeout=1,
            ping_interval=None,
            proxy=None,
        )
        self._open_connections.enter_context(opening)
        return opening

    def _exchange(self, connection: ClientConnection) -> Exchange:
        return Exchange(connection, self._server, self._config.timeout_s)
