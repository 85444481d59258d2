"""The GR00T client: one request for many slots, three ways of packing, and a socket that survives its server."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zmq
from support.policy_servers import QUICK, SeeingEnv, free_port
from vecenv_eval.clients.codecs import gr00t as codec
from vecenv_eval.clients.errors import PolicyServerError
from vecenv_eval.clients.gr00t import ACTION_KEYS
from vecenv_eval.policies import Policy, PolicyError, make_policy

MODALITIES = {
    codec.N1_5: {"video": {"__ModalityConfig_class__": True, "as_json": '{"delta_indices": [0]}'}},
    codec.N1_6: {"video": {"__ModalityConfig_class__": True, "as_json": {"delta_indices": [0]}}},
    codec.N1_7: {"video": {"__ModalityConfig__": True, "as_json": {"delta_indices": [0]}}},
}


class Server:
    """A REP server of one release: 16 actions a slot, whose k-th is the slot's colour plus k / 100."""

    def __init__(self, release: str = codec.N1_6, modalities: object = None) -> None:
        self.release, self.modalities = release, modalities or MODALITIES[release]
        self.seen: list[tuple[str, Any]] = []

    def __call__(self, data: bytes) -> object:
        request, packed = codec.unpack_with_release(data)
        self.seen.append((request["endpoint"], request.get("data")))
        if request["endpoint"] == "get_modality_config":
            return self.modalities
        if request["endpoint"] != "get_action":
            return {"status": "ok"}
        assert packed == (codec.N1_7 if self.release == codec.N1_7 else codec.N1_6)
        wrapped = self.release != codec.N1_5
        actions = self.actions(request["data"]["observation"] if wrapped else request["data"])
        return [actions, {}] if wrapped else actions

    def actions(self, observation: dict[str, Any]) -> dict[str, np.ndarray]:
        nested = "video" in observation
        video = observation["video"]["image"] if nested else observation["video.image"]
        rows = (video[:, 0, 0, 0, 0].astype(np.float32)[:, None] + np.arange(16, dtype=np.float32) / 100)[..., None]
        return {("" if nested else "action.") + key: rows for key in ACTION_KEYS}

    @property
    def observations(self) -> list[Any]:
        data = [data for endpoint, data in self.seen if endpoint == "get_action"]
        return data if self.release == codec.N1_5 else [each["observation"] for each in data]


@contextlib.contextmanager
def rep_server(answer: Callable[[bytes], object], release: str = codec.N1_6, port: int = 0) -> Iterator[int]:
    """Answer each request until the context is left; an answer of None is never sent."""
    with zmq.Context() as context, context.socket(zmq.REP) as socket, context.socket(zmq.PAIR) as stopped:
        socket.linger = stopped.linger = 0
        socket.bind(f"tcp://127.0.0.1:{port or '*'}")
        bound = int(socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        stopped.bind("inproc://stop")

        def run() -> None:
            poller = zmq.Poller()
            poller.register(socket, zmq.POLLIN)
            poller.register(stopped, zmq.POLLIN)
            while stopped not in dict(poller.poll()):
                reply = answer(socket.recv())
                if reply is None:
                    return
                socket.send(codec.pack(reply, release))

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        try:
            yield bound
        finally:
            with context.socket(zmq.PAIR) as stop:
                stop.connect("inproc://stop")
                stop.send(b"")
                thread.join(timeout=20)


def policy_of(port: int, **options: Any) -> Policy:
    return make_policy("gr00t", **{**QUICK, "port": port, **options})


def acted(port: int, env: SeeingEnv, ticks: int = 1, **options: Any) -> np.ndarray:
    policy = policy_of(port, **options)
    policy.reset(env, env.reset())
    actions = []
    for _ in range(ticks):
        actions.append(np.asarray(policy.act(env)))
        env.step_continuous(actions[-1])
    policy.close()  # type: ignore[attr-defined]
    return np.stack(actions)


@pytest.mark.parametrize("release", codec.RELEASES)
def test_the_release_is_found_out_and_spoken(release: str) -> None:
    server = Server(release)
    with rep_server(server, release) as port:
        actions = acted(port, SeeingEnv([1], [0, 1]), ticks=9)
    np.testing.assert_allclose(actions[:, 1, 0], [1, 1.01, 1.02, 1.03, 1.04, 1.05, 1.06, 1.07, 1], atol=1e-6)
    np.testing.assert_array_equal(actions[0, :, 6], [1, -1])  # above one half opens
    (first, _) = server.observations
    assert first["video.image"].shape == first["video.wrist_image"].shape == (2, 1, 64, 64, 3)
    assert first["video.image"].dtype == np.uint8
    assert first["state.x"].shape == (2, 1, 1)
    assert first["state.gripper"].shape == (2, 1, 2)
    assert first["state.gripper"].dtype == np.float32
    np.testing.assert_allclose(first["state.gripper"][1, 0], [1.6, 1.7])
    assert first["annotation.human.action.task_description"] == ["do thing 1", "do thing 1"]


def test_the_nested_layout_is_for_servers_without_the_simulation_wrapper() -> None:
    server = Server()
    with rep_server(server) as port:
        acted(port, SeeingEnv([1], [0, 1]), layout="nested", language_key="task")
    observation = server.observations[0]
    assert set(observation) == {"video", "state", "language"}
    assert observation["language"] == {"task": [["do thing 1"], ["do thing 1"]]}


def test_a_request_holds_at_most_batch_slots() -> None:
    server = Server()
    with rep_server(server) as port:
        actions = acted(port, SeeingEnv([1], [0, 1, 2, 3, 4]), batch=2, connections=2)
    assert sorted(len(each["video.image"]) for each in server.observations) == [1, 2, 2]
    np.testing.assert_allclose(actions[0, :, 0], range(5))


def test_the_server_is_told_when_a_batch_begins() -> None:
    server = Server()
    with rep_server(server) as port:
        acted(port, SeeingEnv([1], [0]))
    assert [endpoint for endpoint, _ in server.seen] == ["get_modality_config", "ping", "reset", "get_action"]


def test_the_key_is_read_from_the_environment_and_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    tokens: list[object] = []

    class Guarded(Server):
        def __call__(self, data: bytes) -> object:
            tokens.append(codec.unpack_with_release(data)[0].get("api_token"))
            return super().__call__(data)

    monkeypatch.setenv("SERVER_KEY", "sesame")
    with rep_server(Guarded()) as port:
        acted(port, SeeingEnv([1], [0]), api_key_env="SERVER_KEY")
    assert set(tokens) == {"sesame"}


def test_an_error_is_the_servers() -> None:
    class Failing(Server):
        def actions(self, observation: dict[str, Any]) -> dict[str, np.ndarray]:
            return {}

        def __call__(self, data: bytes) -> object:
            answer = super().__call__(data)
            return {"error": "CUDA out of memory"} if self.seen[-1][0] == "get_action" else answer

    with rep_server(Failing()) as port, pytest.raises(PolicyServerError, match="reports an error: CUDA out of memory"):
        acted(port, SeeingEnv([1], [0]))


def test_missing_actions_are_named() -> None:
    class Armless(Server):
        def actions(self, observation: dict[str, Any]) -> dict[str, np.ndarray]:
            return {"action.base": np.zeros((1, 16, 1))}

    with rep_server(Armless()) as port, pytest.raises(PolicyServerError, match=r"no 'action.x'; it has action.base"):
        acted(port, SeeingEnv([1], [0]))


def test_a_server_that_wants_several_frames_is_refused() -> None:
    two = {"video": {"__ModalityConfig__": True, "as_json": {"delta_indices": [-1, 0]}}}
    with rep_server(Server(modalities=two)) as port, pytest.raises(PolicyServerError, match="wants 2 frames"):
        acted(port, SeeingEnv([1], [0]))


def test_a_server_that_is_not_there_is_named() -> None:
    port = free_port()
    with pytest.raises(PolicyServerError, match=rf"gr00t at 127.0.0.1:{port}: no connection after 3 attempts"):
        acted(port, SeeingEnv([1], [0]))


def test_a_server_that_went_away_is_asked_again() -> None:
    env, port = SeeingEnv([1], [0]), free_port()
    policy = policy_of(port, attempts=20)
    with rep_server(Server(), port=port):
        policy.reset(env, env.reset())
    with rep_server(Server(), port=port):
        np.testing.assert_allclose(np.asarray(policy.act(env))[0, 0], 0)
        policy.close()  # type: ignore[attr-defined]


def test_a_server_that_does_not_answer_in_time_is_named() -> None:
    late = pytest.raises(PolicyServerError, match=r"no answer within timeout_s=0.2 seconds")
    with rep_server(lambda data: None) as port, late:
        acted(port, SeeingEnv([1], [0]), timeout_s=0.2)


@pytest.mark.parametrize("options", [{"layout": "deep"}, {"release": "n2"}, {"batch": 0}])
def test_wrong_options_are_named(options: dict[str, Any]) -> None:
    with pytest.raises(PolicyError, match=next(iter(options))):
        policy_of(5555, **options)


def test_another_robots_state_is_refused() -> None:
    class Arm(SeeingEnv):
        def observe_egocentric(self, slots: Any = None) -> Any:
            seen = super().observe_egocentric(slots)
            return type(seen)(state=seen.state[:, :5], images=seen.images)

    with rep_server(Server()) as port, pytest.raises(PolicyError, match="this environment's is 5-D"):
        acted(port, Arm([1], [0]))
