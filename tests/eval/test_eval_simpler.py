"""The harness on SIMPLER: episodes, names of tasks, what stood in for missing files, and what does not fit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner
from vecenv_eval.config import ConfigError, EvalConfig, default_policy
from vecenv_eval.results import begin, resume
from vecenv_eval.runner import Evaluation, evaluate

from vecenv.cli import build_app

pytest.importorskip("sapien")
BRIDGE, GOOGLE = "simpler/bridge", "simpler/google_robot"


@pytest.fixture(autouse=True)
def assets(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VECENV_SIMPLER_ASSETS", str(small))


def config(**changes: Any) -> EvalConfig:
    common: dict[str, Any] = {"suite": BRIDGE, "policy": "zero", "episodes": "2", "max_steps": 3, "num_threads": 1}
    return EvalConfig(**{**common, **changes})


def test_every_task_runs_and_one_environment_serves_all_batches(tmp_path: Path) -> None:
    result = evaluate(config(num_envs=2, policy="random"), begin(config(), tmp_path / "r"))
    assert result.ok, result.causes
    assert [row.episodes for row in result.summary.tasks] == [2, 2, 2, 2]
    assert result.summary.tasks[0].instruction == "put the spoon on the towel"
    assert {record.num_steps for record in result.records} == {3}
    assert [record.batch for record in result.records] == [0] * 8


def test_a_google_task_is_asked_for_by_name(tmp_path: Path) -> None:
    chosen = config(suite=GOOGLE, tasks="google_robot_open_top_drawer", episodes="0,7")
    result = evaluate(chosen, begin(chosen, tmp_path / "r"))
    assert result.ok, result.causes
    assert [(record.task, record.episode) for record in result.records] == [
        (result.records[0].task, 0),
        (result.records[0].task, 7),
    ]
    assert result.records[0].instruction == "open top drawer"


def test_what_stood_in_is_in_records_and_report_and_survives_a_resume(tmp_path: Path) -> None:
    store = begin(config(tasks="0"), tmp_path / "r")
    summary = evaluate(config(tasks="0", episodes="1"), store).summary
    again, store = resume(tmp_path / "r")
    summary = evaluate(again, store).summary
    (note,) = summary.stand_ins
    assert summary.stand_ins[note] == 2
    assert "bridge_table_1_v1.glb is missing: a plain table" in note
    assert note in (tmp_path / "r/report.md").read_text()
    assert json.loads((tmp_path / "r/summary.json").read_text())["stand_ins"] == {note: 2}


def test_what_stood_in_is_printed(tmp_path: Path) -> None:
    words = ["eval", "--suite", BRIDGE, "--policy", "zero", "--tasks", "widowx_carrot_on_plate", "--episodes", "1"]
    done = CliRunner().invoke(
        build_app(), [*words, "--max-steps", "2", "--num-threads", "1", "--out", str(tmp_path / "r")]
    )
    assert done.exit_code == 0, done.output
    assert "Files were missing, and something plain stood in for them" in done.output
    assert "1 episodes: data/hab2_bench_assets/stages/bridge_table_1_v1.glb is missing" in done.output


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"image_size": 64, "lod": "fast"}, "simpler/bridge does not take --image-size, --lod: SIMPLER's images are"),
        ({"cameras": "wrist"}, "environment arguments: there is no camera 'wrist'; cameras: agentview"),
        ({"policy": "openpi"}, "policy 'openpi' reads camera 'wrist'; simpler/bridge task 0 has agentview here"),
        (
            {"policy": "pick_place"},
            "'pick_place' is not made for simpler/bridge; the scripted one there is 'simpler_scr",
        ),
        ({"policy": "simpler_scripted", "suite": "libero_goal"}, "is not made for libero_goal.*'pick_place'"),
        ({"policy": "voxposer", "suite": GOOGLE}, "not the Google Robot's"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_runs(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        Evaluation(config(**changes))


def test_options_of_the_wrong_kind_and_missing_assets_are_the_configs_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigError, match="no option geometry='lean'"):
        evaluate(config(env_args={"geometry": "lean"}), begin(config(), tmp_path / "a"))
    monkeypatch.setenv("VECENV_SIMPLER_ASSETS", "/nowhere")
    with pytest.raises(ConfigError, match="vecenv assets pull simpler"):
        evaluate(config(), begin(config(), tmp_path / "b"))
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "b").exists()


def test_each_benchmark_has_its_scripted_policy() -> None:
    assert (default_policy(BRIDGE), default_policy("libero_goal")) == ("simpler_scripted", "pick_place")
