"""Episodes as a LeRobot dataset (format v3.0), written while a policy runs, for LIBERO and SIMPLER alike.

:class:`LeRobotWriter` is an episode recorder (``vecenv_eval.watch``): every tick's proprioception, action and images
come in; a folder that ``lerobot.datasets.LeRobotDataset(repo_id, root=folder)`` reads goes out. Frames hold
``observation.state``, ``action``, the images under the names LeRobot's own LIBERO datasets use, ``next.done`` and
``next.success``; each episode in ``meta/episodes`` also has ``success``, ``suite``, ``task_id`` and ``source_episode``.

Images are encoded as they come, in a file for each episode and camera. An episode is on the disk when ``finish``
returns, in a folder of its own (``waiting``); 100 of them at a time are written to the dataset's files, so memory is
bounded. After a crash, a writer takes up what waited. Needs ``av`` and ``pyarrow``, both in the extra ``datasets``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vecenv.contract import ACTION_DIM
from vecenv.errors import MissingDependency
from vecenv.observations import choose_cameras
from vecenv_eval.datasets import files, waiting
from vecenv_eval.datasets.files import CHUNK, DATA, EPISODES, INFO, STATS, TASKS, VERSION, VIDEO
from vecenv_eval.datasets.statistics import ImageCounts, Statistics, of_values, together
from vecenv_eval.datasets.waiting import PARTIAL, DatasetError, Waiting
from vecenv_eval.episodes import Episode
from vecenv_eval.store import Record
from vecenv_eval.store.files import replace_text
from vecenv_eval.video.episodes import camera_images
from vecenv_eval.video.writer import VideoWriter
from vecenv_eval.watch import Observable

if TYPE_CHECKING:
    import pyarrow as pa

# Cameras -> features, as in LeRobot's own LIBERO datasets and environment.
IMAGE_KEYS = {"agentview": "observation.images.image", "wrist": "observation.images.image2"}
_KEY_OF_OTHERS = "observation.images.{}"
ACTION_NAMES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
LIBERO_STATE_NAMES = ("x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right")
ROBOTS = {"simpler/bridge": "widowx", "simpler/google_robot": "google_robot"}
# Episodes that wait before they are written to the dataset's files; ticks between images whose values are counted.
FLUSH, COUNT_EVERY = 100, 4


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
        verdicts: of an evaluation, gives the episodes that have a verdict on the disk. With it, an episode is in the
            dataset once, and only with its verdict: what a killed process recorded without one is dropped.

    Raises:
        DatasetError: there is something else at ``root``, it is damaged, or an episode in it has no verdict.
        MissingDependency: pyarrow is not installed.
    """

    def __init__(
        self,
        root: Path,
        image_keys: Mapping[str, str] = IMAGE_KEYS,
        verdicts: Callable[[], Collection[Episode]] | None = None,
    ) -> None:
        try:
            import pyarrow  # noqa: F401 - fail before an episode has run
        except ImportError:
            raise MissingDependency("LeRobot datasets need pyarrow: pip install 'vecenv[datasets]'") from None
        self.root, self._image_keys = root, dict(image_keys)
        self._rollouts: dict[int, _Rollout] = {}
        self._verdicts = verdicts
        there = files.open_to_write(root)
        self._info: dict[str, Any] = dict(there.info)
        self._tasks, self._stats, self._files = there.tasks, there.stats, there.files
        self._written = there.keys
        self._waiting = self._take_up()

    @property
    def episodes(self) -> int:
        """How many the dataset has, those that wait included."""
        return self._total + len(self._waiting)

    @property
    def keys(self) -> frozenset[Episode]:
        """Which episodes the dataset has, those that wait included."""
        return frozenset((*self._written, *(each.key for each in self._waiting)))

    @property
    def _total(self) -> int:
        """Episodes in the dataset's files."""
        return self._info.get("total_episodes", 0)

    def _take_up(self) -> list[Waiting]:
        """The episodes that wait since a process was killed; those that have no verdict are dropped."""
        shutil.rmtree(self.root / PARTIAL, ignore_errors=True)
        done = None if self._verdicts is None else frozenset(self._verdicts())
        if done is not None and (strangers := sorted(frozenset(self._written) - done)):
            raise DatasetError(
                f"{self.root} holds {strangers[0].id}, which has no verdict in these results: if they were merged, "
                "merge them again, else move the dataset away"
            )
        kept: dict[Episode | int, Waiting] = {}
        for folder in waiting.folders(self.root):
            if int(folder.name) < self._total:
                waiting.remove(folder)  # it is in the files: the process was killed before it could tidy up
                continue
            each = waiting.load(folder)
            if done is not None and each.key not in done:
                waiting.remove(folder)
                continue
            name = len(kept) if done is None else each.key
            if name in kept:
                waiting.remove(kept[name].folder)
            kept[name] = each
        found = list(kept.values())
        if found and "fps" not in self._info:
            self._info |= dict(found[0].info)
        for each in found:
            self._check_features(dict(each.info["features"]), each.key, each.info["robot_type"])
        return waiting.renumber(found, [], self._total)[0] if found else []

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
        videos = {key: video.path for key, video in rollout.videos.items()}
        about = {
            "tasks": [record.instruction],
            "success": bool(record.success),
            "suite": record.suite,
            "task_id": record.task,
            "source_episode": record.episode,
        }
        images = {key: counts.statistics() for key, counts in rollout.counts.items()}
        self._add(self._columns(rollout, record), images, videos, about)

    def _add(
        self,
        columns: Mapping[str, np.ndarray],
        images: Mapping[str, Statistics],
        videos: Mapping[str, Path],
        about: Mapping[str, Any],
    ) -> None:
        """Add an episode: its frames, the statistics of its images, its videos (which are moved), and what is told."""
        if len(self._waiting) >= FLUSH:
            self.flush()
        number, info = self.episodes, {name: self._info[name] for name in self._info if name not in files.TOTALS}
        key = Episode(about["suite"], about["task_id"], about["source_episode"])
        if self._verdicts is not None:  # of an episode that ended in an error after it was recorded, the new recording
            for index, each in enumerate(self._waiting):
                if each.key == key:
                    self._waiting[index] = waiting.save(self.root, each.number, columns, images, videos, about, info)
                    return
        self._waiting.append(waiting.save(self.root, number, columns, images, videos, about, info))

    def close(self) -> None:
        """Write what has ended to the dataset's files, drop what has not. Closing twice is harmless."""
        try:
            for rollout in self._rollouts.values():
                for video in rollout.videos.values():
                    video.close()
        finally:
            self._rollouts.clear()
            self.flush()
            for folder in (PARTIAL, *([] if self._waiting else [waiting.PENDING])):
                shutil.rmtree(self.root / folder, ignore_errors=True)

    def flush(self) -> None:
        """Write the episodes that wait to the dataset's files: data first, what counts them last.

        Of an evaluation, only those that have a verdict.
        """
        done = None if self._verdicts is None or not self._waiting else frozenset(self._verdicts())
        ready = [each for each in self._waiting if done is None or each.key in done]
        if not ready:
            return
        ready, rest = waiting.renumber(ready, [each for each in self._waiting if each not in ready], self._total)
        self._waiting = [*ready, *rest]
        place = divmod(self._files, CHUNK)
        tasks, frames = dict(self._tasks), self._info.get("total_frames", 0)
        stats, rows, tables = dict(self._stats), [], []
        for each in ready:
            task = tasks.setdefault(each.about["tasks"][0], len(tasks))
            columns = {**each.columns, **self._indices(each, frames, task)}
            own = {name: of_values(values) for name, values in columns.items()} | dict(each.images)
            stats |= {name: together([stats[name], s] if name in stats else [s]) for name, s in own.items()}
            rows.append(self._row(each, frames, own, place))
            tables.append(waiting.table_of(columns))
            frames += len(each)
        import pyarrow as pa

        waiting.write_parquet(self._parent(DATA.format(*place)), tables)
        waiting.write_parquet(self._parent(EPISODES.format(*place)), [pa.Table.from_pylist(rows)])
        waiting.write_parquet(self._parent(TASKS), [_tasks_table(tasks)])
        self._write_json(STATS, {n: {k: v.tolist() for k, v in found.items()} for n, found in stats.items()})
        total = self._total + len(ready)
        totals = {"total_episodes": total, "total_frames": frames, "total_tasks": len(tasks)}
        info: dict[str, Any] = {**self._info, **totals, "splits": {"train": f"0:{total}"}}
        self._write_json(INFO, info)
        self._info, self._tasks, self._stats, self._files = info, tasks, stats, self._files + 1
        self._written = (*self._written, *(each.key for each in ready))
        self._waiting = rest
        for each in ready:
            waiting.remove(each.folder)

    def _fps(self, control_hz: float) -> int:
        known = self._info.get("fps", control_hz)
        if control_hz != int(control_hz) or control_hz != known:
            raise DatasetError(f"{self.root}: {control_hz} control ticks a second, where {known:g}, whole, are needed")
        return int(control_hz)

    def _add_image(self, rollout: _Rollout, slot: int, key: str, image: np.ndarray, fps: int) -> None:
        if key not in rollout.videos:
            # A key frame every other frame, as LeRobot has it: frames are read in random order.
            path = self.root / PARTIAL / f"{slot}_{key}.mp4"
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

    def _columns(self, rollout: _Rollout, record: Record) -> dict[str, np.ndarray]:
        """An episode's frames, by feature, without the indices in the dataset: [T, n] or [T]."""
        ticks = len(rollout.actions)
        last = np.arange(ticks) == ticks - 1
        return {
            "observation.state": np.stack(rollout.states),
            "action": np.stack(rollout.actions),
            "next.done": last,
            "next.success": last & bool(record.success),
            "timestamp": (np.arange(ticks) / self._info["fps"]).astype(np.float32),
            "frame_index": np.arange(ticks),
        }

    def _indices(self, episode: Waiting, start: int, task: int) -> dict[str, np.ndarray]:
        """The columns that depend on what the dataset holds already, [T] each; ``start`` is its first frame."""
        ticks = len(episode)
        return {
            "episode_index": np.full(ticks, episode.number),
            "index": np.arange(start, start + ticks),
            "task_index": np.full(ticks, task),
        }

    def _row(
        self, episode: Waiting, start: int, stats: Mapping[str, Statistics], place: tuple[int, int]
    ) -> dict[str, Any]:
        """The row of an episode in ``meta/episodes``; its videos get their places."""
        ticks = len(episode)
        row: dict[str, Any] = {
            "episode_index": episode.number,
            "tasks": episode.about["tasks"],
            "length": ticks,
            **{name: value for name, value in episode.about.items() if name != "tasks"},
            "dataset_from_index": start,
            "dataset_to_index": start + ticks,
        }
        chunk, file = divmod(episode.number, CHUNK)
        for key in waiting.cameras_of(self._info):
            waiting.place(episode.video(key), self.root / VIDEO.format(chunk, file, key=key))
            row |= {f"videos/{key}/chunk_index": chunk, f"videos/{key}/file_index": file}
            row |= {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": ticks / self._info["fps"]}
        for name, found in stats.items():
            row |= {f"stats/{name}/{which}": value.tolist() for which, value in found.items()}
        for name, index in zip(("chunk_index", "file_index"), place, strict=True):
            row |= {f"data/{name}": index, f"meta/episodes/{name}": index}
        return row

    def _parent(self, name: str) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _write_json(self, name: str, content: Mapping[str, Any]) -> None:
        replace_text(self._parent(name), json.dumps(content, indent=4) + "\n")


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
    scalars = {"next.done": "bool", "next.success": "bool", **waiting.SCALARS}
    return found | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in scalars.items()}


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
