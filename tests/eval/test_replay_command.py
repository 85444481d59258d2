"""``vecenv replay`` with the settings of an evaluation: which demonstrations, other options, and their images."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
from support.images import needs_gl
from typer.testing import CliRunner, Result
from vecenv_eval.cli.replay import SETTINGS
from vecenv_eval.config import EvalConfig, option_name
from vecenv_eval.results import begin
from vecenv_eval.runner import evaluate

from vecenv.cli import build_app

TICKS = 4


def invoke(*arguments: object) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["replay", *map(str, arguments)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes of each of two tasks, recorded with random actions."""
    folder = tmp_path_factory.mktemp("recorded") / "r"
    settings: dict[str, Any] = {"tasks": "7-8", "episodes": "0,2-3", "max_steps": TICKS, "record": True}
    config = EvalConfig(suite="libero_goal", policy="random", **settings)
    assert evaluate(config, begin(config, folder)).ok
    return folder


def replayed(path: Path) -> list[tuple[int, str]]:
    content = json.loads(path.read_text())
    assert content["ok"], content
    return [(demo["task"], demo["name"]) for demo in content["demos"]]


def test_its_options_are_those_of_an_evaluation() -> None:
    help = invoke("--help").stdout
    by_name = {field.name: option_name(field) for field in dataclasses.fields(EvalConfig)}
    for name, option in by_name.items():
        assert (f"{option} " in help) == (name in SETTINGS), name


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], [(task, f"demo_{episode}") for task in (7, 8) for episode in (0, 2, 3)]),
        (["--tasks", "8"], [(8, "demo_0"), (8, "demo_2"), (8, "demo_3")]),
        (["--tasks", "turn_on_the_stove", "--episodes", "1-2"], [(7, "demo_2")]),
        (["--episodes", "3"], [(7, "demo_0"), (7, "demo_2"), (8, "demo_0"), (8, "demo_2")]),
        (["--config", "s.yaml", "--tasks", "7"], [(7, "demo_0"), (7, "demo_3")]),
        (
            ["--env-arg", "geometry=exact", "--backend", "native", "--num-envs", "2", "--tasks", "7"],
            [(7, "demo_0"), (7, "demo_2"), (7, "demo_3")],
        ),
    ],
)
def test_tasks_and_episodes_choose(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], expected: list[Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text("episodes: 0,3\ntasks: '8'\n")
    done = invoke(folder, *arguments, "--out", "out.json")
    assert done.exit_code == 0, done.output
    assert replayed(tmp_path / "out.json") == expected


@needs_gl
def test_what_is_executed_can_be_filmed_and_kept_for_training(folder: Path, tmp_path: Path) -> None:
    av, pq = pytest.importorskip("av"), pytest.importorskip("pyarrow.parquet")
    words = ["--tasks", "7", "--episodes", "0,3", "--video", "all", "--record-lerobot", "--results", tmp_path / "new"]
    done = invoke(folder, *words, "--image-size", "32", "--lod", "fast", "--cameras", "frontview,wrist")
    assert done.exit_code == 0, done.output
    videos = sorted((tmp_path / "new" / "videos").iterdir())
    assert [path.name for path in videos] == ["libero_goal_7_0.mp4", "libero_goal_7_3.mp4"]
    with av.open(str(videos[0])) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert [frame.shape for frame in frames] == [(32, 64, 3)] * (TICKS + 1)
    (table,) = (tmp_path / "new" / "lerobot").glob("data/*/*.parquet")
    assert pq.read_table(table).num_rows == 2 * TICKS
    info = json.loads((tmp_path / "new" / "lerobot" / "meta" / "info.json").read_text())
    images = {name for name in info["features"] if "images" in name}
    assert images == {"observation.images.frontview", "observation.images.image2"}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--tasks", "0"], "--tasks 0: none of the 6 demonstrations is one of these"),
        (["--tasks", "10"], "there is no task 10: the last one is 9"),
        (["--episodes", "9"], "9 episodes asked for"),
        (["--video", "all"], "--video needs --results, the folder to write into"),
        (["--record-lerobot"], "--record-lerobot needs --results"),
        (["--results", "new"], "--results new: give --video or --record-lerobot"),
        (["--video", "all", "--results", "used"], "--results used: it is already there and not empty"),
        (["--video", "some", "--results", "new"], "video='some': expected one of none, failures, all"),
        (["--video", "all", "--results", "new", "--cameras", "nowhere"], "there is no camera 'nowhere'"),
        (["--image-size", "64"], "--image-size: images are drawn for --video and --record-lerobot only"),
        (["--cameras", "wrist"], "--cameras: images are drawn for"),
        (["--env-arg", "max_steps=3"], "option max_steps=3: a demonstration decides"),
        (["--env-arg", "geom=1"], "no option geom=1; did you mean geometry?"),
        (["--backend", "abacus"], "backend='abacus' is not available; available: native"),
        (["--config", "file.yaml"], "file.yaml: policy is no setting of `vecenv replay`; its own: suite, tasks"),
        (["--config", "words.yaml"], "num_envs: "),
    ],
)
def test_what_does_not_fit_gets_one_line_and_status_2(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "file").touch()
    (tmp_path / "file.yaml").write_text("policy: zero\n")
    (tmp_path / "words.yaml").write_text("num_envs: many\n")
    done = invoke(folder, *arguments)
    assert done.exit_code == 2
    assert done.stderr.startswith("error: ")
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "new").exists()


def test_two_demonstrations_of_an_episode_are_not_written_to_one_place(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "copy.hdf5").write_bytes((folder / "demos" / "libero_goal_7.hdf5").read_bytes())
    done = invoke(folder, tmp_path, "--video", "all", "--results", tmp_path / "new")
    assert done.exit_code == 2
    assert "two demonstrations are of episode libero_goal/7/0" in done.stderr


def test_options_of_an_evaluation_alone_are_refused_by_name(folder: Path) -> None:
    for option in ("--policy", "--protocol", "--seed"):
        done = invoke(folder, option, "1")
        assert done.exit_code == 2
        assert f"No such option: {option}" in done.stderr
