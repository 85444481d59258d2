"""A slot's questions: asked side by side, repaired once, unanswered without a verdict, saved and answered again."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.llm_server import Answer, LlmServer, code, failure
from support.lmps import asked
from support.voxposer_models import PROGRAMS, Writer, agent, model

pytest.importorskip("litellm", reason="the extra voxposer is not installed")

from vecenv.errors import InvalidFile, InvalidInput
from voxposer.agent import Agent
from voxposer.language.llm import LlmConfig
from voxposer.language.replies import LlmError
from voxposer.language.saved import ReplayedLlm, SavedReplies, open_llm, to_lines
from voxposer.slots import Unanswered
from voxposer.turns import Turns

BAD = failure(400, "the prompt was refused")


def late(text: str, seconds: float) -> Callable[[Any], Answer]:
    def answer(request: Any) -> Answer:
        time.sleep(seconds)
        return code(text)

    return answer


def queries(server: LlmServer) -> list[str]:
    return [asked(request) for request in server.requests]


# Side by side


def test_eight_slots_wait_for_a_model_together(running: LlmServer) -> None:
    words = [f"go to place {number}" for number in range(8)]
    llm = model(running)
    Writer(running)
    llm.complete([{"role": "user", "content": "Queries are for `planner`"}] * 3)  # imports, connections
    Writer(running, dict.fromkeys(words, late("pass", 1.0)))
    acting, _ = agent(llm, *words)
    began = time.perf_counter()
    acting.step()
    assert time.perf_counter() - began < 2.0
    assert running.most_in_flight == len(running.requests) == 8
    assert [slot.cause for slot in acting.slots] == ["the planner found nothing to do"] * 8


@pytest.mark.parametrize("most", [1, 3])
def test_no_more_questions_wait_than_are_allowed(running: LlmServer, most: int) -> None:
    words = [f"go to place {number}" for number in range(6)]
    Writer(running, dict.fromkeys(words, late("pass", 0.05)))
    agent(model(running, concurrency=most), *words)[0].step()
    assert running.most_in_flight == most


@pytest.mark.parametrize("first", ["lift it", "lift that"])
def test_what_slots_do_and_pay_does_not_depend_on_whose_answer_comes_first(
    running: LlmServer, tmp_path: Path, first: str
) -> None:
    words = ["lift it", "lift that", "lift it"]
    answered = threading.Event()

    def answer(request: Any) -> Answer:
        if asked(request) == first:
            answered.set()
        answered.wait(10)
        return late('composer("lift up")', 0.0 if asked(request) == first else 0.3)(request)

    Writer(running, dict.fromkeys(words, answer))
    acting, env = agent(model(running, cache=tmp_path), *words)
    acting.step()
    programs = ["planner", "composer", "parse_query_obj", "get_affordance_map"]
    assert len(running.requests) == len(programs) + 1  # the slots share all but the second plan
    paid = [[call.lmp for call in slot.lmps.trace if not call.cached] for slot in acting.slots]
    assert paid == [programs, ["planner"], []]
    heights = [each.ee_pose[2] for each in env.snapshots]
    assert heights[0] == heights[1] == heights[2] > 0.41


def test_jobs_run_one_at_a_time_but_where_they_wait() -> None:
    turns, inside = Turns(4), threading.Lock()
    together = threading.Barrier(4, timeout=10)

    def job() -> None:
        assert inside.acquire(blocking=False)
        inside.release()
        with turns.aside():
            together.wait()  # all four get here, or it breaks

    turns.run([job] * 4)


def test_the_first_error_of_a_job_is_raised_at_once() -> None:
    turns, never = Turns(3), threading.Event()
    after: list[int] = []

    def waits() -> None:
        with turns.aside():
            never.wait(20)
        after.append(1)

    def fails() -> None:
        raise KeyError("x")

    began = time.perf_counter()
    with pytest.raises(KeyError):
        turns.run([waits, fails, waits])
    assert time.perf_counter() - began < 10
    never.set()
    assert after == []


# Repairs


@pytest.mark.parametrize(
    ("lmp", "query", "broken", "told"),
    [
        ("planner", "go", "I would love to help!", "cannot be run"),
        ("planner", "go", "composer(3)", "a subtask is text"),
        ("composer", "lift up", "nothing_like_this()", "nothing_like_this"),
        ("composer", "lift up", "execute(parse_query_obj('gripper'), get_affordance_map('above'))\nx = 1 / 0", "zero"),
        ("parse_query_obj", "gripper", "ret_val = detect('griper')", "did you mean"),
        ("get_affordance_map", "above", "ret_val = get_empty_affordance_map()[0]", "not a map"),
    ],
)
def test_a_bad_program_is_repaired_once(running: LlmServer, lmp: str, query: str, broken: str, told: str) -> None:
    Writer(running, {query: [broken, PROGRAMS[lmp]]})
    acting, env = agent(model(running), "go")
    acting.step()
    slot = acting.slots[0]
    assert slot.cause == ""
    assert len(env.plans) == 1
    first, second = [call for call in slot.lmps.trace if (call.lmp, call.query) == (lmp, query)][:2]
    assert told in (first.error or "")
    assert (first.repair, second.repair, second.error) == (0, 1, None)
    assert second.messages[: len(first.messages)] == first.messages
    reply, again = second.messages[len(first.messages) :]
    assert reply == {"role": "assistant", "content": broken}
    assert told in again["content"]
    assert again["content"].endswith(f"# Query: {query}.")
    # What the failed program asked for is not done twice.
    assert 0.41 < env.snapshots[0].ee_pose[2] < 0.46


def test_a_program_that_stays_bad_fails_the_episode_with_its_cause(running: LlmServer) -> None:
    Writer(running, {"lift up": "nothing_like_this()"})
    acting, env = agent(model(running), "go")
    acting.step()
    slot = acting.slots[0]
    assert slot.cause.startswith("LmpError: composer('lift up')")
    assert slot.error == ""
    assert not env.ended.any()
    assert queries(running).count("lift up") == 2


@pytest.mark.parametrize(("repairs", "asked_in_all"), [(0, 1), (3, 4)])
def test_the_number_of_repairs_is_an_option(running: LlmServer, repairs: int, asked_in_all: int) -> None:
    Writer(running, {"lift up": "nothing_like_this()"})
    acting, _ = agent(model(running), "go", repairs=repairs)
    acting.step()
    assert queries(running).count("lift up") == asked_in_all
    assert "LmpError" in acting.slots[0].cause


def test_a_rule_base_is_not_asked_to_repair() -> None:
    from voxposer.language.llm import Llm

    acting, env = agent(Llm(), "colourless green ideas sleep furiously")
    acting.step()
    slot = acting.slots[0]
    assert len(slot.lmps.trace) == 1
    assert slot.cause.startswith("LmpError: planner(")
    assert (slot.error, env.ended.any()) == ("", False)
    call = slot.lmps.trace[0]
    assert (call.prompt_tokens, call.completion_tokens, call.cost_usd) == (None, None, None)


# Unanswered


@pytest.mark.parametrize(
    "answer",
    [BAD, failure(500, "oops"), failure(429, "slow down"), code("x", finish="length"), code(None), code("")],
    ids=["400", "500", "429", "cut off", "null", "empty"],
)
def test_an_unanswered_question_ends_its_episode_alone(running: LlmServer, answer: Answer) -> None:
    Writer(running, {"break": answer})
    acting, env = agent(model(running), "break", "lift")
    control = acting.step()
    assert isinstance(acting.slots[0].phase, Unanswered)
    assert acting.error(0).startswith(("LlmError: openai/local: ", "ReplyError: openai/local: "))
    assert env.ended.tolist() == [True, False]
    assert control.truncated.tolist() == [True, False]
    assert acting.error(1) == acting.slots[1].cause == ""
    assert env.snapshots[1].ee_pose[2] > 0.41
    before = len(running.requests)
    acting.step()
    assert "break" not in queries(running)[before:]


def test_an_unanswered_repair_is_no_fault_of_the_program(running: LlmServer) -> None:
    Writer(running, {"lift up": ["nothing_like_this()", BAD]})
    acting, _ = agent(model(running), "go")
    acting.step()
    assert "the prompt was refused" in acting.error(0)


def test_a_wrong_key_is_raised_and_no_slot_asks_on(running: LlmServer) -> None:
    Writer(running, {"break": failure(401, "bad key")})
    acting, _ = agent(model(running, concurrency=2), "break", *(f"lift {i}" for i in range(6)))
    with pytest.raises(LlmError, match="bad key"):
        acting.step()
    acting.close()


# Saved and answered again


def saved(folder: Path, acting: Agent) -> Path:
    where = folder / "policy_logs"
    where.mkdir(parents=True)
    for number, slot in enumerate(acting.slots):
        lines = to_lines(f"s/0/{number}", slot.lmps.trace)
        (where / f"s_0_{number}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def test_saved_replies_do_what_the_model_did_without_it(running: LlmServer, tmp_path: Path) -> None:
    # The same sentence has another program in each episode, and one of them is repaired.
    Writer(
        running, {"go": ['composer("lift up")', 'composer("rise")'], "rise": ["x = (", "execute(detect('gripper'))"]}
    )
    first, env = agent(model(running), "go", "go")
    first.step()
    folder = saved(tmp_path, first)
    asked_before = len(running.requests)
    llm = open_llm(LlmConfig(model="openai/local"), folder)
    again, replayed = agent(llm, "go", "go")
    again.step()
    assert len(running.requests) == asked_before
    for one, two in zip(first.slots, again.slots, strict=True):
        assert [(call.lmp, call.query, call.code, call.error) for call in one.lmps.trace] == [
            (call.lmp, call.query, call.code, call.error) for call in two.lmps.trace
        ]
        assert all(call.cached for call in two.lmps.trace)
        assert one.cause == two.cause
    assert [each.ee_pose.tolist() for each in env.snapshots] == [each.ee_pose.tolist() for each in replayed.snapshots]
    # An episode that begins again gets the same answers again.
    again.begin(("go", "go"), [0, 1], ("s/0/0", "s/0/1"))
    again.step()
    assert [slot.cause for slot in again.slots] == [slot.cause for slot in first.slots]


def test_a_request_that_is_not_saved_is_named(running: LlmServer, tmp_path: Path) -> None:
    Writer(running)
    first, _ = agent(model(running), "lift it")
    first.step()
    llm = open_llm(LlmConfig(model="openai/local"), saved(tmp_path, first))
    with pytest.raises(
        LlmError, match=r"no saved reply to .*# Query: lift that\..* in s/0/0 \(request [0-9a-f]+\)"
    ) as caught:
        agent(llm, "lift that")[0].step()
    assert caught.value.permanent


def test_long_texts_are_saved_once_an_episode_and_keys_never(running: LlmServer, tmp_path: Path) -> None:
    Writer(running)
    first, _ = agent(model(running, api_key="sesame-123"), "lift it")
    first.step()
    first.step()
    text = (saved(tmp_path, first) / "policy_logs" / "s_0_0.jsonl").read_text()
    prompt = first.slots[0].lmps.trace[1].messages[1]["content"]
    assert len(prompt) > 1000
    assert text.count(json.dumps(prompt)[1:-1]) == 1
    assert "sesame-123" not in text
    lines = [json.loads(line) for line in text.splitlines()]
    question = next(line for line in lines if "text" not in line)
    assert question["settings"]["temperature"] == 0.0
    assert (question["prompt_tokens"], question["cost_usd"], question["reply"]) == (11, None, 'composer("lift up")')


def test_a_folder_without_replies_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no replies of a model"):
        SavedReplies(tmp_path)


@pytest.mark.parametrize("line", ["{", "[]", '{"episode": "s/0/0"}', '{"text": "a"}'])
def test_a_damaged_file_is_named_with_its_line(tmp_path: Path, line: str) -> None:
    (tmp_path / "a.jsonl").write_text(line + "\n")
    with pytest.raises(InvalidFile, match=r"a\.jsonl:1 is no saved question"):
        SavedReplies(tmp_path)


def test_replies_of_another_model_are_refused(running: LlmServer, tmp_path: Path) -> None:
    Writer(running)
    first, _ = agent(model(running), "lift it")
    first.step()
    folder = saved(tmp_path, first)
    with pytest.raises(InvalidInput, match="openai/local wrote these replies, not gpt-4o"):
        open_llm(LlmConfig(model="gpt-4o"), folder)
    assert isinstance(open_llm(LlmConfig(model="openai/local"), folder), ReplayedLlm)
