"""Client of StarVLA's websocket policy server, sending what its LIBERO evaluation sends.

Read in starVLA/starVLA 0ed0aad: ``deployment/model_server/tools/websocket_policy_server.py``,
``deployment/model_server/policy_wrapper.py`` and ``examples/simBenchmarks/LIBERO/eval_files/``. Messages are packed as
openpi's; the metadata has ``action_chunk_size``. A request holds ``examples``, one a slot; the answer holds
``data.actions`` [B, T, 7], unnormalized, or ``ok`` false and ``error.message``.
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
from vecenv_eval.clients.images import resize
from vecenv_eval.clients.websocket import Exchange


@dataclass(frozen=True, kw_only=True)
class StarVLAConfig(ServerConfig):
    """Options of the ``starvla`` policy; the defaults are those of StarVLA's LIBERO evaluation.

    Attributes:
        replan_steps: actions of each answer that are executed; 0 for the server's ``action_chunk_size``.
        batch: most slots in one request.
        image_size: side of the images sent, pixels; 0 sends them as rendered.
        wrist: whether the wrist image is sent after the third-person image.
        send_state: whether the proprioception is sent as ``state``, for checkpoints that were trained with it.
        unnorm_key: data set whose statistics unnormalize the actions; empty for the server's own choice.
        use_ddim: passed on to the model.
        num_ddim_steps: passed on to the model.
    """

    port: int = 10093
    gripper: str = "open_above_half"
    replan_steps: int = 0
    batch: int = 1
    image_size: int = 224
    wrist: bool = True
    send_state: bool = False
    unnorm_key: str = ""
    use_ddim: bool = True
    num_ddim_steps: int = 10


class StarVLAPolicy(GreetedPolicy[StarVLAConfig]):
    """A policy behind StarVLA's websocket server.

    Args:
        **options: fields of ``StarVLAConfig``.
    """

    name = "starvla"

    def __init__(self, **options: object) -> None:
        super().__init__(build(StarVLAConfig, self.name, options))

    def _cameras(self) -> Sequence[str]:
        return ("agentview", "wrist") if self.config.wrist else ("agentview",)

    def _ask(self, frames: Frames) -> Sequence[np.ndarray]:
        parts = self._in_parallel([partial(self._predict, part) for part in frames.split(self.config.batch)])
        return [chunk for part in parts for chunk in part]

    def _predict(self, frames: Frames) -> list[np.ndarray]:
        message = numpy_msgpack.pack(self._request(frames))
        with self._links.borrowed() as link:
            answer = link.converse(partial(_exchange, message))
        if not answer.get("ok", True):
            raise self._error(f"it reports an error: {dict(answer.get('error') or {}).get('message', 'no text')}")
        actions = (answer.get("data") or {}).get("actions")
        if actions is None or len(actions) != len(frames):
            raise self._error(f"its answer has no 'actions' for {len(frames)} examples")
        steps = self.config.replan_steps or int(self.metadata.get("action_chunk_size", 0))
        return [self._chunk(chunk, steps) for chunk in actions]

    def _request(self, frames: Frames) -> dict[str, object]:
        images = [resize(frames.images[name], self.config.image_size) for name in self._cameras()]
        examples = []
        for row, instruction in enumerate(frames.instructions):
            example: dict[str, object] = {"image": [image[row] for image in images], "lang": instruction}
            if self.config.send_state:
                example["state"] = frames.state[row : row + 1]
            examples.append(example)
        return {
            "examples": examples,
            "unnorm_key": self.config.unnorm_key or None,
            "do_sample": False,
            "use_ddim": self.config.use_ddim,
            "num_ddim_steps": self.config.num_ddim_steps,
        }


def _exchange(message: bytes, exchange: Exchange) -> Any:
    exchange.send(message)
    answer = numpy_msgpack.unpack(exchange.receive())
    if not isinstance(answer, Mapping):
        raise ValueError(f"the answer is no map but {type(answer).__name__}")
    return answer
