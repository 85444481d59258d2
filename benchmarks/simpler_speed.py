"""SIMPLER's speed on a CPU: control ticks a second, with and without pictures, over batch sizes and worker processes.

Prints two tables and writes their rows. Upstream needs its own environment (SAPIEN 2.2.2 and NumPy 2 do not mix): give
its Python with ``--peer``, and both sides are measured in alternation; it must find ``simpler_env`` and
``mani_skill2_real2sim``. Times are process CPU seconds for one slot, and wall seconds for batches.
"""

from __future__ import annotations

import argparse
import subprocess
import time
from typing import Any

import common
import numpy as np

from vecenv import make
from vecenv.simpler.env import SimplerEnv
from vecenv.simpler.tasks import NUM_EPISODES, TASKS

PAIR = ("widowx_carrot_on_plate", "google_robot_pick_coke_can")
TICKS = 25
BATCH_TICKS = 12
SCALE = np.array([0.02, 0.02, 0.02, 0.1, 0.1, 0.1, 1.0])

_PEER = """
import sys, time, numpy as np, gymnasium as gym
import mani_skill2_real2sim.envs, simpler_env
name, mode, ticks = sys.argv[1], sys.argv[2], int(sys.argv[3])
kind, options = simpler_env.ENVIRONMENT_MAP[name]
env = gym.make(kind, obs_mode=mode, prepackaged_config=True, **options)
env.reset(seed=2022)
actions = (np.random.RandomState(0).uniform(-1, 1, (ticks, 7)) * [.02, .02, .02, .1, .1, .1, 1]).astype(np.float32)
env.step(np.zeros(7, np.float32))
begin = time.process_time()
for action in actions:
    env.step(action)
print(ticks / (time.process_time() - begin))
"""


def actions(slots: int, ticks: int = TICKS) -> np.ndarray:
    return np.random.RandomState(0).uniform(-1, 1, (slots, ticks, 7)) * SCALE


def running(task: str, slots: int, workers: int) -> SimplerEnv:
    episodes = [slot % NUM_EPISODES for slot in range(slots)]
    env = make(TASKS[task].suite, task=task, episodes=episodes, num_threads=workers)
    assert isinstance(env, SimplerEnv)
    env.reset()
    env.step_continuous(np.zeros((slots, 7)))
    return env


def ours(task: str, pictures: bool) -> float:
    """Control ticks a process CPU second of one slot."""
    env = running(task, 1, 1)
    if pictures:
        _ = env.observe_egocentric().rgb
    begin = time.process_time()
    for action in actions(1)[0]:
        env.step_continuous(action[None])
        if pictures:
            _ = env.observe_egocentric().rgb
    rate = TICKS / (time.process_time() - begin)
    env.close()
    return rate


def theirs(python: str, task: str, pictures: bool) -> float:
    """The same of upstream."""
    command = [python, "-c", _PEER, task, "image" if pictures else "none", str(TICKS)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def batch(task: str, slots: int, workers: int, pictures: bool) -> dict[str, float]:
    """Control ticks of all slots a wall second; with pictures too: one of every slot after each tick."""
    env = running(task, slots, workers)
    chunk = actions(slots, BATCH_TICKS)
    begin = time.perf_counter()
    env.step_continuous(chunk)
    rates = {"ticks a second": slots * BATCH_TICKS / (time.perf_counter() - begin)}
    if pictures:
        _ = env.observe_egocentric().rgb
        begin = time.perf_counter()
        for tick in range(BATCH_TICKS):
            env.step_continuous(chunk[:, tick])
            _ = env.observe_egocentric().rgb
        rates["with pictures"] = slots * BATCH_TICKS / (time.perf_counter() - begin)
    env.close()
    return {name: round(rate, 1) for name, rate in rates.items()}


def compare(peer: str | None, pictures: bool, repeats: int) -> list[dict[str, Any]]:
    rows = []
    for task in PAIR:
        row: dict[str, Any] = {"task": task, "pictures": pictures, "ours": [], "upstream": []}
        for _ in range(repeats):
            row["ours"].append(round(ours(task, pictures), 1))
            if peer:
                row["upstream"].append(round(theirs(peer, task, pictures), 1))
        row["ratio"] = round(float(np.mean(row["ours"]) / np.mean(row["upstream"])), 2) if peer else None
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", help="Python of an environment with upstream SIMPLER")
    parser.add_argument("--pictures", action="store_true", help="measure pictures too (needs Vulkan)")
    parser.add_argument("--slots", type=int, nargs="*", default=[1, 8, 32, 64])
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--only", choices=("one", "batches"), help="one slot against upstream, or batches")
    parser.add_argument("--name", default="simpler_batches", help="of the batches' rows in the results folder")
    chosen = parser.parse_args()
    if chosen.only != "batches":
        rows = compare(chosen.peer, False, chosen.repeats)
        rows += compare(chosen.peer, True, chosen.repeats) if chosen.pictures else []
        common.report("simpler_speed", rows, title="SIMPLER, one slot: control ticks a CPU second")
    if chosen.only == "one":
        return
    batches = []
    for task in PAIR:
        for slots in chosen.slots:
            for workers in (count for count in chosen.workers if count <= slots):
                rates = batch(task, slots, workers, chosen.pictures)
                batches.append({"task": task, "slots": slots, "workers": workers, **rates})
                print(batches[-1], flush=True)
    common.report(chosen.name, batches, title="SIMPLER, batches: control ticks a second of all slots")


if __name__ == "__main__":
    main()
