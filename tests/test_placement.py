"""Which task and episode sits in which slot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vecenv.placement import Placement, PlacementError, cross, each

SIZES = {"num_tasks": 10, "num_episodes": 50}


def pairs(placement: Placement) -> list[tuple[int, int]]:
    return list(zip(placement.task.tolist(), placement.episode.tolist(), strict=True))


# -- cross -------------------------------------------------------------------------------------------------------------


def test_every_episode_of_every_task_task_by_task() -> None:
    assert pairs(cross([3, 1], range(2), **SIZES)) == [(3, 0), (3, 1), (1, 0), (1, 1)]


@pytest.mark.parametrize("tasks", [4, np.int64(4), [4], (4,), np.array([4]), range(4, 5), {4}, iter([4])])
def test_one_index_or_any_sequence_of_them(tasks: Any) -> None:
    assert pairs(cross(tasks, 7, **SIZES)) == [(4, 7)]


def test_episodes_may_differ_by_task() -> None:
    placement = cross([0, 2, 5], {0: [1, 2], 5: 3}, **SIZES)
    assert pairs(placement) == [(0, 1), (0, 2), (5, 3)]
    assert len(placement) == 3


def test_a_whole_suite_is_five_hundred_slots() -> None:
    placement = cross(range(10), range(50), **SIZES)
    assert len(placement) == 500
    assert len(set(pairs(placement))) == 500


@pytest.mark.parametrize(
    ("tasks", "episodes", "message"),
    [
        (10, 0, r"task 10 does not exist; there are 10 \(0 to 9\)"),
        (-1, 0, "task -1 does not exist"),
        (0, 50, r"episode 50 does not exist; there are 50 \(0 to 49\)"),
        ([0, 1], {0: 0, 1: 99}, "episode 99"),
        ([], 0, "no slot to fill"),
        (0, [], "no slot to fill"),
        (0, {1: [0]}, "no slot to fill"),
        ("0", 0, "task: '0' is not an integer"),
        (0.0, 0, "task: 0.0 is not an integer"),
        (True, 0, "task: True is not an integer"),
        ({0: 1}, 0, "task: {0: 1} is not an integer"),
        (None, 0, "task: None is not an integer"),
        (0, [[1], [2, 3]], r"episode: \[1\] is not an integer"),
        (0, np.zeros((2, 2), int), "episode: .* is not an integer"),
        (0, np.array([0.5]), "episode: .*0.5.* is not an integer"),
    ],
)
def test_what_cannot_be_placed_is_refused(tasks: Any, episodes: Any, message: str) -> None:
    with pytest.raises(PlacementError, match=message):
        cross(tasks, episodes, **SIZES)


# -- each --------------------------------------------------------------------------------------------------------------

CURRENT = Placement(np.array([1, 2, 3]), np.array([10, 20, 30]))


@pytest.mark.parametrize(
    ("tasks", "episodes", "expected"),
    [
        (None, None, [(1, 10), (2, 20), (3, 30)]),
        ([7, 8, 9], None, [(7, 10), (8, 20), (9, 30)]),
        (None, [4, 5, 6], [(1, 4), (2, 5), (3, 6)]),
        (0, [4, 5, 6], [(0, 4), (0, 5), (0, 6)]),
        ([5], 49, [(5, 49)] * 3),
    ],
)
def test_each_slot_gets_its_own_a_single_number_goes_to_all_and_none_keeps(
    tasks: Any, episodes: Any, expected: list[tuple[int, int]]
) -> None:
    assert pairs(each(tasks, episodes, CURRENT, **SIZES)) == expected
    assert pairs(CURRENT) == [(1, 10), (2, 20), (3, 30)]


@pytest.mark.parametrize(
    ("tasks", "episodes", "message"),
    [
        ([1, 2], None, "2 tasks for 3 slots"),
        (None, [1, 2, 3, 4], "4 episodes for 3 slots"),
        (None, [], "0 episodes for 3 slots"),
        ([0, 0, 10], None, "task 10 does not exist"),
        (None, -1, "episode -1 does not exist"),
        ("abc", None, "task: 'a' is not an integer"),
        (None, {1: 2}, "episode: {1: 2} is not an integer"),
    ],
)
def test_what_does_not_fit_the_slots_is_refused(tasks: Any, episodes: Any, message: str) -> None:
    with pytest.raises(PlacementError, match=message):
        each(tasks, episodes, CURRENT, **SIZES)


# -- placement ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("task", "episode"), [([], []), ([1], [1, 2]), (np.zeros((1, 1), int), np.zeros((1, 1), int))])
def test_a_placement_has_one_task_and_one_episode_a_slot(task: Any, episode: Any) -> None:
    with pytest.raises(PlacementError, match="at least one slot"):
        Placement(np.asarray(task), np.asarray(episode))


ANYTHING = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3)
NESTED = ANYTHING | st.lists(ANYTHING | st.lists(ANYTHING, max_size=3), max_size=4)


@given(NESTED, NESTED | st.dictionaries(st.integers(0, 9), NESTED, max_size=3))
def test_whatever_comes_is_refused_or_within_range(tasks: Any, episodes: Any) -> None:
    for place in (lambda: cross(tasks, episodes, **SIZES), lambda: each(tasks, episodes, CURRENT, **SIZES)):
        try:
            placement = place()
        except PlacementError:
            continue
        assert ((placement.task >= 0) & (placement.task < 10)).all()
        assert ((placement.episode >= 0) & (placement.episode < 50)).all()
        assert np.issubdtype(placement.task.dtype, np.integer)
