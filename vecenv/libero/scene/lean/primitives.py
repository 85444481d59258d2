"""Few boxes and capsules in the place of many: fits of simple shapes to the convex solids an object is made of.

In: the solids of one body (boxes, capsules, cylinders, hulls of meshes), in that body's frame. Out: a short list of
boxes or capsules that stands for them. Every fit is a deterministic formula of the solids: bounding boxes with the area
of what they replace, greedy merging, vessels (a floor and a ring of walls), round columns, capsules. Lengths are in
metres. Which fit suits which object is data, see ``vecenv.libero.scene.lean.recipes``.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vecenv.errors import InvalidInput

BOX, CAPSULE, CYLINDER, HULL = "box", "capsule", "cylinder", "hull"

# Corner signs of a box, [8, 3].
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
# Of a solid, how much must lie within another for it to be left out before merging.
_COVERED = 0.95
# Points by which volumes are compared, and cells along the longer side of a cross-section.
_VOLUME_POINTS = 300
_SECTION_CELLS = 60
_ROUND_SIDES = 24


class FitError(InvalidInput):
    """Solids to which a shape cannot be fitted; the message says why."""


@dataclass(frozen=True)
class Solid:
    """A convex solid in its body's frame.

    Attributes:
        kind: ``BOX`` (half extents), ``CAPSULE`` and ``CYLINDER`` (radius, half length, 0; along the local z) or
            ``HULL`` (half extents of its box).
        pos: centre, metres, [3].
        mat: rotation, [3, 3].
        size: see ``kind``, metres, [3].
        points: corners of a hull in the body's frame, [n, 3].
    """

    kind: str
    pos: np.ndarray
    mat: np.ndarray
    size: np.ndarray
    points: np.ndarray | None = None

    @property
    def half_extents(self) -> np.ndarray:
        """Half extents of the box around it, in its own frame, [3]."""
        if self.kind in (BOX, HULL):
            return self.size
        ends = self.size[1] + (self.size[0] if self.kind == CAPSULE else 0.0)
        return np.array([self.size[0], self.size[0], ends])

    def extreme_points(self) -> np.ndarray:
        """Points whose convex hull it is (round ones as polygons around them), body frame, [n, 3]."""
        if self.points is not None:
            return self.points
        if self.kind == BOX:
            return self.pos + (_CORNERS * self.size) @ self.mat.T
        return self.pos + _round_points(self) @ self.mat.T

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance of body-frame points [n, 3] from its surface, negative inside, [n]; hulls count as their box."""
        local = (points - self.pos) @ self.mat
        if self.kind == CAPSULE:
            local[:, 2] -= np.clip(local[:, 2], -self.size[1], self.size[1])
            return np.linalg.norm(local, axis=1) - self.size[0]
        if self.kind == CYLINDER:
            local = np.stack([np.linalg.norm(local[:, :2], axis=1), local[:, 2]], axis=1)
            return _box_distance(local, self.size[:2])
        return _box_distance(local, self.size)

    def turned(self, mat: np.ndarray) -> Solid:
        """The same solid with its body's frame rotated by ``mat`` [3, 3]."""
        points = None if self.points is None else self.points @ mat.T
        return replace(self, pos=mat @ self.pos, mat=mat @ self.mat, points=points)


def box(pos: np.ndarray, mat: np.ndarray, size: np.ndarray) -> Solid:
    """A box: centre [3], rotation [3, 3], half extents [3]."""
    return Solid(BOX, np.asarray(pos, float), np.asarray(mat, float), np.asarray(size, float))


def capsule(start: np.ndarray, end: np.ndarray, radius: float) -> Solid:
    """A capsule around the segment from ``start`` to ``end``, [3] each."""
    axis = np.asarray(end, float) - start
    half = float(np.linalg.norm(axis)) / 2
    return Solid(CAPSULE, (np.asarray(start) + end) / 2, _frame_along(axis), np.array([radius, half, 0.0]))


def _frame_along(axis: np.ndarray) -> np.ndarray:
    """A rotation whose z is ``axis``, [3, 3]; the identity for a vector of length 0."""
    length = np.linalg.norm(axis)
    if length == 0.0:
        return np.eye(3)
    z = axis / length
    x = np.eye(3)[np.argmin(np.abs(z))]
    y = np.cross(z, x)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


def _box_distance(local: np.ndarray, half: np.ndarray) -> np.ndarray:
    gap = np.abs(local) - half
    return np.linalg.norm(np.maximum(gap, 0.0), axis=1) + np.minimum(gap.max(axis=1), 0.0)


def _round_points(solid: Solid) -> np.ndarray:
    """Points of a capsule or cylinder in its own frame, [n, 3]."""
    angle = np.arange(_ROUND_SIDES) * 2 * np.pi / _ROUND_SIDES
    radius, half = solid.size[:2]
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(_ROUND_SIDES, half)], axis=1)
    rings = [ring, ring * [1, 1, -1]]
    if solid.kind == CAPSULE:
        rings.append(np.array([[0, 0, half + radius], [0, 0, -half - radius]]))
    return np.concatenate(rings)


def union_distance(solids: Sequence[Solid], points: np.ndarray) -> np.ndarray:
    """Distance of body-frame points [n, 3] from a union of solids, negative inside any of them, [n]."""
    return np.min([solid.distance(points) for solid in solids], axis=0)


def surface_points(solids: Sequence[Solid], spacing: float = 0.002) -> np.ndarray:
    """Points spread evenly over the outer surface of a union of solids, body frame, [n, 3]."""
    kept = []
    for index, solid in enumerate(solids):
        points = _own_surface(solid, spacing)
        others = [other for i, other in enumerate(solids) if i != index]
        if others:
            points = points[union_distance(others, points) > -1e-4]
        kept.append(points)
    return np.concatenate(kept)


def _own_surface(solid: Solid, spacing: float) -> np.ndarray:
    flat = solid.kind in (BOX, HULL)
    local = _box_surface(solid.size, spacing) if flat else _round_surface(solid, spacing)
    return solid.pos + local @ solid.mat.T


def _box_surface(half: np.ndarray, spacing: float) -> np.ndarray:
    faces = []
    for axis in range(3):
        u, v = (half[i] for i in range(3) if i != axis)
        grid = np.stack(np.meshgrid(_ticks(u, spacing), _ticks(v, spacing), indexing="ij"), axis=-1).reshape(-1, 2)
        faces += [np.insert(grid, axis, side * half[axis], axis=1) for side in (-1.0, 1.0)]
    return np.concatenate(faces)


def _ticks(half: float, spacing: float) -> np.ndarray:
    """Middles of equal cells over [-half, half]."""
    count = max(1, round(2 * half / spacing))
    return (np.arange(count) + 0.5) * (2 * half / count) - half


def _round_surface(solid: Solid, spacing: float) -> np.ndarray:
    radius, half = solid.size[:2]
    count = max(8, round(2 * np.pi * radius / spacing))
    angle = np.arange(count) * 2 * np.pi / count
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    rings = [radius * circle + [0, 0, z] for z in _ticks(half, spacing)] if half else []
    for share in _ticks(0.5, spacing / radius) + 0.5:
        if solid.kind == CAPSULE:
            cap = radius * (np.cos(share * np.pi / 2) * circle + [0, 0, np.sin(share * np.pi / 2)]) + [0, 0, half]
        else:
            cap = radius * share * circle + [0, 0, half]
        rings += [cap, cap * [1, 1, -1]]
    return np.concatenate(rings)


# -- boxes around solids -----------------------------------------------------------------------------------------------


def bound(solids: Sequence[Solid], mat: np.ndarray | None = None) -> Solid:
    """The smallest box around solids, oriented as ``mat`` or, without it, as the largest of them."""
    mat = largest(solids).mat if mat is None else mat
    local = np.concatenate([solid.extreme_points() for solid in solids]) @ mat
    low, high = local.min(axis=0), local.max(axis=0)
    return box(mat @ (low + high) / 2, mat, (high - low) / 2)


def largest(solids: Sequence[Solid]) -> Solid:
    """The solid with the largest box."""
    return max(solids, key=lambda solid: float(np.prod(solid.half_extents)))


def block(solids: Sequence[Solid], up: int | None = None) -> Solid:
    """One box with the height of the solids along an axis of their body and the area of their outline seen along it.

    Args:
        solids: what it stands for.
        up: index of the body's axis, 0 to 2; None for the axis across which the outline fills its box best.
    """
    around = bound(solids, None if up is None else _upright(largest(solids).mat, up))
    axes = range(3) if up is None else [2]
    shares = {axis: _outline_share(solids, around, axis) for axis in axes}
    axis = max(shares, key=lambda a: shares[a])
    size = around.size * np.where(np.arange(3) == axis, 1.0, np.sqrt(shares[axis]))
    return replace(around, size=size)


def _upright(mat: np.ndarray, up: int) -> np.ndarray:
    """The rotation nearest to an orientation whose z is the body's axis ``up``."""
    z = np.eye(3)[up]
    side = mat[:, np.argmin(np.abs(mat[up]))]
    x = side - z * side[up]
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _outline_share(solids: Sequence[Solid], around: Solid, axis: int) -> float:
    """How much of a box's face the outline of the solids seen along ``axis`` fills."""
    keep = [i for i in range(3) if i != axis]
    half = around.size[keep]
    ticks = [_ticks(h, 2 * half.max() / _SECTION_CELLS) for h in half]
    grid = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 2)
    filled = np.zeros(len(grid), bool)
    for solid in solids:
        corners = ((solid.extreme_points() - around.pos) @ around.mat)[:, keep]
        filled |= _in_polygon(grid, _convex_hull(corners))
    return max(float(filled.mean()), 1e-3)


def _convex_hull(points: np.ndarray) -> np.ndarray:
    """Corners of the convex hull of points in the plane, counterclockwise (Andrew's monotone chain), [n, 2]."""
    ordered = sorted({(round(float(x), 9), round(float(y), 9)) for x, y in points})
    halves = []
    for sequence in (ordered, ordered[::-1]):
        chain: list[tuple[float, float]] = []
        for point in sequence:
            while len(chain) > 1 and _cross(chain[-2], chain[-1], point) <= 0:
                chain.pop()
            chain.append(point)
        halves += chain[:-1]
    return np.array(halves)


def _polygon_area(corners: np.ndarray) -> float:
    x, y = corners.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _cross(o: tuple[float, float], a: tuple[float, float], b: tuple[float, float]) -> float:
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


def _in_polygon(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Whether points [n, 2] lie within a convex polygon given counterclockwise."""
    edge = np.roll(corners, -1, axis=0) - corners
    offset = points[:, None] - corners
    return np.all(edge[:, 0] * offset[..., 1] - edge[:, 1] * offset[..., 0] >= -1e-9, axis=1)


def merge(solids: Sequence[Solid], count: int, up: int | None = None) -> list[Solid]:
    """At most ``count`` boxes: solids are joined two by two, each time those whose common box adds the least space.

    ``up`` is the body's axis along which heights are kept, as for :func:`block`.
    """
    if count == 1:
        return [_joined(solids, up)]
    clusters = [[solid] for solid in _uncovered(solids)]
    cost = {pair: _added_space(clusters, pair) for pair in itertools.combinations(range(len(clusters)), 2)}
    alive = set(range(len(clusters)))
    while len(alive) > count:
        first, second = min(cost, key=lambda pair: cost[pair])
        clusters.append(clusters[first] + clusters[second])
        alive -= {first, second}
        cost = {pair: value for pair, value in cost.items() if alive.issuperset(pair)}
        joined = len(clusters) - 1
        cost |= {(other, joined): _added_space(clusters, (other, joined)) for other in sorted(alive)}
        alive.add(joined)
    return [_joined(clusters[index], up) for index in sorted(alive)]


def _joined(cluster: Sequence[Solid], up: int | None) -> Solid:
    return bound(cluster) if len(cluster) == 1 else block(cluster, up)


def _uncovered(solids: Sequence[Solid]) -> list[Solid]:
    """The solids, largest first, without those that lie within a larger one."""
    kept: list[Solid] = []
    for solid in sorted(solids, key=lambda s: -float(np.prod(s.half_extents))):
        inside = _volume_points(bound([solid]))
        if not any((other.distance(inside) <= 1e-4).mean() > _COVERED for other in kept):
            kept.append(solid)
    return kept


def _added_space(clusters: Sequence[Sequence[Solid]], pair: tuple[int, int]) -> float:
    """Space within the common box of two clusters that neither of them fills, cubic metres."""
    solids = [*clusters[pair[0]], *clusters[pair[1]]]
    around = bound(solids)
    empty = union_distance(solids, _volume_points(around)) > 0
    return float(empty.mean() * np.prod(2 * around.size))


def _volume_points(around: Solid) -> np.ndarray:
    """Evenly spread points within a box (a Kronecker sequence), body frame."""
    golden = 1.22074408460575947536  # root of x^4 = x + 1: the three-dimensional golden ratio
    unit = (0.5 + np.arange(1, _VOLUME_POINTS + 1)[:, None] * golden ** -np.arange(1.0, 4.0)) % 1.0
    return around.pos + ((2 * unit - 1) * around.size) @ around.mat.T


# -- round things ------------------------------------------------------------------------------------------------------


def column(solids: Sequence[Solid], up: int, blades: int = 2) -> list[Solid]:
    """A solid, round column as ``blades`` crossed boxes whose corners form a regular polygon.

    With two blades the outline is that of a plus, its convex hull a regular octagon: flat for a gripper in eight
    directions, and flat on top and bottom.

    Args:
        solids: what it stands for.
        up: index of the body's axis along the column.
        blades: boxes; their polygon has ``4 * blades`` sides.
    """
    mat = _upright(np.eye(3), up)
    around = bound(solids, mat)
    share = _outline_share(solids, around, axis=2)
    radius = np.sqrt(share * 4 * around.size[0] * around.size[1] / np.pi)
    sides = 4 * blades
    outer = radius * _polygon_scale(sides) / np.cos(np.pi / sides)
    half = outer * np.array([np.cos(np.pi / sides), np.sin(np.pi / sides)])
    turns = [_turn_z(k * np.pi / blades) for k in range(blades)]
    return [box(around.pos, mat @ turn, np.array([*half, around.size[2]])) for turn in turns]


def _polygon_scale(sides: int) -> float:
    """Apothem of the regular polygon whose outline lies at distance 1 from its centre, averaged over all directions."""
    angle = np.pi / sides
    return angle / np.log(np.tan(angle / 2 + np.pi / 4))


def _turn_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


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
        foot=np.sqrt(_polygon_area(_convex_hull(standing[:, :2]))) / 2,
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
        FitError: the solids have no ring of walls, or no handle where one is asked for.
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
    scale = _polygon_scale(walls)
    (r, z), half = (low + high) / 2, np.linalg.norm(high - low) / 2
    side = r * scale * np.tan(np.pi / walls)
    parts = []
    for k in range(walls):
        turn = _turn_z(2 * np.pi * k / walls)
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


# -- capsules ----------------------------------------------------------------------------------------------------------


def long_capsule(solids: Sequence[Solid]) -> Solid:
    """A capsule along the longest side of the solids' box, as long as it, with the mean of its other half sides."""
    around = bound(solids)
    short, middle, long = np.argsort(around.size)
    radius = float(around.size[[short, middle]].mean())
    axis = around.mat[:, long] * max(around.size[long] - radius, 0.0)
    return capsule(around.pos - axis, around.pos + axis, radius)


# The end of a solid is this share of its length; it is an edge, not a tip, when it is that much longer than wide.
_END = 0.25
_EDGE = 1.5


def end_capsule(solids: Sequence[Solid], end: np.ndarray, inner: np.ndarray | None = None) -> Solid:
    """A capsule that fits one end of the solids: as thick as the end is, flush with it, and not beyond its sides.

    Where the end is an edge (a palm) the capsule lies along it; where it is a tip (a finger) it runs to the other end.

    Args:
        solids: what it stands for.
        end: direction in which the end lies, along an axis of the body, [3].
        inner: likewise a side with which a finger is flush all along; None for its middle.
    """
    points = np.concatenate([solid.extreme_points() for solid in solids])
    height = points @ end
    span = height.max() - height.min()
    tip, other = points[height > height.max() - _END * span], points[height < height.min() + _END * span]
    low, high = tip.min(axis=0), tip.max(axis=0)
    lateral = np.flatnonzero(end == 0.0)
    wide, narrow = sorted(lateral, key=lambda axis: low[axis] - high[axis])
    radius = float(high[narrow] - low[narrow]) / 2
    middle = (low + high) / 2 * (end == 0.0) + end * (height.max() - radius)
    if high[wide] - low[wide] > _EDGE * (high[narrow] - low[narrow]):
        along = np.eye(3)[wide] * ((high[wide] - low[wide]) / 2 - radius)
        return capsule(middle - along, middle + along, radius)
    start = (other.min(axis=0) + other.max(axis=0)) / 2 * (end == 0.0) + end * (height.min() + radius)
    if inner is not None:
        start += inner * ((other @ inner).max() - radius - start @ inner)
        middle = middle + inner * ((tip @ inner).max() - radius - middle @ inner)
    return capsule(start, middle, radius)


# -- how far apart two shapes are --------------------------------------------------------------------------------------


def gaps(solids: Sequence[Solid], others: Sequence[Solid], spacing: float = 0.002) -> np.ndarray:
    """How far points spread evenly over the outer surface of solids are from the surface of others, metres, [n]."""
    return np.abs(union_distance(others, surface_points(solids, spacing)))
