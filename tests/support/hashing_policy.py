"""The random policy, reporting a hash of every state that an episode went through: trajectories are told apart."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from vecenv_eval.policies.random import RandomPolicy

from vecenv.contract import BatchEnv, ResetInfo


class HashingPolicy:
    """Acts at random; ``extras`` has the hash of all positions and velocities before each action."""

    name = "hashing"

    def __init__(self, seed: int = 0) -> None:
        self._policy = RandomPolicy(seed=seed)
        self._hashes: list[Any] = []

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self._hashes = [hashlib.sha256() for _ in range(env.num_envs)]
        self._policy.reset(env, info)

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        for slot in slots.tolist():
            self._hashes[slot] = hashlib.sha256()
        self._policy.reset_slots(env, info, slots)

    def act(self, env: BatchEnv) -> np.ndarray:
        state = env.state()
        for slot in np.flatnonzero(~env.done).tolist():
            self._hashes[slot].update(state.qpos[slot, : state.nq[slot]].tobytes())
            self._hashes[slot].update(state.qvel[slot, : state.nv[slot]].tobytes())
        return self._policy.act(env)

    def extras(self, slot: int) -> dict[str, str]:
        return {"states": self._hashes[slot].hexdigest()}
