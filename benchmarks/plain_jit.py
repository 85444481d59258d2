"""The functional environment under plain ``jax.jit`` on a CPU: seconds to compile, and time of a call.

The other side is ``vecenv.libero.functional.jit``: no barriers between the levels of kinematic trees, and XLA's fusion
emitters off (``xla_cpu_use_fusion_emitters=False``, an option of jax 0.10). Each program is compiled on both sides in a
process of its own without the compilation cache, then called in turns. ``--without-either`` adds a row for
``mjx.kinematics`` with neither barriers nor the option, which is slow.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from common import report

if TYPE_CHECKING:
    from vecenv.libero.functional import FunctionalLibero

PART = "--part"
TICKS = 4
EMITTERS_OFF = {"xla_cpu_use_fusion_emitters": False}


def main() -> None:
    """Measure what the command line asks for."""
    options = arguments()
    if options.part:
        print(json.dumps(measured(options)))
        return
    wanted = [(name, batch) for name in options.function for batch in (options.batch if name != "grad" else [1])]
    rows = [apart(options, name, batch) for name, batch in wanted]
    if options.without_either:
        rows.append(apart(options, "kinematics", 1))
    report("plain_jit", rows, title="Plain jax.jit of the functional environment on a CPU")


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="libero_object/0", help="suite/task")
    parser.add_argument("--function", nargs="+", default=["reset", "step", "scan", "grad"], choices=tuple(PROGRAMS))
    parser.add_argument("--batch", nargs="+", type=int, default=[1, 32], help="worlds; grad has one")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each side a round")
    parser.add_argument("--without-either", action="store_true", help="also mjx.kinematics with neither")
    parser.add_argument(PART, action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def apart(options: argparse.Namespace, function: str, batch: int) -> dict[str, Any]:
    """A row measured by a process of its own."""
    command = [sys.executable, __file__, PART, "--scene", options.scene, "--function", function, "--batch", str(batch)]
    command += ["--rounds", str(options.rounds), "--seconds", str(options.seconds)]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_ENABLE_COMPILATION_CACHE": "0"}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    row = json.loads(done.stdout.splitlines()[-1])
    print(row, flush=True)
    return row


# -- programs ----------------------------------------------------------------------------------------------------------


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """Compile one program on both sides, then call both in turns."""
    import jax

    from vecenv.libero.physics.mjx.options import without_barriers

    (name,), (batch,) = options.function, options.batch
    env = make_env(options.scene, name)
    program, arguments = PROGRAMS[name](env, batch)
    plain, costs = compiled(jax.jit(program), arguments)
    # Another function, because JAX remembers what it has traced.
    program, _ = PROGRAMS[name](env, batch)
    with without_barriers():
        emitters = {} if name == "kinematics" else EMITTERS_OFF
        other, others = compiled(jax.jit(program, compiler_options=emitters), arguments)
    walls, works = in_turns([lambda: plain(*arguments), lambda: other(*arguments)], options.rounds, options.seconds)
    return {
        "program": name,
        "B": batch,
        "compile s": round(costs[0], 1),
        "compile CPU s": round(costs[1], 1),
        "functional.jit compile s": round(others[0], 1),
        "functional.jit compile CPU s": round(others[1], 1),
        "ms": round(1e3 * walls[0], 2),
        "functional.jit ms": round(1e3 * walls[1], 2),
        "time, jax.jit / functional.jit": round(walls[0] / walls[1], 3),
        "CPU time, jax.jit / functional.jit": round(works[0] / works[1], 3),
    }


def compiled(function: Any, arguments: tuple[Any, ...]) -> tuple[Callable[..., Any], tuple[float, float]]:
    """A compiled program, and the seconds and processor seconds that its compilation took, without tracing."""
    lowered = function.lower(*arguments)
    began, work = time.perf_counter(), time.process_time()
    program = lowered.compile()
    return program, (time.perf_counter() - began, time.process_time() - work)


def in_turns(
    sides: list[Callable[[], object]], rounds: int, seconds: float
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Seconds and processor seconds (of all cores) a call of each side: medians over the rounds."""
    found: list[list[tuple[float, float]]] = [[] for _ in sides]
    for _ in range(rounds):
        for run, side in zip(sides, found, strict=True):
            side.append(timed(run, seconds))
    medians = [[statistics.median(column) for column in zip(*side, strict=True)] for side in found]
    walls, works = zip(*medians, strict=True)
    return walls, works


def timed(run: Callable[[], object], seconds: float) -> tuple[float, float]:
    """Seconds and processor seconds of a call, over at least so many seconds."""
    import jax

    jax.block_until_ready(run())
    began, work, calls = time.perf_counter(), time.process_time(), 0
    while calls == 0 or time.perf_counter() - began < seconds:
        jax.block_until_ready(run())
        calls += 1
    return (time.perf_counter() - began) / calls, (time.process_time() - work) / calls


def make_env(scene: str, program: str) -> FunctionalLibero:
    """The environment in pure JAX with lean geometry; for grad with pyramidal cones."""
    from vecenv.libero.functional import FunctionalLibero

    suite, task = scene.rsplit("/", 1)
    options: dict[str, Any] = {"impl": "jax", "geometry": "lean"}
    if program == "grad":
        options |= {"cone": "pyramidal", "iterations": (1, 4)}
    return FunctionalLibero(suite, task=int(task), config_overrides=options)


def started(env: FunctionalLibero, batch: int) -> tuple[Any, Any]:
    """Keys and states of some worlds."""
    import jax

    keys = jax.random.split(jax.random.key(0), batch)
    return keys, jax.jit(jax.vmap(env.reset))(keys)


def reset(env: FunctionalLibero, batch: int) -> tuple[Any, tuple[Any, ...]]:
    """Resets of a batch."""
    import jax

    return jax.vmap(env.reset), (jax.random.split(jax.random.key(0), batch),)


def step(env: FunctionalLibero, batch: int) -> tuple[Any, tuple[Any, ...]]:
    """Steps of a batch."""
    import jax
    import jax.numpy as jnp

    return jax.vmap(env.step), (started(env, batch)[1], jnp.full((batch, 7), 0.2))


def scan(env: FunctionalLibero, batch: int) -> tuple[Any, tuple[Any, ...]]:
    """A reset and some steps in a ``scan``."""
    import jax
    import jax.numpy as jnp

    def rollout(keys: Any, actions: Any) -> Any:
        def tick(state: Any, action: Any) -> tuple[Any, Any]:
            state = jax.vmap(env.step)(state, action)
            return state, state.reward

        return jax.lax.scan(tick, jax.vmap(env.reset)(keys), actions)[0].obs

    return rollout, (jax.random.split(jax.random.key(0), batch), jnp.full((TICKS, batch, 7), 0.2))


def grad(env: FunctionalLibero, batch: int) -> tuple[Any, tuple[Any, ...]]:
    """Derivatives of the hand's height after a step with respect to the action, in reverse mode."""
    import jax
    import jax.numpy as jnp

    del batch
    state = jax.jit(env.reset)(jax.random.key(0))
    return jax.grad(lambda action: env.step(state, action).data.world.eef_pos[2]), (jnp.full(7, 0.1),)


def kinematics(env: FunctionalLibero, batch: int) -> tuple[Any, tuple[Any, ...]]:
    """MJX's kinematics alone."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    from vecenv.libero.physics.mjx import fusion

    def run(qpos: Any) -> Any:
        with fusion.level_by_level():
            return mjx.kinematics(env.mjx_model, data.replace(qpos=qpos)).xpos

    data = mjx.make_data(env.mj_model, impl="jax")
    return jax.vmap(run), (jnp.tile(data.qpos, (batch, 1)),)


PROGRAMS = {"reset": reset, "step": step, "scan": scan, "grad": grad, "kinematics": kinematics}

if __name__ == "__main__":
    main()
