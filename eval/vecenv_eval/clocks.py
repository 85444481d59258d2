"""Where the time of each episode went, and how many of its actions had to be sanitized.

In: the controls of a batch as they come. Out: seconds by slot: the wall clock while the slot was live, and its share of
what the batch spent in physics, in rendering and in the policy. Slots that are live at the same time share equally, so
the shares of all episodes add up to the time of the run.
"""

from __future__ import annotations

import time

import numpy as np

from vecenv.contract import BatchEnv, Control, Timings


class EpisodeClocks:
    """Clocks of the slots of one environment, which was just reset.

    Args:
        env: the environment; one without ``timings`` counts everything as the policy's.
        setup_s: seconds that placing it took.

    Attributes:
        sanitized: calls whose actions had to be sanitized, int [B].
        sanitized_first: control tick of the first of them, int [B].
    """

    def __init__(self, env: BatchEnv, setup_s: float) -> None:
        count = env.num_envs
        self._env, self._started = env, time.perf_counter()
        self._begun = np.full(count, self._started)
        self._setup = np.full(count, setup_s)
        self._shares = np.zeros((3, count))
        self._live = np.ones(count, bool)
        self._last = self._readings()
        self.sanitized = np.zeros(count, int)
        self.sanitized_first = np.zeros(count, int)
        self._steps = np.zeros(count, int)

    def now(self) -> float:
        """Seconds since the environment was placed."""
        return time.perf_counter() - self._started

    def begin(self, slots: np.ndarray, setup_s: float) -> None:
        """Slots begin other episodes; placing them took ``setup_s``."""
        self._begun[slots], self._setup[slots] = time.perf_counter(), setup_s
        self._shares[:, slots] = 0
        for table in (self.sanitized, self.sanitized_first, self._steps):
            table[slots] = 0
        self._live[slots] = True
        self._last = self._readings()

    def tick(self, control: Control) -> None:
        """A control has come; the slots that were live share the time since the last."""
        now = self._readings()
        if self._live.any():
            self._shares[:, self._live] += ((now - self._last) / self._live.sum())[:, None]
        self._last = now
        bad = np.asarray(control.info["sanitized"], bool) & self._live
        first = bad & (self.sanitized == 0)
        self.sanitized_first[first] = self._steps[first]
        self.sanitized += bad
        self._steps = control.step_index.copy()
        self._live &= ~control.done

    def seconds_of(self, slot: int) -> dict[str, float]:
        """``setup_s``, ``wall_s``, ``policy_s``, ``physics_s`` and ``images_s`` of a slot's episode."""
        total, physics, images = self._shares[:, slot].tolist()
        return {
            "setup_s": float(self._setup[slot]),
            "wall_s": time.perf_counter() - float(self._begun[slot]),
            "policy_s": max(0.0, total - physics - images),
            "physics_s": physics,
            "images_s": images,
        }

    def _readings(self) -> np.ndarray:
        """Seconds on the wall clock, in physics and in rendering."""
        spent = getattr(self._env, "timings", Timings())
        return np.array([time.perf_counter(), spent.physics_s, spent.images_s])
