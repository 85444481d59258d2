"""Poses of the hand that grasp an object or a part, and rotations that push a part shut.

In: the geometry of one snapshot and the options of perception. Out: a :class:`HandPose` for each name, or a
:class:`~voxposer.perception.observation.PerceptionError` that says why there is none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vecenv.manipulation.grasps import Grasps, clearance, room_around
from vecenv.manipulation.placing import choose_grasp
from vecenv.manipulation.world import SceneGeometry, down_facing, pinching, spun, tilted, yaw
from vecenv.observations import Part
from voxposer.perception.config import PerceptionConfig
from voxposer.perception.observation import PerceptionError
from voxposer.perception.parts import distance, opening_direction


@dataclass(frozen=True)
class HandPose:
    """A pose of the hand: ``pos`` of the grip site [3], metres, and ``rotation`` [3, 3], world frame."""

    pos: np.ndarray
    rotation: np.ndarray


class GraspFinder:
    """Grasps in one snapshot.

    Args:
        scene: geometry of the snapshot.
        config: options of perception.
        base: position of the robot's base, [3].
        failed: by object, positions of grasps that did not hold, relative to the object's origin.
    """

    def __init__(
        self,
        scene: SceneGeometry,
        config: PerceptionConfig,
        base: np.ndarray,
        failed: Mapping[str, Sequence[np.ndarray]],
    ) -> None:
        self.scene, self.config, self.base, self.failed = scene, config, base, failed

    def of_object(self, name: str) -> HandPose:
        """The best grasp of a movable object.

        Raises:
            PerceptionError: the object is fixed, or no grasp fits.
        """
        if name not in self.scene.snapshot.movable:
            parts = [part for part, spec in self.scene.snapshot.parts.items() if spec.parent == name]
            raise PerceptionError(f"{name} is fixed; grasp one of its parts: {', '.join(parts) or 'none'}")
        found = choose_grasp(self.scene, name, self.failed.get(name, ()), narrow=False)
        if found is None:
            raise PerceptionError(f"{name} offers nothing to hold: every face is too wide, too steep or out of reach")
        return HandPose(found.pos, found.rotation)

    def of_part(self, name: str, part: Part) -> HandPose:
        """The grasp of a knob, a handle, or of the handle that belongs to a drawer or door.

        Raises:
            PerceptionError: the part is a place.
        """
        if part.kind == "knob":
            return self._knob(part)
        if part.kind == "handle":
            return self._handle(part)
        if part.joint is not None:
            handles = [p for p in self.scene.snapshot.parts.values() if p.parent == part.parent and p.kind == "handle"]
            handle = min(handles, key=lambda p: distance(p, part), default=None)
            if handle is not None:
                return self._handle(handle)
        raise PerceptionError(f"{name} is a place, not something to hold")

    def pushing_rotation(self, part: Part) -> np.ndarray:
        """Rotation [3, 3] of the hand that pushes a part shut, tilted as far as reach and the scene leave room."""
        out = opening_direction(part)
        start = part.cloud.points.mean(axis=0) + self.config.push_start * out
        obstacles = np.concatenate([self.scene.others(), self.scene.walls])
        obstacles = obstacles[np.linalg.norm(obstacles - start, axis=1) < 0.4]
        hands = [tilted(-out, tilt, self.scene.hand_rotation) for tilt in self.config.push_tilts]
        wrists = [start - self.config.wrist_back * hand[:, 2] - self.base for hand in hands]
        lacks = [max(self.config.nearest - float(np.linalg.norm(wrist[:2])), 0.0) for wrist in wrists]
        rooms = [room_around(start, hand, obstacles, self.config.margins.gripper) for hand in hands]
        costs = [lack + max(-room, 0.0) for lack, room in zip(lacks, rooms, strict=True)]
        return hands[int(np.argmin(costs + self.config.less_tilt * np.arange(len(hands))))]

    def _knob(self, part: Part) -> HandPose:
        """The ridge of a knob, from above."""
        points = part.cloud.points
        ridge = points[points[:, 2] > points[:, 2].max() - 0.02]
        centre = (ridge.min(axis=0) + ridge.max(axis=0)) / 2
        _, vectors = np.linalg.eigh((ridge - centre)[:, :2].T @ (ridge - centre)[:, :2])
        across = np.append(vectors[:, 0], 0.0)
        rotation = _nearest_to_home(down_facing(across[None])[0])
        gripper = self.config.margins.gripper
        return HandPose(np.append(centre[:2], points[:, 2].max() - 0.6 * gripper.palm + 0.004), rotation)

    def _handle(self, part: Part) -> HandPose:
        """The bar of a handle, pinched across its length by a hand from outside; the first tilt that has room."""
        bar, length = self._bar(part)
        options = [
            pinching(-opening_direction(part), tilt, length, self.scene.hand_rotation) for tilt in self.config.tilts
        ]
        rooms = [self._handle_room(bar, rotation, part) for rotation in options]
        fits = [rotation for rotation, room in zip(options, rooms, strict=True) if room > self.config.handle_room]
        return HandPose(bar, fits[0] if fits else options[int(np.argmax(rooms))])

    def _bar(self, part: Part) -> tuple[np.ndarray, np.ndarray]:
        """Centre of a handle's bar [3] and the direction of its length, [3]."""
        out = opening_direction(part)
        points = part.cloud.points
        front = points[points @ out > (points @ out).max() - self.config.bar_depth]
        middle = (front.min(axis=0) + front.max(axis=0)) / 2
        spread = front - front.mean(axis=0)
        _, vectors = np.linalg.eigh(spread.T @ spread)
        return middle, vectors[:, 2]

    def _handle_room(self, pos: np.ndarray, rotation: np.ndarray, part: Part) -> float:
        """Room around an open hand that approaches a handle along its own axis; other parts and the table count."""
        own, snapshot = part.cloud.points, self.scene.snapshot
        other_parts = [p.cloud.points for p in snapshot.parts.values() if p is not part and p.kind != "space"]
        others = np.concatenate([snapshot.scene.points, *other_parts])
        others = others[np.linalg.norm(others - pos, axis=1) < self.config.margins.neighbours]
        away = np.linalg.norm(others[:, None] - own[None, ::8], axis=2).min(axis=1) if len(others) else np.zeros(0)
        local = (others[away > 0.012] - pos) @ rotation @ down_facing(np.array([[0.0, 1.0, 0.0]]))[0].T
        here = Grasps(np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]), np.zeros(1), np.zeros(1))
        return float(clearance(here, local, self.config.margins.gripper)[0])


def _nearest_to_home(rotation: np.ndarray) -> np.ndarray:
    """Of the two hands that close along the same line, the one turned less from home."""
    other = spun(rotation, np.pi)
    return min((rotation, other), key=lambda option: abs(float(yaw(option))))
