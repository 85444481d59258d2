"""The convex parts of an object's collision mesh, as upstream's simulator takes them.

In: a Wavefront OBJ file. Out: the vertices of each part. A part is what hangs together by its faces within one named
object of the file, vertices at the same place being one: SAPIEN 2 splits files like that, SAPIEN 3 by the names alone.
A spoon of four parts would become one hull, and weigh 1.8 times as much.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vecenv.errors import InvalidInput


class MeshError(InvalidInput):
    """A collision mesh that cannot be read; the message names the file."""


def read_parts(path: Path) -> list[np.ndarray]:
    """Vertices of every part, metres, float32 [n, 3] each, in the order of the file.

    Raises:
        MeshError: the file has no faces, or a line that is not what it should be.
    """
    vertices, edges, owners = _read(path)
    corners = np.column_stack([np.repeat(owners, 2), vertices[edges.ravel()]])
    _, begins, index = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    # Hulls depend a little on the order of their vertices: that of the faces, as upstream's.
    places, ranks = corners[np.sort(begins)], np.argsort(np.argsort(begins))
    joined = ranks[index.reshape(-1, 2)]
    graph = coo_matrix((np.ones(len(joined)), joined.T), shape=(len(places), len(places)))
    _, labels = connected_components(graph, directed=False)
    first = labels[joined[:, 0]]
    return [places[labels == label, 1:].astype(np.float32) for label in dict.fromkeys(first.tolist())]


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [n, 3], the edges of the faces [m, 2], and which named object each edge belongs to, [m]."""
    vertices: list[list[float]] = []
    edges: list[tuple[int, int]] = []
    owners: list[int] = []
    owner = 0
    try:
        for line in path.read_text().splitlines():
            kind, *words = line.split() or [""]
            owner += kind in ("o", "g")
            if kind == "v":
                vertices.append([float(word) for word in words[:3]])
            elif kind == "f":
                corners = [_index(word, len(vertices)) for word in words]
                edges += itertools.pairwise(corners)
                owners += [owner] * (len(corners) - 1)
    except (OSError, ValueError) as error:
        raise MeshError(f"{path}: {error}") from error
    found = np.array(vertices, float).reshape(-1, 3)
    if not edges or np.max(edges) >= len(found):
        raise MeshError(f"{path}: no faces, or faces of vertices that are not there")
    return found, np.array(edges), np.array(owners)


def _index(word: str, count: int) -> int:
    """Index of a vertex that a face names: from 1, or backwards from -1."""
    number = int(word.split("/", 1)[0])
    return number - 1 if number > 0 else count + number
