"""Kernels of MuJoCo Warp whose results do not depend on the order in which threads run, for CUDA and the CPU.

Which kernels of MuJoCo Warp they replace, and why, is explained in ``vecenv.libero.physics.mjx.deterministic``. Three
means are used:

* **Ranks.** The place of a constraint row is the number of rows of its world that come before it in a fixed order, not
  the value of a counter that threads increase in the order they arrive.
* **One thread a sum.** Where few terms are added, one thread adds them in a fixed order.
* **Fixed point.** Where many threads add to one number, the terms are rounded to multiples of a power of two and added
  as 64-bit integers. Unlike the addition of floating-point numbers, that of integers is associative, so every order
  gives the same bits.

Rows and contacts of one world only are read to compute that world, so neither the number of worlds nor their order has
an influence.
"""

# In Warp, int(0) makes a variable that a loop may change; a literal is a constant.
# A loop with return is Warp's; all() is not.
# ruff: noqa: RUF046, SIM110, UP018
# The bodies are Warp's language, whose overloads pyright does not know.
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportReturnType=false, reportAttributeAccessIssue=false
# pyright: reportInvalidTypeForm=false, reportAssignmentType=false

from __future__ import annotations

import warp as wp

from vecenv.libero.physics.private import ConstraintState, ContactType, vec5, vec10

# Threads that share the entries of one group of rows.
LANES = 32
# Bits after the binary point. A force is a multiple of 2.3e-10 N or N·m, an entry of the Hessian of 3.7e-9 kg or kg·m².
FORCE_BITS = 32
HESSIAN_BITS = 28
# 2^8 terms of this size fit into 63 bits.
LARGEST_FORCE = float(2 ** (63 - 8 - FORCE_BITS))
LARGEST_ENTRY = float(2 ** (63 - 8 - HESSIAN_BITS))
# Values of a row, see ``read_rows``.
ROW_VALUES = 7

_FORCE_UNITS = wp.constant(float(2**FORCE_BITS))
_HESSIAN_UNITS = wp.constant(float(2**HESSIAN_BITS))
_LARGEST_FORCE = wp.constant(LARGEST_FORCE)
_LARGEST_ENTRY = wp.constant(LARGEST_ENTRY)
_QUADRATIC = wp.constant(int(ConstraintState.QUADRATIC))
_CONE = wp.constant(int(ConstraintState.CONE))
_IN_CONSTRAINT = wp.constant(int(ContactType.CONSTRAINT))
_LANES = wp.constant(LANES)
# Factors of a contact's key: two geoms and the number of the contact between them.
_GEOMS = wp.constant(wp.int64(2**24))
_CONTACTS_OF_PAIR = wp.constant(wp.int64(2**12))
# A contact's rows are at most six.
_MOST_ROWS = wp.constant(8)
_TINY = wp.constant(1e-15)

wp.set_module_options({"enable_backward": False})


# ---------------------------------------------------------------------------------------------------------------------
# Bodies: what children add to their parent. One launch handles all bodies of one depth of the tree, and the arguments
# are those of MuJoCo Warp's kernels. The thread of a parent's first child adds them all.


@wp.func
def _is_first_child(body_parentid: wp.array[int], bodies: wp.array[int], node: int) -> bool:
    """Whether no body earlier in the list has the same parent."""
    parent = body_parentid[bodies[node]]
    for before in range(node):
        if body_parentid[bodies[before]] == parent:
            return False
    return True


@wp.kernel
def add_subtree_com(
    body_parentid: wp.array[int],
    subtree_com_in: wp.array2d[wp.vec3],
    bodies: wp.array[int],
    subtree_com_out: wp.array2d[wp.vec3],
):
    """Mass times centre of mass."""
    world, node = wp.tid()
    if bodies[node] == 0 or not _is_first_child(body_parentid, bodies, node):
        return
    parent = body_parentid[bodies[node]]
    total = subtree_com_out[world, parent]
    for child in range(node, bodies.shape[0]):
        if body_parentid[bodies[child]] == parent:
            total += subtree_com_in[world, bodies[child]]
    subtree_com_out[world, parent] = total


@wp.kernel
def add_composite_inertia(
    body_parentid: wp.array[int],
    crb_in: wp.array2d[vec10],
    bodies: wp.array[int],
    crb_out: wp.array2d[vec10],
):
    """Inertias, to every parent but the world."""
    world, node = wp.tid()
    parent = body_parentid[bodies[node]]
    if parent == 0 or not _is_first_child(body_parentid, bodies, node):
        return
    total = crb_out[world, parent]
    for child in range(node, bodies.shape[0]):
        if body_parentid[bodies[child]] == parent:
            total += crb_in[world, bodies[child]]
    crb_out[world, parent] = total


@wp.kernel
def add_body_force(
    body_parentid: wp.array[int],
    cfrc_in: wp.array2d[wp.spatial_vector],
    bodies: wp.array[int],
    cfrc_out: wp.array2d[wp.spatial_vector],
):
    """Spatial forces."""
    world, node = wp.tid()
    if bodies[node] == 0 or not _is_first_child(body_parentid, bodies, node):
        return
    parent = body_parentid[bodies[node]]
    total = cfrc_out[world, parent]
    for child in range(node, bodies.shape[0]):
        if body_parentid[bodies[child]] == parent:
            total += cfrc_in[world, bodies[child]]
    cfrc_out[world, parent] = total


# ---------------------------------------------------------------------------------------------------------------------
# Constraint rows of friction and of joint limits: each has one entry in the Jacobian. MuJoCo Warp has written them in
# any order; they are copied out in the order of type and id, and back.


@wp.kernel
def read_rows(
    nefc: wp.array[int],
    njmax: int,
    efc_type: wp.array2d[int],
    efc_id: wp.array2d[int],
    rowadr: wp.array2d[int],
    colind: wp.array3d[int],
    jacobian: wp.array3d[float],
    pos: wp.array2d[float],
    margin: wp.array2d[float],
    inverse_mass: wp.array2d[float],
    vel: wp.array2d[float],
    aref: wp.array2d[float],
    frictionloss: wp.array2d[float],
    names: wp.array2d[wp.vec3i],
    values: wp.array3d[float],
):
    """Copy each row to its rank: type, id and column to ``names`` [nworld, n], others to ``values`` [nworld, n, 7]."""
    world, row = wp.tid()
    count = wp.min(nefc[world], njmax)
    if row >= count:
        return
    kind = efc_type[world, row]
    identity = efc_id[world, row]
    rank = int(0)
    for other in range(count):
        other_kind = efc_type[world, other]
        if other_kind < kind or (other_kind == kind and efc_id[world, other] < identity):
            rank += 1
    entry = rowadr[world, row]
    names[world, rank] = wp.vec3i(kind, identity, colind[world, 0, entry])
    values[world, rank, 0] = jacobian[world, 0, entry]
    values[world, rank, 1] = pos[world, row]
    values[world, rank, 2] = margin[world, row]
    values[world, rank, 3] = inverse_mass[world, row]
    values[world, rank, 4] = vel[world, row]
    values[world, rank, 5] = aref[world, row]
    values[world, rank, 6] = frictionloss[world, row]


@wp.kernel
def write_rows(
    nefc: wp.array[int],
    njmax: int,
    names: wp.array2d[wp.vec3i],
    values: wp.array3d[float],
    efc_type: wp.array2d[int],
    efc_id: wp.array2d[int],
    rownnz: wp.array2d[int],
    rowadr: wp.array2d[int],
    colind: wp.array3d[int],
    jacobian: wp.array3d[float],
    pos: wp.array2d[float],
    margin: wp.array2d[float],
    inverse_mass: wp.array2d[float],
    vel: wp.array2d[float],
    aref: wp.array2d[float],
    frictionloss: wp.array2d[float],
    group_row: wp.array2d[int],
    group_rows: wp.array2d[int],
):
    """Write the rows back in order; row i has entry i of the Jacobian and is group i of the Hessian."""
    world, row = wp.tid()
    if row >= wp.min(nefc[world], njmax):
        return
    name = names[world, row]
    efc_type[world, row] = name[0]
    efc_id[world, row] = name[1]
    rownnz[world, row] = 1
    rowadr[world, row] = row
    colind[world, 0, row] = name[2]
    jacobian[world, 0, row] = values[world, row, 0]
    pos[world, row] = values[world, row, 1]
    margin[world, row] = values[world, row, 2]
    inverse_mass[world, row] = values[world, row, 3]
    vel[world, row] = values[world, row, 4]
    aref[world, row] = values[world, row, 5]
    frictionloss[world, row] = values[world, row, 6]
    group_row[world, row] = row
    group_rows[world, row] = 1


# ---------------------------------------------------------------------------------------------------------------------
# Constraint rows of contacts, behind those of friction and limits, in the order of the two geoms and of the number that
# the collider gave to the contact.


@wp.func
def _last_dof(body_weldid: wp.array[int], body_dofnum: wp.array[int], body_dofadr: wp.array[int], body: int) -> int:
    """The last joint coordinate of the body that carries this one; -1 for none."""
    moving = body_weldid[body]
    return wp.max(body_dofadr[moving] + body_dofnum[moving] - 1, -1)


@wp.func
def _count_dofs(dof_parentid: wp.array[int], first: int, second: int) -> int:
    """Coordinates that move one of two bodies but not both."""
    a = int(first)
    b = int(second)
    count = int(0)
    while a != b:
        if a > b:
            a = dof_parentid[a]
        else:
            b = dof_parentid[b]
        count += 1
    return count


@wp.kernel
def list_contacts(
    body_weldid: wp.array[int],
    body_dofnum: wp.array[int],
    body_dofadr: wp.array[int],
    dof_parentid: wp.array[int],
    geom_bodyid: wp.array[int],
    nacon: wp.array[int],
    dist: wp.array[float],
    dim: wp.array[int],
    includemargin: wp.array[float],
    worldid: wp.array[int],
    geom: wp.array[wp.vec2i],
    number: wp.array[int],
    kind: wp.array[int],
    nefc: wp.array[int],
    counts: wp.array[int],
    contacts: wp.array2d[int],
    keys: wp.array2d[wp.int64],
    sizes: wp.array2d[int],
):
    """List the contacts of each world that have constraint rows, in any order.

    Out: ``nefc`` counts their rows too; ``counts`` [nworld]; and [nworld, n] each: ``contacts``, their index; ``keys``,
    what orders them; ``sizes``, the Jacobian entries of a row times 8 plus the rows.
    """
    contact = wp.tid()
    if contact >= wp.min(nacon[0], dist.shape[0]):
        return
    if (kind[contact] & _IN_CONSTRAINT) == 0 or dist[contact] - includemargin[contact] >= 0.0:
        return
    world = worldid[contact]
    rows = dim[contact]
    wp.atomic_add(nefc, world, rows)
    slot = wp.atomic_add(counts, world, 1)
    if slot >= contacts.shape[1]:
        return
    pair = geom[contact]
    first = _last_dof(body_weldid, body_dofnum, body_dofadr, geom_bodyid[pair[0]])
    second = _last_dof(body_weldid, body_dofnum, body_dofadr, geom_bodyid[pair[1]])
    contacts[world, slot] = contact
    keys[world, slot] = (wp.int64(pair[0]) * _GEOMS + wp.int64(pair[1])) * _CONTACTS_OF_PAIR + wp.int64(number[contact])
    sizes[world, slot] = _count_dofs(dof_parentid, first, second) * _MOST_ROWS + rows


@wp.kernel
def place_contacts(
    njmax: int,
    njmax_nnz: int,
    friction: wp.array[int],
    limits: wp.array[int],
    counts: wp.array[int],
    contacts: wp.array2d[int],
    keys: wp.array2d[wp.int64],
    sizes: wp.array2d[int],
    efc_address: wp.array2d[int],
    efc_id: wp.array2d[int],
    rownnz: wp.array2d[int],
    rowadr: wp.array2d[int],
    group_row: wp.array2d[int],
    group_rows: wp.array2d[int],
    groups: wp.array[int],
):
    """Give each listed contact its rows and its entries of the Jacobian, in the order of the keys."""
    world, slot = wp.tid()
    count = wp.min(counts[world], contacts.shape[1])
    if slot >= count:
        return
    key = keys[world, slot]
    before = friction[world] + limits[world]
    rank = wp.min(before, njmax)
    row = int(before)
    entry = int(before)
    for other in range(count):
        if keys[world, other] < key:
            size = sizes[world, other]
            rank += 1
            row += size % _MOST_ROWS
            entry += (size // _MOST_ROWS) * (size % _MOST_ROWS)
    contact = contacts[world, slot]
    own = sizes[world, slot]
    entries = own // _MOST_ROWS
    rows = own % _MOST_ROWS
    for i in range(rows):
        if row + i < njmax:
            efc_address[contact, i] = row + i
            efc_id[world, row + i] = contact
        else:
            efc_address[contact, i] = -1
    if row >= njmax:
        return
    wp.atomic_add(groups, world, 1)
    group_row[world, rank] = row
    group_rows[world, rank] = wp.min(rows, njmax - row)
    # What does not fit is reported by MuJoCo Warp; the memory of vecenv's scenes has room for full rows.
    if entry + entries * rows > njmax_nnz:
        return
    for i in range(wp.min(rows, njmax - row)):
        rowadr[world, row + i] = entry + i * entries
        rownnz[world, row + i] = entries


# ---------------------------------------------------------------------------------------------------------------------
# The solver's sums. A group is a few rows in sequence with the same columns of the Jacobian: those of a contact, or a
# single one.


@wp.func
def _as_integer(value: float, units: float, largest: float) -> wp.int64:
    """A number as a multiple of 1 / ``units``."""
    return wp.int64(wp.rint(wp.clamp(value, -largest, largest) * units))


@wp.kernel
def add_forces(
    groups: wp.array[int],
    group_row: wp.array2d[int],
    group_rows: wp.array2d[int],
    rownnz: wp.array2d[int],
    rowadr: wp.array2d[int],
    colind: wp.array3d[int],
    jacobian: wp.array3d[float],
    force: wp.array2d[float],
    done: wp.array[bool],
    slots: int,
    sums: wp.array2d[wp.int64],
    qfrc: wp.array2d[float],
):
    """Add Jᵀ f to ``sums``, [nworld, nv]. A term that is not finite or too large makes its entry of ``qfrc`` NaN."""
    world, slot, lane = wp.tid()
    if done[world]:
        return
    for group in range(slot, groups[world], slots):
        row = group_row[world, group]
        for column in range(lane, rownnz[world, row], _LANES):
            total = float(0.0)
            for i in range(group_rows[world, group]):
                total += jacobian[world, 0, rowadr[world, row + i] + column] * force[world, row + i]
            dof = colind[world, 0, rowadr[world, row] + column]
            if not (wp.abs(total) < _LARGEST_FORCE):
                qfrc[world, dof] = wp.NAN
            elif total != 0.0:
                wp.atomic_add(sums, world, dof, _as_integer(total, _FORCE_UNITS, _LARGEST_FORCE))


@wp.kernel
def read_forces(done: wp.array[bool], sums: wp.array2d[wp.int64], qfrc: wp.array2d[float]):
    """Add the sums to the forces, which are zero or NaN, and clear them."""
    world, dof = wp.tid()
    if done[world]:
        return
    qfrc[world, dof] = qfrc[world, dof] + float(sums[world, dof]) / _FORCE_UNITS
    sums[world, dof] = wp.int64(0)


@wp.kernel
def gradient(
    qfrc_smooth: wp.array2d[float],
    qfrc_constraint: wp.array2d[float],
    inertial: wp.array2d[float],
    changed: wp.array[int],
    done: wp.array[bool],
    grad: wp.array2d[float],
    grad_dot: wp.array[float],
):
    """The solver's gradient [nworld, nv], and its squared length, which the thread of the first coordinate adds up."""
    world, dof = wp.tid()
    if done[world]:
        return
    grad[world, dof] = inertial[world, dof] - qfrc_smooth[world, dof] - qfrc_constraint[world, dof]
    if dof == 0:
        total = float(0.0)
        for i in range(qfrc_constraint.shape[1]):
            value = inertial[world, i] - qfrc_smooth[world, i] - qfrc_constraint[world, i]
            total += value * value
        grad_dot[world] = total


@wp.func
def _cone_entry(
    jacobian: wp.array3d[float],
    rowadr: wp.array2d[int],
    friction: vec5,
    tangent: vec5,
    curvature: float,
    mu: float,
    ratio: float,
    world: int,
    row: int,
    rows: int,
    first: int,
    second: int,
) -> float:
    """An entry of Jᵀ H J where H is the Hessian of a contact's cost in the middle zone of the elliptic cone.

    With z the scaled rows (the normal one times mu, tangential ones times their friction), t the unit direction of slip
    and r = mu N / T: curvature * (z0 z0' - mu (z0 t·z' + z0' t·z) + r (t·z)(t·z') + (mu² - r) z·z').
    """
    normal1 = mu * jacobian[world, 0, rowadr[world, row] + first]
    normal2 = mu * jacobian[world, 0, rowadr[world, row] + second]
    along1 = float(0.0)
    along2 = float(0.0)
    both = float(0.0)
    for i in range(1, rows):
        address = rowadr[world, row + i]
        z1 = friction[i - 1] * jacobian[world, 0, address + first]
        z2 = friction[i - 1] * jacobian[world, 0, address + second]
        along1 += tangent[i - 1] * z1
        along2 += tangent[i - 1] * z2
        both += z1 * z2
    mixed = normal1 * along2 + normal2 * along1
    return curvature * (normal1 * normal2 - mu * mixed + ratio * along1 * along2 + (mu * mu - ratio) * both)


@wp.kernel
def add_hessian(
    impratio_invsqrt: wp.array[float],
    contact_friction: wp.array[vec5],
    efc_id: wp.array2d[int],
    groups: wp.array[int],
    group_row: wp.array2d[int],
    group_rows: wp.array2d[int],
    rownnz: wp.array2d[int],
    rowadr: wp.array2d[int],
    colind: wp.array3d[int],
    jacobian: wp.array3d[float],
    inverse_mass: wp.array2d[float],
    state: wp.array2d[int],
    residual: wp.array2d[float],
    done: wp.array[bool],
    slots: int,
    sums: wp.array2d[wp.int64],
):
    """Add the constraints' part of the Hessian to ``sums``: entry (i, j), i <= j, at column j (j + 1) / 2 + i."""
    world, slot, lane = wp.tid()
    if done[world]:
        return
    for group in range(slot, groups[world], slots):
        row = group_row[world, group]
        rows = group_rows[world, group]
        in_cone = state[world, row] == _CONE
        friction = vec5()
        tangent = vec5()
        mu = float(0.0)
        curvature = float(0.0)
        ratio = float(0.0)
        if in_cone:
            friction = contact_friction[efc_id[world, row]]
            mu = friction[0] * impratio_invsqrt[world % impratio_invsqrt.shape[0]]
            if mu > 0.0:
                curvature = inverse_mass[world, row] / (mu * mu * (1.0 + mu * mu))
            length = float(0.0)
            for i in range(1, rows):
                tangent[i - 1] = residual[world, row + i] * friction[i - 1]
                length += tangent[i - 1] * tangent[i - 1]
            length = wp.max(wp.sqrt(length), _TINY)
            tangent = tangent / length
            ratio = mu * mu * residual[world, row] / length
        columns = rownnz[world, row]
        for entry in range(lane, columns * (columns + 1) // 2, _LANES):
            second = int((wp.sqrt(float(8 * entry + 1)) - 1.0) * 0.5)
            first = entry - second * (second + 1) // 2
            value = float(0.0)
            if in_cone:
                value = _cone_entry(
                    jacobian, rowadr, friction, tangent, curvature, mu, ratio, world, row, rows, first, second
                )
            else:
                for i in range(rows):
                    if state[world, row + i] == _QUADRATIC:
                        address = rowadr[world, row + i]
                        across = jacobian[world, 0, address + first] * jacobian[world, 0, address + second]
                        value += inverse_mass[world, row + i] * across
            if value != 0.0:
                one = colind[world, 0, rowadr[world, row] + first]
                other = colind[world, 0, rowadr[world, row] + second]
                low = wp.min(one, other)
                high = wp.max(one, other)
                integer = _as_integer(value, _HESSIAN_UNITS, _LARGEST_ENTRY)
                wp.atomic_add(sums, world, high * (high + 1) // 2 + low, integer)


@wp.kernel
def read_hessian(
    nv: int,
    inertia_entry: wp.array2d[int],
    inertia: wp.array2d[float],
    done: wp.array[bool],
    sums: wp.array2d[wp.int64],
    hessian: wp.array3d[float],
):
    """The Hessian's upper triangle: inertia matrix plus sums, which are cleared; the identity beyond ``nv``."""
    world, entry = wp.tid()
    if done[world]:
        return
    column = int((wp.sqrt(float(8 * entry + 1)) - 1.0) * 0.5)
    if column * (column + 1) // 2 > entry:
        column -= 1
    elif (column + 1) * (column + 2) // 2 <= entry:
        column += 1
    row = entry - column * (column + 1) // 2
    if column >= nv:
        hessian[world, row, column] = wp.where(row == column, 1.0, 0.0)
        return
    value = float(sums[world, entry]) / _HESSIAN_UNITS
    if inertia_entry[column, row] >= 0:
        value += inertia[world, inertia_entry[column, row]]
    hessian[world, row, column] = value
    sums[world, entry] = wp.int64(0)
