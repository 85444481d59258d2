"""Routes of the server: what they answer, how they refuse, who may write, and the schema."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from fastapi.testclient import TestClient
from support.live_world import LiveWorld, config, session
from vecenv_eval.panel.session import Session
from vecenv_eval.web.app import create_app
from vecenv_eval.web.settings import ServeSettings
from vecenv_eval.web.writer import Writers

import vecenv

WRITER = {"X-Writer": "first-client"}
OTHER = {"X-Writer": "other-client"}


@pytest.fixture(scope="module")
def live() -> Iterator[Session]:
    with session() as live:
        live.wait_until("ready", timeout=30)
        yield live


@pytest.fixture
def client(live: Session) -> Iterator[TestClient]:
    with TestClient(create_app(live), base_url="http://127.0.0.1:8000", raise_server_exceptions=False) as client:
        live.build(config())
        live.wait_until("ready", timeout=20)
        yield client


def refused(answer: Any, status: int, text: str, field: str | None = None) -> None:
    """An answer is a refusal of the one shape."""
    assert answer.status_code == status, answer.text
    body = answer.json()
    assert set(body) == {"error", "field"}
    assert text in body["error"], body
    assert body["field"] == field
    assert "Traceback" not in answer.text


def test_health_says_the_version(client: TestClient) -> None:
    assert client.get("/api/health").json() == {"status": "ok", "version": vecenv.__version__}


def test_the_session_has_every_field_of_its_state(client: TestClient) -> None:
    state = client.get("/api/session").json()
    assert state["state"] == "ready"
    assert state["num_slots"] == 6
    assert state["slots"][4]["episode_id"] == "fake_suite/1/1"
    assert state["fields"] == {"suite": "fake_suite", "task": 0, "episode": 0}
    assert state["writer"] is False
    assert state["planning"] is None


def test_actions_answer_with_their_signal_and_the_state(client: TestClient) -> None:
    answer = client.post("/api/panel/actions", json={"action": "step", "ticks": 3}, headers=WRITER).json()
    assert (answer["state"], answer["signal_name"], answer["session"]["tick"]) == ("paused", "run_start", 3)
    assert answer["session"]["writer"] is True
    assert client.get("/api/session/history?slot=4").json()["step"] == [0, 1, 2]
    answer = client.post("/api/panel/actions", json={"action": "reset"}, headers=WRITER).json()
    assert (answer["state"], answer["signal_name"]) == ("ready", "episode_reset")


def test_a_speed_limit_is_part_of_the_state(client: TestClient) -> None:
    answer = client.post("/api/session/speed", json={"ticks_per_second": 7.5}, headers=WRITER)
    assert answer.json()["ticks_per_second"] == 7.5
    answer = client.post("/api/session/speed", json={"ticks_per_second": None}, headers=WRITER)
    assert answer.json()["ticks_per_second"] is None


def test_only_one_client_writes_until_it_lets_go(client: TestClient) -> None:
    step = {"action": "step"}
    assert client.post("/api/panel/actions", json=step, headers=WRITER).status_code == 200
    refused(client.post("/api/panel/actions", json=step, headers=OTHER), 409, "another client drives", "X-Writer")
    assert client.get("/api/session", headers=OTHER).json()["writer"] is False
    assert client.get("/api/session", headers=OTHER).json()["writer_held"] is True
    assert client.delete("/api/writer", headers=WRITER).json() == {"ok": True}
    assert client.post("/api/panel/actions", json=step, headers=OTHER).status_code == 200
    refused(client.post("/api/panel/actions", json=step), 400, "X-Writer", "X-Writer")
    refused(client.delete("/api/writer"), 400, "X-Writer", "X-Writer")


def test_a_silent_writer_loses_what_it_holds_and_one_that_shows_itself_keeps_it() -> None:
    now = [0.0]
    writers = Writers(60.0, clock=lambda: now[0])
    writers.claim("session", "one")
    now[0] = 59.0
    writers.touch("one")
    now[0] = 118.0
    assert writers.holds("session", "one")
    now[0] = 120.0
    writers.claim("session", "two")
    assert not writers.holds("session", "one")
    now[0] = 240.0
    writers.touch(None)  # a reader without a name, after the writer has fallen silent
    assert not writers.is_held("session")


@pytest.mark.parametrize(
    ("path", "body", "field"),
    [
        ("/api/panel/actions", {"action": "explode"}, "action"),
        ("/api/panel/actions", {"action": "step", "ticks": 0}, "ticks"),
        ("/api/panel/actions", {"action": "step", "ticks": "3"}, "ticks"),
        ("/api/panel/actions", {"action": "step", "more": 1}, "more"),
        ("/api/panel/actions", [], None),
        ("/api/panel/fields", {"name": "robot", "value": 1}, "name"),
        ("/api/panel/fields", {"name": "task", "value": 1.5}, "value"),
        ("/api/session/speed", {"ticks_per_second": -1}, "ticks_per_second"),
        ("/api/session", {"suite": ""}, "suite"),
        ("/api/session", {"suite": "fake_suite", "num_slots": 10**9}, "num_slots"),
        ("/api/session", {"suite": "fake_suite", "policy_args": [1]}, "policy_args"),
    ],
)
def test_a_wrong_body_is_refused_with_its_field(client: TestClient, path: str, body: Any, field: str | None) -> None:
    answer = client.post(path, json=body, headers=WRITER)
    assert answer.status_code == 422, answer.text
    assert answer.json()["field"] == field


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"NaN", b'"text"', b"null", b'{"action": "play"', b"[1,2"])
def test_what_is_no_json_object_is_refused(client: TestClient, content: bytes) -> None:
    answer = client.post("/api/panel/actions", content=content, headers={**WRITER, "content-type": "application/json"})
    assert answer.status_code == 422
    assert set(answer.json()) == {"error", "field"}


@pytest.mark.parametrize(
    ("body", "status", "text", "field"),
    [
        ({"policy": "os:system"}, 403, "Python code", "policy"),
        ({"policy": "openpi", "policy_args": {"host": "10.0.0.1"}}, 403, "another server", "policy"),
        ({"policy": "voxposer", "policy_args": {"replay": "/etc"}}, 403, "'replay' is not open", "policy_args"),
        ({"policy": "voxposer", "policy_args": {"model": "gpt-x"}}, 403, "'model' is not open", "policy_args"),
        ({"policy": "voxposer", "policy_args": {"perception": "a/../b"}}, 422, "short word", "policy_args"),
        ({"policy": "zero", "policy_args": {"gripper": 1e30}}, 422, "moderate", "policy_args"),
        ({"policy_args": {"gripper": 1}}, 422, "name the policy", "policy_args"),
        ({"env_args": {"scenes": "/etc"}}, 403, "'scenes' is not open", "env_args"),
        ({"env_args": {"render": {"height": 100_000}}}, 422, "at most 1024", "env_args"),
        ({"env_args": {"render": {"cameras": []}}}, 403, "'cameras' is not open", "env_args"),
        ({"env_args": {"render": "x"}}, 422, "mapping", "env_args"),
        ({"num_slots": 65}, 422, "at most 64", "num_slots"),
    ],
)
def test_clients_may_not_have_code_run_nor_files_read(
    client: TestClient, body: dict[str, Any], status: int, text: str, field: str
) -> None:
    refused(client.post("/api/session", json={"suite": "libero_goal", **body}, headers=WRITER), status, text, field)
    assert client.get("/api/session").json()["suite"] == "fake_suite"


def test_a_server_that_trusts_its_clients_takes_their_code(live: Session) -> None:
    app = create_app(live, ServeSettings(trust_clients=True))
    with TestClient(app, base_url="http://127.0.0.1") as client:
        names = [row["name"] for row in client.get("/api/policies").json()["policies"]]
        assert "openpi" in names
        answer = client.post("/api/session", json={"suite": "libero_goal", "policy": "os:nothing"}, headers=WRITER)
        refused(answer, 422, "no class 'nothing'")


def test_suites_tasks_and_policies_are_those_of_the_registry(client: TestClient) -> None:
    suites = client.get("/api/catalog").json()["suites"]
    assert [row["name"] for row in suites] == list(vecenv.list_suites())
    tasks = client.get("/api/catalog/libero_goal").json()["tasks"]
    assert (len(tasks), tasks[0]["task"], tasks[0]["num_episodes"]) == (10, 0, 50)
    named = client.get("/api/catalog/simpler/bridge").json()["tasks"]
    assert named[0]["task"] == vecenv.list_tasks("simpler/bridge")[0].name
    refused(client.get("/api/catalog/libero_gaol"), 422, "did you mean libero_goal")
    names = [row["name"] for row in client.get("/api/policies").json()["policies"]]
    assert "voxposer" in names
    assert "openpi" not in names


def test_addresses_that_are_not_there_and_wrong_methods_are_refused_alike(client: TestClient) -> None:
    refused(client.get("/api/nothing"), 404, "nothing at this address")
    refused(client.put("/api/session"), 405, "method")
    refused(client.get("/api/session?slot=-1"), 422, "slot", "slot")
    refused(client.get("/api/session/history?slot=77"), 404, "no slot 77")


def test_an_action_out_of_turn_is_a_conflict(client: TestClient, live: Session) -> None:
    with Session(simulator=LiveWorld().simulator) as idle:
        app = create_app(idle)
        with TestClient(app, base_url="http://127.0.0.1") as other:
            refused(other.post("/api/panel/actions", json={"action": "play"}, headers=WRITER), 409, "nothing is built")
            refused(
                other.post("/api/panel/fields", json={"name": "task", "value": 0}, headers=WRITER), 409, "suite first"
            )


def test_requests_that_would_wait_too_long_in_line_are_refused_and_reading_goes_on(
    client: TestClient, live: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting, release = threading.Semaphore(0), threading.Event()

    def slow(action: str, ticks: int) -> None:
        waiting.release()
        release.wait(20)

    monkeypatch.setattr(live, "act", slow)
    with ThreadPoolExecutor(8) as pool:
        asked = [
            pool.submit(client.post, "/api/panel/actions", json={"action": "play"}, headers=WRITER) for _ in "12345678"
        ]
        for _ in asked:
            assert waiting.acquire(timeout=20)
        refused(client.post("/api/panel/actions", json={"action": "play"}, headers=WRITER), 503, "wait for the session")
        assert client.get("/api/session").status_code == 200
        release.set()
        assert {each.result(20).status_code for each in asked} == {200}


def test_a_failure_of_the_server_shows_no_traceback(client: TestClient, live: Session) -> None:
    def broken(slot: int = 0) -> None:
        raise RuntimeError("secret detail")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live, "history", broken)
        answer = client.get("/api/session/history")
    refused(answer, 500, "its log says how")
    assert "secret detail" not in answer.text


def test_the_schema_names_every_route(client: TestClient) -> None:
    paths = client.get("/api/openapi.json").json()["paths"]
    assert {
        "/api/health",
        "/api/login",
        "/api/catalog",
        "/api/catalog/{suite}",
        "/api/policies",
        "/api/session",
        "/api/session/history",
        "/api/session/speed",
        "/api/panel/fields",
        "/api/panel/actions",
        "/api/writer",
        "/api/nodes",
        "/api/nodes/{node_type}",
    } <= set(paths)
