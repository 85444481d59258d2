"""Uniformly random actions: a floor for success rates and a load for benchmarks."""

from __future__ import annotations

import zlib

import numpy as np

from vecenv.contract import ACTION_DIM, BatchEnv, ResetInfo

# Ticks drawn at a time, so that the draw itself is one call per slot in many ticks.
_BLOCK = 256


class RandomPolicy:
    """Uniform actions in [-1, 1].

    A slot's actions depend on the seed and on the episode in the slot, not on the batch around it: the same episode
    gets the same actions in any batch, at any batch size.

    Args:
        seed: names the sequence of actions.
        hold: ticks for which one draw is held.
    """

    name = "random"

    def __init__(self, seed: int = 0, hold: int = 1) -> None:
        if hold < 1:
            raise ValueError(f"hold must be at least 1 tick, not {hold}")
        self._seed, self._hold = seed, hold
        self._generators: list[np.random.Generator] = []
        self._block = np.zeros((0, 0, ACTION_DIM))
        self._tick = 0

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Seed one generator a slot with the name of its episode."""
        del env
        self._generators = [np.random.default_rng([self._seed, zlib.crc32(i.encode())]) for i in info.episode_id]
        self._tick = 0

    def act(self, env: BatchEnv) -> np.ndarray:
        """The next action of every slot, [B, 7]."""
        del env
        draw, held = divmod(self._tick, self._hold)
        if held == 0 and draw % _BLOCK == 0:
            self._block = np.stack([g.uniform(-1, 1, (_BLOCK, ACTION_DIM)) for g in self._generators])
        self._tick += 1
        return self._block[:, draw % _BLOCK]
