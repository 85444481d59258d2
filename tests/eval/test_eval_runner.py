"""Running an evaluation: every verdict is kept, whatever goes wrong around it."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fakes import SUITE, FakeEnv, FakeWorld
from vecenv_eval import policies
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.drive import PolicyStuck, drive
from vecenv_eval.episodes import Episode, SpecError
from vecenv_eval.policies import PolicyError
from vecenv_eval.results import EvalResult, Progress, begin, resume
from vecenv_eval.runner import Evaluation, evaluate
from vecenv_eval.store import ResultStore, StoreError

from vecenv.contract import BatchEnv, Control, ResetInfo
from vecenv.errors import NotFound


class UnknownScene(NotFound, KeyError):
    """As vecenv raises it, unlike a bare KeyError, which is an accident."""


class Scripted:
    """Counts its resets, and does in ``act`` what the test says."""

    name = "scripted"

    def __init__(self, act: Any) -> None:
        self.infos: list[ResetInfo] = []
        self._act = act

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self.infos.append(info)

    def act(self, env: BatchEnv) -> np.ndarray | Control:
        return self._act(env)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "run"


def run(folder: Path, world: FakeWorld, progress: list[Progress] | None = None, **settings: Any) -> EvalResult:
    """A new evaluation of the fake suite."""
    config = EvalConfig(**{"suite": SUITE, "policy": "zero", **settings})
    seen = [] if progress is None else progress
    return evaluate(config, begin(config, folder), simulator=world.simulator, on_progress=seen.append)


def run_again(folder: Path, world: FakeWorld, **changes: Any) -> EvalResult:
    config, store = resume(folder, **changes)
    return evaluate(config, store, simulator=world.simulator)


def use_policy(monkeypatch: pytest.MonkeyPatch, policy: Any) -> None:
    """Make ``--policy zero`` mean this policy."""
    monkeypatch.setattr(policies, "_load", lambda name: lambda: policy)


@pytest.fixture
def in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """The policy cannot begin single slots, so episodes run in batches."""
    use_policy(monkeypatch, Scripted(lambda env: np.zeros((env.num_envs, 7))))


def test_every_episode_gets_the_environments_verdict(folder: Path) -> None:
    result = run(folder, FakeWorld())
    assert result.ok
    assert len(result.records) == 20
    for record in result.records:
        solved = record.task % 2 == 0
        assert (record.success, record.reward) == (solved, float(solved))
        assert record.num_steps == (record.episode + 2 if solved else 10)
        assert record.instruction == f"do thing {record.task}"
    assert result.summary.total.rate == 0.5


@pytest.mark.parametrize("num_envs", [1, 2, 3, 7, 10, 100])
def test_verdicts_do_not_depend_on_the_size_of_a_batch(folder: Path, num_envs: int) -> None:
    whole = run(folder, FakeWorld())
    split = run(folder.with_name("split"), FakeWorld(), num_envs=num_envs)
    assert [(r.key, r.success, r.num_steps) for r in split.records] == [
        (r.key, r.success, r.num_steps) for r in whole.records
    ]


def test_only_what_was_asked_for_runs(folder: Path) -> None:
    result = run(folder, FakeWorld(), tasks="2-3", episodes="0,4", max_steps=4)
    assert [(r.task, r.episode, r.success) for r in result.records] == [
        (2, 0, True),
        (2, 4, False),
        (3, 0, False),
        (3, 4, False),
    ]


@pytest.mark.usefixtures("in_batches")
def test_the_environment_is_placed_anew_as_long_as_slots_keep_their_scene(folder: Path) -> None:
    world = FakeWorld()
    run(folder, world, num_envs=5)
    assert [(env.placements, env.closed) for env in world.envs] == [(2, True), (2, True)]


def test_each_batch_resets_the_policy_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = Scripted(lambda env: np.zeros((env.num_envs, 7)))
    use_policy(monkeypatch, policy)
    run(folder, FakeWorld(), num_envs=5)
    assert [info.task_id[0] for info in policy.infos] == [0, 2, 1, 3]


def test_a_policy_may_act_in_chunks(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_policy(monkeypatch, Scripted(lambda env: np.zeros((env.num_envs, 4, 7))))
    assert [r.num_steps for r in run(folder, FakeWorld(), tasks="0").records] == [2, 3, 4, 5, 6]


def test_a_policy_may_step_the_environment_itself(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_policy(monkeypatch, Scripted(lambda env: env.step_ee_pose(np.zeros((env.num_envs, 8)))))
    assert run(folder, FakeWorld(), tasks="0").summary.total.successes == 5


def test_a_policy_that_takes_no_step_is_stopped() -> None:
    env = FakeEnv([0], [0])
    with pytest.raises(PolicyStuck, match="'scripted': 100 calls of act"):
        list(drive(env, Scripted(lambda env: np.zeros((1, 0, 7)))))


def test_a_faulted_episode_is_a_failure_with_its_cause(folder: Path) -> None:
    result = run(folder, FakeWorld(faults={(0, 3): "non-finite state"}))
    record = next(r for r in result.records if r.key == Episode(SUITE, 0, 3))
    assert (record.success, record.fault, record.error) == (False, "non-finite state", "")
    assert result.ok
    assert (result.summary.total.faults, result.summary.total.successes, result.summary.total.episodes) == (1, 9, 20)


class Looking(Scripted):
    """Cannot act for a batch of which no slot is live; begins single slots as well."""

    def __init__(self) -> None:
        super().__init__(self._look)

    def reset_slots(self, env: BatchEnv, info: ResetInfo, slots: np.ndarray) -> None:
        self.infos.append(info)

    def _look(self, env: BatchEnv) -> np.ndarray:
        assert not env.done.all(), "black images"
        return np.zeros((env.num_envs, 7))


@pytest.mark.parametrize("num_envs", [1, 2, 5])
@pytest.mark.parametrize("refillable", [False, True])
def test_an_episode_that_fails_in_the_reset_has_its_fault_and_the_policy_is_not_asked_for_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, num_envs: int, refillable: bool
) -> None:
    use_policy(monkeypatch, Looking() if refillable else Scripted(Looking()._look))
    # All episodes of task 0, and single ones of the others.
    faults = {(0, e): "too many contacts" for e in range(5)} | {(1, 0): "f", (2, 3): "f", (2, 4): "f"}
    result = run(folder, FakeWorld(faults=faults, faults_in_reset=True), num_envs=num_envs)
    assert (result.ok, result.causes, len(result.records)) == (True, (), 20)
    for record in result.records:
        fault = faults.get((record.task, record.episode), "")
        solved = not fault and record.task % 2 == 0
        assert (record.fault, record.error, record.success) == (fault, "", solved)
        assert record.num_steps == (0 if fault else record.episode + 2 if solved else 10)


@pytest.mark.usefixtures("in_batches")
def test_a_batch_that_raises_costs_its_unfinished_episodes_only(folder: Path) -> None:
    result = run(folder, FakeWorld(raise_in={0: ValueError("the sky fell\nin pieces")}), num_envs=5)
    errors = {r.key: r.error for r in result.records if r.error}
    assert errors == {Episode(SUITE, 0, e): "ValueError: the sky fell" for e in range(1, 5)}
    assert (result.ok, result.causes, result.interrupted) == (False, ("ValueError: the sky fell",), False)
    assert (result.summary.total.episodes, result.summary.total.errors) == (16, 4)
    assert "in pieces" in (folder / "errors.log").read_text()


@pytest.mark.usefixtures("in_batches")
def test_a_run_can_stop_at_the_first_error(folder: Path) -> None:
    result = run(folder, FakeWorld(raise_in={0: ValueError("boom")}), num_envs=5, fail_fast=True)
    assert (result.summary.total.errors, result.summary.total.missing) == (4, 15)


@pytest.mark.usefixtures("in_batches")
def test_resuming_tries_again_what_failed_and_only_that(folder: Path) -> None:
    run(folder, FakeWorld(raise_in={0: ValueError("boom")}), num_envs=5)
    world = FakeWorld()
    result = run_again(folder, world)
    assert [(list(env.tasks), list(env.episodes)) for env in world.envs] == [([0] * 4, [1, 2, 3, 4])]
    assert result.ok
    assert [r.run for r in result.records if r.task == 0] == [0, 1, 1, 1, 1]
    assert len(json.loads((folder / "config.json").read_text())["runs"]) == 2


@pytest.mark.usefixtures("in_batches")
def test_ctrl_c_keeps_what_was_computed(folder: Path) -> None:
    result = run(folder, FakeWorld(raise_in={2: KeyboardInterrupt()}), num_envs=5)
    assert result.interrupted
    assert not result.ok
    assert [r.key for r in result.records] == [*(Episode(SUITE, 0, e) for e in range(5)), Episode(SUITE, 2, 0)]
    assert json.loads((folder / "summary.json").read_text())["total"]["missing"] == 14
    assert run_again(folder, FakeWorld(), num_envs=7).ok


def test_resuming_a_complete_run_builds_nothing(folder: Path) -> None:
    first = run(folder, FakeWorld())
    world = FakeWorld()
    assert run_again(folder, world).records == first.records
    assert world.envs == []


def test_an_environment_that_places_something_else_is_an_error(folder: Path) -> None:
    world = FakeWorld()
    make = world.make
    world.make = lambda suite, *, tasks, episodes, **rest: make(suite, tasks=tasks, episodes=[0, 1], **rest)  # pyright: ignore
    result = run(folder, world)
    assert result.causes == ("RuntimeError: the environment placed 8 other episodes than the 20 asked for",)


@pytest.mark.parametrize(
    ("settings", "error", "says"),
    [
        ({"tasks": "7"}, SpecError, "no task 7"),
        ({"episodes": "6"}, SpecError, "ask for 1 to 5"),
        ({"policy": "zerro"}, PolicyError, "did you mean zero"),
        ({"env_args": {"colour": "red"}}, ConfigError, "environment arguments: .*'colour'"),
    ],
)
def test_a_config_that_makes_no_sense_is_refused_before_anything_runs(
    settings: dict[str, Any], error: type[Exception], says: str
) -> None:
    world = FakeWorld()
    with pytest.raises(error, match=says):
        Evaluation(EvalConfig(**{"suite": SUITE, "policy": "zero", **settings}), world.simulator)
    assert world.envs == []


@pytest.mark.parametrize("error", [ValueError("backend 'abacus' is unknown"), UnknownScene("no such scene")])
def test_settings_that_the_environment_refuses_are_the_configs_fault(folder: Path, error: Exception) -> None:
    world = FakeWorld()
    world.refuse = error
    with pytest.raises(ConfigError, match=f"{type(error).__name__}: .*{error.args[0]}"):
        run(folder, world)
    assert not folder.exists()


def test_an_environment_that_breaks_while_it_is_built_is_an_error_of_its_batch(folder: Path) -> None:
    world = FakeWorld()
    world.refuse = RuntimeError("out of memory")
    result = run(folder, world, num_envs=10)
    assert result.causes == ("RuntimeError: out of memory",)
    assert result.summary.total.errors == 20


@pytest.mark.usefixtures("in_batches")
def test_progress_counts_up_to_every_episode(folder: Path) -> None:
    progress: list[Progress] = []
    run(folder, FakeWorld(faults={(1, 0): "f"}), progress, num_envs=10)
    assert progress[0].setting_up
    assert [p.batch for p in progress if p.setting_up] == [0, 1]
    last = progress[-1]
    assert (last.total, last.done, last.successes, last.faults, last.errors, last.num_batches) == (20, 20, 10, 1, 0, 2)
    assert last.steps == sum(e + 2 for e in range(5)) * 2 + 10 * 9 + 1
    for before, after in pairwise(progress):
        assert before.done <= after.done
        assert before.steps <= after.steps
        assert before.seconds <= after.seconds


def test_the_folder_says_how_it_came_about(folder: Path) -> None:
    run(folder, FakeWorld(), policy="random", policy_args={"hold": 2}, tasks="0")
    content = json.loads((folder / "config.json").read_text())
    assert content["config"]["policy_args"] == {"hold": 2}
    conditions = content["runs"][0]
    assert {"python", "vecenv", "mujoco", "jax", "numpy"} <= set(conditions["versions"])
    assert conditions["machine"]["cores"] >= 1
    assert set(conditions) == {
        "started",
        "arguments",
        "commit",
        "versions",
        "machine",
        "engine",
        "num_envs",
        "num_envs_reason",
    }
    assert conditions["num_envs"] == 256
    assert "GiB of memory available" in conditions["num_envs_reason"]
    assert "| 0 | do thing 0 | 5/5 | 100.0% |" in (folder / "report.md").read_text()


def test_a_folder_of_something_else_cannot_be_resumed(tmp_path: Path) -> None:
    store = ResultStore.create(tmp_path / "other", {"config": {"colour": "red"}, "runs": []})
    with pytest.raises(StoreError, match="does not hold an evaluation"):
        resume(store.folder)
