"""What a task asks for, in which order, and where that puts things.

Goals come from a snapshot (``("on", "bowl_1", "plate_1")``); out come the next predicate to work on, whether one holds
already (judged by positions, so contact is taken for granted), and the :class:`Target` of a placement.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vecenv.manipulation.placing import Target
from vecenv.manipulation.world import SceneGeometry
from vecenv.observations import ObjectsSnapshot, RegionBox

Predicate = tuple[str, ...]

PLACING = ("in", "on")
ON_TOP_RADIUS = 0.03


def in_order(goal: Sequence[Predicate]) -> list[Predicate]:
    """The order to work in: what gets filled is opened before and closed after, other things are closed first."""
    filled = {p[2] for p in goal if p[0] in PLACING and len(p) == 3}
    stages = {"open": 1, "turnon": 2, "turnoff": 2, "in": 3, "on": 3}

    def key(predicate: Predicate) -> tuple[int, int]:
        close = 4 if any(name.startswith(predicate[1]) for name in filled) else 0
        return stages.get(predicate[0], close), _depth(predicate, goal)

    return sorted(goal, key=key)


def _depth(predicate: Predicate, goal: Sequence[Predicate]) -> int:
    """How many placements of the goal carry what this one places."""
    carriers = [p for p in goal if p[0] in PLACING and len(predicate) == 3 and p[1] == predicate[2]]
    return 1 + _depth(carriers[0], [p for p in goal if p != predicate]) if carriers else 0


def holds(predicate: Predicate, snapshot: ObjectsSnapshot) -> bool:
    """Whether a placement holds as far as positions tell; False for predicates about joints."""
    if predicate[0] not in PLACING or len(predicate) != 3:
        return False
    pos = snapshot.poses[predicate[1]][:3]
    region = snapshot.regions.get(predicate[2])
    if region is None:
        support = snapshot.poses[predicate[2]][:3]
        return bool(np.linalg.norm((pos - support)[:2]) < ON_TOP_RADIUS and 0 <= pos[2] - support[2] < 0.15)
    offset, half = pos - region.pos, extent(region)
    if predicate[0] == "in":
        return bool((np.abs(offset) < half + [0, 0, 0.01]).all() and offset[2] < half[2])
    inside = (np.abs(region.mat @ offset)[:2] < region.half_extents[:2]).all()
    return bool(inside and -0.005 < offset[2] - half[2] < 0.10)


def extent(region: RegionBox) -> np.ndarray:
    """Half extents of a region along the world's axes, as the goals see them (upstream rotates them as a vector)."""
    return np.abs(region.mat @ region.half_extents)


def shut(predicate: Predicate, world: SceneGeometry) -> bool:
    """Whether a placement goes into a drawer that must be opened first."""
    region = world.snapshot.regions.get(predicate[-1]) if predicate[0] == "in" else None
    return region is not None and region.axis is not None and _roofed(world, predicate[1], region, extent(region))


def target_of(predicate: Predicate, world: SceneGeometry) -> Target | str:
    """Where the origin of the object goes, or why that is beyond this policy."""
    snapshot, name = world.snapshot, predicate[1]
    if name not in snapshot.movable:
        return f"{name} cannot be moved"
    region = snapshot.regions.get(predicate[2])
    if region is None:
        return _on_object(world, predicate[2])
    if predicate[0] == "in":
        return _in_region(world, predicate, region)
    return _on_region(world, predicate, region)


def _on_object(world: SceneGeometry, support: str) -> Target:
    xy = world.snapshot.poses[support][:2]
    return Target(xy[None], np.zeros(1), floor=world.ground(xy))


def _in_region(world: SceneGeometry, predicate: Predicate, region: RegionBox) -> Target | str:
    half = extent(region)
    if _roofed(world, predicate[1], region, half):
        return "the place is under a roof, and this policy comes from above"
    xy, cost = _grid(region.pos[:2], np.maximum(half[:2] - 0.025, 0.0), _share(world, predicate))
    floor = max(region.pos[2] - half[2], world.ground(region.pos[:2]))
    return Target(xy, cost, floor=floor, centre=region.pos[:2], half=half[:2])


def _on_region(world: SceneGeometry, predicate: Predicate, region: RegionBox) -> Target:
    half = extent(region)
    xy, cost = _grid(region.pos[:2], np.maximum(half[:2] - 0.03, 0.0), _share(world, predicate))
    floor = region.pos[2] + half[2] if region.parent else world.ground(region.pos[:2])
    return Target(xy, cost, floor=floor)


def _roofed(world: SceneGeometry, name: str, region: RegionBox, half: np.ndarray) -> bool:
    """Whether something spreads over a region."""
    points = world.others(name)
    offset = points[:, :2] - region.pos[:2]
    inner = (np.abs(offset) < 0.7 * half[:2]).all(axis=1)
    if region.axis is not None:
        inner &= np.abs(offset @ region.axis[:2]) < 0.25 * float(np.abs(region.axis[:2]) @ half[:2])
    return bool((points[inner, 2] > region.pos[2] + half[2]).sum() > 1)


def _share(world: SceneGeometry, predicate: Predicate) -> np.ndarray:
    """Where a thing should stand off the centre of a place that it shares with others of the goal, metres, [2]."""
    sharing = [p for p in world.snapshot.goal if p[0] in PLACING and p[2:] == predicate[2:]]
    points = world.points(predicate[1])[:, :2]
    size = np.ptp(points, axis=0)
    side = (np.arange(2) == size.argmin()).astype(float)
    return side * size.min() * 0.6 * (sharing.index(predicate) - (len(sharing) - 1) / 2)


def _grid(centre: np.ndarray, reach: np.ndarray, wish: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places around a centre and their cost: the distance from the wished-for one in units of 2 cm."""
    ticks = np.linspace(-1, 1, 5)
    offsets = np.stack(np.meshgrid(ticks * reach[0], ticks * reach[1]), axis=-1).reshape(-1, 2)
    wish = np.clip(wish, -reach, reach)
    offsets = np.concatenate([wish[None], offsets])
    distance = np.linalg.norm(offsets - wish, axis=1)
    order = np.argsort(distance, kind="stable")
    return centre + offsets[order], distance[order] / 0.02
