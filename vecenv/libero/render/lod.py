"""Levels of detail: simplified meshes, which look the same or nearly so and take less time to draw.

In: the compiled visual model of a scene. Out: the same model, its visual meshes replaced in place by simplified ones;
geoms, materials, textures and everything else stay. ``"exact"`` removes detail far below a pixel, ``"fast"`` more,
``"original"`` none. The simplified meshes come with the package (``simplified.npz``, made by
``scripts/simplify_meshes.py``) and are found by the content of the mesh they replace, so an unknown mesh is drawn
as it is. Every triangle corner of a simplified mesh is a corner of the original, position and texture
coordinate alike; triangles that are new have new normals, averages of what was around.
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
# The levels in the file.
STORED = ("exact", "fast")
# Meshes of fewer triangles are not simplified: it would save little and, close to a camera, change the shade of a knob
# or of a book's pages (38 to 41 dB).
LEAST = {"exact": 8000, "fast": 0}
# Joint positions are rounded to this before they are drawn, metres and radians: objects at rest, which physics lets
# creep, then have one pose. It moves surfaces by less than a tenth of what the level itself does.
GRID = {"original": 0.0, "exact": 1e-6, "fast": 2e-5}
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
        """Hash of its shape and texture coordinates, 16 hexadecimal digits."""
        digest = hashlib.sha256()
        for array in (self.vert, self.face, self.texcoord, self.face_texcoord):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]


def drawn_meshes(model: mujoco.MjModel) -> Iterator[int]:
    """Meshes of the geoms that are drawn (group 1), each once."""
    drawn = (model.geom_group == 1) & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    yield from np.unique(model.geom_dataid[drawn]).tolist()


@dataclass(frozen=True)
class Simplified:
    """A simplified mesh, in terms of its original.

    Attributes:
        kept: triangles that stay as they are, int [k].
        corners: new triangles, as corners (3 * triangle + corner) of the original, int [n, 3].
        normals: of the new triangles' corners, float32 [n, 3, 3].
    """

    kept: np.ndarray
    corners: np.ndarray
    normals: np.ndarray


def simplify(model: mujoco.MjModel, level: str = "fast") -> int:
    """Replace the drawn meshes of a model by the simplified ones that are known; returns how many triangles remain.

    Geoms that collide share no mesh with geoms that are drawn, and if one did, it would collide as before: MuJoCo
    collides with convex hulls, which are left alone.

    Args:
        model: a visual model as compiled.
        level: ``"original"``, ``"exact"`` or ``"fast"``.
    """
    known, left = simplified(level) if level in STORED else {}, 0
    for index in drawn_meshes(model):
        mesh = Mesh.of(model, index)
        if known and len(mesh.face) >= LEAST[level] and mesh.key in known:
            _replace(model, mesh, known[mesh.key])
        left += int(model.mesh_facenum[index])
    return left


@functools.cache
def simplified(level: str) -> Mapping[str, Simplified]:
    """The simplified meshes of a level, by the key of their original."""
    with np.load(Path(__file__).with_name(FILE), allow_pickle=False) as stored:
        keys = stored["keys"].tolist()
        steps, kept_counts = stored[f"{level}_kept"].astype(np.int64), stored[f"{level}_kept_counts"]
        corners, counts = stored[f"{level}_corners"].astype(np.int64).reshape(-1, 3), stored[f"{level}_counts"]
        normals = stored[f"{level}_normals"].reshape(-1, 3, 3).astype(np.float32) / NORMAL_SCALE
    cuts, kept_cuts = np.cumsum(counts)[:-1], np.cumsum(kept_counts)[:-1]
    parts = zip(np.split(steps, kept_cuts), np.split(corners, cuts), np.split(normals, cuts), strict=True)
    return {key: Simplified(np.cumsum(a), b, c) for key, (a, b, c) in zip(keys, parts, strict=True)}


def _replace(model: mujoco.MjModel, mesh: Mesh, new: Simplified) -> None:
    count, corners = len(new.kept) + len(new.corners), new.corners
    rows = _normal_rows(mesh, new)
    for array, more in (
        (mesh.face, mesh.face.ravel()[corners]),
        (mesh.face_texcoord, mesh.face_texcoord.ravel()[corners] if len(mesh.face_texcoord) else None),
        (mesh.face_normal, rows),
    ):
        if more is not None:
            array[:count] = np.concatenate([array[new.kept], more])
    model.mesh_facenum[mesh.index] = count


def _normal_rows(mesh: Mesh, new: Simplified) -> np.ndarray:
    """Rows of the mesh's normals for the new triangles, int [n, 3]; rows that nothing uses any more are overwritten.

    If there are too few of those, the corners keep their normals: the mesh is smooth, and its few normals suffice.
    """
    distinct, which = np.unique(new.normals.reshape(-1, 3), axis=0, return_inverse=True)
    unused = np.setdiff1d(np.arange(len(mesh.normal)), mesh.face_normal[new.kept])
    if len(unused) < len(distinct):
        return mesh.face_normal.ravel()[new.corners]
    rows = unused[: len(distinct)]
    length = np.linalg.norm(distinct, axis=1, keepdims=True)
    mesh.normal[rows] = distinct / np.maximum(length, 1 / NORMAL_SCALE)
    return rows[which.reshape(-1, 3)]
