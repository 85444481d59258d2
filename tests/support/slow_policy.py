"""A policy whose every action takes a while, so that something can happen to a run before it is over."""

from __future__ import annotations

import os
import time
from pathlib import Path

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


class TellingPolicy(SlowPolicy):
    """Reports in which process it acts."""

    def __init__(self) -> None:
        super().__init__(seconds=0)

    def extras(self, slot: int) -> dict[str, int]:
        return {"process": os.getpid()}


class MeetingPolicy(SlowPolicy):
    """Acts once as many processes as ``processes`` have got so far; each leaves a file in ``folder``."""

    def __init__(self, folder: str, processes: int) -> None:
        super().__init__()
        self._folder, self._processes = Path(folder), processes

    def act(self, env: BatchEnv) -> np.ndarray:
        (self._folder / str(os.getpid())).touch()
        until = time.monotonic() + 60
        while len(list(self._folder.iterdir())) < self._processes and time.monotonic() < until:
            time.sleep(0.05)
        return super().act(env)


class FailingPolicy(SlowPolicy):
    """Cannot be made."""

    def __init__(self) -> None:
        raise ValueError("negative seconds")


class FatalPolicy(SlowPolicy):
    """Ends its process at its first action, as a segmentation fault would."""

    def act(self, env: BatchEnv) -> np.ndarray:
        os._exit(1)
