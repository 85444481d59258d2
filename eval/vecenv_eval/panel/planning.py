"""What VoxPoser has planned, small enough to be sent: its motions become :class:`~vecenv_eval.panel.state.Planning`."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from vecenv_eval.panel.state import Planning, Waypoint
from vecenv_eval.policies import Policy
from vecenv_eval.policies.voxposer import VoxPoserPolicy
from voxposer.planned import PlannedMotion

# Points of a path and waypoints that are kept; of more, evenly spaced ones with both ends.
MOST_POINTS = 64
# Decimals of metres and of quaternions.
_DECIMALS = 4


class Plans:
    """The latest plan of each slot; nothing for policies that do not plan.

    Args:
        policy: the policy, not reset yet.

    Attributes:
        on_motion: called with every motion as it is planned, on the thread of the environment.
    """

    def __init__(self, policy: Policy) -> None:
        self._policy = policy if isinstance(policy, VoxPoserPolicy) else None
        self._lock = threading.Lock()
        self.on_motion: Callable[[PlannedMotion], None] = lambda motion: None
        self._motions: dict[int, Planning] = {}
        self._tick = 0
        if self._policy is not None:
            self._policy.on_planned = self._planned

    def at(self, tick: int) -> None:
        """The session's tick, by which plans are dated."""
        self._tick = tick

    def forget(self, slot: int) -> None:
        """A slot begins another episode."""
        with self._lock:
            self._motions.pop(slot, None)

    def of(self, slot: int, instruction: str) -> Planning | None:
        """What was planned in a slot; None where the policy plans nothing, or no agent runs yet."""
        agent = None if self._policy is None else self._policy.agent
        if agent is None or slot >= len(agent.slots):
            return None
        with self._lock:
            motion = self._motions.get(slot)
        now = agent.slots[slot]
        latest = motion or Planning(
            slot=slot,
            instruction=instruction,
            subtasks=(),
            subtask=max(0, now.progress.number),
            text=now.progress.text,
            path=(),
            waypoints=(),
            cause="",
            tick=self._tick,
        )
        return Planning(
            **{
                **vars(latest),
                "instruction": instruction,
                "subtasks": now.progress.subtasks,
                "cause": now.error or now.cause,
            }
        )

    def _planned(self, motion: PlannedMotion) -> None:
        """Keep a motion; called while the policy acts."""
        path = motion.perception.grid.world(np.asarray(motion.path, float)) if len(motion.path) else np.zeros((0, 3))
        stops = [motion.stops[i] for i in _spread(len(motion.stops))]
        planning = Planning(
            slot=motion.slot,
            instruction="",
            subtasks=(),
            subtask=motion.subtask,
            text=motion.text,
            path=tuple(_triple(path[i]) for i in _spread(len(path))),
            waypoints=tuple(
                Waypoint(pos=_triple(stop.pos), quat=_quat(stop.quat), closed=bool(stop.closed)) for stop in stops
            ),
            cause="",
            tick=self._tick,
        )
        with self._lock:
            self._motions[motion.slot] = planning
        self.on_motion(motion)


def _spread(count: int) -> list[int]:
    """At most ``MOST_POINTS`` indices below ``count``, evenly spaced, both ends among them."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).round().astype(int)).tolist() if count else []


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (round(float(value), _DECIMALS) for value in values)
    return x, y, z


def _quat(values: np.ndarray) -> tuple[float, float, float, float]:
    w, x, y, z = (round(float(value), _DECIMALS) for value in values)
    return w, x, y, z
