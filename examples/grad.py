"""Derivatives of a short rollout with respect to its actions, through ``impl="jax"``, held against finite differences.

    python examples/grad.py
    python examples/grad.py --task 3 --ticks 4 --mode reverse

In: a LIBERO task and a number of ticks. Out: a table with one row an action component: the derivative of the distance
between hand and target at the end (metres a unit of action), the central difference of the same, and by how much they
differ; the exit status is 1 where they do not agree. In float64, unless ``--float32``.

Lean geometry, because pure JAX evaluates every pair of geoms. The constraint solver's derivatives are those of the
minimum that it finds, so that both modes go through any number of its iterations: forward mode costs a rollout for
every component of the actions, reverse mode one backward pass for all and memory for every substep. The gripper's
action has derivative 0: only its sign counts.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from vecenv.libero import functional

AXES = ("x", "y", "z", "rx", "ry", "rz", "gripper")
MODES = ("forward", "reverse")
# Of finite differences. Rotations are rounded to float32 on their way to the controller, as robosuite rounds them: too
# small a difference drowns in that. Too large a one meets kinks, where something begins to slide.
SIZES, SIZES_FLOAT32 = (1e-4,) * 3 + (3e-4,) * 4, (0.02,) * 7


def make_env(suite: str, task: int, scenes: str | None = None) -> functional.FunctionalLibero:
    """A task in pure JAX."""
    options = {"impl": "jax", "geometry": "lean", "objective": "reach", "scenes": scenes}
    return functional.FunctionalLibero(suite, task=task, config_overrides=options)


def rollout(env: functional.FunctionalLibero, state: functional.FunctionalState, actions: jax.Array) -> jax.Array:
    """Distance between hand and target, metres, after some actions, [T, 7]."""
    state, _ = jax.lax.scan(lambda state, action: (env.step(state, action), None), state, actions)
    target = env.mj_model.body(env.scene.entities[env.target].root_body).id
    return jnp.linalg.norm(state.data.xpos[target] - state.data.world.eef_pos)


def derivatives(
    env: functional.FunctionalLibero, state: functional.FunctionalState, actions: jax.Array, mode: str
) -> tuple[jax.Array, Callable[[jax.Array], jax.Array]]:
    """Derivatives [T, 7] of the distance, and the distance itself as a function of the actions.

    One compiled function serves both: compiling takes longer than anything else here.
    """
    if mode == "reverse":
        both = functional.jit(jax.value_and_grad(lambda actions: rollout(env, state, actions)))
        return both(actions)[1], lambda actions: both(actions)[0]

    @functional.jit
    def along(actions: jax.Array, direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.jvp(lambda actions: rollout(env, state, actions), (actions,), (direction,))

    slopes = [along(actions, direction)[1] for direction in directions(actions)]
    return jnp.stack(slopes).reshape(actions.shape), lambda x: along(x, jnp.zeros_like(x))[0]


def directions(actions: jax.Array) -> jax.Array:
    """Each component of the actions by itself, [T * 7, T, 7]."""
    return jnp.eye(actions.size, dtype=actions.dtype).reshape(-1, *actions.shape)


def differences(distance: Callable[[jax.Array], jax.Array], actions: jax.Array, sizes: Sequence[float]) -> jax.Array:
    """Central differences of the distance, [T, 7]; a size for each component of an action."""
    slopes = [
        (distance(actions + size * direction) - distance(actions - size * direction)) / (2 * size)
        for size, direction in zip(itertools.cycle(sizes), directions(actions))
    ]
    return jnp.stack(slopes).reshape(actions.shape)


def print_table(slopes: np.ndarray, checks: np.ndarray) -> None:
    """A row an action component; derivatives [T, 7] and differences [T, 7]."""
    print(f"{'tick':>4} {'action':>8} {'derivative':>14} {'difference':>14} {'off by':>10}")
    for tick, name in np.ndindex(slopes.shape):
        slope, check = slopes[tick, name], checks[tick, name]
        print(f"{tick:>4} {AXES[name]:>8} {slope:>14.6e} {check:>14.6e} {abs(slope - check):>10.1e}")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description="Derivatives of a rollout with respect to its actions.")
    made.add_argument("--suite", default="libero_object")
    made.add_argument("--task", type=int, default=0)
    made.add_argument("--scenes", help="a folder that `vecenv compile` wrote, in place of the installed packages")
    made.add_argument("--ticks", type=int, default=2, help="length of the rollout, 50 ms each")
    made.add_argument("--mode", choices=MODES, default="forward")
    made.add_argument("--float32", action="store_true")
    made.add_argument("--seed", type=int, default=0, help="of the start and the actions")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; 0 where derivatives and differences agree."""
    command = parser()
    args = command.parse_args(argv)
    if args.ticks < 1:
        command.error(f"--ticks {args.ticks}: expected at least 1")
    with jax.enable_x64(not args.float32):
        try:
            env = make_env(args.suite, args.task, args.scenes)
        except (ValueError, LookupError, RuntimeError) as error:
            command.error(str(error))
        return 0 if compare(env, args) else 1


def compare(env: functional.FunctionalLibero, args: argparse.Namespace) -> bool:
    """Print the table; whether derivatives and differences agree."""
    state = functional.jit(env.reset)(jax.random.key(args.seed))
    # Away from -1 and 1, where actions are clipped, and from the gripper's 0.
    actions = jnp.asarray(np.random.default_rng(args.seed).uniform(0.1, 0.6, (args.ticks, 7)), float)
    began = time.perf_counter()
    slopes, distance = derivatives(env, state, actions, args.mode)
    checks = np.asarray(differences(distance, actions, SIZES_FLOAT32 if args.float32 else SIZES))
    print_table(np.asarray(slopes), checks)
    worst = np.abs(np.asarray(slopes) - checks).max() / np.abs(checks).max()
    print(f"off by at most {worst:.1e} of the largest, {args.mode} mode, {time.perf_counter() - began:.0f} s")
    return bool(worst < (0.05 if args.float32 else 0.01))


if __name__ == "__main__":
    sys.exit(main())
