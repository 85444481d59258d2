"""Environments that are made and closed, and those that cannot be made, leave nothing behind in the process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import ctypes, gc, json, sys
import numpy as np
import psutil
import vecenv
from vecenv.errors import VecenvError

kind, count, assets = sys.argv[1], int(sys.argv[2]), sys.argv[3]
libero = {"suite": "libero_object", "task": 0, "episodes": range(4), "num_threads": 2}
simpler = {"suite": "simpler/bridge", "task": 0, "episodes": range(2), "assets": assets, "num_threads": 1}
usual = simpler if kind.startswith("simpler") else libero

def work(env):
    env.reset()
    env.step_continuous(np.zeros((env.num_envs, 7)))
    env.observe_objects()

def once():
    if kind in ("libero", "simpler"):
        with vecenv.make(**usual) as env:
            work(env)
    elif kind == "dropped":
        work(vecenv.make(**usual))
    elif kind == "images":
        with vecenv.make(**usual, render={"height": 32, "width": 32, "lod": "fast"}) as env:
            env.reset()
            assert env.observe_egocentric().images["agentview"].any()
    else:
        wrong = [{"max_steps": 0}, {"episodes": [99]}]
        if kind == "simpler that fail":
            wrong += [{"num_threads": 2, "variant": {"lighting": "brighter"}}]
        else:
            wrong += [{"cameras": ["none"]}, {"fixtures": {"none": ([0, 0, 0], [1, 0, 0, 0])}}, {"scenes": "/nowhere"}]
        for options in wrong:
            try:
                vecenv.make(**{**usual, **options})
            except VecenvError:
                continue
            raise SystemExit(f"{options} were taken")

process, rows = psutil.Process(), []
for number in range(count):
    once()
    if number in (count // 4, count - 1):
        gc.collect()
        if hasattr(ctypes.CDLL(None), "malloc_trim"):
            ctypes.CDLL(None).malloc_trim(0)  # what is free is not held
        held = process.memory_info().rss / 2**20, process.num_fds(), process.num_threads(), len(process.children())
        rows.append(held)
print(json.dumps(rows))
"""


def held(kind: str, count: int, assets: Path, most: float = 40) -> None:
    """Run in a process of its own, and compare the end with the first quarter; memory may grow by ``most`` MiB."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, kind, str(count), str(assets)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    (memory, *others), (memory_after, *others_after) = json.loads(done.stdout.splitlines()[-1])
    assert memory_after - memory < most
    assert all(after <= before + 1 for before, after in zip(others, others_after, strict=True)), (others, others_after)


@pytest.mark.parametrize("kind", ["libero", "libero that fail"])
def test_forty_environments_leave_nothing_behind(kind: str, small: Path) -> None:
    held(kind, 40, small)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["libero", "dropped", "libero that fail", "simpler", "simpler that fail"])
def test_two_hundred_environments_leave_nothing_behind(kind: str, small: Path) -> None:
    if kind.startswith("simpler"):
        pytest.importorskip("sapien")
    held(kind, 200, small)


@pytest.mark.heavy
def test_contexts_of_gl_are_released(small: Path) -> None:
    pytest.importorskip("OpenGL")
    held("images", 40, small, most=120)  # what is held between two environments varies by 90
