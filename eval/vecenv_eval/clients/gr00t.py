"""Client of NVIDIA Isaac-GR00T's policy server, sending what its LIBERO evaluation sends.

Read in NVIDIA/Isaac-GR00T: ``gr00t/policy/server_client.py`` (38624df), ``gr00t/policy/gr00t_policy.py`` (226ca9b),
``gr00t/eval/rollout_policy.py`` (680daf8), ``gr00t/eval/service.py`` (0a015f6, N1.5). Its LIBERO environment
(``gr00t/eval/sim/LIBERO/libero_env.py``) was read in public copies. One request holds many slots: ``video.*``
[B, 1, H, W, 3], ``state.*`` [B, 1, D] and the instructions; the answer holds ``action.*`` [B, T, D].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from vecenv.contract import BatchEnv
from vecenv_eval.clients.base import RemotePolicy
from vecenv_eval.clients.codecs import gr00t as codec
from vecenv_eval.clients.config import ServerConfig, build
from vecenv_eval.clients.frames import Frames
from vecenv_eval.clients.images import resize_with_pad
from vecenv_eval.clients.pool import LinkPool
from vecenv_eval.clients.zmq import ZmqLink
from vecenv_eval.policies import PolicyError

# Columns of LIBERO's proprioception and of its actions by GR00T's names.
STATE_COLUMNS: Mapping[str, slice] = {
    "x": slice(0, 1),
    "y": slice(1, 2),
    "z": slice(2, 3),
    "roll": slice(3, 4),
    "pitch": slice(4, 5),
    "yaw": slice(5, 6),
    "gripper": slice(6, 8),
}
ACTION_KEYS = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
LANGUAGE_KEY = "annotation.human.action.task_description"
LAYOUTS = ("flat", "nested")
AUTO = "auto"


@dataclass(frozen=True, kw_only=True)
class Gr00tConfig(ServerConfig):
    """Options of the ``gr00t`` policy; the defaults are those of GR00T's LIBERO evaluation.

    Attributes:
        replan_steps: actions of each answer that are executed before the server is asked again; 0 for all.
        batch: most slots in one request.
        image_size: side of the images sent, pixels; they are padded to a square. 0 sends them as rendered.
        wrist: whether the wrist image is sent.
        layout: ``"flat"`` keys such as ``video.image`` for servers started with ``--use-sim-policy-wrapper`` and for
            N1.5; ``"nested"`` maps for the others.
        language_key: name of the instruction in the request.
        release: ``"n1.5"``, ``"n1.6"`` or ``"n1.7"``, which pack differently; ``"auto"`` finds out by asking the server
            for its modality config.
    """

    port: int = 5555
    gripper: str = "open_above_half"
    replan_steps: int = 8
    batch: int = 32
    image_size: int = 0
    wrist: bool = True
    layout: str = "flat"
    language_key: str = LANGUAGE_KEY
    release: str = AUTO

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.layout not in LAYOUTS:
            raise PolicyError(f"layout={self.layout!r}: expected one of {', '.join(LAYOUTS)}")
        if self.release not in (AUTO, *codec.RELEASES):
            raise PolicyError(f"release={self.release!r}: expected one of {AUTO}, {', '.join(codec.RELEASES)}")


class Gr00tPolicy(RemotePolicy[Gr00tConfig]):
    """A policy behind GR00T's ZMQ server.

    Args:
        **options: fields of ``Gr00tConfig``.

    Attributes:
        modalities: what the server said about its modalities, by name.
    """

    name = "gr00t"

    def __init__(self, **options: object) -> None:
        super().__init__(build(Gr00tConfig, self.name, options))
        self.modalities: Mapping[str, Any] = {}
        self._release = codec.N1_6 if self.config.release == AUTO else self.config.release
        self._links = LinkPool([ZmqLink(self.config, self.server, self._greet) for _ in range(self.config.connections)])

    def close(self) -> None:
        """Close the sockets; the next call opens them again."""
        self._links.close()

    def _begin_batch(self, env: BatchEnv) -> None:
        with self._links.borrowed() as link:
            link.request(codec.pack(self._endpoint("ping")))
            if self._release != codec.N1_5:
                self._read(link.request(codec.pack(self._endpoint("reset", {"options": None}))))

    def _greet(self, request: Callable[[bytes], bytes]) -> None:
        """Ask which release the server is, and whether it wants one frame at a time."""
        if self.config.release != AUTO:
            return
        answer = self._read(request(codec.pack(self._endpoint("get_modality_config"))))
        self.modalities = answer if isinstance(answer, Mapping) else {}
        known = [each for each in self.modalities.values() if isinstance(each, codec.Modality)]
        self._release = known[0].release if known else codec.N1_6
        video = self.modalities.get("video")
        frames = len(video.fields.get("delta_indices", (0,))) if isinstance(video, codec.Modality) else 1
        if frames != 1:
            raise self._error(f"it wants {frames} frames of video; this client sends the present one")

    def _cameras(self) -> Sequence[str]:
        return ("agentview", "wrist") if self.config.wrist else ("agentview",)

    def _ask(self, frames: Frames) -> Sequence[np.ndarray]:
        if (found := frames.state.shape[1]) != 8:
            raise PolicyError(f"policy 'gr00t' knows LIBERO's 8-D state; this environment's is {found}-D")
        parts = self._in_parallel([partial(self._get_action, part) for part in frames.split(self.config.batch)])
        return [chunk for part in parts for chunk in part]

    def _get_action(self, frames: Frames) -> list[np.ndarray]:
        with self._links.borrowed() as link:
            observation = self._observation(frames)
            wrapped = {"observation": observation, "options": None}
            data = observation if self._release == codec.N1_5 else wrapped
            answer = self._read(link.request(codec.pack(self._endpoint("get_action", data), self._release)))
        actions = answer[0] if isinstance(answer, list) and answer else answer
        return [self._chunk(chunk, self.config.replan_steps) for chunk in self._join(actions, len(frames))]

    def _observation(self, frames: Frames) -> dict[str, object]:
        names = dict(zip(self._cameras(), ("image", "wrist_image"), strict=False))
        size = self.config.image_size
        video = {key: resize_with_pad(frames.images[name], size)[:, None] for name, key in names.items()}
        state = {key: np.float32(frames.state[:, None, columns]) for key, columns in STATE_COLUMNS.items()}
        said = list(frames.instructions)
        if self.config.layout == "nested":
            return {"video": video, "state": state, "language": {self.config.language_key: [[text] for text in said]}}
        flat: dict[str, object] = {f"video.{key}": value for key, value in video.items()}
        return {**flat, **{f"state.{key}": value for key, value in state.items()}, self.config.language_key: said}

    def _join(self, actions: object, count: int) -> np.ndarray:
        """The answer's keys as one array [B, T, 7]."""
        if not isinstance(actions, Mapping):
            raise self._error(f"it answered no actions but {type(actions).__name__}")
        columns = []
        for key in ACTION_KEYS:
            value = actions.get(f"action.{key}", actions.get(key))
            if value is None:
                there = ", ".join(map(str, actions)) or "nothing"
                raise self._error(f"its answer has no 'action.{key}'; it has {there}")
            column = np.asarray(value, dtype=np.float64)
            # N1.5 gives [T] or [B, T] for keys of one number.
            columns.append(column.reshape(count, -1, 1) if column.size % count == 0 else column)
        if len({column.shape for column in columns}) != 1:
            raise self._error(f"its actions have shapes {', '.join(str(column.shape) for column in columns)}")
        return np.concatenate(columns, axis=2)

    def _endpoint(self, name: str, data: object = None) -> dict[str, object]:
        request: dict[str, object] = {"endpoint": name} if data is None else {"endpoint": name, "data": data}
        return {**request, "api_token": self.config.api_key} if self.config.api_key else request

    def _read(self, message: bytes) -> Any:
        try:
            answer = codec.unpack(message)
        except ValueError as error:
            raise self._error(str(error)) from error
        if isinstance(answer, Mapping) and "error" in answer:
            raise self._error(f"it reports an error: {answer['error']}")
        return answer
