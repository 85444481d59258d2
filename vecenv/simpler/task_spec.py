"""What a SIMPLER task consists of, as types: robot, scene, camera, light, budget, and when it is solved.

The values of the 25 tasks are in ``task_table.py``. Lengths are metres, angles radians unless a field says degrees,
poses are xyz + wxyz in the world frame. Nothing here needs SAPIEN or assets.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
import numpy.typing as npt

from vecenv.simpler.control.robots import Robot

BRIDGE, GOOGLE = "simpler/bridge", "simpler/google_robot"
DATA = PurePosixPath("data")
"""Folder of objects, stages and images in the asset tree."""

DRAWERS = ("top", "middle", "bottom")
ORIENTATIONS = ("upright", "laid_vertically", "lr_switch")


@dataclass(frozen=True, kw_only=True)
class Camera:
    """The third-person camera, fixed to a link of the robot.

    Attributes:
        name: upstream's name.
        link: link it is fixed to.
        position: in the link's frame, metres.
        quat: wxyz, in the link's frame; x looks forward and z up, as in SAPIEN.
        width, height: pixels.
        focal: focal length, pixels, horizontally and vertically.
        centre: principal point, pixels.
        near, far: metres.
    """

    name: str
    link: str
    position: tuple[float, float, float]
    quat: tuple[float, float, float, float]
    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    near: float = 0.1
    far: float = 10.0

    @property
    def intrinsics(self) -> np.ndarray:
        """Camera matrix, [3, 3]."""
        return np.array([[self.focal[0], 0, self.centre[0]], [0, self.focal[1], self.centre[1]], [0, 0, 1]])


@dataclass(frozen=True, kw_only=True)
class DirectionalLight:
    """Parallel light: ``direction`` it travels in, world frame, and its ``colour``; ``shadow``: it casts shadows."""

    direction: tuple[float, float, float]
    colour: tuple[float, float, float]
    shadow: bool = False


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """Light of a scene: ``ambient`` colour and the directional lights; ``casts``: they cast shadows upstream."""

    ambient: tuple[float, float, float]
    directional: tuple[DirectionalLight, ...] = ()
    casts: bool = False


@dataclass(frozen=True, kw_only=True)
class StageSpec:
    """What stands around the workspace.

    Attributes:
        name: stem of its mesh among the stages, or None for a bare floor that is only drawn.
        offset: its origin is put at minus this, metres.
        table_height: objects are dropped from half a metre above, metres, world frame.
        turn: pose of the mesh in the stage's frame, xyz and wxyz, not normalised (as upstream has it).
        solid: whether it has collision shapes; the rooms around cabinets are only drawn.
    """

    name: str | None
    offset: tuple[float, float, float]
    table_height: float = 0.87
    turn: tuple[float, ...] = (0.0, 0.0, 0.0, 0.707, 0.707, 0.0, 0.0)
    solid: bool = True

    @property
    def mesh(self) -> PurePosixPath | None:
        """Path of its mesh in the asset tree; y is up in the file."""
        return DATA / "hab2_bench_assets/stages" / f"{self.name}.glb" if self.name else None


@dataclass(frozen=True, kw_only=True)
class PickSuccess:
    """The object was lifted: no contact with anything but the robot while higher than ``lift``, since the last grasp;
    or it was ``significant_lift`` high in so many steps altogether. Heights are since it settled, metres; impulses in
    N·s; the angle, degrees, takes the place of the robot's own.
    """

    impulse: float = 1e-6
    lift: float = 0.01
    significant_lift: float = 0.02
    significant_steps: int = 5
    grasp_angle: float = 80.0


@dataclass(frozen=True, kw_only=True)
class MoveNearSuccess:
    """The source object ends near the target. Metres, since the objects settled.

    Attributes:
        other_drop: how far the other objects may sink.
        drop: how far source and target may sink.
        moved: least distance that the source moves in xy, more than any other object does.
        gap: centres of mass may be this far apart in xy, beyond half of both bounding boxes' diagonals.
        closest: no other object may be nearer to the source by more than this.
    """

    other_drop: float = 0.02
    drop: float = 0.15
    moved: float = 0.03
    gap: float = 0.10
    closest: float = 0.01


@dataclass(frozen=True, kw_only=True)
class DrawerSuccess:
    """The drawer's joint is at least, or at most, ``threshold`` metres open; it starts at ``start``."""

    threshold: float
    opens: bool
    start: float = 0.0

    def reached(self, qpos: npt.ArrayLike) -> np.ndarray:
        """Verdicts for joint positions of any shape, metres."""
        return np.asarray(qpos) >= self.threshold if self.opens else np.asarray(qpos) <= self.threshold


@dataclass(frozen=True, kw_only=True)
class PlaceSuccess:
    """The object touched the drawer's floor in some step, and the drawer is open, in the second half of the episode.

    Attributes:
        open: least joint position of the drawer, metres.
        impulse: least impulse of a contact, N·s.
        floor_shape: which collision shape of the drawer is its floor.
        second_half: control steps after which the second instruction holds whatever the policy does.
        start: the drawer's joint at the beginning, metres.
    """

    open: float = 0.05
    impulse: float = 1e-6
    floor_shape: int = 2
    second_half: int = 100
    start: float = 0.0


@dataclass(frozen=True, kw_only=True)
class PutOnSuccess:
    """The source object's centre of mass is above the target's, within its bounding box.

    Attributes:
        xy_slack: metres beyond half of the target box's xy diagonal.
        z_slack: metres between the boxes.
        clear: nothing but target and robot may touch the source.
        impulse: what counts as a touch, N·s.
    """

    xy_slack: float = 0.003
    z_slack: float = 0.02
    clear: bool = False
    impulse: float = 1e-6


Success = PickSuccess | MoveNearSuccess | DrawerSuccess | PlaceSuccess | PutOnSuccess


@dataclass(frozen=True, kw_only=True)
class SimplerTask:
    """One task.

    Attributes:
        suite: ``simpler/bridge`` or ``simpler/google_robot``.
        index: place in the suite, from 0, in upstream's order.
        name: upstream's name.
        family: ``pick``, ``move_near``, ``open``, ``close``, ``place`` or ``put_on``.
        instruction: the policy's instruction; words in capitals depend on the episode (see ``Layout.instruction``).
        robot: the robot.
        max_steps: step budget, control steps.
        models: objects an episode chooses from; of ``put_on``, source and target.
        triplets: of ``move_near``, the groups of objects.
        drawers: drawers an episode chooses from.
        orientation: how the can stands; None when an episode chooses.
        models_file: JSON file with sizes and densities, in the asset tree; "" where there are no objects.
        stage: surroundings.
        station: the cabinet's URDF file in the asset tree, or None.
        contact_offset: PhysX's, metres.
        overlays: photographs that replace the background, in the asset tree; an episode chooses one.
        always_overlaid: objects that the photograph replaces too.
        camera: the third-person camera.
        lighting: light.
        ray_traced: upstream draws it with its ray tracer.
        shiny: upstream gives the robot's links specular 0.9 and roughness 0.3.
        matte: upstream draws the objects with roughness 1, metallic 0 and specular 0.
        success: when the task is solved.
    """

    suite: str
    index: int
    name: str
    family: str
    instruction: str
    robot: Robot
    max_steps: int
    models: tuple[str, ...] = ()
    triplets: tuple[tuple[str, str, str], ...] = ()
    drawers: tuple[str, ...] = ()
    orientation: str | None = None
    models_file: str = ""
    stage: StageSpec
    station: PurePosixPath | None = None
    contact_offset: float = 0.02
    overlays: tuple[PurePosixPath, ...]
    always_overlaid: tuple[str, ...] = ()
    camera: Camera
    lighting: Lighting
    ray_traced: bool = False
    shiny: bool = True
    matte: bool = False
    success: Success

    @property
    def control_hz(self) -> int:
        """Control steps a second."""
        return self.robot.control_hz

    @property
    def sim_hz(self) -> int:
        """Physics substeps a second."""
        return self.robot.sim_hz

    @property
    def models_path(self) -> PurePosixPath | None:
        """Path of ``models_file`` in the asset tree."""
        return DATA / "custom" / self.models_file if self.models_file else None
