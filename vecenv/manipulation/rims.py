"""Grasps of a dish by its rim: a plate or a saucer, which offers a gripper no two faces that look away from each other.

Surface points of one object that lies on something come in, z up; hands come out, one for each direction in which a
rim rises. One finger comes down outside the rim, the other inside it, on the slope of the dish. The hand leans
outwards a little, so that its inner pad meets the slope less steeply; friction between pads and dish does the rest.
The open hand is not centred: its outer finger is next to the rim, its inner one over the dish. Only geometry happens
here; no environment and no randomness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vecenv.manipulation.grasps import Gripper
from vecenv.manipulation.world import HOME_ROTATION

# A rim at least this far above the lower edge of the pads is held, metres.
_EDGE = 0.003


@dataclass(frozen=True, kw_only=True)
class RimConfig:
    """How rims are held. Metres unless noted.

    Attributes:
        headings: number of directions around the object that are tried.
        tilts: of the hand from the vertical, outwards, best first, radians.
        outside: from the inside of the open outer pad to the rim.
        fingertip: thickness of a finger at its tip, along the closing direction.
        floor: fingertips stay this far above the object's underside: the deeper, the better pads hold.
        edge: points this close to the outermost one in a direction belong to the rim.
        wide: half width of the strip behind a rim in which the slope of the dish is looked for.
        behind: least and largest distance of that slope from the rim.
        rise: least height of a rim over the dish behind it, middle over middle.
    """

    headings: int = 48
    tilts: tuple[float, ...] = (0.1, 0.2)
    outside: float = 0.0085
    fingertip: float = 0.0145
    floor: float = 0.0005
    edge: float = 0.006
    wide: float = 0.02
    behind: tuple[float, float] = (0.015, 0.045)
    rise: float = 0.005


@dataclass(frozen=True)
class RimGrasps:
    """K hands at a rim.

    Attributes:
        pos: of the grip site, [K, 3].
        rotation: of the hand, [K, 3, 3].
        far: distance of the rim from the object's middle, metres, [K]. Where an outline stands out, pads meet two faces
            and the object does not swing between them.
        tilt: of the hand, radians, [K].
    """

    pos: np.ndarray
    rotation: np.ndarray
    far: np.ndarray
    tilt: np.ndarray

    def __len__(self) -> int:
        return len(self.far)


def find_rim_grasps(
    points: np.ndarray,
    gripper: Gripper = Gripper(),  # noqa: B008  (frozen)
    config: RimConfig = RimConfig(),
) -> RimGrasps:
    """Hands that hold an object by its rim.

    Args:
        points: surface samples [N, 3], metres, world frame, z up.
        gripper: the gripper.
        config: how rims are held.

    Returns:
        One hand for each direction in which there is a rim, and each tilt; none for an object that is flat.
    """
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    found = [
        (pos, rotation, far, tilt)
        for heading in np.arange(config.headings) * 2 * np.pi / config.headings
        for inward in [np.array([np.cos(heading), np.sin(heading), 0.0])]
        for rim, far in _rim(points, middle, inward, config)
        for tilt in config.tilts
        for pos, rotation in [_hand(rim, inward, tilt, float(points[:, 2].min()), gripper, config)]
        if _holds(pos, rotation, rim, gripper)
    ]
    if not found:
        return RimGrasps(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0))
    return RimGrasps(*(np.array(column) for column in zip(*found, strict=True)))


def _rim(
    points: np.ndarray, middle: np.ndarray, inward: np.ndarray, config: RimConfig
) -> list[tuple[np.ndarray, float]]:
    """The rim opposite to a direction, a point [3], and its distance from the middle; nothing if none rises there."""
    local = points - middle
    back, aside = -(local @ inward), np.abs(local @ np.array([-inward[1], inward[0], 0.0]))
    far = float(back.max())
    strip = aside < config.wide
    edge = points[strip & (back > far - config.edge)]
    dish = points[strip & (back < far - config.behind[0]) & (back > far - config.behind[1])]
    if not len(edge) or not len(dish) or edge[:, 2].mean() - dish[:, 2].mean() < config.rise:
        return []
    return [(np.append((middle - far * inward)[:2], edge[:, 2].mean()), far)]


def _hand(
    rim: np.ndarray, inward: np.ndarray, tilt: float, floor: float, gripper: Gripper, config: RimConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] and rotation [3, 3] of a hand that leans outwards at a rim; of two such, the one turned less."""
    up = np.array([0.0, 0.0, 1.0])
    ahead = np.sin(tilt) * inward - np.cos(tilt) * up
    closing = np.cos(tilt) * inward + np.sin(tilt) * up
    hands = [np.stack([np.cross(y, ahead), y, ahead], axis=1) for y in (closing, -closing)]
    rotation = max(hands, key=lambda hand: float(np.trace(hand @ HOME_ROTATION.T)))
    pos = rim + (gripper.half_opening - config.outside) * closing
    tip = pos + gripper.tip * ahead - (gripper.half_opening + config.fingertip) * closing
    return pos + (tip[2] - floor - config.floor) / np.cos(tilt) * ahead, rotation


def _holds(pos: np.ndarray, rotation: np.ndarray, rim: np.ndarray, gripper: Gripper) -> bool:
    """Whether a rim [3] is between the edges of the pads of a hand."""
    depth = -float((rim - pos) @ rotation[:, 2])
    return gripper.pad[0] + _EDGE < depth < gripper.pad[1]
