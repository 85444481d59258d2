"""Building a scene in SAPIEN: stage, robot, cabinet and objects, with upstream's materials and solver settings.

In: a ``SceneSpec``. Out: a ``BuiltScene``, the SAPIEN scene with handles to what is in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import sapien
from sapien import physx

from vecenv.simpler.physics import weld
from vecenv.simpler.physics.hulls import read_parts
from vecenv.simpler.physics.spec import CabinetBody, ObjectBody, RobotBody, SceneSpec, StageBody

# Solver iterations of every body, friction of task objects, their damping: upstream's.
POSITION_ITERATIONS, VELOCITY_ITERATIONS = 25, 1
OBJECT_FRICTION, OBJECT_DAMPING = 0.5, 0.1


def vector(pose: sapien.Pose) -> np.ndarray:
    """A SAPIEN pose as xyz + wxyz [7]."""
    return np.concatenate([pose.p, pose.q]).astype(float)


def pose_of(values: Sequence[float] | np.ndarray) -> sapien.Pose:
    """A SAPIEN pose from xyz + wxyz [7]."""
    return sapien.Pose(list(values[:3]), list(values[3:7]))


@dataclass(frozen=True, kw_only=True)
class BuiltScene:
    """A scene and what is in it.

    Attributes:
        system: the physics.
        sapien: the scene.
        robot: the robot.
        cabinet: the cabinet with drawers, None if there is none.
        objects: entities of the objects, in the order of the spec.
        bodies: their dynamic bodies.
    """

    system: physx.PhysxCpuSystem
    sapien: sapien.Scene
    robot: weld.Articulation
    cabinet: weld.Articulation | None
    objects: list[sapien.Entity]
    bodies: list[physx.PhysxRigidDynamicComponent]


def build(spec: SceneSpec, *, visuals: bool) -> BuiltScene:
    """A scene of what the spec lists; ``visuals``: with what is drawn (needs a renderer)."""
    with _upstream_solver():
        system = physx.PhysxCpuSystem()
    systems: list[Any] = [system, sapien.render.RenderSystem()] if visuals else [system]
    scene = sapien.Scene(systems)
    scene.timestep = 1.0 / spec.sim_hz
    if spec.stage is not None:
        _build_stage(scene, spec.stage, visuals)
    robot = _build_robot(scene, spec.robot, visuals)
    cabinet = _build_cabinet(scene, spec.cabinet, visuals) if spec.cabinet is not None else None
    objects = [_build_object(scene, thing, visuals) for thing in spec.objects]
    built = BuiltScene(
        system=system,
        sapien=scene,
        robot=robot,
        cabinet=cabinet,
        objects=objects,
        bodies=[_dynamic(entity) for entity in objects],
    )
    _finish_bodies(built, spec.contact_offset)
    _ignore_root_contacts(built)
    return built


@contextmanager
def _upstream_solver() -> Iterator[None]:
    """SAPIEN keeps scene options in globals that a new scene reads: TGS, no PCM, for the scenes made inside."""
    before = physx.get_scene_config()
    physx.set_scene_config(enable_pcm=False, enable_tgs=True)
    try:
        yield
    finally:
        physx.set_scene_config(before)


def _build_stage(scene: sapien.Scene, stage: StageBody, visuals: bool) -> None:
    builder = scene.create_actor_builder()
    material = physx.PhysxMaterial(1.0, 1.0, 0.0)
    if stage.mesh is not None:
        pose = pose_of(stage.mesh_pose)
        if stage.solid:
            builder.add_nonconvex_collision_from_file(str(stage.mesh), pose, material=material)
        if visuals:
            builder.add_visual_from_file(str(stage.mesh), pose)
    for box in stage.boxes:
        pose, half = sapien.Pose(list(box.centre)), list(box.half_size)
        builder.add_box_collision(pose, half, material=material)  # type: ignore
        if visuals:
            builder.add_box_visual(pose, half)  # type: ignore
    builder.initial_pose = sapien.Pose([-x for x in stage.offset])
    builder.build_static(name="arena")


def _build_robot(scene: sapien.Scene, body: RobotBody, visuals: bool) -> weld.Articulation:
    robot = weld.load(
        scene,
        body.urdf,
        joints=body.joints,
        surfaces=dict(body.surfaces),
        ignored=dict(body.ignored),
        many_hulls=True,
        visuals=visuals,
        frozen=dict(body.frozen),
    )
    for i, joint in robot.joints.items():
        joint.set_drive_properties(body.stiffness[i], body.damping[i], force_limit=body.force_limit[i], mode="force")
        joint.set_friction(0.0)
        if body.armature:
            joint.set_armature(np.array([body.armature[i]], np.float32))
    # Gravity is compensated in any case; without it the robot can sleep while objects settle.
    for link in robot.physx.links:
        link.set_disable_gravity(True)
    return robot


def _build_cabinet(scene: sapien.Scene, cabinet: CabinetBody, visuals: bool) -> weld.Articulation:
    joints = [f"{name}_drawer_joint" for name in cabinet.drawers]
    made = weld.load(scene, cabinet.urdf, joints=joints, surfaces={}, ignored={}, many_hulls=False, visuals=visuals)
    made.physx.set_root_pose(pose_of(cabinet.pose))
    for joint in made.joints.values():
        joint.set_friction(cabinet.friction)
        joint.set_drive_properties(0.0, cabinet.damping)
    return made


def _build_object(scene: sapien.Scene, thing: ObjectBody, visuals: bool) -> sapien.Entity:
    builder = scene.create_actor_builder()
    if visuals and thing.visual is not None:
        builder.add_visual_from_file(str(thing.visual), scale=(thing.scale,) * 3)
    entity = sapien.Entity()
    entity.set_name(thing.name)
    body = _body(thing)
    entity.add_component(body)
    if builder.visual_records:
        entity.add_component(builder.build_render_component())
    scene.add_entity(entity)
    body.set_linear_damping(OBJECT_DAMPING)
    body.set_angular_damping(OBJECT_DAMPING)
    return entity


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


def _finish_bodies(built: BuiltScene, contact_offset: float) -> None:
    """Solver iterations and contact offsets; SAPIEN would read them from globals when a body is made."""
    for part in _components(built.sapien, physx.PhysxRigidBaseComponent):
        for shape in part.collision_shapes:
            shape.set_contact_offset(contact_offset)
    articulations = [built.robot] if built.cabinet is None else [built.robot, built.cabinet]
    for solved in [*(each.physx for each in articulations), *built.bodies]:
        solved.set_solver_position_iterations(POSITION_ITERATIONS)
        solved.set_solver_velocity_iterations(VELOCITY_ITERATIONS)


def _ignore_root_contacts(built: BuiltScene) -> None:
    """The root is fixed, so its contacts with fixed things change nothing and only cost time."""
    static = _components(built.sapien, physx.PhysxRigidStaticComponent)
    fixed = [shape for part in static for shape in part.collision_shapes]
    root = [shape for frame in built.robot.frames.values() if frame.body.is_root for shape in frame.shapes]
    for shape in fixed + root:
        groups = shape.get_collision_groups()
        shape.set_collision_groups([*groups[:2], groups[2] | weld.ROOT_BIT, weld.IGNORE_ID])


def _components(scene: sapien.Scene, kind: type) -> Iterator[Any]:
    for entity in scene.entities:
        yield from (part for part in entity.components if isinstance(part, kind))
