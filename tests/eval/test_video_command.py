"""``vecenv video``: the settings of an evaluation, one mp4 of episodes side by side."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.images import needs_gl
from typer.testing import CliRunner, Result
from vecenv_eval.cli.video import SETTINGS
from vecenv_eval.config import EvalConfig, option_name
from vecenv_eval.video.film import Film

from vecenv.cli import build_app
from vecenv.contract import BatchEnv, ResetInfo

av = pytest.importorskip("av")
Image = pytest.importorskip("PIL.Image")


def invoke(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["video", *arguments])


class Nudging:
    """Moves along x by as much as it is told to."""

    name = "nudging"

    def __init__(self, by: float = 0.0) -> None:
        self.by = by

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        assert {"agentview", "wrist"} <= set(env.observe_egocentric().images)  # whatever the video shows

    def act(self, env: BatchEnv) -> np.ndarray:
        return np.full((env.num_envs, 7), self.by)


def test_its_options_are_those_of_an_evaluation() -> None:
    help = invoke("--help").stdout
    by_name = {field.name: option_name(field) for field in dataclasses.fields(EvalConfig)}
    for name, option in by_name.items():
        assert (f"{option} " in help or f"{option}," in help) == (name in SETTINGS), name


@needs_gl
def test_every_episode_has_a_tile_with_the_cameras_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    words = ["--suite", "libero_goal", "--tasks", "0,1", "--episodes", "1,3", "--policy", f"{__name__}:Nudging"]
    words += ["--policy-arg", "by=0.1", "--max-steps", "3", "--image-size", "32", "--lod", "fast"]
    done = invoke(*words, "--cameras", "frontview", "--cameras", "wrist", "--out", str(path))
    assert done.exit_code == 0, done.output
    assert done.stdout == f"{path}: 4 frames, 0 of 4 episodes solved\n"
    with av.open(str(path)) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 4
    assert frames[0].shape[1] // 2 >= 2 * 32  # two tiles in a row, each of two cameras


@needs_gl
def test_it_shows_every_few_ticks_and_the_end_in_an_animated_image(tmp_path: Path) -> None:
    path = tmp_path / "v.webp"
    words = ["--suite", "libero_goal", "--episodes", "2", "--policy", "zero", "--max-steps", "5", "--image-size", "32"]
    layout = ["--every", "2", "--fps", "10", "--hold", "0.2", "--columns", "1", "--border", "4", "--no-titles"]
    done = invoke(*words, "--lod", "fast", *layout, "--out", str(path))
    assert done.exit_code == 0, done.output
    assert done.stdout == f"{path}: {3 + 1 + 2} frames, 0 of 2 episodes solved\n"
    with Image.open(path) as image:
        assert image.size == (32 + 2 * 4, 2 * (32 + 2 * 4))
        assert image.info["loop"] == 0
        image.seek(image.n_frames - 1)
        red, green, _ = np.asarray(image.convert("RGB"))[1:3].mean((0, 1))
    assert red > green + 50


@needs_gl
def test_a_file_of_settings_gives_what_options_do_not(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("suite: libero_goal\nepisodes: 2\npolicy: zero\nmax_steps: 9\nimage_size: 16\n")
    words = ["--config", str(tmp_path / "s.yaml"), "--max-steps", "2", "--size", "32", "--task", "3"]
    done = invoke(*words, "--out", str(tmp_path / "v.mp4"))
    assert done.exit_code == 0, done.output
    assert "3 frames, 0 of 2 episodes solved" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "--suite or --results is needed"),
        (["--suite", "libero_gaol"], "unknown suite 'libero_gaol': did you mean libero_goal"),
        (["--suite", "libero_goal,libero_10"], "--suite libero_goal,libero_10: a video shows one suite"),
        (["--suite", "libero_goal", "--tasks", "all", "--episodes", "all"], "500 episodes are more than the 100"),
        (["--suite", "libero_goal", "--task", "99"], "there is no task 99: the last one is 9"),
        (["--suite", "libero_goal", "--cameras", "nowhere"], "there is no camera 'nowhere'; cameras: frontview"),
        (["--suite", "libero_goal", "--policy", "nope:X"], "policy 'nope:X': importing 'nope' failed"),
        (["--suite", "libero_goal", "--env-arg", "geom=1"], "no option geom=1; did you mean geometry?"),
        (["--suite", "libero_goal", "--protocol", "x"], "protocol"),
        (["--suite", "libero_goal", "--out", "x.avi"], "--out x.avi: videos are written as .mp4"),
        (["--suite", "simpler/bridge", "--lod", "fast"], "simpler/bridge does not take --lod"),
        (["--suite", "simpler/bridge", "--cameras", "wrist"], "there is no camera 'wrist'; cameras: agentview"),
        (["--suite", "simpler/bridge", "--policy", "pick_place"], "'pick_place' is not made for simpler/bridge"),
        (["--config", "file.yaml"], "file.yaml: record is no setting of `vecenv video`; its own: suite, policy, tasks"),
        (["--config", "typo.yaml"], "typo.yaml: unknown setting 'taks': did you mean tasks"),
        (["--config", "none.yaml"], "none.yaml cannot be read"),
    ],
)
def test_what_cannot_be_shown_gets_one_line_and_status_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file.yaml").write_text("suite: libero_goal\nretries: 1\nrecord: true\n")
    (tmp_path / "typo.yaml").write_text("suite: libero_goal\ntaks: 1\n")
    done = invoke(*arguments)
    assert done.exit_code == 2
    assert done.stderr.startswith("error: ")
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file.yaml", "typo.yaml"]


def test_options_of_an_evaluation_alone_are_refused_by_name() -> None:
    for option in ("--record", "--seeds", "--retries"):
        done = invoke("--suite", "libero_goal", option)
        assert done.exit_code == 2
        assert f"No such option: {option}" in done.stderr


def test_a_saved_evaluation_can_be_filmed_as_far_as_it_applies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings that a video does not have, and that hold their default, are no obstacle."""
    seen: list[EvalConfig] = []

    def record(config: EvalConfig, out: Path, film: Film) -> tuple[int, int, int]:
        seen.append(config)
        return 1, 0, 1

    from vecenv_eval import rollout

    monkeypatch.setattr(rollout, "record_config", record)
    chosen: dict[str, Any] = {"suite": "libero_goal", "tasks": "3", "seed": 5, "cameras": ("wrist",)}
    EvalConfig(**chosen).save(tmp_path / "s.yaml")
    assert invoke("--config", str(tmp_path / "s.yaml"), "--episodes", "2").exit_code == 0
    (config,) = seen
    assert (config.tasks, config.seed, config.camera_names, config.episodes) == ("3", 5, ("wrist",), "2")
