"""SIGTERM and SIGINT, before the first episode and while episodes run: one line that says how to go on."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest
from support.fakes import SUITE, FakeEnv, FakeWorld
from typer.testing import CliRunner, Result
from vecenv_eval import runner
from vecenv_eval.store import ResultStore

from vecenv.cli import build_app

POLICY = """
import os, signal
from vecenv_eval.policies.scripted import ZeroPolicy
class P(ZeroPolicy):
    def __init__(self, when="never", how=15):
        super().__init__()
        self._when, self._how = when, how
        self._stop("making")
    def reset(self, env, info):
        self._stop("reset")
        super().reset(env, info)
    def _stop(self, when):
        if when == self._when:
            os.kill(os.getpid(), self._how)
"""
SIGNALS = pytest.mark.parametrize(
    ("how", "name", "status"), [(signal.SIGTERM, "SIGTERM", 143), (signal.SIGINT, "Ctrl-C", 130)]
)


class StoppingWorld(FakeWorld):
    """A signal comes while an environment is made."""

    how: int | None = None

    def make(self, *arguments: object, **options: object) -> FakeEnv:
        if self.how is not None:
            os.kill(os.getpid(), self.how)
        return super().make(*arguments, **options)  # pyright: ignore[reportArgumentType]


@pytest.fixture(autouse=True)
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> StoppingWorld:
    world = StoppingWorld()
    monkeypatch.setattr(runner, "vecenv_simulator", lambda: world.simulator)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.delitem(sys.modules, "stops", raising=False)
    monkeypatch.chdir(tmp_path)
    Path("stops.py").write_text(POLICY)
    return world


def invoke(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["eval", *arguments])


def evaluate(when: str, how: int) -> Result:
    policy = ["--policy", "stops:P", "--policy-arg", f"when={when}", "--policy-arg", f"how={int(how)}"]
    return invoke("--suite", SUITE, "--out", "here", *policy)


@SIGNALS
def test_before_there_is_a_folder(how: int, name: str, status: int) -> None:
    done = evaluate("making", how)
    assert done.exit_code == status
    assert done.stderr == (
        f"error: stopped by {name} before the first episode or between two: nothing was computed yet; to begin again, "
        "repeat the command\n"
    )
    assert not Path("here").exists()


@SIGNALS
def test_while_a_folder_is_continued(how: int, name: str, status: int) -> None:
    assert invoke("--suite", SUITE, "--out", "here", "--policy", "zero", "--tasks", "0").exit_code == 0
    content = Path("here/config.json").read_text().replace('"policy": "zero"', '"policy": "stops:P"')
    again = [("when", "making"), ("how", int(how))]
    Path("here/config.json").write_text(
        content.replace('"policy_args": {}', '"policy_args": ' + str(dict(again)).replace("'", '"'))
    )
    options = [text for key, value in again for text in ("--policy-arg", f"{key}={value}")]
    done = invoke("--resume", "here", "--policy", "stops:P", *options)
    assert done.exit_code == status
    (line,) = done.stderr.splitlines()
    assert f"stopped by {name}" in line
    assert line.endswith(f"to go on: vecenv eval --resume here --policy stops:P {' '.join(options)}")
    assert len(ResultStore.open(Path("here")).records()) == 5


@SIGNALS
def test_while_an_environment_is_made(world: StoppingWorld, how: int, name: str, status: int) -> None:
    world.how = how
    done = invoke("--suite", SUITE, "--out", "here", "--policy", "zero")
    assert done.exit_code == status, done.output
    assert "Episodes lack a verdict; to run them: vecenv eval --resume here" in done.stdout
    world.how = None
    assert invoke("--resume", "here").exit_code == 0
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@SIGNALS
def test_while_episodes_run(how: int, name: str, status: int) -> None:
    done = evaluate("reset", how)
    assert done.exit_code == status, done.output
    assert "vecenv eval --resume here --policy stops:P" in done.stdout


def test_who_ignores_sigterm_goes_on_ignoring_it() -> None:
    usual = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        done = evaluate("reset", signal.SIGTERM)
        assert done.exit_code == 0, done.output
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, usual)
