"""Worlds differ within the bounds of a ``Randomization``, for an episode, as the key of its reset decides."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vecenv.libero.functional import (
    FunctionalConfig,
    FunctionalError,
    FunctionalLibero,
    FunctionalState,
    Randomization,
    Variation,
    randomize,
)
from vecenv.libero.functional.config import FACTORS, SPREADS
from vecenv.libero.functional.randomize import Randomizer
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.mjx.options import compiler_options

pytestmark = pytest.mark.usefixtures("no_rank_promotion")

# What vecenv.libero.physics.budgets measures for libero_object task 0.
BUDGET = Budget(contacts=218, rows=935, pairs=833, candidates=215)
# LLVM's optimisation off: programs compile several times faster.
OPTIONS: dict[str, Any] = {**compiler_options(), "xla_backend_optimization_level": 0}
compiled: Callable[..., Callable[..., Any]] = partial(jax.jit, compiler_options=OPTIONS)

NOTHING: dict[str, Any] = dict.fromkeys(FACTORS, (1.0, 1.0))
BOUNDS: dict[str, Any] = {name: (0.5 + 0.05 * k, 1.5 + 0.1 * k) for k, name in enumerate(FACTORS)}
PHYSICS = Randomization(**BOUNDS)
LOOK = Randomization(light=0.4, light_shift=0.5, color=0.3, camera_pos=0.02, camera_turn=0.1)
INSTANCES, CAMERAS = 5, ("agentview", "wrist")


@cache
def made(**options: Any) -> FunctionalLibero:
    return FunctionalLibero("libero_object", task=0, config_overrides={"impl": "warp", "budget": BUDGET, **options})


@cache
def varying() -> tuple[Callable[[jax.Array], FunctionalState], Callable[..., FunctionalState]]:
    """Reset and step of several worlds whose physics differ."""
    env = made(randomization=PHYSICS)
    return compiled(jax.vmap(env.reset)), compiled(jax.vmap(env.step))


def keys(count: int, seed: int = 0) -> jax.Array:
    return jax.random.split(jax.random.key(seed), count)


def drawn(config: Randomization, count: int = 64) -> Variation:
    model = made().mjx_model
    return jax.jit(jax.vmap(partial(Randomizer(config, INSTANCES, CAMERAS).episode, model)))(keys(count))


def same(a: Any, b: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


# -- what is drawn -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FACTORS)
def test_factors_of_physics_differ_between_worlds_within_their_bounds(name: str) -> None:
    found = np.asarray(getattr(drawn(PHYSICS), name)).reshape(64, -1)
    low, high = getattr(PHYSICS, name)
    assert found.min() >= low - 1e-6
    assert found.max() <= high + 1e-6
    assert len(np.unique(found[:, 0])) == 64
    # Of 64 draws, some lie in each outer quarter of the range.
    assert found[:, 0].min() < low + (high - low) / 4
    assert found[:, 0].max() > high - (high - low) / 4


@pytest.mark.parametrize("name", SPREADS)
def test_quantities_of_images_differ_between_worlds_within_their_bounds(name: str) -> None:
    look = drawn(LOOK).look
    assert look is not None
    found = np.asarray(getattr(look, name)).reshape(64, -1)
    centre, spread = (1.0 if name in ("light", "color") else 0.0), getattr(LOOK, name)
    assert np.abs(found - centre).max() <= spread + 1e-6
    moving = found[:, np.ptp(found, axis=0) > 0]
    assert moving.shape[1] == {"light": 1, "color": 3 * (INSTANCES - 1)}.get(name, 3)
    assert moving[:, 0].min() < centre - spread / 2
    assert moving[:, 0].max() > centre + spread / 2


def test_only_the_given_cameras_move_and_what_is_no_instance_keeps_its_colours() -> None:
    look = drawn(dataclasses.replace(LOOK, cameras=("wrist",))).look
    assert look is not None
    for moved in (look.camera_pos, look.camera_turn):
        assert not np.asarray(moved[:, 0]).any()
        assert np.asarray(moved[:, 1]).all()
    assert (np.asarray(look.color[:, 0]) == 1).all()


def test_quantities_are_drawn_independently() -> None:
    found = drawn(dataclasses.replace(PHYSICS, light=0.4, color=0.3), 512)
    assert found.look is not None
    columns = [np.asarray(getattr(found, name)).reshape(512, -1)[:, -1] for name in FACTORS]
    columns += [np.asarray(found.look.light), np.asarray(found.look.color[:, 1, 0])]
    # Correlations of 512 independent draws have a standard deviation of 0.044.
    assert np.abs(np.corrcoef(columns) - np.eye(len(columns))).max() < 0.2


def test_without_visual_quantities_there_is_no_look() -> None:
    assert drawn(PHYSICS).look is None


# -- in the environment ------------------------------------------------------------------------------------------------


def test_a_reset_draws_anew_and_depends_on_its_key_alone() -> None:
    reset, _ = varying()
    first, again, other = reset(keys(2)), reset(keys(2)), reset(keys(2, seed=1))
    same(first.data.variation, again.data.variation)
    for name in FACTORS:
        values = [np.asarray(getattr(state.data.variation, name)) for state in (first, other)]
        assert (values[0][0] != values[0][1]).any(), name
        assert (values[0] != values[1]).any(), name


def test_a_variation_lasts_for_the_episode() -> None:
    reset, step = varying()
    first = reset(keys(2))
    state = first
    for _ in range(2):
        state = step(state, np.full((2, 7), 0.2, np.float32))
    same(state.data.variation, first.data.variation)
    assert not np.asarray(state.metrics["fault"]).any()


def test_a_step_simulates_the_varied_model() -> None:
    reset, step = varying()
    action = np.full((2, 7), 0.5, np.float32)
    state = reset(keys(2))
    after = step(state, action)

    plain = made()
    nominal = plain.mjx_model

    def step_as(variation: Variation, state: FunctionalState, action: jax.Array) -> FunctionalState:
        plain._mjx_model = nominal.tree_replace(variation.fields(nominal))
        try:
            return plain.step(state, action)
        finally:
            plain._mjx_model = nominal

    without = state.replace(data=state.data.replace(variation=None))
    expected = compiled(jax.vmap(step_as))(state.data.variation, without, action)
    np.testing.assert_allclose(after.data.qpos, expected.data.qpos, atol=1e-5)
    ones = jax.tree.map(jnp.ones_like, state.data.variation)
    unvaried = step(state.tree_replace({"data.variation": ones}), action)
    assert np.abs(np.asarray(after.data.qpos - unvaried.data.qpos))[:, :7].max() > 1e-4


def test_an_episode_begins_where_it_does_without_randomisation() -> None:
    reset, _ = varying()
    varied, plain = reset(keys(8)), compiled(jax.vmap(made().reset))(keys(8))
    np.testing.assert_array_equal(varied.info["episode"], plain.info["episode"])
    np.testing.assert_array_equal(varied.data.qpos, plain.data.qpos)
    assert plain.data.variation is None


def test_states_keep_their_structure() -> None:
    env = made(randomization=PHYSICS)
    first = jax.eval_shape(env.reset, jax.random.key(0))
    then = jax.eval_shape(env.step, first, jax.ShapeDtypeStruct((7,), jnp.float32))
    assert jax.tree.structure(first) == jax.tree.structure(then)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), first) == jax.tree.map(lambda x: (x.shape, x.dtype), then)


@pytest.fixture
def rank_promotion() -> Iterator[None]:
    with jax.numpy_rank_promotion("allow"):
        yield


# The ray tracer promotes ranks.
@pytest.mark.heavy
@pytest.mark.usefixtures("rank_promotion")
def test_images_differ_as_each_quantity_says() -> None:
    env = made(obs="pixels", image_size=16, randomization=dataclasses.replace(LOOK, **NOTHING))
    begun = compiled(jax.vmap(env.reset))(keys(2))
    data = jax.tree.map(lambda x: x[0], begun.data)
    look = data.variation.look
    nothing = look._replace(
        **{name: jnp.full_like(getattr(look, name), name in ("light", "color")) for name in SPREADS}
    )
    looks = [nothing, *(nothing._replace(**{name: getattr(look, name)}) for name in SPREADS)]
    worlds = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(looks), *x.shape)), data)
    worlds = worlds.replace(variation=worlds.variation._replace(look=jax.tree.map(lambda *x: jnp.stack(x), *looks)))
    see = compiled(jax.vmap(env._observer))
    images, published = (np.asarray(see(seen)["pixels/view_0"]) for seen in (worlds, worlds.replace(variation=None)))
    np.testing.assert_array_equal(images[0], published[0])
    for name, image in zip(SPREADS, images[1:], strict=True):
        assert np.abs(image - images[0]).max() > 0.02, name
    np.testing.assert_array_equal(np.asarray(see(begun.data)["pixels/view_0"]), begun.obs["pixels/view_0"])


# -- for all episodes of a world ---------------------------------------------------------------------------------------


def test_randomize_varies_each_world_within_the_given_factors() -> None:
    model = made().mjx_model
    varied, axes = randomize(model, keys(16), Randomization(mass=(0.5, 2.0)))
    factors = np.asarray(varied.body_mass)[:, 1:] / np.maximum(np.asarray(model.body_mass)[1:], 1e-12)
    heavy = np.asarray(model.body_mass)[1:] > 0
    assert factors[:, heavy].min() >= 0.5 - 1e-6
    assert factors[:, heavy].max() <= 2.0 + 1e-6
    assert len(np.unique(factors[:, heavy][:, 0])) == 16
    assert axes.body_mass == 0
    assert axes.body_pos is None
    wider = jax.tree.map(lambda new, old: 0 if new.ndim > old.ndim else None, varied, model)
    assert jax.tree.structure(wider) == jax.tree.structure(axes)


def test_randomize_by_nothing_changes_nothing() -> None:
    model = made().mjx_model
    varied, _ = randomize(model, keys(3), Randomization(**NOTHING))
    for name in ("geom_friction", "body_mass", "body_inertia", "dof_damping", "actuator_gainprm"):
        np.testing.assert_allclose(getattr(varied, name)[2], getattr(model, name), rtol=1e-6)


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize(
    ("quantity", "value"),
    [
        ("friction", (0.0, 1.0)),
        ("mass", (1.2, 0.8)),
        ("damping", (0.5, math.inf)),
        ("armature", (math.nan, 1.0)),
        ("gripper", 1.1),
        ("light", 1.5),
        ("light", (0.5, 1.5)),
        ("light_shift", -0.1),
        ("color", math.nan),
        ("camera_pos", math.inf),
        ("camera_turn", 4.0),
        ("cameras", "agentview"),
        ("cameras", ("frontview",)),
    ],
)
def test_bounds_that_make_no_sense_are_named(quantity: str, value: Any) -> None:
    with pytest.raises(FunctionalError, match=f"^{quantity}="):
        Randomization(**{quantity: value})


def test_cameras_cannot_move_if_there_are_none() -> None:
    with pytest.raises(FunctionalError, match="cameras="):
        Randomization(camera_pos=0.1, cameras=())


def test_quantities_of_images_are_refused_where_there_are_none() -> None:
    with pytest.raises(FunctionalError, match=r"light=0\.4.*pixels"):
        FunctionalConfig(randomization=LOOK)
    with pytest.raises(FunctionalError, match=r"light, light_shift.*FunctionalConfig"):
        randomize(made().mjx_model, keys(2), LOOK)


@pytest.mark.usefixtures("unchecked_shapes")
def test_a_randomization_of_another_type_is_refused() -> None:
    wrong: Any = {"friction": (0.5, 1.0)}
    with pytest.raises(FunctionalError, match="Randomization"):
        FunctionalConfig(randomization=wrong)
