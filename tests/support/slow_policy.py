"""A policy whose every action takes a while, so that something can happen to a run before it is over."""

from __future__ import annotations

import os
import time

import numpy as np

from vecenv.contract import BatchEnv, ResetInfo


class SlowPolicy:
    """Holds still; each action takes ``seconds``."""

    name = "slow"

    def __init__(self, seconds: float = 0.05) -> None:
        self._seconds = seconds

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        pass

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        pass

    def act(self, env: BatchEnv) -> np.ndarray:
        time.sleep(self._seconds)
        return np.zeros((env.num_envs, 7))


class FailingPolicy(SlowPolicy):
    """Cannot be made."""

    def __init__(self) -> None:
        raise ValueError("negative seconds")


class FatalPolicy(SlowPolicy):
    """Ends its process at its first action, as a segmentation fault would."""

    def act(self, env: BatchEnv) -> np.ndarray:
        os._exit(1)
