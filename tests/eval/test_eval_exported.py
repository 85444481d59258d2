"""An evaluation of an exported folder needs no LIBERO packages, and has the rows of one with them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.simulator import describe_suite, vecenv_simulator

from vecenv.libero.tasks.export import export

SUITE = "libero_goal"
# Rows without what depends on the clock.
FIELDS = ("suite", "task", "episode", "success", "steps", "num_steps", "instruction")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    export(folder, [SUITE])
    return folder


def evaluated(folder: Path, *options: str, **environment: str) -> list[dict[str, object]]:
    """Rows of a short evaluation in a process of its own."""
    command = [sys.executable, "-c", "from vecenv.cli import main; main()", "eval", "--suite", SUITE, "--out", folder]
    command += ["--tasks", "2,7", "--episodes", "0,3", "--max-steps", "3", "--policy", "random", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **environment})
    assert done.returncode == 0, done.stderr
    (file,) = Path(folder).glob("episodes*.jsonl")
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    return sorted(({k: v for k, v in row.items() if k in FIELDS} for row in rows), key=str)


def test_an_exported_suite_runs_without_the_packages(exported: Path, tmp_path: Path) -> None:
    hidden = dict.fromkeys(("VECENV_LIBERO_ROOT", "VECENV_LIBERO_ASSETS", "VECENV_ROBOSUITE_ASSETS"), str(tmp_path))
    ours = evaluated(tmp_path / "ours", "--env-arg", f"scenes={exported}", **hidden)
    assert len(ours) == 4
    assert ours == evaluated(tmp_path / "theirs")


def test_an_exported_suite_is_described_as_the_installed_one(exported: Path) -> None:
    config = EvalConfig(suite=SUITE, env_args={"scenes": str(exported)})
    assert vecenv_simulator().suite_of(config) == describe_suite(SUITE)


@pytest.mark.parametrize(
    ("suite", "problem"), [("libero_10", "holds no suite 'libero_10'"), ("simpler/bridge", "are not exported")]
)
def test_what_a_folder_does_not_hold_is_refused(exported: Path, suite: str, problem: str) -> None:
    config = EvalConfig(suite=suite, env_args={"scenes": str(exported)})
    with pytest.raises(ConfigError, match=problem):
        vecenv_simulator().suite_of(config)
