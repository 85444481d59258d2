"""Ground truth of a SIMPLER slot for planners: ``ObjectsSnapshot`` from an episode and its facts.

In: an ``Episode`` and a row of ``physics.spec.facts_dtype``. Out: surface samples of every object's collision mesh and
of the cabinet's boxes, poses, the drawers as parts with their joints, and the task's goal as a predicate. Samples of a
mesh are drawn once and are always the same.
"""

from __future__ import annotations

import functools
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np

from vecenv.observations import ObjectsSnapshot, Part, PartJoint, PointCloud, RegionBox
from vecenv.simpler.control.rotations import rotation_from_quat
from vecenv.simpler.episodes import Episode
from vecenv.simpler.task_spec import BRIDGE, SimplerTask

_SAMPLES = 300
_FACE_STEPS = 6
CABINET = "cabinet"
# Lower and upper corners of what the robots reach, metres, world frame.
_BRIDGE_SPACE = ((-0.45, -0.35, 0.80), (0.10, 0.40, 1.30))
_TABLE_SPACE = ((-0.60, -0.30, 0.80), (0.25, 0.70, 1.50))
_CABINET_SPACE = ((-0.45, -0.60, 0.00), (0.80, 0.60, 1.50))
_TRAVEL = 0.5
_FLOOR = 2


def take(episode: Episode, facts: np.void, points: str) -> ObjectsSnapshot:
    """The snapshot of one slot; ``points`` is ``"surface"`` or ``"aabb"``."""
    objects = {
        body.name: _placed(_surface(body.collision, body.scale), facts["objects"][i])
        for i, body in enumerate(episode.spec.objects)
    }
    poses = {body.name: facts["objects"][i].copy() for i, body in enumerate(episode.spec.objects)}
    parts = _drawers(episode, facts)
    if parts:
        objects[CABINET] = _joined([*(part.cloud for part in parts.values()), _cabinet_body(episode)])
        poses[CABINET] = np.array(episode.spec.cabinet.pose if episode.spec.cabinet else np.zeros(7))
    if points == "aabb":
        objects = {name: _boxed(cloud) for name, cloud in objects.items()}
    table = [_box_cloud(np.array(box.centre), np.array(box.half_size)) for box in _boxes(episode)]
    roles = episode.roles
    movable = tuple(body.name for body in episode.spec.objects if not body.anchored)
    named = {
        role: episode.spec.objects[i].name for role, i in (("source", roles.source), ("target", roles.target)) if i >= 0
    }
    return ObjectsSnapshot(
        names=(*movable, *(name for name in objects if name not in movable)),
        objects=objects,
        poses=poses,
        regions={name: part.box for name, part in parts.items() if part.box is not None},
        goal=(_goal(episode.task, named, episode.layout.drawer),),
        scene=_joined([*objects.values(), *table]),
        ee_pose=facts["tcp"].copy(),
        gripper=facts["qpos"][list(episode.task.robot.gripper)].copy(),
        workspace=np.array(_workspace(episode.task)),
        targets=tuple(named.values()) or (f"{episode.layout.drawer}_drawer",),
        movable=movable,
        parts=parts,
    )


def _goal(task: SimplerTask, named: dict[str, str], drawer: str) -> tuple[str, ...]:
    if task.family in ("open", "close"):
        return (task.family, f"{drawer}_drawer")
    if task.family == "place":
        return ("in", named["source"], f"{drawer}_drawer")
    if task.family == "pick":
        return ("lifted", named["source"])
    return ({"put_on": "on", "move_near": "near"}[task.family], named["source"], named["target"])


def _workspace(task: SimplerTask) -> tuple[tuple[float, ...], tuple[float, ...]]:
    if task.suite == BRIDGE:
        return _BRIDGE_SPACE
    return _CABINET_SPACE if task.station else _TABLE_SPACE


def _boxes(episode: Episode) -> tuple:
    return episode.spec.stage.boxes if episode.spec.stage else ()


# ---------------------------------------------------------------------------------------------------------------------
# Clouds.


@functools.lru_cache(maxsize=256)
def _surface(mesh: Path, scale: float) -> PointCloud:
    """Points and normals on a mesh, in its own frame."""
    import trimesh

    loaded: Any = trimesh.load(mesh, force="mesh")
    points, faces, *_ = trimesh.sample.sample_surface(loaded, _SAMPLES, seed=0)
    return PointCloud(np.asarray(points) * scale, np.asarray(loaded.face_normals[faces]))


def _placed(cloud: PointCloud, pose: np.ndarray) -> PointCloud:
    turn = rotation_from_quat(pose[None, 3:7])[0]
    return PointCloud(cloud.points @ turn.T + pose[:3], cloud.normals @ turn.T)


def _joined(clouds: list[PointCloud]) -> PointCloud:
    clouds = clouds or [PointCloud(np.zeros((0, 3)), np.zeros((0, 3)))]
    return PointCloud(*(np.concatenate([getattr(c, name) for c in clouds]) for name in ("points", "normals")))


def _boxed(cloud: PointCloud) -> PointCloud:
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    return _box_cloud((low + high) / 2, (high - low) / 2)


def _box_cloud(centre: np.ndarray, half: np.ndarray) -> PointCloud:
    """A grid on every face of a box along the axes."""
    ticks = np.linspace(-1, 1, _FACE_STEPS)
    u, v = (grid.ravel() for grid in np.meshgrid(ticks, ticks))
    points, normals = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.insert(np.stack([u, v], axis=1), axis, side, axis=1)
            points.append(centre + face * half)
            normals.append(np.tile(np.eye(3)[axis] * side, (len(face), 1)))
    return PointCloud(np.concatenate(points), np.concatenate(normals))


# ---------------------------------------------------------------------------------------------------------------------
# The cabinet.


@functools.lru_cache(maxsize=8)
def _cabinet_boxes(urdf: Path) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Link -> centre and half sizes of its collision boxes, in the cabinet's frame with closed drawers."""
    tree = ET.parse(urdf).getroot()  # nosec B314 # a file of the asset tree
    origins = {joint.find("child").attrib["link"]: _xyz(joint) for joint in tree.iter("joint")}  # type: ignore[union-attr]
    boxes: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for link in tree.iter("link"):
        name, origin = link.attrib["name"], origins.get(link.attrib["name"], np.zeros(3))
        boxes[name] = [
            (origin + _xyz(shape), np.array(box.attrib["size"].split(), float) / 2)
            for shape in link.iter("collision")
            if (box := shape.find("geometry/box")) is not None
        ]
    return boxes


def _xyz(element: ET.Element) -> np.ndarray:
    origin = element.find("origin")
    return np.zeros(3) if origin is None else np.array(origin.attrib.get("xyz", "0 0 0").split(), float)


def _cabinet_body(episode: Episode) -> PointCloud:
    cabinet = episode.spec.cabinet
    assert cabinet is not None
    boxes = _cabinet_boxes(cabinet.urdf)["body"]
    return _joined([_box_cloud(centre + np.array(cabinet.pose[:3]), half) for centre, half in boxes])


def _drawers(episode: Episode, facts: np.void) -> dict[str, Part]:
    cabinet = episode.spec.cabinet
    if cabinet is None:
        return {}
    parts = {}
    for index, name in enumerate(cabinet.drawers):
        opened = float(facts["drawers"][index])
        shift = np.array(cabinet.pose[:3]) + np.array([opened, 0.0, 0.0])
        boxes = [(centre + shift, half) for centre, half in _cabinet_boxes(cabinet.urdf)[f"{name}_drawer"]]
        parts[f"{name}_drawer"] = _drawer(boxes, opened)
    return parts


def _drawer(boxes: list[tuple[np.ndarray, np.ndarray]], opened: float) -> Part:
    axis = np.array([1.0, 0.0, 0.0])
    low = np.min([centre - half for centre, half in boxes], axis=0)
    high = np.max([centre + half for centre, half in boxes], axis=0)
    floor, _ = boxes[_FLOOR]
    return Part(
        parent=CABINET,
        kind="drawer",
        cloud=_joined([_box_cloud(centre, half) for centre, half in boxes]),
        box=RegionBox(pos=(low + high) / 2, mat=np.eye(3), half_extents=(high - low) / 2, parent=CABINET, axis=axis),
        joint=PartJoint(kind="slide", axis=axis, anchor=floor, travel=_TRAVEL, opened=opened),
    )
