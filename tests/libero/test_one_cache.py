"""Processes that fill one empty cache at the same time get what one alone gets, and leave a cache that is whole."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from support.paths import REPOSITORY

PROGRAM = """
import hashlib, sys
import numpy as np
import vecenv

print("ready", flush=True)
sys.stdin.readline()  # until all are
with vecenv.make("libero_object", task=0, episodes=[0, 1], num_threads=1) as env:
    env.reset()
    env.step_continuous(np.full((2, 3, 7), 0.3))
    state = env.state()
print(hashlib.sha256(state.qpos.tobytes() + state.qvel.tobytes()).hexdigest())
"""


def started(cache: Path) -> subprocess.Popen[str]:
    environment = {
        **os.environ,
        "VECENV_CACHE_DIR": str(cache),
        "PYTHONPATH": str(REPOSITORY),
    }
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def results(processes: list[subprocess.Popen[str]]) -> tuple[set[str], str]:
    """Their states' digests, and everything that they said besides."""
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    said = [process.communicate(timeout=120) for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes), said
    return {out for out, _ in said}, "".join(errors for _, errors in said)


def files(cache: Path) -> dict[Path, int]:
    return {path.relative_to(cache): path.stat().st_mtime_ns for path in cache.rglob("*") if path.is_file()}


def test_processes_fill_one_cache_at_the_same_time(tmp_path: Path) -> None:
    together, _ = results([started(tmp_path / "shared") for _ in range(3)])
    left = files(tmp_path / "shared")
    later, warnings = results([started(tmp_path / "shared")])
    alone, _ = results([started(tmp_path / "own")])
    assert together == later == alone
    assert len(together) == 1
    assert warnings == ""
    assert files(tmp_path / "shared") == left  # everything was there, and could be used
    assert left.keys() == files(tmp_path / "own").keys()
