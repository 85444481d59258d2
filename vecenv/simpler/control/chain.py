"""Pose, Jacobian and inverse kinematics of one link of a robot, for a batch of arms.

In: joint positions [B, N] of the whole robot, in the order of its drives. Out: of a ``Chain``, the joints between the
root and the link, the link's pose and Jacobian in the robot's root frame, and joint positions that bring it to a pose.
The arithmetic is float64 and compiled (``clik.py``); slots do not depend on each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from vecenv.errors import InvalidInput
from vecenv.simpler.control.clik import forward_kernel, inverse_kernel


class KinematicsError(InvalidInput):
    """A robot description that cannot be used, or arrays of the wrong shape; the message names the part."""


@dataclass(frozen=True, kw_only=True)
class Clik:
    """Settings of the inverse kinematics; the defaults are SAPIEN's.

    Attributes:
        tolerance: done when the error, metres and radians in one norm at the last joint, is below this.
        max_iterations: give up after so many steps.
        damping: added to the diagonal of J Jᵀ.
        step: fraction of the solution that one iteration takes.
    """

    tolerance: float = 1e-4
    max_iterations: int = 100
    damping: float = 1e-6
    step: float = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The joints between a robot's root and one link.

    Attributes:
        width: N, columns of qpos.
        columns: which column of qpos each joint of the chain is, int [n].
        fixed_pos: from the previous joint's frame to the joint's at zero, metres, [n, 3].
        fixed_rot: their rotations, matrices [n, 3, 3].
        axis: unit axes in the joint's own frame, [n, 3].
        slides: prismatic, bool [n].
        tip_pos: from the last joint's frame to the link, metres, [3].
        tip_rot: its rotation, [3, 3].
    """

    width: int
    columns: np.ndarray
    fixed_pos: np.ndarray
    fixed_rot: np.ndarray
    axis: np.ndarray
    slides: np.ndarray
    tip_pos: np.ndarray
    tip_rot: np.ndarray

    def pose(self, qpos: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Position [B, 3] (metres) and rotation [B, 3, 3] of the link in the root's frame, for qpos [B, N]."""
        rows = self._rows(qpos)
        position, rotation = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3))
        jacobian = np.empty((len(rows), 6, len(self.columns)))
        forward_kernel()(*self._constants(), self.tip_pos, self.tip_rot, rows, position, rotation, jacobian)
        return position, rotation

    def jacobian(self, qpos: npt.ArrayLike) -> np.ndarray:
        """Velocity of the link (linear, then angular, root frame) per joint velocity, [B, 6, N]."""
        rows = self._rows(qpos)
        position, rotation = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3))
        jacobian = np.empty((len(rows), 6, len(self.columns)))
        forward_kernel()(*self._constants(), self.tip_pos, self.tip_rot, rows, position, rotation, jacobian)
        wide = np.zeros((len(rows), 6, self.width))
        wide[:, :, self.columns] = jacobian
        return wide

    def solve(
        self, qpos: npt.ArrayLike, position: np.ndarray, rotation: np.ndarray, settings: Clik | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions that bring the link to a pose, starting from ``qpos``.

        Joint limits are ignored; joints that are not in the chain keep their positions.

        Args:
            qpos: where the joints are, [B, N].
            position: target position in the root's frame, metres, [B, 3].
            rotation: target rotation, [B, 3, 3].
            settings: of the iteration; SAPIEN's by default.

        Returns:
            Joint positions [B, N], equal to ``qpos`` where nothing was found, and where something was, bool [B].
        """
        rows, how = self._rows(qpos), settings or Clik()
        # The error is measured at the last joint, as SAPIEN does: it decides when the iteration ends.
        joint_rot = np.ascontiguousarray(np.asarray(rotation, np.float64) @ self.tip_rot.T)
        joint_pos = np.asarray(position, np.float64) - joint_rot @ self.tip_pos
        found, converged = rows.copy(), np.zeros(len(rows), bool)
        numbers = np.array([how.tolerance, how.damping, how.step])
        inverse_kernel()(*self._constants(), joint_pos, joint_rot, numbers, how.max_iterations, found, converged)
        return np.where(converged[:, None], found, rows), converged

    def _constants(self) -> tuple[np.ndarray, ...]:
        return self.columns, self.fixed_pos, self.fixed_rot, self.axis, self.slides

    def _rows(self, qpos: npt.ArrayLike) -> np.ndarray:
        rows = np.ascontiguousarray(qpos, np.float64)
        if rows.ndim != 2 or rows.shape[1] != self.width:
            raise KinematicsError(f"qpos must have shape [B, {self.width}], got {list(rows.shape)}")
        return rows
