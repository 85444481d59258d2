"""The Warp kernel that traces one ray per thread, in place of MuJoCo Warp's own, with the light of GL.

In: a render context of MuJoCo Warp and the model it is of. Out: a kernel with the arguments that MuJoCo Warp's renderer
launches its own with; it packs them into the structs of ``ray_types``. What differs from MuJoCo Warp's kernel:

* Light is limited to 1, highlights included, before the texture is applied. (MuJoCo Warp limits the product and adds
  highlights in white.) ``ray_light`` computes the light; no light casts shadows.
* A reflecting plane, or the upper face of a reflecting box, shows the scene mirrored, added to its own colour.
* What is transparent is blended with what is behind it; masks and depths show the transparent surface alone.
* The palette of untextured meshes (``vecenv.libero.render.scenery``) holds their colours, so it is applied before the
  limit.
* Textures are averaged over a pixel, through mipmaps as in GL (``ray_surface``).
* Pixels that differ from their neighbours get more rays (``ray_passes``).

Some arguments have another meaning than in MuJoCo Warp. Cameras come in the order of the images, by pose; ``cam_fovy``
is how much wider each sees than the context's camera (a ratio of tangents of half the field of view), and
``cam_sensorsize`` the size of a pixel of the context's camera, 1 m away. The headlight is one of the lights, of type
``HEADLIGHT``. ``geom_rgba`` is the colour that geoms are drawn in, their materials' included. And there are no flexes:
``flex_group_root`` is the queue of ``ray_passes``.

The kernel is compiled with a bound on the registers of a thread: without it the compiler uses so many that a GPU can
keep only an eighth of its threads ready, and rays wait for memory.
"""

# Type checkers know neither its arrays nor its arithmetic.
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING

import mujoco
import warp as wp

from vecenv.libero.physics.private import warp_render
from vecenv.libero.render.options import RenderError
from vecenv.libero.render.ray_passes import make_trace
from vecenv.libero.render.ray_types import Cameras, Geoms, Images, Lights, Materials, Meshes, Scene

if TYPE_CHECKING:
    from vecenv.libero.physics.private import RenderContext


def make_kernel(
    model: mujoco.MjModel, context: RenderContext, *, tile: tuple[int, int], antialias: bool, registers: int
) -> wp.Kernel:
    """The kernel.

    Args:
        model: the scenery's model.
        context: its render context; with antialiasing it has the rays and the queue of ``ray_passes``.
        tile: rows and columns of the tiles that the context's rays and buffers are in.
        antialias: whether pixels that differ from their neighbours get more rays.
        registers: most registers of a thread on a GPU; 0 leaves it to the compiler.

    Raises:
        RenderError: this version of MuJoCo Warp gives its renderer other arguments than the one this was written for.
    """
    trace = make_trace(model, context, tile, antialias)
    kernel = _kernel(trace, bool(context.use_fast_math), {"cuda_max_registers": registers} if registers else {})
    expected = warp_render._build_megakernel(SimpleNamespace(nlight=model.nlight), context)
    names = [[arg.label for arg in each.adj.args] for each in (kernel, expected)]
    if names[0] != names[1]:
        changed = sorted(set(names[0]) ^ set(names[1])) or "their order"
        raise RenderError(f"mujoco-mjx {mujoco.__version__} renders with other arguments than 3.17: {changed}")
    return kernel


def _kernel(trace: wp.Function, fast_math: bool, options: dict[str, int]) -> wp.Kernel:
    """The kernel with the arguments of MuJoCo Warp's own, in its order; many are not used here."""

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        module_options={"fast_math": fast_math},
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
        )
        meshes = Meshes(
            mesh_faceadr,
            mesh_facenormal,
            mesh_normal,
            mesh_normaladr,
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
        cameras = Cameras(cam_xpos_in, cam_xmat_in, cam_fovy, cam_sensorsize, ray, ray_base)
        images = Images(rgb_out, aa_accum_out, depth_out, seg_out, flex_group_root)
        trace(Scene(geoms, meshes, materials, lights), cameras, images, world, pixel)

    return rays
