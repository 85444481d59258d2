"""The images of a batch tiled into one image, each with a title and framed by its verdict.

In: images [B, H, W, 3], a title and a verdict per slot. Out: one image. Titles need ``pillow``, in the extra
``render``.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vecenv.libero.render.options import RenderError

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont, ImageFont

# Height of a line of a title, and usual width of the frame around a tile, pixels.
TITLE_HEIGHT, GAP = 16, 2
# Most lines of a title, where its text starts in a line (x, y), and its size, pixels.
_MAX_LINES, _TEXT_AT, _TEXT_SIZE = 3, (3, 2), 11
_BACKGROUND, _INK = (24, 24, 24), (235, 235, 235)
_VERDICTS = {True: ("solved", (80, 200, 120)), False: ("failed", (230, 90, 80)), None: ("", _BACKGROUND)}


def render_grid(
    images: np.ndarray | Sequence[np.ndarray],
    titles: Sequence[str] = (),
    *,
    columns: int | None = None,
    verdicts: Sequence[bool | None] = (),
    border: int = GAP,
) -> np.ndarray:
    """Tile images into one, uint8 [H', W', 3]; a notebook shows it with ``PIL.Image.fromarray``.

    Args:
        images: uint8 [B, H, W, 3], or several such arrays (of two cameras, say), which are shown side by side.
        titles: text above each image, on up to three lines, as many as the longest needs; longer text is cut off.
        columns: images in a row; by default about as many as there are rows.
        verdicts: True frames an image in green, False in red, None not at all; titles begin with the verdict as a word.
        border: width of the frame around each image, pixels.

    Raises:
        RenderError: these are no images, the border is below 0, or there are not as many titles or verdicts as images.
    """
    tiles = _side_by_side(images)
    for name, given in (("titles", titles), ("verdicts", verdicts)):
        if len(given) not in (0, len(tiles)):
            raise RenderError(f"{len(given)} {name} for {len(tiles)} images")
    if columns is not None and columns < 1:
        raise RenderError(f"columns={columns}: need at least 1")
    if border < 0:
        raise RenderError(f"border={border}: need at least 0")
    heads = _heads(titles, verdicts, tiles.shape[2])
    framed = [
        _framed(tile, heads[i] if heads else None, verdicts[i] if verdicts else None, border)
        for i, tile in enumerate(tiles)
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


def _framed(tile: np.ndarray, head: np.ndarray | None, verdict: bool | None, border: int) -> np.ndarray:
    whole = tile if head is None else np.concatenate([head, tile])
    height, width = whole.shape[:2]
    framed = np.full((height + 2 * border, width + 2 * border, 3), _VERDICTS[verdict][1], np.uint8)
    framed[border : border + height, border : border + width] = whole
    return framed


def _heads(titles: Sequence[str], verdicts: Sequence[bool | None], width: int) -> list[np.ndarray]:
    """The titles as images of the same height, uint8 [lines * TITLE_HEIGHT, width, 3]; an empty list without titles."""
    given = (verdicts or [None] * len(titles)) if titles else ()
    # Leave room for the word of a verdict before there is one: all frames of a video have the same size.
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
    """Split text into lines that fit the width, at least one and at most ``_MAX_LINES``."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and _font().getlength(longer) > width - 2 * _TEXT_AT[0]:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines[:_MAX_LINES]


@functools.cache
def _font() -> FreeTypeFont | ImageFont:
    from PIL import ImageFont

    return ImageFont.load_default(size=_TEXT_SIZE)
