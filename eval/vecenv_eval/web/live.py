"""The newest images of a running evaluation, read from its folder (``vecenv_eval.live`` has who writes them).

A look at a run comes in; frames go out, one a process that runs episodes. What a process left that was killed is not
shown; what another machine wrote is shown with its age, and no longer after ten minutes.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vecenv_eval.live import ENDING, LIVE, MOST_BYTES, MOST_SLOTS, LiveError, pack, unpack
from vecenv_eval.web.rows import UnsafePath, regular_file
from vecenv_eval.web.runs import Snapshot

# Most processes of a run that are shown.
MOST_PROCESSES = 64
# Seconds after which a frame is too old to be shown.
OLDEST_S = 600.0
# A frame of this age, seconds, is one of a run that goes on.
FRESH_S = 60.0
_Text = Annotated[str, Field(max_length=1000)]
_Count = Annotated[int, Field(ge=0, le=2**53)]


class Header(BaseModel):
    """What a process says about its mosaic: the slots that it shows, tile by tile; see ``LivePublisher``."""

    model_config = ConfigDict(extra="ignore")

    type: Literal["wall"]
    process: _Text
    host: _Text
    pid: _Count
    time: Annotated[float, Field(allow_inf_nan=False)]
    number: _Count
    num_slots: _Count
    steps_per_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    tile: Annotated[int, Field(ge=1, le=512)]
    columns: Annotated[int, Field(ge=1, le=MOST_SLOTS)]
    slots: Annotated[list[Annotated[int, Field(ge=0, lt=MOST_SLOTS)]], Field(max_length=MOST_SLOTS)]
    ticks: Annotated[list[_Count], Field(max_length=MOST_SLOTS)]
    verdicts: Annotated[list[Literal["live", "success", "failure", "fault"]], Field(max_length=MOST_SLOTS)]
    episodes: Annotated[list[_Text], Field(max_length=MOST_SLOTS)]
    instructions: Annotated[list[_Text], Field(max_length=MOST_SLOTS)]


@dataclass(frozen=True, kw_only=True)
class LiveFrame:
    """The newest frame of one process.

    Attributes:
        header: what it says.
        jpeg: the mosaic.
        age_s: seconds since it was written.
        leg: name of the leg whose episodes it shows.
        folder: the results folder it was in, below the run's; of shards the one of this process.
    """

    header: Header
    jpeg: bytes
    age_s: float
    leg: str
    folder: str

    @property
    def identity(self) -> tuple[str, str, int, float]:
        """Another one for every frame."""
        return (self.leg, self.header.process, self.header.number, self.header.time)

    def message(self) -> bytes:
        """The frame as the stream sends it."""
        about = {"age_s": round(self.age_s, 1), "leg": self.leg, "folder": self.folder}
        return pack({**self.header.model_dump(), **about}, self.jpeg)


def live_frames(run: Snapshot) -> list[LiveFrame]:
    """The newest frame of every process that runs episodes of a run, by leg and process."""
    found: list[LiveFrame] = []
    for leg in run.legs:
        for folder in leg.folders:
            place = run.name if folder == run.folder else folder.relative_to(run.folder).as_posix()
            for path in _files(folder):
                frame = _read(path, leg.name, place)
                if frame is not None and len(found) < MOST_PROCESSES:
                    found.append(frame)
    return sorted(found, key=lambda frame: (frame.leg, frame.header.process))


def _files(folder: Path) -> Iterator[Path]:
    try:
        names = sorted(entry.name for entry in os.scandir(folder / LIVE) if entry.name.endswith(ENDING))
    except OSError:
        return
    for name in names[:MOST_PROCESSES]:
        try:
            path = regular_file(folder, f"{LIVE}/{name}")
        except UnsafePath:
            continue
        if path is not None:
            yield path


def _read(path: Path, leg: str, folder: str) -> LiveFrame | None:
    """A frame; None when it is damaged, old, or of a process of this machine that is gone."""
    try:
        about = path.stat()
        age = max(0.0, time.time() - about.st_mtime)
        if age > OLDEST_S or about.st_size > MOST_BYTES:
            return None
        values, jpeg = unpack(path.read_bytes())
        header = Header.model_validate(values)
    except (OSError, LiveError, ValidationError):
        return None
    lengths = {
        len(each) for each in (header.slots, header.ticks, header.verdicts, header.episodes, header.instructions)
    }
    gone = header.host == platform.node() and not _is_alive(header.pid)
    return None if len(lengths) != 1 or gone else LiveFrame(header=header, jpeg=jpeg, age_s=age, leg=leg, folder=folder)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True  # somebody else's
    return True
