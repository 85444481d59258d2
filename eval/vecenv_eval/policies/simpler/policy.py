"""``simpler_scripted``: a policy with ground truth that solves SIMPLER's tasks, to show that every task can be solved.

It sees the environment through its public verbs: ``observe_objects`` and joints in, ``step_waypoints`` out. Every slot
follows a script of its own (``motions``), grasps are chosen by rehearsing them (``grasps``,
``reach``). A slot that waits for others loses no ticks.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vecenv.contract import BatchEnv, Control, ResetInfo
from vecenv.simpler.assets import files as assets
from vecenv.simpler.env import SimplerEnv
from vecenv_eval.policies.simpler.motions import SCRIPTS, Look, Memory, Script
from vecenv_eval.policies.simpler.reach import Arm, Waypoint


@dataclass
class _Slot:
    """Where a slot stands: its script, what it remembers, scripts begun so far, and the cause if it gave up."""

    script: Script | None = None
    memory: Memory = field(default_factory=Memory)
    attempts: int = 0
    cause: str = ""


class SimplerScriptedPolicy:
    """Ground-truth policy for all 25 tasks of SIMPLER.

    Args:
        attempts: how often a slot may start again before it stays where it is.

    Attributes:
        name: how the policy is called in results.
    """

    name = "simpler_scripted"

    def __init__(self, attempts: int = 8) -> None:
        self.attempts = attempts
        self._slots: list[_Slot] = []
        self._arm: Arm | None = None

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        """Begin with a freshly placed batch.

        Raises:
            TypeError: not a SIMPLER environment.
        """
        if not isinstance(env, SimplerEnv):
            raise TypeError(f"{self.name} works on SIMPLER's suites, not on {info.suite}")
        self._arm = Arm(env.robot, assets.simpler_root(env.config.assets))
        self._slots = [_Slot() for _ in range(env.num_envs)]

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        """Begin from nothing in the slots that begin."""
        del env, info
        for slot in slots.tolist():
            self._slots[slot] = _Slot()

    def act(self, env: BatchEnv) -> Control:
        """The next few waypoints of every slot, followed to their end."""
        plans = [self._next(slot, look) for slot, look in zip(self._slots, self._looks(env), strict=True)]
        return env.step_waypoints(_joined(plans))

    def extras(self, slot: int) -> dict[str, Any]:
        """Attempts made in a slot, and why it gave up, if it did."""
        return {"attempts": self._slots[slot].attempts, "cause": self._slots[slot].cause}

    def _looks(self, env: BatchEnv) -> list[Look | None]:
        """What each slot looks like; None where there is no ground truth."""
        state = env.observe_egocentric().state.astype(float)
        assert self._arm is not None, "call reset() first"
        dof = self._arm.robot.dof
        return [
            Look(snapshot, row[:dof], row[2 * dof :]) if snapshot is not None else None
            for snapshot, row in zip(env.observe_objects().snapshot, state, strict=True)
        ]

    def _next(self, slot: _Slot, look: Look | None) -> list[Waypoint]:
        """The next waypoints of a slot; when it has given up it stays where it is."""
        if look is None:
            return [Waypoint(np.array([0, 0, 0, 1.0, 0, 0, 0]), 0.0, hold=1)]
        while not slot.cause:
            waypoints = self._advance(slot, look)
            if waypoints:
                return waypoints
        return [Waypoint(look.snapshot.ee_pose, 0.0, hold=10)]

    def _advance(self, slot: _Slot, look: Look) -> list[Waypoint]:
        """Waypoints from the script, or from a new one; empty when a script has ended."""
        try:
            if slot.script is not None:
                return slot.script.send(look)
            if slot.attempts >= self.attempts:
                slot.cause = f"gave up after {slot.attempts} attempts"
                return []
            slot.attempts += 1
            assert self._arm is not None
            slot.script = SCRIPTS[look.snapshot.goal[0][0]](self._arm, look, slot.memory)
            return next(slot.script)
        except StopIteration:
            slot.script = None
            return []


def _joined(plans: list[list[Waypoint]]) -> dict[str, np.ndarray]:
    """Plans of all slots as ``step_waypoints`` takes them; shorter ones end with waypoints that are not valid."""
    shape = len(plans), max(len(plan) for plan in plans)
    joined = {
        "poses": np.tile([0.0, 0, 0, 1, 0, 0, 0], (*shape, 1)),
        "grip": np.zeros(shape),
        "hold": np.zeros(shape, int),
        "valid": np.zeros(shape, bool),
    }
    for row, plan in enumerate(plans):
        for column, waypoint in enumerate(plan):
            joined["poses"][row, column] = waypoint.pose
            joined["grip"][row, column], joined["hold"][row, column] = waypoint.grip, waypoint.hold
            joined["valid"][row, column] = True
    return joined
