"""The stream over real connections: what readers get, slow and hostile readers, and the end of the server."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import suppress

import httpx
import numpy as np
import pytest
from support import streams
from support.live_world import LiveWorld, config, session
from vecenv_eval.panel.session import Session
from vecenv_eval.web.app import create_app
from vecenv_eval.web.server import Server, ServerError, running
from vecenv_eval.web.settings import ServeSettings

WRITER = {"X-Writer": "first-client"}


@pytest.fixture
def world() -> LiveWorld:
    return LiveWorld()


@pytest.fixture
def live(world: LiveWorld) -> Iterator[Session]:
    with session(world, config=config(tasks="1", episodes="4", max_steps=1_000_000)) as live:
        live.wait_until("ready", timeout=30)
        yield live


@pytest.fixture
def server(live: Session) -> Iterator[Server]:
    with running(create_app(live)) as server:
        yield server


def test_a_reader_gets_the_state_at_once_and_when_it_changes(server: Server, live: Session) -> None:
    with streams.opened(server) as stream:
        assert streams.until(stream, lambda each: each["type"] == "session")["state"] == "ready"
        live.act("step", 4)
        assert streams.until(stream, lambda each: each.get("tick") == 4)["state"] == "paused"


def test_states_come_at_most_ten_times_a_second(server: Server, live: Session) -> None:
    with streams.opened(server) as stream:
        live.act("play")
        began, count = time.monotonic(), 0
        while time.monotonic() - began < 1.5:
            with suppress(TimeoutError):
                stream.recv(timeout=0.2)
                count += 1
    assert 3 <= count <= 17


def test_a_reader_gets_the_cameras_that_it_wants_and_the_wall(server: Server, live: Session) -> None:
    live.act("step", 2)
    with streams.opened(server) as stream:
        streams.subscribe(stream, slot=3, cameras=["wrist"], size=32, wall=True, fps=30)
        frame = streams.until(stream, lambda each: each["type"] == "frame")
        assert (frame["slot"], frame["camera"], frame["tick"], frame["width"]) == (3, "wrist", 2, 32)
        wall = streams.until(stream, lambda each: each["type"] == "wall")
        assert wall["ticks"] == [2, 2, 2, 2]
        streams.subscribe(stream, slot=1, cameras=["agentview"], size=64)
        assert streams.until(stream, lambda each: each.get("slot") == 1)["camera"] == "agentview"


def test_an_image_that_has_not_changed_is_sent_once(server: Server) -> None:
    with streams.opened(server) as stream:
        streams.subscribe(stream, cameras=["wrist"], fps=60)
        streams.until(stream, lambda each: each["type"] == "frame")
        with pytest.raises(AssertionError, match="no such message"):
            streams.until(stream, lambda each: each["type"] == "frame", seconds=0.5)


def test_readers_of_the_same_view_share_one_drawing(server: Server, world: LiveWorld, live: Session) -> None:
    readers = [streams.opened(server) for _ in range(10)]
    for reader in readers:
        streams.subscribe(reader, slot=2, cameras=["agentview"], size=48)
    for reader in readers:
        streams.until(reader, lambda each: each["type"] == "frame")
        reader.close()
    assert world.last.drawn == [(2, "agentview")]
    assert live.frames.encoded == 1


def test_a_writer_is_told_that_it_is_and_a_reader_that_somebody_is(server: Server) -> None:
    with streams.opened(server) as mine, streams.opened(server) as other:
        mine.send(json.dumps({"writer": WRITER["X-Writer"]}))
        httpx.post(f"{server.url}/api/panel/actions", json={"action": "step"}, headers=WRITER)
        assert streams.until(mine, lambda each: each.get("writer_held", False))["writer"] is True
        assert streams.until(other, lambda each: each.get("writer_held", False))["writer"] is False


@pytest.mark.parametrize(
    "message",
    [
        "",
        "{",
        "[]",
        "null",
        '{"subscribe": {"slot": -1}}',
        '{"subscribe": {"size": 1e9}}',
        '{"subscribe": {"fps": 0}}',
        '{"subscribe": {"cameras": "wrist"}}',
        '{"subscribe": {"cameras": ["a","b","c","d","e","f","g","h","i"]}}',
        '{"play": true}',
        '{"writer": "x"}',
        '{"a":' + "[" * 500,
        "x" * 5000,
        b"\x00\x01",
    ],
)
def test_a_message_that_cannot_be_read_is_answered_and_the_stream_goes_on(server: Server, message: str | bytes) -> None:
    with streams.opened(server) as stream:
        stream.send(message)
        error = streams.until(stream, lambda each: each["type"] == "error")
        assert error["error"]
        streams.subscribe(stream, cameras=["wrist"])
        streams.until(stream, lambda each: each["type"] == "frame")


def test_a_slot_or_camera_that_is_not_there_shows_nothing(server: Server) -> None:
    with streams.opened(server) as stream:
        streams.subscribe(stream, slot=999, cameras=["agentview"])
        streams.subscribe(stream, slot=0, cameras=["no_such_camera"])
        with pytest.raises(AssertionError, match="no such message"):
            streams.until(stream, lambda each: each["type"] == "frame", seconds=0.4)


def test_who_sends_too_much_is_disconnected_and_a_message_that_is_too_large_ends_its_stream(server: Server) -> None:
    with streams.opened(server) as stream:
        for _ in range(60):
            stream.send("[]")
        assert streams.closed(stream) == 1008
    with streams.opened(server) as stream:
        stream.send("x" * 100_000)
        assert streams.closed(stream) == 1009


def test_there_are_no_more_readers_than_allowed_and_others_are_not_disturbed(live: Session) -> None:
    with running(create_app(live, ServeSettings(max_streams=3))) as server:
        readers = [streams.opened(server) for _ in range(3)]
        assert streams.status(server) == 403
        assert streams.until(readers[0], lambda each: each["type"] == "session")["state"] == "ready"
        readers.pop().close()
        deadline = time.monotonic() + 10
        while streams.status(server) != 101:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        for reader in readers:
            reader.close()


def raw_reader(server: Server, received: int = 4096) -> socket.socket:
    """A connection that has asked for a lot and reads nothing from then on."""
    connection = socket.create_connection(("127.0.0.1", server.port))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, received)
    connection.sendall(
        b"GET /api/stream HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    assert b"101" in connection.recv(64)
    wanted = json.dumps({"subscribe": {"cameras": ["agentview", "wrist"], "wall": True, "fps": 60}}).encode()
    connection.sendall(bytes([0x81, 0x80 | 126]) + len(wanted).to_bytes(2, "big") + b"\0\0\0\0" + wanted)
    return connection


def test_a_reader_that_reads_nothing_holds_up_nobody_and_is_disconnected(world: LiveWorld, live: Session) -> None:
    # Large images soon fill what the system keeps for a connection that is not read, which is megabytes.
    world.last.noise = np.random.default_rng(0).integers(0, 256, (256, 256, 3), np.uint8)
    with running(create_app(live, ServeSettings(send_timeout_s=1.0))) as server:
        slow = [raw_reader(server) for _ in range(5)]
        with streams.opened(server) as stream:
            streams.subscribe(stream, cameras=["agentview"], fps=30)
            live.act("play")
            ticks = [streams.until(stream, lambda each: each["type"] == "frame")["tick"] for _ in range(40)]
            assert ticks == sorted(set(ticks))
            deadline = time.monotonic() + 60
            while server.streams > 1:
                assert time.monotonic() < deadline, "slow readers are still there"
                streams.until(stream, lambda each: each["type"] == "frame")
        for connection in slow:
            connection.close()


def test_a_client_that_vanishes_in_the_middle_of_a_frame_leaves_nothing_behind(server: Server, live: Session) -> None:
    live.act("play")
    for _ in range(20):
        connection = raw_reader(server)
        connection.recv(100)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # reset, not closed
        connection.close()
    deadline = time.monotonic() + 20
    while server.streams:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    with streams.opened(server) as stream:
        streams.subscribe(stream, cameras=["wrist"])
        streams.until(stream, lambda each: each["type"] == "frame")


def test_the_end_of_the_server_ends_its_streams(live: Session) -> None:
    with running(create_app(live)) as server:
        stream = streams.opened(server)
        streams.until(stream, lambda each: each["type"] == "session")
        began = time.monotonic()
    assert time.monotonic() - began < 10
    with stream:
        assert streams.closed(stream) == 1012


def test_an_address_that_is_taken_is_named(server: Server, live: Session) -> None:
    with pytest.raises(ServerError, match=rf"cannot listen on 127.0.0.1:{server.port}: "):
        Server(create_app(live), server.port)


def test_silent_connections_are_closed_and_those_beyond_the_limit_at_once(
    live: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vecenv_eval.web.connections.HEADERS_S", 0.3)
    with running(create_app(live, ServeSettings(max_connections=4))) as server:
        silent = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(4)]
        silent[0].sendall(b"GET /api/hea")
        time.sleep(0.1)
        beyond = socket.create_connection(("127.0.0.1", server.port))
        beyond.settimeout(5)
        with suppress(ConnectionResetError):
            assert beyond.recv(10) == b""
        for connection in silent:
            connection.settimeout(5)
            assert connection.recv(10) == b""
        assert httpx.get(f"{server.url}/api/health").status_code == 200
