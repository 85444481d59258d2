"""Follow waypoints with the end effectors of a whole batch, one control tick at a time.

Plans come in slot by slot (a list of :class:`Waypoint`); actions for all slots go out at once. Every slot has its own
cursor into its own plan and moves on when it has arrived, when the fingers have come to rest, or when it has stopped
making progress (a hand that lowers something until it touches). Nothing here loops over slots except loading a plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

OPEN, HOLD, CLOSE = -1.0, 0.0, 1.0

_UNTIL_REST = -1


@dataclass(frozen=True, kw_only=True)
class MotionConfig:
    """How waypoints are followed.

    Attributes:
        gain: the translation command is this much of the remaining way; above 1 it arrives sooner.
        turn_gain: the same for rotation.
        translation_unit: metres that a translation action of 1 stands for.
        rotation_unit: radians that a rotation action of 1 stands for.
        stall_ticks: this many ticks without progress end a waypoint.
        stall_distance: getting this much closer (metres; a radian counts as 10 cm) is progress.
        max_ticks: a waypoint ends after this many ticks whatever happens.
        settled_fingers: fingers that open or close by less than this in a tick have come to rest, metres.
        min_finger_ticks: fingers get at least this many ticks to start moving.
        still_ticks: for this many ticks in a row.
        max_finger_ticks: fingers get at most this many ticks to come to rest.
    """

    gain: float = 1.6
    turn_gain: float = 1.5
    translation_unit: float = 0.05
    rotation_unit: float = 0.5
    stall_ticks: int = 6
    stall_distance: float = 0.001
    max_ticks: int = 120
    settled_fingers: float = 0.0005
    min_finger_ticks: int = 3
    still_ticks: int = 2
    max_finger_ticks: int = 16


@dataclass(frozen=True)
class Waypoint:
    """One stop of a plan.

    Attributes:
        pos: of the grip site, metres, world frame, [3].
        rotation: of the hand, [3, 3].
        grip: ``OPEN``, ``CLOSE``, or ``HOLD`` to leave the fingers where they are.
        tolerance: distance at which the waypoint counts as reached, metres.
        turn_tolerance: the same for the angle, radians.
        fingers: move the fingers until they rest, instead of arriving.
        ticks: stay for this many ticks, instead of arriving; 0 for not.
        speed: share of full speed.
    """

    pos: np.ndarray
    rotation: np.ndarray
    grip: float
    tolerance: float = 0.02
    turn_tolerance: float = 0.2
    fingers: bool = False
    speed: float = 1.0
    ticks: int = 0


class WaypointFollower:
    """The plans of B slots and where each slot is in its own.

    Args:
        num_envs: B.
        config: how waypoints are followed.
    """

    def __init__(self, num_envs: int, config: MotionConfig = MotionConfig()) -> None:
        self.config = config
        self.num_envs = num_envs
        self.length = np.zeros(num_envs, int)
        self.cursor = np.zeros(num_envs, int)
        self._pos = np.zeros((num_envs, 1, 3))
        self._rotation = np.zeros((num_envs, 1, 3, 3))
        self._numbers = np.zeros((num_envs, 1, 5))
        self._grip = np.full(num_envs, OPEN)
        self._ticks = np.zeros(num_envs, int)
        self._idle = np.zeros(num_envs, int)
        self._best = np.full(num_envs, np.inf)
        self._opening = np.zeros(num_envs)
        self._still = np.zeros(num_envs, int)

    @property
    def finished(self) -> np.ndarray:
        """Slots that have come to the end of their plan, bool [B]."""
        return self.cursor >= self.length

    def load(self, slot: int, plan: Sequence[Waypoint]) -> None:
        """Give a slot a new plan, in place of what is left of the old one."""
        self._reserve(len(plan))
        self.length[slot], self.cursor[slot] = len(plan), 0
        for t, waypoint in enumerate(plan):
            self._pos[slot, t], self._rotation[slot, t] = waypoint.pos, waypoint.rotation
            tolerances = waypoint.tolerance, waypoint.turn_tolerance
            waits = waypoint.ticks or (_UNTIL_REST if waypoint.fingers else 0)
            self._numbers[slot, t] = waypoint.grip, *tolerances, waits, waypoint.speed
        self._begin(np.arange(self.num_envs) == slot)

    def clear(self, slots: np.ndarray) -> None:
        """Forget the plans of ``slots``, indices: they begin new episodes, gripper open."""
        for table in (self.length, self.cursor, self._opening, self._still):
            table[slots] = 0
        self._grip[slots] = OPEN
        self._begin(np.isin(np.arange(self.num_envs), slots))

    def act(self, state: np.ndarray) -> np.ndarray:
        """Actions of this tick.

        Args:
            state: proprioception [B, 8]: position, axis-angle of the hand, two finger positions.

        Returns:
            [B, 7]; slots without a plan hold still and keep their grip.
        """
        state = np.asarray(state, float)
        rotation = rotation_matrices(state[:, 3:6])
        self._advance(state, rotation)
        pos_error, turn_error = self._errors(state, rotation)
        numbers = self._current(self._numbers)
        moving = ~self.finished
        self._grip = np.where(moving, numbers[:, 0], self._grip)
        config = self.config
        drive = _limited(pos_error * (config.gain / config.translation_unit)) * numbers[:, 4:5]
        turn = _limited(turn_error * (config.turn_gain / config.rotation_unit))
        self._ticks += moving
        action = np.concatenate([drive, turn], axis=1) * moving[:, None]
        return np.concatenate([action, self._grip[:, None]], axis=1)

    def _advance(self, state: np.ndarray, rotation: np.ndarray) -> None:
        """Move every slot on that is done with its waypoint."""
        config = self.config
        pos_error, turn_error = (np.linalg.norm(error, axis=1) for error in self._errors(state, rotation))
        numbers = self._current(self._numbers)
        arrived = (pos_error < numbers[:, 1]) & (turn_error < numbers[:, 2])
        stalled = self._stalled(np.maximum(pos_error, 0.1 * turn_error))
        rested = self._rested(state[:, 6] - state[:, 7])
        waits = numbers[:, 3]
        waited = np.where(waits == _UNTIL_REST, rested, self._ticks >= waits)
        done = np.where(waits != 0, waited, arrived | stalled | (self._ticks >= config.max_ticks)) & ~self.finished
        self.cursor += done
        self._begin(done)

    def _stalled(self, error: np.ndarray) -> np.ndarray:
        closer = error < self._best - self.config.stall_distance
        self._best = np.where(closer, error, self._best)
        self._idle = np.where(closer, 0, self._idle + 1)
        return self._idle > self.config.stall_ticks

    def _rested(self, opening: np.ndarray) -> np.ndarray:
        still = np.abs(opening - self._opening) < self.config.settled_fingers
        self._opening = opening
        self._still = np.where(still & (self._ticks >= self.config.min_finger_ticks), self._still + 1, 0)
        return (self._still >= self.config.still_ticks) | (self._ticks >= self.config.max_finger_ticks)

    def _begin(self, slots: np.ndarray) -> None:
        """Restart counting for ``slots``, bool [B]."""
        self._ticks[slots], self._idle[slots], self._best[slots] = 0, 0, np.inf

    def _errors(self, state: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Remaining way [B, 3] and rotation vector [B, 3], world frame; zero without a plan."""
        moving = ~self.finished[:, None]
        turn = rotation_vectors(self._current(self._rotation) @ rotation.transpose(0, 2, 1))
        return (self._current(self._pos) - state[:, :3]) * moving, turn * moving

    def _current(self, table: np.ndarray) -> np.ndarray:
        return table[np.arange(self.num_envs), np.clip(self.cursor, 0, np.maximum(self.length - 1, 0))]

    def _reserve(self, length: int) -> None:
        for name in ("_pos", "_rotation", "_numbers"):
            table = getattr(self, name)
            if table.shape[1] < length:
                more = np.zeros((self.num_envs, length - table.shape[1], *table.shape[2:]))
                setattr(self, name, np.concatenate([table, more], axis=1))


def _limited(command: np.ndarray) -> np.ndarray:
    """Scaled down, direction kept, to at most 1 in every component."""
    return command / np.maximum(np.abs(command).max(axis=1, keepdims=True), 1.0)


def rotation_matrices(vectors: np.ndarray) -> np.ndarray:
    """Rotation vectors [n, 3] in radians to matrices [n, 3, 3] (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=1)
    axis = vectors / np.maximum(angle, 1e-12)[:, None]
    cross = np.zeros((len(vectors), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = axis
    cross[:, [1, 2, 0], [2, 0, 1]] = -axis
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)


def rotation_vectors(matrices: np.ndarray) -> np.ndarray:
    """Matrices [n, 3, 3] to rotation vectors [n, 3] of at most pi radians."""
    skew = np.stack([matrices[:, i, j] - matrices[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1) / 2
    sine = np.linalg.norm(skew, axis=1)
    cosine = (np.trace(matrices, axis1=1, axis2=2) - 1) / 2
    angle = np.arctan2(sine, cosine)
    # Near pi the skew part vanishes: the axis is then the largest column of (R + R^T)/2 - cos I.
    symmetric = (matrices + matrices.transpose(0, 2, 1)) / 2 - cosine[:, None, None] * np.eye(3)
    column = symmetric[np.arange(len(matrices)), np.einsum("nii->ni", symmetric).argmax(axis=1)]
    flipped = np.einsum("ni,ni->n", column, skew) < 0
    column = column * np.where(flipped, -1.0, 1.0)[:, None]
    length = np.maximum(np.linalg.norm(column, axis=1), 1e-12)
    near_pi = (sine < 1e-3) & (cosine < 0)
    plain = skew * (angle / np.maximum(sine, 1e-12))[:, None]
    return np.where(near_pi[:, None], column * (angle / length)[:, None], plain)
