"""The commit that records of runs name."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from vecenv.util.revision import git_commit


def git(folder: Path, *arguments: str) -> str:
    command = ["git", "-c", "user.name=a", "-c", "user.email=a@example.org", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A clone with a package that Git tracks, and a virtual environment that it does not."""
    for name in ("package", ".venv"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "module.py").write_text("x = 1\n")
    git(tmp_path, "init", "--quiet")
    git(tmp_path, "add", "package")
    git(tmp_path, "commit", "--quiet", "--message", "first")
    return tmp_path


def test_a_tracked_package_has_the_commit_of_its_clone(clone: Path) -> None:
    commit = git(clone, "rev-parse", "HEAD")
    assert git_commit(clone / "package") == commit
    (clone / "package" / "module.py").write_text("x = 2\n")
    assert git_commit(clone / "package") == f"{commit}+changes"


def test_a_package_in_a_virtual_environment_of_a_clone_has_no_commit(clone: Path) -> None:
    assert git_commit(clone / ".venv") == ""


def test_there_is_no_commit_outside_a_clone(tmp_path: Path) -> None:
    assert git_commit(tmp_path) == ""
