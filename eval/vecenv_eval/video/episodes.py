"""A video of each episode of an evaluation: one mp4, third-person and wrist camera side by side.

A results folder and what to keep come in; ``videos/{suite}_{task}_{episode}.mp4`` go out. Frames are encoded as they
come, so memory does not grow with the length of an episode: an encoder takes about 5 MB for two images of 256 x 256.
:class:`EpisodeVideos` is an episode recorder (``vecenv_eval.watch``)::

    videos = EpisodeVideos(folder, keep="failures")
    videos.begin(env, {slot: episode})
    with watching(env, [videos]):
        ...  # whenever the episode in a slot ends, and before the slot is placed anew:
        videos.finish(env, {slot: record})
    videos.close()
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from vecenv.observations import Egocentric, ImagesUnavailable, Rendered
from vecenv_eval.config import VIDEO_CHOICES
from vecenv_eval.episodes import Episode
from vecenv_eval.store import Record
from vecenv_eval.video.writer import VideoWriter
from vecenv_eval.watch import Observable

VIDEOS = "videos"
# What ``vecenv eval --video`` takes.
NONE, FAILURES, ALL = VIDEO_CHOICES
CAMERAS = ("agentview", "wrist")
_PARTIAL = ".partial"
# Good enough to see what went wrong: 5 s of two images of 256 x 256 take about 0.4 MB.
_CRF = 23


def video_path(folder: Path, episode: Episode) -> Path:
    """Where the video of an episode goes: ``folder/videos/{suite}_{task}_{episode}.mp4``; ``/`` becomes ``-``."""
    suite = re.sub(r"[^\w.-]+", "-", episode.suite)
    return folder / VIDEOS / f"{suite}_{episode.task}_{episode.episode}.mp4"


class EpisodeVideos:
    """An episode recorder that writes one mp4 an episode.

    Args:
        folder: the results folder.
        keep: ``"all"``, or ``"failures"``: episodes that were not solved, ended in a fault or in an error.
        cameras: shown side by side; those that an environment does not have are left out.
    """

    def __init__(self, folder: Path, keep: str = FAILURES, cameras: Sequence[str] = CAMERAS) -> None:
        self._folder, self._keep, self._cameras = folder, keep, tuple(cameras)
        self._open: dict[int, VideoWriter] = {}

    def begin(self, env: Observable, episodes: Mapping[int, Episode]) -> None:
        """Drop what there is of these slots: a video of an episode that never finished."""
        for slot in episodes:
            if slot in self._open:
                self._drop(slot)

    def observe(self, env: Observable, slots: Sequence[int], actions: np.ndarray | None = None) -> None:
        """Add a frame for each slot.

        Raises:
            ImagesUnavailable: the environment has none of the cameras.
            RenderError: PyAV is not installed.
        """
        if not len(slots):
            return
        images = camera_images(env.observe_egocentric(slots), self._cameras)
        for slot in slots:
            if slot not in self._open:
                self._open[slot] = VideoWriter(self._partial / f"{slot}.mp4", env.control_hz, crf=_CRF)
            self._open[slot].add(side_by_side([of_camera[slot] for of_camera in images.values()]))

    def finish(self, env: Observable, records: Mapping[int, Record]) -> None:
        """Keep the videos of the episodes that ended, or drop them; the last frame of each shows its end.

        Args:
            env: the environment, in which the slots still show the end.
            records: how the episode in each slot ended; a slot without any observation is passed over.
        """
        ended = {slot: record for slot, record in records.items() if slot in self._open}
        kept = {
            slot: record
            for slot, record in ended.items()
            if self._keep == ALL or not record.success or bool(record.error)
        }
        self.observe(env, list(kept))
        for slot, record in kept.items():
            video = self._open.pop(slot)
            video.close()
            video.path.replace(video_path(self._folder, record.key))
        for slot in ended.keys() - kept.keys():
            self._drop(slot)

    def close(self) -> None:
        """Drop the videos of episodes that have not finished."""
        for video in self._open.values():
            video.close()
        self._open.clear()
        shutil.rmtree(self._partial, ignore_errors=True)

    def _drop(self, slot: int) -> None:
        video = self._open.pop(slot)
        video.close()
        video.path.unlink(missing_ok=True)

    @property
    def _partial(self) -> Path:
        return self._folder / VIDEOS / _PARTIAL


def camera_images(seen: Egocentric, cameras: Sequence[str]) -> dict[str, np.ndarray]:
    """The images of those cameras that there are, by name, uint8 [B, H, W, 3] each.

    Raises:
        ImagesUnavailable: there is none of them.
    """
    names = [name for name in cameras if name in seen.images]
    if not names:
        there = f"there are: {', '.join(seen.images)}" if seen.images else "this environment renders nothing"
        raise ImagesUnavailable(f"no image of {' or '.join(cameras)}: {there}")
    if isinstance(seen.images, Rendered):
        seen.images.prepare(*names)
    return {name: seen.images[name] for name in names}


def side_by_side(images: Sequence[np.ndarray]) -> np.ndarray:
    """Images [H, W, 3] in a row, lower ones filled up with black."""
    height = max(image.shape[0] for image in images)
    return np.concatenate([np.pad(image, ((0, height - len(image)), (0, 0), (0, 0))) for image in images], axis=1)
