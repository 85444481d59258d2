"""Kinematics and dynamics of the robot alone, from its joint state: what the controller reads, without a simulator.

In: constants of the arm and its two fingers (``Chain``, which ``chain.chain_from_model`` reads from a compiled model),
and joint positions and velocities [..., 9]. Out: the ``ArmState`` that ``osc.torques`` takes (``arm_state``), and the
pose that proprioception reports (``hand_pose``). The numbers are those of MuJoCo's ``mj_forward``: ``site_xpos``,
``site_xmat``, ``mj_jacSite``, the mass matrix, ``qfrc_bias``, ``xquat``. So the controller can run before the physics
step of any simulator, inside ``jit``, at the cost of one arm instead of a whole scene.

How it is computed: in the configuration ``reference`` every frame is taken parallel to the world's, so a hinge turns by
``exp(axis angle)`` and rotations multiply along the chain (product of exponentials; Lynch and Park 2017, chapter 4).
Twists, forces and inertias are written about one point, the first hinge, where those of several bodies simply add up:
velocities and accelerations are running sums out along the chain, composite inertias and forces running sums back
(composite-rigid-body and recursive Newton-Euler algorithms; Featherstone 2008, chapters 5 and 6). Only the rotations
are a product, formed in three steps. The fingers hang on the last link: they count as two more bodies behind it.

Nothing calls a matrix product, which accelerators may round to TF32. Bodies and components are leading axes inside, and
everything is elementwise over the batch. On a CPU the work is cut into stages, see ``_batch_last``.
"""

from __future__ import annotations

from functools import partial, reduce
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from vecenv.controllers._batch_last import cross, fenced_on_cpu, stage, sum_rows
from vecenv.controllers.osc import NUM_JOINTS, ArmState
from vecenv.util.arrays import AnyArray
from vecenv.util.rotations import require_tail

NUM_FINGERS = 2
NUM_BODIES = NUM_JOINTS + NUM_FINGERS
# A float64 NumPy array as read from the model, or a JAX array where the chain is traced.
Constant: TypeAlias = Any


class Chain(NamedTuple):
    """Constants of the robot: a pytree, so it may be traced, or batched with ``vmap`` to randomise masses.

    Vectors are in world axes with the robot in its reference configuration. Bodies are the seven links, then the two
    fingers, each with everything welded to it.

    Attributes:
        reference: joint positions of the reference configuration, radians and metres, [9].
        base: position of the first hinge, metres, world frame, [3].
        axis: unit axes of the hinges, [7, 3].
        offset: from each hinge to the next, metres, [6, 3].
        slide: unit axes of the fingers, [2, 3].
        mass: kg, [9].
        com: centre of mass as seen from the link's hinge (a finger's from the last hinge), metres, [9, 3].
        inertia: about the centre of mass, kg m², [9, 3, 3].
        armature: rotor inertia of the hinges, kg m², [7].
        gravity: m/s², world frame, [3].
        site_offset: from the last hinge to the controlled site, metres, [3].
        site_axes: the x, y and z axes of that site, [3, 3].
        hand_quat: orientation of the hand body, wxyz, [4].
    """

    reference: Constant
    base: Constant
    axis: Constant
    offset: Constant
    slide: Constant
    mass: Constant
    com: Constant
    inertia: Constant
    armature: Constant
    gravity: Constant
    site_offset: Constant
    site_axes: Constant
    hand_quat: Constant


def arm_state(chain: Chain, qpos: Real[AnyArray, "*#B 9"], qvel: Real[AnyArray, "*#B 9"]) -> ArmState:
    """What the controller reads of the arm.

    Args:
        chain: the robot.
        qpos: positions of the seven hinges and the two fingers, radians and metres, [..., 9].
        qvel: their velocities, [..., 9].

    Returns:
        The arm, in the dtype of the inputs. ``mass_matrix`` includes armature, and the fingers where they are; ``bias``
        includes gravity and all velocity products, the fingers' included.

    Raises:
        ValueError: a shape does not match.
    """
    qpos, qvel = jnp.broadcast_arrays(_checked("qpos", qpos), _checked("qvel", qvel))
    dtype = jnp.result_type(qpos, qvel)
    qpos, qvel = qpos.astype(dtype), qvel.astype(dtype)
    found = fenced_on_cpu(_arm_last, _constants(chain, qpos), jnp.moveaxis(qpos, -1, 0), jnp.moveaxis(qvel, -1, 0))
    return ArmState(qpos[..., :NUM_JOINTS], qvel[..., :NUM_JOINTS], *map(_batch_first, found, (1, 2, 2, 2, 1)))


def hand_pose(chain: Chain, qpos: Real[AnyArray, "*B 9"]) -> tuple[Float[Array, "*B 3"], Float[Array, "*B 4"]]:
    """What proprioception reports of the hand.

    Args:
        chain: the robot.
        qpos: joint positions, radians and metres, [..., 9]; the fingers' do not matter.

    Returns:
        Position of the controlled site in metres, [..., 3], and orientation of the hand body, wxyz, [..., 4], with the
        sign of MuJoCo's ``xquat``; world frame.

    Raises:
        ValueError: a shape does not match.
    """
    qpos = _checked("qpos", qpos)
    pos, quat = fenced_on_cpu(_hand_last, _constants(chain, qpos), jnp.moveaxis(qpos, -1, 0))
    return _batch_first(pos, 1), _batch_first(quat, 1)


def _checked(name: str, value: AnyArray) -> jax.Array:
    array = jnp.asarray(value)
    require_tail(name, array, (NUM_BODIES,))
    return array.astype(jnp.result_type(array, 0.0))


def _constants(chain: Chain, qpos: jax.Array) -> Chain:
    """The chain in the dtype of ``qpos``, each array transposed, with axes of 1 in place of the batch's."""
    batch = (None,) * (qpos.ndim - 1)
    return Chain(*(jnp.asarray(x, qpos.dtype).T[(..., *batch)] for x in chain))


def _batch_first(x: jax.Array, tail: int) -> jax.Array:
    """Move the first ``tail`` axes behind the batch's."""
    return jnp.moveaxis(x, range(tail), range(-tail, 0))


# ---------------------------------------------------------------------------------------------------------------------
# Arrays are [components, bodies, ...batch] from here on, in world axes, seen from the first hinge. Twists and forces
# are 6-vectors, the angular part first. The work is cut into stages, see ``_batch_last``.


class _Frames(NamedTuple):
    """Where the robot is.

    Attributes:
        mat: rotations of the links since the reference configuration, [3, 3, 7, ...].
        pos: positions of the hinges, [3, 7, ...].
        eef: position of the controlled site, [3, ...].
    """

    mat: Float[Array, "3 3 7 *B"]
    pos: Float[Array, "3 7 *B"]
    eef: Float[Array, "xyz=3 *B"]


class _Inertias(NamedTuple):
    """Spatial inertias of k bodies: mass [k, ...], mass times centre [3, k, ...], second moments [3, 3, k, ...]."""

    mass: Float[Array, "k ..."]
    first: Float[Array, "3 k *B"]
    second: Float[Array, "3 3 k *B"]


def _hand_last(
    chain: Chain, qpos: Float[Array, "dof=9 *B"], *, fence: bool
) -> tuple[Float[Array, "xyz=3 *B"], Float[Array, "wxyz=4 *B"]]:
    """Position of the site and orientation of the hand."""
    turns = stage(fence, _hinge_quats, chain, qpos)
    turn = reduce(partial(stage, fence, _quat_product), [turns[:, i] for i in range(NUM_JOINTS)])
    return chain.base + _frames(chain, qpos, fence).eef, _quat_product(turn, chain.hand_quat)


def _arm_last(
    chain: Chain, qpos: Float[Array, "dof=9 *B"], qvel: Float[Array, "dof=9 *B"], *, fence: bool
) -> tuple[
    Float[Array, "xyz=3 *B"],
    Float[Array, "3 3 *B"],
    Float[Array, "6 7 *B"],
    Float[Array, "7 7 *B"],
    Float[Array, "dof=7 *B"],
]:
    """Position and orientation of the site, Jacobian, mass matrix and bias."""
    frames = _frames(chain, qpos, fence)
    pos, mat, jacobian, screws = stage(fence, _site, chain, frames)
    inertias = stage(fence, _inertias, chain, frames, qpos)
    mass_matrix = stage(fence, _mass_matrix, chain, screws, inertias)
    twist, added = stage(fence, _twists, chain, frames, screws, qvel)
    force = stage(fence, _forces, chain, inertias, twist, added)
    return pos, mat, jacobian, mass_matrix, stage(fence, _project, screws, force)


def _frames(chain: Chain, qpos: Float[Array, "dof=9 *B"], fence: bool) -> _Frames:
    mat = stage(fence, _hinge_mats, chain, qpos)
    for reach in (1, 2, 4):
        mat = stage(fence, partial(_compose, reach=reach), mat)
    return stage(fence, _place, chain, mat)


def _hinge_mats(chain: Chain, qpos: Float[Array, "dof=9 *B"]) -> Float[Array, "3 3 7 *B"]:
    """Rotation of each hinge since the reference configuration, [3, 3, 7, ...] (Rodrigues' formula).

    Matrices, not quaternions: in float32 the site's position is then off by 4e-8 m instead of 6e-8 (root mean square).
    """
    angle = (qpos - chain.reference)[:NUM_JOINTS]
    along = chain.axis[:, None] * chain.axis[None]
    columns = jnp.eye(3, dtype=along.dtype).reshape(3, 3, *[1] * angle.ndim)
    cos, sin = jnp.cos(angle)[None, None], jnp.sin(angle)[None, None]
    return along + cos * (columns - along) + sin * cross(chain.axis[:, None], columns)


def _compose(mat: Float[Array, "3 3 7 *B"], *, reach: int) -> Float[Array, "3 3 7 *B"]:
    """Multiply onto each rotation the one ``reach`` hinges before it; after 1, 2 and 4, each holds all before it."""
    return jnp.concatenate([mat[:, :, :reach], _product(mat[:, :, :-reach], mat[:, :, reach:])], axis=2)


def _hinge_quats(chain: Chain, qpos: Float[Array, "dof=9 *B"]) -> Float[Array, "4 7 *B"]:
    """The same as quaternions, [4, 7, ...]."""
    half = 0.5 * (qpos - chain.reference)[:NUM_JOINTS]
    return jnp.concatenate([jnp.cos(half)[None], chain.axis * jnp.sin(half)[None]])


def _quat_product(a: Float[Array, "4 *#B"], b: Float[Array, "4 *#B"]) -> Float[Array, "4 *#B"]:
    """Hamilton product of quaternions [4, ...]."""
    scalar = a[0] * b[0] - sum_rows(a[1:] * b[1:])
    return jnp.concatenate([scalar[None], a[:1] * b[1:] + b[:1] * a[1:] + cross(a[1:], b[1:])])


def _rotate(mat: Float[Array, "3 3 *#B"], v: Float[Array, "3 *#B"]) -> Float[Array, "3 *#B"]:
    """Matrices [3, 3, ...] times vectors [3, ...]."""
    return mat[:, 0] * v[:1] + mat[:, 1] * v[1:2] + mat[:, 2] * v[2:]


def _product(a: Float[Array, "3 3 *#B"], b: Float[Array, "3 3 *#B"]) -> Float[Array, "3 3 *#B"]:
    """Matrices [3, 3, ...] times matrices [3, 3, ...]."""
    return a[:, :1] * b[:1] + a[:, 1:2] * b[1:2] + a[:, 2:] * b[2:]


def _place(chain: Chain, mat: Float[Array, "3 3 7 *B"]) -> _Frames:
    steps = _rotate(mat[:, :, :-1], chain.offset)
    pos = _running_sum(jnp.concatenate([jnp.zeros_like(steps[:, :1]), steps], axis=1))
    return _Frames(mat, pos, pos[:, -1] + _rotate(mat[:, :, -1], chain.site_offset))


def _running_sum(x: Float[Array, "c k *B"]) -> Float[Array, "c k *B"]:
    """Along axis 1, the sum of all entries up to each."""
    sums = [x[:, 0]]
    for i in range(1, x.shape[1]):
        sums.append(sums[-1] + x[:, i])
    return jnp.stack(sums, axis=1)


def _site(chain: Chain, frames: _Frames) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The site's position [3, ...], orientation [3, 3, ...] and Jacobian [6, 7, ...], and the hinges' screws.

    A hinge's screw, [6, 7, ...], is the twist that it gives to the links behind it when it turns at 1 rad/s.
    """
    axis = _rotate(frames.mat, chain.axis)
    jacobian = jnp.concatenate([cross(axis, frames.eef[:, None] - frames.pos), axis])
    mat = _product(frames.mat[:, :, -1], chain.site_axes)
    return chain.base + frames.eef, mat, jacobian, jnp.concatenate([axis, cross(frames.pos, axis)])


def _inertias(chain: Chain, frames: _Frames, qpos: Float[Array, "dof=9 *B"]) -> _Inertias:
    """Inertias of the nine bodies."""
    mat, origin = jnp.stack([_with_fingers(row) for row in frames.mat]), _with_fingers(frames.pos)
    slid = chain.slide * (qpos - chain.reference)[None, NUM_JOINTS:]
    own = jnp.concatenate([jnp.zeros_like(frames.pos), slid], axis=1) + chain.com
    com = origin + _rotate(mat, own)
    turned = _product(_product(mat, chain.inertia), jnp.swapaxes(mat, 0, 1))
    first = chain.mass[None] * com
    return _Inertias(chain.mass, first, turned + _point_moments(first, com))


def _with_fingers(x: Float[Array, "c 7 *B"]) -> Float[Array, "c 9 *B"]:
    """Repeat the last link's entry for both fingers: [k, 7, ...] -> [k, 9, ...]."""
    return jnp.concatenate([x, x[:, -1:], x[:, -1:]], axis=1)


def _point_moments(first: Float[Array, "xyz=3 *B"], com: Float[Array, "xyz=3 *B"]) -> Float[Array, "3 3 *B"]:
    """Second moments [3, 3, ...] of point masses at ``com`` [3, ...]; ``first`` is mass times ``com``."""
    across = first[:, None] * com[None]
    trace = across[0, 0] + across[1, 1] + across[2, 2]
    rows = [[(trace if i == j else 0) - across[i, j] for j in range(3)] for i in range(3)]
    return jnp.stack([jnp.stack(row) for row in rows])


def _momentum(inertias: _Inertias, twist: Float[Array, "6 k *B"]) -> Float[Array, "6 k *B"]:
    """Spatial inertias times twists, [6, k, ...]."""
    turn, move = twist[:3], twist[3:]
    moment = _rotate(inertias.second, turn) + cross(inertias.first, move)
    return jnp.concatenate([moment, inertias.mass[None] * move - cross(inertias.first, turn)])


def _mass_matrix(chain: Chain, screws: Float[Array, "6 7 *B"], inertias: _Inertias) -> Float[Array, "7 7 *B"]:
    """Joint-space inertia [7, 7, ...] (composite-rigid-body algorithm)."""
    mass, first = _backward_sum(inertias.mass[None])[0], _backward_sum(inertias.first)
    second = jnp.stack([_backward_sum(row) for row in inertias.second])
    momentum = _momentum(_Inertias(mass, first, second), screws)
    product = sum_rows(screws[:, :, None] * momentum[:, None])
    row, column = np.indices((NUM_JOINTS, NUM_JOINTS)).reshape(2, NUM_JOINTS, NUM_JOINTS, *[1] * (product.ndim - 2))
    # Of two joints, the outer one's composite inertia counts.
    symmetric = jnp.where(row <= column, product, jnp.swapaxes(product, 0, 1))
    return symmetric + jnp.where(row == column, chain.armature[None], 0)


def _backward_sum(x: Float[Array, "c 9 *B"]) -> Float[Array, "c 7 *B"]:
    """Along axis 1, the sum of all entries from each on: of nine bodies [k, 9, ...], the links' [k, 7, ...]."""
    return _running_sum(x[:, ::-1])[:, : NUM_FINGERS - 1 : -1]


def _twists(
    chain: Chain, frames: _Frames, screws: Float[Array, "6 7 *B"], qvel: Float[Array, "dof=9 *B"]
) -> tuple[Float[Array, "6 9 *B"], Float[Array, "6 9 *B"]]:
    """Twists of the nine bodies, and what each body's own joint adds to them, [6, 9, ...]."""
    slide = _rotate(frames.mat[:, :, -1:], chain.slide) * qvel[None, NUM_JOINTS:]
    fingers = jnp.concatenate([jnp.zeros_like(slide), slide])
    added = jnp.concatenate([screws * qvel[None, :NUM_JOINTS], fingers], axis=1)
    return _accumulate(added), added


def _accumulate(x: Float[Array, "c 9 *B"]) -> Float[Array, "c 9 *B"]:
    """Along axis 1, the sum of the entries of each body and all that carry it, [k, 9, ...]."""
    links = _running_sum(x[:, :NUM_JOINTS])
    return jnp.concatenate([links, links[:, -1:] + x[:, NUM_JOINTS:]], axis=1)


def _forces(
    chain: Chain, inertias: _Inertias, twist: Float[Array, "6 9 *B"], added: Float[Array, "6 9 *B"]
) -> Float[Array, "6 9 *B"]:
    """Forces on the nine bodies while no joint accelerates, [6, 9, ...] (recursive Newton-Euler algorithm)."""
    turn, move = twist[:3], twist[3:]
    # A joint's twist is carried along by its body, so it changes direction.
    change = jnp.concatenate([cross(turn, added[:3]), cross(turn, added[3:]) + cross(move, added[:3])])
    accelerations = _accumulate(change)
    # Gravity is an upward acceleration of the base.
    lifted = jnp.concatenate([accelerations[:3], accelerations[3:] - chain.gravity[:, None]])
    momentum = _momentum(inertias, twist)
    gyroscopic = jnp.concatenate([cross(turn, momentum[:3]) + cross(move, momentum[3:]), cross(turn, momentum[3:])])
    return _momentum(inertias, lifted) + gyroscopic


def _project(screws: Float[Array, "6 7 *B"], force: Float[Array, "6 9 *B"]) -> Float[Array, "dof=7 *B"]:
    """Torques of the hinges, [7, ...]: each carries the forces on everything behind it."""
    return sum_rows(screws * _backward_sum(force))
