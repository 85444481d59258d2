"""A policy behind openpi's websocket protocol, as ``src/openpi/serving/websocket_policy_server.py`` (15a9616) has it.

The first message is the metadata; each request is an observation, each answer a map with ``actions`` and
``server_timing``. When the policy fails, the traceback is sent as text and the connection closed with code 1011.
"""

from __future__ import annotations

import asyncio
import time
import traceback
from collections.abc import Mapping

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from vecenv_eval.clients.codecs import numpy_msgpack
from vecenv_eval.serving.websocket import WebSocketServer


class OpenPiServer(WebSocketServer):
    """Serves a policy to openpi's clients."""

    health: Mapping[str, str] = {"/healthz": "OK\n"}

    async def talk(self, connection: ServerConnection) -> None:
        """Metadata, then an answer to each observation."""
        await connection.send(numpy_msgpack.pack(dict(self._served.metadata)))
        while True:
            message = await connection.recv()
            try:
                answer = await self._infer(message)
            except ConnectionClosed:
                raise
            except Exception:  # whatever the policy raises is told to the client
                await connection.send(traceback.format_exc())
                reason = "Internal server error. Traceback included in previous frame."
                await connection.close(CloseCode.INTERNAL_ERROR, reason)
                return
            await connection.send(answer)

    async def _infer(self, message: str | bytes) -> bytes:
        if isinstance(message, str):
            raise TypeError("expected a binary message with an observation")
        started = time.monotonic()
        actions = await asyncio.wrap_future(self._batcher.act(numpy_msgpack.unpack(message)))
        timing = {"infer_ms": (time.monotonic() - started) * 1000}
        return numpy_msgpack.pack({"actions": actions, "server_timing": timing})
