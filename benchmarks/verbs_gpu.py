"""Control steps a second through the verbs on a GPU, with both cameras' images at every control step.

As a policy calls them: ``step_continuous`` with random actions, then ``observe_egocentric``. Modes, which take turns:

*physics*: no images.
*device*: both images as JAX arrays on the device, ``images_device``.
*jax*: the same with ``arrays="jax"`` and actions from the device.
*numpy*: both images as NumPy arrays, ``observation``.

A second table says where a control step goes: the same calls with a wait for the device after each part. Nothing else
may use the GPU meanwhile. ``--scenes`` is a folder that ``vecenv compile --images rays`` wrote.
"""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
import time
from collections.abc import Callable
from typing import Any, cast

import jax
import numpy as np
from common import RESULTS, ROOT, fill_table, report
from mjx import alternate, timed_first

import vecenv
from vecenv.libero.render.options import POLICY_CAMERAS, RenderConfig

MODES = ("physics", "device", "jax", "numpy")


def main() -> None:
    """Measure what the command line asks for."""
    options = arguments()
    if options.table:
        print(fill_table("verbs_gpu", RESULTS / f"{options.name}.json", ROOT / "docs" / "rendering.md"))
        return
    rows: list[dict[str, Any]] = []
    for scene, geometry, batch in itertools.product(options.scene, options.geometry, options.batch):
        rows.append(measure(scene, geometry, batch, options))
        print(rows[-1], flush=True)
    report(
        options.name, rows, title="Control steps a second through the verbs", notes={"device": str(jax.devices()[0])}
    )


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=["libero_object/0"], help="suite/task")
    parser.add_argument("--geometry", nargs="+", default=["lean", "exact"])
    parser.add_argument("--batch", nargs="+", type=int, default=[1024])
    parser.add_argument("--modes", nargs="+", choices=MODES, default=MODES)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--antialias", action="store_true", help="four rays a pixel at edges")
    parser.add_argument("--backend", default="warp")
    parser.add_argument("--devices", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each side a round")
    parser.add_argument("--scenes", help="folder that `vecenv compile` wrote")
    parser.add_argument("--name", default="verbs_gpu", help="name of the results file")
    parser.add_argument("--table", action="store_true", help="fill the table of docs/rendering.md, measure nothing")
    return parser.parse_args()


def measure(scene: str, geometry: str, batch: int, options: argparse.Namespace) -> dict[str, Any]:
    """One row."""
    start = time.perf_counter()
    sides = {mode: Side(mode, scene, geometry, batch, options) for mode in options.modes}
    first = {mode: round(timed_first(cast(Any, side.tick))[1], 1) for mode, side in sides.items()}
    ready = time.perf_counter() - start
    rates = alternate([side.tick for side in sides.values()], options.rounds, options.seconds)
    row: dict[str, Any] = {"scene": scene, "geometry": geometry, "B": batch, "size": options.size}
    row |= {f"{mode} steps/s": round(rate * batch) for mode, rate in zip(sides, rates, strict=True)}
    row |= {"compile s": round(sum(first.values()), 1), "ready s": round(ready, 1)}
    if "numpy" in sides:
        row |= sides["numpy"].parts()
    for side in sides.values():
        side.env.close()
    return row


class Side:
    """A batch and what a policy of one mode calls."""

    def __init__(self, mode: str, scene: str, geometry: str, batch: int, options: argparse.Namespace) -> None:
        suite, task = scene.rsplit("/", 1)
        self.env: Any = vecenv.make(
            suite,
            task=int(task),
            episodes=[i % 50 for i in range(batch)],
            backend=options.backend,
            geometry=geometry,
            num_devices=options.devices,
            scenes=options.scenes,
            arrays="jax" if mode == "jax" else "numpy",
            render=RenderConfig(
                engine="raytrace", lod="fast", height=options.size, width=options.size, antialias=options.antialias
            ),
            max_steps=10**6,
            success="final",
        )
        self.env.reset()
        actions = np.random.default_rng(0).uniform(-1, 1, (16, batch, 7))
        actions = np.concatenate([actions, -actions])  # there and back
        self._actions = itertools.cycle(jax.numpy.asarray(actions) if mode == "jax" else actions)
        self._look: Callable[[], Any] = {
            "physics": lambda: None,
            "device": self._on_device,
            "jax": self._on_device,
            "numpy": lambda: self.env.observe_egocentric().observation,
        }[mode]

    def tick(self) -> Any:
        """One control step and a look at it."""
        self.env.step_continuous(next(self._actions))
        return self._look()

    def _on_device(self) -> Any:
        return on_device(self.env.observe_egocentric())

    def parts(self, repeats: int = 10) -> dict[str, float]:
        """Milliseconds of each part of a control step, medians."""
        found: dict[str, list[float]] = {}

        def timed(name: str, call: Callable[..., Any], *args: Any) -> None:
            start = time.perf_counter()
            jax.block_until_ready(call(*args))
            found.setdefault(name, []).append(1000 * (time.perf_counter() - start))

        for _ in range(repeats):
            timed("step ms", lambda: self.env.step_continuous(next(self._actions)).success)
            timed("observe ms", lambda: self.env.observe_egocentric().state)
            seen = self.env.observe_egocentric()
            timed("rays ms", on_device, seen)
            timed("to NumPy ms", getattr, seen, "observation")
        return {name: round(statistics.median(values), 1) for name, values in found.items()}


def on_device(seen: Any) -> list[jax.Array]:
    """Both policy cameras' images on the device."""
    seen.images_device.prepare(*POLICY_CAMERAS)
    return [seen.images_device[name] for name in POLICY_CAMERAS]


if __name__ == "__main__":
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    main()
