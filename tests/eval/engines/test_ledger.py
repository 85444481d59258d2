"""Reports of other processes in a results folder: each verdict once, with what belongs to it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.fakes import SUITE, FakeWorld
from vecenv_eval.config import EvalConfig
from vecenv_eval.engines.ledger import Ledger
from vecenv_eval.engines.ray_actor import Assignment, EpisodeActor, Report
from vecenv_eval.episodes import Episode
from vecenv_eval.results import begin
from vecenv_eval.runner import Evaluation
from vecenv_eval.store import EPISODES, Record, ResultStore

cloudpickle = pytest.importorskip("cloudpickle")


def record_of(task: int, episode: int, **changes: Any) -> Record:
    plain = Record(
        suite=SUITE, task=task, episode=episode, instruction="do", success=True, num_steps=3, reward=1.0, run=0
    )
    return replace(plain, **changes)


@pytest.fixture
def evaluation() -> Evaluation:
    return Evaluation(EvalConfig(suite=SUITE, policy="random", tasks="0"), FakeWorld().simulator)


@pytest.fixture
def store(tmp_path: Path, evaluation: Evaluation) -> ResultStore:
    return begin(evaluation.config, tmp_path / "run")


def lines(store: ResultStore) -> int:
    return len((store.folder / EPISODES).read_text().splitlines())


def test_a_verdict_that_is_there_already_changes_nothing(evaluation: Evaluation, store: ResultStore) -> None:
    ledger = Ledger(store, evaluation)
    for _ in range(2):
        ledger.receive(Report(records=(record_of(0, 1), record_of(0, 2))))
    ledger.receive(Report(records=(record_of(0, 1, success=False),)))
    ledger.receive(Report(records=(record_of(0, 2, error="boom"),)))
    ledger.fail(Episode(SUITE, 0, 1), "lost", 0, 0)
    assert lines(store) == 2
    assert all(record.success and not record.error for record in store.records().values())
    assert [key.episode for key in ledger.missing] == [0, 3, 4]
    again = Ledger(store, evaluation)  # as after a restart
    again.receive(Report(records=(record_of(0, 1),)))
    assert lines(store) == 2


def test_an_error_gives_way_to_a_verdict_and_names_its_cause(evaluation: Evaluation, store: ResultStore) -> None:
    ledger = Ledger(store, evaluation)
    ledger.receive(Report(records=(record_of(0, 1, error="boom"),), error="Traceback: boom"))
    ledger.fail(Episode(SUITE, 0, 2), "lost (3 attempts)", 0, 4)
    assert (ledger.verdicts, ledger.error_batches) == (0, 2)
    assert list(ledger.causes) == ["boom", "lost (3 attempts)"]
    assert len(ledger.missing) == 5
    ledger.receive(Report(records=(record_of(0, 1),)))
    assert store.records()[Episode(SUITE, 0, 1)].error == ""
    assert ledger.counts == {"total": 5, "done": 1, "successes": 1, "faults": 0, "errors": 1}
    assert "Traceback: boom" in (store.folder / "errors.log").read_text()


def test_videos_of_the_first_verdict_stay(evaluation: Evaluation, store: ResultStore) -> None:
    ledger = Ledger(store, evaluation)
    ledger.receive(Report(records=(record_of(0, 1),), files={"videos/a.mp4": b"first"}))
    ledger.receive(Report(records=(record_of(0, 1),), files={"videos/a.mp4": b"second"}))
    assert (store.folder / "videos" / "a.mp4").read_bytes() == b"first"
    assert [path.name for path in (store.folder / "videos").iterdir()] == ["a.mp4"]


def test_an_actor_reports_what_the_local_engine_writes(evaluation: Evaluation, store: ResultStore) -> None:
    given = Assignment(
        config=evaluation.config, suite=evaluation.suite, simulator=evaluation.simulator, policy_seed=0, index=0
    )
    actor = EpisodeActor(cloudpickle.dumps(given), [])
    assert actor.prepare().policy == "random"
    ledger = Ledger(store, evaluation)
    units = [[Episode(SUITE, 0, e) for e in some] for some in ((0, 1, 2), (3, 4))]
    steps = []
    for number, unit in enumerate(units):
        for report in actor.run(number, unit):
            ledger.receive(report)
            steps.append(report.steps)
    actor.close()
    assert ledger.missing == []
    assert steps[-1] == 2 + 3 + 4 + 5 + 6
    assert "conditions" in store.config()
    expected = evaluation.run(begin(evaluation.config, store.folder.with_name("local")))
    records = store.records()
    assert [records[key].verdict for key in evaluation.planned] == [record.verdict for record in expected.records]
    assert [records[key].batch for key in evaluation.planned] == [0, 0, 0, 1, 1]


def test_an_actor_that_is_closed_stops_what_runs(evaluation: Evaluation) -> None:
    slow = replace(evaluation.config, policy="support.slow_policy:SlowPolicy", policy_args={"seconds": 0.2})
    given = Assignment(config=slow, suite=evaluation.suite, simulator=evaluation.simulator, policy_seed=0, index=0)
    actor = EpisodeActor(cloudpickle.dumps(given), [])
    actor.prepare()
    reports = actor.run(0, evaluation.planned)
    next(reports)  # it has begun
    actor.close()
    assert [record for report in reports for record in report.records] == []
