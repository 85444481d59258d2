"""Jerk-limited paths: within their limits, all dofs in time, at rest in the end, and SIMPLER's own."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.simpler_files import GOOGLE_ROLLOUTS, rollouts

from vecenv.controllers.interpolate import InterpolationError, Limits, Planner, Profiles

ruckig: Any = pytest.importorskip("ruckig")

LIMITS = Limits(velocity=1.5, acceleration=2.0, jerk=50.0)
ARM = [0, 1, 2, 3, 4, 5, 6, 9, 10]
STEP = np.arange(172) / 513


def random_paths(count: int, dofs: int = 3, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, Profiles]:
    rng = np.random.default_rng(seed)
    start, target = rng.uniform(-2, 2, (2, count, dofs))
    velocity = rng.uniform(-1.4, 1.4, (count, dofs))
    return start, velocity, target, Planner(dofs, LIMITS).plan(start, velocity, target)


def test_a_path_begins_as_asked_and_ends_at_rest_at_its_target() -> None:
    start, velocity, target, paths = random_paths(20)
    position, speed = paths.sample([0.0, 100.0])
    np.testing.assert_allclose(position, np.stack([start, target], axis=1), atol=1e-9)
    np.testing.assert_allclose(speed, np.stack([velocity, np.zeros_like(velocity)], axis=1), atol=1e-9)


def test_after_arrival_it_holds() -> None:
    paths = random_paths(5)[-1]
    late = paths.duration.max() + np.linspace(0, 10, 50)
    position, speed = paths.sample(late)
    assert np.ptp(position, axis=1).max() == 0
    assert np.abs(speed).max() < 1e-9


def test_all_dofs_arrive_together() -> None:
    _, _, target, paths = random_paths(20)
    for i, duration in enumerate(paths.duration):
        shortly_before, _ = paths.sample([duration - 0.05])
        assert (np.abs(shortly_before[i, 0] - target[i]) > 1e-6).all()


def test_limits_are_kept() -> None:
    paths = random_paths(20)[-1]
    step = 1e-3
    position, speed = paths.sample(np.arange(0, paths.duration.max(), step))
    acceleration = np.diff(speed, axis=1) / step
    jerk = np.diff(acceleration, axis=1) / step
    assert np.abs(speed).max() <= LIMITS.velocity + 1e-9
    assert np.abs(acceleration).max() <= LIMITS.acceleration + 1e-6
    assert np.abs(jerk).max() <= LIMITS.jerk * 1.001
    np.testing.assert_allclose(np.diff(position, axis=1) / step, (speed[:, 1:] + speed[:, :-1]) / 2, atol=1e-5)


@given(values=arrays(np.float64, (3, 4), elements=st.floats(-2, 2, width=32)))
def test_it_is_ruckigs_path(values: np.ndarray) -> None:
    """Also where the start is faster than the limit, so that it brakes first."""
    start, velocity, target = values
    paths = Planner(4, LIMITS).plan(start[None], velocity[None], target[None])
    solver, trajectory, wanted = ruckig.Ruckig(4), ruckig.Trajectory(4), ruckig.InputParameter(4)
    wanted.current_position, wanted.current_velocity, wanted.target_position = map(list, (start, velocity, target))
    wanted.max_velocity, wanted.max_acceleration, wanted.max_jerk = [1.5] * 4, [2.0] * 4, [50.0] * 4
    solver.calculate(wanted, trajectory)
    times = np.linspace(0, trajectory.duration, 57)
    expected = [trajectory.at_time(time)[:2] for time in times]
    position, speed = paths.sample(times)
    assert paths.planned.all()
    np.testing.assert_allclose(np.stack([position[0], speed[0]], axis=1), expected, atol=1e-9)


def test_a_start_above_the_limit_brakes() -> None:
    paths = Planner(1, LIMITS).plan([[0.0]], [[3.0]], [[5.0]])
    _, speed = paths.sample([0.0, 1.0])
    assert speed[0, 0, 0] == 3.0
    assert speed[0, 1, 0] < 2.0


def test_slots_do_not_depend_on_each_other() -> None:
    start, velocity, target, together = random_paths(4)
    for i in range(4):
        alone = Planner(3, LIMITS).plan(start[[i]], velocity[[i]], target[[i]])
        for whole, single in zip(together.sample(STEP), alone.sample(STEP), strict=True):
            np.testing.assert_array_equal(whole[i], single[0])


def test_a_slot_that_is_not_finite_stays_and_leaves_the_others_alone() -> None:
    start, velocity, target, healthy = random_paths(3)
    target[1, 0] = np.nan
    paths = Planner(3, LIMITS).plan(start, velocity, target)
    assert paths.planned.tolist() == [True, False, True]
    position, speed = paths.sample(STEP)
    np.testing.assert_array_equal(position[1], np.broadcast_to(start[1], position[1].shape))
    assert not speed[1].any()
    np.testing.assert_array_equal(position[[0, 2]], healthy.sample(STEP)[0][[0, 2]])


def test_nowhere_to_go_takes_no_time() -> None:
    paths = Planner(2, LIMITS).plan([[0.3, -0.4]], [[0.0, 0.0]], [[0.3, -0.4]])
    assert paths.planned.all()
    assert paths.duration[0] == 0
    np.testing.assert_array_equal(paths.sample(STEP)[0], np.broadcast_to([0.3, -0.4], (1, 172, 2)))


def test_no_slots_give_no_paths() -> None:
    nothing = np.zeros((0, 2))
    assert Planner(2, LIMITS).plan(nothing, nothing, nothing).sample(STEP)[0].shape == (0, 172, 2)


@pytest.mark.parametrize(("name", "value"), [*itertools.product(("velocity", "acceleration", "jerk"), (0, -1, np.inf))])
def test_limits_must_be_positive_and_finite(name: str, value: float) -> None:
    with pytest.raises(InterpolationError, match=name):
        Limits(**{"velocity": 1.0, "acceleration": 1.0, "jerk": 1.0, name: value})


def test_shapes_are_checked() -> None:
    planner = Planner(2, LIMITS)
    with pytest.raises(InterpolationError, match=r"target must have shape \[B, 2\], got \[1, 3\]"):
        planner.plan(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 3)))
    with pytest.raises(InterpolationError, match="differ in length"):
        planner.plan(np.zeros((1, 2)), np.zeros((2, 2)), np.zeros((1, 2)))


def test_recorded_arm_paths_are_met() -> None:
    """Upstream chains them: a path begins where the previous one was left."""
    planner = Planner(9, LIMITS)
    position, velocity = (rollouts(GOOGLE_ROLLOUTS, key)[:, ARM].astype(float) for key in ("qpos0", "qvel0"))
    targets, recorded = rollouts(GOOGLE_ROLLOUTS, "arm_target_qpos"), rollouts(GOOGLE_ROLLOUTS, "arm_path")
    for step in range(recorded.shape[1]):
        positions, velocities = planner.plan(position, velocity, targets[:, step]).sample(STEP)
        np.testing.assert_allclose(positions, recorded[:, step], atol=1e-12)
        position, velocity = positions[:, -1], velocities[:, -1]


def test_recorded_gripper_paths_are_met() -> None:
    """They begin at the measured state."""
    planner = Planner(2, Limits(velocity=1.0, acceleration=7.0, jerk=50.0))
    targets, recorded = rollouts(GOOGLE_ROLLOUTS, "grip_target_qpos"), rollouts(GOOGLE_ROLLOUTS, "grip_path")
    measured = [
        np.concatenate([rollouts(GOOGLE_ROLLOUTS, f"{key}0")[:, None], rollouts(GOOGLE_ROLLOUTS, key)], axis=1)
        for key in ("qpos", "qvel")
    ]
    for step in range(recorded.shape[1]):
        qpos, qvel = (values[:, step, 7:9].astype(float) for values in measured)
        positions, _ = planner.plan(qpos, np.clip(qvel, -1, 1), targets[:, step]).sample(STEP)
        np.testing.assert_allclose(positions, recorded[:, step], atol=1e-12)
