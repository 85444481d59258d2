"""The physics benchmark measures what it says; how fast is for `make bench` to tell."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result
from vecenv_eval.bench.physics import make_batch, random_actions
from vecenv_eval.bench.table import publish

from vecenv.cli import build_app


def invoke(*arguments: object) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["bench", *map(str, arguments)])


def test_every_side_gets_the_same_actions() -> None:
    few, many = random_actions(2, tick=7), random_actions(2, tick=8)
    np.testing.assert_array_equal(few, many)
    assert not np.array_equal(few, random_actions(2, tick=10))
    assert np.abs(few[:, :6]).max() <= 0.5
    assert set(np.abs(few[:, 6])) == {1.0}


@pytest.mark.parametrize("num_envs", [1, 64, 1024])
def test_batches_have_the_size_asked_for(num_envs: int) -> None:
    env = make_batch("libero_object", 0, num_envs, threads=1)
    assert env.num_envs == num_envs
    env.close()


@pytest.mark.parametrize("text", ["libero_object", "libero_object/x", "/3"])
def test_a_scene_that_is_none_is_refused(text: str) -> None:
    result = invoke("physics", "--scene", text)
    assert result.exit_code == 2
    assert text in result.output


def test_rows_are_written_with_machine_and_versions(tmp_path: Path) -> None:
    publish([{"scene": "a/0", "ratio": 2.5}], "a table", tmp_path / "deep" / "rows.json")
    content = json.loads((tmp_path / "deep" / "rows.json").read_text())
    assert content["rows"] == [{"scene": "a/0", "ratio": 2.5}]
    assert content["machine"]["cores"] >= 1
    assert "mujoco" in content["versions"]


@pytest.mark.heavy
def test_both_sides_run_and_are_compared(tmp_path: Path) -> None:
    out = tmp_path / "rows.json"
    asked = ("--scene", "libero_object/0", "--rounds", 1, "--seconds", 0.5, "--num-envs", 4, "--out", out)
    assert invoke("physics", *asked).exit_code == 0
    (row,) = json.loads(out.read_text())["rows"]
    assert row["scene"] == "libero_object/0"
    assert row["vecenv / upstream"] == pytest.approx(row["vecenv steps/s"] / row["upstream steps/s"], rel=0.05)


@pytest.mark.heavy
def test_a_suite_is_solved_alike_on_both_sides(tmp_path: Path) -> None:
    out = tmp_path / "rows.json"
    assert invoke("suite", "--episodes", 1, "--out", out).exit_code == 0
    (row,) = json.loads(out.read_text())["rows"]
    assert row["episodes"] == row["solved"] == 10
    assert row["upstream / vecenv"] > 0
