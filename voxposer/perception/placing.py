"""Where the hand lets go of what it holds, on or in an object or part.

In: the geometry of one snapshot and the options of perception. Out: a
:class:`~vecenv.manipulation.placing.Target` for a name, and the pose of the hand over or in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from vecenv.manipulation.placing import Target, put_down, put_in_corner
from vecenv.manipulation.world import SceneGeometry, upright
from vecenv.observations import Part
from voxposer.perception.config import PerceptionConfig
from voxposer.perception.grasping import HandPose
from voxposer.perception.parts import cavity, exit_direction, world_half_extents


class PlaceFinder:
    """Places in one snapshot.

    Args:
        scene: geometry of the snapshot.
        config: options of perception.
    """

    def __init__(self, scene: SceneGeometry, config: PerceptionConfig) -> None:
        self.scene, self.config = scene, config

    def pose(self, points: np.ndarray, target: Target | None, held: str) -> HandPose:
        """Pose of the hand that puts the held object on a target; above the points [N, 3] when nothing is held."""
        rotation = upright(self.scene.hand_rotation)
        if target is None or not held:
            top = np.append((points.min(axis=0) + points.max(axis=0))[:2] / 2, points[:, 2].max() + self.config.above)
            return HandPose(top, rotation)
        return HandPose(*put_down(self.scene, held, target))

    def corner(self, target: Target | None, held: str, middle: HandPose) -> HandPose:
        """Pose of the hand that puts the held object into a corner of a container, rotated as in its middle.

        So much room is left for others. The same pose where there is no container or no corner.
        """
        if self.config.fields == "centroid" or target is None or not held:
            return middle
        return HandPose(put_in_corner(self.scene, held, target, middle.pos, middle.rotation), middle.rotation)

    def half(
        self, points: np.ndarray, target: Target | None, held: str, middle: Callable[[], HandPose], side: float
    ) -> HandPose:
        """Pose of the hand that puts the held object on one half of a target, so that another has room beside it.

        The half is a target of its own: what stands on the other half is beside the object, not below it.

        Args:
            points: surface of what it is put on, [N, 3].
            target: the whole target.
            held: the held object, "" for none.
            middle: gives the pose for the whole target.
            side: -1 for the left half, towards -y, 1 for the right one.
        """
        reach = (points.max(axis=0) - points.min(axis=0))[:2] / 2
        aside = np.array([0.0, side * reach[1] / 2])
        if self.config.fields == "centroid" or target is None or not held:
            whole = middle()
            return HandPose(whole.pos + np.append(aside, 0.0), whole.rotation)
        xy, cost = grid_around(target.xy[0] + aside, np.maximum(reach * [1.0, 0.5] - self.config.edge, 0.0))
        return HandPose(*put_down(self.scene, held, replace(target, xy=xy, cost=cost)))

    def of_object(self, name: str) -> Target | None:
        """Target for a whole object: its only space, else its only top, else the object itself."""
        snapshot = self.scene.snapshot
        parts = [spec for spec in snapshot.parts.values() if spec.parent == name]
        for kind in ("space", "top"):
            places = [part for part in parts if part.kind == kind]
            if len(places) == 1:
                return self.of_part(places[0])
        xy = snapshot.poses[name][:2]
        return Target(xy[None], np.zeros(1), floor=self.scene.ground(xy))

    def of_part(self, part: Part) -> Target | None:
        """Target for a part; None for a part that carries nothing."""
        if part.box is None or part.kind == "handle":
            return None
        half = world_half_extents(part.box)
        xy, cost = grid_around(part.box.pos[:2], np.maximum(half[:2] - self.config.edge, 0.0))
        if part.kind == "top":
            return Target(xy, cost, floor=part.box.pos[2] + half[2])
        out = exit_direction(part, self.scene) if part.kind == "space" else np.array([0.0, 0.0, 1.0])
        if out[2] > 0.5:
            floor = max(part.box.pos[2] - half[2], self.scene.ground(part.box.pos[:2]))
            # What is to be shut has to take all of what is put into it.
            roof = np.inf if part.joint is None else float(part.box.pos[2] + half[2])
            return Target(xy, cost, floor=floor, centre=part.box.pos[:2], half=half[:2], roof=roof)
        low, high = cavity(part, self.scene)
        middle = (low + high)[:2] / 2
        return Target(
            middle[None], np.zeros(1), low[2], centre=middle, half=(high - low)[:2] / 2, entry=out, roof=high[2]
        )


def grid_around(centre: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions around a centre [M, 2], the centre first, and their cost [M]: the distance in units of 2 cm."""
    ticks = np.linspace(-1, 1, 5)
    offsets = np.stack(np.meshgrid(ticks * reach[0], ticks * reach[1]), axis=-1).reshape(-1, 2)
    far = np.linalg.norm(offsets, axis=1)
    order = np.argsort(far, kind="stable")
    return centre + offsets[order], far[order] / 0.02
