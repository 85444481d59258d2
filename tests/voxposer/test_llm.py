"""Questions to a language model, over HTTP to a server on this machine: answered, repeated, counted, kept."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.llm_server import Answer, LlmServer, code
from support.lmps import QUESTION, Model

pytest.importorskip("litellm", reason="the extra voxposer is not installed")

from vecenv.util import caching
from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.replies import ReplyError, Usage
from voxposer.language.reply_cache import ReplyCache

# The question and the answer


def test_the_provider_gets_the_whole_request(server: LlmServer, config: LlmConfig) -> None:
    Model(replace(config, options={"seed": 7})).complete(QUESTION, stop=("# Query: ",), max_tokens=99)
    assert server.requests == [
        {
            "model": "local",
            "messages": list(QUESTION),
            "stop": ["\n# Query: "],
            "max_tokens": 99,
            "temperature": 0.0,
            "seed": 7,
        }
    ]


def test_an_answer_comes_with_its_tokens(server: LlmServer, config: LlmConfig) -> None:
    server.say(code("  x = 1\n", prompt_tokens=30, completion_tokens=4))
    reply = Model(config).complete(QUESTION)
    assert (reply.text, reply.finish_reason, reply.model, reply.cached) == ("x = 1", "stop", "local", False)
    assert (reply.prompt_tokens, reply.completion_tokens) == (30, 4)


def test_an_answer_ends_at_the_first_stop_token_wherever_the_provider_stopped(
    server: LlmServer, config: LlmConfig
) -> None:
    server.say("x = 1\nobjects = ['a']\n# Query: more.\ny = 2")
    assert Model(config).complete(QUESTION, stop=("# Query: ", "objects =")).text == "x = 1"


@pytest.mark.parametrize(
    "program",
    [
        "composer('say \"# Query: more\"')",
        "x = 1  # Query: what was asked",
        "    # Query: indented, so no line starts with it",
        "near_objects = [o for o in names]\nf(objects = near_objects)",
        "text = 'objects = none'",
        "x = '\u2028objects = 1'",
    ],
)
def test_a_stop_token_inside_a_line_does_not_end_an_answer(server: LlmServer, config: LlmConfig, program: str) -> None:
    server.say(f"{program}\n# done")
    reply = Model(config).complete(QUESTION, stop=("# Query: ", "objects = ", "objects ="))
    assert reply.text == f"{program}\n# done".strip()
    assert server.requests[-1]["stop"] == ["\n# Query: ", "\nobjects = ", "\nobjects ="]


def test_an_answer_that_begins_with_a_stop_token_is_empty(server: LlmServer, config: LlmConfig) -> None:
    server.say("# Query: more.\ny = 2")
    with pytest.raises(ReplyError, match="the answer is empty"):
        Model(config).complete(QUESTION, stop=("# Query: ",))


def test_a_known_model_has_a_price_and_an_unknown_one_none(server: LlmServer, config: LlmConfig) -> None:
    server.say(code("pass", prompt_tokens=1000, completion_tokens=1000))
    priced, unpriced = Model(replace(config, model="openai/gpt-4o")), Model(config)
    assert (priced.complete(QUESTION).cost_usd or 0) > 0
    assert unpriced.complete(QUESTION).cost_usd is None
    assert (priced.usage.unpriced, unpriced.usage.unpriced) == (0, 1)
    assert priced.usage.cost_usd > unpriced.usage.cost_usd == 0


# What is configured


def test_a_key_is_not_shown(config: LlmConfig) -> None:
    assert "secret" not in repr(config)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"model": ""}, {"model": "offline/other"}, {"attempts": 0}, {"timeout_s": 0}, {"backoff_s": -1}),
        *({"concurrency": 0}, {"options": {"stream": True}}),
    ],
    ids=str,
)
def test_invalid_configs_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LlmConfig(**wrong)


# What is kept


def test_repeated_requests_are_cached(server: LlmServer, config: LlmConfig) -> None:
    server.say("x = 1", "x = 2")
    model = Model(config)
    first, second = model.complete(QUESTION), model.complete(QUESTION)
    assert (first.text, second.text, first.cached, second.cached) == ("x = 1", "x = 1", False, True)
    assert len(server.requests) == 1
    assert model.usage == Usage(calls=1, cached=1, prompt_tokens=11, completion_tokens=7, unpriced=1)


def test_another_model_object_reads_the_same_cache(server: LlmServer, config: LlmConfig) -> None:
    Model(config).complete(QUESTION)
    reply = Model(config).complete(QUESTION)
    assert (reply.cached, reply.prompt_tokens, len(server.requests)) == (True, 11, 1)


@pytest.mark.parametrize(
    "other",
    [
        {"max_tokens": 100},
        {"temperature": 0.5},
        {"stop": ("a",)},
        {"messages": ({"role": "user", "content": "# Query: grasp the cup."},)},
        {"messages": ({"role": "system", "content": "# Query: grasp the bowl."},)},
    ],
    ids=str,
)
def test_any_difference_in_a_request_misses_the_cache(
    server: LlmServer, config: LlmConfig, other: dict[str, Any]
) -> None:
    model = Model(config)
    model.complete(QUESTION)
    assert not model.complete(other.pop("messages", QUESTION), **other).cached


@pytest.mark.parametrize("other", [{"model": "openai/other"}, {"options": {"seed": 1}}], ids=str)
def test_another_model_or_option_misses_the_cache(server: LlmServer, config: LlmConfig, other: dict[str, Any]) -> None:
    Model(config).complete(QUESTION)
    assert not Model(replace(config, **other)).complete(QUESTION).cached


def test_retries_and_key_are_not_part_of_the_cache_key(server: LlmServer, config: LlmConfig) -> None:
    Model(config).complete(QUESTION)
    assert Model(replace(config, api_key="another", timeout_s=1, attempts=1)).complete(QUESTION).cached


@pytest.mark.parametrize("answer", [code("x = 1", finish="length"), code("")], ids=["cut off", "empty"])
def test_unusable_answers_are_not_cached(server: LlmServer, config: LlmConfig, answer: Answer) -> None:
    server.say(answer, "x = 1")
    model = Model(config)
    with pytest.raises(ReplyError):
        model.complete(QUESTION)
    assert model.complete(QUESTION).text == "x = 1"


def test_answers_that_fail_a_check_are_not_cached(server: LlmServer, config: LlmConfig) -> None:
    def check(text: str) -> None:
        compile(text, "", "exec")

    server.say("Sure, here is the code!", "x = 1")
    model = Model(config)
    with pytest.raises(SyntaxError):
        model.complete(QUESTION, check=check)
    assert model.complete(QUESTION, check=check).text == "x = 1"


def test_the_cache_can_be_turned_off(
    server: LlmServer, config: LlmConfig, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Model(replace(config, cache=False))
    assert [model.complete(QUESTION).cached for _ in range(2)] == [False, False]
    monkeypatch.setenv(caching.VARIABLE, "")
    Model(config).complete(QUESTION)
    assert not folder.exists()


def test_the_cache_folder_can_be_chosen(server: LlmServer, config: LlmConfig, folder: Path, tmp_path: Path) -> None:
    Model(replace(config, cache=tmp_path / "mine")).complete(QUESTION)
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["replies.sqlite3"]
    assert not folder.exists()


def test_cache_files_are_json_with_the_request_but_not_the_key(
    server: LlmServer, config: LlmConfig, folder: Path
) -> None:
    Model(config).complete(QUESTION, stop=("b",))
    with sqlite3.connect(folder / "replies.sqlite3") as connection:
        ((request, reply),) = connection.execute("SELECT request, reply FROM replies").fetchall()
    assert json.loads(request)["messages"] == list(QUESTION)
    assert json.loads(reply)["text"] == "pass"
    assert b"secret" not in (folder / "replies.sqlite3").read_bytes()


@pytest.mark.parametrize("reply", ["{", "[]", '{"text": 1}', '"text"', b"\x80\x04]\x94."])
def test_a_damaged_cache_entry_is_requested_again(
    server: LlmServer, config: LlmConfig, folder: Path, reply: str | bytes
) -> None:
    Model(config).complete(QUESTION)
    with sqlite3.connect(folder / "replies.sqlite3") as connection:
        connection.execute("UPDATE replies SET reply = ?", (reply,))
    assert not Model(config).complete(QUESTION).cached


def test_a_file_in_place_of_the_cache_is_a_warning(server: LlmServer, config: LlmConfig, folder: Path) -> None:
    folder.mkdir()
    (folder / "replies.sqlite3").write_text("not a database, " * 100)
    with pytest.warns(UserWarning, match=r"replies\.sqlite3: replies of language models are not kept"):
        assert Model(config).complete(QUESTION).text == "pass"


def test_a_cache_folder_that_cannot_be_created_is_a_warning(server: LlmServer, config: LlmConfig, folder: Path) -> None:
    folder.write_text("a file")
    with pytest.warns(UserWarning, match="are not kept"):
        assert Model(config).complete(QUESTION).text == "pass"


WRITER = """
import sys
from pathlib import Path
from voxposer.language.replies import Reply
from voxposer.language.reply_cache import ReplyCache

cache, name = ReplyCache(Path(sys.argv[1])), sys.argv[2]
print("ready", flush=True)
sys.stdin.readline()
tokens = {"prompt_tokens": 1, "completion_tokens": 1, "cost_usd": None}
for i in range(25):
    reply = Reply(text=f"{name} {i}", model="m", finish_reason="stop", **tokens)
    cache.put(f"shared {i}", {}, reply)
    cache.put(f"{name} {i}", {}, reply)
    assert cache.get(f"{name} {i}") == reply
print(*(cache.get(f"shared {i}").text for i in range(25)), sep=",")
"""


def test_concurrent_processes_share_the_cache_without_loss(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", "-c", WRITER, str(tmp_path)]
    pipe = subprocess.PIPE
    writers = [subprocess.Popen([*command, name], text=True, stdin=pipe, stdout=pipe, stderr=pipe) for name in "ab"]
    for writer in writers:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "ready\n"
    for writer in writers:
        assert writer.stdin is not None
        writer.stdin.write("go\n")
        writer.stdin.flush()
    said = [writer.communicate() for writer in writers]
    assert [errors for _, errors in said] == ["", ""]
    assert all(out.count(",") == 24 for out, _ in said)
    cache = ReplyCache(tmp_path)
    kept = [cache.get(f"{name} {i}") for name in "ab" for i in range(25)]
    assert [reply.text for reply in kept if reply is not None] == [f"{name} {i}" for name in "ab" for i in range(25)]
    final = [cache.get(f"shared {i}") for i in range(25)]
    assert all(",".join(reply.text for reply in final if reply is not None) == out.strip() for out, _ in said)


def test_threads_may_share_a_model(server: LlmServer, config: LlmConfig) -> None:
    server.answer = lambda request: code(request["messages"][0]["content"])
    model, barrier = Model(config), threading.Barrier(4)

    def ask(thread: int) -> list[str]:
        barrier.wait()
        return [model.complete([{"role": "user", "content": f"x = {i}"}]).text for i in range(10)]

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(ask, range(4)))
    assert answers == [[f"x = {i}" for i in range(10)]] * 4
    assert model.usage.calls + model.usage.cached == 40
    assert model.usage.calls == len(server.requests)


# Libraries


ALONE = """
import os, socket, sys
def refuse(*args): raise AssertionError(f"the network was used: {args}")
from voxposer.language.llm import Llm
assert "litellm" not in sys.modules
socket.socket.connect = refuse
before = dict(os.environ)
from voxposer.language import providers
providers.litellm()
assert dict(os.environ) == before, set(os.environ) ^ set(before)
"""


WITHOUT_LITELLM = """
import sys
sys.modules["litellm"] = None
from voxposer.language.llm import Llm, LlmConfig
from voxposer.language.replies import NoRuleError
llm = Llm(LlmConfig(model="offline/libero"))
def ask(query):
    prompt = "Queries are for `planner`"
    question = f"objects = ['mug_1', 'plate_1']\\n# Query: {query}"
    return llm.complete([{"role": "system", "content": prompt}, {"role": "user", "content": question}], max_tokens=512)
print("grasp the mug" in ask("put the mug on the plate.").text)
try:
    ask("sing.")
except NoRuleError as error:
    print(error)
"""


def test_the_rule_base_needs_no_litellm() -> None:
    run = subprocess.run([sys.executable, "-c", WITHOUT_LITELLM], capture_output=True, text=True, timeout=120)
    assert run.stdout.splitlines()[0] == "True", run.stderr
    assert "offline/libero does not understand: no known verb" in run.stdout


def test_litellm_is_imported_late_without_network_env_files_or_output(tmp_path: Path) -> None:
    (tmp_path / ".env").write_text("FROM_A_FILE=1\n")
    done = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_missing_library_is_reported_with_the_extra(config: LlmConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tenacity", None)
    with pytest.raises(ImportError, match=r"tenacity: pip install 'vecenv\[voxposer\]'"):
        Model(config).complete(QUESTION)


# The offline writer


def offline_question(query: str) -> list[dict[str, str]]:
    task = "Queries are for `composer`.\n```\nmovable = parse_query_obj('gripper')\nexecute(movable)\n```"
    return [{"role": "user", "content": task}, {"role": "user", "content": f"# Query: {query}."}]


def test_the_default_model_needs_no_key_and_leaves_nothing_on_disk(folder: Path) -> None:
    model = Llm()
    first, second = (model.complete(offline_question("open gripper"), stop=("# Query: ",)) for _ in range(2))
    assert model.config.model == "offline/libero"
    assert "execute(" in first.text
    assert (second.text, second.cached) == (first.text, True)
    assert (model.usage.calls, model.usage.cost_usd, model.usage.unpriced) == (1, 0.0, 0)
    assert not folder.exists()


def test_the_offline_writers_errors_are_not_retried(folder: Path) -> None:
    pauses: list[float] = []
    model = Llm(sleep=pauses.append)
    with pytest.raises(ReplyError, match=r"^offline/libero: [^:]*: .*colourless green ideas"):
        model.complete(offline_question("colourless green ideas sleep furiously"))
    assert pauses == []
