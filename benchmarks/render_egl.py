"""Where the time of images goes with a GPU's GL: threads against processes, and the parts of one image.

Images a second of one scene, two cameras a slot, drawn by threads and by processes, each with images read at once
(``direct``) and some images later (``late``); then milliseconds of the parts of an image in one context: ``fill``
(MuJoCo's list of things to draw), ``render`` (its commands), ``finish`` (waiting for the driver), ``read``
(``mjr_readPixels``), ``copy`` (turning the image into its array), and of a late read ``begin`` and ``take``. Shadows
are off in LIBERO; ``on`` lets every lamp cast them. The arm is somewhere else in every image. It works with software GL
as well; images are drawn whole there too, without layers. ``late`` and ``direct`` take turns; rates are medians over
the turns.

    MUJOCO_GL=egl python benchmarks/render_egl.py
    python benchmarks/render_egl.py --threads 1 2 --processes 2 --slots 4 --turns 1 --name render_egl_software
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any

import mujoco
import numpy as np
from common import report

from vecenv.libero.render import lod
from vecenv.libero.render.commands import renderer_name
from vecenv.libero.render.contexts import choose, open_context
from vecenv.libero.render.drawing import Pose, Stage
from vecenv.libero.render.gl import GlRenderer, Shot
from vecenv.libero.render.readback import Readback
from vecenv.libero.render.sources import InstalledVisuals
from vecenv.libero.tasks.suites import NUM_EPISODES, TaskSpec, list_tasks
from vecenv.util.cores import usable_cores

CAMERAS = ("agentview", "wrist")
NOISE = 0.05  # of the arm's joints, radians


def stage_of(task: TaskSpec, level: str, *, shadows: bool = False) -> Stage:
    """The visual model of a task's scene."""
    scene = InstalledVisuals().scene(task.problem(), level=level, colors="published")
    if shadows:
        scene.model.light_castshadow[:] = True
    return Stage(scene, lod.GRID[level])


def batches(task: TaskSpec, stage: Stage, slots: int, seed: int) -> Iterator[list[Shot]]:
    """Shots of slots at the task's starts, the arm somewhere else in every batch."""
    rng, model, starts = np.random.default_rng(seed), stage.model, task.init_states()
    while True:
        shots = []
        for slot in range(slots):
            qpos = starts[slot % NUM_EPISODES, 1 : 1 + model.nq].copy()
            qpos[stage.scene.arm_qpos] += rng.normal(0, NOISE, len(stage.scene.arm_qpos))
            shots.append(Shot(0, Pose(qpos, model.body_pos.copy(), model.body_quat.copy())))
        yield shots


def rates(task: TaskSpec, level: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Images a second of every number of threads and processes."""
    stage = stage_of(task, level)
    variants = [(kind, count) for kind in ("threads", "processes") for count in getattr(given, kind)]
    rows = []
    for kind, count in variants:
        # One variant at a time has contexts: those of all at once would not fit on small GPUs.
        found: dict[bool, list[float]] = {True: [], False: []}
        options: dict[str, Any] = {"height": given.size, "width": given.size, "layer_memory": 0, f"num_{kind}": count}
        renderers = {late: GlRenderer([stage], late_reads=late, **options) for late in found}
        try:
            for turn in range(given.turns + 1):  # the first warms up
                for late, renderer in renderers.items():
                    value = _rate(renderer, batches(task, stage, given.slots, turn), given.batches)
                    if turn:
                        found[late].append(value)
        finally:
            for renderer in renderers.values():
                renderer.close()
        row = {"drawn by": kind, "count": count, "lod": level}
        rows.append({**row, "late": round(median(found[True]), 1), "direct": round(median(found[False]), 1)})
        print(rows[-1], flush=True)
    return rows


def _rate(renderer: GlRenderer, shots: Iterator[list[Shot]], count: int) -> float:
    asked = [next(shots) for _ in range(count)]
    begun = time.perf_counter()
    for one in asked:
        renderer.render(one, CAMERAS)
    return count * len(asked[0]) * len(CAMERAS) / (time.perf_counter() - begun)


def parts(task: TaskSpec, level: str, shadows: bool, given: argparse.Namespace) -> dict[str, Any]:
    """Median milliseconds of the parts of an image, the two cameras' mean, in a context of this thread."""
    stage, size = stage_of(task, level, shadows=shadows), given.size
    context, frames = stage.context(size, size), [stage.new_frame()]
    readback, rect = Readback.where_possible(size, size), mujoco.MjrRect(0, 0, size, size)
    pixels, out = np.empty((2, size, size, 3), np.uint8)
    times: dict[str, list[float]] = {}

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        times.setdefault(name, []).append(1e3 * (time.perf_counter() - begun))

    def late(done: Callable[[], None]) -> None:
        if readback is not None:
            mujoco.mjr_render(rect, frames[0], context)
            mujoco.mjr_finish()
            with timed("begin"):
                readback.begin(context, out)
            mujoco.mjr_finish()
            with timed("take"):
                done()

    for _, (shot,) in zip(range(given.images), batches(task, stage, 1, 0), strict=False):
        for camera in CAMERAS:
            with timed("fill"):
                stage.fill(frames, [camera], shot.pose, shot.options, slot=0, aspect=1.0)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
            with timed("render"):
                mujoco.mjr_render(rect, frames[0], context)
            with timed("finish"):
                mujoco.mjr_finish()
            with timed("read"):
                mujoco.mjr_readPixels(pixels, None, rect, context)
            with timed("copy"):
                out[:] = pixels[::-1, ::-1]
            if readback is not None:
                late(readback.finish)
    context.free()
    # The first images upload and warm up.
    found = {name: round(median(values[2 * len(CAMERAS) :]), 3) for name, values in times.items()}
    return {"lod": level, "shadows": "on" if shadows else "off", **found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="libero_object/0")
    parser.add_argument("--lods", nargs="+", default=["exact", "fast"])
    parser.add_argument("--threads", type=int, nargs="*", default=[1, 4, 16])
    parser.add_argument("--processes", type=int, nargs="*", default=[4, 8, 16])
    parser.add_argument("--slots", type=int, default=64)
    parser.add_argument("--size", type=int, default=256, help="height and width of images, pixels")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--batches", type=int, default=4, help="calls of a turn, each with an image of every slot")
    parser.add_argument("--images", type=int, default=40, help="images of each camera whose parts are measured")
    parser.add_argument("--name", default="render_egl", help="name of the results file")
    given = parser.parse_args()
    suite, number = given.scene.split("/")
    task = list_tasks(suite)[int(number)]
    rows = [row for level in given.lods for row in rates(task, level, given)]
    # This thread's context comes after the renderers: the driver's threads would wait for each other.
    window = open_context(choose(), given.size, given.size)
    driver = renderer_name()
    pieces = [parts(task, level, shadows, given) for level in given.lods for shadows in (False, True)]
    window.free()
    about = {"scene": given.scene, "GL": choose(), "driver": driver, "slots": given.slots, "size": given.size}
    cores = f"{usable_cores()} cores, {driver}"
    report(given.name, rows, title=f"images a second of {given.scene}, {given.slots} slots, {cores}", notes=about)
    report(f"{given.name}_parts", pieces, title=f"milliseconds of an image of {given.scene}, {cores}", notes=about)


if __name__ == "__main__":
    main()
