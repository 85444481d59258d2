"""The path planner against its NumPy and SciPy reference, on both engines, and what it does with odd input."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import savgol_filter
from support import voxposer_reference as reference

from voxposer.planning import planner
from voxposer.planning.config import Fault, PlannerConfig
from voxposer.planning.planner import Paths, optimize_paths

pytestmark = pytest.mark.usefixtures("no_rank_promotion")

Engine = Literal["jax", "numba"]
ENGINES: tuple[Engine, ...] = ("jax", "numba")
DEFAULT = PlannerConfig()
# The smallest grid there is, and one number of slots where it does not matter: JAX compiles each shape for seconds.
SMALL, SLOTS = 50, 5


def plan(problems: list[reference.Problem], engine: Engine, config: PlannerConfig = DEFAULT) -> Any:
    """Paths as NumPy arrays; a batch is filled up to ``SLOTS`` slots by repeating its last one."""
    filled = problems + problems[-1:] * (SLOTS - len(problems) if engine == "jax" else 0)
    start, target, obstacle, moved = reference.stack(filled)
    paths = optimize_paths(start.astype(float), target, obstacle, moved, config, engine=engine)
    return jax.tree.map(lambda x: np.asarray(x)[: len(problems)], paths)


def rows(paths: Any, part: slice) -> Any:
    return jax.tree.map(lambda x: x[part], paths)


def draw(count: int, size: int, seed: int) -> list[reference.Problem]:
    rng = np.random.default_rng(seed)
    return [reference.random_problem(rng, size) for _ in range(count)]


def require_equal(paths: Any, problems: list[reference.Problem], config: PlannerConfig = DEFAULT) -> None:
    """Raw voxels identical; waypoints within half a voxel (in fact float32's rounding), and as many."""
    for i, problem in enumerate(problems):
        raw, path = reference.optimize_path(**vars(problem), config=config)
        np.testing.assert_array_equal(paths.raw[i, : paths.raw_length[i]], raw, err_msg=f"raw path of problem {i}")
        assert paths.path_length[i] == len(path), f"waypoints of problem {i}"
        np.testing.assert_allclose(paths.path[i, : len(path)], path, atol=1e-4, err_msg=f"path of problem {i}")


def open_space(start: Any, target: Any, size: int = SMALL, object_centric: bool = False) -> reference.Problem:
    volume = np.zeros((size,) * 3)
    volume[tuple(target)] = 1
    return reference.Problem(np.asarray(start), volume, np.zeros((size,) * 3), object_centric)


# ----------------------------------------------------------------------------------------------------------------------
# Against the reference.


@pytest.mark.parametrize("engine", ENGINES)
def test_paths_are_those_of_numpy_and_scipy(engine: Engine) -> None:
    for seed in range(4):
        problems = draw(SLOTS, SMALL, seed)
        require_equal(plan(problems, engine), problems)


def test_paths_are_those_of_numpy_and_scipy_at_the_real_size() -> None:
    problems = draw(SLOTS, 100, seed=10)
    require_equal(plan(problems, "numba"), problems)


@pytest.mark.heavy
def test_five_hundred_paths_at_the_real_size_are_those_of_numpy_and_scipy() -> None:
    for seed in range(20):
        problems = draw(25, 100, seed=100 + seed)
        paths = plan(problems, "numba")
        require_equal(paths, problems)
        jax.tree.map(np.testing.assert_array_equal, plan(problems, "jax"), paths)


OTHER_COSTS = {"obstacle_map_gaussian_sigma": 3, "obstacle_map_weight": 1.3, "target_map_weight": 0.7}
OTHER_WINDOW = {"max_steps": 25, "savgol_window_size": 7, "savgol_polyorder": 2, "pushing_skip_per_k": 2}
OTHER_ENDS = {"max_curvature": 0.05, "stop_threshold": 0.05, "target_spacing": 5}
ONE_STEP = {"max_steps": 1, "savgol_window_size": 1, "pushing_skip_per_k": 1}


@pytest.mark.parametrize(
    ("engine", "change"),
    [
        *[("numba", change) for change in (OTHER_COSTS, OTHER_WINDOW, OTHER_ENDS, ONE_STEP)],
        ("jax", OTHER_COSTS | OTHER_WINDOW | OTHER_ENDS),
    ],
)
def test_every_option_acts_as_in_the_reference(engine: Engine, change: dict[str, Any]) -> None:
    config = replace(DEFAULT, **change)
    problems = draw(SLOTS, 60, seed=20) + draw(SLOTS, 60, seed=21) * (engine == "numba")
    require_equal(plan(problems, engine, config), problems, config)


@pytest.mark.parametrize("engine", ENGINES)
def test_of_equally_good_neighbours_the_first_is_taken(engine: Engine) -> None:
    volume = np.zeros((SMALL,) * 3)
    volume[10, 25, 25] = volume[40, 25, 25] = 1
    obstacle = np.zeros_like(volume)
    obstacle[24:27, 20:31, 20:31] = 1
    problem = reference.Problem(np.array([25, 25, 25]), volume, obstacle, False)
    paths = plan([problem], engine)
    require_equal(paths, [problem])
    assert paths.raw[0, paths.raw_length[0] - 1].tolist() == [10, 25, 25]


@pytest.mark.parametrize(("window", "degree"), [(20, 3), (7, 2), (1, 0), (5, 8)])
def test_smoothing_is_scipys_for_every_length(window: int, degree: int) -> None:
    path = np.cumsum(np.random.default_rng(3).integers(-2, 3, (60, 3)), axis=0).astype(float)
    with jax.enable_x64(True):
        smooth = jax.jit(lambda length: planner.smooth(jnp.asarray(path), length, window, degree))
        for length in range(1, len(path) + 1):
            width = min(length, window)
            wanted = savgol_filter(path[:length], width, min(degree, width - 1), axis=0)
            np.testing.assert_allclose(smooth(length)[:length], np.asarray(wanted), atol=1e-10)


# ----------------------------------------------------------------------------------------------------------------------
# What holds for every path.

voxels = st.tuples(*[st.integers(0, SMALL - 1)] * 3)
inner = st.tuples(*[st.integers(12, SMALL - 13)] * 3)


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_waypoints_stay_in_the_grid_and_steps_are_short(seed: int) -> None:
    problems = draw(2, SMALL, seed)
    paths = plan(problems, "numba")
    for i, problem in enumerate(problems):
        raw, path = paths.raw[i, : paths.raw_length[i]], paths.path[i, : paths.path_length[i]]
        assert len(path) >= 1
        assert path.min() >= 0
        assert path.max() <= SMALL - 1
        assert np.abs(np.diff(raw, axis=0)).max() <= planner.reach(SMALL)
        if problem.object_centric:
            assert (raw[:, 2] == problem.start[2]).all()
        else:
            assert problem.target[tuple(np.round(path[-1]).astype(int))] != 0


@settings(max_examples=25)
@given(start=voxels, target=voxels)
def test_without_obstacles_a_path_is_straight(start: tuple[int, ...], target: Any) -> None:
    paths = plan([open_space(start, target)], "numba")
    raw = paths.raw[0, : paths.raw_length[0]]
    distance = np.linalg.norm(raw - np.asarray(target), axis=1)
    arrived = np.flatnonzero(distance == 0)
    assert len(arrived)
    assert (np.diff(distance[: arrived[0] + 1]) < 0).all()
    np.testing.assert_array_equal(paths.path[0, paths.path_length[0] - 1].round(), target)


@settings(max_examples=25)
@given(start=inner, target=inner, shift=st.tuples(*[st.integers(-10, 10)] * 3))
def test_moving_everything_moves_the_path(start: Any, target: Any, shift: Any) -> None:
    moved = open_space(np.add(start, shift), np.add(target, shift))
    here, there = plan([open_space(start, target)], "numba"), plan([moved], "numba")
    assert here.raw_length == there.raw_length
    length = here.path_length[0]
    np.testing.assert_array_equal(there.raw, here.raw + np.array(shift))
    np.testing.assert_allclose(there.path[0, :length], here.path[0, :length] + np.array(shift), atol=1e-4)


def test_a_path_avoids_obstacles() -> None:
    problem = open_space((10, 50, 50), (90, 50, 50), size=100)
    problem.obstacle[45:55, 40:56, 40:60] = 1
    free = plan([replace(problem, obstacle=np.zeros_like(problem.obstacle))], "numba")
    kept = plan([problem], "numba")
    assert problem.obstacle[tuple(free.raw[0, : free.raw_length[0]].T)].any()
    assert not problem.obstacle[tuple(kept.raw[0, : kept.raw_length[0]].T)].any()


# ----------------------------------------------------------------------------------------------------------------------
# Slots and engines.


@pytest.mark.parametrize("engine", ENGINES)
def test_a_slot_does_not_depend_on_its_batch(engine: Engine) -> None:
    problems = draw(SLOTS, SMALL, seed=30)
    together = plan(problems, engine)
    for i, problem in enumerate(problems):
        jax.tree.map(np.testing.assert_array_equal, plan([problem], engine), rows(together, slice(i, i + 1)))


def test_a_batch_may_be_cut_into_parts_that_do_not_divide_it() -> None:
    def double(values: jax.Array, more: jax.Array) -> Any:
        return {"sum": values.sum(-1) + more, "first": 2 * values[:, :1]}

    values, more = jnp.arange(21.0).reshape(7, 3), jnp.arange(7.0)
    for at_once in (1, 2, 3, 7, 64):
        parts: Any = planner._in_parts(double, at_once, values, more)
        jax.tree.map(np.testing.assert_array_equal, parts, double(values, more))


def test_slots_traced_in_a_larger_function_equal_single_slots() -> None:
    arrays = reference.stack(draw(SLOTS, SMALL, seed=31))

    @jax.jit
    def larger(*arrays: jax.Array) -> tuple[Paths, jax.Array]:
        paths = planner._in_parts(partial(planner._plan, config=DEFAULT), SLOTS, *arrays)  # as on a GPU
        return paths, 2 * paths.path

    with jax.enable_x64(True):
        paths, doubled = larger(*arrays)
    jax.tree.map(np.testing.assert_array_equal, paths, optimize_paths(*arrays, engine="numba"))
    np.testing.assert_array_equal(doubled, 2 * np.asarray(paths.path))


def test_tracing_without_float64_is_refused() -> None:
    arrays = reference.stack(draw(1, SMALL, seed=32))
    with pytest.raises(ValueError, match="enable_x64"):
        jax.jit(lambda *arrays: optimize_paths(*arrays))(*arrays)
    with jax.enable_x64(True), pytest.raises(ValueError, match="concrete arrays"):
        jax.jit(lambda *arrays: optimize_paths(*arrays, engine="numba"))(*arrays)


def test_the_callers_precision_is_left_alone() -> None:
    paths = optimize_paths(*reference.stack(draw(1, SMALL, seed=34)))
    assert paths.path.dtype == jnp.float32
    assert all(x.dtype == jnp.int32 for x in (paths.raw, paths.raw_length, paths.path_length, paths.fault))
    assert jnp.ones(1).dtype == jnp.float32


@pytest.mark.parametrize("engine", ENGINES)
def test_behind_its_end_a_path_repeats_its_last_entry(engine: Engine) -> None:
    paths = plan(draw(3, SMALL, seed=35), engine)
    for i in range(3):
        raw, path = paths.raw[i], paths.path[i]
        assert (raw[paths.raw_length[i] - 1 :] == raw[-1]).all()
        assert (path[paths.path_length[i] - 1 :] == path[-1]).all()


# ----------------------------------------------------------------------------------------------------------------------
# Odd input.


@pytest.mark.parametrize("engine", ENGINES)
def test_a_slot_without_a_path_reports_why_and_affects_no_other(engine: Engine) -> None:
    good, lost, broken, torn, nowhere = draw(SLOTS, SMALL, seed=33)
    lost, broken = replace(lost, target=0 * lost.target), replace(broken, obstacle=broken.obstacle + np.nan)
    torn = replace(torn, target=np.where(torn.target == 1, np.inf, 0))
    nowhere = replace(nowhere, start=np.array([np.nan, 0, 0]))
    paths = plan([lost, good, broken, torn, nowhere], engine)
    assert paths.fault.tolist() == [Fault.NO_TARGET, Fault.NONE, *[Fault.NOT_FINITE] * 3]
    assert (paths.path_length > 0).tolist() == (paths.raw_length > 0).tolist() == [False, True, False, False, False]
    assert np.isfinite(paths.path).all()
    alone = plan([good], engine)
    jax.tree.map(np.testing.assert_array_equal, alone, rows(paths, slice(1, 2)))


@pytest.mark.parametrize("engine", ENGINES)
def test_a_start_outside_the_grid_or_between_voxels_goes_to_the_nearest_voxel(engine: Engine) -> None:
    outside = replace(open_space((0, 0, 0), (20, 20, 20)), start=np.array([-7.0, 80.0, 10.4]))
    inside = replace(outside, start=np.array([0.0, 49.0, 10.0]))
    jax.tree.map(np.testing.assert_array_equal, plan([outside], engine), plan([inside], engine))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("object_centric", [False, True])
def test_a_start_on_the_target_gives_a_path_that_ends_there(engine: Engine, object_centric: bool) -> None:
    problem = open_space((25, 20, 30), (25, 20, 30), object_centric=object_centric)
    paths = plan([problem], engine)
    require_equal(paths, [problem])
    np.testing.assert_array_equal(paths.path[0, paths.path_length[0] - 1].round(), [25, 20, 30])


@pytest.mark.parametrize("engine", ENGINES)
def test_targets_everywhere_leave_nothing_to_descend(engine: Engine) -> None:
    problem = replace(open_space((25, 20, 30), (0, 0, 0)), target=np.ones((SMALL,) * 3))
    require_equal(plan([problem], engine), [problem])


def test_maps_of_other_types_are_read_by_value() -> None:
    problem = draw(1, SMALL, seed=36)[0]
    solid = replace(problem, obstacle=(problem.obstacle > 0).astype(float))
    packed = replace(solid, target=solid.target == 1, obstacle=solid.obstacle.astype(np.uint8))
    jax.tree.map(np.testing.assert_array_equal, plan([packed], "numba"), plan([solid], "numba"))


def test_an_empty_batch_has_no_paths() -> None:
    grid = np.zeros((0, SMALL, SMALL, SMALL))
    paths = optimize_paths(np.zeros((0, 3)), grid, grid, np.zeros(0, bool), engine="numba")
    assert paths.path.shape == (0, 302, 3)
    with jax.enable_x64(True):
        traced = jax.eval_shape(optimize_paths, np.zeros((0, 3)), grid, grid, np.zeros(0, bool))
    assert [x.shape for x in traced] == [x.shape for x in paths]


@pytest.mark.usefixtures("unchecked_shapes")
def test_mismatched_shapes_are_reported() -> None:
    start, grid, moved = np.zeros((2, 3)), np.zeros((2, SMALL, SMALL, SMALL)), np.zeros(2, bool)
    with pytest.raises(ValueError, match="start must have shape"):
        optimize_paths(start[:, :2], grid, grid, moved)
    with pytest.raises(ValueError, match="obstacle must have shape"):
        optimize_paths(start, grid, grid[:1], moved)
    with pytest.raises(ValueError, match="object_centric must have shape"):
        optimize_paths(start, grid, grid, np.zeros((2, 1)))
    with pytest.raises(ValueError, match="50 or more"):
        optimize_paths(start, grid[:, :20, :20, :20], grid[:, :20, :20, :20], moved)


@pytest.mark.parametrize(
    "change",
    [{"stop_criteria": "never"}, {"max_steps": 0}, {"savgol_window_size": 0}, {"obstacle_map_gaussian_sigma": -1}],
)
def test_numbers_out_of_range_are_reported(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(change))):
        PlannerConfig(**change)
