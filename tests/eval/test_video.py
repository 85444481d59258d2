"""Grids of images, and videos of them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from vecenv_eval.video.grid import GAP, TITLE_HEIGHT, render_grid
from vecenv_eval.video.writer import VideoWriter, recording

from vecenv.libero.render.options import RenderError

IMAGES = np.arange(5, dtype=np.uint8)[:, None, None, None] * np.full((1, 20, 30, 3), 50, np.uint8)


def inner(grid: np.ndarray, row: int, column: int, head: int = 0) -> np.ndarray:
    height, width = 20 + head + 2 * GAP, 30 + 2 * GAP
    tile = grid[row * height : (row + 1) * height, column * width : (column + 1) * width]
    return tile[GAP + head : -GAP, GAP:-GAP]


def test_images_stand_in_rows() -> None:
    grid = render_grid(IMAGES, columns=3)
    assert grid.shape == (2 * (20 + 2 * GAP), 3 * (30 + 2 * GAP), 3)
    for index in range(5):
        np.testing.assert_array_equal(inner(grid, *divmod(index, 3)), IMAGES[index])


def test_cameras_stand_side_by_side() -> None:
    grid = render_grid([IMAGES[:1], IMAGES[1:2]])
    np.testing.assert_array_equal(grid[GAP:-GAP, GAP:-GAP], np.concatenate([IMAGES[0], IMAGES[1]], axis=1))


def test_titles_stand_above_and_leave_the_images_alone() -> None:
    pytest.importorskip("PIL")
    grid = render_grid(IMAGES[:1], ["soup"])
    np.testing.assert_array_equal(inner(grid, 0, 0, TITLE_HEIGHT), IMAGES[0])
    assert (grid[:TITLE_HEIGHT].max(axis=-1) > 200).any()


def test_long_titles_take_up_to_three_lines_in_every_tile() -> None:
    pytest.importorskip("PIL")
    grid = render_grid(IMAGES[:2], ["soup", "pick up the soup and place it in the basket"], columns=2)
    assert grid.shape[0] == 20 + 3 * TITLE_HEIGHT + 2 * GAP
    for column in range(2):
        np.testing.assert_array_equal(inner(grid, 0, column, 3 * TITLE_HEIGHT), IMAGES[column])


def test_titles_say_the_verdict_in_its_colour() -> None:
    pytest.importorskip("PIL")
    images = np.zeros((3, 20, 120, 3), np.uint8)
    grid = render_grid(images, ["soup"] * 3, columns=1, verdicts=[True, False, None]).astype(int)
    heads = grid.reshape(3, -1, grid.shape[1], 3)[:, GAP : GAP + TITLE_HEIGHT, GAP:-GAP]
    greener, redder = heads[..., 1] - heads[..., 0], heads[..., 0] - heads[..., 1]
    assert [int(head.max()) > 60 for head in greener] == [True, False, False]
    assert [int(head.max()) > 60 for head in redder] == [False, True, False]


def test_verdicts_frame_a_slot() -> None:
    solved, failed, open_ = (tuple(render_grid(IMAGES[:1], verdicts=[v])[0, 0]) for v in (True, False, None))
    assert solved[1] > solved[0]
    assert failed[0] > failed[1]
    assert max(open_) < 50


@pytest.mark.parametrize("border", [0, 5])
def test_the_frame_is_as_wide_as_asked_for(border: int) -> None:
    grid = render_grid(IMAGES[4:], border=border, verdicts=[False])
    assert grid.shape == (20 + 2 * border, 30 + 2 * border, 3)
    np.testing.assert_array_equal(grid[border : border + 20, border : border + 30], IMAGES[4])


@pytest.mark.parametrize(
    ("images", "options", "message"),
    [
        (IMAGES[:0], {}, "no image"),
        (IMAGES.astype(float), {}, "uint8"),
        (IMAGES[0], {}, "uint8"),
        (IMAGES, {"titles": ["one"]}, "1 titles for 5 images"),
        (IMAGES, {"verdicts": [True]}, "1 verdicts for 5 images"),
        (IMAGES, {"columns": 0}, "columns=0"),
        (IMAGES, {"border": -1}, "border=-1"),
    ],
)
def test_what_cannot_be_tiled_is_refused(images: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises(RenderError, match=message):
        render_grid(images, **options)


def frames_of(path: Path) -> list[np.ndarray]:
    av = pytest.importorskip("av")
    with av.open(str(path)) as video:
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]


def test_a_video_has_its_frames(tmp_path: Path) -> None:
    pytest.importorskip("av")
    path = tmp_path / "new" / "episode.mp4"
    with VideoWriter(path) as writer:
        for shade in (0, 60, 120, 180, 240):
            writer.add(np.full((47, 65, 3), shade, np.uint8))
    frames = frames_of(path)
    assert [round(float(frame.mean()) / 60) for frame in frames] == [0, 1, 2, 3, 4]
    assert frames[0].shape == (48, 66, 3)


def test_an_animated_image_has_its_frames_and_loops(tmp_path: Path) -> None:
    pytest.importorskip("av")
    Image = pytest.importorskip("PIL.Image")
    path = tmp_path / "new" / "episode.webp"
    with VideoWriter(path, fps=10) as writer:
        for shade in (0, 60, 120, 180, 240):
            writer.add(np.full((47, 65, 3), shade, np.uint8))
    with Image.open(path) as image:
        assert (image.n_frames, image.size, image.info["loop"]) == (5, (66, 48), 0)
        for number in range(5):
            image.seek(number)
            assert np.asarray(image.convert("RGB")).mean() == pytest.approx(60 * number, abs=3)
            assert image.info["duration"] == 100


def test_an_animated_image_has_a_largest_size(tmp_path: Path) -> None:
    pytest.importorskip("av")
    with pytest.raises(RenderError, match=r"at most 16383 pixels a side, not 16384 x 2 pixels"):
        VideoWriter(tmp_path / "wide.webp").add(np.zeros((2, 16384, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_videos_are_mp4_or_webp(tmp_path: Path) -> None:
    with pytest.raises(RenderError, match=r"written as \.mp4 or \.webp"):
        VideoWriter(tmp_path / "episode.avi")


def test_without_pyav_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(RenderError, match=r"vecenv\[render\]"):
        VideoWriter(tmp_path / "episode.mp4").add(IMAGES[0])


class Countdown:
    """Two slots: the first is solved after two ticks, the second never."""

    def __init__(self) -> None:
        self.ticks, self.watchers = 0, []

    @property
    def done(self) -> np.ndarray:
        return np.zeros(2, bool)

    def reset(self) -> SimpleNamespace:
        return SimpleNamespace(episode_id=("a/0/0", "a/0/1"), instruction=("do it", "do it"))

    def observe_egocentric(self) -> SimpleNamespace:
        return SimpleNamespace(images={"agentview": np.full((2, 32, 32, 3), 40 * self.ticks, np.uint8)})

    def evaluate(self) -> SimpleNamespace:
        return SimpleNamespace(success=np.array([self.ticks >= 2, False]))

    @contextmanager
    def watched(self, watcher: Any) -> Iterator[None]:
        self.watchers.append(watcher)
        yield
        self.watchers.remove(watcher)

    def step(self) -> None:
        for watcher in self.watchers:
            watcher(None, None)
        self.ticks += 1


def test_every_tick_of_a_batch_is_a_frame_and_the_last_shows_the_verdicts(tmp_path: Path) -> None:
    pytest.importorskip("av")
    pytest.importorskip("PIL")
    env: Any = Countdown()
    with recording(env, tmp_path / "batch.mp4"):
        for _ in range(3):
            env.step()
    frames = frames_of(tmp_path / "batch.mp4")
    assert len(frames) == 4
    assert frames[0][1].max() < 60
    green, red = frames[-1][1, 10], frames[-1][1, -10]
    assert green[1] > green[0]
    assert red[0] > red[1]


@pytest.mark.parametrize("control_hz", [3, 5, 20])
def test_a_rollouts_video_runs_at_its_robots_rate(tmp_path: Path, control_hz: int) -> None:
    av = pytest.importorskip("av")
    pytest.importorskip("PIL")
    from vecenv_eval.rollout import record_rollout

    env: Any = Countdown()
    env.num_envs, env.control_hz = 2, control_hz

    def step(actions: Any) -> Any:
        env.step()
        return SimpleNamespace(done=np.array([env.ticks >= 2, env.ticks >= 6]), step_index=np.full(2, env.ticks))

    env.step_continuous = step
    policy: Any = SimpleNamespace(name="still", reset=lambda *_: None, act=lambda _: None)
    assert record_rollout(env, policy, tmp_path / "v.mp4", ["agentview"]) == 7
    with av.open(str(tmp_path / "v.mp4")) as video:
        assert video.streams.video[0].average_rate == control_hz
