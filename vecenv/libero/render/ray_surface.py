"""What a surface looks like where a ray hits it: its normal, blended as GL blends it, and its filtered texture.

In: a hit, and how far a step of one pixel moves along the surface. Out: device functions for the normal that light is
computed with, and for the colour of the texture, averaged over about a pixel: GL picks the level of a texture's mipmap
by how many texels a step of one pixel crosses, and so does ``make_texel``. ``mipmapped`` makes such textures.
"""

# Warp tells variables from constants by calls such as `float(0.0)`, and knows `wp.static` only alone in a test.
# ruff: noqa: UP018, RUF046, SIM102
# Type checkers know neither its arrays nor its arithmetic.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import warp as wp

from vecenv.libero.physics.private import warp_render
from vecenv.libero.render.flatten import PALETTE
from vecenv.libero.render.ray_types import Footprint, Geoms, Hit, Materials, Meshes
from vecenv.libero.render.surfaces import next_level

_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
# MuJoCo lights a corner by its triangle's normal where its own is further away than this (a cosine; mjr_uploadMesh).
_LEAST_COSINE = wp.constant(0.8)

_texture_plane = warp_render._texture_plane
_texture_sphere = warp_render._texture_sphere_ellipsoid
_texture_capsule = warp_render._texture_capsule
_texture_cylinder = warp_render._texture_cylinder
_texture_box = warp_render._texture_box
_texture_mesh = warp_render._texture_mesh


class _Mipmap(wp.Texture2D):
    """A texture whose levels are those of GL; Warp's own differ where a side is odd."""

    def _generate_mipmap_chain(self, data_np: np.ndarray) -> list[np.ndarray]:
        levels = [data_np]
        while len(levels) < self._num_mip_levels:
            levels.append(np.rint(next_level(levels[-1])).astype(data_np.dtype))
        return levels


def mipmapped(model: mujoco.MjModel) -> list[wp.Texture2D]:
    """The textures of a model with all levels of their mipmaps, except the palette, whose texels are no image."""
    found = []
    for index in range(model.ntex):
        height, width, channels = model.tex_height[index], model.tex_width[index], model.tex_nchannel[index]
        start = model.tex_adr[index]
        pixels = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)
        padded = np.full((height, width, 4), 255, np.uint8)
        padded[..., :channels] = pixels
        levels = 1 if model.texture(index).name == PALETTE else 0
        found.append(_Mipmap(padded, address_mode=wp.TextureAddressMode.WRAP, num_mip_levels=levels))
    return found


@wp.func
def footprint_on(surface_normal: wp.vec3, direction: wp.vec3, step: Footprint, depth: float) -> Footprint:
    """How far steps of one pixel move the point where a ray meets a plane.

    Args:
        surface_normal, direction: of the plane and the ray.
        step: the steps at a depth of one metre.
        depth: of the point, metres from the camera's plane.
    """
    slope = wp.dot(surface_normal, direction)
    slope = wp.where(slope > -1e-4, -1e-4, slope)
    right = depth * (step.right - (wp.dot(surface_normal, step.right) / slope) * direction)
    down = depth * (step.down - (wp.dot(surface_normal, step.down) / slope) * direction)
    return Footprint(right, down)


@wp.func
def _corner_normal(normal: wp.vec3, flat: wp.vec3) -> wp.vec3:
    return wp.where(wp.dot(normal, flat) < _LEAST_COSINE, flat, normal)


@wp.func
def blended_normal(geoms: Geoms, meshes: Meshes, world: int, hit: Hit) -> wp.vec3:
    """The normal that light is computed with, world frame: of a mesh, a blend of those of the triangle's corners."""
    if hit.face < 0:
        return hit.normal
    mesh = geoms.dataid[world % geoms.dataid.shape[0], hit.geom]
    turn = geoms.mat[world, hit.geom]
    flat = wp.transpose(turn) @ hit.normal
    corners = meshes.face_normal[meshes.face_start[mesh] + hit.face]
    start = meshes.normal_start[mesh]
    blend = hit.u * _corner_normal(meshes.normal[start + corners[0]], flat)
    blend += hit.v * _corner_normal(meshes.normal[start + corners[1]], flat)
    blend += (1.0 - hit.u - hit.v) * _corner_normal(meshes.normal[start + corners[2]], flat)
    return wp.normalize(turn @ blend)


@wp.func
def _moved(mesh: wp.uint64, face: int, u: float, v: float, by: wp.vec3) -> wp.vec2:
    """Barycentric coordinates, of the first two corners, after a move in the plane of a triangle."""
    origin = wp.mesh_get_point(mesh, 3 * face + 2)
    first = wp.mesh_get_point(mesh, 3 * face) - origin
    second = wp.mesh_get_point(mesh, 3 * face + 1) - origin
    normal = wp.cross(first, second)
    area = wp.max(wp.dot(normal, normal), 1e-30)
    return wp.vec2(u + wp.dot(wp.cross(by, second), normal) / area, v + wp.dot(wp.cross(first, by), normal) / area)


def make_texel(kinds: Sequence[int]) -> wp.Function:
    """A device function for the colour of a texture at a hit, filtered over a pixel.

    Args:
        kinds: the geom types that occur; the code for others is left out.
    """
    has_plane, has_sphere, has_capsule, has_ellipsoid, has_cylinder, has_box, has_mesh = (
        kind in kinds for kind in (_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH)
    )
    has_ball = has_sphere or has_ellipsoid
    has_round = has_ball or has_capsule or has_cylinder

    @wp.func
    def coordinates(
        geoms: Geoms,
        meshes: Meshes,
        world: int,
        hit: Hit,
        local: wp.vec3,
        outward: wp.vec3,
        by: wp.vec3,
        repeat: wp.vec2,
        uniform: bool,
    ) -> wp.vec2:
        """Texture coordinates of a hit, moved by ``by``, in the frame of its geom."""
        kind, there = geoms.type[hit.geom], local + by
        size = geoms.size[world % geoms.size.shape[0], hit.geom]
        uv, offset, times = wp.vec2(0.0), wp.vec2(0.0), repeat
        if wp.static(has_mesh):
            if kind == wp.static(_MESH):
                mesh = geoms.dataid[world % geoms.dataid.shape[0], hit.geom]
                place = _moved(geoms.mesh_bvh[mesh], hit.face, hit.u, hit.v, by)
                uv, offset, times = _texture_mesh(
                    meshes.face_start,
                    there,
                    size,
                    repeat,
                    uniform,
                    hit.face,
                    mesh,
                    place[0],
                    place[1],
                    meshes.face_texcoord,
                    meshes.texcoord,
                    meshes.texcoord_start,
                )
        if wp.static(has_plane):
            if kind == wp.static(_PLANE):
                uv, offset, times = _texture_plane(there, size, repeat, uniform)
        if wp.static(has_box):
            if kind == wp.static(_BOX):
                uv, offset, times = _texture_box(there, outward, size, repeat, uniform)
        if wp.static(has_ball):
            if kind == wp.static(_SPHERE) or kind == wp.static(_ELLIPSOID):
                uv, offset, times = _texture_sphere(there, size, repeat, uniform, kind == wp.static(_SPHERE))
        if wp.static(has_cylinder):
            if kind == wp.static(_CYLINDER):
                uv, offset, times = _texture_cylinder(there, outward, size, repeat, uniform)
        if wp.static(has_capsule):
            if kind == wp.static(_CAPSULE):
                uv, offset, times = _texture_capsule(there, size, repeat, uniform)
        return wp.cw_mul(uv, times) + offset

    @wp.func
    def without_seam(kind: int, apart: wp.vec2, repeat: wp.vec2) -> wp.vec2:
        """A difference of coordinates; where the texture around a round shape meets itself, it is no step."""
        if wp.static(has_round):
            if kind != wp.static(_PLANE) and kind != wp.static(_BOX) and kind != wp.static(_MESH):
                return wp.vec2(apart[0] - repeat[0] * wp.round(apart[0] / repeat[0]), apart[1])
        return apart

    @wp.func
    def texel(
        geoms: Geoms,
        meshes: Meshes,
        materials: Materials,
        world: int,
        hit: Hit,
        point: wp.vec3,
        material: int,
        texture: int,
        step: Footprint,
    ) -> wp.vec3:
        """Red, green, blue of a material's texture; ``step`` is how far a step of one pixel moves along the surface."""
        turn = wp.transpose(geoms.mat[world, hit.geom])
        local, outward = turn @ (point - geoms.pos[world, hit.geom]), turn @ hit.normal
        repeat = materials.repeat[world % materials.repeat.shape[0], material]
        uniform = materials.uniform[world % materials.uniform.shape[0], material]
        kind, image = geoms.type[hit.geom], materials.textures[texture]
        texels = wp.vec2(float(image.width), float(image.height))
        uv, crossed = wp.vec2(0.0), float(1.0)
        turns = int(0)
        while turns < 3:
            by = wp.vec3(0.0)
            if turns == 1:
                by = turn @ step.right
            if turns == 2:
                by = turn @ step.down
            there = coordinates(geoms, meshes, world, hit, local, outward, by, repeat, uniform)
            if turns == 0:
                uv = there
            else:
                crossed = wp.max(crossed, wp.length(wp.cw_mul(without_seam(kind, there - uv, repeat), texels)))
            turns += 1
        color = wp.texture_sample(image, uv, dtype=wp.vec4, lod=wp.log2(crossed))
        return wp.vec3(color[0], color[1], color[2])

    return texel
