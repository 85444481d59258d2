"""Policies that follow a fixed script: so far the one that holds still."""

from __future__ import annotations

import numpy as np

from vecenv.contract import ACTION_DIM, BatchEnv, ResetInfo


class ZeroPolicy:
    """Holds the arm where it is, with a fixed gripper command: what succeeds here, succeeds by itself.

    Args:
        gripper: last column of every action; -1 opens on LIBERO.
    """

    name = "zero"

    def __init__(self, gripper: float = -1.0) -> None:
        self._action = np.zeros(ACTION_DIM)
        self._action[-1] = gripper
        self._actions = self._action[None]

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Repeat the action for every slot."""
        del info
        self._actions = np.tile(self._action, (env.num_envs, 1))

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Nothing to begin: every episode has the same actions."""

    def act(self, env: BatchEnv) -> np.ndarray:
        """The same action for every slot, [B, 7]."""
        del env
        return self._actions
