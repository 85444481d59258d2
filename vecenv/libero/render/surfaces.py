"""What the surfaces of a scene's visual model are made of: colours, materials, textures, and the triangles of meshes.

In: a compiled visual model and a geom of it. Out: the geom's ``Look``, its ``Corners`` in the frame of its body, and
textures reduced to about the size that cameras see them in, by the rule that GL's mipmaps are made by.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from vecenv.libero.render import lod

# MuJoCo draws a geom in its material's colour while the geom's own is this.
_UNSET = np.array([0.5, 0.5, 0.5, 1.0])
RGB_ROLE = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)


class Look(NamedTuple):
    """What a surface is made of: texture (or -1), colour, repetition, and what MuJoCo's materials have besides.

    ``color`` None stands for the palette. A geom without a material has the defaults.
    """

    texture: int = -1
    color: tuple[float, ...] | None = None
    repeat: tuple[float, ...] = (1.0, 1.0)
    uniform: bool = False
    specular: float = 0.5
    shininess: float = 0.5
    emission: float = 0.0
    reflectance: float = 0.0


class Corners(NamedTuple):
    """Triangles: ``pos`` and ``normal`` [n, 3, 3] in the body's frame, ``uv`` [n, 3, 2]."""

    pos: np.ndarray
    normal: np.ndarray
    uv: np.ndarray


def drawn_colors(model: mujoco.MjModel) -> np.ndarray:
    """Red, green, blue, alpha that geoms are drawn in (times their textures), float32 [ngeom, 4]."""
    return np.array([drawn_color(model, geom) for geom in range(model.ngeom)], np.float32).reshape(-1, 4)


def drawn_color(model: mujoco.MjModel, geom: int) -> tuple[float, ...]:
    """Red, green, blue, alpha that a geom is drawn in (times its texture)."""
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    chosen = model.mat_rgba[material] if material >= 0 and np.allclose(own, _UNSET) else own
    return tuple(float(x) for x in chosen)


def texture_of(model: mujoco.MjModel, geom: int) -> int:
    """Index of a geom's texture, -1 without one."""
    material = int(model.geom_matid[geom])
    return int(model.mat_texid[material, RGB_ROLE]) if material >= 0 else -1


def look_of(model: mujoco.MjModel, geom: int) -> Look:
    """What a geom is made of."""
    material, color = int(model.geom_matid[geom]), drawn_color(model, geom)
    if material < 0:
        return Look(color=color)
    return Look(
        texture=texture_of(model, geom),
        color=color,
        repeat=tuple(model.mat_texrepeat[material].tolist()),
        uniform=bool(model.mat_texuniform[material]),
        specular=float(model.mat_specular[material]),
        shininess=float(model.mat_shininess[material]),
        emission=float(model.mat_emission[material]),
        reflectance=float(model.mat_reflectance[material]),
    )


def corners_of(model: mujoco.MjModel, geom: int) -> Corners:
    """The triangles of a mesh geom in its body's frame."""
    mesh, turn = lod.Mesh.of(model, int(model.geom_dataid[geom])), matrix(model.geom_quat[geom])
    pos = mesh.vert[mesh.face] @ turn.T + model.geom_pos[geom]
    normal = mesh.normal[mesh.face_normal] @ turn.T
    uv = mesh.texcoord[mesh.face_texcoord] if len(mesh.texcoord) else _projected(model, geom, mesh)
    return Corners(pos.astype(np.float32), normal.astype(np.float32), uv.astype(np.float32))


def _projected(model: mujoco.MjModel, geom: int, mesh: lod.Mesh) -> np.ndarray:
    """Texture coordinates, repetition included, [n, 3, 2], that MuJoCo gives meshes without any: seen from above."""
    material = int(model.geom_matid[geom])
    repeat = model.mat_texrepeat[material] if material >= 0 else np.ones(2)
    size = np.ones(2) if material >= 0 and model.mat_texuniform[material] else model.geom_size[geom, :2]
    return mesh.vert[mesh.face][..., :2] * np.array([0.5, -0.5]) * repeat / np.maximum(size, 1e-9) - 0.5


def mean_edge(corners: Corners) -> float:
    """Length of the edges of triangles, metres, as seen on average over their surface."""
    area = _areas(corners.pos)
    return float(np.average(np.sqrt(area), weights=area)) if area.sum() > 0 else 0.0


def _areas(triangles: np.ndarray) -> np.ndarray:
    """Areas [n] of triangles [n, 3, 3]."""
    sides = np.diff(triangles.astype(float), axis=1)
    return np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2


def concatenated(parts: list[Corners]) -> Corners:
    """All triangles in one."""
    return Corners(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix [3, 3] of a quaternion wxyz [4]."""
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, quat)
    return out.reshape(3, 3)


def texture_pixels(model: mujoco.MjModel, index: int, side: int) -> np.ndarray:
    """A texture, uint8 [h, w, 3]: the first level of its mipmap with at most ``side`` texels a side, decoded."""
    height, width, channels = model.tex_height[index], model.tex_width[index], model.tex_nchannel[index]
    start = model.tex_adr[index]
    pixels = model.tex_data[start : start + height * width * channels].reshape(height, width, channels)[..., :3]
    if model.tex_type[index] == mujoco.mjtTexture.mjTEXTURE_CUBE and height == 6 * width:
        pixels = pixels[:width]
    if model.tex_colorspace[index] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB:
        pixels = _DECODED[pixels]
    while max(pixels.shape[:2]) > side:
        pixels = next_level(pixels)
    return np.rint(pixels).astype(np.uint8)


def next_level(image: np.ndarray) -> np.ndarray:
    """The next level of a mipmap, float32 [h / 2, w / 2, c], of an image [h, w, c].

    It is made as Mesa makes it: a texel is interpolated between two of the level before, at its middle. Sides of even
    length are averaged in pairs; of odd ones, texels count differently.
    """
    for axis in (0, 1):
        size = image.shape[axis]
        count = max(size // 2, 1)
        if count < size:
            place = (np.arange(count) + 0.5) * size / count - 0.5
            low = place.astype(int)
            part = (place - low).astype(np.float32).reshape([-1 if a == axis else 1 for a in range(image.ndim)])
            image = np.take(image, low, axis) * (1 - part) + np.take(image, low + 1, axis) * part
    return image.astype(np.float32)


_CODES = np.arange(256) / 255
# What sRGB's codes stand for, of 255.
_DECODED = (255 * np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4)).astype(np.float32)
