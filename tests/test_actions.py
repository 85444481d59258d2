"""Action input becomes a validated array or an error that says what would be right; nothing in between."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vecenv.actions import ActionError, continuous, ee_poses, hold_steps

NUMBER = st.floats(width=64)
JSONABLE = st.recursive(
    st.none() | st.booleans() | st.integers() | NUMBER | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=40,
)
ARRAYS = hnp.arrays(
    st.sampled_from([np.float64, np.float32, np.int64, np.uint8, np.bool_, np.complex128, np.dtype("U3"), object]),
    hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=9),
)
JUNK = JSONABLE | JSONABLE.map(json.dumps) | ARRAYS | st.binary(max_size=9) | st.text() | st.sets(st.integers())
POSES = hnp.arrays(np.float64, (3, 8), elements=NUMBER)


# -- continuous --------------------------------------------------------------------------------------------------------


def test_one_action_a_slot_is_a_chunk_of_one() -> None:
    value = np.linspace(-1, 1, 14).reshape(2, 7)
    actions, sanitized = continuous(value, 2)
    np.testing.assert_array_equal(actions, value[:, None])
    assert actions.dtype == np.float64
    assert sanitized.tolist() == [False, False]


def test_a_chunk_keeps_its_length() -> None:
    assert continuous(np.zeros((2, 5, 7)), 2)[0].shape == (2, 5, 7)
    assert continuous(np.zeros((2, 0, 7)), 2)[0].shape == (2, 0, 7)


def test_a_batch_of_one_takes_a_bare_action() -> None:
    assert continuous([0.1] * 7, 1)[0].shape == (1, 1, 7)


@pytest.mark.parametrize("form", [np.asarray, np.ndarray.tolist, lambda a: json.dumps(a.tolist()), np.float32])
def test_arrays_lists_and_json_text_are_the_same(form: Any) -> None:
    value = np.arange(-7, 7).reshape(2, 7) / 8
    np.testing.assert_array_equal(continuous(form(value), 2)[0][:, 0], value)


def test_not_finite_becomes_zero_and_too_large_is_clipped_and_the_slot_is_marked() -> None:
    value = np.zeros((3, 2, 7))
    value[0, 1, :5] = [np.nan, np.inf, -np.inf, 1.5, -7.0]
    value[1, 0, :2] = [1.0, -1.0]
    actions, sanitized = continuous(value, 3)
    np.testing.assert_array_equal(actions[0, 1, :5], [0, 0, 0, 1, -1])
    np.testing.assert_array_equal(actions[1:], value[1:])
    assert sanitized.tolist() == [True, False, False]


def test_the_callers_array_is_left_alone() -> None:
    value = np.full((1, 7), np.nan)
    continuous(value, 1)
    assert np.isnan(value).all()


def test_json_text_may_hold_nan() -> None:
    actions, sanitized = continuous("[[NaN, Infinity, 0, 0, 0, 0, 1]]", 1)
    assert actions[0, 0].tolist() == [0, 0, 0, 0, 0, 0, 1]
    assert sanitized[0]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((3, 7)), r"got shape \(3, 7\); expected \[2, 7\] or \[2, K, 7\]"),
        (np.zeros((2, 6)), r"got shape \(2, 6\)"),
        (np.zeros(7), r"got shape \(7,\)"),
        (np.zeros((2, 1, 1, 7)), r"got shape \(2, 1, 1, 7\)"),
        ("[[0, 0]]", r"got shape \(1, 2\)"),
        ("[[0, 0", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("9" * 5000, "not JSON"),
        ([[0] * 7, [0] * 6], "ragged"),
        ([[10**400] * 7] * 2, "not numbers"),
        ([["a"] * 7] * 2, "not numbers"),
        ([[None] * 7] * 2, "not numbers"),
        (np.zeros((2, 7), complex), "complex128 values, not numbers"),
        (None, "not numbers"),
        ({"action": [0] * 7}, "not numbers"),
    ],
)
def test_what_is_no_action_is_refused(value: Any, message: str) -> None:
    with pytest.raises(ActionError, match=f"^actions: .*{message}"):
        continuous(value, 2)


@given(JUNK, st.integers(1, 3))
def test_whatever_comes_is_refused_or_valid(value: Any, num_envs: int) -> None:
    try:
        actions, sanitized = continuous(value, num_envs)
    except ActionError:
        return
    assert actions.dtype == np.float64
    assert actions.shape[::2] == (num_envs, 7)
    assert (np.abs(actions) <= 1).all()
    assert sanitized.shape == (num_envs,)
    assert sanitized.dtype == bool


@given(hnp.arrays(np.float64, (2, 3, 7), elements=NUMBER))
def test_only_what_was_wrong_changes(value: np.ndarray) -> None:
    actions, sanitized = continuous(value, 2)
    fine = np.isfinite(value) & (np.abs(value) <= 1)
    np.testing.assert_array_equal(actions[fine], value[fine])
    np.testing.assert_array_equal(sanitized, (~fine).any(axis=(1, 2)))
    assert (actions[~np.isfinite(value)] == 0).all()


# -- poses -------------------------------------------------------------------------------------------------------------


def test_quaternions_are_made_unit_and_the_rest_is_kept() -> None:
    value = np.array([[0.1, 0.2, 0.3, 2.0, 0.0, 0.0, 0.0, 1.0], [1, 2, 3, 1, 1, 1, 1, 0]])
    poses, moves, errors = ee_poses(value, 2)
    np.testing.assert_allclose(poses[:, 3:7], [[1, 0, 0, 0], [0.5] * 4])
    np.testing.assert_array_equal(poses[:, [0, 1, 2, 7]], value[:, [0, 1, 2, 7]])
    assert moves.tolist() == [True, True]
    assert errors == ("", "")


@pytest.mark.parametrize("nothing", [None, [], "[]", np.zeros((0, 8)), np.zeros((3, 0))])
def test_nothing_is_a_no_op_without_an_error(nothing: Any) -> None:
    poses, moves, errors = ee_poses(nothing, 3)
    assert poses.shape == (3, 8)
    assert moves.tolist() == [False] * 3
    assert errors == ("",) * 3


def test_a_batch_of_one_takes_a_bare_pose() -> None:
    assert ee_poses([0, 0, 0, 1, 0, 0, 0, 1], 1)[0].shape == (1, 8)


def test_a_bad_pose_stops_its_own_slot_only() -> None:
    value = np.tile([0.0, 0, 0, 1, 0, 0, 0, 1], (4, 1))
    value[1, 0] = np.nan
    value[2, 3] = 0.0
    value[3, 4] = np.inf
    poses, moves, errors = ee_poses(value, 4)
    assert moves.tolist() == [True, False, False, False]
    assert errors == ("", "pose is not finite", "quaternion has no length", "pose is not finite")
    assert np.isfinite(poses).all()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((2, 7)), r"got shape \(2, 7\); expected \[2, 8\] or an empty sequence"),
        (np.zeros((1, 8)), r"got shape \(1, 8\)"),
        (np.zeros(8), r"got shape \(8,\)"),
        ("{", "not JSON"),
        ("up", "not JSON"),
        ({"pose": []}, "not numbers"),
    ],
)
def test_what_is_no_pose_is_refused(value: Any, message: str) -> None:
    with pytest.raises(ActionError, match=f"^poses: .*{message}"):
        ee_poses(value, 2)


@given(JUNK, st.integers(1, 3))
def test_whatever_pose_comes_is_refused_or_valid(value: Any, num_envs: int) -> None:
    try:
        poses, moves, errors = ee_poses(value, num_envs)
    except ActionError:
        return
    assert poses.shape == (num_envs, 8)
    assert np.isfinite(poses).all()
    assert moves.shape == (num_envs,)
    assert len(errors) == num_envs


@given(POSES)
def test_slots_that_move_have_unit_quaternions_in_the_given_direction(value: np.ndarray) -> None:
    poses, moves, errors = ee_poses(value, 3)
    for given_pose, pose, moving, error in zip(value, poses, moves, errors, strict=True):
        assert moving == (error == "")
        if moving:
            assert np.isfinite(given_pose).all()
            assert np.linalg.norm(pose[3:7]) == pytest.approx(1)
            scale = np.abs(given_pose[3:7]).max()
            assert (pose[3:7] * np.sign(given_pose[3:7]) >= 0).all()
            np.testing.assert_allclose(pose[3:7] / np.abs(pose[3:7]).max(), given_pose[3:7] / scale, atol=1e-12)


# -- hold steps --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "expected"), [(3, [3, 3]), ([0, 2], [0, 2]), ("[1, 2]", [1, 2]), ("4", [4, 4]), (2.0, [2, 2])]
)
def test_hold_steps_are_one_number_or_one_a_slot(value: Any, expected: list[int]) -> None:
    steps = hold_steps(value, 2)
    assert steps.tolist() == expected
    assert np.issubdtype(steps.dtype, np.integer)


@pytest.mark.parametrize(
    "value", [-1, 1.5, [1], [1, 2, 3], [[1, 2]], np.nan, np.inf, 1e300, 2**31, None, "soon", [1, -1]]
)
def test_what_is_no_number_of_steps_is_refused(value: Any) -> None:
    with pytest.raises(ActionError, match=r"^hold_steps: .*a non-negative integer or 2 of them"):
        hold_steps(value, 2)


@given(JUNK, st.integers(1, 3))
def test_whatever_hold_steps_come_are_refused_or_valid(value: Any, num_envs: int) -> None:
    try:
        steps = hold_steps(value, num_envs)
    except ActionError:
        return
    assert steps.shape == (num_envs,)
    assert (steps >= 0).all()
