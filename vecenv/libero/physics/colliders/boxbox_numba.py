"""The compiled function behind ``boxbox``: contacts of two boxes, written to memory that MuJoCo hands over.

In: addresses of poses and half sizes of two boxes, a margin, and the address of the rows to write. Out: how many
contacts there are. ``boxbox`` explains the method. All parts are in this one file, because numba's cache notices
changes in the file of the compiled function alone.

A box is a tuple of position [3], rotation [9] and half size [3]. Candidates are a tuple of points [24, 3], depths [24]
and a normal [3], written in place. The parts come in this order: separating axes; a face of one box and the lowest
vertex, edge or face of the other; two edges; the clean-up.
"""

from __future__ import annotations

import functools
import math
from typing import Any, TypeAlias

import numpy as np
from numba import types

from vecenv.util.compiled import carray, compile_for_c, floats_at, part, stack_array

Array: TypeAlias = np.ndarray
Box: TypeAlias = tuple[Array, Array, Array]
Axes: TypeAlias = tuple[int, int, int]
Sides: TypeAlias = tuple[float, float]
Candidates: TypeAlias = tuple[Array, Array, Array]

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
# The two other axes of each axis of a box.
_OTHERS = ((1, 2), (0, 2), (1, 0))


@functools.cache
def compiled() -> Any:
    """``_collide`` as a C function of addresses: pose and half size of either box, margin (a number), rows."""
    return compile_for_c(types.int32(*[types.uintp] * 6, types.float64, types.uintp), _collide)


def _collide(pos1: int, mat1: int, size1: int, pos2: int, mat2: int, size2: int, margin: float, rows: int) -> int:
    """Write contacts to ``rows`` [8, 10] and return their number."""
    first = carray(floats_at(pos1), (3,)), carray(floats_at(mat1), (9,)), carray(floats_at(size1), (3,))
    second = carray(floats_at(pos2), (3,)), carray(floats_at(mat2), (9,)), carray(floats_at(size2), (3,))
    return _contacts(first, second, margin, carray(floats_at(rows), (MOST, COLUMNS)))


@part
def _contacts(first: Box, second: Box, margin: float, rows: Array) -> int:
    rot = carray(stack_array(9), (3, 3))  # the second box's axes, as columns, in the frame of the first
    between = carray(stack_array(6), (2, 3))  # from either centre to the other, in its own frame
    axis = carray(stack_array(3), (3,))
    _relative(first, second, rot, between)
    code = _least_overlap(first[2], second[2], rot, between, margin, axis)
    if code < 0:
        return 0
    normal = carray(stack_array(3), (3,))
    found = carray(stack_array(72), (_CANDIDATES, 3)), carray(stack_array(24), (_CANDIDATES,)), normal
    if code >= 12:
        count = _edge_contacts(code - 12, first, second[2], rot, between, axis, margin, found)
    elif code >= 6:
        turned = carray(stack_array(9), (3, 3))
        for i in range(9):
            turned[i // 3, i % 3] = rot[i % 3, i // 3]
        count = _face_contacts(code - 6, second, first[2], turned, between[1], margin, found)
        for i in range(3):
            normal[i] = -normal[i]
    else:
        count = _face_contacts(code, first, second[2], rot, between[0], margin, found)
    return _keep_good(first, second, margin, found, count, rows)


@part
def _relative(first: Box, second: Box, rot: Array, between: Array) -> None:
    """The second box's axes in the first's frame, and the vectors between the centres."""
    (pos1, mat1, _), (pos2, mat2, _) = first, second
    x, y, z = pos2[0] - pos1[0], pos2[1] - pos1[1], pos2[2] - pos1[2]
    for i in range(3):
        between[0, i] = mat1[i] * x + mat1[3 + i] * y + mat1[6 + i] * z
        between[1, i] = mat2[i] * -x + mat2[3 + i] * -y + mat2[6 + i] * -z
        for k in range(3):
            rot[i, k] = mat1[i] * mat2[k] + mat1[3 + i] * mat2[3 + k] + mat1[6 + i] * mat2[6 + k]


@part
def _least_overlap(size1: Array, size2: Array, rot: Array, between: Array, margin: float, axis: Array) -> int:
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


@part
def _face_contacts(
    face: int, box: Box, other_size: Array, other_axes: Array, other_centre: Array, margin: float, found: Candidates
) -> int:
    """Candidates on a face of a box, in the world frame: points, depths (halved) and the outward normal.

    ``other_axes`` (columns) and ``other_centre`` are the other box's, in this box's frame.
    """
    (pos, mat, size), (points, depth, normal) = box, found
    axes, half, corner = carray(stack_array(9), (3, 3)), carray(stack_array(3), (3,)), carray(stack_array(3), (3,))
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
def _turn_into_face(
    face: int, size: Array, matrix: Array, vector: Array, axes: Array, half: Array, place: Array
) -> None:
    """Rows of a matrix, half sizes and a vector of a box's frame in that of its face, whose origin is on the face."""
    for i in range(3):
        k, sign = _AXIS[face, i], _SIGN[face, i]
        for j in range(3):
            axes[i, j] = matrix[k, j] * sign
        half[i] = size[k]
        place[i] = vector[k] * sign
    place[2] -= half[2]


@part
def _to_world(face: int, pos: Array, mat: Array, height: float, points: Array, count: int) -> None:
    """Points of a face's frame, in place; ``height`` is how far the face is from its box's centre."""
    a, b, c = _AXIS[face, 0], _AXIS[face, 1], _AXIS[face, 2]
    sa, sb, sc = _SIGN[face, 0], _SIGN[face, 1], _SIGN[face, 2]
    for n in range(count):
        x, y, z = points[n, 0], points[n, 1], points[n, 2] + height
        for i in range(3):
            points[n, i] = mat[3 * i + a] * sa * x + mat[3 * i + b] * sb * y + mat[3 * i + c] * sc * z + pos[i]


@part
def _side(origin: float, first: float, second: float, number: int) -> tuple[float, float]:
    """Origin and step, along one coordinate, of the four sides of a parallelogram; the first alone is an edge."""
    if number < 2:
        return origin, (first if number == 0 else second)
    return (origin + first, second) if number == 2 else (origin + second, first)


@part
def _clip_lines(corner: Array, edges: Array, flat: int, half: Array, points: Array) -> int:
    """Where the sides of the other box's edge or face cross the borders of the rectangle."""
    count = 0
    for number in range(0 if flat == 0 else (1 if flat == 1 else 4)):
        for q in range(2):
            at, step = _side(corner[q], edges[0, q], edges[1, q], number)
            across, turn = _side(corner[1 - q], edges[0, 1 - q], edges[1, 1 - q], number)
            if abs(step) <= _MINVAL:
                continue
            for side in range(2):
                border = half[q] * (2 * side - 1)
                t = (border - at) * (1 / step)
                if t < 0 or t > 1 or abs(across + turn * t) > half[1 - q]:
                    continue
                for i in range(3):
                    origin, direction = _side(corner[i], edges[0, i], edges[1, i], number)
                    points[count, i] = origin + direction * t
                count += 1
    return count


@part
def _corners_below(corner: Array, edges: Array, half: Array, points: Array, count: int) -> int:
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
def _vertices_above(corner: Array, edges: Array, flat: int, half: Array, points: Array, count: int) -> int:
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


@part
def _edge_contacts(
    code: int, first: Box, size2: Array, rot: Array, between: Array, axis: Array, margin: float, found: Candidates
) -> int:
    """Candidates about edge ``code // 3`` of the first box and ``code % 3`` of the second, in the world frame."""
    (pos1, mat1, size1), (points, _, normal) = first, found
    e1, e2 = code // 3, code % 3
    away = between[0, 0] * axis[0] + between[0, 1] * axis[1] + between[0, 2] * axis[2] < 0
    # The face of either box next to its edge: its normal is the less parallel to the other's edge of the two.
    along2, face2 = _OTHERS[e2]
    if abs(rot[e1, along2]) < abs(rot[e1, face2]):
        along2, face2 = face2, along2
    along1, face1 = _OTHERS[e1]
    if abs(rot[along1, e2]) < abs(rot[face1, e2]):
        along1, face1 = face1, along1
    face = face1 if (axis[face1] > 0) != away else face1 + 3
    sides = _corner_side(rot, e1, e2, along2, away), _corner_side(rot, e1, e2, face2, away)

    axes, half, centre = carray(stack_array(9), (3, 3)), carray(stack_array(3), (3,)), carray(stack_array(3), (3,))
    _turn_into_face(face, size1, rot, between[0], axes, half, centre)
    across = carray(stack_array(3), (3,))
    for i in range(3):
        across[i] = axis[_AXIS[face, i]] * _SIGN[face, i]
    if abs(across[2]) < _MINVAL:
        return 0
    quad = carray(stack_array(12), (4, 3))  # the second box's face
    _face_corners(axes, centre, size2, (e2, along2, face2), sides, quad)
    flat_quad = carray(stack_array(12), (4, 3))  # the same, projected along the axis
    for n in range(4):
        step = -quad[n, 2] * (1 / across[2])
        for i in range(3):
            flat_quad[n, i] = quad[n, i] + across[i] * step
    rise = (1 / across[2]) * (-1.0 if away else 1.0)
    lines = _edge_lines(quad, flat_quad, half, rise, margin, found)
    count = _edge_corners(quad, flat_quad, half, margin, lines, found, lines)
    count = _edge_vertices(quad, flat_quad, half, rise, margin, lines, found, count)
    _to_world(face, pos1, mat1, half[2], points, count)
    sign = -1.0 if away else 1.0
    for i in range(3):
        total = 0.0
        for k in range(3):
            total += mat1[3 * i + _AXIS[face, k]] * _SIGN[face, k] * across[k]
        normal[i] = total * sign
    return count


@part
def _corner_side(rot: Array, e1: int, e2: int, k: int, away: bool) -> float:
    """On which side along its axis k the second box's edge lies, 1 or -1."""
    positive = (rot[e1, 3 - k - e2] > 0) != away
    return 1.0 if positive != ((k - e2 + 3) % 3 == 1) else -1.0


@part
def _face_corners(axes: Array, centre: Array, size: Array, chosen: Axes, sides: Sides, quad: Array) -> None:
    """The face of the second box that holds its edge: both ends of the edge, then both of the opposite one.

    ``chosen`` are the box's axes: along the edge, the other one in the face, and the face's normal; ``sides`` of the
    last two.
    """
    edge, along, face = chosen
    for n in range(4):
        along_step = size[along] * (sides[0] if n < 2 else -sides[0])
        face_step = size[face] * sides[1]
        edge_step = size[edge] * (1 if n % 2 == 0 else -1)
        for i in range(3):
            place = centre[i] + axes[i, along] * along_step
            place = place + axes[i, face] * face_step
            quad[n, i] = place + axes[i, edge] * edge_step


@part
def _quad_line(quad: Array, number: int, i: int) -> tuple[float, float]:
    """A side, along coordinate i, of the parallelogram with the corners 0, 1 and 2."""
    return _side(quad[0, i], quad[1, i] - quad[0, i], quad[2, i] - quad[0, i], number)


@part
def _edge_lines(quad: Array, flat_quad: Array, half: Array, rise: float, margin: float, found: Candidates) -> int:
    """Where the projected sides cross the borders of the rectangle."""
    points, depth, _ = found
    count = 0
    for number in range(4):
        for q in range(2):
            at, step = _quad_line(flat_quad, number, q)
            across, turn = _quad_line(flat_quad, number, 1 - q)
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
                origin, direction = _quad_line(quad, number, 2)
                if (origin + direction * t) * rise > margin:
                    continue
                for i in range(3):
                    origin, direction = _quad_line(quad, number, i)
                    points[count, i] = origin * 0.5 + direction * (0.5 * t)
                points[count, q] += 0.5 * border
                points[count, 1 - q] += 0.5 * where
                depth[count] = points[count, 2] * rise * 2
                count += 1
    return count


@part
def _edge_corners(
    quad: Array, flat_quad: Array, half: Array, margin: float, lines: int, found: Candidates, count: int
) -> int:
    """The rectangle's corners inside the projected face, or next to it where no side crosses the rectangle."""
    points, depth, _ = found
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
        # MuJoCo 3.3.0 keeps this square in the variable that held the area and maps the following corners with it.
        # Reproducing its contacts needs the same.
        area = gap
        if above > 0 and gap > margin * margin:
            continue
        depth[count] = math.sqrt(gap) * (-1 if above < 0 else 1)
        count += 1
    return count


@part
def _edge_vertices(
    quad: Array, flat_quad: Array, half: Array, rise: float, margin: float, lines: int, found: Candidates, count: int
) -> int:
    """The second box's corners above the rectangle, or near it where no side crosses the rectangle."""
    points, depth, _ = found
    before = count
    for n in range(4):
        x, y = flat_quad[n, 0], flat_quad[n, 1]
        outside_x, outside_y = x < -half[0] or x > half[0], y < -half[1] or y > half[1]
        if lines == 0:
            if before > 0 and outside_x and outside_y:
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


@part
def _keep_good(first: Box, second: Box, margin: float, found: Candidates, count: int, rows: Array) -> int:
    """Write the candidates to ``rows``, except those outside a box and repeated ones; returns how many."""
    points, depth, normal = found
    kept = 0
    for n in range(count):
        out1 = _outside(points[n], first, margin)
        out2 = _outside(points[n], second, margin)
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
            same = points[n, 0] == points[later, 0] and points[n, 1] == points[later, 1]
            if same and points[n, 2] == points[later, 2]:
                again = True
        if again or written == MOST:
            continue
        rows[written, 0] = depth[n]
        for i in range(3):
            rows[written, 1 + i], rows[written, 4 + i], rows[written, 7 + i] = points[n, i], normal[i], 0.0
        written += 1
    return written


@part
def _outside(point: Array, box: Box, margin: float) -> int:
    """1 outside a box, -1 inside, 0 near its surface (within a hundredth of its size)."""
    pos, mat, size = box
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
