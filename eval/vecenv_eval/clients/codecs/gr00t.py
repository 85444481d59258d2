"""Messages of NVIDIA Isaac-GR00T's policy server, which is a ZMQ REP socket.

A request is the msgpack map ``{"endpoint", "data", "api_token"?}``. Two ways to pack an array are in use:

* N1.5 and N1.6: ``{"__ndarray_class__": True, "as_npy": <bytes of numpy.save>}``;
* N1.7: ``{b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [...], b"data": bytes}``, as the package
  ``msgpack_numpy`` does.

``unpack`` takes both. Read in NVIDIA/Isaac-GR00T, ``gr00t/eval/service.py`` (0a015f6, N1.5) and
``gr00t/policy/server_client.py`` (38624df, N1.6; N1.7's from public copies of that file).
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from vecenv.errors import InvalidInput

N1_5, N1_6, N1_7 = RELEASES = ("n1.5", "n1.6", "n1.7")


@dataclass(frozen=True)
class Modality:
    """What a server says about one modality.

    Attributes:
        release: which release packs it so.
        fields: its config: ``delta_indices``, ``modality_keys`` and others.
    """

    release: str
    fields: Mapping[str, Any]


def pack(message: object, release: str = N1_6) -> bytes:
    """A message as bytes, arrays packed as a release does."""
    return msgpack.Packer(default=_encode_msgpack_numpy if release == N1_7 else _encode_npy).pack(message)


def unpack(data: bytes) -> Any:
    """A message from bytes, whichever way its arrays are packed; configs of modalities become ``Modality``.

    Raises:
        InvalidInput: the bytes are not such a message.
    """
    return unpack_with_release(data)[0]


def unpack_with_release(data: bytes) -> tuple[Any, str]:
    """A message, and the release that packs arrays as it does; N1.6 where the message has no array."""
    seen = {N1_6}

    def decode(value: dict[Any, Any]) -> object:
        if b"nd" in value:
            seen.add(N1_7)
        return _decode(value)

    try:
        return msgpack.unpackb(data, object_hook=decode), max(seen)
    except (ValueError, TypeError, KeyError, msgpack.UnpackException) as error:
        raise InvalidInput(f"not a message of GR00T: {type(error).__name__}: {error}") from error


def _encode_npy(value: object) -> object:
    if isinstance(value, np.ndarray):
        stream = io.BytesIO()
        np.save(stream, value, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": stream.getvalue()}
    return value.item() if isinstance(value, np.generic) else value


def _encode_msgpack_numpy(value: object) -> object:
    if isinstance(value, np.ndarray):
        if value.dtype.kind in "OV":
            raise InvalidInput(f"arrays of {value.dtype} cannot be sent")
        header = {b"nd": True, b"type": value.dtype.str, b"kind": b"", b"shape": value.shape}
        return {**header, b"data": value.tobytes()}
    return value.item() if isinstance(value, np.generic) else value


def _decode(value: dict[Any, Any]) -> object:
    if "__ndarray_class__" in value:
        return np.load(io.BytesIO(value["as_npy"]), allow_pickle=False)
    if b"nd" in value:
        dtype = np.dtype(value[b"type"])
        if value.get(b"kind") or dtype.kind in "OV":
            raise InvalidInput(f"arrays of {dtype} are not taken")
        flat = np.frombuffer(value[b"data"], dtype).copy()
        return flat.reshape(value[b"shape"]) if value[b"nd"] else flat[0]
    if "__ModalityConfig__" in value:
        return Modality(N1_7, value["as_json"])
    if "__ModalityConfig_class__" in value:
        fields = value["as_json"] if "as_json" in value else value["as_dict"]
        return Modality(N1_5, json.loads(fields)) if isinstance(fields, str) else Modality(N1_6, fields)
    return value
