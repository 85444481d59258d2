"""The access log: one line a request with method, path, status and time; no query, header or body, so no secret."""

from __future__ import annotations

import logging
import time

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vecenv_eval.web.limits import client_of

log = logging.getLogger("vecenv_eval.web.access")
_LONGEST = 200


class AccessLog:
    """ASGI middleware that writes the log.

    Args:
        app: whose requests are logged.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Log a request when it was answered."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        began, status = time.perf_counter(), "-"

        async def note(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = str(message["status"])
            elif message["type"] in ("websocket.accept", "websocket.close"):
                status = message["type"].partition(".")[2]
            await send(message)

        try:
            await self._app(scope, receive, note)
        finally:
            milliseconds = (time.perf_counter() - began) * 1000
            method = scope.get("method", "WS")
            # repr: a path may hold line breaks, which would forge lines.
            path = repr(scope["path"][:_LONGEST])
            log.info("%s %s %s %s %.1f ms", client_of(scope), method, path, status, milliseconds)
