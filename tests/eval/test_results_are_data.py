"""A results folder is data: nothing that it names is imported, called or sent anywhere unless it is given again."""

from __future__ import annotations

import json
import os
import pickle
import sqlite3
import sys
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from support.fakes import SUITE, FakeWorld
from typer.testing import CliRunner, Result
from vecenv_eval import campaign, runner
from vecenv_eval.config import ConfigError
from vecenv_eval.merge import folders
from vecenv_eval.policies import PolicyError, make_policy
from vecenv_eval.results import resume
from vecenv_eval.store import ResultStore

from vecenv.cli import build_app

# A policy whose import, making and acting leave files.
OWN = """
from pathlib import Path
Path("imported").touch()
class P:
    name = "own"
    def __init__(self, seed=0, weights="none"):
        Path("made").write_text(weights)
    def reset(self, env, info): self.n = env.num_envs
    def reset_slots(self, env, info, slots): pass
    def act(self, env):
        import numpy as np
        return np.zeros((self.n, 7))
def annotated(seed: int = 0) -> P: return P(seed)
def anything(weights): Path("called").touch()
POLICY = P.__new__(P)
"""


@pytest.fixture(autouse=True)
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeWorld:
    world = FakeWorld()
    for module in (runner, folders, campaign):
        monkeypatch.setattr(module, "vecenv_simulator", lambda: world.simulator)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.chdir(tmp_path)
    Path("own_policy.py").write_text(OWN)
    monkeypatch.delitem(sys.modules, "own_policy", raising=False)
    return world


def invoke(*arguments: str) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), list(arguments))


def begin(**settings: Any) -> Path:
    """A folder with half of its episodes done, which then says something else."""
    folder = Path("here")
    assert invoke("eval", "--suite", SUITE, "--policy", "zero", "--tasks", "0", "--out", "here").exit_code == 0
    rows = (folder / "episodes.jsonl").read_text().splitlines(keepends=True)
    (folder / "episodes.jsonl").write_text("".join(rows[:2]))
    rewrite(folder / "config.json", settings)
    return folder


def rewrite(path: Path, settings: Mapping[str, Any]) -> None:
    content = json.loads(path.read_text())
    content.get("config", content).update(settings)
    path.write_text(json.dumps(content))


def refused(done: Result, *words: str) -> None:
    assert done.exit_code == 2, done.output
    (line,) = done.stderr.splitlines()
    assert [word for word in words if word not in line] == []
    assert {path.name for path in Path.cwd().iterdir()} & {"imported", "made", "called", "owned"} == set()


SYSTEM = {"policy": "os:system", "policy_args": {"command": "touch owned"}}


@pytest.mark.parametrize("settings", [SYSTEM, {"policy": "own_policy:P"}, {"policy": "own_policy:anything"}])
def test_a_policy_that_only_the_folder_names_is_not_loaded(settings: dict[str, Any]) -> None:
    begin(**settings)
    for command in (["eval", "--resume", "here"], ["eval", "--resume", "here", "--num-envs", "1", "--json"]):
        done = invoke(*command)
        refused(done, "a results folder does not decide what is run", f"--policy {settings['policy']}")
    with pytest.raises(ConfigError, match="give it again"):
        resume(Path("here"))


def test_what_reads_a_folder_loads_no_policy() -> None:
    begin(**SYSTEM)
    assert invoke("report", "here", "--format", "csv").exit_code == 0
    assert invoke("export", "here", "--format", "jsonl").exit_code == 0
    assert invoke("merge", "whole", "here").exit_code == 1  # some episodes have no verdict
    assert len(ResultStore.open(Path("whole")).records()) == 2
    refused(invoke("replay", "here"), "no HDF5 file")
    refused(invoke("eval", "--resume", "whole"), "os:system")


def test_a_policy_that_is_given_again_is_loaded_if_it_is_one() -> None:
    begin(policy="own_policy:P")
    refused(invoke("eval", "--resume", "here", "--policy", "zero"), "was evaluated with policy 'own_policy:P'")
    done = invoke("eval", "--resume", "here", "--policy", "own_policy:P")
    assert done.exit_code == 0, done.output
    assert Path("made").read_text() == "none"


def test_nothing_else_of_a_module_is_called() -> None:
    begin(**SYSTEM)
    again = ["--policy", "os:system", "--policy-arg", "command=touch owned"]
    refused(invoke("eval", "--resume", "here", *again), "'os:system' is not a policy")
    for name in ("own_policy:anything", "subprocess:run", "builtins:exec", "pathlib:Path"):
        with pytest.raises(PolicyError, match="is not a policy"):
            make_policy(name, {"weights": "x"})
    assert not Path("called").exists()
    assert make_policy("own_policy:annotated").name == make_policy("own_policy:POLICY").name == "own"


def test_arguments_of_a_policy_of_ones_own_are_given_again() -> None:
    begin(policy="own_policy:P", policy_args={"weights": "evil.pkl"})
    policy = ["--policy", "own_policy:P"]
    refused(invoke("eval", "--resume", "here", *policy), "--policy-arg weights=evil.pkl")
    refused(invoke("eval", "--resume", "here", *policy, "--policy-arg", "weights=mine"), "has other arguments")
    assert invoke("eval", "--resume", "here", *policy, "--policy-arg", "weights=evil.pkl").exit_code == 0
    assert Path("made").read_text() == "evil.pkl"


def test_a_folder_does_not_say_where_a_language_model_is_asked() -> None:
    begin(policy="voxposer", policy_args={"model": "gpt-4o", "api_base": "http://elsewhere.example"})
    refused(invoke("eval", "--resume", "here"), "arguments of policy 'voxposer'", "api_base=http://elsewhere.example")


@pytest.mark.parametrize("engine", ["submitit", "ray"])
def test_an_engine_and_its_arguments_are_given_again(engine: str) -> None:
    hostile = {"setup": ["touch owned"], "runtime_env": {"py_executable": "touch owned"}}
    begin(engine=engine, engine_args=hostile)
    refused(invoke("eval", "--resume", "here"), f"engine '{engine}'", "does not decide what is run")
    config, _ = resume(Path("here"), engine=engine)
    assert config.engine_args == {}
    done = invoke("eval", "--resume", "here", "--engine", "local")
    assert done.exit_code == 0, done.output
    assert not Path("owned").exists()


def test_a_campaign_is_data_too() -> None:
    command = ["eval", "--suite", SUITE, "--policy", "zero", "--seeds", "0,1", "--tasks", "0", "--out", "many"]
    assert invoke(*command).exit_code == 0
    rewrite(Path("many/campaign.json"), SYSTEM)
    refused(invoke("eval", "--resume", "many"), "os:system")
    rewrite(Path("many/campaign.json"), {"policy": "zero", "policy_args": {}})
    for seed in (0, 1):  # a run in it says something else than the campaign
        rewrite(Path(f"many/seed-{seed}/{SUITE}/config.json"), SYSTEM)
    refused(invoke("eval", "--resume", "many"), "another evaluation")


@pytest.mark.parametrize("name", ["scenes", "backend", "render", "protocol", "family"])
def test_environment_arguments_name_no_module(name: str, world: FakeWorld) -> None:
    begin(env_args={name: "own_policy:anything"})
    done = invoke("eval", "--resume", "here")
    refused(done, "error: ") if name != "backend" else None
    assert not Path("imported").exists()
    assert "own_policy" not in sys.modules


class Owned:
    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("owned"),)


def test_no_pickle_in_a_folder_is_read() -> None:
    folder = begin()
    content = pickle.dumps(Owned())
    for name in ("demos/x.pkl", "lerobot/meta/x.pkl", "shards/jobs/1_0_result.pkl", "policy_logs/x.pkl", "x.pkl"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    for name in ("summary.json", "errors.log", "report.md"):
        (folder / name).write_bytes(content)
    assert invoke("eval", "--resume", "here").exit_code == 0
    assert invoke("report", "here", "--format", "csv").exit_code == 0
    assert invoke("merge", "whole", "here").exit_code == 0
    assert not Path("owned").exists()


def test_the_command_to_go_on_says_what_has_to_be_given_again(world: FakeWorld) -> None:
    world.raise_in = {0: ValueError("boom")}
    done = invoke(
        *("eval", "--suite", SUITE, "--tasks", "0", "--out", "a b", "--retries", "0"),
        *("--policy", "own_policy:P", "--policy-arg", "weights=it's 1"),
    )
    assert done.exit_code == 1
    assert "vecenv eval --resume 'a b' --policy own_policy:P --policy-arg 'weights=it'\"'\"'s 1'" in done.stdout


# Names that a run writes to, or that SQLite does.
WRITTEN = [
    ".lock",
    ".lock.host",
    "episodes.jsonl",
    "config.json.tmp",
    "summary.json.tmp",
    "report.md.tmp",
    "errors.log",
]


@pytest.mark.parametrize("name", [*WRITTEN, "episodes.sqlite", "episodes.sqlite-wal", "episodes.sqlite-journal"])
def test_nothing_is_written_through_a_link(name: str) -> None:
    folder, mine = begin(), Path("precious")
    mine.write_text("mine")
    if name.startswith("episodes.sqlite"):
        (folder / "episodes.jsonl").unlink()
        rewrite(folder / "config.json", {"store": "sqlite"})
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(mine.resolve())
    for command in (["eval", "--resume", "here"], ["merge", "whole", "here"], ["report", "here"]):
        done = invoke(*command)
        assert done.exit_code in (0, 1, 2)
        assert done.exception is None or isinstance(done.exception, SystemExit), command
        assert mine.read_text() == "mine", command


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("name", ["config.json", "episodes.jsonl", "episodes.sqlite", "summary.json", ".lock"])
def test_a_pipe_is_not_waited_for(name: str) -> None:
    folder = begin()
    if name == "episodes.sqlite":
        (folder / "episodes.jsonl").unlink()
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    for command in (["report", "here"], ["export", "here", "--format", "jsonl"], ["eval", "--resume", "here"]):
        done = invoke(*command)
        assert done.exit_code in (0, 2)
        assert done.exception is None or isinstance(done.exception, SystemExit), command
        assert len(done.stderr.splitlines()) < 3


def test_a_database_with_triggers_is_refused() -> None:
    assert invoke("eval", "--suite", SUITE, "--policy", "zero", "--store", "sqlite", "--out", "here").exit_code == 0
    with closing(sqlite3.connect("here/episodes.sqlite")) as connection, connection:
        connection.execute("CREATE TRIGGER t AFTER INSERT ON episodes BEGIN DELETE FROM episodes; END")
    for command in ("report", "export"):
        refused(invoke(command, "here", *(["--format", "jsonl"] if command == "export" else [])), "has triggers")
    refused(invoke("eval", "--resume", "here"), "has triggers")
