"""Where a ray meets the geoms of a scene: intersections with each shape, and the first one along a ray.

In: the geom types that occur and whether faces are seen from their front only. Out: ``make_nearest``'s device function,
which searches the tree of geoms for the first hit. The shapes that MuJoCo Warp intersects as GL draws them are its own;
planes, boxes and meshes differ, because GL shows no faces from behind.
"""

# Warp tells variables from constants by calls such as `float(0.0)`, and knows `wp.static` only alone in a test.
# ruff: noqa: UP018, RUF046, SIM102
# Type checkers know neither its arrays nor its arithmetic.
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import warp as wp

from vecenv.libero.physics.private import ray_capsule, ray_cylinder, ray_ellipsoid, ray_sphere
from vecenv.libero.render.ray_types import Geoms, Hit, Ray

_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
# Two distances count as equal if they differ by less than this: relative, and in metres.
_RELATIVE, _ABSOLUTE = wp.constant(1e-6), wp.constant(1e-9)
# The most faces seen from behind that a ray passes in one mesh (the pages of a book).
_MAX_BACK_FACES = wp.constant(64)
# Farther than anything, metres.
_INFINITE = wp.constant(1e10)


@wp.func
def _hit_plane(size: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> float:
    """Distance to a plane's upper face along a ray in its frame; -1 if the ray misses. A size of 0 is infinite."""
    if direction[2] >= 0.0 or origin[2] < 0.0:
        return -1.0
    distance = -origin[2] / direction[2]
    there = origin + distance * direction
    for axis in range(2):
        if size[axis] > 0.0 and wp.abs(there[axis]) > size[axis]:
            distance = -1.0
    return distance


@wp.func
def _hit_box(size: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> tuple[float, wp.vec3]:
    """Distance to a box along a ray in its frame (-1: it misses or starts inside), and the normal where it enters."""
    near, last = float(-1.0), float(1e10)
    normal = wp.vec3(0.0)
    for axis in range(3):
        slow = wp.where(wp.abs(direction[axis]) < 1e-9, 1e-9, direction[axis])
        enter, leave = (-size[axis] - origin[axis]) / slow, (size[axis] - origin[axis]) / slow
        if wp.min(enter, leave) > near:
            near = wp.min(enter, leave)
            normal = wp.vec3(0.0)
            normal[axis] = -wp.sign(slow)
        last = wp.min(last, wp.max(enter, leave))
    return wp.where(near < 0.0 or near > last, -1.0, near), normal


@wp.func
def _hit_mesh(
    mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, reach: float
) -> tuple[float, wp.vec3, float, float, int]:
    """The first face of a mesh that faces the ray: distance (-1: none), normal, barycentric coordinates, face."""
    start = float(0.0)
    tries = int(0)
    distance, u, v, sign = float(-1.0), float(0.0), float(0.0), float(0.0)
    normal = wp.vec3(0.0)
    face = int(-1)
    while tries < _MAX_BACK_FACES:
        tries += 1
        ahead = float(0.0)
        if wp.mesh_query_ray(
            mesh, origin + start * direction, direction, reach - start, ahead, u, v, sign, normal, face
        ):
            if wp.dot(normal, direction) < 0.0:
                distance = start + ahead
                tries = _MAX_BACK_FACES
            start += ahead * (1.0 + _RELATIVE) + _ABSOLUTE
        else:
            tries = _MAX_BACK_FACES
    return distance, normal, u, v, face


@wp.func
def _enter_bounds(half: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> float:
    """Distance to a geom's bounding box along a ray, 0 from inside; beyond ``_INFINITE`` if the ray misses it."""
    near, last = float(0.0), float(_INFINITE)
    for axis in range(3):
        slow = wp.where(wp.abs(direction[axis]) < 1e-9, 1e-9, direction[axis])
        one, other = (-half[axis] - origin[axis]) / slow, (half[axis] - origin[axis]) / slow
        near = wp.max(near, wp.min(one, other))
        last = wp.min(last, wp.max(one, other))
    return wp.where(near > last, 2.0 * _INFINITE, near)


@wp.func
def _identity() -> wp.mat33:
    return wp.identity(n=3, dtype=float)


def _make_hit_geom(kinds: Sequence[int], culls: bool) -> wp.Function:
    """A device function that intersects a ray with a geom of one of these types; it returns what ``_hit_mesh`` does.

    With ``culls``, faces are invisible from behind, as in GL; without, meshes show them.
    """
    has_plane, has_sphere, has_capsule, has_ellipsoid, has_cylinder, has_box, has_mesh = (
        kind in kinds for kind in (_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH)
    )

    @wp.func
    def hit_geom(
        kind: int, mesh: wp.uint64, size: wp.vec3, start: wp.vec3, ahead: wp.vec3, reach: float
    ) -> tuple[float, wp.vec3, float, float, int]:
        distance, u, v, face = float(-1.0), float(0.0), float(0.0), int(-1)
        outward = wp.vec3(0.0)
        if wp.static(has_mesh and culls):
            if kind == wp.static(_MESH):
                distance, outward, u, v, face = _hit_mesh(mesh, start, ahead, reach)
        if wp.static(has_mesh and not culls):
            if kind == wp.static(_MESH):
                sign = float(0.0)
                if not wp.mesh_query_ray(mesh, start, ahead, reach, distance, u, v, sign, outward, face):
                    distance = -1.0
                if wp.dot(outward, ahead) > 0.0:
                    outward = -outward
        if wp.static(has_box):
            if kind == wp.static(_BOX):
                distance, outward = _hit_box(size, start, ahead)
        if wp.static(has_plane):
            if kind == wp.static(_PLANE):
                distance = _hit_plane(size, start, ahead)
                outward = wp.vec3(0.0, 0.0, 1.0)
        if wp.static(has_cylinder):
            if kind == wp.static(_CYLINDER):
                distance, outward = ray_cylinder(wp.vec3(0.0), _identity(), size, start, ahead)
        if wp.static(has_sphere):
            if kind == wp.static(_SPHERE):
                distance, outward = ray_sphere(wp.vec3(0.0), size[0] * size[0], start, ahead)
        if wp.static(has_capsule):
            if kind == wp.static(_CAPSULE):
                distance, outward = ray_capsule(wp.vec3(0.0), _identity(), size, start, ahead)
        if wp.static(has_ellipsoid):
            if kind == wp.static(_ELLIPSOID):
                distance, outward = ray_ellipsoid(wp.vec3(0.0), _identity(), size, start, ahead)
        if wp.dot(outward, ahead) > 0.0:
            distance = -1.0
        return distance, outward, u, v, face

    return hit_geom


def make_nearest(kinds: Sequence[int], culls: bool) -> wp.Function:
    """A device function ``(geoms, world, ray) -> Hit`` that finds the first surface on a ray.

    Args:
        kinds: the geom types that occur; the code for others is left out.
        culls: whether faces are invisible from behind.

    Geoms are visited in the order of the tree: sorting their boxes by distance costs more than it saves.
    """
    hit_geom = _make_hit_geom(kinds, culls)

    @wp.func
    def nearest(geoms: Geoms, world: int, ray: Ray) -> Hit:
        best = float(ray.reach)
        found, face = int(-1), int(-1)
        normal = wp.vec3(0.0)
        u, v = float(0.0), float(0.0)
        item = int(0)
        first = world * geoms.num_drawn
        query = wp.bvh_query_ray(geoms.bvh, ray.origin, ray.direction, geoms.roots[world])
        while wp.bvh_query_next(query, item, best * (1.0 + _RELATIVE) + _ABSOLUTE):
            geom = geoms.drawn[item - first]
            if geoms.rgba[world % geoms.rgba.shape[0], geom][3] == 0.0:
                continue
            turn = geoms.mat[world, geom]
            start = wp.transpose(turn) @ (ray.origin - geoms.pos[world, geom])
            ahead = wp.transpose(turn) @ ray.direction
            size = geoms.size[world % geoms.size.shape[0], geom]
            kind = geoms.type[geom]
            limit = best * (1.0 + _RELATIVE) + _ABSOLUTE
            mesh = wp.uint64(0)
            if kind == wp.static(_MESH):
                if _enter_bounds(size, start, ahead) > limit:
                    continue
                mesh = geoms.mesh_bvh[geoms.dataid[world % geoms.dataid.shape[0], geom]]
            distance, outward, at_u, at_v, at_face = hit_geom(kind, mesh, size, start, ahead, limit)
            if distance >= 0.0:
                # Of surfaces at the same distance, GL shows the one that is drawn last.
                slack = _RELATIVE * wp.max(best, 1.0)
                if distance < best - slack or (distance <= best + slack and geom > found):
                    best, found, face, u, v, normal = distance, geom, at_face, at_u, at_v, outward
        if found >= 0:
            normal = wp.normalize(geoms.mat[world, found] @ normal)
        return Hit(found, best, normal, u, v, face)

    return nearest
