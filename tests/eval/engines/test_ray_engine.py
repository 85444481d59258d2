"""Episodes on Ray's actors: the same verdicts as in one process, whatever happens to actors, nodes and the driver."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from support.fakes import SUITE, FakeEnv, FakeWorld
from support.ray_cluster import ray_cluster
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.engine import EngineError
from vecenv_eval.episodes import Episode
from vecenv_eval.results import EvalResult, resume
from vecenv_eval.runner import Evaluation, evaluate
from vecenv_eval.simulator import Simulator
from vecenv_eval.store import EPISODES

ray = pytest.importorskip("ray")
pytest.importorskip("ray.cluster_utils")

from vecenv_eval.engines.ray_engine import RayEngine, connect  # noqa: E402
from vecenv_eval.engines.ray_options import RayOptions, resources, room  # noqa: E402

SLOW = "support.slow_policy:SlowPolicy"


class FatalWorld(FakeWorld):
    """Episode 3 of task 1 ends its process, as a segmentation fault would."""

    def make(self, suite: str, **arguments: Any) -> FakeEnv:
        env = super().make(suite, **arguments)
        step = env.step_continuous

        def step_or_die(actions: Any) -> Any:
            if ((env.tasks == 1) & (env.episodes == 3) & ~env.done).any():
                os._exit(1)
            return step(actions)

        env.step_continuous = step_or_die
        return env

    @property
    def simulator(self) -> Simulator:
        return dataclasses.replace(super().simulator, make=self.make)


def config_of(**settings: Any) -> EvalConfig:
    return EvalConfig(**{"suite": SUITE, "policy": "random", **settings})


def verdicts(result: EvalResult) -> list[dict[str, Any]]:
    return [record.verdict for record in result.records]


def lines(folder: Path) -> int:
    return len((folder / EPISODES).read_text().splitlines())


def local(folder: Path, world: FakeWorld, **settings: Any) -> EvalResult:
    return evaluate(config_of(**settings), folder, simulator=world.simulator)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A Ray instance with two CPUs, to which this process is connected."""
    with ray_cluster(2) as nodes:
        connect(address=nodes.address, log_to_driver=False, logging_level="ERROR")
        yield ray
        ray.shutdown()


def on_ray(folder: Path, world: FakeWorld, arguments: Mapping[str, Any] | None = None, **settings: Any) -> EvalResult:
    config = config_of(engine="ray", engine_args=dict(arguments or {}), **settings)
    return evaluate(config, folder, simulator=world.simulator)


# -- arguments ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"actrs": 2}, "did you mean actors"),
        ({"actors": 0}, "actors must be at least 1, not 0"),
        ({"actors": "many"}, "actors: Input should be a valid integer"),
        ({"gpus": 1.5}, "gpus must be a whole number or below 1, not 1.5"),
        ({"address": "ray://head:10001"}, "the Ray client cannot stream records"),
        ({"start_timeout_s": 0}, "start_timeout_s must be above 0"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Evaluation(config_of(engine="ray", engine_args=arguments), FakeWorld().simulator)


def test_a_dataset_with_one_writer_is_refused() -> None:
    with pytest.raises(ConfigError, match="leave out --record-lerobot"):
        Evaluation(config_of(engine="ray", record_lerobot=True), FakeWorld().simulator)


def test_where_nothing_answers_there_is_no_cluster_and_no_folder(tmp_path: Path) -> None:
    with pytest.raises(EngineError, match=r"no Ray cluster at 127\.0\.0\.1:1: "):
        on_ray(tmp_path / "run", FakeWorld(), {"address": "127.0.0.1:1"})
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("settings", "options", "expected"),
    [
        ({}, {}, {"CPU": 1, "GPU": 0}),
        ({"num_threads": 4}, {}, {"CPU": 4, "GPU": 0}),
        ({"num_threads": 4}, {"cpus": 2}, {"CPU": 2, "GPU": 0}),
        ({"backend": "warp"}, {}, {"CPU": 1, "GPU": 1}),
        ({"backend": "warp"}, {"gpus": 0.5}, {"CPU": 1, "GPU": 0.5}),
        ({"backend": "jax"}, {}, {"CPU": 1, "GPU": 0}),
    ],
)
def test_an_actor_takes_the_threads_and_gpus_that_its_backend_needs(
    settings: dict[str, Any], options: dict[str, Any], expected: dict[str, float]
) -> None:
    assert resources(RayOptions(**options), config_of(**settings)) == expected


def test_a_cluster_has_room_for_as_many_actors_as_fit_on_its_nodes() -> None:
    nodes = [{"CPU": 8, "GPU": 1}, {"CPU": 3}, {"CPU": 16, "GPU": 4}]
    assert room({"CPU": 2, "GPU": 0}, nodes) == 4 + 1 + 8
    assert room({"CPU": 2, "GPU": 1}, nodes) == 1 + 4
    assert room({"CPU": 1, "GPU": 0.1}, nodes) == 8 + 16
    assert room({"CPU": 32, "GPU": 0}, nodes) == 0


# -- runs --------------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("cluster")
def test_rows_are_those_of_the_local_engine(tmp_path: Path) -> None:
    here = local(tmp_path / "here", FakeWorld(faults={(2, 1): "broken"}))
    there = on_ray(tmp_path / "there", FakeWorld(faults={(2, 1): "broken"}))
    assert there.ok
    assert verdicts(there) == verdicts(here)
    assert there.summary.policy == "random"
    assert lines(there.folder) == 20  # every episode once
    assert len({record.batch for record in there.records}) > 4


@pytest.mark.usefixtures("cluster")
def test_runs_that_share_actors_give_the_same_rows_in_the_same_processes(tmp_path: Path) -> None:
    def processes(result: EvalResult) -> set[Any]:
        assert result.ok
        return {record.extras["process"] for record in result.records}

    telling = {"policy": "support.slow_policy:TellingPolicy", "arguments": {"actors": 1}}
    with RayEngine.shared():
        first = on_ray(tmp_path / "first", FakeWorld(), tasks="0-1", **telling)
        second = on_ray(tmp_path / "second", FakeWorld(faults={(2, 1): "broken"}), **telling)
        third = on_ray(tmp_path / "third", FakeWorld())  # more of them, and another policy
    alone = on_ray(tmp_path / "alone", FakeWorld(), **telling)
    assert processes(first) == processes(second)
    assert processes(alone).isdisjoint(processes(first))
    here = local(tmp_path / "here", FakeWorld(faults={(2, 1): "broken"}), policy=telling["policy"])
    assert [{**row, "extras": {}} for row in verdicts(second)] == [{**row, "extras": {}} for row in verdicts(here)]
    assert verdicts(third) == verdicts(local(tmp_path / "there", FakeWorld()))
    assert third.summary.policy == "random"


@pytest.mark.usefixtures("cluster")
def test_shared_actors_that_are_lost_are_replaced_for_the_next_run(tmp_path: Path) -> None:
    with RayEngine.shared():
        fatal = {"policy": "support.slow_policy:FatalPolicy", "tasks": "0", "episodes": "1", "retries": 0}
        broken = on_ray(tmp_path / "broken", FakeWorld(), {"actors": 1, "attempts": 1}, **fatal)
        whole = on_ray(tmp_path / "whole", FakeWorld())
    assert not broken.ok
    assert verdicts(whole) == verdicts(local(tmp_path / "here", FakeWorld()))


@pytest.mark.usefixtures("cluster")
def test_a_run_that_is_resumed_runs_only_what_is_missing(tmp_path: Path) -> None:
    done = local(tmp_path / "run", FakeWorld(), tasks="0-1")
    config, store = resume(done.folder, engine="ray", engine_args={"actors": 1})
    whole = evaluate(dataclasses.replace(config, tasks="all"), store, simulator=FakeWorld().simulator)
    assert whole.ok
    assert lines(whole.folder) == 20
    assert {record.run for record in whole.records if record.task < 2} == {0}
    assert {record.run for record in whole.records if record.task >= 2} == {1}
    config, store = resume(done.folder, engine="local")  # which takes no arguments
    assert config.engine_args == {}


@pytest.mark.usefixtures("cluster")
def test_what_a_policy_or_environment_raises_costs_the_running_episodes(tmp_path: Path) -> None:
    world = FakeWorld(raise_in={0: ValueError("the sky fell\nin pieces")})
    result = on_ray(tmp_path / "run", world, {"actors": 1}, retries=0)
    errors = {record.key for record in result.records if record.error}
    assert Episode(SUITE, 0, 1) in errors
    assert {key.task for key in errors} <= {0, 2}  # they share a scene
    assert result.causes == ("ValueError: the sky fell",)
    assert len(result.records) == 20
    assert "in pieces" in (result.folder / "errors.log").read_text()
    again = evaluate(*resume(result.folder, engine="ray", engine_args={"actors": 1}), simulator=FakeWorld().simulator)
    assert again.ok
    assert verdicts(again) == verdicts(local(tmp_path / "local", FakeWorld()))


@pytest.mark.heavy
@pytest.mark.usefixtures("cluster")
def test_a_run_of_nothing_but_errors_stops(tmp_path: Path) -> None:
    world = FakeWorld(raise_in={task: ValueError("no server") for task in range(4)})
    result = on_ray(tmp_path / "run", world, {"actors": 1, "unit": 2}, num_envs=1, tasks="1,3")
    assert result.summary.total.missing > 0
    assert result.causes == ("ValueError: no server",)


@pytest.mark.heavy
@pytest.mark.usefixtures("cluster")
def test_an_episode_that_ends_its_process_has_an_error_and_costs_no_other_its_verdict(tmp_path: Path) -> None:
    result = on_ray(tmp_path / "run", FatalWorld(), {"actors": 2, "attempts": 2}, tasks="0-1")
    errors = [record for record in result.records if record.error]
    assert [record.key for record in errors] == [Episode(SUITE, 1, 3)]
    assert "was lost: The actor died" in errors[0].error or "ActorDiedError" in errors[0].error
    assert "(2 attempts)" in errors[0].error
    assert lines(result.folder) == 10
    expected = local(tmp_path / "local", FakeWorld(), tasks="0-1")
    wanted = [
        row for row, record in zip(verdicts(expected), expected.records, strict=True) if record.key != errors[0].key
    ]
    assert [record.verdict for record in result.records if not record.error] == wanted


@pytest.mark.usefixtures("cluster")
def test_a_setting_that_the_environment_refuses_ends_the_run_without_a_folder(tmp_path: Path) -> None:
    world = FakeWorld()
    world.refuse = ValueError("no such backend")
    with pytest.raises(ConfigError, match="no such backend"):
        on_ray(tmp_path / "run", world)
    assert not (tmp_path / "run").exists()


@pytest.mark.heavy
@pytest.mark.usefixtures("cluster")
def test_a_policy_that_cannot_be_made_on_any_actor_is_named(tmp_path: Path) -> None:
    with pytest.raises(EngineError, match=r"no actor could start: .*negative seconds"):
        on_ray(tmp_path / "run", FakeWorld(), policy="support.slow_policy:FailingPolicy")
