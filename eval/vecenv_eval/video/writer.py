"""Writing frames to an mp4, and recording a batch while it runs.

In: frames [H, W, 3], or a live environment. Out: a file that any player opens. Needs ``imageio[ffmpeg]`` and
``pillow``, both in the extra ``render``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol

import numpy as np

from vecenv.contract import Metrics, ResetInfo
from vecenv.libero.render.options import RenderError
from vecenv.observations import Egocentric, Rendered
from vecenv_eval.video.grid import render_grid

if TYPE_CHECKING:
    from imageio.core.format import Format

# LIBERO's control steps per second: a video at this rate runs as fast as the robot.
CONTROL_HZ = 20


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
        path: the file, ending in .mp4.
        fps: frames per second.

    Raises:
        RenderError: the path does not end in .mp4.
    """

    def __init__(self, path: str | Path, fps: float = CONTROL_HZ) -> None:
        self.path = Path(path)
        if self.path.suffix != ".mp4":
            raise RenderError(f"{self.path}: videos are written as .mp4")
        self.frames = 0
        self._fps = fps
        self._writer: Format.Writer | None = None

    def add(self, frame: np.ndarray) -> None:
        """Append a frame, uint8 [H, W, 3].

        Raises:
            RenderError: imageio[ffmpeg] is not installed.
        """
        if self._writer is None:
            self._writer = _open(self.path, self._fps)
        # H.264 stores colour for two pixels at a time: both sides must be even.
        padded = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")
        self._writer.append_data(padded)
        self.frames += 1

    def close(self) -> None:
        """Finish the file. Closing twice is harmless."""
        if self._writer is not None:
            self._writer.close()
        self._writer = None

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def _open(path: Path, fps: float) -> Format.Writer:
    try:
        import imageio
        import imageio_ffmpeg  # noqa: F401 - imageio finds ffmpeg through it
    except ImportError as error:
        raise RenderError("writing videos needs imageio and ffmpeg: pip install 'vecenv[render]'") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    # imageio forks to put ffmpeg into another process group, which fails beside the large mappings of JAX and GL.
    os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    return imageio.get_writer(path, fps=fps, codec="libx264", quality=8, macro_block_size=1)


@contextmanager
def recording(
    env: Recordable,
    path: str | Path,
    *,
    cameras: Sequence[str] = ("agentview",),
    columns: int | None = None,
    fps: float = CONTROL_HZ,
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
    """
    info = env.reset()
    titles = [f"{name}: {text}" for name, text in zip(info.episode_id, info.instruction, strict=True)]

    def add_frame(failed: bool | None = None) -> None:
        seen, solved = env.observe_egocentric(), env.evaluate().success
        if isinstance(seen.images, Rendered):
            seen.images.prepare(*cameras)
        verdicts = [True if one else failed for one in solved.tolist()]
        video.add(render_grid([seen.images[name] for name in cameras], titles, columns=columns, verdicts=verdicts))

    with VideoWriter(path, fps) as video:
        with env.watched(lambda actions, active: add_frame()):
            yield video
        add_frame(failed=False)
