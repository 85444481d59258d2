"""An evaluation that is killed again and again ends as one that ran undisturbed."""

from __future__ import annotations

import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest
from vecenv_eval.config import STORE_CHOICES
from vecenv_eval.store import ResultStore

# Two tasks and many short episodes, a few at a time, so that rows are written most of the time.
SETTINGS = "--suite libero_object --tasks 0-1 --policy random --max-steps 8 --num-envs 3 --num-threads 1"
COMMAND = [sys.executable, "-c", "from vecenv.cli import main; main()", "eval", *SETTINGS.split()]


def start(folder: Path, kind: str, episodes: int) -> subprocess.Popen[bytes]:
    """The evaluation in a process group of its own."""
    options = ["--out", str(folder), "--store", kind, "--episodes", str(episodes // 2)]
    with folder.with_suffix(".log").open("ab") as log:
        return subprocess.Popen([*COMMAND, *options], stdout=log, stderr=log, start_new_session=True)


def finish(folder: Path, kind: str, episodes: int) -> None:
    assert start(folder, kind, episodes).wait() == 0, folder.with_suffix(".log").read_text()[-2000:]


def kill_when(process: subprocess.Popen[bytes], folder: Path, wait_for: int, delay_s: float) -> bool:
    """SIGKILL to the whole group, some time after so many episodes have a row; False if it had ended before."""
    while process.poll() is None and count(folder) < wait_for:
        time.sleep(0.002)
    time.sleep(delay_s)
    alive = process.poll() is None
    if alive:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return alive


def count(folder: Path) -> int:
    """Rows on the disk, without a look at anything but the file."""
    if (path := folder / "episodes.jsonl").exists():
        return path.read_bytes().count(b"\n")
    try:
        with closing(sqlite3.connect(f"file:{folder / 'episodes.sqlite'}?mode=ro", uri=True)) as database:
            return database.execute("SELECT count(*) FROM episodes").fetchone()[0]
    except sqlite3.Error:  # not made yet
        return 0


def rows(folder: Path) -> list[str]:
    records = sorted(ResultStore.open(folder).records().values(), key=lambda record: record.key)
    return [json.dumps(record.verdict, sort_keys=True) for record in records]


def table(folder: Path) -> list[dict[str, object]]:
    return json.loads((folder / "summary.json").read_text())["tasks"]


def survive(folder: Path, whole: Path, kind: str, kills: int, episodes: int) -> None:
    """Kill a run so many times, at random moments from its start to its end; then let it finish, and compare."""
    chance, killed = random.Random(f"{kind} {kills}"), 0
    for _ in range(4 * kills):
        there, left = count(folder), kills - killed
        # Half of the kills come while rows are written, the others at any time, beginning with the start of Python.
        ahead = chance.randint(1, max(1, (episodes - there) // left)) if chance.random() < 0.5 else 0
        delay_s = chance.uniform(0, 0.02) if ahead else chance.uniform(0, 4)
        before = rows(folder) if (folder / "config.json").exists() else []
        killed += kill_when(start(folder, kind, episodes), folder, there + ahead, delay_s)
        if (folder / "config.json").exists():
            assert set(before) <= set(rows(folder)), "a row was lost"
        if killed == kills:
            break
    assert killed == kills
    finish(folder, kind, episodes)
    assert len(ResultStore.open(folder).records()) == episodes
    assert rows(folder) == rows(whole)
    assert table(folder) == table(whole)
    if kind == "jsonl":  # no episode that had a verdict ran again
        assert len((folder / "episodes.jsonl").read_text().splitlines()) == episodes


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed run of 24 episodes."""
    folder = tmp_path_factory.mktemp("few") / "whole"
    finish(folder, "jsonl", 24)
    return folder


@pytest.mark.parametrize("kind", STORE_CHOICES)
def test_three_kills_cost_nothing(tmp_path: Path, few: Path, kind: str) -> None:
    survive(tmp_path / "run", few, kind, kills=3, episodes=24)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", STORE_CHOICES)
def test_twenty_kills_cost_nothing(tmp_path: Path, kind: str) -> None:
    finish(tmp_path / "whole", "jsonl", 100)
    survive(tmp_path / "run", tmp_path / "whole", kind, kills=20, episodes=100)
