"""One ZMQ REQ socket to a policy server: it is made when it is needed and again when the connection is lost.

ZMQ reconnects by itself but loses the request that was under way; the socket's monitor tells when that happens.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from tenacity import Retrying, retry_if_exception_type, stop_after_attempt, wait_random_exponential

from vecenv.errors import MissingDependency
from vecenv_eval.clients.config import ServerConfig
from vecenv_eval.clients.errors import PolicyServerError

try:
    import zmq
except ImportError as error:
    raise MissingDependency("pyzmq is not installed: pip install 'vecenv[clients]'") from error

_Answer = TypeVar("_Answer")
_LOST_EVENTS = zmq.EVENT_DISCONNECTED | zmq.EVENT_CLOSED | zmq.EVENT_CONNECT_RETRIED


class ConnectionLost(ConnectionError):
    """The server is not there, or went away before it answered."""


class ZmqLink:
    """A REQ socket that is made when it is needed.

    Args:
        config: address, time-outs and retries.
        server: protocol and address, for messages.
        greet: called with ``request`` and the socket new, before anything else is sent.
    """

    def __init__(self, config: ServerConfig, server: str, greet: Callable[[Callable[[bytes], bytes]], None]) -> None:
        self._config, self._server, self._greet = config, server, greet
        self._socket: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None

    def request(self, message: bytes) -> bytes:
        """Send a request and wait for its answer; it is sent again when the connection was lost.

        Raises:
            PolicyServerError: no connection, or no answer in time.
        """
        retrying = Retrying(
            stop=stop_after_attempt(self._config.attempts),
            wait=wait_random_exponential(multiplier=self._config.first_wait_s, max=self._config.longest_wait_s),
            retry=retry_if_exception_type(ConnectionLost),
            reraise=True,
        )
        try:
            return retrying(lambda: self._attempt(message))
        except ConnectionLost as error:
            cause = f"no connection after {self._config.attempts} attempts: {error}"
            raise PolicyServerError(self._server, cause) from error
        except zmq.ZMQError as error:
            raise PolicyServerError(self._server, f"ZMQError: {error}") from error

    def close(self) -> None:
        """Close the socket if there is one."""
        socket, self._socket, self._monitor = self._socket, None, None
        if socket is not None:
            socket.disable_monitor()
            socket.close(linger=0)

    def _attempt(self, message: bytes) -> bytes:
        try:
            if self._socket is None:
                self._open()
                self._greet(self._exchange)
            return self._exchange(message)
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        socket = zmq.Context.instance().socket(zmq.REQ)
        self._socket, self._monitor = socket, socket.get_monitor_socket(_LOST_EVENTS)
        socket.setsockopt(zmq.CONNECT_TIMEOUT, round(self._config.connect_timeout_s * 1000))
        socket.connect(f"tcp://{self._config.address}")

    def _exchange(self, message: bytes) -> bytes:
        assert self._socket is not None
        assert self._monitor is not None
        self._socket.send(message)
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._monitor, zmq.POLLIN)
        ready = dict(poller.poll(round(self._config.timeout_s * 1000)))
        if self._socket in ready:
            return self._socket.recv()
        if ready:
            raise ConnectionLost("the connection was refused or lost")
        timeout = f"no answer within timeout_s={self._config.timeout_s:g} seconds"
        raise PolicyServerError(self._server, timeout)
