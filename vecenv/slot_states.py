"""How the episodes in the slots of a batch stand, as arrays: live or finished, steps, rewards, verdicts and faults.

In: what happened in control ticks (which slots took them, which goals hold, whose physics failed). Out: rewards, and
the arrays that ``vecenv.slots`` reports. The rules are those of ``vecenv.contract``; nothing here knows a simulator.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


class SlotStates:
    """The slots of a batch that was just placed; none is live.

    Args:
        max_steps: step budget of each slot in control ticks, int [B].
        until_success: an episode ends when its goal first holds; if not, when its budget is spent.

    Attributes:
        max_steps: as given.
        live: the slot was begun, bool [B]. It stays live when its episode has ended.
        steps: control ticks taken, int [B].
        terminated: the episode has ended with success, bool [B].
        truncated: it has ended otherwise, bool [B].
        success: the goal held after the last tick, bool [B].
        solved: the goal held after some tick, bool [B].
        reward: sum of the rewards, float64 [B].
        fault: of each slot, why its physics failed; "" where it did not.
    """

    def __init__(self, max_steps: np.ndarray, *, until_success: bool) -> None:
        self.max_steps, self._until_success = max_steps, until_success
        count = len(max_steps)
        self.live = np.zeros(count, bool)
        self.terminated = np.zeros(count, bool)
        self.truncated = np.zeros(count, bool)
        self.success = np.zeros(count, bool)
        self.solved = np.zeros(count, bool)
        self.steps = np.zeros(count, int)
        self.reward = np.zeros(count)
        self.fault = [""] * count

    @property
    def done(self) -> np.ndarray:
        """Slots that have finished their episode, bool [B]."""
        return self.terminated | self.truncated

    def replace(self, rows: np.ndarray, max_steps: np.ndarray) -> None:
        """Other episodes in the slots ``rows`` (int [n]), with budgets int [n]; they are not live."""
        self.max_steps[rows] = max_steps
        self.live[rows] = False
        self._clear(rows)

    def begin(self, stale: np.ndarray, failures: Mapping[int, str]) -> None:
        """Make slots (bool [B]) live at the start of their episodes; a slot that failed there is quarantined."""
        self._clear(np.flatnonzero(stale))
        self.live |= stale
        self.quarantine(stale, failures)

    def end(self, rows: np.ndarray) -> None:
        """Truncate the episodes in the slots ``rows`` (int [n]) that have not ended with success."""
        self.truncated[rows] |= ~self.terminated[rows]

    def book(
        self,
        ticks: np.ndarray,
        success: np.ndarray,
        failures: Mapping[int, str],
        solved: np.ndarray | None = None,
    ) -> np.ndarray:
        """Update steps, success and rewards after ticks.

        Args:
            ticks: how many it took, int or bool [B].
            success: whether its goal held after the last of them, bool [B].
            failures: slot -> why its physics failed; healthy slots are left out.
            solved: whether its goal held after any of them, bool [B]; as ``success`` where each took one at most.

        Returns:
            Rewards, [B]: 1 where the goal held for the first time in the episode.
        """
        active = ticks > 0
        self.steps += ticks
        spent = active & (self.steps >= self.max_steps)
        before = self.solved.copy()
        self.success[active] = success[active]
        self.solved |= active & (success if solved is None else solved)
        self.terminated |= success & (active if self._until_success else spent)
        self.truncated |= spent & ~success
        self.quarantine(active, failures)
        # A quarantined slot has no success and no reward.
        reward = np.where(self.solved & ~before, 1.0, 0.0)
        self.reward += reward
        return reward

    def quarantine(self, among: np.ndarray, failures: Mapping[int, str]) -> None:
        """End those of the slots ``among`` (bool [B]) whose physics failed: truncated, without success."""
        for slot, reason in failures.items():
            if among[slot] and not self.fault[slot]:
                self.fault[slot] = reason
                self.truncated[slot] = True
                self.terminated[slot] = self.success[slot] = self.solved[slot] = False

    def _clear(self, rows: np.ndarray) -> None:
        """No tick, reward, verdict or fault in some slots."""
        for array in (self.terminated, self.truncated, self.success, self.solved, self.steps, self.reward):
            array[rows] = 0
        for slot in rows.tolist():
            self.fault[slot] = ""
