"""SIMPLER's scenes on SAPIEN's CPU physics: one PhysX scene a slot, many in a process, none closed between episodes.

In: what stands in a scene (``SceneSpec``), where an episode starts (``Start``), and drive set-points for every substep
of a control tick. Out: a row of ``facts_dtype``, what was measured after the tick: joints, poses, contacts. Nothing
here knows tasks. ``Scene`` is one slot; ``vecenv.simpler.physics.workers`` spreads slots over processes.

Poses are xyz + wxyz in the world frame, lengths metres, angles radians, impulses newton seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sapien
from sapien import physx

from vecenv.simpler.physics import weld
from vecenv.simpler.physics.hulls import read_parts
from vecenv.simpler.physics.weld import LinkSurface

# Solver iterations of every body, friction of task objects, their damping: upstream's.
POSITION_ITERATIONS, VELOCITY_ITERATIONS = 25, 1
OBJECT_FRICTION, OBJECT_DAMPING = 0.5, 0.1
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
# The Google Robot's fingers weigh almost nothing for their drives. PhysX 5 then leaves a residue when they press on
# something, and the arm drifts: 0.037 rad around a box, where PhysX 4 has 0.002. With this inertia (kg m2) it is 0.002;
# free fingers lag by 0.4 ms.
GOOGLE_FINGER_ARMATURE = 0.003
# Pressed on each other, the same fingers move the arm by 0.07 rad, where PhysX 4 has 0.00003. So they do not collide;
# they stop where PhysX 4 stops them, when their joints add up to this (radians), also when one leads by 0.25 rad; the
# drives are not told to press on within the margin.
GOOGLE_FINGER_STOP = 2.1496
_STOP_MARGIN = 0.004
MAX_FINGERS = 4
ROBOT, CABINET = "robot", "cabinet"
MAX_DRAWERS = 3


@dataclass(frozen=True, kw_only=True)
class Finger:
    """A link that grasps: side 0 left, 1 right; ``opening`` is the sign of its own y axis along which it opens."""

    link: str
    side: int
    opening: float = 1.0


@dataclass(frozen=True, kw_only=True)
class RobotBody:
    """A robot as physics sees it; vectors are in the order of ``joints``.

    Attributes:
        urdf: the file.
        joints: active joints.
        stiffness, damping, force_limit: drives, force mode, [dof].
        surfaces: link and its surface, where it differs from friction 1.
        ignored: link and bit set; links that share a bit never collide.
        tcp: link whose pose is the tool's.
        fingers: links that grasp.
        armature: kg m2 (or kg) added to the joints, [dof]; empty for none. See ``GOOGLE_FINGER_ARMATURE``.
        stop: the two finger joints, and what they may add up to; None for no limit. See ``GOOGLE_FINGER_STOP``.
        frozen: joints that stay where an episode begins, and their angles (radians): physics leaves them out.
    """

    urdf: Path
    joints: tuple[str, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    force_limit: tuple[float, ...]
    surfaces: tuple[tuple[str, LinkSurface], ...] = ()
    ignored: tuple[tuple[str, int], ...] = ()
    tcp: str
    fingers: tuple[Finger, ...]
    armature: tuple[float, ...] = ()
    stop: tuple[int, int, float] | None = None
    frozen: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True, kw_only=True)
class ObjectBody:
    """A thing that lies in the scene.

    Attributes:
        name: its name, unique in the scene.
        collision: mesh file of convex hulls. visual: what is drawn, None for nothing.
        scale: of both. density: kg/m3.
        anchored: it never moves.
    """

    name: str
    collision: Path
    visual: Path | None = None
    scale: float = 1.0
    density: float = 1000.0
    anchored: bool = False


@dataclass(frozen=True, kw_only=True)
class Box:
    """A fixed box: centre and half sizes, metres."""

    centre: tuple[float, float, float]
    half_size: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Stage:
    """The surroundings: a mesh at a pose (``mesh_pose`` turns the mesh, ``offset`` is subtracted), or boxes.

    A mesh that is not ``solid`` is only drawn.
    """

    mesh: Path | None = None
    mesh_pose: tuple[float, ...] = (0.0, 0.0, 0.0, 0.707, 0.707, 0.0, 0.0)
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    boxes: tuple[Box, ...] = ()
    solid: bool = True


@dataclass(frozen=True, kw_only=True)
class Cabinet:
    """A cabinet with drawers: URDF file, drawer names top first, pose, and the drawers' friction and damping."""

    urdf: Path
    drawers: tuple[str, ...]
    pose: tuple[float, ...]
    friction: float = 0.05
    damping: float = 1.0


@dataclass(frozen=True, kw_only=True)
class SceneSpec:
    """Everything in a scene. Slots with equal specs can take over each other's scenes."""

    robot: RobotBody
    sim_hz: int
    contact_offset: float
    objects: tuple[ObjectBody, ...] = ()
    stage: Stage | None = None
    cabinet: Cabinet | None = None


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where an episode begins.

    Attributes:
        base_pose: of the robot's root [7]. qpos: of its joints [dof].
        objects: poses [n, 7], in the order of the spec; those not anchored fall from there and settle.
        settled: None, or pose and velocity [n, 13] that settling has led to before.
        source, target: indices of the objects the task is about; -1 for none.
        late: indices of objects that fall one after the other, straight down, when the others have settled.
        drawer: index of the task's drawer, -1 for none. opened: how far it is open, metres.
    """

    base_pose: np.ndarray
    qpos: np.ndarray
    objects: np.ndarray
    settled: np.ndarray | None = None
    source: int = -1
    target: int = -1
    late: tuple[int, ...] = ()
    drawer: int = -1
    opened: float = 0.0


def facts_dtype(dof: int, objects: int) -> np.dtype:
    """One row of measurements a slot, for ``dof`` joints and at most ``objects`` objects.

    Fields: ``qpos``, ``qvel`` [dof]; ``tcp``, ``base`` [7]; ``objects`` [n, 7], ``velocities`` [n, 6] (linear, then
    angular), ``centres`` [n, 3] (of mass); ``drawers`` [3] and ``drawer_speeds`` [3]; ``grip`` [4, 2]: impulse between
    a finger link and the source, and the angle between it and the link's opening direction (rows as
    ``RobotBody.fingers``); ``support`` [2]: the largest impulse of a contact of the source with anything but the
    robot, and with anything but robot and target; ``floor``: impulse between the source and the floor of the task's
    drawer.
    """
    return np.dtype(
        [
            ("qpos", float, (dof,)),
            ("qvel", float, (dof,)),
            ("tcp", float, (7,)),
            ("base", float, (7,)),
            ("objects", float, (objects, 7)),
            ("velocities", float, (objects, 6)),
            ("centres", float, (objects, 3)),
            ("drawers", float, (MAX_DRAWERS,)),
            ("drawer_speeds", float, (MAX_DRAWERS,)),
            ("grip", float, (MAX_FINGERS, 2)),
            ("support", float, (2,)),
            ("floor", float),
        ]
    )


def instances(spec: SceneSpec) -> tuple[str, ...]:
    """What a segmentation image's numbers mean: "" for the background, then robot, objects, cabinet."""
    return ("", ROBOT, *(thing.name for thing in spec.objects), *((CABINET,) if spec.cabinet else ()))


def vector(pose: sapien.Pose) -> np.ndarray:
    """A SAPIEN pose as xyz + wxyz [7]."""
    return np.concatenate([pose.p, pose.q]).astype(float)


def pose_of(values: Sequence[float] | np.ndarray) -> sapien.Pose:
    """A SAPIEN pose from xyz + wxyz [7]."""
    return sapien.Pose(list(values[:3]), list(values[3:7]))


@contextmanager
def _upstreams_solver() -> Iterator[None]:
    """SAPIEN keeps scene options in globals that a new scene reads: TGS, no PCM, for the scenes made inside."""
    before = physx.get_scene_config()
    physx.set_scene_config(enable_pcm=False, enable_tgs=True)
    try:
        yield
    finally:
        physx.set_scene_config(before)


class Scene:
    """One slot's scene.

    Args:
        spec: what stands in it.
        visuals: load what is drawn too (needs a renderer).
    """

    def __init__(self, spec: SceneSpec, *, visuals: bool = False) -> None:
        self.spec = spec
        with _upstreams_solver():
            self.system = physx.PhysxCpuSystem()
        systems: list[Any] = [self.system]
        if visuals:
            systems.append(sapien.render.RenderSystem())
        self.sapien = sapien.Scene(systems)
        self.sapien.timestep = 1.0 / spec.sim_hz
        self._visuals = visuals
        self._build_stage()
        self.robot = self._build_robot()
        self.cabinet = self._build_cabinet()
        self.objects = [self._build_object(thing) for thing in spec.objects]
        self._bodies = [_dynamic(entity) for entity in self.objects]
        self._finish_bodies()
        self._let_the_root_stand()
        self._start: Start | None = None
        self._robot_links = set(self.robot.physx.links)
        fingers = [self.robot.frames[finger.link] for finger in spec.robot.fingers]
        self._fingers = {shape: i for i, finger in enumerate(fingers) for shape in finger.shapes}

    # -- building ------------------------------------------------------------------------------------------------------

    def _build_stage(self) -> None:
        stage = self.spec.stage
        if stage is None:
            return
        builder = self.sapien.create_actor_builder()
        material = physx.PhysxMaterial(1.0, 1.0, 0.0)
        if stage.mesh is not None:
            pose = pose_of(stage.mesh_pose)
            if stage.solid:
                builder.add_nonconvex_collision_from_file(str(stage.mesh), pose, material=material)
            if self._visuals:
                builder.add_visual_from_file(str(stage.mesh), pose)
        for box in stage.boxes:
            pose, half = sapien.Pose(list(box.centre)), list(box.half_size)
            builder.add_box_collision(pose, half, material=material)  # type: ignore
            if self._visuals:
                builder.add_box_visual(pose, half)  # type: ignore
        builder.initial_pose = sapien.Pose([-x for x in stage.offset])
        builder.build_static(name="arena")

    def _build_robot(self) -> weld.Articulation:
        body = self.spec.robot
        robot = weld.load(
            self.sapien,
            body.urdf,
            joints=body.joints,
            surfaces=dict(body.surfaces),
            ignored=dict(body.ignored),
            many_hulls=True,
            visuals=self._visuals,
            frozen=dict(body.frozen),
        )
        for i, joint in robot.joints.items():
            joint.set_drive_properties(
                body.stiffness[i], body.damping[i], force_limit=body.force_limit[i], mode="force"
            )
            joint.set_friction(0.0)
            if body.armature:
                joint.set_armature(np.array([body.armature[i]], np.float32))
        # Gravity is compensated in any case; without it the robot can sleep while objects settle.
        for link in robot.physx.links:
            link.set_disable_gravity(True)
        return robot

    def _build_cabinet(self) -> weld.Articulation | None:
        cabinet = self.spec.cabinet
        if cabinet is None:
            return None
        joints = [f"{name}_drawer_joint" for name in cabinet.drawers]
        made = weld.load(
            self.sapien, cabinet.urdf, joints=joints, surfaces={}, ignored={}, many_hulls=False, visuals=self._visuals
        )
        made.physx.set_root_pose(pose_of(cabinet.pose))
        for joint in made.joints.values():
            joint.set_friction(cabinet.friction)
            joint.set_drive_properties(0.0, cabinet.damping)
        return made

    def _build_object(self, thing: ObjectBody) -> sapien.Entity:
        builder = self.sapien.create_actor_builder()
        if self._visuals and thing.visual is not None:
            builder.add_visual_from_file(str(thing.visual), scale=(thing.scale,) * 3)
        entity = sapien.Entity()
        entity.set_name(thing.name)
        body = _body(thing)
        entity.add_component(body)
        if builder.visual_records:
            entity.add_component(builder.build_render_component())
        self.sapien.add_entity(entity)
        body.set_linear_damping(OBJECT_DAMPING)
        body.set_angular_damping(OBJECT_DAMPING)
        return entity

    def _finish_bodies(self) -> None:
        """Solver iterations and contact offsets; SAPIEN would read them from globals when a body is made."""
        for part in self._parts(physx.PhysxRigidBaseComponent):
            for shape in part.collision_shapes:
                shape.set_contact_offset(self.spec.contact_offset)
        articulations = [self.robot] if self.cabinet is None else [self.robot, self.cabinet]
        for solved in [*(each.physx for each in articulations), *self._bodies]:
            solved.set_solver_position_iterations(POSITION_ITERATIONS)
            solved.set_solver_velocity_iterations(VELOCITY_ITERATIONS)

    def _let_the_root_stand(self) -> None:
        """The root is fixed, so its contacts with fixed things change nothing and only cost time."""
        fixed = [shape for part in self._parts(physx.PhysxRigidStaticComponent) for shape in part.collision_shapes]
        root = [shape for frame in self.robot.frames.values() if frame.body.is_root for shape in frame.shapes]
        for shape in fixed + root:
            groups = shape.get_collision_groups()
            shape.set_collision_groups([*groups[:2], groups[2] | weld.ROOT_BIT, weld.IGNORE_ID])

    def _parts(self, kind: type) -> Iterator[Any]:
        for entity in self.sapien.entities:
            yield from (part for part in entity.components if isinstance(part, kind))

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
            velocities: joint velocities to aim at, likewise; None for zero.
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
        """Set what stays the same for the whole tick; returns the rest, column by column."""
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
        """What keeps two fingers from passing through each other in this tick; None when they are not told to."""
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
        """Write what is measured now into a row of ``facts_dtype``; returns what is wrong with it, "" if nothing."""
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
        """All there is to restore: qpos, qvel of the robot, of the cabinet, then pose and velocity of the objects."""
        parts = [self.robot.qpos, self.robot.qvel]
        if self.cabinet is not None:
            parts += [self.cabinet.qpos, self.cabinet.qvel]
        return np.concatenate([*parts, self._object_states().ravel()]).astype(float)

    def restore(self, state: np.ndarray) -> None:
        """Undo of ``state``."""
        rest = np.asarray(state, float)
        for articulation in (self.robot, self.cabinet):
            if articulation is not None:
                n = articulation.dof
                articulation.place(rest[:n].astype(np.float32), rest[n : 2 * n].astype(np.float32))
                rest = rest[2 * n :]
        self._restore_objects(rest.reshape(-1, 13))

    def show(self, facts: np.void) -> None:
        """Stand like the slot that a row of facts was measured in, at rest."""
        self.robot.place(facts["qpos"].astype(np.float32))
        self.robot.physx.set_root_pose(pose_of(facts["base"]))
        if self.cabinet is not None:
            self.cabinet.place(facts["drawers"].astype(np.float32))
        for entity, pose in zip(self.objects, facts["objects"], strict=False):
            entity.set_pose(pose_of(pose))


def _body(thing: ObjectBody) -> physx.PhysxRigidDynamicComponent:
    """An object's body, its parts as convex hulls."""
    body = physx.PhysxRigidDynamicComponent()
    body.name = thing.name
    material = physx.PhysxMaterial(OBJECT_FRICTION, OBJECT_FRICTION, 0.0)
    for vertices in read_parts(thing.collision):
        shape = physx.PhysxCollisionShapeConvexMesh(vertices=vertices, scale=[thing.scale] * 3, material=material)
        shape.set_density(thing.density)
        body.attach(shape)
    return body


def _dynamic(entity: sapien.Entity) -> physx.PhysxRigidDynamicComponent:
    body = entity.find_component_by_type(physx.PhysxRigidDynamicComponent)
    if body is None:
        raise ValueError(f"{entity.name} has no dynamic body")
    return body  # type: ignore


def _release(body: Any) -> None:
    body.set_locked_motion_axes(_FREE)
    # PhysX puts resting bodies to sleep; setting the pose wakes them, as upstream does.
    body.entity.set_pose(body.entity.pose)
    _stop(body)
    body.wake_up()


def _moving(bodies: Sequence[Any]) -> bool:
    linear = sum(np.linalg.norm(body.linear_velocity) for body in bodies)
    angular = sum(np.linalg.norm(body.angular_velocity) for body in bodies)
    return bool(linear > _STILL_LINEAR or angular > _STILL_ANGULAR)


def _stop(body: physx.PhysxRigidDynamicComponent) -> None:
    body.set_linear_velocity([0.0, 0.0, 0.0])
    body.set_angular_velocity([0.0, 0.0, 0.0])
