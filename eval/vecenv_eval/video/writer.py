"""Writing frames to an mp4, and recording a batch while it runs.

In: frames [H, W, 3], or a live environment. Out: an H.264 file that any player and browser opens. Frames are encoded as
they come, in this process. Needs ``av`` and ``pillow``, both in the extra ``render``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol

import numpy as np

from vecenv.contract import Metrics, ResetInfo
from vecenv.libero.render.options import RenderError
from vecenv.observations import Egocentric, Rendered
from vecenv_eval.video.grid import render_grid

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

# LIBERO's control steps per second: a video at this rate runs as fast as the robot.
CONTROL_HZ = 20
# No frame depends on a later one. Two images of 256 x 256 take 6 ms on a busy core; "veryfast"
# takes half as long again for the same size, "ultrafast" two thirds for twice the size.
_H264 = {"preset": "superfast", "bf": "0", "rc-lookahead": "0"}


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
    """Writes frames to an mp4; a context manager. Frames may have any size, but all the same one.

    Args:
        path: the file, ending in .mp4; its folder is made.
        fps: frames per second.
        keyframes: every how many frames one can be decoded without those before it.
        crf: how much may be lost, from 0 (nothing) to 51; 6 more halve the file.

    Attributes:
        frames: how many were written.
        height, width: of the file's frames, pixels; 0 before the first.

    Raises:
        RenderError: the path does not end in .mp4.
    """

    def __init__(self, path: str | Path, fps: float = CONTROL_HZ, *, keyframes: int = 40, crf: int = 18) -> None:
        self.path = Path(path)
        if self.path.suffix != ".mp4":
            raise RenderError(f"{self.path}: videos are written as .mp4")
        self.frames, self.height, self.width = 0, 0, 0
        self._fps = Fraction(fps).limit_denominator(1000)
        self._options = _H264 | {"g": str(keyframes), "crf": str(crf)}
        self._open: tuple[OutputContainer, VideoStream] | None = None

    def add(self, frame: np.ndarray) -> None:
        """Append a frame, uint8 [H, W, 3].

        Raises:
            RenderError: PyAV is not installed.
        """
        # H.264 stores colour for two pixels at a time: both sides must be even.
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
        self.path.parent.mkdir(parents=True, exist_ok=True)
        container = av.open(str(self.path), "w", options={"movflags": "+faststart"})
        stream = container.add_stream("libx264", rate=self._fps, options=self._options)
        stream.height, stream.width, stream.pix_fmt = frame.shape[0], frame.shape[1], "yuv420p"
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
) -> Iterator[VideoWriter]:
    """Record all slots in one video inside the context, one frame per control step, with titles.

    Every control step becomes a frame, whichever method moves the slots. A slot is framed in green once it is solved;
    the last frame shows the end, where unsolved slots are framed in red.

    Args:
        env: an environment; ``reset`` is called for the titles.
        path: the mp4.
        cameras: shown side by side; SIMPLER has ``agentview`` alone.
        columns: slots in a row.
        fps: frames per second; at the robot's control rate the video runs as fast as the robot.
        titles: of the slots, in place of the episodes' names and instructions.
        judged: whether slots are framed by their verdict.
    """
    info = env.reset()
    if titles is None:
        titles = [f"{name}: {text}" for name, text in zip(info.episode_id, info.instruction, strict=True)]

    def add_frame(failed: bool | None = None) -> None:
        seen, solved = env.observe_egocentric(), env.evaluate().success
        if isinstance(seen.images, Rendered):
            seen.images.prepare(*cameras)
        verdicts = [True if one else failed for one in solved.tolist()] if judged else []
        video.add(render_grid([seen.images[name] for name in cameras], titles, columns=columns, verdicts=verdicts))

    with VideoWriter(path, fps) as video:
        with env.watched(lambda actions, active: add_frame()):
            yield video
        add_frame(failed=False)
