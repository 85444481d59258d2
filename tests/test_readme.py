"""The README's examples run, and print what it says they print."""

from __future__ import annotations

import contextlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support.paths import REPOSITORY

README = REPOSITORY / "README.md"
FENCES = re.findall(r"^```(\w+)\n(.*?)^```$", README.read_text(), re.MULTILINE | re.DOTALL)
COMMANDS = [line.split("#")[0].strip() for kind, body in FENCES if kind == "bash" for line in body.splitlines()]


def test_the_readme_shows_the_main_commands() -> None:
    assert {"make eval", "make test", "vecenv doctor"} <= set(COMMANDS)
    assert {command.split()[0] for command in COMMANDS} == {"make", "vecenv"}
    assert {kind for kind, _ in FENCES} == {"bash", "python", "text"}


def test_the_python_examples_print_what_the_readme_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {}
    for (kind, body), (next_kind, expected) in zip(FENCES, [*FENCES[1:], ("", "")], strict=True):
        if kind != "python":
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(body, str(README), "exec"), namespace)
        assert next_kind == "text"
        assert printed.getvalue() == expected


def test_the_make_targets_exist(repository: Path) -> None:
    targets = [command.split()[1] for command in COMMANDS if command.startswith("make ")]
    for target in targets:
        subprocess.run(["make", "--dry-run", target], cwd=repository, check=True, capture_output=True)


def test_the_commands_run_in_order(tmp_path: Path) -> None:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for command in COMMANDS:
        if command.startswith("vecenv "):
            done = subprocess.run(
                command.split(),
                cwd=tmp_path,
                env={**os.environ, "PATH": path},
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    assert (tmp_path / "results" / "zero" / "report.md").exists()
