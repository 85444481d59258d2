"""What the report counts, and what it leaves out of a rate."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from vecenv_eval.episodes import Episode
from vecenv_eval.report import Summary, closing_line, markdown, sanitized_line, summarise, table, wilson
from vecenv_eval.store import Record

PLANNED = [Episode("s", task, episode) for task in range(2) for episode in range(4)]


def record(task: int, episode: int, success: bool = True, *, steps: int = 10, **fields: object) -> Record:
    values = {"instruction": "do it", "reward": float(success), **fields}
    return Record(
        suite="s",
        task=task,
        episode=episode,
        success=success,
        num_steps=steps,
        **values,  # pyright: ignore
    )


def summary(*records: Record) -> Summary:
    return summarise(records, PLANNED, suite="s", policy="p", instructions=["first | thing", "second thing"])


@given(episodes=st.integers(1, 500), data=st.data())
def test_the_interval_is_wilsons_formula(episodes: int, data: st.DataObject) -> None:
    successes = data.draw(st.integers(0, episodes))
    z, p = 1.959963984540054, successes / episodes
    centre = (p + z**2 / (2 * episodes)) / (1 + z**2 / episodes)
    half = z / (1 + z**2 / episodes) * math.sqrt(p * (1 - p) / episodes + z**2 / (4 * episodes**2))
    assert wilson(successes, episodes) == pytest.approx((centre - half, centre + half), abs=1e-9)


def test_rates_are_by_task_and_pooled() -> None:
    result = summary(record(0, 0), record(0, 1, False), record(1, 0), record(1, 1))
    assert [(row.task, row.successes, row.episodes, row.rate) for row in (*result.tasks, result.total)] == [
        (0, 1, 2, 0.5),
        (1, 2, 2, 1.0),
        ("all", 3, 4, 0.75),
    ]
    assert (result.total.low, result.total.high) == wilson(3, 4)


def test_a_faulted_episode_is_a_failure_and_is_counted() -> None:
    row = summary(record(0, 0), record(0, 1, False, fault="non-finite state")).tasks[0]
    assert (row.episodes, row.successes, row.rate, row.faults) == (2, 1, 0.5, 1)


def test_an_error_is_no_verdict_but_is_counted() -> None:
    result = summary(record(0, 0), record(0, 1, False, error="ValueError: boom"))
    row = result.tasks[0]
    assert (row.episodes, row.rate, row.errors, row.missing) == (1, 1.0, 1, 2)
    assert not result.complete


def test_episodes_that_never_ran_are_counted() -> None:
    result = summary()
    assert [row.missing for row in (*result.tasks, result.total)] == [4, 4, 8]
    assert result.total.rate is None
    assert not result.complete
    assert summary(*(record(e.task, e.episode) for e in PLANNED)).complete


def test_records_of_other_episodes_are_left_out() -> None:
    assert summary(record(0, 0), record(0, 9), record(5, 0)).total.episodes == 1


def test_steps_to_solve_are_those_of_solved_episodes() -> None:
    assert (
        summary(record(0, 0, steps=10), record(0, 1, steps=20), record(0, 2, False, steps=999)).total.steps_to_solve
        == 15
    )


def test_a_batch_lasts_until_its_last_episode_ends() -> None:
    result = summary(
        record(0, 0, steps=100, batch=0, setup_s=1.0, wall_s=2.0),
        record(0, 1, steps=300, batch=0, setup_s=1.0, wall_s=4.0),
        record(1, 0, steps=200, batch=1, setup_s=0.5, wall_s=1.0),
        record(1, 1, steps=400, batch=1, run=1, setup_s=0.5, wall_s=5.0),
    )
    assert (result.setup_s, result.wall_s, result.steps, result.steps_per_s) == (2.0, 10.0, 1000, 100.0)
    assert "1,000 control steps in 10.0 s (100 steps/s" in closing_line(result)


def printed(result: Summary, width: int = 160) -> list[list[str]]:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(table(result))
    return [line.split() for line in capture.get().splitlines()]


def test_the_table_shows_every_count() -> None:
    lines = printed(summary(record(0, 0), record(0, 1, False, fault="f"), record(1, 0, False, error="e")))
    assert ["0", "first", "|", "thing", "1/2", "50.0%", "9.5%-90.5%", "10", "1", "0", "2"] in lines
    assert ["1", "second", "thing", "0/0", "-", "-", "-", "0", "1", "3"] in lines
    assert ["all", "1/2", "50.0%", "9.5%-90.5%", "10", "1", "1", "5"] in lines


def test_the_table_of_a_healthy_run_fits_a_narrow_screen() -> None:
    everything = [record(e.task, e.episode) for e in PLANNED]
    lines = printed(summary(*everything), width=60)
    assert ["all", "8/8", "100.0%", "67.6%-100.0%", "10"] in lines
    assert "faults" not in str(lines)
    assert "(0 faulted), 0 errors, 0 not run" in closing_line(summary(*everything))


def test_the_markdown_table_keeps_its_columns() -> None:
    rows = [line for line in markdown(summary(record(0, 0))).splitlines() if line.startswith("|")]
    assert len(rows) == 5
    assert {row.count("|") for row in rows} == {10}


def test_the_summary_is_plain_json() -> None:
    assert json.loads(json.dumps(summary(record(0, 0)).to_dict()))["total"]["rate"] == 1.0


def test_what_the_policy_reports_is_averaged_or_counted() -> None:
    said = [{"calls": 2, "cause": ""}, {"calls": 4, "cause": "dropped it"}, {"calls": None, "cause": "dropped it"}]
    found = summary(*(record(0, i, extras=extras) for i, extras in enumerate(said)))
    unknown = {"calls (unknown)": {"unknown": 1}}
    assert found.extras == {"calls": 3.0, **unknown, "cause": {"dropped it": 2}}
    page = markdown(found)
    assert "- calls: 3" in page
    assert "- cause: 2 x dropped it" in page
    assert "Reported" not in markdown(summary(record(0, 0)))


def test_sanitised_actions_are_told() -> None:
    clean, changed = summary(record(0, 0)), summary(record(0, 0, sanitized=3), record(0, 1, sanitized=1), record(1, 0))
    assert (clean.sanitized, sanitized_line(clean)) == (0, "")
    assert "Sanitised" not in markdown(clean)
    assert sanitized_line(changed).startswith("Sanitised actions in 2 episodes")
    assert sanitized_line(changed) in markdown(changed)
