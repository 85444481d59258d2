"""Geoms drawn into MuJoCo's framebuffer as MuJoCo draws them: over a stored image, or into a mirror.

``mujoco.mjr_render`` begins with an empty image. A ``Canvas`` adds to the image that is there, after an ``mjr_render``
has set lights and camera: it takes the looks of geoms from a filled ``MjvScene`` and gives OpenGL the commands that
MuJoCo gives (``renderGeom`` in its ``render_gl3.c``), for opaque geoms and sites without shadows, so pixels are equal
to MuJoCo's. Meshes and textures are those that the ``MjrContext`` has uploaded.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from vecenv.libero.render.commands import commands

_GEOM = mujoco.mjtGeom
_SHAPES = (
    _GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_ELLIPSOID, _GEOM.mjGEOM_CYLINDER,
    _GEOM.mjGEOM_BOX, _GEOM.mjGEOM_MESH,
)  # fmt: skip
_LIGHTS = (mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, mujoco.mjtLightType.mjLIGHT_SPOT)
# Lists of MuJoCo's shapes, counted from ``baseBuiltin``.
_SPHERE, _SPHERE_TOP, _SPHERE_BOTTOM, _CYLINDER, _CYLINDER_OPEN, _BOX = 0, 1, 2, 3, 4, 6
_LISTS = {
    _GEOM.mjGEOM_SPHERE: _SPHERE,
    _GEOM.mjGEOM_ELLIPSOID: _SPHERE,
    _GEOM.mjGEOM_CYLINDER: _CYLINDER,
    _GEOM.mjGEOM_BOX: _BOX,
}
# Past so many, the lists of looks are made anew: slots whose colours are redrawn each episode would fill the memory.
_MOST_LISTS = 8192

# OpenGL's constants, without their "GL_".
LIST_COMPILE, QUADS, MODELVIEW, PROJECTION, TEXTURE = 0x1300, 0x7, 0x1700, 0x1701, 0x1702
TEXTURE_2D, CUBE_MAP, TEXTURE0, GEN_S, GEN_T, GEN_R = 0x0DE1, 0x8513, 0x84C0, 0x0C60, 0x0C61, 0x0C62
S, T, R, OBJECT_PLANE, BOTH_SIDES = 0x2000, 0x2001, 0x2002, 0x2501, 0x0408
EMISSION, SHININESS, SPECULAR = 0x1600, 0x1601, 0x1202
LIGHTING, LIGHT0, POSITION, SPOT_DIRECTION = 0x0B50, 0x4000, 0x1203, 0x1204
STENCIL_TEST, STENCIL_BITS, DEPTH_TEST, BLEND, CLIP_PLANE0 = 0x0B90, 0x0400, 0x0B71, 0x0BE2, 0x3000
ALWAYS, EQUAL, NOTEQUAL, GEQUAL = 0x0207, 0x0202, 0x0205, 0x0206
KEEP, REPLACE, INCREASE, ONE, CLOCKWISE, COUNTERCLOCKWISE = 0x1E00, 0x1E01, 0x1E02, 1, 0x0900, 0x0901


class Look(NamedTuple):
    """What decides how an item looks in its own frame; the fields of ``MjvGeom``."""

    type: int
    dataid: int
    size: tuple[float, ...]
    rgba: tuple[float, ...]
    emission: float
    specular: float
    shininess: float
    matid: int
    texid: int
    texuniform: bool
    texrepeat: tuple[float, ...]
    texcoord: bool

    @classmethod
    def of(cls, geom: mujoco.MjvGeom) -> Look:
        """The look of an entry of a filled scene."""
        return cls(
            type=int(geom.type),
            dataid=int(geom.dataid),
            size=tuple(geom.size.tolist()),
            rgba=tuple(geom.rgba.tolist()),
            emission=float(geom.emission),
            specular=float(geom.specular),
            shininess=float(geom.shininess),
            matid=int(geom.matid),
            texid=int(geom.texid),
            texuniform=bool(geom.texuniform),
            texrepeat=tuple(geom.texrepeat.tolist()),
            texcoord=bool(geom.texcoord),
        )

    @property
    def is_supported(self) -> bool:
        """Whether a canvas draws it: no plane without end, whose place depends on the camera, and none of the rest."""
        return self.type in _SHAPES and not (self.type == _GEOM.mjGEOM_PLANE and min(self.size[:2]) <= 0)

    def dimmed(self, scale: float) -> Look:
        """As it looks in a mirror that reflects this part of the light."""
        *rgb, alpha = self.rgba
        return self._replace(rgba=(*(float(np.float32(c) * np.float32(scale)) for c in rgb), alpha))

    def upper_side(self) -> Look:
        """The plane that MuJoCo reflects in, without texture."""
        is_box = self.type == _GEOM.mjGEOM_BOX
        return self._replace(type=int(_GEOM.mjGEOM_PLANE), dataid=-1 if is_box else self.dataid, matid=-1)


class Canvas:
    """What one thread needs to draw geoms of one scene.

    Args:
        context: of this thread, with the scene's meshes and textures.
    """

    def __init__(self, context: mujoco.MjrContext) -> None:
        self._gl: Any = commands()
        self._context = context
        self._textures, self._kinds = context.texture.tolist(), context.textureType.tolist()
        self._lists: dict[Look, int] = {}
        self._quad = self._compiled_quad()

    def draw(self, looks: Sequence[Look], poses: np.ndarray) -> None:
        """Draw items over the image, lit by the lights that are on; ``poses`` [n, 12] are positions and matrices."""
        gl = self._gl
        matrices = _columns(poses)
        start = matrices.ctypes.data
        for number, (look, (x, y, z)) in enumerate(zip(looks, poses[:, :3].tolist(), strict=True)):
            gl.PushMatrix()
            gl.Translatef(x, y, z)
            gl.MultMatrixf(start + 64 * number)
            gl.CallList(self._lists.get(look) or self._compiled(look))
            gl.PopMatrix()

    def switch(self, frame: mujoco.MjvScene, on: bool) -> None:
        """Turn the lights of a frame on or off."""
        for number, light in enumerate(frame.lights[: frame.nlight]):
            if light.type in _LIGHTS:
                (self._gl.Enable if on else self._gl.Disable)(LIGHT0 + number)

    def place(self, frame: mujoco.MjvScene) -> None:
        """Put the lights of a frame where they are, in the coordinates of now."""
        for number, light in enumerate(frame.lights[: frame.nlight]):
            if light.type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
                self._gl.Lightfv(LIGHT0 + number, POSITION, _floats(*(-light.dir).tolist(), 0))
            elif light.type == mujoco.mjtLightType.mjLIGHT_SPOT:
                self._gl.Lightfv(LIGHT0 + number, SPOT_DIRECTION, _floats(*light.dir.tolist(), 0))
                self._gl.Lightfv(LIGHT0 + number, POSITION, _floats(*light.pos.tolist(), 1))

    def clear_stencil(self) -> None:
        """Set the stencil to 0."""
        self._gl.ClearStencil(0)
        self._gl.Clear(STENCIL_BITS)

    def reflect(
        self, frame: mujoco.MjvScene, mirror: tuple[Look, np.ndarray, float], looks: Sequence[Look], poses: np.ndarray
    ) -> None:
        """Draw what a mirror shows into an image that was drawn without reflections; the stencil must be 0.

        Args:
            frame: its lights and camera are those of the image.
            mirror: its look, its pose [12], and the part of the light that it reflects.
            looks, poses: of what it shows, [n, 12].
        """
        gl, (look, pose, reflectance) = self._gl, mirror
        plane = pose.copy()
        if look.type == _GEOM.mjGEOM_BOX:
            plane[:3] = np.float32(plane[:3]) + np.float32(look.size[2]) * np.float32(pose[5::3])
        self._mark(look, pose, plane)
        self._blacken()
        self._draw_mirrored(frame, reflectance, plane, looks, poses)
        # The mirror's own light is added.
        gl.StencilFunc(NOTEQUAL, 0, 0xFF)
        self.place(frame)
        self.switch(frame, on=True)
        gl.Enable(BLEND)
        gl.BlendFunc(ONE, ONE)
        self.draw([look], pose[None])
        gl.Disable(BLEND)
        self.switch(frame, on=False)
        gl.Disable(STENCIL_TEST)

    def _mark(self, mirror: Look, pose: np.ndarray, plane: np.ndarray) -> None:
        """Set the stencil to 2 where the mirror's upper side is seen, to 1 where another side is, 0 elsewhere."""
        gl = self._gl
        gl.Enable(STENCIL_TEST)
        gl.ColorMask(0, 0, 0, 0)
        gl.DepthMask(0)
        gl.StencilFunc(ALWAYS, 1, 0xFF)
        gl.StencilOp(KEEP, KEEP, REPLACE)
        self.draw([mirror], pose[None])
        gl.Disable(DEPTH_TEST)
        gl.StencilFunc(EQUAL, 1, 0xFF)
        gl.StencilOp(KEEP, INCREASE, INCREASE)
        self.draw([mirror.upper_side()], plane[None])
        gl.ColorMask(1, 1, 1, 1)
        gl.DepthMask(1)
        gl.Enable(DEPTH_TEST)

    def _blacken(self) -> None:
        """Empty the image where the stencil is set."""
        gl = self._gl
        gl.StencilFunc(NOTEQUAL, 0, 0xFF)
        gl.StencilOp(KEEP, KEEP, KEEP)
        gl.CallList(self._quad)

    def _draw_mirrored(
        self, frame: mujoco.MjvScene, scale: float, plane: np.ndarray, looks: Sequence[Look], poses: np.ndarray
    ) -> None:
        gl = self._gl
        normal, point = plane[5::3].astype(np.float32), plane[:3].astype(np.float32)
        clip = np.array([*-normal, _dot(normal, point)], float)
        matrix = _reflection(normal, point)
        gl.StencilFunc(EQUAL, 2, 0xFF)
        gl.Enable(CLIP_PLANE0)
        gl.ClipPlane(CLIP_PLANE0, clip.ctypes.data)
        gl.FrontFace(CLOCKWISE)
        gl.PushMatrix()
        gl.MultMatrixf(matrix.ctypes.data)
        self.place(frame)
        self.switch(frame, on=True)
        self.draw([look.dimmed(scale) for look in looks], poses)
        self.switch(frame, on=False)
        gl.Disable(CLIP_PLANE0)
        gl.PopMatrix()
        gl.FrontFace(COUNTERCLOCKWISE)

    def _compiled(self, look: Look) -> int:
        """A list of commands that draws an item in its own frame."""
        if len(self._lists) >= _MOST_LISTS:
            for number in self._lists.values():
                self._gl.DeleteLists(number, 1)
            self._lists.clear()
        gl = self._gl
        number = gl.GenLists(1)
        gl.NewList(number, LIST_COMPILE)
        self._set_material(look)
        is_textured = look.matid >= 0 and look.texid >= 0
        undo = self._set_texture(look) if is_textured else ()
        self._call_shape(look)
        for capability in undo:
            gl.Disable(capability)
        if is_textured:
            gl.MatrixMode(TEXTURE)
            gl.LoadIdentity()
            gl.MatrixMode(MODELVIEW)
        gl.EndList()
        self._lists[look] = number
        return number

    def _set_material(self, look: Look) -> None:
        gl, rgb = self._gl, np.array(look.rgba[:3], np.float32)
        gl.Materialfv(BOTH_SIDES, EMISSION, _floats(*(np.float32(look.emission) * rgb).tolist(), 1))
        gl.Color4f(*look.rgba)
        gl.Materialf(BOTH_SIDES, SHININESS, float(np.float32(look.shininess) * np.float32(128)))
        gl.Materialfv(BOTH_SIDES, SPECULAR, _floats(*(look.specular,) * 3, 1))

    def _set_texture(self, look: Look) -> tuple[int, ...]:
        """Turn an item's texture on; returns what turns it off."""
        gl = self._gl
        gl.ActiveTexture(TEXTURE0)
        if self._kinds[look.texid] != mujoco.mjtTexture.mjTEXTURE_2D and not look.texcoord:
            sides = look.size if look.texuniform else (1.0, 1.0, 1.0)
            gl.Enable(CUBE_MAP)
            gl.BindTexture(CUBE_MAP, self._textures[look.texid])
            for number, (axis, switch) in enumerate(((S, GEN_S), (T, GEN_T), (R, GEN_R))):
                gl.Enable(switch)
                gl.TexGenfv(axis, OBJECT_PLANE, _floats(*(sides[number] if i == number else 0 for i in range(4))))
            return CUBE_MAP, GEN_S, GEN_T, GEN_R
        gl.Enable(TEXTURE_2D)
        gl.BindTexture(TEXTURE_2D, self._textures[look.texid])
        scale, sides = np.array(look.texrepeat, np.float32), np.array(look.size[:2], np.float32)
        has_sides = sides > 0
        if look.texcoord or look.type != _GEOM.mjGEOM_MESH:
            scale = np.where(scale > 0, scale, np.float32(1))
            scale = np.where(has_sides & look.texuniform, scale * sides, scale)
            gl.MatrixMode(TEXTURE)
            gl.LoadIdentity()
            gl.Scalef(*scale.tolist(), 1)
            gl.MatrixMode(MODELVIEW)
            return (TEXTURE_2D,)
        if look.dataid >= 0:
            scale = np.where(has_sides, scale / np.where(has_sides, sides, 1), scale)
        scale = np.where(has_sides & look.texuniform, scale * sides, scale).astype(float).tolist()
        gl.Enable(GEN_S)
        gl.Enable(GEN_T)
        gl.TexGenfv(S, OBJECT_PLANE, _floats(0.5 * scale[0], 0, 0, -0.5))
        gl.TexGenfv(T, OBJECT_PLANE, _floats(0, -0.5 * scale[1], 0, -0.5))
        return TEXTURE_2D, GEN_S, GEN_T

    def _call_shape(self, look: Look) -> None:
        gl, (x, y, z), built_in = self._gl, look.size, self._context.baseBuiltin
        if look.type == _GEOM.mjGEOM_MESH:
            gl.CallList(self._context.baseMesh + look.dataid)
        elif look.type == _GEOM.mjGEOM_PLANE and look.dataid >= 0:
            gl.CallList(self._context.basePlane + look.dataid + 1)
        elif look.type == _GEOM.mjGEOM_PLANE:
            gl.Scalef(x, y, 1)
            gl.CallList(self._context.basePlane)
        elif look.type == _GEOM.mjGEOM_CAPSULE:
            mean = 0.5 * (x + y)
            gl.Scalef(x, y, z)
            gl.CallList(built_in + _CYLINDER_OPEN)
            gl.Scalef(1, 1, mean / z)
            gl.Translatef(0, 0, (z - mean) / mean)
            gl.CallList(built_in + _SPHERE_TOP)
            gl.Translatef(0, 0, 2 * (mean - z) / mean)
            gl.CallList(built_in + _SPHERE_BOTTOM)
        else:
            gl.Scalef(x, y, z)
            gl.CallList(built_in + _LISTS[look.type])

    def _compiled_quad(self) -> int:
        """A list of commands that blackens the image at the greatest distance."""
        gl = self._gl
        number = gl.GenLists(1)
        gl.NewList(number, LIST_COMPILE)
        gl.Disable(LIGHTING)
        gl.DepthFunc(ALWAYS)
        gl.DepthRange(0, 0)
        for stack in (PROJECTION, MODELVIEW):
            gl.MatrixMode(stack)
            gl.PushMatrix()
            gl.LoadIdentity()
        gl.Color4f(0, 0, 0, 0)
        gl.Begin(QUADS)
        for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            gl.Vertex3f(x, y, 0)
        gl.End()
        for stack in (PROJECTION, MODELVIEW):
            gl.MatrixMode(stack)
            gl.PopMatrix()
        gl.DepthRange(0, 1)
        gl.DepthFunc(GEQUAL)
        gl.Enable(LIGHTING)
        gl.EndList()
        return number


def _columns(poses: np.ndarray) -> np.ndarray:
    """Rotations of poses [n, 12] as OpenGL takes them, float32 [n, 16]."""
    matrices = np.zeros((len(poses), 4, 4), np.float32)
    matrices[:, :3, :3] = poses[:, 3:].reshape(-1, 3, 3).transpose(0, 2, 1)
    matrices[:, 3, 3] = 1
    return matrices


def _floats(*values: float) -> ctypes.Array[ctypes.c_float]:
    return (ctypes.c_float * len(values))(*values)


def _dot(a: np.ndarray, b: np.ndarray) -> np.float32:
    """In the order in which MuJoCo adds."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _reflection(normal: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The matrix that mirrors in a plane, as OpenGL takes it, float32 [4, 4]."""
    products = normal[:, None] * normal
    matrix = np.eye(4, dtype=np.float32)
    matrix[:3, :3] -= 2 * products
    matrix[3, :3] = [2 * _dot(row, point) for row in products]
    return matrix
