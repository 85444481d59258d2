"""The store, shards and merging from the command line; a command that is repeated continues its results folder."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.fakes import SUITE, FakeWorld, Worlds
from typer.testing import CliRunner, Result
from vecenv_eval import campaign, runner
from vecenv_eval.merge import folders
from vecenv_eval.store import ResultStore, jsonl, sqlite

from vecenv.cli import build_app


def invoke(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), list(arguments))


def evaluate(*arguments: str) -> Result:
    return invoke("eval", "--suite", SUITE, "--policy", "zero", *arguments)


@pytest.fixture(autouse=True)
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeWorld:
    """``vecenv eval`` and ``vecenv merge`` on the fake suite, in an empty folder."""
    world = FakeWorld()
    for module in (runner, folders):
        monkeypatch.setattr(module, "vecenv_simulator", lambda: world.simulator)
    monkeypatch.chdir(tmp_path)
    return world


def one_line(result: Result, status: int = 2) -> str:
    """The only line that a command prints which is refused, or cannot go on."""
    assert result.exit_code == status, result.output
    assert len(result.stderr.splitlines()) == 1
    return result.stderr


@pytest.mark.parametrize("kind", ["jsonl", "sqlite"])
def test_a_repeated_command_continues_its_folder(world: FakeWorld, kind: str) -> None:
    command = ("--out", "here", "--store", kind)
    world.raise_in = {0: ValueError("boom")}
    assert evaluate(*command).exit_code == 1
    done = ResultStore(Path("here")).done()
    assert 0 < len(done) < 20
    world.raise_in, world.envs = None, []
    again = evaluate(*command, "--num-envs", "3")  # what no verdict depends on may change
    assert again.exit_code == 0, again.output
    assert "10/20" in again.stdout
    assert {key for key, record in ResultStore(Path("here")).records().items() if record.run == 0} == done
    world.envs.clear()
    assert evaluate(*command).exit_code == 0
    assert world.envs == []
    assert len(json.loads(Path("here/config.json").read_text())["runs"]) == 3


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--max-steps", "3"), "max_steps not set and 3"),
        (("--tasks", "0-3", "--seed", "1"), "tasks 'all' and '0-3', seed not set and 1"),
        (("--store", "sqlite"), "store 'jsonl' and 'sqlite'"),
        (("--shard", "1/2"), "shard None and '1/2'"),
    ],
)
def test_a_folder_with_other_settings_is_refused(arguments: tuple[str, ...], says: str) -> None:
    assert evaluate("--out", "here").exit_code == 0
    before = {path: path.read_bytes() for path in Path("here").iterdir()}
    assert f"error: here is already there and holds another evaluation (there and here: {says})" in one_line(
        evaluate("--out", "here", *arguments)
    )
    assert {path: path.read_bytes() for path in Path("here").iterdir()} == before


def test_a_folder_of_something_else_is_refused() -> None:
    Path("mine").mkdir()
    Path("mine/notes.txt").write_text("here")
    assert "mine is already there and not empty" in one_line(evaluate("--out", "mine"))
    Path("campaign").mkdir()
    Path("campaign/campaign.json").write_text("{}")
    assert "campaign is already there and holds several suites" in one_line(evaluate("--out", "campaign"))


# Holds the folder until its input ends.
HOLDER = """
import sys
from pathlib import Path
from vecenv_eval.store.lock import writing
with writing(Path("here")):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_folder_that_another_process_writes_to_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert evaluate("--out", "here").exit_code == 0
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command, pipe = [sys.executable, "-c", HOLDER], subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe) as holder:
        assert holder.stdout is not None
        assert holder.stdin is not None
        assert holder.stdout.readline() == b"held\n"
        assert f"error: here is in use: process {holder.pid} on" in one_line(evaluate("--out", "here"))
        holder.stdin.close()
    assert evaluate("--out", "here").exit_code == 0


def test_a_full_disk_ends_the_run_in_one_sentence_and_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    write, written = jsonl.append_text, []

    def full(path: Path, text: str) -> None:
        if len(written) == 4:
            write(path, text[: len(text) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.append(write(path, text))

    with monkeypatch.context() as patch:
        patch.setattr(jsonl, "append_text", full)
        assert "error: here/episodes.jsonl cannot be written: No space left" in one_line(
            evaluate("--out", "here", "--num-envs", "2")
        )
    done = ResultStore(Path("here")).done()
    assert len(done) >= 3
    assert evaluate("--out", "here").exit_code == 0
    assert {key for key, record in ResultStore(Path("here")).records().items() if record.run == 0} >= done


def test_the_store_is_kept_when_a_folder_is_resumed(world: FakeWorld) -> None:
    world.raise_in = {3: KeyboardInterrupt()}
    assert evaluate("--out", "here", "--store", "sqlite").exit_code == 130
    world.raise_in = None
    assert "leave out --store" in one_line(invoke("eval", "--resume", "here", "--store", "jsonl"))
    assert invoke("eval", "--resume", "here").exit_code == 0
    assert not Path("here/episodes.jsonl").exists()
    assert len(ResultStore.open(Path("here")).records()) == 20
    assert "store=" in one_line(evaluate("--store", "papyrus"))


def test_a_database_without_its_log_is_announced(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert evaluate("--store", "sqlite", "--out", "local").exit_code == 0
    assert "write-ahead log is off" not in caplog.text
    stored = json.loads(Path("local/summary.json").read_text())["conditions"]["store"]
    assert stored == "sqlite, write-ahead log"
    monkeypatch.setattr(sqlite, "file_system", lambda folder: "nfs4")
    assert evaluate("--store", "sqlite", "--out", "shared").exit_code == 0
    assert "write-ahead log is off" in caplog.text
    assert json.loads(Path("shared/config.json").read_text())["conditions"]["store"].endswith("(file system nfs4)")
    assert "store sqlite, no write-ahead log (file system nfs4)" in Path("shared/report.md").read_text()


def test_a_database_is_reported_like_a_text_file() -> None:
    for kind in ("jsonl", "sqlite"):
        assert evaluate("--store", kind, "--out", kind).exit_code == 0
    tables = [invoke("report", kind, "--format", "csv").stdout for kind in ("jsonl", "sqlite")]
    assert tables[0] == tables[1].replace("sqlite", "jsonl")
    assert len(tables[0].splitlines()) > 4


def test_shards_are_merged_from_the_command_line() -> None:
    for part in (1, 2):
        assert evaluate("--shard", f"{part}/2", "--out", f"part{part}").exit_code == 0
    assert "shard 1/2" in Path("part1/report.md").read_text()
    half = invoke("merge", "all", "part1")
    assert half.exit_code == 1
    assert "vecenv eval --resume all" in half.stdout
    done = invoke("merge", "all", "part1", "part2")
    assert done.exit_code == 0, done.output
    assert "10/20" in done.stdout
    assert done.stdout.splitlines()[-1] == "all"
    assert "shard" not in Path("all/report.md").read_text()
    assert invoke("merge", "--quiet", "all", "part1").stdout == "all\n"
    assert invoke("eval", "--resume", "all").exit_code == 0
    assert evaluate("--max-steps", "3", "--out", "other").exit_code == 0
    assert "not from one evaluation: max_steps not set and 3" in one_line(invoke("merge", "new", "part1", "other"))
    assert "nowhere is not a results folder" in one_line(invoke("merge", "new", "nowhere"))
    assert "shard='3/2': expected i/n" in one_line(evaluate("--shard", "3/2"))
    assert not Path("new").exists()


def test_a_campaign_is_sharded_repeated_and_merged(monkeypatch: pytest.MonkeyPatch) -> None:
    worlds = Worlds()
    for module in (runner, folders, campaign):
        monkeypatch.setattr(module, "vecenv_simulator", lambda: worlds.simulator)
    command = ("eval", "--suite", "libero_goal,libero_10", "--policy", "zero")
    for part in (1, 2, 2):
        assert invoke(*command, "--shard", f"{part}/2", "--out", f"part{part}").exit_code == 0
    assert len(worlds.made) == 4
    done = invoke("merge", "all", "part1", "part2")
    assert done.exit_code == 0, done.output
    assert "average over suites" in done.stdout
    assert invoke(*command, "--out", "all").exit_code == 0
    assert len(worlds.made) == 4
    assert "max_steps not set and 2" in one_line(invoke(*command, "--out", "all", "--max-steps", "2"))
