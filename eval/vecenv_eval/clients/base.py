"""What all clients of policy servers share: a policy that asks for chunks of actions and executes them slot by slot.

The harness calls ``reset`` and ``act``. A slot whose queue is empty asks; the others go on with the chunk they have, so
slots need not be in step. A slot that is given another episode while the others go on is announced by ``reset_slots``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from vecenv.contract import ACTION_DIM, BatchEnv, ResetInfo
from vecenv_eval.clients.config import ServerConfig
from vecenv_eval.clients.errors import PolicyServerError
from vecenv_eval.clients.frames import Frames, observe
from vecenv_eval.clients.gripper import convert
from vecenv_eval.clients.queues import ActionQueues

_Config = TypeVar("_Config", bound=ServerConfig)
_Answer = TypeVar("_Answer")


class RemotePolicy(Generic[_Config]):
    """A policy that runs as a server; subclasses speak one protocol each.

    Args:
        config: where the server is, and the options of the protocol.

    Attributes:
        name: how the policy is called in results.
    """

    name = "remote"

    def __init__(self, config: _Config) -> None:
        self.config = config
        self.server = f"{self.name} at {config.address}"
        self._queues = ActionQueues(0)

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Begin with a freshly placed batch.

        Raises:
            PolicyServerError: the server cannot be reached or refuses.
        """
        self._queues = ActionQueues(env.num_envs)
        self._begin_batch(env)
        self.reset_slots(env, info, np.arange(env.num_envs))

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Begin other episodes in some slots while the others continue: their remaining actions are dropped."""
        del info
        self._queues.clear(slots.tolist())
        self._begin_episodes(env, slots.tolist())

    def act(self, env: BatchEnv) -> np.ndarray:
        """One action for every slot, float64 [B, 7], zeros where the episode has finished.

        Raises:
            PolicyServerError: the server cannot be reached, takes too long, or reports an error.
            ImagesUnavailable: the environment lacks a camera that the server wants.
        """
        done = np.asarray(env.done)
        self._before_asking(env, done)
        live = np.flatnonzero(~done)
        asking = live[self._queues.empty[live]]
        if len(asking):
            frames = observe(env, asking, self._cameras())
            for slot, chunk in zip(asking.tolist(), self._ask(frames), strict=True):
                self._queues.fill(slot, convert(chunk, self.config.gripper))
        return self._queues.pop(live.tolist())

    def needed_cameras(self) -> Sequence[str]:
        """Whose images are sent, as far as is known before the server was asked."""
        return self._cameras()

    def close(self) -> None:
        """Close the connections; the next call opens them again."""

    def _cameras(self) -> Sequence[str]:
        """Whose images the server wants."""
        raise NotImplementedError

    def _ask(self, frames: Frames) -> Sequence[np.ndarray]:
        """A chunk of actions [K, 7] for each of the slots in ``frames``."""
        raise NotImplementedError

    def _begin_batch(self, env: BatchEnv) -> None:
        """Called when a new batch begins."""

    def _begin_episodes(self, env: BatchEnv, slots: Sequence[int]) -> None:
        """Called when new episodes begin in some slots."""

    def _before_asking(self, env: BatchEnv, done: np.ndarray) -> None:
        """Called at each tick, with which slots have finished, bool [B]."""

    def _in_parallel(self, jobs: Sequence[Callable[[], _Answer]]) -> list[_Answer]:
        """Run jobs, at most ``connections`` at once; the first failure cancels those that have not begun."""
        if self.config.connections == 1 or len(jobs) < 2:
            return [job() for job in jobs]
        with ThreadPoolExecutor(min(self.config.connections, len(jobs))) as pool:
            futures = [pool.submit(job) for job in jobs]
            try:
                return [future.result() for future in futures]
            except BaseException:
                for future in futures:
                    future.cancel()
                raise

    def _chunk(self, value: npt.ArrayLike | None, steps: int = 0) -> np.ndarray:
        """Check what a server answered for one slot: [7] or [K, 7] becomes its first ``steps`` actions (0: all)."""
        try:
            chunk = np.atleast_2d(np.asarray(value, dtype=np.float64))
        except (TypeError, ValueError):
            raise self._error(f"it answered actions that are no numbers but {type(value).__name__}") from None
        if chunk.ndim != 2 or chunk.shape[1] != ACTION_DIM or not len(chunk):
            raise self._error(f"it answered actions of shape {np.shape(chunk)}; expected [K, {ACTION_DIM}]")
        if len(chunk) < steps:
            raise self._error(f"it answered {len(chunk)} actions, fewer than replan_steps={steps}")
        return chunk[: steps or None]

    def _error(self, cause: str) -> PolicyServerError:
        return PolicyServerError(self.server, cause)
