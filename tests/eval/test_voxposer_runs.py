"""VoxPoser with a language model in an evaluation: whose fault an end is, what is kept of it, and what it prints."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fakes import SUITE, FakeEnv, FakeWorld
from support.llm_server import LlmServer, code, failure, serving
from support.lmps import asked
from support.voxposer_models import CUBE, Writer
from support.voxposer_world import snapshot
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.merge import merge
from vecenv_eval.policies import PolicyError, make_policy
from vecenv_eval.report.tables import markdown
from vecenv_eval.results import EvalResult, open_or_begin
from vecenv_eval.runner import evaluate

pytest.importorskip("litellm", reason="the extra voxposer is not installed")

from vecenv.contract import PlanControl
from vecenv.observations import Objects


class Table(FakeEnv):
    """The fake's episodes, with a cube in each slot, and plans whose waypoints each take a tick."""

    def observe_objects(self, points: str = "surface", slots: Any = None) -> Objects:
        return Objects(tuple(snapshot(CUBE) for _ in range(self.num_envs)), ("",) * self.num_envs)

    def step_waypoints(self, plan: Any, max_misses: int | None = None) -> PlanControl:
        control = self.step_continuous(np.zeros((self.num_envs, 7)))
        spent = np.where(plan.valid, np.maximum(plan.hold, 1), 0)
        return PlanControl(
            **vars(control), converged=plan.valid.copy(), waypoint_ticks=spent, error=("",) * self.num_envs
        )


class Tables(FakeWorld):
    def make(self, suite: str, **arguments: Any) -> FakeEnv:
        arguments = {name: value for name, value in arguments.items() if name in ("tasks", "episodes", "max_steps")}
        self.envs.append(Table(**arguments))
        return self.envs[-1]


@pytest.fixture(scope="module")
def server() -> Iterator[LlmServer]:
    with serving() as running:
        yield running


@pytest.fixture(autouse=True)
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "sesame-123")


def options(server: LlmServer, **more: Any) -> dict[str, Any]:
    return {"model": "openai/local", "api_base": server.base, "attempts": 1, "cache": False, "passes": 1, **more}


def run(folder: Path, policy_args: dict[str, Any], **settings: Any) -> EvalResult:
    fields = {"suite": SUITE, "policy": "voxposer", "tasks": "0,2", "episodes": "2", "max_steps": 60, **settings}
    config = EvalConfig(**{**fields, "policy_args": policy_args})
    return evaluate(config, open_or_begin(config, folder), simulator=Tables().simulator)


def errors(result: EvalResult) -> dict[int, str]:
    return {record.task: record.error for record in result.records if record.error}


# Errors


def test_what_the_model_does_not_answer_is_an_error_and_no_failed_episode(server: LlmServer, tmp_path: Path) -> None:
    Writer(server, {"do thing 2": failure(500, "oops")})
    result = run(tmp_path / "run", options(server), retries=0)
    assert not result.ok
    total = result.summary.total
    assert (total.episodes, total.errors, total.missing) == (2, 2, 0)
    assert set(errors(result)) == {2}
    assert "InternalServerError: oops" in errors(result)[2]
    assert result.causes == tuple({record.error: None for record in result.records if record.error})
    assert "InternalServerError: oops" in (tmp_path / "run" / "errors.log").read_text()


def test_an_error_runs_again_within_the_run_and_when_it_is_resumed(server: LlmServer, tmp_path: Path) -> None:
    oops = failure(503, "busy")
    Writer(server, {"do thing 2": [oops, oops, 'composer("lift up")']})
    result = run(tmp_path / "run", options(server), retries=1)
    assert result.ok
    assert len(result.causes) == 1
    Writer(server, {"do thing 2": oops})
    assert not run(tmp_path / "again", options(server), retries=0).ok
    Writer(server)
    resumed = run(tmp_path / "again", options(server), retries=0)
    assert resumed.ok
    assert [asked(request) for request in server.requests].count("do thing 0") == 0  # it has its verdict


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (failure(401, "Incorrect API key provided", "invalid_api_key"), "AuthenticationError: Incorrect API key"),
        (failure(404, "The model `local` does not exist"), "NotFoundError: The model `local` does not exist"),
        (failure(429, "You exceeded your current quota", "insufficient_quota"), "RateLimitError: You exceeded your"),
    ],
    ids=["key", "model", "quota"],
)
def test_what_no_waiting_ends_ends_the_run_at_once(server: LlmServer, tmp_path: Path, answer: Any, says: str) -> None:
    Writer(server, {f"do thing {task}": answer for task in range(4)})
    result = run(tmp_path / "run", options(server, concurrency=1), num_envs=1, tasks="all", retries=3)
    assert not result.ok
    (cause,) = result.causes
    assert cause.startswith(f"openai/local: {says}")
    assert len(server.requests) == 1
    assert (result.summary.total.errors, result.summary.total.missing) == (1, 7)


def test_a_model_that_answers_nobody_ends_the_run_after_two_batches(server: LlmServer, tmp_path: Path) -> None:
    Writer(server, {f"do thing {task}": failure(500, "oops") for task in range(4)})
    result = run(tmp_path / "run", options(server), num_envs=2, tasks="all", episodes="5", retries=3)
    assert len(server.requests) == 4
    assert (result.summary.total.episodes, result.summary.total.errors) == (0, 4)
    assert any(cause.startswith("the run was ended: 4 episodes in a row ended in an error") for cause in result.causes)


def test_fail_fast_ends_the_run_at_the_first_error(server: LlmServer, tmp_path: Path) -> None:
    Writer(server, {"do thing 0": failure(500, "oops")})
    result = run(tmp_path / "run", options(server), num_envs=1, fail_fast=True)
    assert len(server.requests) == 1
    assert result.summary.total.missing == 3


def test_a_bad_program_is_a_failed_episode_with_its_repairs_counted(server: LlmServer, tmp_path: Path) -> None:
    Writer(server, {"do thing 1": "I would love to help!"})
    result = run(tmp_path / "run", options(server), tasks="1", retries=0)
    assert result.ok
    assert {record.extras["cause"] for record in result.records} == {"LmpError"}
    assert {(record.extras["questions"], record.extras["repairs"]) for record in result.records} == {(1, 1)}


def test_a_sentence_that_the_rule_base_does_not_know_is_a_failed_episode(tmp_path: Path) -> None:
    result = run(tmp_path / "run", {"passes": 1}, tasks="1,3", retries=0)
    assert result.ok
    assert result.summary.total.rate == 0
    assert {record.extras["cause"] for record in result.records} == {"LmpError"}


# What is kept


def test_every_question_is_saved_and_answers_a_run_without_the_model(server: LlmServer, tmp_path: Path) -> None:
    Writer(server)
    first = run(tmp_path / "run", options(server, temperature=0.5))
    logs = sorted(path.name for path in (tmp_path / "run" / "policy_logs").iterdir())
    assert logs == [f"fake_suite_{task}_{episode}.jsonl" for task in (0, 2) for episode in (0, 1)]
    for path in (tmp_path / "run").rglob("*"):
        assert path.is_dir() or b"sesame-123" not in path.read_bytes(), path
    asked_before = len(server.requests)
    again = run(tmp_path / "again", {"replay": str(tmp_path / "run"), "passes": 1})
    assert len(server.requests) == asked_before
    assert [(r.key, r.success, r.num_steps) for r in first.records] == [
        (r.key, r.success, r.num_steps) for r in again.records
    ]
    assert [r.extras["questions"] for r in first.records] == [r.extras["questions"] for r in again.records]
    assert again.summary.policy == "voxposer (openai/local, replayed; perception: ground truth)"


def test_a_replay_that_lacks_a_reply_ends_the_run_and_names_it(server: LlmServer, tmp_path: Path) -> None:
    Writer(server)
    run(tmp_path / "run", options(server), tasks="0")
    result = run(tmp_path / "again", {"replay": str(tmp_path / "run"), "passes": 1}, tasks="2")
    (cause,) = result.causes
    assert "the replay has no saved reply to" in cause
    assert "# Query: do thing 2." in cause


def test_the_log_of_an_unanswered_episode_is_kept_until_it_runs_again(server: LlmServer, tmp_path: Path) -> None:
    Writer(server, {"lift up": failure(500, "oops")})
    run(tmp_path / "run", options(server), tasks="0", episodes="1", retries=0)
    path = tmp_path / "run" / "policy_logs" / "fake_suite_0_0.jsonl"
    said = [json.loads(line) for line in path.read_text().splitlines()]
    said = [line for line in said if "text" not in line]
    assert [(line["lmp"], line["reply"]) for line in said] == [("planner", 'composer("lift up")'), ("composer", None)]
    assert "oops" in said[1]["error"]
    Writer(server)
    assert run(tmp_path / "run", options(server), tasks="0", episodes="1", retries=0).ok
    assert "oops" not in path.read_text()


def test_logs_are_merged(server: LlmServer, tmp_path: Path) -> None:
    Writer(server)
    for part in ("1/2", "2/2"):
        run(tmp_path / part[0], options(server), shard=part)
    merge(tmp_path / "whole", [tmp_path / "1", tmp_path / "2"], simulator=Tables().simulator)
    assert len(list((tmp_path / "whole" / "policy_logs").iterdir())) == 4


# What is printed


def test_unknown_tokens_and_price_are_null_and_known_ones_are_added(server: LlmServer, tmp_path: Path) -> None:
    Writer(server)
    result = run(tmp_path / "run", options(server))
    for record in result.records:
        assert record.extras["llm_cost_usd"] is None
        assert record.extras["llm_tokens"] == 18 * (record.extras["questions"] + record.extras["repairs"])
        assert record.extras["writer"] == "openai/local"
    text = markdown(result.summary)
    assert "voxposer (openai/local; perception: ground truth)" in text
    assert "- llm_cost_usd: 4 x unknown" in text


def test_a_rule_base_has_neither_tokens_nor_a_price(tmp_path: Path) -> None:
    result = run(tmp_path / "run", {"passes": 1})
    for record in result.records:
        assert not {name for name in record.extras if "llm" in name or "token" in name or "cost" in name}
        assert record.extras["writer"] == "offline/libero, rule-based"
    text = markdown(result.summary)
    assert "offline/libero, rule-based" in text
    assert "token" not in text
    assert "usd" not in text


# Options


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"temprature": 0.2}, "no option 'temprature': did you mean temperature"),
        ({"planner.max_step": 1}, "no option 'planner.max_step': did you mean planner.max_steps"),
        ({"planner": {"map_size": 60}}, "no option 'planner.map_size': did you mean .*perception.map_size"),
        ({"planner": 3}, "planner=3: give its fields, such as planner"),
        ({"planner.max_steps": "many"}, "max_steps"),
        ({"perception.map_size": 3}, "map_size must be at least 50, not 3"),
        ({"passes": 0}, "passes=0: expected at least 1"),
        ({"temperature": -1}, "temperature=-1: .* temperature not below 0"),
        ({"lmps.planner.max_tokens": 0}, "lmps.planner.max_tokens=0: planner: max_tokens must be at least 1"),
        ({"lmps": 3}, "lmps=3: give its fields"),
        ({"api_key": "x"}, "set the provider's environment variable"),
        ({"model": "offline/other"}, "there is no model 'offline/other'; the rule base is offline/libero"),
        ({"replay": "no_such_folder"}, "replay='no_such_folder': there is no such folder"),
        ({"temperature": float("nan")}, "temperature=nan: expected a finite number"),
    ],
    ids=str,
)
def test_options_that_cannot_be_used_are_refused(given: dict[str, Any], says: str) -> None:
    with pytest.raises(PolicyError, match=says):
        make_policy("voxposer", **given)


def test_every_field_of_the_configs_is_an_option() -> None:
    from voxposer.settings import Settings, option_names
    from voxposer.simpler_scene import widowx_config

    names = option_names()
    assert {"temperature", "max_tokens", "seed", "timeout_s", "api_base", "concurrency", "repairs"} <= set(names)
    given = {
        **{"perception.map_size": 60, "planner.max_steps": 77, "route.over": 0.05, "plan.settle": 4},
        **{"push.push.push_speed": 0.25, "limits.seconds": 3, "lmps.planner.max_tokens": 900, "passes": 2},
        **{"perception.margins.gripper.wrist": 0.2, "perception.tilts": [0.1, 0.2]},
    }
    assert set(given) <= set(names)
    for base in (None, widowx_config()):
        config = Settings.of(given).agent_config(base)
        for name, value in given.items():
            found: Any = config
            for part in name.split("."):
                found = found[part] if isinstance(found, dict) else getattr(found, part)
            assert found == (tuple(value) if isinstance(value, list) else value), name
    # What was not given is what the robot needs.
    assert config.idle_ticks == widowx_config().idle_ticks
    assert config.perception.margins.above == widowx_config().perception.margins.above


def test_options_of_a_model_mean_nothing_to_a_rule_base(caplog: pytest.LogCaptureFixture) -> None:
    make_policy("voxposer", temperature=0.2)
    assert "temperature: no effect, offline/libero is a rule base" in caplog.text


def test_options_come_from_a_yaml_file_too(server: LlmServer, tmp_path: Path) -> None:
    file = tmp_path / "run.yaml"
    file.write_text(
        "suite: fake_suite\npolicy: voxposer\npolicy_args:\n  model: openai/local\n  temperature: 0.3\n"
        "  planner:\n    max_steps: 50\n  perception.map_size: 60\n"
    )
    policy: Any = make_policy("voxposer", **EvalConfig.load(file).policy_args)
    config = policy.settings.agent_config()
    assert {lmp.temperature for lmp in config.lmps.values()} == {0.3}
    assert (config.planner.max_steps, config.perception.map_size) == (50, 60)


def test_options_reach_the_provider(server: LlmServer, tmp_path: Path) -> None:
    given = options(server, temperature=0.3, max_tokens=77, seed=5, **{"lmps.planner.max_tokens": 99})
    Writer(server, {"lift up": code("pass")})
    run(tmp_path / "run", given, tasks="0", episodes="1")
    plan, subtask = server.requests[:2]
    assert (plan["temperature"], plan["max_tokens"], plan["seed"]) == (0.3, 99, 5)
    assert (subtask["temperature"], subtask["max_tokens"], subtask["seed"]) == (0.3, 77, 5)


def test_the_same_run_with_other_options_is_another_evaluation(server: LlmServer, tmp_path: Path) -> None:
    Writer(server)
    run(tmp_path / "run", options(server), tasks="0", episodes="1")
    with pytest.raises((ConfigError, RuntimeError), match="policy_args"):
        run(tmp_path / "run", options(server, temperature=0.3), tasks="0", episodes="1")
