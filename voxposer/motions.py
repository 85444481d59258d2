"""Motions that programs asked for become stops of the hand; objects that are to be moved without a grasp, pushes.

In: slots whose programs have run (``voxposer.slots``), each with what it sees. Out: the stops of each slot's motions,
and the slots in the phases that follow. The paths of all slots are planned in one call (``voxposer.paths``), and so are
their pushes (``voxposer.pushing``). A slot for which nothing can be planned is stopped with its cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from vecenv.manipulation.routes import Stop
from vecenv.manipulation.world import matrix
from voxposer import pushing
from voxposer.failures import stop_with
from voxposer.paths import PlannedOn, each_alone, plan_paths
from voxposer.planned import PlannedMotion
from voxposer.pushing import PushSituation
from voxposer.quaternions import quaternion
from voxposer.requests import InterfaceError, MotionRequest
from voxposer.runtime_config import RuntimeConfig
from voxposer.slots import Grasp, Moving, Pushing, Slot, pending
from voxposer.stops import stops_of, travel


class MotionPlanner:
    """Plans the motions and the next pushes of a batch of slots.

    Args:
        config: options.
        on_planned: called with every motion as it is planned, its ``slot`` being the row of the call.
    """

    def __init__(self, config: RuntimeConfig, on_planned: Callable[[PlannedMotion], None] | None = None) -> None:
        self._config, self._on_planned = config, on_planned

    def plan(self, slots: Sequence[Slot]) -> list[list[list[Stop]]]:
        """The motions of every slot that its programs asked for, each a list of stops."""
        motions: list[list[list[Stop]]] = [[] for _ in slots]
        for slot in slots:
            try:
                _return_hand(slot)
            except Exception as error:
                stop_with(slot, error)
        waiting = [i for i, slot in enumerate(slots) if isinstance(slot.phase, Moving)]
        while waiting:
            wants = [(slots[i].interface, slots[i].requests[0]) for i in waiting]
            kept: dict[int, PlannedOn] = {}
            then = [slots[i].requests[1] if len(slots[i].requests) > 1 else None for i in waiting]
            maps_of = kept if self._on_planned else None
            paths = plan_paths(wants, self._config.planner, self._config.route, maps_of, then)
            for row, (i, path) in enumerate(zip(waiting, paths, strict=True)):
                stops = self._plan_motion(i, slots[i], path, kept.get(row))
                motions[i] += [stops] if stops else []
            waiting = [i for i in waiting if isinstance(phase := slots[i].phase, Moving) and not phase.iterations]
        self._plan_pushes([slot for slot in slots if isinstance(slot.phase, Pushing)], slots, motions)
        return motions

    def _plan_motion(
        self, row: int, slot: Slot, path: np.ndarray | InterfaceError, maps: PlannedOn | None
    ) -> list[Stop]:
        """Stops of a slot's next motion; the hand is then taken to be at its end."""
        perception, request, grip = slot.interface.perception, slot.requests[0], slot.grip.closed
        slot.latest = replace(slot.latest, movable=request.movable, object_centric=request.object_centric)
        start = np.concatenate([perception.ee.pos, quaternion(perception.ee.rotation)])
        try:
            stops = self._begun(slot, path)
        except Exception as error:
            stop_with(slot, error)
            return []
        if self._on_planned:
            number, text = slot.progress.number, slot.progress.text
            obstacles, value = maps or (None, None)
            shown = (np.asarray(path), tuple(stops), obstacles, start, grip, slot.latest.calls, value)
            self._on_planned(PlannedMotion(row, number, text, request, perception, *shown))
        if stops:
            perception.move_hand(stops[-1].pos, matrix(stops[-1].quat), closed=slot.grip.closed)
        return stops

    def _begun(self, slot: Slot, path: np.ndarray | InterfaceError) -> list[Stop]:
        """Stops of a slot's next motion, which it enters; none where an object is to be pushed."""
        assert isinstance(slot.phase, Moving)
        perception, request, rest = slot.interface.perception, slot.requests[0], slot.requests[1:]
        if isinstance(path, InterfaceError):
            raise path
        if request.object_centric:
            slot.enter(Pushing(pushing.task_of(request.movable, perception.grid.world(path), perception), rest))
            return []
        stops = stops_of(request, path, perception, self._config.route, closed=slot.grip.closed)
        stops = _finite(stops[: self._config.num_waypoints_per_plan])
        if request.kind == "path":
            _remember_grasp(slot, request, path[-1])
        again = request.kind == "path" and self._config.max_plan_iter > 1
        slot.enter(replace(slot.phase, iterations=slot.phase.iterations + 1) if again else pending(rest))
        slot.close_grip(stops[-1].closed)
        return stops

    def _plan_pushes(
        self, pushing_slots: Sequence[Slot], slots: Sequence[Slot], motions: list[list[list[Stop]]]
    ) -> None:
        """The next push of every slot that pushes, searched for all in one call."""
        found = [(slot, situation) for slot in pushing_slots if (situation := self._situation(slot))]
        pushes = each_alone(lambda chosen: pushing.next_pushes(chosen, self._config.push), [each for _, each in found])
        for (slot, _), stops in zip(found, pushes, strict=True):
            try:
                if isinstance(stops, Exception):
                    raise stops
                perception = slot.interface.perception
                here = Stop(perception.ee.pos, quaternion(perception.ee.rotation), True)
                way = _finite([*travel([here, stops[0]], perception, self._config.route), *stops[1:]])
            except Exception as error:
                stop_with(slot, error)
                continue
            motions[slots.index(slot)].append(way)
            slot.close_grip(way[-1].closed)

    def _situation(self, slot: Slot) -> PushSituation | None:
        """What is known before the next push; None, and the slot stopped, where there is no room for one."""
        assert isinstance(slot.phase, Pushing)
        try:
            return pushing.situation(slot.phase.task, slot.interface.perception, self._config.push)
        except Exception as error:
            stop_with(slot, error)
            return None


def _return_hand(slot: Slot) -> None:
    """Let planning start at the present pose of the hand, not at the end of what programs asked for."""
    if slot.requests:
        ee = slot.interface.perception.snapshot.ee_pose
        slot.interface.perception.move_hand(ee[:3], matrix(ee[3:]), closed=slot.grip.closed)


def _finite(stops: list[Stop]) -> list[Stop]:
    """Stops, if the hand can be sent to them."""
    if not all(np.isfinite([*stop.pos, *stop.quat, stop.velocity]).all() for stop in stops):
        raise InterfaceError("the motion has a pose or a velocity that is not finite")
    return stops


def _remember_grasp(slot: Slot, request: MotionRequest, end: np.ndarray) -> None:
    """Keep what a path that ends at a voxel [3] closes the hand around, so that the next look can check it."""
    perception = slot.interface.perception
    voxel = np.clip(np.round(end), 0, perception.grid.size - 1).astype(int)
    name = perception.targets.get((int(voxel[0]), int(voxel[1]), int(voxel[2])))
    if name and request.closed_at_end(voxel) and name in perception.snapshot.poses:
        offset = perception.position_of(voxel) - perception.snapshot.poses[name][:3]
        slot.grip = replace(slot.grip, grasp=Grasp(name, offset))
