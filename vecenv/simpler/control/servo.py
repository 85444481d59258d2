"""Driving a robot's tool to absolute poses: what ``step_ee_pose`` sends every control tick on SIMPLER.

In: target poses with a grip bit, [B, 8], and the facts of every slot. Out: actions in the robot's own space, [B, 7].
A *reference* moves from the tool towards the target, at most so far a tick, and never further ahead of the tool than
``lead`` such steps; the action asks the robot's controller to make the reference its next target.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vecenv.errors import InvalidInput
from vecenv.simpler.control.controllers import Controller
from vecenv.simpler.control.robots import WIDOWX, Robot
from vecenv.simpler.control.rotations import (
    quat_from_rotation,
    rotation_from_quat,
    rotation_from_rotvec,
    rotvec_from_rotation,
)
from vecenv.util import configs, inputs


@dataclass(frozen=True, kw_only=True)
class ServoConfig:
    """Speeds and tolerances.

    Attributes:
        max_steps: control ticks one waypoint may take.
        pos_tol: metres, rot_tol: radians, within which it has arrived.
        max_advance_pos, max_advance_rot: metres and radians that the reference moves in a tick at most.
        lead: how many of those steps the reference may be ahead of the tool.
        stuck_after: a tool that has come no nearer for so many ticks is stuck, and its waypoint ends.
        nearer: what counts as nearer, as a share of the tolerances.
    """

    max_steps: int = 100
    pos_tol: float = 0.01
    rot_tol: float = 0.10
    max_advance_pos: float
    max_advance_rot: float
    lead: float = 2.0
    stuck_after: int = 6
    nearer: float = 0.1

    def __post_init__(self) -> None:
        numbers = ("pos_tol", "rot_tol", "max_advance_pos", "max_advance_rot", "lead", "nearer")
        counts: dict[str, tuple[int, int]] = dict.fromkeys(("max_steps", "stuck_after"), (1, inputs.MOST_COUNT))
        configs.check(self, InvalidInput, positive=numbers, ranges=counts)

    @classmethod
    def of(cls, robot: Robot) -> ServoConfig:
        """A robot's own: 0.15 m and 1 rad a second for WidowX at 5 Hz, and the same for the Google Robot at 3 Hz."""
        return cls(max_advance_pos=0.15 / robot.control_hz, max_advance_rot=1.0 / robot.control_hz)


class Servo:
    """Drives the tools of B slots.

    Args:
        controller: the robots' controller; its memory decides what an action means.
        config: speeds and tolerances.
    """

    def __init__(self, controller: Controller, config: ServoConfig) -> None:
        self.controller, self.config = controller, config
        self._reference = np.zeros((controller.count, 7))
        self._known = np.zeros(controller.count, bool)
        self._wanted = np.full((controller.count, 7), np.nan)
        self._nearest = np.full(controller.count, np.inf)
        self._idle = np.zeros(controller.count, int)

    def forget(self, slots: np.ndarray) -> None:
        """Discard the references of slots (bool [B]) that were driven otherwise."""
        self._known &= ~slots

    def begin(self, tool: np.ndarray) -> None:
        """References begin at the tools' poses, [B, 7], world frame; those of an earlier call are kept.

        The Google Robot's actions are relative to the measured pose of its tool, so without a kept reference it would
        drift, tick by tick, under a contact force while it holds still.
        """
        self._reference = np.where(self._known[:, None], self._reference, tool)
        self._known[:] = True

    def actions(
        self, targets: np.ndarray, driving: np.ndarray, facts: np.ndarray | Mapping[str, np.ndarray]
    ) -> np.ndarray:
        """Actions of this tick, [B, 7]: slots in ``driving`` go towards their targets [B, 8], the others hold still.

        ``facts`` are ``tcp`` and ``base`` [B, 7] and ``qpos`` [B, N].
        """
        reference = _towards(self._reference, targets[:, :7], self.config.max_advance_pos, self.config.max_advance_rot)
        reach = self.config.lead
        reference = _towards(
            facts["tcp"], reference, reach * self.config.max_advance_pos, reach * self.config.max_advance_rot
        )
        self._reference = np.where(driving[:, None], reference, self._reference)
        wanted = self.controller.towards(in_frame(self._reference, facts["base"]), facts["qpos"])
        return np.concatenate([wanted, self.gripper(targets[:, 7])[:, None]], axis=1)

    def gripper(self, grip: np.ndarray) -> np.ndarray:
        """The robot's own gripper action for 1 (closed) or 0 (open)."""
        closing = np.where(np.asarray(grip) > 0.5, 1.0, -1.0)
        return -closing if self.controller.robot.name == WIDOWX.name else closing

    def arrived(self, targets: np.ndarray, tool: np.ndarray) -> np.ndarray:
        """Which tools [B, 7] are within tolerance of their targets [B, 8], bool [B]."""
        near = np.linalg.norm(targets[:, :3] - tool[:, :3], axis=1) <= self.config.pos_tol
        return near & (np.linalg.norm(_turn(tool, targets), axis=1) <= self.config.rot_tol)

    def stuck(self, targets: np.ndarray, tool: np.ndarray, driving: np.ndarray) -> np.ndarray:
        """Which of the tools [B, 7] that are driven to ``targets`` [B, 8] come no nearer, bool [B].

        To be asked once a tick: it counts. A new target begins the count anew.
        """
        new = ~driving | (self._wanted != targets[:, :7]).any(axis=1)
        way = np.linalg.norm(targets[:, :3] - tool[:, :3], axis=1) / self.config.pos_tol
        distance = np.maximum(way, np.linalg.norm(_turn(tool, targets), axis=1) / self.config.rot_tol)
        nearer = new | (distance < self._nearest - self.config.nearer)
        self._wanted = targets[:, :7].copy()
        self._nearest = np.where(nearer, distance, self._nearest)
        self._idle = np.where(nearer, 0, self._idle + 1)
        return driving & (self._idle >= self.config.stuck_after)


def in_frame(poses: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """World poses [B, 7] seen from frames [B, 7]."""
    back = rotation_from_quat(frames[:, 3:7]).swapaxes(1, 2)
    position = np.einsum("nij,nj->ni", back, poses[:, :3] - frames[:, :3])
    return np.concatenate([position, quat_from_rotation(back @ rotation_from_quat(poses[:, 3:7]))], axis=1)


def _turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotation vectors [B, 3] that turn the poses ``start`` into ``end``, world frame."""
    return rotvec_from_rotation(rotation_from_quat(end[:, 3:7]) @ rotation_from_quat(start[:, 3:7]).swapaxes(1, 2))


def _towards(start: np.ndarray, end: np.ndarray, metres: float, radians: float) -> np.ndarray:
    """Poses [B, 7] on the way from ``start`` to ``end``, at most so far from the start."""
    way, turn = end[:, :3] - start[:, :3], _turn(start, end)
    position = start[:, :3] + way * _share(way, metres)
    rotation = rotation_from_rotvec(turn * _share(turn, radians)) @ rotation_from_quat(start[:, 3:7])
    return np.concatenate([position, quat_from_rotation(rotation)], axis=1)


def _share(vectors: np.ndarray, most: float) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.minimum(1.0, most / np.maximum(length, 1e-12))
