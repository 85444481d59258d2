"""Contacts of two boxes as MuJoCo 2.3 to 3.3 computed them, as a Warp function for CUDA and the CPU.

Method, order of the contacts and halved depth of face contacts are those of ``vecenv.libero.physics.colliders.boxbox``,
which explains them; signature and result are those of MuJoCo Warp's own ``box_box``, which it replaces
(``vecenv.libero.physics.mjx.contacts``). Everything is float32, in the world frame, metres.

Single precision requires two differences.

* An axis made of two nearly parallel edges is only as accurate as the cross product of the edges, and where boxes rest
  flat on each other its overlap ties with that of a face: it is chosen only if its overlap is smaller by more than the
  rounding error.
* Boxes whose edges touch within the rounding error may overlap along the axis while no side of the projected face
  crosses the rectangle at their depth. MuJoCo 3.3.0 then takes corners that are far from the edges, centimetres deep,
  and throws the boxes apart; in double precision the coincidence is a hundred times as rare. Boxes without a crossing
  do not overlap, so a negative distance is dropped there.
"""

# In Warp, int(0) makes a variable that a loop may change; a literal is a constant.
# ruff: noqa: RUF046, UP018
# The bodies are Warp's language, whose overloads pyright does not know.
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportReturnType=false, reportAttributeAccessIssue=false

from __future__ import annotations

import warp as wp

from vecenv.libero.physics.private import mat83f, vec8f

MOST = 8
# Squared sine below which the cross product of two edges is noise.
PARALLEL = 1e-10
# Margin by which an edge axis must be better, times the boxes' size over the sine between the edges.
EDGE_NOISE = 5e-8
_TINY = 1e-12
_OUTSIDE = 1.01
_FAR = 1e10


class Candidates(wp.types.matrix(shape=(24, 4), dtype=wp.float32)):
    """Candidates, see ``vecenv.libero.physics.colliders.boxbox``: position and depth."""


class Corners(wp.types.matrix(shape=(4, 3), dtype=wp.float32)):
    """Corners of a face."""


wp.set_module_options({"enable_backward": False})


@wp.func
def box_box(
    box1_pos: wp.vec3,
    box1_rot: wp.mat33,
    box1_size: wp.vec3,
    box2_pos: wp.vec3,
    box2_rot: wp.mat33,
    box2_size: wp.vec3,
    margin: float,
):
    """Contacts of two boxes: their number, distances [8], positions [8, 3], normal from the first to the second.

    Args:
        box1_pos, box2_pos: centres, metres, world frame.
        box1_rot, box2_rot: rotations to the world frame.
        box1_size, box2_size: half sizes, metres.
        margin: contacts up to this distance are reported, metres.
    """
    dist = vec8f(_FAR)
    pos = mat83f()
    rot = wp.transpose(box1_rot) @ box2_rot
    centre2 = wp.transpose(box1_rot) @ (box2_pos - box1_pos)
    centre1 = wp.transpose(box2_rot) @ (box1_pos - box2_pos)
    code, axis = _least_overlap(box1_size, box2_size, rot, centre2, centre1, margin)
    if code < 0:
        return 0, dist, pos, axis
    found = Candidates()
    count = int(0)
    normal = wp.vec3()
    if code >= 12:
        count, found, normal = _edge_contacts(code - 12, box1_size, box2_size, rot, centre2, axis, margin)
        normal = box1_rot @ normal
        found = _to_world(found, count, box1_pos, box1_rot)
    elif code >= 6:
        frame = _face_frame(code - 6)
        count, found = _face_contacts(frame, box2_size, box1_size, wp.transpose(rot), centre1, margin)
        normal = -(box2_rot @ frame[2])
        found = _to_world(found, count, box2_pos, box2_rot)
    else:
        frame = _face_frame(code)
        count, found = _face_contacts(frame, box1_size, box2_size, rot, centre2, margin)
        normal = box1_rot @ frame[2]
        found = _to_world(found, count, box1_pos, box1_rot)

    kept = int(0)
    for n in range(count):
        point = wp.vec3(found[n, 0], found[n, 1], found[n, 2])
        out1 = _outside(point, box1_pos, box1_rot, box1_size, margin)
        out2 = _outside(point, box2_pos, box2_rot, box2_size, margin)
        if not ((out1 == 1 and out2 != -1) or (out2 == 1 and out1 != -1)):
            found[kept] = found[n]
            kept += 1
    written = int(0)
    for n in range(kept):
        again = bool(False)
        for later in range(n + 1, kept):
            if found[n, 0] == found[later, 0] and found[n, 1] == found[later, 1] and found[n, 2] == found[later, 2]:
                again = True
        if not again and written < wp.static(MOST):
            dist[written] = found[n, 3]
            pos[written] = wp.vec3(found[n, 0], found[n, 1], found[n, 2])
            written += 1
    return written, dist, pos, normal


@wp.func
def _to_world(found: Candidates, count: int, pos: wp.vec3, rot: wp.mat33) -> Candidates:
    """Candidates in a box's frame, in the world frame."""
    turned = found
    for n in range(count):
        point = rot @ wp.vec3(found[n, 0], found[n, 1], found[n, 2]) + pos
        turned[n, 0] = point[0]
        turned[n, 1] = point[1]
        turned[n, 2] = point[2]
    return turned


@wp.func
def _outside(point: wp.vec3, pos: wp.vec3, rot: wp.mat33, size: wp.vec3, margin: float) -> int:
    """1 outside a box, -1 inside, 0 near its surface."""
    place = wp.transpose(rot) @ (point - pos)
    inside = int(-1)
    for i in range(3):
        reach = size[i] + margin
        if wp.abs(place[i]) > reach * _OUTSIDE:
            return 1
        if wp.abs(place[i]) >= reach / _OUTSIDE:
            inside = 0
    return inside


# ---------------------------------------------------------------------------------------------------------------------
# Separating axes.


@wp.func
def _least_overlap(size1: wp.vec3, size2: wp.vec3, rot: wp.mat33, centre2: wp.vec3, centre1: wp.vec3, margin: float):
    """Number of the axis of least overlap, -1 where one separates the boxes; the axis itself for two edges."""
    total = size1[0] + size1[1] + size1[2] + size2[0] + size2[1] + size2[2]
    least = margin + 3.0 * total
    code = int(-1)
    axis = wp.vec3()
    for i in range(3):
        reach2 = wp.abs(rot[i, 0]) * size2[0] + wp.abs(rot[i, 1]) * size2[1] + wp.abs(rot[i, 2]) * size2[2]
        reach1 = wp.abs(rot[0, i]) * size1[0] + wp.abs(rot[1, i]) * size1[1] + wp.abs(rot[2, i]) * size1[2]
        overlap1 = size1[i] + reach2 - wp.abs(centre2[i])
        overlap2 = size2[i] + reach1 - wp.abs(centre1[i])
        if overlap1 < -margin or overlap2 < -margin:
            return -1, axis
        if overlap1 < least:
            least = overlap1
            code = wp.where(centre2[i] < 0.0, i + 3, i)
        if overlap2 < least:
            least = overlap2
            code = wp.where(centre1[i] < 0.0, i + 9, i + 6)
    three = int(3)  # a variable, so that Warp does not unroll the loops
    for i in range(three):
        for k in range(three):
            edge2 = wp.vec3(rot[0, k], rot[1, k], rot[2, k])
            edge1 = wp.vec3()
            edge1[i] = 1.0
            across = wp.cross(edge1, edge2)
            square = wp.dot(across, across)
            if square > PARALLEL:
                scale = 1.0 / wp.sqrt(square)
                across = across * scale
                overlap = -wp.abs(wp.dot(centre2, across))
                for other in range(3):
                    overlap += size1[other] * wp.abs(across[other])
                    if other != k:
                        overlap += size2[other] * wp.abs(rot[i, 3 - other - k]) * scale
                if overlap < -margin:
                    return -1, axis
                if overlap + EDGE_NOISE * total * scale < least:
                    least = overlap
                    code = 12 + 3 * i + k
                    axis = across
    return code, axis


@wp.func
def _face_frame(face: int) -> wp.mat33:
    """Rows: the axes of the frame of a face +x +y +z -x -y -z of a box; the third points out of it."""
    if face == 0:
        return wp.mat33(0.0, 0.0, -1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0)
    if face == 1:
        return wp.mat33(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0)
    if face == 2:
        return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    if face == 3:
        return wp.mat33(0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0)
    if face == 4:
        return wp.mat33(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0)
    return wp.mat33(-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0)


@wp.func
def _half_sizes(frame: wp.mat33, size: wp.vec3) -> wp.vec3:
    """Half sizes along the axes of a face's frame."""
    turned = frame @ size
    return wp.vec3(wp.abs(turned[0]), wp.abs(turned[1]), wp.abs(turned[2]))


@wp.func
def _line(number: int, corner: wp.vec3, first: wp.vec3, second: wp.vec3):
    """Origin and step of the four sides of a parallelogram; the first alone is an edge."""
    if number == 0:
        return corner, first
    if number == 1:
        return corner, second
    if number == 2:
        return corner + first, second
    return corner + second, first


@wp.func
def _rectangle_corner(number: int, half: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.where(number >= 2, half[0], -half[0]), wp.where(number % 2 == 1, half[1], -half[1]), 0.0)


# ---------------------------------------------------------------------------------------------------------------------
# A face of one box and the lowest vertex, edge or face of the other.


@wp.func
def _face_contacts(
    frame: wp.mat33, size: wp.vec3, other_size: wp.vec3, other_axes: wp.mat33, other_centre: wp.vec3, margin: float
):
    """Number of candidates on a face of a box, and the candidates in the box's frame, their depth halved."""
    axes = frame @ other_axes
    half = _half_sizes(frame, size)
    corner = frame @ other_centre - wp.vec3(0.0, 0.0, half[2])
    first = wp.vec3()
    second = wp.vec3()
    flat = int(0)
    for k in range(3):
        step = wp.where(axes[2, k] < 0.0, other_size[k], -other_size[k])
        along = wp.vec3(axes[0, k], axes[1, k], axes[2, k]) * step
        corner += along
        if wp.abs(axes[2, k]) < 0.5 and flat < 2:
            if flat == 0:
                first = -2.0 * along
            else:
                second = -2.0 * along
            flat += 1
    found = Candidates()
    count = int(0)
    lines = wp.where(flat == 2, 4, flat)
    for number in range(lines):
        origin, direction = _line(number, corner, first, second)
        for q in range(2):
            if wp.abs(direction[q]) > _TINY:
                for side in range(2):
                    border = wp.where(side == 1, half[q], -half[q])
                    t = (border - origin[q]) * (1.0 / direction[q])
                    if t >= 0.0 and t <= 1.0 and wp.abs(origin[1 - q] + direction[1 - q] * t) <= half[1 - q]:
                        count, found = _add_point(found, count, origin + direction * t)
    if flat == 2:
        scale = 1.0 / (first[0] * second[1] - second[0] * first[1])
        four = int(4)
        for number in range(four):
            point = _rectangle_corner(number, half)
            away = point - corner
            u = (away[0] * second[1] - away[1] * second[0]) * scale
            v = (away[1] * first[0] - away[0] * first[1]) * scale
            if u > 0.0 and v > 0.0 and u < 1.0 and v < 1.0:
                point[2] = corner[2] + u * first[2] + v * second[2]
                count, found = _add_point(found, count, point)
    vertices = wp.where(flat == 0, 1, 2 * flat)
    for number in range(vertices):
        place = corner
        if number % 2 == 1:
            place = place + first
        if number >= 2:
            place = place + second
        if number == 0 or (wp.abs(place[0]) < half[0] and wp.abs(place[1]) < half[1]):
            count, found = _add_point(found, count, place)
    return _halved(found, count, frame, half[2], margin)


@wp.func
def _add_point(found: Candidates, count: int, point: wp.vec3):
    longer = found
    longer[count, 0] = point[0]
    longer[count, 1] = point[1]
    longer[count, 2] = point[2]
    return count + 1, longer


@wp.func
def _halved(found: Candidates, count: int, frame: wp.mat33, height: float, margin: float):
    """Candidates of a face's frame half-way between the surfaces, with half the depth, in the box's frame."""
    moved = Candidates()
    kept = int(0)
    for n in range(count):
        if found[n, 2] <= margin:
            depth = 0.5 * found[n, 2]
            point = wp.transpose(frame) @ wp.vec3(found[n, 0], found[n, 1], depth + height)
            moved[kept] = wp.vec4(point[0], point[1], point[2], depth)
            kept += 1
    return kept, moved


# ---------------------------------------------------------------------------------------------------------------------
# Two edges.


@wp.func
def _edge_contacts(
    code: int, size1: wp.vec3, size2: wp.vec3, rot: wp.mat33, centre2: wp.vec3, axis: wp.vec3, margin: float
):
    """Number of candidates about two edges, the candidates and the normal, in the frame of the first box."""
    e1 = code // 3
    e2 = code % 3
    away = wp.dot(centre2, axis) < 0.0
    sign = wp.where(away, -1.0, 1.0)
    # The face of either box next to its edge: its normal is the less parallel to the other's edge of the two.
    along2 = wp.where(e2 == 0, 1, 0)
    face2 = wp.where(e2 == 2, 0, 2)
    if e2 == 2:
        along2 = 1
    if wp.abs(rot[e1, along2]) < wp.abs(rot[e1, face2]):
        along2 = face2
        face2 = 3 - e2 - along2
    along1 = wp.where(e1 == 0, 1, 0)
    face1 = wp.where(e1 == 2, 0, 2)
    if e1 == 2:
        along1 = 1
    if wp.abs(rot[along1, e2]) < wp.abs(rot[face1, e2]):
        along1 = face1
        face1 = 3 - e1 - along1
    frame = _face_frame(wp.where((axis[face1] > 0.0) != away, face1, face1 + 3))
    half = _half_sizes(frame, size1)
    across = frame @ axis
    normal = axis * sign
    found = Candidates()
    if wp.abs(across[2]) < _TINY:
        return 0, found, normal

    # The second box's face: both ends of the edge, then both of the opposite one; and the same, projected.
    axes = frame @ rot
    centre = frame @ centre2 - wp.vec3(0.0, 0.0, half[2])
    along_step = _column(axes, along2) * (size2[along2] * _corner_side(rot, e1, e2, along2, away))
    centre += _column(axes, face2) * (size2[face2] * _corner_side(rot, e1, e2, face2, away))
    edge_step = _column(axes, e2) * size2[e2]
    quad = Corners()
    flat_quad = Corners()
    for n in range(4):
        place = centre + wp.where(n < 2, along_step, -along_step) + wp.where(n % 2 == 0, edge_step, -edge_step)
        quad[n] = place
        flat_quad[n] = place - across * (place[2] / across[2])
    rise = sign / across[2]
    count = int(0)
    count, found = _edge_lines(found, quad, flat_quad, half, rise, margin)
    lines = count
    count, found = _edge_corners(found, count, quad, flat_quad, half, margin)
    count, found = _edge_vertices(found, lines, count, quad, flat_quad, half, rise, margin)
    kept = int(0)
    for n in range(count):
        if lines > 0 or found[n, 3] >= 0.0:
            point = wp.transpose(frame) @ wp.vec3(found[n, 0], found[n, 1], found[n, 2] + half[2])
            found[kept] = wp.vec4(point[0], point[1], point[2], found[n, 3])
            kept += 1
    return kept, found, normal


@wp.func
def _column(matrix: wp.mat33, k: int) -> wp.vec3:
    return wp.vec3(matrix[0, k], matrix[1, k], matrix[2, k])


@wp.func
def _corner_side(rot: wp.mat33, e1: int, e2: int, k: int, away: bool) -> float:
    """On which side along its axis k the second box's edge lies, 1 or -1."""
    positive = (rot[e1, 3 - k - e2] > 0.0) != away
    if (k - e2 + 3) % 3 == 1:
        positive = not positive
    return wp.where(positive, 1.0, -1.0)


@wp.func
def _edge_lines(found: Candidates, quad: Corners, flat_quad: Corners, half: wp.vec3, rise: float, margin: float):
    """Where the projected sides cross the borders of the rectangle."""
    longer = found
    count = int(0)
    four = int(4)
    for number in range(four):
        origin, direction = _line(number, quad[0], quad[1] - quad[0], quad[2] - quad[0])
        flat, step = _line(number, flat_quad[0], flat_quad[1] - flat_quad[0], flat_quad[2] - flat_quad[0])
        for q in range(2):
            if wp.abs(step[q]) > _TINY:
                for side in range(2):
                    border = wp.where(side == 1, half[q], -half[q])
                    t = (border - flat[q]) * (1.0 / step[q])
                    where = flat[1 - q] + step[1 - q] * t
                    height = origin[2] + direction[2] * t
                    if t >= 0.0 and t <= 1.0 and wp.abs(where) <= half[1 - q] and height * rise <= margin:
                        point = 0.5 * (origin + direction * t)
                        point[q] = point[q] + 0.5 * border
                        point[1 - q] = point[1 - q] + 0.5 * where
                        longer[count] = wp.vec4(point[0], point[1], point[2], 2.0 * point[2] * rise)
                        count += 1
    return count, longer


@wp.func
def _edge_corners(found: Candidates, lines: int, quad: Corners, flat_quad: Corners, half: wp.vec3, margin: float):
    """The rectangle's corners inside the projected face, or next to it where no side crosses the rectangle."""
    longer = found
    count = int(lines)
    first = flat_quad[1] - flat_quad[0]
    second = flat_quad[2] - flat_quad[0]
    # MuJoCo 3.3.0 divides by the last corner's squared gap from the second corner on, see
    # ``vecenv.libero.physics.colliders.boxbox``.
    area = float(first[0] * second[1] - second[0] * first[1])
    four = int(4)
    for number in range(four):
        below = _rectangle_corner(number, half)
        beside = below - flat_quad[0]
        u = (beside[0] * second[1] - beside[1] * second[0]) / area
        v = (beside[1] * first[0] - beside[0] * first[1]) / area
        outside_u = u < 0.0 or u > 1.0
        outside_v = v < 0.0 or v > 1.0
        out = outside_u or outside_v
        if lines == 0:
            out = outside_u and outside_v
        if not out:
            u = wp.clamp(u, 0.0, 1.0)
            v = wp.clamp(v, 0.0, 1.0)
            above = quad[0] * (1.0 - u - v) + quad[1] * u + quad[2] * v
            gap = wp.length_sq(below - above)
            area = gap
            if not (above[2] > 0.0 and gap > margin * margin):
                point = 0.5 * (below + above)
                depth = wp.where(above[2] < 0.0, -wp.sqrt(gap), wp.sqrt(gap))
                longer[count] = wp.vec4(point[0], point[1], point[2], depth)
                count += 1
    return count, longer


@wp.func
def _edge_vertices(
    found: Candidates,
    lines: int,
    have: int,
    quad: Corners,
    flat_quad: Corners,
    half: wp.vec3,
    rise: float,
    margin: float,
):
    """The second box's corners above the rectangle, or near it where no side crosses the rectangle."""
    longer = found
    count = int(have)
    four = int(4)
    for n in range(four):
        x = flat_quad[n, 0]
        y = flat_quad[n, 1]
        outside_x = wp.abs(x) > half[0]
        outside_y = wp.abs(y) > half[1]
        out = outside_x or outside_y
        if lines == 0:
            out = have > 0 and outside_x and outside_y
        if not out:
            near_x = wp.clamp(x, -half[0], half[0])
            near_y = wp.clamp(y, -half[1], half[1])
            height = quad[n, 2]
            gap = (x - near_x) * (x - near_x) + (y - near_y) * (y - near_y) + height * rise * height * rise
            if not (height > 0.0 and gap > margin * margin):
                depth = wp.where(height < 0.0, -wp.sqrt(gap), wp.sqrt(gap))
                point = wp.vec2(near_x + quad[n, 0], near_y + quad[n, 1]) * 0.5
                longer[count] = wp.vec4(point[0], point[1], 0.5 * height, depth)
                count += 1
    return count, longer
