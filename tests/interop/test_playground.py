"""LIBERO tasks in MuJoCo Playground: its registry finds them, its wrappers reset them, Brax trains on them."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vecenv.libero import functional
from vecenv.libero.functional import FunctionalError
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.mjx.options import compiler_options

pytest.importorskip("mujoco_playground")

from mujoco_playground import MjxEnv, registry, wrapper

from vecenv.interop import playground

NAME = "Libero/libero_object/0"
WORLDS = 3
# What vecenv.libero.physics.budgets measures for this scene.
BUDGET = Budget(contacts=90, rows=285, pairs=71, candidates=237)
OPTIONS: dict[str, Any] = {**compiler_options(), "xla_backend_optimization_level": 0}
compiled = functools.partial(jax.jit, compiler_options=OPTIONS)


@pytest.fixture(scope="module")
def env() -> playground.PlaygroundEnv:
    overrides = {"impl": "warp", "budget": BUDGET, "objective": "reach", "reward": "shaped", "action_scale": 0.5}
    return playground.load(NAME, config_overrides=overrides)


def test_every_task_has_a_name_in_the_registry() -> None:
    names = playground.register()
    assert len(names) == len(set(names)) == 290
    assert set(names) <= set(registry.ALL_ENVS)
    assert playground.register() == names
    assert len(registry.ALL_ENVS) == len(set(registry.ALL_ENVS))
    assert registry.get_default_config(NAME).episode_length == 500


def test_the_registry_loads_a_task_with_its_options() -> None:
    playground.register(["libero_object"])
    env = registry.load(NAME, config_overrides={"impl": "warp", "obs": "proprio"})
    assert isinstance(env, MjxEnv)
    assert isinstance(env, functional.FunctionalLibero)
    assert (env.suite, env.task, env.config.obs) == ("libero_object", 0, "proprio")
    assert (env.dt, env.sim_dt, env.n_substeps) == (0.05, 0.002, 25)
    assert (env.action_size, env.observation_size) == (7, 25)


@pytest.mark.parametrize("name", ["Libero/libero_object", "libero_object/0", "Libero/libero_object/x"])
def test_a_name_that_is_no_task_is_refused(name: str) -> None:
    with pytest.raises(FunctionalError, match="Libero/libero_object/0"):
        playground.load(name)


def test_the_length_of_a_step_is_not_an_option() -> None:
    with pytest.raises(FunctionalError, match=r"0\.05 s"):
        playground.load(NAME, config_overrides={"ctrl_dt": 0.02})


@pytest.mark.parametrize("full_reset", [True, pytest.param(False, marks=pytest.mark.heavy)])
def test_starts_rotate_with_full_resets_and_only_then(env: playground.PlaygroundEnv, full_reset: bool) -> None:
    wrapped = playground.wrap_for_training(env, episode_length=1, full_reset=full_reset)
    state = compiled(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), WORLDS))
    step = compiled(wrapped.step)
    seen, first = [np.asarray(state.data.qpos)], np.asarray(state.obs)
    for _ in range(3):
        state = step(state, jnp.full((WORLDS, 7), 0.3))
        assert np.asarray(state.done).all()
        seen.append(np.asarray(state.data.qpos))
    for world in range(WORLDS):
        assert len(np.unique([qpos[world] for qpos in seen], axis=0)) == (4 if full_reset else 1)
    assert np.abs(np.asarray(state.obs) - first).max(axis=1).min() > 1e-4 or not full_reset
    # What the controller remembers begins anew as well.
    np.testing.assert_array_equal(state.data.world.gripper, [[1.0, -1.0]] * WORLDS)


def test_the_functional_environment_itself_goes_through_the_wrapper() -> None:
    env = functional.FunctionalLibero("libero_object", task=0, config_overrides={"impl": "warp", "budget": BUDGET})
    wrapped = playground.wrap_for_training(env, episode_length=5)
    first = jax.eval_shape(wrapped.reset, jax.random.split(jax.random.PRNGKey(0), WORLDS))
    then = jax.eval_shape(wrapped.step, first, jax.ShapeDtypeStruct((WORLDS, 7), jnp.float32))
    assert jax.tree.structure(first) == jax.tree.structure(then)
    assert [x.shape for x in jax.tree.leaves(first)] == [x.shape for x in jax.tree.leaves(then)]


def test_fixtures_are_drawn_where_the_episode_has_them(
    env: playground.PlaygroundEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(playground, "render_array", lambda *args, **options: drawn.append((args, options)) or [])
    state = jax.eval_shape(env.reset, jax.random.key(0))
    pos = np.random.default_rng(0).normal(size=env.mj_model.body_pos.shape)
    state = state.tree_replace({"data.world.body_pos": pos, "data.world.body_quat": env.mj_model.body_quat})
    env.render([state], 64, camera="agentview")
    ((model, trajectory, height), options) = drawn[0]
    np.testing.assert_allclose(model.body_pos, pos)
    assert (trajectory, height, options) == ([state], 64, {"camera": "agentview"})
    assert model is not env.mj_model


@pytest.mark.heavy
@pytest.mark.parametrize("randomised", [False, True])
def test_brax_trains_through_playgrounds_wrapper(env: playground.PlaygroundEnv, randomised: bool) -> None:
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo

    playground.mend_brax()
    progress: list[int] = []
    trained: Any = env
    policy, _, metrics = ppo.train(
        environment=trained,
        num_timesteps=24,
        episode_length=4,
        num_envs=4,
        num_eval_envs=4,
        num_evals=2,
        unroll_length=3,
        batch_size=4,
        num_minibatches=1,
        num_updates_per_batch=1,
        network_factory=functools.partial(
            networks.make_ppo_networks, policy_hidden_layer_sizes=(8,), value_hidden_layer_sizes=(8,)
        ),
        wrap_env_fn=wrapper.wrap_for_brax_training if randomised else playground.wrap_for_training,
        randomization_fn=playground.randomize if randomised else None,
        progress_fn=lambda steps, values: progress.append(steps),
    )
    assert callable(policy)
    assert progress == [0, 24]
    for name in ("eval/episode_reward", "eval/episode_success", "eval/episode_fault", "training/total_loss"):
        assert np.isfinite(metrics[name]), name
    assert metrics["eval/episode_fault"] == 0
