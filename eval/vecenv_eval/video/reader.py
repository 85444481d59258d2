"""Reading a recorded video frame after frame.

The path of an mp4 comes in, perhaps of a stranger's results folder; images go out, scaled if asked for. What cannot be
read is one sentence that names the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from vecenv.errors import InvalidFile, MissingDependency

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer

# Longest side of a video's images, pixels.
LARGEST = 8192


class VideoFileError(InvalidFile):
    """A recorded video cannot be read; the message names the file and says why."""


class VideoReader:
    """An mp4, read forwards; a context manager.

    Args:
        path: the file.

    Attributes:
        frames: how many it says it has, at least 1.
        fps: frames a second.
        height, width: of an image, pixels.

    Raises:
        VideoFileError: it is no such file, it is damaged, or its images are larger than `LARGEST`.
        MissingDependency: PyAV is not installed.
    """

    def __init__(self, path: Path) -> None:
        try:
            from av.error import FFmpegError
        except ImportError:
            raise MissingDependency("reading videos needs PyAV: pip install 'vecenv[render]'") from None
        self.path, self._errors = path, (FFmpegError, IndexError, ValueError, OSError)
        try:
            self._container = opened(path)
        except self._errors as error:
            raise VideoFileError(sentence(path, error)) from None
        try:
            self._decoded = self._checked()
        except BaseException:
            self._container.close()
            raise
        self._at = -1
        self._frame: VideoFrame | None = None

    def _checked(self) -> Iterator[VideoFrame]:
        """Note what the file says about itself, and return its frames, of which none has been decoded yet."""
        try:
            stream = self._container.streams.video[0]
            self.frames, rate = stream.frames, stream.average_rate
            self.height, self.width = stream.height, stream.width
        except self._errors as error:
            raise VideoFileError(sentence(self.path, error)) from None
        if not (self.frames and rate and self.width and self.height):
            raise VideoFileError(f"{self.path.name} cannot be played: it holds no frames")
        if max(self.width, self.height) > LARGEST:
            size = f"{self.width} x {self.height} pixels"
            raise VideoFileError(f"{self.path.name} cannot be played: its images are {size}")
        self.fps = float(rate)
        stream.codec_context.thread_count = 1
        return self._container.decode(stream)

    def image(self, number: int, height: int | None = None) -> np.ndarray:
        """A frame, uint8 [H, W, 3], beyond the end the last one; its number may not be below the one asked for before.

        Args:
            number: which, from 0.
            height: pixels to scale to, with the same proportions; None for those of the file.

        Raises:
            VideoFileError: the file is damaged, or ends before it says it does.
        """
        number = min(number, self.frames - 1)
        if number < self._at:
            raise ValueError(f"frame {number} was asked for after frame {self._at}")
        try:
            while self._at < number:
                self._frame = next(self._decoded)
                self._at += 1
        except StopIteration:
            raise VideoFileError(f"{self.path.name} ends after {self._at + 1} of {self.frames} frames") from None
        except self._errors as error:
            raise VideoFileError(sentence(self.path, error)) from None
        assert self._frame is not None
        return _scaled(self._frame, height)

    def close(self) -> None:
        """Close the file. Closing twice is harmless."""
        self._container.close()

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def scaled_width(height: int, width: int, to: int) -> int:
    """The width of an image that is scaled to a height, pixels."""
    return max(1, round(width * to / height))


def opened(path: Path) -> InputContainer:
    """A video file, read as an mp4 whatever it claims to be: other formats may name further files."""
    import av

    return av.open(str(path), format="mp4", options={"protocol_whitelist": "file"})


def sentence(path: Path, error: Exception) -> str:
    """Why a file cannot be played, without the folder that it is in."""
    reason = " ".join(str(error).split()).replace(str(path), path.name)
    return f"{path.name} cannot be played: {reason[:200]}"


def _scaled(frame: VideoFrame, height: int | None) -> np.ndarray:
    if height in (None, frame.height):
        return frame.to_ndarray(format="rgb24")
    width = scaled_width(frame.height, frame.width, height)
    return frame.reformat(width=width, height=height, format="rgb24", interpolation="AREA").to_ndarray()
