"""Which task and episode sits in which slot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vecenv.placement import (
    Placement,
    PlacementError,
    SpecError,
    cross,
    each,
    episode_indices,
    parse_tasks,
    task_indices,
)

SIZES = {"num_tasks": 10, "num_episodes": 50}


def pairs(placement: Placement) -> list[tuple[int, int]]:
    return list(zip(placement.task.tolist(), placement.episode.tolist(), strict=True))


# -- cross -------------------------------------------------------------------------------------------------------------


def test_every_episode_of_every_task_task_by_task() -> None:
    assert pairs(cross([3, 1], range(2), **SIZES)) == [(3, 0), (3, 1), (1, 0), (1, 1)]


@pytest.mark.parametrize("tasks", [4, np.int64(4), [4], (4,), np.array([4]), range(4, 5), {4}, iter([4])])
def test_one_index_or_any_sequence_of_them(tasks: Any) -> None:
    assert pairs(cross(tasks, [7], **SIZES)) == [(4, 7)]


def test_episodes_may_differ_by_task() -> None:
    placement = cross([0, 2, 5], {0: [1, 2], 5: [3]}, **SIZES)
    assert pairs(placement) == [(0, 1), (0, 2), (5, 3)]
    assert len(placement) == 3


@pytest.mark.parametrize(
    ("spec", "episodes"),
    [
        (None, range(50)),
        ("all", range(50)),
        ("3", range(3)),
        ("5,", [5]),
        ("5-5", [5]),
        ("0,3,5-7", [0, 3, 5, 6, 7]),
        ([5], [5]),
        (np.array([5, 1]), [5, 1]),
        ({2: "2"}, [0, 1]),
    ],
)
def test_episodes_are_named_as_in_an_evaluation(spec: Any, episodes: Any) -> None:
    assert pairs(cross([2], spec, **SIZES)) == [(2, episode) for episode in episodes]


def test_all_episodes_are_those_of_the_protocol_while_others_may_be_named() -> None:
    assert episode_indices("all", 50, every=10) == tuple(range(10))
    assert episode_indices(None, 50, every=10) == tuple(range(10))
    assert episode_indices("12", 50, every=10) == tuple(range(12))


def test_tasks_may_have_different_numbers_of_episodes() -> None:
    counts = {0: 2, 2: 3}
    assert pairs(cross([0, 2], "all", num_tasks=3, num_episodes=counts)) == [(0, 0), (0, 1), (2, 0), (2, 1), (2, 2)]
    with pytest.raises(PlacementError, match=r"episode 2 does not exist; there are 2"):
        cross([0, 2], [2], num_tasks=3, num_episodes=counts)
    with pytest.raises(PlacementError, match="no slot to fill"):
        cross([1], "all", num_tasks=3, num_episodes=counts)


def test_a_whole_suite_is_five_hundred_slots() -> None:
    placement = cross(range(10), range(50), **SIZES)
    assert len(placement) == 500
    assert len(set(pairs(placement))) == 500


@pytest.mark.parametrize(
    ("tasks", "episodes", "message"),
    [
        (10, 0, r"task 10 does not exist; there are 10 \(0 to 9\)"),
        (-1, 0, "task -1 does not exist"),
        (0, [50], r"episode 50 does not exist; there are 50 \(0 to 49\)"),
        ([0, 1], {0: [0], 1: [99]}, "episode 99"),
        ([], 0, "no slot to fill"),
        (0, [], "no slot to fill"),
        (0, 3, r"write \[3\] for episode 3 alone, or '3' for the first 3$"),
        (0, np.int64(0), r"episodes=0: a bare number used to mean one episode.*write \[0\] for episode 0 alone$"),
        (0, {0: 3}, r"write \[3\]"),
        (0, "51", "ask for 1 to 50"),
        (0, "0,x", "cannot read 'x' as episodes"),
        (0, {1: [0]}, "episodes: 1 is none of the tasks, 0"),
        (0, {0: []}, "no slot to fill"),
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


# -- tasks by name -----------------------------------------------------------------------------------------------------

NAMES = ("open_the_top_drawer", "open_the_middle_drawer", "put_the_bowl_on_the_plate", "SCENE1_open_the_top_drawer")


@pytest.mark.parametrize(
    ("tasks", "indices"),
    [
        (None, (0, 1, 2, 3)),
        ("all", (0, 1, 2, 3)),
        ("open_the_top_drawer", (0,)),
        ("bowl", (2,)),
        ("Bowl on the  plate", (2,)),
        ("scene1", (3,)),
        ("middle, 0", (1, 0)),
        ("1-2", (1, 2)),
        (["bowl", 3], (2, 3)),
        (np.array([3, 3]), (3, 3)),
        (2, (2,)),
    ],
)
def test_tasks_are_named_by_index_or_name_or_a_part_that_only_one_has(tasks: Any, indices: tuple[int, ...]) -> None:
    assert task_indices(tasks, NAMES) == indices


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        ("drawer", "'drawer' fits 3: open_the_top_drawer, open_the_middle_drawer, SCENE1_open_the_top_drawer; write"),
        ("put_the_bowl_on_the_plat3", "did you mean put_the_bowl_on_the_plate"),
        ("zebra", "did you mean open_the_top_drawer, open_the_middle_drawer, put_the_bowl_on_the_plate, SCENE1"),
        (["bowl", "zebra"], "cannot read 'zebra'"),
        ("4", "there is no task 4: the last one is 3"),
        (4, r"task 4 does not exist; there are 4 \(0 to 3\)"),
        (1.5, "1.5 is not an integer"),
        ({0: 1}, "is not an integer"),
    ],
)
def test_tasks_that_do_not_exist_or_are_not_the_only_one_are_refused(tasks: Any, message: str) -> None:
    with pytest.raises(PlacementError, match=message):
        task_indices(tasks, NAMES)


def test_a_long_list_of_names_is_cut_short() -> None:
    with pytest.raises(PlacementError, match=r"fits 90: .*, \.\.\. \(78 more\); write"):
        task_indices("task", [f"task_{i}" for i in range(90)])


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
        ("abc", None, "task: 'abc' is not an integer"),
        ({3, 1, 2}, None, "a set, which has no order"),
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


def test_patterns_name_every_task_that_matches() -> None:
    names = ("pick_the_cup", "open_the_drawer", "pick_the_bowl")
    assert parse_tasks("pick*", 3, names) == (0, 2)
    assert parse_tasks("*drawer, 0", 3, names) == (1, 0)
    with pytest.raises(SpecError, match="no task matches 'close\\*'"):
        parse_tasks("close*", 3, names)
