"""How much memory a slot takes, from which the harness chooses how many run at once (``vecenv_eval.memory``).

A batch of one size is built, reset and stepped in a process of its own; where images are asked for, those of its
cameras are drawn and read in every slot. Memory is the largest resident size of the process and of the processes that
it started. The difference between two sizes of a batch, divided by the difference in slots, is what a slot takes; what
is left of the smaller batch is fixed. Shared pages of worker processes are counted in each of them.

    python benchmarks/memory.py
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from common import report

import vecenv
from vecenv.util.cores import usable_cores

MIB = 2**20
# Suite, tasks, whether images are drawn, and the two sizes of a batch. libero_10 has a scene for nearly every task.
CASES: tuple[tuple[str, tuple[int, ...], bool, tuple[int, int]], ...] = (
    ("libero_object", (0,), False, (32, 256)),
    ("libero_spatial", (0,), False, (32, 256)),
    ("libero_10", (0, 1, 2, 3, 4), False, (40, 240)),
    ("libero_object", (0,), True, (8, 40)),
    ("libero_spatial", (0,), True, (8, 40)),
    ("libero_10", (0,), True, (8, 40)),
    ("libero_10", (0, 1, 2, 3, 4), True, (5, 20)),
    ("simpler/bridge", (0,), False, (8, 24)),
    ("simpler/bridge", (0,), True, (8, 24)),
    ("simpler/google_robot", (0,), False, (8, 24)),
    ("simpler/google_robot", (0,), True, (8, 24)),
)
TICKS = 1


def measure(suite: str, tasks: list[int], images: bool, num_envs: int) -> float:
    """The largest resident size of a batch of this process and its children, MiB."""
    env = vecenv.make(suite, tasks=tasks * (num_envs // len(tasks)), episodes=[0])
    assert env.num_envs == num_envs
    env.reset()
    for _ in range(TICKS):
        env.step_continuous(np.zeros((num_envs, 7)))
        if images:
            seen = env.observe_egocentric().images
            assert all(seen[name].any() for name in seen)
    found = _resident()
    env.close()
    return found


def _resident() -> float:
    """Largest resident sizes so far of this process and of its children, added up, MiB."""
    import psutil

    me = psutil.Process()
    return sum(_largest(each.pid) for each in (me, *me.children(recursive=True)))


def _largest(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


def measured(suite: str, tasks: tuple[int, ...], images: bool, num_envs: int) -> float:
    """``measure`` in a process of its own."""
    command = [sys.executable, __file__, "--one", json.dumps([suite, tasks, images, num_envs])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{suite} {tasks}, {num_envs} slots: exit {done.returncode}\n{done.stderr[-2000:]}")
    return float(done.stdout.splitlines()[-1])


def row(suite: str, tasks: tuple[int, ...], images: bool, sizes: tuple[int, int]) -> dict[str, Any]:
    """One row: the slope between two sizes of a batch, and what is left at none."""
    few, many = (measured(suite, tasks, images, size) for size in sizes)
    slot = (many - few) / (sizes[1] - sizes[0])
    return {
        "suite": suite,
        "tasks": " ".join(map(str, tasks)),
        "images": images,
        "slots": f"{sizes[0]}, {sizes[1]}",
        "MiB": f"{few:.0f}, {many:.0f}",
        "MiB a slot": round(slot, 2),
        "MiB fixed": round(few - slot * sizes[0]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--one", help="one measurement, as JSON: suite, tasks, images, slots")
    parser.add_argument("--suite", help="the rows of this suite only; nothing is written")
    parser.add_argument("--images", action="store_true", help="the rows with images only; nothing is written")
    options = parser.parse_args()
    if options.one:
        print(measure(*json.loads(options.one)))
        return
    rows = []
    for case in CASES:
        if options.suite in (None, case[0]) and (case[2] or not options.images):
            rows.append(row(*case))
            print(rows[-1], flush=True)
    if options.suite is None and not options.images:
        report("memory", rows, title="Memory of a batch", notes={"processes": usable_cores()})


if __name__ == "__main__":
    main()
