"""Options of perception, and the state of the hand that a view of the scene starts from.

In: nothing. Out: :class:`PerceptionConfig` with its defaults for the Panda, and :class:`HandState`, which a caller
fills in for each slot.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vecenv.manipulation.grasps import Gripper
from vecenv.manipulation.world import Margins
from voxposer.perception.grid import LEAST_MAP_SIZE, MAP_SIZE


@dataclass(frozen=True, kw_only=True)
class PerceptionConfig:
    """How objects are seen and grasped. Metres unless noted.

    Attributes:
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
