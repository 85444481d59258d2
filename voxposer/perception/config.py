"""Options of perception, and the state of the hand that a view of the scene starts from.

In: nothing. Out: :class:`PerceptionConfig` with its defaults for the Panda, and :class:`HandState`, which a caller
fills in for each slot.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vecenv.errors import InvalidInput
from vecenv.manipulation.grasps import Gripper
from vecenv.manipulation.world import Margins
from voxposer.perception.grid import LEAST_MAP_SIZE, MAP_SIZE

# Where observations come from, and how pixels get the names of objects.
SOURCES = ("ground_truth", "camera")
SEGMENTATIONS = ("renderer", "geometry")
# The cameras that are used unless others are named.
CAMERAS = ("agentview", "wrist")


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """How depth images become objects. Metres unless noted.

    Attributes:
        cameras: names of the cameras; those that an environment does not have are an error. None for those of
            agentview and wrist that it has.
        segmentation: ``"renderer"``, the instance masks of the renderer; or ``"geometry"``, clusters over the table,
            named by size and colour.
        colored: an object without a mask is looked for by the colour in its name, as far as it has one.
        largest_image: of larger images only every second, third, ... row and column is used, pixels.
        tolerance: a camera sees through a point this far in front of what it sees.
        voxel: seen points are averaged over voxels of this size.
        most_points: of an object; voxels are enlarged until there are no more.
        most_fixture_points: of a fixture.
        cluster: points within this distance of each other belong together.
        least_points: pixels by which an object is seen at all.
        moved: share of an object's remembered points in view that are not seen again, from which it has moved.
        fixed: an object that is longer than this, horizontally, is taken to be a fixture.
        on_table: a surface this close to the table belongs to it.
        rests: an object whose lowest seen point is this close to the table stands on it.
        hollow: a space that is open to above and deeper than this can hold things.
        sticks_out: what extends this far over the outline of a fixture's top is an open drawer.
        workspace: lower and upper corner of the workspace, relative to the robot's base horizontally and to the table
            vertically, [2, 3].
    """

    cameras: tuple[str, ...] | None = None
    segmentation: str = "renderer"
    colored: bool = False
    largest_image: int = 320
    tolerance: float = 0.008
    voxel: float = 0.004
    most_points: int = 600
    most_fixture_points: int = 2500
    cluster: float = 0.02
    least_points: int = 12
    moved: float = 0.25
    fixed: float = 0.25
    on_table: float = 0.003
    rests: float = 0.025
    hollow: float = 0.06
    sticks_out: float = 0.06
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]] = ((-0.1, -0.5, -0.09), (0.9, 0.5, 0.36))

    def __post_init__(self) -> None:
        if self.segmentation not in SEGMENTATIONS:
            raise InvalidInput(f"segmentation={self.segmentation!r}: expected one of {', '.join(SEGMENTATIONS)}")
        if self.cameras is not None and (isinstance(self.cameras, str) or not all(self.cameras) or not self.cameras):
            raise InvalidInput(f"cameras={self.cameras!r}: give a sequence of names of cameras, or None")


@dataclass(frozen=True, kw_only=True)
class PerceptionConfig:
    """How objects are seen and grasped. Metres unless noted.

    Attributes:
        source: ``"ground_truth"``, what ``observe_objects`` returns; or ``"camera"``, depth images.
        camera: how depth images become objects.
        margins: of picking and placing.
        held_box: half extents of the space between the pads, along the hand's x, y (closing) and z. While the fingers
            are closed around something, an object with points in this space is held. The closing half extent is added
            to half the gap between the pads.
        closed_gap: fingers that were commanded to close and stay further apart than this hold something.
        bar_depth: largest depth of the bar of a handle.
        tilts: of the hand from the vertical, tried at a handle in this order, radians.
        push_tilts: of the hand from the vertical while it pushes a part shut, best first, radians.
        less_tilt: room that each step down that list must gain, metres.
        push_start: distance before a part at which such a push begins.
        wrist_back: distance of the wrist behind the grip site.
        nearest: a wrist closer than this to the robot's base, horizontally, is out of reach.
        handle_room: sufficient room around the hand at a handle.
        table_margin: share of the workspace left out at each side of the table.
        above: height of the hand over an object when it has nothing to put down.
        edge: distance from the border of a place that the centre of what is put there keeps.
        home_reach: distance of the hand before the robot's base when an episode begins.
        map_size: voxels along each axis of the maps.
        fields: what the grasp, place and push fields of an observation hold. ``"geometry"``: poses found by geometry
            on ground-truth surface points and boxes. ``"centroid"``: what upstream's programs have to go by, the
            middle of an object for a grasp, the middle of its top for a place, and the hand pointing down.

    Raises:
        ValueError: there are no such fields.
    """

    source: str = "ground_truth"
    camera: CameraConfig = field(default_factory=CameraConfig)
    margins: Margins = field(default_factory=lambda: Margins(gripper=Gripper(wrist=0.14), grasp_tilts=(0.3, 0.6)))
    held_box: tuple[float, float, float] = (0.020, 0.006, 0.022)
    closed_gap: float = 0.0015
    bar_depth: float = 0.017
    tilts: tuple[float, ...] = (np.pi / 4, np.pi / 3, 1.4)
    push_tilts: tuple[float, ...] = (np.pi / 4, 0.6, 0.4, 0.2, 0.0)
    less_tilt: float = 0.01
    push_start: float = 0.08
    wrist_back: float = 0.2
    nearest: float = 0.30
    handle_room: float = 0.0
    table_margin: float = 0.1
    above: float = 0.10
    edge: float = 0.03
    home_reach: float = 0.45
    map_size: int = MAP_SIZE
    fields: Literal["geometry", "centroid"] = "geometry"

    def __post_init__(self) -> None:
        if self.map_size < LEAST_MAP_SIZE:
            raise ValueError(f"map_size must be at least {LEAST_MAP_SIZE}, not {self.map_size}")
        if self.fields not in ("geometry", "centroid"):
            raise ValueError(f"fields must be 'geometry' or 'centroid', got {self.fields!r}")
        if self.source not in SOURCES:
            raise InvalidInput(f"perception={self.source!r}: expected one of {', '.join(SOURCES)}")

    @property
    def title(self) -> str:
        """How results name it: "ground truth", or "camera" and what segments its images."""
        if self.source == "ground_truth":
            return "ground truth"
        masks = {"renderer": "renderer masks", "geometry": "segmented by geometry"}[self.camera.segmentation]
        return f"camera, {masks}"


@dataclass(frozen=True)
class HandState:
    """The hand of one slot.

    Attributes:
        pose: of the grip site, xyz + wxyz, world frame, [7].
        home: its pose when the episode began, [7].
        closed: whether the last command closed it.
    """

    pose: np.ndarray
    home: np.ndarray
    closed: bool = False
