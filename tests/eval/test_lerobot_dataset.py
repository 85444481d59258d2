"""LeRobot datasets: what is in them, how they are continued, and whether LeRobot itself reads them."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.filmed import SIZE, FilmedEnv, record
from vecenv_eval.datasets.statistics import ImageCounts, of_values, together
from vecenv_eval.watch import watching

from vecenv.observations import ImagesUnavailable

pq = pytest.importorskip("pyarrow.parquet")
av = pytest.importorskip("av")
lerobot = pytest.importorskip("vecenv_eval.datasets.lerobot")
KEYS = ("observation.images.image", "observation.images.image2")


def run(root: Path, *episodes: tuple[int, Any], env: Any = None) -> Path:
    """A dataset of episodes, each a number of ticks and its record; all in slot 1, while slot 0 never ends."""
    env, writer = env or FilmedEnv(), lerobot.LeRobotWriter(root)
    for ticks, outcome in episodes:
        with watching(env, [writer]):
            for _ in range(ticks):
                env.tick(0, 1)
        writer.finish(env, {1: outcome})
    writer.close()
    return root


def rows(root: Path, pattern: str) -> list[dict[str, Any]]:
    return [row for path in sorted(root.glob(pattern)) for row in pq.read_table(path).to_pylist()]


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    stove = record(5, False, instruction="turn on the stove")
    return run(tmp_path / "set", (3, record(4)), (2, stove), (4, record(6)))


def test_frames_are_in_the_order_in_which_episodes_ended(dataset: Path) -> None:
    frames = rows(dataset, "data/*/*.parquet")
    assert [row["index"] for row in frames] == list(range(9))
    assert [row["episode_index"] for row in frames] == [0, 0, 0, 1, 1, 2, 2, 2, 2]
    assert [row["frame_index"] for row in frames] == [0, 1, 2, 0, 1, 0, 1, 2, 3]
    assert [row["task_index"] for row in frames] == [0, 0, 0, 1, 1, 0, 0, 0, 0]
    assert [row["next.done"] for row in frames] == [False, False, True, False, True, False, False, False, True]
    assert [row["next.success"] for row in frames] == [False, False, True, False, False, False, False, False, True]
    np.testing.assert_allclose([row["timestamp"] for row in frames[:3]], [0, 0.05, 0.1], atol=1e-7)
    for tick, row in enumerate(frames):
        np.testing.assert_allclose(row["observation.state"], [10 * tick] * 8)
        np.testing.assert_allclose(row["action"], [10 * tick / 255] * 7, atol=1e-7)


def test_episodes_say_where_they_are_and_how_they_went(dataset: Path) -> None:
    episodes = rows(dataset, "meta/episodes/*/*.parquet")
    assert [(row["length"], row["dataset_from_index"], row["dataset_to_index"]) for row in episodes] == [
        (3, 0, 3),
        (2, 3, 5),
        (4, 5, 9),
    ]
    assert [(row["success"], row["source_episode"], row["task_id"]) for row in episodes] == [
        (True, 4, 1),
        (False, 5, 1),
        (True, 6, 1),
    ]
    assert [row["tasks"] for row in episodes] == [["open the drawer"], ["turn on the stove"], ["open the drawer"]]
    assert rows(dataset, "meta/tasks.parquet") == [
        {"task_index": 0, "task": "open the drawer"},
        {"task_index": 1, "task": "turn on the stove"},
    ]
    assert episodes[1][f"videos/{KEYS[0]}/to_timestamp"] == pytest.approx(0.1)


def test_every_frame_has_its_images(dataset: Path) -> None:
    for number, shades in enumerate(([0, 10, 20], [30, 40], [50, 60, 70, 80])):
        for key, sign in zip(KEYS, (0, 255), strict=True):
            with av.open(str(dataset / f"videos/{key}/chunk-000/file-{number:03d}.mp4")) as video:
                frames = list(video.decode(video=0))
            found = [frame.to_ndarray(format="rgb24").mean() for frame in frames]
            np.testing.assert_allclose(found, np.abs(sign - np.array(shades)), atol=3)
            np.testing.assert_allclose([frame.time for frame in frames], np.arange(len(shades)) / 20, atol=1e-6)


def test_info_describes_the_features(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 20, "panda")
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 9, 2)
    assert info["splits"] == {"train": "0:3"}
    shapes = {name: feature["shape"] for name, feature in info["features"].items()}
    assert shapes["observation.state"] == [8]
    assert shapes["action"] == [7]
    assert shapes[KEYS[0]] == shapes[KEYS[1]] == [SIZE, SIZE, 3]
    assert set(shapes) - set(KEYS) == set(rows(dataset, "data/*/*.parquet")[0])


def test_statistics_are_of_all_frames(dataset: Path) -> None:
    stats = json.loads((dataset / "meta/stats.json").read_text())
    state = stats["observation.state"]
    assert (state["min"][0], state["max"][0], state["mean"][0], state["count"]) == (0, 80, pytest.approx(40), [9])
    assert state["std"][0] == pytest.approx(np.std(10 * np.arange(9)))
    # One image in four is counted: the first of each episode.
    np.testing.assert_allclose(np.ravel(stats[KEYS[0]]["mean"]), [80 / 3 / 255] * 3)
    assert np.shape(stats[KEYS[0]]["mean"]) == (3, 1, 1)


def test_a_dataset_is_continued(dataset: Path, tmp_path: Path) -> None:
    run(dataset, (2, record(9, instruction="close the drawer")))
    assert [row["episode_index"] for row in rows(dataset, "meta/episodes/*/*.parquet")] == [0, 1, 2, 3]
    assert [row["index"] for row in rows(dataset, "data/*/*.parquet")] == list(range(11))
    assert json.loads((dataset / "meta/info.json").read_text())["total_episodes"] == 4
    assert rows(dataset, "meta/tasks.parquet")[-1] == {"task_index": 2, "task": "close the drawer"}
    assert json.loads((dataset / "meta/stats.json").read_text())["action"]["count"] == [11]
    assert not (dataset / ".partial").exists()


def test_many_episodes_are_written_as_they_come(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot, "FLUSH", 2)
    run(tmp_path / "set", *[(1, record(number)) for number in range(5)])
    assert len(list((tmp_path / "set").glob("data/*/*.parquet"))) == 3
    places = [
        (row["data/file_index"], row["meta/episodes/file_index"]) for row in rows(tmp_path / "set", "meta/episodes/*/*")
    ]
    assert places == [(0, 0), (0, 0), (1, 1), (1, 1), (2, 2)]


def test_what_ended_in_a_fault_or_an_error_is_left_out(tmp_path: Path) -> None:
    root = run(
        tmp_path / "set",
        (2, record(0, False, fault="non-finite state")),
        (2, record(1, False, error="ValueError: boom")),
        (2, record(2)),
    )
    assert [row["source_episode"] for row in rows(root, "meta/episodes/*/*")] == [2]
    assert len(list(root.rglob("*.mp4"))) == 2


def test_nothing_is_left_of_a_run_without_an_episode(tmp_path: Path) -> None:
    lerobot.LeRobotWriter(tmp_path / "set").close()
    assert not (tmp_path / "set").exists()


def test_simplers_robots_have_their_own_state_and_no_wrist(tmp_path: Path) -> None:
    env = FilmedEnv(cameras={"agentview": 30}, control_hz=5, state=23)
    root = run(tmp_path / "set", (2, record(0, suite="simpler/bridge")), env=env)
    info = json.loads((root / "meta/info.json").read_text())
    assert (info["fps"], info["robot_type"]) == (5, "widowx")
    assert info["features"]["observation.state"]["shape"] == [23]
    assert KEYS[1] not in info["features"]


def test_what_does_not_fit_is_refused(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(lerobot.DatasetError, match=r"5\.0 control ticks a second, where 20"):
        run(dataset, (1, record(0)), env=FilmedEnv(control_hz=5.0))
    with pytest.raises(lerobot.DatasetError, match=r"observation.state of libero_goal/1/0 is \[9\]"):
        run(dataset, (1, record(0)), env=FilmedEnv(state=9))
    with pytest.raises(ImagesUnavailable, match="renders nothing"):
        run(tmp_path / "other", (1, record(0)), env=FilmedEnv(cameras={}))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    with pytest.raises(lerobot.DatasetError, match="something other than a LeRobot dataset"):
        lerobot.LeRobotWriter(tmp_path / "mine")
    (dataset / "meta/info.json").write_text('{"codebase_version": "v2.1"}')
    with pytest.raises(lerobot.DatasetError, match=r"format v2\.1"):
        lerobot.LeRobotWriter(dataset)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.lists(st.floats(-100, 100), min_size=1, max_size=20), min_size=1, max_size=5))
def test_statistics_of_parts_are_those_of_the_whole(parts: Sequence[Sequence[float]]) -> None:
    found = together([of_values(np.array(part)) for part in parts])
    whole = np.concatenate(parts)
    for name, value in (("min", whole.min()), ("max", whole.max()), ("mean", whole.mean()), ("std", whole.std())):
        np.testing.assert_allclose(found[name], [value], atol=1e-9)
    assert found["count"] == [len(whole)]
    quantiles = [[np.quantile(part, level) for part in parts] for level in (0.01, 0.99)]
    np.testing.assert_allclose([found["q01"][0], found["q99"][0]], [min(quantiles[0]), max(quantiles[1])], atol=1e-9)


def test_an_images_statistics_are_those_of_its_pixels() -> None:
    images = np.random.default_rng(0).integers(0, 256, (4, 9, 7, 3), np.uint8)
    counts = ImageCounts()
    for image in images:
        counts.add(image)
    found, pixels = counts.statistics(), images.reshape(-1, 3) / 255
    expected = {"min": pixels.min(0), "max": pixels.max(0), "mean": pixels.mean(0), "std": pixels.std(0)}
    expected |= {"q10": np.quantile(pixels, 0.1, axis=0, method="inverted_cdf")}
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value.reshape(3, 1, 1), atol=1e-9)


READ = """
import json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("vecenv/test", root=sys.argv[1], delta_timestamps={"action": [0.0, 0.05]}, video_backend="pyav")
frames = [data[index] for index in range(len(data))]
print(json.dumps({
    "episodes": data.num_episodes, "fps": data.fps, "tasks": [frame["task"] for frame in frames],
    "state": [frame["observation.state"][0].item() for frame in frames],
    "image": [255 * frame["observation.images.image"].mean().item() for frame in frames],
    "wrist": [255 * frame["observation.images.image2"].mean().item() for frame in frames],
    "shape": list(frames[0]["observation.images.image"].shape), "chunk": list(frames[0]["action"].shape),
    "success": [bool(data.meta.episodes[i]["success"]) for i in range(data.num_episodes)],
    "mean": float(data.meta.stats["observation.state"]["mean"][0]),
}))
"""


@pytest.mark.heavy
def test_lerobot_reads_it(dataset: Path) -> None:
    python = os.environ.get("VECENV_LEROBOT_PYTHON")
    if not python:
        pytest.skip("VECENV_LEROBOT_PYTHON must name the Python of an environment with lerobot >= 0.4")
    run(dataset, (2, record(9)))
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONPATH": ""}
    done = subprocess.run([python, "-c", READ, str(dataset)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    shades = [0, 10, 20, 30, 40, 50, 60, 70, 80, 0, 10]
    assert (found["episodes"], found["fps"], found["shape"], found["chunk"]) == (4, 20, [3, SIZE, SIZE], [2, 7])
    assert found["success"] == [True, False, True, True]
    assert found["tasks"][2:5] == ["open the drawer", "turn on the stove", "turn on the stove"]
    np.testing.assert_allclose(found["state"], shades)
    np.testing.assert_allclose(found["image"], shades, atol=3)
    np.testing.assert_allclose(found["wrist"], 255 - np.array(shades), atol=3)
    assert found["mean"] == pytest.approx(np.mean(shades))
