"""One video of episodes that were filmed before: a wall of the videos that ``vecenv eval --video`` left.

Results folders come in, of any suites and policies. Out: one mp4 or animated WebP, in which all episodes begin together
and each is framed by its verdict from its own end on. Nothing is simulated, and the folders are not changed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import vecenv
from vecenv.placement import episode_indices, parse_tasks
from vecenv_eval.config import ConfigError
from vecenv_eval.export import results_folders
from vecenv_eval.results import read_folder
from vecenv_eval.store import Record
from vecenv_eval.video.episodes import video_path
from vecenv_eval.video.film import MOST_EPISODES, Film
from vecenv_eval.video.grid import render_grid
from vecenv_eval.video.reader import VideoReader, scaled_width
from vecenv_eval.video.writer import VideoWriter


@dataclass(frozen=True, kw_only=True)
class Filmed:
    """An episode that has a verdict and a video.

    Attributes:
        record: how it went.
        path: its video.
    """

    record: Record
    path: Path


@dataclass(frozen=True, kw_only=True)
class Wall:
    """What was written.

    Attributes:
        frames: how many.
        episodes: how many are shown.
        solved: how many of these.
        without: episodes with a verdict that were asked for and have no video.
    """

    frames: int
    episodes: int
    solved: int
    without: int


def write_wall(
    folders: Sequence[Path],
    out: Path,
    *,
    film: Film | None = None,
    suites: Collection[str] = (),
    tasks: str | None = None,
    episodes: str | Sequence[int] | None = None,
    height: int | None = None,
) -> Wall:
    """Show the episodes of results folders side by side, in the order of folders, tasks and episodes.

    Args:
        folders: results folders, or folders of them (a campaign's).
        out: the video, .mp4 or .webp.
        film: how the episodes are shown.
        suites: show those of these suites alone; empty for all.
        tasks, episodes: show those of these tasks and episodes alone, as for ``vecenv eval``.
        height: pixels of an image to scale to; None for that of the videos.

    Raises:
        StoreError: there are no results, or they are damaged.
        SpecError: tasks or episodes that cannot be parsed or do not exist.
        ConfigError: none of the episodes has a video, there are too many, or they do not go together.
        VideoFileError: a video is damaged; nothing is written.
        RenderError: the end of the file's name is another, or the video is too large for it.
        OSError: the file cannot be written.
    """
    film = film or Film()
    shown, without = find_filmed(folders, suites=suites, tasks=tasks, episodes=episodes)
    # Beside the file, which may be there already and is replaced once the whole is written.
    partial = out.with_name(f".{out.stem}.partial{out.suffix}")
    try:
        frames = _write(shown, partial, film, height)
        partial.replace(out)
    finally:
        partial.unlink(missing_ok=True)
    solved = sum(each.record.success for each in shown)
    return Wall(frames=frames, episodes=len(shown), solved=solved, without=without)


def _write(shown: Sequence[Filmed], out: Path, film: Film, height: int | None) -> int:
    """Write the video of some episodes; returns the number of frames."""
    with ExitStack() as stack:
        videos = [stack.enter_context(VideoReader(each.path)) for each in shown]
        control_hz, size = _common(videos, height)
        titles = [f"{each.record.key.id}: {each.record.instruction}" for each in shown] if film.titles else []
        writer = stack.enter_context(VideoWriter(out, film.rate(control_hz)))
        for tick in _ticks(max(video.frames for video in videos), film.every):
            images = np.stack([_fitted(video.image(tick, height), size) for video in videos])
            ended = [tick >= video.frames - 1 for video in videos]
            verdicts = [each.record.success if over else None for each, over in zip(shown, ended, strict=True)]
            grid = render_grid(images, titles, columns=film.columns, verdicts=verdicts, border=film.border)
            for _ in range(1 + (film.held(control_hz) if all(ended) else 0)):
                writer.add(grid)
    return writer.frames


def find_filmed(
    folders: Sequence[Path],
    *,
    suites: Collection[str] = (),
    tasks: str | None = None,
    episodes: str | Sequence[int] | None = None,
) -> tuple[list[Filmed], int]:
    """The episodes to show, and how many more were asked for that have a verdict and no video.

    Raises:
        StoreError, SpecError, ConfigError: see `write_wall`.
    """
    found: list[tuple[Path, Record]] = []
    for folder in dict.fromkeys(each for given in folders for each in results_folders(given)):
        _, store = read_folder(folder)
        records = [record for record in store.records().values() if not record.error]
        found += [(folder, record) for record in sorted(records, key=lambda record: record.key)]
    found = [(folder, record) for folder, record in found if not suites or record.suite in suites]
    if tasks is not None:
        wanted = {suite: _tasks(tasks, suite) for suite in {record.suite for _, record in found}}
        found = [(folder, record) for folder, record in found if record.task in wanted[record.suite]]
    if episodes is not None and found:
        numbers = episode_indices(episodes, 1 + max(record.episode for _, record in found))
        found = [(folder, record) for folder, record in found if record.episode in numbers]
    shown = [
        Filmed(record=record, path=path)
        for folder, record in found
        if (path := video_path(folder, record.key)).is_file()
    ]
    where = ", ".join(map(str, folders))
    if not shown:
        asked = "none of the episodes asked for has" if found else "there is none of the episodes asked for with"
        raise ConfigError(f"{where}: {asked} a verdict and a video; `vecenv eval --video all` makes videos")
    if len(shown) > MOST_EPISODES:
        raise ConfigError(
            f"{where}: {len(shown)} episodes are more than the {MOST_EPISODES} that a video shows: choose some with "
            "--suite, --tasks and --episodes"
        )
    return shown, len(found) - len(shown)


def _tasks(spec: str, suite: str) -> tuple[int, ...]:
    names = [task.name for task in vecenv.list_tasks(suite)]
    return parse_tasks(spec, len(names), names)


def _common(videos: Sequence[VideoReader], height: int | None) -> tuple[float, tuple[int, int]]:
    """Control ticks a second of all videos, and the size of an image (height, width).

    Raises:
        ConfigError: they have different rates, or without a height different heights.
    """
    by_rate = {video.fps: video for video in videos}
    if len(by_rate) > 1:
        two = " and ".join(f"{rate:g} ({video.path.name})" for rate, video in list(by_rate.items())[:2])
        raise ConfigError(f"robots with {two} control ticks a second cannot be shown together: name one --suite")
    by_height = {video.height: video for video in videos}
    if height is None and len(by_height) > 1:
        two = " and ".join(f"{each} ({video.path.name})" for each, video in list(by_height.items())[:2])
        raise ConfigError(f"images are {two} pixels high: give --image-size")
    tall = height or videos[0].height
    return videos[0].fps, (tall, max(scaled_width(video.height, video.width, tall) for video in videos))


def _fitted(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An image of that height, filled up with black to that width."""
    return np.pad(image, ((0, 0), (0, size[1] - image.shape[1]), (0, 0)))


def _ticks(frames: int, every: int) -> Iterator[int]:
    """The frames to show: every so many, and the last."""
    yield from range(0, frames - 1, every)
    yield frames - 1
