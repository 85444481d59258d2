"""Pushes: the model against upstream's procedure, what the search picks, and where the hand goes."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support import voxposer_reference as reference

from vecenv.util.rotations import quat_to_mat
from voxposer.planning import push
from voxposer.planning.push import PushConfig, best_push, push_waypoints

pytestmark = pytest.mark.usefixtures("no_rank_promotion")

# Few samples suffice where the best of them is not the question.
FEW = PushConfig(num_samples=300)
KEY = jax.random.key(0)
# The same examples in every run; how long it takes to draw them says something about the machine only.
steady = settings(max_examples=20, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
TABLE = 0.9


def plate(count: int = 320, seed: int = 0) -> np.ndarray:
    """Points of a disc of 8 cm radius and 2 cm height that lies on the table, [M, 3]."""
    rng = np.random.default_rng(seed)
    angle, radius = rng.uniform(0, 2 * np.pi, count), 0.08 * np.sqrt(rng.random(count))
    heights = TABLE + 0.02 * rng.random(count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), heights], axis=-1).astype(np.float32)


def target(x: float = 0.05, y: float = -0.03) -> np.ndarray:
    return np.array([x, y, TABLE + 0.01], np.float32)


def test_costs_are_those_of_moving_the_whole_cloud() -> None:
    points, goal = plate().astype(float), target().astype(float)
    samples = reference.sample_pushes(points, goal, 500, np.random.default_rng(1))
    with jax.enable_x64(True):
        pushes = (jnp.asarray(x) for x in (samples.contact, samples.direction, samples.distance))
        _, costs = push.push_costs(jnp.asarray(points.mean(0)), jnp.asarray(goal), *pushes)
    np.testing.assert_allclose(costs, reference.push_costs(points, goal, samples, block=200), atol=1e-12)


def test_a_hand_that_moves_away_does_not_move_the_object() -> None:
    centre, goal = jnp.zeros(3), jnp.array([1.0, 0, 0])
    contact = jnp.array([[-0.1, 0, 0], [0.1, 0, 0]])
    predicted, cost = push.push_costs(centre, goal, contact, jnp.array([[1.0, 0, 0]] * 2), jnp.array([0.05, 0.05]))
    np.testing.assert_allclose(predicted, [[0.05, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(cost, [0.95, 1])


@steady
@given(angle=st.floats(0, 6.28), far=st.floats(0.02, 0.085))
def test_the_best_push_reaches_a_target_in_range(angle: float, far: float) -> None:
    points = plate()
    centre = points.mean(0)
    goal = centre + far * np.array([np.cos(angle), np.sin(angle), 0], np.float32)
    found = best_push(points[None], goal[None], KEY)
    assert found.cost[0] < 0.005
    np.testing.assert_allclose(found.predicted[0], goal, atol=0.005)
    np.testing.assert_allclose(centre + found.distance[0] * found.direction[0], found.predicted[0], atol=1e-6)
    # From behind, through the centre.
    assert np.dot(np.asarray(found.contact[0]) - centre, goal - centre) < 0


def test_a_target_out_of_reach_is_approached_as_far_as_one_push_goes() -> None:
    found = best_push(plate()[None], target(0.5, 0)[None], KEY)
    assert found.distance[0] == pytest.approx(0.09, abs=0.002)
    assert found.cost[0] == pytest.approx(0.41, abs=0.01)


def test_the_contact_is_where_the_hand_first_meets_the_object() -> None:
    points = plate(2000)
    found = best_push(points[None], target(0.06, 0)[None], KEY)
    contact, along = np.asarray(found.contact[0]), np.asarray(found.direction[0])
    assert np.linalg.norm(contact[:2]) == pytest.approx(0.08, abs=0.005)
    offset = points - contact
    aside = np.linalg.norm((offset - np.outer(offset @ along, along))[:, :2], axis=1)
    assert (offset @ along)[aside <= 0.02].min() > -1e-4


def test_negative_distances_pull_an_object_back() -> None:
    near = plate().mean(0) + np.array([0.015, 0, 0], np.float32)
    drawn = best_push(plate()[None], near[None], KEY, PushConfig(min_distance=-0.02, max_distance=-0.01))
    assert drawn.distance[0] < 0
    assert drawn.direction[0, 0] < 0
    assert drawn.cost[0] < 0.005


def test_level_pushes_have_no_vertical_part_and_upstreams_do() -> None:
    goal = target() - np.array([0, 0, 0.05], np.float32)
    level = best_push(plate()[None], goal[None], KEY)
    tilted = best_push(plate()[None], goal[None], KEY, replace(FEW, level=False))
    assert level.direction[0, 2] == 0
    assert level.cost[0] < 0.005
    assert tilted.direction[0, 2] < -0.1


def test_contacts_keep_between_the_heights_allowed() -> None:
    points = np.stack([plate(), plate(seed=1)])
    goals = np.stack([target(), target()])
    found = best_push(
        points, goals, KEY, FEW, lowest=np.array([TABLE + 0.015, 0]), highest=np.array([2, TABLE + 0.005])
    )
    assert TABLE + 0.015 <= found.contact[0, 2] <= TABLE + 0.02
    assert TABLE <= found.contact[1, 2] <= TABLE + 0.005


def test_an_object_below_the_lowest_height_is_pushed_at_that_height() -> None:
    found = best_push(plate()[None], target()[None], KEY, lowest=TABLE + 0.04)
    assert found.contact[0, 2] == pytest.approx(TABLE + 0.04)
    assert found.cost[0] < 0.005


def test_padding_and_non_finite_points_do_not_count() -> None:
    points = plate(200)
    padded = np.concatenate([points, np.full((50, 3), 5.0), np.full((6, 3), np.nan)]).astype(np.float32)
    valid = np.arange(256) < 200
    valid[-6:] = True
    plain = best_push(points[None], target()[None], KEY, FEW)
    kept = best_push(padded[None], target()[None], KEY, FEW, valid=valid[None])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), kept, plain)


def test_an_object_without_points_has_no_push() -> None:
    found = best_push(plate()[None], target()[None], KEY, FEW, valid=np.zeros((1, 320), bool))
    assert jnp.isinf(found.cost[0])
    assert all(np.isfinite(np.asarray(x)).all() for x in (found.contact, found.direction, found.distance))


def test_with_a_key_a_slot_a_push_does_not_depend_on_the_batch() -> None:
    points, goals = np.stack([plate(seed=i) for i in range(3)]), np.stack([target(0.01 * i, 0.05) for i in range(3)])
    keys = jax.random.split(KEY, 3)
    together = best_push(points, goals, keys, FEW)
    for i in range(3):
        alone = best_push(points[i : i + 1], goals[i : i + 1], keys[i : i + 1], FEW)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[0], b[i], atol=1e-6), alone, together)


@pytest.mark.usefixtures("unchecked_shapes")
def test_invalid_input_is_reported() -> None:
    with pytest.raises(ValueError, match=r"must be \[B, M, 3\] and \[B, 3\]"):
        best_push(plate(), target()[None], KEY)
    with pytest.raises(ValueError, match="one key or 1"):
        best_push(plate()[None], target()[None], jax.random.split(KEY, 2))
    with pytest.raises(ValueError, match="num_samples"):
        PushConfig(num_samples=0)
    with pytest.raises(ValueError, match="max_distance"):
        PushConfig(min_distance=0.1, max_distance=0.0)


@steady
@given(angle=st.floats(0, 6.28))
def test_the_closed_hand_comes_from_behind_pushes_slowly_and_draws_back(angle: float) -> None:
    goal = target(0.06 * np.cos(angle), 0.06 * np.sin(angle))
    found = best_push(plate()[None], goal[None], KEY, FEW, lowest=TABLE + 0.015)
    way = push_waypoints(found, FEW)
    contact, along, pos = np.asarray(found.contact[0]), np.asarray(found.direction[0]), np.asarray(way.pose[0, :, :3])
    travelled = (pos - contact) @ along
    np.testing.assert_allclose(travelled, [-0.08, -0.08, found.distance[0], -0.064, -0.064], atol=1e-5)
    np.testing.assert_allclose(pos[:, 2] - contact[2], [0.12, 0, 0, 0, 0.12], atol=1e-6)
    assert pos[:, 2].min() >= TABLE + 0.0149
    np.testing.assert_array_equal(way.grip, np.ones((1, 5)))
    np.testing.assert_allclose(way.velocity[0], [1, 1, 0.2, 0.33, 1])


@steady
@given(angle=st.floats(0, 6.28), hand=st.integers(0, 2**32 - 1))
def test_the_fingers_point_down_and_forwards_and_lie_across_the_push(angle: float, hand: int) -> None:
    along = jnp.array([[np.cos(angle), np.sin(angle), 0]])
    still = jnp.zeros(1)
    held = np.random.default_rng(hand).normal(size=4)
    held /= np.linalg.norm(held)
    way = push_waypoints(push.Push(jnp.zeros((1, 3)), along, still, still, jnp.zeros((1, 3))), hand=held)
    quat = np.asarray(way.pose[0, 0, 3:])
    x, y, z = np.asarray(quat_to_mat(way.pose[0, 0, 3:])).T
    np.testing.assert_allclose(z, [np.cos(angle) / np.sqrt(2), np.sin(angle) / np.sqrt(2), -np.sqrt(0.5)], atol=1e-5)
    np.testing.assert_allclose([y @ np.asarray(along[0]), y[2], x @ y], 0, atol=1e-5)
    # The other way to hold it is half a turn about z: w, x, y, z -> -z, y, -x, w.
    other = np.array([-quat[3], quat[2], -quat[1], quat[0]])
    assert abs(quat @ held) >= abs(other @ held) - 1e-5


def test_a_push_straight_down_still_has_an_orientation() -> None:
    down = push.Push(jnp.zeros((1, 3)), jnp.array([[0.0, 0, -1]]), jnp.ones(1), jnp.ones(1), jnp.zeros((1, 3)))
    quat = push_waypoints(down).pose[0, :, 3:]
    np.testing.assert_allclose(np.linalg.norm(quat, axis=-1), 1, atol=1e-6)
