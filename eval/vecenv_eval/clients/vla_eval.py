"""Client of vla-evaluation-harness's model servers, sending what its LIBERO benchmark sends.

Read in allenai/vla-evaluation-harness e1ee9ad: ``src/vla_eval/protocol/``, ``src/vla_eval/model_servers/serve.py``,
``src/vla_eval/benchmarks/libero/benchmark.py`` and ``src/vla_eval/runners/sync_runner.py``. A server keeps the state of
an episode (step counter, action chunks) with the connection, so every slot has a connection of its own and asks at each
tick; the server decides when it computes. After a lost connection the episode is announced again.
"""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vecenv.contract import BatchEnv
from vecenv_eval.clients.base import RemotePolicy
from vecenv_eval.clients.codecs import vla_eval as codec
from vecenv_eval.clients.config import ServerConfig, build
from vecenv_eval.clients.errors import PolicyServerError
from vecenv_eval.clients.frames import Frames
from vecenv_eval.clients.images import resize_with_pad
from vecenv_eval.clients.websocket import Exchange, WebSocketLink
from vecenv_eval.policies import PolicyError

_log = logging.getLogger(__name__)
# What a server may ask of upstream's LIBERO benchmark that the evaluation protocol decides here.
_DECIDED_HERE = ("seed", "env_seed", "num_steps_wait", "max_steps")


@dataclass(frozen=True, kw_only=True)
class VlaEvalConfig(ServerConfig):
    """Options of the ``vla-eval`` policy; the defaults are those of the harness's LIBERO benchmark.

    ``connections`` is the number of requests in flight; every slot has a connection of its own besides.

    Attributes:
        image_size: side of the images sent, pixels; they are padded to a square. 0 sends them as rendered.
        image_format: how images travel, ``"png"`` or ``"raw"``.
        send_wrist_image: whether the wrist image is sent; None to do as the server asks in its hello.
        send_state: whether the proprioception is sent as ``states``; None to do as the server asks.
    """

    gripper: str = "sign"
    image_size: int = 256
    image_format: str = "png"
    send_wrist_image: bool | None = None
    send_state: bool | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.image_format not in codec.IMAGE_FORMATS:
            known = ", ".join(codec.IMAGE_FORMATS)
            raise PolicyError(f"image_format={self.image_format!r}: expected one of {known}")


class Session:
    """The conversation about one slot: a connection, numbered messages, and the episode the server knows of.

    Args:
        config: address, time-outs and retries.
        server: protocol and address, for messages.
    """

    def __init__(self, config: VlaEvalConfig, server: str) -> None:
        self._config, self._server = config, server
        self._link = WebSocketLink(config, server, self._greet)
        self._seq = 0
        self._task: Mapping[str, object] = {}
        # The connection on which the episode was announced; 0 for none.
        self._announced = 0
        self.hello: Mapping[str, Any] = {}

    def open(self) -> None:
        """Connect and say hello, if that has not been done."""
        if not self._link.opened:
            self._link.converse(lambda exchange: None)

    def begin(self, task: Mapping[str, object]) -> None:
        """Another episode begins; the server is told with its first observation."""
        self._task, self._announced = task, 0

    def act(self, observation: Mapping[str, object]) -> Mapping[str, Any]:
        """What the server answers to an observation."""
        return self._link.converse(partial(self._act, observation))

    def end(self, result: Mapping[str, object]) -> None:
        """The episode is over; nothing happens when the server does not know of it."""
        if self._announced and self._announced == self._link.opened:
            self._link.converse(lambda exchange: self._send(exchange, codec.EPISODE_END, result))
        self._announced = 0

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def _act(self, observation: Mapping[str, object], exchange: Exchange) -> Mapping[str, Any]:
        if self._announced != self._link.opened:
            self._send(exchange, codec.EPISODE_START, {"task": self._task})
            self._announced = self._link.opened
        seq = self._send(exchange, codec.OBSERVATION, observation)
        message = self._receive(exchange)
        if message.kind != codec.ACTION or message.seq != seq:
            raise PolicyServerError(
                self._server, f"expected the action for message {seq}, got {message.kind} {message.seq}"
            )
        return message.payload

    def _greet(self, exchange: Exchange) -> None:
        version = importlib.metadata.version("vecenv")
        hello = {"harness_version": f"vecenv {version}", "protocol_version": codec.PROTOCOL_VERSION}
        self._send(exchange, codec.HELLO, hello)
        answer = self._receive(exchange)
        theirs = answer.payload.get("protocol_version")
        if answer.kind != codec.HELLO or theirs != codec.PROTOCOL_VERSION:
            raise PolicyServerError(
                self._server, f"it speaks protocol {theirs!r} ({answer.kind}), not {codec.PROTOCOL_VERSION}"
            )
        self.hello = answer.payload

    def _send(self, exchange: Exchange, kind: str, payload: Mapping[str, object]) -> int:
        self._seq += 1
        exchange.send(codec.pack(codec.Message(kind, payload, self._seq), self._config.image_format))
        return self._seq

    def _receive(self, exchange: Exchange) -> codec.Message:
        message = codec.unpack(exchange.receive())
        if message.kind == codec.ERROR:
            cause = message.payload.get("error", dict(message.payload))
            raise PolicyServerError(self._server, f"it reports an error: {cause}")
        return message


class VlaEvalPolicy(RemotePolicy[VlaEvalConfig]):
    """A policy behind one of vla-evaluation-harness's model servers.

    Args:
        **options: fields of ``VlaEvalConfig``.
    """

    name = "vla-eval"

    def __init__(self, **options: object) -> None:
        super().__init__(build(VlaEvalConfig, self.name, options))
        self._sessions: list[Session] = []
        self._running: set[int] = set()
        self._wrist = self._state = False
        self._robosuite_rotation = False

    def close(self) -> None:
        """Close the connections; the next call opens them again."""
        for session in self._sessions:
            session.close()

    def _begin_batch(self, env: BatchEnv) -> None:
        for slot in sorted(self._running):
            self._sessions[slot].end({})
        self._running.clear()
        for session in self._sessions[env.num_envs :]:
            session.close()
        missing = env.num_envs - len(self._sessions)
        new = [Session(self.config, self.server) for _ in range(missing)]
        self._sessions = [*self._sessions[: env.num_envs], *new]
        self._in_parallel([session.open for session in self._sessions])
        self._read_params(self._sessions[0].hello.get("observation_params") or {})

    def _begin_episodes(self, env: BatchEnv, slots: Sequence[int]) -> None:
        placement, instructions = env.placement, env.instructions()
        for slot in slots:
            if slot in self._running:
                self._sessions[slot].end({})
            task = {"name": instructions[slot], "suite": env.suite, "task_id": int(placement.task[slot])}
            self._sessions[slot].begin({**task, "episode_idx": int(placement.episode[slot])})
            self._running.add(slot)

    def _before_asking(self, env: BatchEnv, done: np.ndarray) -> None:
        """Tell the server which episodes have finished, and how."""
        finished = [slot for slot in sorted(self._running) if done[slot]]
        if not finished:
            return
        metrics = env.evaluate()
        for slot in finished:
            result = {"metrics": {"success": bool(metrics.success[slot])}, "steps": int(metrics.num_steps[slot])}
            self._sessions[slot].end(result)
        self._running.difference_update(finished)

    def _read_params(self, params: Mapping[str, object]) -> None:
        """Do as the server's hello asks, unless the user decided."""
        if params.get("absolute_action"):
            raise self._error("it answers absolute actions (absolute_action); vecenv takes relative ones")
        wrist, state = self.config.send_wrist_image, self.config.send_state
        self._wrist = bool(params.get("send_wrist_image", False)) if wrist is None else wrist
        self._state = bool(params.get("send_state", False)) if state is None else state
        self._robosuite_rotation = bool(params.get("quat_no_antipodal", False))
        ignored = [f"{name}={params[name]!r}" for name in _DECIDED_HERE if name in params]
        if ignored:
            _log.warning("%s asks for %s; the evaluation protocol decides here", self.server, ", ".join(ignored))

    def needed_cameras(self) -> Sequence[str]:
        """Whose images are sent, as far as is known before the server has said hello."""
        return ("agentview", "wrist") if self._wrist or self.config.send_wrist_image else ("agentview",)

    def _cameras(self) -> Sequence[str]:
        return ("agentview", "wrist") if self._wrist else ("agentview",)

    def _ask(self, frames: Frames) -> Sequence[np.ndarray]:
        images = {name: resize_with_pad(frames.images[name], self.config.image_size) for name in self._cameras()}
        states = frames.state if self._robosuite_rotation else shortest_rotation(frames.state)
        jobs = []
        for row, slot in enumerate(frames.slots.tolist()):
            observation: dict[str, object] = {
                "images": {name: image[row] for name, image in images.items()},
                "task_description": frames.instructions[row],
            }
            if self._state:
                observation["states"] = states[row].astype(np.float64)
            jobs.append(partial(self._act, self._sessions[slot], observation))
        return self._in_parallel(jobs)

    def _act(self, session: Session, observation: Mapping[str, object]) -> np.ndarray:
        payload = session.act(observation)
        actions = payload.get("actions", payload.get("action"))
        if actions is None:
            raise self._error("its answer has no 'actions'")
        return self._chunk(actions)


def shortest_rotation(state: np.ndarray) -> np.ndarray:
    """LIBERO's proprioception [n, 8] with its axis-angle vectors no longer than pi; other states are left alone.

    robosuite's conversion chooses no sign of the quaternion, so its vectors are up to 2 pi long; that of
    vla-evaluation-harness takes the shorter way unless ``quat_no_antipodal`` is asked for.
    """
    if state.shape[1] != 8:
        return state
    vector = state[:, 3:6]
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    shorter = vector * (1 - 2 * np.pi / np.maximum(angle, np.pi))
    return np.concatenate([state[:, :3], np.where(angle > np.pi, shorter, vector), state[:, 6:]], axis=1)
