"""Operational-space control of the Panda arm, for every slot of a batch at once: robosuite 1.4.0's ``OSC_POSE`` in JAX.

In: the arm's kinematics and dynamics (``ArmState``), and once per control tick a 6-D action, which sets the goal pose.
Out: joint torques for each physics substep. ``set_goal`` and ``torques`` take arrays with any leading batch axes and
work under ``jit``, ``vmap`` and ``grad``; the dtype follows the inputs. Nothing is remembered between calls: the goal
is the caller's to keep. ``osc_numba`` is the same controller with its memory, for a simulator that is not JAX's.

How torques are computed: robosuite inverts ``J M⁻¹ Jᵀ``, which squares the conditioning of the arm. Here M = L Lᵀ is
factored and the columns of X = L⁻¹ Jᵀ are made orthogonal (modified Gram-Schmidt). The torques are the same:

* ``Jₚᵀ Λₚ F = L t``, where t is the shortest solution of ``Xₚᵀ t = F``; orientation likewise, with ``Xₒ`` alone.
* ``Nᵀ M a = L r``, where r is what remains of ``Lᵀ a`` after removing its part in the span of X.

A column that vanishes (an exactly singular arm) is dropped; robosuite's pseudo-inverse drops a singular value instead.
Nothing calls LAPACK: matrices are held batch-last and every operation is elementwise over the slots, so no slot affects
another.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from vecenv.controllers._batch_last import cross, fenced_on_cpu, stage, sum_rows
from vecenv.util.arrays import AnyArray
from vecenv.util.rotations import matmul, require_tail, safe_norm

NUM_JOINTS = 7
# Below this squared ratio to its own length a Gram-Schmidt remainder is rounding; robosuite's pinv uses the same 1e-15.
_RANK_TOLERANCE = 1e-15


@dataclass(frozen=True, kw_only=True)
class OscConfig:
    """Gains and limits of the controller; the defaults are robosuite's ``osc_pose.json`` and the Panda's actuators.

    Attributes:
        kp: stiffness of the end effector, 1/s².
        damping_ratio: 1 is critical damping.
        max_delta_pos: metres a full position action moves the goal.
        max_delta_ori: radians a full rotation action turns the goal.
        nullspace_kp: stiffness of the posture task, 1/s²; its damping is critical.
        torque_limit: largest torque of each joint, N·m.
    """

    kp: float = 150.0
    damping_ratio: float = 1.0
    max_delta_pos: float = 0.05
    max_delta_ori: float = 0.5
    nullspace_kp: float = 10.0
    torque_limit: tuple[float, ...] = (80.0, 80.0, 80.0, 80.0, 80.0, 12.0, 12.0)


OSC_POSE = OscConfig()


class ArmState(NamedTuple):
    """What the controller reads of the arm, world frame, SI units.

    Attributes:
        qpos: joint angles, [..., 7].
        qvel: joint velocities, [..., 7].
        eef_pos: position of the grip site, [..., 3].
        eef_mat: orientation of the grip site, [..., 3, 3].
        jacobian: of the grip site, linear rows first, [..., 6, 7].
        mass_matrix: joint-space inertia, [..., 7, 7].
        bias: gravity and velocity-product torques, [..., 7].
    """

    qpos: Float[Array, "*B 7"]
    qvel: Float[Array, "*B 7"]
    eef_pos: Float[Array, "*B 3"]
    eef_mat: Float[Array, "*B 3 3"]
    jacobian: Float[Array, "*B 6 7"]
    mass_matrix: Float[Array, "*B 7 7"]
    bias: Float[Array, "*B 7"]


class OscGoal(NamedTuple):
    """Pose the controller pulls the grip site to: ``pos`` [..., 3] and ``mat`` [..., 3, 3], world frame."""

    pos: Float[Array, "*B 3"]
    mat: Float[Array, "*B 3 3"]


_TAILS: tuple[tuple[int, ...], ...] = ((7,), (7,), (3,), (3, 3), (6, 7), (7, 7), (7,))


def _check_arm(arm: ArmState) -> ArmState:
    arm = ArmState(*map(jnp.asarray, arm))
    for name, value, tail in zip(ArmState._fields, arm, _TAILS, strict=True):
        require_tail(f"arm.{name}", value, tail)
    return arm


def _check_goal(goal: OscGoal) -> OscGoal:
    goal = OscGoal(*map(jnp.asarray, goal))
    require_tail("goal.pos", goal.pos, (3,))
    require_tail("goal.mat", goal.mat, (3, 3))
    return goal


def hold_goal(arm: ArmState) -> OscGoal:
    """The goal of a controller that was just loaded: stay at the arm's present pose."""
    return OscGoal(jnp.asarray(arm.eef_pos), jnp.asarray(arm.eef_mat))


@partial(jax.jit, static_argnames="config")
def set_goal(
    arm: ArmState, goal: OscGoal, delta_action: Float[AnyArray, "*B 6"], config: OscConfig = OSC_POSE
) -> OscGoal:
    """Set the goal from a policy action, as ``OperationalSpaceController.set_goal`` does once per control tick.

    The goal is relative to where the arm *is*, not to the previous goal. The orientation goal is kept when all three
    rotation components are exactly 0 (robosuite compares with zero absolute tolerance), so an arm whose action
    does not rotate returns to its last commanded orientation.

    Args:
        arm: current arm; only ``eef_pos`` and ``eef_mat`` are read.
        goal: previous goal.
        delta_action: position and rotation-vector action, [..., 6]; clipped to [-1, 1].
        config: the controller.

    Returns:
        The new goal.

    Raises:
        ValueError: a shape does not match.
    """
    arm, goal, action = _check_arm(arm), _check_goal(goal), jnp.asarray(delta_action)
    require_tail("delta_action", action, (6,))
    action = jnp.clip(action, -1, 1)
    rotvec = action[..., 3:] * config.max_delta_ori
    turned = matmul(_robosuite_rotation(rotvec), arm.eef_mat)
    keep = (rotvec == 0).all(-1)[..., None, None]
    return OscGoal(arm.eef_pos + action[..., :3] * config.max_delta_pos, jnp.where(keep, goal.mat, turned))


def _robosuite_rotation(rotvec: Float[Array, "*B 3"]) -> Float[Array, "*B 3 3"]:
    """Rotation matrix of a rotation vector with robosuite's rounding (``quat2mat(axisangle2quat(v))``).

    ``quat2mat`` computes in float32 for any input, which moves a goal by up to 1e-7 rad. The same roundings are
    made here, in the order compiled robosuite makes them, so float64 goals agree to the last bits.
    """
    angle = safe_norm(rotvec)[..., None]
    moving = angle > 0
    axis = rotvec / jnp.where(moving, angle, 1)
    single = _round_to_float32
    quat = single(jnp.concatenate([jnp.cos(angle / 2), axis * jnp.sin(angle / 2)], axis=-1))
    squares = single(quat * quat)
    squared_norm = single(squares[..., 0] + squares[..., 1] + squares[..., 2] + squares[..., 3])
    quat = single(quat * jnp.sqrt(2 / squared_norm)[..., None])
    w, x, y, z = (quat[..., i] for i in range(4))
    xx, yy, zz = single(x * x), single(y * y), single(z * z)
    xy, xz, yz = single(x * y), single(x * z), single(y * z)
    wx, wy, wz = single(w * x), single(w * y), single(w * z)
    rows = [
        [1 - yy - zz, single(xy - wz), single(xz + wy)],
        [single(xy + wz), 1 - xx - zz, single(yz - wx)],
        [single(xz - wy), single(yz + wx), 1 - xx - yy],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


@jax.custom_jvp
def _round_to_float32(x: jax.Array) -> jax.Array:
    # A cast there and back may be optimised away as excess precision; reduce_precision never is.
    return lax.reduce_precision(x, exponent_bits=8, mantissa_bits=23)


@_round_to_float32.defjvp
def _round_to_float32_jvp(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    return _round_to_float32(*primals), tangents[0]


@partial(jax.jit, static_argnames="config")
def torques(
    arm: ArmState, goal: OscGoal, home_qpos: Float[AnyArray, "*B 7"], config: OscConfig = OSC_POSE
) -> Float[Array, "... 7"]:
    """Joint torques that pull the grip site to the goal: ``OperationalSpaceController.run_controller``, then clipped.

    Args:
        arm: current arm.
        goal: goal pose.
        home_qpos: posture the redundant joint is drawn to, [..., 7]; robosuite takes the joints at reset.
        config: the controller.

    Returns:
        Torques clipped to the limits, [..., 7].

    Raises:
        ValueError: a shape does not match.
    """
    arm, goal, home = _check_arm(arm), _check_goal(goal), jnp.asarray(home_qpos)
    require_tail("home_qpos", home, (7,))
    tails = (*_TAILS, (3,), (3, 3), (7,))
    inputs = (*arm, *goal, home)
    batch = jnp.broadcast_shapes(*(x.shape[: x.ndim - len(tail)] for x, tail in zip(inputs, tails, strict=True)))
    last = [_to_batch_last(x, batch, tail) for x, tail in zip(inputs, tails, strict=True)]
    result = fenced_on_cpu(_torques_last, ArmState(*last[:7]), OscGoal(*last[7:9]), last[9], config=config)
    return jnp.moveaxis(result, -1, 0).reshape(*batch, NUM_JOINTS)


def _to_batch_last(x: jax.Array, batch: tuple[int, ...], tail: tuple[int, ...]) -> jax.Array:
    """[..., *tail] -> [*tail, N] with all batch axes flattened into the last."""
    return jnp.moveaxis(jnp.broadcast_to(x, batch + tail).reshape(-1, *tail), 0, -1)


# ---------------------------------------------------------------------------------------------------------------------
# Arrays are [rows, columns, slots] from here on, and the work is cut into stages: see ``_batch_last``.


def _torques_last(
    arm: ArmState, goal: OscGoal, home: Float[Array, "7 N"], *, config: OscConfig, fence: bool
) -> Float[Array, "7 N"]:
    """``torques`` on batch-last arrays: [7, N]."""
    force, moment, acceleration = stage(fence, partial(_desired, config=config), arm, goal, home)
    tables = [stage(fence, _table, arm.mass_matrix, arm.jacobian, acceleration)]
    for _ in range(NUM_JOINTS - 1):
        tables.append(stage(fence, _eliminate_row, tables[-1]))
    factor, whitened = stage(fence, _scale_rows, tables)
    both, turning, floor, turning_floor = stage(fence, _systems, whitened, force, moment)
    basis, rest = _orthogonalise(both, floor, 6, fence)
    turning_basis, _ = _orthogonalise(turning, turning_floor, 3, fence)
    # Rounding leaves up to a condition number of the projection behind: project a second time.
    left = stage(fence, _components, basis, rest)
    free = stage(fence, _remove_all, basis, left, rest)
    linear, angular = stage(fence, _solutions, basis[:3], turning_basis)
    total = stage(fence, _add_solutions, basis[:3] + turning_basis, linear + angular, free)
    return stage(fence, partial(_finish, config=config), factor, total, arm.bias)


def _desired(arm: ArmState, goal: OscGoal, home: jax.Array, *, config: OscConfig) -> tuple[jax.Array, ...]:
    """Desired linear [3, N], angular [3, N] and joint [7, N] accelerations: springs and dampers."""
    kd = 2 * math.sqrt(config.kp) * config.damping_ratio
    velocity = sum_rows(jnp.moveaxis(arm.jacobian * arm.qvel[None], 1, 0))
    turn = sum(cross(arm.eef_mat[:, i], goal.mat[:, i]) for i in range(3))
    force = config.kp * (goal.pos - arm.eef_pos) - kd * velocity[:3]
    moment = 0.5 * config.kp * turn - kd * velocity[3:]
    joint_kd = 2 * math.sqrt(config.nullspace_kp)
    return force, moment, config.nullspace_kp * (home - arm.qpos) - joint_kd * arm.qvel


def _table(
    mass_matrix: Float[Array, "7 7 N"], jacobian: Float[Array, "6 7 N"], acceleration: Float[Array, "7 N"]
) -> Float[Array, "7 14 N"]:
    """[M | Jᵀ | M a], [7, 14, N]: eliminating M's lower triangle leaves the rows of D Lᵀ, D X and D Lᵀ a."""
    inertial = sum_rows(mass_matrix * acceleration[:, None])
    return jnp.concatenate([mass_matrix, jnp.moveaxis(jacobian, 0, 1), inertial[:, None]], axis=1)


def _eliminate_row(rest: Float[Array, "k m N"]) -> Float[Array, "k-1 m-1 N"]:
    """One step of Gaussian elimination without pivoting (M is positive definite): [k, m, N] -> [k - 1, m - 1, N]."""
    pivot = rest[0, 1:]
    return rest[1:, 1:] - (pivot[: rest.shape[0] - 1] / rest[0, :1])[:, None] * pivot[None]


def _scale_rows(tables: list[jax.Array]) -> tuple[Float[Array, "7 7 N"], Float[Array, "7 7 N"]]:
    """Lᵀ [7, 7, N], zero below the diagonal, and [X | Lᵀ a] [7, 7, N], from the first rows of the tables."""
    rows = [table[0] for table in tables]
    scale = lax.rsqrt(jnp.stack([row[0] for row in rows]))[:, None]
    factor = [jnp.concatenate([jnp.zeros_like(row[:i]), row[: NUM_JOINTS - i]]) for i, row in enumerate(rows)]
    whitened = [row[NUM_JOINTS - i :] for i, row in enumerate(rows)]
    return jnp.stack(factor) * scale, jnp.stack(whitened) * scale


def _systems(
    whitened: Float[Array, "7 7 N"], force: Float[Array, "3 N"], moment: Float[Array, "3 N"]
) -> tuple[Float[Array, "8 7 N"], Float[Array, "8 3 N"], Float[Array, "6 N"], Float[Array, "3 N"]]:
    """What Gram-Schmidt works on: columns [8, k, N] whose eighth entry is the column's right-hand side.

    Returns:
        Position and posture system [8, 7, N], orientation system [8, 3, N], and for each column of either the squared
        length under which what remains of it is rounding, [6, N] and [3, N].
    """
    columns = whitened[:, :6]
    sides = jnp.concatenate([force, jnp.zeros_like(whitened[0, 3:])])
    epsilon = float(jnp.finfo(whitened.dtype).eps)
    floor = max(_RANK_TOLERANCE, (16 * epsilon) ** 2) * sum_rows(columns * columns)
    turning = jnp.concatenate([columns[:, 3:], moment[None]])
    return jnp.concatenate([whitened, sides[None]]), turning, floor, floor[3:]


class _Direction(NamedTuple):
    """One orthogonal direction: the first column of ``block`` [8, k, N], and its ``inverse`` squared length [N]."""

    block: Float[Array, "8 k N"]
    inverse: Float[Array, " N"]


def _orthogonalise(
    block: Float[Array, "8 k N"], floor: Float[Array, "count N"], count: int, fence: bool
) -> tuple[list[_Direction], Float[Array, "8 rest N"]]:
    """Modified Gram-Schmidt over the first ``count`` columns of a system [8, k, N].

    Returns:
        The orthogonal directions, and what remains of the other columns [8, k - count, N].
    """
    basis = []
    for k in range(count):
        inverse, ratio = stage(fence, partial(_project, index=k), block, floor)
        basis.append(_Direction(block, inverse))
        block = stage(fence, _remove, block, ratio)
    return basis, block


def _project(
    block: Float[Array, "8 k N"], floor: Float[Array, "count N"], *, index: int
) -> tuple[Float[Array, " N"], Float[Array, "k-1 N"]]:
    """Inverse squared length of the first column [N] and the other columns' components along it [k - 1, N]."""
    pivot = block[:7, 0]
    squared = sum_rows(pivot * pivot)
    kept = squared > floor[index]
    inverse = jnp.where(kept, 1 / jnp.where(kept, squared, 1), 0)
    return inverse, sum_rows(pivot[:, None] * block[:7, 1:]) * inverse[None]


def _remove(block: Float[Array, "8 k N"], ratio: Float[Array, "k-1 N"]) -> Float[Array, "8 k-1 N"]:
    """The other columns less their component along the first, [8, k - 1, N]."""
    return block[:, 1:] - block[:, :1] * ratio[None]


def _components(basis: list[_Direction], rest: Float[Array, "8 1 N"]) -> list[Float[Array, " N"]]:
    """Components [N] of the last column [8, 1, N] along each direction."""
    return [sum_rows(along.block[:7, 0] * rest[:7, 0]) * along.inverse for along in basis]


def _remove_all(
    basis: list[_Direction], components: list[Float[Array, " N"]], rest: Float[Array, "8 1 N"]
) -> Float[Array, "7 N"]:
    """The last column less these components, [7, N]."""
    vector = rest[:7, 0]
    for along, component in zip(basis, components, strict=True):
        vector = vector - along.block[:7, 0] * component[None]
    return vector


def _solutions(*bases: list[_Direction]) -> list[list[jax.Array]]:
    """Components [N] along each direction of the shortest solution of each system.

    The k-th would be ``rhs_k / length_k²`` were the directions exactly orthogonal; subtracting what the later ones
    contribute makes the method backward stable (Björck and Paige 1992, minimum norm). In float32 the worst of 20,000
    random arms is then off by 0.003 N·m instead of 0.03.
    """
    found = []
    for basis in bases:
        vectors = [along.block[:, 0] for along in basis]
        components = [vectors[-1][7] * basis[-1].inverse]
        for k in range(len(basis) - 2, -1, -1):
            left = vectors[k][7]
            for vector, component in zip(vectors[k + 1 :], components, strict=True):
                left = left - sum_rows(vectors[k][:7] * vector[:7]) * component
            components.insert(0, left * basis[k].inverse)
        found.append(components)
    return found


def _add_solutions(
    basis: list[_Direction], components: list[Float[Array, " N"]], free: Float[Array, "7 N"]
) -> Float[Array, "7 N"]:
    """Whitened torque [7, N]: the shortest solutions of both systems plus the posture's free part."""
    for along, component in zip(basis, components, strict=True):
        free = free + along.block[:7, 0] * component[None]
    return free


def _finish(
    factor: Float[Array, "7 7 N"], whitened: Float[Array, "7 N"], bias: Float[Array, "7 N"], *, config: OscConfig
) -> Float[Array, "7 N"]:
    """Torques ``L whitened + bias``, clipped, [7, N]."""
    raw = sum_rows(factor * whitened[:, None]) + bias
    limit = jnp.asarray(config.torque_limit, raw.dtype)[:, None]
    return jnp.clip(raw, -limit, limit)
