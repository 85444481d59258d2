"""Physics and two 256 x 256 images every control step: vecenv against upstream's SubprocVectorEnv on the same machine.

Upstream runs one process for each of its environments, each an ``OffScreenRenderEnv``: as many as there are cores, or,
with ``--processes slots``, as many as vecenv has slots. vecenv steps in one process with as many threads as there are
cores and draws as ``RenderConfig`` does by default (threads, or processes where GL draws in hardware), once with
upstream's image (``lod="exact"``) and once with simplified meshes (``"fast"``); with ``--physics`` also without
images, against upstream's environments without a renderer. All draw with the same GL (``MUJOCO_GL``: software on a
CPU, the GPU's with ``egl`` where there is one) and take the same random actions. The sides take turns within one run,
a few control steps each, so other load on the machine affects all of them; rates are environment control steps a
second, medians over the turns, and ratios are medians of the turns' ratios. ``psnr`` and ``ssim``
compare ``"fast"`` with ``"exact"``, the worst image of the run.

    python benchmarks/render.py
    MUJOCO_GL=egl python benchmarks/render.py --scenes libero_object/0 --slots 1 16 64 --processes slots --physics
"""

from __future__ import annotations

import argparse
import functools
import itertools
import os
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
from vecenv.libero.tasks.suites import NUM_EPISODES, list_tasks
from vecenv.util.cores import usable_cores

TASKS = [("libero_object", 0), ("libero_spatial", 0), ("libero_10", 0)]
SIZE = 256


def upstream_batch(suite: str, task: int, workers: int, *, images: bool = True) -> Callable[[np.ndarray], None]:
    """Upstream's vector environment, live; stepping takes actions [workers, 7]."""
    from support import upstream

    bare, _ = upstream._classes()
    with upstream.silence():
        from libero.libero.envs import OffScreenRenderEnv, SubprocVectorEnv
    spec = list_tasks(suite)[task]
    blind = {"use_camera_obs": False, "has_renderer": False, "has_offscreen_renderer": False}
    make = (
        functools.partial(
            OffScreenRenderEnv, bddl_file_name=str(spec.bddl_path), camera_heights=SIZE, camera_widths=SIZE
        )
        if images
        else functools.partial(bare, bddl_file_name=str(spec.bddl_path), **blind)
    )
    env = SubprocVectorEnv([make] * workers)  # pyright: ignore[reportArgumentType]
    with upstream.silence():
        env.reset()
        env.set_init_state([spec.init_states()[worker % NUM_EPISODES] for worker in range(workers)])

    def step(actions: np.ndarray) -> None:
        observations, *_ = env.step(actions)
        assert not images or observations[0]["agentview_image"].shape == (SIZE, SIZE, 3)

    step.close = env.close  # pyright: ignore[reportFunctionMemberAccess]
    return step


def our_batch(
    suite: str, task: int, slots: int, lod: str | None
) -> tuple[Any, Callable[[np.ndarray], list[np.ndarray] | None]]:
    """A live batch; stepping takes actions [slots, 7] and gives the two images of every slot, none without ``lod``."""
    episodes = [slot % NUM_EPISODES for slot in range(slots)]
    render = None if lod is None else RenderConfig(lod=lod, height=SIZE, width=SIZE)
    env = vecenv.make(suite, task=task, episodes=episodes, render=render)
    env.reset()

    def step(actions: np.ndarray) -> list[np.ndarray] | None:
        env.step_continuous(actions)
        return None if lod is None else env.observe_egocentric().observation

    return env, step


def rate(step: Callable[[np.ndarray], Any], slots: int, ticks: int, rng: np.random.Generator) -> tuple[float, Any]:
    """Environment control steps a second over a few ticks, and what the last one gave."""
    actions = rng.uniform(-1, 1, (ticks, slots, 7))
    begun, last = time.perf_counter(), None
    for tick in range(ticks):
        last = step(actions[tick])
    return slots * ticks / (time.perf_counter() - begun), last


def compare(suite: str, task: int, slots: int, processes: int, turns: int, ticks: int, physics: bool) -> dict[str, Any]:
    """One scene with so many slots, and so many processes of upstream's."""
    theirs = {"upstream": upstream_batch(suite, task, processes)}
    ours = {lod: our_batch(suite, task, slots, lod) for lod in ("exact", "fast")}
    if physics:
        theirs["upstream, physics"] = upstream_batch(suite, task, processes, images=False)
        ours["physics"] = our_batch(suite, task, slots, None)
    rates: dict[str, list[float]] = {name: [] for name in (*theirs, *ours)}
    worst = [np.inf, np.inf]
    for turn in range(turns + 1):  # the first warms up
        found = {name: rate(step, processes, ticks, np.random.default_rng(turn))[0] for name, step in theirs.items()}
        images = {}
        for name, (_, step) in ours.items():
            found[name], images[name] = rate(step, slots, ticks, np.random.default_rng(turn))
        for exact, fast in zip(*(np.concatenate(images[lod]) for lod in ("exact", "fast")), strict=True):
            worst = [min(worst[0], psnr(exact, fast)), min(worst[1], ssim(exact, fast))]
        if turn:
            for name, value in found.items():
                rates[name].append(value)
    for env, _ in ours.values():
        env.close()
    for step in theirs.values():
        step.close()  # pyright: ignore[reportFunctionMemberAccess]
    blind = {"physics / upstream": round(_ratio(rates["physics"], rates["upstream, physics"]), 2)} if physics else {}
    return {
        "scene": f"{suite} {task}",
        "slots": slots,
        "upstream processes": processes,
        **{f"{lod} / upstream": round(_ratio(rates[lod], rates["upstream"]), 2) for lod in ("exact", "fast")},
        **blind,
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
    parser.add_argument("--slots", type=int, nargs="+", default=[8], help="slots of vecenv's batch")
    parser.add_argument("--processes", choices=("cores", "slots"), default="cores", help="processes of upstream's")
    parser.add_argument("--physics", action="store_true", help="also without images")
    parser.add_argument("--name", default="render", help="name of the results file")
    given = parser.parse_args()
    rows = []
    # A process a row: upstream forks its workers, and a fork of a process that has drawn before hangs.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as apart:
        for scene, slots in itertools.product(given.scenes, given.slots):
            suite, task = scene.split("/")
            processes = usable_cores() if given.processes == "cores" else slots
            settings = (slots, processes, given.turns, given.ticks, given.physics)
            rows.append(apart.submit(compare, suite, int(task), *settings).result())
            print(rows[-1], flush=True)
    report(
        given.name,
        rows,
        title=f"control steps a second with two {SIZE} x {SIZE} images, {usable_cores()} cores",
        notes={"GL": os.environ.get("MUJOCO_GL", "usual"), "turns": given.turns, "ticks": given.ticks},
    )


if __name__ == "__main__":
    main()
