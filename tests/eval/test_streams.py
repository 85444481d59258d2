"""Slots that take the next episode as soon as theirs has ended, and verdicts that do not notice."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.fakes import SUITE, FakeEnv, FakeWorld
from vecenv_eval import policies
from vecenv_eval.config import EvalConfig
from vecenv_eval.episodes import MAX_SCENES, Episode, Stream, Suite, streams
from vecenv_eval.results import EvalResult, begin, resume
from vecenv_eval.runner import evaluate
from vecenv_eval.store import Record, ResultStore

from vecenv.contract import BatchEnv, ResetInfo


class Holding:
    """Holds still, begins single slots, and writes down which."""

    name = "holding"

    def __init__(self) -> None:
        self.begun: list[tuple[int, ...]] = []
        self.ended: list[tuple[int, dict[str, Any]]] = []

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self.begun.append(tuple(range(env.num_envs)))

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        self.begun.append(tuple(slots.tolist()))

    def episode_end(self, slot: int, record: dict[str, Any]) -> None:
        self.ended.append((slot, record))

    def act(self, env: BatchEnv) -> np.ndarray:
        return np.zeros((env.num_envs, 7))


def run(folder: Path, world: FakeWorld, **settings: Any) -> EvalResult:
    config = EvalConfig(**{"suite": SUITE, "policy": "zero", **settings})
    return evaluate(config, begin(config, folder), simulator=world.simulator)


def verdicts(records: tuple[Record, ...]) -> list[dict[str, Any]]:
    return [record.verdict for record in sorted(records, key=lambda record: record.key)]


# -- plans -------------------------------------------------------------------------------------------------------------


@given(
    num_envs=st.integers(1, 40),
    scenes=st.lists(st.integers(0, 3), min_size=1, max_size=9),
    counts=st.integers(1, 7),
    done=st.sets(st.tuples(st.integers(0, 8), st.integers(0, 6))),
)
def test_streams_hold_every_episode_once_within_their_slots(
    num_envs: int, scenes: list[int], counts: int, done: set[tuple[int, int]]
) -> None:
    suite = Suite("s", ("do",) * len(scenes), tuple(scenes), counts)
    episodes = {task: range(counts) for task in range(len(scenes))}
    finished = {Episode("s", task, episode) for task, episode in done}
    made = streams(suite, range(len(scenes)), episodes, num_envs=num_envs, done=finished)
    every = [episode for stream in made for episode in stream.episodes]
    wanted = {Episode("s", task, e) for task in episodes for e in range(counts)} - finished
    assert Counter(every) == Counter(wanted)
    for stream in made:
        assert 1 <= len(stream.first) <= num_envs
        used = {suite.scenes[episode.task] for episode in stream.first}
        assert len(used) <= MAX_SCENES
        assert set(stream.waiting) <= used  # every scene that has more to do has a slot
        if len(stream.first) < num_envs:
            assert not any(stream.waiting.values())


# -- runs --------------------------------------------------------------------------------------------------------------


def test_a_slot_takes_the_next_episode_of_its_scene_at_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, world = Holding(), FakeWorld()
    monkeypatch.setattr(policies, "_load", lambda name: lambda: policy)
    result = run(folder, world, tasks="0", num_envs=2)
    # Episodes 0 to 4 take 2 to 6 ticks: slot 0 runs 0, 2 and 4 after another, slot 1 runs 1 and 3.
    assert policy.begun == [(0, 1), (0,), (1,), (0,)]
    assert [(slot, record["episode"]) for slot, record in policy.ended] == [(0, 0), (1, 1), (0, 2), (1, 3), (0, 4)]
    assert [env.placements for env in world.envs] == [1]
    assert [record.num_steps for record in result.records] == [2, 3, 4, 5, 6]


def test_slots_without_another_episode_stay_where_they_are_while_others_are_refilled(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reset, tick, moved = FakeEnv.reset, FakeEnv._tick, []

    def restarting(self: FakeEnv) -> ResetInfo:
        """As the contract says: every finished slot begins its episode again."""
        self.ticks[self.done] = 0
        self.terminated[:], self.truncated[:] = False, False
        return reset(self)

    def counting(self: FakeEnv) -> None:
        moved.append(int((~self.done).sum()))
        tick(self)

    monkeypatch.setattr(FakeEnv, "reset", restarting)
    monkeypatch.setattr(FakeEnv, "_tick", counting)
    steps: list[int] = []
    config = EvalConfig(suite=SUITE, policy="zero", num_envs=4)
    # Scene kitchen (tasks 0 and 2) has run out long before scene study, whose episodes take their whole budget.
    result = evaluate(
        config, begin(config, folder), simulator=FakeWorld().simulator, on_progress=lambda p: steps.append(p.steps)
    )
    assert sum(moved) == sum(record.num_steps for record in result.records) == steps[-1]
    assert steps == sorted(steps)


@pytest.mark.parametrize("num_envs", [1, 2, 3, 7, 10, 100])
def test_rows_are_the_same_at_any_number_of_slots(folder: Path, num_envs: int) -> None:
    whole = run(folder, FakeWorld(faults={(2, 1): "broken"}), policy="random")
    split = run(folder.with_name("split"), FakeWorld(faults={(2, 1): "broken"}), policy="random", num_envs=num_envs)
    assert verdicts(split.records) == verdicts(whole.records)


def test_an_exception_costs_the_episodes_that_were_running(folder: Path) -> None:
    # Task 0 raises in its third tick: the two slots of its scene are running then, and the next two, and so on.
    result = run(folder, FakeWorld(raise_in={0: ValueError("the sky fell\nin pieces")}), num_envs=2)
    errors = {record.key for record in result.records if record.error}
    assert Episode(SUITE, 0, 1) in errors
    assert Episode(SUITE, 0, 0) not in errors
    assert {key.task for key in errors} <= {0, 1, 2, 3}
    assert len(result.records) == 20
    assert (result.ok, result.causes) == (False, ("ValueError: the sky fell",))
    again = evaluate(*resume(folder), simulator=FakeWorld().simulator)
    assert again.ok


def test_actions_that_were_sanitized_are_counted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = FakeEnv.step_continuous

    def sanitizing(self: FakeEnv, actions: Any) -> Any:
        control = step(self, actions)
        control.info["sanitized"][:] = (self.ticks >= 2) & (self.ticks <= 3)
        return control

    monkeypatch.setattr(FakeEnv, "step_continuous", sanitizing)
    result = run(folder, FakeWorld(), tasks="1", num_envs=2)
    assert {(record.sanitized, record.sanitized_first) for record in result.records} == {(2, 1)}


def test_seconds_of_all_episodes_add_up_to_less_than_the_run(folder: Path) -> None:
    result = run(folder, FakeWorld(), num_envs=3)
    spent = sum(record.policy_s + record.physics_s + record.images_s for record in result.records)
    assert 0 < spent <= max(record.wall_s + record.setup_s for record in result.records) * len(result.records)


def test_a_stream_of_a_batch_has_nothing_waiting() -> None:
    assert Stream("s", (Episode("s", 0, 0),)).episodes == (Episode("s", 0, 0),)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "run"


def test_records_of_a_store_have_the_same_verdicts(folder: Path) -> None:
    result = run(folder, FakeWorld(), num_envs=4)
    stored = ResultStore.open(folder).records()
    assert verdicts(tuple(stored.values())) == verdicts(result.records)


def test_slots_for_which_nothing_waits_stay_where_their_episode_ended(tmp_path: Path) -> None:
    """A reset begins the episodes of all finished slots again; the harness must not run them a second time."""
    ticks: list[int] = []
    world = FakeWorld()
    config = EvalConfig(suite=SUITE, policy="zero", tasks="0-1", episodes="5", num_envs=5, max_steps=10)
    result = evaluate(
        config,
        begin(config, tmp_path / "r"),
        on_progress=lambda now: ticks.append(now.steps),
        simulator=world.simulator,
    )
    assert result.ok
    assert ticks == sorted(ticks)
    # The slots of task 0 have nothing left to run while those of task 1 begin other episodes.
    assert ticks[-1] == sum(record.num_steps for record in result.records) == 2 + 3 + 4 + 5 + 6 + 5 * 10
