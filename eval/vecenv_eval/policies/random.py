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
        self._block = np.zeros((0, _BLOCK, ACTION_DIM))
        self._ticks = np.zeros(0, int)

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Seed one generator a slot with the name of its episode."""
        self._generators = [self._generator(name) for name in info.episode_id]
        self._block = np.zeros((env.num_envs, _BLOCK, ACTION_DIM))
        self._ticks = np.zeros(env.num_envs, int)

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Likewise for the slots that begin."""
        del env
        for slot in slots.tolist():
            self._generators[slot] = self._generator(info.episode_id[slot])
        self._ticks[slots] = 0

    def act(self, env: BatchEnv) -> np.ndarray:
        """The next action of every slot, [B, 7]."""
        del env
        draw, held = np.divmod(self._ticks, self._hold)
        for slot in np.flatnonzero((held == 0) & (draw % _BLOCK == 0)).tolist():
            self._block[slot] = self._generators[slot].uniform(-1, 1, (_BLOCK, ACTION_DIM))
        self._ticks += 1
        return self._block[np.arange(len(draw)), draw % _BLOCK]

    def _generator(self, episode_id: str) -> np.random.Generator:
        return np.random.default_rng([self._seed, zlib.crc32(episode_id.encode())])
