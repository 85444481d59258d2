"""Images of a live batch: drawn only when somebody asks, encoded once for everybody who asked for the same.

Readers name what they want (:class:`View` or :data:`WALL`) with :meth:`FrameHub.want`, once for every frame; the thread
of the environment draws it between two ticks (:meth:`FrameHub.draw`), another thread encodes it, and
:meth:`FrameHub.newest` has it. Nothing is queued: a frame is replaced by the next.

While a run is played at full speed, drawing takes at most about a third of the time. The wall is one mosaic of all
slots, whose tiles are drawn a few at a time, those that have waited longest first.
"""

from __future__ import annotations

import io
import json
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from vecenv.contract import BatchEnv
from vecenv.errors import VecenvError
from vecenv.observations import Rendered
from vecenv.util.extras import how_to_install, is_installed
from vecenv_eval.panel.monitor import Monitor
from vecenv_eval.policies import raised

_log = logging.getLogger(__name__)
TILE, COLUMNS = 96, 16
QUALITY = 80
# Different views that are kept at once; of more, those that were asked for longest ago are dropped.
MOST_VIEWS = 128
# Slots of the wall that are drawn in one call, and seconds that one turn of drawing tiles may take.
_TILES_AT_ONCE, _TURN_S, _IDLE_TURN_S = 8, 0.05, 0.4
# While a run is played: after drawing for some time, so many times that long pass before it is drawn again, and no more
# than this many seconds. The first image of a scene takes long and does not count.
_REST, _LONGEST_REST_S = 2.0, 10.0
# The wall's camera, where there is one of that name; otherwise the first.
_WALL_CAMERA = "agentview"
# Seconds after which nobody is taken to look at a view that was not asked for again.
_INTEREST_S = 5.0
_BACKGROUND = 24


@dataclass(frozen=True)
class View:
    """One camera of one slot; ``size`` is the longer side in pixels, at most."""

    slot: int
    camera: str
    size: int


WALL = "wall"
Key: TypeAlias = View | str


@dataclass(frozen=True)
class Frame:
    """An encoded image.

    Attributes:
        number: larger for every frame of the hub.
        revision: what it shows (``Monitor.revisions``).
        message: as it is sent: length of the header (4 bytes, little-endian), the header (JSON), JPEG.
    """

    number: int
    revision: int
    message: bytes


class FrameHub:
    """Draws and encodes what was asked for.

    Args:
        monitor: the table of the batch.
        wake: called when something was asked for, so that an environment that waits is drawn.

    Attributes:
        error: why nothing can be drawn, None while it can.
        preparing: the first image is being drawn, which takes seconds in LIBERO, because a visual scene is compiled.
        cameras: names of the cameras.
        image_size: height and width of the images, pixels; None before the first.
        drawn, encoded: images so far.
    """

    def __init__(self, monitor: Monitor, wake: Callable[[], None]) -> None:
        self._monitor, self._wake = monitor, wake
        self._lock = threading.Lock()
        self._encoder = ThreadPoolExecutor(1, thread_name_prefix="vecenv-encoder")
        self._clear()
        self.drawn = self.encoded = 0
        self._number = 0

    def _clear(self) -> None:
        self.error: str | None = None
        self.preparing = self._has_drawn = False
        self.cameras: tuple[str, ...] = ()
        self.image_size: tuple[int, int] | None = None
        self._wanted: dict[Key, None] = {}
        self._asked: dict[Key, float] = {}
        self._busy: set[Key] = set()
        self._frames: dict[Key, Frame] = {}
        self._tiles = np.zeros((0, TILE, TILE, 3), np.uint8)
        self._tile_revisions, self._tile_ticks = np.zeros(0, int), np.zeros(0, int)
        self._not_before = 0.0
        self._generation = object()

    # -- for readers, on any thread ------------------------------------------------------------------------------------

    def newest(self, key: Key) -> Frame | None:
        """The newest frame of a view, None before the first."""
        return self._frames.get(key)

    def want(self, key: Key) -> None:
        """Ask for one more frame of a view; nothing happens if there is none newer to be had."""
        with self._lock:
            self._asked[key] = time.monotonic()
            if self.error or key in self._wanted or key in self._busy or not self._is_stale(key):
                return
            self._wanted[key] = None
            while len(self._wanted) > MOST_VIEWS:
                self._wanted.pop(next(iter(self._wanted)))
        self._wake()

    def _is_stale(self, key: Key) -> bool:
        revisions = self._monitor.revisions
        if isinstance(key, View):
            frame = self._frames.get(key)
            exists = key.slot < len(revisions) and (not self.cameras or key.camera in self.cameras)
            return exists and (frame is None or frame.revision < revisions[key.slot])
        return bool(len(revisions)) and (
            len(self._tile_revisions) != len(revisions) or bool((self._tile_revisions < revisions).any())
        )

    # -- on the thread of the environment ------------------------------------------------------------------------------

    def placed(self, env: BatchEnv) -> None:
        """Another environment is watched, or none of its old frames is true any more."""
        with self._lock:
            self._clear()
            try:
                self.cameras = tuple(env.observe_egocentric(np.zeros(env.num_envs, bool)).images)
            except VecenvError as error:
                self.error = f"images cannot be drawn: {error}"
            if not is_installed("PIL"):
                self.error = how_to_install("PIL")
            count = env.num_envs
            self._tiles = np.full((count, TILE, TILE, 3), _BACKGROUND, np.uint8)
            self._tile_revisions, self._tile_ticks = np.zeros(count, int), np.zeros(count, int)

    def lost(self) -> None:
        """There is no environment any more."""
        with self._lock:
            self._clear()

    def is_due(self, playing: bool) -> bool:
        """Whether something is to be drawn now."""
        return bool(self._wanted) and (not playing or time.monotonic() >= self._not_before)

    def draw(self, env: BatchEnv, *, playing: bool, only: Sequence[int] | None = None) -> None:
        """Draw what was asked for.

        Args:
            env: the environment.
            playing: the run goes on, so that drawing is to take little of its time.
            only: views of these slots only, and the wall.
        """
        began = time.monotonic()
        with self._lock:
            keys = [key for key in self._wanted if only is None or key == WALL or _slot(key) in only]
            for key in keys:
                del self._wanted[key]
        self.preparing = keys != [] and not self._has_drawn
        try:
            views = [key for key in keys if isinstance(key, View) and self._is_stale(key)]
            if views:
                self._draw_views(env, views, wall=WALL in keys)
            if WALL in keys and self.cameras:
                self._draw_wall(env, _TURN_S if playing else _IDLE_TURN_S)
        except Exception as error:  # no GL, no memory: the run goes on without images
            _log.warning("images cannot be drawn: %s", raised(error))
            self.error = f"images cannot be drawn: {raised(error)}"
        now = time.monotonic()
        self._not_before = now + (min(_REST * (now - began), _LONGEST_REST_S) if self._has_drawn else 0.0)
        self.preparing, self._has_drawn = False, self._has_drawn or keys != []

    def draw_ended(self, env: BatchEnv, slots: Sequence[int]) -> None:
        """Draw the views of slots whose episodes have just ended, while the environment shows their end.

        Of views that somebody looks at, whether or not they are due: the slot's next image is of another episode.
        """
        since = time.monotonic() - _INTEREST_S
        with self._lock:
            self._asked = {key: asked for key, asked in self._asked.items() if asked > since}
            self._wanted.update({key: None for key in self._asked if key == WALL or _slot(key) in slots})
        if self._wanted:
            self.draw(env, playing=True, only=slots)

    def _draw_views(self, env: BatchEnv, views: Sequence[View], *, wall: bool) -> None:
        """Draw cameras of slots; what the wall shows as well is put there."""
        cameras = [camera for camera in self.cameras if any(view.camera == camera for view in views)]
        slots = sorted({view.slot for view in views})
        ticks = self._monitor.tick
        revisions = self._monitor.revisions.copy()
        images = _images(env, slots, cameras)
        self.drawn += len(slots) * len(cameras)
        for view in views:
            image = images[view.camera][view.slot]
            self.image_size = int(image.shape[0]), int(image.shape[1])
            self._encode(view, int(revisions[view.slot]), image.copy(), ticks)
        if wall and self._wall_camera in images:
            self._put_tiles(slots, images[self._wall_camera], revisions)

    @property
    def _wall_camera(self) -> str:
        return _WALL_CAMERA if _WALL_CAMERA in self.cameras else self.cameras[0]

    def _put_tiles(self, slots: Sequence[int], images: np.ndarray, revisions: np.ndarray) -> None:
        for slot in slots:
            self._tiles[slot] = _square(images[slot])
        rows = list(slots)
        self._tile_revisions[rows], self._tile_ticks[rows] = revisions[rows], self._monitor.tick

    def _encode(self, view: View, revision: int, image: np.ndarray, tick: int) -> None:
        def encode() -> bytes:
            pixels = _fitted(image, view.size)
            height, width = pixels.shape[:2]
            header = {"type": "frame", "slot": view.slot, "camera": view.camera, "tick": tick}
            return _message({**header, "width": width, "height": height}, pixels)

        self._submit(view, revision, encode)

    def _draw_wall(self, env: BatchEnv, budget_s: float) -> None:
        began, revisions, camera = time.monotonic(), self._monitor.revisions.copy(), self._wall_camera
        stale = np.flatnonzero(self._tile_revisions < revisions)
        order = stale[np.argsort(self._tile_revisions[stale], kind="stable")].tolist()
        while order and time.monotonic() - began < budget_s:
            some, order = order[:_TILES_AT_ONCE], order[_TILES_AT_ONCE:]
            images = _images(env, some, [camera])[camera]
            self.drawn += len(some)
            self._put_tiles(some, images, revisions)
        tiles, ticks = self._tiles.copy(), self._tile_ticks.tolist()
        slots = self._monitor.slots()

        def encode() -> bytes:
            columns = min(COLUMNS, len(tiles))
            header = {
                "type": "wall",
                "tile": TILE,
                "columns": columns,
                "slots": [slot.slot for slot in slots],
                "ticks": ticks,
                "verdicts": [slot.verdict for slot in slots],
            }
            return _message(header, _mosaic(tiles, columns))

        self._submit(WALL, int(self._tile_revisions.min(initial=0)), encode)

    def _submit(self, key: Key, revision: int, encode: Callable[[], bytes]) -> None:
        """Have an image encoded on the other thread, and keep it if the environment is still the same."""
        generation = self._generation
        with self._lock:
            self._busy.add(key)

        def work() -> None:
            message = b""
            try:
                message = encode()
            except Exception as error:  # Pillow's
                _log.warning("an image cannot be encoded: %s", raised(error))
            with self._lock:
                if generation is not self._generation:
                    return
                self._busy.discard(key)
                if not message:
                    return
                self._number += 1
                self.encoded += 1
                self._frames.pop(key, None)
                self._frames[key] = Frame(self._number, revision, message)
                while len(self._frames) > MOST_VIEWS:
                    self._frames.pop(next(iter(self._frames)))

        self._encoder.submit(work)

    def close(self) -> None:
        """Encode nothing more."""
        self._encoder.shutdown(wait=True, cancel_futures=True)


def _slot(key: Key) -> int:
    return key.slot if isinstance(key, View) else -1


def _images(env: BatchEnv, slots: Sequence[int], cameras: Sequence[str]) -> Mapping[str, np.ndarray]:
    """Images of some slots, uint8 [B, H, W, 3] by camera; those of other slots are black."""
    images = env.observe_egocentric(np.array(slots)).images
    if isinstance(images, Rendered):
        images.prepare(*cameras)
    return {camera: np.asarray(images[camera]) for camera in cameras}


def _fitted(image: np.ndarray, size: int) -> np.ndarray:
    """An image [H, W, 3] whose longer side is ``size`` pixels at most."""
    from PIL import Image

    longer = max(image.shape[:2])
    if longer <= size:
        return image
    height, width = (max(1, round(side * size / longer)) for side in image.shape[:2])
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR, reducing_gap=2.0))


def _square(image: np.ndarray) -> np.ndarray:
    """An image in the middle of a tile, [TILE, TILE, 3]."""
    fitted = _fitted(image, TILE)
    tile = np.full((TILE, TILE, 3), _BACKGROUND, np.uint8)
    top, left = (TILE - fitted.shape[0]) // 2, (TILE - fitted.shape[1]) // 2
    tile[top : top + fitted.shape[0], left : left + fitted.shape[1]] = fitted
    return tile


def _mosaic(tiles: np.ndarray, columns: int) -> np.ndarray:
    """Tiles [B, TILE, TILE, 3] in rows, uint8 [H, W, 3]."""
    rows = -(-len(tiles) // columns)
    canvas = np.full((rows * columns, TILE, TILE, 3), _BACKGROUND, np.uint8)
    canvas[: len(tiles)] = tiles
    grid = canvas.reshape(rows, columns, TILE, TILE, 3).swapaxes(1, 2)
    return np.ascontiguousarray(grid.reshape(rows * TILE, columns * TILE, 3))


def _message(header: Mapping[str, Any], pixels: np.ndarray) -> bytes:
    """Header and JPEG as one binary message."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=QUALITY)
    text = json.dumps(header, separators=(",", ":")).encode()
    return len(text).to_bytes(4, "little") + text + buffer.getvalue()
