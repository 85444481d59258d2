"""The commit that this code runs from, for records of what was run."""

from __future__ import annotations

import subprocess
from pathlib import Path


def git_commit(folder: Path = Path(__file__).parent) -> str:
    """Commit of the clone that a folder is in, this package's by default, with ``+changes`` when files differ from it.

    Empty outside a clone, and where Git does not track the folder: an installed package may lie in the virtual
    environment of another project's clone.
    """
    try:
        _git("ls-files", "--error-unmatch", ".", cwd=folder)
        commit = _git("rev-parse", "HEAD", cwd=folder)
        return commit + ("+changes" if _git("status", "--porcelain", "--untracked-files=no", cwd=folder) else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


def _git(*arguments: str, cwd: Path) -> str:
    command = ["git", *arguments]  # as the user's shell finds it; without a git there is no commit
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=True)  # nosec B603 # no shell
    return done.stdout.strip()
