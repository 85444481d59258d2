"""``vecenv video --results``: episodes that were filmed before, on one wall with their verdicts."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.results_folders import some_records, write_results
from typer.testing import CliRunner, Result
from vecenv_eval.store import Record
from vecenv_eval.video.episodes import video_path
from vecenv_eval.video.film import Film
from vecenv_eval.video.reader import VideoFileError, VideoReader
from vecenv_eval.video.writer import VideoWriter
from vecenv_eval.wall import find_filmed, write_wall

from vecenv.cli import build_app
from vecenv.libero.render.options import RenderError

av = pytest.importorskip("av")
pytest.importorskip("PIL")
SIDE, BORDER = 32, 4


def invoke(*arguments: object) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["video", *map(str, arguments)])


def film(folder: Path, record: Record, frames: int, *, side: int = SIDE, fps: float = 20) -> None:
    """A video of grey frames; frame i has the shade 10 * i."""
    with VideoWriter(video_path(folder, record.key), fps, crf=6) as video:
        for number in range(frames):
            video.add(np.full((side, side, 3), 10 * number, np.uint8))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two tasks with two episodes each; task 0 is solved, in 4 ticks; task 1 is not, in 8."""
    records = some_records(lambda task, episode: task == 0, episodes=2)
    folder = write_results(tmp_path / "run", records)
    for record in records:
        film(folder, record, 5 if record.success else 9)
    return folder


def frames_of(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as video:
        return [frame.to_ndarray(format="rgb24").astype(int) for frame in video.decode(video=0)]


def tile(frame: np.ndarray, row: int, column: int) -> tuple[float, str]:
    """The shade of a tile, and the colour of its frame: green, red or none."""
    size = SIDE + 2 * BORDER
    whole = frame[row * size : (row + 1) * size, column * size : (column + 1) * size]
    red, green, _ = whole[1 : BORDER - 1, SIDE // 2 : SIDE].mean((0, 1))
    colour = "none" if abs(red - green) < 30 else "green" if green > red else "red"
    return float(whole[BORDER:-BORDER, BORDER:-BORDER].mean()), colour


def test_each_episode_gets_its_verdict_when_it_ends_and_stays(folder: Path, tmp_path: Path) -> None:
    look = Film(titles=False, border=BORDER, columns=2)
    wall = write_wall([folder], tmp_path / "w.mp4", film=look)
    assert (wall.frames, wall.episodes, wall.solved, wall.without) == (9, 4, 2, 0)
    frames = frames_of(tmp_path / "w.mp4")
    assert len(frames) == 9
    for tick, frame in enumerate(frames):
        for column in range(2):
            shade, colour = tile(frame, 0, column)
            assert shade == pytest.approx(10 * min(tick, 4), abs=4)
            assert colour == ("green" if tick >= 4 else "none")
            shade, colour = tile(frame, 1, column)
            assert shade == pytest.approx(10 * tick, abs=4)
            assert colour == ("red" if tick == 8 else "none")


def test_a_frame_every_few_ticks_ends_with_the_end_which_stays(folder: Path, tmp_path: Path) -> None:
    look = Film(titles=False, border=BORDER, every=3, fps=10, hold=0.4)
    wall = write_wall([folder], tmp_path / "w.mp4", film=look, tasks="1", episodes="1-1")
    frames = frames_of(tmp_path / "w.mp4")
    assert wall.frames == len(frames) == 4 + 4
    assert [tile(frame, 0, 0)[0] for frame in frames] == pytest.approx([0, 30, 60, 80, 80, 80, 80, 80], abs=4)
    assert [tile(frame, 0, 0)[1] for frame in frames] == ["none"] * 3 + ["red"] * 5
    with av.open(str(tmp_path / "w.mp4")) as video:
        assert video.streams.video[0].average_rate == 10


def test_without_a_rate_it_runs_as_fast_as_the_robot(folder: Path, tmp_path: Path) -> None:
    write_wall([folder], tmp_path / "w.mp4", film=Film(every=4))
    with av.open(str(tmp_path / "w.mp4")) as video:
        assert video.streams.video[0].average_rate == 5


def test_an_animated_image_loops_and_lasts_as_long(folder: Path, tmp_path: Path) -> None:
    from PIL import Image, ImageSequence

    path = tmp_path / "w.webp"
    write_wall([folder], path, film=Film(titles=False, border=BORDER, columns=2, fps=10, hold=1))
    durations = []
    with Image.open(path) as image:
        assert image.info["loop"] == 0
        for frame in ImageSequence.Iterator(image):
            frame.load()
            durations.append(frame.info["duration"])
            last = np.asarray(frame.convert("RGB")).astype(int)
    assert sum(durations) == pytest.approx(100 * (9 + 10), abs=100)
    assert tile(last, 0, 0) == (pytest.approx(40, abs=4), "green")
    assert tile(last, 1, 1) == (pytest.approx(80, abs=4), "red")


def test_images_are_scaled_and_titled(folder: Path, tmp_path: Path) -> None:
    done = invoke("--results", folder, "--image-size", 64, "--columns", 4, "--out", tmp_path / "w.mp4")
    assert done.exit_code == 0, done.output
    assert done.stdout == f"{tmp_path / 'w.mp4'}: 9 frames, 2 of 4 episodes solved\n"
    height, width, _ = frames_of(tmp_path / "w.mp4")[0].shape
    assert width == 4 * (64 + 2 * 2)
    assert height > 64 + 2 * 2 + 16


def test_folders_of_several_suites_make_one_wall(folder: Path, tmp_path: Path) -> None:
    others = some_records(lambda task, episode: False, suite="libero_10", tasks=1, episodes=1)
    other = write_results(tmp_path / "all" / "libero_10", others, suite="libero_10")
    film(other, others[0], 3)
    shown, _ = find_filmed([tmp_path / "all", folder, folder])
    assert [each.record.key.id for each in shown] == [
        "libero_10/0/0",
        *(f"libero_goal/{task}/{episode}" for task in (0, 1) for episode in (0, 1)),
    ]
    assert len(find_filmed([tmp_path / "all", folder], suites=["libero_goal"], tasks="0")[0]) == 2


def test_episodes_without_a_video_are_counted_and_those_without_a_verdict_are_not_shown(
    folder: Path, tmp_path: Path
) -> None:
    records = some_records(lambda task, episode: True, tasks=1, episodes=3)
    error = some_records(lambda task, episode: False, tasks=2, episodes=1, error="ValueError: boom")[1]
    other = write_results(tmp_path / "other", [*records, error])
    film(other, records[0], 2)
    film(other, error, 2)
    done = invoke("--results", other, "--out", tmp_path / "w.mp4")
    assert done.exit_code == 0, done.output
    assert "1 of 1 episodes solved; 2 more have no video" in done.stdout


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def replaced(path: Path) -> None:
    path.write_text("ffconcat version 1.0\nfile /etc/passwd\n")


@pytest.mark.parametrize("damage", [cut, replaced])
def test_a_damaged_video_is_named(folder: Path, tmp_path: Path, damage: Callable[[Path], None]) -> None:
    damage(folder / "videos" / "libero_goal_1_0.mp4")
    (tmp_path / "w.mp4").write_text("an earlier film")
    done = invoke("--results", folder, "--out", tmp_path / "w.mp4")
    assert done.exit_code == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "w.mp4"]
    assert (tmp_path / "w.mp4").read_text() == "an earlier film"
    assert done.stderr.startswith("error: libero_goal_1_0.mp4 ")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--results", "none"], "none is not a results folder: there is no such folder"),
        (["--results", "run/videos"], "neither it nor a folder in it has a config.json"),
        (["--results", "run", "--policy", "zero"], "--policy: the episodes of --results have been run and filmed"),
        (["--results", "run", "--suite", "libero_gaol"], "unknown suite 'libero_gaol': did you mean libero_goal"),
        (["--results", "run", "--suite", "libero_10"], "run: there is none of the episodes asked for"),
        (["--results", "run", "--tasks", "0-3"], "run: "),
        (["--results", "run", "--tasks", "99"], "there is no task 99"),
        (["--results", "run", "--episodes", "5-6"], "episode 6"),
        (["--results", "run", "--fps", "0"], "fps=0.0: need more than 0"),
        (["--results", "run", "--hold", "inf"], "hold=inf: need at least 0"),
        (["--results", "run", "--out", "run/config.json/w.mp4"], "no file can be made in "),
        (["--results", "run", "--out", "a.mp4"], "--out a.mp4 cannot be written: it is a folder"),
        (["--results", "run", "--out", "w.gif"], "--out w.gif: videos are written as .mp4 or .webp"),
    ],
)
def test_what_cannot_be_shown_gets_one_line_and_status_2(
    folder: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(folder.parent)
    (folder.parent / "a.mp4").mkdir()
    if "0-3" in arguments:
        for path in (folder / "videos").iterdir():
            path.unlink()
        says = "none of the episodes asked for has a verdict and a video; `vecenv eval --video all`"
    done = invoke(*arguments)
    assert done.exit_code == 2, done.output
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not [path for path in folder.parent.iterdir() if path.suffix in (".mp4", ".webp", ".gif") and path.is_file()]


def test_other_sizes_rates_and_too_many_episodes_are_refused(tmp_path: Path) -> None:
    records = some_records(lambda task, episode: True, tasks=1, episodes=101)
    folder = write_results(tmp_path / "run", records)
    film(folder, records[0], 2)
    film(folder, records[1], 2, side=64)
    film(folder, records[2], 2, fps=5)
    out = tmp_path / "w.mp4"
    assert "images are 32 (libero_goal_0_0.mp4) and 64" in invoke("--results", folder, "--episodes", 2).stderr
    assert invoke("--results", folder, "--episodes", 2, "--image-size", 32, "--out", out).exit_code == 0
    assert "5 (libero_goal_0_2.mp4) control ticks" in invoke("--results", folder, "--episodes", "0,2").stderr
    for record in records[3:]:
        film(folder, record, 1)
    assert "101 episodes are more than the 100" in invoke("--results", folder).stderr


def test_a_reader_goes_forwards_and_stays_at_the_end(folder: Path) -> None:
    with VideoReader(folder / "videos" / "libero_goal_0_0.mp4") as video:
        assert (video.frames, video.fps, video.height, video.width) == (5, 20, SIDE, SIDE)
        shades = [video.image(number).mean() for number in (0, 2, 2, 4, 70)]
        assert shades == pytest.approx([0, 20, 20, 40, 40], abs=4)
        assert video.image(4, 16).shape == (16, 16, 3)
        with pytest.raises(ValueError, match="after frame 4"):
            video.image(1)


def test_a_missing_video_is_named(tmp_path: Path) -> None:
    with pytest.raises(VideoFileError, match=r"no\.mp4 cannot be played"):
        VideoReader(tmp_path / "no.mp4")


@pytest.mark.parametrize("wrong", [{"every": 0}, {"columns": 0}, {"border": -1}, {"hold": -1.0}, {"fps": 1000.0}])
def test_numbers_that_make_no_film_are_refused(wrong: dict[str, float]) -> None:
    (name,) = wrong
    with pytest.raises(RenderError, match=f"^{name}="):
        Film(**wrong)  # pyright: ignore[reportArgumentType]
