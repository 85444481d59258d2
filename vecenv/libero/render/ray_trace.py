"""What a ray shows: the colour of what it meets, of what that mirrors, and of what is behind what is transparent.

In: a render context of MuJoCo Warp and the model it is of. Out: ``make_follow``'s device function, which follows one
ray of a pixel from the camera on.
"""

# Warp tells variables from constants by calls such as `float(0.0)`, and knows `wp.static` only alone in a test.
# ruff: noqa: UP018, RUF046, SIM102
# Type checkers know neither its arrays nor its arithmetic.
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from vecenv.libero.render.flatten import PALETTE
from vecenv.libero.render.ray_light import arriving_light
from vecenv.libero.render.ray_shapes import make_nearest
from vecenv.libero.render.ray_surface import blended_normal, footprint_on, make_texel
from vecenv.libero.render.ray_types import Cameras, Footprint, Hit, Images, Ray, Scene, Surface

if TYPE_CHECKING:
    from vecenv.libero.physics.private import RenderContext

_MIRROR_TYPES = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_BOX)
_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
# How far from a surface the rays start that continue from it, metres; and the cosine from which a box's face counts as
# its upper one.
_OFFSET, _UPPER = wp.constant(1e-4), wp.constant(0.9)
# The most mirrors of a scene that reflect; further ones do not.
_MAX_MIRRORS = 3
# The most transparent surfaces that a ray passes before it ends.
_MAX_TRANSPARENT = 3
# MuJoCo's segmentation images name a geom by this object type.
_GEOM = wp.constant(int(mujoco.mjtObj.mjOBJ_GEOM))


def mirrors(model: mujoco.MjModel) -> list[tuple[int, float]]:
    """The geoms that MuJoCo mirrors the scene in, and the share of light that each reflects."""
    materials = [(geom, int(material)) for geom, material in enumerate(model.geom_matid) if material >= 0]
    found = [(geom, float(model.mat_reflectance[material])) for geom, material in materials]
    return [(geom, share) for geom, share in found if share > 0 and model.geom_type[geom] in _MIRROR_TYPES]


def _is_transparent(model: mujoco.MjModel) -> bool:
    """Whether a geom or material of the model lets light through."""
    return bool((model.geom_rgba[:, 3] < 1).any() or (model.mat_rgba[:, 3] < 1).any())


def _palette(model: mujoco.MjModel) -> int:
    """Index of the palette's texture; -2 if there is none."""
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXTURE, PALETTE)
    return found if found >= 0 else -2


def _make_mirror_share(reflecting: Sequence[tuple[int, float]]) -> wp.Function:
    """A device function that says which share of light a geom reflects."""
    # No loop: Warp's cache of compiled kernels does not tell apart what static expressions in loops were.
    padded = (*reflecting, *[(-1, 0.0)] * _MAX_MIRRORS)[:_MAX_MIRRORS]
    (first, first_share), (second, second_share), (third, third_share) = padded

    @wp.func
    def mirror_share(geom: int) -> float:
        share = float(0.0)
        if geom == wp.static(first):
            share = wp.static(first_share)
        if geom == wp.static(second):
            share = wp.static(second_share)
        if geom == wp.static(third):
            share = wp.static(third_share)
        return share

    return mirror_share


def _make_shade(kinds: Sequence[int], palette: int) -> wp.Function:
    """A device function for the colour of a hit, light and texture included, each channel 0 to 1.

    Args:
        kinds: the geom types that occur.
        palette: the palette's texture, see ``_palette``.
    """
    texel_at = make_texel(kinds)

    @wp.func
    def shade(
        scene: Scene,
        world: int,
        hit: Hit,
        point: wp.vec3,
        material: int,
        rgb: wp.vec3,
        facing: wp.vec3,
        direction: wp.vec3,
        step: Footprint,
    ) -> wp.vec3:
        own = rgb
        texel = wp.vec3(1.0)
        emission, specular, shininess = float(0.0), float(0.5), float(0.5)
        materials = scene.materials
        if material >= 0:
            emission = materials.emission[world % materials.emission.shape[0], material]
            specular = materials.specular[world % materials.specular.shape[0], material]
            shininess = materials.shininess[world % materials.shininess.shape[0], material]
            texture = materials.texture_id[world % materials.texture_id.shape[0], material, wp.static(_RGB)]
            if texture >= 0:
                texel = texel_at(scene.geoms, scene.meshes, materials, world, hit, point, material, texture, step)
                if texture == wp.static(palette):
                    own = wp.cw_mul(own, texel)
                    texel = wp.vec3(1.0)
        normal = blended_normal(scene.geoms, scene.meshes, world, hit)
        surface = Surface(point, normal, -direction, shininess)
        light, shine = arriving_light(scene.lights, world, facing, surface)
        light += wp.vec3(emission)
        lit = wp.cw_mul(own, light) + specular * shine
        return wp.cw_mul(wp.min(lit, wp.vec3(1.0)), texel)

    return shade


def make_follow(model: mujoco.MjModel, context: RenderContext) -> wp.Function:
    """A device function that follows a ray of one pixel and returns its colour, each channel 0 to 255.

    The ray through the middle of the pixel, ``sample`` 0, also writes the pixel's depth and geom.
    """
    kinds, palette = context.geom_ray_types, _palette(model)
    nearest = make_nearest(kinds, bool(context.enable_backface_culling))
    shade, mirror_share = _make_shade(kinds, palette), _make_mirror_share(mirrors(model))
    pixels, far = int(np.prod(context.cam_res.numpy()[0])), float(context.zfar)
    rays = int(context.total_rays)
    passes = 1 + min(len(mirrors(model)), 1) + (_MAX_TRANSPARENT if _is_transparent(model) else 0)
    has_rgb, has_depth, has_seg = (
        bool(flags.numpy().all()) for flags in (context.render_rgb, context.render_depth, context.render_seg)
    )

    @wp.func
    def follow(scene: Scene, cameras: Cameras, images: Images, world: int, pixel: int, sample: int) -> wp.vec3:
        camera = pixel // wp.static(pixels)
        ahead = cameras.rays[sample * wp.static(rays) + pixel]
        wider = cameras.width[world % cameras.width.shape[0], camera]
        ahead = wp.normalize(wp.vec3(wider * ahead[0], wider * ahead[1], ahead[2]))
        turn = cameras.mat[world, camera]
        facing = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
        ray = Ray(cameras.pos[world, camera], turn @ ahead, wp.static(far) / wp.max(-ahead[2], 1e-6))
        across = wider * cameras.pixel[camera]
        one = Footprint(turn @ wp.vec3(across[0], 0.0, 0.0), turn @ wp.vec3(0.0, across[1], 0.0))
        seen = wp.vec3(0.0)
        share, through, travelled = float(1.0), float(1.0), float(0.0)
        step = int(0)
        while step < wp.static(passes):
            hit = nearest(scene.geoms, world, ray)
            color, material = wp.vec4(1.0), int(-1)
            if hit.geom >= 0:
                color = scene.geoms.rgba[world % scene.geoms.rgba.shape[0], hit.geom]
                material = scene.geoms.matid[world % scene.geoms.matid.shape[0], hit.geom]
            solid = 1.0 - (1.0 - color[3]) * (1.0 - color[3])  # MuJoCo draws what is transparent twice
            if sample == 0 and step == 0:
                if wp.static(has_depth):
                    images.depth[world, pixel] = wp.where(hit.geom < 0, 0.0, -hit.distance * ahead[2])
                if wp.static(has_seg):
                    if hit.geom >= 0:
                        images.segmentation[world, pixel] = wp.vec2i(hit.geom, _GEOM)
            step += 1
            point = ray.origin + ray.direction * hit.distance
            if hit.geom < 0:
                step = wp.static(passes)
            elif wp.static(has_rgb):
                own = share * wp.vec3(color[0], color[1], color[2])
                moved = footprint_on(hit.normal, ray.direction, one, -(travelled + hit.distance) * ahead[2])
                shaded = shade(scene, world, hit, point, material, own, facing, ray.direction, moved)
                seen += (through * solid) * shaded
            if wp.static(passes > 1):
                travelled += hit.distance
                if hit.geom >= 0 and color[3] < 1.0:
                    through *= 1.0 - solid
                    ray.origin = point + _OFFSET * ray.direction
                    ray.reach -= hit.distance + _OFFSET
                elif hit.geom >= 0:
                    share *= mirror_share(hit.geom)
                    upright = scene.geoms.mat[world, hit.geom]
                    up = wp.vec3(upright[0, 2], upright[1, 2], upright[2, 2])
                    if share == 0.0 or wp.dot(hit.normal, up) < _UPPER:
                        step = wp.static(passes)
                    ray.origin = point + _OFFSET * hit.normal
                    ray.direction = ray.direction - 2.0 * wp.dot(ray.direction, hit.normal) * hit.normal
                    ray.reach = wp.static(far)
                    one.right -= 2.0 * wp.dot(one.right, hit.normal) * hit.normal
                    one.down -= 2.0 * wp.dot(one.down, hit.normal) * hit.normal
        return 255.0 * wp.min(seen, wp.vec3(1.0))

    return follow
