"""Deterministic steps on MuJoCo Warp: the order of contacts, rows, threads and slots does not change a bit.

On a CPU, Warp runs threads one after the other, so the order in which a GPU might run them is made here: contacts and
constraint rows are shuffled before each use, and sums are taken over shuffled rows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import vecenv
from vecenv.controllers import kinematics, osc
from vecenv.libero.config import LiberoConfig, LiberoError
from vecenv.libero.env import LiberoEnv
from vecenv.libero.functional.config import FunctionalConfig, FunctionalError
from vecenv.libero.physics import private
from vecenv.libero.physics.mjx.blocks import for_worlds
from vecenv.libero.physics.mjx.options import MjxError, jit
from vecenv.libero.robot import HOME_QPOS, panda_chain

wp = pytest.importorskip("warp", reason="MuJoCo Warp is an extra: pip install 'vecenv[warp]'")

from vecenv.libero.physics.mjx import deterministic  # noqa: E402
from vecenv.libero.physics.mjx import deterministic_warp as kernels  # noqa: E402

SLOTS = 3
TICKS = 3


def make(episodes: list[int], *, on: bool = True) -> LiberoEnv:
    """Some episodes of a task, live."""
    env = vecenv.make("libero_object", task=0, episodes=episodes, backend="warp", geometry="lean", deterministic=on)
    assert isinstance(env, LiberoEnv)
    return env


@pytest.fixture(scope="module")
def env() -> Iterator[LiberoEnv]:
    made = make(list(range(SLOTS)))
    yield made
    made.close()


@pytest.fixture(scope="module")
def usual() -> Iterator[LiberoEnv]:
    made = make(list(range(SLOTS)), on=False)
    yield made
    made.close()


def native_model() -> mujoco.MjModel:
    """The scene's model."""
    with vecenv.make("libero_object", task=0, episodes=[0], geometry="lean") as env:
        assert isinstance(env, LiberoEnv)
        return env.mj_models[0]


def actions(slots: int) -> np.ndarray:
    """Actions that press the open hand down between the objects, other ones in each slot."""
    drawn = np.random.default_rng(0).uniform(-1, 1, (slots, TICKS, 7))
    drawn[..., 2] = -1
    return drawn


def states(env: LiberoEnv, episodes: list[int], given: np.ndarray) -> np.ndarray:
    """Positions and velocities after the actions, bit for bit, [B, nq + nv]."""
    env.set_episodes(tasks=0, episodes=episodes)
    env.reset()
    env.step_continuous(given)
    (group,) = env.physics.groups
    return np.concatenate([group.qpos, group.qvel], axis=1)


# ---------------------------------------------------------------------------------------------------------------------
# Orders that a GPU might have.


def shuffle_contacts(d: Any, rng: np.random.Generator) -> None:
    """Put the contacts of all worlds into another order."""
    order = rng.permutation(min(int(d.nacon.numpy()[0]), d.naconmax))
    for field in dataclasses.fields(d.contact):
        array = getattr(d.contact, field.name)
        if isinstance(array, wp.array) and array.shape and array.shape[0] == d.naconmax:
            rows = array.numpy()
            rows[: len(order)] = rows[order]


def shuffle_rows(d: Any, rng: np.random.Generator) -> None:
    """Put the rows of friction and limits of each world into another order."""
    fields = ("type", "id", "J_rownnz", "J_rowadr", "pos", "margin", "D", "vel", "aref", "frictionloss")
    for world, count in enumerate(d.nefc.numpy()):
        order = rng.permutation(int(count))
        for name in fields:
            rows = getattr(d.efc, name).numpy()[world]
            rows[: len(order)] = rows[order]


@pytest.fixture
def shuffled(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Shuffle contacts after each collision, and rows before each use; returns how many collisions there were."""
    rng, count = np.random.default_rng(0), [0]
    collide, order = private.warp_collision_driver.collision, deterministic._order_rows

    def collision(m: Any, d: Any, *args: Any, **kwargs: Any) -> None:
        collide(m, d, *args, **kwargs)
        shuffle_contacts(d, rng)
        count[0] += 1

    def order_rows(m: Any, d: Any) -> None:
        shuffle_rows(d, rng)
        order(m, d)

    monkeypatch.setattr(private.warp_collision_driver, "collision", collision)
    monkeypatch.setattr(deterministic, "_order_rows", order_rows)
    return lambda: count[0]


def test_contacts_and_rows_in_any_order_give_the_same_bits(env: LiberoEnv, request: pytest.FixtureRequest) -> None:
    episodes, given = list(range(SLOTS)), actions(SLOTS)
    expected = states(env, episodes, given)
    collisions = request.getfixturevalue("shuffled")
    np.testing.assert_array_equal(states(env, episodes, given), expected)
    assert collisions() >= TICKS * 25


@pytest.mark.heavy
def test_without_the_option_the_order_of_contacts_matters(usual: LiberoEnv, request: pytest.FixtureRequest) -> None:
    episodes, given = list(range(SLOTS)), actions(SLOTS)
    expected = states(usual, episodes, given)
    request.getfixturevalue("shuffled")
    found = states(usual, episodes, given)
    assert (found != expected).any()
    np.testing.assert_allclose(found, expected, atol=1e-2)


@pytest.mark.heavy
def test_a_slot_does_not_depend_on_its_batch(env: LiberoEnv) -> None:
    given = actions(SLOTS)
    expected = states(env, [0, 1, 2], given)
    np.testing.assert_array_equal(states(env, [2, 0, 1], given[[2, 0, 1]]), expected[[2, 0, 1]])
    alone = make([2])
    np.testing.assert_array_equal(states(alone, [2], given[[2]]), expected[[2]])
    alone.close()


@pytest.mark.heavy
def test_it_is_the_same_physics(env: LiberoEnv, usual: LiberoEnv) -> None:
    episodes, given = list(range(SLOTS)), actions(SLOTS)
    np.testing.assert_allclose(states(env, episodes, given), states(usual, episodes, given), atol=1e-2)


@pytest.mark.heavy
def test_the_controller_gives_the_same_bits_in_any_batch() -> None:
    """Without blocks, XLA's torques on a CPU differ in a few of 64 rows between batches of 64 and of fewer."""
    chain = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), panda_chain(native_model()))
    home = kinematics.arm_state(chain, jnp.array([*HOME_QPOS, 0, 0], jnp.float32), jnp.zeros(9))

    def torques(home: osc.ArmState, world: tuple[jax.Array, ...]) -> jax.Array:
        qpos, qvel, action = world
        arm = kinematics.arm_state(chain, qpos, qvel)
        return osc.torques(arm, osc.set_goal(arm, osc.hold_goal(home), action), home.qpos)

    rng, rows = np.random.default_rng(0), 64
    qpos = np.array([*HOME_QPOS, 0, 0]) + rng.normal(size=(rows, 9)) * 0.1
    given = [x.astype(np.float32) for x in (qpos, rng.normal(size=(rows, 9)) * 0.3, rng.uniform(-1, 1, (rows, 6)))]
    compute = jit(jax.vmap(for_worlds(torques, deterministic=True), in_axes=(None, 0)))
    expected = np.asarray(compute(home, tuple(given)))
    assert np.isfinite(expected).all()
    for count in (1, 5, 16):
        np.testing.assert_array_equal(compute(home, tuple(x[-count:] for x in given)), expected[-count:])


# ---------------------------------------------------------------------------------------------------------------------
# Sums.


def array(values: Any, kind: Any) -> Any:
    return wp.array(np.asarray(values), dtype=kind, device="cpu")


def launch(kernel: Any, dim: Any, *arguments: Any) -> None:
    wp.launch(kernel, dim=dim, inputs=list(arguments), device="cpu")


class Rows:
    """Random contacts of three rows in one world, each with 6 of 12 columns of the Jacobian.

    Args:
        order: in which the contacts come.
    """

    CONTACTS, DIM, COLUMNS, NV = 60, 3, 6, 12

    def __init__(self, order: np.ndarray) -> None:
        rng, rows = np.random.default_rng(0), self.CONTACTS * self.DIM
        columns = np.stack([np.sort(rng.permutation(self.NV)[: self.COLUMNS])[::-1] for _ in range(self.CONTACTS)])
        size = 10 ** rng.uniform(-2, 1, (self.CONTACTS, 1, 1))
        entries = rng.normal(size=(self.CONTACTS, self.DIM, self.COLUMNS)) * size
        self.force = rng.normal(size=(self.CONTACTS, self.DIM))
        self.columns, self.entries = columns, entries.astype(np.float32)
        self.weight = rng.uniform(1, 100, (self.CONTACTS, self.DIM)).astype(np.float32)
        self.residual = rng.normal(size=(self.CONTACTS, self.DIM)).astype(np.float32)
        self.cone = rng.random(self.CONTACTS) < 0.5
        flat = lambda x: x[order].reshape(1, -1)  # noqa: E731
        address = np.arange(rows) * self.COLUMNS
        state = np.repeat(
            np.where(self.cone, kernels.ConstraintState.CONE, kernels.ConstraintState.QUADRATIC), self.DIM
        )
        self.groups = [
            array([self.CONTACTS], int),
            array(np.arange(self.CONTACTS)[None] * self.DIM, int),
            array(np.full((1, self.CONTACTS), self.DIM), int),
            array(np.full((1, rows), self.COLUMNS), int),
            array(address[None], int),
            array(np.repeat(columns[:, None], self.DIM, axis=1)[order].reshape(1, 1, -1), int),
            array(self.entries[order].reshape(1, 1, -1), float),
        ]
        self.forces = array(flat(self.force), float)
        self.state = array(flat(state.reshape(self.CONTACTS, self.DIM)), int)
        self.weights, self.residuals = array(flat(self.weight), float), array(flat(self.residual), float)

    def add_forces(self, slots: int) -> np.ndarray:
        sums, out = wp.zeros((1, self.NV), dtype=wp.int64, device="cpu"), array(np.zeros((1, self.NV)), float)
        done = array([False], bool)
        launch(kernels.add_forces, (1, slots, kernels.LANES), *self.groups, self.forces, done, slots, sums, out)
        launch(kernels.read_forces, (1, self.NV), done, sums, out)
        assert not sums.numpy().any()
        return out.numpy()[0]

    def hessian(self, slots: int) -> np.ndarray:
        size = self.NV * (self.NV + 1) // 2
        sums, out = wp.zeros((1, size), dtype=wp.int64, device="cpu"), array(np.zeros((1, self.NV, self.NV)), float)
        done, ids = array([False], bool), array(np.zeros((1, self.CONTACTS * self.DIM)), int)
        friction = wp.array(np.array([[0.5, 0.5, 0.1, 0, 0]]), dtype=private.vec5, device="cpu")
        solved = self.weights, self.state, self.residuals
        launch(
            kernels.add_hessian,
            (1, slots, kernels.LANES),
            array([0.3], float),
            friction,
            ids,
            *self.groups,
            *solved,
            done,
            slots,
            sums,
        )
        none, inertia = array(np.full((self.NV, self.NV), -1), int), array(np.zeros((1, 1)), float)
        launch(kernels.read_hessian, (1, size), self.NV, none, inertia, done, sums, out)
        assert not sums.numpy().any()
        return out.numpy()[0]


def orders() -> list[np.ndarray]:
    rng = np.random.default_rng(1)
    return [np.arange(Rows.CONTACTS), *(rng.permutation(Rows.CONTACTS) for _ in range(4))]


def test_forces_are_the_same_sum_in_any_order_and_with_any_number_of_threads() -> None:
    found = [Rows(order).add_forces(slots) for order in orders() for slots in (1, 8, 128)]
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])
    rows, expected = Rows(orders()[0]), np.zeros(Rows.NV)
    terms = (rows.entries * rows.force[..., None]).sum(1)
    np.add.at(expected, rows.columns, terms)
    np.testing.assert_allclose(found[0], expected, rtol=1e-5, atol=1e-4)


def test_sums_of_floats_depend_on_the_order() -> None:
    """What the previous test would miss if the rows did not tell orders apart."""
    sums = []
    for order in orders():
        rows, total = Rows(order), np.zeros(Rows.NV, np.float32)
        terms = (rows.entries * rows.force[..., None].astype(np.float32)).sum(1)
        for contact in order:
            total[rows.columns[contact]] += terms[contact]
        sums.append(total)
    assert any((other != sums[0]).any() for other in sums[1:])


def test_the_hessian_is_the_same_sum_in_any_order_and_with_any_number_of_threads() -> None:
    found = [Rows(order).hessian(slots) for order in orders() for slots in (1, 8, 128)]
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_the_hessian_is_that_of_the_constraints_cost() -> None:
    """Against second differences of MuJoCo's cost of elliptic contacts."""
    rows, expected = Rows(orders()[0]), np.zeros((Rows.NV, Rows.NV))
    for contact in range(Rows.CONTACTS):
        dense = np.zeros((Rows.DIM, Rows.NV))
        dense[:, rows.columns[contact]] = rows.entries[contact]
        weight = np.diag(rows.weight[contact].astype(float))
        if rows.cone[contact]:
            weight = cone_hessian(rows.residual[contact].astype(float), float(rows.weight[contact, 0]))
        expected += dense.T @ weight @ dense
    found = rows.hessian(8)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, np.triu(expected), atol=1e-5 * scale)


def cone_hessian(residual: np.ndarray, weight: float) -> np.ndarray:
    """Second derivatives of the cost in the cone's middle zone: weight (N - mu T)² / (2 mu² (1 + mu²))."""
    friction, mu = np.array([0.5, 0.5]), 0.5 * 0.3

    def cost(x: np.ndarray) -> float:
        normal, slip = mu * x[0], np.linalg.norm(friction * x[1:])
        return weight / (mu**2 * (1 + mu**2)) * 0.5 * float(normal - mu * slip) ** 2

    step, found, axes = 1e-4, np.zeros((3, 3)), np.eye(3)
    for i in range(3):
        for j in range(3):
            corners = [(a, b, cost(residual + step * (a * axes[i] + b * axes[j]))) for a in (-1, 1) for b in (-1, 1)]
            found[i, j] = sum(a * b * value for a, b, value in corners) / (4 * step**2)
    return found


def test_a_force_that_is_not_finite_or_too_large_is_not_hidden() -> None:
    for bad in (np.nan, np.inf, -np.inf, 1e30):
        rows = Rows(orders()[0])
        rows.forces.numpy()[0, 5] = bad
        found = rows.add_forces(8)
        np.testing.assert_array_equal(np.isnan(found), np.isin(np.arange(Rows.NV), rows.columns[5 // Rows.DIM]))


def test_children_are_added_in_one_order_for_any_order_of_threads() -> None:
    rng = np.random.default_rng(0)
    parent, level = np.array([0, 0, 1, 1, 1, 0]), np.array([2, 3, 4])
    for kernel, kind, width in (
        (kernels.add_subtree_com, wp.vec3, 3),
        (kernels.add_composite_inertia, private.vec10, 10),
        (kernels.add_body_force, wp.spatial_vector, 6),
    ):
        values = rng.normal(size=(2, len(parent), width)).astype(np.float32)
        bodies = wp.array(values, dtype=kind, device="cpu")
        launch(kernel, (2, len(level)), array(parent, int), bodies, array(level, int), bodies)
        expected = values.copy()
        for child in level:
            expected[:, 1] += values[:, child]
        np.testing.assert_array_equal(bodies.numpy(), expected)


# ---------------------------------------------------------------------------------------------------------------------
# Who gets it.


def test_a_backend_without_it_is_refused() -> None:
    with pytest.raises(LiberoError, match="backend='warp'"):
        LiberoConfig(backend="jax", deterministic=True)
    assert LiberoConfig(backend="native", deterministic=True).deterministic
    for options in ({"impl": "jax"}, {"impl": "warp", "cone": "pyramidal"}):
        with pytest.raises(FunctionalError, match="needs 'warp' and 'elliptic'"):
            FunctionalConfig(deterministic=True, **options)  # type: ignore[arg-type]


def test_mjx_without_cuda_is_pure_jax_and_is_refused() -> None:
    with pytest.raises(MjxError, match="pure JAX"):
        vecenv.make("libero_object", task=0, episodes=[0], backend="mjx", geometry="lean", deterministic=True)


def test_what_is_not_supported_is_named() -> None:
    text = """
    <mujoco><option cone="elliptic"/><worldbody>
      <body name="a"><joint name="j"/><geom size=".1"/></body><body><joint name="k"/><geom size=".1"/></body>
    </worldbody>
    <equality><joint joint1="j" joint2="k"/></equality></mujoco>
    """
    with pytest.raises(MjxError, match=r"deterministic=True does not support equality constraints$"):
        deterministic.prepared(mujoco.MjModel.from_xml_string(text))


def test_an_mjx_whose_functions_have_changed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    changes: list[tuple[Any, str, Any, Callable[[], Any], str]] = [
        (private.warp_smooth, "crb", lambda m: None, deterministic._smooth_variants, "takes m"),
        (private.warp_constraint, "make_constraint", lambda m, d: None, deterministic._constraint_variants, "refer to"),
        (private.warp_solver, "_update_gradient", None, deterministic._solver_variants, "is not a function"),
    ]
    for owner, name, value, find, message in changes:
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            with pytest.raises(deterministic.MjxDeterminismError, match=rf"{message}.*deterministic=False"):
                find()
