"""Policies served by us: round trips with our clients, errors, batches, and the command."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.policy_servers import QUICK, SeeingEnv, chunk, running
from typer.testing import CliRunner
from vecenv_eval.clients.errors import PolicyServerError
from vecenv_eval.policies import Policy, make_policy
from vecenv_eval.serving.batcher import Batcher
from vecenv_eval.serving.cli import serve_policy_command
from vecenv_eval.serving.gr00t import Gr00tServer, split
from vecenv_eval.serving.openpi import OpenPiServer
from vecenv_eval.serving.policy import Observation, Served, ServedPolicyError, load
from vecenv_eval.serving.vla_eval import VlaEvalServer

from vecenv.cli import COMMAND_GROUP

SERVERS = {"openpi": OpenPiServer, "vla-eval": VlaEvalServer, "gr00t": Gr00tServer}
KEYS = {
    "openpi": {"observation/image", "observation/wrist_image", "observation/state", "prompt"},
    "vla-eval": {"images", "states", "task_description"},
    "gr00t": {"video.image", "video.wrist_image", "annotation.human.action.task_description"}
    | {f"state.{key}" for key in ("x", "y", "z", "roll", "pitch", "yaw", "gripper")},
}


def colour(observation: Observation) -> float:
    """The number of the slot, which ``SeeingEnv`` paints."""
    if "images" in observation:
        return float(observation["images"]["agentview"][0, 0, 0])
    image = observation["observation/image"] if "prompt" in observation else observation["video.image"]
    return float(image.reshape(-1)[0])


class Painter:
    """Answers chunks whose first numbers are the colours that it sees."""

    def __init__(self) -> None:
        self.metadata = {"model": "painter"}
        self.seen: list[Observation] = []
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def act_batch(self, observations: Sequence[Observation]) -> list[np.ndarray]:
        self.seen.extend(observations)
        return [chunk(colour(observation) / 10, 8) for observation in observations]


class Single:
    """openpi's own kind of policy."""

    def infer(self, observation: Observation) -> dict[str, Any]:
        return {"actions": chunk(colour(observation) / 10, 8), "state": observation}


class Failing:
    def act_batch(self, observations: Sequence[Observation]) -> list[np.ndarray]:
        raise KeyError("no such camera")


def acted(name: str, policy: object, env: SeeingEnv, ticks: int, **options: Any) -> np.ndarray:
    """What our client makes of our server, [ticks, B, 7]."""
    with running(SERVERS[name](Served(policy), port=0)) as port:  # type: ignore[arg-type]
        client: Policy = make_policy(name, **{**QUICK, "port": port, "gripper": "as_is", **options})
        client.reset(env, env.reset())
        actions = []
        for _ in range(ticks):
            actions.append(np.asarray(client.act(env)))
            env.step_continuous(actions[-1])
        client.close()  # type: ignore[attr-defined]
    return np.stack(actions)


@pytest.mark.parametrize("name", SERVERS)
@pytest.mark.parametrize("kind", [Painter, Single])
def test_our_client_executes_what_our_server_answers(name: str, kind: type) -> None:
    policy, env = kind(), SeeingEnv([1], [0, 1, 2], max_steps=100)
    actions = acted(name, policy, env, 10, connections=2)
    steps = 5 if name == "openpi" else 8
    expected = np.arange(3)[None, :] / 10 + (np.arange(10) % steps)[:, None] / 100
    np.testing.assert_allclose(actions[..., 0], expected, atol=1e-6)
    if isinstance(policy, Painter):
        assert set(policy.seen[0]) == KEYS[name]
        assert policy.resets == {"openpi": 0, "vla-eval": 3, "gr00t": 1}[name]


@pytest.mark.parametrize("name", SERVERS)
def test_what_the_policy_raises_reaches_the_client(name: str) -> None:
    with pytest.raises(PolicyServerError, match=rf"{name} at .* it reports an error: .*no such camera"):
        acted(name, Failing(), SeeingEnv([1], [0]), 1)


@pytest.mark.parametrize(("path", "name"), [("/healthz", "openpi"), ("/health", "vla-eval")])
def test_the_server_says_that_it_is_up(path: str, name: str) -> None:
    import urllib.request

    with running(SERVERS[name](Served(Painter()), port=0)) as port:
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(f"http://127.0.0.1:{port}{path}", timeout=20) as answer:
            assert answer.status == 200


def test_requests_that_arrive_while_the_policy_is_busy_make_one_batch() -> None:
    class Slow:
        def __init__(self) -> None:
            self.busy, self.go_on = threading.Event(), threading.Event()
            self.batches: list[int] = []

        def act_batch(self, observations: Sequence[Observation]) -> list[np.ndarray]:
            self.batches.append(len(observations))
            self.busy.set()
            self.go_on.wait(20)
            return [chunk(0.0)] * len(observations)

        def reset(self) -> None:
            self.batches.append(0)

    slow = Slow()
    with Batcher(Served(slow), most=3) as batcher:
        futures = [batcher.act({})]
        assert slow.busy.wait(20)
        futures += [batcher.act({}), batcher.act({}), batcher.reset(), *[batcher.act({}) for _ in range(4)]]
        slow.go_on.set()
        for future in futures:
            future.result(timeout=20)
    assert slow.batches == [1, 2, 0, 3, 1]


def test_a_policy_needs_one_of_the_two_methods() -> None:
    with pytest.raises(ServedPolicyError, match=r"object cannot be served: it needs act_batch"):
        Served(object())  # type: ignore[arg-type]


@pytest.mark.parametrize("answer", [[], [np.zeros((2, 3, 7))], [["a"]]])
def test_answers_that_do_not_fit_are_the_policys_fault(answer: Any) -> None:
    class Odd:
        def act_batch(self, observations: Sequence[Observation]) -> Any:
            return answer

    with pytest.raises(ServedPolicyError, match="the policy answered"):
        Served(Odd()).act([{}])


def test_a_request_of_many_slots_is_split() -> None:
    parts = split({"video": {"image": np.arange(2)}, "language": {"task": [["a"], ["b"]]}})
    assert parts[1] == {"video": {"image": 1}, "language": {"task": ["b"]}}
    with pytest.raises(ValueError, match="different batch sizes"):
        split({"a": [1], "b": [1, 2]})


MODULE = """
class Still:
    def infer(self, observation):
        return {"actions": [[0.0] * 7]}

still = Still()
number = 3
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "a_served_policy.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_a_policy_is_a_class_or_an_object(module: Path) -> None:
    for name in ("Still", "still"):
        assert load(f"a_served_policy:{name}").act([{}])[0].shape == (1, 7)
    for name, cause in [("Other", "AttributeError"), ("number", "int cannot be served")]:
        with pytest.raises(ServedPolicyError, match=cause):
            load(f"a_served_policy:{name}")
    with pytest.raises(ServedPolicyError, match="write module:Name"):
        load("a_served_policy")
    with pytest.raises(ServedPolicyError, match="No module named"):
        load("no_such_module_here:Still")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a_served_policy:still", "--as", "openai"], "unknown protocol 'openai': did you mean openpi"),
        (["a_served_policy:number", "--as", "openpi"], "int cannot be served"),
    ],
)
def test_the_command_refuses_what_makes_no_sense(module: Path, arguments: list[str], message: str) -> None:
    import typer

    app = typer.Typer()
    app.command()(serve_policy_command)
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert message in result.output


def test_the_command_serves_until_it_is_interrupted(module: Path) -> None:
    run = "import typer; from vecenv_eval.serving.cli import serve_policy_command as c; typer.run(c)"
    command = [sys.executable, "-c", run, "a_served_policy:still", "--as", "openpi", "--port", "0"]
    with subprocess.Popen(command, cwd=module, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("serving a_served_policy:still as openpi on ws://127.0.0.1:")
            env = SeeingEnv([1], [0])
            client: Policy = make_policy("openpi", **{**QUICK, "port": int(line.rpartition(":")[2]), "replan_steps": 1})
            client.reset(env, env.reset())
            assert not np.asarray(client.act(env)).any()
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0
        finally:
            process.kill()  # leaving the block waits for its end


def test_the_command_is_announced_to_the_command_line(repository: Path) -> None:
    commands = tomllib.loads((repository / "pyproject.toml").read_text())["project"]["entry-points"][COMMAND_GROUP]
    assert commands["serve-policy"] == "vecenv_eval.serving.cli:serve_policy_command"
