"""The controllers of SIMPLER's robots, which turn actions into drive set-points.

In: a robot's URDF file, and at every control step a 7-vector a slot (dx dy dz in metres, a rotation vector in radians,
the gripper) with the measured joint positions and velocities. Out: ``SetPoints``, where each drive is to be at every
physics substep of that control step, [B, S, N], and how fast. Poses are in the robot's root frame, whose axes are
those the actions are stated in.

Against SIMPLER's recorded rollouts, made with SAPIEN 2, the set-points agree to 4e-5 rad, and against SAPIEN 3's own
inverse kinematics the solutions agree to 1e-6 rad (both in ``tests/simpler/test_simpler_robots.py``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from vecenv.controllers.interpolate import Limits, Planner
from vecenv.simpler.control.chain import Chain
from vecenv.simpler.control.robots import GOOGLE_ROBOT, WIDOWX, Robot, RobotError
from vecenv.simpler.control.rotations import (
    quat_from_rotation,
    rotation_from_quat,
    rotation_from_rotvec,
    rotvec_from_rotation,
)

ACTION_DIM = 7


class SetPoints(NamedTuple):
    """Where the drives are to be during one control step, in the order of qpos.

    Attributes:
        position: set-point at the end of each substep, radians (WidowX's fingers: metres), [B, S, N].
        velocity: rad/s or m/s, of the same shape; 0 where only positions are commanded.
        solved: the inverse kinematics found the pose, bool [B]; where it did not, the arm keeps its position.
    """

    position: np.ndarray
    velocity: np.ndarray
    solved: np.ndarray


class Controller:
    """What both controllers share: the tool's kinematics and the last set-points of B slots.

    Args:
        robot: the robot.
        chain: kinematics of its tool, ``robot.chain(...)``.
        count: B.
    """

    def __init__(self, robot: Robot, chain: Chain, count: int) -> None:
        if chain.width != robot.dof:
            raise RobotError(f"the chain is of a robot with {chain.width} joints; {robot.name} has {robot.dof}")
        self.robot = robot
        self.chain = chain
        self.count = count
        self._arm, self._fingers = np.array(robot.arm), np.array(robot.gripper)
        # What a slot remembers from one control step to the next; see ``memory``.
        self._memory: dict[str, np.ndarray] = {"held": np.zeros((count, robot.dof))}

    def reset(self, mask: npt.ArrayLike, qpos: npt.ArrayLike) -> None:
        """Clear the memory of the slots in ``mask`` (bool [B]); their robots stand at ``qpos`` [B, N]."""
        chosen = self._flags("mask", mask)
        self._begin(chosen, self._rows("qpos", qpos, self.robot.dof)[chosen])

    def set_action(
        self, action: npt.ArrayLike, qpos: npt.ArrayLike, qvel: npt.ArrayLike, active: npt.ArrayLike | None = None
    ) -> SetPoints:
        """Set-points of the coming control step.

        Args:
            action: dx dy dz (metres), rotation vector (radians), gripper (in [-1, 1]), [B, 7].
            qpos: measured joint positions, [B, N].
            qvel: measured joint velocities, [B, N].
            active: slots that take the action, bool [B], all by default; the others hold their last set-points and
                keep their memory.

        Raises:
            RobotError: a shape does not match.
        """
        actions = self._rows("action", action, ACTION_DIM)
        q, v = self._rows("qpos", qpos, self.robot.dof), self._rows("qvel", qvel, self.robot.dof)
        rows = np.flatnonzero(np.ones(self.count, bool) if active is None else self._flags("active", active))
        position = np.repeat(self._memory["held"][:, None], self.robot.substeps, axis=1)
        velocity, solved = np.zeros_like(position), np.ones(self.count, bool)
        if rows.size:
            position[rows], velocity[rows], solved[rows] = self._act(rows, actions[rows], q[rows], v[rows])
            self._memory["held"][rows] = position[rows, -1]
        return SetPoints(position, velocity, solved)

    def tool(self, qpos: npt.ArrayLike) -> np.ndarray:
        """Pose of the tool in the root's frame, xyz (metres) and wxyz, [B, 7]."""
        position, rotation = self.chain.pose(qpos)
        return np.concatenate([position, quat_from_rotation(rotation)], axis=1)

    def towards(self, pose: npt.ArrayLike, qpos: npt.ArrayLike) -> np.ndarray:
        """The action's first six columns, [B, 6], that make ``pose`` [B, 7] (xyz, wxyz, root frame) the next target."""
        poses = self._rows("pose", pose, 7)
        return self._delta(poses[:, :3], rotation_from_quat(poses[:, 3:]), self._rows("qpos", qpos, self.robot.dof))

    def memory(self) -> dict[str, np.ndarray]:
        """A copy of what the slots remember, arrays with B rows; ``restore`` takes it back."""
        return {name: values.copy() for name, values in self._memory.items()}

    def restore(self, memory: Mapping[str, np.ndarray], mask: npt.ArrayLike | None = None) -> None:
        """Set what the slots in ``mask`` (bool [B], all by default) remember."""
        if set(memory) != set(self._memory):
            raise RobotError(f"memory has {sorted(memory)}; {self.robot.name} remembers {sorted(self._memory)}")
        chosen = np.ones(self.count, bool) if mask is None else self._flags("mask", mask)
        for name, values in self._memory.items():
            values[chosen] = np.asarray(memory[name])[chosen]

    def _begin(self, mask: np.ndarray, qpos: np.ndarray) -> None:
        self._memory["held"][mask] = qpos

    def _act(
        self, rows: np.ndarray, action: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions and velocities [n, S, N] and whether a solution was found [n], of the slots ``rows`` [n]."""
        raise NotImplementedError

    def _delta(self, position: np.ndarray, rotation: np.ndarray, qpos: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _rows(self, name: str, value: npt.ArrayLike, width: int) -> np.ndarray:
        rows = np.asarray(value, np.float64)
        if rows.shape != (self.count, width):
            raise RobotError(f"{name} must have shape [{self.count}, {width}], got {list(rows.shape)}")
        return rows

    def _flags(self, name: str, value: npt.ArrayLike) -> np.ndarray:
        flags = np.asarray(value)
        if flags.shape != (self.count,) or flags.dtype != np.bool_:
            raise RobotError(f"{name} must be bool [{self.count}], got {flags.dtype} {list(flags.shape)}")
        return flags


class WidowXController(Controller):
    """WidowX: actions add up to a target pose, the drives go straight to its solution.

    Upstream's ``arm_pd_ee_target_delta_pose_align2`` and ``gripper_pd_joint_pos``: the target turns about the tool's
    *measured* position, and stays where it is when no solution was found. The gripper's value is absolute: +1 opens.
    """

    def __init__(self, chain: Chain, count: int, robot: Robot = WIDOWX) -> None:
        super().__init__(robot, chain, count)
        self._memory["position"] = np.zeros((count, 3))
        self._memory["rotation"] = np.tile(np.eye(3), (count, 1, 1))

    def _begin(self, mask: np.ndarray, qpos: np.ndarray) -> None:
        super()._begin(mask, qpos)
        self._memory["position"][mask], self._memory["rotation"][mask] = self.chain.pose(qpos)

    def _act(
        self, rows: np.ndarray, action: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        here, _ = self.chain.pose(qpos)
        turn = rotation_from_rotvec(action[:, 3:6])
        arm = self._memory["position"][rows] - here
        position = here + action[:, :3] + np.einsum("nij,nj->ni", turn, arm)
        rotation = turn @ self._memory["rotation"][rows]
        self._memory["position"][rows], self._memory["rotation"][rows] = position, rotation
        found, solved = self.chain.solve(qpos, position, rotation)
        low, high = self.robot.gripper_range
        found[:, self._fingers] = (0.5 * (high + low) + 0.5 * (high - low) * np.clip(action[:, 6], -1, 1))[:, None]
        positions = np.repeat(found[:, None], self.robot.substeps, axis=1)
        return positions, np.zeros_like(positions), solved

    def _delta(self, position: np.ndarray, rotation: np.ndarray, qpos: np.ndarray) -> np.ndarray:
        here, _ = self.chain.pose(qpos)
        turn = rotation @ self._memory["rotation"].swapaxes(1, 2)
        moved = np.einsum("nij,nj->ni", turn, self._memory["position"] - here)
        return np.concatenate([position - here - moved, rotvec_from_rotation(turn)], axis=1)


_ARM_LIMITS = Limits(velocity=1.5, acceleration=2.0, jerk=50.0)
_GRIPPER_LIMITS = Limits(velocity=1.0, acceleration=7.0, jerk=50.0)


@dataclass(frozen=True, kw_only=True)
class GoogleConfig:
    """Limits of the Google Robot's paths; the defaults are upstream's.

    Attributes:
        arm: of the arm and the head.
        gripper: of the fingers.
        gripper_scale: radians that a gripper action of 1 adds to the set-point.
        small_gripper_action: below so many radians the gripper keeps its target.
    """

    arm: Limits = _ARM_LIMITS
    gripper: Limits = _GRIPPER_LIMITS
    gripper_scale: float = 1.31
    small_gripper_action: float = 1e-3


class GoogleController(Controller):
    """Google Robot: an action moves the *measured* tool, and jerk-limited paths lead the drives to the solution.

    Upstream's ``arm_pd_ee_delta_pose_align_interpolate_by_planner`` and
    ``gripper_pd_joint_target_delta_pos_interpolate_by_planner``: a path of the arm begins where the previous one was
    left, with its velocity, so paths join smoothly however far the robot lags behind; the drives get no velocity. The
    gripper's action is relative to its last set-point (+1 closes); its path begins at the measured state, and its
    velocity is commanded too. From rest no joint of the arm gets further than 0.098 rad in a control step.
    """

    def __init__(
        self, chain: Chain, count: int, robot: Robot = GOOGLE_ROBOT, config: GoogleConfig | None = None
    ) -> None:
        super().__init__(robot, chain, count)
        self.config = config or GoogleConfig()
        self._arm_planner = Planner(len(robot.arm), self.config.arm)
        self._gripper_planner = Planner(len(robot.gripper), self.config.gripper)
        self._times = np.arange(1, robot.substeps + 1) / robot.sim_hz
        self._memory["fresh"] = np.ones(count, bool)
        self._memory["arm_velocity"] = np.zeros((count, len(robot.arm)))
        self._memory["gripper_target"] = np.zeros((count, len(robot.gripper)))

    def _begin(self, mask: np.ndarray, qpos: np.ndarray) -> None:
        super()._begin(mask, qpos)
        self._memory["fresh"][mask] = True
        self._memory["arm_velocity"][mask] = 0
        self._memory["gripper_target"][mask] = qpos[:, self._fingers]

    def _act(
        self, rows: np.ndarray, action: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        position = np.empty((len(rows), self.robot.substeps, self.robot.dof))
        velocity = np.zeros_like(position)
        here, facing = self.chain.pose(qpos)
        found, solved = self.chain.solve(qpos, here + action[:, :3], rotation_from_rotvec(action[:, 3:6]) @ facing)
        position[..., self._arm] = self._arm_path(rows, found[:, self._arm], qpos[:, self._arm], qvel[:, self._arm])
        position[..., self._fingers], velocity[..., self._fingers] = self._gripper_path(
            rows, action[:, 6], qpos[:, self._fingers], qvel[:, self._fingers]
        )
        self._memory["fresh"][rows] = False
        return position, velocity, solved

    def _arm_path(self, rows: np.ndarray, target: np.ndarray, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        fresh = self._memory["fresh"][rows][:, None]
        limit = self.config.arm.velocity
        start = np.where(fresh, qpos, self._memory["held"][rows][:, self._arm])
        speed = np.where(fresh, np.clip(qvel, -limit, limit), self._memory["arm_velocity"][rows])
        position, velocity = self._arm_planner.plan(start, speed, target).sample(self._times)
        self._memory["arm_velocity"][rows] = velocity[:, -1]
        return position

    def _gripper_path(
        self, rows: np.ndarray, action: np.ndarray, qpos: np.ndarray, qvel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        change = (self.config.gripper_scale * np.clip(action, -1, 1))[:, None]
        moved = np.clip(self._memory["held"][rows][:, self._fingers] + change, *self.robot.gripper_range)
        small = np.abs(change) < self.config.small_gripper_action
        target = np.where(small, self._memory["gripper_target"][rows], moved)
        self._memory["gripper_target"][rows] = target
        limit = self.config.gripper.velocity
        return self._gripper_planner.plan(qpos, np.clip(qvel, -limit, limit), target).sample(self._times)

    def _delta(self, position: np.ndarray, rotation: np.ndarray, qpos: np.ndarray) -> np.ndarray:
        here, facing = self.chain.pose(qpos)
        return np.concatenate([position - here, rotvec_from_rotation(rotation @ facing.swapaxes(1, 2))], axis=1)


def controller(robot: Robot, urdf: Path, count: int) -> WidowXController | GoogleController:
    """The controller of B = ``count`` robots, with the kinematics of a URDF file."""
    kinds = {WIDOWX.name: WidowXController, GOOGLE_ROBOT.name: GoogleController}
    return kinds[robot.name](robot.chain(urdf), count, robot)
