"""Bowls, mugs, pans and plates as a floor, a ring of walls and handles, or as one box.

In: solids of one body, z up, in that body's frame, metres. Out: boxes (and copies of handles). Every fit is a
deterministic formula.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vecenv.libero.scene.lean.planar import convex_hull, polygon_area, polygon_scale, turn_z
from vecenv.libero.scene.lean.solids import FitError, Solid, box, surface_points


@dataclass(frozen=True)
class Vessel:
    """What a bowl, mug, pan or plate is made of; z is up.

    Attributes:
        centre: of its rim, [2].
        floor: solids of the floor.
        wall: solids of the uppermost ring of walls.
        lower: solids of walls below it.
        rest: handles and spouts.
        bottom: lowest point, without ``rest``.
        inner: height of the floor inside.
        foot: half side of the square with the area of what it stands on.
    """

    centre: np.ndarray
    floor: tuple[Solid, ...]
    wall: tuple[Solid, ...]
    lower: tuple[Solid, ...]
    rest: tuple[Solid, ...]
    bottom: float
    inner: float
    foot: float


# A solid whose thinnest direction is within 10 degrees of vertical is floor.
_FLAT = np.cos(np.radians(10))
# Walls end within this distance below the rim's highest point, or they belong to a lower ring.
_TIER = 0.004
# What lies this far beyond the rim is a handle.
_BEYOND = 0.006
# A vessel stands on what is less than this above its lowest point.
_FOOT = 0.0025


def find_vessel(solids: Sequence[Solid]) -> Vessel:
    """Tell floor, walls and handles of a vessel apart.

    Raises:
        FitError: there is no ring of walls.
    """
    thin = [solid.mat[:, np.argmin(solid.half_extents)] for solid in solids]
    upright = [solid for solid, axis in zip(solids, thin, strict=True) if abs(axis[2]) < _FLAT]
    if len(upright) < 3:
        raise FitError(f"{len(upright)} upright solids make no vessel")
    centre, radius = _rim(upright)
    ring = [solid for solid in upright if _reach(solid, centre) < radius + _BEYOND]
    floor = [s for s, axis in zip(solids, thin, strict=True) if abs(axis[2]) >= _FLAT and _reach(s, centre) < radius]
    if len(ring) < 3 or not floor:
        raise FitError(f"{len(ring)} walls and {len(floor)} floors make no vessel")
    rest = [solid for solid in solids if not any(solid is other for other in (*ring, *floor))]
    top = max(_top(solid) for solid in ring)
    wall = [solid for solid in ring if _top(solid) > top - _TIER]
    lower = [solid for solid in ring if _top(solid) <= top - _TIER]
    points = np.concatenate([solid.extreme_points() for solid in (*floor, *ring)])
    bottom = float(points[:, 2].min())
    standing = points[points[:, 2] < bottom + _FOOT]
    return Vessel(
        centre=centre,
        floor=tuple(floor),
        wall=tuple(wall),
        lower=tuple(lower),
        rest=tuple(rest),
        bottom=bottom,
        inner=max(_top(solid) for solid in floor),
        foot=np.sqrt(polygon_area(convex_hull(standing[:, :2]))) / 2,
    )


def _top(solid: Solid) -> float:
    return float(solid.extreme_points()[:, 2].max())


def _reach(solid: Solid, centre: np.ndarray) -> float:
    """Largest distance of a solid from a vertical axis."""
    return float(np.linalg.norm(solid.extreme_points()[:, :2] - centre, axis=1).max())


def _rim(upright: Sequence[Solid]) -> tuple[np.ndarray, float]:
    """Centre and radius of the circle on which most of the highest upright solids lie."""
    tops = sorted((_top(solid) for solid in upright), reverse=True)
    enough = max(3, len(upright) // 5)
    top = next(top for top in tops if sum(top - _TIER < other <= top for other in tops) >= enough)
    highest = [solid for solid in upright if top - _TIER < _top(solid) <= top]
    points = np.array([solid.pos[:2] for solid in highest])
    for _ in range(4):
        centre, radius = _circle(points)
        off = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
        keep = off <= max(0.003, 2.5 * float(np.median(off)))
        if keep.all():
            break
        points = points[keep]
    return centre, max(_reach(solid, centre) for solid in highest if _near(solid, centre, radius))


def _near(solid: Solid, centre: np.ndarray, radius: float) -> bool:
    return abs(float(np.linalg.norm(solid.pos[:2] - centre)) - radius) < 0.006


def _circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Least-squares circle through points [n, 2] (Kåsa's method)."""
    system = np.column_stack([2 * points, np.ones(len(points))])
    (x, y, c), *_ = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)
    return np.array([x, y]), float(np.sqrt(c + x * x + y * y))


def vessel(solids: Sequence[Solid], walls: int, handles: int = 0) -> list[Solid]:
    """A floor, ``walls`` slanted walls in a ring and the ``handles`` largest solids of what sticks out.

    The floor carries: walls end a little above it. Without walls the floor reaches half way to the rim, since a plate's
    rim does not lie on the ground.

    Raises:
        FitError: the solids have no ring of walls, or no handle where one is required.
    """
    found = find_vessel(solids)
    ring = _ring(found, walls) if walls else []
    parts = [_floor(found, plate=not walls), *ring]
    if handles:
        if not found.rest:
            raise FitError("nothing sticks out that could be a handle")
        parts += sorted(found.rest, key=lambda solid: -float(np.prod(solid.half_extents)))[:handles]
    return parts


def filled_vessel(solids: Sequence[Solid], sink: float = 0.0) -> Solid:
    """A vessel without its handles as one box with its height, less ``sink``, and the volume it would have when full.

    Raises:
        FitError: the solids have no ring of walls.
    """
    found = find_vessel(solids)
    points = surface_points((*found.floor, *found.wall, *found.lower))
    height = np.ptp(points[:, 2])
    slices = np.minimum(((points[:, 2] - found.bottom) / height * _SLICES).astype(int), _SLICES - 1)
    reach = np.linalg.norm(points[:, :2] - found.centre, axis=1)
    radii = [reach[slices == k].max(initial=0.0) for k in range(_SLICES)]
    half = np.sqrt(np.pi * np.mean(np.square(radii))) / 2
    tall = (height - sink) / 2
    return box(np.array([*found.centre, found.bottom + tall]), np.eye(3), np.array([half, half, tall]))


_SLICES = 12
# Walls begin this far above the lowest point.
_CLEAR = 0.0015


def _floor(found: Vessel, *, plate: bool) -> Solid:
    rim = max(_reach(solid, found.centre) for solid in found.wall)
    half = (found.foot + rim * np.sqrt(np.pi) / 2) / 2 if plate else found.foot
    height = (found.inner - found.bottom) / 2
    pos = np.array([*found.centre, found.bottom + height])
    return box(pos, np.eye(3), np.array([half, half, height]))


def _ring(found: Vessel, walls: int) -> list[Solid]:
    """Walls with the slope, height and thickness of the upper ring, as a regular polygon."""
    slabs = np.array([_meridian(solid, found.centre) for solid in found.wall])
    radius, height, lean, half_length, half_thick = np.median(slabs, axis=0)
    lowest = found.bottom + _CLEAR
    along = np.array([np.sin(lean), np.cos(lean)])
    low = np.array([radius, height]) - half_length * along
    high = np.array([radius, height]) + half_length * along
    drop = half_thick * abs(np.sin(lean))
    if low[1] - drop < lowest:
        low += along * (lowest + drop - low[1]) / along[1]
    scale = polygon_scale(walls)
    (r, z), half = (low + high) / 2, np.linalg.norm(high - low) / 2
    side = r * scale * np.tan(np.pi / walls)
    parts = []
    for k in range(walls):
        turn = turn_z(2 * np.pi * k / walls)
        tilt = np.array([[np.cos(lean), 0.0, np.sin(lean)], [0.0, 1.0, 0.0], [-np.sin(lean), 0.0, np.cos(lean)]])
        pos = turn @ np.array([r * scale, 0.0, z]) + [*found.centre, 0.0]
        parts.append(box(pos, turn @ tilt, np.array([half_thick, side, half])))
    return parts


def _meridian(solid: Solid, centre: np.ndarray) -> tuple[float, float, float, float, float]:
    """Of a wall: radius and height of its middle, angle from vertical (outwards), half height, half thickness."""
    half = solid.half_extents
    thin = int(np.argmin(half))
    outward = np.array([*(solid.pos[:2] - centre), 0.0])
    outward /= np.linalg.norm(outward)
    others = [axis for axis in range(3) if axis != thin]
    tall = max(others, key=lambda axis: abs(solid.mat[2, axis]))
    direction = solid.mat[:, tall] * (1.0 if solid.mat[2, tall] > 0 else -1.0)
    lean = float(np.arctan2(direction @ outward, direction[2]))
    return float(np.linalg.norm(solid.pos[:2] - centre)), float(solid.pos[2]), lean, half[tall], half[thin]
