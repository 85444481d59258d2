"""Parts of a scene's things: drawers and handles, doors, knobs, tops and insides, from geoms, joints and regions.

In: a :class:`~vecenv.libero.scene.scene.Scene` with upstream's geometry. Out: name -> :class:`PartSpec`, samples in
body frames and which joint moves the part. Names follow one rule, ``<thing>_<which>_<what>``, so that a reader finds
"the top drawer of the cabinet" by its words:

* ``<thing>_<level>_drawer``: what a slide joint moves, its handle left out; ``<thing>_<level>_handle``: what sticks out
  in front of it. ``<thing>_door`` and ``<thing>_handle``: likewise for a hinge off to one side of what it carries.
* ``<thing>_knob``: what a hinge through its middle turns.
* ``<thing>_top``: the flat region over a thing (``_top_side``); ``<thing>_slot``: any other flat region, such as a
  rack's; ``<thing>_burner``: a stove's ``_cook_region``.
* ``<thing>_inside``: the only space in a thing (a basket's, a microwave's); with several,
  ``<thing>_<which>_compartment`` where BDDL says that they contain, else ``<thing>_upper_level`` and
  ``<thing>_lower_level`` (a shelf's).

``<level>`` and ``<which>`` are BDDL's own words (top, middle, bottom, left, right, front, back).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from vecenv.libero.scene import surface
from vecenv.libero.scene.scene import Entity, RegionSite, Scene
from vecenv.libero.scene.surface import BodyPoints

POINTS_PER_PART = 240
# A region thinner than this (half, metres) is a face to stand things on, a thicker one is a space to put things in.
_FLAT = 0.01
# Surface points this close to a region belong to it, metres.
_NEAR_REGION = 0.015
_DRAWN_FOR_REGIONS = 6000
# Geoms with at least this share of the largest one's area are panels, not handles.
_WIDE = 0.25
_LEVELS = {"top": "upper", "bottom": "lower"}


@dataclass(frozen=True)
class PartSpec:
    """A part in body frames.

    Attributes:
        parent: the object or fixture it belongs to.
        kind: ``"drawer"``, ``"door"``, ``"handle"``, ``"knob"``, ``"top"`` or ``"space"``.
        points: surface samples.
        region: the region it is, or that moves with it; None without.
        joint: the joint that moves it; None where nothing does.
    """

    parent: str
    kind: str
    points: BodyPoints
    region: str | None = None
    joint: str | None = None


def scene_parts(scene: Scene) -> dict[str, PartSpec]:
    """Every part of a scene by name; the module says how they are named.

    Args:
        scene: with upstream's collision geoms. A lean scene has the same bodies, so these are its parts as well; its
            own geoms do not tell a drawer from its handle, and some drawers have none.
    """
    parts: dict[str, PartSpec] = {}
    for entity in scene.entities.values():
        parts.update(_moving_parts(scene, entity))
        parts.update(_places(scene, entity))
    return parts


def opening(model: mujoco.MjModel, joint: str) -> float:
    """The end of a joint's range that is farthest from 0, where fixtures are closed or off; its sign says which way."""
    low, high = model.joint(joint).range
    return float(low if abs(low) > abs(high) else high)


def _moving_parts(scene: Scene, entity: Entity) -> Iterator[tuple[str, PartSpec]]:
    for joint in entity.joints:
        if scene.model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_SLIDE:
            yield from _drawer(scene, entity, joint)
        elif scene.model.joint(joint).type[0] == mujoco.mjtJoint.mjJNT_HINGE:
            yield from _hinged(scene, entity, joint)


def _drawer(scene: Scene, entity: Entity, joint: str) -> Iterator[tuple[str, PartSpec]]:
    model = scene.model
    region = next((r for r in _regions(scene, entity) if joint in r.joints), None)
    level = _words(entity, region)[:1] if region else []
    stem = "_".join([entity.name, *level])
    geoms = _geoms(scene, joint)
    out = model.joint(joint).axis * np.sign(opening(model, joint))
    handle = _in_front(model, geoms, out)
    rest = [g for g in geoms if g not in handle]
    name = region.name if region else None
    yield f"{stem}_drawer", PartSpec(entity.name, "drawer", _sampled(model, rest), name, joint)
    if handle:
        yield f"{stem}_handle", PartSpec(entity.name, "handle", _sampled(model, handle), name, joint)


def _hinged(scene: Scene, entity: Entity, joint: str) -> Iterator[tuple[str, PartSpec]]:
    model, geoms = scene.model, _geoms(scene, joint)
    corners = _corners(model, geoms) - model.joint(joint).pos
    across = corners - np.outer(corners @ model.joint(joint).axis, model.joint(joint).axis)
    middle = (across.min(axis=0) + across.max(axis=0)) / 2
    if np.linalg.norm(middle) < 0.5 * np.linalg.norm(across - middle, axis=1).max():
        yield f"{entity.name}_knob", PartSpec(entity.name, "knob", _sampled(model, geoms), None, joint)
        return
    panel = max(geoms, key=lambda g: _area(model, g))
    handle = [g for g in geoms if g != panel]
    yield f"{entity.name}_door", PartSpec(entity.name, "door", _sampled(model, [panel]), None, joint)
    if handle:
        yield f"{entity.name}_handle", PartSpec(entity.name, "handle", _sampled(model, handle), None, joint)


def _places(scene: Scene, entity: Entity) -> Iterator[tuple[str, PartSpec]]:
    """Faces and spaces that regions name, drawers apart."""
    regions = [r for r in _regions(scene, entity) if not r.joints]
    spaces = [r for r in regions if not _flat(r)]
    drawn = _sampled(scene.model, _collision(scene, entity), _DRAWN_FOR_REGIONS) if regions else None
    for region in regions:
        assert drawn is not None
        kind = "top" if _flat(region) else "space"
        name = f"{entity.name}_{_place_name(entity, region, alone=len(spaces) == 1)}"
        yield name, PartSpec(entity.name, kind, _near_region(scene, region, drawn), region.name)


def _place_name(entity: Entity, region: RegionSite, *, alone: bool) -> str:
    words = _words(entity, region)
    if _flat(region):
        return "burner" if "cook" in words else "top" if "side" in words else "slot"
    if alone:
        return "inside"
    return f"{words[0]}_compartment" if "contain" in words else f"{_LEVELS.get(words[0], words[0])}_level"


def _words(entity: Entity, region: RegionSite) -> list[str]:
    return region.name.removeprefix(entity.name).strip("_").split("_")


def _flat(region: RegionSite) -> bool:
    return min(region.size) < _FLAT


def _regions(scene: Scene, entity: Entity) -> list[RegionSite]:
    return [region for region in scene.regions.values() if region.parent == entity.name]


def _near_region(scene: Scene, region: RegionSite, drawn: BodyPoints) -> BodyPoints:
    """Those samples that lie on or near a region, in a pose of the model's reference state."""
    model = scene.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    pos, _ = drawn.world(data.xpos[None], data.xmat[None])
    site = model.site(region.name).id
    local = (pos[0] - data.site_xpos[site]) @ data.site_xmat[site].reshape(3, 3)
    near = np.flatnonzero((np.abs(local) < np.array(region.size) + _NEAR_REGION).all(axis=1))
    near = near[:: max(1, len(near) // POINTS_PER_PART)]
    if len(near) < 8:
        return _on_site(model, region, site)
    return BodyPoints(drawn.body[near], drawn.pos[near], drawn.normal[near])


def _on_site(model: mujoco.MjModel, region: RegionSite, site: int) -> BodyPoints:
    """The region's own faces, for one that floats free of every surface."""
    size = np.array(region.size)
    points, normals = surface.box_samples(-size[None], size[None])
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, model.site_quat[site])
    turn = mat.reshape(3, 3).T
    body = np.full(points.shape[1], model.site_bodyid[site])
    return BodyPoints(body, points[0] @ turn + model.site_pos[site], normals[0] @ turn)


def _in_front(model: mujoco.MjModel, geoms: list[int], out: np.ndarray) -> list[int]:
    """Geoms whose middle lies before the front of every wide one, seen from ``out`` (body frame)."""
    widest = max(_area(model, g) for g in geoms)
    faces = [g for g in geoms if _area(model, g) > _WIDE * widest]
    edge = max(float((_corners(model, [g]) @ out).max()) for g in faces)
    return [g for g in geoms if float((_corners(model, [g]) @ out).mean()) > edge]


def _area(model: mujoco.MjModel, geom: int) -> float:
    """Area of the largest face of the box around a geom, square metres."""
    half = np.sort(model.geom_aabb[geom, 3:])
    return float(4 * half[1] * half[2])


def _corners(model: mujoco.MjModel, geoms: list[int]) -> np.ndarray:
    """Corners of the boxes around geoms in their body's frame, [8 n, 3]."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    parts = []
    for g in geoms:
        mat = np.zeros(9)
        mujoco.mju_quat2Mat(mat, model.geom_quat[g])
        local = model.geom_aabb[g, :3] + signs * model.geom_aabb[g, 3:]
        parts.append(local @ mat.reshape(3, 3).T + model.geom_pos[g])
    return np.concatenate(parts)


def _geoms(scene: Scene, joint: str) -> list[int]:
    body = scene.model.joint(joint).bodyid[0]
    return surface.colliding_geoms(scene.model, scene.model.body(body).name)


def _collision(scene: Scene, entity: Entity) -> list[int]:
    return surface.colliding_geoms(scene.model, entity.root_body)


def _sampled(model: mujoco.MjModel, geoms: list[int], count: int = POINTS_PER_PART) -> BodyPoints:
    return surface.sample_geoms(model, geoms, count)
