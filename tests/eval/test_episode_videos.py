"""One video an episode: which are kept, what is in them, and what is left when a run stops."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.filmed import SIZE, FilmedEnv, record
from vecenv_eval.episodes import Episode
from vecenv_eval.video.episodes import VIDEOS, EpisodeVideos, video_path
from vecenv_eval.watch import watching

from vecenv.observations import ImagesUnavailable

av = pytest.importorskip("av")


def frames_of(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as video:
        return [frame.to_ndarray(format="rgb24").astype(int) for frame in video.decode(video=0)]


def run(env: Any, videos: EpisodeVideos, *ticks: tuple[int, ...]) -> None:
    with watching(env, [videos]):
        for active in ticks:
            env.tick(*active)


def kept(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*.mp4"))


@pytest.mark.parametrize(
    ("keep", "names"),
    [("failures", ["libero_goal_1_1.mp4"]), ("all", ["libero_goal_1_0.mp4", "libero_goal_1_1.mp4"])],
)
def test_failures_are_kept_or_all(tmp_path: Path, keep: str, names: list[str]) -> None:
    env, videos = FilmedEnv(), EpisodeVideos(tmp_path, keep)
    run(env, videos, (0, 1), (0, 1))
    videos.finish(env, {0: record(0, success=True), 1: record(1, success=False)})
    videos.close()
    assert kept(tmp_path) == names
    assert sorted(path.name for path in (tmp_path / VIDEOS).iterdir()) == names


def test_a_frame_is_what_the_slot_saw_before_each_tick_and_at_the_end(tmp_path: Path) -> None:
    env, videos = FilmedEnv(), EpisodeVideos(tmp_path, "all")
    run(env, videos, (0, 1), (1,), (0, 1))
    videos.finish(env, {1: record(7)})
    frames = frames_of(video_path(tmp_path, Episode("libero_goal", 1, 7)))
    assert [frame.shape for frame in frames] == [(SIZE, 2 * SIZE, 3)] * 4
    for tick, frame in enumerate(frames):
        assert frame[:, :SIZE].mean() == pytest.approx(10 * tick, abs=3)
        assert frame[:, SIZE:].mean() == pytest.approx(255 - 10 * tick, abs=3)


def test_a_slot_that_is_placed_anew_begins_a_new_video(tmp_path: Path) -> None:
    env, videos = FilmedEnv(), EpisodeVideos(tmp_path, "all")
    for episode, ticks in enumerate((3, 2)):
        run(env, videos, *[(0,)] * ticks)
        videos.finish(env, {0: record(episode)})
    assert [len(frames_of(tmp_path / VIDEOS / name)) for name in kept(tmp_path)] == [3 + 1, 2 + 1]


def test_ticks_of_an_episode_that_was_broken_off_are_in_no_other_video(tmp_path: Path) -> None:
    env, videos = FilmedEnv(), EpisodeVideos(tmp_path, "all")
    run(env, videos, (0,), (0,), (0,))
    videos.begin(env, {0: Episode("libero_goal", 1, 5)})
    run(env, videos, (0,))
    videos.finish(env, {0: record(5)})
    assert len(frames_of(tmp_path / VIDEOS / "libero_goal_1_5.mp4")) == 1 + 1


def test_an_episode_that_is_run_again_replaces_its_video(tmp_path: Path) -> None:
    env, videos = FilmedEnv(), EpisodeVideos(tmp_path)
    for ticks in (1, 4):
        run(env, videos, *[(0,)] * ticks)
        videos.finish(env, {0: record(0, success=False, error="ValueError: boom")})
    assert [len(frames_of(tmp_path / VIDEOS / name)) for name in kept(tmp_path)] == [4 + 1]


def test_what_has_not_finished_leaves_nothing(tmp_path: Path) -> None:
    env, videos = FilmedEnv(), EpisodeVideos(tmp_path, "all")
    run(env, videos, (0, 1))
    videos.close()
    videos.close()
    assert not list((tmp_path / VIDEOS).iterdir())


def test_a_slot_without_a_tick_has_no_video(tmp_path: Path) -> None:
    videos = EpisodeVideos(tmp_path, "all")
    videos.finish(FilmedEnv(), {0: record(0, success=False, fault="non-finite state")})
    assert not list(tmp_path.iterdir())


def test_an_environment_without_a_wrist_camera_shows_the_other(tmp_path: Path) -> None:
    env, videos = FilmedEnv(cameras={"agentview": 30}, control_hz=5), EpisodeVideos(tmp_path, "all")
    run(env, videos, (0,))
    videos.finish(env, {0: record(0, suite="simpler/bridge")})
    path = tmp_path / VIDEOS / "simpler-bridge_1_0.mp4"
    assert frames_of(path)[0].shape == (30, SIZE, 3)
    with av.open(str(path)) as video:
        assert video.streams.video[0].average_rate == 5


def test_without_cameras_the_error_says_so(tmp_path: Path) -> None:
    with pytest.raises(ImagesUnavailable, match="agentview or wrist: this environment renders nothing"):
        run(FilmedEnv(cameras={}), EpisodeVideos(tmp_path), (0,))


def test_the_cameras_asked_for_are_shown_in_their_order(tmp_path: Path) -> None:
    env, videos = FilmedEnv(), EpisodeVideos(tmp_path, "all", ["wrist", "agentview"])
    run(env, videos, (0,))
    videos.finish(env, {0: record(0)})
    frame = frames_of(tmp_path / VIDEOS / "libero_goal_1_0.mp4")[0]
    assert frame[:, :SIZE].mean() == pytest.approx(255, abs=3)
    assert frame[:, SIZE:].mean() == pytest.approx(0, abs=3)


def test_recorders_share_one_observation_a_tick(tmp_path: Path) -> None:
    env = FilmedEnv()
    recorders = [EpisodeVideos(tmp_path / name, "failures") for name in "ab"]
    with watching(env, recorders):  # pyright: ignore[reportArgumentType]
        env.tick(0, 1)
        env.tick(0)
    assert env.looks == 2
    for recorder in recorders:
        recorder.finish(env, {0: record(0, success=False)})
        recorder.close()
    assert len(kept(tmp_path)) == 2
