"""``vecenv report``: what is on the page and in the tables, two runs together, and folders that are damaged."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom
from support.results_folders import CONDITIONS, RUN, some_records, write_results
from typer.testing import CliRunner, Result
from vecenv_eval.cli.report import report_command
from vecenv_eval.episodes import Episode
from vecenv_eval.report import figures
from vecenv_eval.report.compare import compare, mcnemar
from vecenv_eval.report.findings import warnings
from vecenv_eval.report.html import page
from vecenv_eval.report.run import read_run
from vecenv_eval.store import ResultStore
from vecenv_eval.video.episodes import video_path

LINE = '{"suite": "s", "task": 0, "episode": 0, "instruction": "", "success": true, "num_steps": 1, "reward": 0}\n'
SUITES = {"libero_10": 0.2, "libero_spatial": 1.0, "libero_goal": 0.6}


def report(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(report_command)
    return CliRunner(env={"COLUMNS": "200"}).invoke(app, [str(each) for each in arguments])


def html_of(folder: Path, other: Path | None = None, **options: Any) -> str:
    runs = [read_run(each) for each in (folder, other) if each]
    return page(*runs, out=folder / "report.html", **options)


def without_plotly(text: str) -> str:
    """The page without the library, which holds addresses of its own."""
    return re.sub(r"<script>[^<]*plotly\.js v.*?</script>", "", text, count=1, flags=re.DOTALL)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_results(tmp_path / "run", some_records(lambda task, episode: episode < 3 + task))


def test_the_page_has_rates_intervals_and_conditions(folder: Path) -> None:
    text = html_of(folder)
    for expected in (
        "7/10",
        "70.0%",
        "39.7% to 89.2%",
        "turn on the stove",
        "horizon",
        "0123abc",
        "gpu H100",
        "mujoco 3.17.0",
    ):
        assert expected in text
    assert "2026-01-02T03:04:05+00:00" in text
    assert "Before you quote" not in text


def test_the_page_asks_nobody_for_anything(folder: Path) -> None:
    text = without_plotly(html_of(folder))
    assert len(text) < 100_000
    assert not re.findall(r"""(?:src|href)=["']?(?!data:)[^"'>]*//""", text)
    assert "default-src 'none'" in text


def test_what_comes_from_the_folder_is_escaped(tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
    records = [
        replace(each, instruction=evil, fault=evil, extras={evil: evil}) for each in some_records(lambda *_: False)
    ]
    text = html_of(write_results(tmp_path / "run", records, conditions={**CONDITIONS, "start": evil}))
    assert "<script>alert" not in text
    assert "<img src=x" not in text
    assert "&lt;script&gt;alert(1)" in text


def test_averages_are_over_suites_in_the_order_of_papers(tmp_path: Path) -> None:
    for suite, rate in SUITES.items():
        records = some_records(lambda _, episode, rate=rate: episode < 5 * rate, suite=suite)
        write_results(tmp_path / suite, records, suite=suite)
    run = read_run(tmp_path)
    assert [suite.title for suite in run.suites] == ["Spatial", "Goal", "Long"]
    assert run.average == pytest.approx(0.6)
    assert "average over suites" in html_of(tmp_path)
    latex = report(tmp_path, "--format", "latex").stdout
    assert r" & Spatial & Goal & Long & Average \\" in latex
    assert r"my:Policy & 100.0 {\scriptsize [72.2, 100.0]}" in latex
    assert r" & 60.0 \\" in latex
    assert "| my:Policy | 100.0% (72.2% to 100.0%)" in report(tmp_path, "--format", "markdown").stdout


def test_the_csv_has_a_row_for_each_task_and_suite(folder: Path) -> None:
    rows = list(csv.DictReader(io.StringIO(report(folder, "--format", "csv").stdout)))
    assert [(row["suite"], row["task"], row["rate"]) for row in rows] == [
        ("libero_goal", "0", "0.6"),
        ("libero_goal", "1", "0.8"),
        ("libero_goal", "all", "0.7"),
        ("average", "", "0.7"),
    ]


def test_latex_is_escaped(tmp_path: Path) -> None:
    records = [replace(each, instruction="50% of a_b & {c}") for each in some_records(lambda *_: True)]
    assert r"50\% of a\_b \& \{c\}" in report(write_results(tmp_path / "run", records), "--format", "latex").stdout


def test_failures_come_first_with_video_and_last_actions(folder: Path) -> None:
    path = video_path(folder, Episode("libero_goal", 0, 4))
    path.parent.mkdir()
    path.write_bytes(b"not really a video")
    demos = ResultStore(folder).demos_path("libero_goal", 0)
    demos.parent.mkdir()
    with h5py.File(demos, "w") as file:
        file["data/demo_4/actions"] = np.full((20, 7), 0.125)
    text = html_of(folder)
    first = text.index('<article class="episode">')
    assert text.index("libero_goal/0/3", first) < text.index("libero_goal/0/4", first) < text.index("solved episodes")
    assert text.count("data:video/mp4;base64,bm90") == 1
    assert text.count("last 8 actions") == 1
    assert text.count('<td class="n">0.125</td>') == 56
    linked = html_of(folder, embed_mb=0)
    assert 'src="videos/libero_goal_0_4.mp4"' in linked
    assert "base64,bm90" not in linked


def test_damaged_recordings_are_left_out(folder: Path) -> None:
    demos = ResultStore(folder).demos_path("libero_goal", 0)
    demos.parent.mkdir()
    demos.write_bytes(b"not HDF5")
    assert "actions</summary>" not in html_of(folder)


def test_what_went_wrong_is_said(tmp_path: Path) -> None:
    records = some_records(lambda *_: True)
    records[0] = replace(records[0], success=False, fault="non-finite state")
    records[1] = replace(records[1], success=False, error="ValueError: boom")
    records[2] = replace(records[2], stand_ins=("a mesh was missing",))
    later = {**RUN, "commit": "456+changes"}
    folder = write_results(tmp_path / "run", records, runs=[RUN, later], ended=False)
    text = " ".join(warnings(read_run(folder)))
    for expected in (
        "1 episodes have no verdict (1 x ValueError: boom)",
        "1 episodes ended in a fault and count as failures (1 x non-finite state)",
        "1 episodes ran with a stand-in: a mesh was missing",
        "episodes that never ran are not counted",
        "continued with different commits",
        "differed from the commit on record",
    ):
        assert expected in text
    page = html_of(folder)
    assert page.index("ValueError: boom") < page.index("libero_goal/0/1 ")
    assert page.index(">error</span>") < page.index(">fault</span>")


def test_sanitized_actions_are_counted(tmp_path: Path) -> None:
    records = some_records(lambda *_: True)
    for index, (count, first) in enumerate(((3, 17), (1, 4))):
        records[index] = replace(records[index], sanitized=count, sanitized_first=first)
    assert warnings(read_run(write_results(tmp_path / "run", records))) == [
        "libero_goal: actions of 4 calls in 2 episodes were not finite or out of range, the earliest at tick 4."
    ]


def test_planned_episodes_that_never_ran_are_counted(folder: Path) -> None:
    lines = (folder / "episodes.jsonl").read_text().splitlines(keepends=True)
    (folder / "episodes.jsonl").write_text("".join(lines[:-2]))
    run = read_run(folder)
    assert [row.missing for row in (*run.suites[0].summary.tasks, run.suites[0].summary.total)] == [0, 2, 2]
    assert "2 planned episodes never ran" in html_of(folder)


def test_success_over_ticks_ends_at_the_rate(folder: Path) -> None:
    ticks, share = figures.solved_within(read_run(folder).suites[0])
    assert ticks.tolist() == [0, 100, 120, 140, 160, 300]
    np.testing.assert_allclose(share, [0, 0.2, 0.4, 0.6, 0.7, 0.7])


def test_the_time_budget_needs_recorded_seconds(folder: Path, tmp_path: Path) -> None:
    assert figures.time_budget(read_run(folder)) is None
    records = some_records(lambda *_: True, policy_s=3.0, physics_s=1.0)
    run = read_run(write_results(tmp_path / "timed", records))
    budget = figures.time_budget(run)
    assert budget is not None
    parts = [(bar["name"], bar["x"]) for bar in budget["data"]]
    assert parts == [("policy", [75.0]), ("physics", [25.0]), ("images", [0.0])]
    assert (run.suites[0].summary.wall_s, run.suites[0].summary.setup_s) == (40.0, 1.5)


@given(lost=st.integers(0, 40), won=st.integers(0, 40))
def test_mcnemar_is_the_binomial_test_of_the_pairs_that_changed(lost: int, won: int) -> None:
    fewer = min(lost, won)
    assert mcnemar(lost, won) == pytest.approx(min(1.0, 2 * float(binom.cdf(fewer, lost + won, 0.5))), abs=1e-9)


def test_two_runs_are_compared_episode_by_episode(folder: Path, tmp_path: Path) -> None:
    records = some_records(lambda task, episode: episode >= 1, episodes=6)
    records[3] = replace(records[3], success=False, error="boom")
    other = write_results(tmp_path / "other", records, conditions={**CONDITIONS, "horizon": 600})
    found = compare(read_run(folder), read_run(other))
    assert [pair.episode.id for pair in found.lost] == ["libero_goal/0/0", "libero_goal/1/0"]
    assert [pair.episode.id for pair in found.won] == ["libero_goal/0/4", "libero_goal/1/4"]
    assert (found.both, found.neither, found.episodes, found.unpaired) == (5, 0, 9, 3)
    assert found.p_value == 1.0
    assert found.differences == {"horizon": ("300", "600")}
    text = html_of(folder, other)
    assert "McNemar" in text
    assert "The 4 episodes that changed sides" in text
    assert "libero_goal/0/4: failed -&gt; solved" not in text
    assert "- libero_goal/0/4: failed -> solved" in report(folder, other, "--format", "markdown").stdout


def test_runs_without_a_common_episode_are_said_to_have_none(folder: Path, tmp_path: Path) -> None:
    other = write_results(
        tmp_path / "other", some_records(lambda *_: True, suite="libero_object"), suite="libero_object"
    )
    assert "no episode in common" in html_of(folder, other)


def test_the_command_writes_the_page_beside_the_results(folder: Path) -> None:
    done = report(folder)
    assert (done.exit_code, done.stdout.strip()) == (0, str(folder / "report.html"))
    assert (folder / "report.html").read_text().startswith("<!doctype html>")


def damage(folder: Path, file: str, content: str | bytes | None) -> Path:
    path = folder / file
    path.unlink()
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("config.json", None, "is not a results folder"),
        ("config.json", "{", "config.json cannot be read"),
        ("config.json", "[]", "cannot be read: it holds no JSON object"),
        ("config.json", b"\xff\xfe\x00", "cannot be read"),
        ("episodes.jsonl", "nonsense\n", "is not an episode"),
        ("episodes.jsonl", b"\xff\n", "episodes.jsonl:1 is not an episode: byte 1 is not UTF-8"),
        (
            "episodes.jsonl",
            LINE.replace('"task": 0', '"task": "x"'),
            "episodes.jsonl:1 is not an episode: task is 'x', not a whole number from 0",
        ),
        (
            "episodes.jsonl",
            LINE.replace('"num_steps": 1', '"num_steps": -1'),
            "num_steps is -1, not a whole number from 0",
        ),
    ],
)
def test_damaged_folders_cost_one_sentence(folder: Path, file: str, content: str | bytes | None, message: str) -> None:
    done = report(damage(folder, file, content))
    assert done.exit_code == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_damaged_summary_costs_a_warning(folder: Path) -> None:
    (folder / "summary.json").write_text("{")
    assert "never ran are not counted" in html_of(folder)


def test_two_runs_of_one_suite_in_a_folder_are_refused(tmp_path: Path) -> None:
    for name in "ab":
        write_results(tmp_path / name, some_records(lambda *_: True))
    done = report(tmp_path)
    assert done.exit_code == 2
    assert "holds several runs of libero_goal" in done.stderr


def test_other_mistakes_cost_one_sentence_too(folder: Path, tmp_path: Path) -> None:
    assert "there is no such folder" in report(tmp_path / "nowhere").stderr
    done = report(folder, "--out", tmp_path / "no" / "where.html")
    assert (done.exit_code, "cannot be written" in done.stderr) == (2, True)


def test_a_run_without_an_episode_still_makes_a_page(tmp_path: Path) -> None:
    text = html_of(write_results(tmp_path / "run", []))
    assert "0/0" in text
    assert json.loads(re.search(r'id="figures">(.*?)</script>', text, re.DOTALL)[1])  # pyright: ignore
