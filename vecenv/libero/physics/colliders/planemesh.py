"""Contacts of a mesh on a plane as MuJoCo 2.3 to 3.3 chose them, compiled by numba.

In: a plane, a convex mesh with the graph of its hull, and a margin. Out: up to three contacts. The lowest vertex is the
first; its neighbours in the hull follow if they are below the plane and further from it than three tenths of the mesh's
bounding radius, in the order of the graph. From 3.13.0 on MuJoCo also keeps neighbours that are closer: a hand that
lies on the floor then rests on two or three points a few millimetres apart instead of one.

The method is the one of MuJoCo 3.3.0 (``mjc_PlaneConvex``). Meshes without a hull are left to the installed MuJoCo.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numba import types

from vecenv.util.compiled import carray, compile_for_c, floats_at, int32s_at, part, singles_at, stack_array

MOST = 3
# Columns of a contact, see ``vecenv.libero.physics.colliders.boxbox``.
_COLUMNS = 10
_APART = 0.3


@functools.cache
def compiled() -> Any:
    """``_collide`` as a C function."""
    pointer = types.uintp
    return compile_for_c(types.int32(*[pointer] * 6, *[types.float64] * 2, pointer), _collide)


def _collide(
    plane_pos: int,
    plane_mat: int,
    pos: int,
    mat: int,
    vertices: int,
    graph: int,
    radius: float,
    margin: float,
    rows: int,
) -> int:
    """Write contacts to ``rows`` [3, 10] and return their number.

    Args:
        plane_pos, plane_mat, pos, mat: addresses of the poses of plane and mesh, float64.
        vertices: address of the mesh's vertices, float32 [n, 3].
        graph: address of its hull, int32: numbers of vertices and faces, then for each vertex where its neighbours
            begin, then its index among ``vertices``, then the neighbours, each list closed by -1.
        radius: bounding radius of the mesh, metres.
        margin: contacts up to this distance are reported, metres.
        rows: address of the contacts.
    """
    turn, at = carray(floats_at(plane_mat), (9,)), carray(floats_at(plane_pos), (3,))
    own, centre = carray(floats_at(mat), (9,)), carray(floats_at(pos), (3,))
    hull = carray(int32s_at(graph), (2,))
    count, faces = hull[0], hull[1]
    hull = carray(int32s_at(graph), (2 + 3 * count + 3 * faces,))
    points = carray(singles_at(vertices), (1, 3))
    found = carray(floats_at(rows), (MOST, _COLUMNS))
    down = carray(stack_array(3), (3,))  # the mesh's own direction towards the plane
    for i in range(3):
        down[i] = own[i] * -turn[2] + own[3 + i] * -turn[5] + own[6 + i] * -turn[8]
    lowest = _lowest(hull, count, points, down)
    if not _contact(points, hull[2 + count + lowest], turn, at, own, centre, found, 0, -1.0, margin):
        return 0
    written, edge = 1, 2 + 2 * count + hull[2 + lowest]
    while hull[edge] >= 0 and written < MOST:
        vertex = hull[2 + count + hull[edge]]
        if _contact(points, vertex, turn, at, own, centre, found, written, _APART * radius, margin):
            written += 1
        edge += 1
    return written


@part
def _lowest(hull: np.ndarray, count: int, points: np.ndarray, down: np.ndarray) -> Any:
    """Number of the hull's vertex furthest along a direction, reached from the first along its edges."""
    best, height, climbing = 0, _along(points, hull[2 + count], down), True
    while climbing:
        climbing = False
        edge = 2 + 2 * count + hull[2 + best]
        while hull[edge] >= 0:
            value = _along(points, hull[2 + count + hull[edge]], down)
            if value > height:
                best, height, climbing = hull[edge], value, True
            edge += 1
    return best


@part
def _along(points: np.ndarray, vertex: int, down: np.ndarray) -> float:
    return down[0] * points[vertex, 0] + down[1] * points[vertex, 1] + down[2] * points[vertex, 2]


@part
def _contact(
    points: np.ndarray,
    vertex: int,
    turn: np.ndarray,
    at: np.ndarray,
    own: np.ndarray,
    centre: np.ndarray,
    found: np.ndarray,
    row: int,
    apart: float,
    margin: float,
) -> bool:
    """Write a vertex's contact to a row, if it is within the margin and far enough from the first contact."""
    place = carray(stack_array(3), (3,))
    distance, gap = 0.0, 0.0
    for i in range(3):
        x, y, z = points[vertex, 0], points[vertex, 1], points[vertex, 2]
        place[i] = own[3 * i] * x + own[3 * i + 1] * y + own[3 * i + 2] * z + centre[i]
        distance += turn[3 * i + 2] * (place[i] - at[i])
        gap += (place[i] - found[0, 1 + i]) * (place[i] - found[0, 1 + i])
    if distance > margin or (apart >= 0 and math.sqrt(gap) < apart):
        return False
    found[row, 0] = distance
    for i in range(3):
        found[row, 1 + i] = place[i] - turn[3 * i + 2] * 0.5 * distance
        found[row, 4 + i], found[row, 7 + i] = turn[3 * i + 2], 0.0
    return True
