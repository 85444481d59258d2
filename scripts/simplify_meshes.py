"""Make ``vecenv/libero/render/simplified.npz``: simplified versions of all meshes that LIBERO's scenes draw.

Needs meshoptimizer's Python package (``pip install meshoptimizer``, a C++ compiler); users of vecenv need neither.
Simplification stops at an error that no camera of the benchmark resolves: a pixel of the third-person image is about
3 mm on the table, one of the wrist camera 1 mm at 20 cm. Run it again when the asset packages change.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vecenv.libero.render import lod
from vecenv.libero.scene.scene import compile_scene
from vecenv.libero.tasks import suites

# Largest error in metres by level: of the gripper, which fills a third of the wrist image, of what it handles, and of
# what stands at least a metre away.
ERRORS = {"exact": (0.00001, 0.000015, 0.000015), "fast": (0.0002, 0.00035, 0.0007)}
# Share of the error for meshes of these names: strips of a weave are not much thicker than it, and the highlights of a
# shiny black bowl move with every normal; a microwave's panels and a book's pages are flat and show it.
FINER = {
    "basket": 0.7,
    "akita_black_bowl": 0.4,
    "bigger_akita_black_bowl": 0.7,
    "microwave": 0.1,
    "black_book": 0.1,
    "yellow_book": 0.1,
}
# Texture in pieces shows errors sooner: this many vertices a place or more, and this share of the error.
PATCHY, PATCHY_SHARE = 1.25, {"exact": 1.0, "fast": 0.3}
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
    found: dict[str, dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    before = 0
    for task in _tasks_with_everything():
        start, scene = time.time(), compile_scene(task.problem(), visual=True)
        entities = tuple(scene.entities)
        for index in lod.drawn_meshes(scene.model):
            mesh, name = lod.Mesh.of(scene.model, index), scene.model.mesh(index).name
            if mesh.key not in found and len(mesh.face) > 100:
                textured = _textured(scene.model, index)
                errors = {level: _error(name, entities, level) for level in ERRORS}
                found[mesh.key] = {level: simplified(mesh, textured, level, errors[level]) for level in ERRORS}
                before += len(mesh.face)
        print(f"{task.suite} {task.index}: {len(found)} meshes, {time.time() - start:.0f} s", file=sys.stderr)
    path = Path(lod.__file__).with_name(lod.FILE)
    arrays: Any = {
        name: array for level in ERRORS for name, array in _stored(level, [m[level] for m in found.values()])
    }
    np.savez_compressed(path, keys=np.array(list(found)), **arrays)
    after = ", ".join(f"{arrays[f'{n}_counts'].sum() + arrays[f'{n}_kept_counts'].sum()} ({n})" for n in ERRORS)
    print(f"{before} triangles became {after}; {path.name}: {path.stat().st_size / 1e6:.1f} MB")


def _stored(level: str, meshes: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Iterator[tuple[str, np.ndarray]]:
    """What the file has of a level (``vecenv.libero.render.lod.simplified``): kept triangles as steps from one to the
    next."""
    kept, corners, normals = zip(*meshes, strict=True)
    yield f"{level}_kept", np.concatenate([np.diff(rows, prepend=0) for rows in kept]).astype(np.uint32)
    yield f"{level}_kept_counts", np.array([len(rows) for rows in kept])
    yield f"{level}_corners", np.concatenate(corners).astype(np.uint32)
    yield f"{level}_counts", np.array([len(rows) for rows in corners])
    yield f"{level}_normals", np.concatenate(normals)


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


def _error(mesh: str, entities: tuple[str, ...], level: str) -> float:
    tool, near, far = ERRORS[level]
    if mesh.startswith("gripper0_"):
        return tool
    if mesh.startswith((*entities, "robot0_")) and not mesh.startswith(_FAR_NAMES):
        return near * next((share for name, share in FINER.items() if mesh.startswith(name)), 1.0)
    return far


def _textured(model, index: int) -> bool:
    geoms = np.flatnonzero((model.geom_dataid == index) & (model.geom_matid >= 0) & (model.geom_group == 1))
    return bool((model.mat_texid[model.geom_matid[geoms]] >= 0).any())


def simplified(mesh: lod.Mesh, textured: bool, level: str, error: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A simplified mesh: original triangles that stay, int [k], and corners [n, 3] of new ones, which are corners of
    the original, with quantised normals, int8 [n, 3, 3].
    """
    pos = mesh.vert[mesh.face.ravel()]
    normal = mesh.normal[mesh.face_normal.ravel()]
    place = np.unique(pos, axis=0, return_inverse=True)[1].ravel()
    keys = [pos]
    if textured and len(mesh.texcoord):
        keys.append(mesh.texcoord[mesh.face_texcoord.ravel()])
    merged, first, inverse = np.unique(np.concatenate(keys, axis=1), axis=0, return_index=True, return_inverse=True)
    inverse = inverse.ravel()
    normal_weight = FAR_NORMAL_WEIGHT if error == ERRORS["fast"][-1] and textured else NORMAL_WEIGHT
    if len(merged) > PATCHY * (place.max() + 1):
        error *= PATCHY_SHARE[level]
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
    same = _same(inverse.reshape(-1, 3), kept)
    corners = first[kept[same < 0]]
    flat = np.repeat(cross, 3, axis=0) / np.maximum(weight, 1e-20)
    return np.sort(same[same >= 0]), corners, _normals(corners, pos, flat, normal * weight, normal, place)


def _same(faces: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which of the faces [m, 3] each other one [n, 3] is, up to where it begins; -1 for none."""
    keys, wanted = _face_keys(faces), _face_keys(others)
    order = np.argsort(keys, kind="stable")
    at = order[np.minimum(np.searchsorted(keys[order], wanted), len(order) - 1)]
    return np.where(keys[at] == wanted, at, -1)


def _face_keys(faces: np.ndarray) -> np.ndarray:
    """A number for each face, int64 [n]: its smallest vertex and, in turn, the others."""
    turns = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces.astype(np.int64), turns, axis=1).T
    return (a << 42) | (b << 21) | c


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
