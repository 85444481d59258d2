"""Shards in jobs of submitit: the same verdicts as in one process, whatever happens to jobs and to the driver."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support import fake_slurm
from support.fakes import SUITE, FakeWorld
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.results import EvalResult, Progress, open_or_begin, resume
from vecenv_eval.runner import Evaluation, evaluate
from vecenv_eval.store import EPISODES
from vecenv_eval.store.lock import LOCK

pytest.importorskip("submitit")

SLOW = "support.slow_policy:SlowPolicy"
LOCAL = {"executor": "local", "shards": 2, "poll_s": 0.1}


def config_of(**settings: Any) -> EvalConfig:
    return EvalConfig(**{"suite": SUITE, "policy": "random", "engine": "submitit", "engine_args": LOCAL, **settings})


def run(folder: Path, on_progress: Callable[[Progress], None] = lambda progress: None, **settings: Any) -> EvalResult:
    config = config_of(**settings)
    return evaluate(config, open_or_begin(config, folder), simulator=FakeWorld().simulator, on_progress=on_progress)


def local(folder: Path, **settings: Any) -> EvalResult:
    return run(folder, **{"engine": "local", "engine_args": {}, **settings})


def verdicts(result: EvalResult) -> list[dict[str, Any]]:
    return [record.verdict for record in result.records]


def lines(folder: Path) -> int:
    path = folder / EPISODES
    return len(path.read_text().splitlines()) if path.exists() else 0


def writer_of(folder: Path) -> int:
    """The process that writes a results folder, as it says in its lock; 0 before there is one."""
    path = folder / LOCK
    match = re.match(r"process (\d+) on ", path.read_text()) if path.exists() else None
    return int(match[1]) if match else 0


class Signals:
    """Sends a signal to the job of a shard as soon as that has written some rows; may be called as ``on_progress``."""

    def __init__(self, shard: Path, number: int, rows: int = 2) -> None:
        self._shard, self._number, self._rows = shard, number, rows
        self.sent_to = 0

    def __call__(self, progress: Progress) -> None:
        if not self.sent_to and lines(self._shard) >= self._rows:
            self.sent_to = writer_of(self._shard)
            os.kill(self.sent_to, self._number)


@pytest.fixture(autouse=True)
def _modules_for_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs find the modules of these tests, and this clone's code, where this process finds them."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"shards": 0}, "shards must be at least 1, not 0"),
        ({"shards": 2, "executor": "pbs"}, "executor='pbs': expected one of auto, slurm, local, debug"),
        (
            {"shards": 2, "partitoin": "x"},
            "unknown argument of engine 'submitit' 'partitoin': did you mean .*partition",
        ),
        ({"shards": 2, "poll_s": 0}, "poll_s must be above 0"),
        ({"shards": 2, "nodes": 2}, "nodes=2: a shard is one task on one node"),
        ({"shards": 2, "attempts": 0}, "attempts must be at least 1"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Evaluation(config_of(engine_args=arguments), FakeWorld().simulator)


def test_a_shard_of_shards_is_refused() -> None:
    with pytest.raises(ConfigError, match="leave out --shard"):
        Evaluation(config_of(shard="1/2"), FakeWorld().simulator)


def test_parameters_of_the_executor_are_checked_and_leave_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="needs the number of jobs"):
        run(tmp_path / "run", engine_args={"executor": "local"})
    assert not (tmp_path / "run").exists()


def test_slurm_gets_its_parameters_with_and_without_prefix() -> None:
    from vecenv_eval.engines.submitit_engine import _parameters

    given = {"partition": "gpu", "slurm_qos": "high", "mem_gb": 8, "timeout_min": 60}
    assert _parameters(config_of(num_threads=4, backend="warp"), given) == {
        "name": "vecenv",
        "timeout_min": 60,
        "mem_gb": 8,
        "cpus_per_task": 4,
        "gpus_per_node": 1,
        "slurm_partition": "gpu",
        "slurm_qos": "high",
    }


@pytest.mark.heavy
def test_a_job_that_is_killed_is_submitted_again_and_costs_no_verdict(tmp_path: Path) -> None:
    folder, seen = tmp_path / "run", list[Progress]()
    kill = Signals(folder.resolve() / "shards" / "2-of-2", signal.SIGKILL)

    def watch(progress: Progress) -> None:
        seen.append(progress)
        kill(progress)

    result = run(folder, watch, policy=SLOW, num_envs=1)
    assert kill.sent_to
    assert result.ok
    assert "shard 2, job" in (folder / "errors.log").read_text()
    assert lines(folder) == 20
    assert verdicts(result) == verdicts(local(tmp_path / "local", policy=SLOW))
    assert result.summary.policy == "slow"
    assert len({progress.done for progress in seen}) > 3  # rows are merged while jobs run
    assert run(folder, policy=SLOW, num_envs=1).ok  # and then nothing is left to do
    assert lines(folder) == 20


@pytest.mark.heavy
def test_a_job_that_is_preempted_continues(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    preempt = Signals(folder.resolve() / "shards" / "1-of-1", signal.SIGUSR2)
    arguments = {**LOCAL, "shards": 1, "attempts": 1}
    result = run(folder, preempt, policy=SLOW, num_envs=2, tasks="0-1", engine_args=arguments)
    assert preempt.sent_to
    assert result.ok
    assert len({record.run for record in result.records}) == 2
    assert verdicts(result) == verdicts(local(tmp_path / "local", policy=SLOW, tasks="0-1"))


@pytest.mark.heavy
def test_a_job_that_keeps_dying_is_given_up(tmp_path: Path) -> None:
    policy = "support.slow_policy:FatalPolicy"
    result = run(tmp_path / "run", policy=policy, tasks="0", engine_args={**LOCAL, "shards": 1, "attempts": 2})
    assert not result.ok
    assert result.summary.total.missing == 5
    assert (tmp_path / "run" / "errors.log").read_text().count("shard 1, job") == 2
    assert result.causes[0].startswith("shard 1, job")


@pytest.mark.heavy
def test_what_a_job_raises_is_named(tmp_path: Path) -> None:
    policy = "support.slow_policy:FailingPolicy"
    result = run(tmp_path / "run", policy=policy, engine_args={**LOCAL, "shards": 1, "attempts": 1})
    assert re.fullmatch(r"shard 1, job \d+: ValueError: negative seconds", result.causes[0])
    assert result.summary.total.missing == 20


@pytest.mark.heavy
def test_what_every_job_refuses_ends_the_run_without_a_row(tmp_path: Path) -> None:
    world, config = FakeWorld(), config_of(engine_args={**LOCAL, "shards": 1})
    world.refuse = ValueError("no such backend")
    with pytest.raises(ConfigError, match="no such backend"):
        evaluate(config, open_or_begin(config, tmp_path / "run"), simulator=world.simulator)
    assert lines(tmp_path / "run") == 0


def test_a_folder_keeps_its_number_of_shards_and_its_engine(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    local(folder, tasks="0-1", episodes="2")
    config, store = resume(folder, engine="submitit", engine_args=LOCAL)
    with pytest.raises(ConfigError, match="another engine began it"):
        evaluate(replace(config, tasks="0-3"), store, simulator=FakeWorld().simulator)
    (tmp_path / "other" / "shards" / "1-of-5").mkdir(parents=True)
    config = config_of()
    with pytest.raises(ConfigError, match="holds 5 shards, not 2"):
        Evaluation(config, FakeWorld().simulator)._engine._shards(  # pyright: ignore[reportAttributeAccessIssue]
            Evaluation(config, FakeWorld().simulator), tmp_path / "other"
        )


@pytest.mark.heavy
def test_slurm_gets_an_array_of_jobs_and_one_that_dies_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands = fake_slurm.install(tmp_path / "bin")
    monkeypatch.setenv("PATH", f"{commands}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr("vecenv_eval.engines.submitit_engine._ASK_S", 1.0)
    folder = tmp_path / "run"
    kill = Signals(folder.resolve() / "shards" / "2-of-2", signal.SIGKILL)
    arguments = {"executor": "auto", "shards": 2, "poll_s": 0.2, "partition": "gpu", "timeout_min": 60, "mem_gb": 2}
    result = run(folder, kill, policy=SLOW, num_envs=1, num_threads=2, engine_args=arguments)
    assert kill.sent_to
    assert result.ok
    assert verdicts(result) == verdicts(local(tmp_path / "local", policy=SLOW))
    array, again = [path.read_text() for path in sorted(commands.glob("sbatch-*.sh"))]
    for line in ("partition=gpu", "time=60", "mem=2GB", "cpus-per-task=2"):
        assert f"#SBATCH --{line}\n" in array
        assert f"#SBATCH --{line}\n" in again
    assert "#SBATCH --array=0-1" in array
    assert "--array" not in again


DRIVER = """
import sys
from pathlib import Path
from support import fake_slurm
from support.fakes import FakeWorld
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import open_or_begin
from vecenv_eval.runner import evaluate

config = EvalConfig(suite="fake_suite", policy="support.slow_policy:SlowPolicy", num_envs=1, engine="submitit",
                    engine_args={"executor": "local", "shards": 2, "poll_s": 0.2})
result = evaluate(config, open_or_begin(config, Path(sys.argv[1])), simulator=FakeWorld().simulator)
sys.exit(130 if result.interrupted else 0 if result.ok else 1)
"""


@pytest.mark.heavy
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_driver_that_is_ended_is_resumed_by_the_same_command(tmp_path: Path, how: int) -> None:
    folder = tmp_path / "run"
    command = [sys.executable, "-c", DRIVER, str(folder)]
    driver = subprocess.Popen(command, start_new_session=True)
    until = time.monotonic() + 60
    while lines(folder) < 3 and time.monotonic() < until:
        time.sleep(0.1)
    if how == signal.SIGINT:
        os.killpg(driver.pid, how)
    else:
        driver.kill()  # its jobs go on
    assert driver.wait(60) == (130 if how == signal.SIGINT else -signal.SIGKILL)
    assert 3 <= lines(folder) < 20
    assert subprocess.run(command, check=False, timeout=120).returncode == 0
    assert lines(folder) == 20
    told = resume(folder, policy=SLOW, engine="submitit", engine_args=LOCAL)
    result = evaluate(*told, simulator=FakeWorld().simulator)
    assert verdicts(result) == verdicts(local(tmp_path / "local", policy=SLOW))
