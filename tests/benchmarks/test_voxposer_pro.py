"""The LIBERO-PRO benchmark: its rows are of what its folders have, and a wrong suite or task is one sentence."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import voxposer_pro
from vecenv_eval.store import Record
from voxposer_pro import SUITES, Job, failure_of, row_of, rows_of

import vecenv


def record(task: int, episode: int, *, success: bool, cause: str = "") -> Record:
    return Record(
        suite="libero_goal_task",
        task=task,
        episode=episode,
        instruction="put it there",
        success=success,
        success_first=success,
        success_final=success,
        num_steps=100,
        reward=0.0,
        extras={"cause": cause},
    )


def test_the_suites_are_all_of_libero_pro() -> None:
    assert len(SUITES) == 16
    assert all(len(vecenv.list_tasks(suite)) == voxposer_pro.TASKS for suite in SUITES)


def test_a_row_counts_what_was_solved_and_names_the_tasks_with_failures() -> None:
    records = [record(2, e, success=e > 0) for e in range(4)] + [record(3, e, success=True) for e in range(4)]
    row = row_of("libero_goal_task", records)
    assert (row["episodes"], row["solved"], row["rate"], row["failed"]) == (8, 7, 0.875, "2: 1/4")
    assert row["95 %"] == "0.53-0.98"


def test_a_failure_has_its_cause() -> None:
    assert failure_of(record(2, 0, success=False, cause="OutOfReach: too far"))["cause"] == "OutOfReach: too far"


def test_folders_that_are_not_there_make_no_rows(tmp_path: Path) -> None:
    assert rows_of([Job("libero_goal_task", 0, "0-1", 2, "", tmp_path / "none")]) == ([], [])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--suites", "libero_goal_tasks"], "no suite 'libero_goal_tasks'"),
        (["--tasks", "8-12"], "expected indices from 0 to 9"),
        (["--tasks", "one"], "expected indices and ranges"),
        (["--jobs", "0"], "--jobs and --num-envs must be at least 1"),
    ],
)
def test_what_does_not_exist_is_refused(
    options: list[str], says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["voxposer_pro.py", *options])
    with pytest.raises(SystemExit) as ended:
        voxposer_pro.main()
    assert ended.value.code == 2
    assert says in capsys.readouterr().err


def test_an_empty_folder_is_no_report(tmp_path: Path) -> None:
    command = [sys.executable, voxposer_pro.__file__, "--report", "--work", str(tmp_path)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert run.returncode == 1
    assert "no episodes of these suites yet" in run.stderr


def test_where_nothing_was_run_the_causes_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxposer_pro, "run", lambda jobs, processes: [f"{jobs[0].suite}/0: episodes='0': no episode"])
    monkeypatch.setattr(sys, "argv", ["voxposer_pro.py", "--episodes", "0", "--work", str(tmp_path)])
    with pytest.raises(SystemExit, match="no episodes of these suites yet\nlibero_spatial_lan/0: episodes='0'"):
        voxposer_pro.main()
