"""Tables at any width: nothing is cut, keys are repeated where a table is split, and every command's fit 80 columns."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rich.console import Console, RenderableType
from typer.testing import CliRunner
from vecenv_eval import campaign
from vecenv_eval.bench.table import publish
from vecenv_eval.campaign import CampaignSummary, SuiteRow
from vecenv_eval.demos import outcomes
from vecenv_eval.demos.outcomes import Outcome, ReplayReport
from vecenv_eval.episodes import Episode
from vecenv_eval.report import summarise
from vecenv_eval.report import table as summary_table
from vecenv_eval.store import Record

import vecenv
from vecenv import doctor
from vecenv.cli import build_app
from vecenv.doctor import Check, Package, Report
from vecenv.util.tables import Column, FittedTable, from_rows

WIDTH = 80
PATH = "/a/path/of/many/folders/" + "/".join(["folder"] * 12)


def rendered(table: RenderableType, width: int = WIDTH) -> str:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def assert_readable(text: str, cells: Sequence[str], width: int = WIDTH) -> None:
    """No line is too long, nothing is abbreviated, and every word of every cell is there in one piece."""
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    words = {word.rstrip(":") for word in text.split()} | set(text.split())  # rows as lists have "name: value"
    missing = [word for cell in cells for word in cell.split() if word not in words and len(word) <= 40]
    assert not missing


def test_a_table_that_fits_is_one_table() -> None:
    table = from_rows([{"scene": "a", "ratio": 1.5}, {"scene": "b", "ratio": 20.0}], title="speed")
    assert [line.rstrip() for line in rendered(table).splitlines()] == [
        "speed",
        "scene  ratio",
        "────────────",
        "a       1.50",
        "b      20.00",
    ]


def test_free_text_wraps_before_columns_are_split_off() -> None:
    text = " ".join(["words"] * 30)
    table = FittedTable(
        columns=[Column("task", key=True), Column("what", text=True), Column("n")], rows=[("0", text, "7")]
    )
    lines = rendered(table, 40).splitlines()
    assert lines[0].split() == ["task", "what", "n"]
    assert sum(line.count("words") for line in lines) == 30
    assert len(lines) == 2 + 6


def test_a_table_that_is_too_wide_is_split_with_its_keys() -> None:
    rows = [{"scene": f"scene{i}", **{f"column{j}": f"value{i}{j}" for j in range(9)}} for i in range(2)]
    parts = rendered(from_rows(rows), 40).split("\n\n")
    assert len(parts) == 3
    assert all(part.split()[0] == "scene" and "scene1" in part for part in parts)
    assert_readable("\n".join(parts), [value for row in rows for value in (*row, *row.values())], 40)


def test_rows_that_fit_no_table_become_lists() -> None:
    rows = [{"scene": "a_rather_long_name", "ratio": "also_a_long_value"}, {"scene": "b", "ratio": "c"}]
    lines = rendered(from_rows(rows), 25).splitlines()
    assert lines == ["scene: a_rather_long_name", "ratio: also_a_long_value", "", "scene: b", "ratio: c"]


def test_markup_in_cells_is_text() -> None:
    assert "[red]x[/red]" in rendered(FittedTable(columns=[Column("a")], rows=[("[red]x[/red]",)]))


def test_a_table_without_rows_is_its_head() -> None:
    assert rendered(FittedTable(columns=[Column("a"), Column("b", text=True)], rows=[])).split()[:2] == ["a", "b"]


@settings(max_examples=25)
@given(
    st.integers(1, 5).flatmap(
        lambda count: st.lists(
            st.lists(st.from_regex(r"[a-z0-9 ]{0,60}", fullmatch=True), min_size=count, max_size=count)
        )
    ),
    st.sets(st.integers(0, 4)),
    st.integers(44, 120),
)
@example([["", "", "0" * 41]], set(), 44)
def test_no_word_is_lost_whatever_the_cells(rows: list[list[str]], texts: set[int], width: int) -> None:
    count = len(rows[0]) if rows else 1
    columns = [Column(f"c{i}", text=i in texts, key=i == 0) for i in range(count)]
    text = rendered(FittedTable(columns=columns, rows=rows), width)
    assert_readable(text, [f"c{i}" for i in range(count)], width)
    # A word may be folded where it is longer than the screen; nothing but spaces and rules may differ.
    for row in rows:
        for cell in row:
            for word in cell.split():
                assert word in text or len(word) > 40


# What commands print.


def record(task: int, episode: int, **values: object) -> Record:
    usual = {"instruction": "", "success": True, "num_steps": 100, "reward": 1.0}
    return Record(suite="libero_10", task=task, episode=episode, **{**usual, **values})  # type: ignore[arg-type]


def test_eval() -> None:
    instructions = [task.instruction for task in vecenv.list_tasks("libero_10")]
    planned = [Episode("libero_10", task, episode) for task in range(10) for episode in range(50)]
    records = [record(0, 0, fault="non-finite state"), record(0, 1, error="ValueError: boom", success=False)]
    records += [record(task, episode) for task in range(1, 10) for episode in range(50)]
    summary = summarise(records, planned, suite="libero_10", policy="zero", instructions=instructions)
    cells = [*instructions, "50/50", "451/451", "100.0%", "99.2%-100.0%", "faults", "errors", "48"]
    assert_readable(rendered(summary_table(summary)), cells)


def test_campaign() -> None:
    seeds = tuple(range(10))
    rates = tuple(0.9 + seed / 100 for seed in seeds)
    rows = [
        SuiteRow(suite=suite, rates=rates, mean=0.945, std=0.03, episodes=5000, errors=12, missing=3)
        for suite in ("libero_spatial", "simpler/google_robot")
    ]
    summary = CampaignSummary(policy="openpi", seeds=seeds, suites=tuple(rows), average=0.945, average_std=0.03)
    text = rendered(campaign.table(summary))
    assert_readable(text, ["simpler/google_robot", "94.5%", "±", "3.0", "99.0%", "5000", "15", "average", "suites"])
    assert text.count("seed") == len(seeds) + 1


def test_replay() -> None:
    long = {"recorded": True, "length": 500, "ticks": 500, "qpos_error": 1.2e-13, "qvel_error": 0.0}
    rows = [
        Outcome(
            path=Path(f"{name}_demo.hdf5"), name="demo_49", suite="libero_90", task=89, replayed=name == "a", **long
        )
        for name in ("a", "put_the_white_mug_on_the_left_plate")
    ]
    report = ReplayReport(outcomes=tuple(rows), problems=())
    text = rendered(outcomes.table(report))
    assert_readable(text, ["libero_90/89", "demo_49", "solved", "failed", "500/500", "1.2e-13", "a_demo.hdf5"])
    assert "put_the_white_mug_on_the_left_plate_demo" in text.replace("\n", "").replace(" ", "")


def test_doctor() -> None:
    checks = (
        Check("GL: egl", True, False, "llvmpipe (LLVM 19.1.7, 256 bits), OpenGL 4.5", ""),
        Check("assets: libero", False, True, PATH, "pip install it"),
    )
    console = Console(width=WIDTH)
    with console.capture() as capture:
        doctor.print_report(Report((Package("mujoco", "core", "<4,>=3.17", "", False),), checks, {}), console)
    tables = capture.get().split("needed ·")[0]
    assert_readable(tables, ["mujoco", "missing", "<4,>=3.17", checks[0].detail])
    assert PATH in "".join(line[-len(line.lstrip()) :] for line in tables.split())


@pytest.mark.parametrize("name", ["physics", "sweep", "suite"])
def test_bench(
    name: str, tmp_path: Path, repository: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    rows = json.loads((repository / "benchmarks" / "results" / f"{name}.json").read_text())["rows"]
    publish(rows, f"env control steps/s, {name}", None)
    cells = [f"{value:.2f}" if isinstance(value, float) else str(value) for row in rows for value in row.values()]
    assert_readable(capsys.readouterr().out, cells)


@pytest.mark.parametrize("arguments", [(), ("libero_90",), ("simpler/google_robot",)])
def test_list(arguments: tuple[str, ...]) -> None:
    runner = CliRunner(env={"COLUMNS": str(WIDTH)})
    rows = json.loads(runner.invoke(build_app(), ["list", *arguments, "--json"]).stdout)
    assert_readable(
        runner.invoke(build_app(), ["list", *arguments]).stdout, [str(v) for row in rows for v in row.values()]
    )


def test_list_of_protocols() -> None:
    text = CliRunner(env={"COLUMNS": str(WIDTH)}).invoke(build_app(), ["list", "--protocols"]).stdout
    tables = text.split("libero seed: this project")[0]
    assert_readable(tables, ["variant-aggregation", "220/280/300/520/400", "fixtures", "episodes", "replan", "1000"])
