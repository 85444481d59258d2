"""Following a plan of waypoints: every slot advances to its next waypoint when it has reached the current one.

In: a checked plan and, tick by tick, the facts of all slots. Out: the rewards, which waypoints were reached, and how
many ticks each one took.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vecenv.controllers.waypoint import WaypointPlan
from vecenv.simpler.control.servo import Servo


class PlanFollower:
    """Follows one plan.

    Args:
        servo: drives the tools.
        plan: arrays [B, T, ...]; rows that are not valid are skipped.
        max_misses: a slot stops after this many missed waypoints in a row; None for no limit.

    Attributes:
        converged: waypoints that were reached within tolerance, bool [B, T].
        ticks: control ticks that each waypoint took, [B, T].
    """

    def __init__(self, servo: Servo, plan: WaypointPlan, max_misses: int | None) -> None:
        self._servo, self._max_misses = servo, max_misses
        self._targets = np.concatenate([plan.pose.pos, plan.pose.quat, np.asarray(plan.grip)[..., None]], axis=-1)
        self._hold, self._valid = np.asarray(plan.hold), np.asarray(plan.valid)
        self.converged = np.zeros(self._valid.shape, bool)
        self.ticks = np.zeros(self._valid.shape, int)
        count = len(self._valid)
        self._index, self._misses = np.zeros(count, int), np.zeros(count, int)
        self._rows = np.arange(count)

    def run(
        self,
        tick: Callable[[np.ndarray, np.ndarray], np.ndarray],
        facts: Callable[[], np.ndarray],
        done: Callable[[], np.ndarray],
    ) -> np.ndarray:
        """Follow the plan to its end.

        Args:
            tick: one control tick, from actions [B, 7] and active slots (bool [B]) to rewards [B].
            facts: the current rows of ``physics.spec.facts_dtype``, [B].
            done: which slots have finished, bool [B].

        Returns:
            The sum of the rewards, [B].
        """
        servo, length, reward = self._servo, self._valid.shape[1], np.zeros(len(self._valid))
        servo.begin(facts()["tcp"])
        self._skip_invalid()
        while (going := (self._index < length) & ~done() & self._within_misses()).any():
            here = np.minimum(self._index, length - 1)
            targets, driving = self._targets[self._rows, here], self._hold[self._rows, here] == 0
            reward += tick(servo.actions(targets, driving & going, facts()), going)
            self.ticks[self._rows[going], here[going]] += 1
            self._advance(going, here, targets, driving, facts()["tcp"])
        return reward

    def _within_misses(self) -> np.ndarray:
        return self._misses < self._max_misses if self._max_misses is not None else np.ones(len(self._index), bool)

    def _advance(
        self, going: np.ndarray, here: np.ndarray, targets: np.ndarray, driving: np.ndarray, tool: np.ndarray
    ) -> None:
        """Advance slots that reached their waypoint, are stuck, or have spent its ticks."""
        rows = self._rows
        arrived = self._servo.arrived(targets, tool)
        limit = np.where(driving, self._servo.config.max_steps, self._hold[rows, here])
        stuck = self._servo.stuck(targets, tool, driving & going)
        spent = stuck | (self.ticks[rows, here] >= limit)
        leaving = going & ((driving & arrived) | spent)
        self.converged[rows[leaving], here[leaving]] = arrived[leaving]
        missed = leaving & driving & ~arrived
        self._misses = np.where(missed, self._misses + 1, np.where(leaving & driving, 0, self._misses))
        self._index += leaving
        self._skip_invalid()

    def _skip_invalid(self) -> None:
        length = self._valid.shape[1]
        for row in self._rows:
            while self._index[row] < length and not self._valid[row, self._index[row]]:
                self._index[row] += 1
