"""Messages of vla-evaluation-harness, protocol 1.

A message is the msgpack map ``{"type", "payload", "seq", "timestamp"}``. Arrays are ``{"__ndarray__": True, "data",
"dtype", "shape"}``; uint8 images [H, W, 1, 3 or 4] travel as PNG, ``{"__image__": True, "format": "png", "data",
"shape"}``. Read in allenai/vla-evaluation-harness e1ee9ad, ``src/vla_eval/protocol/``.
"""

from __future__ import annotations

import functools
import io
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgpack
import numpy as np
from PIL import Image

from vecenv.errors import InvalidInput

PROTOCOL_VERSION = 1
HELLO, OBSERVATION, ACTION = "hello", "observation", "action"
EPISODE_START, EPISODE_END, ERROR = "episode_start", "episode_end", "error"
KINDS = (HELLO, OBSERVATION, ACTION, EPISODE_START, EPISODE_END, ERROR)
IMAGE_FORMATS = ("png", "raw")
_NUMBER_KINDS = "biuf"


@dataclass(frozen=True)
class Message:
    """One message.

    Attributes:
        kind: one of ``KINDS``.
        payload: what it carries.
        seq: number of the message; an answer has that of its request.
        timestamp: seconds since 1970 at its sender.
    """

    kind: str
    payload: Mapping[str, Any]
    seq: int = 0
    timestamp: float = field(default_factory=time.time)


def pack(message: Message, image_format: str = "png") -> bytes:
    """A message as bytes; images are compressed as PNG, or not at all (``"raw"``)."""
    plain = {
        "type": message.kind,
        "payload": message.payload,
        "seq": message.seq,
        "timestamp": message.timestamp,
    }
    return msgpack.Packer(default=functools.partial(_encode, image_format=image_format)).pack(plain)


def unpack(data: bytes) -> Message:
    """A message from bytes.

    Raises:
        InvalidInput: the bytes are not a message of this protocol.
    """
    try:
        plain = msgpack.unpackb(data, object_hook=_decode)
        message = Message(plain["type"], plain["payload"], plain["seq"], plain["timestamp"])
    except (ValueError, TypeError, KeyError, OSError, msgpack.UnpackException) as error:
        raise InvalidInput(f"not a message of vla-eval: {type(error).__name__}: {error}") from error
    if message.kind not in KINDS:
        raise InvalidInput(f"message of unknown type {message.kind!r}; expected one of {', '.join(KINDS)}")
    return message


def _encode(value: object, image_format: str) -> object:
    if isinstance(value, np.ndarray):
        if image_format == "png" and value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] in (1, 3, 4):
            return {"__image__": True, "format": "png", "data": _png(value), "shape": list(value.shape)}
        return {"__ndarray__": True, "data": value.tobytes(), "dtype": value.dtype.str, "shape": list(value.shape)}
    return value.item() if isinstance(value, np.generic) else value


def _png(image: np.ndarray) -> bytes:
    stream = io.BytesIO()
    # Pillow wants one-channel images without the last axis; the shape travels along. The fastest compression saves
    # most of the time and costs little size.
    Image.fromarray(image[..., 0] if image.shape[2] == 1 else image).save(stream, format="PNG", compress_level=1)
    return stream.getvalue()


def _decode(value: dict[str, Any]) -> object:
    if "__image__" in value and value["format"] != "raw":
        return np.array(Image.open(io.BytesIO(value["data"]))).reshape(value["shape"])
    if "__image__" in value or "__ndarray__" in value:
        dtype = np.dtype(value["dtype"])
        if dtype.kind not in _NUMBER_KINDS:
            raise InvalidInput(f"arrays of {dtype} are not taken")
        return np.frombuffer(value["data"], dtype).reshape(value["shape"]).copy()
    return value
