"""Every kind of file that is read, damaged in many ways: either data of the right form, or one error that names a file.

A few hundred mutations each; thousands with ``-m heavy``.
"""

from __future__ import annotations

import json
import resource
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import mutations
from support.demo_files import some_rollout, write
from support.filmed import FilmedEnv
from support.filmed import record as filmed_record
from support.results_folders import some_records, write_results
from vecenv_eval.campaign import read_campaign, write_campaign
from vecenv_eval.config import EvalConfig
from vecenv_eval.demos import reader
from vecenv_eval.demos.files import read_files
from vecenv_eval.demos.hdf5 import DemoError
from vecenv_eval.export import read_rows
from vecenv_eval.merge.sources import read_source
from vecenv_eval.report import run_tables
from vecenv_eval.report.compare import compare
from vecenv_eval.report.run import read_run
from vecenv_eval.results import resume
from vecenv_eval.store import Record, ResultStore, StoreError, sqlite
from vecenv_eval.watch import watching

from vecenv.errors import VecenvError
from vecenv.libero.tasks.suites import task as task_spec

# Seconds for one damaged file, on a machine that does other things too; and bytes by which this process may grow.
MOST_S, MOST_BYTES = 20.0, 1 << 30
SPEC = task_spec("libero_goal", 3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with rows in a text file."""
    folder = tmp_path_factory.mktemp("fuzz") / "jsonl"
    records = some_records(
        lambda task, episode: episode % 2 == 0, extras={"cause": "x", "tokens": 3}, parts={"is": True}
    )
    return write_results(folder, records)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory, folder: Path) -> Path:
    """The same in a database."""
    made = tmp_path_factory.mktemp("fuzz") / "sqlite"
    content = json.loads((folder / "config.json").read_text())
    content["config"]["store"] = "sqlite"
    store = ResultStore.create(made, content)
    store.append(ResultStore(folder).records().values())
    store.close()
    return made


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of two demonstrations."""
    path = tmp_path_factory.mktemp("fuzz") / "some.hdf5"
    return write(path, SPEC, [some_rollout(SPEC), some_rollout(SPEC, ticks=6, success=False)])


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LeRobot dataset of two episodes, and a third one that waits."""
    lerobot = pytest.importorskip("vecenv_eval.datasets.lerobot")
    root = tmp_path_factory.mktemp("fuzz") / "set"
    env: Any = FilmedEnv()
    done: list[Any] = []
    writer = lerobot.LeRobotWriter(root, verdicts=lambda: done)
    for number in range(3):
        outcome = filmed_record(number)
        with watching(env, [writer]):
            env.tick(1)
            env.tick(1)
        writer.finish(env, {1: outcome})
        if number < 2:
            done.append(outcome.key)
    writer.close()
    return root


def read_everything(folder: Path) -> None:
    """Whatever reads a results folder."""
    run = read_run(folder)
    for text in (run_tables.markdown([run], compare(run, run)), run_tables.latex([run]), run_tables.to_csv([run])):
        assert text.encode()
    for row in read_rows(folder):
        json.dumps(row, allow_nan=False).encode()
    source = read_source(folder)
    assert all(isinstance(record, Record) for record in source.records.values())
    resume(folder, policy="my:Policy", policy_args={"path": "x"})


def outcome(read: Callable[[], object], number: object) -> str | None:
    """What reading says is wrong, None if it gives data; anything but an error of ours fails the test."""
    try:
        read()
    except VecenvError as error:
        said = str(error)
    except BaseException as error:
        raise AssertionError(f"mutation {number} raises {type(error).__name__}: {error!s:.500}") from error
    else:
        return None
    assert said.strip(), number
    assert len(said) < 2000, (number, said[:1000])
    return said


def survives(place: Path, damaged: Iterator[bytes], read: Callable[[], object]) -> tuple[int, int]:
    """Put each damaged content in a file's place and read it; gives how often that was data, and an error."""
    usual, good, refused = place.read_bytes(), 0, 0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    try:
        for number, content in enumerate(damaged):
            place.write_bytes(content)
            began, said = time.monotonic(), outcome(read, number)
            good, refused = good + (said is None), refused + (said is not None)
            assert time.monotonic() - began < MOST_S, number
    finally:
        place.write_bytes(usual)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before < MOST_BYTES
    read()
    return good, refused


@pytest.fixture(params=[pytest.param(1, id="some"), pytest.param(12, id="many", marks=pytest.mark.heavy)])
def times(request: pytest.FixtureRequest) -> int:
    """How many times as many mutations."""
    return request.param


@pytest.mark.parametrize("name", ["config.json", "episodes.jsonl", "summary.json"])
def test_text_files_of_a_results_folder(folder: Path, tmp_path: Path, name: str, times: int) -> None:
    shutil.copytree(folder, tmp_path / "run")
    place = tmp_path / "run" / name
    damaged = mutations.mutations(place.read_bytes(), mutations.JSON, 250 * times)
    good, refused = survives(place, damaged, lambda: read_everything(tmp_path / "run"))
    assert good > 0
    assert refused > 0 or name == "summary.json"  # which costs a warning


def test_databases(database: Path, tmp_path: Path, times: int) -> None:
    shutil.copytree(database, tmp_path / "run")
    place = tmp_path / "run" / "episodes.sqlite"

    def read() -> None:
        ResultStore.open(tmp_path / "run")
        read_everything(tmp_path / "run")

    damaged = mutations.mutations(place.read_bytes(), mutations.BYTES, 200 * times)
    assert min(survives(place, damaged, read)) > 0


VALUES = ["NULL", "'x'", "-1", "x'00ff'", "9e999", "1.5", "zeroblob(1000)", "'" + "[" * 5000 + "'", "char(55296)"]


@pytest.mark.parametrize("value", VALUES)
def test_values_of_other_types_in_a_database(database: Path, tmp_path: Path, value: str) -> None:
    for column in sqlite_columns(database):
        shutil.copytree(database, tmp_path / "run")
        path = tmp_path / "run" / "episodes.sqlite"
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.execute("PRAGMA ignore_check_constraints = ON")
            with suppress(sqlite3.IntegrityError):  # NOT NULL
                connection.execute(f"UPDATE episodes SET {column} = {value} WHERE task = 1 AND episode = 1")
        said = outcome(lambda: read_everything(tmp_path / "run"), column)
        assert said is None or "episodes.sqlite" in said
        shutil.rmtree(tmp_path / "run")


def sqlite_columns(database: Path) -> list[str]:
    with closing(sqlite3.connect(database / "episodes.sqlite")) as connection:
        return [name for _, name, *_ in connection.execute("PRAGMA table_info(episodes)")]


@pytest.mark.parametrize("column", ["instruction", "num_steps"])
def test_a_database_that_computes_without_end_is_given_up(
    database: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, column: str
) -> None:
    monkeypatch.setattr(sqlite, "_READING_S", 1.0)
    shutil.copytree(database, tmp_path / "run")
    names = sqlite_columns(database)
    # A table that computes its columns when they are read, from ever larger values.
    costly = " || ".join(["hex(zeroblob(50000000))"] * 4)
    made = ", ".join(f"{name} AS ({costly})" if name == column else name for name in names)
    with closing(sqlite3.connect(tmp_path / "run" / "episodes.sqlite")) as connection, connection:
        kept = ", ".join(name for name in names if name != column)
        connection.execute("ALTER TABLE episodes RENAME TO old")
        connection.execute(f"CREATE TABLE episodes ({made})")
        connection.execute(f"INSERT INTO episodes ({kept}) SELECT {kept} FROM old")
        connection.execute("DROP TABLE old")
    with pytest.raises(StoreError, match=r"episodes\.sqlite cannot be read: "):
        read_everything(tmp_path / "run")


def test_campaigns(tmp_path: Path, times: int) -> None:
    config = EvalConfig(suite="libero_goal,libero_10", policy="zero", seeds="0,1", env_args={"a": [1, {"b": 2}]})
    write_campaign(config, tmp_path / "run")
    place = tmp_path / "run" / "campaign.json"
    damaged = mutations.mutations(place.read_bytes(), mutations.JSON, 150 * times)
    assert min(survives(place, damaged, lambda: read_campaign(tmp_path / "run"))) > 0


def test_settings(tmp_path: Path, times: int) -> None:
    path = tmp_path / "settings.yaml"
    EvalConfig(suite="libero_goal", episodes=(0, 1), env_args={"a": [1, {"b": "2024-01-01"}]}).save(path)
    damaged = mutations.mutations(path.read_bytes(), mutations.LINES, 150 * times)

    def read() -> None:
        json.dumps(EvalConfig.load(path).to_dict(), default=str)

    assert min(survives(path, damaged, read)) > 0


@pytest.mark.parametrize(
    "text",
    [
        "suite: x\nenv_args: &a {b: *a}\n",
        "suite: x\nenv_args:\n  a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n"
        + "".join(f"  a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]\n" for i in range(12)),
        "suite: !!python/object/apply:os.system [touch owned]\n",
        "suite: x\nenv_args: {a: " + "9" * 5000 + "}\n",
    ],
    ids=["itself", "laughs", "object", "digits"],
)
def test_settings_that_are_made_to_hurt(tmp_path: Path, text: str) -> None:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(VecenvError, match=r"settings\.yaml cannot be read"):
        EvalConfig.load(path)
    assert list(tmp_path.iterdir()) == [path]


def test_demonstrations(demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, times: int) -> None:
    monkeypatch.setattr(reader, "DEADLINE_S", 10.0)
    place = shutil.copyfile(demos, tmp_path / "some.hdf5")

    def read() -> None:
        found, bad = read_files([place])
        assert all(problem.reason for problem in bad)
        for demo in found:
            assert demo.actions.shape[1] == 7
            assert np.isfinite(demo.actions).all()
            with suppress(DemoError):
                demo.recorded_state(1)
        if not found:
            raise DemoError(str(bad[0]))

    damaged = mutations.mutations(place.read_bytes(), mutations.BYTES, 300 * times)
    assert min(survives(place, damaged, read)) > 0


@pytest.mark.parametrize(
    "pattern",
    [
        *("meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes/*/*.parquet"),
        *("data/*/*.parquet", ".pending/*/about.json", ".pending/*/frames.parquet"),
    ],
)
def test_lerobot_data(dataset: Path, tmp_path: Path, pattern: str, times: int) -> None:
    from vecenv_eval.datasets.join import copy_episodes
    from vecenv_eval.datasets.lerobot import LeRobotWriter

    source = tmp_path / "set"
    shutil.copytree(dataset, source)
    (place,) = source.glob(pattern)
    keys = [filmed_record(number).key for number in range(3)]
    target = tmp_path / "target"

    def read() -> None:
        try:
            assert copy_episodes(source, target, keys) <= 3
        finally:
            shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target)
        try:
            LeRobotWriter(target).close()
        finally:
            shutil.rmtree(target)

    kinds: Any = mutations.JSON if pattern.endswith("json") else mutations.BYTES
    good, refused = survives(place, mutations.mutations(place.read_bytes(), kinds, 40 * times), read)
    assert good + refused == 40 * times
    assert refused > 0
