"""The openpi client: what it sends, when it asks, and what it makes of failures."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fakes import FakeWorld
from support.policy_servers import QUICK, SeeingEnv, WebSocketHost, chunk, free_port, messages, websocket_host
from vecenv_eval.clients.codecs import numpy_msgpack
from vecenv_eval.clients.errors import PolicyServerError
from vecenv_eval.clients.openpi import OpenPiPolicy
from vecenv_eval.policies import Policy, PolicyError, make_policy
from vecenv_eval.results import begin
from vecenv_eval.runner import EvalConfig, Simulator, evaluate
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection

from vecenv.observations import ImagesUnavailable


def answer_all(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
    """Metadata, then chunks whose numbers count the requests: 0.1 for the first, 0.2 for the second."""
    del number
    connection.send(numpy_msgpack.pack({"model": "fake"}))
    for message in messages(connection):
        host.seen.append(numpy_msgpack.unpack(message))
        connection.send(numpy_msgpack.pack({"actions": chunk(len(host.seen) / 10)}))


def policy_of(port: int, **options: Any) -> OpenPiPolicy:
    policy = make_policy("openpi", **{**QUICK, "port": port, **options})
    assert isinstance(policy, OpenPiPolicy)
    return policy


def started(policy: OpenPiPolicy, env: SeeingEnv) -> OpenPiPolicy:
    policy.reset(env, env.reset())
    return policy


def step(policy: Policy, env: SeeingEnv) -> np.ndarray:
    actions = np.asarray(policy.act(env))
    env.step_continuous(actions)
    return actions


def test_a_request_is_what_openpis_libero_example_sends() -> None:
    env = SeeingEnv([1], [0, 1])
    with websocket_host(answer_all) as host:
        policy = started(policy_of(host.port), env)
        policy.act(env)
        policy.close()
    assert policy.metadata == {"model": "fake"}
    for slot, request in enumerate(host.seen):
        assert set(request) == {"observation/image", "observation/wrist_image", "observation/state", "prompt"}
        assert request["observation/image"].shape == request["observation/wrist_image"].shape == (224, 224, 3)
        assert request["observation/image"].dtype == np.uint8
        assert (request["observation/image"] == slot).all()
        np.testing.assert_allclose(request["observation/state"], np.arange(8) / 10 + slot, atol=1e-6)
        assert request["prompt"] == "do thing 1"


def test_a_chunk_is_executed_for_replan_steps_ticks() -> None:
    env = SeeingEnv([1], [0], max_steps=100)
    with websocket_host(answer_all) as host:
        policy = started(policy_of(host.port), env)
        actions = np.stack([step(policy, env) for _ in range(12)])[:, 0, 0]
        policy.close()
    np.testing.assert_allclose(actions, [0.1, 0.11, 0.12, 0.13, 0.14, 0.2, 0.21, 0.22, 0.23, 0.24, 0.3, 0.31])
    assert [request["observation/wrist_image"][0, 0, 0] for request in host.seen] == [0, 5, 10]


def test_finished_slots_do_not_ask_and_get_zeros() -> None:
    env = SeeingEnv([0], [0, 8], max_steps=100)  # they end after 2 and 10 ticks
    with websocket_host(answer_all) as host:
        policy = started(policy_of(host.port), env)
        actions = [step(policy, env) for _ in range(7)]
        policy.close()
    assert [request["observation/image"][0, 0, 0] for request in host.seen] == [0, 1, 1]
    assert not actions[6][0].any()
    assert actions[6][1].all()


def test_a_slot_that_begins_again_drops_its_chunk_and_the_others_keep_theirs() -> None:
    env = SeeingEnv([1], [0, 1], max_steps=100)
    with websocket_host(answer_all) as host:
        policy = started(policy_of(host.port), env)
        step(policy, env)
        policy.reset_slots(env, env.reset(), np.array([1]))
        actions = step(policy, env)
        policy.close()
    np.testing.assert_allclose(actions[:, 0], [0.11, 0.3])


def test_the_connection_is_opened_again_when_the_server_dropped_it() -> None:
    def drop_the_first(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        if number:
            answer_all(host, connection, number)
        else:
            connection.send(numpy_msgpack.pack({}))
            connection.recv()

    env = SeeingEnv([1], [0])
    with websocket_host(drop_the_first) as host:
        policy = started(policy_of(host.port), env)
        np.testing.assert_allclose(policy.act(env)[0], 0.1)
        policy.close()
    assert host.connections == 2


def test_retries_are_bounded() -> None:
    def drop(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(numpy_msgpack.pack({}))
        connection.recv()

    env = SeeingEnv([1], [0])
    with websocket_host(drop) as host:
        policy = started(policy_of(host.port), env)
        with pytest.raises(
            PolicyServerError, match=rf"openpi at 127.0.0.1:{host.port}: no connection after 3 attempts"
        ):
            policy.act(env)
        assert host.connections == 3


def test_a_server_that_is_not_there_is_named() -> None:
    env, port = SeeingEnv([1], [0]), free_port()
    with pytest.raises(PolicyServerError, match=rf"127.0.0.1:{port}: no connection after 3 attempts: Connection"):
        started(policy_of(port), env).act(env)


def test_a_text_message_is_the_servers_error() -> None:
    def fail(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(numpy_msgpack.pack({}))
        connection.recv()
        connection.send("Traceback (most recent call last):\n  File \"policy.py\"\nKeyError: 'observation/state'\n")

    env = SeeingEnv([1], [0])
    with websocket_host(fail) as host:
        policy = started(policy_of(host.port), env)
        with pytest.raises(PolicyServerError, match=r"it reports an error: KeyError: 'observation/state'$"):
            policy.act(env)
        assert host.connections == 1


def test_a_server_that_does_not_answer_in_time_is_not_asked_again() -> None:
    def hang(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(numpy_msgpack.pack({}))
        for _ in connection:
            host.seen.append(1)

    env = SeeingEnv([1], [0])
    with websocket_host(hang) as host:
        policy = started(policy_of(host.port, timeout_s=0.2), env)
        with pytest.raises(PolicyServerError, match=r"no answer within timeout_s=0.2 seconds"):
            policy.act(env)
    assert host.seen == [1]


@pytest.mark.parametrize(
    ("answer", "cause"),
    [
        ({"actions": np.zeros((10, 32))}, r"actions of shape \(10, 32\); expected \[K, 7\]"),
        ({"actions": np.zeros((3, 7))}, "answered 3 actions, fewer than replan_steps=5"),
        ({"actions": ["a"]}, "no numbers"),
        ({"action": 1}, "has no 'actions'"),
    ],
)
def test_unusable_answers_are_refused(answer: dict[str, Any], cause: str) -> None:
    def misanswer(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(numpy_msgpack.pack({}))
        for _ in connection:
            connection.send(numpy_msgpack.pack(answer))

    env = SeeingEnv([1], [0])
    with websocket_host(misanswer) as host:
        policy = started(policy_of(host.port), env)
        with pytest.raises(PolicyServerError, match=cause):
            policy.act(env)
        policy.close()


def test_bytes_that_are_no_message_are_an_error() -> None:
    def garble(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(b"\xc1")
        with pytest.raises(ConnectionClosed):
            connection.recv()

    env = SeeingEnv([1], [0])
    with websocket_host(garble) as host, pytest.raises(PolicyServerError, match="not a msgpack message"):
        started(policy_of(host.port), env).act(env)


def test_nan_reaches_the_environment() -> None:
    def nan(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(numpy_msgpack.pack({}))
        for _ in connection:
            connection.send(numpy_msgpack.pack({"actions": np.full((5, 7), np.nan)}))

    env = SeeingEnv([1], [0])
    with websocket_host(nan) as host:
        for gripper in ("as_is", "sign", "open_above_half"):
            policy = started(policy_of(host.port, gripper=gripper), env)
            assert np.isnan(policy.act(env)).all()
            policy.close()


def test_several_connections_have_several_requests_in_flight() -> None:
    together = threading.Barrier(3, timeout=20)

    def meet(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(numpy_msgpack.pack({}))
        for message in messages(connection):
            slot = numpy_msgpack.unpack(message)["observation/image"][0, 0, 0]
            together.wait()
            connection.send(numpy_msgpack.pack({"actions": chunk(float(slot))}))

    env = SeeingEnv([1], [0, 1, 2])
    with websocket_host(meet) as host:
        policy = started(policy_of(host.port, connections=3), env)
        np.testing.assert_allclose(policy.act(env)[:, 0], [0, 1, 2])
        policy.close()
    assert host.connections == 3


def test_an_environment_without_a_wrist_camera_needs_wrist_key_empty() -> None:
    class OneEyed(SeeingEnv):
        def observe_egocentric(self, slots: Any = None) -> Any:
            seen = super().observe_egocentric(slots)
            return type(seen)(state=seen.state, images={"agentview": seen.images["agentview"]})

    env = OneEyed([1], [0])
    with websocket_host(answer_all) as host:
        with pytest.raises(ImagesUnavailable, match="wants camera 'wrist'; the environment's cameras: agentview"):
            started(policy_of(host.port), env).act(env)
        policy = started(policy_of(host.port, wrist_key=""), env)
        policy.act(env)
        policy.close()
    assert "observation/wrist_image" not in host.seen[0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"prot": 1}, "policy 'openpi' has no option prot=1; did you mean port"),
        ({"port": "a"}, "port"),
        ({"port": 70000}, "expected 0 to 65535"),
        ({"connections": 0}, "connections=0: expected at least 1"),
        ({"timeout_s": 0}, "expected a positive number"),
        ({"gripper": "left"}, "expected one of as_is, sign, open_above_half"),
        ({"api_key": "sesame"}, "api_key is not taken"),
        ({"api_key_env": "NOT_THERE"}, "api_key_env=NOT_THERE: there is no such environment variable"),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(PolicyError, match=message):
        make_policy("openpi", **options)


def test_the_key_is_read_from_the_environment_and_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    def handle(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        assert connection.request is not None
        host.seen.append(connection.request.headers.get("Authorization"))
        connection.send(numpy_msgpack.pack({}))
        for _ in messages(connection):
            connection.send(numpy_msgpack.pack({"actions": chunk(0)}))

    monkeypatch.setenv("SERVER_KEY", "sesame")
    with websocket_host(handle) as host:
        for options in ({"api_key_env": "SERVER_KEY"}, {}):
            env = SeeingEnv([1], [0])
            policy = started(policy_of(host.port, **options), env)
            policy.act(env)
            policy.close()
    assert host.seen == ["Api-Key sesame", None]


def test_the_harness_counts_a_server_that_fails_as_errors_not_as_failures(tmp_path: Path) -> None:
    def fail_late(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(numpy_msgpack.pack({}))
        for message in connection:
            host.seen.append(message)
            if len(host.seen) > 5:
                connection.send("RuntimeError: out of memory")
                return
            connection.send(numpy_msgpack.pack({"actions": chunk(0.1)}))

    world = FakeWorld()
    make = Simulator(world.simulator.suite, lambda suite, *, tasks, episodes, **options: SeeingEnv(tasks, episodes))
    with websocket_host(fail_late) as host:
        config = EvalConfig(suite="fake_suite", policy="openpi", policy_args={**QUICK, "port": host.port}, tasks="0")
        result = evaluate(config, begin(config, tmp_path / "results"), simulator=make)
    assert [record.error != "" for record in result.records] == [False] * 4 + [True]
    assert all(record.success for record in result.records if not record.error)
    assert result.causes == (
        f"PolicyServerError: policy server openpi at 127.0.0.1:{host.port}: it reports an error: "
        "RuntimeError: out of memory",
    )
