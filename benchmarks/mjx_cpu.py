"""MJX on a CPU: control steps a second beside native MuJoCo, XLA's fusion trap, and how long compiling takes.

The rows: the batched environment on ``impl="jax"`` with lean geometry against the native backend on the same scene
and actions, in alternation, and the processor time of all cores that a step takes, which others' work changes little.
Beside them in the file, "fusion trap": a function compiled with the options of
``vecenv.libero.physics.mjx.options.compiler_options`` and without; and "compile": seconds to trace and to compile a
chunk of control steps in a process with empty caches, and in a second process that finds them.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from common import report

if TYPE_CHECKING:
    from vecenv.libero.env import LiberoEnv

TICKS = 4
PART = "--part"


def main() -> None:
    """Measure what the command line asks for."""
    options = arguments()
    if options.part:
        print(json.dumps(PARTS[options.part](options)))
        return
    speeds = [apart("speed", options, scene=scene) for scene in options.scene]
    traps = [apart("trap", options, scene=options.scene[0], function=name) for name in options.function]
    compiling = [compiled_twice(backend, scene, options) for backend in options.backend for scene in options.compile]
    for row in traps + compiling:
        print(row)
    notes = {"fusion trap": traps, "compile": compiling}
    report("mjx_cpu", speeds, title="MJX on a CPU: control steps a second", notes=notes)


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=["libero_object/0", "libero_spatial/0"], help="suite/task")
    parser.add_argument("--compile", nargs="*", default=["libero_object/0", "libero_spatial/0", "libero_goal/0"])
    parser.add_argument("--backend", nargs="*", default=["jax", "warp"], help="whose compiling is timed")
    parser.add_argument("--function", nargs="*", default=["kinematics"], help="or substep, much slower")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=5.0, help="of each side a round")
    parser.add_argument("--quick", action="store_true", help="one scene, two short rounds, one compilation a backend")
    parser.add_argument(PART, choices=tuple(PARTS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.quick:
        options.scene, options.compile = options.scene[:1], options.compile[:1]
        options.rounds, options.seconds = 2, 2.0
    return options


def apart(part: str, options: argparse.Namespace, **given: str) -> dict[str, Any]:
    """A row measured by a process of its own; ``folder`` is where its caches lie, those of the user otherwise."""
    folder = given.pop("folder", None)
    caches = {"JAX_COMPILATION_CACHE_DIR": f"{folder}/jax", "WARP_CACHE_PATH": f"{folder}/warp"} if folder else {}
    command = [sys.executable, __file__, PART, part, "--batch", str(options.batch), "--rounds", str(options.rounds)]
    command += ["--seconds", str(options.seconds), *(word for k, v in given.items() for word in (f"--{k}", v))]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", **caches}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


# -- control steps -----------------------------------------------------------------------------------------------------


def speed(options: argparse.Namespace) -> dict[str, Any]:
    """Control steps a second on ``impl="jax"`` and on native physics."""
    from mjx import alternate

    (scene,), batch = options.scene, options.batch
    sides = [chunk_runner(scene, backend, batch) for backend in ("jax", "native")]
    began = time.perf_counter()
    for run in sides:
        run()
    first = time.perf_counter() - began
    rates = [calls * batch * TICKS for calls in alternate(list(sides), options.rounds, options.seconds)]
    work = [processor_seconds(run) / (batch * TICKS) for run in sides]
    return {
        "scene": scene,
        "backend": "jax",
        "geometry": "lean",
        "B": batch,
        "jax / native": round(rates[0] / rates[1], 4),
        "env steps/s": round(rates[0], 1),
        "native steps/s": round(rates[1], 1),
        "CPU ms a step": round(1e3 * work[0], 2),
        "native CPU ms": round(1e3 * work[1], 2),
        "first call s": round(first, 1),
    }


def processor_seconds(run: Callable[[], object]) -> float:
    """Seconds of all cores that a call takes, which other load on the machine changes little."""
    began = time.process_time()
    run()
    run()
    return (time.process_time() - began) / 2


def chunk_runner(scene: str, backend: str, batch: int) -> Callable[[], np.ndarray]:
    """A function that gives every slot some random actions and then their opposites, from where the last call ended."""
    env = ready_env(scene, backend, batch)
    there = np.random.default_rng(0).uniform(-1, 1, (batch, 1, 7))
    chunk = np.concatenate([np.repeat(there, TICKS // 2, axis=1), np.repeat(-there, TICKS // 2, axis=1)], axis=1)
    everyone, limit = np.ones(batch, bool), np.full(batch, 10**6)

    def run() -> np.ndarray:
        ran = env.physics.run(chunk, everyone, limit)
        if env.physics.faults:
            raise RuntimeError(f"{scene} {backend}: {env.physics.faults}")
        return ran.ticks

    return run


def ready_env(scene: str, backend: str, batch: int) -> LiberoEnv:
    """A live batch with lean geometry."""
    import vecenv
    from vecenv.libero.env import LiberoEnv

    suite, task = scene.rsplit("/", 1)
    episodes = [i % 50 for i in range(batch)]
    env = vecenv.make(suite, task=int(task), episodes=episodes, backend=backend, geometry="lean")
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


# -- the fusion trap ---------------------------------------------------------------------------------------------------


def trap(options: argparse.Namespace) -> dict[str, Any]:
    """One function, compiled with our options and without."""
    import jax
    from mjx import alternate
    from mujoco import mjx

    from vecenv.libero.physics.mjx.options import compiler_options
    from vecenv.libero.physics.mjx.step import substep

    (scene,), (name,) = options.scene, options.function
    (group,) = ready_env(scene, "jax", 1).physics.groups
    functions: dict[str, Callable[..., Any]] = {"kinematics": mjx.kinematics, "substep": substep}
    mapped, arguments = jax.vmap(functions[name], in_axes=(None, 0)), (group.system.model, group.worlds.data)
    ours, plain = jax.jit(mapped, compiler_options=compiler_options()), jax.jit(mapped)
    for run in (ours, plain):
        jax.block_until_ready(run(*arguments))
    sides = [lambda: ours(*arguments), lambda: plain(*arguments)]
    rates = alternate(list(sides), options.rounds, options.seconds)
    return {
        "scene": scene,
        "backend": "jax",
        "geometry": "lean",
        "function": name,
        "B": 1,
        "with options / without": round(rates[0] / rates[1], 1),
        "with options, ms": round(1e3 / rates[0], 3),
        "without, ms": round(1e3 / rates[1], 3),
    }


# -- compiling ---------------------------------------------------------------------------------------------------------


def compiled_twice(backend: str, scene: str, options: argparse.Namespace) -> dict[str, Any]:
    """A row: with empty caches, and in another process that finds what the first one left."""
    with tempfile.TemporaryDirectory() as folder:
        cold, warm = (apart("compile", options, backend=backend, compile=scene, folder=folder) for _ in range(2))
    row = {"scene": scene, "backend": backend, "geometry": "lean", "B": options.batch}
    for name, found in (("cold", cold), ("warm", warm)):
        row |= {f"{name}: {column}": value for column, value in found.items()}
    return row


def compile_seconds(options: argparse.Namespace) -> dict[str, Any]:
    """Seconds until a batch is at its starts, to trace a chunk of control steps, to compile it, and to run it once."""
    import jax

    (backend,), (scene,), n = options.backend, options.compile, options.batch
    laps = [time.perf_counter()]
    (group,) = ready_env(scene, backend, n).physics.groups
    laps.append(time.perf_counter())
    chunk, everyone, limit = group.put(np.zeros((n, TICKS, 7))), group.put_mask(np.ones(n, bool)), group.put([9] * n)
    call = (group.system, group.table, group.worlds, chunk, everyone, limit)
    lowered = group.compiled.run(True).lower(*call)
    laps.append(time.perf_counter())
    program = lowered.compile()
    laps.append(time.perf_counter())
    jax.block_until_ready(program(*call).ticks)
    laps.append(time.perf_counter())
    names = ("start s", "trace s", "compile s", "first run s")
    return dict(zip(names, np.diff(laps).round(1).tolist(), strict=True))


PARTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "speed": speed,
    "trap": trap,
    "compile": compile_seconds,
}

if __name__ == "__main__":
    main()
