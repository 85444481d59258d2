"""msgpack with NumPy arrays as openpi and StarVLA pack them.

An array is the map ``{b"__ndarray__": True, b"data": bytes, b"dtype": "<f4", b"shape": [...]}``, a NumPy scalar is
``{b"__npgeneric__": True, b"data": number, b"dtype": "<f4"}``. Read in openpi 15a9616,
``packages/openpi-client/src/openpi_client/msgpack_numpy.py``.
"""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np

from vecenv.errors import InvalidInput

# Kinds of dtypes whose elements are not plain numbers, booleans or strings.
_REFUSED_KINDS = "VOc"


def pack(message: object) -> bytes:
    """A message as bytes.

    Raises:
        InvalidInput: an array of Python objects, records or complex numbers.
    """
    return msgpack.Packer(default=_encode).pack(message)


def unpack(data: bytes) -> Any:
    """A message from bytes; arrays are copies that can be written to.

    Raises:
        InvalidInput: the bytes are not such a message.
    """
    try:
        return msgpack.unpackb(data, object_hook=_decode)
    except (ValueError, TypeError, KeyError, msgpack.UnpackException) as error:
        raise InvalidInput(f"not a msgpack message with NumPy arrays: {type(error).__name__}: {error}") from error


def _encode(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in _REFUSED_KINDS:
        raise InvalidInput(f"arrays of {value.dtype} cannot be sent")
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    return value


def _decode(value: dict[Any, Any]) -> object:
    if b"__ndarray__" in value:
        return np.frombuffer(value[b"data"], _dtype(value[b"dtype"])).reshape(value[b"shape"]).copy()
    if b"__npgeneric__" in value:
        return _dtype(value[b"dtype"]).type(value[b"data"])
    return value


def _dtype(text: str) -> np.dtype:
    dtype = np.dtype(text)
    if dtype.kind in _REFUSED_KINDS:
        raise InvalidInput(f"arrays of {dtype} are not taken")
    return dtype
