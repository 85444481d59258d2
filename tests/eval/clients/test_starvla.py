"""The StarVLA client: batched examples, and errors within answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.policy_servers import QUICK, SeeingEnv, WebSocketHost, chunk, messages, websocket_host
from vecenv_eval.clients.codecs import numpy_msgpack
from vecenv_eval.clients.errors import PolicyServerError
from vecenv_eval.policies import Policy, make_policy
from websockets.sync.server import ServerConnection


def answer_all(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
    connection.send(numpy_msgpack.pack({"action_chunk_size": 3, "available_unnorm_keys": ["franka"]}))
    for message in messages(connection):
        host.seen.append(request := numpy_msgpack.unpack(message))
        actions = np.stack([chunk(float(example["image"][0][0, 0, 0]), 8) for example in request["examples"]])
        data = {"status": "ok", "ok": True, "type": "inference_result", "data": {"actions": actions}}
        connection.send(numpy_msgpack.pack(data))


def acted(port: int, env: SeeingEnv, ticks: int = 1, **options: Any) -> np.ndarray:
    policy: Policy = make_policy("starvla", **{**QUICK, "port": port, **options})
    policy.reset(env, env.reset())
    actions = []
    for _ in range(ticks):
        actions.append(np.asarray(policy.act(env)))
        env.step_continuous(actions[-1])
    return np.stack(actions)


def test_the_request_holds_examples_and_the_chunk_size_is_the_servers() -> None:
    env = SeeingEnv([1], [0, 1, 2], max_steps=100)
    with websocket_host(answer_all) as host:
        actions = acted(host.port, env, ticks=4, batch=2)
    assert [len(request["examples"]) for request in host.seen] == [2, 1, 2, 1]
    example = host.seen[0]["examples"][1]
    assert set(example) == {"image", "lang"}
    assert [image.shape for image in example["image"]] == [(224, 224, 3)] * 2
    assert example["lang"] == "do thing 1"
    settings = {key: value for key, value in host.seen[0].items() if key != "examples"}
    assert settings == {"unnorm_key": None, "do_sample": False, "use_ddim": True, "num_ddim_steps": 10}
    np.testing.assert_allclose(actions[:, 1, 0], [1, 1.01, 1.02, 1])


def test_a_gripper_above_one_half_opens() -> None:
    with websocket_host(answer_all) as host:
        actions = acted(host.port, SeeingEnv([1], [0, 1]))
    np.testing.assert_array_equal(actions[0, :, 6], [1, -1])


def test_the_state_and_the_statistics_are_sent_when_asked_for() -> None:
    with websocket_host(answer_all) as host:
        acted(host.port, SeeingEnv([1], [0]), send_state=True, unnorm_key="franka", wrist=False)
    assert host.seen[0]["examples"][0]["state"].shape == (1, 8)
    assert len(host.seen[0]["examples"][0]["image"]) == 1
    assert host.seen[0]["unnorm_key"] == "franka"


@pytest.mark.parametrize(
    ("answer", "cause"),
    [
        ({"ok": False, "error": {"message": "unnorm_key not specified"}}, "reports an error: unnorm_key not specified"),
        ({"ok": True, "data": {"normalized_actions": 1}}, "has no 'actions' for 1 examples"),
        ({"ok": True, "data": {"actions": np.zeros((2, 8, 7))}}, "has no 'actions' for 1 examples"),
        ([1], "the answer is no map but list"),
    ],
)
def test_unusable_answers_are_refused(answer: object, cause: str) -> None:
    def misanswer(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        connection.send(numpy_msgpack.pack({"action_chunk_size": 8}))
        for _ in connection:
            connection.send(numpy_msgpack.pack(answer))

    with websocket_host(misanswer) as host, pytest.raises(PolicyServerError, match=cause):
        acted(host.port, SeeingEnv([1], [0]))
