"""Limits that keep one client from taking the server away from the others: rates, sizes, depth, and time.

``Limits`` wraps the application. A body is read whole before the application runs, up to its limit and within a time
limit, and JSON that is nested too deeply is refused before it is parsed.
"""

from __future__ import annotations

import asyncio
import json
import re
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vecenv_eval.web.errors import error_body
from vecenv_eval.web.settings import ServeSettings

# Addresses that are counted at once; of more, those that were silent longest are forgotten.
_MOST_CLIENTS = 10_000
# Seconds that a client may take to send a body.
_BODY_TIMEOUT_S = 20.0
_NODES = "/api/nodes/"
# Requests that a client may send at once, as seconds of its average.
_BURST_S = 10.0
# A string of a JSON text, which need not end.
_STRING = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+"?', re.DOTALL)


@dataclass(frozen=True)
class Refusal:
    """Why a request is not answered: status, sentence, and further headers."""

    status: int
    sentence: str
    headers: tuple[tuple[str, str], ...] = ()


class Buckets:
    """A token bucket for each client.

    Args:
        rate: tokens a second that a bucket gains.
        burst: tokens that it holds at most, and at first.
        clock: seconds.
    """

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate, self._burst, self._clock = rate, burst, clock
        self._lock = threading.Lock()
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, client: str) -> bool:
        """Take a token; False when there is none."""
        with self._lock:
            left = self._now(client)
            self._left[client] = (max(0.0, left - 1.0) if left >= 1.0 else left, self._clock())
            self._left.move_to_end(client)
            while len(self._left) > _MOST_CLIENTS:
                self._left.popitem(last=False)
            return left >= 1.0

    def has_left(self, client: str) -> bool:
        """Whether there is a token, which stays."""
        with self._lock:
            return self._now(client) >= 1.0

    def _now(self, client: str) -> float:
        left, when = self._left.get(client, (self._burst, self._clock()))
        return min(self._burst, left + (self._clock() - when) * self._rate)


class Limits:
    """ASGI middleware: rate, size, depth and duration of requests.

    Args:
        app: what is protected.
        settings: the limits.
    """

    def __init__(self, app: ASGIApp, settings: ServeSettings) -> None:
        self._app, self._settings = app, settings
        self._rates = Buckets(settings.requests_per_second, settings.requests_per_second * _BURST_S)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on with its body read, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if not self._rates.take(client_of(scope)):
            await refuse(scope, receive, send, Refusal(429, "too many requests: slow down", (("retry-after", "1"),)))
            return
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        body = await self._body(scope, receive)
        if isinstance(body, Refusal):
            await refuse(scope, receive, send, body)
        elif body is not None:
            await self._app(scope, _replayed(body, receive), send)

    async def _body(self, scope: Scope, receive: Receive) -> bytes | Refusal | None:
        """The body of a request; None when the client left."""
        most = self._settings.max_node_body if scope["path"].startswith(_NODES) else self._settings.max_body
        too_large = Refusal(413, f"the body is larger than {most} bytes", (("connection", "close"),))
        headers = dict(scope["headers"])
        length = headers.get(b"content-length", b"")
        if length.isdigit() and (len(length) > 18 or int(length) > most):
            return too_large
        try:
            async with asyncio.timeout(_BODY_TIMEOUT_S):
                body = await _read(receive, most)
        except TimeoutError:
            return Refusal(408, f"the body did not arrive within {_BODY_TIMEOUT_S:.0f} s", (("connection", "close"),))
        if body is None or len(body) > most:
            return None if body is None else too_large
        if is_deeper(body, self._settings.max_depth):
            return Refusal(422, f"the body is nested more deeply than {self._settings.max_depth} levels")
        return body


async def _read(receive: Receive, most: int) -> bytes | None:
    """A body, or more than ``most`` bytes of it; None when the client left."""
    parts, size = [], 0
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return None
        parts.append(message.get("body", b""))
        size += len(parts[-1])
        if size > most or not message.get("more_body", False):
            return b"".join(parts)


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Gives a body that was read, then whatever comes."""
    given = False

    async def replay() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replay


def is_deeper(body: bytes, most: int) -> bool:
    """Whether the brackets of a JSON text are nested more deeply than ``most``; what is in strings does not count."""
    if body.count(b"[") + body.count(b"{") <= most:
        return False
    characters = np.frombuffer(_STRING.sub(b"", body), np.uint8)
    opening = (characters == ord("[")) | (characters == ord("{"))
    closing = (characters == ord("]")) | (characters == ord("}"))
    depth = np.cumsum(opening.astype(np.int32) - closing)
    return bool(depth.max(initial=0) > most)


def client_of(scope: Scope) -> str:
    """Whom limits are counted for: the address that a request comes from."""
    client = scope.get("client")
    return str(client[0]) if client else "?"


async def refuse(scope: Scope, receive: Receive, send: Send, refusal: Refusal) -> None:
    """Answer with a refusal; a WebSocket is closed before it was accepted, which its client sees as status 403."""
    if scope["type"] == "websocket":
        await receive()  # "websocket.connect"
        await send({"type": "websocket.close", "code": 1008, "reason": refusal.sentence[:120]})
        return
    body = json.dumps(error_body(refusal.sentence)).encode()
    headers = [("content-type", "application/json"), ("content-length", str(len(body))), *refusal.headers]
    await send(
        {
            "type": "http.response.start",
            "status": refusal.status,
            "headers": [(name.encode(), value.encode()) for name, value in headers],
        }
    )
    await send({"type": "http.response.body", "body": body})
