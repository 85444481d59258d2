"""Requests made from the schema, valid and not: the server never fails, and every answer has the promised shape."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import not_a_server_error
from schemathesis.core.result import Ok
from schemathesis.schemas import APIOperation, BaseSchema
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from support.live_world import config, session
from vecenv_eval.panel.session import Session
from vecenv_eval.web.app import create_app
from vecenv_eval.web.settings import ServeSettings

CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


SLOW = (HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large, HealthCheck.large_base_example)


@pytest.fixture(scope="module")
def live() -> Iterator[Session]:
    with session(config=config(max_steps=50)) as live:
        live.wait_until("ready", timeout=30)
        yield live


@pytest.fixture(scope="module")
def api(live: Session) -> BaseSchema:
    limits = ServeSettings(allowed_hosts=("testserver",), requests_per_second=100_000.0, nodes=False)
    return schemathesis.openapi.from_asgi("/api/openapi.json", create_app(live, limits))


@pytest.mark.parametrize("mode", list(GenerationMode))
def test_no_request_makes_the_server_fail(api: BaseSchema, live: Session, mode: GenerationMode) -> None:
    asked = 0

    def check(operation: APIOperation) -> None:
        @given(operation.as_strategy(generation_mode=mode))
        @settings(max_examples=6, suppress_health_check=SLOW, derandomize=True)
        def ask(case: schemathesis.Case) -> None:
            nonlocal asked
            asked += 1
            case.call_and_validate(headers={"X-Writer": "schemathesis-1"}, checks=CHECKS)

        ask()

    for found in api.get_all_operations():
        assert isinstance(found, Ok), found
        with suppress(Unsatisfiable):  # nothing about it can be wrong
            check(found.ok())
    assert asked > 30
    assert live.state().state != "error"


def test_the_session_still_works_afterwards(live: Session) -> None:
    live.build(config())
    live.wait_until("ready", timeout=20)
    live.act("play")
    assert live.wait_until("finished", timeout=20).finished == 6
