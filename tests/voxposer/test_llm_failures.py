"""What a language model's provider does wrong: what passes is asked again, what stays is an error that says so."""

from __future__ import annotations

import re
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from pathlib import Path
from typing import Any

import pytest
from support.llm_server import HANG, Answer, LlmServer, code, failure
from support.lmps import QUESTION, Model

pytest.importorskip("litellm", reason="the extra voxposer is not installed")

from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.replies import LlmError, ReplyError, Usage

# Failures that pass


PASSING = {
    "429": failure(429, "slow down"),
    "500": failure(500, "oops"),
    "502": failure(502, "gateway"),
    "503": failure(503, "busy"),
    "408": failure(408, "too slow"),
    "a page": Answer(body="<html>busy</html>"),
    "529": failure(529, "overloaded"),
    "a body that is cut off": replace(code("x = 1"), cut=40),
    "events of a stream": Answer(body='data: {"choices": []}\n\n', headers={"Content-Type": "text/event-stream"}),
    "half of a reply": Answer(body='{"choices": [{"mess'),
    "another object": Answer(body={"hello": 1}),
    "a list": Answer(body=[1, 2]),
    "null": Answer(body="null"),
}


@pytest.mark.parametrize("answer", PASSING.values(), ids=PASSING)
def test_transient_failures_are_retried(server: LlmServer, config: LlmConfig, answer: Answer) -> None:
    server.say(answer, answer, "x = 1")
    model = Model(config)
    assert model.complete(QUESTION).text == "x = 1"
    assert len(server.requests) == 3
    assert model.usage == Usage(calls=1, retries=2, prompt_tokens=11, completion_tokens=7, unpriced=1)


def test_pauses_double_with_random_jitter(server: LlmServer, config: LlmConfig) -> None:
    server.say(failure(500, "oops"))
    model = Model(config)
    with pytest.raises(LlmError, match=r"openai/local: .*oops"):
        model.complete(QUESTION)
    assert len(server.requests) == config.attempts
    assert [int(pause // 2) for pause in model.pauses] == [1, 2, 4]
    assert all(0 <= pause - 2 * 2**i <= 1 for i, pause in enumerate(model.pauses))


@pytest.mark.parametrize(("asked", "waited"), [("7", 7.0), ("0.5", 0.5), ("9999", 60.0), ("-3", 0.0)])
def test_retry_after_in_seconds_is_honoured(server: LlmServer, config: LlmConfig, asked: str, waited: float) -> None:
    server.say(failure(429, "slow down", Retry_After=asked), "x = 1")
    model = Model(config)
    model.complete(QUESTION)
    assert model.pauses == [waited]


def test_retry_after_as_a_date_is_honoured(server: LlmServer, config: LlmConfig) -> None:
    then = format_datetime(datetime.now(UTC) + timedelta(seconds=40), usegmt=True)
    server.say(failure(503, "busy", Retry_After=then), "x = 1")
    model = Model(config)
    model.complete(QUESTION)
    assert 20 < model.pauses[0] <= 41


def test_an_invalid_retry_after_falls_back_to_the_default_pause(server: LlmServer, config: LlmConfig) -> None:
    server.say(failure(429, "slow down", Retry_After="soon"), "x = 1")
    model = Model(config)
    model.complete(QUESTION)
    assert 2 <= model.pauses[0] <= 3


def test_timeouts_are_retried(server: LlmServer, config: LlmConfig) -> None:
    server.say(HANG, "x = 1")
    model = Model(replace(config, timeout_s=0.3))
    assert model.complete(QUESTION).text == "x = 1"
    assert model.usage.retries == 1


def test_an_unreachable_server_is_reported_after_all_attempts(config: LlmConfig) -> None:
    model = Model(replace(config, api_base="http://127.0.0.1:9/v1"))
    with pytest.raises(LlmError, match="openai/local: ") as caught:
        model.complete(QUESTION)
    assert not isinstance(caught.value, ReplyError)
    assert model.usage.retries == 3


# Failures that stay


TOO_LONG = "This model's maximum context length is 4096 tokens. However, your messages resulted in 9000 tokens."


@pytest.mark.parametrize(
    ("answer", "permanent"),
    [
        (failure(401, "Incorrect API key provided", "invalid_api_key"), True),
        (failure(402, "Insufficient credits"), True),
        (failure(403, "this project may not"), True),
        (failure(404, "The model `local` does not exist", "model_not_found"), True),
        (failure(429, "You exceeded your current quota, please check your plan", "insufficient_quota"), True),
        (failure(400, TOO_LONG, "context_length_exceeded"), False),
        (failure(400, "the prompt was refused"), False),
        (failure(413, "too large"), False),
    ],
    ids=["key", "credit", "rights", "model", "quota", "context", "other", "size"],
)
def test_what_no_waiting_ends_is_asked_once_and_says_whether_it_ends_the_run(
    server: LlmServer, config: LlmConfig, answer: Answer, permanent: bool
) -> None:
    server.say(answer)
    model = Model(config)
    with pytest.raises(LlmError) as caught:
        model.complete(QUESTION)
    assert answer.body["error"]["message"] in str(caught.value)
    assert (caught.value.permanent, len(server.requests), model.pauses) == (permanent, 1, [])


@pytest.mark.parametrize("answer", [failure(429, "slow down"), failure(500, "oops"), HANG], ids=["429", "500", "slow"])
def test_what_waiting_may_end_is_given_up_after_the_last_attempt_without_ending_the_run(
    server: LlmServer, config: LlmConfig, answer: Answer
) -> None:
    server.say(answer)
    with pytest.raises(LlmError, match=r"\(4 attempts\)$") as caught:
        Model(replace(config, timeout_s=0.2)).complete(QUESTION)
    assert not caught.value.permanent
    assert len(server.requests) == 4


def test_a_refused_connection_does_not_end_the_run(config: LlmConfig) -> None:
    with pytest.raises(LlmError, match=r"Connection error.*\(4 attempts\)") as caught:
        Model(replace(config, api_base="http://127.0.0.1:9/v1")).complete(QUESTION)
    assert not caught.value.permanent


@pytest.mark.parametrize(
    ("name", "hint"), [("gtp-4o", "did you mean gpt-4o"), ("qqqq", "write PROVIDER/MODEL, such as openai/gpt-4o")]
)
def test_a_model_of_no_provider_is_refused_at_once(folder: Path, name: str, hint: str) -> None:
    with pytest.raises(LlmError, match=f"^{name}: .*litellm knows no provider of this model; {hint}") as caught:
        Model(LlmConfig(model=name, api_key="k")).complete(QUESTION)
    assert caught.value.permanent


def test_tokens_and_price_that_nobody_says_are_unknown_and_not_zero(server: LlmServer, config: LlmConfig) -> None:
    body = {name: value for name, value in code("x = 1").body.items() if name != "usage"}
    server.say(Answer(body=body))
    model = Model(replace(config, model="openai/gpt-4o"))
    reply = model.complete(QUESTION)
    assert (reply.prompt_tokens, reply.completion_tokens, reply.cost_usd) == (None, None, None)
    assert (model.usage.calls, model.usage.uncounted, model.usage.unpriced) == (1, 1, 1)


def test_the_same_question_of_several_threads_is_asked_once(server: LlmServer, config: LlmConfig) -> None:
    everyone_waits = threading.Event()

    def answer(request: dict[str, Any]) -> Answer:
        everyone_waits.wait(10)
        return code("x = 1")

    server.answer = answer
    model = Model(config)
    with ThreadPoolExecutor(4) as pool:
        asked = [pool.submit(model.complete, QUESTION) for _ in range(4)]
        while sum(each.running() for each in asked) < 4:
            pass
        everyone_waits.set()
        replies = [each.result() for each in asked]
    assert len(server.requests) == 1
    assert sorted(reply.cached for reply in replies) == [False, True, True, True]


def test_those_who_wait_for_the_same_answer_share_its_failure(server: LlmServer, config: LlmConfig) -> None:
    server.say(failure(400, "no"))
    model, barrier = Model(config), threading.Barrier(3)

    def ask() -> LlmError:
        barrier.wait()
        with pytest.raises(LlmError, match="no") as caught:
            model.complete(QUESTION)
        return caught.value

    with ThreadPoolExecutor(3) as pool:
        errors = [pool.submit(ask) for _ in range(3)]
        assert len({id(each.result()) for each in errors}) == 3
    assert len(server.requests) <= 3


def test_a_closed_model_asks_nothing_again(server: LlmServer, config: LlmConfig) -> None:
    server.say(failure(500, "oops"))
    model = Llm(replace(config, backoff_s=60))
    threading.Timer(0.3, model.close).start()
    with pytest.raises(LlmError, match="oops"):
        model.complete(QUESTION)
    assert len(server.requests) <= 2


@pytest.mark.parametrize("status", [400, 401, 403, 404])
def test_client_errors_are_not_retried(server: LlmServer, config: LlmConfig, status: int) -> None:
    server.say(failure(status, "no such key"))
    model = Model(config)
    with pytest.raises(LlmError, match="no such key") as caught:
        model.complete(QUESTION)
    assert len(server.requests) == 1
    assert model.pauses == []
    assert re.fullmatch(r"openai/local: \w+Error: no such key", str(caught.value))
    assert "secret" not in str(caught.value)


def test_a_truncated_answer_is_an_error_that_names_the_limit(server: LlmServer, config: LlmConfig) -> None:
    server.say(code("x = 1\ny = ", finish="length"))
    model = Model(config)
    with pytest.raises(ReplyError, match="openai/local: the answer is cut off at 512 tokens; raise max_tokens"):
        model.complete(QUESTION)
    assert model.usage.calls == 1


@pytest.mark.parametrize("text", [None, "", "  \n ", "# Query: again"])
def test_an_empty_answer_is_an_error(server: LlmServer, config: LlmConfig, text: str | None) -> None:
    server.say(code(text))
    with pytest.raises(ReplyError, match="the answer is empty"):
        Model(config).complete(QUESTION, stop=("# Query: ",))


def test_a_response_without_choices_is_an_error(server: LlmServer, config: LlmConfig) -> None:
    server.say(Answer(body={"id": "x", "object": "chat.completion", "created": 0, "model": "local", "choices": []}))
    with pytest.raises(LlmError, match="no answer in it"):
        Model(config).complete(QUESTION)


def test_a_missing_key_is_reported_without_retries(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OPENAI_API_KEY", "OPENAI_ADMIN_KEY"):
        monkeypatch.delenv(name, raising=False)
    model = Model(LlmConfig(model="gpt-4o"))
    with pytest.raises(LlmError, match=r"gpt-4o: .*OPENAI_API_KEY") as caught:
        model.complete(QUESTION)
    assert caught.value.permanent
    assert model.pauses == []
