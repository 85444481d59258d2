"""Closed-loop following of absolute end-effector poses: what ``step_ee_pose`` computes each control tick.

In: the end effector's pose and a target pose with a grip bit (1 closed, 0 open). Out: the 7-D continuous action of this
tick and the reference the next tick starts from. Everything is a pure function of arrays with any leading batch axes:
xyz in metres, unit quaternions wxyz, world frame.

The servo carries a *reference*: a pose that starts at the hand and moves towards the target by at most 5 mm and
0.05 rad a tick. The action is the offset from the hand to the reference, because goals of the OSC are relative to the
present pose.

A goal that is always 5 mm ahead of the hand would be too slow, because the OSC is a damped spring that never catches up
with it: the hand settles at ``kp / kd`` = 6.1 /s times 5 mm, which is 1.5 mm a 50 ms tick. On
robosuite's own simulation (libero_object task 0, 20 cm sideways) that took 154 ticks, past the default budget of 100;
carrying the reference took 41 at 5.0 mm a tick, and a 1.5 rad turn 33 instead of 117. Travelling at 5 mm a tick the
hand trails the reference by ``kd / kp`` times the speed: 16 mm, 0.16 rad. ``max_lead_pos`` and ``max_lead_rot`` bound
that gap, so that a hand held back by an obstacle does not wind the reference up; set to the advances themselves they
give the simple form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Real

from vecenv.controllers.osc import OSC_POSE, OscConfig
from vecenv.errors import InvalidInput
from vecenv.util import configs, inputs
from vecenv.util.arrays import AnyArray
from vecenv.util.rotations import quat_mul, quat_normalize, require_tail, rotation_between, rotvec_to_quat, safe_norm

_SERVO_NUMBERS = ("pos_tol", "rot_tol", "max_advance_pos", "max_advance_rot", "max_lead_pos", "max_lead_rot")


@dataclass(frozen=True, kw_only=True)
class WaypointConfig:
    """Numbers of the servo.

    Attributes:
        max_steps: control ticks one call may use.
        pos_tol: metres within which the position has converged.
        rot_tol: radians within which the rotation has converged.
        max_advance_pos: metres the reference moves in a tick at most.
        max_advance_rot: radians the reference turns in a tick at most.
        max_lead_pos: metres the reference may be ahead of the hand.
        max_lead_rot: radians the reference may be ahead of the hand.
    """

    max_steps: int = 100
    pos_tol: float = 0.01
    rot_tol: float = 0.10
    max_advance_pos: float = 0.005
    max_advance_rot: float = 0.05
    max_lead_pos: float = 0.025
    max_lead_rot: float = 0.25

    def __post_init__(self) -> None:
        configs.check(self, InvalidInput, positive=_SERVO_NUMBERS, ranges={"max_steps": (1, inputs.MOST_COUNT)})


STEP_EE_POSE = WaypointConfig()


class Pose(NamedTuple):
    """Position ``pos`` [..., 3] in metres and unit quaternion ``quat`` [..., 4] wxyz, world frame."""

    pos: Float[AnyArray, "*B 3"]
    quat: Float[AnyArray, "*B 4"]


class Target(NamedTuple):
    """A waypoint read by ``read_target``.

    Attributes:
        pose: where to go; the origin, unrotated, where ``valid`` is False.
        grip: 1 closed, 0 open, [...].
        valid: bool [...]; False where the waypoint held NaN or infinity or a quaternion of length zero.
    """

    pose: Pose
    grip: Float[Array, "*B"]
    valid: Bool[Array, "*B"]


def read_target(waypoint: Float[AnyArray, "*B 8"]) -> Target:
    """Split and check waypoints.

    Args:
        waypoint: [..., 8]: x, y, z, qw, qx, qy, qz, grip. Quaternions of any positive length are scaled to 1.

    Returns:
        The targets. An invalid waypoint must not be followed; it is replaced by finite numbers.

    Raises:
        ValueError: the last axis is not 8 wide.
    """
    waypoint = jnp.asarray(waypoint)
    require_tail("waypoint", waypoint, (8,))
    quat, turned = quat_normalize(waypoint[..., 3:7])
    valid = turned & jnp.isfinite(waypoint).all(-1)
    pos = jnp.where(valid[..., None], waypoint[..., :3], 0)
    quat = jnp.where(valid[..., None], quat, jnp.eye(1, 4, dtype=quat.dtype)[0])
    return Target(Pose(pos, quat), jnp.where(valid, waypoint[..., 7], 0), valid)


def gripper_action(grip: Real[AnyArray, "*B"]) -> Real[Array, "*B"]:
    """Gripper action [...] of a grip bit [...]: +1 (close) above one half, else -1 (open)."""
    grip = jnp.asarray(grip)
    return jnp.where(grip > 0.5, jnp.ones_like(grip), -jnp.ones_like(grip))


def hold_action(grip: Real[AnyArray, "*B"]) -> Real[Array, "*B 7"]:
    """Action of a hold tick, [..., 7]: no motion, the gripper command of the grip bit [...].

    The OSC then keeps the position it has and its last commanded orientation.
    """
    command = gripper_action(grip)[..., None]
    return jnp.concatenate([jnp.zeros((*command.shape[:-1], 6), command.dtype), command], axis=-1)


def servo(
    current: Pose,
    target: Pose,
    grip: Real[AnyArray, "*B"],
    reference: Pose,
    config: WaypointConfig = STEP_EE_POSE,
    osc: OscConfig = OSC_POSE,
) -> tuple[Float[Array, "... 7"], Pose]:
    """Action of one tick towards the targets.

    Args:
        current: the end effector now.
        target: where it shall go.
        grip: grip bit, [...].
        reference: what the previous tick returned; ``current`` when the previous tick was no servo tick. Following
            several waypoints, carry it from one to the next: starting over at ``current`` costs the hand its speed.
        config: the servo.
        osc: the controller that will take the action; it defines what a full action means.

    Returns:
        Continuous actions [..., 7] and the new reference.

    Raises:
        ValueError: a shape does not match.
    """
    for name, pose in (("current", current), ("target", target), ("reference", reference)):
        require_tail(f"{name}.pos", jnp.asarray(pose.pos), (3,))
        require_tail(f"{name}.quat", jnp.asarray(pose.quat), (4,))
    ahead = _advance(reference, target, config)
    lead = _bounded(ahead.pos - current.pos, config.max_lead_pos)
    turn = _bounded(rotation_between(current.quat, ahead.quat), config.max_lead_rot)
    command = gripper_action(grip).astype(lead.dtype)
    motion = jnp.concatenate([lead / osc.max_delta_pos, turn / osc.max_delta_ori], axis=-1)
    command = jnp.broadcast_to(command[..., None], (*motion.shape[:-1], 1))
    action = jnp.concatenate([jnp.clip(motion, -1, 1), command], axis=-1)
    return action, Pose(current.pos + lead, _turn(current.quat, turn))


def _advance(reference: Pose, target: Pose, config: WaypointConfig) -> Pose:
    """The reference after one tick on its way to the target."""
    step = _bounded(target.pos - reference.pos, config.max_advance_pos)
    turn = _bounded(rotation_between(reference.quat, target.quat), config.max_advance_rot)
    return Pose(reference.pos + step, _turn(reference.quat, turn))


def _bounded(vector: Float[AnyArray, "*B 3"], length: float) -> Float[Array, "*B 3"]:
    """Vectors [..., 3] shortened to at most ``length``."""
    vector = jnp.asarray(vector)
    norm = safe_norm(vector)[..., None]
    return vector * jnp.where(norm > length, length / jnp.where(norm > length, norm, 1), 1)


def _turn(quat: Float[AnyArray, "*#B 4"], rotvec: Float[Array, "*#B 3"]) -> Float[Array, "*#B 4"]:
    """Unit quaternions [..., 4] turned by world-frame rotation vectors [..., 3]."""
    return quat_normalize(quat_mul(rotvec_to_quat(rotvec), quat))[0]


def pose_error(current: Pose, target: Pose) -> tuple[Float[Array, ...], Float[Array, ...]]:
    """Distance [...] in metres and angle [...] in radians (at most pi) between poses."""
    return safe_norm(target.pos - current.pos), safe_norm(rotation_between(current.quat, target.quat))


def converged(current: Pose, target: Pose, config: WaypointConfig = STEP_EE_POSE) -> Bool[Array, ...]:
    """Bool [...]: position and rotation are both within tolerance.

    Evaluate it after a tick: a call then takes at least one tick, and its gripper command is always applied.
    """
    distance, angle = pose_error(current, target)
    return (distance <= config.pos_tol) & (angle <= config.rot_tol)


class WaypointPlan(NamedTuple):
    """Waypoints of B slots, T each, to be followed in order.

    Attributes:
        pose: targets, [B, T, ...].
        grip: 1 closed, 0 open, [B, T].
        hold: control ticks without motion in place of the drive, int [B, T]; 0 drives.
        valid: bool [B, T]; the others are skipped.
    """

    pose: Pose
    grip: Real[AnyArray, "B T"]
    hold: Int[AnyArray, "B T"]
    valid: Bool[AnyArray, "B T"]


class Progress(NamedTuple):
    """How far each slot has come on its plan.

    Attributes:
        index: waypoint being followed, int [B]; T when none is left.
        spent: ticks spent on it, int [B].
        misses: waypoints in a row that ran out of ticks, int [B].
        reference: the servo's reference, [B, ...].
        converged: bool [B, T]; within tolerance when it was left.
        ticks: ticks spent on each, int [B, T].
    """

    index: Int[Array, " B"]
    spent: Int[Array, " B"]
    misses: Int[Array, " B"]
    reference: Pose
    converged: Bool[Array, "B T"]
    ticks: Int[Array, "B T"]


def begin_plan(plan: WaypointPlan, reference: Pose) -> Progress:
    """Progress before the first tick; the servo's reference starts at the end effector unless it is carried on."""
    shape = plan.valid.shape
    none = jnp.zeros(shape[0], jnp.int32)
    index = _next_valid(plan.valid, none)
    return Progress(index, none, none, reference, jnp.zeros(shape, bool), jnp.zeros(shape, jnp.int32))


def start_reference(current: Pose, carried: Real[AnyArray, "B 7"]) -> Pose:
    """Where the servo's reference starts: at the end effectors, or at the rows of ``carried`` that are not NaN."""
    kept = jnp.isfinite(carried).all(-1, keepdims=True)
    pos, quat = jnp.asarray(current.pos), jnp.asarray(current.quat)
    return Pose(jnp.where(kept, carried[..., :3], pos), jnp.where(kept, carried[..., 3:], quat))


def unfinished(plan: WaypointPlan, progress: Progress) -> Bool[Array, " B"]:
    """Bool [B]: a waypoint is left."""
    return progress.index < plan.valid.shape[1]


def plan_action(
    plan: WaypointPlan,
    progress: Progress,
    current: Pose,
    moves: Bool[AnyArray, " B"],
    config: WaypointConfig = STEP_EE_POSE,
) -> tuple[Float[Array, "B 7"], Progress]:
    """Action of one tick, [B, 7], and the progress with the servo's new reference in the slots ``moves``, bool [B]."""
    target, grip, hold = _at_index(plan, progress.index)
    moving, ahead = servo(current, target, grip, progress.reference, config)
    holding = (hold > 0)[:, None]
    action = jnp.where(holding, hold_action(grip), moving)
    reference = Pose(*(jnp.where(holding, now, new) for now, new in zip(current, ahead, strict=True)))
    parts = zip(reference, progress.reference, strict=True)
    reference = Pose(*(jnp.where(jnp.asarray(moves)[:, None], new, old) for new, old in parts))
    return action, progress._replace(reference=reference)


def plan_advance(
    plan: WaypointPlan,
    progress: Progress,
    current: Pose,
    moved: Bool[AnyArray, " B"],
    config: WaypointConfig = STEP_EE_POSE,
) -> Progress:
    """Progress after a tick.

    Args:
        plan: the plan.
        progress: what ``plan_action`` returned.
        current: the end effector after the tick.
        moved: bool [B], the slots that took part; the others keep their progress.
        config: tolerances, and the ticks a waypoint may take.
    """
    target, _, hold = _at_index(plan, progress.index)
    driving = hold == 0
    arrived = converged(current, target, config)
    spent = progress.spent + 1
    left = (arrived & driving) | (spent >= jnp.where(driving, config.max_steps, hold))
    missed = left & driving & ~arrived
    misses = jnp.where(left & driving, jnp.where(missed, progress.misses + 1, 0), progress.misses)
    here = jnp.arange(plan.valid.shape[1])[None] == progress.index[:, None]
    after = Progress(
        index=_next_valid(plan.valid, progress.index + left),
        spent=jnp.where(left, 0, spent),
        misses=misses,
        reference=progress.reference,
        converged=jnp.where(here, arrived[:, None], progress.converged),
        ticks=jnp.where(here, spent[:, None], progress.ticks),
    )
    return jax.tree.map(lambda new, old: jnp.where(moved.reshape(-1, *[1] * (new.ndim - 1)), new, old), after, progress)


def _at_index(plan: WaypointPlan, index: Int[Array, " B"]) -> tuple[Pose, Real[AnyArray, " B"], Int[AnyArray, " B"]]:
    """Pose, grip and hold of one waypoint a slot; past the end, of the last."""
    slot, at = jnp.arange(index.shape[0]), jnp.minimum(index, plan.valid.shape[1] - 1)
    return Pose(plan.pose.pos[slot, at], plan.pose.quat[slot, at]), plan.grip[slot, at], plan.hold[slot, at]


def _next_valid(valid: Bool[AnyArray, "B T"], index: Int[Array, " B"]) -> Int[Array, " B"]:
    """The first valid waypoint at or after ``index``, or T."""
    count = valid.shape[1]
    ahead = valid & (jnp.arange(count)[None] >= index[:, None])
    return jnp.where(ahead.any(1), ahead.argmax(1), count).astype(jnp.int32)
