"""SIMPLER's scenes on SAPIEN's CPU physics: one PhysX scene a slot, many in a process, none closed between episodes.

In: a ``SceneSpec``, where an episode starts (``Start``), and drive set-points for every substep of a control tick. Out:
a row of ``facts_dtype``, what was measured after the tick: joints, poses, contacts. ``Scene`` is one slot;
``vecenv.simpler.workers`` spreads slots over processes. Units are those of ``spec.py``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import sapien
from sapien import physx

from vecenv.simpler.physics.building import build, pose_of, vector
from vecenv.simpler.physics.spec import MAX_FINGERS, ObjectBody, SceneSpec, Start

# Upstream's settling: fall with roll and pitch locked, then freely, then longer if anything still moves.
_FALL, _REST, _LONGER = 0.5, 0.5, 1.5
_STILL_LINEAR, _STILL_ANGULAR = 1e-3, 1e-2
_AWAY = sapien.Pose([-10.0, 0.0, 0.0])
_UPRIGHT = [False, False, False, True, True, False]
_FREE, _LOCKED = [False] * 6, [True] * 6
_STRAIGHT = [True, True, False, True, True, False]
# Objects that fall later wait this far above their places, times their number.
_WAITING = np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0])
# Which of a drawer's collision shapes is its floor.
_FLOOR_SHAPE = 2
_STOP_MARGIN = 0.004


class Scene:
    """One slot's scene.

    Args:
        spec: its content.
        visuals: load what is drawn too (needs a renderer).
    """

    def __init__(self, spec: SceneSpec, *, visuals: bool = False) -> None:
        self.spec = spec
        built = build(spec, visuals=visuals)
        self.system, self.sapien = built.system, built.sapien
        self.robot, self.cabinet = built.robot, built.cabinet
        self.objects, self._bodies = built.objects, built.bodies
        self._start: Start | None = None
        self._robot_links = set(self.robot.physx.links)
        fingers = [self.robot.frames[finger.link] for finger in spec.robot.fingers]
        self._fingers = {shape: i for i, finger in enumerate(fingers) for shape in finger.shapes}

    # -- an episode's start --------------------------------------------------------------------------------------------

    def begin(self, start: Start) -> np.ndarray:
        """Put everything where an episode starts; returns pose and velocity of the settled objects, [n, 13]."""
        self._start = start
        if self.cabinet is not None:
            self.cabinet.place(np.zeros(self.cabinet.dof, np.float32))
        if start.settled is None:
            self._settle(start)
        settled = self._object_states() if start.settled is None else start.settled
        # Also what has just settled, so that an episode begins the same way every time.
        self._restore_objects(settled)
        self.robot.place(np.asarray(start.qpos, np.float32))
        self.robot.physx.set_root_pose(pose_of(start.base_pose))
        for i, joint in self.robot.joints.items():
            joint.set_drive_target(float(start.qpos[i]))
            joint.set_drive_velocity_target(0.0)
        if self.cabinet is not None and start.drawer >= 0:
            opened = np.zeros(self.cabinet.dof, np.float32)
            opened[start.drawer] = start.opened
            self.cabinet.place(opened)
        return settled

    def _settle(self, start: Start) -> None:
        self.robot.place(np.asarray(start.qpos, np.float32))
        self.robot.physx.set_root_pose(_AWAY)
        for i, (entity, body, pose, thing) in enumerate(self._things(start.objects)):
            waits = i in start.late
            entity.set_pose(pose_of(pose + _WAITING * (i + 1) if waits else pose))
            _stop(body)
            body.set_locked_motion_axes(_LOCKED if thing.anchored or waits else _UPRIGHT)
        bodies = enumerate(zip(self._bodies, self.spec.objects, strict=True))
        loose = [body for i, (body, thing) in bodies if not thing.anchored and i not in start.late]
        if not loose:
            return
        self._pass(_FALL)
        for body in loose:
            _release(body)
        self._pass(_REST)
        if _moving(loose):
            self._pass(_LONGER)
        self._settle_late(start)

    def _settle_late(self, start: Start) -> None:
        late = [self._bodies[i] for i in start.late]
        for i, body in zip(start.late, late, strict=True):
            body.entity.set_pose(pose_of(start.objects[i]))
            _stop(body)
            body.set_locked_motion_axes(_STRAIGHT)
            self._pass(_FALL)
        for body in late:
            _release(body)
            self._pass(_REST)
        if _moving(late):
            self._pass(_LONGER)

    def _things(self, poses: np.ndarray) -> Iterator[tuple[Any, Any, np.ndarray, ObjectBody]]:
        return zip(self.objects, self._bodies, poses, self.spec.objects, strict=True)

    def _pass(self, seconds: float) -> None:
        for _ in range(int(self.spec.sim_hz * seconds)):
            self.system.step()

    def _object_states(self) -> np.ndarray:
        rows = [
            np.concatenate([vector(body.entity.pose), body.linear_velocity, body.angular_velocity])
            for body in self._bodies
        ]
        return np.array(rows).reshape(len(rows), 13)

    def _restore_objects(self, states: np.ndarray) -> None:
        for entity, body, state, thing in self._things(states):
            entity.set_pose(pose_of(state[:7]))
            body.set_locked_motion_axes(_LOCKED if thing.anchored else _FREE)
            body.set_linear_velocity(state[7:10])
            body.set_angular_velocity(state[10:13])

    # -- stepping ------------------------------------------------------------------------------------------------------

    def advance(self, targets: np.ndarray, velocities: np.ndarray | None = None) -> None:
        """One control tick: a physics step for each row of drive set-points.

        Args:
            targets: joint positions [substeps, dof].
            velocities: target joint velocities, of the same shape; None for zero.
        """
        robot, step = self.robot.physx, self.system.step
        moving, stop = self._command(targets, velocities), self._stop_for(targets)
        for substep in range(len(targets)):
            for command, values in moving:
                command(values[substep])
            if stop is not None:
                stop(substep)
            robot.set_qf(robot.compute_passive_force(gravity=False, coriolis_and_centrifugal=True))
            step()

    def _command(self, targets: np.ndarray, velocities: np.ndarray | None) -> list[tuple[Any, list[float]]]:
        """Set the targets that are constant in this tick; returns the others, column by column."""
        moving = []
        columns = [(joint.set_drive_target, targets[:, i]) for i, joint in self.robot.joints.items()]
        if velocities is not None:
            columns += [(joint.set_drive_velocity_target, velocities[:, i]) for i, joint in self.robot.joints.items()]
        for command, values in columns:
            command(float(values[0]))
            if (values != values[0]).any():
                moving.append((command, values.tolist()))
        return moving

    def _stop_for(self, targets: np.ndarray) -> Callable[[int], None] | None:
        """What keeps two fingers from passing through each other in this tick; None when no targets do."""
        if self.spec.robot.stop is None:
            return None
        one, two, total = self.spec.robot.stop
        excess = targets[:, one] + targets[:, two] - total
        if (excess <= 0).all():
            return None
        robot = self.robot.physx
        columns = self.robot.order[[list(self.robot.joints).index(i) for i in (one, two)]]
        fingers = [(self.robot.joints[i], (targets[:, i] - excess / 2).tolist()) for i in (one, two)]
        pressing = [(self.robot.joints[i], targets[:, i].tolist()) for i in (one, two)]
        over = (excess > 0).tolist()

        def stop(substep: int) -> None:
            if not over[substep]:
                return
            met = robot.qpos[columns].sum() > total - _STOP_MARGIN
            for joint, values in fingers if met else pressing:
                joint.set_drive_target(values[substep])
                if met:
                    joint.set_drive_velocity_target(0.0)

        return stop

    # -- measuring -----------------------------------------------------------------------------------------------------

    def measure(self, row: np.void) -> str:
        """Write what is measured now into a row of ``facts_dtype``; returns what is wrong, "" if nothing."""
        count = len(self.objects)
        row["qpos"], row["qvel"] = self.robot.qpos, self.robot.qvel
        row["tcp"] = vector(self.robot.frames[self.spec.robot.tcp].pose)
        row["base"] = vector(self.robot.physx.root_pose)
        states = self._object_states()
        row["objects"][:count], row["velocities"][:count] = states[:, :7], states[:, 7:]
        for i, body in enumerate(self._bodies):
            row["centres"][i] = (body.entity.pose * body.cmass_local_pose).p
        if self.cabinet is not None:
            row["drawers"], row["drawer_speeds"] = self.cabinet.qpos, self.cabinet.qvel
        self._measure_contacts(row)
        healthy = all(np.isfinite(row[name]).all() for name in ("qpos", "qvel", "objects", "velocities", "drawers"))
        return "" if healthy else "physics state is not finite"

    def _measure_contacts(self, row: np.void) -> None:
        start = self._start
        grip, floor = np.zeros((MAX_FINGERS, 3)), np.zeros(3)
        row["support"] = 0.0
        source = self.objects[start.source] if start is not None and start.source >= 0 else None
        bottom = self._drawer_floor()
        for impulse, other, shape in self._contacts_of(source):
            if other in self._robot_links:
                if shape in self._fingers:
                    grip[self._fingers[shape]] -= impulse
                continue
            size = np.linalg.norm(impulse)
            row["support"][0] = max(row["support"][0], size)
            if start is None or start.target < 0 or other.entity != self.objects[start.target]:
                row["support"][1] = max(row["support"][1], size)
            if shape == bottom:
                floor += impulse
        row["floor"] = np.linalg.norm(floor)
        for i, finger in enumerate(self.spec.robot.fingers):
            opening = self.robot.frames[finger.link].pose.to_transformation_matrix()[:3, 1] * finger.opening
            size = np.linalg.norm(grip[i])
            cosine = grip[i] @ opening / size if size > 0 else 0.0
            row["grip"][i] = size, np.arccos(np.clip(cosine, -1.0, 1.0))

    def _drawer_floor(self) -> physx.PhysxCollisionShape | None:
        start, cabinet = self._start, self.spec.cabinet
        if self.cabinet is None or cabinet is None or start is None or start.drawer < 0:
            return None
        return self.cabinet.frames[f"{cabinet.drawers[start.drawer]}_drawer"].shapes[_FLOOR_SHAPE]

    def _contacts_of(self, entity: sapien.Entity | None) -> Iterator[tuple[np.ndarray, Any, Any]]:
        """Impulse on an object, the other body and its shape, for every contact the object has."""
        if entity is None:
            return
        for contact in self.system.get_contacts():
            for mine, sign in ((0, 1.0), (1, -1.0)):
                if contact.bodies[mine].entity == entity:
                    impulse = sign * np.sum([point.impulse for point in contact.points], axis=0)
                    yield impulse, contact.bodies[1 - mine], contact.shapes[1 - mine]

    # -- state ---------------------------------------------------------------------------------------------------------

    def state(self) -> np.ndarray:
        """The physics state: qpos, qvel of the robot, of the cabinet, then pose and velocity of the objects."""
        parts = [self.robot.qpos, self.robot.qvel]
        if self.cabinet is not None:
            parts += [self.cabinet.qpos, self.cabinet.qvel]
        return np.concatenate([*parts, self._object_states().ravel()]).astype(float)

    def restore(self, state: np.ndarray) -> None:
        """Restore a physics state from ``state``."""
        rest = np.asarray(state, float)
        for articulation in (self.robot, self.cabinet):
            if articulation is not None:
                n = articulation.dof
                articulation.place(rest[:n].astype(np.float32), rest[n : 2 * n].astype(np.float32))
                rest = rest[2 * n :]
        self._restore_objects(rest.reshape(-1, 13))

    def show(self, facts: np.void) -> None:
        """Take the poses of a row of facts, at rest."""
        self.robot.place(facts["qpos"].astype(np.float32))
        self.robot.physx.set_root_pose(pose_of(facts["base"]))
        if self.cabinet is not None:
            self.cabinet.place(facts["drawers"].astype(np.float32))
        for entity, pose in zip(self.objects, facts["objects"], strict=False):
            entity.set_pose(pose_of(pose))


def _release(body: physx.PhysxRigidDynamicComponent) -> None:
    body.set_locked_motion_axes(_FREE)
    # PhysX puts resting bodies to sleep; setting the pose wakes them, as upstream does.
    body.entity.set_pose(body.entity.pose)
    _stop(body)
    body.wake_up()


def _moving(bodies: Sequence[physx.PhysxRigidDynamicComponent]) -> bool:
    linear = sum(np.linalg.norm(body.linear_velocity) for body in bodies)
    angular = sum(np.linalg.norm(body.angular_velocity) for body in bodies)
    return bool(linear > _STILL_LINEAR or angular > _STILL_ANGULAR)


def _stop(body: physx.PhysxRigidDynamicComponent) -> None:
    body.set_linear_velocity([0.0, 0.0, 0.0])
    body.set_angular_velocity([0.0, 0.0, 0.0])
