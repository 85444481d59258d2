"""When, with which versions and on which machine a run happens, for ``config.json``."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from vecenv import doctor


def run_conditions() -> dict[str, Any]:
    """Start time, command line, commit, versions and machine of this process, in plain types."""
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "arguments": sys.argv[1:],
        "commit": git_commit(),
        "versions": dict(_versions()),
        "machine": doctor.machine(),
    }


@cache
def _versions() -> dict[str, str]:
    """The versions, which take half a second to look up and stay what they are."""
    return doctor.versions()


def git_commit() -> str:
    """Commit of the clone this package runs from, with ``+changes`` when files differ from it; "" outside a clone."""
    here = Path(__file__).parent
    try:
        commit = _git("rev-parse", "HEAD", cwd=here)
        return commit + ("+changes" if _git("status", "--porcelain", "--untracked-files=no", cwd=here) else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


def _git(*arguments: str, cwd: Path) -> str:
    done = subprocess.run(["git", *arguments], cwd=cwd, capture_output=True, text=True, check=True)
    return done.stdout.strip()
