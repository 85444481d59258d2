"""What a ray shows: the program that MuJoCo Warp's renderer runs for every ray, with GL's light in place of its own.

In: a render context of MuJoCo Warp and the model that it is of. Out: a Warp kernel that takes the renderer's place and
arguments.

* Light is limited to 1, highlights included, before the texture is applied, and a lamp's ambient light fades with the
  rest of it. (MuJoCo Warp limits the product and adds highlights in white.)
* The upper face of a box, or a plane, whose material reflects shows the scene mirrored, added to its own colour.
* What is transparent is blended with what is behind it; masks and depths show it alone.
* The palette of untextured meshes (``vecenv.libero.render.scenery``) holds their colours, so it is applied before the
limit.

Three arguments mean other things than in MuJoCo Warp. Cameras come in the order of the images, by pose; ``cam_fovy`` is
how much wider each sees than the context's camera (a ratio of tangents of half the field of view). The headlight is one
of the lamps, of type ``HEADLIGHT``. And ``geom_rgba`` is what geoms are drawn in, their materials' colours included.

No light casts shadows. The kernel is made with a bound on the registers of a thread: without it the compiler takes so
many that a GPU can keep only an eighth of its threads ready, and rays wait for memory.
"""

# Warp tells variables from constants by calls such as `float(0.0)`, and knows `wp.static` only alone in a test.
# ruff: noqa: UP018, RUF046, SIM102
# Type checkers know neither its arrays nor its arithmetic.
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party.mujoco_warp._src import render as theirs
from mujoco.mjx.third_party.mujoco_warp._src.ray import ray_capsule, ray_cylinder, ray_ellipsoid, ray_sphere
from mujoco.mjx.third_party.mujoco_warp._src.render_util import pack_rgba_to_uint32

from vecenv.libero.render.options import RenderError
from vecenv.libero.render.scenery import PALETTE

_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
_MIRRORS = _PLANE, _BOX
_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
# How far from a mirror its rays start, metres; and the cosine from which a box's face counts as its upper one.
_OFF, _UPPER = wp.constant(1e-4), wp.constant(0.9)
# Two distances, relative and in metres, that count as one; and as many faces from behind a ray may pass in a mesh (the
# pages of a book).
_NEARLY, _HARDLY, _TRIES = wp.constant(1e-6), wp.constant(1e-9), wp.constant(64)
# Mirrors of a scene; further ones are dull.
_MOST_MIRRORS = 3
# As many panes a ray passes before it ends.
_MOST_PANES = 3
_DIRECTIONAL = wp.constant(int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL))
_SPOT = wp.constant(int(mujoco.mjtLightType.mjLIGHT_SPOT))
# A lamp of this type shines where the camera looks.
HEADLIGHT = 100
_HEADLIGHT = wp.constant(HEADLIGHT)
# What MuJoCo's segmentation calls a geom.
_GEOM = wp.constant(int(mujoco.mjtObj.mjOBJ_GEOM))
# Farther than anything, metres.
_NEVER = wp.constant(1e10)
# What a shininess of 1 is as an exponent, in GL.
_SHARPEST = wp.constant(128.0)


def mirrors(model: mujoco.MjModel) -> list[tuple[int, float]]:
    """Geoms that MuJoCo mirrors the scene in, and how much of it."""
    materials = [(geom, int(material)) for geom, material in enumerate(model.geom_matid) if material >= 0]
    found = [(geom, float(model.mat_reflectance[material])) for geom, material in materials]
    return [(geom, share) for geom, share in found if share > 0 and model.geom_type[geom] in _MIRRORS]


def make_kernel(model: mujoco.MjModel, context: Any, registers: int) -> wp.Kernel:
    """The kernel.

    Args:
        model: the scenery's model.
        context: its render context, ``mujoco_warp.RenderContext``.
        registers: most registers of a thread on a GPU; 0 leaves it to the compiler.

    Raises:
        RenderError: this version of MuJoCo Warp gives its renderer other arguments than the one this was written for.
    """
    made = _kernel(model, context, {"cuda_max_registers": registers} if registers else {})
    expected = theirs._build_megakernel(SimpleNamespace(nlight=model.nlight), context)
    names = [[arg.label for arg in kernel.adj.args] for kernel in (made, expected)]
    if names[0] != names[1]:
        changed = sorted(set(names[0]) ^ set(names[1])) or "their order"
        raise RenderError(f"mujoco-mjx {mujoco.__version__} renders with other arguments than 3.17: {changed}")
    return made


@wp.func
def _strength(
    kind: int,
    towards: wp.vec3,
    distance: float,
    aim: wp.vec3,
    fading: wp.vec3,
    cutoff: float,
    exponent: float,
) -> float:
    """How much of a lamp's light arrives, from its distance and, of a spot, its aim."""
    if kind == _DIRECTIONAL:
        return 1.0
    strength = 1.0 / (fading[0] + distance * (fading[1] + distance * fading[2]))
    if kind == _SPOT:
        cosine = -wp.dot(towards, aim)
        if cosine < wp.cos(wp.radians(cutoff)):
            return 0.0
        if exponent != 0.0:
            strength *= wp.pow(wp.max(cosine, 0.0), exponent)
    return strength


@wp.func
def _highlight(normal: wp.vec3, towards: wp.vec3, back: wp.vec3, shininess: float) -> float:
    """How much of a light a surface mirrors to the viewer; everywhere the same where it has no shininess."""
    if shininess == 0.0:
        return 1.0
    cosine = wp.max(0.0, wp.dot(normal, wp.normalize(towards + back)))
    return wp.pow(cosine, shininess * _SHARPEST)


@wp.func
def _meet_plane(size: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> float:
    """How far a plane's upper face is along a ray in its frame; -1 if the ray misses. Sizes of 0 have no end."""
    if direction[2] >= 0.0 or origin[2] < 0.0:
        return -1.0
    distance = -origin[2] / direction[2]
    there = origin + distance * direction
    for axis in range(2):
        if size[axis] > 0.0 and wp.abs(there[axis]) > size[axis]:
            distance = -1.0
    return distance


@wp.func
def _meet_box(size: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> tuple[float, wp.vec3]:
    """How far a box is along a ray in its frame, and the face that the ray enters by; -1 if it misses or is inside."""
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
def _meet_mesh(
    mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, reach: float
) -> tuple[float, wp.vec3, float, float, int]:
    """How far a mesh's first face that faces the ray is, its normal, barycentric coordinates, and face; -1: none."""
    start = float(0.0)
    tries = int(0)
    distance, u, v, sign = float(-1.0), float(0.0), float(0.0), float(0.0)
    normal = wp.vec3(0.0)
    face = int(-1)
    while tries < _TRIES:
        tries += 1
        ahead = float(0.0)
        if wp.mesh_query_ray(
            mesh, origin + start * direction, direction, reach - start, ahead, u, v, sign, normal, face
        ):
            if wp.dot(normal, direction) < 0.0:
                distance = start + ahead
                tries = _TRIES
            start += ahead * (1.0 + _NEARLY) + _HARDLY
        else:
            tries = _TRIES
    return distance, normal, u, v, face


@wp.func
def _enter(half: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> float:
    """How far along a ray the box around a geom begins, 0 from inside; beyond ``_NEVER`` if the ray misses it."""
    near, last = float(0.0), float(_NEVER)
    for axis in range(3):
        slow = wp.where(wp.abs(direction[axis]) < 1e-9, 1e-9, direction[axis])
        one, other = (-half[axis] - origin[axis]) / slow, (half[axis] - origin[axis]) / slow
        near = wp.max(near, wp.min(one, other))
        last = wp.min(last, wp.max(one, other))
    return wp.where(near > last, 2.0 * _NEVER, near)


def _make_meet(kinds: tuple[int, ...], culls: bool) -> wp.Function:
    """A function that says where a ray meets a geom of one of these types: see ``_meet_mesh``.

    As in GL, faces from behind are not there, unless not ``culls``: then meshes show them.
    """
    has_plane, has_sphere, has_capsule, has_ellipsoid, has_cylinder, has_box, has_mesh = (
        kind in kinds for kind in (_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH)
    )

    @wp.func
    def meet(
        kind: int, mesh: int, size: wp.vec3, mesh_bvh: wp.array[wp.uint64], start: wp.vec3, ahead: wp.vec3, reach: float
    ) -> tuple[float, wp.vec3, float, float, int]:
        distance, u, v, face = float(-1.0), float(0.0), float(0.0), int(-1)
        outward = wp.vec3(0.0)
        if wp.static(has_mesh and culls):
            if kind == wp.static(_MESH):
                distance, outward, u, v, face = _meet_mesh(mesh_bvh[mesh], start, ahead, reach)
        if wp.static(has_mesh and not culls):
            if kind == wp.static(_MESH):
                sign = float(0.0)
                if not wp.mesh_query_ray(mesh_bvh[mesh], start, ahead, reach, distance, u, v, sign, outward, face):
                    distance = -1.0
                if wp.dot(outward, ahead) > 0.0:
                    outward = -outward
        if wp.static(has_box):
            if kind == wp.static(_BOX):
                distance, outward = _meet_box(size, start, ahead)
        if wp.static(has_plane):
            if kind == wp.static(_PLANE):
                distance = _meet_plane(size, start, ahead)
                outward = wp.vec3(0.0, 0.0, 1.0)
        if wp.static(has_cylinder):
            if kind == wp.static(_CYLINDER):
                distance, outward = ray_cylinder(wp.vec3(0.0), _upright(), size, start, ahead)
        if wp.static(has_sphere):
            if kind == wp.static(_SPHERE):
                distance, outward = ray_sphere(wp.vec3(0.0), size[0] * size[0], start, ahead)
        if wp.static(has_capsule):
            if kind == wp.static(_CAPSULE):
                distance, outward = ray_capsule(wp.vec3(0.0), _upright(), size, start, ahead)
        if wp.static(has_ellipsoid):
            if kind == wp.static(_ELLIPSOID):
                distance, outward = ray_ellipsoid(wp.vec3(0.0), _upright(), size, start, ahead)
        if wp.dot(outward, ahead) > 0.0:
            distance = -1.0
        return distance, outward, u, v, face

    return meet


def _make_nearest(kinds: tuple[int, ...], culls: bool) -> wp.Function:
    """A function that finds what a ray meets first, for geoms of these types.

    In the order of the tree of boxes: to sort boxes by how far they are costs more than it saves.
    """
    meet = _make_meet(kinds, culls)

    @wp.func
    def nearest(
        geom_type: wp.array[int],
        geom_dataid: wp.array2d[int],
        geom_size: wp.array2d[wp.vec3],
        geom_rgba: wp.array2d[wp.vec4],
        geom_xpos: wp.array2d[wp.vec3],
        geom_xmat: wp.array2d[wp.mat33],
        bvh: wp.uint64,
        root: int,
        first: int,
        world: int,
        drawn: wp.array[int],
        mesh_bvh: wp.array[wp.uint64],
        origin: wp.vec3,
        direction: wp.vec3,
        reach: float,
    ) -> tuple[int, float, wp.vec3, float, float, int]:
        best = float(reach)
        found, face = int(-1), int(-1)
        normal = wp.vec3(0.0)
        u, v = float(0.0), float(0.0)
        item = int(0)
        query = wp.bvh_query_ray(bvh, origin, direction, root)
        while wp.bvh_query_next(query, item, best * (1.0 + _NEARLY) + _HARDLY):
            geom = drawn[item - first]
            if geom_rgba[world % geom_rgba.shape[0], geom][3] == 0.0:
                continue
            turn = geom_xmat[world, geom]
            start = wp.transpose(turn) @ (origin - geom_xpos[world, geom])
            ahead = wp.transpose(turn) @ direction
            size = geom_size[world % geom_size.shape[0], geom]
            mesh = geom_dataid[world % geom_dataid.shape[0], geom]
            kind = geom_type[geom]
            limit = best * (1.0 + _NEARLY) + _HARDLY
            if kind == wp.static(_MESH):
                if _enter(size, start, ahead) > limit:
                    continue
            distance, outward, at_u, at_v, at_face = meet(kind, mesh, size, mesh_bvh, start, ahead, limit)
            if distance >= 0.0:
                # Of what is equally far, GL shows what is drawn last.
                slack = _NEARLY * wp.max(best, 1.0)
                if distance < best - slack or (distance <= best + slack and geom > found):
                    best, found, face, u, v, normal = distance, geom, at_face, at_u, at_v, outward
        if found >= 0:
            normal = wp.normalize(geom_xmat[world, found] @ normal)
        return found, best, normal, u, v, face

    return nearest


@wp.func
def _upright() -> wp.mat33:
    return wp.identity(n=3, dtype=float)


@wp.func
def _arriving(
    light_type: wp.array2d[int],
    light_active: wp.array2d[bool],
    light_attenuation: wp.array2d[wp.vec3],
    light_cutoff: wp.array2d[float],
    light_exponent: wp.array2d[float],
    light_ambient: wp.array2d[wp.vec3],
    light_diffuse: wp.array2d[wp.vec3],
    light_specular: wp.array2d[wp.vec3],
    light_xpos: wp.array2d[wp.vec3],
    light_xdir: wp.array2d[wp.vec3],
    world: int,
    point: wp.vec3,
    normal: wp.vec3,
    facing: wp.vec3,
    back: wp.vec3,
    shininess: float,
) -> tuple[wp.vec3, wp.vec3]:
    """What all lamps shed on a surface: plain light, and highlights."""
    light, shine = wp.vec3(0.0), wp.vec3(0.0)
    for lamp in range(light_type.shape[1]):
        if light_active[world % light_active.shape[0], lamp]:
            kind = light_type[world % light_type.shape[0], lamp]
            aim = light_xdir[world, lamp]
            if kind == _HEADLIGHT:
                kind = _DIRECTIONAL
                aim = -facing
            towards = light_xpos[world, lamp] - point
            away = wp.length(towards)
            towards = wp.where(kind == _DIRECTIONAL, -aim, towards / away)
            fading = light_attenuation[world % light_attenuation.shape[0], lamp]
            cutoff = light_cutoff[world % light_cutoff.shape[0], lamp]
            exponent = light_exponent[world % light_exponent.shape[0], lamp]
            strength = _strength(kind, towards, away, aim, fading, cutoff, exponent)
            if strength > 0.0:
                light += strength * light_ambient[world % light_ambient.shape[0], lamp]
                cosine = wp.dot(normal, towards)
                if cosine > 0.0:
                    light += (strength * cosine) * light_diffuse[world % light_diffuse.shape[0], lamp]
                    highlight = strength * _highlight(normal, towards, back, shininess)
                    shine += highlight * light_specular[world % light_specular.shape[0], lamp]
    return light, shine


def _has_panes(model: mujoco.MjModel) -> bool:
    """Whether something lets light through."""
    return bool((model.geom_rgba[:, 3] < 1).any() or (model.mat_rgba[:, 3] < 1).any())


def _palette(model: mujoco.MjModel) -> int:
    """Index of the palette's texture; -2 if there is none."""
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXTURE, PALETTE)
    return found if found >= 0 else -2


def _kernel(model: mujoco.MjModel, context: Any, options: dict[str, int]) -> wp.Kernel:
    kinds = context.geom_ray_types
    nearest = _make_nearest(kinds, bool(context.enable_backface_culling))
    sample_texture = theirs._make_sample_texture(kinds)
    pixels = int(np.prod(context.cam_res.numpy()[0]))
    far, palette = float(context.zfar), _palette(model)
    reflecting = mirrors(model)
    passes = 1 + min(len(reflecting), 1) + (_MOST_PANES if _has_panes(model) else 0)
    supersampled = context.samples_per_pixel > 1
    has_rgb, has_depth, has_seg = (
        bool(flags.numpy().all()) for flags in (context.render_rgb, context.render_depth, context.render_seg)
    )

    # No loop: Warp's cache of compiled kernels does not tell apart what static expressions in loops were.
    (first, first_share), (second, second_share), (third, third_share) = (reflecting + 3 * [(-1, 0.0)])[:_MOST_MIRRORS]

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
        camera = pixel // wp.static(pixels)
        ahead = ray[ray_base + pixel]
        wider = cam_fovy[world % cam_fovy.shape[0], camera]
        ahead = wp.normalize(wp.vec3(wider * ahead[0], wider * ahead[1], ahead[2]))
        turn = cam_xmat_in[world, camera]
        origin = cam_xpos_in[world, camera]
        facing = wp.vec3(turn[0, 2], turn[1, 2], turn[2, 2])
        direction = turn @ ahead
        reach = wp.static(far) / wp.max(-ahead[2], 1e-6)
        seen = wp.vec3(0.0)
        share, through = float(1.0), float(1.0)
        step = int(0)
        while step < wp.static(passes):
            geom, distance, normal, u, v, face = nearest(
                geom_type,
                geom_dataid,
                geom_size,
                geom_rgba,
                geom_xpos_in,
                geom_xmat_in,
                bvh_id,
                group_root[world],
                world * bvh_ngeom,
                world,
                enabled_geom_ids,
                mesh_bvh_id,
                origin,
                direction,
                reach,
            )
            color, material = wp.vec4(1.0), int(-1)
            if geom >= 0:
                color = geom_rgba[world % geom_rgba.shape[0], geom]
                material = geom_matid[world % geom_matid.shape[0], geom]
            solid = 1.0 - (1.0 - color[3]) * (1.0 - color[3])  # MuJoCo draws what is transparent twice
            if ray_base == 0 and step == 0:
                if wp.static(has_depth):
                    depth_out[world, pixel] = wp.where(geom < 0, 0.0, -distance * ahead[2])
                if wp.static(has_seg):
                    if geom >= 0:
                        seg_out[world, pixel] = wp.vec2i(geom, _GEOM)
            step += 1
            point = origin + direction * distance
            if geom < 0:
                step = wp.static(passes)
            elif wp.static(has_rgb):
                own = share * wp.vec3(color[0], color[1], color[2])
                texel = wp.vec3(1.0)
                emission, specular, shininess = float(0.0), float(0.5), float(0.5)
                if material >= 0:
                    emission = mat_emission[world % mat_emission.shape[0], material]
                    specular = mat_specular[world % mat_specular.shape[0], material]
                    shininess = mat_shininess[world % mat_shininess.shape[0], material]
                    texture = mat_texid[world % mat_texid.shape[0], material, wp.static(_RGB)]
                    if texture >= 0:
                        texel = sample_texture(
                            geom_type,
                            mesh_faceadr,
                            geom,
                            geom_size[world % geom_size.shape[0], geom],
                            mat_texrepeat[world % mat_texrepeat.shape[0], material],
                            mat_texuniform[world % mat_texuniform.shape[0], material],
                            textures[texture],
                            geom_xpos_in[world, geom],
                            geom_xmat_in[world, geom],
                            mesh_facetexcoord,
                            mesh_texcoord,
                            mesh_texcoord_offsets,
                            point,
                            normal,
                            u,
                            v,
                            face,
                            geom_dataid[world % geom_dataid.shape[0], geom],
                        )
                        if texture == wp.static(palette):
                            own = wp.cw_mul(own, texel)
                            texel = wp.vec3(1.0)
                light, shine = _arriving(
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
                    world,
                    point,
                    normal,
                    facing,
                    -direction,
                    shininess,
                )
                light += wp.vec3(emission)
                lit = wp.cw_mul(own, light) + specular * shine
                seen += (through * solid) * wp.cw_mul(wp.min(lit, wp.vec3(1.0)), texel)
            if wp.static(passes > 1):
                if geom >= 0 and color[3] < 1.0:
                    through *= 1.0 - solid
                    origin = point + _OFF * direction
                    reach -= distance + _OFF
                elif geom >= 0:
                    share *= mirror_share(geom)
                    upright = geom_xmat_in[world, geom]
                    if share == 0.0 or wp.dot(normal, wp.vec3(upright[0, 2], upright[1, 2], upright[2, 2])) < _UPPER:
                        step = wp.static(passes)
                    origin = point + _OFF * normal
                    direction = direction - 2.0 * wp.dot(direction, normal) * normal
                    reach = wp.static(far)
        if wp.static(has_rgb):
            seen = 255.0 * wp.min(seen, wp.vec3(1.0))
            if wp.static(supersampled):
                aa_accum_out[world, pixel] += seen
            else:
                seen += wp.vec3(0.5)  # what follows cuts fractions off
                rgb_out[world, pixel] = pack_rgba_to_uint32(seen[0], seen[1], seen[2], 255.0)

    return rays
