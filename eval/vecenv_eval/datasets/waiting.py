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
from vecenv_eval.datasets.statistics import Statistics
from vecenv_eval.episodes import Episode
from vecenv_eval.store.files import replace_bytes, sync_folder

if TYPE_CHECKING:
    import pyarrow as pa

PENDING, PARTIAL = ".pending", ".partial"
_FRAMES, _ABOUT = "frames.parquet", "about.json"
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

    from vecenv_eval.store.files import read_json

    try:
        content, table = read_json(folder / _ABOUT), pq.read_table(folder / _FRAMES)
        return Waiting(
            folder=folder,
            key=_key(content["about"]),
            columns={name: array_of(table, name) for name in table.column_names},
            images={
                name: {k: np.array(v) for k, v in found.items()} for name, found in dict(content["images"]).items()
            },
            about=dict(content["about"]),
            info=dict(content["info"]),
        )
    except FileNotFoundError:
        raise
    except (*DAMAGE, InvalidFile) as error:
        raise DatasetError(f"{folder} is damaged: {type(error).__name__}: {' '.join(str(error).split())}") from None


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
    with temporary.open("wb") as file, pq.ParquetWriter(file, tables[0].schema) as writer:
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
    temporary = target.with_name(target.name + ".tmp")
    temporary.unlink(missing_ok=True)
    try:
        os.link(source, temporary)
    except OSError:
        shutil.copyfile(source, temporary)
        sync(temporary)
    temporary.replace(target)
