"""Which poses a Panda's hand can take: inverse kinematics within the limits of its joints.

The pose of the robot's base and poses of the grip site come in; :meth:`PandaArm.reaches` says which of them the arm can
take, :meth:`PandaArm.solve` with which joint angles. Solved by damped least squares from several seeds (Nakamura and
Hanafusa 1986), with the tolerances within which a waypoint counts as reached. Self-collision is not considered.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np

from vecenv.manipulation.world import matrix
from vecenv.util.compiled import compile_function, part

# Limits of the joints, radians, and Denavit and Hartenberg's parameters in Craig's convention: a and alpha of the link
# before each joint, and d; the last row is the grip site behind the flange (Franka Emika's data sheet, robosuite).
LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
_HALF = np.pi / 2
_LINKS = np.array(
    [
        [0.0, 0.0, 0.333],
        [0.0, -_HALF, 0.0],
        [0.0, _HALF, 0.316],
        [0.0825, _HALF, 0.0],
        [-0.0825, -_HALF, 0.384],
        [0.0, _HALF, 0.0],
        [0.088, _HALF, 0.0],
    ]
)
_FLANGE, _GRIP_SITE, _HAND_TURN = 0.107, 0.0965, -np.pi / 4
# The arm as an episode begins; seeds differ from it in the first and the last joint.
_HOME = np.array([0.0, -0.161, 0.0, -2.445, 0.0, 2.227, np.pi / 4])
_WRISTS = (0.0, 1.4, -1.4, 2.1)
_STEPS, _DAMPING = 40, 0.05


@dataclass(frozen=True)
class PandaArm:
    """A Panda at a place.

    Attributes:
        base: pose of its base, xyz + wxyz, world frame, [7].
        within: distance and angle within which a pose counts as reached, metres and radians.
    """

    base: np.ndarray
    within: tuple[float, float] = (0.01, 0.1)

    def reaches(self, positions: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Which poses of the grip site (positions [M, 3], rotations [M, 3, 3], world frame) it can take, bool [M]."""
        return self.solve(positions, rotations)[0]

    def solve(self, positions: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint angles for poses.

        Args:
            positions: of the grip site, world frame, metres, [M, 3].
            rotations: of the hand, [M, 3, 3].

        Returns:
            Which poses were reached, bool [M], and joint angles within their limits, radians, [M, 7].
        """
        turn = matrix(self.base[3:])
        local = np.ascontiguousarray((np.asarray(positions, float) - self.base[:3]) @ turn)
        turned = np.ascontiguousarray(turn.T @ np.asarray(rotations, float))
        joints = np.zeros((len(local), 7))
        found = np.zeros(len(local), np.bool_)
        kernel = _kernel()
        for i in range(len(local)):
            found[i] = kernel(local[i], turned[i], _seeds(local[i]), LOWER, UPPER, *self.within, joints[i])
        return found, joints


def hand_of(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] and rotation [3, 3] of the grip site in the base's frame, of seven joint angles."""
    axes, origins, pose = np.empty((7, 3)), np.empty((7, 3)), np.empty((4, 3))
    _forward_kernel()(np.ascontiguousarray(joints, float), axes, origins, pose)
    return pose[0].copy(), pose[1:].T.copy()


def compile_kernels() -> None:
    """Compile what this module computes with, seconds once a machine, before anything that has little time asks for it.

    Afterwards it is read from a cache.
    """
    _kernel()
    _forward_kernel()


def _seeds(position: np.ndarray) -> np.ndarray:
    seeds = np.tile(_HOME, (len(_WRISTS), 1))
    seeds[:, 0] = np.arctan2(position[1], position[0])
    seeds[:, 6] = np.clip(_HOME[6] + np.array(_WRISTS), LOWER[6], UPPER[6])
    return seeds


# ----------------------------------------------------------------------------------------------------------------------


@part
def _forward_part(joints: np.ndarray, axes: np.ndarray, origins: np.ndarray, pose: np.ndarray) -> None:
    """Axes and origins [7, 3] of the joints; ``pose`` [4, 3]: position of the grip site and the hand's three axes."""
    x, y, z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    at = np.zeros(3)
    for i in range(7):
        a, alpha, d = _LINKS[i, 0], _LINKS[i, 1], _LINKS[i, 2]
        at = at + a * x
        ca, sa = np.cos(alpha), np.sin(alpha)
        y, z = ca * y + sa * z, ca * z - sa * y
        c, s = np.cos(joints[i]), np.sin(joints[i])
        x, y = c * x + s * y, c * y - s * x
        axes[i], origins[i] = z, at
        at = at + d * z
    c, s = np.cos(_HAND_TURN), np.sin(_HAND_TURN)
    pose[0] = at + (_FLANGE + _GRIP_SITE) * z
    pose[1] = c * x + s * y
    pose[2] = c * y - s * x
    pose[3] = z


def _forward(joints: np.ndarray, axes: np.ndarray, origins: np.ndarray, pose: np.ndarray) -> None:
    _forward_part(joints, axes, origins, pose)


def _solve(
    position: np.ndarray,
    rotation: np.ndarray,
    seeds: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    near: float,
    turned: float,
    joints: np.ndarray,
) -> bool:
    """Whether a pose is reached from one of the seeds [S, 7]; ``joints`` [7] are the last angles tried."""
    axes, origins, pose = np.empty((7, 3)), np.empty((7, 3)), np.empty((4, 3))
    jacobian, error = np.empty((6, 7)), np.empty(6)
    for seed in range(len(seeds)):
        for k in range(7):
            joints[k] = seeds[seed, k]
        for _ in range(_STEPS):
            _forward_part(joints, axes, origins, pose)
            error[:3] = position - pose[0]
            turn, cosine = np.zeros(3), -0.5
            for k in range(3):
                wanted = np.array([rotation[0, k], rotation[1, k], rotation[2, k]])
                turn += np.cross(pose[1 + k], wanted)
                cosine += (pose[1 + k] * wanted).sum() / 2
            # Half the sum of the cross products is the axis times the angle's sine; near pi it vanishes.
            angle, sine = np.arccos(min(max(cosine, -1.0), 1.0)), np.sqrt((turn * turn).sum()) / 2
            error[3:] = turn / 2 * (angle / sine if sine > 1e-6 else 1.0)
            if np.sqrt((error[:3] ** 2).sum()) <= near and angle <= turned:
                return True
            for k in range(7):
                jacobian[:3, k] = np.cross(axes[k], pose[0] - origins[k])
                jacobian[3:, k] = axes[k]
            normal = jacobian @ jacobian.T
            for k in range(6):
                normal[k, k] += _DAMPING**2
            step = jacobian.T @ np.linalg.solve(normal, error)
            longest = np.abs(step).max()
            if longest > 0.5:
                step *= 0.5 / longest
            for k in range(7):
                joints[k] = min(max(joints[k] + step[k], lower[k]), upper[k])
    return False


@functools.cache
def _kernel() -> Callable[..., bool]:
    vector, table, f8 = numba.float64[::1], numba.float64[:, ::1], numba.float64
    return compile_function(numba.boolean(vector, table, table, vector, vector, f8, f8, vector), _solve)


@functools.cache
def _forward_kernel() -> Callable[..., None]:
    vector, table = numba.float64[::1], numba.float64[:, ::1]
    return compile_function(numba.void(vector, table, table, table), _forward)
