"""Our messages against those that openpi-client 0.1.2 and vla-eval 0.8.0 made (scripts/record_policy_frames.py)."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from vecenv_eval.clients.codecs import gr00t, numpy_msgpack, vla_eval
from vecenv_eval.clients.images import resize, resize_with_pad

from vecenv.errors import InvalidInput


def observation() -> dict[str, object]:
    rng = np.random.default_rng(0)
    return {
        "image": rng.integers(0, 256, (6, 9, 3), np.uint8),
        "state": rng.normal(size=8),
        "grip": np.float32(0.5),
        "prompt": "put the bowl on the plate",
    }


@pytest.fixture(scope="module")
def frames() -> dict[str, dict[str, bytes]]:
    path = Path(__file__).parent.parent.parent / "data" / "policy_frames.json"
    return {
        package: {key: base64.b64decode(text) for key, text in record.items() if key != "version"}
        for package, record in json.loads(path.read_text()).items()
    }


def assert_same(found: Mapping[str, object], expected: Mapping[str, object]) -> None:
    assert set(found) == set(expected)
    for key, value in expected.items():
        np.testing.assert_array_equal(found[key], value)


def test_openpis_packing_is_ours_byte_for_byte(frames: dict[str, dict[str, bytes]]) -> None:
    theirs = frames["openpi-client"]["message"]
    assert numpy_msgpack.pack(observation()) == theirs
    assert_same(numpy_msgpack.unpack(theirs), observation())


@pytest.mark.parametrize("size", [32, 5])
def test_openpis_padding_is_ours_pixel_for_pixel(frames: dict[str, dict[str, bytes]], size: int) -> None:
    ours = resize_with_pad(np.asarray(observation()["image"])[None], size)
    theirs = np.frombuffer(frames["openpi-client"][f"padded_{size}"], np.uint8).reshape(1, size, size, 3)
    np.testing.assert_array_equal(ours, theirs)


def test_images_of_the_right_size_are_left_alone() -> None:
    images = np.zeros((2, 8, 8, 3), np.uint8)
    assert resize_with_pad(images, 8) is images
    assert resize_with_pad(images, 0) is images
    assert resize(images, 8) is images
    assert resize(images, 4).shape == (2, 4, 4, 3)


def test_messages_of_vla_eval_are_read(frames: dict[str, dict[str, bytes]]) -> None:
    message = vla_eval.unpack(frames["vla-eval"]["message"])
    assert (message.kind, message.seq, message.timestamp) == (vla_eval.OBSERVATION, 3, 1.5)
    assert_same(message.payload, observation())


@pytest.mark.parametrize("release", gr00t.RELEASES)
def test_messages_of_gr00t_survive_the_round_trip(release: str) -> None:
    message, packed_as = gr00t.unpack_with_release(gr00t.pack(observation(), release))
    assert packed_as == (gr00t.N1_7 if release == gr00t.N1_7 else gr00t.N1_6)
    assert_same(message, observation())


def test_python_objects_are_neither_sent_nor_taken() -> None:
    with pytest.raises(InvalidInput, match="cannot be sent"):
        numpy_msgpack.pack({"a": np.array([None])})
    forged = numpy_msgpack.pack({b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "|O", b"shape": [1]})
    with pytest.raises(InvalidInput, match="not taken"):
        numpy_msgpack.unpack(forged)
    forged = numpy_msgpack.pack({b"nd": True, b"kind": b"O", b"type": "<f4", b"data": b"\0" * 4, b"shape": [1]})
    with pytest.raises(InvalidInput, match="not taken"):
        gr00t.unpack(forged)


@pytest.mark.parametrize("unpack", [numpy_msgpack.unpack, vla_eval.unpack, gr00t.unpack])
@pytest.mark.parametrize("data", [b"", b"\xc1", b"\x81"])
def test_bytes_that_are_no_message_are_refused(unpack: object, data: bytes) -> None:
    assert callable(unpack)
    with pytest.raises(InvalidInput, match="not a"):
        unpack(data)
