"""Which episodes run, and in which batches."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from vecenv_eval.episodes import Batch, Episode, SpecError, Suite, parse_episodes, parse_tasks, plan


def suite(scenes: str = "aabb", num_episodes: int = 5) -> Suite:
    return Suite("s", tuple(f"task {i}" for i in range(len(scenes))), tuple(scenes), num_episodes)


@pytest.mark.parametrize(
    ("spec", "tasks"),
    [("all", (0, 1, 2, 3)), ("2", (2,)), ("0,3", (0, 3)), ("3, 1-2", (3, 1, 2)), ("1-1", (1,)), ("1,1,0-1", (1, 0))],
)
def test_task_specs_name_indices_and_ranges_in_the_order_given(spec: str, tasks: tuple[int, ...]) -> None:
    assert parse_tasks(spec, 4) == tasks


@pytest.mark.parametrize(
    ("spec", "episodes"),
    [("all", tuple(range(50))), ("3", (0, 1, 2)), ("5-5", (5,)), ("5,", (5,)), ("0,7-8", (0, 7, 8))],
)
def test_a_bare_number_of_episodes_is_a_count(spec: str, episodes: tuple[int, ...]) -> None:
    assert parse_episodes(spec, 50) == episodes


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ("4", "there is no task 4: the last one is 3"),
        ("2-9", "there is no task 9"),
        ("3-1", "runs backwards"),
        ("x", "cannot read 'x' as tasks"),
        ("-1", "cannot read '-1'"),
        ("1-", "cannot read '1-'"),
        ("1-2-3", "cannot read '1-2-3'"),
        ("", "no task named"),
        (",", "no task named"),
    ],
)
def test_task_specs_that_make_no_sense_say_why(spec: str, says: str) -> None:
    with pytest.raises(SpecError, match=says):
        parse_tasks(spec, 4)


@pytest.mark.parametrize("spec", ["0", "51"])
def test_a_count_of_episodes_must_be_one_the_task_has(spec: str) -> None:
    with pytest.raises(SpecError, match="ask for 1 to 50"):
        parse_episodes(spec, 50)


def test_episode_ids_survive_suites_with_slashes() -> None:
    assert Episode.from_id("simpler/bridge/2/13") == Episode("simpler/bridge", 2, 13)
    assert Episode.from_id(Episode("simpler/bridge", 2, 13).id) == Episode("simpler/bridge", 2, 13)


def test_a_batch_is_a_rectangle_with_tasks_slowest() -> None:
    batch = Batch("s", (4, 2), (0, 1))
    assert [(slot.task, slot.episode) for slot in batch.slots] == [(4, 0), (4, 1), (2, 0), (2, 1)]
    assert len(batch) == 4


def test_everything_fits_one_batch_when_it_may() -> None:
    assert plan(suite(), range(4), range(5), num_envs=20) == [Batch("s", (0, 1, 2, 3), (0, 1, 2, 3, 4))]


def test_tasks_that_share_a_scene_sit_together() -> None:
    batches = plan(suite("abab"), range(4), range(5), num_envs=10)
    assert [batch.tasks for batch in batches] == [(0, 2), (1, 3)]


def test_a_task_with_more_episodes_than_slots_is_split_evenly() -> None:
    batches = plan(suite("a", 50), [0], range(50), num_envs=32)
    assert [len(batch) for batch in batches] == [25, 25]


def test_what_is_done_is_left_out_and_equal_gaps_stay_together() -> None:
    done = {Episode("s", 1, 3), Episode("s", 2, 3), *(Episode("s", 3, e) for e in range(5))}
    batches = plan(suite("aaaa"), range(4), range(5), num_envs=100, done=done)
    assert batches == [Batch("s", (0,), (0, 1, 2, 3, 4)), Batch("s", (1, 2), (0, 1, 2, 4))]


def test_nothing_is_planned_when_everything_is_done() -> None:
    done = {Episode("s", 0, e) for e in range(5)}
    assert plan(suite(), [0], range(5), num_envs=8, done=done) == []


def test_a_batch_needs_a_slot() -> None:
    with pytest.raises(SpecError, match="num_envs must be at least 1"):
        plan(suite(), [0], range(5), num_envs=0)


@given(data=st.data())
def test_every_plan_covers_each_missing_episode_once_within_the_slots(data: st.DataObject) -> None:
    s = suite(data.draw(st.text("abc", min_size=1, max_size=8)), 12)
    tasks = data.draw(st.permutations(range(len(s.scenes))))
    episodes = data.draw(st.lists(st.integers(0, 11), min_size=1, unique=True))
    num_envs = data.draw(st.integers(1, 40))
    everything = [Episode("s", t, e) for t in tasks for e in episodes]
    done = data.draw(st.sets(st.sampled_from(everything)))
    batches = plan(s, tasks, episodes, num_envs=num_envs, done=done)
    placed = [slot for batch in batches for slot in batch.slots]
    assert sorted(placed) == sorted(set(everything) - done)
    assert all(0 < len(batch) <= num_envs for batch in batches)


def test_tasks_may_be_asked_for_by_name() -> None:
    names = ("stack_cube", "open_drawer", "0-1")
    assert parse_tasks("open_drawer, 0", 3, names) == (1, 0)
    assert parse_tasks("0-1", 3, names) == (2,)
    assert parse_tasks("stack", 3, names) == (0,)
    with pytest.raises(SpecError, match=r"cannot read 'stack_cubs' as tasks.*did you mean stack_cube"):
        parse_tasks("stack_cubs", 3, names)
