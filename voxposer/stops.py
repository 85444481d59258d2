"""Planned paths become stops of the hand: rotation, grip and speed are read from the maps along the way.

In: a :class:`~voxposer.requests.MotionRequest`, its path over voxels and the view it was planned on. Out: the stops
that ``voxposer.planning.plan`` turns into waypoints.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np

from vecenv.manipulation.routes import RouteConfig, Stop, planned_route, travel_route, work_route
from vecenv.manipulation.world import matrix
from voxposer.mapped import OutOfReach, plan_mapped
from voxposer.paths import is_contact_motion
from voxposer.perception.view import Perception
from voxposer.planning.config import PlannerConfig
from voxposer.quaternions import quaternion
from voxposer.requests import MotionRequest

# The end of a path begins this many voxels before its last: a grip that changes within it changes at the end.
_END = 3.0


def stops_of(
    request: MotionRequest, path: np.ndarray, perception: Perception, route: RouteConfig, *, closed: bool
) -> list[Stop]:
    """The stops of a motion of the hand.

    Args:
        request: the motion.
        path: over voxels, [P, 3]; empty unless the request is a path.
        perception: the view, with the hand where the motion starts.
        route: distances that the hand keeps from the scene.
        closed: the grip before the motion.

    Raises:
        InterfaceError: a map of the request cannot be used on the way.
    """
    ee = perception.ee
    here = Stop(ee.pos, quaternion(ee.rotation), closed)
    if request.kind == "stay":
        voxel = perception.grid.voxel(ee.pos)
        quat, grip = request.rotation_at(voxel), request.closed_at_end(voxel)
        return [Stop(ee.pos, quat, grip, request.velocity_at(voxel), final=True)]
    if request.kind == "home":
        home = perception.hand.home
        return travel([here, Stop(home[:3], home[3:], closed, final=True)], perception, route)
    touching = is_contact_motion(perception, request, route)
    stops = along(request, path, perception)
    stops[0] = Stop(here.pos, here.quat, stops[0].closed, stops[0].velocity)
    if route.mode == "map" and not touching:
        turn = perception.turns.get(request, 0)
        return planned_route([replace(s, quat=here.quat) if i < turn else s for i, s in enumerate(stops)], route)
    return work_route(stops, route) if touching else travel(stops, perception, route)


def travel(stops: list[Stop], perception: Perception, route: RouteConfig) -> list[Stop]:
    """The stops of a hand that travels: raised over the scene, or, as ``route.mode`` says, those of its path."""
    if route.mode == "planned":
        return planned_route(stops, route)
    if route.mode == "map":
        # No program asked for such a motion, so none is told: the arm goes over the scene as near as it can.
        with contextlib.suppress(OutOfReach):
            return _mapped(stops[0], stops[-1], perception, route)
    axes = matrix(stops[0].quat)[:, 2], matrix(stops[-1].quat)[:, 2]
    held = perception.held if stops[0].closed else ""
    return travel_route(stops, axes, perception.scene, held, route)


def _mapped(here: Stop, goal: Stop, perception: Perception, route: RouteConfig) -> list[Stop]:
    """The way of a hand to a pose that no program asked for, over configuration-space maps."""
    found = plan_mapped(perception, goal, closed=here.closed, avoidance=None, planner=PlannerConfig(), route=route)
    way = perception.grid.world(found.path[:-1])
    stops = [replace(here, pos=at, quat=here.quat if i < found.turn else goal.quat) for i, at in enumerate(way)]
    return planned_route([*stops, goal], route)


def along(request: MotionRequest, path: np.ndarray, perception: Perception) -> list[Stop]:
    """The stops of a path over voxels [P, 3], each with the rotation, velocity and grip of its maps.

    A grip that changes within 3 voxels of the end changes at the end: a hand that closes around something must be there
    first.
    """
    size = perception.grid.size
    voxels = np.clip(np.round(path), 0, size - 1).astype(int)
    closed = [request.closed_at(voxel) for voxel in voxels]
    closed[-1] = request.closed_at_end(voxels[-1])
    far = np.flatnonzero(np.linalg.norm(voxels - voxels[-1], axis=1) > _END)
    before = closed[int(far[-1])] if len(far) else closed[0]
    for i in range(int(far[-1]) + 1 if len(far) else 1, len(voxels) - 1):
        closed[i] = before
    stops = [
        Stop(perception.grid.world(at), request.rotation_at(voxel), grip, request.velocity_at(voxel))
        for at, voxel, grip in zip(path, voxels, closed, strict=True)
    ]
    end = stops[-1]
    stops[-1] = Stop(perception.position_of(voxels[-1]), end.quat, end.closed, end.velocity, final=True)
    return stops
