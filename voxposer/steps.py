"""Requests of a batch become paths over voxels, in one call of the planner for all that have the same shape.

In: what the programs of several slots asked for (``voxposer.interface``). Out: a path a request. In between stands what
upstream's ``execute`` does before it plans: the scene counts as an obstacle except near the start and the targets, what
the hand holds does not, and a map that was not given has no say.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vecenv.manipulation.routes import RouteConfig, works
from voxposer.interface import Interface, InterfaceError, Request
from voxposer.perception import Perception
from voxposer.planning import maps
from voxposer.planning.planner import Fault, PlannerConfig, optimize_paths

# Paths planned at once: few shapes to compile for, and a bound on memory (a float64 volume of a path is 8 MB).
CHUNK = 8


def plan_paths(
    wants: Sequence[tuple[Interface, Request]], config: PlannerConfig, route: RouteConfig
) -> list[np.ndarray | InterfaceError]:
    """A path [P, 3] in voxels for each request: empty for one that asks for none, an error for one that has none."""
    paths: list[np.ndarray | InterfaceError] = [np.zeros((0, 3)) for _ in wants]
    asking = [i for i, (_, request) in enumerate(wants) if request.targets is not None]
    for first in range(0, len(asking), CHUNK):
        chunk = asking[first : first + CHUNK]
        for i, path in zip(chunk, _planned([wants[i] for i in chunk], config, route), strict=True):
            paths[i] = path
    return paths


def _planned(
    wants: Sequence[tuple[Interface, Request]], config: PlannerConfig, route: RouteConfig
) -> list[np.ndarray | InterfaceError]:
    padded = [*wants, *[wants[-1]] * ((1 if len(wants) == 1 else CHUNK) - len(wants))]
    starts = np.stack([start_of(interface, request) for interface, request in padded])
    obstacles = [obstacle_map(interface.perception, request, route) for interface, request in wants]
    obstacles += [obstacles[-1]] * (len(padded) - len(wants))
    found = optimize_paths(
        starts,
        np.stack([np.asarray(request.targets) for _, request in padded]),
        np.stack(obstacles),
        np.array([request.object_centric for _, request in padded]),
        config,
    )
    lengths, path, fault = (np.asarray(x) for x in (found.path_length, found.path, found.fault))
    return [
        path[i, : lengths[i]].astype(float)
        if lengths[i]
        else InterfaceError(f"no path to the targets: {Fault(int(fault[i])).name.lower().replace('_', ' ')}")
        for i in range(len(wants))
    ]


def start_of(interface: Interface, request: Request) -> np.ndarray:
    """Voxel to plan from: of the thing to be pushed, or of the hand at the end of what was planned before."""
    return request.start if request.object_centric else interface.perception.grid.voxel(interface.perception.ee.pos)


def touches(perception: Perception, request: Request, config: RouteConfig) -> bool:
    """Whether a motion is to push or pull, as `works` says: then only the program's own map is in its way."""
    if request.targets is None or request.object_centric:
        return False
    here = perception.grid.voxel(perception.ee.pos)
    ends = np.argwhere(request.targets)
    goal = perception.position_of(ends[int(np.linalg.norm(ends - here, axis=1).argmin())])
    hold = {"held": perception.held, "attached": perception.attached}
    closed = perception.closed and request.closed_at(here)
    return works(perception.ee.pos, goal, closed=closed, config=config, **hold)


def obstacle_map(perception: Perception, request: Request, route: RouteConfig) -> np.ndarray:
    """What the planner keeps away from, float64 [N, N, N] in 0..1."""
    if touches(perception, request, route):
        return np.zeros((perception.grid.size,) * 3) if request.avoidance is None else request.avoidance.astype(float)
    size = perception.grid.size
    avoidance = np.zeros((size,) * 3) if request.avoidance is None else request.avoidance.astype(float)
    occupied = scene_occupancy(perception, request.movable if request.object_centric else perception.held)
    near: dict[str, np.ndarray] = (
        {"movable": request.occupancy}
        if request.occupancy is not None
        else {"start": perception.grid.voxel(perception.ee.pos)}
    )
    return np.asarray(maps.preprocess_avoidance(avoidance, occupied, request.targets, **near))


def scene_occupancy(perception: Perception, moving: str) -> np.ndarray:
    """Voxels that something other than the robot and ``moving`` occupies, bool [N, N, N]."""
    parts = [part.cloud.points for part in perception.snapshot.parts.values() if part.parent != moving]
    points = np.concatenate([perception.world.others(moving), *parts])
    grid = perception.grid
    inside = ((points >= grid.lo) & (points <= grid.hi)).all(axis=1)
    return grid.occupancy(points[inside])
