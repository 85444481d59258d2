"""An environment of coloured images, for what watches episodes: no physics, no rendering."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
from vecenv_eval.store import Record

from vecenv.observations import Egocentric

SIZE = 32


class FilmedEnv:
    """Every slot shows one shade of grey, 10 more each tick; the wrist camera shows it inverted.

    Args:
        num_envs: slots.
        cameras: names -> height of an image.
        control_hz: control ticks a second.
    """

    def __init__(
        self, num_envs: int = 2, cameras: Mapping[str, int] | None = None, control_hz: float = 20.0, state: int = 8
    ) -> None:
        self.num_envs, self.control_hz, self.looks = num_envs, control_hz, 0
        self.shades, self.state = np.zeros(num_envs, int), state
        self._cameras = {"agentview": SIZE, "wrist": SIZE} if cameras is None else cameras
        self._watchers: list[Callable[[np.ndarray, np.ndarray], None]] = []

    def observe_egocentric(self, slots: npt.ArrayLike | None = None) -> Egocentric:
        self.looks += 1
        images = {}
        for name, height in self._cameras.items():
            shades = 255 - self.shades if name == "wrist" else self.shades
            images[name] = np.full((self.num_envs, height, SIZE, 3), shades[:, None, None, None], np.uint8)
            if slots is not None:
                images[name][~np.isin(np.arange(self.num_envs), np.asarray(slots))] = 0
        state = np.repeat(self.shades[:, None], self.state, axis=1).astype(np.float32)
        return Egocentric(state=state, images=images)

    @contextmanager
    def watched(self, watcher: Callable[[np.ndarray, np.ndarray], None]) -> Iterator[None]:
        self._watchers.append(watcher)
        yield
        self._watchers.remove(watcher)

    def tick(self, *active: int) -> None:
        """One control tick of some slots; their actions are the tick's shade / 255."""
        moved = np.isin(np.arange(self.num_envs), active)
        actions = np.repeat(self.shades[:, None] / 255, 7, axis=1)
        for watcher in self._watchers:
            watcher(actions, moved)
        self.shades[moved] += 10


def record(
    episode: int = 0, success: bool = True, *, suite: str = "libero_goal", steps: int = 3, **more: Any
) -> Record:
    """How an episode went."""
    return Record(
        suite=suite,
        task=1,
        episode=episode,
        instruction=more.pop("instruction", "open the drawer"),
        success=success,
        success_first=success,
        success_final=success,
        num_steps=steps,
        reward=float(success),
        **more,
    )
