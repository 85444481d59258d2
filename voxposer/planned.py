"""What ``voxposer.runtime`` returns: subtasks of instructions, trajectories of subtasks, and motions for display."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vecenv.manipulation.routes import Stop
from voxposer.episode import Trajectory
from voxposer.perception.view import Perception
from voxposer.requests import MotionRequest


@dataclass(frozen=True)
class PlannedMotion:
    """One motion as it was planned, for display.

    Attributes:
        slot: index of the slot.
        subtask: number of the subtask.
        text: its words.
        request: what the program asked for, its maps evaluated.
        perception: the snapshot it was planned on.
        path: over voxels, [P, 3].
        stops: the stops of the hand along it; none for an object that is pushed along the path.
        obstacles: the obstacle map that the path was planned on, [N, N, N] in 0..1; None where nothing was planned.
        start: where the hand was taken to be, xyz + wxyz, world frame, [7].
        closed: whether its grip was taken to be closed.
        calls: the subtask's questions to the model, as a range of the slot's trace.
        value: the affordance map that was descended, cost to go, [N, N, N]; None where it follows from targets and
            obstacles, as upstream's does.
    """

    slot: int
    subtask: int
    text: str
    request: MotionRequest
    perception: Perception
    path: np.ndarray
    stops: tuple[Stop, ...]
    obstacles: np.ndarray | None = None
    start: np.ndarray = field(default_factory=lambda: np.zeros(7))
    closed: bool = False
    calls: range = range(0)
    value: np.ndarray | None = None


class Subtasks(NamedTuple):
    """What ``Runtimes.planner`` returns.

    Attributes:
        subtask_list: of each slot, in words.
        subtask_count: how many, int [B].
        error: why a slot is stopped, "" for none.
    """

    subtask_list: tuple[tuple[str, ...], ...]
    subtask_count: np.ndarray
    error: tuple[str, ...]


class PlannedSubtasks(NamedTuple):
    """What ``Runtimes.plan_subtask`` returns.

    Attributes:
        trajectory: the waypoints of each slot; none after an error, or if the programs asked for no motion.
        n_waypoints: how many there are, int [B].
        subtask_text: the subtask that was planned, in words.
        next_subtask_index: index to give next time, int [B]: of the same subtask while it is unfinished, and the
            number of subtasks in a slot that is stopped.
        movable_name: what the last motion moves.
        object_centric: whether that is an object, to be pushed, bool [B].
        prev_gripper: whether the grip is closed before the first waypoint, bool [B].
        error: why a slot is stopped, "" for none.
    """

    trajectory: Trajectory
    n_waypoints: np.ndarray
    subtask_text: tuple[str, ...]
    next_subtask_index: np.ndarray
    movable_name: tuple[str, ...]
    object_centric: np.ndarray
    prev_gripper: np.ndarray
    error: tuple[str, ...]
