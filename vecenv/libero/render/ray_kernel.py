"""The Warp kernel that traces one ray per thread, in place of MuJoCo Warp's own, with the light of GL.

In: a render context of MuJoCo Warp and the model it is of. Out: a kernel with the arguments that MuJoCo Warp's renderer
launches its own with; it packs them into the structs of ``ray_types``. What differs from MuJoCo Warp's kernel:

* Light is limited to 1, highlights included, before the texture is applied. (MuJoCo Warp limits the product and adds
  highlights in white.) ``ray_light`` computes the light; no light casts shadows.
* A reflecting plane, or the upper face of a reflecting box, shows the scene mirrored, added to its own colour.
* What is transparent is blended with what is behind it; masks and depths show the transparent surface alone.
* The palette of untextured meshes (``vecenv.libero.render.scenery``) holds their colours, so it is applied before the
  limit.

Three arguments have another meaning than in MuJoCo Warp. Cameras come in the order of the images, by pose; ``cam_fovy``
is how much wider each sees than the context's camera (a ratio of tangents of half the field of view). The headlight is
one of the lights, of type ``HEADLIGHT``. And ``geom_rgba`` is the colour that geoms are drawn in, their materials'
included.

The kernel is compiled with a bound on the registers of a thread: without it the compiler uses so many that a GPU can
keep only an eighth of its threads ready, and rays wait for memory.
"""

# Warp tells variables from constants by calls such as `float(0.0)`, and knows `wp.static` only alone in a test.
# ruff: noqa: UP018, RUF046, SIM102
# Type checkers know neither its arrays nor its arithmetic.
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

from vecenv.libero.physics.private import pack_rgba_to_uint32, warp_render
from vecenv.libero.render.flatten import PALETTE
from vecenv.libero.render.options import RenderError
from vecenv.libero.render.ray_light import arriving_light
from vecenv.libero.render.ray_shapes import make_nearest
from vecenv.libero.render.ray_types import Cameras, Geoms, Hit, Images, Lights, Materials, Ray, Surface

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


def make_kernel(model: mujoco.MjModel, context: RenderContext, registers: int) -> wp.Kernel:
    """The kernel.

    Args:
        model: the scenery's model.
        context: its render context.
        registers: most registers of a thread on a GPU; 0 leaves it to the compiler.

    Raises:
        RenderError: this version of MuJoCo Warp gives its renderer other arguments than the one this was written for.
    """
    kernel = _kernel(model, context, {"cuda_max_registers": registers} if registers else {})
    expected = warp_render._build_megakernel(SimpleNamespace(nlight=model.nlight), context)
    names = [[arg.label for arg in each.adj.args] for each in (kernel, expected)]
    if names[0] != names[1]:
        changed = sorted(set(names[0]) ^ set(names[1])) or "their order"
        raise RenderError(f"mujoco-mjx {mujoco.__version__} renders with other arguments than 3.17: {changed}")
    return kernel


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
    sample_texture = warp_render._make_sample_texture(kinds)

    @wp.func
    def shade(
        geoms: Geoms,
        materials: Materials,
        lights: Lights,
        world: int,
        hit: Hit,
        point: wp.vec3,
        material: int,
        rgb: wp.vec3,
        facing: wp.vec3,
        direction: wp.vec3,
    ) -> wp.vec3:
        own = rgb
        texel = wp.vec3(1.0)
        emission, specular, shininess = float(0.0), float(0.5), float(0.5)
        if material >= 0:
            emission = materials.emission[world % materials.emission.shape[0], material]
            specular = materials.specular[world % materials.specular.shape[0], material]
            shininess = materials.shininess[world % materials.shininess.shape[0], material]
            texture = materials.texture_id[world % materials.texture_id.shape[0], material, wp.static(_RGB)]
            if texture >= 0:
                texel = sample_texture(
                    geoms.type,
                    materials.mesh_face_start,
                    hit.geom,
                    geoms.size[world % geoms.size.shape[0], hit.geom],
                    materials.repeat[world % materials.repeat.shape[0], material],
                    materials.uniform[world % materials.uniform.shape[0], material],
                    materials.textures[texture],
                    geoms.pos[world, hit.geom],
                    geoms.mat[world, hit.geom],
                    materials.mesh_face_texcoord,
                    materials.mesh_texcoord,
                    materials.mesh_texcoord_start,
                    point,
                    hit.normal,
                    hit.u,
                    hit.v,
                    hit.face,
                    geoms.dataid[world % geoms.dataid.shape[0], hit.geom],
                )
                if texture == wp.static(palette):
                    own = wp.cw_mul(own, texel)
                    texel = wp.vec3(1.0)
        surface = Surface(point, hit.normal, -direction, shininess)
        light, shine = arriving_light(lights, world, facing, surface)
        light += wp.vec3(emission)
        lit = wp.cw_mul(own, light) + specular * shine
        return wp.cw_mul(wp.min(lit, wp.vec3(1.0)), texel)

    return shade


def _make_trace(model: mujoco.MjModel, context: RenderContext) -> wp.Function:
    """A device function that follows the ray of one pixel and writes its colour, depth and geom."""
    kinds, palette = context.geom_ray_types, _palette(model)
    nearest = make_nearest(kinds, bool(context.enable_backface_culling))
    shade, mirror_share = _make_shade(kinds, palette), _make_mirror_share(mirrors(model))
    pixels, far = int(np.prod(context.cam_res.numpy()[0])), float(context.zfar)
    passes = 1 + min(len(mirrors(model)), 1) + (_MAX_TRANSPARENT if _is_transparent(model) else 0)
    supersampled = context.samples_per_pixel > 1
    has_rgb, has_depth, has_seg = (
        bool(flags.numpy().all()) for flags in (context.render_rgb, context.render_depth, context.render_seg)
    )

    @wp.func
    def trace_ray(
        geoms: Geoms, materials: Materials, lights: Lights, cameras: Cameras, images: Images, world: int, pixel: int
    ):
        camera = pixel // wp.static(pixels)
        ahead = cameras.rays[cameras.first_ray + pixel]
        wider = cameras.width[world % cameras.width.shape[0], camera]
        ahead = wp.normalize(wp.vec3(wider * ahead[0], wider * ahead[1], ahead[2]))
        turn = cameras.mat[world, camera]
        facing = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
        ray = Ray(cameras.pos[world, camera], turn @ ahead, wp.static(far) / wp.max(-ahead[2], 1e-6))
        seen = wp.vec3(0.0)
        share, through = float(1.0), float(1.0)
        step = int(0)
        while step < wp.static(passes):
            hit = nearest(geoms, world, ray)
            color, material = wp.vec4(1.0), int(-1)
            if hit.geom >= 0:
                color = geoms.rgba[world % geoms.rgba.shape[0], hit.geom]
                material = geoms.matid[world % geoms.matid.shape[0], hit.geom]
            solid = 1.0 - (1.0 - color[3]) * (1.0 - color[3])  # MuJoCo draws what is transparent twice
            if cameras.first_ray == 0 and step == 0:
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
                shaded = shade(geoms, materials, lights, world, hit, point, material, own, facing, ray.direction)
                seen += (through * solid) * shaded
            if wp.static(passes > 1):
                if hit.geom >= 0 and color[3] < 1.0:
                    through *= 1.0 - solid
                    ray.origin = point + _OFFSET * ray.direction
                    ray.reach -= hit.distance + _OFFSET
                elif hit.geom >= 0:
                    share *= mirror_share(hit.geom)
                    upright = geoms.mat[world, hit.geom]
                    up = wp.vec3(upright[0, 2], upright[1, 2], upright[2, 2])
                    if share == 0.0 or wp.dot(hit.normal, up) < _UPPER:
                        step = wp.static(passes)
                    ray.origin = point + _OFFSET * hit.normal
                    ray.direction = ray.direction - 2.0 * wp.dot(ray.direction, hit.normal) * hit.normal
                    ray.reach = wp.static(far)
        if wp.static(has_rgb):
            seen = 255.0 * wp.min(seen, wp.vec3(1.0))
            if wp.static(supersampled):
                images.sums[world, pixel] += seen
            else:
                seen += wp.vec3(0.5)  # packing truncates
                images.rgb[world, pixel] = pack_rgba_to_uint32(seen[0], seen[1], seen[2], 255.0)

    return trace_ray


def _kernel(model: mujoco.MjModel, context: RenderContext, options: dict[str, int]) -> wp.Kernel:
    """The kernel with the arguments of MuJoCo Warp's own, in its order; many are not used here."""
    trace_ray = _make_trace(model, context)

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options={"fast_math": bool(context.use_fast_math)},
        **options,
    )
    def rays(
        geom_type: wp.array[int],
        geom_dataid: wp.array2d[int],
        geom_matid: wp.array2d[int],
        geom_size: wp.array2d[wp.vec3],
        geom_rgba: wp.array2d[wp.vec4],
        cam_projection: wp.array[int],
        cam_fovy: wp.array2d[float],
        cam_sensorsize: wp.array[wp.vec2],
        cam_intrinsic: wp.array2d[wp.vec4],
        light_type: wp.array2d[int],
        light_castshadow: wp.array2d[bool],
        light_active: wp.array2d[bool],
        light_attenuation: wp.array2d[wp.vec3],
        light_cutoff: wp.array2d[float],
        light_exponent: wp.array2d[float],
        light_ambient: wp.array2d[wp.vec3],
        light_diffuse: wp.array2d[wp.vec3],
        light_specular: wp.array2d[wp.vec3],
        flex_vertadr: wp.array[int],
        flex_edge: wp.array[wp.vec2i],
        flex_radius: wp.array[float],
        mesh_faceadr: wp.array[int],
        mesh_normaladr: wp.array[int],
        mesh_normal: wp.array[wp.vec3],
        mat_texid: wp.array3d[int],
        mat_texuniform: wp.array2d[bool],
        mat_texrepeat: wp.array2d[wp.vec2],
        mat_emission: wp.array2d[float],
        mat_specular: wp.array2d[float],
        mat_shininess: wp.array2d[float],
        mat_rgba: wp.array2d[wp.vec4],
        geom_xpos_in: wp.array2d[wp.vec3],
        geom_xmat_in: wp.array2d[wp.mat33],
        cam_xpos_in: wp.array2d[wp.vec3],
        cam_xmat_in: wp.array2d[wp.mat33],
        light_xpos_in: wp.array2d[wp.vec3],
        light_xdir_in: wp.array2d[wp.vec3],
        flexvert_xpos_in: wp.array2d[wp.vec3],
        nrender: int,
        use_shadows: bool,
        bvh_ngeom: int,
        bvh_nflexgeom: int,
        cam_res: wp.array[wp.vec2i],
        cam_id_map: wp.array[int],
        ray: wp.array[wp.vec3],
        ray_offset: wp.array[wp.vec3],
        ray_base: int,
        rgb_adr: wp.array[int],
        depth_adr: wp.array[int],
        seg_adr: wp.array[int],
        render_rgb: wp.array[bool],
        render_depth: wp.array[bool],
        render_seg: wp.array[bool],
        bvh_id: wp.uint64,
        group_root: wp.array[int],
        flex_bvh_id: wp.array[wp.uint64],
        flex_group_root: wp.array2d[int],
        enabled_geom_ids: wp.array[int],
        mesh_bvh_id: wp.array[wp.uint64],
        mesh_facetexcoord: wp.array[wp.vec3i],
        mesh_facenormal: wp.array[wp.vec3i],
        mesh_texcoord: wp.array[wp.vec2],
        mesh_texcoord_offsets: wp.array[int],
        hfield_bvh_id: wp.array[wp.uint64],
        flex_rgba: wp.array[wp.vec4],
        flex_geom_flexid: wp.array[int],
        flex_geom_edgeid: wp.array[int],
        skybox_tex_id: wp.array[int],
        skybox_face_width: wp.array[int],
        textures: wp.array[wp.Texture2D],
        splat_position: wp.array[wp.vec3],
        splat_rotation: wp.array[wp.quat],
        splat_scale: wp.array[wp.vec3],
        splat_rgba: wp.array[wp.vec4],
        splat_bvh_id: wp.uint64,
        splat_group_root: wp.array[int],
        rgb_out: wp.array2d[wp.uint32],
        aa_accum_out: wp.array2d[wp.vec3],
        depth_out: wp.array2d[float],
        seg_out: wp.array2d[wp.vec2i],
    ):
        world, pixel = wp.tid()
        geoms = Geoms(
            geom_type,
            geom_dataid,
            geom_matid,
            geom_size,
            geom_rgba,
            geom_xpos_in,
            geom_xmat_in,
            bvh_id,
            group_root,
            enabled_geom_ids,
            bvh_ngeom,
            mesh_bvh_id,
        )
        materials = Materials(
            mat_texid,
            mat_texuniform,
            mat_texrepeat,
            mat_emission,
            mat_specular,
            mat_shininess,
            textures,
            mesh_faceadr,
            mesh_facetexcoord,
            mesh_texcoord,
            mesh_texcoord_offsets,
        )
        lights = Lights(
            light_type,
            light_active,
            light_attenuation,
            light_cutoff,
            light_exponent,
            light_ambient,
            light_diffuse,
            light_specular,
            light_xpos_in,
            light_xdir_in,
        )
        cameras = Cameras(cam_xpos_in, cam_xmat_in, cam_fovy, ray, ray_base)
        images = Images(rgb_out, aa_accum_out, depth_out, seg_out)
        trace_ray(geoms, materials, lights, cameras, images, world, pixel)

    return rays
