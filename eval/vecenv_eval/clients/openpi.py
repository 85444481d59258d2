"""Client of Physical-Intelligence/openpi's policy server, sending what openpi's LIBERO example sends.

Read in openpi 15a9616: ``examples/libero/main.py``, ``src/openpi/serving/websocket_policy_server.py`` and
``packages/openpi-client/``. The server's first message is its metadata; each request is one observation, each answer a
map with ``actions`` [K, 7]; a text message is a traceback.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vecenv_eval.clients.codecs import numpy_msgpack
from vecenv_eval.clients.config import ServerConfig, build
from vecenv_eval.clients.frames import Frames
from vecenv_eval.clients.greeting import GreetedPolicy
from vecenv_eval.clients.images import resize_with_pad
from vecenv_eval.clients.websocket import Exchange


@dataclass(frozen=True, kw_only=True)
class OpenPiConfig(ServerConfig):
    """Options of the ``openpi`` policy; the defaults are those of openpi's LIBERO example.

    Attributes:
        replan_steps: actions of each answer that are executed before the server is asked again; 0 for all.
        image_size: side of the images sent, pixels; they are padded to a square. 0 sends them as rendered.
        image_key: name of the third-person image in the request.
        wrist_key: name of the wrist image; empty to send none, as SIMPLER has no wrist camera.
        state_key: name of the proprioception; empty to send none.
        prompt_key: name of the instruction.
    """

    replan_steps: int = 5
    image_size: int = 224
    image_key: str = "observation/image"
    wrist_key: str = "observation/wrist_image"
    state_key: str = "observation/state"
    prompt_key: str = "prompt"


class OpenPiPolicy(GreetedPolicy[OpenPiConfig]):
    """A policy behind openpi's websocket server.

    Args:
        **options: fields of ``OpenPiConfig``.
    """

    name = "openpi"

    def __init__(self, **options: object) -> None:
        super().__init__(build(OpenPiConfig, self.name, options))

    def _cameras(self) -> Sequence[str]:
        return ("agentview", "wrist") if self.config.wrist_key else ("agentview",)

    def _ask(self, frames: Frames) -> Sequence[np.ndarray]:
        return self._in_parallel([partial(self._infer, request) for request in self._requests(frames)])

    def _requests(self, frames: Frames) -> list[dict[str, object]]:
        """One observation a slot, as the LIBERO example builds it."""
        names = dict(zip(self._cameras(), (self.config.image_key, self.config.wrist_key), strict=False))
        images = {key: resize_with_pad(frames.images[name], self.config.image_size) for name, key in names.items()}
        requests = []
        for row, instruction in enumerate(frames.instructions):
            request: dict[str, object] = {key: image[row] for key, image in images.items()}
            if self.config.state_key:
                request[self.config.state_key] = frames.state[row].astype(np.float64)
            requests.append({**request, self.config.prompt_key: instruction})
        return requests

    def _infer(self, request: Mapping[str, object]) -> np.ndarray:
        with self._links.borrowed() as link:
            answer = link.converse(partial(_request, numpy_msgpack.pack(request)))
        if not isinstance(answer, Mapping) or "actions" not in answer:
            raise self._error("its answer has no 'actions'")
        return self._chunk(answer["actions"], self.config.replan_steps)


def _request(message: bytes, exchange: Exchange) -> Any:
    exchange.send(message)
    return numpy_msgpack.unpack(exchange.receive())
