"""The batched OSC against robosuite's own controller, and what JAX is promised about it."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from robosuite_peer import RobosuitePeer

from vecenv.controllers import osc

# The options the library uses on the CPU: they compile several times faster.
compiled = partial(jax.jit, compiler_options={"xla_cpu_use_fusion_emitters": False})
LIMIT = np.array([80.0] * 5 + [12.0] * 2)


@pytest.fixture(scope="module")
def peer() -> RobosuitePeer:
    return RobosuitePeer()


class Cases(NamedTuple):
    """Random arms and actions with what robosuite makes of them."""

    packed: np.ndarray
    before: osc.OscGoal
    action: np.ndarray
    after: osc.OscGoal
    torque: np.ndarray
    home: np.ndarray


def robosuite_cases(peer: RobosuitePeer, count: int, seed: int) -> Cases:
    """Joints anywhere in their ranges, moving, with a previous goal nearby; every fifth action does not rotate."""
    rng = np.random.default_rng(seed)
    low, high = peer.model.jnt_range[list(peer.controller.joint_index)].T
    rows: dict[str, list[np.ndarray]] = {
        name: [] for name in ("packed", "pos", "mat", "action", "to", "turn", "torque")
    }
    for i in range(count):
        peer.place_arm(rng.uniform(low, high), rng.normal(size=7) * 0.5)
        controller = peer.controller
        controller.goal_pos = controller.ee_pos + rng.uniform(-0.05, 0.05, 3)
        controller.goal_ori = rotation_about(rng.normal(size=3) * 0.3) @ controller.ee_ori_mat
        rows["pos"].append(controller.goal_pos)
        rows["mat"].append(controller.goal_ori)
        action = rng.uniform(-1.3, 1.3, 6)
        action[3:] *= i % 5 > 0
        controller.set_goal(action)
        rows["packed"].append(peer.packed())
        rows["torque"].append(np.clip(controller.run_controller(), -LIMIT, LIMIT))
        rows["action"].append(action)
        rows["to"].append(controller.goal_pos)
        rows["turn"].append(controller.goal_ori)
    table = {name: np.array(values) for name, values in rows.items()}
    before, after = goal_of(table["pos"], table["mat"]), goal_of(table["to"], table["turn"])
    home = np.array(peer.controller.initial_joint)
    return Cases(table["packed"], before, table["action"], after, table["torque"], home)


def goal_of(pos: Any, mat: Any) -> osc.OscGoal:
    """A goal that keeps NumPy's float64 until it is used."""
    return osc.OscGoal(pos, mat)


def rotation_about(rotvec: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(rotvec)
    x, y, z = rotvec / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


@pytest.fixture(scope="module")
def cases(peer: RobosuitePeer) -> Cases:
    return robosuite_cases(peer, 1000, seed=0)


def single(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


def relative_error(torque: Any, expected: np.ndarray) -> np.ndarray:
    return np.abs(np.asarray(torque) - expected).max(-1) / np.abs(expected).max(-1)


# Parity -------------------------------------------------------------------------------------------------------------


def test_goals_equal_robosuites(cases: Cases) -> None:
    with jax.enable_x64(True):
        goal = osc.set_goal(osc.arm_from_packed(cases.packed), cases.before, cases.action)
    np.testing.assert_allclose(goal.pos, cases.after.pos, rtol=0, atol=1e-15)
    np.testing.assert_allclose(goal.mat, cases.after.mat, rtol=0, atol=1e-15)


def test_small_rotations_are_rounded_as_robosuite_rounds_them(peer: RobosuitePeer) -> None:
    peer.place_arm(np.array(peer.robot.init_qpos), np.zeros(7))
    for size in (1e-30, 1e-12, 1e-8, 1e-4, 1e-2):
        action = np.array([0, 0, 0, size, -0.3 * size, 0.0])
        with jax.enable_x64(True):
            arm = osc.arm_from_packed(peer.packed())
            goal = osc.set_goal(arm, osc.hold_goal(arm), action)
        peer.controller.set_goal(action)
        np.testing.assert_allclose(goal.mat, peer.controller.goal_ori, rtol=0, atol=1e-15, err_msg=str(size))


def test_torques_equal_robosuites_in_1000_random_states(cases: Cases) -> None:
    with jax.enable_x64(True):
        torque = osc.torques(osc.arm_from_packed(cases.packed), cases.after, cases.home)
    assert torque.dtype == np.float64
    assert relative_error(torque, cases.torque).max() < 1e-9


def test_float32_torques_equal_robosuites_in_1000_random_states(cases: Cases) -> None:
    with jax.enable_x64(True):
        exact = osc.arm_from_packed(cases.packed)
    arm, before = single(exact), single(cases.before)
    goal = osc.set_goal(arm, before, single(cases.action))
    torque = osc.torques(arm, goal, single(cases.home))
    assert torque.dtype == np.float32
    assert np.abs(np.asarray(torque, np.float64) - cases.torque).max() < 1e-3


def test_the_random_states_include_nearly_singular_arms(cases: Cases) -> None:
    """The parity tests filter nothing: their hardest arms have task inertias of condition 1e6 and more."""
    with jax.enable_x64(True):
        arm = jax.tree.map(np.asarray, osc.arm_from_packed(cases.packed))
    inverse = arm.jacobian @ np.linalg.inv(arm.mass_matrix) @ arm.jacobian.transpose(0, 2, 1)
    assert np.linalg.cond(inverse).max() > 1e6


def rollout_actions(count: int) -> np.ndarray:
    """Random actions, out of range at times, with ticks that do not rotate and ticks that do nothing."""
    actions = np.random.default_rng(3).uniform(-1.2, 1.2, (count, 7))
    actions[1::4, 3:6] = 0
    actions[2::7, 3:5] = 0
    actions[9::10] = 0
    return actions


class Recorder:
    """Keeps what robosuite's robot saw and commanded in every physics substep."""

    def __init__(self, peer: RobosuitePeer) -> None:
        self.substeps: list[tuple[bool, np.ndarray, np.ndarray]] = []
        original = peer.robot.control

        def control(action: np.ndarray, policy_step: bool = False) -> None:
            packed = peer.packed()
            original(action, policy_step=policy_step)
            self.substeps.append((policy_step, packed, peer.data.ctrl.copy()))

        peer.robot.control = control


def displaced_start(peer: RobosuitePeer) -> None:
    """Reset, then load a state that is not the home pose, as ``set_init_state`` does."""
    peer.env.reset()
    state = peer.env.sim.get_state().flatten()
    state[1:8] += [0.03, -0.02, 0.02, 0.01, -0.03, 0.02, 0.03]
    peer.env.sim.set_state_from_flattened(state)
    peer.env.sim.forward()


def test_controls_equal_robosuites_along_a_rollout_from_a_loaded_state(peer: RobosuitePeer) -> None:
    displaced_start(peer)
    controllers = osc.compile_substeps()
    state = controllers.start(peer.home_packed()[None])
    recorder = Recorder(peer)
    worst = 0.0
    for tick, action in enumerate(rollout_actions(45)):
        recorder.substeps.clear()
        peer.env.step(action)
        assert len(recorder.substeps) == 25
        for policy_step, packed, expected in recorder.substeps:
            if policy_step:
                ctrl, state = controllers.begin(state, packed[None], action[None], np.array([tick == 0]))
            else:
                ctrl, state = controllers.proceed(state, packed[None])
            worst = max(worst, float(relative_error(ctrl, expected[None]).max()))
    assert worst < 1e-9


def test_the_first_substep_of_an_episode_uses_the_arm_of_the_reset(peer: RobosuitePeer) -> None:
    """robosuite's controller is not told of a loaded state until it has run once; only the bias torques are live."""
    displaced_start(peer)
    assert not peer.controller.new_update
    recorder = Recorder(peer)
    action = np.array([0.2, 0, 0, 0, 0, 0.3, -1.0])
    peer.env.step(action)
    _, packed, expected = recorder.substeps[0]
    controllers = osc.compile_substeps()
    state = controllers.start(peer.home_packed()[None])
    stale, after = controllers.begin(state, packed[None], action[None], np.array([True]))
    live, _ = controllers.begin(state, packed[None], action[None], np.array([False]))
    assert relative_error(stale, expected[None]).max() < 1e-9
    assert relative_error(live, expected[None]).max() > 1e-2
    home = peer.home_packed()[osc.packed_slices()["eef_pos"]]
    np.testing.assert_allclose(after.goal.pos[0], home + [0.01, 0, 0], atol=1e-15)


# Goals --------------------------------------------------------------------------------------------------------------


def test_the_orientation_goal_stays_when_all_rotation_components_are_zero(cases: Cases) -> None:
    arm, before = single(osc.arm_from_packed(cases.packed[:2])), single(osc.OscGoal(*(x[:2] for x in cases.before)))
    still = osc.set_goal(arm, before, jnp.array([[1.0, 0, 0, 0, 0, 0], [1.0, 0, 0, -0.0, 0, 0]]))
    np.testing.assert_array_equal(still.mat, before.mat)
    nudged = osc.set_goal(arm, before, jnp.array([1.0, 0, 0, 0, 0, 1e-6]))
    assert np.abs(nudged.mat - arm.eef_mat).max() < 1e-5
    assert np.abs(nudged.mat - before.mat).max() > 1e-3


def test_actions_are_clipped_to_one(cases: Cases) -> None:
    arm = single(osc.arm_from_packed(cases.packed[:3]))
    wild = osc.set_goal(arm, osc.hold_goal(arm), jnp.array([5.0, -5.0, 1.0, 9.0, 0.0, -2.0]))
    full = osc.set_goal(arm, osc.hold_goal(arm), jnp.array([1.0, -1.0, 1.0, 1.0, 0.0, -1.0]))
    np.testing.assert_array_equal(wild.pos, full.pos)
    np.testing.assert_array_equal(wild.mat, full.mat)
    np.testing.assert_allclose(full.pos - arm.eef_pos, np.full((3, 3), 0.05) * [1, -1, 1], atol=1e-6)


# JAX ----------------------------------------------------------------------------------------------------------------


def arms(cases: Cases, count: int, dtype: type = np.float32) -> tuple[osc.ArmState, osc.OscGoal, jax.Array]:
    arm = osc.arm_from_packed(jnp.asarray(cases.packed[:count], dtype))
    goal = osc.OscGoal(*(jnp.asarray(x[:count], dtype) for x in cases.after))
    return arm, goal, jnp.asarray(cases.home, dtype)


def test_any_leading_axes_give_the_same_torques(cases: Cases) -> None:
    arm, goal, home = arms(cases, 6)
    flat = osc.torques(arm, goal, home)

    def fold(x: jax.Array) -> jax.Array:
        return x.reshape(2, 3, *x.shape[1:])

    np.testing.assert_allclose(
        osc.torques(jax.tree.map(fold, arm), jax.tree.map(fold, goal), home), fold(flat), rtol=1e-5
    )
    one = osc.torques(jax.tree.map(lambda x: x[0], arm), jax.tree.map(lambda x: x[0], goal), home)
    assert one.shape == (7,)
    np.testing.assert_allclose(one, flat[0], rtol=1e-5)


def test_jit_and_vmap_agree_with_the_batch(cases: Cases) -> None:
    with jax.enable_x64(True):
        arm, goal, home = arms(cases, 16, np.float64)
        batched = osc.torques(arm, goal, home)
        mapped = compiled(jax.vmap(osc.torques, in_axes=(0, 0, None)))(arm, goal, home)
    np.testing.assert_allclose(mapped, batched, rtol=1e-9, atol=1e-9)


def test_gradients_equal_finite_differences(cases: Cases) -> None:
    loose = osc.OscConfig(torque_limit=(1e6,) * 7)
    with jax.enable_x64(True):
        arm, goal, home = arms(cases, 4, np.float64)

        def objective(action: jax.Array, qvel: jax.Array) -> jax.Array:
            moving = arm._replace(qvel=qvel)
            return jnp.sum(osc.torques(moving, osc.set_goal(moving, goal, action, loose), home, loose) ** 2)

        action = jnp.asarray(np.random.default_rng(0).uniform(-0.5, 0.5, (4, 6)))
        action = action.at[:, 3:].set(0.0)  # float32 rounding of rotations hides small differences
        value, slopes = compiled(objective), compiled(jax.grad(objective, argnums=(0, 1)))(action, arm.qvel)
        for index, (argument, slope) in enumerate(zip((action, arm.qvel), slopes, strict=True)):
            arguments = [action, arm.qvel]
            direction = jnp.zeros_like(argument).at[:, :3].set(1.0)
            ends = []
            for step in (1e-5, -1e-5):
                arguments[index] = argument + step * direction
                ends.append(value(*arguments))
            np.testing.assert_allclose(jnp.sum(slope * direction), (ends[0] - ends[1]) / 2e-5, rtol=1e-6)


def test_gradients_are_finite_at_rest_at_zero_rotation_and_in_singular_arms(cases: Cases) -> None:
    arm, goal, home = arms(cases, 2)

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


def test_wrong_shapes_are_named() -> None:
    arm = osc.arm_from_packed(jnp.zeros((2, osc.PACKED_SIZE)))
    goal = osc.hold_goal(arm)
    with pytest.raises(ValueError, match=r"arm.jacobian must have shape \[\.\.\., 6, 7\], got \[2, 7, 6\]"):
        osc.torques(arm._replace(jacobian=jnp.zeros((2, 7, 6))), goal, jnp.zeros(7))
    with pytest.raises(ValueError, match=r"delta_action must have shape \[\.\.\., 6\], got \[2, 7\]"):
        osc.set_goal(arm, goal, jnp.zeros((2, 7)))
    with pytest.raises(ValueError, match=r"home_qpos must have shape \[\.\.\., 7\]"):
        osc.torques(arm, goal, jnp.zeros(6))
    with pytest.raises(ValueError, match=r"packed must have shape \[\.\.\., 103\]"):
        osc.arm_from_packed(jnp.zeros(100))


# The packed entry ---------------------------------------------------------------------------------------------------


def test_a_packed_row_holds_the_arm_robosuite_sees(peer: RobosuitePeer, cases: Cases) -> None:
    rng = np.random.default_rng(7)
    peer.place_arm(np.array(peer.robot.init_qpos) + rng.normal(size=7) * 0.2, rng.normal(size=7))
    with jax.enable_x64(True):
        arm = osc.arm_from_packed(peer.packed())
    controller = peer.controller
    expected = (controller.joint_pos, controller.joint_vel, controller.ee_pos, controller.ee_ori_mat)
    for name, value in zip(("qpos", "qvel", "eef_pos", "eef_mat"), expected, strict=True):
        np.testing.assert_array_equal(getattr(arm, name), value)
    np.testing.assert_allclose(arm.jacobian, controller.J_full, atol=1e-14)
    np.testing.assert_array_equal(arm.mass_matrix, controller.mass_matrix)
    np.testing.assert_array_equal(arm.bias, controller.torque_compensation)


def commands(cases: Cases, rows: np.ndarray) -> np.ndarray:
    """Controls of the first two substeps of a tick for these slots."""
    controllers = osc.compile_substeps()
    state = controllers.start(cases.packed[rows])
    action = np.concatenate([cases.action, np.ones((len(cases.action), 1))], axis=1)[rows]
    first, state = controllers.begin(state, cases.packed[rows], action, np.zeros(len(rows), bool))
    second, _ = controllers.proceed(state, cases.packed[rows])
    return np.concatenate([first, second], axis=1)


def test_a_slot_gets_the_same_bits_in_any_batch(cases: Cases) -> None:
    whole = commands(cases, np.arange(64))
    for size in (1, 5, 16):
        rows = np.arange(40, 40 + size)
        np.testing.assert_array_equal(commands(cases, rows), whole[rows])


def test_a_broken_slot_does_not_touch_the_others(cases: Cases) -> None:
    rows = np.arange(8)
    clean = commands(cases, rows)
    packed = cases.packed.copy()
    packed[3] = np.nan
    broken = commands(cases._replace(packed=packed), rows)
    healthy = rows != 3
    np.testing.assert_array_equal(broken[healthy], clean[healthy])
    assert np.isnan(broken[3, :7]).all()


def test_compiled_controllers_work_in_float64_without_switching_jax(cases: Cases) -> None:
    assert jnp.zeros(1).dtype == np.float32
    assert commands(cases, np.arange(2)).dtype == np.float64
    assert jnp.zeros(1).dtype == np.float32


def test_rearming_puts_chosen_slots_back_to_their_home(cases: Cases) -> None:
    controllers = osc.compile_substeps()
    start = controllers.start(cases.packed[:2])
    action = np.ones((2, 7))
    _, used = controllers.begin(start, cases.packed[2:4], action, np.zeros(2, bool))
    mixed = controllers.rearm(used, np.array([True, False]))
    for slot, origin in ((0, start), (1, used)):
        for got, expected in zip(jax.tree.leaves(mixed), jax.tree.leaves(origin), strict=True):
            np.testing.assert_array_equal(got[slot], expected[slot])


def test_a_batch_of_another_size_is_refused(cases: Cases) -> None:
    controllers = osc.compile_substeps()
    state = controllers.start(cases.packed[:2])
    with pytest.raises(ValueError, match=r"packed must have shape \[2, 103\], got \[3, 103\]"):
        controllers.proceed(state, cases.packed[:3])
    with pytest.raises(ValueError, match=r"action must have shape \[2, 7\], got \[2, 6\]"):
        controllers.begin(state, cases.packed[:2], np.zeros((2, 6)), np.zeros(2, bool))
