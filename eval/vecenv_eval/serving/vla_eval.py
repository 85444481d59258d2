"""A policy behind vla-evaluation-harness's protocol, as ``src/vla_eval/model_servers/serve.py`` (e1ee9ad) has it.

The harness executes one action an observation, so chunks are kept here, a queue for each connection, which begins anew
with each episode. When the policy fails, an error message is sent and the connection stays open.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
from collections import deque
from collections.abc import Mapping

import numpy as np
from websockets.asyncio.server import ServerConnection

from vecenv_eval.clients.codecs import vla_eval as codec
from vecenv_eval.serving.websocket import WebSocketServer


class VlaEvalServer(WebSocketServer):
    """Serves a policy to vla-evaluation-harness.

    What it asks of the benchmark in its hello is the policy's attribute ``observation_params``; without one it asks for
    the wrist image and the state.
    """

    health: Mapping[str, str] = {"/health": '{"status": "ok"}\n'}

    async def talk(self, connection: ServerConnection) -> None:
        """Answer each message."""
        queue: deque[np.ndarray] = deque()
        async for data in connection:
            message = codec.unpack(data if isinstance(data, bytes) else data.encode())
            try:
                answer = await self._answer(message, queue)
            except Exception as error:  # whatever the policy raises is told to the client
                what = "episode_start" if message.kind == codec.EPISODE_START else "observation"
                payload = {"error": f"{what}_failed: {type(error).__name__}: {error}"}
                answer = codec.Message(codec.ERROR, payload, message.seq)
            if answer is not None:
                await connection.send(codec.pack(answer))

    async def _answer(self, message: codec.Message, queue: deque[np.ndarray]) -> codec.Message | None:
        if message.kind == codec.HELLO:
            return codec.Message(codec.HELLO, self._hello(), message.seq)
        if message.kind == codec.EPISODE_START:
            queue.clear()
            await asyncio.wrap_future(self._batcher.reset())
        elif message.kind == codec.OBSERVATION:
            if not queue:
                queue.extend(await asyncio.wrap_future(self._batcher.act(message.payload)))
            return codec.Message(codec.ACTION, {"actions": np.float32(queue.popleft())}, message.seq)
        return None

    def _hello(self) -> dict[str, object]:
        wanted = {"send_wrist_image": True, "send_state": True}
        return {
            "harness_version": f"vecenv {importlib.metadata.version('vecenv')}",
            "protocol_version": codec.PROTOCOL_VERSION,
            "model_server": type(self._served.policy).__name__,
            "capabilities": {},
            "observation_params": dict(getattr(self._served.policy, "observation_params", wanted)),
        }
