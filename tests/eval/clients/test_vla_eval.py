"""The vla-eval client: hello, episodes, one observation a tick and slot, and a session for every slot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.policy_servers import QUICK, SeeingEnv, WebSocketHost, chunk, websocket_host
from vecenv_eval.clients.codecs import vla_eval as codec
from vecenv_eval.clients.errors import PolicyServerError
from vecenv_eval.clients.vla_eval import VlaEvalPolicy, shortest_rotation
from vecenv_eval.policies import make_policy
from websockets.sync.server import ServerConnection

HELLO = {"harness_version": "0.8.0", "protocol_version": 1, "capabilities": {}}


def send(connection: ServerConnection, kind: str, payload: dict[str, Any], seq: int) -> None:
    connection.send(codec.pack(codec.Message(kind, payload, seq)))


class Harness:
    """A model server: it notes what each connection says and answers 0.1, 0.2, ... to the observations of each."""

    def __init__(self, hello: dict[str, Any] | None = None, drop_after: int | None = None) -> None:
        self.hello = {**HELLO, **(hello or {})}
        self.drop_after = drop_after
        self.said: dict[int, list[codec.Message]] = {}

    def __call__(self, host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        said = self.said.setdefault(number, [])
        for data in connection:
            assert isinstance(data, bytes)
            said.append(message := codec.unpack(data))
            observations = self.kinds(number).count(codec.OBSERVATION)
            if message.kind == codec.HELLO:
                send(connection, codec.HELLO, self.hello, message.seq)
            elif message.kind == codec.OBSERVATION:
                if number == 0 and observations == self.drop_after:
                    return
                send(connection, codec.ACTION, self.action(observations), message.seq)

    def action(self, count: int) -> dict[str, Any]:
        return {"actions": np.full(7, count / 10, np.float32)}

    def kinds(self, number: int) -> list[str]:
        return [message.kind for message in self.said[number]]


def policy_of(port: int, **options: Any) -> VlaEvalPolicy:
    policy = make_policy("vla-eval", **{**QUICK, "port": port, **options})
    assert isinstance(policy, VlaEvalPolicy)
    return policy


def run(harness: Any, env: SeeingEnv, ticks: int, **options: Any) -> list[np.ndarray]:
    with websocket_host(harness) as host:
        policy = policy_of(host.port, **options)
        policy.reset(env, env.reset())
        actions = []
        for _ in range(ticks):
            actions.append(policy.act(env))
            env.step_continuous(actions[-1])
        policy.reset(env, env.reset())  # which ends the episodes
        policy.close()
    return actions


def test_every_slot_has_a_session_that_follows_the_protocol() -> None:
    harness, env = Harness(), SeeingEnv([0, 1], [0], max_steps=4)  # the first slot ends after two ticks
    actions = run(harness, env, 4)
    start, observe, end = codec.EPISODE_START, codec.OBSERVATION, codec.EPISODE_END
    assert harness.kinds(0) == [codec.HELLO, start, observe, observe, end]
    assert harness.kinds(1) == [codec.HELLO, start, *[observe] * 4, end]
    assert harness.said[0][1].payload == {
        "task": {"name": "do thing 0", "suite": "fake_suite", "task_id": 0, "episode_idx": 0}
    }
    assert harness.said[0][-1].payload == {"metrics": {"success": True}, "steps": 2}
    assert harness.said[1][0].payload["protocol_version"] == 1
    assert [message.seq for message in harness.said[1]] == list(range(1, 8))
    np.testing.assert_allclose(np.stack(actions)[:, 1, 0], [0.1, 0.2, 0.3, 0.4], atol=1e-6)


def test_a_positive_gripper_closes_and_a_negative_one_opens() -> None:
    class Opening(Harness):
        def action(self, count: int) -> dict[str, Any]:
            return {"actions": np.array([0.5] * 6 + [-0.2 if count == 1 else 0.2])}

    actions = run(Opening(), SeeingEnv([1], [0]), 2)
    assert [action[0, 6] for action in actions] == [-1, 1]


def test_the_observation_is_what_the_hello_asks_for() -> None:
    plain, full = Harness(), Harness({"observation_params": {"send_wrist_image": True, "send_state": True}})
    run(plain, SeeingEnv([1], [0]), 1)
    run(full, SeeingEnv([1], [0]), 1)
    observation = plain.said[0][2].payload
    assert set(observation) == {"images", "task_description"}
    assert set(observation["images"]) == {"agentview"}
    assert observation["images"]["agentview"].shape == (256, 256, 3)
    observation = full.said[0][2].payload
    assert set(observation["images"]) == {"agentview", "wrist"}
    assert observation["states"].shape == (8,)
    assert observation["task_description"] == "do thing 1"


def test_what_the_user_says_goes_before_what_the_hello_asks() -> None:
    harness = Harness({"observation_params": {"send_wrist_image": True, "send_state": True}})
    run(harness, SeeingEnv([1], [0]), 1, send_state=False, image_size=0, image_format="raw")
    observation = harness.said[0][2].payload
    assert "states" not in observation
    assert observation["images"]["wrist"].shape == (64, 64, 3)


def test_a_chunk_is_executed_before_the_next_observation() -> None:
    class Chunking(Harness):
        def action(self, count: int) -> dict[str, Any]:
            return {"actions": chunk(float(count), 3)}

    harness = Chunking()
    actions = run(harness, SeeingEnv([1], [0]), 5)
    np.testing.assert_allclose([action[0, 0] for action in actions], [1, 1.01, 1.02, 2, 2.01])


def test_a_lost_session_is_opened_again_and_its_episode_announced_again() -> None:
    harness, env = Harness(drop_after=2), SeeingEnv([1], [0])
    run(harness, env, 3)
    assert harness.kinds(0) == [codec.HELLO, codec.EPISODE_START, codec.OBSERVATION, codec.OBSERVATION]
    assert harness.kinds(1)[:3] == [codec.HELLO, codec.EPISODE_START, codec.OBSERVATION]


def test_a_slot_that_begins_again_ends_one_episode_and_starts_another() -> None:
    harness, env = Harness(), SeeingEnv([1], [0, 1])
    with websocket_host(harness) as host:
        policy = policy_of(host.port)
        policy.reset(env, env.reset())
        policy.act(env)
        policy.reset_slots(env, env.reset(), np.array([1]))
        policy.act(env)
        policy.close()
    start, observe = codec.EPISODE_START, codec.OBSERVATION
    assert harness.kinds(0) == [codec.HELLO, start, observe, observe]
    assert harness.kinds(1) == [codec.HELLO, start, observe, codec.EPISODE_END, start, observe]


@pytest.mark.parametrize(
    ("hello", "cause"),
    [
        ({"protocol_version": 2}, "speaks protocol 2"),
        ({"observation_params": {"absolute_action": True}}, "absolute actions"),
    ],
)
def test_servers_that_do_not_fit_are_refused(hello: dict[str, Any], cause: str) -> None:
    with pytest.raises(PolicyServerError, match=cause):
        run(Harness(hello), SeeingEnv([1], [0]), 1)


def test_an_error_message_is_the_servers_error() -> None:
    def fail(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        for data in connection:
            assert isinstance(data, bytes)
            message = codec.unpack(data)
            if message.kind == codec.HELLO:
                send(connection, codec.HELLO, HELLO, message.seq)
            elif message.kind == codec.OBSERVATION:
                send(connection, codec.ERROR, {"error": "observation_failed: KeyError: 'wrist'"}, message.seq)

    with pytest.raises(PolicyServerError, match="reports an error: observation_failed: KeyError: 'wrist'"):
        run(fail, SeeingEnv([1], [0]), 1)


def test_an_answer_to_another_observation_is_refused() -> None:
    def shift(host: WebSocketHost, connection: ServerConnection, number: int) -> None:
        for data in connection:
            assert isinstance(data, bytes)
            message = codec.unpack(data)
            kind = codec.HELLO if message.kind == codec.HELLO else codec.ACTION
            send(connection, kind, {**HELLO, "actions": np.zeros(7)}, message.seq - 1)

    with pytest.raises(PolicyServerError, match="expected the action for message 3, got action 1"):
        run(shift, SeeingEnv([1], [0]), 1)


def test_rotations_take_the_shorter_way() -> None:
    state = np.zeros((3, 8))
    state[0, 3], state[1, 4], state[2, 3:6] = 3.0, 4.0, [0.0, 3.0, 4.0]
    shorter = shortest_rotation(state)
    np.testing.assert_allclose(shorter[0], state[0])
    np.testing.assert_allclose(shorter[1, 4], 4 - 2 * np.pi)
    np.testing.assert_allclose(shorter[2, 3:6], np.array([0, 0.6, 0.8]) * (5 - 2 * np.pi))


def test_images_travel_as_png_without_loss() -> None:
    image = np.random.default_rng(0).integers(0, 256, (5, 6, 3), np.uint8)
    for shown in (image, image[..., :1]):
        for image_format in codec.IMAGE_FORMATS:
            packed = codec.pack(codec.Message(codec.OBSERVATION, {"image": shown}, 1), image_format)
            assert (b"PNG" in packed) == (image_format == "png")
            np.testing.assert_array_equal(codec.unpack(packed).payload["image"], shown)
