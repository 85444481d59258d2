"""Results folders as data: campaigns, shards, damage, links that lead out, and folders that grow and are killed."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.filmed import record
from support.results_folders import some_records, write_results
from vecenv_eval.config import STORE_CHOICES
from vecenv_eval.episodes import Episode
from vecenv_eval.store import CONFIG, EPISODES, ResultStore, StoreError
from vecenv_eval.web.runs import RunReader, Snapshot, open_runs

WRITER = """
import sys, time
from pathlib import Path
from typing import Any
from support.filmed import record
from vecenv_eval.store import ResultStore
store = ResultStore.open(Path(sys.argv[1]))
with store.writing():
    for episode in range(int(sys.argv[2]), 10**6):
        store.append([record(episode, episode % 3 > 0, wall_s=0.1)])
        time.sleep(0.005)
"""


def look(folder: Path) -> Snapshot:
    return RunReader("run", folder).snapshot()


def write_some(folder: Path, suite: str = "libero_goal", **settings: Any) -> Path:
    return write_results(folder, some_records(lambda task, episode: episode < 3, suite=suite), suite=suite, **settings)


def config_of(suite: str = "libero_goal", **more: object) -> dict[str, object]:
    return {"suite": suite, "policy": "random", "tasks": "0-1", "episodes": 5, **more}


def test_a_folder_has_counts_intervals_and_tasks(tmp_path: Path) -> None:
    run = look(write_some(tmp_path / "run", config=config_of()))
    assert (run.total.episodes, run.total.successes, run.total.missing) == (10, 6, 0)
    assert run.total.low == pytest.approx(0.3127, abs=1e-3)
    assert run.state() == "complete"
    (leg,) = run.legs
    assert [row.successes for row in leg.tasks] == [3, 3]
    assert leg.conditions.startswith("protocol seed")
    assert run.problems == ()


def test_what_was_planned_is_known_before_it_has_run(tmp_path: Path) -> None:
    folder = write_results(tmp_path / "run", [], ended=False, config=config_of())
    run = look(folder)
    assert [row.missing for row in run.legs[0].tasks] == [5, 5]
    assert "drawer" in run.legs[0].tasks[0].instruction
    assert run.state() == "empty"
    ResultStore.open(folder).append(some_records(lambda *_: True, tasks=1, episodes=2))
    assert look(folder).total.missing == 8


def test_a_suite_that_is_not_installed_has_rows_without_a_plan(tmp_path: Path) -> None:
    run = look(write_some(tmp_path / "run", "somebody's suite", config=config_of("somebody's suite")))
    assert run.total.episodes == 10
    assert run.legs[0].planned is None
    assert run.state() == "complete"


def test_a_campaign_has_a_leg_for_each_suite_and_seed(tmp_path: Path) -> None:
    for seed in (0, 1):
        for suite in ("libero_goal", "libero_10"):
            write_some(tmp_path / f"seed-{seed}" / suite, suite, config=config_of(suite, seed=seed))
    run = look(tmp_path)
    assert [(leg.name, leg.seed) for leg in run.legs] == [
        ("seed-0/libero_10", 0),
        ("seed-0/libero_goal", 0),
        ("seed-1/libero_10", 1),
        ("seed-1/libero_goal", 1),
    ]
    assert run.total.episodes == 40
    assert len(run.rows) == 40


def test_shards_beside_one_another_are_one_evaluation(tmp_path: Path) -> None:
    records = some_records(lambda task, episode: episode < 3)
    for part, some in ((1, records[:5]), (2, records[5:])):
        write_results(tmp_path / f"part{part}", some, config=config_of(shard=f"{part}/2"))
    write_some(tmp_path / "other", config=config_of(max_steps=5))
    run = look(tmp_path)
    joined = next(leg for leg in run.legs if len(leg.folders) == 2)
    assert len(run.legs) == 2
    assert (joined.total.episodes, joined.total.missing) == (10, 0)


def test_the_shards_of_jobs_are_read_with_what_was_merged_already(tmp_path: Path) -> None:
    records = some_records(lambda *_: True)
    write_results(tmp_path / "run", records[:3], config=config_of(), ended=False)
    for part, some in ((1, records[:5]), (2, records[5:8])):
        write_results(
            tmp_path / "run" / "shards" / f"{part}-of-2", some, config=config_of(shard=f"{part}/2"), ended=False
        )
    (leg,) = look(tmp_path / "run").legs
    assert len(leg.folders) == 3
    assert (leg.total.episodes, leg.total.missing) == (8, 2)


# -- damage ------------------------------------------------------------------------------------------------------------


DAMAGED = [
    b"not json",
    b"[1, 2]",
    b'{"suite": "libero_goal"}',
    b"\xff\xfe\x00",
    b"[" * 100_000,
    b"1" * 5000,
    b'{"suite": "s", "task": -1, "episode": 0, "instruction": "", "success": true, "num_steps": 1, "reward": 1}',
    b'{"suite": "s", "task": 0, "episode": 0, "instruction": "", "success": "no way", "num_steps": 1, "reward": 1}',
    b'{"suite": "s", "task": 0, "episode": 0, "instruction": [], "success": true, "num_steps": 1, "reward": 1}',
    b'{"suite": "s", "task": 0, "episode": 0, "instruction": "", "success": 1, "num_steps": 1, "reward": 1}',
]


@pytest.mark.parametrize("damage", DAMAGED, ids=range(len(DAMAGED)))
def test_a_damaged_row_is_named_and_the_others_are_shown(tmp_path: Path, damage: bytes) -> None:
    folder = write_some(tmp_path / "run")
    lines = (folder / EPISODES).read_bytes().split(b"\n")
    (folder / EPISODES).write_bytes(b"\n".join([*lines[:4], damage, *lines[4:]]))
    run = look(folder)
    assert run.total.episodes == 10
    (problem,) = run.problems
    assert problem.startswith(f"{EPISODES}:5 is not an episode: ")
    assert problem.endswith("1 row passed over")
    assert "\n" not in problem


def test_a_damaged_row_of_a_database_is_named(tmp_path: Path) -> None:
    folder = write_some(tmp_path / "run", config=config_of(store="sqlite"))
    with closing(sqlite3.connect(folder / "episodes.sqlite")) as database:
        database.execute("UPDATE episodes SET extras = 'no json' WHERE task = 0 AND episode = 2")
        database.execute("UPDATE episodes SET num_steps = 'many' WHERE task = 1 AND episode = 0")
        database.commit()
    run = look(folder)
    assert run.total.episodes == 8
    assert "2 rows passed over" in run.problems[0]


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\x00" + b"\xff" * 4000, b"nothing of the kind"])
def test_a_damaged_database_is_a_sentence(tmp_path: Path, content: bytes) -> None:
    folder = write_some(tmp_path / "run", config=config_of(store="sqlite"))
    for path in folder.glob("episodes.sqlite*"):
        path.unlink()
    (folder / "episodes.sqlite").write_bytes(content)
    run = look(folder)
    assert run.total.episodes == 0
    assert len(run.problems) == (1 if content else 0)


def test_a_query_that_never_ends_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vecenv_eval.store.sqlite import COLUMNS
    from vecenv_eval.web import rows

    monkeypatch.setattr(rows, "_LONGEST_S", 0.3)
    folder = write_some(tmp_path / "run", config=config_of(store="sqlite"))
    with closing(sqlite3.connect(folder / "episodes.sqlite")) as database:
        database.execute("DROP TABLE episodes")
        endless = "(WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT count(*) FROM n)"
        columns = ", ".join(f"{endless if name == 'task' else 1} AS {name}" for name in COLUMNS)
        database.execute("CREATE TABLE other (x)")
        database.execute(f"CREATE VIEW episodes AS SELECT {columns}")
        database.commit()
    began = time.monotonic()
    assert look(folder).total.episodes == 0
    assert time.monotonic() - began < 5


@pytest.mark.parametrize("content", ["", "[]", "{", "null", '{"config": 5, "conditions": [], "runs": {}}'])
def test_a_damaged_config_leaves_the_rows(tmp_path: Path, content: str) -> None:
    folder = write_some(tmp_path / "run")
    (folder / CONFIG).write_text(content)
    run = look(folder)
    assert run.total.episodes == 10
    assert len(run.problems) == (0 if "runs" in content else 1)


def test_two_kinds_of_rows_are_refused_by_name(tmp_path: Path) -> None:
    folder = write_some(tmp_path / "run")
    (folder / "episodes.sqlite").write_bytes(b"")
    assert "episodes.jsonl and episodes.sqlite" in look(folder).problems[0]


def test_links_out_of_the_folder_are_not_followed(tmp_path: Path) -> None:
    secret = write_some(tmp_path / "elsewhere")
    folder = write_some(tmp_path / "all" / "run")
    (tmp_path / "all" / "away").symlink_to(secret)
    (folder / EPISODES).unlink()
    (folder / EPISODES).symlink_to(secret / EPISODES)
    run = look(tmp_path / "all")
    assert run.total.episodes == 0
    assert sorted(run.problems) == [
        "away is a link out of the folder, and is not read",
        "episodes.jsonl is a link out of the folder run, and is not read",
    ]


def test_a_pipe_does_not_stop_the_viewer(tmp_path: Path) -> None:
    folder = write_some(tmp_path / "run")
    (folder / EPISODES).unlink()
    os.mkfifo(folder / EPISODES)
    assert "no ordinary file" in look(folder).problems[0]


def test_a_line_without_an_end_costs_no_memory(tmp_path: Path) -> None:
    folder = write_some(tmp_path / "run")
    with (folder / EPISODES).open("ab") as file:
        file.truncate(file.tell() + 60_000_000)
    run = look(folder)
    assert run.total.episodes == 10
    assert "a line is longer than" in run.problems[0]


@pytest.mark.parametrize("name", ["nowhere", "empty", "file"])
def test_what_holds_no_results_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=name):
        open_runs([tmp_path / name])


def test_two_runs_of_one_name_have_two_names(tmp_path: Path) -> None:
    folders = [write_some(tmp_path / place / "a run") for place in ("x", "y")]
    assert [reader.name for reader in open_runs(folders)] == ["a-run", "a-run-2"]


def test_a_name_is_looked_for_in_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_some(tmp_path / "results" / "mine")
    monkeypatch.chdir(tmp_path)
    assert open_runs([Path("mine")])[0].folder == tmp_path / "results" / "mine"


# -- growing -----------------------------------------------------------------------------------------------------------


class Looks:
    """Looks at a folder without waiting between them."""

    def __init__(self, folder: Path) -> None:
        self.reader = RunReader("run", folder)

    def __call__(self) -> Snapshot:
        self.reader._due = 0.0
        return self.reader.snapshot()


@pytest.mark.parametrize("kind", STORE_CHOICES)
def test_rows_come_as_they_are_written(tmp_path: Path, kind: str) -> None:
    folder = write_results(tmp_path / "run", [], ended=False, config=config_of(store=kind))
    looks, store = Looks(folder), ResultStore.open(folder)
    first = looks()
    assert looks() is first, "nothing has changed"
    with store.writing():
        for episode in range(3):
            store.append([record(episode)])
            run = looks()
            assert [key.episode for key in run.legs[0].records] == list(range(episode + 1))
            assert run.version == first.version + episode + 1
    store.append([replace(record(7, False), error="boom")])
    store.append([record(7)])
    assert looks().total.errors == 0


def test_a_line_that_is_being_written_is_read_when_it_is_whole(tmp_path: Path) -> None:
    folder = write_some(tmp_path / "run", ended=False)
    looks = Looks(folder)
    looks()
    line = (folder / EPISODES).read_bytes().splitlines()[0].replace(b'"episode": 0', b'"episode": 77')
    for some, count in ((line[:40], 10), (line[40:], 10), (b"\n", 11)):
        with (folder / EPISODES).open("ab") as file:
            file.write(some)
        run = looks()
        assert (run.total.episodes, run.problems) == (count, ())


def test_a_folder_that_is_replaced_is_read_again(tmp_path: Path) -> None:
    folder = write_some(tmp_path / "run")
    looks = Looks(folder)
    looks()
    lines = (folder / EPISODES).read_bytes().splitlines(keepends=True)
    (folder / "new").write_bytes(b"".join(lines[:2]))
    (folder / "new").replace(folder / EPISODES)
    assert looks().total.episodes == 2


def test_a_suite_that_begins_later_is_found(tmp_path: Path) -> None:
    write_some(tmp_path / "libero_goal")
    looks = Looks(tmp_path)
    assert len(looks().legs) == 1
    write_some(tmp_path / "libero_10", "libero_10", config=config_of("libero_10"))
    assert len(looks().legs) == 2


@pytest.mark.parametrize("kind", STORE_CHOICES)
def test_a_writer_that_is_killed_loses_nothing_by_being_looked_at(tmp_path: Path, kind: str) -> None:
    folder = write_results(tmp_path / "run", [], ended=False, config=config_of("libero_goal", store=kind))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    looks, seen = Looks(folder), 0
    for round in range(3):
        begin = [sys.executable, "-c", WRITER, str(folder), str(1000 * round)]
        with subprocess.Popen(begin, env=environment) as writer:
            until = time.monotonic() + 60
            while seen < 40 * (round + 1) and time.monotonic() < until:
                run = looks()
                now = {key.episode for key in run.legs[0].records}
                assert len(now) >= seen, "what was seen stays"
                assert run.problems == ()
                seen = len(now)
            assert looks().state() == "running"
            writer.send_signal(signal.SIGKILL)
        kept = ResultStore.open(folder).records()
        run = looks()
        assert run.legs[0].records == kept, "the page shows what is on the disk"
        assert not run.legs[0].writing
        numbers = sorted(key.episode for key in kept if key.episode >= 1000 * round)
        assert numbers == list(range(1000 * round, 1000 * round + len(numbers))), "no row between two others is lost"
    assert seen >= 120
    assert Episode("libero_goal", 1, 0) in kept


def test_nothing_is_written_by_looking(tmp_path: Path) -> None:
    folder = write_some(tmp_path / "run")
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in sorted(folder.rglob("*"))}
    looks = Looks(folder)
    assert looks().legs[0].tasks
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in sorted(folder.rglob("*"))} == before
