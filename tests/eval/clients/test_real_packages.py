"""The projects' own packages on the other end of the line: openpi-client 0.1.2 and vla-eval 0.8.0.

Each needs a venv of its own (openpi-client wants NumPy 1), named by VECENV_OPENPI_PYTHON and VECENV_VLA_EVAL_PYTHON::

    python -m venv .venv-openpi && .venv-openpi/bin/pip install openpi-client==0.1.2 typing_extensions
    python -m venv .venv-vla-eval && .venv-vla-eval/bin/pip install vla-eval==0.8.0
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from support.policy_servers import QUICK, SeeingEnv, chunk, running
from vecenv_eval.policies import Policy, make_policy
from vecenv_eval.serving.openpi import OpenPiServer
from vecenv_eval.serving.policy import Observation, Served
from vecenv_eval.serving.vla_eval import VlaEvalServer

pytestmark = pytest.mark.heavy


def python(variable: str) -> str:
    found = os.environ.get(variable, "")
    if not found:
        pytest.skip(f"{variable} names no interpreter")
    return found


def run(interpreter: str, program: str, *arguments: object) -> Any:
    """What a program prints last, as JSON."""
    command = [interpreter, "-c", program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


class Echo:
    """Answers the first pixel of the image, or raises where there is no prompt."""

    metadata: dict[str, str]

    def __init__(self) -> None:
        self.metadata = {"model": "echo"}

    def act_batch(self, observations: Sequence[Observation]) -> list[np.ndarray]:
        return [self.answer(observation) for observation in observations]

    def answer(self, observation: Observation) -> np.ndarray:
        if "images" in observation:
            return chunk(float(observation["images"]["agentview"][0, 0, 0]), 2)
        return chunk(float(observation["observation/image"][0, 0, 0]) + len(observation["prompt"]), 10)


OPENPI_CLIENT = """
import json, sys
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy
policy = WebsocketClientPolicy("127.0.0.1", int(sys.argv[1]))
seen = {"observation/image": np.full((224, 224, 3), 3, np.uint8), "prompt": "go"}
answers = [policy.infer(seen) for _ in range(2)]
try:
    policy.infer({"observation/image": seen["observation/image"]})
    error = ""
except RuntimeError as raised:
    error = str(raised)
print(json.dumps({
    "metadata": policy.get_server_metadata(),
    "actions": np.asarray(answers[1]["actions"]).tolist(),
    "timing": sorted(answers[1]["server_timing"]),
    "error": error,
}))
"""


def test_openpis_own_client_is_served() -> None:
    interpreter = python("VECENV_OPENPI_PYTHON")
    with running(OpenPiServer(Served(Echo()), port=0)) as port:
        said = run(interpreter, OPENPI_CLIENT, port)
    assert said["metadata"] == {"model": "echo"}
    np.testing.assert_allclose(said["actions"], chunk(5.0, 10))
    assert said["timing"] == ["infer_ms"]
    assert said["error"].startswith("Error in inference server:\nTraceback")
    assert "KeyError: 'prompt'" in said["error"]


VLA_EVAL_CLIENT = """
import json, sys
import anyio
import numpy as np
from vla_eval.connection import Connection
async def main():
    connection = Connection(f"ws://127.0.0.1:{sys.argv[1]}")
    await connection.connect(benchmark="libero")
    image = np.full((256, 256, 3), 4, np.uint8)
    await connection.start_episode({"task": {"name": "go"}})
    actions = [await connection.act({"images": {"agentview": image}, "task_description": "go"}) for _ in range(4)]
    await connection.end_episode({"metrics": {"success": True}})
    try:
        await connection.act({"images": {}})
        error = ""
    except RuntimeError as raised:
        error = str(raised)
    await connection.close()
    first = [float(action["actions"][0]) for action in actions]
    print(json.dumps({"hello": connection.server_info, "actions": first, "error": error}))
anyio.run(main)
"""


def test_vla_evals_own_connection_is_served() -> None:
    interpreter = python("VECENV_VLA_EVAL_PYTHON")
    with running(VlaEvalServer(Served(Echo()), port=0)) as port:
        said = run(interpreter, VLA_EVAL_CLIENT, port)
    assert said["hello"]["model_server"] == "Echo"
    assert said["hello"]["observation_params"] == {"send_wrist_image": True, "send_state": True}
    np.testing.assert_allclose(said["actions"], [4, 4.01, 4, 4.01], atol=1e-6)
    assert "observation_failed: KeyError: 'agentview'" in said["error"]


VLA_EVAL_SERVER = """
import json, sys
import anyio
import numpy as np
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve_async
class Echo(PredictModelServer):
    def predict(self, obs, ctx):
        if "oops" in obs["task_description"] or obs["states"].shape != (8,):
            raise KeyError("no such task")
        colour = float(obs["images"]["agentview"][0, 0, 0]) + obs["images"]["wrist"].shape[0] / 1000
        return {"actions": colour + np.arange(3)[:, None] / 100 + np.zeros((3, 7))}
    def get_observation_params(self):
        return {"send_wrist_image": True, "send_state": True}
async def main():
    async with anyio.create_task_group() as group:
        port = await group.start(serve_async, Echo(chunk_size=3), "127.0.0.1", 0)
        print(port, flush=True)
        await anyio.to_thread.run_sync(sys.stdin.read)
        group.cancel_scope.cancel()
anyio.run(main)
"""


@contextlib.contextmanager
def vla_eval_server(interpreter: str) -> Iterator[int]:
    """vla-eval's server on a free port, until its standard input ends."""
    command = [interpreter, "-c", VLA_EVAL_SERVER]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        yield int(process.stdout.readline())
        process.stdin.close()
        process.wait(60)


def test_vla_evals_own_server_drives_our_environment() -> None:
    env = SeeingEnv([1], [0, 1, 2], max_steps=100)
    with vla_eval_server(python("VECENV_VLA_EVAL_PYTHON")) as port:
        client: Policy = make_policy("vla-eval", **{**QUICK, "port": port, "connections": 3})
        client.reset(env, env.reset())
        first = []
        for _ in range(4):
            actions = np.asarray(client.act(env))
            first.append(actions[:, 0])
            env.step_continuous(actions)
        client.close()  # type: ignore[attr-defined]
    expected = np.arange(3)[None] + 0.256 + np.array([0, 1, 2, 0])[:, None] / 100
    np.testing.assert_allclose(np.stack(first), expected, atol=1e-5)
