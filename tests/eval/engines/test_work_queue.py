"""Which episodes a worker gets next."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st
from vecenv_eval.engines.work import WorkQueue
from vecenv_eval.episodes import Episode, Suite


def suite_of(scenes: list[int]) -> Suite:
    return Suite("s", ("do",) * len(scenes), tuple(scenes), 100)


def episodes_of(suite: Suite, counts: list[int]) -> list[Episode]:
    return [Episode("s", task, e) for task, count in enumerate(counts) for e in range(count)]


def queue_of(counts: list[int], **settings: object) -> WorkQueue:
    """One scene a task."""
    suite = suite_of(list(range(len(counts))))
    return WorkQueue(suite, episodes_of(suite, counts), **{"workers": 2, **settings})  # pyright: ignore[reportArgumentType]


@given(
    tasks=st.lists(st.tuples(st.integers(0, 2), st.integers(0, 12)), min_size=1, max_size=6),
    workers=st.integers(1, 9),
    unit=st.none() | st.integers(1, 20),
    shrink=st.booleans(),
)
def test_units_are_of_one_scene_and_together_every_episode_once(
    tasks: list[tuple[int, int]], workers: int, unit: int | None, shrink: bool
) -> None:
    suite = suite_of([scene for scene, _ in tasks])
    wanted = episodes_of(suite, [count for _, count in tasks])
    queue = WorkQueue(suite, wanted, workers=workers, unit=unit, shrink=shrink)
    taken: list[Episode] = []
    scene = None
    while len(queue):
        waiting = len(queue)
        some = queue.take(scene)
        assert 1 <= len(some) <= (unit or waiting)
        assert len({queue.scene_of(episode) for episode in some}) == 1
        assert len(queue) == waiting - len(some)
        scene = queue.scene_of(some[0])
        taken += some
    assert Counter(taken) == Counter(wanted)
    assert queue.take(scene) == ()


def test_a_worker_stays_with_its_scene_while_it_lasts() -> None:
    queue = queue_of([3, 50], unit=2)
    assert [e.task for e in queue.take(0)] == [0, 0]
    assert [e.task for e in queue.take(0)] == [0]
    assert [e.task for e in queue.take(0)] == [1, 1]


def test_workers_begin_with_different_scenes() -> None:
    queue = queue_of([8, 10, 9], unit=1)
    held: list[int] = []
    for _ in range(3):
        held.append(queue.take(None, held)[0].task)
    assert sorted(held) == [0, 1, 2]


def test_an_idle_worker_takes_part_of_what_another_scene_still_has() -> None:
    queue = queue_of([20, 1])
    assert queue.take(None, [0])[0].task == 0  # 10 a worker of scene 0, more than the one of scene 1
    last = queue_of([20])
    assert 0 < len(last.take(7, [0])) < 20


def test_units_shrink_to_single_episodes_so_that_workers_finish_together() -> None:
    queue, sizes = queue_of([64], workers=4), []
    while len(queue):
        sizes.append(len(queue.take(0)))
    assert sizes[0] == 8
    assert sizes[-4:] == [1, 1, 1, 1]
    assert sizes == sorted(sizes, reverse=True)


def test_units_keep_their_size_where_an_environment_is_expensive() -> None:
    queue, sizes = queue_of([50], workers=4, shrink=False), []
    while len(queue):
        sizes.append(len(queue.take(0)))
    assert set(sizes) == {6, 7}


def test_what_is_put_back_comes_first_and_what_is_set_aside_comes_alone() -> None:
    queue = queue_of([6], unit=3)
    first = queue.take(0)
    queue.put_alone(first[0])
    queue.put_back(first[1:])
    assert len(queue) == 6
    assert queue.take(0) == (*first[1:], Episode("s", 0, 3))
    assert queue.take(0) == (Episode("s", 0, 4), Episode("s", 0, 5))
    assert queue.take(0) == (first[0],)


@pytest.mark.parametrize("unit", [None, 4])
def test_the_number_of_units_left_is_about_right(unit: int | None) -> None:
    queue, taken = queue_of([12, 8], unit=unit), 0
    expected = queue.units
    while len(queue):
        queue.take(None)
        taken += 1
    assert expected <= taken <= 3 * expected
