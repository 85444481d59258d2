"""Physics and two 256 x 256 images every control step: vecenv against upstream's SubprocVectorEnv at equal cores.

Upstream runs one process a core, each an ``OffScreenRenderEnv``; vecenv runs one process with as many threads, once
with upstream's image (``lod="exact"``) and once with simplified meshes (``"fast"``). All draw in the same software GL
and take the same random actions. The three sides take turns within one run, a few control steps each, so other load
on the machine affects all of them; rates are environment control steps a second, medians over the turns, and ratios are
medians of the turns' ratios. ``psnr`` and ``ssim`` compare ``"fast"`` with ``"exact"``, the worst image of the run.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from statistics import median
from typing import Any

import numpy as np
from common import report
from support.images import psnr, ssim

import vecenv
from vecenv.libero.render.options import RenderConfig
from vecenv.libero.tasks.suites import list_tasks
from vecenv.util.cores import usable_cores

TASKS = [("libero_object", 0), ("libero_spatial", 0), ("libero_10", 0)]
SIZE = 256


def upstream_batch(suite: str, task: int, workers: int) -> Callable[[np.ndarray], None]:
    """Upstream's vector environment, live; stepping takes actions [workers, 7]."""
    from support import upstream

    upstream._classes()
    with upstream.silence():
        from libero.libero.envs import OffScreenRenderEnv, SubprocVectorEnv
    spec = list_tasks(suite)[task]
    make = functools.partial(
        OffScreenRenderEnv, bddl_file_name=str(spec.bddl_path), camera_heights=SIZE, camera_widths=SIZE
    )
    env = SubprocVectorEnv([make] * workers)  # pyright: ignore[reportArgumentType]
    with upstream.silence():
        env.reset()
        env.set_init_state(list(spec.init_states()[:workers]))

    def step(actions: np.ndarray) -> None:
        observations, *_ = env.step(actions)
        assert observations[0]["agentview_image"].shape == (SIZE, SIZE, 3)

    step.close = env.close  # pyright: ignore[reportFunctionMemberAccess]
    return step


def our_batch(suite: str, task: int, slots: int, lod: str) -> tuple[Any, Callable[[np.ndarray], list[np.ndarray]]]:
    """A live batch; stepping takes actions [slots, 7] and gives the two images of every slot."""
    env = vecenv.make(suite, task=task, episodes=range(slots), render=RenderConfig(lod=lod, height=SIZE, width=SIZE))
    env.reset()

    def step(actions: np.ndarray) -> list[np.ndarray]:
        env.step_continuous(actions)
        return env.observe_egocentric().observation

    return env, step


def rate(step: Callable[[np.ndarray], Any], slots: int, ticks: int, rng: np.random.Generator) -> tuple[float, Any]:
    """Environment control steps a second over a few ticks, and what the last one gave."""
    actions = rng.uniform(-1, 1, (ticks, slots, 7))
    begun, last = time.perf_counter(), None
    for tick in range(ticks):
        last = step(actions[tick])
    return slots * ticks / (time.perf_counter() - begun), last


def compare(suite: str, task: int, turns: int, ticks: int, slots: int) -> dict[str, Any]:
    cores = usable_cores()
    theirs = upstream_batch(suite, task, cores)
    ours = {lod: our_batch(suite, task, slots, lod) for lod in ("exact", "fast")}
    rates: dict[str, list[float]] = {"upstream": [], "exact": [], "fast": []}
    worst = [np.inf, np.inf]
    for turn in range(turns + 1):  # the first warms up
        found = {"upstream": rate(theirs, cores, ticks, np.random.default_rng(turn))[0]}
        images = {}
        for lod, (_, step) in ours.items():
            found[lod], images[lod] = rate(step, slots, ticks, np.random.default_rng(turn))
        for exact, fast in zip(*(np.concatenate(images[lod]) for lod in ("exact", "fast")), strict=True):
            worst = [min(worst[0], psnr(exact, fast)), min(worst[1], ssim(exact, fast))]
        if turn:
            for name, value in found.items():
                rates[name].append(value)
    for env, _ in ours.values():
        env.close()
    theirs.close()  # pyright: ignore[reportFunctionMemberAccess]
    return {
        "scene": f"{suite} {task}",
        **{f"{lod} / upstream": round(_ratio(rates[lod], rates["upstream"]), 2) for lod in ("exact", "fast")},
        **{name: round(median(values), 1) for name, values in rates.items()},
        "psnr": round(worst[0], 1),
        "ssim": round(worst[1], 3),
    }


def _ratio(ours: list[float], theirs: list[float]) -> float:
    return median(a / b for a, b in zip(ours, theirs, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="*", default=[f"{suite}/{task}" for suite, task in TASKS])
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--ticks", type=int, default=4, help="control steps of a turn")
    parser.add_argument("--slots", type=int, default=8, help="slots of vecenv's batch")
    given = parser.parse_args()
    rows = []
    # A process a scene: upstream forks its workers, and a fork of a process that has drawn before hangs.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as apart:
        for scene in given.scenes:
            suite, task = scene.split("/")
            rows.append(apart.submit(compare, suite, int(task), given.turns, given.ticks, given.slots).result())
            print(rows[-1], flush=True)
    report(
        "render",
        rows,
        title=f"control steps a second with two {SIZE} x {SIZE} images, {usable_cores()} cores",
        notes={"upstream_processes": usable_cores(), "slots": given.slots, "turns": given.turns, "ticks": given.ticks},
    )


if __name__ == "__main__":
    main()
