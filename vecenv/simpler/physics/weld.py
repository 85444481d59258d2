"""Articulations for SAPIEN from URDF files, with the links that fixed joints hold together welded into one body.

In: a SAPIEN scene, a URDF file, what its links are made of. Out: an ``Articulation`` whose joints and frames are
addressed by the URDF's names. Welding changes nothing that can move: masses, centres and inertias are combined exactly.
It makes a physics step cheaper, because the solver passes over every link and because shapes of one body are never
tested against each other (the Google Robot has 37 links for 11 joints). Visual shapes are left out by default, so
that physics needs no Vulkan.
"""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import sapien
from sapien import physx
from sapien.wrapper.articulation_builder import ArticulationBuilder, LinkBuilder

from vecenv.simpler.physics.spec import LinkSurface

# Shapes with the same id (word 3 of a collision group) that share an "ignore" bit (word 2) never collide.
IGNORE_ID = 1
# The bit for a robot's root and what it stands on; others are free.
ROOT_BIT = 1 << 15


@dataclass(frozen=True)
class Frame:
    """A URDF link: the body that carries it, its pose on that body, and its own collision shapes."""

    body: physx.PhysxArticulationLinkComponent
    local: sapien.Pose
    shapes: tuple[physx.PhysxCollisionShape, ...]

    @property
    def pose(self) -> sapien.Pose:
        """Pose in the world frame."""
        return self.body.entity_pose * self.local


@dataclass(frozen=True)
class Articulation:
    """A welded articulation with ``dof`` named joints, some of which may be frozen.

    Attributes:
        physx: SAPIEN's articulation.
        joints: column of a named joint -> the joint, without those that are frozen, in the requested order.
        order: index of each of ``joints`` in SAPIEN's qpos.
        frames: every link of the URDF by name.
        frozen: angles of the frozen joints, 0 for the others, float32 [dof].
    """

    physx: physx.PhysxArticulation
    joints: Mapping[int, physx.PhysxArticulationJoint]
    order: np.ndarray
    frames: Mapping[str, Frame]
    frozen: np.ndarray

    @property
    def dof(self) -> int:
        """How many joints have names, frozen or not."""
        return len(self.frozen)

    @property
    def qpos(self) -> np.ndarray:
        """Joint positions, float32 [dof]."""
        out = self.frozen.copy()
        out[self._columns] = self.physx.qpos[self.order]
        return out

    @property
    def qvel(self) -> np.ndarray:
        """Joint velocities, float32 [dof]."""
        out = np.zeros_like(self.frozen)
        out[self._columns] = self.physx.qvel[self.order]
        return out

    def place(self, qpos: np.ndarray, qvel: np.ndarray | None = None) -> None:
        """Set joint positions and velocities [dof] (none: at rest), and clear the joint forces; frozen ones stay."""
        self.physx.set_qpos(self._unordered(qpos))
        self.physx.set_qvel(self._unordered(np.zeros_like(qpos) if qvel is None else qvel))
        self.physx.set_qf(np.zeros(len(self.order), np.float32))

    @property
    def _columns(self) -> list[int]:
        return list(self.joints)

    def _unordered(self, values: np.ndarray) -> np.ndarray:
        out = np.zeros(len(self.order), np.float32)
        out[self.order] = values[self._columns]
        return out


def load(
    scene: sapien.Scene,
    urdf: Path,
    *,
    joints: Sequence[str],
    surfaces: Mapping[str, LinkSurface],
    ignored: Mapping[str, int],
    many_hulls: bool,
    visuals: bool = False,
    frozen: Mapping[str, float] | None = None,
) -> Articulation:
    """Load a URDF file with a fixed root into a scene.

    Args:
        scene: where it goes.
        urdf: the file.
        joints: names of the active joints, in the order that ``Articulation`` uses.
        surfaces: link name -> surface; others have friction 1.
        ignored: link name -> bit set; links that share a bit never collide.
        many_hulls: whether a collision mesh file holds several convex hulls.
        visuals: keep visual shapes (needs a renderer).
        frozen: those of the joints that never move, and their angles (radians): they are welded too.

    Raises:
        ValueError: the file's active joints are not those named.
    """
    still = dict(frozen or {})
    source = _parse(scene, urdf, surfaces, many_hulls, visuals)
    _freeze(source.link_builders, still)
    welded, hosts = _weld(scene, source.link_builders)
    built = welded.build(fix_root_link=True, build_mimic_joints=False)
    names = [joint.name for joint in built.active_joints]
    if sorted([*names, *still]) != sorted(joints):
        raise ValueError(f"{urdf.name}: active joints {', '.join(sorted(names))}; expected {', '.join(sorted(joints))}")
    bodies = {link.name: link for link in built.links}
    frames = _frames(bodies, source.link_builders, hosts)
    for name, bits in ignored.items():
        for shape in frames[name].shapes:
            shape.set_collision_groups([*shape.get_collision_groups()[:2], bits, IGNORE_ID])
    moving = {column: names.index(name) for column, name in enumerate(joints) if name not in still}
    return Articulation(
        physx=built,
        joints={column: built.active_joints[i] for column, i in moving.items()},
        order=np.array(list(moving.values())),
        frames=frames,
        frozen=np.array([still.get(name, 0.0) for name in joints], np.float32),
    )


def _freeze(links: Sequence[LinkBuilder], angles: Mapping[str, float]) -> None:
    """Make joints fixed at their angles; SAPIEN's joints turn about the x axis of their frames."""
    for link in links:
        joint = link.joint_record
        if joint.name in angles:
            half = angles[joint.name] / 2
            turn = sapien.Pose([0.0, 0.0, 0.0], [np.cos(half), np.sin(half), 0.0, 0.0])
            link.joint_record = replace(joint, joint_type="fixed", pose_in_parent=joint.pose_in_parent * turn)


def _parse(
    scene: sapien.Scene, urdf: Path, surfaces: Mapping[str, LinkSurface], many_hulls: bool, visuals: bool
) -> ArticulationBuilder:
    # SAPIEN warns of every STL file with several hulls, which upstream's robots have; upstream silences it too.
    sapien.set_log_level("error")
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    loader.load_multiple_collisions_from_file = many_hulls
    loader.set_material(1.0, 1.0, 0.0)
    for link, surface in surfaces.items():
        loader.set_link_material(link, *surface.friction, 0.0)
        loader.set_link_patch_radius(link, surface.patch_radius)
        loader.set_link_min_patch_radius(link, surface.patch_radius)
    if visuals:
        return loader.load_file_as_articulation_builder(str(urdf))
    with tempfile.TemporaryDirectory() as folder:
        bare = Path(folder) / urdf.name
        bare.write_bytes(_without_visuals(urdf))
        return loader.load_file_as_articulation_builder(str(bare))


def _without_visuals(urdf: Path) -> bytes:
    """A URDF file without what is drawn, which SAPIEN would need a renderer to read; mesh paths are absolute."""
    tree = ET.parse(urdf).getroot()  # nosec B314 # a file of the asset tree
    for link in tree.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for mesh in tree.iter("mesh"):
        mesh.set("filename", str((urdf.parent / mesh.attrib["filename"]).resolve()))
    return ET.tostring(tree)


# A URDF link's host (the link it is welded to, or itself), its pose there, and its physics body on its own.
_Host = tuple[LinkBuilder, sapien.Pose, Any]


def _weld(scene: sapien.Scene, links: Sequence[LinkBuilder]) -> tuple[ArticulationBuilder, list[_Host]]:
    hosts = _hosts(links)
    builder, made = scene.create_articulation_builder(), {}
    for link, (host, _, _) in zip(links, hosts, strict=True):
        if host is link:
            made[link.index] = _host_builder(builder, link, links, hosts, made)
    return builder, hosts


def _hosts(links: Sequence[LinkBuilder]) -> list[_Host]:
    hosts: list[_Host] = []
    for link in links:
        body = link.build_physx_component(None)
        joint = link.joint_record
        if link.parent is None or joint.joint_type != "fixed":
            hosts.append((link, sapien.Pose(), body))
            continue
        host, pose, _ = hosts[link.parent.index]
        hosts.append((host, pose * joint.pose_in_parent * joint.pose_in_child.inv(), body))
    return hosts


def _host_builder(
    builder: ArticulationBuilder,
    link: LinkBuilder,
    links: Sequence[LinkBuilder],
    hosts: Sequence[_Host],
    made: Mapping[int, LinkBuilder],
) -> LinkBuilder:
    parent_host: LinkBuilder | None = None
    parent_pose = sapien.Pose()
    if link.parent is not None:
        parent_host, parent_pose, _ = hosts[link.parent.index]
    new = builder.create_link_builder(None if parent_host is None else made[parent_host.index])  # type: ignore
    new.set_name(link.name)
    joint = link.joint_record
    new.joint_record = replace(joint, pose_in_parent=parent_pose * joint.pose_in_parent) if parent_host else joint
    bodies, poses = [], []
    for part, (host, pose, body) in zip(links, hosts, strict=True):
        if host is link:
            new.collision_records += [replace(record, pose=pose * record.pose) for record in part.collision_records]
            new.visual_records += [replace(record, pose=pose * record.pose) for record in part.visual_records]
            bodies.append(body)
            poses.append(pose)
    new.set_mass_and_inertia(*_combined(bodies, poses))
    return new


def _combined(bodies: Sequence[Any], poses: Sequence[sapien.Pose]) -> tuple[float, sapien.Pose, np.ndarray]:
    """Mass, centre-of-mass pose (axes along the principal ones) and principal inertia [3] of several bodies."""
    if len(bodies) == 1:
        return bodies[0].mass, poses[0] * bodies[0].cmass_local_pose, np.asarray(bodies[0].inertia)
    frames = [
        (pose * body.cmass_local_pose).to_transformation_matrix().astype(float)
        for body, pose in zip(bodies, poses, strict=True)
    ]
    masses = np.array([body.mass for body in bodies])
    centres = np.array([frame[:3, 3] for frame in frames])
    centre = masses @ centres / masses.sum()
    total = np.zeros((3, 3))
    for body, mass, frame in zip(bodies, masses, frames, strict=True):
        arm = frame[:3, 3] - centre
        total += frame[:3, :3] @ np.diag(body.inertia) @ frame[:3, :3].T
        total += mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    principal, axes = np.linalg.eigh(total)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = axes, centre
    return float(masses.sum()), sapien.Pose(frame), principal


def _frames(
    bodies: Mapping[str, physx.PhysxArticulationLinkComponent], links: Sequence[LinkBuilder], hosts: Sequence[_Host]
) -> dict[str, Frame]:
    """Every URDF link; the shapes of a body lie in the order of the links welded to it."""
    remaining = {name: list(body.collision_shapes) for name, body in bodies.items()}
    frames = {}
    for link, (host, local, body) in zip(links, hosts, strict=True):
        count = len(body.collision_shapes)
        mine, remaining[host.name] = remaining[host.name][:count], remaining[host.name][count:]
        frames[link.name] = Frame(bodies[host.name], local, tuple(mine))
    return frames
