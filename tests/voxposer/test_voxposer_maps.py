"""Value maps: voxels and metres, distances and blurs against SciPy, obstacles near targets."""

from __future__ import annotations

import platform

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt, gaussian_filter
from support import voxposer_reference as reference

from voxposer.planning import maps

pytestmark = pytest.mark.usefixtures("no_rank_promotion")

LOWER, UPPER = np.array([-0.7, -0.4, 0.812]), np.array([0.3, 0.5, 1.262])
# SciPy's wheels for other machines may fuse multiplications and additions.
SAME_BITS = platform.machine() in ("x86_64", "AMD64")


@given(st.integers(2, 150), st.integers(0, 2**32 - 1))
def test_a_point_comes_back_within_half_a_voxel(size: int, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(LOWER, UPPER, (20, 3))
    back = maps.to_world(maps.to_voxel(points, LOWER, UPPER, size), LOWER, UPPER, size)
    assert (np.abs(back - points) <= 0.5001 * (UPPER - LOWER) / (size - 1)).all()


def test_corners_are_centres_of_the_outermost_voxels_and_points_outside_go_to_the_border() -> None:
    points = np.stack([LOWER, UPPER, LOWER - 1, UPPER + 1])
    np.testing.assert_array_equal(maps.to_voxel(points, LOWER, UPPER), [[0] * 3, [99] * 3, [0] * 3, [99] * 3])


def test_numpy_stays_numpy_and_jax_may_be_traced() -> None:
    points = np.random.default_rng(0).uniform(LOWER, UPPER, (50, 3))
    voxels = maps.to_voxel(points, LOWER, UPPER)
    assert isinstance(voxels, np.ndarray)
    traced = jax.jit(lambda p: maps.to_voxel(p, LOWER, UPPER))(points)
    np.testing.assert_array_equal(traced, voxels)


def test_invalid_points_and_bounds_are_reported() -> None:
    with pytest.raises(ValueError, match="1 of the points are not finite"):
        maps.to_voxel(np.array([[0, 0, 1], [0, np.nan, 1]]), LOWER, UPPER)
    with pytest.raises(ValueError, match="upper > lower"):
        maps.to_voxel(np.zeros((1, 3)), UPPER, LOWER)


def test_voxels_that_hold_a_point_are_occupied_slot_by_slot() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(LOWER, UPPER, (3, 200, 3)).astype(np.float32)
    valid = rng.random((3, 200)) < 0.8
    points[0, 0], points[1, 3] = np.nan, np.inf
    found = np.asarray(maps.voxelize(points, LOWER, UPPER, 40, valid))
    wanted = np.zeros((3, 40, 40, 40), bool)
    for slot in range(3):
        usable = points[slot][valid[slot] & np.isfinite(points[slot]).all(-1)]
        wanted[slot][tuple(maps.to_voxel(usable, LOWER, UPPER, 40).T)] = True
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("share", [0.0005, 0.02, 0.7])
@pytest.mark.parametrize("shape", [(40, 40, 40), (2, 30, 25, 7), (1, 1, 12, 3)])
def test_distances_are_scipys_exactly(share: float, shape: tuple[int, ...]) -> None:
    occupied = np.random.default_rng(2).random(shape) < share
    occupied.reshape(-1, *shape[-3:])[:, 0, 0, -1] = True
    with jax.enable_x64(True):
        found = np.asarray(maps.distance_transform(occupied))
    wanted = [distance_transform_edt(~volume) for volume in occupied.reshape(-1, *shape[-3:])]
    np.testing.assert_array_equal(found.reshape(-1, *shape[-3:]), wanted)


def test_grids_too_large_for_16_bits_have_exact_distances_as_well() -> None:
    occupied = np.zeros((200, 3, 150), bool)
    occupied[0, 0, 0] = True
    squares = maps.squared_distance(jnp.asarray(occupied))
    assert squares.dtype == jnp.int32
    assert squares[-1, -1, -1] == 199**2 + 2**2 + 149**2


def test_without_anything_occupied_everything_is_unreachable() -> None:
    empty = jnp.zeros((100, 100, 100), bool)
    assert (maps.squared_distance(empty) == maps.unreachable((100, 100, 100))).all()
    assert jnp.isinf(maps.distance_transform(empty)).all()


@pytest.mark.parametrize(
    ("shape", "sigma"), [((60, 60, 60), 10), ((2, 20, 30, 8), 3.7), ((9, 9, 9), 10), ((5, 6, 7), 0)]
)
def test_the_blur_is_scipys(shape: tuple[int, ...], sigma: float) -> None:
    volume = np.random.default_rng(3).random(shape)
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(lambda x: maps.gaussian_blur(x, sigma))(volume)).reshape(-1, *shape[-3:])
    wanted = np.stack([gaussian_filter(part, sigma) for part in volume.reshape(-1, *shape[-3:])])
    np.testing.assert_allclose(found, wanted, rtol=1e-14)
    if SAME_BITS:
        np.testing.assert_array_equal(found, wanted)


def test_without_float64_the_blur_is_single_precision() -> None:
    volume = np.random.default_rng(4).random((50, 50, 50))
    found = maps.gaussian_blur(volume, 5)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, gaussian_filter(volume, 5), rtol=1e-5)


def test_scaling_divides_as_numpy_does_and_leaves_constants_alone() -> None:
    rng = np.random.default_rng(5)
    volumes = np.stack([rng.normal(size=(20, 20, 20)), np.full((20, 20, 20), 0.3), 1e-9 * rng.random((20, 20, 20))])
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(maps.normalize)(volumes))
    np.testing.assert_array_equal(found, [reference.normalize(volume) for volume in volumes])


def _scene(size: int = 100) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(6)
    scene = rng.random((size,) * 3) < 0.05
    scene[:, :, size // 5] = True
    avoidance, affordance = np.zeros((size,) * 3), np.zeros((size,) * 3)
    avoidance[20:40, 20:40, 20:40] = 0.1
    affordance[6 * size // 10, 7 * size // 10, 3 * size // 10] = 1
    return avoidance, scene, affordance


def test_the_scene_is_no_obstacle_near_targets_and_the_moving_object() -> None:
    avoidance, scene, affordance = _scene()
    movable = np.zeros_like(avoidance)
    movable[30:35, 40:45, 20:25] = 1
    found = maps.preprocess_avoidance(avoidance, scene, affordance, movable=movable)
    assert isinstance(found, np.ndarray)
    assert found.dtype == np.float64
    wanted = reference.preprocess_avoidance(avoidance, scene, affordance, movable=movable)
    np.testing.assert_array_equal(found, wanted)
    assert scene[60, 70, 20]
    assert found[60, 70, 20] == 0


@pytest.mark.parametrize("start", [[50, 40, 60], [10, 99, 10], [3, 50, 98]])
def test_the_scene_is_no_obstacle_in_a_box_around_the_hand(start: list[int]) -> None:
    avoidance, scene, affordance = _scene()
    found = maps.preprocess_avoidance(avoidance, scene, affordance, start=np.array(start))
    wanted = reference.preprocess_avoidance(avoidance, scene, affordance, start=np.array(start))
    np.testing.assert_array_equal(found, wanted)


def test_avoidance_maps_of_a_batch_are_those_of_its_slots() -> None:
    first, second = _scene(50), tuple(np.flip(volume, 0) for volume in _scene(50))
    batch = [np.stack(pair) for pair in zip(first, second, strict=True)]
    starts = np.array([[5, 6, 7], [30, 40, 20]])
    found = maps.preprocess_avoidance(*batch, start=starts)
    for slot, parts in enumerate((first, second)):
        np.testing.assert_array_equal(found[slot], maps.preprocess_avoidance(*parts, start=starts[slot]))


def test_without_targets_the_scene_counts_everywhere_but_at_the_start() -> None:
    avoidance, scene, affordance = _scene(50)
    found = maps.preprocess_avoidance(avoidance, scene, np.zeros_like(affordance), start=np.array([5, 5, 5]))
    np.testing.assert_array_equal(found[10:] > 0, (scene | (avoidance > 0))[10:])


def test_the_moving_object_must_be_given_in_one_way() -> None:
    avoidance, scene, affordance = _scene(50)
    with pytest.raises(ValueError, match="either movable"):
        maps.preprocess_avoidance(avoidance, scene, affordance)
