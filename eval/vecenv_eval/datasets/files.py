"""The files of a LeRobot dataset (format v3.0), read: what a writer continues, and what is copied from it.

A folder comes in, perhaps damaged or a stranger's. What a process that was killed left behind (files that
``meta/info.json`` does not count) is passed over by readers, and removed by whoever opens it to write.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vecenv.errors import InvalidFile
from vecenv_eval.datasets import waiting
from vecenv_eval.datasets.statistics import Statistics, together
from vecenv_eval.datasets.waiting import DAMAGE, PARTIAL, PENDING, DatasetError
from vecenv_eval.episodes import Episode
from vecenv_eval.store.files import read_json

VERSION = "v3.0"
# Files in a folder.
CHUNK = 1000
DATA, EPISODES = "data/chunk-{0:03d}/file-{1:03d}.parquet", "meta/episodes/chunk-{0:03d}/file-{1:03d}.parquet"
VIDEO = "videos/{key}/chunk-{0:03d}/file-{1:03d}.mp4"
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
# What ``meta/info.json`` counts.
TOTALS = ("total_episodes", "total_frames", "total_tasks", "splits")
_PLACE = re.compile(r"chunk-(\d{3,6})/file-(\d{3,6})\.parquet")
# Bytes of one parquet file that is read as a whole; ours have a few megabytes.
_MOST_BYTES = 1 << 30


@dataclass(frozen=True, kw_only=True)
class Contents:
    """What a dataset holds; everything is empty where there is none yet.

    Attributes:
        info: content of ``meta/info.json``.
        tasks: instruction -> index.
        stats: statistics of each feature.
        rows: the rows of ``meta/episodes`` that ``info`` counts, in order.
        files: how many files of data there are.
    """

    info: dict[str, Any] = field(default_factory=dict)
    tasks: dict[str, int] = field(default_factory=dict)
    stats: dict[str, Statistics] = field(default_factory=dict)
    rows: tuple[dict[str, Any], ...] = ()
    files: int = 0

    @property
    def keys(self) -> tuple[Episode, ...]:
        """Which episodes they are."""
        return tuple(key_of(row) for row in self.rows)


def key_of(row: Mapping[str, Any]) -> Episode:
    """The episode of a row of ``meta/episodes``."""
    return Episode(str(row["suite"]), int(row["task_id"]), int(row["source_episode"]))


def read(root: Path) -> Contents:
    """Read a dataset that ``LeRobotWriter`` wrote; nothing is changed.

    Raises:
        DatasetError: it is damaged, or something else.
        MissingDependency: pyarrow is not installed.
    """
    if not (root / INFO).is_file():
        strange = [] if not root.exists() else [p.name for p in root.iterdir() if p.name not in (PENDING, PARTIAL)]
        if strange and not (set(strange) <= {"data", "meta", "videos"} and (root / PENDING).is_dir()):
            raise DatasetError(f"{root} holds something other than a LeRobot dataset: it has no {INFO}")
        return Contents()
    try:
        return _read(root)
    except DatasetError:
        raise
    except (*DAMAGE, InvalidFile) as error:
        text = " ".join(str(error).split())
        raise DatasetError(f"{root} cannot be read as a LeRobot dataset: {type(error).__name__}: {text:.300}") from None


def _read(root: Path) -> Contents:
    info = read_json(root / INFO)
    if info["codebase_version"] != VERSION:
        raise DatasetError(f"{root} is a LeRobot dataset of format {info['codebase_version']!s:.50}, not {VERSION}")
    waiting.checked_info(info)
    for name in ("total_episodes", "total_frames"):
        if type(info[name]) is not int or info[name] < 0:
            raise DatasetError(f"{root / INFO}: {name} is {info[name]!r:.50}, not a whole number from 0")
    total = info["total_episodes"]
    rows = [row for path in sorted(root.glob("meta/episodes/*/*.parquet")) for row in table(path).to_pylist()]
    rows = sorted((row for row in rows if row["episode_index"] < total), key=lambda row: row["episode_index"])
    if [row["episode_index"] for row in rows] != list(range(total)):
        raise DatasetError(f"{root}: {INFO} counts {total} episodes, meta/episodes has {len(rows)} of them")
    if sum(row["length"] for row in rows) != info["total_frames"]:
        raise DatasetError(f"{root}: {INFO} counts {info['total_frames']} frames, meta/episodes has others")
    places = [row["data/chunk_index"] * CHUNK + row["data/file_index"] for row in rows]
    for row in rows:
        waiting.checked_about(row)
    tasks = table(root / TASKS).to_pydict()
    found = Contents(
        info=info,
        tasks={str(task): int(index) for task, index in zip(tasks["task"], tasks["task_index"], strict=True)},
        rows=tuple(rows),
        files=1 + max(places, default=-1),
    )
    stats = {name: waiting.statistics(each) for name, each in read_json(root / STATS).items()}
    if set(stats) != set(info["features"]) or int(stats["index"]["count"][0]) != info["total_frames"]:
        stats = _together(rows)  # a process was killed between the two
    return Contents(info=info, tasks=found.tasks, stats=stats, rows=found.rows, files=found.files)


def _together(rows: list[dict[str, Any]]) -> dict[str, Statistics]:
    """The statistics of all episodes, from those of each."""
    own = [statistics_of(row) for row in rows]
    return {name: together([each[name] for each in own]) for name in (own[0] if own else {})}


def statistics_of(row: Mapping[str, Any]) -> dict[str, Statistics]:
    """The statistics of an episode by feature, from its row of ``meta/episodes``."""
    found: dict[str, dict[str, Any]] = {}
    for name, value in row.items():
        start, _, rest = name.partition("/")
        if start == "stats":
            feature, _, which = rest.rpartition("/")
            found.setdefault(feature, {})[which] = value
    return {feature: waiting.statistics(values) for feature, values in found.items()}


def table(path: Path) -> Any:
    """A parquet file as a ``pyarrow.Table``.

    Raises:
        DatasetError: it is larger than any of ours.
    """
    import pyarrow.parquet as pq

    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        about = file.metadata
        size = sum(about.row_group(index).total_byte_size for index in range(about.num_row_groups))
        if not 0 <= size <= _MOST_BYTES:
            raise DatasetError(f"{path} says that it has {size:,} bytes, more than {_MOST_BYTES:,}")
        return file.read()


def open_to_write(root: Path) -> Contents:
    """Read a dataset and remove the files that it does not count: a process was killed while it wrote them.

    Raises:
        DatasetError: it is damaged, or something else.
    """
    found = read(root)
    for pattern in ("data/*/*.parquet", "meta/episodes/*/*.parquet"):
        for path in root.glob(pattern):
            match = _PLACE.fullmatch("/".join(path.parts[-2:]))
            if match and int(match[1]) * CHUNK + int(match[2]) >= found.files:
                path.unlink()
    for part in ("data", "meta", "videos"):
        for path in (root / part).rglob("*.tmp"):
            path.unlink()
    return found
