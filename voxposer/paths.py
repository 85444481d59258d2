"""Requests of a batch become paths over voxels, in one call of the planner for all that have the same shape.

In: the motions that programs of several slots asked for (``voxposer.requests``). Out: a path for each. As in upstream's
``execute``, the scene is an obstacle except near the start and the targets, the held object is none, and a map that was
not given has no effect.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np

from vecenv.manipulation.routes import RouteConfig, Stop, is_contact_move
from voxposer.interface import Interface
from voxposer.mapped import MappedPath, plan_mapped
from voxposer.perception.view import Perception
from voxposer.planning import maps
from voxposer.planning.config import Fault, PlannerConfig
from voxposer.planning.planner import optimize_paths
from voxposer.requests import InterfaceError, MotionRequest

T = TypeVar("T")
_log = logging.getLogger(__name__)
# Paths planned at once: few shapes to compile for, and a bound on memory (a float64 volume of a path is 8 MB).
CHUNK = 8


class PlannedOn(NamedTuple):
    """The maps that a path was planned on, [N, N, N] each.

    Attributes:
        obstacles: what is kept away from, 0 to 1.
        value: the affordance map of ``route.mode="map"``, cost to go; None for upstream's, which follows from the
            targets and the obstacles.
    """

    obstacles: np.ndarray
    value: np.ndarray | None = None


def plan_paths(
    wants: Sequence[tuple[Interface, MotionRequest]],
    config: PlannerConfig,
    route: RouteConfig,
    maps_of: dict[int, PlannedOn] | None = None,
    then: Sequence[MotionRequest | None] = (),
) -> list[np.ndarray | InterfaceError]:
    """A path [P, 3] in voxels for each request: empty for one without targets, an error where there is no path.

    The maps that paths were planned on are put into ``maps_of``, if given, by index of request. ``then`` are the
    motions that were asked for after these, if any.
    """
    kept: dict[int, PlannedOn] = {} if maps_of is None else maps_of
    paths: list[np.ndarray | InterfaceError] = [np.zeros((0, 3)) for _ in wants]
    jointed = [i for i, (interface, request) in enumerate(wants) if hangs_on_joint(interface.perception, request)]
    for i in jointed:
        paths[i] = np.stack([wants[i][1].start, nearest_target(wants[i][1])]).astype(float)
    asking = [i for i, (_, request) in enumerate(wants) if request.targets is not None and i not in jointed]
    if route.mode == "map" and config.method == "greedy":
        for i in list(asking):
            try:
                if not travels(*wants[i], route):
                    continue
                found = _mapped(*wants[i], then[i] if then else None, config, route)
                paths[i], kept[i] = found.path, PlannedOn(found.avoidance, found.value)
            except Exception as error:
                paths[i] = _as_interface_error(error)
            asking.remove(i)
    for first in range(0, len(asking), CHUNK):
        chunk = asking[first : first + CHUNK]
        obstacles, refused = _obstacle_maps([wants[i] for i in chunk], route)
        planned = each_alone(partial(_planned, config=config), [wants[i] for i in chunk], obstacles)
        for number, (i, path) in enumerate(zip(chunk, planned, strict=True)):
            paths[i] = refused.get(number) or (_as_interface_error(path) if isinstance(path, Exception) else path)
        if maps_of is not None:
            kept |= {i: PlannedOn(each) for i, each in zip(chunk, obstacles, strict=True)}
    return paths


def each_alone(plan: Callable[..., Sequence[T]], *rows: Sequence[Any]) -> list[T | Exception]:
    """What a function makes of rows that belong to different slots: in one call, or, if that fails, row by row.

    A slot that nothing can be planned for is then the only one that has no result.

    Args:
        plan: takes a list of each kind of row, and gives a result for each row.
        rows: of each kind, one a slot.
    """
    if not rows[0]:
        return []
    try:
        return list(plan(*rows))
    except Exception as error:
        if len(rows[0]) == 1:
            return [error]
        return [found for row in zip(*rows, strict=True) for found in each_alone(plan, *([each] for each in row))]


def _as_interface_error(error: Exception) -> InterfaceError:
    if isinstance(error, InterfaceError):
        return error
    _log.error("planning failed", exc_info=error)
    return InterfaceError(f"planning failed: {type(error).__name__}: {error}")


def _planned(
    wants: Sequence[tuple[Interface, MotionRequest]], obstacles: Sequence[np.ndarray], *, config: PlannerConfig
) -> list[np.ndarray | InterfaceError]:
    if config.method == "straight":
        return [straight_path(start_of(*want), want[1], config) for want in wants]
    padded = [*wants, *[wants[-1]] * ((1 if len(wants) == 1 else CHUNK) - len(wants))]
    starts = np.stack([start_of(interface, request) for interface, request in padded])
    obstacles = [*obstacles, *[obstacles[-1]] * (len(padded) - len(wants))]
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


def _obstacle_maps(
    wants: Sequence[tuple[Interface, MotionRequest]], route: RouteConfig
) -> tuple[list[np.ndarray], dict[int, InterfaceError]]:
    """The obstacle map of each request, and the errors of those that have none, by their number."""
    made: list[np.ndarray] = []
    refused: dict[int, InterfaceError] = {}
    for i, (interface, request) in enumerate(wants):
        try:
            made.append(obstacle_map(interface.perception, request, route))
        except Exception as error:
            refused[i] = _as_interface_error(error)
            made.append(np.zeros((interface.perception.grid.size,) * 3))
    return made, refused


def hangs_on_joint(perception: Perception, request: MotionRequest) -> bool:
    """Whether a part is to be pushed: where it can go is up to its joint, so its path is not searched for."""
    return request.object_centric and request.targets is not None and request.movable in perception.snapshot.parts


def nearest_target(request: MotionRequest) -> np.ndarray:
    """The target voxel that is nearest to the start of a motion, [3]."""
    found = np.argwhere(np.asarray(request.targets))
    return found[int(np.linalg.norm(found - request.start, axis=1).argmin())]


def travels(interface: Interface, request: MotionRequest, route: RouteConfig) -> bool:
    """Whether a request moves the hand through the scene, neither pushing nor pulling."""
    return not request.object_centric and not is_contact_motion(interface.perception, request, route)


def _mapped(
    interface: Interface,
    request: MotionRequest,
    then: MotionRequest | None,
    config: PlannerConfig,
    route: RouteConfig,
) -> MappedPath:
    """The path of a request over configuration-space maps; where it turns is kept in the view.

    Raises:
        OutOfReach: the arm cannot take the goal.
    """
    perception = interface.perception
    here = perception.grid.voxel(perception.ee.pos)
    ends = np.argwhere(np.asarray(request.targets))
    end = ends[int(np.linalg.norm(ends - here, axis=1).argmin())]
    goal = Stop(perception.position_of(end), request.rotation_at(end), request.closed_at_end(end))
    closed = perception.closed and request.closed_at(here)
    options = {"avoidance": request.avoidance, "planner": config, "route": route}
    # Where the hand is to grasp or let go, it is meant to be in among things, whoever chose the place.
    last = then.closed_at_end(end) if then is not None and then.kind == "stay" else goal.closed
    exact = tuple(int(index) for index in end) in perception.exact or last != perception.closed
    # So is a hand that moves by a little only: giving way to obstacles would take it farther than it was to go.
    exact = exact or bool(np.linalg.norm(goal.pos - perception.ee.pos) < route.little)
    found = plan_mapped(perception, goal, closed=closed, exact=exact, **options)
    perception.turns[request] = found.turn
    return found


def straight_path(start: np.ndarray, request: MotionRequest, config: PlannerConfig) -> np.ndarray:
    """A straight line over voxels [P, 3] to the nearest target; an object that is pushed keeps its height."""
    targets = np.argwhere(np.asarray(request.targets))
    end = targets[int(np.linalg.norm(targets - start, axis=1).argmin())].astype(float)
    end[2] = start[2] if request.object_centric else end[2]
    count = max(int(np.linalg.norm(end - start)), 1)
    path = start + np.linspace(0, 1, count + 1)[:, None] * (end - start)
    return np.concatenate([path[:: config.pushing_skip_per_k], path[-1:]])[1:] if request.object_centric else path


def start_of(interface: Interface, request: MotionRequest) -> np.ndarray:
    """Voxel to plan from: of the object to be pushed, or of the hand at the end of what was planned before."""
    return request.start if request.object_centric else interface.perception.grid.voxel(interface.perception.ee.pos)


def is_contact_motion(perception: Perception, request: MotionRequest, config: RouteConfig) -> bool:
    """Whether the hand is meant to push or pull: then only the program's own avoidance map is an obstacle."""
    if request.targets is None or request.object_centric:
        return False
    here = perception.grid.voxel(perception.ee.pos)
    ends = np.argwhere(request.targets)
    goal = perception.position_of(ends[int(np.linalg.norm(ends - here, axis=1).argmin())])
    hold = {"held": perception.held, "attached": perception.attached}
    closed = perception.closed and request.closed_at(here)
    return is_contact_move(perception.ee.pos, goal, closed=closed, config=config, **hold)


def obstacle_map(perception: Perception, request: MotionRequest, route: RouteConfig) -> np.ndarray:
    """The obstacle map of the planner, float64 [N, N, N] in 0..1."""
    if is_contact_motion(perception, request, route):
        return np.zeros((perception.grid.size,) * 3) if request.avoidance is None else request.avoidance.astype(float)
    size = perception.grid.size
    avoidance = np.zeros((size,) * 3) if request.avoidance is None else request.avoidance.astype(float)
    occupied = scene_occupancy(perception, request.movable if request.object_centric else perception.held)
    near: dict[str, np.ndarray] = (
        {"movable": request.occupancy}
        if request.occupancy is not None
        else {"start": perception.grid.voxel(perception.ee.pos)}
    )
    return np.asarray(maps.preprocess_avoidance(avoidance, occupied, np.asarray(request.targets), **near))


def scene_occupancy(perception: Perception, moving: str) -> np.ndarray:
    """Voxels occupied by anything but the robot and ``moving``, bool [N, N, N]."""
    parts = [part.cloud.points for part in perception.snapshot.parts.values() if part.parent != moving]
    points = np.concatenate([perception.scene.others(moving), *parts])
    grid = perception.grid
    inside = ((points >= grid.lo) & (points <= grid.hi)).all(axis=1)
    return grid.occupancy(points[inside])
