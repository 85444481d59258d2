"""Under plain ``jax.jit`` on a CPU, pure JAX compiles tree level by tree level, and computes what it did."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from vecenv.libero import functional
from vecenv.libero.functional import FunctionalLibero, FunctionalState
from vecenv.libero.physics import private
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.mjx import fusion, options
from vecenv.libero.physics.mjx.options import MjxError, compiler_options

# LLVM's optimisation off: programs compile several times faster. What XLA fuses does not depend on it.
quickly = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
BUDGET = Budget(contacts=80, rows=1, pairs=30, candidates=1)


@cache
def made() -> FunctionalLibero:
    chosen = {"impl": "jax", "geometry": "lean", "budget": BUDGET}
    return FunctionalLibero("libero_object", task=0, config_overrides=chosen)


@cache
def blank() -> mjx.Data:
    return mjx.make_data(made().mj_model, impl="jax")


def positions(qpos: jax.Array) -> jax.Array:
    """Body positions [nbody, 3], level by level."""
    with fusion.level_by_level():
        return mjx.kinematics(made().mjx_model, blank().replace(qpos=qpos)).xpos


def start() -> np.ndarray:
    """Joint positions with every hinge of the arm turned, [nq]."""
    qpos = np.array(made().mj_model.qpos0)
    qpos[:7] = [0.1, 0.3, -0.2, -2.0, 0.2, 2.2, 0.8]
    return qpos


def upstream(qpos: np.ndarray) -> np.ndarray:
    """Body positions [nbody, 3] as native MuJoCo computes them."""
    data = mujoco.MjData(made().mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(made().mj_model, data)
    return np.array(data.xpos)


def barriers(function: Any, *args: Any) -> int:
    return jax.jit(function).lower(*args).as_text().count("optimization_barrier")


def test_there_is_a_barrier_after_each_level_of_the_arm() -> None:
    assert barriers(positions, jnp.asarray(start())) >= 7


def test_other_users_of_mjx_and_other_devices_get_no_barriers(monkeypatch: pytest.MonkeyPatch) -> None:
    def alone(qpos: jax.Array) -> jax.Array:
        return mjx.kinematics(made().mjx_model, blank().replace(qpos=qpos)).xpos

    def allowed(qpos: jax.Array) -> jax.Array:
        with options.without_barriers():
            return positions(qpos)

    def elsewhere(qpos: jax.Array) -> jax.Array:
        return positions(qpos)

    qpos = jnp.asarray(start())
    positions_count = barriers(positions, qpos)
    assert positions_count > 0
    assert barriers(alone, qpos) == 0
    assert barriers(allowed, qpos) == 0
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert barriers(elsewhere, qpos) == 0


@pytest.mark.skipif(not compiler_options(), reason="this jaxlib needs no options")
def test_functional_jit_needs_no_barriers() -> None:
    lowered: Any = functional.jit(positions)
    assert "optimization_barrier" not in lowered.lower(jnp.asarray(start())).as_text()


def test_kinematics_are_those_of_mujoco() -> None:
    qpos = np.stack([start(), np.array(made().mj_model.qpos0)])
    found = quickly(jax.vmap(positions))(jnp.asarray(qpos, jnp.float32))
    np.testing.assert_allclose(found, np.stack([upstream(row) for row in qpos]), atol=1e-5)


def test_reverse_derivatives_are_those_of_finite_differences() -> None:
    hand = made().scene.hand_body
    slopes = quickly(jax.grad(lambda qpos: positions(qpos)[hand].sum()))(jnp.asarray(start(), jnp.float32))
    for joint in range(7):
        step = np.zeros_like(start())
        step[joint] = 1e-5
        high, low = (upstream(start() + sign * step)[hand].sum() for sign in (1, -1))
        assert float(slopes[joint]) == pytest.approx((high - low) / 2e-5, abs=1e-4)


def test_an_mjx_that_works_in_another_way_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(private.jax_scan, "_nvmap")
    fusion._install.cache_clear()
    with pytest.raises(MjxError, match="mujoco-mjx"), fusion.level_by_level():
        pass
    fusion._install.cache_clear()


@pytest.mark.heavy
def test_a_plain_jit_gives_the_values_of_functional_jit() -> None:
    env = made()

    def rollout(keys: jax.Array, actions: jax.Array) -> tuple[FunctionalState, jax.Array]:
        def tick(state: FunctionalState, action: jax.Array) -> tuple[FunctionalState, jax.Array]:
            state = jax.vmap(env.step)(state, action)
            return state, state.obs

        return jax.lax.scan(tick, jax.vmap(env.reset)(keys), actions)

    keys = jax.random.split(jax.random.key(0), 2)
    actions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (2, 2, 7)), jnp.float32)
    final, seen = jax.jit(rollout)(keys, actions)
    reset, step = functional.jit(jax.vmap(env.reset)), functional.jit(jax.vmap(env.step))
    state = reset(keys)
    for action, obs in zip(actions, seen, strict=True):
        state = step(state, action)
        np.testing.assert_allclose(obs, state.obs, atol=2e-4)
    np.testing.assert_allclose(final.data.qpos, state.data.qpos, atol=1e-4)
    assert not np.asarray(final.metrics["fault"]).any()
