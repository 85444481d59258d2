"""Motions that programs ask for: what a call of ``execute`` leaves behind.

In: maps that are evaluated. Out: a frozen :class:`MotionRequest` that answers what its maps want at a voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vecenv.errors import InvalidInput

# A gripper map's rarer value applies to the last waypoint from up to this many voxels away, as upstream's does.
_GRIP_REACH = 3.0


class InterfaceError(InvalidInput):
    """A program called a function with invalid arguments; the message says what is expected."""


@dataclass(frozen=True, eq=False)
class MotionRequest:
    """One motion that a program asked for, its maps evaluated; equal only to itself.

    Attributes:
        kind: ``"path"`` (plan over maps), ``"stay"`` (no affordance: where the hand is) or ``"home"``.
        movable: name of what is to be moved.
        object_centric: whether that is an object, or a part that hangs on a joint, to be pushed, and not the hand.
        start: voxel from which to plan, [3].
        targets: bool [N, N, N]; None for ``stay`` and ``home``.
        avoidance: float32 [N, N, N] in 0..1, None without.
        occupancy: of the object to be pushed, bool [N, N, N].
        rotation: wxyz, [4] where it is the same everywhere, else [N, N, N, 4]; likewise the next two.
        velocity: share of full speed, [] or [N, N, N].
        gripper: 1 open, 0 closed, [] or [N, N, N].
    """

    kind: str
    movable: str
    object_centric: bool
    start: np.ndarray
    targets: np.ndarray | None
    avoidance: np.ndarray | None
    occupancy: np.ndarray | None
    rotation: np.ndarray
    velocity: np.ndarray
    gripper: np.ndarray

    @property
    def nbytes(self) -> int:
        """Bytes of its maps."""
        maps = (self.targets, self.avoidance, self.occupancy, self.rotation, self.velocity, self.gripper)
        return sum(each.nbytes for each in maps if each is not None)

    def rotation_at(self, voxel: np.ndarray) -> np.ndarray:
        """Rotation wanted at a voxel, unit quaternion wxyz [4]."""
        quat = np.asarray(self.rotation if self.rotation.ndim == 1 else self.rotation[tuple(voxel)], float)
        length = float(np.linalg.norm(quat))
        if length < 1e-6:
            raise InterfaceError("the rotation map holds a quaternion of length zero on the way")
        return quat / length

    def velocity_at(self, voxel: np.ndarray) -> float:
        """Share of full speed wanted at a voxel."""
        return float(self.velocity if self.velocity.ndim == 0 else self.velocity[tuple(voxel)])

    def closed_at(self, voxel: np.ndarray) -> bool:
        """Whether the grip is to be closed at a voxel."""
        return float(self.gripper if self.gripper.ndim == 0 else self.gripper[tuple(voxel)]) < 0.5

    def closed_at_end(self, voxel: np.ndarray) -> bool:
        """Whether it is to be closed at the end of the path.

        Programs mark the few voxels where the grip changes, and a path may end beside them: the rarer of the two
        values counts if it is within 3 voxels (upstream's ``_path2traj``).
        """
        if self.gripper.ndim == 0:
            return self.closed_at(voxel)
        closed = self.gripper < 0.5
        rare = bool(closed.sum() < closed.size / 2)
        near = np.argwhere(closed == rare)
        if len(near) and np.linalg.norm(near - voxel, axis=1).min() <= _GRIP_REACH:
            return rare
        return self.closed_at(voxel)
