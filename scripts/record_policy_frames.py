"""Record messages of policy protocols as the projects' own packages make them, for tests/data/policy_frames.json.

Run it once in a venv with ``openpi-client==0.1.2`` and once in one with ``vla-eval==0.8.0``; each run replaces the
entries of the packages it finds. Needs NumPy besides, which both bring.
"""

from __future__ import annotations

import base64
import importlib.metadata
import json
import sys
from pathlib import Path

import numpy as np

FILE = Path(__file__).parent.parent / "tests" / "data" / "policy_frames.json"


def observation() -> dict[str, object]:
    """What is packed; tests/eval/clients/test_recorded_frames.py builds the same."""
    rng = np.random.default_rng(0)
    return {
        "image": rng.integers(0, 256, (6, 9, 3), np.uint8),
        "state": rng.normal(size=8),
        "grip": np.float32(0.5),
        "prompt": "put the bowl on the plate",
    }


def openpi() -> dict[str, str]:
    """Packing and image resizing of openpi-client."""
    from openpi_client import image_tools, msgpack_numpy  # type: ignore[import-not-found]

    image = observation()["image"]
    return {
        "version": importlib.metadata.version("openpi-client"),
        "message": _text(msgpack_numpy.packb(observation())),
        "padded_32": _text(image_tools.resize_with_pad(np.asarray(image)[None], 32, 32).tobytes()),
        "padded_5": _text(image_tools.resize_with_pad(np.asarray(image)[None], 5, 5).tobytes()),
    }


def vla_eval() -> dict[str, str]:
    """Messages of vla-eval."""
    from vla_eval.protocol.messages import Message, MessageType, pack_message  # type: ignore[import-not-found]

    message = Message(MessageType.OBSERVATION, observation(), seq=3, timestamp=1.5)
    return {"version": importlib.metadata.version("vla-eval"), "message": _text(pack_message(message))}


def main() -> None:
    """Record what this interpreter has."""
    recorded = json.loads(FILE.read_text()) if FILE.exists() else {}
    for name, record in {"openpi-client": openpi, "vla-eval": vla_eval}.items():
        try:
            recorded[name] = record()
        except ImportError as error:
            print(f"{name}: {error}", file=sys.stderr)
    FILE.write_text(json.dumps(recorded, indent=1) + "\n")


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()


if __name__ == "__main__":
    main()
