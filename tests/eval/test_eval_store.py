"""The results folder: nothing computed is lost, and nothing damaged is taken for a result."""

from __future__ import annotations

import dataclasses
import json
import os
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vecenv_eval.config import STORE_CHOICES
from vecenv_eval.episodes import Episode
from vecenv_eval.store import STORES, Record, ResultStore, StoreError, default_folder, sqlite
from vecenv_eval.store.filesystems import file_system, is_local


def record(task: int = 0, episode: int = 0, **fields: object) -> Record:
    values = {"instruction": "do it", "success": True, "num_steps": 7, "reward": 1.0, **fields}
    return Record(suite="s", task=task, episode=episode, **values)  # pyright: ignore[reportArgumentType]


def create(folder: Path, kind: str) -> ResultStore:
    return ResultStore.create(folder, {"config": {"store": kind}, "runs": []})


@pytest.fixture
def store(tmp_path: Path) -> ResultStore:
    """A results folder with a text file."""
    return ResultStore.create(tmp_path / "run", {"runs": []})


@pytest.fixture(params=STORE_CHOICES)
def either(tmp_path: Path, request: pytest.FixtureRequest) -> ResultStore:
    """A results folder of each kind."""
    return create(tmp_path / "run", request.param)


def test_records_read_back_as_they_were_written(either: ResultStore) -> None:
    written = [record(0, 0), record(1, 2, success=False, fault="it flew away", wall_s=1.5, batch=3)]
    either.append(written)
    assert list(ResultStore.open(either.folder).records().values()) == written


def test_every_kind_of_store_can_be_asked_for() -> None:
    assert tuple(STORES) == STORE_CHOICES


TEXTS = st.text(max_size=5)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False, allow_infinity=False) | TEXTS,
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(TEXTS, inner, max_size=2),
    max_leaves=4,
)


@settings(max_examples=30)
@given(
    values=st.fixed_dictionaries(
        {
            "success": st.booleans(),
            "success_final": st.booleans(),
            "num_steps": st.integers(0, 2**62),
            "reward": st.none() | st.floats(),
            "fault": TEXTS,
            "sanitized_first": st.none() | st.integers(0, 10),
            "wall_s": st.floats(0, 1e9),
            "extras": st.dictionaries(TEXTS, PLAIN, max_size=3),
            "stand_ins": st.lists(TEXTS, max_size=2).map(tuple),
        }
    )
)
def test_every_store_gives_back_the_same_row_byte_for_byte(
    tmp_path_factory: pytest.TempPathFactory, values: dict[str, Any]
) -> None:
    written, rows = record(**values), []
    for kind in STORE_CHOICES:
        store = create(tmp_path_factory.mktemp("results") / "run", kind)
        store.append([written])
        store.close()
        (found,) = ResultStore.open(store.folder).records().values()
        rows.append(json.dumps(found.verdict))
    assert len(set(rows)) == 1


def test_the_database_has_a_typed_column_for_every_field(tmp_path: Path) -> None:
    store = create(tmp_path / "run", "sqlite")
    store.append([record(extras={"a": [1, 2]}, wall_s=2)])
    with closing(sqlite3.connect(store.folder / "episodes.sqlite")) as database:
        columns = {name: kind for _, name, kind, *_ in database.execute("PRAGMA table_info(episodes)")}
        assert columns.keys() == {field.name for field in dataclasses.fields(Record)}
        assert (columns["task"], columns["success"], columns["wall_s"]) == ("INTEGER", "BOOLEAN", "REAL")
        query = "SELECT task, success, json_extract(extras, '$.a[1]'), typeof(wall_s) FROM episodes"
        assert database.execute(query).fetchall() == [(0, 1, 2, "real")]


def test_a_verdict_is_never_replaced_by_an_error(either: ResultStore) -> None:
    either.append([record()])
    either.append([record(error="boom", success=False), record(0, 1, error="first")])
    either.append([record(0, 1, error="second")])
    found = {key.episode: found.error for key, found in either.records().items()}
    assert found == {0: "", 1: "second"}
    either.append([record(num_steps=9)])
    assert either.records()[Episode("s", 0, 0)].num_steps == 9


def test_readers_come_while_a_run_writes(either: ResultStore) -> None:
    reader = ResultStore(either.folder)
    for count in range(1, 6):
        either.append([record(0, count)])
        assert len(reader.records()) == len(ResultStore.open(either.folder).records()) == count
        assert len(run_python(f"print(len(ResultStore.open(Path({str(either.folder)!r})).records()))")) == 2


def run_python(code: str) -> str:
    """What a new process prints."""
    start = "from pathlib import Path\nfrom vecenv_eval.store import *\n"
    return subprocess.run([sys.executable, "-c", start + code], capture_output=True, text=True, check=True).stdout


def test_a_killed_writer_loses_nothing_that_it_appended(tmp_path: Path) -> None:
    for kind in STORE_CHOICES:
        folder = tmp_path / kind
        create(folder, kind).close()
        code = f"""
import os, signal
store = ResultStore.open(Path({str(folder)!r}))
for episode in range(3):
    store.append([Record(suite="s", task=0, episode=episode, instruction="", success=True, num_steps=1, reward=1.0)])
os.kill(os.getpid(), signal.SIGKILL)
"""
        with pytest.raises(subprocess.CalledProcessError):
            run_python(code)
        store = ResultStore.open(folder)
        assert len(store.records()) == 3
        store.append([record(0, 9)])
        assert len(ResultStore.open(folder).records()) == 4


def test_a_closed_database_is_one_file_that_reading_leaves_alone(tmp_path: Path) -> None:
    store = create(tmp_path / "run", "sqlite")
    store.append([record()])
    store.close()
    assert len(ResultStore.open(store.folder).records()) == 1
    assert {path.name for path in store.folder.iterdir()} == {".lock", "config.json", "episodes.sqlite"}
    store.append([record(0, 1)])  # it opens again
    assert len(store.records()) == 2


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda path: path.write_bytes(b"not a database" * 100), "cannot be read: file is not a database"),
        (lambda path: path.write_bytes(path.read_bytes()[:5000]), "episodes.sqlite (cannot be read|is damaged): "),
        (lambda path: execute(path, "PRAGMA user_version = 7"), "has version 7 of the table of episodes; this .* 1"),
        (lambda path: execute(path, "DROP TABLE episodes"), "is a database without a table of episodes"),
        (lambda path: execute(path, "UPDATE episodes SET extras = '{'"), "the row of s/0/0 is not an episode"),
    ],
)
def test_a_damaged_database_is_named(tmp_path: Path, damage: Callable[[Path], object], says: str) -> None:
    store = create(tmp_path / "run", "sqlite")
    store.append(record(0, episode, instruction="x" * 500) for episode in range(20))
    store.close()
    damage(store.folder / "episodes.sqlite")
    with pytest.raises(StoreError, match=says):
        ResultStore.open(store.folder)


def execute(path: Path, statement: str) -> None:
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(statement)


def test_a_database_that_was_not_begun_is_empty(tmp_path: Path) -> None:
    store = create(tmp_path / "run", "sqlite")
    store.close()
    (store.folder / "episodes.sqlite").write_bytes(b"")  # as a kill before the first transaction leaves it
    assert ResultStore.open(store.folder).records() == {}
    store.append([record()])
    assert len(store.records()) == 1


def test_the_kind_of_store_is_found_from_the_file(tmp_path: Path) -> None:
    for kind in STORE_CHOICES:
        create(tmp_path / kind, kind)
        (tmp_path / kind / "config.json").write_text("{}")
        assert ResultStore.open(tmp_path / kind).rows.describe().startswith(kind)
    (tmp_path / "jsonl" / "episodes.sqlite").touch()
    with pytest.raises(StoreError, match=r"holds episodes\.jsonl and episodes\.sqlite"):
        ResultStore.open(tmp_path / "jsonl")
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "config.json").write_text('{"config": {"store": "papyrus"}}')
    with pytest.raises(StoreError, match="'papyrus' is not known; there are jsonl, sqlite"):
        ResultStore.open(tmp_path / "new")


MOUNTS = """\
/dev/sda / ext4 rw 0 0
server:/home /home nfs4 rw 0 0
tmpfs /home/local\\040disk tmpfs rw 0 0
//box/share /smb cifs rw 0 0
lustre /scratch lustre rw 0 0
sshfs /fuse fuse.sshfs rw 0 0
host /9p 9p rw 0 0
gpfs /gpfs gpfs rw 0 0
beegfs /bee beegfs rw 0 0
thing /odd tomorrowfs rw 0 0
broken
"""


@pytest.mark.parametrize(
    ("path", "kind", "local"),
    [
        ("/var/results", "ext4", True),
        ("/home", "nfs4", False),
        ("/home/me/results/run", "nfs4", False),
        ("/homes", "ext4", True),
        ("/home/local disk/run", "tmpfs", True),
        ("/smb/x", "cifs", False),
        ("/scratch/x", "lustre", False),
        ("/fuse/x", "fuse.sshfs", False),
        ("/9p/x", "9p", False),
        ("/gpfs/x", "gpfs", False),
        ("/bee/x", "beegfs", False),
        ("/odd/x", "tomorrowfs", False),
    ],
)
def test_file_systems_that_may_be_shared_are_told_from_local_ones(
    tmp_path: Path, path: str, kind: str, local: bool
) -> None:
    (tmp_path / "mounts").write_text(MOUNTS)
    assert file_system(Path(path), tmp_path / "mounts") == kind
    assert is_local(kind) == local


def test_a_later_mount_hides_an_earlier_one_and_an_unknown_system_is_not_local(tmp_path: Path) -> None:
    (tmp_path / "mounts").write_text("a /x ext4 rw 0 0\nb /x nfs rw 0 0\n")
    assert file_system(Path("/x/y"), tmp_path / "mounts") == "nfs"
    assert not is_local(file_system(Path("/x"), tmp_path / "none"))


def test_the_write_ahead_log_is_on_where_it_works_and_off_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind, mode in (("ext4", "wal"), ("nfs4", "delete")):
        monkeypatch.setattr(sqlite, "file_system", lambda folder, kind=kind: kind)
        store = create(tmp_path / kind, "sqlite")
        store.append([record()])
        with closing(sqlite3.connect(store.rows.path)) as database:
            assert database.execute("PRAGMA journal_mode").fetchall() == [(mode,)]
        assert (store.folder / "episodes.sqlite-wal").exists() == (mode == "wal")
        assert ("nfs4" in store.rows.describe()) == ("nfs4" in store.rows.notice()) == (mode == "delete")
        store.close()
    # A folder that is moved to such a file system no longer has the log.
    moved = ResultStore.open(tmp_path / "ext4")
    moved.append([record(0, 1)])
    with closing(sqlite3.connect(moved.rows.path)) as database:
        assert database.execute("PRAGMA journal_mode").fetchall() == [("delete",)]


def test_a_reader_keeps_neither_the_log_nor_the_run_from_going_on(tmp_path: Path) -> None:
    store = create(tmp_path / "run", "sqlite")
    store.append([record()])
    store.close()
    with closing(sqlite3.connect(store.rows.path, check_same_thread=False)) as reader:
        rows = reader.execute("SELECT * FROM episodes")  # a lock until all rows are fetched
        threading.Timer(0.3, rows.fetchall).start()
        store.append([record(0, 1)])
        again = reader.execute("SELECT * FROM episodes")
        store.append([record(0, 2)])
        store.close()
        assert len(again.fetchall()) == 2
    assert len(ResultStore.open(store.folder).records()) == 3


def test_one_process_writes_at_a_time(store: ResultStore) -> None:
    code = f"with ResultStore.open(Path({str(store.folder)!r})).writing(): print('written')"
    with store.writing(), pytest.raises(subprocess.CalledProcessError) as raised:
        run_python(code)
    assert f"is in use: process {os.getpid()} on" in raised.value.stderr
    assert run_python(code) == "written\n"


def test_an_interrupted_beginning_is_begun_again(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.json.tmp").write_text("{")
    (folder / ".lock").touch()
    assert ResultStore.create(folder, {}).records() == {}


def test_each_record_is_on_the_disk_before_the_next(store: ResultStore) -> None:
    for count in range(1, 4):
        store.append([record(0, count)])
        assert len((store.folder / "episodes.jsonl").read_text().splitlines()) == count


def test_the_latest_record_of_an_episode_counts(either: ResultStore) -> None:
    either.append([record(error="boom", success=False)])
    either.append([record()])
    assert either.records() == {Episode("s", 0, 0): record()}


def test_an_episode_that_ended_in_an_error_is_not_done(either: ResultStore) -> None:
    either.append([record(0, 0, error="boom"), record(0, 1, fault="it flew away")])
    assert either.done() == {Episode("s", 0, 1)}


def test_a_reward_that_is_not_finite_is_written_as_null(store: ResultStore) -> None:
    store.append([record(reward=float("nan"))])
    assert json.loads((store.folder / "episodes.jsonl").read_text())["reward"] is None
    assert store.records()[Episode("s", 0, 0)].reward is None


@given(cut=st.integers(2, 60))
def test_a_cut_off_last_line_costs_that_episode_only(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    store = ResultStore.create(tmp_path_factory.mktemp("results") / "run", {})
    store.append([record(0, 0), record(0, 1)])
    path = store.folder / "episodes.jsonl"
    path.write_bytes(path.read_bytes()[:-cut])
    assert list(store.records()) == [Episode("s", 0, 0)]
    reopened = ResultStore.open(store.folder)
    reopened.append([record(0, 2)])
    assert list(reopened.records()) == [Episode("s", 0, 0), Episode("s", 0, 2)]


def test_a_row_of_which_only_the_newline_was_cut_off_is_kept(store: ResultStore) -> None:
    store.append([record(0, 0), record(0, 1)])
    path = store.folder / "episodes.jsonl"
    path.write_bytes(path.read_bytes()[:-1])
    assert len(store.records()) == 2
    reopened = ResultStore.open(store.folder)
    reopened.append([record(0, 2)])
    assert len(reopened.records()) == 3


def test_a_damaged_line_further_up_is_named(store: ResultStore) -> None:
    store.append([record(0, 0), record(0, 1), record(0, 2)])
    path = store.folder / "episodes.jsonl"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], lines[1][:20], lines[2], ""]))
    with pytest.raises(StoreError, match=r"episodes\.jsonl:2 is not an episode"):
        ResultStore.open(store.folder)


@pytest.mark.parametrize("line", ["3", "null", '{"suite": "s"}', "[]"])
def test_json_that_is_no_episode_is_refused(store: ResultStore, line: str) -> None:
    (store.folder / "episodes.jsonl").write_text(line + "\n")
    with pytest.raises(StoreError, match="is not an episode"):
        store.records()


def test_fields_of_a_later_version_are_passed_over(store: ResultStore) -> None:
    store.append([record()])
    path = store.folder / "episodes.jsonl"
    path.write_text(json.dumps({**json.loads(path.read_text()), "of_tomorrow": 1}) + "\n")
    assert list(store.records().values()) == [record()]


def test_a_folder_with_something_in_it_is_not_taken(store: ResultStore, tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="already there and not empty"):
        ResultStore.create(store.folder, {})
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match="already there"):
        ResultStore.create(tmp_path / "file", {})
    ResultStore.create(tmp_path / "new" / "folder", {})


def test_only_a_results_folder_can_be_opened(tmp_path: Path, store: ResultStore) -> None:
    with pytest.raises(StoreError, match=r"is not a results folder: it has no config\.json"):
        ResultStore.open(tmp_path)
    (store.folder / "config.json").write_text("{")
    with pytest.raises(StoreError, match=r"config\.json cannot be read"):
        ResultStore.open(store.folder)


def test_default_folders_are_named_after_time_suite_and_policy_and_never_collide(tmp_path: Path) -> None:
    now = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
    folder = default_folder(tmp_path, "simpler/bridge", "my.module:Policy", now)
    assert folder == tmp_path / "20260304T050607Z_simpler-bridge_my.module-Policy"
    folder.mkdir()
    assert default_folder(tmp_path, "simpler/bridge", "my.module:Policy", now).name.endswith("Policy-2")


def test_an_empty_folder_can_be_discarded(either: ResultStore) -> None:
    with either.writing():
        either.discard()
    assert not either.folder.exists()


def test_only_an_empty_folder_can_be_discarded(store: ResultStore) -> None:
    (store.folder / "notes.txt").touch()
    store.discard()
    assert store.folder.exists()
    (store.folder / "notes.txt").unlink()
    store.append([record()])
    store.discard()
    assert len(store.records()) == 1
    (store.folder / "episodes.jsonl").write_text("")
    store.discard()
    assert not store.folder.exists()


def test_what_a_policy_reports_is_kept_with_the_episode(store: ResultStore) -> None:
    said = {"subtasks": 3, "cost": float("inf"), "cause": "dropped it", "each": [1.0, float("nan")]}
    store.append([record(extras=said)])
    assert store.records()[Episode("s", 0, 0)].extras == {**said, "cost": None, "each": [1.0, None]}
    older = (store.folder / "episodes.jsonl").read_text().replace('"extras"', '"unknown"')
    (store.folder / "episodes.jsonl").write_text(older)
    assert store.records()[Episode("s", 0, 0)].extras == {}


def test_a_reader_that_takes_long_costs_no_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sqlite, "file_system", lambda folder: "nfs4")  # without the log, readers and writer exclude
    monkeypatch.setattr(sqlite, "_WRITER_S", 0.05)
    store = create(tmp_path / "run", "sqlite")
    store.append([record()])
    with closing(sqlite3.connect(store.rows.path, check_same_thread=False)) as reader:
        rows = reader.execute("SELECT * FROM episodes")
        timer = threading.Timer(0.5, rows.fetchall)
        timer.start()
        store.append([record(0, 1)])
        timer.join()
    assert "another process holds the database; waiting to write" in caplog.text
    assert len(store.records()) == 2


def test_whatever_a_policy_reports_can_be_read_again(either: ResultStore) -> None:
    deep: list[Any] = []
    for _ in range(500):
        deep = [deep]
    said = {
        "array": np.arange(3),
        "number": np.float32(0.5),
        "large": 10**5000,
        "path": "a\udc80b",
        7: {1, 2},
        "deep": deep,
    }
    either.append([record(extras=said, fault="\ud800", wall_s=np.float64(2.0))])
    (found,) = ResultStore.open(either.folder).records().values()
    assert (found.extras["array"], found.extras["number"]) == ([0, 1, 2], 0.5)
    assert (found.extras["path"], found.extras["7"], found.fault) == ("a\\udc80b", "{1, 2}", "\\ud800")
    json.dumps(found.verdict, allow_nan=False).encode()
