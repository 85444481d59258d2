"""A policy behind Isaac-GR00T's ZMQ protocol, as ``gr00t/policy/server_client.py`` (38624df) has it.

A request holds many slots; the policy gets one observation a slot, by the request's own names and without the batch
axis. Answers are packed as the request is: N1.5's plain map of actions, or N1.6's and N1.7's pair of actions and info.
Errors are the map ``{"error": text}``. The endpoint ``kill`` is not offered.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import wait
from typing import Any

import numpy as np

from vecenv.errors import InvalidInput, MissingDependency
from vecenv_eval.clients.codecs import gr00t as codec
from vecenv_eval.clients.gr00t import ACTION_KEYS
from vecenv_eval.serving.batcher import Batcher
from vecenv_eval.serving.policy import Observation, Served

try:
    import zmq
except ImportError as error:
    raise MissingDependency("pyzmq is not installed: pip install 'vecenv[clients]'") from error

# Milliseconds between looks at whether the server was stopped.
_POLL_MS = 100


class Gr00tServer:
    """Serves a policy to GR00T's clients until it is stopped.

    Args:
        served: the policy.
        host: address to listen on.
        port: TCP port; 0 for any that is free.
    """

    scheme = "tcp"

    def __init__(self, served: Served, host: str = "127.0.0.1", port: int = 5555) -> None:
        self._served, self._host, self._port = served, host, port
        self._batcher = Batcher(served)
        self._stopped = False

    def run(self, ready: Callable[[int], None] = lambda port: None) -> None:
        """Serve until ``stop`` is called; ``ready`` is called with the port once connections are accepted."""
        context = zmq.Context()
        socket = context.socket(zmq.REP)
        try:
            socket.bind(f"tcp://{self._host}:{self._port or '*'}")
            endpoint = socket.getsockopt_string(zmq.LAST_ENDPOINT)
            ready(int(endpoint.rpartition(":")[2]))
            with self._batcher:
                while not self._stopped:
                    if socket.poll(_POLL_MS):
                        socket.send(self._answer(socket.recv()))
        finally:
            context.destroy(linger=0)

    def stop(self) -> None:
        """End ``run``; may be called from any thread."""
        self._stopped = True

    def _answer(self, message: bytes) -> bytes:
        release = codec.N1_6
        try:
            request, release = codec.unpack_with_release(message)
            return codec.pack(self._endpoint(request), release)
        except Exception as error:  # a REP socket must answer, and whatever the policy raises is told to the client
            return codec.pack({"error": str(error) or type(error).__name__}, release)

    def _endpoint(self, request: Mapping[str, Any]) -> object:
        name = request.get("endpoint", "get_action")
        if name == "ping":
            return {"status": "ok", "message": "Server is running"}
        if name == "get_modality_config":
            return {}
        if name == "reset":
            self._batcher.reset().result()
            return {}
        if name == "get_action":
            data = request["data"]
            wrapped = "observation" in data
            actions = self._act(data["observation"] if wrapped else data)
            return [actions, {}] if wrapped else actions
        raise InvalidInput(f"Unknown endpoint: {name}")

    def _act(self, observation: Observation) -> dict[str, np.ndarray]:
        """Actions by GR00T's names, [B, T, 1] each."""
        slots = split(observation)
        futures = [self._batcher.act(slot) for slot in slots]
        wait(futures)
        actions = np.stack([future.result() for future in futures]).astype(np.float32)
        if actions.shape[2] != len(ACTION_KEYS):
            raise InvalidInput(f"the policy answered {actions.shape[2]} numbers an action, not {len(ACTION_KEYS)}")
        prefix = "" if "video" in observation else "action."
        return {f"{prefix}{key}": actions[:, :, column, None] for column, key in enumerate(ACTION_KEYS)}


def split(observation: Observation) -> list[dict[str, Any]]:
    """A request of B slots as B observations without the batch axis; maps within it are split likewise."""
    if not observation:
        raise InvalidInput("the observation is empty")
    parts = {key: split(value) if isinstance(value, Mapping) else list(value) for key, value in observation.items()}
    counts = {key: len(part) for key, part in parts.items()}
    if len(set(counts.values())) != 1:
        raise InvalidInput(f"the parts of the observation have different batch sizes: {counts}")
    return [dict(zip(parts, values, strict=True)) for values in zip(*parts.values(), strict=True)]
