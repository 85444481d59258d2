"""How a part moves on its joint: a drawer along its slide, a door around its hinge.

A :class:`~vecenv.observations.Part` with its joint comes in; positions of its centre, and the directions in which its
points move, go out. World frame, metres; joint values are metres or radians, 0 closed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from vecenv.observations import Part, PartJoint

# Waypoints on the way of a hinge are this far apart, radians.
_STEP = 0.2
# A joint value this close to an end of its travel is that end, metres.
_END = 0.005


@dataclass(frozen=True)
class JointMotion:
    """A part on its joint.

    Attributes:
        joint: the joint.
        centre: mean of the part's points, [3].
    """

    joint: PartJoint
    centre: np.ndarray

    @classmethod
    def of(cls, part: Part, joint: PartJoint) -> JointMotion:
        """The motion of a part."""
        return cls(joint, part.cloud.points.mean(axis=0))

    @property
    def opened(self) -> float:
        """The present value of the joint."""
        return self.joint.opened

    @property
    def way(self) -> np.ndarray:
        """Direction in which the centre moves when the part opens, unit vector [3]."""
        return self._directions(self.centre[None])[0]

    @property
    def radius(self) -> float:
        """Metres that the centre moves for one unit of the joint."""
        return float(self._radii(self.centre[None])[0])

    def metres(self, value: float) -> float:
        """A difference of joint values as the length of the centre's way, metres."""
        return value * self.radius

    def value_at(self, target: np.ndarray) -> float:
        """The joint value to which a target [3] for the centre pushes the part, within the joint's travel.

        It is the target's distance along the direction in which the part moves now: "20 cm into the handle" is 20 cm
        of a drawer's way, and 20 cm of the arc of a door's handle.
        """
        along = float((target - self.centre) @ self.way) / max(self.radius, 1e-6)
        return float(np.clip(self.opened + along, 0.0, self.joint.travel))

    def is_end(self, value: float) -> bool:
        """Whether a joint value is an end of the joint's travel."""
        return min(value, self.joint.travel - value) * self.radius <= _END

    def centres(self, goal: float) -> np.ndarray:
        """Positions of the centre on its way to a joint value, the last one there, [P, 3]."""
        change = goal - self.opened
        if self.joint.kind == "slide":
            return (self.centre + change * self.joint.axis)[None]
        count = max(int(np.ceil(abs(change) / _STEP)), 1)
        turns = Rotation.from_rotvec(np.linspace(0, change, count + 1)[1:, None] * self.joint.axis)
        return turns.apply(self.centre - self.joint.anchor) + self.joint.anchor

    def ways(self, points: np.ndarray, sign: float) -> tuple[np.ndarray, np.ndarray]:
        """How points [M, 3] of the part move when it opens (``sign`` 1) or closes (-1).

        Returns:
            Their directions, unit vectors, [M, 3]; and how far the centre moves for each metre that they do, [M, 3].
        """
        gain = self.radius / np.maximum(self._radii(points), 1e-6)
        return sign * self._directions(points), sign * gain[:, None] * self.way

    def _directions(self, points: np.ndarray) -> np.ndarray:
        if self.joint.kind == "slide":
            return np.broadcast_to(self.joint.axis, points.shape).copy()
        around = np.cross(self.joint.axis, points - self.joint.anchor)
        return around / np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-6)

    def _radii(self, points: np.ndarray) -> np.ndarray:
        if self.joint.kind == "slide":
            return np.ones(len(points))
        return np.linalg.norm(np.cross(self.joint.axis, points - self.joint.anchor), axis=1)
