"""Brax's PPO on one LIBERO task, through MuJoCo Playground's training wrapper.

    python examples/brax_ppo.py --objective reach --num-envs 2048 --steps 3_000_000 --out runs/brax_reach
    python examples/brax_ppo.py --randomize --restore runs/brax_reach/checkpoints/STEPS --out runs/more

Every episode begins in a start of its own (full resets), and ``--randomize`` gives every world friction, masses,
damping and gripper strength of its own. Out, in the folder ``--out``: ``curve.csv``, one row an evaluation,
``config.json``, and Brax's own checkpoints, from which ``--restore`` goes on with the networks and observation
statistics of an earlier run.
"""

from __future__ import annotations

import argparse
import csv
import functools
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from mujoco import mjx

from vecenv.libero.functional.objectives import OBJECTIVES
from vecenv.libero.scene.lean.geometry import PROFILES

try:
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo
    from mujoco_playground import State, wrapper

    from vecenv.interop import playground
except ImportError as error:
    raise SystemExit(
        f"examples/brax_ppo.py needs Brax and Playground: pip install 'vecenv[train]' ({error})"
    ) from error


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description="Brax PPO on one LIBERO task.")
    made.add_argument("--suite", default="libero_object")
    made.add_argument("--task", type=int, default=0)
    made.add_argument("--objective", choices=OBJECTIVES, default="reach")
    made.add_argument("--target", help="what to reach or lift; the first object the task is about by default")
    made.add_argument("--geometry", choices=PROFILES, default="lean")
    made.add_argument("--impl", choices=("auto", "jax", "warp"), default="auto", help="auto: warp on CUDA, else jax")
    made.add_argument("--action", choices=("position", "osc"), default="position", help="position: without rotations")
    made.add_argument("--randomize", action="store_true", help="physics of its own for every world")
    made.add_argument("--scenes", help="a folder that `vecenv compile` wrote, in place of the installed packages")
    made.add_argument("--steps", type=_whole, default=3_000_000, help="environment steps to train for")
    made.add_argument("--num-envs", type=_whole, default=2048)
    made.add_argument("--num-eval-envs", type=_whole, default=256)
    made.add_argument("--num-evals", type=int, default=6)
    made.add_argument("--episode-length", type=int, default=100)
    made.add_argument("--action-repeat", type=int, default=1)
    made.add_argument("--unroll", type=int, default=16, help="actions of each world a batch")
    made.add_argument("--minibatches", type=int, default=8)
    made.add_argument("--epochs", type=int, default=4)
    made.add_argument("--learning-rate", type=float, default=1e-3)
    made.add_argument("--discount", type=float, default=0.97)
    made.add_argument("--entropy", type=float, default=1e-3)
    made.add_argument("--hidden", type=int, nargs="+", default=[256, 256, 128])
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--restore", type=Path, help="a folder below an earlier run's checkpoints/")
    made.add_argument("--out", type=Path, required=True, help="folder for curve and checkpoints")
    return made


def _whole(text: str) -> int:
    """An integer, also as 2e6."""
    number = float(text)
    if number != int(number):
        raise argparse.ArgumentTypeError(f"{text} is no whole number")
    return int(number)


class Upright(wrapper.Wrapper):
    """An environment whose actions have four numbers, position and gripper; the hand never turns."""

    @property
    def action_size(self) -> int:
        """Width of an action."""
        return 4

    def step(self, state: State, action: jax.Array) -> State:
        """Advance by one step; ``action`` is [4]."""
        return self.env.step(state, jnp.zeros(7, action.dtype).at[jnp.array([0, 1, 2, 6])].set(action))

    # Domain randomisation puts another model into what `unwrapped` returns, and steps that.

    @property
    def unwrapped(self) -> Any:
        """This environment."""
        return self

    @property
    def _mjx_model(self) -> mjx.Model:
        return self.env._mjx_model

    @_mjx_model.setter
    def _mjx_model(self, model: mjx.Model) -> None:
        self.env._mjx_model = model


def make_env(args: argparse.Namespace) -> Any:
    """The environment that the command line asks for, with the shaped reward."""
    options: dict[str, Any] = {name: getattr(args, name) for name in ("objective", "geometry", "episode_length")}
    given = {"target": args.target, "scenes": args.scenes, "impl": None if args.impl == "auto" else args.impl}
    options |= {name: value for name, value in given.items() if value is not None}
    env = playground.load(f"Libero/{args.suite}/{args.task}", config_overrides={"reward": "shaped", **options})
    return Upright(env) if args.action == "position" else env


class Curve:
    """Prints an evaluation and writes it to a file.

    Args:
        path: the file, made anew.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._began = path, time.perf_counter()
        self._path.unlink(missing_ok=True)

    def __call__(self, steps: int, metrics: Mapping[str, Any]) -> None:
        """What Brax calls with the environment steps so far and what it measured."""
        row = {
            "env_steps": steps,
            "seconds": round(time.perf_counter() - self._began, 3),
            "return": float(metrics["eval/episode_reward"]),
            "success": float(metrics["eval/episode_success"]),
            "length": float(metrics["eval/avg_episode_length"]),
            "faults": float(metrics["eval/episode_fault"]),
        }
        new = not self._path.exists()
        with self._path.open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if new:
                writer.writeheader()
            writer.writerow(row)
        print("  ".join(f"{name} {value:,.3f}" for name, value in row.items()), flush=True)


def train(env: Any, args: argparse.Namespace) -> Any:
    """Train; returns what Brax's ``train`` does: a maker of policies, parameters and the last metrics."""
    playground.mend_brax()
    checkpoints = (args.out / "checkpoints").resolve()
    checkpoints.mkdir(parents=True, exist_ok=True)
    widths = tuple(args.hidden)
    return ppo.train(
        environment=env,
        wrap_env_fn=playground.wrap_for_training,
        randomization_fn=playground.randomize if args.randomize else None,
        num_timesteps=args.steps,
        num_envs=args.num_envs,
        episode_length=args.episode_length,
        action_repeat=args.action_repeat,
        num_evals=args.num_evals,
        num_eval_envs=args.num_eval_envs,
        deterministic_eval=True,
        unroll_length=args.unroll,
        num_minibatches=args.minibatches,
        batch_size=args.num_envs // args.minibatches,
        num_updates_per_batch=args.epochs,
        learning_rate=args.learning_rate,
        discounting=args.discount,
        entropy_cost=args.entropy,
        clipping_epsilon=0.2,
        max_grad_norm=1.0,
        normalize_observations=True,
        network_factory=functools.partial(
            networks.make_ppo_networks, policy_hidden_layer_sizes=widths, value_hidden_layer_sizes=widths
        ),
        seed=args.seed,
        progress_fn=Curve(args.out / "curve.csv"),
        save_checkpoint_path=str(checkpoints),
        restore_checkpoint_path=None if args.restore is None else str(args.restore.resolve()),
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Train and write the curve."""
    command = parser()
    args = command.parse_args(argv)
    if args.num_envs % args.minibatches:
        command.error(f"--num-envs {args.num_envs} does not divide into --minibatches {args.minibatches}")
    if args.restore is not None and not args.restore.is_dir():
        command.error(f"--restore {args.restore}: no such folder")
    try:
        env = make_env(args)
    except (ValueError, LookupError, RuntimeError) as error:
        command.error(str(error))
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "config.json").write_text(json.dumps(vars(args), indent=1, default=str))
    train(env, args)


if __name__ == "__main__":
    main()
