"""Positions and joint positions of SIMPLER's robots when an episode begins.

Lengths are metres, angles radians, quaternions wxyz in the world frame, as tuples. The numbers are upstream's
(ManiSkill2_real2sim commit ef7a4d4, ``envs/custom_scenes``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TypedDict

from vecenv.simpler.task_spec import SimplerTask

Quat = tuple[float, float, float, float]
_GOOGLE_QPOS = (
    -0.2639457174606611,
    0.0831913360274175,
    0.5017611504652179,
    1.156859026208673,
    0.028583671314766423,
    1.592598203487462,
    -1.080652960128774,
    0.0,
    0.0,
    -0.00285961,
    0.7851361,
)
_WIDOWX_QPOS = (-0.01840777, 0.0398835, 0.22242722, -0.00460194, 1.36524296, 0.00153398, 0.037, 0.037)
_SINK_QPOS = (-0.2600599, -0.12875618, 0.04461369, -0.00652761, 1.7033415, -0.26983038, 0.037, 0.037)
# Heights of the base: WidowX at the table, at the sink; the Google Robot's, which is its own and the floor's.
_WIDOWX_HEIGHT, _SINK_HEIGHT, _GOOGLE_HEIGHT = 0.87, 0.85, 0.06205 + 0.017
_TURNED: Quat = (0.0, 0.0, 0.0, 1.0)
Station = tuple[float, float, float]
WIDOWX_STATION: Station = (0.147, 0.028, 0.0)
"""Where a robot stands: x, y (metres) and yaw (radians)."""
SINK_STATION: Station = (0.127, 0.06, 0.0)
PICK_STATION: Station = (0.35, 0.20, 0.0)
MOVE_NEAR_STATION: Station = (0.35, 0.21, -0.09)
DRAWER_STATIONS: Mapping[str, Station] = MappingProxyType(
    {
        "a0": (0.644, -0.179, -0.03),
        "a1": (0.765, -0.182, -0.02),
        "a2": (0.889, -0.203, -0.06),
        "b0": (0.652, 0.009, 0.0),
        "b1": (0.752, 0.009, 0.0),
        "b2": (0.851, 0.035, 0.0),
        "c0": (0.665, 0.224, 0.0),
        "c1": (0.765, 0.222, -0.025),
        "c2": (0.865, 0.222, -0.025),
    }
)
"""Where the real robot stood when the images of the drawers were taken."""


class Stand(TypedDict):
    """The robot's place, as ``Choices`` has it."""

    robot_xy: tuple[float, float]
    robot_quat: Quat


def stand(station: Station) -> Stand:
    """A robot's place: yaw is added to the half turn by which the robots face their tables."""
    x, y, yaw = station
    return {"robot_xy": (x, y), "robot_quat": multiply_quats(yaw_quat(yaw), _TURNED)}


def put_on_station(task: SimplerTask) -> Station:
    """Position of WidowX in a task of ``put_on``."""
    return SINK_STATION if at_sink(task) else WIDOWX_STATION


def at_sink(task: SimplerTask) -> bool:
    """Whether a task is at the sink."""
    return task.name == "widowx_put_eggplant_in_basket"


def first_posture(task: SimplerTask) -> tuple[float, tuple[float, ...]]:
    """Height of the base, metres, and the joints at the beginning."""
    if task.family != "put_on":
        return _GOOGLE_HEIGHT, _GOOGLE_QPOS
    return (_SINK_HEIGHT, _SINK_QPOS) if at_sink(task) else (_WIDOWX_HEIGHT, _WIDOWX_QPOS)


def yaw_quat(angle: float) -> Quat:
    """The rotation about z."""
    return math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)


def roll_quat(angle: float) -> Quat:
    """The rotation about x."""
    return math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0


def multiply_quats(a: Quat, b: Quat) -> Quat:
    """The product a b."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
