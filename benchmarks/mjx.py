"""Control steps a second on MJX, controller and verdicts included, against a bare loop of ``mjx.step`` in the same run.

For every scene, geometry and batch size: the environment runs a chunk of random actions; the bare loop steps the same
number of substeps through the same states with the same memory: every control tick begins where the environment's
began and holds the commands with which it ended, so both meet the same contacts. Both are compiled; the two take turns.
Also: seconds to compile, device memory, and how many worlds ran out of contact or constraint memory.

With ``--devices N`` the batch is spread over N devices, and the other side is one device with its share of it.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import subprocess
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import report
from jax import lax
from mujoco import mjx

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.physics.base import SUBSTEPS
from vecenv.libero.physics.mjx.backend import MjxGroup
from vecenv.libero.physics.mjx.options import jit
from vecenv.libero.physics.mjx.step import World, control_step
from vecenv.libero.scene.contacts import CONTACTS

CHUNK = 10
# Messages of XLA, CUDA and Warp.
OUT_OF_MEMORY = ("resource_exhausted", "out of memory", "failed to allocate")


def main() -> None:
    """Measure what the command line asks for."""
    options = arguments()
    rows: list[dict[str, Any]] = []
    cases = itertools.product(options.scene, options.geometry, options.batch, options.contacts)
    for scene, geometry, batch, contacts in cases:
        case = {"scene": scene, "geometry": geometry, "contacts": contacts, "B": batch}
        try:
            rows.append(case | measure(scene, geometry, batch, contacts, options))
        except Exception as error:
            if not any(sign in str(error).lower() for sign in OUT_OF_MEMORY):
                raise
            rows.append(dict.fromkeys(rows[0] if rows else (), "-") | case)
            print(f"{scene} {geometry} {contacts} B={batch}: out of memory", flush=True)
        print(rows[-1], flush=True)
    report(options.name, rows, title="MJX: control steps a second", notes={"device": str(jax.devices()[0])})


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=["libero_object/0", "libero_spatial/0"], help="suite/task")
    parser.add_argument("--geometry", nargs="+", default=["exact", "lean"])
    parser.add_argument("--contacts", nargs="+", default=["published"], choices=CONTACTS, help="see `vecenv.make`")
    parser.add_argument("--backend", default="mjx")
    parser.add_argument("--batch", nargs="+", type=int, default=[64])
    parser.add_argument("--devices", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each side a round")
    parser.add_argument("--scenes", help="folder that `vecenv compile` wrote")
    parser.add_argument("--name", default="mjx", help="name of the results file")
    return parser.parse_args()


def measure(scene: str, geometry: str, batch: int, contacts: str, options: argparse.Namespace) -> dict[str, Any]:
    """What is measured in one case."""
    before = used_memory()
    start = time.perf_counter()
    env = ready_env(scene, geometry, batch, contacts, options.devices, options)
    ready = time.perf_counter() - start
    group: MjxGroup = env.physics.groups[0]
    ours, compile_seconds = timed_first(environment(group))
    memory = used_memory() - before
    if options.devices > 1:
        return compare_devices(ours, env, scene, geometry, batch, contacts, options) | {
            "ready s": round(ready, 1),
            "compile s": round(compile_seconds, 1),
        }
    start = jax.tree.map(jnp.copy, group.worlds)
    ours, _ = timed_first(environment(group, start))
    theirs, _ = timed_first(bare(group, start))
    rates = alternate([ours, theirs], options.rounds, options.seconds)
    failed = int((np.asarray(group.worlds.fault) != 0).sum())
    row = {
        "impl": group.built.impl,
        "geoms": int(
            (np.asarray(group.scene.model.geom_contype) | np.asarray(group.scene.model.geom_conaffinity) > 0).sum()
        ),
        "env / bare": round(rates[0] / rates[1], 3),
        "env steps/s": round(rates[0] * batch * CHUNK),
        "bare steps/s": round(rates[1] * batch * CHUNK),
        "ready s": round(ready, 1),
        "compile s": round(compile_seconds, 1),
        "MiB a world": round(memory / batch, 2) if memory else "-",
        "faults": failed,
    }
    env.close()
    return row


def ready_env(
    scene: str, geometry: str, batch: int, contacts: str, devices: int, options: argparse.Namespace
) -> LiberoEnv:
    """A batch at its starts."""
    suite, task = scene.rsplit("/", 1)
    env = vecenv.make(
        suite,
        task=int(task),
        episodes=[i % 50 for i in range(batch)],
        backend=options.backend,
        geometry=geometry,
        contacts=contacts,
        num_devices=devices,
        scenes=options.scenes,
    )
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def compare_devices(
    ours: Callable[[], Any],
    env: LiberoEnv,
    scene: str,
    geometry: str,
    batch: int,
    contacts: str,
    options: argparse.Namespace,
) -> dict[str, Any]:
    """The batch over several devices against its share on one."""
    share = batch // options.devices
    single = ready_env(scene, geometry, share, contacts, 1, options)
    alone, _ = timed_first(environment(single.physics.groups[0]))
    rates = alternate([ours, alone], options.rounds, options.seconds)
    failed = sum(int((np.asarray(e.physics.groups[0].worlds.fault) != 0).sum()) for e in (env, single))
    for each in (env, single):
        each.close()
    return {
        "devices": options.devices,
        "all / one": round(rates[0] * batch / (rates[1] * share), 3),
        "env steps/s": round(rates[0] * batch * CHUNK),
        "one device steps/s": round(rates[1] * share * CHUNK),
        "faults": failed,
    }


def there_and_back(group: MjxGroup) -> jax.Array:
    """Actions [B, CHUNK, 7]: a random one held for some ticks, then its opposite."""
    there = np.random.default_rng(0).uniform(-1, 1, (len(group.slots), 1, 7))
    held = np.repeat(there, CHUNK // 2, axis=1)
    return group.put(np.concatenate([held, -held], axis=1))


def environment(group: MjxGroup, start: World | None = None) -> Callable[[], jax.Array]:
    """Run a chunk, each time from ``start``; without it each call continues from the last."""
    n = len(group.slots)
    chunk, active, limit = there_and_back(group), group.put_mask(np.ones(n, bool)), group.put(np.full(n, 10**6))

    def run() -> jax.Array:
        assert group.table is not None
        worlds = group.worlds if start is None else jax.tree.map(jnp.copy, start)
        loop = group.compiled.run(True)(group.system, group.table, worlds, chunk, active, limit)
        group.replace(loop.worlds)
        return loop.ticks

    return run


def bare(group: MjxGroup, start: World) -> Callable[[], jax.Array]:
    """Step the physics alone through the ticks of the same chunk."""
    act = jax.vmap(control_step, in_axes=(None, 0, 0))
    step = jax.vmap(mjx.step, in_axes=(None, 0))

    def tick(worlds: World, action: jax.Array) -> tuple[World, tuple[jax.Array, ...]]:
        after = act(group.system, worlds, action)
        return after, (worlds.data.qpos, worlds.data.qvel, after.data.ctrl)

    def bare_tick(data: mjx.Data, given: tuple[jax.Array, ...]) -> tuple[mjx.Data, None]:
        qpos, qvel, ctrl = given
        data = data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        return lax.scan(lambda d, _: (step(group.system.model, d), None), data, None, length=SUBSTEPS)[0], None

    ticks = jit(lambda worlds, actions: lax.scan(tick, worlds, actions)[1])(start, there_and_back(group).swapaxes(0, 1))
    many = jit(lambda data, ticks: lax.scan(bare_tick, data, ticks)[0].qpos)
    return lambda: many(start.data, ticks)


def timed_first(run: Callable[[], jax.Array]) -> tuple[Callable[[], jax.Array], float]:
    """The function, and the seconds its first call takes beyond its second."""
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - start)
    return run, max(seconds[0] - seconds[1], 0.0)


def alternate(runs: Sequence[Callable[[], object] | None], rounds: int, seconds: float) -> list[float]:
    """Calls a second of each, the median over the rounds."""
    found: list[list[float]] = [[] for _ in runs]
    for _ in range(rounds):
        for run, rates in zip(runs, found, strict=True):
            if run is not None:
                rates.append(rate(run, seconds))
    return [statistics.median(rates) if rates else 0.0 for rates in found]


def rate(run: Callable[[], object], seconds: float) -> float:
    """Calls a second over at least so many seconds."""
    start, calls, elapsed = time.perf_counter(), 0, 0.0
    while elapsed < seconds:
        jax.block_until_ready(run())
        calls, elapsed = calls + 1, time.perf_counter() - start
    return calls / elapsed


def used_memory() -> float:
    """MiB in use on the first device; 0 where it is not known."""
    if jax.devices()[0].platform == "cpu":
        return 0.0
    query = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits"]
    return float(subprocess.run(query, capture_output=True, text=True, check=True).stdout.split()[0])


if __name__ == "__main__":
    main()
