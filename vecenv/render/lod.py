"""Fewer triangles: ``lod="fast"`` draws simplified meshes, which look almost the same and cost a fraction.

In: the compiled visual model of a scene. Out: the same model, its visual meshes replaced in place by simplified ones;
geoms, materials, textures and everything else stay. The simplified meshes come with the package
(``simplified.npz``, made by ``scripts/simplify_meshes.py``) and are found by the content of the mesh they replace, so a
mesh that is not known there is drawn as it is. Every triangle corner of a simplified mesh is a corner of the original,
position and texture coordinate alike; only the normals are new, averages of what was around.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

FILE = "simplified.npz"
# Normals are stored as whole numbers up to this.
NORMAL_SCALE = 127


@dataclass(frozen=True)
class Mesh:
    """One mesh of a compiled model: views of its arrays, so writing to them changes the model.

    Attributes:
        index: in the model.
        vert: [nvert, 3]. normal: [nnormal, 3]. texcoord: [ntexcoord, 2], empty without.
        face, face_normal, face_texcoord: rows of these, a triangle a row, int [nface, 3].
    """

    index: int
    vert: np.ndarray
    normal: np.ndarray
    texcoord: np.ndarray
    face: np.ndarray
    face_normal: np.ndarray
    face_texcoord: np.ndarray

    @classmethod
    def of(cls, model: mujoco.MjModel, index: int) -> Mesh:
        """The mesh of this index."""

        def rows(array: np.ndarray, address: int, count: int) -> np.ndarray:
            return array[address : address + count] if address >= 0 else array[:0]

        faces = model.mesh_faceadr[index], model.mesh_facenum[index]
        has_texture = model.mesh_texcoordadr[index] >= 0
        return cls(
            index=index,
            vert=rows(model.mesh_vert, model.mesh_vertadr[index], model.mesh_vertnum[index]),
            normal=rows(model.mesh_normal, model.mesh_normaladr[index], model.mesh_normalnum[index]),
            texcoord=rows(model.mesh_texcoord, model.mesh_texcoordadr[index], model.mesh_texcoordnum[index]),
            face=rows(model.mesh_face, *faces),
            face_normal=rows(model.mesh_facenormal, *faces),
            face_texcoord=rows(model.mesh_facetexcoord, *faces) if has_texture else model.mesh_face[:0],
        )

    @property
    def key(self) -> str:
        """Hash of what it looks like, 16 hexadecimal digits."""
        digest = hashlib.sha256()
        for array in (self.vert, self.face, self.texcoord, self.face_texcoord):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]


def drawn_meshes(model: mujoco.MjModel) -> Iterator[int]:
    """Meshes of the geoms that are drawn (group 1), each once."""
    drawn = (model.geom_group == 1) & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    yield from np.unique(model.geom_dataid[drawn]).tolist()


def simplify(model: mujoco.MjModel) -> int:
    """Replace the drawn meshes of a model by the simplified ones that are known; returns how many triangles are left.

    Geoms that collide share no mesh with geoms that are drawn, and if one did, it would collide as before: MuJoCo
    collides with convex hulls, which are left alone.
    """
    known, left = simplified(), 0
    for index in drawn_meshes(model):
        mesh = Mesh.of(model, index)
        if mesh.key in known:
            _replace(model, mesh, *known[mesh.key])
        left += int(model.mesh_facenum[index])
    return left


@functools.cache
def simplified() -> Mapping[str, tuple[np.ndarray, np.ndarray]]:
    """By key: triangles [n, 3], as corners (3 * face + corner) of the original, and normals, float32 [n, 3, 3]."""
    with np.load(Path(__file__).with_name(FILE), allow_pickle=False) as stored:
        keys, counts = stored["keys"].tolist(), stored["counts"]
        corners, normals = stored["corners"].reshape(-1, 3), stored["normals"].reshape(-1, 3, 3)
    ends = np.cumsum(counts)
    parts = [slice(end - count, end) for end, count in zip(ends.tolist(), counts.tolist(), strict=True)]
    return {
        key: (corners[part], normals[part].astype(np.float32) / NORMAL_SCALE)
        for key, part in zip(keys, parts, strict=True)
    }


def _replace(model: mujoco.MjModel, mesh: Mesh, corners: np.ndarray, normals: np.ndarray) -> None:
    count = len(corners)
    face, texcoord = mesh.face.ravel()[corners], mesh.face_texcoord.ravel()
    distinct, rows = np.unique(normals.reshape(-1, 3), axis=0, return_inverse=True)
    if len(distinct) <= len(mesh.normal):
        length = np.linalg.norm(distinct, axis=1, keepdims=True)
        mesh.normal[: len(distinct)] = distinct / np.maximum(length, 1 / NORMAL_SCALE)
        mesh.face_normal[:count] = rows.reshape(-1, 3)
    else:  # a smooth mesh, whose few normals do as they are
        mesh.face_normal[:count] = mesh.face_normal.ravel()[corners]
    mesh.face[:count] = face
    if len(texcoord):
        mesh.face_texcoord[:count] = texcoord[corners]
    model.mesh_facenum[mesh.index] = count
