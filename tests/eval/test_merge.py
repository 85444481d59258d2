"""Shards of an evaluation, and results folders merged into the one that a single run would have left."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import filmed
from support.fakes import SUITE, FakeWorld
from vecenv_eval.config import ConfigError, EvalConfig, parse_shard
from vecenv_eval.demos.hdf5 import member, numeric_dataset
from vecenv_eval.episodes import Episode, Suite, shard
from vecenv_eval.merge import merge
from vecenv_eval.results import EvalResult, resume
from vecenv_eval.runner import Evaluation, evaluate
from vecenv_eval.store import Record, ResultStore, StoreError
from vecenv_eval.video.episodes import video_path
from vecenv_eval.watch import watching


def run(folder: Path, world: FakeWorld | None = None, **settings: Any) -> EvalResult:
    config = EvalConfig(**{"suite": SUITE, "policy": "zero", **settings})
    return evaluate(config, folder, simulator=(world or FakeWorld()).simulator)


def shards(folder: Path, parts: int, **settings: Any) -> list[Path]:
    """Every shard of an evaluation, run."""
    folders = [folder / f"{part}-of-{parts}" for part in range(1, parts + 1)]
    for part, each in enumerate(folders, start=1):
        run(each, shard=f"{part}/{parts}", **settings)
    return folders


def join(out: Path, folders: Sequence[Path], **options: Any) -> EvalResult:
    (result,) = merge(out, folders, simulator=FakeWorld().simulator, **options).results
    return result


def verdicts(folder: Path) -> list[str]:
    """Rows without their circumstances, ordered by episode."""
    records = sorted(ResultStore.open(folder).records().values(), key=lambda record: record.key)
    return [json.dumps(record.verdict, sort_keys=True) for record in records]


def content(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "config.json").read_text())


@given(
    scenes=st.lists(st.integers(0, 3), min_size=1, max_size=8),
    counts=st.lists(st.integers(0, 7), min_size=8, max_size=8),
    parts=st.integers(1, 12),
)
def test_shards_are_disjoint_complete_balanced_and_keep_scenes_together(
    scenes: list[int], counts: list[int], parts: int
) -> None:
    suite = Suite("s", ("",) * len(scenes), tuple(scenes), 7)
    tasks = tuple(range(len(scenes)))
    episodes = {task: tuple(range(counts[task])) for task in tasks}
    found = [shard(suite, tasks, episodes, part, parts) for part in range(1, parts + 1)]
    keys = [[(task, episode) for task in part for episode in part[task]] for part in found]
    assert sorted(key for part in keys for key in part) == [(t, e) for t in tasks for e in episodes[t]]
    sizes = [len(part) for part in keys]
    assert max(sizes) - min(sizes) <= 1
    parts_of_scene = Counter(scene for part in keys for scene in {scenes[task] for task, _ in part})
    assert sum(count - 1 for count in parts_of_scene.values()) <= parts - 1


@pytest.mark.parametrize("text", ["0/3", "4/3", "1/0", "1", "a/b", "-1/2", "1/2/3", "", "1.0/2"])
def test_a_shard_that_does_not_exist_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expected i/n with 1 <= i <= n"):
        EvalConfig(suite=SUITE, shard=text)


def test_a_shard_is_read_and_the_whole_is_one() -> None:
    assert (parse_shard("2/5"), parse_shard(None)) == ((2, 5), (1, 1))


@pytest.mark.parametrize("parts", [1, 2, 3, 25])
def test_merged_shards_are_what_one_run_leaves(tmp_path: Path, parts: int) -> None:
    whole = run(tmp_path / "whole")
    merged = join(tmp_path / "merged", shards(tmp_path, parts))
    assert merged.ok
    assert verdicts(tmp_path / "merged") == verdicts(tmp_path / "whole")
    timeless = {"setup_s": 0.0, "wall_s": 0.0, "steps_per_s": 0.0}
    assert replace(merged.summary, **timeless) == replace(whole.summary, **timeless)
    assert sorted(p.name for p in (tmp_path / "merged").iterdir() if p.name[0] != ".") == sorted(
        p.name for p in (tmp_path / "whole").iterdir() if p.name[0] != "."
    )
    config = content(tmp_path / "merged")
    assert (config["config"], config["conditions"]) == (
        content(tmp_path / "whole")["config"],
        content(tmp_path / "whole")["conditions"],
    )


def test_each_record_says_which_of_the_merged_runs_it_is_from(tmp_path: Path) -> None:
    merged = join(tmp_path / "merged", shards(tmp_path, 3))
    runs = content(tmp_path / "merged")["runs"]
    assert [each["shard"] for each in runs] == ["1/3", "2/3", "3/3"]
    assert sorted({record.run for record in merged.records}) == [0, 1, 2]
    for part in (1, 2, 3):
        keys = ResultStore.open(tmp_path / f"{part}-of-3").records().keys()
        assert {record.run for record in merged.records if record.key in keys} == {part - 1}


def test_shards_are_merged_as_they_finish_and_the_rest_is_missing(tmp_path: Path) -> None:
    folders = shards(tmp_path, 3)
    for count, missing in ((1, 14), (2, 7), (3, 0)):
        merged = join(tmp_path / "merged", folders[:count])
        assert merged.summary.total.missing == missing
        assert json.loads((tmp_path / "merged" / "summary.json").read_text())["total"]["missing"] == missing
    assert len(content(tmp_path / "merged")["runs"]) == 3
    before = (tmp_path / "merged" / "episodes.jsonl").read_text()
    join(tmp_path / "merged", folders)
    assert (tmp_path / "merged" / "episodes.jsonl").read_text() == before
    assert len(content(tmp_path / "merged")["runs"]) == 3


def test_a_merged_folder_is_resumed_and_merged_into_again(tmp_path: Path) -> None:
    folders = shards(tmp_path, 3)
    join(tmp_path / "merged", folders[:2])
    config, store = resume(tmp_path / "merged")
    world = FakeWorld()
    assert evaluate(config, store, simulator=world.simulator).ok
    assert sum(env.num_envs for env in world.envs) <= 7  # the third shard's
    assert join(tmp_path / "merged", folders).ok
    assert verdicts(tmp_path / "merged") == verdicts_of_whole(tmp_path)
    assert [each.get("shard") for each in content(tmp_path / "merged")["runs"]] == ["1/3", "2/3", None, "3/3"]


def verdicts_of_whole(tmp_path: Path) -> list[str]:
    run(tmp_path / "whole")
    return verdicts(tmp_path / "whole")


def test_merged_folders_can_be_merged(tmp_path: Path) -> None:
    folders = shards(tmp_path, 4)
    join(tmp_path / "a", folders[:2])
    join(tmp_path / "b", folders[2:])
    merged = join(tmp_path / "all", [tmp_path / "a", tmp_path / "b", folders[0]])
    assert merged.ok
    assert [each["shard"] for each in content(tmp_path / "all")["runs"]] == ["1/4", "2/4", "3/4", "4/4"]


def test_a_verdict_counts_rather_than_an_error(tmp_path: Path) -> None:
    broken = FakeWorld(raise_in={0: ValueError("boom"), 2: ValueError("boom")})
    run(tmp_path / "broken", broken, retries=0)
    run(tmp_path / "part", tasks="all", shard="1/2")
    errors = join(tmp_path / "merged", [tmp_path / "broken"]).summary.total.errors
    assert errors
    merged = join(tmp_path / "merged", [tmp_path / "part"])
    assert merged.summary.total.errors < errors
    # The other way round an error changes nothing.
    assert join(tmp_path / "merged", [tmp_path / "broken"]).summary.total.errors == merged.summary.total.errors
    assert "boom" in next((tmp_path / "merged").glob("errors-*.log")).read_text()


def test_two_different_verdicts_of_one_episode_are_named(tmp_path: Path) -> None:
    run(tmp_path / "a")
    run(tmp_path / "b")
    store = ResultStore.open(tmp_path / "b")
    record = store.records()[Episode(SUITE, 2, 1)]
    store.append([replace(record, success=False, num_steps=4)])
    with pytest.raises(
        StoreError, match=r"episode fake_suite/2/1 has two .*/a and in .*/b: success True and False, num_steps 3 and 4"
    ):
        join(tmp_path / "merged", [tmp_path / "a", tmp_path / "b"])
    assert not (tmp_path / "merged").exists()


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"max_steps": 3}, "max_steps not set and 3"),
        ({"policy": "random"}, "policy 'zero' and 'random'"),
        ({"seed": 4, "tasks": "0-3"}, "tasks 'all' and '0-3', seed not set and 4"),
    ],
)
def test_folders_of_different_evaluations_are_refused(tmp_path: Path, other: dict[str, Any], says: str) -> None:
    run(tmp_path / "a", shard="1/2")
    run(tmp_path / "b", shard="2/2", **other)
    with pytest.raises(StoreError, match=f"/a and .*/b are not from one evaluation: {says}"):
        join(tmp_path / "merged", [tmp_path / "a", tmp_path / "b"])
    assert not (tmp_path / "merged").exists()


def test_what_no_verdict_depends_on_may_differ(tmp_path: Path) -> None:
    run(tmp_path / "a", shard="1/2", num_envs=2, store="sqlite")
    run(tmp_path / "b", shard="2/2", num_threads=1, retries=0)
    assert join(tmp_path / "merged", [tmp_path / "a", tmp_path / "b"]).ok


def edit(folder: Path, **values: Any) -> None:
    (folder / "config.json").write_text(json.dumps(content(folder) | values))


def test_other_conditions_are_named(tmp_path: Path) -> None:
    a, b = shards(tmp_path, 2)
    edit(b, conditions=content(b)["conditions"] | {"contacts": "current"})
    with pytest.raises(StoreError, match="ran under different conditions: contacts '-' and 'current'"):
        join(tmp_path / "merged", [a, b])


def test_other_versions_are_named_and_may_be_allowed(tmp_path: Path) -> None:
    a, b = shards(tmp_path, 2)
    runs = content(b)["runs"]
    runs[0]["versions"] |= {"mujoco": "3.3.0", "ruff": "0.1"}
    edit(b, runs=runs)
    with pytest.raises(StoreError, match=r"mujoco .* in .*1-of-2 and 3.3.0 in .*2-of-2: .*--any-versions"):
        join(tmp_path / "merged", [a, b])
    assert join(tmp_path / "merged", [a, b], any_versions=True).ok


def test_an_episode_that_nobody_planned_is_refused(tmp_path: Path) -> None:
    a, b = shards(tmp_path, 2)
    stray = Record(suite=SUITE, task=3, episode=77, instruction="", success=True, num_steps=1, reward=1.0)
    ResultStore.open(b).append([stray])
    with pytest.raises(StoreError, match="2-of-2 has episode fake_suite/3/77, which is not part"):
        join(tmp_path / "merged", [a, b])


def test_places_that_cannot_be_merged_into_are_refused(tmp_path: Path) -> None:
    a, b = shards(tmp_path, 2)
    with pytest.raises(StoreError, match="into itself"):
        join(a, [a, b])
    with pytest.raises(StoreError, match="is shard 1/2 of an evaluation"):
        join(a, [b])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    with pytest.raises(StoreError, match="already there and not empty"):
        join(tmp_path / "mine", [a, b])
    with pytest.raises(StoreError, match="nowhere is not a results folder"):
        join(tmp_path / "merged", [a, tmp_path / "nowhere"])
    with pytest.raises(StoreError, match="no results folder"):
        join(tmp_path / "merged", [])
    run(tmp_path / "whole", max_steps=4)
    with pytest.raises(StoreError, match="max_steps 4 and not set"):
        join(tmp_path / "whole", [a, b])


def test_a_shard_without_episodes_is_complete(tmp_path: Path) -> None:
    result = run(tmp_path / "a", tasks="0", episodes="2", shard="1/3")
    assert result.ok
    assert result.summary.total.episodes == 0


def test_a_shard_runs_its_own_episodes_only_also_when_resumed(tmp_path: Path) -> None:
    run(tmp_path / "a", shard="2/3")
    own = set(ResultStore.open(tmp_path / "a").records())
    assert len(own) == 7
    config, store = resume(tmp_path / "a")
    assert set(Evaluation(config, FakeWorld().simulator).planned) == own
    assert evaluate(config, store, simulator=FakeWorld().simulator).ok


@pytest.mark.parametrize("stage", ["write_config", "append", "write_summary"])
def test_a_merge_that_was_interrupted_is_completed_by_repeating_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    folders = shards(tmp_path, 2)
    with monkeypatch.context() as patch:
        join(tmp_path / "merged", folders[:1])

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        patch.setattr(ResultStore, stage, interrupt)
        with pytest.raises(KeyboardInterrupt):
            join(tmp_path / "merged", folders)
    assert join(tmp_path / "merged", folders).ok
    assert verdicts(tmp_path / "merged") == verdicts_of_whole(tmp_path)
    assert [each["shard"] for each in content(tmp_path / "merged")["runs"]] == ["1/2", "2/2"]


def test_a_run_may_write_while_it_is_merged(tmp_path: Path) -> None:
    a, b = shards(tmp_path, 2)
    path = b / "episodes.jsonl"
    text = path.read_text()
    path.write_text(text[:-30])  # its last row is being written
    assert join(tmp_path / "merged", [a, b]).summary.total.missing == 1
    assert path.read_text() == text[:-30]


def test_recordings_and_videos_of_merged_rows_are_copied(tmp_path: Path) -> None:
    settings = {"suite": "libero_object", "policy": "random", "tasks": "0-1", "episodes": "3", "max_steps": 4}
    folders = [tmp_path / "a", tmp_path / "b"]
    for part, folder in enumerate(folders, start=1):
        result = evaluate(EvalConfig(**settings, record=True, shard=f"{part}/2"), folder)
        for record in result.records:
            path = video_path(folder, record.key)
            path.parent.mkdir(exist_ok=True)
            path.write_text(record.key.id)
    for count in (1, 2, 2):  # as they finish, and again
        (merged,) = merge(tmp_path / "merged", folders[:count]).results
    assert merged.ok
    for record in merged.records:
        assert video_path(tmp_path / "merged", record.key).read_text() == record.key.id
    for folder in folders:
        for path in (folder / "demos").iterdir():
            with h5py.File(path) as file, h5py.File(tmp_path / "merged" / "demos" / path.name) as copy:
                assert copy["data"].attrs["problem_info"] == file["data"].attrs["problem_info"]
                for name in map(str, member(file, "data", h5py.Group)):
                    assert actions(copy, name).tobytes() == actions(file, name).tobytes()
                    assert copy[f"data/{name}"].attrs["make"] == file[f"data/{name}"].attrs["make"]
    with h5py.File(tmp_path / "merged" / "demos" / "libero_object_0.hdf5") as file:
        assert file["data"].attrs["num_demos"] == 3
        assert file["data"].attrs["total"] == 12


def actions(file: h5py.File, demo: str) -> np.ndarray:
    return np.asarray(numeric_dataset(member(file, f"data/{demo}", h5py.Group), "actions"))


def test_lerobot_datasets_are_joined_as_one_run_would_have_written_them(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    pytest.importorskip("av")
    from vecenv_eval.datasets.join import copy_episodes
    from vecenv_eval.datasets.lerobot import DatasetError

    stove = filmed.record(5, False, instruction="turn on the stove")
    outcomes = [(3, filmed.record(4)), (2, stove), (4, filmed.record(6))]
    film(tmp_path / "whole", outcomes)
    film(tmp_path / "a", outcomes[:1])
    film(tmp_path / "b", outcomes[1:], begun=3)
    every = [outcome.key for _, outcome in outcomes]
    assert copy_episodes(tmp_path / "a", tmp_path / "merged", every) == 1
    assert copy_episodes(tmp_path / "b", tmp_path / "merged", every[:2]) == 1
    assert copy_episodes(tmp_path / "b", tmp_path / "merged", every) == 1
    assert copy_episodes(tmp_path / "b", tmp_path / "merged", every) == 0
    info, stats = "meta/info.json", "meta/stats.json"
    assert json.loads((tmp_path / "merged" / info).read_text()) == json.loads((tmp_path / "whole" / info).read_text())
    for name, ours in json.loads((tmp_path / "merged" / stats).read_text()).items():
        for which, theirs in json.loads((tmp_path / "whole" / stats).read_text())[name].items():
            np.testing.assert_allclose(ours[which], theirs, err_msg=f"{name} {which}")
    assert frames(tmp_path / "merged") == frames(tmp_path / "whole")
    assert len(frames(tmp_path / "merged")) == 9
    for path in sorted((tmp_path / "whole").rglob("*.mp4")):
        copy = tmp_path / "merged" / path.relative_to(tmp_path / "whole")
        assert copy.read_bytes() == path.read_bytes()
    film(tmp_path / "other", [(2, filmed.record(7))], env=filmed.FilmedEnv(state=9))
    with pytest.raises(DatasetError, match=r"observation.state of libero_goal/1/7 is \[9\]"):
        copy_episodes(tmp_path / "other", tmp_path / "merged", [filmed.record(7).key])
    (tmp_path / "b" / "meta/info.json").write_text("{")
    with pytest.raises(DatasetError, match="/b cannot be read"):
        copy_episodes(tmp_path / "b", tmp_path / "merged", every)


def film(root: Path, outcomes: Sequence[tuple[int, Record]], begun: int = 0, env: Any = None) -> None:
    """A dataset of so many ticks of each episode, after so many that were not filmed."""
    from vecenv_eval.datasets.lerobot import LeRobotWriter

    env, writer = env or filmed.FilmedEnv(), LeRobotWriter(root)
    for _ in range(begun):
        env.tick(1)
    for ticks, outcome in outcomes:
        with watching(env, [writer]):
            for _ in range(ticks):
                env.tick(1)
        writer.finish(env, {1: outcome})
    writer.close()


def frames(root: Path) -> list[dict[str, Any]]:
    import pyarrow.parquet as pq

    return [row for path in sorted(root.glob("data/*/*.parquet")) for row in pq.read_table(path).to_pylist()]
