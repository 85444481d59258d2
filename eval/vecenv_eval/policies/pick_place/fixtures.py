"""Open and close drawers, turn knobs: motions of the hand against the moving parts of fixtures, as waypoints.

Drawers are known by their regions, which slide along ``RegionBox.axis``; a drawer's handle is a bar in front of it, at
a place that is the same on all of LIBERO's cabinets (:class:`DrawerHandle`; surface points are too few to find it). A
knob is the ridge that stands highest on its fixture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vecenv.manipulation.world import HOME_ROTATION, SceneGeometry, down_facing, spun, yaw
from vecenv.observations import RegionBox
from vecenv_eval.policies.pick_place.motion import CLOSE, OPEN, Waypoint


@dataclass(frozen=True, kw_only=True)
class DrawerHandle:
    """Where the handle bar of a drawer is, and how it is used. Metres and radians.

    Measured on the collision boxes of wooden_cabinet and white_cabinet.

    Attributes:
        before: from the front of the region to the middle of the bar, in opening direction.
        below: from the middle of the region down to the middle of the bar.
        depth: half the bar's depth in opening direction.
        travel: how far a drawer slides.
        past: pushing and pulling aim this far beyond the end of the travel.
        tilt: of the hand from the vertical while pushing.
        flat_tilt: the same for a handle with another above it.
        shallow, deepest: heights of the cabinet's top over a handle, up to which it is pulled with ``tilt``, or at all.
        clear: room before the bar to come down in.
    """

    before: float = 0.0455
    below: float = 0.006
    depth: float = 0.0075
    travel: float = 0.155
    past: float = 0.03
    tilt: float = np.pi / 4
    flat_tilt: float = 1.4
    shallow: float = 0.08
    deepest: float = 0.15
    clear: float = 0.06


def drawer_direction(world: SceneGeometry, region: RegionBox) -> np.ndarray:
    """The direction in which a drawer opens: along its axis, to the side where the cabinet sticks out (its handles)."""
    if region.axis is None or region.parent is None:
        raise ValueError("a drawer's region has an axis and a parent")
    tops = [r for r in world.snapshot.regions.values() if r.parent == region.parent and r.axis is None]
    if not tops:
        return region.axis
    along = (world.points(region.parent) - tops[0].pos) @ region.axis
    return region.axis if along.max() > -along.min() else -region.axis


def handle_of(region: RegionBox, direction: np.ndarray, handle: DrawerHandle) -> np.ndarray:
    """Middle of the handle bar, [3]."""
    half = float(np.abs(region.mat.T @ direction) @ region.half_extents)
    return region.pos + direction * (half + handle.before) - [0.0, 0.0, handle.below]


def close_drawer(world: SceneGeometry, region: RegionBox, handle: DrawerHandle) -> list[Waypoint]:
    """Push a drawer shut by its handle with closed, tilted fingers."""
    direction = drawer_direction(world, region)
    bar = handle_of(region, direction, handle)
    rotation = tilted(-direction, handle.tilt, world.hand_rotation)
    tip = rotation[:, 2] * world.config.gripper.tip
    begin = bar + direction * (handle.depth + handle.clear) - tip
    end = bar - direction * (handle.travel + handle.past) - tip
    over = max(world.tallest(world.hand, begin) + 0.06, begin[2] + 0.10)
    return [
        Waypoint(world.hand * [1, 1, 0] + [0, 0, max(over, world.hand[2])], world.hand_rotation, CLOSE, tolerance=0.05),
        Waypoint(begin * [1, 1, 0] + [0, 0, over], rotation, CLOSE, tolerance=0.03, turn_tolerance=0.2),
        Waypoint(begin, rotation, CLOSE, tolerance=0.015, turn_tolerance=0.15),
        Waypoint(end, rotation, CLOSE, tolerance=0.005, turn_tolerance=9.0),
        Waypoint(end + direction * 0.10 + [0, 0, 0.05], rotation, OPEN, tolerance=0.05),
    ]


def open_drawer(world: SceneGeometry, region: RegionBox, handle: DrawerHandle) -> list[Waypoint] | str:
    """Pinch a drawer's handle bar from above and below with a tilted hand and pull; or return why not."""
    direction = drawer_direction(world, region)
    bar = handle_of(region, direction, handle)
    depth = world.points(region.parent or "")[:, 2].max() - bar[2]
    if depth > handle.deepest:
        return "the handle is too low to come at with the hand"
    tilt = handle.tilt if depth < handle.shallow else handle.flat_tilt
    rotation = pitched(-direction, tilt, world.hand_rotation)
    back = -rotation[:, 2]
    begin, end = bar + 0.08 * back, bar + direction * (handle.travel + handle.past)
    over = max(world.tallest(world.hand, begin) + 0.06, begin[2], world.hand[2])
    return [
        Waypoint(world.hand * [1, 1, 0] + [0, 0, over], world.hand_rotation, OPEN, tolerance=0.05),
        Waypoint(begin * [1, 1, 0] + [0, 0, over], rotation, OPEN, tolerance=0.03, turn_tolerance=0.2),
        Waypoint(begin, rotation, OPEN, tolerance=0.012, turn_tolerance=0.1),
        Waypoint(bar, rotation, OPEN, tolerance=0.004, turn_tolerance=0.08),
        Waypoint(bar, rotation, CLOSE, fingers=True),
        Waypoint(end, rotation, CLOSE, tolerance=0.005, turn_tolerance=9.0, speed=0.6),
        Waypoint(end, rotation, OPEN, fingers=True),
        Waypoint(end + 0.08 * back, rotation, OPEN, tolerance=0.03, turn_tolerance=9.0),
        Waypoint(end + 0.08 * back + [0, 0, 0.1], rotation, OPEN, tolerance=0.04, turn_tolerance=9.0),
    ]


def pitched(towards: np.ndarray, tilt: float, current: np.ndarray) -> np.ndarray:
    """Like :func:`tilted`, but the fingers close in the vertical plane in which the hand is tilted."""
    z = np.sin(tilt) * towards - np.cos(tilt) * np.array([0.0, 0.0, 1.0])
    x = np.cross([0.0, 0.0, 1.0], towards)
    return _nearest([np.stack([side, np.cross(z, side), z], axis=1) for side in (x, -x)], current)


def tilted(towards: np.ndarray, tilt: float, current: np.ndarray) -> np.ndarray:
    """A hand that points down, tilted so that its fingers lead ``towards``; it closes horizontally.

    Args:
        towards: horizontal unit vector [3].
        tilt: angle from the vertical, radians.
        current: the hand's present rotation.
    """
    z = np.sin(tilt) * towards - np.cos(tilt) * np.array([0.0, 0.0, 1.0])
    y = np.cross([0.0, 0.0, 1.0], towards)
    return _nearest([np.stack([np.cross(side, z), side, z], axis=1) for side in (y, -y)], current)


def _nearest(options: list[np.ndarray], current: np.ndarray) -> np.ndarray:
    """The rotation nearest to home (the wrist has limits); of equals, the one nearest to the current one."""
    return max(options, key=lambda option: float(np.trace(option @ (HOME_ROTATION + 0.1 * current).T)))


def turn_knob(world: SceneGeometry, fixture: str, angle: float) -> list[Waypoint]:
    """Take hold of a knob's ridge from above and turn it by ``angle`` (radians, counterclockwise seen from above)."""
    points = world.points(fixture)
    ridge = points[points[:, 2] > points[:, 2].max() - 0.02]
    centre = (ridge.min(axis=0) + ridge.max(axis=0)) / 2
    spread = (ridge - centre)[:, :2]
    _, vectors = np.linalg.eigh(spread.T @ spread)
    across = np.append(vectors[:, 0], 0.0)
    begin = _knob_start(down_facing(across[None])[0], angle)
    gripper = world.config.gripper
    pos = np.append(centre[:2], points[:, 2].max() - 0.6 * gripper.palm + 0.004)
    over = np.append(centre[:2], max(world.tallest(world.hand, pos) + 0.05, pos[2] + 0.06))
    middle, end = spun(begin, angle / 2), spun(begin, angle)
    return [
        Waypoint(over, begin, OPEN, tolerance=0.012, turn_tolerance=0.12),
        Waypoint(pos, begin, OPEN, tolerance=0.004, turn_tolerance=0.06),
        Waypoint(pos, begin, CLOSE, fingers=True),
        Waypoint(pos, middle, CLOSE, tolerance=0.05, turn_tolerance=0.3),
        Waypoint(pos, end, CLOSE, tolerance=0.05, turn_tolerance=0.05),
        Waypoint(pos, end, OPEN, fingers=True),
        Waypoint(over, end, OPEN, tolerance=0.03, turn_tolerance=3.2),
    ]


def _knob_start(rotation: np.ndarray, angle: float) -> np.ndarray:
    """Of the two hands that hold a ridge, the one that ends up turned less from home."""
    other = spun(rotation, np.pi)
    return min((rotation, other), key=lambda option: max(abs(float(yaw(option))), abs(float(yaw(option)) + angle)))
