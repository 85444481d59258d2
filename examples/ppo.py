"""Proximal policy optimisation on one LIBERO task: JAX and optax, everything inside ``jit``.

    python examples/ppo.py --objective reach --num-envs 2048 --steps 3_000_000 --out runs/reach
    python examples/ppo.py --objective reach --steps 6_000_000 --out runs/reach --resume
    python examples/ppo.py --objective goal --task all --hold-back 25 --out runs/goal
    python examples/ppo.py --objective lift --obs pixels --out runs/pixels

In: a task, an objective of ``vecenv.libero.functional.objectives`` and the options below. Out, in the folder ``--out``:
``curve.csv`` (one row an iteration), ``curve.png`` where matplotlib is installed, ``checkpoint.npz`` (all there is:
networks, optimiser, worlds and random key, so a resumed run goes on as if it had not stopped), ``policy.npz`` (only
what acts), ``config.json`` and ``result.json`` with the success rate of the policy without noise. With ``--task all``
each task has a folder of its own in it. ``examples/ppo_policy.py`` is what was learnt as a policy of ``vecenv eval``.

An iteration is one compiled call: a rollout of all worlds, generalised advantage estimation, and a few epochs of
clipped updates. Any environment serves that has ``reset(key)``, ``step(state, action)``, ``action_size`` and
``observation_size``, whose states have ``obs``, ``reward``, ``done`` and ``metrics["success"]``. Observations are
vectors, or dictionaries of a vector ``state`` and images ``pixels/...``, as Brax has them; images go through
convolutions that policy and value function share.

The algorithm and the command line are in this file. Its parts are in ``ppo_parts``: settings (``config``), networks and
the distribution of actions (``networks``), LIBERO tasks as environments (``tasks``), files of a run (``files``).
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from ppo_parts.config import Environment, PPOConfig, RunError
from ppo_parts.files import POLICY, SETTINGS, Learnt, Row, load, plot, read_rows, save, settings, write_rows
from ppo_parts.files import load_policy as load_policy
from ppo_parts.networks import Actions as Actions
from ppo_parts.networks import Networks, Normalizer, Obs, actions_of, init_networks, packed, value_of
from ppo_parts.networks import mean_of as mean_of
from ppo_parts.tasks import Upright as Upright
from ppo_parts.tasks import acting, make_env
from ppo_parts.tasks import upright as upright

from vecenv.errors import VecenvError
from vecenv.libero import functional
from vecenv.libero.functional.objectives import OBJECTIVES
from vecenv.libero.scene.lean.geometry import PROFILES
from vecenv.libero.tasks.export import exported_tasks
from vecenv.libero.tasks.sources import installed_tasks

try:
    import optax
except ImportError as error:
    raise SystemExit("examples/ppo.py needs optax: pip install 'vecenv[train]'") from error


# ---------------------------------------------------------------------------------------------------------------------
# Rollout.


class Worlds(NamedTuple):
    """The worlds between two actions.

    Attributes:
        state: states of the environment, leaves [B, ...].
        age: environment steps since the episode began, [B].
        total: reward since then, [B].
        counts: whether the statistics count the episode; not the first ones of a training, which begin at random ages.
    """

    state: Any
    age: jax.Array
    total: jax.Array
    counts: jax.Array


class Transition(NamedTuple):
    """An action and what came of it; leaves [T, B, ...]. ``next_obs`` is from before a reset."""

    obs: Obs
    action: jax.Array
    log_prob: jax.Array
    reward: jax.Array
    next_obs: Obs
    terminated: jax.Array
    ended: jax.Array


class Statistics(NamedTuple):
    """Sums over episodes that ended: their number, rewards, successes, environment steps, and failures of physics."""

    episodes: jax.Array
    reward: jax.Array
    success: jax.Array
    length: jax.Array
    faults: jax.Array


def begin(env: Environment, rng: jax.Array, config: PPOConfig, *, staggered: bool) -> Worlds:
    """Worlds at the beginning of an episode; staggered, they will be cut off at different times."""
    reset, clock = jax.random.split(rng)
    state = jax.vmap(env.reset)(jax.random.split(reset, config.num_envs))
    age = jax.random.randint(clock, (config.num_envs,), 0, config.episode_length)
    return Worlds(
        state=state,
        age=age if staggered else jnp.zeros_like(age),
        total=jnp.zeros(config.num_envs),
        counts=jnp.full(config.num_envs, not staggered),
    )


def advance(env: Environment, state: Any, action: jax.Array, repeat: int) -> tuple[Any, jax.Array]:
    """Hold actions for some steps; returns the states and the summed rewards. Worlds that are done stand still."""

    def again(carry: tuple[Any, jax.Array], _: None) -> tuple[Any, None]:
        state, total = carry
        after = jax.vmap(env.step)(state, action)
        done = state.done > 0
        return (choose(done, state, after), total + jnp.where(done, 0.0, after.reward)), None

    return lax.scan(again, (state, jnp.zeros(len(action))), None, repeat)[0]


def choose(mask: jax.Array, yes: Any, no: Any) -> Any:
    """Leaf by leaf ``yes`` for the worlds of the mask and ``no`` for the others."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), yes, no)


def rollout(
    env: Environment,
    networks: Networks,
    normalizer: Normalizer,
    worlds: Worlds,
    rng: jax.Array,
    config: PPOConfig,
    noise: jax.Array,
) -> tuple[Worlds, Transition, Statistics]:
    """Some actions in every world, with a new episode wherever one ends.

    Args:
        env, networks, normalizer, worlds, rng, config: as they say.
        noise: 1 to explore. 0 for the mean actions, and statistics of each world's present episode only.
    """

    def tick(worlds: Worlds, rng: jax.Array) -> tuple[Worlds, tuple[Transition, Statistics]]:
        act, reset = jax.random.split(rng)
        obs = packed(worlds.state.obs)
        actions = actions_of(networks, normalizer(obs), config)
        action = actions.draw(act, noise)
        after, reward = advance(env, worlds.state, action, config.action_repeat)
        terminated = after.done > 0
        age, total = worlds.age + config.action_repeat, worlds.total + reward
        ended = terminated | (age >= config.episode_length)
        logged = actions.log_probability(action)
        transition = Transition(obs, action, logged, reward, packed(after.obs), terminated, ended)
        seen = ended & worlds.counts
        fault = after.metrics.get("fault", jnp.zeros_like(after.done))
        sums = [jnp.sum(jnp.where(seen, x, 0)) for x in (1.0, total, after.metrics["success"], age, fault)]
        fresh = jax.vmap(env.reset)(jax.random.split(reset, config.num_envs))
        worlds = Worlds(
            state=choose(ended, fresh, after),
            age=jnp.where(ended, 0, age),
            total=jnp.where(ended, 0.0, total),
            counts=jnp.where(ended, noise > 0, worlds.counts),
        )
        return worlds, (transition, Statistics(*sums))

    worlds, (transitions, sums) = lax.scan(tick, worlds, jax.random.split(rng, config.unroll))
    return worlds, transitions, jax.tree.map(jnp.sum, sums)


# ---------------------------------------------------------------------------------------------------------------------
# Learning.


class Learner(NamedTuple):
    """All that changes while training."""

    networks: Networks
    optimizer: Any
    normalizer: Normalizer
    worlds: Worlds
    rng: jax.Array


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Adam with a falling learning rate and bounded gradients."""
    updates = config.iterations * config.epochs * config.minibatches
    rate = optax.linear_schedule(config.learning_rate, config.learning_rate / 10, updates)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), optax.adam(rate, eps=1e-5))


def init_learner(env: Environment, config: PPOConfig) -> Learner:
    """A learner at the beginning."""
    rng, layers, start = jax.random.split(jax.random.key(config.seed), 3)
    networks = init_networks(layers, env, config)
    worlds = begin(env, start, config, staggered=True)
    first = packed(worlds.state.obs).vector
    none = jnp.zeros(first.shape[-1])
    normalizer = Normalizer(jnp.zeros(()), none, none).updated(first)
    learner = Learner(networks, make_optimizer(config).init(networks), normalizer, worlds, jax.random.key_data(rng))
    # No weak types: they would end with the first iteration, and it would be compiled twice.
    return jax.tree.map(lambda x: x.astype(x.dtype), learner)


def advantages(networks: Networks, obs: Normalizer, data: Transition, config: PPOConfig) -> tuple[jax.Array, jax.Array]:
    """Generalised advantage estimates and targets of the value function, [T, B] (Schulman et al. 2016, eq. 16).

    What follows an episode that was cut off is worth what the value function says; after success or failure nothing is.
    """
    # Action by action: the convolutions of all images at once would need much memory.
    values = functools.partial(lax.map, functools.partial(value_of, networks))
    value = values(obs(data.obs))
    following = jnp.where(data.terminated, 0.0, values(obs(data.next_obs)))
    delta = data.reward + config.discount * following - value

    def backwards(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta, ended = now
        estimate = delta + config.discount * config.gae * jnp.where(ended, 0.0, later)
        return estimate, estimate

    _, estimates = lax.scan(backwards, jnp.zeros_like(delta[0]), (delta, data.ended), reverse=True)
    return estimates, estimates + value


class Batch(NamedTuple):
    """What the loss is computed of; leaves [N, ...], observations normalised."""

    obs: Obs
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    target: jax.Array


def loss_of(networks: Networks, batch: Batch, config: PPOConfig) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The clipped objective (Schulman et al. 2017, eq. 9), and what to watch."""
    actions = actions_of(networks, batch.obs, config)
    log_ratio = actions.log_probability(batch.action) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    advantage = (batch.advantage - batch.advantage.mean()) / (batch.advantage.std() + 1e-8)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    gain = jnp.minimum(ratio * advantage, clipped * advantage).mean()
    error = jnp.mean((value_of(networks, batch.obs) - batch.target) ** 2)
    watched = {"kl": jnp.mean(ratio - 1 - log_ratio), "value_error": error, "std": actions.std.mean()}
    return 0.5 * error - gain - config.entropy * actions.entropy(), watched


def learn(
    networks: Networks, state: Any, batch: Batch, rng: jax.Array, config: PPOConfig
) -> tuple[Networks, Any, dict[str, jax.Array]]:
    """Some epochs over a batch in random minibatches."""
    optimizer = make_optimizer(config)

    def descend(carry: tuple[Networks, Any], chosen: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        networks, state = carry
        part = jax.tree.map(lambda x: x[chosen], batch)
        gradient, watched = jax.grad(loss_of, has_aux=True)(networks, part, config)
        change, state = optimizer.update(gradient, state, networks)
        return (optax.apply_updates(networks, change), state), watched

    size = len(batch.target)
    orders = jax.vmap(lambda key: jax.random.permutation(key, size))(jax.random.split(rng, config.epochs))
    chosen = orders.reshape(config.epochs * config.minibatches, -1)
    (networks, state), watched = lax.scan(descend, (networks, state), chosen)
    return networks, state, jax.tree.map(lambda x: x[-config.minibatches :].mean(), watched)


def iteration(
    env: Environment, config: PPOConfig, learner: Learner, noise: jax.Array
) -> tuple[Learner, Statistics, dict[str, jax.Array]]:
    """A rollout and what is learnt from it."""
    rng, act, order = jax.random.split(jax.random.wrap_key_data(learner.rng), 3)
    networks, obs = learner.networks, learner.normalizer
    worlds, data, statistics = rollout(env, networks, obs, learner.worlds, act, config, noise)
    advantage, target = advantages(networks, obs, data, config)
    batch = Batch(obs(data.obs), data.action, data.log_prob, advantage, target)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
    networks, state, watched = learn(networks, learner.optimizer, flat, order, config)
    learner = Learner(networks, state, obs.updated(data.obs.vector), worlds, jax.random.key_data(rng))
    return learner, statistics, watched


# ---------------------------------------------------------------------------------------------------------------------
# Runs.


class Trained(NamedTuple):
    """What a training leaves: the learner, the rows of its curve, the success rate of one noiseless episode a world."""

    learner: Learner
    rows: list[Row]
    success: float


def train(
    env: Environment,
    config: PPOConfig,
    out: Path,
    *,
    resume: bool = False,
    checkpoint_seconds: float = 60.0,
    jit: Callable[..., Any] = functional.jit,
    report: Callable[[str], Any] = print,
) -> Trained:
    """Train, writing the curve and checkpoints to a folder.

    Args:
        env: what is trained on.
        config: settings; with ``resume`` those of the run that is resumed, but for ``steps``.
        out: the folder.
        resume: go on from the checkpoint there.
        checkpoint_seconds: time between checkpoints; there is always one at the end.
        jit: how functions are compiled.
        report: where a line an iteration goes.

    Raises:
        RunError: nothing to resume, or it does not fit.
    """
    out.mkdir(parents=True, exist_ok=True)
    learner, done, seconds = jit(functools.partial(init_learner, env, config))(), 0, 0.0
    if resume:
        learner, numbers = load(out / "checkpoint.npz", learner, "iterations", "seconds")
        done, seconds = int(numbers["iterations"]), numbers["seconds"]
    rows = read_rows(out / "curve.csv", done * config.steps_per_iteration) if resume else []
    step = jit(functools.partial(iteration, env, config))
    began = saved = time.perf_counter()
    for number in range(done + 1, config.iterations + 1):
        learner, *measured = step(learner, jnp.ones(()))
        rows.append(_row(number, config, seconds + _since(began, measured), *measured))
        write_rows(out / "curve.csv", rows)
        report(_line(rows[-1]))
        if time.perf_counter() - saved > checkpoint_seconds or number == config.iterations:
            save(out / "checkpoint.npz", learner, iterations=number, seconds=rows[-1]["seconds"])
            save(out / POLICY, Learnt(learner.networks, learner.normalizer))
            saved = time.perf_counter()
    return Trained(learner, rows, _noiseless(env, config, learner, step, jit))


def _since(began: float, result: Any) -> float:
    jax.block_until_ready(result)
    return time.perf_counter() - began


def _row(number: int, config: PPOConfig, seconds: float, sums: Statistics, watched: Mapping[str, jax.Array]) -> Row:
    episodes = max(float(sums.episodes), 1.0)
    return {
        "iteration": number,
        "env_steps": number * config.steps_per_iteration,
        "seconds": round(seconds, 3),
        "episodes": float(sums.episodes),
        "return": float(sums.reward) / episodes,
        "success": float(sums.success) / episodes,
        "length": float(sums.length) / episodes,
        "faults": float(sums.faults),
        **{name: float(value) for name, value in watched.items()},
    }


def _line(row: Mapping[str, float]) -> str:
    return (
        f"{row['env_steps']:>11,.0f} steps {row['seconds']:>7.1f} s  return {row['return']:6.3f}  "
        f"success {row['success']:5.3f}  length {row['length']:5.1f}  kl {row['kl']:.4f}  std {row['std']:.3f}"
    )


def _noiseless(env: Environment, config: PPOConfig, learner: Learner, step: Any, jit: Callable[..., Any]) -> float:
    """Success rate of one episode of every world with mean actions."""
    started = jit(lambda rng: begin(env, rng, config, staggered=False))(jax.random.key(config.seed + 1))
    learner, sums = learner._replace(worlds=started), np.zeros(2)
    # The iteration is compiled already; what it learns is thrown away.
    for _ in range(math.ceil(config.episode_length / (config.unroll * config.action_repeat))):
        after, statistics, _ = step(learner, jnp.zeros(()))
        learner = learner._replace(worlds=after.worlds, rng=after.rng)
        sums += [float(statistics.success), float(statistics.episodes)]
    return float(sums[0] / max(sums[1], 1))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description="PPO on one LIBERO task.")
    made.add_argument("--suite", default="libero_object")
    made.add_argument("--task", type=_task, default=0, help="a number, or all: one after another, each in a folder")
    made.add_argument("--objective", choices=OBJECTIVES, default="reach")
    made.add_argument("--target", help="what to reach or lift; the first object the task is about by default")
    made.add_argument("--geometry", choices=PROFILES, default="lean")
    made.add_argument("--impl", choices=("auto", "jax", "warp"), default="auto", help="auto: warp on CUDA, else jax")
    made.add_argument(
        "--action",
        choices=("position", *functional.ACTIONS),
        default="position",
        help="position: osc without rotations, the hand stays upright",
    )
    made.add_argument(
        "--obs", choices=("state", "pixels"), default="state", help="pixels: images and the robot's joints"
    )
    made.add_argument("--image-size", type=_whole, default=64)
    made.add_argument("--placement", choices=functional.PLACEMENTS, default="stored")
    made.add_argument(
        "--hold-back", type=_whole, default=0, help="so many of the stored starts, the last, are not used"
    )
    made.add_argument("--scenes", help="a folder that `vecenv compile` wrote, in place of the installed packages")
    made.add_argument("--out", type=Path, required=True, help="folder for curve, checkpoint and result")
    made.add_argument("--resume", action="store_true", help="go on from the checkpoint in --out")
    for field in dataclasses.fields(PPOConfig):
        kind = type(field.default)
        made.add_argument(
            f"--{field.name.replace('_', '-')}",
            default=field.default,
            nargs="+" if kind is tuple else None,
            type=float if kind is float else _whole,
        )
    made.set_defaults(switches=1)  # the last number of every kind of action is the gripper's
    return made


def _task(text: str) -> int | str:
    """The number of a task, or all."""
    return text if text == "all" else _whole(text)


def _whole(text: str) -> int:
    """An integer, also as 2e6."""
    number = float(text.replace("_", ""))
    if number != int(number):
        raise argparse.ArgumentTypeError(f"{text} is no whole number")
    return int(number)


def main(argv: Sequence[str] | None = None) -> None:
    """Train and write the results."""
    command = parser()
    args = command.parse_args(argv)
    try:
        if args.task == "all":
            for task in range(
                len(installed_tasks(args.suite) if args.scenes is None else exported_tasks(args.scenes, args.suite))
            ):
                _train(command, [*(argv or sys.argv[1:]), "--task", str(task), "--out", str(args.out / f"task_{task}")])
        else:
            _train(command, argv)
    except (VecenvError, RunError) as error:
        # What these say is meant for users; anything else is a defect and keeps its traceback.
        command.error(str(error))


def _train(command: argparse.ArgumentParser, argv: Sequence[str] | None) -> None:
    """Train on one task."""
    args = command.parse_args(argv)
    if args.resume:
        command.set_defaults(**settings(args.out))
        args = command.parse_args(argv)
    config = PPOConfig.of(vars(args))
    env = make_env(args)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / SETTINGS).write_text(json.dumps({**vars(args), "out": str(args.out)}, indent=1))
    trained = train(acting(env, args.action), config, args.out, resume=args.resume)
    result = _result(env, config, trained)
    (args.out / "result.json").write_text(json.dumps(result, indent=1))
    print(json.dumps(result))
    if not plot(args.out / "curve.png", trained.rows, f"{args.suite} {args.task}: {args.objective} {env.target}"):
        print("no curve.png: matplotlib is not installed")


def _result(env: functional.FunctionalLibero, config: PPOConfig, trained: Trained) -> dict[str, Any]:
    last = trained.rows[-1]
    return {
        "success_without_noise": trained.success,
        "episodes": config.num_envs,
        "env_steps": last["env_steps"],
        "seconds": last["seconds"],
        "device": jax.devices()[0].device_kind,
        "impl": env.impl,
        "target": env.target,
        "jax": jax.__version__,
    }


if __name__ == "__main__":
    main()
