"""The functional environment keeps what JAX training loops rely on, and simulates what the batched one does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.upstream import scene_ids, scene_tasks

import vecenv
from vecenv.libero import functional
from vecenv.libero.env import LiberoEnv
from vecenv.libero.functional import (
    FunctionalConfig,
    FunctionalError,
    FunctionalLibero,
    FunctionalState,
)
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.mjx.options import compiler_options
from vecenv.libero.tasks.suites import UnknownTask

# Arrays of different rank do not broadcast, neither in our functions nor in MJX on MuJoCo Warp. MJX's pure JAX promotes
# ranks itself, so tests that step with it use `rank_promotion`.
pytestmark = pytest.mark.usefixtures("no_rank_promotion")

WORLDS = 2
# What vecenv.libero.physics.budgets measures for libero_object task 0.
BUDGET = Budget(contacts=218, rows=935, pairs=833, candidates=215)
# Enough for any scene.
ROOMY = {
    "warp": Budget(contacts=500, rows=1500, pairs=1, candidates=500),
    "jax": Budget(contacts=80, rows=1, pairs=30, candidates=1),
}
# LLVM's optimisation off: programs compile several times faster.
OPTIONS: dict[str, Any] = {**compiler_options(), "xla_backend_optimization_level": 0}
compiled: Callable[..., Callable[..., Any]] = partial(jax.jit, compiler_options=OPTIONS)


@cache
def made(suite: str = "libero_object", task: int = 0, **options: Any) -> FunctionalLibero:
    return FunctionalLibero(suite, task=task, config_overrides={"impl": "warp", "budget": BUDGET, **options})


def keys(count: int = WORLDS, seed: int = 0) -> jax.Array:
    return jax.random.split(jax.random.key(seed), count)


def wiggle(env: FunctionalLibero, ticks: int, worlds: int = WORLDS) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (ticks, worlds, env.action_size)).astype(np.float32)


def types(tree: Any) -> Any:
    return jax.tree.map(lambda x: (x.shape, x.dtype.name), tree)


class Compiled:
    """One environment with its two functions over ``WORLDS`` worlds."""

    def __init__(self, env: FunctionalLibero) -> None:
        self.env = env
        self.reset: Callable[[jax.Array], FunctionalState] = compiled(jax.vmap(env.reset))
        self.step: Callable[[FunctionalState, Any], FunctionalState] = compiled(jax.vmap(env.step))


@pytest.fixture(scope="module")
def plain() -> Compiled:
    return Compiled(made(reward="shaped"))


@pytest.fixture
def rank_promotion() -> Iterator[None]:
    with jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture
def state(plain: Compiled) -> FunctionalState:
    return plain.reset(keys())


# -- structure ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"action": "joint", "obs": "proprio", "objective": "reach", "reward": "shaped"},
        {"placement": "regions", "obs": ("objects",), "objective": "lift", "reward": "shaped"},
    ],
)
def test_a_step_returns_what_a_reset_returns(options: dict[str, Any]) -> None:
    env = made(**options)
    first = jax.eval_shape(env.reset, jax.random.key(0))
    then = jax.eval_shape(env.step, first, jax.ShapeDtypeStruct((env.action_size,), jnp.float32))
    assert types(first) == types(then)
    assert jax.tree.structure(first) == jax.tree.structure(then)
    assert first.obs.shape == (env.observation_size,)
    assert {first.reward.dtype, first.done.dtype, first.obs.dtype} == {jnp.dtype("float32")}
    assert (first.reward.shape, first.done.shape) == ((), ())


def test_what_wrappers_add_to_a_state_stays_in_it(plain: Compiled) -> None:
    first = jax.eval_shape(plain.env.reset, jax.random.key(0))
    first.info["steps"], first.metrics["reward"] = first.reward, first.reward
    then = jax.eval_shape(plain.env.step, first, jax.ShapeDtypeStruct((7,), jnp.float32))
    assert types(first) == types(then)


def test_observations_hold_what_the_layout_says(plain: Compiled, state: FunctionalState) -> None:
    env, layout = plain.env, plain.env.layout
    assert layout["fixture_joints"].stop == env.observation_size
    obs, model = np.asarray(state.obs), env.mj_model
    soup = model.body(env.scene.entities["alphabet_soup_1"].root_body).id
    np.testing.assert_allclose(obs[:, layout["joint_pos"]], state.data.qpos[:, :7])
    np.testing.assert_allclose(obs[:, layout["alphabet_soup_1"]][:, :3], state.data.xpos[:, soup])
    away = np.asarray(state.data.xpos[:, soup] - state.data.site_xpos[:, env.scene.grip_site])
    np.testing.assert_allclose(obs[:, layout["target_offset"]], away, atol=0.01)


def test_a_state_can_be_changed_by_path(state: FunctionalState) -> None:
    changed = state.tree_replace({"data.world.gripper": jnp.ones((WORLDS, 2)), "info.episode": 7, "done": 1})
    assert (changed.info["episode"], changed.done) == (7, 1)
    assert np.all(np.asarray(changed.data.world.gripper) == 1)
    assert changed.data.qpos is state.data.qpos


# -- stepping ----------------------------------------------------------------------------------------------------------


def test_the_same_call_gives_the_same_result_and_leaves_its_arguments(plain: Compiled, state: FunctionalState) -> None:
    before = jax.tree.map(np.array, state)
    action = wiggle(plain.env, 1)[0]
    once, twice = plain.step(state, action), plain.step(state, action)
    for a, b in zip(jax.tree.leaves(once), jax.tree.leaves(twice), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, before, state)
    assert np.abs(np.asarray(once.data.qpos - state.data.qpos)).max() > 1e-4


def test_it_steps_as_the_batched_environment_does(plain: Compiled, state: FunctionalState) -> None:
    episodes = np.asarray(state.info["episode"]).tolist()
    batched = vecenv.make("libero_object", tasks=[0] * WORLDS, episodes=[0], backend="warp", budget=BUDGET)
    assert isinstance(batched, LiberoEnv)
    batched.set_episodes(episodes=episodes)
    batched.reset()
    np.testing.assert_allclose(batched.state().qpos, state.data.qpos, atol=1e-6)
    for action in wiggle(plain.env, 3):
        batched.step_continuous(action)
        state = plain.step(state, action)
    np.testing.assert_allclose(batched.state().qpos, state.data.qpos, atol=1e-5)
    columns = [plain.env.layout[name] for name in ("eef_pos", "finger_pos")]
    seen = batched.observe_egocentric().state[:, [0, 1, 2, 6, 7]]
    np.testing.assert_allclose(np.concatenate([state.obs[:, c] for c in columns], axis=1), seen, atol=1e-5)
    np.testing.assert_allclose(plain.env.observe_batch(batched.physics), state.obs, atol=1e-5)
    batched.close()


def test_a_batch_of_another_scene_or_with_images_is_not_observed() -> None:
    env = vecenv.make("libero_goal", tasks=[0], episodes=[0], backend="native")
    assert isinstance(env, LiberoEnv)
    env.reset()
    assert made().observe_batch(env.physics, []).shape == (0, made().observation_size)
    with pytest.raises(FunctionalError, match="slot 0 simulates another scene"):
        made().observe_batch(env.physics)
    env.close()


def test_a_batch_with_other_geometry_is_observed_likewise() -> None:
    env = vecenv.make("libero_object", tasks=[0], episodes=[3], backend="native")
    assert isinstance(env, LiberoEnv)
    env.reset()
    lean = FunctionalLibero("libero_object", task=0, config_overrides={"geometry": "lean", "budget": BUDGET})
    np.testing.assert_allclose(lean.observe_batch(env.physics), made().observe_batch(env.physics), atol=2e-3)
    env.close()


def test_non_finite_actions_count_as_zero_and_large_ones_are_clipped(plain: Compiled, state: FunctionalState) -> None:
    odd = np.array([[np.nan, np.inf, 0, 0, 0, 0, 1], [9, -9, 0, 0, 0, 0, 9]], np.float32)
    even = np.array([[0, 0, 0, 0, 0, 0, 1], [1, -1, 0, 0, 0, 0, 1]], np.float32)
    np.testing.assert_allclose(plain.step(state, odd).data.qpos, plain.step(state, even).data.qpos, atol=1e-5)


def test_a_failed_world_ends_alone_and_earns_nothing(plain: Compiled, state: FunctionalState) -> None:
    broken = state.tree_replace({"data.qvel": state.data.qvel.at[0, 3].set(jnp.nan)})
    after = plain.step(broken, np.zeros((WORLDS, 7), np.float32))
    np.testing.assert_array_equal(after.done, [1, 0])
    np.testing.assert_array_equal(after.metrics["fault"], [1, 0])
    np.testing.assert_array_equal(after.metrics["success"], [0, 0])
    assert after.reward[0] == 0
    assert np.isfinite(np.asarray(after.obs)).all()
    healthy = plain.step(state, np.zeros((WORLDS, 7), np.float32))
    np.testing.assert_allclose(after.data.qpos[1], healthy.data.qpos[1], atol=1e-5)


def test_success_ends_the_episode_and_pays_one(plain: Compiled, state: FunctionalState) -> None:
    env = plain.env
    soup = int(env.mj_model.joint("alphabet_soup_1_joint0").qposadr[0])
    basket = np.asarray(state.data.site_xpos[1, env.mj_model.site("basket_1_contain_region").id])
    inside = state.tree_replace({"data.qpos": state.data.qpos.at[1, soup : soup + 3].set(basket)})
    after = plain.step(inside, np.zeros((WORLDS, 7), np.float32))
    np.testing.assert_array_equal(after.metrics["success"], [0, 1])
    np.testing.assert_array_equal(after.done, [0, 1])
    assert after.reward[1] > 1


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_batch_of_actions_for_one_world_is_refused(plain: Compiled, state: FunctionalState) -> None:
    with pytest.raises(FunctionalError, match=r"jax\.vmap"):
        plain.env.step(jax.tree.map(lambda x: x[0], state), jnp.zeros((WORLDS, 7)))


@pytest.mark.heavy
def test_worlds_do_not_depend_on_how_they_are_mapped() -> None:
    env = made(reward="shaped")

    def rollout(key: jax.Array) -> jax.Array:
        def tick(state: FunctionalState, action: jax.Array) -> tuple[FunctionalState, jax.Array]:
            state = env.step(state, action)
            return state, state.obs

        return jax.lax.scan(tick, env.reset(key), jnp.full((2, 7), 0.1))[1]

    flat = compiled(jax.vmap(rollout))(keys(4))
    nested = compiled(jax.vmap(jax.vmap(rollout)))(keys(4).reshape(2, 2))
    alone = compiled(rollout)(keys(4)[3])
    np.testing.assert_allclose(nested.reshape(flat.shape), flat, atol=1e-5)
    np.testing.assert_allclose(alone, flat[3], atol=1e-5)


@pytest.mark.heavy
def test_joint_actions_move_the_joints() -> None:
    env = Compiled(made(action="joint"))
    state = env.reset(keys())
    action = np.zeros((WORLDS, 8), np.float32)
    action[1, 3], action[:, 7] = 1.0, 1.0
    moved = state
    for _ in range(4):
        moved = env.step(moved, action)
    change = np.asarray(moved.data.qpos - state.data.qpos)
    assert np.abs(change[0, :7]).max() < 0.01
    # A target leads its joint by at most 0.05 rad: 0.02 rad in 0.2 s from rest.
    assert 0.015 < change[1, 3] < 0.05
    np.testing.assert_array_less(np.abs(np.asarray(moved.data.qpos[:, 7:9])), 0.03)


def fullest_scenes() -> list[str]:
    """The scene with most fixtures and objects of each class of problems (floor, table, kitchen, ...)."""
    kinds: dict[str, dict[str, int]] = {}
    for name, (kind, fixtures, objects) in zip(scene_ids(), scene_tasks(), strict=True):
        kinds.setdefault(kind, {})[name] = len(fixtures) + len(objects)
    return [max(sizes, key=sizes.__getitem__) for sizes in kinds.values()]


@pytest.mark.heavy
@pytest.mark.parametrize("scene_id", scene_ids())
def test_every_scene_resets_and_steps(scene_id: str) -> None:
    reset_and_step(scene_id, impl="warp", geometry="exact")


# Pure JAX takes four times as long to compile: half a minute a scene, 20 minutes for all of them.
@pytest.mark.heavy
@pytest.mark.usefixtures("rank_promotion")
@pytest.mark.parametrize("scene_id", fullest_scenes())
def test_a_scene_of_every_kind_resets_and_steps_in_pure_jax(scene_id: str) -> None:
    reset_and_step(scene_id, impl="jax", geometry="lean")


def reset_and_step(scene_id: str, impl: str, geometry: str) -> None:
    suite, task = scene_id.rsplit("-", 1)
    options = {"impl": impl, "geometry": geometry, "reward": "shaped", "placement": "regions", "budget": ROOMY[impl]}
    env = Compiled(FunctionalLibero(suite, task=int(task), config_overrides=options))
    first = env.reset(keys())
    state = env.step(first, wiggle(env.env, 1)[0])
    assert types(state) == types(first)
    assert not np.asarray(state.metrics["fault"]).any()
    assert np.isfinite(np.asarray(state.data.qpos)).all()
    assert np.isfinite(np.asarray(state.reward)).all()
    assert state.obs.shape == (WORLDS, env.env.observation_size)
    assert np.abs(np.asarray(state.data.qpos - first.data.qpos))[:, :7].max() > 1e-4
    jax.clear_caches()


@pytest.mark.heavy
@pytest.mark.usefixtures("rank_promotion")
def test_derivatives_of_a_step_are_those_of_finite_differences() -> None:
    env = made(impl="jax", geometry="lean", budget=ROOMY["jax"])
    state = compiled(env.reset)(jax.random.key(0))

    def height(action: jax.Array) -> jax.Array:
        return env.step(state, action).data.world.eef_pos[2]

    @compiled
    def slope(action: jax.Array, along: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(height, (action,), (along,))

    action, size = jnp.full(7, 0.1), 0.05
    for k in (0, 2, 4):
        along = jnp.eye(7)[k]
        high, low = (float(slope(action + sign * size * along, along)[0]) for sign in (1, -1))
        assert float(slope(action, along)[1]) == pytest.approx((high - low) / (2 * size), abs=2e-4), k


# -- options -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"obs": "pixels", "image_size": 0}, "image_size"),
        ({"obs": ()}, "proprio"),
        ({"obs": ("proprio", "touch")}, "touch"),
        ({"action": "velocity"}, "osc, joint"),
        ({"action_scale": 0.0}, "action_scale"),
        ({"placement": "random"}, "stored, regions"),
        ({"geometry": "round"}, "exact, lean"),
        ({"iterations": (0, 4)}, "iterations"),
        ({"cone": "round"}, "elliptic, pyramidal"),
        ({"episode_length": 0}, "episode_length"),
        ({"colors": "srgb"}, "published, current"),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(FunctionalError, match=message):
        FunctionalConfig(**options)


def test_unknown_options_and_tasks_are_named() -> None:
    with pytest.raises(FunctionalError, match="num_worlds"):
        FunctionalLibero("libero_object", task=0, config_overrides={"num_worlds": 3})
    with pytest.raises(UnknownTask, match="0 to 9"):
        FunctionalLibero("libero_object", task=10)


def test_the_default_configuration_is_upstreams_task() -> None:
    config = functional.default_config()
    assert (config.objective, config.reward, config.action, config.geometry) == ("goal", "sparse", "osc", "exact")
