"""vla-eval's policy server for ``standard_protocol.py``: answers a batch with one chunk after a fixed time.

Run by the Python that has vla-eval, through its own entry point for servers, with its batching of requests.
"""

from __future__ import annotations

import json
import os
import time
from typing import Any

import numpy as np
from vla_eval.model_servers.predict import PredictModelServer  # pyright: ignore[reportMissingImports]
from vla_eval.model_servers.serve import run_server  # pyright: ignore[reportMissingImports]
from vla_eval.specs import (  # pyright: ignore[reportMissingImports]
    GRIPPER_CLOSE_POS,
    POSITION_DELTA,
    ROTATION_AA,
)


class ChunkServer(PredictModelServer):
    """Knows one chunk, which is in the environment variable ``CHUNK``.

    Args:
        reply_s: seconds that a batch takes.
        most: most observations in a batch.
    """

    def __init__(self, reply_s: float = 0.0, most: int = 1) -> None:
        self._chunk, self._reply_s = np.array(json.loads(os.environ["CHUNK"]), np.float32), reply_s
        super().__init__(chunk_size=len(self._chunk), max_batch_size=most)

    def predict_batch(self, obs_batch: list[Any], ctx_batch: list[Any]) -> list[dict[str, Any]]:
        time.sleep(self._reply_s)
        return [{"actions": self._chunk} for _ in obs_batch]

    def get_action_spec(self) -> dict[str, Any]:
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": GRIPPER_CLOSE_POS}

    def get_observation_spec(self) -> dict[str, Any]:
        return {}


if __name__ == "__main__":
    run_server(ChunkServer)
