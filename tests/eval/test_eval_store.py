"""The results folder: nothing computed is lost, and nothing damaged is taken for a result."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from vecenv_eval.episodes import Episode
from vecenv_eval.store import Record, ResultStore, StoreError, default_folder


def record(task: int = 0, episode: int = 0, **fields: object) -> Record:
    values = {"instruction": "do it", "success": True, "num_steps": 7, "reward": 1.0, **fields}
    return Record(suite="s", task=task, episode=episode, **values)  # pyright: ignore[reportArgumentType]


@pytest.fixture
def store(tmp_path: Path) -> ResultStore:
    return ResultStore.create(tmp_path / "run", {"runs": []})


def test_records_read_back_as_they_were_written(store: ResultStore) -> None:
    written = [record(0, 0), record(1, 2, success=False, fault="it flew away", wall_s=1.5, batch=3)]
    store.append(written)
    assert list(ResultStore.open(store.folder).records().values()) == written


def test_each_record_is_on_the_disk_before_the_next(store: ResultStore) -> None:
    for count in range(1, 4):
        store.append([record(0, count)])
        assert len((store.folder / "episodes.jsonl").read_text().splitlines()) == count


def test_the_latest_record_of_an_episode_counts(store: ResultStore) -> None:
    store.append([record(error="boom", success=False)])
    store.append([record()])
    assert store.records() == {Episode("s", 0, 0): record()}


def test_an_episode_that_ended_in_an_error_is_not_done(store: ResultStore) -> None:
    store.append([record(0, 0, error="boom"), record(0, 1, fault="it flew away")])
    assert store.done() == {Episode("s", 0, 1)}


def test_a_reward_that_is_not_finite_is_written_as_null(store: ResultStore) -> None:
    store.append([record(reward=float("nan"))])
    assert json.loads((store.folder / "episodes.jsonl").read_text())["reward"] is None
    assert store.records()[Episode("s", 0, 0)].reward is None


@given(cut=st.integers(1, 60))
def test_a_cut_off_last_line_costs_that_episode_only(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    store = ResultStore.create(tmp_path_factory.mktemp("results") / "run", {})
    store.append([record(0, 0), record(0, 1)])
    path = store.folder / "episodes.jsonl"
    path.write_bytes(path.read_bytes()[:-cut])
    assert list(store.records()) == [Episode("s", 0, 0)]
    reopened = ResultStore.open(store.folder)
    reopened.append([record(0, 2)])
    assert list(reopened.records()) == [Episode("s", 0, 0), Episode("s", 0, 2)]


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
    said = {"subtasks": 3, "cost": float("inf"), "cause": "dropped it"}
    store.append([record(extras=said)])
    assert store.records()[Episode("s", 0, 0)].extras == {**said, "cost": None}
    older = (store.folder / "episodes.jsonl").read_text().replace('"extras"', '"unknown"')
    (store.folder / "episodes.jsonl").write_text(older)
    assert store.records()[Episode("s", 0, 0)].extras == {}
