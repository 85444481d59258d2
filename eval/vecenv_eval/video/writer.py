"""Writing frames to an mp4 or an animated WebP, and recording a batch while it runs.

In: frames [H, W, 3], or a live environment. Out: an H.264 file that any player and browser opens, or an image that
browsers play in a loop wherever a page shows images. Frames are encoded as they come, in this process. Needs ``av`` and
``pillow``, both in the extra ``render``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from vecenv.contract import Metrics, ResetInfo
from vecenv.libero.render.options import RenderError
from vecenv.observations import Egocentric, Rendered
from vecenv_eval.video.grid import GAP, render_grid

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

# LIBERO's control steps per second: a video at this rate runs as fast as the robot.
CONTROL_HZ = 20
# No frame depends on a later one. Two images of 256 x 256 take 6 ms on a busy core; "veryfast"
# takes half as long again for the same size, "ultrafast" two thirds for twice the size.
_H264 = {"preset": "superfast", "bf": "0", "rc-lookahead": "0"}
# WebP: how thoroughly it searches for a smaller file, 0 to 6.
WEBP_QUALITY, _WEBP = 60, {"compression_level": "4"}
# Kinds of files by the end of their name: the encoder, the format of its pixels, and options of the file.
_KINDS = {
    ".mp4": ("libx264", "yuv420p", {"movflags": "+faststart"}),
    ".webp": ("libwebp_anim", "yuv420p", {"loop": "0"}),
}
SUFFIXES = tuple(_KINDS)
# WebP's largest image, pixels a side.
_LARGEST_WEBP = 16383


def check_suffix(path: Path, what: str = "") -> None:
    """Refuse a file that no video can be written as.

    Args:
        path: the file.
        what: put before its name in the message, such as the option that names it.

    Raises:
        RenderError: its name ends in none of `SUFFIXES`.
    """
    if path.suffix not in _KINDS:
        raise RenderError(f"{f'{what} {path}'.strip()}: videos are written as {' or '.join(SUFFIXES)}")


class Recordable(Protocol):
    """The part of an environment that ``recording`` uses; those of ``vecenv.make`` have it."""

    def reset(self) -> ResetInfo:
        """Make every slot live."""
        ...

    def observe_egocentric(self) -> Egocentric:
        """Cameras and proprioception."""
        ...

    def evaluate(self) -> Metrics:
        """Verdicts."""
        ...

    def watched(self, watcher: Callable[[np.ndarray, np.ndarray], None]) -> AbstractContextManager[None]:
        """Inside the context, call ``watcher(actions [B, 7], active [B])`` before every control step."""
        ...


class VideoWriter:
    """Writes frames to a video; a context manager. Frames may have any size, but all the same one.

    Args:
        path: the file, ending in .mp4, or in .webp for an animated image that plays in a loop; its folder is made.
        fps: frames per second.
        keyframes: mp4: every how many frames one can be decoded without those before it.
        crf: mp4: how much may be lost, from 0 (nothing) to 51; 6 more halve the file.
        quality: WebP: from 0 (smallest file) to 100.

    Attributes:
        frames: how many were written.
        height, width: of the file's frames, pixels; 0 before the first.

    Raises:
        RenderError: the path ends in neither.
    """

    def __init__(
        self,
        path: str | Path,
        fps: float = CONTROL_HZ,
        *,
        keyframes: int = 40,
        crf: int = 18,
        quality: int = WEBP_QUALITY,
    ) -> None:
        self.path = Path(path)
        check_suffix(self.path)
        self.frames, self.height, self.width = 0, 0, 0
        self._fps = Fraction(fps).limit_denominator(1000)
        mp4 = self.path.suffix == ".mp4"
        self._options = _H264 | {"g": str(keyframes), "crf": str(crf)} if mp4 else _WEBP | {"quality": str(quality)}
        self._open: tuple[OutputContainer, VideoStream] | None = None

    def add(self, frame: np.ndarray) -> None:
        """Append a frame, uint8 [H, W, 3].

        Raises:
            RenderError: PyAV is not installed, or the frame is larger than the kind of file can hold.
        """
        # Both store colour for two pixels at a time: sides must be even.
        padded = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")
        if self._open is None:
            self._open = self._start(padded)
            self.height, self.width = padded.shape[:2]
        from av import VideoFrame

        container, stream = self._open
        image = VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="rgb24")
        image.pts, image.time_base = self.frames, 1 / self._fps
        container.mux(stream.encode(image))
        self.frames += 1

    def close(self) -> None:
        """Finish the file. Closing twice is harmless."""
        if self._open is not None:
            container, stream = self._open
            container.mux(stream.encode())
            container.close()
        self._open = None

    def _start(self, frame: np.ndarray) -> tuple[OutputContainer, VideoStream]:
        try:
            import av
        except ImportError as error:
            raise RenderError("writing videos needs PyAV: pip install 'vecenv[render]'") from error
        encoder, pixels, options = _KINDS[self.path.suffix]
        if encoder == "libwebp_anim" and max(frame.shape) > _LARGEST_WEBP:
            size = f"{frame.shape[1]} x {frame.shape[0]} pixels"
            raise RenderError(f"{self.path}: a WebP has at most {_LARGEST_WEBP} pixels a side, not {size}")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        container = av.open(str(self.path), "w", options=options)
        stream = cast("VideoStream", container.add_stream(encoder, rate=self._fps, options=self._options))
        stream.height, stream.width, stream.pix_fmt = frame.shape[0], frame.shape[1], pixels
        stream.codec_context.thread_count = 1
        return container, stream

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


@contextmanager
def recording(
    env: Recordable,
    path: str | Path,
    *,
    cameras: Sequence[str] = ("agentview",),
    columns: int | None = None,
    fps: float = CONTROL_HZ,
    titles: Sequence[str] | None = None,
    judged: bool = True,
    every: int = 1,
    border: int = GAP,
    held: int = 0,
) -> Iterator[VideoWriter]:
    """Record all slots in one video inside the context, one frame per control step, with titles.

    Control steps become frames whichever method moves the slots. A slot is framed in green once it is solved; the last
    frame shows the end, where unsolved slots are framed in red.

    Args:
        env: an environment; ``reset`` is called for the titles.
        path: the video, .mp4 or .webp.
        cameras: shown side by side; SIMPLER has ``agentview`` alone.
        columns: slots in a row.
        fps: frames per second; at the robot's control rate the video runs as fast as the robot.
        titles: of the slots, in place of the episodes' names and instructions; an empty list for none.
        judged: whether slots are framed by their verdict.
        every: show every so many control steps, and the end.
        border: width of the frame around each slot, pixels.
        held: how many more times the last frame is written.
    """
    info = env.reset()
    if titles is None:
        titles = [f"{name}: {text}" for name, text in zip(info.episode_id, info.instruction, strict=True)]

    def frame(failed: bool | None = None) -> np.ndarray:
        seen, solved = env.observe_egocentric(), env.evaluate().success
        if isinstance(seen.images, Rendered):
            seen.images.prepare(*cameras)
        verdicts = [True if one else failed for one in solved.tolist()] if judged else []
        images = [seen.images[name] for name in cameras]
        return render_grid(images, titles, columns=columns, verdicts=verdicts, border=border)

    ticks = itertools.count()

    def look(actions: np.ndarray, active: np.ndarray) -> None:
        if next(ticks) % every == 0:
            video.add(frame())

    with VideoWriter(path, fps) as video:
        with env.watched(look):
            yield video
        last = frame(failed=False)
        for _ in range(1 + held):
            video.add(last)
