"""Batched rotations against SciPy's, and where they must not break: half turns, the identity, empty quaternions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vecenv.util import rotations

NEAR_HALF_TURNS = [np.pi, np.pi - 1e-9, np.pi - 1e-4]
SMALL_TURNS = [0.0, 1e-300, 1e-9, 1e-4]

pytestmark = pytest.mark.usefixtures("no_rank_promotion")


def scipy_of(quat: Any) -> Rotation:
    return Rotation.from_quat(np.asarray(quat)[..., [1, 2, 3, 0]])


@pytest.fixture(scope="module")
def quats() -> np.ndarray:
    quat = np.random.default_rng(0).normal(size=(200, 4))
    return quat / np.linalg.norm(quat, axis=-1, keepdims=True)


def test_matrices_and_products_equal_scipys(quats: np.ndarray) -> None:
    with jax.enable_x64(True):
        np.testing.assert_allclose(rotations.quat_to_mat(quats), scipy_of(quats).as_matrix(), atol=1e-14)
        product = rotations.quat_mul(quats[:100], quats[100:])
        mats = rotations.matmul(rotations.quat_to_mat(quats[:100]), rotations.quat_to_mat(quats[100:]))
        inverse = rotations.quat_mul(quats, rotations.quat_conjugate(quats))
    expected = (scipy_of(quats[:100]) * scipy_of(quats[100:])).as_matrix()
    np.testing.assert_allclose(scipy_of(product).as_matrix(), expected, atol=1e-14)
    np.testing.assert_allclose(mats, expected, atol=1e-14)
    np.testing.assert_allclose(inverse, np.tile([1.0, 0, 0, 0], (200, 1)), atol=1e-14)


def test_a_quaternion_survives_the_way_through_its_matrix(quats: np.ndarray) -> None:
    half_turns = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0.6, 0.8, 0], [1e-9, 0, -0.6, 0.8], [1, 0, 0, 0]]
    every = np.concatenate([quats, half_turns])
    with jax.enable_x64(True):
        back = np.asarray(rotations.mat_to_quat(rotations.quat_to_mat(every)))
    assert (back[:, 0] >= 0).all()
    np.testing.assert_allclose(np.abs((back * every).sum(-1)), 1, atol=1e-14)


@pytest.mark.parametrize("angle", [*SMALL_TURNS, 0.3, 2.0, *NEAR_HALF_TURNS])
def test_a_rotation_vector_survives_the_way_through_its_quaternion(angle: float) -> None:
    axes = np.random.default_rng(1).normal(size=(20, 3))
    rotvec = axes / np.linalg.norm(axes, axis=-1, keepdims=True) * angle
    with jax.enable_x64(True):
        quat = rotations.rotvec_to_quat(rotvec)
        back = np.asarray(rotations.quat_to_rotvec(quat))
    np.testing.assert_allclose(scipy_of(quat).as_matrix(), Rotation.from_rotvec(rotvec).as_matrix(), atol=1e-14)
    # At half a turn to the last bit, the opposite axis is the same rotation.
    flipped = (back * rotvec).sum(-1, keepdims=True) < 0
    np.testing.assert_allclose(np.where(flipped & (angle > 3.14159), -back, back), rotvec, rtol=1e-9, atol=1e-12)


def test_the_rotation_between_takes_the_short_way(quats: np.ndarray) -> None:
    current, target = quats[:100], quats[100:]
    with jax.enable_x64(True):
        error = np.array(rotations.rotation_between(current, target))
        signs = np.asarray(rotations.rotation_between(current, -target))
    assert np.linalg.norm(error, axis=-1).max() <= np.pi
    reached = Rotation.from_rotvec(error) * scipy_of(current)
    np.testing.assert_allclose(reached.as_matrix(), scipy_of(target).as_matrix(), atol=1e-13)
    np.testing.assert_allclose(signs, error, atol=1e-12)


def test_vectors_are_turned_as_scipy_turns_them(quats: np.ndarray) -> None:
    vectors = np.random.default_rng(5).normal(size=(len(quats), 3))
    with jax.enable_x64(True):
        turned = rotations.rotate(quats, vectors)
    np.testing.assert_allclose(turned, scipy_of(quats).apply(vectors), atol=1e-13)


def test_quaternions_without_a_direction_are_masked() -> None:
    quat = np.array([[2.0, 0, 0, 0], [0, 0, 0, 0], [np.nan, 1, 0, 0], [np.inf, 0, 0, 1], [1e-30, 0, 0, -1e-30]])
    unit, valid = rotations.quat_normalize(jnp.asarray(quat, jnp.float32))
    np.testing.assert_array_equal(valid, [True, False, False, False, True])
    np.testing.assert_allclose(unit[:4], np.tile([1.0, 0, 0, 0], (4, 1)), atol=1e-7)
    np.testing.assert_allclose(unit[4], [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)], atol=1e-7)


@pytest.mark.parametrize(
    ("function", "at"),
    [
        (rotations.rotvec_to_quat, [0.0, 0.0, 0.0]),
        (rotations.quat_to_rotvec, [1.0, 0.0, 0.0, 0.0]),
        (rotations.quat_to_rotvec, [0.0, 1.0, 0.0, 0.0]),
        (rotations.safe_norm, [0.0, 0.0, 0.0]),
        (rotations.mat_to_quat, np.eye(3)),
        (rotations.mat_to_quat, np.diag([1.0, -1.0, -1.0])),
        (lambda q: rotations.quat_normalize(q)[0], [0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_gradients_are_finite_where_angles_and_axes_degenerate(function: Callable, at: list[float]) -> None:
    slope = jax.jacobian(function)(jnp.asarray(at))
    assert np.isfinite(slope).all()


def test_the_dtype_of_the_input_is_kept(quats: np.ndarray) -> None:
    single = jnp.asarray(quats, jnp.float32)
    assert rotations.quat_to_rotvec(single).dtype == np.float32
    assert rotations.mat_to_quat(rotations.quat_to_mat(single)).dtype == np.float32
    with jax.enable_x64(True):
        assert rotations.mat_to_quat(rotations.quat_to_mat(quats)).dtype == np.float64
        assert rotations.rotvec_to_quat(single[..., 1:]).dtype == np.float32


def test_any_leading_axes_are_kept(quats: np.ndarray) -> None:
    folded = jnp.asarray(quats.reshape(4, 50, 4))
    assert rotations.quat_to_mat(folded).shape == (4, 50, 3, 3)
    assert rotations.mat_to_quat(rotations.quat_to_mat(folded[0, 0])).shape == (4,)
    assert rotations.rotation_between(folded, folded[0, 0]).shape == (4, 50, 3)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"quat must have shape \[\.\.\., 4\], got \[2, 3\]"):
        rotations.quat_to_mat(jnp.zeros((2, 3)))
    with pytest.raises(ValueError, match=r"mat must have shape \[\.\.\., 3, 3\], got \[3\]"):
        rotations.mat_to_quat(jnp.zeros(3))
