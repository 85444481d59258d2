"""Episodes as a LeRobot dataset (format v3.0), written while a policy runs, for LIBERO and SIMPLER alike.

:class:`LeRobotWriter` is an episode recorder (``vecenv_eval.watch``): every tick's proprioception, action and images
come in; a folder that ``lerobot.datasets.LeRobotDataset(repo_id, root=folder)`` reads goes out. Frames hold
``observation.state``, ``action``, the images under the names LeRobot's own LIBERO datasets use, ``next.done`` and
``next.success``; each episode in ``meta/episodes`` also has ``success``, ``suite``, ``task_id`` and ``source_episode``.

Images are encoded as they come, in a file for each episode and camera; the rest is kept until 100 episodes have ended,
then written. So memory is bounded, and after a crash the dataset is whole and lacks the last episodes at most. Needs
``av`` and ``pyarrow``, both in the extra ``datasets``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vecenv.contract import ACTION_DIM
from vecenv.errors import InvalidFile, MissingDependency
from vecenv.observations import choose_cameras
from vecenv_eval.datasets.statistics import ImageCounts, Statistics, of_values, together
from vecenv_eval.episodes import Episode
from vecenv_eval.store import Record
from vecenv_eval.video.episodes import camera_images
from vecenv_eval.video.writer import VideoWriter
from vecenv_eval.watch import Observable

if TYPE_CHECKING:
    import pyarrow as pa

VERSION = "v3.0"
# Cameras -> features, as in LeRobot's own LIBERO datasets and environment.
IMAGE_KEYS = {"agentview": "observation.images.image", "wrist": "observation.images.image2"}
_KEY_OF_OTHERS = "observation.images.{}"
ACTION_NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
LIBERO_STATE_NAMES = ("x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right")
ROBOTS = {"simpler/bridge": "widowx", "simpler/google_robot": "google_robot"}
# Files in a folder; episodes that are kept before they are written; ticks between images whose values are counted.
CHUNK, FLUSH, COUNT_EVERY = 1000, 100, 4
_DATA, _EPISODES = "data/chunk-{0:03d}/file-{1:03d}.parquet", "meta/episodes/chunk-{0:03d}/file-{1:03d}.parquet"
_VIDEO = "videos/{key}/chunk-{0:03d}/file-{1:03d}.mp4"
_INFO, _STATS, _TASKS, _PARTIAL = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", ".partial"
_SCALARS = {"timestamp": "float32", **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")}


class DatasetError(InvalidFile):
    """A dataset cannot be continued, or an episode does not fit it."""


def image_keys(cameras: Sequence[str] = ()) -> dict[str, str]:
    """Camera -> feature: of these cameras, or of the two of LeRobot's own LIBERO datasets where none is named."""
    names = choose_cameras(cameras, list(dict.fromkeys((*IMAGE_KEYS, *cameras)))) if cameras else tuple(IMAGE_KEYS)
    return {name: IMAGE_KEYS.get(name, _KEY_OF_OTHERS.format(name)) for name in names}


@dataclass
class _Rollout:
    """What a slot has done so far."""

    states: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    videos: dict[str, VideoWriter] = field(default_factory=dict)
    counts: dict[str, ImageCounts] = field(default_factory=dict)


class LeRobotWriter:
    """An episode recorder that writes a LeRobot dataset; one that is there already is continued.

    Episodes that end in a fault or an error are left out.

    Args:
        root: the dataset's folder.
        image_keys: camera -> feature; cameras that an environment does not have are left out.

    Attributes:
        episodes: how many the dataset has, those not written yet included.

    Raises:
        DatasetError: there is something else at ``root``.
        MissingDependency: pyarrow is not installed.
    """

    def __init__(self, root: Path, image_keys: Mapping[str, str] = IMAGE_KEYS) -> None:
        try:
            import pyarrow  # noqa: F401 - fail before an episode has run
        except ImportError:
            raise MissingDependency("LeRobot datasets need pyarrow: pip install 'vecenv[datasets]'") from None
        self.root, self._image_keys = root, dict(image_keys)
        self._rollouts: dict[int, _Rollout] = {}
        self._rows: list[tuple[pa.Table, dict[str, Any]]] = []
        self._info, self._tasks, self._stats = _read(root)
        self.episodes, self._frames = self._info.get("total_episodes", 0), self._info.get("total_frames", 0)
        self._files = len(list(root.glob("data/*/*.parquet")))

    def begin(self, env: Observable, episodes: Mapping[int, Episode]) -> None:
        """Drop what there is of these slots: ticks of an episode that never finished."""
        for slot in episodes:
            rollout = self._rollouts.pop(slot, None)
            if rollout is not None:
                _discard(rollout)

    def observe(self, env: Observable, slots: Sequence[int], actions: np.ndarray) -> None:
        """Take down one tick of each slot.

        Raises:
            ImagesUnavailable: the environment has none of the cameras.
            DatasetError: the control rate is no whole number of ticks a second, or another than the dataset's.
        """
        if not len(slots):
            return
        seen, fps = env.observe_egocentric(slots), self._fps(env.control_hz)
        images = camera_images(seen, tuple(self._image_keys))
        for slot in slots:
            rollout = self._rollouts.setdefault(slot, _Rollout())
            for camera, batch in images.items():
                self._add_image(rollout, slot, self._image_keys[camera], batch[slot], fps)
            rollout.states.append(np.array(seen.state[slot], np.float32))
            rollout.actions.append(np.array(actions[slot], np.float32))

    def finish(self, env: Observable, records: Mapping[int, Record]) -> None:
        """Add the episodes that ended to the dataset.

        Args:
            env: the environment, of which nothing more is observed.
            records: how the episode in each slot ended.

        Raises:
            DatasetError: its state or its images have other shapes than the dataset's.
        """
        for slot, record in records.items():
            rollout = self._rollouts.pop(slot, None)
            if rollout is not None:
                self._add_episode(rollout, record)

    def _add_episode(self, rollout: _Rollout, record: Record) -> None:
        if record.fault or record.error:
            _discard(rollout)
            return
        for video in rollout.videos.values():
            video.close()
        self._check_features(_features(rollout, self._info["fps"]), record.key, ROBOTS.get(record.suite, "panda"))
        task = self._tasks.setdefault(record.instruction, len(self._tasks))
        videos = {key: video.path for key, video in rollout.videos.items()}
        about = {
            "tasks": [record.instruction],
            "success": bool(record.success),
            "suite": record.suite,
            "task_id": record.task,
            "source_episode": record.episode,
        }
        images = {key: counts.statistics() for key, counts in rollout.counts.items()}
        self._add(self._columns(rollout, record, task), images, videos, about)

    def _add(
        self,
        columns: Mapping[str, np.ndarray],
        images: Mapping[str, Statistics],
        videos: Mapping[str, Path],
        about: Mapping[str, Any],
    ) -> None:
        """Add an episode: its frames, the statistics of its images, its videos (which are moved), and what is told."""
        stats = {name: of_values(values) for name, values in columns.items()} | dict(images)
        self._stats = {
            name: together([self._stats[name], s] if name in self._stats else [s]) for name, s in stats.items()
        }
        ticks = len(columns["index"])
        self._rows.append((_table(columns), self._episode(ticks, stats, videos, about)))
        self.episodes, self._frames = self.episodes + 1, self._frames + ticks
        if len(self._rows) >= FLUSH:
            self.flush()

    def close(self) -> None:
        """Write what has ended, drop what has not. Closing twice is harmless."""
        for rollout in self._rollouts.values():
            for video in rollout.videos.values():
                video.close()
        self._rollouts.clear()
        self.flush()
        shutil.rmtree(self.root / _PARTIAL, ignore_errors=True)

    def flush(self) -> None:
        """Write the episodes that have ended: data first, what points to it last."""
        if not self._rows:
            return
        import pyarrow as pa
        import pyarrow.parquet as pq

        place = divmod(self._files, CHUNK)
        where = {"data/chunk_index": place[0], "data/file_index": place[1]}
        where |= {
            f"meta/episodes/{name}": index for name, index in zip(("chunk_index", "file_index"), place, strict=True)
        }
        data, episodes = self._parent(_DATA.format(*place)), self._parent(_EPISODES.format(*place))
        with pq.ParquetWriter(data, self._rows[0][0].schema) as writer:
            for table, _ in self._rows:
                writer.write_table(table)
        pq.write_table(pa.Table.from_pylist([row | where for _, row in self._rows]), episodes)
        pq.write_table(_tasks_table(self._tasks), self._parent(_TASKS))
        self._write_json(_STATS, {n: {k: v.tolist() for k, v in stats.items()} for n, stats in self._stats.items()})
        totals = {"total_episodes": self.episodes, "total_frames": self._frames, "total_tasks": len(self._tasks)}
        self._info |= totals | {"splits": {"train": f"0:{self.episodes}"}}
        self._write_json(_INFO, self._info)
        self._rows, self._files = [], self._files + 1

    def _fps(self, control_hz: float) -> int:
        known = self._info.get("fps", control_hz)
        if control_hz != int(control_hz) or control_hz != known:
            raise DatasetError(f"{self.root}: {control_hz} control ticks a second, where {known:g}, whole, are needed")
        return int(control_hz)

    def _add_image(self, rollout: _Rollout, slot: int, key: str, image: np.ndarray, fps: int) -> None:
        if key not in rollout.videos:
            # A key frame every other frame, as LeRobot has it: frames are read in random order.
            path = self.root / _PARTIAL / f"{slot}_{key}.mp4"
            rollout.videos[key] = VideoWriter(path, fps, keyframes=2)
            rollout.counts[key] = ImageCounts()
        if rollout.videos[key].frames % COUNT_EVERY == 0:
            rollout.counts[key].add(image)
        rollout.videos[key].add(image)
        self._info.setdefault("fps", fps)

    def _check_features(self, features: dict[str, dict[str, Any]], episode: Episode, robot: str) -> None:
        """Fix the features with the first episode; hold every other one against them."""
        known = self._info.setdefault("features", features)
        for name in features.keys() | known.keys():
            ours, theirs = features.get(name, {}).get("shape"), known.get(name, {}).get("shape")
            if ours != theirs:
                raise DatasetError(f"{self.root}: {name} of {episode.id} is {ours}, in the dataset it is {theirs}")
        if "codebase_version" not in self._info:
            self._info |= {
                "codebase_version": VERSION,
                "robot_type": robot,
                "chunks_size": CHUNK,
                "data_files_size_in_mb": 100,
                "video_files_size_in_mb": 200,
                "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
                "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
            }

    def _columns(self, rollout: _Rollout, record: Record, task: int) -> dict[str, np.ndarray]:
        """An episode's frames, by feature: [T, n] or [T]."""
        ticks = len(rollout.actions)
        last = np.arange(ticks) == ticks - 1
        return {
            "observation.state": np.stack(rollout.states),
            "action": np.stack(rollout.actions),
            "next.done": last,
            "next.success": last & bool(record.success),
            "timestamp": (np.arange(ticks) / self._info["fps"]).astype(np.float32),
            "frame_index": np.arange(ticks),
            **self._indices(ticks, task),
        }

    def _indices(self, ticks: int, task: int) -> dict[str, np.ndarray]:
        """The columns that depend on what the dataset holds already, [T] each."""
        return {
            "episode_index": np.full(ticks, self.episodes),
            "index": np.arange(self._frames, self._frames + ticks),
            "task_index": np.full(ticks, task),
        }

    def _episode(
        self, ticks: int, stats: Mapping[str, Statistics], videos: Mapping[str, Path], about: Mapping[str, Any]
    ) -> dict[str, Any]:
        """The row of an episode in ``meta/episodes``; its videos move to their places."""
        row: dict[str, Any] = {
            "episode_index": self.episodes,
            "tasks": about["tasks"],
            "length": ticks,
            **{name: value for name, value in about.items() if name != "tasks"},
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + ticks,
        }
        chunk, file = divmod(self.episodes, CHUNK)
        for key, video in videos.items():
            video.replace(self._parent(_VIDEO.format(chunk, file, key=key)))
            row |= {f"videos/{key}/chunk_index": chunk, f"videos/{key}/file_index": file}
            row |= {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": ticks / self._info["fps"]}
        for name, found in stats.items():
            row |= {f"stats/{name}/{which}": value.tolist() for which, value in found.items()}
        return row

    def _parent(self, name: str) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _write_json(self, name: str, content: Mapping[str, Any]) -> None:
        path = self._parent(name)
        temporary = path.with_suffix(".tmp")
        temporary.write_text(json.dumps(content, indent=4) + "\n")
        temporary.replace(path)


def _read(root: Path) -> tuple[dict[str, Any], dict[str, int], dict[str, Statistics]]:
    """Info, tasks and statistics of the dataset at ``root``; empty where there is none yet."""
    if not root.exists() or not any(root.iterdir()):
        return {}, {}, {}
    import pyarrow.parquet as pq

    try:
        info = json.loads((root / _INFO).read_text())
        if info["codebase_version"] != VERSION:
            raise DatasetError(f"{root} is a LeRobot dataset of format {info['codebase_version']}, not {VERSION}")
        tasks = pq.read_table(root / _TASKS).to_pydict()
        stats = json.loads((root / _STATS).read_text())
        return (
            info,
            dict(zip(tasks["task"], tasks["task_index"], strict=True)),
            {name: {k: np.array(v) for k, v in each.items()} for name, each in stats.items()},
        )
    except DatasetError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{root} holds something other than a LeRobot dataset: {error}") from None


def _discard(rollout: _Rollout) -> None:
    for video in rollout.videos.values():
        video.close()
        video.path.unlink()


def _features(rollout: _Rollout, fps: int) -> dict[str, dict[str, Any]]:
    """The features of ``meta/info.json`` that an episode has."""
    width = len(rollout.states[0])
    names = LIBERO_STATE_NAMES if width == len(LIBERO_STATE_NAMES) else [f"state_{i}" for i in range(width)]
    found: dict[str, dict[str, Any]] = {
        "observation.state": {"dtype": "float32", "shape": [width], "names": list(names)},
        "action": {"dtype": "float32", "shape": [ACTION_DIM], "names": list(ACTION_NAMES)},
    }
    for key, video in rollout.videos.items():
        info = {"video.height": video.height, "video.width": video.width, "video.codec": "h264"}
        info |= {"video.pix_fmt": "yuv420p", "video.fps": fps, "video.channels": 3}
        info |= {"has_audio": False, "is_depth_map": False}
        shape = [video.height, video.width, 3]
        found[key] = {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"], "info": info}
    scalars = {"next.done": "bool", "next.success": "bool", **_SCALARS}
    return found | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in scalars.items()}


def _table(columns: Mapping[str, np.ndarray]) -> pa.Table:
    """An episode's frames; vectors as lists of a fixed length."""
    import pyarrow as pa

    arrays = {
        name: pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])
        if values.ndim == 2
        else pa.array(values)
        for name, values in columns.items()
    }
    return pa.table(arrays)


def _tasks_table(tasks: Mapping[str, int]) -> pa.Table:
    """Instructions and their indices, such that pandas takes the instructions for the index, as LeRobot expects."""
    import pyarrow as pa

    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
        for name, kind, dtype in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    about = {"index_columns": ["task"], "column_indexes": [], "columns": described, "pandas_version": "2.0.0"}
    table = pa.table({"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(about)})
