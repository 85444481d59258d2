"""The native backend's controllers against robosuite's and the JAX ones, and what they remember."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch
from numba import types
from support.robosuite_peer import RobosuitePeer, Rollout, arm_from_rows, believed, views_of

from vecenv.controllers import gripper, osc
from vecenv.controllers.gripper import GripperConfig
from vecenv.controllers.osc import OscConfig
from vecenv.controllers.osc_numba import ArmViews, Controllers
from vecenv.libero.physics.mjx.options import compiler_options
from vecenv.libero.physics.native import arm_views, home_row
from vecenv.libero.scene.scene import Scene, compile_scene
from vecenv.libero.tasks.suites import task
from vecenv.util.compiled import compile_function

COUNT = 1000
EVERYONE = np.ones(COUNT, bool)
# Parity does not need LLVM's optimisation, and things compile several times faster without.
OPTIONS: dict[str, Any] = {**compiler_options(), "xla_backend_optimization_level": 0}
jax_set_goal, jax_torques = (
    partial(jax.jit, static_argnames="config", compiler_options=OPTIONS)(f) for f in (osc.set_goal, osc.torques)
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return compile_scene(task("libero_object", 0).problem())


@pytest.fixture(scope="module")
def home(scene: Scene) -> np.ndarray:
    return home_row(scene)[0]


@pytest.fixture(scope="module")
def arms(scene: Scene) -> np.ndarray:
    """Moving arms with joints anywhere in their ranges, as rows; some of them hardly able to move along a direction."""
    rng = np.random.default_rng(0)
    batch = Batch(scene.model, COUNT, 2)
    views = arm_views(scene, batch)
    joints = [scene.model.joint(index).id for index in range(7)]
    low, high = scene.model.jnt_range[joints].T
    views.qpos[:] = rng.uniform(low, high, (COUNT, 7))
    views.qpos[::10, 5] = low[5] + rng.uniform(0, 1e-3, COUNT // 10)  # wrist stretched
    views.qpos[5::10, 3] = high[3] - rng.uniform(0, 1e-3, COUNT // 10)  # elbow stretched
    views.qvel[:] = rng.normal(size=(COUNT, 7)) * 0.5
    batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL.value)
    return views.rows()


def actions(count: int = COUNT, seed: int = 1) -> np.ndarray:
    """Random actions, at times out of range; every fifth does not rotate."""
    chosen = np.random.default_rng(seed).uniform(-1.3, 1.3, (count, 7))
    chosen[::5, 3:6] = 0
    chosen[:, 6] = np.sign(chosen[:, 6]) * (np.arange(count) % 3 > 0)
    return chosen


def controllers(
    arms: np.ndarray, home: np.ndarray, *, fresh: bool = False, **configs: Any
) -> tuple[Controllers, ArmViews]:
    """Controllers over a copy of these arms, with the arrays they read and write; their goals are at home."""
    # Rows of a simulator are wider than what is read of them.
    wide = np.concatenate([arms, np.zeros((len(arms), 20))], axis=1)
    views = views_of(wide, wide[:, -9:])
    made = Controllers(views, home, **configs)
    made.rearm(np.arange(len(arms)), fresh=fresh)
    return made, views


class Expected(NamedTuple):
    """What the JAX controllers make of a tick."""

    goal: osc.OscGoal
    ctrl: np.ndarray
    fingers: np.ndarray


@contextmanager
def double() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def expected(
    arm: np.ndarray, goal: osc.OscGoal, action: np.ndarray, home: np.ndarray, fingers: np.ndarray, **configs: Any
) -> Expected:
    """One substep: new goals, torques and finger targets."""
    config, hand = configs.get("config", osc.OSC_POSE), configs.get("gripper", gripper.PANDA_GRIPPER)
    with double():
        state = arm_from_rows(arm)
        goal = jax_set_goal(state, goal, action[:, :6], config=config)
        torque = jax_torques(state, goal, home[:7], config=config)
        targets = gripper.integrate(jnp.asarray(fingers), jnp.asarray(action[:, 6]), hand)
        ctrl = jnp.concatenate([torque, gripper.command(targets, hand)], axis=1)
        return Expected(goal, np.asarray(ctrl), np.asarray(targets))


def goals_of(made: Controllers) -> osc.OscGoal:
    with double():
        pos, mat = jnp.array(made.memory["goal_pos"]), jnp.array(made.memory["goal_mat"]).reshape(-1, 3, 3)
        return osc.OscGoal(pos, mat)


def relative_error(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.abs(found - wanted).max(-1) / np.abs(wanted).max(-1)


# Parity with JAX ----------------------------------------------------------------------------------------------------


def test_the_arms_include_nearly_singular_ones(arms: np.ndarray) -> None:
    jacobian, mass = map(np.asarray, arm_from_rows(arms)[4:6])
    assert np.linalg.cond(jacobian @ np.linalg.inv(mass) @ jacobian.transpose(0, 2, 1)).max() > 1e8


def test_goals_and_controls_equal_those_of_the_jax_controllers(arms: np.ndarray, home: np.ndarray) -> None:
    made, fields = controllers(arms, home)
    chosen, fingers = actions(), np.zeros((COUNT, 2))
    for tick in range(2):  # the second tick's goals may keep the first's
        wanted = expected(arms, goals_of(made), chosen, home, fingers)
        made.take_actions(chosen, EVERYONE)
        made.command(EVERYONE)
        assert relative_error(fields.ctrl, wanted.ctrl).max() < 1e-9
        np.testing.assert_allclose(made.memory["goal_pos"], wanted.goal.pos, rtol=0, atol=1e-15)
        np.testing.assert_allclose(made.memory["goal_mat"].reshape(-1, 3, 3), wanted.goal.mat, rtol=0, atol=1e-15)
        np.testing.assert_allclose(made.memory["fingers"], wanted.fingers, rtol=0, atol=1e-15)
        chosen, fingers = actions(seed=tick + 2), wanted.fingers


def test_small_rotations_are_rounded_alike(arms: np.ndarray, home: np.ndarray) -> None:
    made, _ = controllers(arms, home)
    chosen, sizes = np.zeros((COUNT, 7)), np.geomspace(1e-200, 1e-2, COUNT)
    chosen[:, 3], chosen[:, 4] = sizes, -0.3 * sizes
    wanted = expected(arms, goals_of(made), chosen, home, np.zeros((COUNT, 2)))
    made.take_actions(chosen, EVERYONE)
    np.testing.assert_allclose(made.memory["goal_mat"].reshape(-1, 3, 3), wanted.goal.mat, rtol=0, atol=1e-15)


def test_gains_and_limits_are_the_configurations(arms: np.ndarray, home: np.ndarray) -> None:
    gains = {"kp": 90.0, "damping_ratio": 0.7, "nullspace_kp": 4.0, "max_delta_pos": 0.02, "max_delta_ori": 0.3}
    configs = {
        "config": OscConfig(torque_limit=(30.0,) * 7, **gains),
        "gripper": GripperConfig(speed=0.03, ctrl_low=(0.01, -0.05), ctrl_high=(0.05, -0.01)),
    }
    made, fields = controllers(arms, home, **configs)
    wanted = expected(arms, goals_of(made), actions(), home, np.zeros((COUNT, 2)), **configs)
    made.take_actions(actions(), EVERYONE)
    made.command(EVERYONE)
    assert relative_error(fields.ctrl, wanted.ctrl).max() < 1e-9


def test_views_of_a_batch_follow_its_simulations(scene: Scene, home: np.ndarray) -> None:
    batch = Batch(scene.model, 3, 1, persistent=True)
    views = arm_views(scene, batch)
    batch.bind("qpos")[:, scene.arm_qpos] = home[:7]
    batch.bind("qpos")[1, 0] += 0.3
    batch.forward()
    rows = views.rows()
    np.testing.assert_array_equal(rows[0], rows[2])
    np.testing.assert_array_equal(rows[0, :96], home[:96])
    assert abs(rows[1, 15] - home[15]) > 0.1
    views.ctrl[:] = np.arange(9)
    np.testing.assert_array_equal(batch.bind("ctrl"), np.tile(np.arange(9.0), (3, 1)))


# Parity with robosuite ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rollout() -> Rollout:
    return RobosuitePeer().rollout(40)


def test_ticks_equal_robosuites_along_a_rollout_from_a_loaded_state(rollout: Rollout) -> None:
    """Goals, torques and finger targets of 1,000 substeps, from the first, when robosuite believes the arm at home."""
    rows, one = rollout.rows[0, :1].copy(), np.ones(1, bool)
    views = views_of(rows, np.zeros((1, 9)))
    made, found = Controllers(views, rollout.home), []
    for tick, action in enumerate(rollout.actions):
        for substep, row in enumerate(rollout.rows[tick]):
            rows[0] = row
            if substep == 0:
                made.take_actions(action[None], one)
                np.testing.assert_allclose(made.memory["goal_pos"][0], rollout.goals.pos[tick], rtol=0, atol=1e-15)
                np.testing.assert_allclose(
                    made.memory["goal_mat"].reshape(3, 3), rollout.goals.mat[tick], rtol=0, atol=1e-15
                )
            made.command(one)
            found.append(views.ctrl[0].copy())
    ctrl = rollout.ctrl.reshape(-1, 9)
    assert relative_error(np.array(found), ctrl).max() < 1e-9
    np.testing.assert_allclose(np.array(found)[:, 7:], ctrl[:, 7:], rtol=0, atol=1e-15)
    assert np.abs(np.diff(ctrl[:, 7])).max() > 0


def test_only_the_arm_of_the_reset_explains_robosuites_first_substep(rollout: Rollout) -> None:
    """Its controller is not told of a loaded state until it has run once; the bias torques alone are live."""
    errors = []
    for fresh in (True, False):
        made, views = controllers(rollout.rows[0, :1], rollout.home, fresh=fresh)
        made.take_actions(rollout.actions[:1], np.ones(1, bool))
        made.command(np.ones(1, bool))
        errors.append(relative_error(views.ctrl, rollout.ctrl[0, :1]).max())
    assert errors[0] < 1e-9
    assert errors[1] > 1e-2


# Memory -------------------------------------------------------------------------------------------------------------


def test_the_first_substep_of_a_fresh_slot_uses_the_arm_of_the_reset(arms: np.ndarray, home: np.ndarray) -> None:
    """Goal and torques come from home, only the bias torques from the simulator; the next substep sees the arm."""
    made, fields = controllers(arms, home, fresh=True)
    first = expected(believed(arms, home), goals_of(made), actions(), home, np.zeros((COUNT, 2)))
    made.take_actions(actions(), EVERYONE)
    made.command(EVERYONE)
    assert relative_error(fields.ctrl, first.ctrl).max() < 1e-9
    np.testing.assert_allclose(made.memory["goal_pos"], first.goal.pos, rtol=0, atol=1e-15)
    assert not made.memory["fresh"].any()
    made.command(EVERYONE)
    with double():
        torque = jax_torques(arm_from_rows(arms), first.goal, home[:7], config=osc.OSC_POSE)
    assert relative_error(fields.ctrl[:, :7], np.asarray(torque)).max() < 1e-9


def test_rearming_puts_chosen_slots_back_to_home_and_leaves_the_others(arms: np.ndarray, home: np.ndarray) -> None:
    made, _ = controllers(arms[:4], home)
    new = made.memory.copy()
    made.take_actions(np.ones((4, 7)), np.ones(4, bool))
    made.command(np.ones(4, bool))
    used = made.memory.copy()
    made.rearm(np.array([0, 2]))
    assert made.memory["fresh"].tolist() == [True, False, True, False]
    for name in ("goal_pos", "goal_mat", "fingers", "grip"):
        np.testing.assert_array_equal(made.memory[name][[0, 2]], new[name][[0, 2]])
        np.testing.assert_array_equal(made.memory[name][[1, 3]], used[name][[1, 3]])
        assert (used[name] != new[name]).any()


def test_the_goal_at_home_is_the_pose_there(home: np.ndarray, arms: np.ndarray) -> None:
    made, _ = controllers(arms[:1], home)
    np.testing.assert_array_equal(made.memory["goal_pos"][0], home[14:17])
    np.testing.assert_array_equal(made.memory["goal_mat"][0], home[17:26])


def test_slots_that_do_not_move_keep_memory_and_controls(arms: np.ndarray, home: np.ndarray) -> None:
    made, fields = controllers(arms[:6], home, fresh=True)
    moving = np.array([True, False, True, True, False, False])
    fields.ctrl[:] = 7.0
    before = made.memory.copy()
    made.take_actions(actions(6), moving)
    made.command(moving)
    np.testing.assert_array_equal(made.memory[~moving], before[~moving])
    np.testing.assert_array_equal(fields.ctrl[~moving], 7.0)
    assert (fields.ctrl[moving] != 7.0).all()
    assert made.memory["fresh"].tolist() == (~moving).tolist()


def test_the_orientation_goal_stays_when_all_rotation_components_are_zero(arms: np.ndarray, home: np.ndarray) -> None:
    made, _ = controllers(arms[:3], home)
    chosen = np.array([[1, 0, 0, 0, 0, 0, 0], [1, 0, 0, -0.0, 0, 0, 0], [1, 0, 0, 0, 0, 1e-6, 0]], float)
    made.take_actions(chosen, np.ones(3, bool))
    np.testing.assert_array_equal(made.memory["goal_mat"][:2], np.tile(home[17:26], (2, 1)))
    assert np.abs(made.memory["goal_mat"][2] - arms[2, 17:26]).max() < 1e-5


def test_fingers_integrate_the_sign_of_the_action_until_they_end(arms: np.ndarray, home: np.ndarray) -> None:
    made, fields = controllers(arms[:3], home)
    chosen, everyone = np.zeros((3, 7)), np.ones(3, bool)
    chosen[:, 6] = [0.2, -1.0, 0.0]
    made.take_actions(chosen, everyone)
    for _ in range(150):
        made.command(everyone)
    np.testing.assert_allclose(made.memory["fingers"], [[-1, 1], [1, -1], [0, 0]])
    np.testing.assert_allclose(fields.ctrl[:, 7:], [[0, 0], [0.04, -0.04], [0.02, -0.02]], atol=1e-15)


# Batches ------------------------------------------------------------------------------------------------------------


def two_ticks(arms: np.ndarray, chosen: np.ndarray, home: np.ndarray) -> np.ndarray:
    """Controls of the first two substeps of two ticks."""
    made, fields = controllers(arms, home, fresh=True)
    everyone, found = np.ones(len(arms), bool), []
    for _ in range(2):
        made.take_actions(chosen, everyone)
        for _ in range(2):
            made.command(everyone)
            found.append(fields.ctrl.copy())
    return np.concatenate(found, axis=1)


def test_a_slot_gets_the_same_bits_in_any_batch_and_at_any_place(arms: np.ndarray, home: np.ndarray) -> None:
    chosen, rng = actions(), np.random.default_rng(4)
    whole = two_ticks(arms, chosen, home)
    for size in (1, 2, 3, 5, 8, 16, 61):
        rows = rng.permutation(COUNT)[:size]
        np.testing.assert_array_equal(two_ticks(arms[rows], chosen[rows], home), whole[rows])


def test_a_broken_slot_does_not_touch_the_others(arms: np.ndarray, home: np.ndarray) -> None:
    clean, damaged = two_ticks(arms[:8], actions(8), home), arms[:8].copy()
    damaged[3] = np.nan
    broken = two_ticks(damaged, actions(8), home)
    healthy = np.arange(8) != 3
    np.testing.assert_array_equal(broken[healthy], clean[healthy])
    assert np.isnan(broken[3, 9:16]).all()


def test_arrays_that_do_not_fit_are_named(arms: np.ndarray, home: np.ndarray) -> None:
    made, fields = controllers(arms[:2], home)
    with pytest.raises(ValueError, match=r"actions must be float64 \[2, 7\], got float64 \[2, 6\]"):
        made.take_actions(np.zeros((2, 6)), np.ones(2, bool))
    with pytest.raises(ValueError, match=r"actions must be float64 \[2, 7\], got float32 \[2, 7\]"):
        made.take_actions(np.zeros((2, 7), np.float32), np.ones(2, bool))
    with pytest.raises(ValueError, match=r"active must be bool \[2\], got bool \[3\]"):
        made.command(np.ones(3, bool))
    views = fields._replace(bias=np.zeros((2, 6)))
    with pytest.raises(ValueError, match=r"bias must be float64 \[2, 7\], got float64 \[2, 6\]"):
        Controllers(views, home)
    with pytest.raises(ValueError, match=r"home must be float64 \[103\], got float64 \[7\]"):
        Controllers(fields, home[:7])


def test_code_that_no_cache_can_hold_is_compiled_all_the_same() -> None:
    """numba refuses to cache where it finds no folder to write to, or no file at all, as here."""
    space: dict[str, Any] = {}
    exec("def twice(x):\n    return 2 * x", space)
    assert compile_function(types.float64(types.float64), space["twice"])(21.0) == 42.0
