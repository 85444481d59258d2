"""The newest images of running episodes, as small files that whoever looks at the results folder may read.

:class:`LivePublisher` is an episode recorder (``vecenv_eval.watch``): at most once a second it draws some of the
running slots and publishes one frame, a JSON header and a JPEG mosaic of up to 64 slots. A process has one file,
``DIR/live/HOST-PID.frame``, which is replaced in one step and never synced. Making frames takes at most a tenth of the
time: as many slots are drawn for each as fit into that, and they take turns. It never costs an episode: what goes wrong
is logged once. ``vecenv eval --live`` asks for it; the files go when the run ends.
"""

from __future__ import annotations

import io
import json
import logging
import os
import platform
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vecenv.contract import BatchEnv
from vecenv.errors import InvalidFile
from vecenv_eval.episodes import Episode
from vecenv_eval.store import Record
from vecenv_eval.watch import Observable

LIVE, ENDING = "live", ".frame"
# Side of a tile in pixels, and tiles in a row.
TILE, COLUMNS = 96, 8
# Most slots in a mosaic, and how many are drawn for the first frame, which tells what drawing costs.
MOST_SLOTS, DRAWN_FIRST = 64, 8
# Seconds between two frames at least, and the share of the time that making them may take.
PERIOD_S, SHARE = 1.0, 0.1
# Longest file that a reader takes.
MOST_BYTES = 4_000_000
_QUALITY = 75
_MOST_TEXT = 300
_BACKGROUND = 24

_log = logging.getLogger(__name__)


class LiveError(InvalidFile):
    """A file of newest images that cannot be read."""


def pack(header: Mapping[str, Any], jpeg: bytes) -> bytes:
    """A frame: the length of the header (4 bytes, little-endian), the header as JSON, the image."""
    text = json.dumps(header).encode()
    return len(text).to_bytes(4, "little") + text + jpeg


def unpack(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The header and the image of a frame.

    Raises:
        LiveError: it is none.
    """
    size = int.from_bytes(content[:4], "little")
    try:
        header = json.loads(content[4 : 4 + size])
    except (ValueError, RecursionError) as error:
        raise LiveError(f"a frame without a header: {error}") from None
    image = content[4 + size :]
    if not isinstance(header, dict) or (image and not image.startswith(b"\xff\xd8")):
        raise LiveError("a frame whose header or image is none")
    return header, image


def own_name() -> str:
    """What this process's frames are called: its machine and its number."""
    return f"{platform.node() or 'host'}-{os.getpid()}"


def write_frame(folder: Path, name: str, content: bytes | None) -> None:
    """Replace a process's frame in a results folder in one step, or remove it (None).

    Raises:
        OSError: it cannot be written.
    """
    path = folder / LIVE / f"{re.sub(r'[^A-Za-z0-9_.-]+', '-', name)[:100]}{ENDING}"
    if content is None:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_bytes(content)
    temporary.replace(path)


@contextmanager
def cleared(folder: Path) -> Iterator[None]:
    """No frame is in a results folder before and after: a run that was killed may have left some."""
    shutil.rmtree(folder / LIVE, ignore_errors=True)
    try:
        yield
    finally:
        shutil.rmtree(folder / LIVE, ignore_errors=True)


@dataclass
class _Shown:
    """A slot of the mosaic."""

    episode: Episode
    step: int = 0
    verdict: str = "live"


class LivePublisher:
    """An episode recorder that publishes what the running episodes look like.

    Args:
        publish: called with this process's name and its newest frame, or None at the end; may raise ``OSError``.
        instructions: of each task.
        camera: shown; where there is no such camera, the first one.
        name: of this process.
        clock: seconds.
    """

    def __init__(
        self,
        publish: Callable[[str, bytes | None], None],
        instructions: Sequence[str] = (),
        *,
        camera: str = "agentview",
        name: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._publish, self._instructions, self._camera = publish, instructions, camera
        self._name, self._clock = name or own_name(), clock
        self._env: BatchEnv | None = None
        self._shown: dict[int, _Shown] = {}
        self._mosaic = np.zeros((0, 0, 3), np.uint8)
        self._due, self._number, self._turn = clock(), 0, 0
        self._draws = self._works = True
        self._drawn_at_once, self._drawn = DRAWN_FIRST, 0
        self._steps, self._counted_since = 0, clock()

    def begin(self, env: BatchEnv, episodes: Mapping[int, Episode]) -> None:
        """Episodes have begun in some slots."""
        if env is not self._env:
            self._env, self._shown = env, {}
            count = min(env.num_envs, MOST_SLOTS)
            rows, columns = -(-count // COLUMNS), min(count, COLUMNS)
            self._mosaic = np.full((rows * TILE, columns * TILE, 3), _BACKGROUND, np.uint8)
        for slot, episode in episodes.items():
            if slot < MOST_SLOTS:
                self._shown[slot] = _Shown(episode)

    def observe(self, env: Observable, slots: Sequence[int], actions: np.ndarray) -> None:
        """See one tick of some slots before it happens; a frame is made when one is due."""
        del env, actions  # what is shared with other recorders draws every slot
        self._steps += len(slots)
        for slot in self._shown.keys() & set(slots):
            self._shown[slot].step += 1
        if self._works and self._clock() >= self._due:
            self._make_frame(sorted(self._shown.keys() & set(slots)))

    def finish(self, env: BatchEnv, records: Mapping[int, Record]) -> None:
        """Episodes have ended; their tiles stay until other episodes begin in the slots."""
        del env
        for slot in self._shown.keys() & records.keys():
            record = records[slot]
            self._shown[slot].verdict = "fault" if record.fault else "success" if record.success else "failure"
            self._shown[slot].step = record.num_steps

    def close(self) -> None:
        """Remove the frame."""
        self._env, self._shown = None, {}
        self._tell(None)

    def _make_frame(self, live: Sequence[int]) -> None:
        began = self._clock()
        try:
            if self._draws:
                self._draw(live)
        except Exception as error:  # an environment without images is no reason to lose an episode
            self._draws = False
            _log.warning("--live: no images are shown: %s: %s", type(error).__name__, " ".join(str(error).split()))
        self._tell(pack(self._header(), self._jpeg()))
        cost = self._clock() - began
        self._due = began + PERIOD_S
        if self._number == 1:  # it paid for the renderer, which is made once
            self._drawn_at_once = 1
            return
        self._due = began + max(PERIOD_S, cost / SHARE)
        if self._drawn:
            fitting = int(SHARE * PERIOD_S * self._drawn / max(cost, 1e-6))
            self._drawn_at_once = max(1, min(fitting, 2 * self._drawn_at_once, MOST_SLOTS))

    def _draw(self, live: Sequence[int]) -> None:
        """Draw the next of the live slots into the mosaic."""
        from PIL import Image, ImageOps

        assert self._env is not None
        later = [slot for slot in live if slot >= self._turn]
        chosen = (later + [slot for slot in live if slot < self._turn])[: self._drawn_at_once]
        self._drawn = len(chosen)
        if not chosen:
            return
        self._turn = chosen[-1] + 1
        images = self._env.observe_egocentric(chosen).images
        names = list(images)
        if not names:  # an environment without cameras
            self._draws = False
            return
        pixels = images[self._camera if self._camera in images else names[0]]
        for slot in chosen:
            tile = ImageOps.pad(Image.fromarray(np.asarray(pixels[slot])), (TILE, TILE))
            y, x = divmod(slot, COLUMNS)
            self._mosaic[y * TILE : (y + 1) * TILE, x * TILE : (x + 1) * TILE] = np.asarray(tile)

    def _header(self) -> dict[str, Any]:
        assert self._env is not None
        now, slots = self._clock(), sorted(self._shown)
        rate, self._steps = self._steps / max(now - self._counted_since, 1e-6), 0
        self._counted_since, self._number = now, self._number + 1
        shown = [self._shown[slot] for slot in slots]
        return {
            "type": "wall",
            "process": self._name,
            "host": platform.node(),
            "pid": os.getpid(),
            "time": time.time(),
            "number": self._number,
            "num_slots": self._env.num_envs,
            "steps_per_s": round(rate, 2),
            "tile": TILE,
            "columns": COLUMNS,
            "slots": slots,
            "ticks": [each.step for each in shown],
            "verdicts": [each.verdict for each in shown],
            "episodes": [each.episode.id for each in shown],
            "instructions": [self._instruction(each.episode.task) for each in shown],
        }

    def _instruction(self, task: int) -> str:
        return self._instructions[task][:_MOST_TEXT] if task < len(self._instructions) else ""

    def _jpeg(self) -> bytes:
        from PIL import Image

        buffer = io.BytesIO()
        Image.fromarray(self._mosaic).save(buffer, "JPEG", quality=_QUALITY)
        return buffer.getvalue()

    def _tell(self, content: bytes | None) -> None:
        try:
            if self._works or content is None:
                self._publish(self._name, content)
        except OSError as error:
            self._works = False
            _log.warning("--live: newest images cannot be written: %s", error.strerror or error)
