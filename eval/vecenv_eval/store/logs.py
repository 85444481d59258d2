"""What a policy notes about an episode, as a file of its own in the results folder: JSON Lines, written in one step.

A log is on the disk before the record of its episode is. An episode that runs again, after an error, replaces it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vecenv_eval.episodes import Episode
from vecenv_eval.store.files import replace_text
from vecenv_eval.store.record import StoreWriteError

LOGS = "policy_logs"


def log_path(folder: Path, episode: Episode) -> Path:
    """Where the log of an episode goes: ``folder/policy_logs/{suite}_{task}_{episode}.jsonl``; ``/`` becomes ``-``."""
    suite = re.sub(r"[^\w.-]+", "-", episode.suite)
    return folder / LOGS / f"{suite}_{episode.task}_{episode.episode}.jsonl"


def write_log(folder: Path, episode: Episode, lines: Sequence[Mapping[str, Any]]) -> None:
    """Write the log of an episode; returns when it is on the disk. Without lines there is no file.

    Raises:
        StoreWriteError: it cannot be written.
    """
    if not lines:
        return
    path = log_path(folder, episode)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_text(path, "".join(json.dumps(line) + "\n" for line in lines))
    except OSError as error:
        raise StoreWriteError(f"{path} cannot be written: {error.strerror}") from None
