"""Environment steps a second with two ray-traced camera images every control step, on a GPU, and their quality.

For every scene, image size and batch size, one compiled loop of control steps of the functional environment under
random actions: physics alone, images alone (of the same worlds, moved a little each time), and both. The three take
turns; nothing else may use the GPU meanwhile. With ``--references``, a folder of ``suite_task_size.npz`` with ``xpos``,
``xquat``, ``qpos``, ``rgb``, ``seg`` of N states, images are compared with GL's of the same states.

The GPU's machine needs neither GL nor LIBERO: ``--scenes`` is a folder that ``vecenv compile`` wrote; ``--sceneries``,
a folder of ``suite_task.npz``, and references are written by ``--write`` on a machine that has both.
"""

from __future__ import annotations

import argparse
import itertools
import os
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import report
from jax import lax
from mjx import alternate, timed_first

from vecenv.libero.functional import FunctionalConfig, FunctionalLibero, jit
from vecenv.libero.render.options import POLICY_CAMERAS
from vecenv.libero.render.raytrace import RayTracer
from vecenv.libero.render.scenery import Scenery

# Control steps of one timed call.
STEPS = 4
# Instances of fewer pixels are not counted: one pixel at their edge changes the IoU much.
LEAST_PIXELS = 100


def main() -> None:
    """Measure what the command line asks for."""
    options = arguments()
    if options.write:
        write(options)
        return
    rows: list[dict[str, Any]] = []
    for scene, batch in itertools.product(options.scene, options.batch):
        env = environment(scene, options)
        for size, antialias in itertools.product(options.size, options.antialias):
            rows.append(measure(env, size, batch, antialias, options))
            print(rows[-1], flush=True)
    report(options.name, rows, title="Ray-traced images: steps a second", notes={"device": str(jax.devices()[0])})


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=["libero_object/0", "libero_spatial/0"], help="suite/task")
    parser.add_argument("--size", nargs="+", type=int, default=[256])
    parser.add_argument("--batch", nargs="+", type=int, default=[1024])
    parser.add_argument("--geometry", default="exact", help="collision geoms of the physics")
    parser.add_argument("--samples", type=int, default=1, help="rays a pixel along each side")
    parser.add_argument("--antialias", nargs="+", choices=("on", "off"), default=["on"], help="of RayTracer")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each side a round")
    parser.add_argument("--scenes", help="folder that `vecenv compile` wrote")
    parser.add_argument("--sceneries", type=Path, default=Path("sceneries"))
    parser.add_argument("--references", type=Path)
    parser.add_argument("--images", type=Path, help="folder for images beside their references")
    parser.add_argument("--write", action="store_true", help="make sceneries and references, on a machine with GL")
    parser.add_argument("--name", default="render_gpu", help="name of the results file")
    return parser.parse_args()


def environment(scene: str, options: argparse.Namespace) -> FunctionalLibero:
    """The functional environment of ``suite/task``."""
    suite, task = scene.rsplit("/", 1)
    config = FunctionalConfig(impl="warp", geometry=options.geometry, scenes=options.scenes)
    return FunctionalLibero(suite, task=int(task), config=config)


def measure(
    env: FunctionalLibero, size: int, batch: int, antialias: str, options: argparse.Namespace
) -> dict[str, Any]:
    """One row."""
    scenery = Scenery.load(options.sceneries / f"{env.suite}_{env.task}.npz")
    rays: dict[str, Any] = {"height": size, "width": size, "samples": options.samples, "antialias": antialias == "on"}
    tracer = RayTracer(scenery, **rays)
    runs = Loops(env, tracer, batch)
    start = time.perf_counter()
    first = [timed_first(run)[1] for run in (runs.physics, runs.images, runs.both)]
    ready = time.perf_counter() - start
    rates = alternate([runs.physics, runs.images, runs.both], options.rounds, options.seconds)
    physics, images, both = (round(rate * batch * STEPS) for rate in rates)
    return {
        "scene": f"{env.suite}/{env.task}",
        "geometry": options.geometry,
        "size": size,
        "B": batch,
        "antialias": antialias,
        "env steps/s": both,
        "physics alone": physics,
        "images alone": images,
        "compile s": round(sum(first), 1),
        "ready s": round(ready, 1),
        "triangles": int(scenery.model.nmeshface),
        "geoms": int(scenery.model.ngeom),
        "MiB on device": round(memory() / 2**20),
        **(quality(scenery, f"{env.suite}_{env.task}", rays, options) if options.references else {}),
    }


def memory() -> int:
    """Peak bytes that JAX had on the device; Warp's own are not in it."""
    stats = jax.devices()[0].memory_stats() or {}
    return int(stats.get("peak_bytes_in_use", 0))


class Loops:
    """Three compiled loops over the same batch, each of ``STEPS`` control steps.

    What a loop returns depends on every pixel, as a policy would.
    """

    def __init__(self, env: FunctionalLibero, tracer: RayTracer, batch: int) -> None:
        keys = jax.random.split(jax.random.key(0), batch)
        step, self._look = jax.vmap(env.step), jax.vmap(tracer.look)
        self._state = jit(jax.vmap(env.reset))(keys)
        actions = jax.random.uniform(jax.random.key(1), (STEPS, batch, env.action_size), minval=-1, maxval=1)
        self._actions = actions

        def physics(state: Any, actions: jax.Array) -> Any:
            return lax.scan(lambda s, a: (step(s, a), jnp.zeros(())), state, actions)

        def both(state: Any, actions: jax.Array) -> Any:
            def tick(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
                state = step(state, action)
                return state, self._seen(state.data.xpos, state)

            return lax.scan(tick, state, actions)

        def images(state: Any, actions: jax.Array) -> Any:
            def tick(xpos: jax.Array, _: jax.Array) -> tuple[Any, jax.Array]:
                xpos = xpos + 1e-4
                return xpos, self._seen(xpos, state)

            return lax.scan(tick, state.data.xpos, actions)

        self._physics, self._both, self._images = jit(physics), jit(both), jit(images)

    def _seen(self, xpos: jax.Array, state: Any) -> jax.Array:
        rgb = self._look(xpos, state.data.xquat, state.data.qpos).rgb
        assert rgb is not None
        return rgb.sum(dtype=jnp.uint32)

    def physics(self) -> Any:
        """Physics alone; the state goes on from call to call."""
        self._state, out = self._physics(self._state, self._actions)
        return out

    def both(self) -> Any:
        """Physics, then images, every control step."""
        self._state, out = self._both(self._state, self._actions)
        return out

    def images(self) -> Any:
        """Images alone."""
        return self._images(self._state, self._actions)[1]


def quality(scenery: Scenery, scene: str, rays: dict[str, Any], options: argparse.Namespace) -> dict[str, Any]:
    """How close the images are to GL's: the lowest and the mean PSNR, dB, and the lowest IoU of an instance's masks.

    Args:
        scenery: of the scene.
        scene: ``suite_task``.
        rays: options of ``RayTracer``.
        options: the command line.
    """
    path = options.references / f"{scene}_{rays['width']}.npz"
    if not path.exists():
        return {"PSNR min": "-", "PSNR mean": "-", "IoU min": "-"}
    with np.load(path) as file:
        reference = dict(file)
    tracer = RayTracer(scenery, **rays, segmentation=True)
    seen = jit(jax.vmap(tracer.look))(reference["xpos"], reference["xquat"], reference["qpos"])
    rgb, seg = np.asarray(seen.rgb), np.asarray(seen.segmentation)
    ratios = [psnr(a, b) for a, b in zip(merged(rgb), merged(reference["rgb"]), strict=True)]
    overlaps = ious(seg, reference["seg"])
    if options.images:
        save_images(options.images / f"{path.stem}.png", reference["rgb"], rgb)
    return {
        "PSNR min": round(min(ratios), 1),
        "PSNR mean": round(float(np.mean(ratios)), 1),
        "IoU min": round(min(overlaps), 3),
    }


def merged(images: np.ndarray) -> np.ndarray:
    """States and cameras on one axis."""
    return images.reshape(-1, *images.shape[2:])


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two uint8 images, dB."""
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-9)))


def ious(a: np.ndarray, b: np.ndarray) -> list[float]:
    """Overlap of the masks, over all images together, of every instance that the second ones show enough of."""
    counts = np.bincount(b.ravel())
    shown = np.flatnonzero(counts >= LEAST_PIXELS)
    return [float(((a == i) & (b == i)).sum() / ((a == i) | (b == i)).sum()) for i in shown]


def save_images(path: Path, left: np.ndarray, right: np.ndarray) -> None:
    """GL's image and the ray tracer's side by side, a row for each camera of the first and last state."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [np.concatenate([left[i, c], right[i, c]], axis=1) for i in (0, -1) for c in range(left.shape[1])]
    Image.fromarray(np.concatenate(rows)).save(path)


def write(options: argparse.Namespace) -> None:
    """Sceneries and references of the scenes."""
    from vecenv.libero.render.scenery import scenery_of
    from vecenv.libero.scene.scene import compile_scene
    from vecenv.libero.tasks.suites import list_tasks

    for scene in options.scene:
        suite, task = scene.rsplit("/", 1)
        problem = list_tasks(suite)[int(task)].problem()
        options.sceneries.mkdir(parents=True, exist_ok=True)
        scenery_of(compile_scene(problem, visual=True)).save(options.sceneries / f"{suite}_{task}.npz")
        for size in options.size if options.references else ():
            options.references.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(options.references / f"{suite}_{task}_{size}.npz", **references(suite, int(task), size))


def references(suite: str, task: int, size: int) -> dict[str, Any]:
    """States of two episodes, at their start and after eight random actions, and GL's images of them."""
    import vecenv
    from vecenv.libero.render.options import RenderConfig

    env = vecenv.make(suite, task=task, episodes=[0, 7], render=RenderConfig(height=size, width=size))
    env.reset()
    found = [snapshot(env)]
    for action in np.random.default_rng(0).uniform(-1, 1, (8, 2, 7)):
        env.step_continuous(action)
    found.append(snapshot(env))
    env.close()
    return {key: np.concatenate([each[key] for each in found]) for key in found[0]}


def snapshot(env: Any) -> dict[str, np.ndarray]:
    """The poses of a batch's bodies, its joints, and what its cameras show."""
    from vecenv.libero.render.raytrace import poses

    seen, (group,) = env.observe_egocentric(), env.physics.groups
    xpos, xquat = poses(group.scene.model, group.seen_qpos, group.expand("body_pos"), group.expand("body_quat"))
    return {
        "xpos": xpos,
        "xquat": xquat,
        "qpos": group.seen_qpos.astype(np.float32),
        "rgb": np.stack([seen.images[camera] for camera in POLICY_CAMERAS], axis=1),
        "seg": np.stack([seen.segmentations[camera] for camera in POLICY_CAMERAS], axis=1),
    }


if __name__ == "__main__":
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    main()
