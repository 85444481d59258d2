"""Episodes of one LeRobot dataset added to another, as merging results folders needs it.

Frames, videos and statistics of images are copied; indices of episodes, frames and tasks become those of the target,
and what depends on them is counted anew.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vecenv.errors import MissingDependency
from vecenv_eval.datasets.lerobot import DatasetError, LeRobotWriter
from vecenv_eval.datasets.statistics import Statistics
from vecenv_eval.episodes import Episode

if TYPE_CHECKING:
    import pyarrow as pa

_ABOUT = ("tasks", "success", "suite", "task_id", "source_episode")
# Raised over files that are damaged or hold something else.
_DAMAGE = (OSError, ValueError, KeyError, TypeError, AttributeError, IndexError)


def copy_episodes(source: Path, target: Path, episodes: Collection[Episode]) -> int:
    """Add episodes of one dataset to another, or make that; those that the target has are passed over.

    Args:
        source, target: folders of datasets that ``LeRobotWriter`` wrote.
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
    wanted = frozenset(episodes) - frozenset(key for key, _ in _rows(target))
    writer = _Joiner(target)
    try:
        info = json.loads((source / "meta/info.json").read_text()) if wanted else {}
        for key, row in dict(_rows(source)).items():  # of an episode that ran twice, the last
            if key in wanted:
                writer.add(source, info, key, row)
    except DatasetError:
        raise
    except _DAMAGE as error:
        raise DatasetError(f"{source} cannot be read as a LeRobot dataset: {type(error).__name__}: {error}") from None
    finally:
        added = len(writer.added)
        writer.close()
    return added


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
        self._info.setdefault("fps", info["fps"])
        if info["fps"] != self._info["fps"]:
            raise DatasetError(f"{source}: {info['fps']} ticks a second, in {self.root} {self._info['fps']}")
        self._check_features(dict(info["features"]), key, info["robot_type"])
        cameras = [name for name, feature in info["features"].items() if feature["dtype"] == "video"]
        frames = _frames(source, info, row)
        task = self._tasks.setdefault(row["tasks"][0], len(self._tasks))
        videos = {camera: self._copied(source, info, row, camera) for camera in cameras}
        images = {camera: _statistics(row, camera) for camera in cameras}
        columns = frames | self._indices(len(frames["index"]), task)
        self._add(columns, images, videos, {name: row[name] for name in _ABOUT})
        self.added.append(key)

    def _copied(self, source: Path, info: Mapping[str, Any], row: Mapping[str, Any], camera: str) -> Path:
        """A copy of an episode's video, ready to be moved to its place."""
        where = {f"{kind}_index": row[f"videos/{camera}/{kind}_index"] for kind in ("chunk", "file")}
        path = self._parent(f".partial/{camera}.mp4")
        shutil.copyfile(source / info["video_path"].format(video_key=camera, **where), path)
        return path


def _rows(root: Path) -> Iterator[tuple[Episode, dict[str, Any]]]:
    """The rows of ``meta/episodes`` that the dataset counts, in order."""
    import pyarrow.parquet as pq

    if not (root / "meta/info.json").is_file():
        return
    try:
        total = json.loads((root / "meta/info.json").read_text())["total_episodes"]
        for path in sorted(root.glob("meta/episodes/*/*.parquet")):
            for row in pq.read_table(path).to_pylist():
                if row["episode_index"] < total:
                    yield Episode(row["suite"], row["task_id"], row["source_episode"]), row
    except _DAMAGE as error:
        raise DatasetError(f"{root} cannot be read as a LeRobot dataset: {type(error).__name__}: {error}") from None


def _frames(source: Path, info: Mapping[str, Any], row: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """An episode's frames, by feature: [T, n] or [T]."""
    import pyarrow.parquet as pq

    where = {f"{kind}_index": row[f"data/{kind}_index"] for kind in ("chunk", "file")}
    table: pa.Table = pq.read_table(
        source / info["data_path"].format(**where), filters=[("episode_index", "=", row["episode_index"])]
    )
    if table.num_rows != row["length"]:
        raise DatasetError(f"{source}: episode {row['episode_index']} has {table.num_rows} frames, not {row['length']}")
    return {name: np.array(table[name].to_pylist(), _dtype(info, name)) for name in table.column_names}


def _dtype(info: Mapping[str, Any], name: str) -> str:
    return info["features"][name]["dtype"]


def _statistics(row: Mapping[str, Any], camera: str) -> Statistics:
    """The statistics of an episode's images, from its row."""
    start = f"stats/{camera}/"
    return {name.removeprefix(start): np.array(value) for name, value in row.items() if name.startswith(start)}
