"""The pose servo: what it commands, and that it arrives on robosuite's physics."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.robosuite_peer import OurArm, RobosuitePeer

from vecenv.controllers import waypoint
from vecenv.controllers.waypoint import STEP_EE_POSE, Pose, WaypointConfig
from vecenv.util.rotations import quat_mul, rotvec_to_quat

OPEN, CLOSED = jnp.asarray(0.0), jnp.asarray(1.0)
IDENTITY = jnp.array([1.0, 0.0, 0.0, 0.0])


def pose(pos: list[float], rotvec: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Pose:
    return Pose(jnp.array(pos), rotvec_to_quat(jnp.array(rotvec)))


def angle_between(a: Pose, b: Pose) -> np.ndarray:
    return np.asarray(waypoint.pose_error(a, b)[1])


# One tick -----------------------------------------------------------------------------------------------------------


def test_the_first_tick_asks_for_at_most_5_mm_and_a_twentieth_of_a_radian() -> None:
    here = pose([0.1, 0.2, 0.3])
    action, reference = waypoint.servo(here, pose([0.1, 0.5, -0.1], (0.0, 0.0, 2.0)), OPEN, here)
    np.testing.assert_allclose(action[:3] * 0.05, np.array([0, 0.6, -0.8]) * 0.005, atol=1e-7)
    np.testing.assert_allclose(action[3:6] * 0.5, [0, 0, 0.05], atol=1e-6)
    np.testing.assert_allclose(reference.pos - here.pos, action[:3] * 0.05, atol=1e-7)


def test_a_near_target_is_asked_for_exactly() -> None:
    here, there = pose([0.0, 0.0, 0.0]), pose([0.003, 0.0, -0.002], (0.02, 0.0, 0.0))
    action, reference = waypoint.servo(here, there, OPEN, here)
    np.testing.assert_allclose(action[:3] * 0.05, there.pos, atol=1e-7)
    np.testing.assert_allclose(action[3:6] * 0.5, [0.02, 0, 0], atol=1e-6)
    np.testing.assert_allclose(reference.quat, there.quat, atol=1e-6)


def test_the_reference_advances_by_no_more_than_the_limits_and_arrives() -> None:
    current, there = pose([0.0, 0.0, 0.0]), pose([0.03, 0.04, 0.0], (0.0, 0.4, 0.0))
    reference, ticks = current, 0
    while waypoint.pose_error(reference, there)[0] > 1e-6 or angle_between(reference, there) > 1e-6:
        before = reference
        _, reference = waypoint.servo(before, there, OPEN, before)
        moved, turned = waypoint.pose_error(before, reference)
        assert moved <= 0.005 + 1e-7
        assert turned <= 0.05 + 1e-6
        ticks += 1
        assert ticks < 20
    assert ticks == 10


def test_a_blocked_hand_does_not_wind_the_reference_up() -> None:
    stuck, there = pose([0.0, 0.0, 0.0]), pose([1.0, 0.0, 0.0], (0.0, 0.0, 3.0))
    reference = stuck
    for _ in range(50):
        action, reference = waypoint.servo(stuck, there, OPEN, reference)
    np.testing.assert_allclose(action[:3] * 0.05, [STEP_EE_POSE.max_lead_pos, 0, 0], atol=1e-6)
    np.testing.assert_allclose(action[3:6] * 0.5, [0, 0, STEP_EE_POSE.max_lead_rot], atol=1e-5)


@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-6, -np.pi, 3.0, -3.0])
def test_a_half_turn_is_finished_without_turning_back(angle: float) -> None:
    reference, there = pose([0.0, 0.0, 0.0]), pose([0.0, 0.0, 0.0], (angle, 0.0, 0.0))
    left = angle_between(reference, there)
    for _ in range(int(np.ceil(abs(angle) / 0.05)) + 1):
        action, reference = waypoint.servo(reference, there, OPEN, reference)
        now = angle_between(reference, there)
        assert np.isfinite(action).all()
        assert now < left or now < 1e-3
        left = now
    assert left < 1e-3


def test_the_grip_bit_becomes_the_gripper_action() -> None:
    grip = jnp.array([0.0, 0.4, 0.5, 0.51, 1.0])
    np.testing.assert_array_equal(waypoint.gripper_action(grip), [-1, -1, -1, 1, 1])
    held = waypoint.hold_action(grip)
    np.testing.assert_array_equal(held[:, :6], 0)
    np.testing.assert_array_equal(held[:, 6], waypoint.gripper_action(grip))
    here = pose([0.0, 0.0, 0.0])
    assert waypoint.servo(here, here, CLOSED, here)[0][6] == 1


def test_convergence_needs_both_tolerances() -> None:
    here = pose([0.0, 0.0, 0.0])
    for offset, turn, expected in ((0.009, 0.09, True), (0.011, 0.09, False), (0.009, 0.11, False)):
        assert bool(waypoint.converged(pose([offset, 0.0, 0.0], (0.0, turn, 0.0)), here)) is expected
    loose = WaypointConfig(pos_tol=0.02, rot_tol=0.2)
    assert waypoint.converged(pose([0.011, 0.0, 0.0], (0.0, 0.11, 0.0)), here, loose)


# Waypoints ----------------------------------------------------------------------------------------------------------


def test_waypoints_are_split_and_their_quaternions_scaled_to_one() -> None:
    target = waypoint.read_target(jnp.array([1.0, 2.0, 3.0, 0.0, 0.0, -4.0, 3.0, 1.0]))
    np.testing.assert_array_equal(target.pose.pos, [1, 2, 3])
    np.testing.assert_allclose(target.pose.quat, [0, 0, -0.8, 0.6], atol=1e-7)
    assert target.valid
    assert target.grip == 1


def test_unusable_waypoints_are_masked_and_replaced_by_finite_numbers() -> None:
    good = [0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0, 1.0]
    rows = np.array([good] * 5)
    rows[1, 3:7] = 0
    rows[2, 0] = np.nan
    rows[3, 5] = np.inf
    rows[4, 7] = np.nan
    target = waypoint.read_target(jnp.asarray(rows))
    np.testing.assert_array_equal(target.valid, [True, False, False, False, False])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(target))
    np.testing.assert_array_equal(target.pose.quat[1:], np.tile(IDENTITY, (4, 1)))


# Batches ------------------------------------------------------------------------------------------------------------


def random_poses(count: int, seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    pos, rotvec = rng.normal(size=(2, count, 3))
    return Pose(jnp.asarray(pos, jnp.float32), rotvec_to_quat(jnp.asarray(rotvec, jnp.float32)))


def test_slots_are_independent_under_jit_and_vmap() -> None:
    here, there, reference = (random_poses(6, seed) for seed in range(3))
    grip = jnp.array([0.0, 1.0, 1.0, 0.0, 1.0, 0.0])
    batched = jax.jit(waypoint.servo)(here, there, grip, reference)
    mapped = jax.vmap(waypoint.servo)(here, there, grip, reference)
    single = [
        waypoint.servo(*(jax.tree.map(lambda x, i=i: x[i], v) for v in (here, there, grip, reference)))
        for i in range(6)
    ]
    assert batched[0].shape == (6, 7)
    assert batched[0].dtype == np.float32
    for got, expected in zip(jax.tree.leaves(mapped), jax.tree.leaves(batched), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-5)
    np.testing.assert_allclose(np.stack([action for action, _ in single]), batched[0], atol=1e-5)


def test_gradients_are_finite_at_the_target() -> None:
    here = pose([0.0, 0.0, 0.0])
    slope = jax.grad(lambda pos: waypoint.servo(Pose(pos, here.quat), here, OPEN, here)[0].sum())(here.pos)
    assert np.isfinite(slope).all()


@pytest.mark.usefixtures("unchecked_shapes")
def test_wrong_shapes_are_named() -> None:
    here = pose([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"waypoint must have shape \[\.\.\., 8\], got \[7\]"):
        waypoint.read_target(jnp.zeros(7))
    with pytest.raises(ValueError, match=r"target\.quat must have shape \[\.\.\., 4\], got \[3\]"):
        waypoint.servo(here, Pose(here.pos, jnp.zeros(3)), OPEN, here)


# Physics ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def peer() -> RobosuitePeer:
    return RobosuitePeer()


def follow(arm: OurArm, target: Pose, config: WaypointConfig) -> tuple[int, float, float]:
    """Ticks until convergence (0: never), and the most the hand moved and turned in one tick."""
    step = jax.jit(waypoint.servo, static_argnums=4)
    reference, moved, turned = arm.pose(), 0.0, 0.0
    for tick in range(1, config.max_steps + 1):
        before = arm.pose()
        action, reference = step(before, target, OPEN, reference, config)
        arm.tick(np.asarray(action))
        now = arm.pose()
        distance, angle = waypoint.pose_error(before, now)
        moved, turned = max(moved, float(distance)), max(turned, float(angle))
        if waypoint.converged(now, target, config):
            return tick, moved, turned
    return 0, moved, turned


@pytest.mark.parametrize(
    ("offset", "turn", "ticks"),
    [
        ((0.0, 0.2, 0.0), (0.0, 0.0, 0.0), 50),
        ((0.1, -0.1, 0.1), (0.0, 0.0, 0.0), 45),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 1.2), 35),
        ((0.05, 0.05, -0.03), (0.3, 0.0, -0.6), 30),
    ],
)
def test_the_hand_arrives_at_about_5_mm_a_tick(
    peer: RobosuitePeer, offset: tuple[float, ...], turn: tuple[float, ...], ticks: int
) -> None:
    with jax.enable_x64(True):
        arm = OurArm(peer)
        start = arm.pose()
        target = Pose(start.pos + np.array(offset), quat_mul(rotvec_to_quat(jnp.array(turn)), start.quat))
        used, moved, turned = follow(arm, target, STEP_EE_POSE)
    assert 0 < used <= ticks
    # The setpoint keeps the limits exactly; the hand overshoots them by a tenth while it gathers speed.
    assert moved < 0.006
    assert turned < 0.06


def test_without_a_carried_reference_20_cm_take_longer_than_the_default_budget(peer: RobosuitePeer) -> None:
    plain = WaypointConfig(max_lead_pos=0.005, max_lead_rot=0.05)
    with jax.enable_x64(True):
        arm = OurArm(peer)
        start = arm.pose()
        used, moved, _ = follow(arm, Pose(start.pos + np.array([0.0, 0.2, 0.0]), start.quat), plain)
    assert used == 0
    assert moved < 0.002


def test_hold_ticks_keep_the_pose(peer: RobosuitePeer) -> None:
    with jax.enable_x64(True):
        arm = OurArm(peer)
        start = arm.pose()
        for _ in range(20):
            arm.tick(np.asarray(waypoint.hold_action(CLOSED)))
        distance, angle = map(float, waypoint.pose_error(start, arm.pose()))
    assert distance < 0.003
    assert angle < 0.02
