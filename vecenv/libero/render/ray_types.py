"""The Warp structs that the ray tracer's device functions pass to each other.

The kernel (``ray_kernel``) fills them from the arguments of MuJoCo Warp's renderer; ``ray_shapes`` and ``ray_light``
read them. Arrays whose first index is ``world % shape[0]`` hold one row for all worlds or one row per world, as in
MuJoCo Warp. Positions are in the world frame, in metres.
"""

# Type checkers do not know that a struct is a class.
# pyright: reportGeneralTypeIssues=false

from __future__ import annotations

import warp as wp


@wp.struct
class Geoms:
    """The geoms of all worlds and the trees that rays are traced through.

    ``type``, ``dataid``, ``matid`` and ``size`` are MuJoCo's, ``rgba`` is the colour that a geom is drawn in, its
    material's included. ``bvh`` is the tree of all worlds' geoms, ``roots`` its root per world, ``drawn`` the geoms in
    it and ``num_drawn`` their number. ``mesh_bvh`` holds Warp's mesh of each MuJoCo mesh.
    """

    type: wp.array[int]
    dataid: wp.array2d[int]
    matid: wp.array2d[int]
    size: wp.array2d[wp.vec3]
    rgba: wp.array2d[wp.vec4]
    pos: wp.array2d[wp.vec3]
    mat: wp.array2d[wp.mat33]
    bvh: wp.uint64
    roots: wp.array[int]
    drawn: wp.array[int]
    num_drawn: int
    mesh_bvh: wp.array[wp.uint64]


@wp.struct
class Materials:
    """MuJoCo's materials and their textures."""

    texture_id: wp.array3d[int]
    uniform: wp.array2d[bool]
    repeat: wp.array2d[wp.vec2]
    emission: wp.array2d[float]
    specular: wp.array2d[float]
    shininess: wp.array2d[float]
    textures: wp.array[wp.Texture2D]


@wp.struct
class Meshes:
    """The normals and texture coordinates of the corners of MuJoCo's meshes.

    ``face_normal`` and ``face_texcoord`` are rows of ``normal`` and ``texcoord``, counted from ``normal_start`` and
    ``texcoord_start`` of the mesh (-1: it has no texture coordinates); those of a mesh begin at its ``face_start``.
    """

    face_start: wp.array[int]
    face_normal: wp.array[wp.vec3i]
    normal: wp.array[wp.vec3]
    normal_start: wp.array[int]
    face_texcoord: wp.array[wp.vec3i]
    texcoord: wp.array[wp.vec2]
    texcoord_start: wp.array[int]


@wp.struct
class Lights:
    """MuJoCo's lights; the headlight is one of them, of type ``ray_light.HEADLIGHT``."""

    type: wp.array2d[int]
    active: wp.array2d[bool]
    attenuation: wp.array2d[wp.vec3]
    cutoff: wp.array2d[float]
    exponent: wp.array2d[float]
    ambient: wp.array2d[wp.vec3]
    diffuse: wp.array2d[wp.vec3]
    specular: wp.array2d[wp.vec3]
    pos: wp.array2d[wp.vec3]
    dir: wp.array2d[wp.vec3]


@wp.struct
class Scene:
    """What rays meet and what lights it."""

    geoms: Geoms
    meshes: Meshes
    materials: Materials
    lights: Lights


@wp.struct
class Cameras:
    """The cameras, in the order of the images, and the directions of their rays in the camera's frame.

    ``width`` is how much wider a camera sees than the one the directions were made for, a ratio of tangents of half the
    field of view; ``pixel`` is the width and height of a pixel of that one, 1 m away, in metres. ``first_ray`` is the
    first direction of this pass: the number of the pass times the number of pixels of all cameras.
    """

    pos: wp.array2d[wp.vec3]
    mat: wp.array2d[wp.mat33]
    width: wp.array2d[float]
    pixel: wp.array[wp.vec2]
    rays: wp.array[wp.vec3]
    first_ray: int


@wp.struct
class Images:
    """The buffers that the kernel writes, [worlds, pixels of all cameras].

    ``sums`` adds up the samples of a pixel. ``queue`` holds the pixels that need more samples, see ``ray_passes``.
    """

    rgb: wp.array2d[wp.uint32]
    sums: wp.array2d[wp.vec3]
    depth: wp.array2d[float]
    segmentation: wp.array2d[wp.vec2i]
    queue: wp.array2d[int]


@wp.struct
class Ray:
    """A ray in the world frame that ends after ``reach`` metres."""

    origin: wp.vec3
    direction: wp.vec3
    reach: float


@wp.struct
class Hit:
    """The first surface on a ray: the geom or -1, metres to it, the normal in the world frame, and of a mesh the
    barycentric coordinates and the face."""

    geom: int
    distance: float
    normal: wp.vec3
    u: float
    v: float
    face: int


@wp.struct
class Footprint:
    """How far a step of one pixel to the right, and one down, moves a point, world frame, metres."""

    right: wp.vec3
    down: wp.vec3


@wp.struct
class Surface:
    """A point to be lit: where it is, its normal, the direction to the viewer, and MuJoCo's shininess."""

    point: wp.vec3
    normal: wp.vec3
    back: wp.vec3
    shininess: float
