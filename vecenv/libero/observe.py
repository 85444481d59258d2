"""What a batch of LIBERO slots reports about its state: proprioception, and the ground truth of objects and parts.

In: the physics groups of a batch and the problem of each slot. Out: the arrays and snapshots of ``vecenv.contract``, in
the world frame. Surface points are drawn once a scene in body frames and moved with the bodies. Images are
``vecenv.libero.render``'s.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from vecenv.libero.physics.base import Group, Physics
from vecenv.libero.robot import BASE_BODY
from vecenv.libero.scene import surface
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.parts import PartSpec, opening, scene_parts
from vecenv.libero.scene.scene import Scene
from vecenv.observations import Objects, ObjectsSnapshot, Part, PartJoint, PointCloud, RegionBox

# The name of the samples that belong to no object or fixture: table and floor.
_SCENERY = ""


def proprioception(physics: Physics) -> np.ndarray:
    """Position (m), rotation vector (rad) of the hand and finger joints (m) of every slot, float32 [B, 8]."""
    state = np.concatenate([physics.eef_pos, _axis_angle(physics.eef_quat), physics.fingers], axis=1)
    return state.astype(np.float32)


def _axis_angle(quat: np.ndarray) -> np.ndarray:
    """Rotation vectors [..., 3] of quaternions wxyz [..., 4], with the angle in [0, 2 pi), as LIBERO policies expect.

    The convention is that of robosuite's ``quat2axisangle``: no sign is chosen, and a rotation of zero is zero.
    """
    w = np.clip(quat[..., :1], -1.0, 1.0)
    norm = np.sqrt(1.0 - w * w)
    small = np.isclose(norm, 0.0, rtol=1e-9, atol=0.0)
    scale = np.where(small, 0.0, 2.0 * np.arccos(w) / np.where(small, 1.0, norm))
    return quat[..., 1:] * scale


def objects(
    groups: Sequence[Group],
    exact_scene: Callable[[Group], Scene],
    problems: Sequence[Problem],
    faults: Sequence[str],
    points: str,
    slots: np.ndarray,
) -> Objects:
    """Ground truth of every slot.

    Args:
        groups: the slots by scene; none of what they hold is changed.
        exact_scene: a group's scene with upstream's collision geoms, on which parts are measured.
        problems: the problem of each slot, B.
        faults: why the physics of each slot failed, "" where it did not, B; a failed slot has no snapshot.
        points: ``"surface"`` or ``"aabb"``, see ``LiberoEnv.observe_objects``.
        slots: indices of the slots to observe; the others have no snapshot.
    """
    snapshots: list[ObjectsSnapshot | None] = [None] * len(problems)
    wanted = np.isin(np.arange(len(problems)), slots)
    for group in groups:
        rows = np.flatnonzero(wanted[group.slots])
        if not len(rows):
            continue
        samples = _Clouds.of(group.scene, exact_scene(group))
        with group.refreshed():
            clouds, parts = samples.world(group, rows, points), samples.parts_in_world(group, rows)
            for index, row in enumerate(rows.tolist()):
                slot = int(group.slots[row])
                if not faults[slot]:
                    seen = {name: (pos[index], normal[index]) for name, (pos, normal) in clouds.items()}
                    snapshots[slot] = _snapshot(group, row, problems[slot], seen, parts[index])
    return Objects(
        snapshot=tuple(snapshots), error=tuple(f"physics failed: {reason}" if reason else "" for reason in faults)
    )


def _snapshot(
    group: Group,
    row: int,
    problem: Problem,
    clouds: Mapping[str, tuple[np.ndarray, np.ndarray]],
    parts: Mapping[str, Part],
) -> ObjectsSnapshot:
    scene = group.scene
    named = {name: PointCloud(pos, normal) for name, (pos, normal) in clouds.items()}
    scenery = named.pop(_SCENERY)
    everything = [*named.values(), scenery]
    return ObjectsSnapshot(
        names=tuple(scene.entities),
        objects=named,
        poses={name: _body_pose(group, row, entity.root_body) for name, entity in scene.entities.items()},
        regions={name: _region_box(group, row, name) for name in scene.regions},
        goal=tuple((predicate.name, *predicate.args) for predicate in problem.goal),
        scene=PointCloud(
            np.concatenate([cloud.points for cloud in everything]),
            np.concatenate([cloud.normals for cloud in everything]),
        ),
        ee_pose=np.concatenate([group.site_xpos[row, scene.grip_site], group.xquat[row, scene.hand_body]]),
        gripper=group.qpos[row, scene.finger_qpos].copy(),
        workspace=scene.workspace_bounds,
        targets=problem.obj_of_interest,
        movable=tuple(entity.name for entity in scene.objects),
        parts=parts,
        panda_base=_body_pose(group, row, BASE_BODY),
    )


@dataclass(frozen=True)
class _Clouds:
    """Body-frame samples of everything in a scene."""

    surface: Mapping[str, surface.BodyPoints]
    corners: Mapping[str, surface.BodyPoints]
    parts: Mapping[str, PartSpec]

    @staticmethod
    @functools.lru_cache(maxsize=64)
    def of(scene: Scene, exact: Scene) -> _Clouds:
        """Samples of a scene's geoms, and parts measured on the same scene with upstream's."""
        names = tuple(scene.entities)
        points = {name: surface.entity_points(scene, name) for name in names}
        points[_SCENERY] = surface.scenery_points(scene)
        corners = {name: surface.entity_corners(scene, name) for name in names}
        return _Clouds(points, corners, scene_parts(exact))

    def world(self, group: Group, rows: np.ndarray, points: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        xpos, xmat = group.xpos[rows], group.xmat[rows]
        clouds = {name: cloud.world(xpos, xmat) for name, cloud in self.surface.items()}
        if points == "aabb":
            for name, corners in self.corners.items():
                pos, _ = corners.world(xpos, xmat)
                clouds[name] = surface.box_samples(pos.min(axis=1), pos.max(axis=1))
        return clouds

    def parts_in_world(self, group: Group, rows: np.ndarray) -> list[dict[str, Part]]:
        """The parts of each of a group's rows."""
        xpos, xmat = group.xpos[rows], group.xmat[rows]
        clouds = {name: spec.points.world(xpos, xmat) for name, spec in self.parts.items()}
        return [
            {name: _part(group, row, self.parts[name], pos[k], normal[k]) for name, (pos, normal) in clouds.items()}
            for k, row in enumerate(rows.tolist())
        ]


def _body_pose(group: Group, row: int, body: str) -> np.ndarray:
    index = group.scene.model.body(body).id
    return np.concatenate([group.xpos[row, index], group.xquat[row, index]])


def _region_box(group: Group, row: int, name: str) -> RegionBox:
    model, region = group.scene.model, group.scene.regions[name]
    site = model.site(name).id
    axis = None
    for joint in region.joints:
        if model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_SLIDE:
            axis = group.xmat[row, model.joint(joint).bodyid[0]].reshape(3, 3) @ model.joint(joint).axis
    return RegionBox(
        pos=group.site_xpos[row, site].copy(),
        mat=group.site_xmat[row, site].reshape(3, 3).copy(),
        half_extents=np.array(region.size),
        parent=region.parent,
        axis=axis,
    )


def _part(group: Group, row: int, spec: PartSpec, pos: np.ndarray, normal: np.ndarray) -> Part:
    return Part(
        parent=spec.parent,
        kind=spec.kind,
        cloud=PointCloud(pos, normal),
        box=_region_box(group, row, spec.region) if spec.region else None,
        joint=_part_joint(group, row, spec.joint) if spec.joint else None,
    )


def _part_joint(group: Group, row: int, name: str) -> PartJoint:
    model = group.scene.model
    joint = model.joint(name)
    end = opening(model, name)
    body = int(joint.bodyid[0])
    mat = group.xmat[row, body].reshape(3, 3)
    return PartJoint(
        kind="slide" if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "hinge",
        axis=mat @ joint.axis * np.sign(end),
        anchor=group.xpos[row, body] + mat @ joint.pos,
        travel=abs(end),
        opened=float(group.qpos[row, joint.qposadr[0]] * np.sign(end)),
    )
