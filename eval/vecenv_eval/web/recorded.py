"""What was recorded of one episode: its video, actions and states, and what its policy noted.

An episode's leg and record come in. Files are found by the names that the recorders give them, and read only where they
lie in the results folder; nothing is trusted (``demos.hdf5``). What cannot be read is a sentence.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from vecenv.errors import InvalidInput, NotFound
from vecenv_eval.config import EvalConfig
from vecenv_eval.episodes import Episode
from vecenv_eval.store import ResultStore, log_path
from vecenv_eval.video.episodes import CAMERAS, video_path
from vecenv_eval.video.reader import VideoFileError, VideoReader, opened, sentence
from vecenv_eval.web.rows import UnsafePath, regular_file
from vecenv_eval.web.runs import Leg

# Every camera of a video, as it was written.
WHOLE = "all"
# Most points of a curve, and of what a policy noted, lines and characters.
MOST_POINTS, MOST_LINES, MOST_TEXT = 2_000, 500, 400_000
ACTION_NAMES = ("x", "y", "z", "rx", "ry", "rz", "gripper")
# Joints of the robot, which come first in a state: LIBERO's arm and fingers, SIMPLER's robots.
_JOINTS = {"libero": 9, "simpler/bridge": 8, "simpler/google_robot": 11}
_KEPT = 8
_Value = TypeVar("_Value")


class Unreadable(InvalidInput):
    """A recording that cannot be used; the message says why."""


@dataclass(frozen=True, kw_only=True)
class VideoFacts:
    """A recorded video.

    Attributes:
        path: the file.
        frames: how many; frame i shows the state before tick i, the last one the end.
        fps: control ticks a second.
        width, height: pixels.
        cameras: those side by side in it, () where that is not known.
    """

    path: Path
    frames: int
    fps: float
    width: int
    height: int
    cameras: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class DemoFacts:
    """A recording of actions, perhaps with states.

    Attributes:
        demo: the recording (``vecenv_eval.demos.schema.Demo``).
        actions: [T, 7].
        joints: the robot's joint positions before each action, [T, J]; None without recorded states.
    """

    demo: Any
    actions: np.ndarray
    joints: np.ndarray | None


class Kept:
    """A few values by file and by when it was written; a file that is replaced is read again. Safe for threads."""

    def __init__(self, size: int = _KEPT) -> None:
        self._size, self._lock = size, threading.Lock()
        self._values: OrderedDict[Any, Any] = OrderedDict()

    def get(self, path: Path, what: Any, make: Callable[[], _Value]) -> _Value:
        """The value of a file, made when the file is new."""
        about = path.stat()
        key = (path, about.st_ino, about.st_mtime_ns, about.st_size, what)
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        value = make()
        with self._lock:
            self._values[key] = value
            while len(self._values) > self._size:
                self._values.popitem(last=False)
        return value


class Recordings:
    """What there is of the episodes of a leg; keeps a few files that were read."""

    def __init__(self) -> None:
        self._videos, self._demos = Kept(64), Kept()

    def video(self, leg: Leg, episode: Episode) -> VideoFacts | None:
        """The video of an episode, None where there is none.

        Raises:
            Unreadable: it is damaged, or no file of the folder.
        """
        path = self._file(leg, lambda folder: video_path(folder, episode))
        return path and self._videos.get(path, None, lambda: _video_facts(path, _cameras_of(leg)))

    def demo(self, leg: Leg, episode: Episode) -> DemoFacts | None:
        """The recorded actions of an episode, and its states; None where there are none.

        Raises:
            Unreadable: they are damaged.
        """
        path = self._file(leg, lambda folder: ResultStore(folder).demos_path(episode.suite, episode.task))
        return path and self._demos.get(path, episode, lambda: _demo_facts(path, episode))

    def log(self, leg: Leg, episode: Episode) -> tuple[list[Any], bool] | None:
        """What the policy noted, one JSON value a line, and whether that is all; None where there is nothing.

        Raises:
            Unreadable: it is no file of the folder.
        """
        path = self._file(leg, lambda folder: log_path(folder, episode))
        return path and _log_lines(path)

    def has(self, leg: Leg, episode: Episode) -> dict[str, bool]:
        """Which files there are, without a look into them."""
        names = {
            "video": lambda folder: video_path(folder, episode),
            "demo": lambda folder: ResultStore(folder).demos_path(episode.suite, episode.task),
            "log": lambda folder: log_path(folder, episode),
        }
        return {name: any(place(folder).is_file() for folder in leg.folders) for name, place in names.items()}

    def _file(self, leg: Leg, place: Callable[[Path], Path]) -> Path | None:
        for folder in leg.folders:
            try:
                path = regular_file(folder, place(folder).relative_to(folder).as_posix())
            except UnsafePath as error:
                raise Unreadable(str(error)) from None
            if path is not None:
                return path
        return None


def _cameras_of(leg: Leg) -> tuple[str, ...]:
    """The cameras that the recorder was asked for."""
    settings = leg.config.get("config")
    try:
        return EvalConfig.from_dict(settings).camera_names or CAMERAS if isinstance(settings, Mapping) else CAMERAS
    except (ValueError, TypeError):
        return CAMERAS


# -- videos ------------------------------------------------------------------------------------------------------------


def _video_facts(path: Path, cameras: Sequence[str]) -> VideoFacts:
    try:
        with VideoReader(path) as video:
            frames, fps, width, height = video.frames, video.fps, video.width, video.height
    except VideoFileError as error:
        raise Unreadable(str(error)) from None
    # Images are square and of one size unless a camera was left out; then nobody knows which is which.
    known = len(cameras) > 1 and width == height * len(cameras)
    return VideoFacts(
        path=path, frames=frames, fps=fps, width=width, height=height, cameras=tuple(cameras) if known else ()
    )


def video_frame(video: VideoFacts, tick: int, camera: str = WHOLE) -> np.ndarray:
    """The image before a tick, uint8 [H, W, 3]; beyond the end the last one.

    Raises:
        NotFound: the video does not have the camera.
        Unreadable: it is damaged.
    """
    if camera != WHOLE and camera not in video.cameras:
        raise NotFound(f"the video has no camera {camera!r:.50}; it shows {', '.join((WHOLE, *video.cameras))}")
    image = _decoded(video, min(tick, video.frames - 1))
    if camera == WHOLE:
        return image
    width = image.shape[1] // len(video.cameras)
    at = video.cameras.index(camera)
    return image[:, at * width : (at + 1) * width]


def _decoded(video: VideoFacts, number: int) -> np.ndarray:
    from av.error import FFmpegError

    try:
        with opened(video.path) as container:
            stream = container.streams.video[0]
            assert stream.time_base is not None
            wanted = round(number / video.fps / stream.time_base)
            container.seek(wanted, stream=stream)
            last = None
            for frame in container.decode(stream):
                last = frame
                if frame.pts is not None and frame.pts >= wanted:
                    break
            if last is not None:
                return last.to_ndarray(format="rgb24")
    except (FFmpegError, ValueError, OSError) as error:
        raise Unreadable(sentence(video.path, error)) from None
    raise Unreadable(f"{video.path.name} has no frame {number}")


# -- actions, states, notes --------------------------------------------------------------------------------------------


def _demo_facts(path: Path, episode: Episode) -> DemoFacts | None:
    import h5py

    from vecenv_eval.demos.hdf5 import DemoError, Errors, Opened, member, states_dataset
    from vecenv_eval.demos.read import read_demos

    try:
        demos, bad = read_demos(path)
        found = next((demo for demo in demos if demo.key == episode), None)
        if found is None:
            damaged = next((each for each in bad if each.name == f"demo_{episode.episode}"), None)
            if damaged is not None:
                raise Unreadable(f"{path.name}: {damaged.name}: {damaged.reason}")
            return None
        joints = None
        with Opened(path) as file, Errors(path, found.name):
            group = member(member(file, "data", h5py.Group), found.name, h5py.Group)
            if "states" in group:
                states = states_dataset(group, len(found))
                count = _JOINTS.get(episode.suite, _JOINTS["libero"])
                joints = np.asarray(states[:, 1 : 1 + count], float)
        return DemoFacts(demo=found, actions=found.actions, joints=joints)
    except DemoError as error:
        raise Unreadable(str(error).replace(str(path), path.name)) from None


def curves(demo: DemoFacts) -> dict[str, Any]:
    """Actions and joint positions over ticks, thinned out where there are very many."""
    ticks = np.arange(0, len(demo.actions), -(-len(demo.actions) // MOST_POINTS))
    joints = None if demo.joints is None else np.nan_to_num(demo.joints[ticks]).round(5)
    return {
        "ticks": ticks.tolist(),
        "actions": {name: demo.actions[ticks, i].round(5).tolist() for i, name in enumerate(ACTION_NAMES)},
        "joints": {} if joints is None else {f"joint {i + 1}": joints[:, i].tolist() for i in range(joints.shape[1])},
    }


def _log_lines(path: Path) -> tuple[list[Any], bool]:
    with path.open("rb") as file:
        content = file.read(MOST_TEXT)
        whole = not file.read(1)
    *lines, rest = content.decode("utf-8", "replace").split("\n")
    found: list[Any] = []
    for line in lines[:MOST_LINES] if whole or lines else [rest]:
        try:
            found.append(json.loads(line))
        except (ValueError, RecursionError):
            found.append(line)
    return found, whole and len(lines) <= MOST_LINES
