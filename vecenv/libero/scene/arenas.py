"""The six LIBERO workspaces as a table: which MJCF they come from, where table, robot, regions and cameras sit.

Every number is a fact read from LIBERO's problem classes (``libero/envs/problems``) and arenas (``libero/envs/arenas``)
and from robosuite 1.4.0's mounts. Lengths are metres, quaternions wxyz, positions are in the world frame unless a
comment says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A fixed camera: ``pos`` in metres, ``quat`` wxyz, world frame."""

    name: str
    pos: Vec3
    quat: Quat


@dataclass(frozen=True, kw_only=True)
class BoxTable:
    """A table whose box is sized by the problem: ``full_size`` in metres, sliding/torsional/rolling ``friction``."""

    full_size: Vec3
    friction: Vec3


@dataclass(frozen=True, kw_only=True)
class Arena:
    """One workspace.

    Attributes:
        scene_xml: MJCF file below the LIBERO assets.
        workspace: name of the fixture that stands for the table (or floor) in BDDL; regions on it become sites.
        workspace_category: category under which BDDL declares that fixture; it is part of the arena, not an object.
        table_body: body that carries the region sites.
        workspace_offset: origin of the region coordinates, world frame.
        zone_offset: added to a region's centre to get the site's position in ``table_body``'s frame.
        fixture_z: added to ``workspace_offset[2]`` when a fixture is placed.
        robot_base: position of the robot's base body.
        mounted: whether the robot stands on the pedestal.
        table: the table box, where the problem sizes it.
        floor_texture, wall_texture: image files used by the visual model.
        cameras: cameras that the problem adds or moves.
    """

    scene_xml: str
    workspace: str
    workspace_category: str
    table_body: str
    workspace_offset: Vec3
    zone_offset: Vec3
    fixture_z: float
    robot_base: Vec3
    mounted: bool
    floor_texture: str
    wall_texture: str = "light-gray-plaster.png"
    table: BoxTable | None = None
    cameras: tuple[Camera, ...] = field(default_factory=tuple)


# Cameras in the MJCF of every workspace, and those of the robot.
_IN_EVERY_ARENA = ("frontview", "birdview", "agentview", "sideview")
_OF_ROBOT = ("robot0_robotview", "robot0_eye_in_hand")


def camera_names(arena: Arena) -> tuple[str, ...]:
    """Names of the cameras that scenes in a workspace have, in their order in the compiled model."""
    return tuple(dict.fromkeys((*_IN_EVERY_ARENA, *(camera.name for camera in arena.cameras), *_OF_ROBOT)))


_DOWN: Quat = (0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349)
_LOW: Quat = (0.6182166934013367, 0.3432307541370392, 0.3432314395904541, 0.6182177066802979)
_FRONT: Quat = (0.56, 0.43, 0.43, 0.56)


def _gallery() -> Camera:
    return Camera(
        name="galleryview",
        pos=(2.844547668904445, 2.1279684793440667, 3.128616846013882),
        quat=(0.42261379957199097, 0.23374411463737488, 0.41646939516067505, 0.7702690958976746),
    )


def _paper(pos: Vec3) -> Camera:
    return Camera(name="paperview", pos=pos, quat=(0.513, 0.353, 0.443, 0.645))


_HIGH_FRONT = Camera(name="frontview", pos=(1.0, 0.0, 1.48), quat=_FRONT)

ARENAS: dict[str, Arena] = {
    "libero_tabletop_manipulation": Arena(
        scene_xml="scenes/libero_tabletop_base_style.xml",
        workspace="main_table",
        workspace_category="table",
        table_body="table",
        workspace_offset=(0.0, 0.0, 0.90),
        zone_offset=(0.0, 0.0, 0.02),
        fixture_z=0.01 - 0.05,
        robot_base=(-0.66, 0.0, 0.912),
        mounted=True,
        floor_texture="light-gray-floor-tile.png",
        table=BoxTable(full_size=(1.0, 1.2, 0.05), friction=(0.6, 0.005, 0.0001)),
        cameras=(
            Camera(name="agentview", pos=(0.6586131746834771, 0.0, 1.6103500240372423), quat=_DOWN),
            _HIGH_FRONT,
            _gallery(),
        ),
    ),
    "libero_kitchen_tabletop_manipulation": Arena(
        scene_xml="scenes/libero_kitchen_tabletop_base_style.xml",
        workspace="kitchen_table",
        workspace_category="kitchen_table",
        table_body="table",
        workspace_offset=(0.0, 0.0, 0.90),
        zone_offset=(0.0, 0.0, 0.90 - 0.90),
        fixture_z=0.01 - 0.05,
        robot_base=(-0.66, 0.0, 0.912),
        mounted=True,
        floor_texture="gray_ceramic_tile.png",
        wall_texture="yellow_linen_wall_texture.png",
        table=BoxTable(full_size=(1.0, 1.2, 0.05), friction=(1.0, 0.005, 0.0001)),
        cameras=(
            Camera(name="agentview", pos=(0.6586131746834771, 0.0, 1.6103500240372423), quat=_DOWN),
            _HIGH_FRONT,
            _gallery(),
            _paper((2.1, 0.535, 2.075)),
        ),
    ),
    "libero_study_tabletop_manipulation": Arena(
        scene_xml="scenes/libero_study_base_style.xml",
        workspace="study_table",
        workspace_category="study_table",
        table_body="study_table",
        workspace_offset=(-0.2, 0.0, 0.867),
        zone_offset=(-0.2, 0.0, 0.867),
        fixture_z=0.01 - 0.05,
        robot_base=(-0.75, 0.0, 0.912),
        mounted=True,
        floor_texture="light-gray-floor-tile.png",
        cameras=(
            Camera(name="agentview", pos=(0.4586131746834771, 0.0, 1.6103500240372423), quat=_DOWN),
            _HIGH_FRONT,
            _gallery(),
            _paper((2.1, 0.535, 2.075)),
        ),
    ),
    "libero_living_room_tabletop_manipulation": Arena(
        scene_xml="scenes/libero_living_room_tabletop_base_style.xml",
        workspace="living_room_table",
        workspace_category="living_room_table",
        table_body="living_room_table",
        workspace_offset=(0.0, 0.0, 0.41),
        zone_offset=(0.0, 0.0, 0.41),
        fixture_z=0.01 - 0.024,
        robot_base=(-0.51, 0.0, 0.42),
        mounted=False,
        floor_texture="seamless_wood_planks_floor.png",
        cameras=(
            Camera(name="agentview", pos=(0.6065773716836134, 0.0, 0.96), quat=_LOW),
            Camera(name="frontview", pos=(1.5, 0.0, 0.9), quat=_FRONT),
            _gallery(),
            _paper((2.1, 0.735, 1.875)),
        ),
    ),
    "libero_coffee_table_manipulation": Arena(
        scene_xml="scenes/libero_coffee_table_base_style.xml",
        workspace="coffee_table",
        workspace_category="coffee_table",
        table_body="coffee_table",
        workspace_offset=(0.0, 0.0, 0.41),
        zone_offset=(0.0, 0.0, 0.02),
        fixture_z=0.01 - 0.024,
        robot_base=(-0.51, 0.0, 0.41),
        mounted=False,
        floor_texture="seamless_wood_planks_floor.png",
        cameras=(
            Camera(name="agentview", pos=(1.5, 0.0, 0.9), quat=_FRONT),
            _gallery(),
            Camera(name="canonical_agentview", pos=(0.5386131746834771, 0.0, 0.7903500240372423), quat=_DOWN),
        ),
    ),
    "libero_floor_manipulation": Arena(
        scene_xml="scenes/libero_floor_base_style.xml",
        workspace="floor",
        workspace_category="floor",
        table_body="floor",
        workspace_offset=(0.0, 0.0, -0.035),
        zone_offset=(0.0, 0.0, 0.02),
        fixture_z=-0.025,
        robot_base=(-0.6, 0.0, 0.0),
        mounted=False,
        floor_texture="light-gray-floor-tile.png",
        cameras=(
            Camera(name="agentview", pos=(0.8965773716836134, 5.216182733499864e-07, 0.65), quat=_LOW),
            Camera(name="frontview", pos=(1.0, 0.0, 0.65), quat=_FRONT),
            _gallery(),
        ),
    ),
}
