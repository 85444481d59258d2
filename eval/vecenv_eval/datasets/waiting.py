"""Episodes of a LeRobot dataset that are on the disk and not yet in its files.

The files of a dataset hold many episodes each, so an episode cannot be added to them when it ends. Until it is, it has
a folder of its own, ``.pending/NUMBER``: its frames, its videos and what is told about it. The folder appears in one
step and its number is the episode's index in the dataset, so that after a crash it is plain which episodes are in the
files (those below ``total_episodes``) and which still wait.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vecenv.errors import InvalidFile
from vecenv_eval.datasets.statistics import QUANTILES, Statistics
from vecenv_eval.episodes import Episode
from vecenv_eval.store.files import naming, read_json, replace_bytes, sync_folder
from vecenv_eval.store.record import MOST_EPISODES

if TYPE_CHECKING:
    import pyarrow as pa

PENDING, PARTIAL = ".pending", ".partial"
_FRAMES, _ABOUT = "frames.parquet", "about.json"
# Columns of frames that depend on what the dataset holds already, and the others with one number a frame.
INDICES = ("episode_index", "index", "task_index")
SCALARS = {"timestamp": "float32", **dict.fromkeys(("frame_index", *INDICES), "int64")}
STATISTICS = ("min", "max", "mean", "std", "count", *QUANTILES)
_DTYPES = ("float32", "bool", "int64", "video")
# Far beyond any robot and camera.
_MOST_FPS, _MOST_SIZE = 10_000, 100_000
# Names of features become names of files.
_FEATURE = re.compile(r"[\w.-]{1,200}")
# What pyarrow, NumPy and json raise over files that are damaged or hold something else.
DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    IndexError,
    RecursionError,
    OverflowError,
    MemoryError,
)


class DatasetError(InvalidFile):
    """A dataset cannot be continued, or an episode does not fit it."""


@dataclass(frozen=True, kw_only=True)
class Waiting:
    """An episode that waits to be written to the files of a dataset.

    Attributes:
        folder: where it is.
        key: which episode it is.
        columns: its frames by feature, [T, n] or [T]; without the indices, which depend on the dataset.
        images: statistics of its images by feature.
        about: what ``meta/episodes`` tells about it.
        info: what ``meta/info.json`` says of datasets that it fits into: fps, features, robot.
    """

    folder: Path
    key: Episode
    columns: Mapping[str, np.ndarray]
    images: Mapping[str, Statistics]
    about: Mapping[str, Any]
    info: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.columns["frame_index"])

    @property
    def number(self) -> int:
        """Its index in the dataset."""
        return int(self.folder.name)

    def video(self, feature: str) -> Path:
        """The mp4 of a camera."""
        return self.folder / f"{feature}.mp4"

    def moved(self, number: int) -> Waiting:
        """The same episode with another index."""
        folder = self.folder.with_name(f"{number:08d}")
        if folder != self.folder:
            self.folder.replace(folder)
        return replace(self, folder=folder)


def save(
    root: Path,
    number: int,
    columns: Mapping[str, np.ndarray],
    images: Mapping[str, Statistics],
    videos: Mapping[str, Path],
    about: Mapping[str, Any],
    info: Mapping[str, Any],
) -> Waiting:
    """Put an episode on the disk; it is there as a whole when this returns, and not at all before.

    Args:
        root: the dataset's folder.
        number: its index; an episode that waits with it already is replaced.
        columns, images, about, info: see :class:`Waiting`.
        videos: feature -> mp4, which is moved.
    """
    made = root / PARTIAL / uuid.uuid4().hex
    made.mkdir(parents=True)
    write_parquet(made / _FRAMES, [table_of(columns)])
    content = {
        "about": dict(about),
        "images": {name: {k: v.tolist() for k, v in found.items()} for name, found in images.items()},
        "info": dict(info),
    }
    replace_bytes(made / _ABOUT, json.dumps(content).encode())
    for feature, video in videos.items():
        sync(video)
        video.replace(made / f"{feature}.mp4")
    sync_folder(made)
    folder = root / PENDING / f"{number:08d}"
    folder.parent.mkdir(exist_ok=True)
    remove(folder)
    made.replace(folder)
    sync_folder(folder.parent)
    return Waiting(folder=folder, key=_key(about), columns=columns, images=images, about=about, info=info)


def load(folder: Path) -> Waiting:
    """Read an episode that waits.

    Raises:
        DatasetError: it is damaged.
    """
    import pyarrow.parquet as pq

    try:
        content, table = read_json(folder / _ABOUT), pq.read_table(folder / _FRAMES, page_checksum_verification=True)
        about, info = dict(content["about"]), checked_info(content["info"])
        checked_about(about)
        images = {name: statistics(found) for name, found in dict(content["images"]).items()}
        if set(images) != set(cameras_of(info)):
            raise ValueError("it has images of other cameras than it says")
        return Waiting(
            folder=folder,
            key=_key(about),
            columns=columns_of(table, info["features"]),
            images=images,
            about=about,
            info=info,
        )
    except FileNotFoundError:
        raise
    except (*DAMAGE, InvalidFile) as error:
        raise DatasetError(f"{folder} is damaged: {type(error).__name__}: {' '.join(str(error).split())}") from None


def checked_info(info: Any) -> dict[str, Any]:
    """What ``meta/info.json`` says, if it has the form of ours.

    Raises:
        ValueError: it has not.
    """
    if not isinstance(info, dict) or not isinstance(info.get("robot_type"), str):
        raise ValueError("robot_type is no text")
    if type(info.get("fps")) is not int or not 0 < info["fps"] <= _MOST_FPS:
        raise ValueError(f"fps is {info.get('fps')!r:.50}, not a whole number from 1 to {_MOST_FPS}")
    features = info.get("features")
    if not isinstance(features, dict):
        raise ValueError("features is no JSON object")
    for name, feature in features.items():
        shape = feature.get("shape") if isinstance(feature, dict) else None
        sizes = isinstance(shape, list) and all(type(size) is int and 0 < size <= _MOST_SIZE for size in shape)
        if not sizes or len(shape or ()) not in (1, 3) or feature.get("dtype") not in _DTYPES:
            raise ValueError(f"feature {name!r:.50} has another dtype or shape than any of ours")
        if not _FEATURE.fullmatch(name):
            raise ValueError(f"{name!r:.50} is no name of a feature")
    if missing := sorted({"observation.state", "action", *SCALARS} - features.keys()):
        raise ValueError(f"there is no feature {missing[0]}")
    return info


def checked_about(row: Mapping[str, Any]) -> None:
    """Refuse what ``meta/episodes`` tells about an episode if it has another form than ours.

    Raises:
        ValueError, KeyError: it has.
    """
    tasks = row["tasks"]
    if not isinstance(tasks, list) or len(tasks) != 1 or not isinstance(tasks[0], str):
        raise ValueError(f"tasks is {tasks!r:.50}, not one instruction")
    if not isinstance(row["suite"], str) or not isinstance(row["success"], bool):
        raise ValueError("suite is no text, or success not true or false")
    for name in ("task_id", "source_episode"):
        if type(row[name]) is not int or not 0 <= row[name] <= MOST_EPISODES:
            raise ValueError(f"{name} is {row[name]!r:.50}, not a whole number from 0 to {MOST_EPISODES:,}")


def statistics(values: Mapping[str, Any]) -> Statistics:
    """Statistics of one feature, from JSON or parquet.

    Raises:
        ValueError, KeyError: they are none.
    """
    found = {name: np.array(values[name]) for name in STATISTICS}
    shape = found["mean"].shape
    for name, array in found.items():
        if array.dtype.kind not in "iufb" or array.shape != ((1,) if name == "count" else shape) or array.size > 10_000:
            raise ValueError(f"{name} holds no statistics")
    if not found["count"][0] > 0:
        raise ValueError("count is not above 0")
    return found


def cameras_of(info: Mapping[str, Any]) -> list[str]:
    """The features that are videos."""
    return [name for name, feature in info["features"].items() if feature["dtype"] == "video"]


def columns_of(table: pa.Table, features: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """An episode's frames by feature, [T, n] or [T], without the indices in the dataset.

    Raises:
        ValueError: they are not what the features say.
    """
    wanted = [name for name, feature in features.items() if feature["dtype"] != "video" and name not in INDICES]
    if not set(wanted) <= set(table.column_names) <= {*wanted, *INDICES}:
        raise ValueError("frames have other features than meta/info.json says")
    found = {name: array_of(table, name) for name in wanted}
    for name, array in found.items():
        width = array.shape[1] if array.ndim == 2 else 1
        if [width] != features[name]["shape"] or array.dtype != features[name]["dtype"]:
            raise ValueError(f"{name} is {array.dtype} {array.shape}, meta/info.json says something else")
    if not len(table):
        raise ValueError("there is no frame")
    return found


def folders(root: Path) -> list[Path]:
    """The folders of the episodes that wait, in order."""
    place = root / PENDING
    names = [path.name for path in place.iterdir()] if place.is_dir() else []
    return [place / name for name in sorted(names) if re.fullmatch(r"\d{8}", name)]


def renumber(chosen: Sequence[Waiting], rest: Sequence[Waiting], start: int) -> tuple[list[Waiting], list[Waiting]]:
    """Give the chosen episodes the numbers from ``start`` on, in order, and the rest those that follow."""
    if [each.number for each in (*chosen, *rest)] == list(range(start, start + len(chosen) + len(rest))):
        return list(chosen), list(rest)
    free = 1 + max(each.number for each in (*chosen, *rest))
    free = max(free, start + len(chosen) + len(rest))
    aside = [each.moved(free + index) for index, each in enumerate((*chosen, *rest))]
    placed = [each.moved(start + index) for index, each in enumerate(aside)]
    return placed[: len(chosen)], placed[len(chosen) :]


def remove(folder: Path) -> None:
    """Remove the folder of an episode, in one step for whoever looks for episodes that wait."""
    if not folder.exists():
        return
    aside = folder.parent.parent / PARTIAL / uuid.uuid4().hex
    aside.parent.mkdir(parents=True, exist_ok=True)
    folder.replace(aside)
    shutil.rmtree(aside, ignore_errors=True)


def _key(about: Mapping[str, Any]) -> Episode:
    return Episode(str(about["suite"]), int(about["task_id"]), int(about["source_episode"]))


def array_of(table: pa.Table, name: str) -> np.ndarray:
    """A column of frames: [T], or of lists of one length [T, n]."""
    import pyarrow as pa

    column = table[name].combine_chunks()
    if pa.types.is_fixed_size_list(column.type):
        return column.flatten().to_numpy(zero_copy_only=False).reshape(len(column), column.type.list_size)
    return column.to_numpy(zero_copy_only=False)


def table_of(columns: Mapping[str, np.ndarray]) -> pa.Table:
    """An episode's frames; vectors as lists of a fixed length."""
    import pyarrow as pa

    arrays = {
        name: pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
        if values.ndim == 2
        else pa.array(values)
        for name, values in columns.items()
    }
    return pa.table(arrays)


def write_parquet(path: Path, tables: Iterable[pa.Table]) -> None:
    """Write tables of one schema to a file, in one step, and wait until it is on the disk."""
    import pyarrow.parquet as pq

    temporary = path.with_name(path.name + ".tmp")
    tables = list(tables)
    with (
        naming(path),
        temporary.open("wb") as file,
        pq.ParquetWriter(file, tables[0].schema, write_page_checksum=True) as writer,
    ):
        for table in tables:
            writer.write_table(table)
    sync(temporary)
    temporary.replace(path)
    sync_folder(path.parent)


def sync(path: Path) -> None:
    """Wait until a file is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def place(source: Path, target: Path) -> None:
    """Give a file a second name, which replaces what is there; a copy where the file system has no such links."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists() and target.samefile(source):  # a rename of one name to another of the same file does nothing
        return
    temporary = target.with_name(target.name + ".tmp")
    temporary.unlink(missing_ok=True)
    try:
        os.link(source, temporary)
    except OSError:
        shutil.copyfile(source, temporary)
        sync(temporary)
    temporary.replace(target)
