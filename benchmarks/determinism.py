"""The same run twice on MuJoCo Warp, with ``deterministic=True`` and without, and what the option costs.

For every scene and geometry, B slots are run with random actions, stopped at their success:

* *twins*: the same batch twice, one after the other;
* *halves*: with the option, the same episodes and actions in two batches of B / 2, in shuffled slots.

Positions, velocities and verdicts of every slot are compared bit by bit after every chunk of ticks. *Cost* is the time
of a chunk with the option over that without, from the same states, in turns; the median over the rounds.

Each case is printed and written as soon as it is measured; ``--seconds`` keeps a new one from being started.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from common import report

import vecenv
from vecenv.libero.env import LiberoEnv

# Ticks of a call, and for how many of them an action is held.
CHUNK, HELD = 20, 5
EPISODES = 50


def main() -> None:
    """Measure what the command line asks for."""
    options = arguments()
    start, rows = time.perf_counter(), []
    for geometry, scene in itertools.product(options.geometry, options.scene):
        elapsed = time.perf_counter() - start
        if rows and elapsed > options.seconds:
            print(f"{scene} {geometry}: not run, {elapsed:.0f} s have passed", flush=True)
            continue
        rows.append(measure(scene, geometry, options))
        print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
        notes = {"device": str(jax.devices()[0]), "seconds": round(time.perf_counter() - start)}
        report(options.name, rows, title="The same run twice", notes=notes)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=["libero_object/0", "libero_spatial/0", "libero_10/3"])
    parser.add_argument("--geometry", nargs="+", default=["lean", "exact"])
    parser.add_argument("--batch", type=int, default=512)
    parser.add_argument("--ticks", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=180.0, help="after which no other case is started")
    parser.add_argument("--scenes", help="folder that `vecenv compile` wrote")
    parser.add_argument("--name", default="determinism", help="name of the results file")
    return parser.parse_args()


def measure(scene: str, geometry: str, options: argparse.Namespace) -> dict[str, Any]:
    """One case."""
    batch, rng = options.batch, np.random.default_rng(0)
    episodes, actions = np.arange(batch) % EPISODES, random_actions(batch, options.ticks, rng)
    envs = {on: make(scene, geometry, episodes, on, options) for on in (True, False)}
    runs = {on: [run(env, episodes, actions) for _ in range(2)] for on, env in envs.items()}
    slots = rng.permutation(batch)
    halves = [run_half(scene, geometry, half, episodes, actions, options) for half in np.array_split(slots, 2)]
    whole = [after[slots] for after in runs[True][0]]
    split = [np.concatenate(parts) for parts in zip(*halves, strict=True)]
    row = {
        "scene": scene,
        "geometry": geometry,
        "B": batch,
        "ticks": options.ticks,
        "twins differ": differing(*runs[True]),
        "halves differ": differing(whole, split),
        "twins differ without": differing(*runs[False]),
        "verdicts differ": int((verdicts(runs[True][0]) != verdicts(runs[True][1])).sum()),
        "verdicts differ without": int((verdicts(runs[False][0]) != verdicts(runs[False][1])).sum()),
        "successes": int(verdicts(runs[True][0]).sum()),
        "faults": sum(len(env.physics.faults) for env in envs.values()),
        "cost": cost(envs, episodes, actions, options.rounds),
    }
    for env in envs.values():
        env.close()
    return row


def random_actions(batch: int, ticks: int, rng: np.random.Generator) -> np.ndarray:
    """Actions [batch, ticks, 7] that tend downwards, each held for some ticks."""
    drawn = rng.uniform(-1, 1, (batch, -(-ticks // HELD), 7)) - [0, 0, 0.5, 0, 0, 0, 0]
    return np.clip(np.repeat(drawn, HELD, axis=1)[:, :ticks], -1, 1)


def make(
    scene: str, geometry: str, episodes: np.ndarray, deterministic: bool, options: argparse.Namespace
) -> LiberoEnv:
    """A batch."""
    suite, task = scene.rsplit("/", 1)
    env = vecenv.make(
        suite,
        task=int(task),
        episodes=episodes.tolist(),
        backend="warp",
        geometry=geometry,
        deterministic=deterministic,
        scenes=options.scenes,
    )
    assert isinstance(env, LiberoEnv)
    return env


def begin(env: LiberoEnv, episodes: np.ndarray) -> None:
    """Place all slots at the start of their episodes."""
    env.set_episodes(tasks=env.reset().task_id, episodes=episodes.tolist())
    env.reset()


def run(env: LiberoEnv, episodes: np.ndarray, actions: np.ndarray) -> list[np.ndarray]:
    """What every slot was like after every chunk: positions, velocities and the verdict, [B, n] each."""
    begin(env, episodes)
    seen = []
    for first in range(0, actions.shape[1], CHUNK):
        control = env.step_continuous(actions[:, first : first + CHUNK])
        (group,) = env.physics.groups
        seen.append(np.concatenate([group.qpos, group.qvel, control.success[:, None]], axis=1))
    return seen


def run_half(
    scene: str,
    geometry: str,
    slots: np.ndarray,
    episodes: np.ndarray,
    actions: np.ndarray,
    options: argparse.Namespace,
) -> list[np.ndarray]:
    """The same for some of the slots, in a batch of their own."""
    env = make(scene, geometry, episodes[slots], True, options)
    seen = run(env, episodes[slots], actions[slots])
    env.close()
    return seen


def differing(first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> str:
    """How many slots differ in any bit at the end of the first chunk and of the last one; NaN equals NaN."""
    counts = [
        int((one.view(np.uint64) != two.view(np.uint64)).any(axis=1).sum())
        for one, two in zip(first, second, strict=True)
    ]
    return f"{counts[0]} -> {counts[-1]} of {len(first[0])}"


def verdicts(seen: Sequence[np.ndarray]) -> np.ndarray:
    """Which slots succeeded, bool [B]."""
    return np.any([after[:, -1] > 0 for after in seen], axis=0)


def cost(envs: dict[bool, LiberoEnv], episodes: np.ndarray, actions: np.ndarray, rounds: int) -> float:
    """Time of the first chunk with the option over that without, the median over rounds in which they take turns."""
    ratios = []
    for _ in range(rounds):
        seconds = {}
        for on, env in envs.items():
            begin(env, episodes)
            start = time.perf_counter()
            env.step_continuous(actions[:, :CHUNK])
            np.asarray(env.physics.groups[0].qpos)
            seconds[on] = time.perf_counter() - start
        ratios.append(seconds[True] / seconds[False])
    return round(statistics.median(ratios), 3)


if __name__ == "__main__":
    main()
