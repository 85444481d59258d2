"""Every report says what its numbers were measured under."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from vecenv_eval.conditions import NONE, conditions, describe
from vecenv_eval.config import EvalConfig
from vecenv_eval.report import markdown, summarise, table
from vecenv_eval.results import begin, resume
from vecenv_eval.runner import Evaluation, evaluate
from vecenv_eval.store import Record

import vecenv

NAMES = ("protocol", "horizon", "start", "contacts", "colours", "fixtures", "seed", "success")


def of(config: EvalConfig, **options: Any) -> dict[str, Any]:
    """Conditions of an environment made as an evaluation makes it."""
    env = vecenv.make(config.suite, task=0, episodes=[0], protocol=config.protocol, **options)
    env.close()
    return conditions(env, config)


def test_a_protocol_is_said_in_full() -> None:
    found = of(EvalConfig(suite="libero_10", protocol="openpi"))
    expected = {
        "protocol": "openpi",
        "instead": {},
        "horizon": 520,
        "idle_steps": 10,
        "start": "raw",
        "fixtures": "upstream",
        "seed": 7,
        "success": "first",
    }
    assert {name: found[name] for name in expected} == expected
    text = describe(found)
    assert text.startswith("protocol openpi; horizon 520; success first; start raw and 10 idle ticks; contacts ")
    assert text.endswith("fixtures upstream; seed 7.")


def test_options_that_are_not_the_protocols_are_named_with_both_values() -> None:
    poses = {"wooden_cabinet_1": ([0.0, -0.3, 0.9], [1.0, 0.0, 0.0, 0.0])}
    found = of(EvalConfig(suite="libero_goal", protocol="openpi"), max_steps=9, seed=0, fixtures=poses, success="final")
    assert found["instead"] == {
        "max_steps": [300, 9],
        "fixtures": ["upstream", "given for wooden_cabinet_1"],
        "seed": [7, 0],
        "success": ["first", "final"],
    }
    assert found["reset_loop"] == NONE
    assert "protocol openpi (but max_steps 300 -> 9, fixtures upstream -> given for wooden_cabinet_1" in describe(found)


def test_contacts_and_colours_are_the_environments() -> None:
    config = SimpleNamespace(contacts="published", render=SimpleNamespace(colors="current"))
    env: Any = SimpleNamespace(config=config)
    found = conditions(env, EvalConfig(suite="libero_goal"))
    assert (found["contacts"], found["colors"]) == ("published", "current")
    assert "contacts published; colours current" in describe(found)


@pytest.mark.parametrize("protocol", ["seed", "visual-matching", "variant-aggregation"])
def test_simpler_has_no_such_choices_and_says_so(protocol: str) -> None:
    env: Any = SimpleNamespace(config=SimpleNamespace(max_steps=None, success="first"))
    found = conditions(env, EvalConfig(suite="simpler/bridge", protocol=protocol))
    assert found["horizon"] == "each task's own"
    assert {found[name] for name in ("start", "contacts", "colors", "fixtures", "idle_steps")} == {NONE}
    assert found["instead"] == ({} if protocol == "seed" else {"success": ["final", "first"]})
    assert all(f"{name} " in describe(found) for name in NAMES)


def test_every_report_names_them(tmp_path: Path) -> None:
    config = EvalConfig(
        suite="libero_goal", protocol="vla-eval", policy="zero", tasks="0", episodes="1", max_steps=2, num_threads=1
    )
    store = begin(config, tmp_path / "run")
    result = evaluate(config, store)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    said = store.config()["conditions"]
    assert said == summary["conditions"] == dict(result.summary.conditions)
    assert said["instead"] == {"max_steps": [300, 2]}
    report = (tmp_path / "run" / "report.md").read_text()
    assert describe(said) in report
    assert all(f"{name} " in describe(said) for name in NAMES)
    assert table(result.summary).caption == describe(said)
    again, store = resume(tmp_path / "run")
    assert Evaluation(again).run(store).summary.conditions == said


def test_both_verdicts_are_reported_where_they_differ() -> None:
    def record(episode: int, first: bool, final: bool) -> Record:
        told = Record(suite="s", task=0, episode=episode, instruction="i", success=final, num_steps=3, reward=1.0)
        return replace(told, success_first=first, success_final=final)

    records = [record(0, True, True), record(1, True, False), record(2, False, False)]
    summary = summarise(records, [r.key for r in records], suite="s", policy="p", instructions=["i"])
    assert (summary.total.successes, summary.total.first, summary.total.final) == (1, 2, 1)
    assert "The goal held at some tick in 2 and at the last tick in 1 of them." in markdown(summary)
    same = summarise(records[:1], [records[0].key], suite="s", policy="p", instructions=["i"])
    assert "The goal held" not in markdown(same)


def test_deterministic_steps_are_named_only_where_they_were_asked_for() -> None:
    config = EvalConfig(suite="libero_10")
    assert "deterministic" not in of(config)
    found = of(config, deterministic=True)
    assert found["deterministic"] is True
    assert describe(found).endswith("; deterministic yes.")
