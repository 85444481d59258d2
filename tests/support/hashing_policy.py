"""Policies that report a hash of every state that an episode went through: trajectories are told apart."""

from __future__ import annotations

import hashlib
from typing import Any, Protocol

import numpy as np
from vecenv_eval.policies import Policy, Refillable
from vecenv_eval.policies.random import RandomPolicy

from vecenv.contract import BatchEnv, Control, ResetInfo


class Whole(Policy, Refillable, Protocol):
    """A policy that is refilled."""


class Hashing:
    """Acts as another policy; ``extras`` has the hash of all positions and velocities before each action."""

    def __init__(self, policy: Whole, name: str) -> None:
        self.name, self._policy = name, policy
        self._hashes: list[Any] = []

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self._hashes = [hashlib.sha256() for _ in range(env.num_envs)]
        self._policy.reset(env, info)

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        for slot in slots.tolist():
            self._hashes[slot] = hashlib.sha256()
        self._policy.reset_slots(env, info, slots)

    def act(self, env: BatchEnv) -> np.ndarray | Control:
        state = env.state()
        for slot in np.flatnonzero(~env.done).tolist():
            self._hashes[slot].update(state.qpos[slot, : state.nq[slot]].tobytes())
            self._hashes[slot].update(state.qvel[slot, : state.nv[slot]].tobytes())
        return self._policy.act(env)

    def extras(self, slot: int) -> dict[str, str]:
        return {"states": self._hashes[slot].hexdigest()}


class HashingPolicy(Hashing):
    """Acts at random."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__(RandomPolicy(seed=seed), "hashing")
