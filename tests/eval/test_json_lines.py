"""``vecenv eval --json``: lines of the schema, nothing else on standard output, and all that happened in them."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import subprocess
import sys
import typing
from pathlib import Path
from typing import Any

import pytest
from support.fakes import SUITE, FakeWorld
from typer.testing import CliRunner, Result
from vecenv_eval import campaign, events, runner
from vecenv_eval.campaign import Leg
from vecenv_eval.cli.json_lines import INTERVAL_S, JsonLines
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import Progress
from vecenv_eval.store import Record

from vecenv.cli import build_app


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeWorld:
    """``vecenv eval`` on the fake suite, in an empty folder."""
    world = FakeWorld()
    for module in (runner, campaign):
        monkeypatch.setattr(module, "vecenv_simulator", lambda: world.simulator)
    monkeypatch.chdir(tmp_path)
    return world


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(build_app(), ["eval", "--json", *arguments])


def evaluate(*arguments: str) -> Result:
    return invoke("--suite", SUITE, "--policy", "zero", "--out", "here", *arguments)


def lines(text: str) -> list[dict[str, Any]]:
    """The events, each of which must be one of the schema's."""
    for line in text.splitlines():
        events.EVENTS.validate_json(line)
    return [json.loads(line) for line in text.splitlines()]


def of(kind: str, said: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [event for event in said if event["event"] == kind]


def test_everything_that_happened_is_in_the_lines(world: FakeWorld) -> None:
    world.faults = {(1, 2): "non-finite state"}
    done = evaluate("--tasks", "0-1", "--num-envs", "3")
    said = lines(done.stdout)
    assert (said[0]["event"], said[-1]) == ("start", {"event": "end", "status": 0, "folder": "here"})
    assert (said[0]["schema_version"], said[0]["config"]["tasks"]) == (events.SCHEMA, "0-1")
    assert said[0]["runs"] == [{"suite": SUITE, "seed": None, "folder": "here", "episodes": 10}]
    (conditions,) = of("conditions", said)
    assert conditions["conditions"] == json.loads(Path("here/config.json").read_text())["conditions"]
    rows = [json.loads(line) for line in Path("here/episodes.jsonl").read_text().splitlines()]
    assert [event["record"] for event in of("episode", said)] == rows
    assert set(rows[0]) == {field.name for field in dataclasses.fields(Record)}
    last = of("progress", said)[-1]
    assert (last["total"], last["done"], last["successes"], last["faults"], last["success_rate"]) == (10, 10, 5, 1, 0.5)
    assert last["seconds_left"] == 0
    (summary,) = of("summary", said)
    assert (summary["complete"], summary["interrupted"]) == (True, False)
    assert summary["summary"] == json.loads(Path("here/summary.json").read_text())


def test_errors_are_events_and_lines_on_standard_error_and_the_status_is_in_the_last(world: FakeWorld) -> None:
    world.raise_in = {0: ValueError("boom")}
    done = evaluate("--retries", "0")
    said = lines(done.stdout)
    assert (done.exit_code, said[-1]["status"]) == (1, 1)
    assert of("error", said) == [{"event": "error", "message": "ValueError: boom", "suite": SUITE, "seed": None}]
    assert {event["record"]["error"] for event in of("episode", said)} >= {"ValueError: boom"}
    assert not of("summary", said)[0]["complete"]
    world.raise_in = None
    again = invoke("--resume", "here")
    assert (again.exit_code, lines(again.stdout)[-1]["status"]) == (0, 0)
    wrong = evaluate("--tasks", "9")
    assert wrong.exit_code == 2
    error, end = lines(wrong.stdout)
    assert error["message"].startswith("there is no task 9")
    assert (end["status"], end["folder"]) == (2, None)
    assert wrong.stderr == f"error: {error['message']}\n"
    assert lines(evaluate("--policy-arg", "gripper").stdout) == [{"event": "end", "status": 2, "folder": None}]


def test_ctrl_c_ends_with_a_summary_and_130(world: FakeWorld) -> None:
    world.raise_in = {1: KeyboardInterrupt()}
    done = evaluate("--num-envs", "5")
    said = lines(done.stdout)
    assert (done.exit_code, said[-1]["status"], of("summary", said)[0]["interrupted"]) == (130, 130, True)
    stored = [json.loads(line) for line in Path("here/episodes.jsonl").read_text().splitlines()]
    assert [event["record"] for event in of("episode", said)] == stored


def test_a_campaign_names_its_runs_and_ends_with_the_whole(world: FakeWorld) -> None:
    said = lines(evaluate("--seeds", "3,4", "--tasks", "0").stdout)
    assert [(run["seed"], run["episodes"]) for run in said[0]["runs"]] == [(3, 5), (4, 5)]
    assert [event["seed"] for event in of("episode", said)] == [3] * 5 + [4] * 5
    assert [event["seed"] for event in of("summary", said)] == [3, 4]
    assert of("campaign", said)[0]["summary"] == json.loads(Path("here/summary.json").read_text())


def test_progress_comes_at_a_bounded_rate() -> None:
    stream, now = io.StringIO(), 0.0
    writer = JsonLines(stream, clock=lambda: now)
    leg = Leg(suite=SUITE, seed=None, config=EvalConfig(suite=SUITE, policy="zero"), folder=Path("here"))
    for tick in range(100):
        now = tick / 10
        counts: dict[str, Any] = {"done": 0, "successes": 0, "faults": 0, "errors": 0}
        writer.progress(
            leg, Progress(total=5, **counts, steps=tick, seconds=now, batch=0, num_batches=1, setting_up=False)
        )
    assert len(lines(stream.getvalue())) == 10 / INTERVAL_S


def test_numbers_that_are_not_finite_are_null() -> None:
    record = Record(suite="s", task=0, episode=0, instruction="", success=False, num_steps=1, reward=float("nan"))
    event = events.EpisodeEvent(suite="s", seed=None, record=dataclasses.asdict(record))
    assert json.loads(event.line())["record"]["reward"] is None


def test_a_reader_that_goes_away_does_not_end_the_evaluation() -> None:
    class Broken(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    writer = JsonLines(Broken())
    writer.failed("something", 2)
    writer.failed("something", 2)


def test_quiet_and_json_exclude_each_other(world: FakeWorld) -> None:
    done = evaluate("--quiet")
    assert (done.exit_code, done.stderr) == (2, "error: give --quiet or --json, not both\n")


NOISY = """
import os, sys
from support.fakes import SUITE, FakeWorld
from vecenv_eval import runner
from vecenv_eval.policies.scripted import ZeroPolicy
class Noisy(ZeroPolicy):
    name = "noisy"
    def act(self, env):
        print("from Python")
        os.write(1, b"from C\\n")
        return super().act(env)
sys.modules["noisy"] = sys.modules["__main__"]
runner.vecenv_simulator = lambda: FakeWorld().simulator
sys.argv = ["vecenv", "eval", "--suite", SUITE, "--policy", "noisy:Noisy", *sys.argv[1:]]
from vecenv.cli import main
main()
"""


@pytest.mark.parametrize("option", ["--json", "--quiet"])
def test_what_others_print_goes_to_standard_error(option: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", NOISY, option, "--out", "here"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    assert "from Python" in done.stderr
    assert "from C" in done.stderr
    if option == "--json":
        assert len(of("episode", lines(done.stdout))) == 20
    else:
        assert done.stdout == "here\n"


def test_the_documentation_has_every_event_and_field(repository: Path) -> None:
    text = (repository / "docs" / "watching.md").read_text()
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| `")]
    told = {row[1].strip(" `"): row[2] for row in rows}
    for kind in typing.get_args(events.Event):
        names = [name for name in kind.model_fields if name != "event"]
        said = told[kind.model_fields["event"].default]
        assert [name for name in names if f"`{name}`" not in said] == []
    assert all(f"`{name}`" in told["start"] for name in events.Run.model_fields)
