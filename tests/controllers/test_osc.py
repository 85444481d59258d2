"""The batched OSC against robosuite's own controller, and what JAX is promised about it."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.robosuite_peer import SUBSTEPS, RobosuitePeer, Rollout, arm_from_rows, believed, goal_of

from vecenv.controllers import osc
from vecenv.libero.physics.mjx.options import compiler_options

# Without LLVM's optimisation things compile several times faster; where a test says nothing of speed and rounding.
OPTIONS: dict[str, Any] = {**compiler_options(), "xla_backend_optimization_level": 0}
compiled = partial(jax.jit, compiler_options=OPTIONS)
# Arms of the parity tests, and substeps of the rollout: functions of as many slots compile once.
COUNT = 1000
LIMIT = np.array([80.0] * 5 + [12.0] * 2)


@pytest.fixture(scope="module")
def peer() -> RobosuitePeer:
    return RobosuitePeer()


class Cases(NamedTuple):
    """Random arms and actions with what robosuite makes of them."""

    arm: osc.ArmState
    before: osc.OscGoal
    action: np.ndarray
    after: osc.OscGoal
    torque: np.ndarray
    home: np.ndarray


def robosuite_cases(peer: RobosuitePeer, seed: int) -> Cases:
    """Joints anywhere in their ranges, moving, with a previous goal nearby; every fifth action does not rotate."""
    rng, controller = np.random.default_rng(seed), peer.controller
    low, high = peer.model.jnt_range[list(controller.joint_index)].T
    found = []
    for i in range(COUNT):
        peer.place_arm(rng.uniform(low, high), rng.normal(size=7) * 0.5)
        controller.goal_pos = controller.ee_pos + rng.uniform(-0.05, 0.05, 3)
        controller.goal_ori = rotation_about(rng.normal(size=3) * 0.3) @ controller.ee_ori_mat
        before = controller.goal_pos, controller.goal_ori
        action = rng.uniform(-1.3, 1.3, 6)
        action[3:] *= i % 5 > 0
        controller.set_goal(action)
        torque = np.clip(controller.run_controller(), -LIMIT, LIMIT)
        found.append((peer.row(), *before, action, controller.goal_pos, controller.goal_ori, torque))
    row, pos, mat, action, to, turn, torque = map(np.array, zip(*found, strict=True))
    home = np.array(controller.initial_joint)
    return Cases(arm_from_rows(row), goal_of(pos, mat), action, goal_of(to, turn), torque, home)


def rotation_about(rotvec: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(rotvec)
    x, y, z = rotvec / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.fixture(scope="module")
def cases(peer: RobosuitePeer) -> Cases:
    return robosuite_cases(peer, seed=0)


@pytest.fixture(scope="module")
def rollout(peer: RobosuitePeer) -> Rollout:
    return peer.rollout(COUNT // SUBSTEPS)


def single(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


def relative_error(torque: Any, expected: np.ndarray) -> np.ndarray:
    return np.abs(np.asarray(torque) - expected).max(-1) / np.abs(expected).max(-1)


# Parity -------------------------------------------------------------------------------------------------------------


def test_goals_equal_robosuites(cases: Cases) -> None:
    with jax.enable_x64(True):
        goal = osc.set_goal(cases.arm, cases.before, cases.action)
    np.testing.assert_allclose(goal.pos, cases.after.pos, rtol=0, atol=1e-15)
    np.testing.assert_allclose(goal.mat, cases.after.mat, rtol=0, atol=1e-15)


def test_small_rotations_are_rounded_as_robosuite_rounds_them(peer: RobosuitePeer) -> None:
    peer.place_arm(np.array(peer.robot.init_qpos), np.zeros(7))
    arm = arm_from_rows(peer.row())
    for size in (1e-30, 1e-12, 1e-8, 1e-4, 1e-2):
        action = np.array([0, 0, 0, size, -0.3 * size, 0.0])
        with jax.enable_x64(True):
            goal = osc.set_goal(arm, osc.hold_goal(arm), action)
        peer.controller.set_goal(action)
        np.testing.assert_allclose(goal.mat, peer.controller.goal_ori, rtol=0, atol=1e-15, err_msg=str(size))


def test_torques_equal_robosuites_in_1000_random_states(cases: Cases) -> None:
    with jax.enable_x64(True):
        torque = osc.torques(cases.arm, cases.after, cases.home)
    assert torque.dtype == np.float64
    assert relative_error(torque, cases.torque).max() < 1e-9


def test_float32_torques_equal_robosuites_in_1000_random_states(cases: Cases) -> None:
    arm, before = single(cases.arm), single(cases.before)
    goal = osc.set_goal(arm, before, single(cases.action))
    torque = osc.torques(arm, goal, single(cases.home))
    assert torque.dtype == np.float32
    assert np.abs(np.asarray(torque, np.float64) - cases.torque).max() < 1e-3


def test_the_random_states_include_nearly_singular_arms(cases: Cases) -> None:
    """The parity tests filter nothing: their hardest arms have task inertias of condition 1e6 and more."""
    jacobian, mass = np.asarray(cases.arm.jacobian), np.asarray(cases.arm.mass_matrix)
    assert np.linalg.cond(jacobian @ np.linalg.inv(mass) @ jacobian.transpose(0, 2, 1)).max() > 1e6


def test_goals_and_torques_equal_robosuites_along_a_rollout_from_a_loaded_state(rollout: Rollout) -> None:
    """Goals are carried from tick to tick. In the first substep robosuite's controller believes to be at home."""
    rows = rollout.rows.copy()
    rows[0, 0] = believed(rows[0, 0], rollout.home)
    with jax.enable_x64(True):
        goals = [osc.hold_goal(arm_from_rows(rollout.home))]
        for seen, action in zip(rows[:, 0], rollout.actions, strict=True):
            goals.append(osc.set_goal(arm_from_rows(seen), goals[-1], action[:6]))
        kept = jax.tree.map(lambda *x: np.repeat(np.stack(x), SUBSTEPS, axis=0), *goals[1:])
        torque = osc.torques(arm_from_rows(rows.reshape(COUNT, -1)), kept, rollout.home[:7])
    np.testing.assert_allclose(kept.pos[::SUBSTEPS], rollout.goals.pos, rtol=0, atol=1e-15)
    np.testing.assert_allclose(kept.mat[::SUBSTEPS], rollout.goals.mat, rtol=0, atol=1e-15)
    assert {True, False} == set((rollout.actions[1:, 3:6] == 0).all(axis=1).tolist())
    assert relative_error(torque, rollout.ctrl[..., :7].reshape(COUNT, 7)).max() < 1e-9


# Goals --------------------------------------------------------------------------------------------------------------


def test_the_orientation_goal_stays_when_all_rotation_components_are_zero(cases: Cases) -> None:
    arm, before = single((cases.arm, cases.before))
    action = np.zeros((COUNT, 6), np.float32)
    action[:, 0], action[1::2, 3] = 1.0, -0.0
    np.testing.assert_array_equal(osc.set_goal(arm, before, action).mat, before.mat)
    action[:, 5] = 1e-6
    nudged = osc.set_goal(arm, before, action)
    assert np.abs(nudged.mat - arm.eef_mat).max() < 1e-5
    assert np.abs(nudged.mat - before.mat).max() > 1e-3


def test_actions_are_clipped_to_one(cases: Cases) -> None:
    arm = single(cases.arm)
    wild, full = (
        osc.set_goal(arm, osc.hold_goal(arm), np.tile(np.array(action, np.float32), (COUNT, 1)))
        for action in ([5.0, -5.0, 1.0, 9.0, 0.0, -2.0], [1.0, -1.0, 1.0, 1.0, 0.0, -1.0])
    )
    np.testing.assert_array_equal(wild.pos, full.pos)
    np.testing.assert_array_equal(wild.mat, full.mat)
    np.testing.assert_allclose(full.pos - arm.eef_pos, np.full((COUNT, 3), 0.05) * [1, -1, 1], atol=1e-6)


# JAX ----------------------------------------------------------------------------------------------------------------


def first(count: int, cases: Cases) -> tuple[osc.ArmState, osc.OscGoal]:
    """That many arms and their goals."""
    return jax.tree.map(lambda x: x[:count], (cases.arm, cases.after))


def test_any_leading_axes_and_vmap_give_the_same_torques(cases: Cases) -> None:
    arm, goal = first(6, cases)
    with jax.enable_x64(True):
        wanted = np.asarray(osc.torques(cases.arm, cases.after, cases.home))[:6]
        mapped = compiled(jax.vmap(osc.torques, in_axes=(0, 0, None)))(arm, goal, cases.home)
        folded = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), (arm, goal))
        grid = compiled(osc.torques)(*folded, cases.home)
        one = compiled(osc.torques)(*jax.tree.map(lambda x: x[0], (arm, goal)), cases.home)
    for found, expected in ((mapped, wanted), (grid, wanted.reshape(2, 3, 7)), (one, wanted[0])):
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_a_broken_slot_does_not_touch_the_others(cases: Cases) -> None:
    damaged = jax.tree.map(np.array, cases.arm)
    for array in damaged:
        array[3] = np.nan
    with jax.enable_x64(True):
        clean, broken = (np.asarray(osc.torques(arm, cases.after, cases.home)) for arm in (cases.arm, damaged))
    assert np.isnan(broken[3]).all()
    np.testing.assert_array_equal(np.delete(broken, 3, axis=0), np.delete(clean, 3, axis=0))


def test_gradients_equal_finite_differences(cases: Cases) -> None:
    loose, step = osc.OscConfig(torque_limit=(1e6,) * 7), 1e-5
    arm, goal = first(4, cases)
    # Rotations stay 0: their rounding to float32 hides small differences.
    inputs = np.concatenate([cases.action[:4, :3] / 2, np.zeros((4, 3)), np.asarray(arm.qvel)], axis=1)
    directions = np.random.default_rng(0).normal(size=(10, 1, 13)) * ([1.0] * 3 + [0.0] * 3 + [1.0] * 7)

    @compiled
    @partial(jax.grad, has_aux=True)
    def slopes_and_values(inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of a number for each slot that depends on all of its torques."""
        still, aim = jax.tree.map(lambda x: x[None], (arm, goal))
        moving = still._replace(qvel=inputs[..., 6:])
        torque = osc.torques(moving, osc.set_goal(moving, aim, inputs[..., :6], loose), cases.home, loose)
        values = jnp.sum(torque**2, axis=-1)
        return jnp.sum(values), values

    with jax.enable_x64(True):
        slopes, values = slopes_and_values(
            inputs + step * np.concatenate([0 * directions[:1], directions, -directions])
        )
    ahead, behind = np.split(np.asarray(values)[1:], 2)
    np.testing.assert_allclose(
        np.sum(np.asarray(slopes)[0] * directions, axis=-1), (ahead - behind) / (2 * step), rtol=1e-6
    )


def test_gradients_are_finite_at_rest_at_zero_rotation_and_in_singular_arms(cases: Cases) -> None:
    (arm, goal), home = single(first(2, cases)), single(cases.home)

    @compiled
    @partial(jax.value_and_grad, argnums=(0, 1))
    def value_and_slopes(arm: osc.ArmState, action: jax.Array) -> jax.Array:
        return jnp.sum(osc.torques(arm, osc.set_goal(arm, goal, action), home) ** 2)

    still = arm._replace(qvel=jnp.zeros_like(arm.qvel))
    position, orientation = (arm.jacobian.at[:, i].set(0.5 * arm.jacobian[:, i + 1]) for i in (0, 3))
    singular = [arm._replace(jacobian=x) for x in (position, orientation, jnp.zeros_like(arm.jacobian))]
    for case in (still, *singular):
        value, slopes = value_and_slopes(case, jnp.zeros((2, 6)))
        assert np.isfinite(value)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(slopes))


@pytest.mark.usefixtures("unchecked_shapes")
def test_wrong_shapes_are_named() -> None:
    arm = osc.ArmState(*(jnp.zeros((2, *tail)) for tail in ((7,), (7,), (3,), (3, 3), (6, 7), (7, 7), (7,))))
    goal = osc.hold_goal(arm)
    with pytest.raises(ValueError, match=r"arm.jacobian must have shape \[\.\.\., 6, 7\], got \[2, 7, 6\]"):
        osc.torques(arm._replace(jacobian=jnp.zeros((2, 7, 6))), goal, jnp.zeros(7))
    with pytest.raises(ValueError, match=r"delta_action must have shape \[\.\.\., 6\], got \[2, 7\]"):
        osc.set_goal(arm, goal, jnp.zeros((2, 7)))
    with pytest.raises(ValueError, match=r"home_qpos must have shape \[\.\.\., 7\]"):
        osc.torques(arm, goal, jnp.zeros(6))


# The peer -----------------------------------------------------------------------------------------------------------


def test_a_row_holds_the_arm_robosuite_sees(peer: RobosuitePeer) -> None:
    rng, controller = np.random.default_rng(7), peer.controller
    peer.place_arm(np.array(peer.robot.init_qpos) + rng.normal(size=7) * 0.2, rng.normal(size=7))
    arm = arm_from_rows(peer.row())
    expected = (controller.joint_pos, controller.joint_vel, controller.ee_pos, controller.ee_ori_mat)
    for name, value in zip(("qpos", "qvel", "eef_pos", "eef_mat"), expected, strict=True):
        np.testing.assert_array_equal(getattr(arm, name), value)
    np.testing.assert_allclose(arm.jacobian, controller.J_full, atol=1e-14)
    np.testing.assert_array_equal(arm.mass_matrix, controller.mass_matrix)
    np.testing.assert_array_equal(arm.bias, controller.torque_compensation)
