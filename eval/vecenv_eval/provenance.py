"""When, with which versions and on which machine a run happens, for ``config.json``."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from functools import cache
from typing import Any

from vecenv import doctor
from vecenv.util.revision import git_commit


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
