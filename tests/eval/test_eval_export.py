"""Every episode as one table in a file, with the types it has in the store."""

from __future__ import annotations

import json
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from support.fakes import SUITE, FakeWorld, Worlds
from typer.testing import CliRunner, Result
from vecenv_eval.campaign import Campaign
from vecenv_eval.cli.export import Format
from vecenv_eval.config import STORE_CHOICES, EvalConfig
from vecenv_eval.export import FORMATS, TABLE, export, read_rows
from vecenv_eval.runner import evaluate
from vecenv_eval.store import ResultStore

from vecenv.cli import build_app


def invoke(*arguments: object) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["export", *map(str, arguments)])


@pytest.fixture(params=STORE_CHOICES)
def results(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    config = EvalConfig(suite=SUITE, policy="zero", store=request.param)
    world = FakeWorld(faults={(0, 1): "it flew, far\naway"}, raise_in={1: ValueError('a "boom"')})
    evaluate(config, tmp_path / "run", simulator=world.simulator)
    store = ResultStore.open(tmp_path / "run")
    store.close()
    return tmp_path / "run"


def read(path: Path, kind: str) -> list[dict[str, Any]]:
    """The rows of an exported file, with what is JSON text read."""
    if kind == "jsonl":
        return [json.loads(line) for line in path.read_text().splitlines()]
    if kind == "sqlite":
        with closing(sqlite3.connect(path)) as database:
            found = database.execute(f"SELECT {', '.join(TABLE)} FROM episodes").fetchall()
        rows = [dict(zip(TABLE, row, strict=True)) for row in found]
        rows = [{n: bool(v) if TABLE[n].startswith("BOOLEAN") else v for n, v in row.items()} for row in rows]
    elif kind == "parquet":
        rows = pytest.importorskip("pyarrow.parquet").read_table(path).to_pylist()
    else:
        options = pytest.importorskip("pyarrow.csv").ParseOptions(newlines_in_values=True)
        rows = sys.modules["pyarrow.csv"].read_csv(path, parse_options=options).to_pylist()
        rows = [{n: "" if v is None and "TEXT" in TABLE[n] else v for n, v in row.items()} for row in rows]
    return [{**row, **{name: json.loads(str(row[name])) for name in ("extras", "stand_ins", "parts")}} for row in rows]


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_holds_every_row(results: Path, kind: str) -> None:
    done = invoke(results, "--format", kind)
    assert done.exit_code == 0, done.output
    path = results / f"export.{kind}"
    assert done.stdout == f"{path}\n"
    rows = read(path, kind)
    assert rows == read_rows(results)
    assert len(rows) == 20
    assert [(row["task"], row["episode"]) for row in rows] == [(t, e) for t in range(4) for e in range(5)]
    assert rows[1]["fault"] == "it flew, far\naway"
    assert {row["error"] for row in rows if row["task"] == 1} == {'ValueError: a "boom"'}
    assert not list(results.glob(".export-*"))


def test_parquet_columns_have_their_types(results: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    export(results, "parquet", results / "x.parquet")
    types = {field.name: (str(field.type), field.nullable) for field in parquet.read_schema(results / "x.parquet")}
    assert types["success"] == ("bool", False)
    assert (types["task"], types["wall_s"], types["reward"]) == (("int64", False), ("double", False), ("double", True))
    assert types["seed"] == ("int64", True)


def test_a_campaign_is_one_table_with_suite_and_seed(tmp_path: Path) -> None:
    config = EvalConfig(suite="libero_goal,libero_10", seeds="7,0", policy="zero", episodes="1")
    Campaign(config, tmp_path / "c", Worlds().simulator).run()
    assert invoke(tmp_path / "c", "--format", "jsonl", "--out", tmp_path / "deep" / "all.jsonl").exit_code == 0
    rows = read(tmp_path / "deep" / "all.jsonl", "jsonl")
    pairs = [(row["suite"], row["seed"]) for row in rows]
    assert list(dict.fromkeys(pairs)) == [(s, n) for s in ("libero_10", "libero_goal") for n in (0, 7)]
    assert len(rows) == 16


def test_what_cannot_be_exported_gets_one_sentence(tmp_path: Path, results: Path) -> None:
    (tmp_path / "there.csv").write_text("mine")
    for arguments, says in (
        ((results, "--format", "csv", "--out", tmp_path / "there.csv"), "there.csv is already there: name another"),
        ((tmp_path / "nowhere", "--format", "jsonl"), "nowhere is not a results folder: there is no such folder"),
        ((tmp_path / "empty", "--format", "jsonl"), "empty is not a results folder: neither it nor"),
        ((results, "--format", "jsonl", "--out", tmp_path / "there.csv" / "x"), "x cannot be written"),
    ):
        (tmp_path / "empty").mkdir(exist_ok=True)
        done = invoke(*arguments)
        assert done.exit_code == 2
        assert says in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert (tmp_path / "there.csv").read_text() == "mine"
    unknown = invoke(results, "--format", "xlsx")
    assert unknown.exit_code == 2
    assert "'xlsx' is not one of" in unknown.stderr


def test_a_missing_package_is_named(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for kind in ("csv", "parquet"):
        done = invoke(results, "--format", kind)
        assert done.exit_code == 1
        assert done.stderr == "error: CSV and Parquet need pyarrow: pip install 'vecenv[datasets]'\n"
    assert invoke(results, "--format", "sqlite").exit_code == 0


def test_the_command_has_every_format() -> None:
    assert [each.value for each in Format] == list(FORMATS)
