"""The integrated gripper command against robosuite's PandaGripper, and on a real object."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.robosuite_peer import OurArm, RobosuitePeer

from vecenv.controllers import gripper
from vecenv.controllers.waypoint import Pose, converged, gripper_action, hold_action, servo


def test_the_state_and_command_equal_robosuites_over_random_actions() -> None:
    robot = RobosuitePeer().robot
    actuators = robot._ref_joint_gripper_actuator_indexes
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        state = jnp.zeros(2)
        for action in np.repeat(rng.choice([-1.0, -0.3, 0.0, 1e-9, 1.0], 12), 40):
            robot.grip_action(gripper=robot.gripper, gripper_action=np.array([action]))
            state = gripper.integrate(state, jnp.asarray(action))
            np.testing.assert_allclose(state, robot.gripper.current_action, rtol=0, atol=1e-14)
            np.testing.assert_allclose(gripper.command(state), robot.sim.data.ctrl[actuators], rtol=0, atol=1e-16)


def test_plus_one_closes_and_minus_one_opens_until_the_end_of_the_range() -> None:
    closed = opened = jnp.zeros(2)
    for _ in range(150):
        closed, opened = gripper.integrate(closed, jnp.array(1.0)), gripper.integrate(opened, jnp.array(-1.0))
    np.testing.assert_allclose(gripper.command(closed), [0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(gripper.command(opened), [0.04, -0.04], atol=1e-9)


def test_a_command_takes_a_hundred_substeps_from_the_middle() -> None:
    state = jnp.zeros(2)
    for _ in range(99):
        state = gripper.integrate(state, jnp.array(1.0))
    assert np.abs(state).max() < 0.995
    np.testing.assert_allclose(gripper.integrate(state, jnp.array(1.0)), [-1.0, 1.0], atol=1e-5)


def test_slots_are_independent_for_any_leading_axes() -> None:
    state = jnp.asarray(np.random.default_rng(0).uniform(-0.9, 0.9, (3, 2, 2)), jnp.float32)
    action = jnp.asarray([[1.0, -1.0], [0.0, 1.0], [-1.0, 0.0]])
    moved = jax.jit(gripper.integrate)(state, action)
    expected = np.asarray(state) + 0.01 * np.asarray(action)[..., None] * [-1, 1]
    np.testing.assert_allclose(moved, expected, atol=1e-6)
    assert moved.dtype == np.float32
    np.testing.assert_array_equal(jax.vmap(jax.vmap(gripper.integrate))(state, action), moved)


@pytest.mark.usefixtures("unchecked_shapes")
def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"gripper state must have shape \[\.\.\., 2\], got \[3\]"):
        gripper.integrate(jnp.zeros(3), jnp.zeros(()))


def test_closing_on_a_cube_lifts_it() -> None:
    """Our controllers drive robosuite's physics: over the cube, down, close, up."""
    with jax.enable_x64(True):
        arm = OurArm(RobosuitePeer(seed=1))
        sim = arm.peer.env.sim
        cube = sim.model.body_name2id(arm.peer.env.cube.root_body)
        start = np.array(sim.data.body_xpos[cube])
        down = arm.pose().quat
        step = jax.jit(servo)

        def go(pos: np.ndarray, grip: float) -> bool:
            target, reference = Pose(jnp.asarray(pos), down), arm.pose()
            for _ in range(100):
                action, reference = step(arm.pose(), target, jnp.asarray(grip), reference)
                arm.tick(np.asarray(action))
                if converged(arm.pose(), target):
                    return True
            return False

        assert go(start + [0, 0, 0.10], 0.0)
        assert go(start, 0.0)
        for _ in range(10):
            arm.tick(np.asarray(hold_action(jnp.asarray(1.0))))
        assert go(start + [0, 0, 0.15], 1.0)
    assert sim.data.body_xpos[cube][2] - start[2] > 0.10
    assert float(gripper_action(jnp.asarray(1.0))) == 1.0
