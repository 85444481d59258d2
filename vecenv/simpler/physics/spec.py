"""The content of a SIMPLER scene, the start of an episode, and the measurements after a control tick, as data.

Poses are xyz + wxyz in the world frame, lengths metres, angles radians, impulses newton seconds. Nothing here knows
tasks or needs SAPIEN.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

# The Google Robot's fingers weigh almost nothing for their drives. PhysX 5 then leaves a residue when they press on
# something, and the arm drifts: 0.037 rad around a box, where PhysX 4 has 0.002. With this inertia (kg m2) it is 0.002;
# free fingers lag by 0.4 ms.
GOOGLE_FINGER_ARMATURE = 0.003
# Pressed on each other, the same fingers move the arm by 0.07 rad, where PhysX 4 has 0.00003. So they do not collide;
# they stop where PhysX 4 stops them, when their joints add up to this (radians), also when one leads by 0.25 rad.
# Within a margin of it (``scenes.py``) the drives' targets do not press on.
GOOGLE_FINGER_STOP = 2.1496
MAX_FINGERS = 4
ROBOT, CABINET = "robot", "cabinet"
MAX_DRAWERS = 3


@dataclass(frozen=True, kw_only=True)
class LinkSurface:
    """What the collision shapes of a link are made of.

    Attributes:
        friction: static and dynamic friction.
        patch_radius: metres; what torsional friction is computed from.
    """

    friction: tuple[float, float] = (1.0, 1.0)
    patch_radius: float = 0.0


@dataclass(frozen=True, kw_only=True)
class FingerLink:
    """A link that grasps: side 0 left, 1 right; ``opening`` is the sign of its own y axis along which it opens."""

    link: str
    side: int
    opening: float = 1.0


@dataclass(frozen=True, kw_only=True)
class RobotBody:
    """A robot as physics sees it; vectors are in the order of ``joints``.

    Attributes:
        urdf: the file.
        joints: active joints.
        stiffness, damping, force_limit: drives, force mode, [dof].
        surfaces: link and its surface, where it differs from friction 1.
        ignored: link and bit set; links that share a bit never collide.
        tcp: link whose pose is the tool's.
        fingers: links that grasp.
        armature: kg m2 (or kg) added to the joints, [dof]; empty for none. See ``GOOGLE_FINGER_ARMATURE``.
        stop: the two finger joints, and what they may add up to; None for no limit. See ``GOOGLE_FINGER_STOP``.
        frozen: joints that stay where an episode begins, and their angles (radians): physics leaves them out.
    """

    urdf: Path
    joints: tuple[str, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    force_limit: tuple[float, ...]
    surfaces: tuple[tuple[str, LinkSurface], ...] = ()
    ignored: tuple[tuple[str, int], ...] = ()
    tcp: str
    fingers: tuple[FingerLink, ...]
    armature: tuple[float, ...] = ()
    stop: tuple[int, int, float] | None = None
    frozen: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, kw_only=True)
class ObjectBody:
    """A movable object in the scene.

    Attributes:
        name: its name, unique in the scene.
        collision: mesh file of convex hulls. visual: what is drawn, None for nothing.
        scale: of both. density: kg/m3.
        anchored: it never moves.
    """

    name: str
    collision: Path
    visual: Path | None = None
    scale: float = 1.0
    density: float = 1000.0
    anchored: bool = False


@dataclass(frozen=True, kw_only=True)
class Box:
    """A fixed box: centre and half sizes, metres."""

    centre: tuple[float, float, float]
    half_size: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class StageBody:
    """The surroundings: a mesh at a pose (``mesh_pose`` turns the mesh, ``offset`` is subtracted), or boxes.

    A mesh that is not ``solid`` is only drawn.
    """

    mesh: Path | None = None
    mesh_pose: tuple[float, ...] = (0.0, 0.0, 0.0, 0.707, 0.707, 0.0, 0.0)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    boxes: tuple[Box, ...] = ()
    solid: bool = True


@dataclass(frozen=True, kw_only=True)
class CabinetBody:
    """A cabinet with drawers: URDF file, drawer names top first, pose, and the drawers' friction and damping."""

    urdf: Path
    drawers: tuple[str, ...]
    pose: tuple[float, ...]
    friction: float = 0.05
    damping: float = 1.0


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """Everything in a scene. Slots with equal specs can take over each other's scenes."""

    robot: RobotBody
    sim_hz: int
    contact_offset: float
    objects: tuple[ObjectBody, ...] = ()
    stage: StageBody | None = None
    cabinet: CabinetBody | None = None


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where an episode begins.

    Attributes:
        base_pose: of the robot's root [7]. qpos: of its joints [dof].
        objects: poses [n, 7], in the order of the spec; those not anchored fall from there and settle.
        settled: None, or pose and velocity [n, 13] that settling has led to before.
        source, target: indices of the objects the task is about; -1 for none.
        late: indices of objects that fall one after the other, straight down, when the others have settled.
        drawer: index of the task's drawer, -1 for none. opened: how far it is open, metres.
    """

    base_pose: np.ndarray
    qpos: np.ndarray
    objects: np.ndarray
    settled: np.ndarray | None = None
    source: int = -1
    target: int = -1
    late: tuple[int, ...] = ()
    drawer: int = -1
    opened: float = 0.0


def facts_dtype(dof: int, objects: int) -> np.dtype:
    """One row of measurements a slot, for ``dof`` joints and at most ``objects`` objects.

    Fields: ``qpos``, ``qvel`` [dof]; ``tcp``, ``base`` [7]; ``objects`` [n, 7], ``velocities`` [n, 6] (linear, then
    angular), ``centres`` [n, 3] (of mass); ``drawers`` [3] and ``drawer_speeds`` [3]; ``grip`` [4, 2]: impulse between
    a finger link and the source, and the angle between it and the link's opening direction (rows as
    ``RobotBody.fingers``); ``support`` [2]: the largest impulse of a contact of the source with anything but the
    robot, and with anything but robot and target; ``floor``: impulse between the source and the floor of the task's
    drawer.
    """
    return np.dtype(
        [
            ("qpos", float, (dof,)),
            ("qvel", float, (dof,)),
            ("tcp", float, (7,)),
            ("base", float, (7,)),
            ("objects", float, (objects, 7)),
            ("velocities", float, (objects, 6)),
            ("centres", float, (objects, 3)),
            ("drawers", float, (MAX_DRAWERS,)),
            ("drawer_speeds", float, (MAX_DRAWERS,)),
            ("grip", float, (MAX_FINGERS, 2)),
            ("support", float, (2,)),
            ("floor", float),
        ]
    )


def instances(spec: SceneSpec) -> tuple[str, ...]:
    """What a segmentation image's numbers mean: "" for the background, then robot, objects, cabinet."""
    return ("", ROBOT, *(thing.name for thing in spec.objects), *((CABINET,) if spec.cabinet else ()))
