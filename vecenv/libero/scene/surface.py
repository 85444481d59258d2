"""Surface samples of a scene's collision geometry: the ground truth for planners.

Points are drawn once a scene, deterministically, in body frames, spread evenly by area over the outer surface (what
lies inside another geom of the same body is not surface). Moving them to the world is one matrix product a batch.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np

from vecenv.libero.robot import BASE_BODY
from vecenv.libero.scene.scene import Scene

# The planned density; every entity gets at least MIN_POINTS.
POINTS_PER_ENTITY = 320
MIN_POINTS = 200
_INSIDE = 1e-4
# Points drawn for each requested point, at first and at most; those inside another geom are discarded.
_DRAWN_FIRST = 4
_DRAWN_AT_MOST = 64
_BOX_FACE_GRID = 7

_PLANE, _SPHERE, _CAPSULE, _CYLINDER, _BOX, _MESH = (
    int(kind)
    for kind in (
        mujoco.mjtGeom.mjGEOM_PLANE,
        mujoco.mjtGeom.mjGEOM_SPHERE,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        mujoco.mjtGeom.mjGEOM_BOX,
        mujoco.mjtGeom.mjGEOM_MESH,
    )
)


@dataclass(frozen=True)
class BodyPoints:
    """N points fixed to bodies: ``body`` int [N], ``pos`` and ``normal`` [N, 3] in the body's frame."""

    body: np.ndarray
    pos: np.ndarray
    normal: np.ndarray

    def world(self, xpos: np.ndarray, xmat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World positions and normals, [n, N, 3] each, for body poses [n, nbody, 3] and [n, nbody, 9]."""
        mat = xmat.reshape(*xmat.shape[:2], 3, 3)[:, self.body]
        pos = np.einsum("nkij,kj->nki", mat, self.pos) + xpos[:, self.body]
        return pos, np.einsum("nkij,kj->nki", mat, self.normal)


def entity_points(scene: Scene, name: str) -> BodyPoints:
    """Samples of one object's or fixture's surface; at least ``MIN_POINTS``."""
    geoms = colliding_geoms(scene.model, scene.entities[name].root_body)
    return sample_geoms(scene.model, geoms, POINTS_PER_ENTITY)


def colliding_geoms(model: mujoco.MjModel, body: str) -> list[int]:
    """Geoms that collide, of a body and all that hangs from it."""
    return [g for g in _subtree_geoms(model, body) if _collides(model, g)]


def scenery_points(scene: Scene, half_size: float = 1.0) -> BodyPoints:
    """Samples of what collides but is no robot, object or fixture: table and floor; planes are cut to a square."""
    model = scene.model
    roots = (BASE_BODY, *(entity.root_body for entity in scene.entities.values()))
    taken = {g for root in roots for g in _subtree_geoms(model, root)}
    geoms = [g for g in range(model.ngeom) if g not in taken and _collides(model, g)]
    return sample_geoms(model, geoms, 2 * POINTS_PER_ENTITY, plane_half_size=half_size)


def entity_corners(scene: Scene, name: str) -> BodyPoints:
    """Corners of the boxes around each geom of an entity, which bound it exactly where the geoms are boxes."""
    model = scene.model
    geoms = colliding_geoms(model, scene.entities[name].root_body)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    local = [model.geom_aabb[g, :3] + signs * model.geom_aabb[g, 3:] for g in geoms]
    pos = [points @ _mat(model.geom_quat[g]).T + model.geom_pos[g] for g, points in zip(geoms, local, strict=True)]
    body = np.repeat(model.geom_bodyid[geoms], len(signs))
    stacked = np.concatenate(pos)
    return BodyPoints(body, stacked, np.zeros_like(stacked))


def box_samples(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A grid on the six faces of axis-aligned boxes, the cheap approximation of a surface that some planners use.

    Args:
        low, high: corners, metres, [n, 3].

    Returns:
        points and outward normals, [n, 294, 3] each.
    """
    ticks = np.linspace(0, 1, _BOX_FACE_GRID)
    u, v = (axis.ravel() for axis in np.meshgrid(ticks, ticks, indexing="ij"))
    unit, normal = [], []
    for axis in range(3):
        for side in (0.0, 1.0):
            points = np.insert(np.stack([u, v], 1), axis, side, axis=1)
            unit.append(points)
            normal.append(np.tile(np.eye(3)[axis] * (2 * side - 1), (len(points), 1)))
    points = low[:, None] + np.concatenate(unit) * (high - low)[:, None]
    return points, np.broadcast_to(np.concatenate(normal), points.shape).copy()


def sample_geoms(
    model: mujoco.MjModel, geoms: Iterable[int], count: int, *, plane_half_size: float = 1.0
) -> BodyPoints:
    """Spread about ``count`` points over the outer surface of geoms; each body is a union of its geoms."""
    geoms = list(geoms)
    rng = np.random.default_rng(0)
    areas = np.array([_area(model, g, plane_half_size) for g in geoms])
    drawn = _DRAWN_FIRST * count
    while True:
        counts = np.ceil(drawn * areas / areas.sum()).astype(int)
        parts = [_sample_outer(model, g, geoms, n, rng, plane_half_size) for g, n in zip(geoms, counts, strict=True)]
        pos = np.concatenate([part[0] for part in parts])
        if len(pos) >= count or drawn > _DRAWN_AT_MOST * count:
            break
        drawn *= 2
    normal = np.concatenate([part[1] for part in parts])
    body = np.repeat(model.geom_bodyid[geoms], [len(part[0]) for part in parts])
    chosen = np.sort(rng.choice(len(pos), min(count, len(pos)), replace=False))
    return BodyPoints(body[chosen], pos[chosen], normal[chosen])


def _sample_outer(
    model: mujoco.MjModel, geom: int, geoms: list[int], count: int, rng: np.random.Generator, plane_half_size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Those of ``count`` points of a geom's surface that are not inside its siblings, body frame, and their normals."""
    local, normal = _sample_primitive(model, geom, count, rng, plane_half_size)
    mat = _mat(model.geom_quat[geom])
    pos, normal = local @ mat.T + model.geom_pos[geom], normal @ mat.T
    outer = np.ones(len(pos), bool)
    for other in geoms:
        if other != geom and model.geom_bodyid[other] == model.geom_bodyid[geom]:
            outer &= ~_inside(model, other, pos)
    return pos[outer], normal[outer]


def _inside(model: mujoco.MjModel, geom: int, pos: np.ndarray) -> np.ndarray:
    """Whether body-frame points lie inside a geom by more than a tenth of a millimetre."""
    p = (pos - model.geom_pos[geom]) @ _mat(model.geom_quat[geom])
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == _BOX:
        return (np.abs(p) < size - _INSIDE).all(axis=1)
    radial = np.linalg.norm(p[:, :2], axis=1)
    if kind == _CYLINDER:
        return (radial < size[0] - _INSIDE) & (np.abs(p[:, 2]) < size[1] - _INSIDE)
    if kind in (_SPHERE, _CAPSULE):
        half = size[1] if kind == _CAPSULE else 0.0
        core = np.concatenate([p[:, :2], (p[:, 2:] - np.clip(p[:, 2:], -half, half))], axis=1)
        return np.linalg.norm(core, axis=1) < size[0] - _INSIDE
    return np.zeros(len(p), bool)


def _area(model: mujoco.MjModel, geom: int, plane_half_size: float) -> float:
    """Area of a geom's surface, square metres."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == _BOX:
        return float(8 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0]))
    if kind == _PLANE:
        return 4 * plane_half_size**2
    if kind in (_SPHERE, _CAPSULE, _CYLINDER):
        return sum(_round_areas(size[0], _half_length(model, geom), flat_ends=kind == _CYLINDER))
    if kind == _MESH:
        return float(np.linalg.norm(_face_normals(_mesh_corners(model, geom)), axis=1).sum() / 2)
    raise ValueError(f"geom {model.geom(geom).name!r}: surface sampling does not know geom type {kind}")


def _half_length(model: mujoco.MjModel, geom: int) -> float:
    return 0.0 if model.geom_type[geom] == _SPHERE else float(model.geom_size[geom, 1])


def _sample_primitive(
    model: mujoco.MjModel, geom: int, count: int, rng: np.random.Generator, plane_half_size: float
) -> tuple[np.ndarray, np.ndarray]:
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == _BOX:
        return _sample_box(size, count, rng)
    if kind == _PLANE:
        flat = rng.uniform(-plane_half_size, plane_half_size, (count, 3)) * [1, 1, 0]
        return flat, np.tile([0.0, 0.0, 1.0], (count, 1))
    if kind == _MESH:
        return _sample_mesh(_mesh_corners(model, geom), count, rng)
    return _sample_round(size[0], _half_length(model, geom), count, rng, flat_ends=kind == _CYLINDER)


def _sample_box(size: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, count, p=areas / areas.sum())
    side = rng.choice([-1.0, 1.0], count)
    pos = rng.uniform(-1, 1, (count, 3))
    pos[np.arange(count), axis] = side
    normal = np.zeros((count, 3))
    normal[np.arange(count), axis] = side
    return pos * size, normal


def _round_areas(radius: float, half: float, *, flat_ends: bool) -> tuple[float, float]:
    """Areas of the side and of both ends of a sphere, capsule or cylinder."""
    return 4 * np.pi * radius * half, 2 * np.pi * radius**2 * (1 if flat_ends else 2)


def _sample_round(
    radius: float, half: float, count: int, rng: np.random.Generator, *, flat_ends: bool
) -> tuple[np.ndarray, np.ndarray]:
    """A sphere, capsule or cylinder about z."""
    side_area, end_area = _round_areas(radius, half, flat_ends=flat_ends)
    on_side = rng.uniform(size=count) < side_area / (side_area + end_area)
    angle = rng.uniform(0, 2 * np.pi, count)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], 1)
    sign = rng.choice([-1.0, 1.0], count)
    z_axis = np.array([0.0, 0.0, 1.0])
    if flat_ends:
        end_pos = ring * (radius * np.sqrt(rng.uniform(size=(count, 1)))) + (sign * half)[:, None] * z_axis
        end_normal = sign[:, None] * z_axis
    else:
        height = rng.uniform(size=(count, 1))
        end_normal = ring * np.sqrt(1 - height**2) + sign[:, None] * height * z_axis
        end_pos = radius * end_normal + (sign * half)[:, None] * z_axis
    side_pos = radius * ring + (rng.uniform(-half, half, count) if half else np.zeros(count))[:, None] * z_axis
    pick = on_side[:, None]
    return np.where(pick, side_pos, end_pos), np.where(pick, ring, end_normal)


def _mesh_corners(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Corners of the triangles of a geom's mesh, [n, 3, 3]."""
    mesh = model.geom_dataid[geom]
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]].astype(float)
    return vertices[model.mesh_face[face : face + model.mesh_facenum[mesh]]]


def _face_normals(corners: np.ndarray) -> np.ndarray:
    """Normals of triangles, twice as long as their area, [n, 3]."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _sample_mesh(corners: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    normal = _face_normals(corners)
    length = np.linalg.norm(normal, axis=1)
    chosen = rng.choice(len(corners), count, p=length / length.sum())
    u = np.sort(rng.uniform(size=(count, 2)), axis=1)
    weights = np.stack([u[:, 0], u[:, 1] - u[:, 0], 1 - u[:, 1]], 1)
    return (weights[:, :, None] * corners[chosen]).sum(1), normal[chosen] / length[chosen, None]


def _subtree_geoms(model: mujoco.MjModel, body: str) -> list[int]:
    root = model.body(body).id
    inside = np.zeros(model.nbody, bool)
    for index in range(model.nbody):
        inside[index] = index == root or (index > 0 and inside[model.body_parentid[index]])
    return [g for g in range(model.ngeom) if inside[model.geom_bodyid[g]]]


def _collides(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])


def _mat(quat: np.ndarray) -> np.ndarray:
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, quat)
    return mat.reshape(3, 3)
