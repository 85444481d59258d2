"""The bodies of a MuJoCo model as glTF, for a viewer in a browser.

In: a compiled model, visual or physics. Out: for each body that has something to draw, a binary glTF in the body's own
frame, in metres, with the model's textures made smaller. A body that moves is then one pose.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from vecenv.libero.render.lod import Mesh

if TYPE_CHECKING:
    import trimesh

# Longer side of a texture, pixels. Upstream's have up to 4096, 48 MB each before they are compressed.
_TEXTURE_SIDE = 512
_SMALLEST_ALPHA = 0.01
_OPAQUE = 0.995
_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
_GEOM = mujoco.mjtGeom
# A plane is drawn this far from its centre where the model lets it go on for ever, metres.
_PLANE = 3.0


def glb_of_bodies(model: mujoco.MjModel, groups: Sequence[int], hidden: Sequence[str] = ()) -> dict[int, bytes]:
    """Binary glTF of each body that has something to draw, by the body's id.

    Args:
        model: the model; it is only read.
        groups: groups of geoms that are drawn.
        hidden: parts of names of geoms that are left out.
    """
    import trimesh

    materials = _Materials(model)
    parts: dict[int, list[trimesh.Trimesh]] = defaultdict(list)
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if int(model.geom_group[geom]) not in groups or any(part in name for part in hidden):
            continue
        rgba = materials.rgba(geom)
        if rgba[3] < _SMALLEST_ALPHA:
            continue
        mesh = _mesh(model, geom, materials, rgba)
        if mesh is not None:
            parts[int(model.geom_bodyid[geom])].append(mesh)
    return {body: _exported(trimesh.Scene(meshes)) for body, meshes in parts.items()}


def _exported(scene: trimesh.Scene) -> bytes:
    glb = scene.export(file_type="glb")
    assert isinstance(glb, bytes)
    return glb


def _mesh(model: mujoco.MjModel, geom: int, materials: _Materials, rgba: np.ndarray) -> trimesh.Trimesh | None:
    """A geom in its body's frame; None for a kind of geom that is not drawn."""
    from trimesh.visual import TextureVisuals

    size, kind = model.geom_size[geom], int(model.geom_type[geom])
    if kind == _GEOM.mjGEOM_MESH:
        made = _of_mesh(model, geom, materials, rgba)
    else:
        made = _of_primitive(kind, size)
        if made is None:
            return None
        made.visual = TextureVisuals(material=materials.plain(geom, rgba))
    pose = np.eye(4)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
    made.apply_transform(pose)
    return made


def _of_primitive(kind: int, size: np.ndarray) -> trimesh.Trimesh | None:
    import trimesh

    if kind == _GEOM.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind == _GEOM.mjGEOM_SPHERE:
        return trimesh.creation.icosphere(subdivisions=2, radius=float(size[0]))
    if kind == _GEOM.mjGEOM_ELLIPSOID:
        ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
        ball.apply_scale(size)
        return ball
    if kind == _GEOM.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=float(size[0]), height=2 * float(size[1]), sections=24)
    if kind == _GEOM.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(radius=float(size[0]), height=2 * float(size[1]), count=[12, 12])
    if kind == _GEOM.mjGEOM_PLANE:
        half = np.where(size[:2] > 0, size[:2], _PLANE)
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * np.append(half, 1.0)
        return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    return None


def _of_mesh(model: mujoco.MjModel, geom: int, materials: _Materials, rgba: np.ndarray) -> trimesh.Trimesh:
    """A geom's mesh: a vertex for each combination of position, normal and texture coordinate that a corner has."""
    import trimesh
    from trimesh.visual import TextureVisuals

    mesh = Mesh.of(model, int(model.geom_dataid[geom]))
    textured = len(mesh.texcoord) > 0 and materials.texture(geom) is not None
    columns = [mesh.face.ravel(), mesh.face_normal.ravel()]
    if textured:
        columns.append(mesh.face_texcoord.ravel())
    corners, index = np.unique(np.stack(columns, axis=1), axis=0, return_inverse=True)
    made = trimesh.Trimesh(
        mesh.vert[corners[:, 0]],
        index.reshape(-1, 3),
        vertex_normals=mesh.normal[corners[:, 1]],
        process=False,
    )
    if textured:
        # MuJoCo's rows of texture begin at v = 0, those of the pictures that trimesh writes at v = 1.
        uv = mesh.texcoord[corners[:, 2]] * materials.repeat(geom)
        made.visual = TextureVisuals(uv=uv * (1, -1) + (0, 1), material=materials.pictured(geom, rgba))
    else:
        made.visual = TextureVisuals(material=materials.plain(geom, rgba))
    return made


class _Materials:
    """The materials of a model, each texture made smaller once."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._pictures: dict[int, Any] = {}

    def rgba(self, geom: int) -> np.ndarray:
        """A geom's colour: its own, or its material's while its own is MuJoCo's default."""
        own, material = self._model.geom_rgba[geom], int(self._model.geom_matid[geom])
        unset = np.allclose(own, (0.5, 0.5, 0.5, 1.0))
        return np.array(self._model.mat_rgba[material] if material >= 0 and unset else own, float)

    def texture(self, geom: int) -> int | None:
        """Index of a geom's texture; None without one."""
        material = int(self._model.geom_matid[geom])
        texture = int(self._model.mat_texid[material, _RGB]) if material >= 0 else -1
        return texture if texture >= 0 else None

    def repeat(self, geom: int) -> np.ndarray:
        """How often a geom's texture is repeated along u and v, [2]."""
        return self._model.mat_texrepeat[int(self._model.geom_matid[geom])]

    def plain(self, geom: int, rgba: np.ndarray) -> Any:
        """One colour: the geom's, times the mean of its texture."""
        texture = self.texture(geom)
        if texture is not None:
            mean = np.asarray(self._picture(texture), float).reshape(-1, 3).mean(axis=0) / 255
            rgba = np.append(rgba[:3] * mean, rgba[3])
        return self._material(rgba, None)

    def pictured(self, geom: int, rgba: np.ndarray) -> Any:
        """The geom's texture, times its colour."""
        texture = self.texture(geom)
        assert texture is not None
        return self._material(rgba, self._picture(texture))

    def _material(self, rgba: np.ndarray, picture: Any) -> Any:
        from trimesh.visual.material import PBRMaterial

        return PBRMaterial(
            baseColorFactor=np.round(255 * np.clip(rgba, 0, 1)).astype(np.uint8),
            baseColorTexture=picture,
            metallicFactor=0.0,
            roughnessFactor=0.8,
            alphaMode="OPAQUE" if rgba[3] >= _OPAQUE else "BLEND",
            doubleSided=True,
        )

    def _picture(self, texture: int) -> Any:
        """A texture as an image of at most ``_TEXTURE_SIDE`` pixels a side."""
        from PIL import Image

        if texture not in self._pictures:
            model = self._model
            shape = (model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture])
            start = int(model.tex_adr[texture])
            pixels = model.tex_data[start : start + int(np.prod(shape))].reshape(shape)
            pixels = np.repeat(pixels, 3, axis=2) if shape[2] < 3 else pixels[:, :, :3]
            image = Image.fromarray(np.ascontiguousarray(pixels))
            image.thumbnail((_TEXTURE_SIDE, _TEXTURE_SIDE))
            self._pictures[texture] = image
        return self._pictures[texture]
