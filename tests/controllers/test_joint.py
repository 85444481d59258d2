"""Joint-space control holds and moves the arm as robosuite's ``JOINT_POSITION`` does."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from vecenv.controllers import joint, kinematics
from vecenv.controllers.osc import ArmState
from vecenv.libero.robot import HOME_QPOS, panda_chain
from vecenv.libero.tasks.sources import installed_tasks

compiled = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def arm(qpos: np.ndarray, qvel: np.ndarray, mass: np.ndarray, bias: np.ndarray) -> ArmState:
    return ArmState(*map(jnp.asarray, (qpos, qvel, np.zeros(3), np.eye(3), np.zeros((6, 7)), mass, bias)))


def test_torques_are_a_spring_and_damper_through_the_mass_matrix() -> None:
    rng = np.random.default_rng(0)
    qpos, qvel, goal, bias = rng.normal(size=(4, 7)) * 0.1
    mass = np.diag(rng.uniform(1, 2, 7)) + 0.1
    expected = mass @ (50 * (goal - qpos) - 2 * np.sqrt(50) * qvel) + bias
    limit = joint.JOINT_POSITION.torque_limit
    found = joint.torques(arm(qpos, qvel, mass, bias), jnp.asarray(goal))
    np.testing.assert_allclose(found, np.clip(expected, -np.array(limit), limit), rtol=1e-5, atol=1e-5)


def test_torques_and_goals_stay_within_limits() -> None:
    still = arm(np.zeros(7), np.zeros(7), 100 * np.eye(7), np.zeros(7))
    np.testing.assert_allclose(joint.torques(still, jnp.ones(7)), joint.JOINT_POSITION.torque_limit)
    limits = jnp.asarray([[-1.0] * 7, [1.0] * 7])
    goal = joint.set_goal(jnp.asarray([0.0, 0.99, -2.0, 0, 0, 0, 0]), jnp.asarray([5.0, 1, -1, 0.5, 0, 0, 0]), limits)
    np.testing.assert_allclose(goal, [0.05, 1.0, -1.0, 0.025, 0, 0, 0], atol=1e-6)


@pytest.mark.usefixtures("unchecked_shapes")
def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="action"):
        joint.set_goal(jnp.zeros(7), jnp.zeros(8), jnp.zeros((2, 7)))


def test_the_arm_holds_still_and_goes_where_it_is_told() -> None:
    model = installed_tasks("libero_object")[0].scene(()).model
    chain = panda_chain(model)

    @compiled
    def control(qpos: jax.Array, qvel: jax.Array, goal: jax.Array) -> jax.Array:
        return joint.torques(kinematics.arm_state(chain, qpos, qvel), goal)

    data = mujoco.MjData(model)
    data.qpos[:] = installed_tasks("libero_object")[0].settled().qpos[0]
    data.qpos[:7] = HOME_QPOS
    for target in (HOME_QPOS, HOME_QPOS + [0.05, -0.05, 0.05, 0.05, -0.05, 0.05, -0.05]):
        for _ in range(500):
            mujoco.mj_forward(model, data)
            data.ctrl[:7] = control(data.qpos[:9].copy(), data.qvel[:9].copy(), target)
            mujoco.mj_step(model, data)
        # Dry friction of 0.1 N m keeps a joint from going all the way.
        np.testing.assert_allclose(data.qpos[:7], target, atol=5e-3)
