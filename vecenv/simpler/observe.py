"""What the camera of each slot sees: images that are drawn when they are first read, and where the camera is.

In: rows of facts (``physics.spec.facts_dtype``) at one moment, the slots' cameras, and a function that draws. Out: the
parts of ``SimplerEgocentric``. Positions are metres, quaternions wxyz, world frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from vecenv.observations import CameraView, Egocentric
from vecenv.simpler.control.chain import Chain
from vecenv.simpler.control.robots import Robot
from vecenv.simpler.control.rotations import quat_from_rotation, rotation_from_quat
from vecenv.simpler.control.urdf import read_urdf
from vecenv.simpler.episodes import Episode
from vecenv.simpler.overlay import Images
from vecenv.simpler.task_spec import Camera

SlotFacts: TypeAlias = Mapping[int, tuple[Episode, np.void]]
"""Slot -> its episode and a row of facts."""
# From right, down and forward to the axes of SAPIEN's cameras, which look along x with z up.
_OPTICAL_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class SimplerEgocentric(Egocentric):
    """An observation with the third-person camera only."""

    @property
    def wrist_image(self) -> None:  # type: ignore[override]
        """Always None: there is no wrist camera."""
        return None

    @property
    def observation(self) -> list[np.ndarray]:
        """The third-person camera's image alone."""
        return [self.rgb]


class LazyImages:
    """Images of all slots at one moment, drawn when the first is read, and once more if depth is read later.

    Args:
        draw: draws slots, with depth if the second argument is True.
        slots: what to draw.
    """

    def __init__(self, draw: Callable[[SlotFacts, bool], Images], slots: SlotFacts) -> None:
        self._draw, self._slots = draw, slots
        self._images: Images | None = None

    def read(self, field: str) -> np.ndarray:
        """One field of the images; zeros where nothing was drawn."""
        if self._images is None or getattr(self._images, field) is None:
            self._images = self._draw(self._slots, field == "depth")
        return getattr(self._images, field)


class CameraPoses:
    """Poses of cameras that are fixed to links of a robot.

    Args:
        robot: the robot.
        root: of the asset tree.
    """

    def __init__(self, robot: Robot, root: Path) -> None:
        self._robot, self._root = robot, root
        self._chains: dict[str, Chain] = {}

    def view(self, cameras: Sequence[Camera], facts: np.ndarray) -> CameraView:
        """Intrinsics and poses of the slots' cameras, one camera and one row of facts a slot."""
        by_link = {camera.link: self._link_poses(camera.link, facts) for camera in cameras}
        mount = np.stack([by_link[camera.link][slot] for slot, camera in enumerate(cameras)])
        local = rotation_from_quat(np.array([camera.quat for camera in cameras]))
        rotation = rotation_from_quat(mount[:, 3:])
        position = mount[:, :3] + np.einsum("nij,nj->ni", rotation, np.array([camera.position for camera in cameras]))
        return CameraView(
            intrinsics=np.stack([camera.intrinsics for camera in cameras]),
            pos=position,
            mat=(rotation @ local) @ _OPTICAL_AXES,
        )

    def _link_poses(self, link: str, facts: np.ndarray) -> np.ndarray:
        """World poses of a link, [B, 7]."""
        if link == self._robot.root:
            return facts["base"]
        if link not in self._chains:
            urdf = read_urdf(self._root / self._robot.urdf_path())
            self._chains[link] = urdf.chain(link, self._robot.joints)
        position, rotation = self._chains[link].pose(facts["qpos"])
        base = rotation_from_quat(facts["base"][:, 3:])
        world = facts["base"][:, :3] + np.einsum("nij,nj->ni", base, position)
        return np.concatenate([world, quat_from_rotation(base @ rotation)], axis=1)
