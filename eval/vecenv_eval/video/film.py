"""How the slots of a batch are shown in one video: how often, how fast, and what is around each image."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vecenv.libero.render.options import RenderError
from vecenv_eval.video.grid import GAP

# Most episodes that one video shows.
MOST_EPISODES = 100
# Most frames a second; browsers show animated images no faster.
MOST_FPS = 100


@dataclass(frozen=True, kw_only=True)
class Film:
    """Options of a video of many slots.

    Attributes:
        every: show the state before every so many control ticks; the end of an episode is shown in any case.
        fps: frames a second; None for as fast as the robot moves.
        columns: slots in a row; None for about as many as there are rows.
        titles: whether each image has its episode and instruction above it.
        border: width of the frame around each image, which gets the colour of its verdict, pixels.
        hold: for how long the last frame stays, seconds.

    Raises:
        RenderError: a number that is not finite or too small; the message names it.
    """

    every: int = 1
    fps: float | None = None
    columns: int | None = None
    titles: bool = True
    border: int = GAP
    hold: float = 0.0

    def __post_init__(self) -> None:
        for name, least in (("every", 1), ("columns", 1), ("border", 0), ("hold", 0)):
            value = getattr(self, name)
            if value is not None and not least <= value < math.inf:
                raise RenderError(f"{name}={value}: need at least {least}")
        if self.fps is not None and not 0 < self.fps <= MOST_FPS:
            raise RenderError(f"fps={self.fps}: need more than 0 and at most {MOST_FPS}")

    def rate(self, control_hz: float) -> float:
        """Frames a second of a video of a robot with so many control ticks a second."""
        return self.fps or control_hz / self.every

    def held(self, control_hz: float) -> int:
        """How many more frames the last one stays for."""
        return round(self.hold * self.rate(control_hz))
