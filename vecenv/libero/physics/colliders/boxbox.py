"""Contacts of two boxes as MuJoCo 2.3 to 3.3 computed them, compiled by numba.

In: centres, rotations and half sizes of two boxes, and a margin. Out: up to eight contacts, each with distance,
position and normal, in MuJoCo's order. Everything is float64, in the world frame, metres; the normal points from the
first box to the second, a negative distance is a penetration.

The method is the one of MuJoCo 3.3.0 (``mjc_BoxBox`` and the clean-up in ``mj_collideGeoms``); 3.4.0 changed the depth
of face contacts and 3.12.0 replaced the collider. Fifteen separating axes are tried: the axis of least overlap decides.

* A face axis: the lowest vertex, edge or face of the other box is clipped against the rectangle of the reference face.
  Positions lie half-way between the two surfaces, and **the distance is half the depth**, which is what distinguishes
  these contacts from those of MuJoCo 3.4 and later.
* An edge axis: a face next to the second box's edge is projected along the axis onto a face next to the first box's
  edge, and clipped there. Distances are whole.

Sums are taken in MuJoCo's order, because a tie between two axes (boxes stacked squarely) is decided by rounding.
``tests/libero/physics/test_boxbox.py`` holds the results against recordings of MuJoCo 3.3.0.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numba import types

from vecenv.util.compiled import carray, compile_for_c, floats_at, part, stack_array

# Contacts a pair can have: what MuJoCo 3.17 reserves for two boxes.
MOST = 8
# Columns of a contact as MuJoCo's collision functions write it (``mjPreContact``): distance, position [3], normal [3],
# first tangent [3]; a tangent of zero lets MuJoCo choose one.
COLUMNS = 10

# Candidates before the clean-up: sixteen crossings of edges, four corners of the face, four corners of the other box.
_CANDIDATES = 24
_MINVAL = 1e-15
# A contact further outside one box than this share of its size, and not well inside the other, is dropped.
_OUTSIDE = 1.01
# Frames of the faces +x +y +z -x -y -z: coordinate i of the frame is _SIGN[face, i] times coordinate _AXIS[face, i] of
# the box. The third points out of the face, the first two span it.
_AXIS = np.array([[2, 1, 0], [0, 2, 1], [0, 1, 2], [2, 1, 0], [0, 2, 1], [0, 1, 2]])
_SIGN = np.array([[-1.0, 1, 1], [1, -1, 1], [1, 1, 1], [1, 1, -1], [1, 1, -1], [-1, 1, -1]])


def box_box(
    pos1: np.ndarray,
    mat1: np.ndarray,
    size1: np.ndarray,
    pos2: np.ndarray,
    mat2: np.ndarray,
    size2: np.ndarray,
    margin: float = 0.0,
) -> np.ndarray:
    """Contacts of two boxes, a row each: distance, position [3], normal [3]; [n, 7] with n from 0 to 8.

    Args:
        pos1, pos2: centres, metres, world frame, [3].
        mat1, mat2: rotations to the world frame, [3, 3].
        size1, size2: half sizes, metres, [3].
        margin: contacts up to this distance are reported, metres.
    """
    rows = np.zeros((MOST, COLUMNS))
    boxes = [np.ascontiguousarray(value, float) for value in (pos1, mat1, size1, pos2, mat2, size2)]
    count = compiled().ctypes(*(box.ctypes.data for box in boxes), float(margin), rows.ctypes.data)
    return rows[:count, :7]


@functools.cache
def compiled() -> Any:
    """``_collide`` as a C function of addresses: pose and half size of either box, margin (a number), rows."""
    return compile_for_c(types.int32(*[types.uintp] * 6, types.float64, types.uintp), _collide)


def _collide(pos1: Any, mat1: Any, size1: Any, pos2: Any, mat2: Any, size2: Any, margin: Any, rows: Any) -> Any:
    """Write contacts to ``rows`` [8, 10] and return their number."""
    return _contacts(
        carray(floats_at(pos1), (3,)),
        carray(floats_at(mat1), (9,)),
        carray(floats_at(size1), (3,)),
        carray(floats_at(pos2), (3,)),
        carray(floats_at(mat2), (9,)),
        carray(floats_at(size2), (3,)),
        margin,
        carray(floats_at(rows), (MOST, COLUMNS)),
    )


@part
def _contacts(pos1: Any, mat1: Any, size1: Any, pos2: Any, mat2: Any, size2: Any, margin: Any, rows: Any) -> int:
    rot = carray(stack_array(9), (3, 3))  # the second box's axes, as columns, in the frame of the first
    between = carray(stack_array(6), (2, 3))  # from either centre to the other, in its own frame
    axis = carray(stack_array(3), (3,))
    _relative(pos1, mat1, pos2, mat2, rot, between)
    code = _least_overlap(size1, size2, rot, between, margin, axis)
    if code < 0:
        return 0
    points = carray(stack_array(72), (_CANDIDATES, 3))
    depth = carray(stack_array(24), (_CANDIDATES,))
    normal = carray(stack_array(3), (3,))
    if code >= 12:
        count = _edge_contacts(code - 12, pos1, mat1, size1, size2, rot, between, axis, margin, points, depth, normal)
    elif code >= 6:
        turned = carray(stack_array(9), (3, 3))
        for i in range(3):
            for k in range(3):
                turned[i, k] = rot[k, i]
        count = _face_contacts(code - 6, pos2, mat2, size2, size1, turned, between[1], margin, points, depth, normal)
        for i in range(3):
            normal[i] = -normal[i]
    else:
        count = _face_contacts(code, pos1, mat1, size1, size2, rot, between[0], margin, points, depth, normal)
    return _keep_good(pos1, mat1, size1, pos2, mat2, size2, margin, points, depth, normal, count, rows)


# ---------------------------------------------------------------------------------------------------------------------
# Separating axes.


@part
def _relative(pos1: Any, mat1: Any, pos2: Any, mat2: Any, rot: Any, between: Any) -> None:
    x, y, z = pos2[0] - pos1[0], pos2[1] - pos1[1], pos2[2] - pos1[2]
    for i in range(3):
        between[0, i] = mat1[i] * x + mat1[3 + i] * y + mat1[6 + i] * z
        between[1, i] = mat2[i] * -x + mat2[3 + i] * -y + mat2[6 + i] * -z
        for k in range(3):
            rot[i, k] = mat1[i] * mat2[k] + mat1[3 + i] * mat2[3 + k] + mat1[6 + i] * mat2[6 + k]


@part
def _least_overlap(size1: Any, size2: Any, rot: Any, between: Any, margin: Any, axis: Any) -> int:
    """The axis of least overlap; -1 where one separates the boxes.

    0 to 5: a face of the first box (+x +y +z -x -y -z); 6 to 11: of the second; 12 + 3 i + k: edge i of the first box
    across edge k of the second, whose unit axis, in the frame of the first box, is written to ``axis``.
    """
    least, code = margin, -1
    for i in range(3):
        least += size1[i] * 3 + size2[i] * 3
    for i in range(3):
        reach2 = abs(rot[i, 0]) * size2[0] + abs(rot[i, 1]) * size2[1] + abs(rot[i, 2]) * size2[2]
        reach1 = abs(rot[0, i]) * size1[0] + abs(rot[1, i]) * size1[1] + abs(rot[2, i]) * size1[2]
        overlap1 = -abs(between[0, i]) + size1[i] + reach2
        overlap2 = -abs(between[1, i]) + size2[i] + reach1
        if overlap1 < -margin or overlap2 < -margin:
            return -1
        if overlap1 < least:
            least, code = overlap1, i + (3 if between[0, i] < 0 else 0)
        if overlap2 < least:
            least, code = overlap2, i + (3 if between[1, i] < 0 else 0) + 6
    for i in range(3):
        low, high = (1 if i == 0 else 0), (1 if i == 2 else 2)  # the coordinates other than i
        side = -1.0 if i == 1 else 1.0
        for k in range(3):
            # Edge i crossed with edge k has no component along i.
            at_low, at_high = -side * rot[high, k], side * rot[low, k]
            length = math.sqrt(at_low * at_low + at_high * at_high)
            if length < _MINVAL:
                continue
            scale = 1 / length
            at_low, at_high = at_low * scale, at_high * scale
            overlap = size1[low] * abs(at_low) + size1[high] * abs(at_high)
            for other in range(3):
                if other != k:
                    overlap += size2[other] * abs(rot[i, 3 - other - k]) / length
            overlap -= abs(between[0, low] * at_low + between[0, high] * at_high)
            if overlap < -margin:
                return -1
            if overlap < least * (1 - 1e-12):
                least, code = overlap, 12 + 3 * i + k
                axis[i], axis[low], axis[high] = 0.0, at_low, at_high
    return code


# ---------------------------------------------------------------------------------------------------------------------
# A face of one box and the lowest vertex, edge or face of the other.


@part
def _face_contacts(
    face: Any,
    pos: Any,
    mat: Any,
    size: Any,
    other_size: Any,
    other_axes: Any,
    other_centre: Any,
    margin: Any,
    points: Any,
    depth: Any,
    normal: Any,
) -> int:
    """Candidates on a face of a box, in the world frame: ``points``, ``depth`` (halved) and the outward ``normal``.

    ``other_axes`` (columns) and ``other_centre`` are the other box's, in this box's frame.
    """
    axes = carray(stack_array(9), (3, 3))
    half = carray(stack_array(3), (3,))
    corner = carray(stack_array(3), (3,))
    _turn_into_face(face, size, other_axes, other_centre, axes, half, corner)
    lowest = 0  # bit k: the lowest corner lies towards plus along axis k
    for k in range(3):
        if axes[2, k] < 0:
            lowest |= 1 << k
    for k in range(3):
        step = other_size[k] * (1 if lowest & (1 << k) else -1)
        for i in range(3):
            corner[i] += axes[i, k] * step
    edges = carray(stack_array(6), (2, 3))
    flat = 0
    for k in range(3):
        if abs(axes[2, k]) < 0.5 and flat < 2:  # three would be shorter than a unit vector
            step = other_size[k] * (-2 if lowest & (1 << k) else 2)
            for i in range(3):
                edges[flat, i] = axes[i, k] * step
            flat += 1
    count = _clip_lines(corner, edges, flat, half, points)
    if flat == 2:
        count = _corners_below(corner, edges, half, points, count)
    count = _vertices_above(corner, edges, flat, half, points, count)
    kept = 0
    for n in range(count):
        if points[n, 2] > margin:
            continue
        depth[kept] = points[n, 2] * 0.5
        points[kept, 0], points[kept, 1], points[kept, 2] = points[n, 0], points[n, 1], depth[kept]
        kept += 1
    _to_world(face, pos, mat, half[2], points, kept)
    for i in range(3):
        normal[i] = mat[3 * i + _AXIS[face, 2]] * _SIGN[face, 2]
    return kept


@part
def _turn_into_face(face: Any, size: Any, matrix: Any, vector: Any, axes: Any, half: Any, place: Any) -> None:
    """Rows of a matrix, half sizes and a vector of a box's frame in that of its face, whose origin is on the face."""
    for i in range(3):
        k, sign = _AXIS[face, i], _SIGN[face, i]
        for j in range(3):
            axes[i, j] = matrix[k, j] * sign
        half[i] = size[k]
        place[i] = vector[k] * sign
    place[2] -= half[2]


@part
def _to_world(face: Any, pos: Any, mat: Any, height: Any, points: Any, count: Any) -> None:
    """Points of a face's frame, in place; ``height`` is how far the face is from its box's centre."""
    a, b, c = _AXIS[face, 0], _AXIS[face, 1], _AXIS[face, 2]
    sa, sb, sc = _SIGN[face, 0], _SIGN[face, 1], _SIGN[face, 2]
    for n in range(count):
        x, y, z = points[n, 0], points[n, 1], points[n, 2] + height
        for i in range(3):
            row = 3 * i
            points[n, i] = mat[row + a] * sa * x + mat[row + b] * sb * y + mat[row + c] * sc * z + pos[i]


@part
def _line(corner: Any, edges: Any, number: Any, i: Any) -> Any:
    """Origin and step, along coordinate i, of the four sides of a parallelogram; the first alone is an edge."""
    if number == 0:
        return corner[i], edges[0, i]
    if number == 1:
        return corner[i], edges[1, i]
    if number == 2:
        return corner[i] + edges[0, i], edges[1, i]
    return corner[i] + edges[1, i], edges[0, i]


@part
def _clip_lines(corner: Any, edges: Any, flat: Any, half: Any, points: Any) -> int:
    """Where the sides of the other box's edge or face cross the borders of the rectangle."""
    count = 0
    for number in range(0 if flat == 0 else (1 if flat == 1 else 4)):
        for q in range(2):
            at, step = _line(corner, edges, number, q)
            across, turn = _line(corner, edges, number, 1 - q)
            if abs(step) <= _MINVAL:
                continue
            for side in range(2):
                border = half[q] * (2 * side - 1)
                t = (border - at) * (1 / step)
                if t < 0 or t > 1 or abs(across + turn * t) > half[1 - q]:
                    continue
                for i in range(3):
                    origin, direction = _line(corner, edges, number, i)
                    points[count, i] = origin + direction * t
                count += 1
    return count


@part
def _corners_below(corner: Any, edges: Any, half: Any, points: Any, count: Any) -> int:
    """The rectangle's corners that lie inside the other face seen from above."""
    a, b, c, d = edges[0, 0], edges[1, 0], edges[0, 1], edges[1, 1]
    scale = 1 / (a * d - b * c)
    for number in range(4):
        px, py = half[0] * (1 if number >= 2 else -1), half[1] * (1 if number % 2 else -1)
        x, y = px - corner[0], py - corner[1]
        u, v = (x * d - y * b) * scale, (y * a - x * c) * scale
        if u <= 0 or v <= 0 or u >= 1 or v >= 1:
            continue
        points[count, 0], points[count, 1] = px, py
        points[count, 2] = corner[2] + u * edges[0, 2] + v * edges[1, 2]
        count += 1
    return count


@part
def _vertices_above(corner: Any, edges: Any, flat: Any, half: Any, points: Any, count: Any) -> int:
    """The other box's lowest corner, and those of its edge or face that lie above the rectangle."""
    for number in range(1 << flat):
        for i in range(3):
            place = corner[i]
            if number & 1:
                place = place + edges[0, i]
            if number & 2:
                place = place + edges[1, i]
            points[count, i] = place
        inside = abs(points[count, 0]) < half[0] and abs(points[count, 1]) < half[1]
        if number == 0 or inside:
            count += 1
    return count


# ---------------------------------------------------------------------------------------------------------------------
# Two edges.


@part
def _edge_contacts(
    code: Any,
    pos1: Any,
    mat1: Any,
    size1: Any,
    size2: Any,
    rot: Any,
    between: Any,
    axis: Any,
    margin: Any,
    points: Any,
    depth: Any,
    normal: Any,
) -> int:
    """Candidates about edge ``code // 3`` of the first box and ``code % 3`` of the second, in the world frame."""
    e1, e2 = code // 3, code % 3
    away = between[0, 0] * axis[0] + between[0, 1] * axis[1] + between[0, 2] * axis[2] < 0
    # The face of either box next to its edge: its normal is the less parallel to the other's edge of the two.
    along2, face2 = (1 if e2 == 0 else 0), (1 if e2 == 2 else 2)
    if e2 == 2:
        along2, face2 = 1, 0
    if abs(rot[e1, along2]) < abs(rot[e1, face2]):
        along2, face2 = face2, along2
    along1, face1 = (1 if e1 == 0 else 0), 2
    if e1 == 2:
        along1, face1 = 1, 0
    if abs(rot[along1, e2]) < abs(rot[face1, e2]):
        along1, face1 = face1, along1
    face = face1 if (axis[face1] > 0) != away else face1 + 3
    side_along = _corner_side(rot, e1, e2, along2, away)
    side_face = _corner_side(rot, e1, e2, face2, away)

    axes = carray(stack_array(9), (3, 3))
    half = carray(stack_array(3), (3,))
    centre = carray(stack_array(3), (3,))
    _turn_into_face(face, size1, rot, between[0], axes, half, centre)
    across = carray(stack_array(3), (3,))
    for i in range(3):
        across[i] = axis[_AXIS[face, i]] * _SIGN[face, i]
    if abs(across[2]) < _MINVAL:
        return 0
    quad = carray(stack_array(12), (4, 3))  # the second box's face
    _face_corners(axes, centre, size2, e2, along2, side_along, face2, side_face, quad)
    flat_quad = carray(stack_array(12), (4, 3))  # the same, projected along the axis
    for n in range(4):
        step = -quad[n, 2] * (1 / across[2])
        for i in range(3):
            flat_quad[n, i] = quad[n, i] + across[i] * step
    rise = (1 / across[2]) * (-1.0 if away else 1.0)
    count = _edge_lines(quad, flat_quad, half, rise, margin, points, depth)
    lines = count
    count = _edge_corners(quad, flat_quad, half, margin, lines, points, depth, count)
    count = _edge_vertices(quad, flat_quad, half, rise, margin, lines, points, depth, count)
    _to_world(face, pos1, mat1, half[2], points, count)
    sign = -1.0 if away else 1.0
    for i in range(3):
        total = 0.0
        for k in range(3):
            total += mat1[3 * i + _AXIS[face, k]] * _SIGN[face, k] * across[k]
        normal[i] = total * sign
    return count


@part
def _corner_side(rot: Any, e1: Any, e2: Any, k: Any, away: Any) -> float:
    """On which side along its axis k the second box's edge lies, 1 or -1."""
    positive = (rot[e1, 3 - k - e2] > 0) != away
    if (k - e2 + 3) % 3 == 1:
        positive = not positive
    return 1.0 if positive else -1.0


@part
def _face_corners(
    axes: Any, centre: Any, size: Any, edge: Any, along: Any, side_along: Any, face: Any, side_face: Any, quad: Any
) -> None:
    """The face of the second box that holds its edge: both ends of the edge, then both of the opposite one."""
    for n in range(4):
        along_step = size[along] * (side_along if n < 2 else -side_along)
        face_step = size[face] * side_face
        edge_step = size[edge] * (1 if n % 2 == 0 else -1)
        for i in range(3):
            place = centre[i] + axes[i, along] * along_step
            place = place + axes[i, face] * face_step
            quad[n, i] = place + axes[i, edge] * edge_step


@part
def _side(quad: Any, number: Any, i: Any) -> Any:
    """Origin and step, along coordinate i, of the four sides of a parallelogram given by its corners 0, 1 and 2."""
    first, second = quad[1, i] - quad[0, i], quad[2, i] - quad[0, i]
    if number == 0:
        return quad[0, i], first
    if number == 1:
        return quad[0, i], second
    if number == 2:
        return quad[0, i] + first, second
    return quad[0, i] + second, first


@part
def _edge_lines(quad: Any, flat_quad: Any, half: Any, rise: Any, margin: Any, points: Any, depth: Any) -> int:
    """Where the projected sides cross the borders of the rectangle."""
    count = 0
    for number in range(4):
        for q in range(2):
            at, step = _side(flat_quad, number, q)
            across, turn = _side(flat_quad, number, 1 - q)
            if abs(step) <= _MINVAL:
                continue
            for side in range(2):
                border = half[q] * (2 * side - 1)
                t = (border - at) * (1 / step)
                if t < 0 or t > 1:
                    continue
                where = across + turn * t
                if abs(where) > half[1 - q]:
                    continue
                origin, direction = _side(quad, number, 2)
                if (origin + direction * t) * rise > margin:
                    continue
                for i in range(3):
                    origin, direction = _side(quad, number, i)
                    points[count, i] = origin * 0.5 + direction * (0.5 * t)
                points[count, q] += 0.5 * border
                points[count, 1 - q] += 0.5 * where
                depth[count] = points[count, 2] * rise * 2
                count += 1
    return count


@part
def _edge_corners(
    quad: Any, flat_quad: Any, half: Any, margin: Any, lines: Any, points: Any, depth: Any, count: Any
) -> int:
    """The rectangle's corners inside the projected face, or beside it where no side crosses the rectangle."""
    a, b = flat_quad[1, 0] - flat_quad[0, 0], flat_quad[2, 0] - flat_quad[0, 0]
    c, d = flat_quad[1, 1] - flat_quad[0, 1], flat_quad[2, 1] - flat_quad[0, 1]
    area = a * d - b * c
    for number in range(4):
        px, py = half[0] * (1 if number >= 2 else -1), half[1] * (1 if number % 2 else -1)
        x, y = px - flat_quad[0, 0], py - flat_quad[0, 1]
        u, v = (x * d - y * b) * (1 / area), (y * a - x * c) * (1 / area)
        outside_u, outside_v = u < 0 or u > 1, v < 0 or v > 1
        if (outside_u and outside_v) if lines == 0 else (outside_u or outside_v):
            continue
        u, v = min(max(u, 0.0), 1.0), min(max(v, 0.0), 1.0)
        above = 0.0
        gap = 0.0
        for i in range(3):
            below = px if i == 0 else (py if i == 1 else 0.0)
            above = quad[0, i] * (1 - u - v) + quad[1, i] * u
            above = above + quad[2, i] * v
            gap += (below - above) * (below - above)
            points[count, i] = (below + above) * 0.5
        # MuJoCo 3.3.0 keeps this square in the variable that held the area, so the corners that follow are mapped with
        # it; who wants its contacts has to as well.
        area = gap
        if above > 0 and gap > margin * margin:
            continue
        depth[count] = math.sqrt(gap) * (-1 if above < 0 else 1)
        count += 1
    return count


@part
def _edge_vertices(
    quad: Any, flat_quad: Any, half: Any, rise: Any, margin: Any, lines: Any, points: Any, depth: Any, count: Any
) -> int:
    """The second box's corners above the rectangle, or near it where no side crosses the rectangle."""
    found = count
    for n in range(4):
        x, y = flat_quad[n, 0], flat_quad[n, 1]
        outside_x, outside_y = x < -half[0] or x > half[0], y < -half[1] or y > half[1]
        if lines == 0:
            if found > 0 and outside_x and outside_y:
                continue
        elif outside_x or outside_y:
            continue
        gap = 0.0
        for i in range(2):
            place = flat_quad[n, i]
            near = place * 0.5
            if place < -half[i]:
                gap += (place + half[i]) * (place + half[i])
                near = -half[i] * 0.5
            elif place > half[i]:
                gap += (place - half[i]) * (place - half[i])
                near = half[i] * 0.5
            points[count, i] = near + quad[n, i] * 0.5
        height = quad[n, 2]
        gap += height * rise * height * rise
        if height > 0 and gap > margin * margin:
            continue
        points[count, 2] = height * 0.5
        depth[count] = math.sqrt(gap) * (-1 if height < 0 else 1)
        count += 1
    return count


# ---------------------------------------------------------------------------------------------------------------------
# The clean-up.


@part
def _keep_good(
    pos1: Any,
    mat1: Any,
    size1: Any,
    pos2: Any,
    mat2: Any,
    size2: Any,
    margin: Any,
    points: Any,
    depth: Any,
    normal: Any,
    count: Any,
    rows: Any,
) -> int:
    """Write candidates to ``rows`` but those outside a box and those that come again; returns how many."""
    kept = 0
    for n in range(count):
        out1 = _outside(points[n], pos1, mat1, size1, margin)
        out2 = _outside(points[n], pos2, mat2, size2, margin)
        if (out1 == 1 and out2 != -1) or (out2 == 1 and out1 != -1):
            continue
        for i in range(3):
            points[kept, i] = points[n, i]
        depth[kept] = depth[n]
        kept += 1
    written = 0
    for n in range(kept):
        again = False
        for later in range(n + 1, kept):
            if (
                points[n, 0] == points[later, 0]
                and points[n, 1] == points[later, 1]
                and points[n, 2] == points[later, 2]
            ):
                again = True
        if again or written == MOST:
            continue
        rows[written, 0] = depth[n]
        for i in range(3):
            rows[written, 1 + i], rows[written, 4 + i], rows[written, 7 + i] = points[n, i], normal[i], 0.0
        written += 1
    return written


@part
def _outside(point: Any, pos: Any, mat: Any, size: Any, margin: Any) -> int:
    """1 outside a box, -1 inside, 0 near its surface (within a hundredth of its size)."""
    x, y, z = point[0] - pos[0], point[1] - pos[1], point[2] - pos[2]
    inside = True
    for i in range(3):
        place = mat[i] * x + mat[3 + i] * y + mat[6 + i] * z
        reach = size[i] + margin
        if abs(place) > reach * _OUTSIDE:
            return 1
        if abs(place) >= reach / _OUTSIDE:
            inside = False
    return -1 if inside else 0
