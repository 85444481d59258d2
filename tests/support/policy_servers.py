"""An environment whose slots see different images, and servers on this machine that misbehave as they are told."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any

import numpy as np
from websockets.sync.server import ServerConnection, serve

from support.fakes import FakeEnv
from vecenv.contract import State, Watcher
from vecenv.observations import Egocentric
from vecenv.placement import Placement

SIZE = 64
# Nothing in these tests waits longer than it must; a failing one ends all the same.
QUICK = {"attempts": 3, "first_wait_s": 0.001, "longest_wait_s": 0.01, "timeout_s": 20, "connect_timeout_s": 20}


class SeeingEnv(FakeEnv):
    """``FakeEnv`` with cameras: the image of a slot is of one colour, its number, plus the tick in the wrist image."""

    suite = "fake_suite"
    config, control_hz = None, 20.0

    def state(self) -> State:
        raise NotImplementedError

    def set_state(self, state: State) -> None:
        raise NotImplementedError

    def watched(self, watcher: Watcher) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    @property
    def done(self) -> np.ndarray:
        return self.terminated | self.truncated

    @property
    def placement(self) -> Placement:
        return Placement(self.tasks, self.episodes)

    def observe_egocentric(self, slots: Any = None) -> Egocentric:
        slots = np.arange(self.num_envs, dtype=np.uint8)
        shape = (self.num_envs, SIZE, SIZE, 3)
        agentview = np.broadcast_to(slots[:, None, None, None], shape).astype(np.uint8)
        wrist = np.broadcast_to(self.ticks[:, None, None, None], shape).astype(np.uint8)
        state = np.tile(np.arange(8, dtype=np.float32) / 10, (self.num_envs, 1)) + slots[:, None]
        return Egocentric(state=state, images={"agentview": agentview, "wrist": wrist})


def chunk(first: float, count: int = 10) -> np.ndarray:
    """A chunk [count, 7] whose k-th action is ``first + k / 100`` throughout."""
    return np.repeat(first + np.arange(count)[:, None] / 100, 7, axis=1)


@dataclass
class WebSocketHost:
    """A websocket server with a handler of the test's.

    Attributes:
        handle: called with each connection and its number, counted from 0.
        port: where it listens.
        connections: how many connections there have been.
        seen: what handlers put there.
    """

    handle: Callable[[WebSocketHost, ServerConnection, int], None]
    port: int = 0
    connections: int = 0
    seen: list[Any] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def serve_one(self, connection: ServerConnection) -> None:
        with self._lock:
            number, self.connections = self.connections, self.connections + 1
        self.handle(self, connection, number)


@contextlib.contextmanager
def websocket_host(handle: Callable[[WebSocketHost, ServerConnection, int], None]) -> Iterator[WebSocketHost]:
    host = WebSocketHost(handle)
    with serve(host.serve_one, "127.0.0.1", 0, compression=None, max_size=None, close_timeout=1) as server:
        host.port = server.socket.getsockname()[1]
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield host
        finally:
            server.shutdown()
            thread.join()


def messages(connection: ServerConnection) -> Iterator[bytes]:
    """The binary messages of a connection, until it is closed."""
    for message in connection:
        assert isinstance(message, bytes)
        yield message


@contextlib.contextmanager
def running(server: Any) -> Iterator[int]:
    """Run one of ours in a thread; gives its port."""
    ports: SimpleQueue[int] = SimpleQueue()
    thread = threading.Thread(target=server.run, args=(ports.put,), daemon=True)
    thread.start()
    try:
        yield ports.get(timeout=20)
    finally:
        server.stop()
        thread.join(timeout=20)
    assert not thread.is_alive()


def free_port() -> int:
    """A port that nobody listens on."""
    import socket

    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return held.getsockname()[1]
