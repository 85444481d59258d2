"""Readers of a server's stream: a real connection, and what comes over it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from typing import Any

from vecenv_eval.web.server import Server
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.sync.connection import Connection


def opened(server: Server, headers: Mapping[str, str] | None = None) -> Connection:
    """A connection to the stream."""
    return opened_at(server.url, headers)


def opened_at(address: str, headers: Mapping[str, str] | None = None) -> Connection:
    """A connection to the stream of the server at an address."""
    url = f"{address.replace('http', 'ws', 1)}/api/stream"
    return connect(url, additional_headers=dict(headers or {}), max_size=None, compression=None, close_timeout=1)


def status(server: Server, headers: Mapping[str, str] | None = None) -> int:
    """The HTTP status that a connection gets, 101 when it is accepted."""
    try:
        with closing(opened(server, headers)):
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def subscribe(stream: Connection, **wanted: Any) -> None:
    """Say what to show."""
    stream.send(json.dumps({"subscribe": wanted}))


def read(message: str | bytes) -> tuple[dict[str, Any], bytes]:
    """A message as its header and what follows it."""
    if isinstance(message, str):
        return json.loads(message), b""
    length = int.from_bytes(message[:4], "little")
    return json.loads(message[4 : 4 + length]), message[4 + length :]


def until(stream: Connection, fits: Callable[[dict[str, Any]], bool], seconds: float = 20.0) -> dict[str, Any]:
    """The header of the first message that fits."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            header, _ = read(stream.recv(timeout=end - time.monotonic()))
        except TimeoutError:
            break
        if fits(header):
            return header
    raise AssertionError("no such message came")


def closed(stream: Connection) -> int | None:
    """The code that the server closes a connection with; what comes before is read and dropped."""
    try:
        while True:
            stream.recv(timeout=20)
    except ConnectionClosed as error:
        return None if error.rcvd is None else error.rcvd.code
