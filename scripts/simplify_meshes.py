"""Make ``vecenv/render/simplified.npz``: simplified versions of all meshes that LIBERO's scenes draw.

Needs meshoptimizer's Python package (``pip install meshoptimizer``, a C++ compiler); users of vecenv need neither.
Simplification stops at an error that no camera of the benchmark resolves: a pixel of the third-person image is about
3 mm on the table, one of the wrist camera 1 mm at 20 cm. Run it again when the asset packages change.
"""

from __future__ import annotations

import ctypes
import sys
import time
from pathlib import Path

import numpy as np

from vecenv.libero import suites
from vecenv.libero.scene import compile_scene
from vecenv.render import lod

# Largest error in metres: of the gripper, which fills a third of the wrist image, of what it handles, and of what
# stands at least a metre away.
TOOL, NEAR, FAR = 0.0001, 0.00035, 0.0007
# Texture in pieces shows errors sooner: this many vertices a place or more, and this share of the error.
PATCHY, PATCHY_SHARE = 1.25, 0.3
# How many metres of error a difference of 1 counts as: in texture coordinates, as a share of the mesh's diagonal (a
# texture covers about one side of it), and in normals.
TEXCOORD_SHARE, NORMAL_WEIGHT = 0.5, 0.001
# Cabinets are shaded round over narrow bevels; without those the shade would run over the whole panel.
FAR_NORMAL_WEIGHT = 0.01
CREASE = np.cos(np.deg2rad(28))
_FAR_NAMES = ("mount0_", *(f"robot0_link{i}_" for i in range(5)))
_ABSOLUTE = 1 << 2


def main() -> None:
    """Simplify what all scenes draw and write the file."""
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    before = after = 0
    for task in _tasks_with_everything():
        start, scene = time.time(), compile_scene(task.problem(), visual=True)
        entities = tuple(scene.entities)
        for index in lod.drawn_meshes(scene.model):
            mesh, name = lod.Mesh.of(scene.model, index), scene.model.mesh(index).name
            if mesh.key not in found and len(mesh.face) > 100:
                corners, normals = simplified(mesh, _textured(scene.model, index), _error(name, entities))
                found[mesh.key] = corners, normals
                before, after = before + len(mesh.face), after + len(corners)
        print(f"{task.suite} {task.index}: {len(found)} meshes, {time.time() - start:.0f} s", file=sys.stderr)
    path = Path(lod.__file__).with_name(lod.FILE)
    np.savez_compressed(
        path,
        keys=np.array(list(found)),
        counts=np.array([len(corners) for corners, _ in found.values()]),
        corners=np.concatenate([corners for corners, _ in found.values()]).astype(np.uint32),
        normals=np.concatenate([normals for _, normals in found.values()]),
    )
    print(f"{before} triangles became {after}; {path.name}: {path.stat().st_size / 1e6:.1f} MB")


def _tasks_with_everything() -> list[suites.TaskSpec]:
    """Tasks that together have every workspace and every category."""
    chosen, seen = [], set()
    for suite in suites.list_suites():
        for task in suites.list_tasks(suite):
            problem = task.problem()
            things = {problem.name, *(i.category for i in (*problem.objects, *problem.fixtures))}
            if things - seen:
                chosen.append(task)
                seen |= things
    return chosen


def _error(mesh: str, entities: tuple[str, ...]) -> float:
    if mesh.startswith("gripper0_"):
        return TOOL
    return NEAR if mesh.startswith((*entities, "robot0_")) and not mesh.startswith(_FAR_NAMES) else FAR


def _textured(model, index: int) -> bool:
    geoms = np.flatnonzero((model.geom_dataid == index) & (model.geom_matid >= 0) & (model.geom_group == 1))
    return bool((model.mat_texid[model.geom_matid[geoms]] >= 0).any())


def simplified(mesh: lod.Mesh, textured: bool, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the original [n, 3] and quantised normals, int8 [n, 3, 3], of a simplified mesh."""
    pos = mesh.vert[mesh.face.ravel()]
    normal = mesh.normal[mesh.face_normal.ravel()]
    place = np.unique(pos, axis=0, return_inverse=True)[1].ravel()
    keys = [pos]
    if textured and len(mesh.texcoord):
        keys.append(mesh.texcoord[mesh.face_texcoord.ravel()])
    merged, first, inverse = np.unique(np.concatenate(keys, axis=1), axis=0, return_index=True, return_inverse=True)
    inverse = inverse.ravel()
    normal_weight = FAR_NORMAL_WEIGHT if error == FAR and textured else NORMAL_WEIGHT
    if len(merged) > PATCHY * (place.max() + 1):
        error *= PATCHY_SHARE
    triangles = place.reshape(-1, 3)
    proper = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    sides = pos.reshape(-1, 3, 3)
    cross = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    weight = np.repeat(np.linalg.norm(cross, axis=1), 3)[:, None]
    smooth = np.zeros((len(merged), 3))
    np.add.at(smooth, inverse, normal * weight)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    texcoord_weight = TEXCOORD_SHARE * float(np.linalg.norm(np.ptp(pos, axis=0)))
    attributes = np.concatenate([merged[:, 3:] * texcoord_weight, smooth * normal_weight], axis=1)
    kept = _meshopt(inverse.reshape(-1, 3)[proper], merged[:, :3], attributes, error)
    corners = first[kept]
    flat = np.repeat(cross, 3, axis=0) / np.maximum(weight, 1e-20)
    return corners, _normals(corners, pos, flat, normal * weight, normal, place)


def _normals(
    corners: np.ndarray, pos: np.ndarray, flat: np.ndarray, weighted: np.ndarray, normal: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Of each corner, the mean normal of the original triangles at its place that face as its own does."""
    sides = pos[corners]
    own = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    own /= np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-20)
    own = np.repeat(own, 3, axis=0)
    order = np.argsort(place, kind="stable")
    starts = np.searchsorted(place[order], np.arange(place.max() + 2))
    at = place[corners.ravel()]
    counts = starts[at + 1] - starts[at]
    row = np.repeat(np.arange(len(at)), counts)
    offset = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    source = order[starts[at][row] + offset]
    # Compared are faces, not normals: some files' normals point anywhere.
    facing = np.einsum("ij,ij->i", flat[source], own[row])
    ranked = np.lexsort((facing, row))  # the last of each row faces best
    best = source[ranked[np.cumsum(counts) - 1]]
    alike = np.einsum("ij,ij->i", flat[source], flat[best][row]) > CREASE
    mean = np.zeros((len(at), 3))
    np.add.at(mean, row[alike], weighted[source[alike]])
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    mean = np.where(length > 1e-20, mean / np.maximum(length, 1e-20), normal[best])
    return np.round(mean * lod.NORMAL_SCALE).astype(np.int8).reshape(-1, 3, 3)


def _meshopt(faces: np.ndarray, pos: np.ndarray, attributes: np.ndarray, error: float) -> np.ndarray:
    """Faces [n, 3] of vertices of the original that stay within an error, metres.

    The function is called directly: the package's wrapper (0.2.30a0) passes its arguments in another order.
    """
    from meshoptimizer._loader import find_library  # pyright: ignore[reportMissingImports]

    call = ctypes.CDLL(find_library()).meshopt_simplifyWithAttributes
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    call.restype = size
    call.argtypes = [pointer, pointer, size, pointer, size, size, pointer, size, pointer, size, pointer, size]
    call.argtypes += [ctypes.c_float, ctypes.c_uint, pointer]
    indices = np.ascontiguousarray(faces.ravel(), np.uint32)
    pos, attributes = np.ascontiguousarray(pos, np.float32), np.ascontiguousarray(attributes, np.float32)
    weights, kept = np.ones(attributes.shape[1], np.float32), np.zeros_like(indices)
    count = call(
        kept.ctypes.data, indices.ctypes.data, len(indices), pos.ctypes.data, len(pos), pos.strides[0],
        attributes.ctypes.data, attributes.strides[0], weights.ctypes.data, len(weights), None,
        3, error, _ABSOLUTE, None,
    )  # fmt: skip
    return kept[:count].reshape(-1, 3).astype(np.int64)


if __name__ == "__main__":
    main()
