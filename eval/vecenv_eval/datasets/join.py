"""Episodes of one LeRobot dataset added to another, as merging results folders needs it.

Frames, videos and statistics of images are copied; indices of episodes, frames and tasks become those of the target,
and what depends on them is counted anew.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vecenv.errors import MissingDependency, VecenvError
from vecenv_eval.datasets import files, waiting
from vecenv_eval.datasets.lerobot import LeRobotWriter
from vecenv_eval.datasets.statistics import Statistics
from vecenv_eval.datasets.waiting import DAMAGE, PARTIAL, DatasetError, Waiting
from vecenv_eval.episodes import Episode

_ABOUT = ("tasks", "success", "suite", "task_id", "source_episode")
# A writer may be moving episodes into the dataset's files while they are read: how often to look again.
_LOOKS = 5


def copy_episodes(source: Path, target: Path, episodes: Collection[Episode]) -> int:
    """Add episodes of one dataset to another, or make that; those that the target has are passed over.

    Args:
        source, target: folders of datasets that ``LeRobotWriter`` wrote; a run may be writing to ``source``.
        episodes: which episodes; those that the source lacks are passed over.

    Returns:
        How many were added.

    Raises:
        DatasetError: the source cannot be read, or its features are others than the target's.
        MissingDependency: pyarrow is not installed.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise MissingDependency("LeRobot datasets need pyarrow: pip install 'vecenv[datasets]'") from None
    writer = _Joiner(target)
    try:
        for look in range(1, _LOOKS + 1):
            try:
                _copy(source, writer, frozenset(episodes))
                break
            except FileNotFoundError:
                if look == _LOOKS:
                    raise
    except VecenvError:
        raise
    except DAMAGE as error:
        text = " ".join(str(error).split())
        raise DatasetError(
            f"{source} cannot be read as a LeRobot dataset: {type(error).__name__}: {text:.300}"
        ) from None
    finally:
        added = len(writer.added)
        writer.close()
    return added


def _copy(source: Path, writer: _Joiner, wanted: Collection[Episode]) -> None:
    """Copy what the writer lacks."""
    there = files.read(source)
    for key, row in {files.key_of(row): row for row in there.rows}.items():  # of an episode that ran twice, the last
        if key in wanted and key not in writer.keys:
            writer.add(source, there.info, key, row)
    total = there.info.get("total_episodes", 0)
    for folder in waiting.folders(source):
        if int(folder.name) >= total and (each := waiting.load(folder)).key in wanted and each.key not in writer.keys:
            writer.add_waiting(source, each)


class _Joiner(LeRobotWriter):
    """A writer that takes episodes from another dataset.

    Attributes:
        added: what it took.
    """

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.added: list[Episode] = []

    def add(self, source: Path, info: Mapping[str, Any], key: Episode, row: Mapping[str, Any]) -> None:
        """Add one episode, given its row in the source's ``meta/episodes``."""
        cameras = self._check(source, info, key)
        columns = _frames(source, info, row)
        where = {
            camera: _numbers(row, f"videos/{camera}/chunk_index", f"videos/{camera}/file_index") for camera in cameras
        }
        videos = {
            camera: self._copied(source / files.VIDEO.format(*where[camera], key=camera), camera) for camera in cameras
        }
        stats = files.statistics_of(row)
        images = {camera: stats[camera] for camera in cameras}
        self._add(columns, images, videos, {name: row[name] for name in _ABOUT})
        self.added.append(key)

    def add_waiting(self, source: Path, episode: Waiting) -> None:
        """Add one episode that waits in the source."""
        cameras = self._check(source, episode.info, episode.key)
        videos = {camera: self._copied(episode.video(camera), camera) for camera in cameras}
        images: dict[str, Statistics] = {camera: episode.images[camera] for camera in cameras}
        self._add(episode.columns, images, videos, {name: episode.about[name] for name in _ABOUT})
        self.added.append(episode.key)

    def _check(self, source: Path, info: Mapping[str, Any], key: Episode) -> list[str]:
        """Refuse what does not fit the dataset; gives the features that are videos."""
        self._info.setdefault("fps", info["fps"])
        if info["fps"] != self._info["fps"]:
            raise DatasetError(f"{source}: {info['fps']} ticks a second, in {self.root} {self._info['fps']}")
        self._check_features(dict(info["features"]), key, info["robot_type"])
        return waiting.cameras_of(info)

    def _copied(self, video: Path, camera: str) -> Path:
        """A copy of an episode's video, ready to be moved to its place."""
        path = self._parent(f"{PARTIAL}/{camera}.mp4")
        shutil.copyfile(video, path)
        return path


def _frames(source: Path, info: Mapping[str, Any], row: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """An episode's frames, by feature: [T, n] or [T]; without the indices in the dataset."""
    path = source / files.DATA.format(*_numbers(row, "data/chunk_index", "data/file_index"))
    table = files.table(path)
    table = table.filter(waiting.array_of(table, "episode_index") == row["episode_index"])
    if table.num_rows != row["length"]:
        raise DatasetError(f"{source}: episode {row['episode_index']} has {table.num_rows} frames, not {row['length']}")
    return waiting.columns_of(table, info["features"])


def _numbers(row: Mapping[str, Any], *names: str) -> list[int]:
    """Parts of a file's name."""
    return [int(row[name]) for name in names]
