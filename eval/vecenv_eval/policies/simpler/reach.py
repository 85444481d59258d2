"""What a SIMPLER robot's arm can follow: motions of the tool, rehearsed with its kinematics before they are made.

In: where the joints are and where the tool shall go, many alternatives at once. Out: for each alternative how well it
can be followed. The inverse kinematics of the robots' controllers starts from the present posture and heeds no joint
limits, so a pose that some posture could take may still be out of reach along the way; only following the way tells.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from vecenv.simpler.control.chain import Chain, Clik
from vecenv.simpler.control.controllers import controller
from vecenv.simpler.control.robots import GOOGLE_ROBOT, WIDOWX, Robot
from vecenv.simpler.control.rotations import (
    quat_from_rotation,
    rotation_from_quat,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from vecenv.simpler.control.servo import Servo, ServoConfig
from vecenv.simpler.control.urdf import read_urdf

# Steps of the way at which the inverse kinematics is solved again, metres and radians: what a control tick covers.
_STRIDE, _TURN = 0.05, 0.3
# Like the controllers' inverse kinematics, but it takes larger steps: a rehearsal need not be as exact.
_QUICK = Clik(tolerance=1e-3, max_iterations=40, step=0.4)
# Following a way: ticks that it may take to one stop, set-points a tick.
_PATIENCE, _SET_POINTS = 40, 8
# Joints are to stay so far from their limits, radians.
_SPARE = 0.03


@dataclass(frozen=True, kw_only=True)
class Hand:
    """A gripper's shape in its tool's frame, metres; read off the collision meshes.

    Attributes:
        approach, opening: which axes of the tool point forward, and where a finger opens to.
        widest: widest thing that fits between the open fingers, with room to spare.
        tip: how far the fingers reach beyond the tool's origin, open or closed.
        depth: where the tool's origin belongs when something is grasped, so far beyond its centre: widths, and the
            depth for each, where the fingers meet it with their pads; linear between.
        palm: things reach at most so far into the hand, from the tool's origin back.
        thickness: of the closed fingers, across ``opening``, half of it. edge: the same of their tips.
        close_ticks: control ticks that closing takes. settle_ticks: ticks to come to rest before it.
    """

    approach: int
    opening: int
    widest: float
    tip: float
    depth: tuple[tuple[float, ...], tuple[float, ...]]
    palm: float
    thickness: float
    edge: float
    close_ticks: int
    settle_ticks: int

    def rotation(self, approach: np.ndarray, opening: np.ndarray) -> np.ndarray:
        """Rotations of the tool, [..., 3, 3], from where it points and where it opens to, unit vectors [..., 3]."""
        columns = np.empty((*approach.shape, 3))
        third = 3 - self.approach - self.opening
        sign = 1.0 if (self.approach, self.opening, third) in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1.0
        columns[..., self.approach], columns[..., self.opening] = approach, opening
        columns[..., third] = sign * np.cross(approach, opening)
        return columns


HANDS: Mapping[str, Hand] = MappingProxyType(
    {
        WIDOWX.name: Hand(
            approach=0,
            opening=1,
            widest=0.050,
            tip=0.016,
            depth=((0.0,), (0.0,)),
            palm=0.022,
            thickness=0.015,
            edge=0.015,
            close_ticks=3,
            settle_ticks=1,
        ),
        GOOGLE_ROBOT.name: Hand(
            approach=2,
            opening=1,
            widest=0.11,
            tip=0.004,
            depth=((0.04, 0.076, 0.10), (0.01, 0.025, 0.045)),
            palm=0.07,
            thickness=0.028,
            edge=0.010,
            close_ticks=6,
            settle_ticks=3,
        ),
    }
)


class Arm:
    """A robot's arm, as far as planning goes.

    Args:
        robot: the robot.
        root: of the asset tree.
    """

    def __init__(self, robot: Robot, root: Path) -> None:
        self._urdf = root / robot.urdf_path()
        urdf = read_urdf(self._urdf)
        self.robot, self.hand = robot, HANDS[robot.name]
        self.chain: Chain = urdf.chain(robot.tool, robot.joints)
        # A few set-points a tick are all that following a way needs.
        self._coarse = replace(robot, sim_hz=_SET_POINTS * robot.control_hz)
        self._limits = urdf.limits(robot.joints)[self.chain.columns]

    def tool(self, qpos: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World position [3] and rotation [3, 3] of the tool."""
        position, rotation = self.chain.pose(qpos[None])
        turn = rotation_from_quat(base[3:7])
        return base[:3] + turn @ position[0], turn @ rotation[0]

    def rehearse(
        self, qpos: np.ndarray, base: np.ndarray, positions: np.ndarray, rotations: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Follow ways of the tool, every alternative from the same posture.

        Args:
            qpos: joints, [N]. base: world pose of the robot's root, [7].
            positions: world positions of the stops, [C, T, 3]. rotations: world rotations of the stops, [C, T, 3, 3].

        Returns:
            How far the joints stay from their limits, radians, [C]; minus infinity where the inverse kinematics finds
            nothing somewhere. And the joints at each stop, [C, T, N].
        """
        turn = rotation_from_quat(base[3:7])
        goals, turns = (positions - base[:3]) @ turn, turn.T @ rotations
        count, stops = positions.shape[:2]
        joints, spare = np.repeat(qpos[None], count, axis=0), np.full(count, np.inf)
        visited = np.empty((count, stops, len(qpos)))
        for stop in range(stops):
            joints, room = self._go(joints, goals[:, stop], turns[:, stop])
            spare, visited[:, stop] = np.minimum(spare, room), joints
        return spare - _SPARE, visited

    def follow(
        self, qpos: np.ndarray, base: np.ndarray, positions: np.ndarray, rotations: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Follow ways tick by tick as ``step_waypoints`` does, with the robot's controller and drives that lag.

        Dearer than ``rehearse`` and closer to what will happen: joints take their time, so the hand leaves the straight
        way, and near a singular posture the arm may end in another one. Nothing is in the way here, and the arm has no
        weight: a drive's damping over its stiffness (0.6 s in the Google Robot's arm) is how long a joint lags.

        Args:
            qpos, base, positions, rotations: as for ``rehearse``.

        Returns:
            Room at the joints' limits, radians, [C]; and how many stops were reached one after the other, [C].
        """
        count, stops = positions.shape[:2]
        targets = np.concatenate([pose(positions, rotations), np.zeros((count, stops, 1))], axis=2)
        servo = Servo(controller(self._coarse, self._urdf, count), ServoConfig.of(self.robot))
        rows, at, ticks = np.arange(count), np.zeros(count, int), np.zeros(count, int)
        seen = {"qpos": np.repeat(qpos[None], count, axis=0), "base": np.repeat(base[None], count, axis=0)}
        servo.controller.reset(np.ones(count, bool), seen["qpos"])
        seen["tcp"] = self._tools(seen)
        servo.begin(seen["tcp"])
        room, going = np.full(count, np.inf), np.ones(count, bool)
        while going.any():
            wanted = targets[rows, np.minimum(at, stops - 1)]
            actions = servo.actions(wanted, going, seen)
            points = servo.controller.set_action(actions, seen["qpos"], np.zeros_like(seen["qpos"]), going)
            moved = np.where(going[:, None], self._dragged(seen["qpos"], points.position), seen["qpos"])
            room = np.where(going, np.minimum(room, self._room(moved)), room)
            seen["qpos"] = self._clipped(moved)
            seen["tcp"] = self._tools(seen)
            stuck = servo.stuck(wanted, seen["tcp"], going)
            arrived = going & servo.arrived(wanted, seen["tcp"])
            at, ticks = at + arrived, np.where(arrived, 0, ticks + 1)
            going &= (at < stops) & ~(stuck & ~arrived) & (ticks < _PATIENCE)
        return room - _SPARE, at

    def _dragged(self, joints: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Where drives that lag behind their set-points [C, S, N] take the joints [C, N] in a tick."""
        lag = np.array([drive.damping / drive.stiffness for drive in self.robot.drives])
        left = np.exp(-1 / (self._coarse.sim_hz * lag))
        for point in points.swapaxes(0, 1):
            joints = point + (joints - point) * left
        return joints

    def _clipped(self, joints: np.ndarray) -> np.ndarray:
        """Joints [C, N] that stop at the limits of the tool's chain."""
        clipped = joints.copy()
        clipped[:, self.chain.columns] = np.clip(joints[:, self.chain.columns], *self._limits.T)
        return clipped

    def _tools(self, seen: dict[str, np.ndarray]) -> np.ndarray:
        """World poses of the tools, [C, 7]."""
        position, rotation = self.chain.pose(seen["qpos"])
        turn = rotation_from_quat(seen["base"][:, 3:7])
        return pose(seen["base"][:, :3] + np.einsum("nij,nj->ni", turn, position), turn @ rotation)

    def _go(self, joints: np.ndarray, goal: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Straight to a pose, shifting and turning each at its own pace as ``step_waypoints`` does: joints there [C, N]
        and the least room on the way [C]."""
        start, facing = self.chain.pose(joints)
        way, twist = goal - start, rotvec_from_rotation(turn @ facing.swapaxes(1, 2))
        strides = (
            np.maximum(np.linalg.norm(way, axis=1) / _STRIDE, 1e-9),
            np.maximum(np.linalg.norm(twist, axis=1) / _TURN, 1e-9),
        )
        room = np.full(len(joints), np.inf)
        for tick in range(1, int(np.ceil(max(strides[0].max(), strides[1].max()))) + 1):
            moved, turned = (np.minimum(tick / count, 1.0)[:, None] for count in strides)
            rotation = rotation_from_rotvec(twist * turned) @ facing
            joints, solved = self.chain.solve(joints, start + way * moved, rotation, _QUICK)
            room = np.minimum(room, np.where(solved, self._room(joints), -np.inf))
        return joints, room

    def _room(self, joints: np.ndarray) -> np.ndarray:
        chosen = joints[:, self.chain.columns]
        return np.minimum(chosen - self._limits[:, 0], self._limits[:, 1] - chosen).min(axis=1)


def pose(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """xyz and wxyz, [..., 7]."""
    return np.concatenate([position, quat_from_rotation(rotation)], axis=-1)


@dataclass(frozen=True)
class Waypoint:
    """One stop: the tool's pose [7], ``grip`` (1 closed, 0 open), and ticks to hold still instead of moving there."""

    pose: np.ndarray
    grip: float
    hold: int = 0


def through(stops: Iterable[np.ndarray], turn: np.ndarray, grip: float) -> list[Waypoint]:
    """Waypoints at positions [3] with one rotation [3, 3]."""
    return [Waypoint(pose(stop, turn), grip) for stop in stops]
