"""Runs on Ray whose nodes or driver are killed: nothing is lost, nothing runs twice, nothing is left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.fakes import SUITE, FakeWorld
from support.ray_cluster import ClusterProcess, ray_cluster
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import EvalResult, Progress, resume
from vecenv_eval.runner import evaluate
from vecenv_eval.store import EPISODES

ray = pytest.importorskip("ray")
pytest.importorskip("ray.cluster_utils")

SLOW = "support.slow_policy:SlowPolicy"


def verdicts(result: EvalResult) -> list[dict[str, Any]]:
    return [record.verdict for record in result.records]


def lines(folder: Path) -> int:
    path = folder / EPISODES
    return len(path.read_text().splitlines()) if path.exists() else 0


def local(folder: Path) -> EvalResult:
    return evaluate(EvalConfig(suite=SUITE, policy=SLOW), folder, simulator=FakeWorld().simulator)


@pytest.fixture
def nodes() -> Iterator[ClusterProcess]:
    """Two nodes with a CPU each, the second of which can be killed."""
    if ray.is_initialized():
        ray.shutdown()
    with ray_cluster(1, 1) as cluster:
        yield cluster


class Kills:
    """Kills a node as soon as some episodes are done; may be called as ``on_progress``."""

    def __init__(self, cluster: ClusterProcess, done: int) -> None:
        self._cluster, self._done = cluster, done
        self.killed = False

    def __call__(self, progress: Progress) -> None:
        if progress.done >= self._done and not self.killed:
            self.killed = True
            self._cluster.kill_last_node()


def test_a_node_that_is_killed_costs_no_verdict(tmp_path: Path, nodes: ClusterProcess) -> None:
    kill, usual = Kills(nodes, 4), signal.getsignal(signal.SIGTERM)
    arguments = {"address": nodes.address, "unit": 3}
    meeting = tmp_path / "meeting"
    meeting.mkdir()
    config = EvalConfig(
        suite=SUITE,
        policy="support.slow_policy:MeetingPolicy",  # so that both nodes have begun
        policy_args={"folder": str(meeting), "processes": 2},
        num_envs=2,
        engine="ray",
        engine_args=arguments,
    )
    result = evaluate(config, tmp_path / "run", simulator=FakeWorld().simulator, on_progress=kill)
    assert kill.killed
    assert "was lost with" in (result.folder / "errors.log").read_text()
    assert result.ok
    assert lines(result.folder) == 20
    assert verdicts(result) == verdicts(local(tmp_path / "local"))
    assert signal.getsignal(signal.SIGTERM) is usual


@pytest.mark.heavy
def test_trajectories_of_libero_are_the_same_with_a_node_killed(tmp_path: Path, nodes: ClusterProcess) -> None:
    kill = Kills(nodes, 2)
    config = EvalConfig(
        suite="libero_goal",
        policy="support.hashing_policy:HashingPolicy",
        tasks="1,3,7",
        episodes="4",
        max_steps=40,
        engine="ray",
        engine_args={"address": nodes.address, "unit": 2},
    )
    result = evaluate(config, tmp_path / "run", on_progress=kill)
    assert kill.killed
    assert result.ok
    assert lines(result.folder) == 12
    assert verdicts(result) == verdicts(evaluate(replace(config, engine="local", engine_args={}), tmp_path / "local"))
    assert len({record.extras["states"] for record in result.records}) == 12


DRIVER = """
import sys
from pathlib import Path
from support.fakes import FakeWorld
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import open_or_begin
from vecenv_eval.runner import evaluate

folder = Path(sys.argv[1])
config = EvalConfig(suite="fake_suite", policy="support.slow_policy:SlowPolicy", num_envs=1, engine="ray",
                    engine_args={"actors": 2, "unit": 2})
result = evaluate(config, open_or_begin(config, folder), simulator=FakeWorld().simulator)
sys.exit(130 if result.interrupted else 0 if result.ok else 1)
"""


def processes_of(session: int) -> list[str]:
    """Command lines of the processes of a session, as setsid makes one."""
    listed = subprocess.run(["ps", "-eo", "sess=,stat=,args="], capture_output=True, text=True, check=True).stdout
    rows = [line.split(None, 2) for line in listed.splitlines()]
    return [row[2] for row in rows if row[0] == str(session) and not row[1].startswith("Z")]


def wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.1)
    return condition()


@pytest.mark.heavy
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_driver_that_is_ended_leaves_no_process_and_the_same_command_resumes(tmp_path: Path, how: int) -> None:
    folder = tmp_path / "run"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", DRIVER, str(folder)]
    driver = subprocess.Popen(command, env=environment, start_new_session=True)
    assert wait_until(lambda: lines(folder) >= 3, 60)
    if how == signal.SIGINT:
        os.killpg(driver.pid, how)  # as a terminal does
    else:
        driver.kill()
    assert driver.wait(30) == (130 if how == signal.SIGINT else -signal.SIGKILL)
    # After SIGKILL, Ray's own agents notice after a while that their parent is gone.
    assert wait_until(lambda: not processes_of(driver.pid), 120), processes_of(driver.pid)
    assert 3 <= lines(folder) < 20
    assert subprocess.run(command, env=environment, check=False).returncode == 0
    assert lines(folder) == 20
    told = resume(folder, policy="support.slow_policy:SlowPolicy", engine="local")
    result = evaluate(*told, simulator=FakeWorld().simulator)  # nothing is left to run
    assert verdicts(result) == verdicts(local(tmp_path / "local"))
    assert len({record.key for record in result.records}) == 20
