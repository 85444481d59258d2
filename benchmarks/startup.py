"""How long until the first step: processes that start cold, from the cache, or from an exported folder.

Each row of the first kind is a fresh process that imports vecenv, makes a batch of one task of ``libero_spatial``,
resets it and takes one control step; the row names its caches. The compiled JAX functions are the bulk of it,
so they are shown with JAX's own persistent cache as well. ``cpu`` is the whole process's, which shows what a machine
that is shared would do alone. Then, within one process: going to another scene with
``set_episodes``, up to and including its first step; and compiling the 32 scenes of LIBERO's own suites, without the
cache, into it, and out of it. Seconds; the median of the repetitions, and the slowest.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from common import report
from rich.progress import track

FIRST_STEP = """
import json, sys, time
begun = float(sys.argv[1])
marks = {}
def mark(name):
    global begun
    now = time.time()
    marks[name], begun = now - begun, now
import numpy as np
import vecenv, vecenv.libero.env
mark("import")
scenes, slots = sys.argv[2] or None, int(sys.argv[3])
env = vecenv.make("libero_spatial", task=0, episodes=range(slots), scenes=scenes)
mark("make")
env.reset()
mark("reset")
env.step_continuous(np.zeros((slots, 7)))
mark("step")
env.step_continuous(np.zeros((slots, 7)))
mark("second step")
marks["cpu"] = time.process_time()
print(json.dumps(marks))
"""

COMPILE_ALL = """
import time
import mujoco
from vecenv.libero import cache, goals, suites
problems = {}
for suite in suites.BASE_SUITES:
    for spec in suites.list_tasks(suite):
        problems.setdefault(spec.problem().scene_key(), []).append(spec.problem())
begun, cpu = time.perf_counter(), time.process_time()
for sharing in problems.values():
    cache.cached_scene(sharing[0], contact_pairs=goals.contact_pairs(sharing))
print(len(problems), time.perf_counter() - begun, time.process_time() - cpu)
"""


PARTS = ("import", "make", "reset", "step")


def run(code: str, *arguments: str, **environment: str) -> str:
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return done.stdout


def first_step(slots: int, scenes: str = "", **environment: str) -> Callable[[], dict[str, float]]:
    def measure() -> dict[str, float]:
        marks = json.loads(run(FIRST_STEP, repr(time.time()), scenes, str(slots), **environment))
        return {"total": sum(marks[part] for part in PARTS), **marks}

    return measure


def compile_all(cache: str) -> dict[str, float]:
    count, seconds, cpu = run(COMPILE_ALL, VECENV_CACHE_DIR=cache).split()
    assert int(count) == 32
    return {"total": float(seconds), "cpu": float(cpu)}


def switches(slots: int, scenes: Path) -> list[dict[str, float]]:
    """From one scene of libero_90 to the next, until its first step is done; all of its scenes."""
    import vecenv
    from vecenv.libero.tasks.suites import list_tasks

    first_of = {spec.problem().scene_key(): spec.index for spec in reversed(list_tasks("libero_90"))}
    tasks = sorted(first_of.values())
    env = vecenv.make("libero_90", task=tasks[0], episodes=range(slots), scenes=scenes)
    env.reset()
    env.step_continuous(np.zeros((slots, 7)))
    rows = []
    for task in tasks[1:]:
        begun = time.perf_counter()
        env.set_episodes(tasks=task)
        made = time.perf_counter()
        env.reset()
        ready = time.perf_counter()
        env.step_continuous(np.zeros((slots, 7)))
        ended = time.perf_counter()
        rows.append({"total": ended - begun, "make": made - begun, "reset": ready - made, "step": ended - ready})
    env.close()
    return rows


def row(what: str, limit: float, samples: list[dict[str, float]]) -> dict[str, Any]:
    """Medians of the total and its parts, the slowest total, and the limit it must keep."""
    totals = [sample["total"] for sample in samples]
    parts = {part: median(s[part] for s in samples) if part in samples[0] else "" for part in ("cpu", *PARTS)}
    return {"what": what, "n": len(samples), "median": median(totals), "slowest": max(totals), "limit": limit, **parts}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--slots", type=int, default=8, help="episodes in the batch")
    parser.add_argument("--repeat", type=int, default=5, help="processes of each kind")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        rows = measure(Path(name), arguments.slots, arguments.repeat)
    load = os.getloadavg()[0]
    report(
        "startup", rows, title="Seconds until the first step", notes={"slots": arguments.slots, "load_average": load}
    )


def measure(folder: Path, slots: int, repeat: int) -> list[dict[str, Any]]:
    from vecenv.libero.tasks.export import export

    cache, exported, jax = folder / "cache", folder / "exported", str(folder / "jax")
    export(exported, ["libero_spatial", "libero_90"])
    keep: Mapping[str, str] = {"JAX_COMPILATION_CACHE_DIR": jax, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    kinds = {
        "first step, no cache": first_step(slots, VECENV_CACHE_DIR=""),
        "first step, cached scene": first_step(slots, VECENV_CACHE_DIR=str(cache)),
        "first step, exported scene": first_step(slots, str(exported), VECENV_CACHE_DIR=""),
        "first step, cached scene and JAX functions": first_step(slots, VECENV_CACHE_DIR=str(cache), **keep),
    }
    samples: dict[str, list[dict[str, float]]] = {what: [] for what in kinds}
    for number in track(range(repeat + 1), "processes"):  # the first round fills the caches
        for what, once in kinds.items():
            sample = once()
            if number:
                samples[what].append(sample)
    rows = [row(what, 10.0, found) for what, found in samples.items()]
    rows.append(row("another scene (set_episodes to first step)", 1.0, switches(slots, exported)))
    rows.append(row("32 scenes compiled, no cache", 60.0, [compile_all("") for _ in range(repeat)]))
    fresh = [compile_all(str(folder / f"cache{i}")) for i in range(repeat)]
    rows.append(row("32 scenes compiled and cached", 60.0, fresh))
    rows.append(row("32 scenes from the cache", 60.0, [compile_all(str(folder / f"cache{i}")) for i in range(repeat)]))
    return rows


if __name__ == "__main__":
    main()
