"""Pictures of a batch tiled into one, and videos of them: one mp4 for an episode or for sixteen.

In: images [B, H, W, 3] and a title a slot. Out: one image, or a file that any player opens. Writing videos needs
``imageio[ffmpeg]`` and titles need ``pillow``, both in the extra ``render``.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from vecenv.contract import Rendered
from vecenv.libero.render.options import RenderError

# Height of a line above an image that has a title, pixels; and the darkness between tiles.
TITLE_HEIGHT, GAP = 16, 2
# Lines of a title at most, and the room beside and above its text, pixels.
_MOST_LINES, _TEXT_AT, _TEXT_SIZE = 3, (3, 2), 11
# Control ticks a second: a video at this rate runs as fast as the robot.
CONTROL_HZ = 20
_BACKGROUND, _INK = (24, 24, 24), (235, 235, 235)
_VERDICTS = {True: ("solved", (80, 200, 120)), False: ("failed", (230, 90, 80)), None: ("", _BACKGROUND)}


def render_grid(
    images: np.ndarray | Sequence[np.ndarray],
    titles: Sequence[str] = (),
    *,
    columns: int | None = None,
    verdicts: Sequence[bool | None] = (),
) -> np.ndarray:
    """Images side by side, uint8 [H', W', 3]; a notebook shows it with ``PIL.Image.fromarray``.

    Args:
        images: [B, H, W, 3], or several of that (two cameras, say), which are put next to each other.
        titles: text above each, on up to three lines, as many as the longest needs; cut off where it is too long.
        columns: how many stand in a row; by default about as many as there are rows.
        verdicts: True frames a slot in green, False in red, None not at all; before a title, they are words as well.

    Raises:
        RenderError: not images, or not as many titles or verdicts as images.
    """
    tiles = _side_by_side(images)
    for name, given in (("titles", titles), ("verdicts", verdicts)):
        if len(given) not in (0, len(tiles)):
            raise RenderError(f"{len(given)} {name} for {len(tiles)} images")
    if columns is not None and columns < 1:
        raise RenderError(f"columns={columns}: need at least 1")
    heads = _heads(titles, verdicts, tiles.shape[2])
    framed = [
        _framed(tile, heads[i] if heads else None, verdicts[i] if verdicts else None) for i, tile in enumerate(tiles)
    ]
    columns = min(columns or math.ceil(math.sqrt(len(framed))), len(framed))
    height, width = framed[0].shape[:2]
    rows = math.ceil(len(framed) / columns)
    canvas = np.full((rows * height, columns * width, 3), _BACKGROUND, np.uint8)
    for index, tile in enumerate(framed):
        y, x = divmod(index, columns)
        canvas[y * height : (y + 1) * height, x * width : (x + 1) * width] = tile
    return canvas


def _side_by_side(images: np.ndarray | Sequence[np.ndarray]) -> np.ndarray:
    sets = [images] if isinstance(images, np.ndarray) else list(images)
    if not sets or any(
        s.ndim != 4 or s.shape[-1] != 3 or s.dtype != np.uint8 or s.shape != sets[0].shape for s in sets
    ):
        raise RenderError("images must be uint8 [B, H, W, 3], all of one shape")
    if not len(sets[0]):
        raise RenderError("there is no image to show")
    return np.concatenate(sets, axis=2)


def _framed(tile: np.ndarray, head: np.ndarray | None, verdict: bool | None) -> np.ndarray:
    whole = tile if head is None else np.concatenate([head, tile])
    framed = np.full((whole.shape[0] + 2 * GAP, whole.shape[1] + 2 * GAP, 3), _VERDICTS[verdict][1], np.uint8)
    framed[GAP:-GAP, GAP:-GAP] = whole
    return framed


def _heads(titles: Sequence[str], verdicts: Sequence[bool | None], width: int) -> list[np.ndarray]:
    """The titles as images of one height, uint8 [lines * TITLE_HEIGHT, width, 3] each; none without titles."""
    given = (verdicts or [None] * len(titles)) if titles else ()
    # Where there may be verdicts, there is room for them before there are any: frames of a video have one size.
    words = ("solved ", "failed ") if verdicts else ("",)
    lines = max((len(_wrapped(word + title, width)) for title in titles for word in words), default=0)
    return [_head(title, lines, width, verdict) for title, verdict in zip(titles, given, strict=True)]


def _head(title: str, lines: int, width: int, verdict: bool | None) -> np.ndarray:
    from PIL import Image, ImageDraw

    word, color = _VERDICTS[verdict]
    image = Image.new("RGB", (width, lines * TITLE_HEIGHT), _BACKGROUND)
    draw = ImageDraw.Draw(image)
    for number, line in enumerate(_wrapped(f"{word} {title}", width)):
        draw.text((_TEXT_AT[0], _TEXT_AT[1] + number * TITLE_HEIGHT), line, fill=_INK, font=_font())
    draw.text(_TEXT_AT, word, fill=color, font=_font())
    return np.asarray(image)


def _wrapped(text: str, width: int) -> list[str]:
    """Text in lines that fit, up to the most; at least one."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and _font().getlength(longer) > width - 2 * _TEXT_AT[0]:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines[:_MOST_LINES]


@functools.cache
def _font() -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size=_TEXT_SIZE)


class VideoWriter:
    """Writes frames to an mp4; a context manager. Frames may have any size, all the same.

    Args:
        path: the file, ending in .mp4.
        fps: frames a second.

    Raises:
        RenderError: another ending, or imageio[ffmpeg] is not installed.
    """

    def __init__(self, path: str | Path, fps: float = CONTROL_HZ) -> None:
        self.path = Path(path)
        if self.path.suffix != ".mp4":
            raise RenderError(f"{self.path}: videos are written as .mp4")
        self.frames = 0
        self._fps, self._writer = fps, None

    def add(self, frame: np.ndarray) -> None:
        """Append a frame, uint8 [H, W, 3]."""
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


def _open(path: Path, fps: float) -> Any:
    try:
        import imageio
        import imageio_ffmpeg  # noqa: F401 - imageio finds ffmpeg through it
    except ImportError as error:
        raise RenderError("writing videos needs imageio and ffmpeg: pip install 'vecenv[render]'") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    # A child that is forked to give it a process group of its own cannot start beside large mappings (JAX's, GL's).
    os.environ.setdefault("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    return imageio.get_writer(path, fps=fps, codec="libx264", quality=8, macro_block_size=1)


@contextmanager
def recording(
    env: Any,
    path: str | Path,
    *,
    cameras: Sequence[str] = ("agentview",),
    columns: int | None = None,
    fps: float = CONTROL_HZ,
) -> Iterator[VideoWriter]:
    """While inside, write what the cameras see at every control tick: all slots in one video, titled.

    Whatever verb moves the slots, every tick becomes a frame. A slot is framed in green once it is solved; in the last
    frame, which shows how things ended, those that are not are framed in red.

    Args:
        env: a live environment (``reset`` has been called; it is asked for the titles).
        path: the mp4.
        cameras: shown side by side; SIMPLER has ``agentview`` alone.
        columns: slots in a row.
        fps: frames a second; at the robot's control rate the video runs as fast as the robot.
    """
    info = env.reset()
    titles = [f"{name}: {text}" for name, text in zip(info.episode_id, info.instruction, strict=True)]

    def shoot(failed: bool | None = None) -> None:
        seen, solved = env.observe_egocentric(), env.evaluate().success
        if isinstance(seen.images, Rendered):
            seen.images.prepare(*cameras)
        verdicts = [True if one else failed for one in solved.tolist()]
        video.add(render_grid([seen.images[name] for name in cameras], titles, columns=columns, verdicts=verdicts))

    with VideoWriter(path, fps) as video:
        with env.watched(lambda actions, active: shoot()):
            yield video
        shoot(failed=False)
