"""Nodes over HTTP, with a node set of the tests' own: what is listed, called, refused, and how values become JSON."""

from __future__ import annotations

import base64
import io
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from pydantic import BaseModel, ConfigDict
from vecenv_eval.web.context import Context
from vecenv_eval.web.errors import install_handlers
from vecenv_eval.web.routes_nodes import NodeHost, nodes_router, plain
from vecenv_eval.web.settings import ServeSettings

WRITER = {"X-Writer": "first-client"}


class Options(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    factor: int = 1
    model: str = "offline/libero"


class Double:
    node_type = "numbers__double"
    config: ClassVar[type[BaseModel]] = Options
    inputs: ClassVar[list[Any]] = [SimpleNamespace(name="value"), SimpleNamespace(name="hold")]

    def __init__(self) -> None:
        self.release = threading.Event()
        self.threads: set[str] = set()

    def describe(self) -> dict[str, Any]:
        port = {"name": "value", "type": "ANY", "optional": False, "description": "a number"}
        return {
            "node_type": self.node_type,
            "display_name": "Double",
            "description": "Twice a number.",
            "inputs": [port],
            "outputs": [{**port, "name": "result"}],
            "config": Options.model_json_schema(),
            "family": "method",
        }

    def run(self, inputs: Mapping[str, Any], config: Mapping[str, Any], *, node: str = "") -> dict[str, Any]:
        self.threads.add(threading.current_thread().name)
        if inputs.get("hold"):
            self.release.wait(20)
        return {"result": 2 * inputs["value"] * config.get("factor", 1), "node": node, "error": ""}


class Panel:
    def fields(self) -> list[Any]:
        return [SimpleNamespace(model_dump=lambda: {"name": "task", "value": 0})]

    def set_field(self, name: str, value: Any) -> Any:
        return self._answer("" if name == "task" else f"there is no field {name}")

    def action(self, name: str) -> Any:
        return self._answer("")

    def _answer(self, error: str) -> Any:
        return SimpleNamespace(model_dump=lambda: {"state": "idle", "fields": {"task": 0}, "error": error})


class Numbers:
    display_name = "Numbers"

    def __init__(self, panel: Panel | None) -> None:
        self.panel, self.tool, self.ended = panel, Double(), False

    def get_tools(self) -> list[Double]:
        return [self.tool]

    def shutdown(self) -> None:
        self.ended = True


@pytest.fixture
def numbers() -> Numbers:
    return Numbers(Panel())


@pytest.fixture
def client(numbers: Numbers) -> Iterator[TestClient]:
    app, context = FastAPI(), Context(None, ServeSettings())
    install_handlers(app)
    host = NodeHost({"numbers": numbers})
    app.include_router(nodes_router(context, host))
    with TestClient(app) as client:
        yield client
    numbers.tool.release.set()
    host.close()


def test_the_catalogue_has_ports_and_the_schema_of_the_config(client: TestClient) -> None:
    catalogue = client.get("/api/nodes").json()
    (node,) = catalogue["nodes"]
    assert (node["node_type"], node["node_set"], node["display_name"]) == ("numbers__double", "numbers", "Double")
    assert node["inputs"][0]["type"] == "ANY"
    assert "factor" in node["config"]["properties"]
    assert catalogue["sets"] == [{"name": "numbers", "display_name": "Numbers", "has_panel": True}]


def test_a_node_is_called_on_one_thread_with_inputs_config_and_node(client: TestClient, numbers: Numbers) -> None:
    body = {"inputs": {"value": 4}, "config": {"factor": 3}, "node": "n1"}
    for _ in range(5):
        answer = client.post("/api/nodes/numbers__double", json=body, headers=WRITER)
        assert answer.json() == {"outputs": {"result": 24, "node": "n1", "error": ""}}
    assert len(numbers.tool.threads) == 1


@pytest.mark.parametrize(
    ("node", "body", "status", "text"),
    [
        ("numbers__treble", {}, 404, "no node"),
        ("numbers__double", {"inputs": {"other": 1}}, 422, "no port 'other'"),
        ("numbers__double", {"config": {"factor": "x"}}, 422, "config.factor"),
        ("numbers__double", {"config": {"speed": 1}}, 422, "config.speed"),
        ("numbers__double", {"config": {"model": "gpt-x"}}, 403, "language model"),
        ("numbers__double", {"inputs": []}, 422, "inputs"),
    ],
)
def test_what_a_node_does_not_take_is_refused(
    client: TestClient, node: str, body: dict[str, Any], status: int, text: str
) -> None:
    answer = client.post(f"/api/nodes/{node}", json=body, headers=WRITER)
    assert answer.status_code == status
    assert text in answer.json()["error"]


def test_a_node_set_has_one_writer(client: TestClient) -> None:
    body = {"inputs": {"value": 1}}
    assert client.post("/api/nodes/numbers__double", json=body, headers=WRITER).status_code == 200
    assert client.post("/api/nodes/numbers__double", json=body, headers={"X-Writer": "other-one"}).status_code == 409
    assert client.post("/api/nodes/numbers__double", json=body).status_code == 400


def test_panels_are_read_and_driven_and_their_errors_are_refusals(client: TestClient) -> None:
    assert client.get("/api/panels/numbers").json()["fields"][0]["name"] == "task"
    changed = client.post("/api/panels/numbers/fields", json={"name": "task", "value": 1}, headers=WRITER)
    assert changed.json()["state"] == "idle"
    wrong = client.post("/api/panels/numbers/fields", json={"name": "robot", "value": 1}, headers=WRITER)
    assert (wrong.status_code, wrong.json()["error"]) == (422, "there is no field robot")
    assert client.post("/api/panels/numbers/actions", json={"action": "play"}, headers=WRITER).status_code == 200
    assert client.get("/api/panels/letters").status_code == 404


def test_calls_that_would_wait_too_long_in_line_are_refused(client: TestClient, numbers: Numbers) -> None:
    def call(_: int) -> int:
        body = {"inputs": {"value": 1, "hold": True}}
        return client.post("/api/nodes/numbers__double", json=body, headers=WRITER).status_code

    with ThreadPoolExecutor(12) as pool:
        calls = [pool.submit(call, number) for number in range(12)]
        deadline = time.monotonic() + 20
        while sum(each.done() for each in calls) < 4:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        numbers.tool.release.set()
        assert sorted(each.result(20) for each in calls) == [200] * 8 + [503] * 4


def test_only_sets_that_were_called_are_shut_down(numbers: Numbers) -> None:
    app, host = FastAPI(), NodeHost({"numbers": numbers})
    app.include_router(nodes_router(Context(None, ServeSettings()), host))
    host.close()
    assert not numbers.ended
    with TestClient(app) as client:
        client.post("/api/nodes/numbers__double", json={"inputs": {"value": 1}}, headers=WRITER)
    host.close()
    assert numbers.ended


def test_values_of_ports_become_json() -> None:
    image = np.zeros((4, 5, 3), np.uint8)
    image[1, 2] = 200
    encoded = plain({"rgb": image})["rgb"]
    assert encoded["type"] == "image/png"
    from PIL import Image

    shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded["base64"]))))
    assert (shown == image).all()
    assert plain(np.array([1.5, np.nan])) == [1.5, None]
    assert plain({"a": (np.float32(0.5), np.bool_(True), float("inf"), None, {3: "x"})}) == {
        "a": [0.5, True, None, None, {"3": "x"}]
    }
    assert plain(Options()) == {"factor": 1, "model": "offline/libero"}


def test_the_installed_node_sets_are_served() -> None:
    nodes = pytest.importorskip("vecenv.interop.nodes")
    host = NodeHost()
    try:
        assert {tool.node_type for each in nodes.node_sets().values() for tool in each.get_tools()} <= set(host.tools)
    finally:
        host.close()
