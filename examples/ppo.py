"""Proximal policy optimisation on one LIBERO task, in one file: JAX and optax, everything inside ``jit``.

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
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import functools
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from vecenv.libero import functional
from vecenv.libero.functional.objectives import OBJECTIVES
from vecenv.libero.scene.lean.geometry import PROFILES
from vecenv.libero.tasks.export import exported_tasks
from vecenv.libero.tasks.sources import installed_tasks
from vecenv.libero.tasks.suites import NUM_EPISODES

try:
    import optax
except ImportError as error:
    raise SystemExit("examples/ppo.py needs optax: pip install 'vecenv[train]'") from error


class RunError(ValueError):
    """Settings or a checkpoint that cannot be used; the message says why."""


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Settings of the training; each is an option of the command line.

    Attributes:
        steps: environment steps to train for, over all worlds; repeated actions count.
        num_envs: worlds.
        episode_length: environment steps after which an episode is cut off.
        action_repeat: environment steps that an action is held for.
        unroll: actions of each world an iteration.
        epochs: times an iteration goes through its data.
        minibatches: parts the data is divided into.
        learning_rate: of Adam, at the beginning; falls linearly to a tenth of it.
        discount: of the reward an action later.
        gae: lambda of generalised advantage estimation.
        clip: how far the ratio of the probabilities of an action may move from 1.
        entropy: weight of the policy's entropy.
        max_grad_norm: gradients are scaled down to this norm.
        hidden: widths of the hidden layers of policy and value function.
        initial_std: of the noise on actions; learnt from there on.
        min_std: it never gets smaller than this, so that something remains to be found out.
        switches: how many of the last numbers of an action are -1 or 1, drawn with a probability of each of at least
            2 %; the gripper's, of which the simulator takes the sign only, is one.
        seed: of everything random.
    """

    steps: int = 3_000_000
    num_envs: int = 2048
    episode_length: int = 100
    action_repeat: int = 1
    unroll: int = 16
    epochs: int = 4
    minibatches: int = 16
    learning_rate: float = 1e-3
    discount: float = 0.97
    gae: float = 0.95
    clip: float = 0.2
    entropy: float = 1e-3
    max_grad_norm: float = 1.0
    hidden: tuple[int, ...] = (256, 256, 128)
    initial_std: float = 0.6
    min_std: float = 0.05
    switches: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        if (self.num_envs * self.unroll) % self.minibatches:
            raise RunError(
                f"num_envs={self.num_envs} worlds of unroll={self.unroll} actions do not divide into "
                f"minibatches={self.minibatches}"
            )
        for name in ("steps", "num_envs", "episode_length", "action_repeat", "unroll", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise RunError(f"{name}={getattr(self, name)}: expected at least 1")

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of an iteration."""
        return self.num_envs * self.unroll * self.action_repeat

    @property
    def iterations(self) -> int:
        """Iterations to train for."""
        return math.ceil(self.steps / self.steps_per_iteration)


class Environment(Protocol):
    """What is trained on: one world, pure functions."""

    @property
    def action_size(self) -> int:
        """Width of an action; each number is clipped to [-1, 1]."""
        ...

    @property
    def observation_size(self) -> Any:
        """Width of an observation, or a dictionary of the shapes of its parts."""
        ...

    def reset(self, rng: jax.Array) -> Any:
        """Begin an episode."""
        ...

    def step(self, state: Any, action: jax.Array) -> Any:
        """Advance."""
        ...


# ---------------------------------------------------------------------------------------------------------------------
# Policy and value function.

Layers = list[dict[str, jax.Array]]
# Convolutions over images: (output channels, side of the kernel, stride), then a layer of so many numbers.
CONVOLUTIONS, SEEN = ((32, 8, 4), (64, 4, 2), (64, 3, 1)), 256
# The largest logit of a switch: each side keeps a probability of 2 %.
SUREST = 4.0


class Obs(NamedTuple):
    """Observations: vectors [..., n] and images uint8 [..., H, W, channels], None where there are none."""

    vector: jax.Array
    images: jax.Array | None


class Networks(NamedTuple):
    """What is learnt: layers of the policy's mean, log of its standard deviation [A], layers of the value function.

    ``vision`` are the layers that both see images through; empty without images.
    """

    policy: Layers
    log_std: jax.Array
    value: Layers
    vision: Layers


class Normalizer(NamedTuple):
    """Running mean [n] and variance [n] of ``count`` vectors."""

    count: jax.Array
    mean: jax.Array
    var: jax.Array

    def __call__(self, obs: Obs) -> Obs:
        """Vectors of about mean 0 and deviation 1; what hardly ever varies is not blown up. Images stay."""
        scaled = (obs.vector - self.mean) / jnp.maximum(jnp.sqrt(self.var), 0.01)
        return obs._replace(vector=jnp.clip(scaled, -10, 10))

    def updated(self, obs: jax.Array) -> Normalizer:
        """With more vectors, [..., n] (Chan et al., parallel variance)."""
        axes = tuple(range(obs.ndim - 1))
        more = obs.size // obs.shape[-1]
        count, shift = self.count + more, obs.mean(axes) - self.mean
        mean = self.mean + shift * more / count
        squares = self.var * self.count + obs.var(axes) * more + shift**2 * self.count * more / count
        return Normalizer(count, mean, squares / count)


def init_layers(rng: jax.Array, widths: Sequence[int], last_scale: float) -> Layers:
    """Normal weights that keep the size of what goes through (LeCun), the last layer's scaled; biases of 0."""
    scales = [1.0] * (len(widths) - 2) + [last_scale]
    keys = jax.random.split(rng, len(scales))
    return [
        {"weight": scale / math.sqrt(n) * jax.random.normal(key, (n, m)), "bias": jnp.zeros(m)}
        for key, scale, n, m in zip(keys, scales, widths[:-1], widths[1:], strict=True)
    ]


def init_networks(rng: jax.Array, env: Environment, config: PPOConfig) -> Networks:
    """Networks that know nothing yet."""
    policy, value, vision = jax.random.split(rng, 3)
    width, image = observed(env)
    layers = [] if image is None else init_vision(vision, image)
    widths = (width + (SEEN if layers else 0), *config.hidden)
    log_std = jnp.full(env.action_size, math.log(config.initial_std))
    return Networks(
        policy=init_layers(policy, (*widths, env.action_size), 0.01),
        log_std=log_std,
        value=init_layers(value, (*widths, 1), 0.01),
        vision=layers,
    )


def observed(env: Environment) -> tuple[int, tuple[int, int, int] | None]:
    """Width of the vector of an observation, and the shape of its images, laid upon each other channel by channel."""
    size = env.observation_size
    if not isinstance(size, Mapping):
        return int(size), None
    shapes = [shape for name, shape in sorted(size.items()) if name != "state"]
    if not shapes or len(set(shapes)) > 1:
        raise RunError(f"observations have images of shapes {shapes}: expected one shape")
    height, width, channels = shapes[0]
    return math.prod(size.get("state", (0,))), (height, width, channels * len(shapes))


def packed(obs: Any) -> Obs:
    """Observations of an environment; images as bytes, which need a quarter of the memory."""
    if not isinstance(obs, Mapping):
        return Obs(obs, None)
    views = [view for name, view in sorted(obs.items()) if name != "state"]
    images = jnp.round(jnp.concatenate(views, axis=-1) * 255).astype(jnp.uint8)
    return Obs(obs["state"] if "state" in obs else jnp.zeros((*images.shape[:-3], 0)), images)


def init_vision(rng: jax.Array, shape: tuple[int, int, int]) -> Layers:
    """Convolutions for images of this shape, and the layer after them."""
    height, width, channels = shape
    layers = []
    for key, (made, side, stride) in zip(jax.random.split(rng, len(CONVOLUTIONS)), CONVOLUTIONS, strict=True):
        height, width = (height - side) // stride + 1, (width - side) // stride + 1
        if min(height, width) < 1:
            raise RunError(f"images of {shape[0]} x {shape[1]} pixels are too small for the convolutions")
        weight = jax.random.normal(key, (side, side, channels, made)) / math.sqrt(side * side * channels)
        layers.append({"weight": weight, "bias": jnp.zeros(made)})
        channels = made
    return layers + init_layers(jax.random.fold_in(rng, 1), (height * width * channels, SEEN), 1.0)


def see(layers: Layers, images: jax.Array) -> jax.Array:
    """What is seen in images: numbers [..., SEEN]."""
    x = images.reshape(-1, *images.shape[-3:]).astype(jnp.float32) / 255 - 0.5
    for layer, (_, _, stride) in zip(layers[:-1], CONVOLUTIONS, strict=True):
        x = lax.conv_general_dilated(
            x, layer["weight"], (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        x = jax.nn.silu(x + layer["bias"])
    x = jax.nn.silu(apply_layers(layers[-1:], x.reshape(len(x), -1)))
    return x.reshape(*images.shape[:-3], -1)


def features(networks: Networks, obs: Obs) -> jax.Array:
    """What policy and value function are computed of, [..., n]."""
    if obs.images is None:
        return obs.vector
    return jnp.concatenate([obs.vector, see(networks.vision, obs.images)], axis=-1)


def apply_layers(layers: Layers, x: jax.Array) -> jax.Array:
    """A multilayer perceptron with SiLU."""
    for layer in layers[:-1]:
        x = jax.nn.silu(x @ layer["weight"] + layer["bias"])
    return x @ layers[-1]["weight"] + layers[-1]["bias"]


def mean_of(networks: Networks, obs: Obs) -> jax.Array:
    """The action without noise for normalised observations, [..., A] in (-1, 1); of switches the sign counts."""
    return jnp.tanh(apply_layers(networks.policy, features(networks, obs)))


class Actions(NamedTuple):
    """A distribution of actions: normal ones, and after them S switches, which are -1 or 1.

    Attributes:
        mean: of the normal ones, [..., A - S].
        std: their standard deviations, [A - S].
        logits: of the switches' being 1, [..., S].
    """

    mean: jax.Array
    std: jax.Array
    logits: jax.Array

    def draw(self, rng: jax.Array, noise: jax.Array) -> jax.Array:
        """Actions [..., A]; with a ``noise`` of 0 the likeliest."""
        normal, uniform = jax.random.split(rng)
        moves = self.mean + noise * self.std * jax.random.normal(normal, self.mean.shape)
        chance = jnp.where(noise > 0, jax.nn.sigmoid(self.logits), self.logits > 0)
        switches = jnp.where(jax.random.uniform(uniform, self.logits.shape) < chance, 1.0, -1.0)
        return jnp.concatenate([moves, switches], axis=-1)

    def log_probability(self, action: jax.Array) -> jax.Array:
        """Of actions [..., A] before the environment clips them, [...]."""
        moves, switches = jnp.split(action, [len(self.std)], axis=-1)
        z = (moves - self.mean) / self.std
        normal = -jnp.sum(0.5 * z**2 + jnp.log(self.std) + 0.5 * math.log(2 * math.pi), axis=-1)
        return normal - jnp.sum(jax.nn.softplus(-switches * self.logits), axis=-1)

    def entropy(self) -> jax.Array:
        """Mean entropy, but for a constant."""
        chance = jax.nn.sigmoid(self.logits)
        switches = jax.nn.softplus(self.logits) - chance * self.logits
        return jnp.sum(jnp.log(self.std)) + jnp.sum(switches, axis=-1).mean()


def actions_of(networks: Networks, obs: Obs, config: PPOConfig) -> Actions:
    """What the policy does for normalised observations."""
    raw = apply_layers(networks.policy, features(networks, obs))
    moves, switches = jnp.split(raw, [raw.shape[-1] - config.switches], axis=-1)
    std = jnp.exp(jnp.clip(networks.log_std[: moves.shape[-1]], math.log(config.min_std), 0.5))
    return Actions(jnp.tanh(moves), std, SUREST * jnp.tanh(switches / SUREST))


def value_of(networks: Networks, obs: Obs) -> jax.Array:
    """Expected discounted reward from normalised observations on, [...]."""
    return apply_layers(networks.value, features(networks, obs))[..., 0]


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
# Checkpoints and curves.


SETTINGS, POLICY = "config.json", "policy.npz"


def save(path: Path, tree: Any, **numbers: float) -> None:
    """Write the arrays of a tree, and some numbers, to one ``.npz`` file; an older one stays until the new is whole."""
    arrays: dict[str, Any] = {
        f"tree{jax.tree_util.keystr(where)}": np.asarray(x) for where, x in jax.tree.leaves_with_path(tree)
    }
    arrays |= {name: np.asarray(value) for name, value in numbers.items()}
    beside = path.with_name(f".{path.name}")
    with beside.open("wb") as file:
        np.savez(file, **arrays)
    beside.replace(path)


def load(path: Path, like: Any, *numbers: str) -> tuple[Any, dict[str, float]]:
    """Read what ``save`` wrote: a tree of the structure of ``like``, and the named numbers.

    Raises:
        RunError: there is none, or it is of another environment or other settings.
    """
    if not path.is_file():
        raise RunError(f"{path} does not exist; start without --resume")
    leaves, treedef = jax.tree.flatten_with_path(like)
    names = [f"tree{jax.tree_util.keystr(where)}" for where, _ in leaves]
    with np.load(path, allow_pickle=False) as file:
        found = {name: file[name] for name in [*names, *numbers] if name in file}
    made = [_fitting(path, name, found.get(name), x) for name, (_, x) in zip(names, leaves, strict=True)]
    return jax.tree.unflatten(treedef, made), {name: float(found[name]) for name in numbers}


class Learnt(NamedTuple):
    """The part of a learner that acts."""

    networks: Networks
    normalizer: Normalizer


def load_policy(folder: Path, env: Environment) -> Learnt:
    """What a run has learnt.

    Raises:
        RunError: there is no such run, or it does not fit the environment.
    """
    fields = {field.name for field in dataclasses.fields(PPOConfig)}
    config = PPOConfig(**{name: _frozen(value) for name, value in settings(folder).items() if name in fields})
    none = jnp.zeros(observed(env)[0])
    like = Learnt(init_networks(jax.random.key(0), env, config), Normalizer(jnp.zeros(()), none, none))
    return load(folder / POLICY, like)[0]


def _fitting(path: Path, name: str, array: np.ndarray | None, like: jax.Array) -> jax.Array:
    if array is None or (array.shape, array.dtype) != (like.shape, like.dtype):
        have = "nothing" if array is None else f"{array.dtype}{list(array.shape)}"
        raise RunError(
            f"{path}: {name} is {have}, this run needs {like.dtype}{list(like.shape)}; "
            "resume with the task and settings that it was made with"
        )
    return jnp.asarray(array)


Row: TypeAlias = dict[str, float]


def read_rows(path: Path, until: int) -> list[Row]:
    """The rows of a curve up to so many environment steps; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    return [row for row in rows if row["env_steps"] <= until]


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a curve."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows({name: f"{value:.10g}" for name, value in row.items()} for row in rows)


def plot(path: Path, rows: Sequence[Row], title: str) -> bool:
    """Draw success and return over environment steps; False where matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return False
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    steps = [row["env_steps"] for row in rows]
    for axes, name in zip(figure.subplots(1, 2), ("success", "return"), strict=True):
        axes.plot(steps, [row[name] for row in rows])
        axes.set(xlabel="environment steps", ylabel=name)
        axes.grid(alpha=0.3)
    figure.suptitle(title)
    figure.savefig(path, dpi=120)
    return True


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


class Upright:
    """An environment under OSC control whose actions have four numbers: position and gripper; the hand never turns.

    Args:
        env: the environment.
    """

    action_size = 4

    def __init__(self, env: functional.FunctionalLibero) -> None:
        self.inner, self.observation_size, self.reset = env, env.observation_size, env.reset

    def step(self, state: functional.FunctionalState, action: jax.Array) -> functional.FunctionalState:
        """Advance by one step; ``action`` is [4]."""
        return self.inner.step(state, upright(action))


def upright(action: Any) -> jax.Array:
    """OSC actions [..., 7] that do as actions of position and gripper [..., 4] say."""
    action = jnp.asarray(action)
    still = jnp.zeros((*action.shape[:-1], 3), action.dtype)
    return jnp.concatenate([action[..., :3], still, action[..., 3:]], axis=-1)


def make_env(args: argparse.Namespace, **more: Any) -> functional.FunctionalLibero:
    """The task that the command line asks for, with the shaped reward and more options."""
    if not 0 <= args.hold_back < NUM_EPISODES:
        raise RunError(f"--hold-back {args.hold_back}: there are {NUM_EPISODES} stored starts")
    same = ("objective", "target", "geometry", "placement", "scenes", "episode_length")
    return functional.FunctionalLibero(
        args.suite,
        task=args.task,
        config_overrides={
            **{name: getattr(args, name) for name in same},
            "episodes": tuple(range(NUM_EPISODES - args.hold_back)),
            "obs": ("proprio", "objects") if args.obs == "state" else ("proprio", "pixels"),
            "image_size": args.image_size,
            "reward": "shaped",
            "impl": None if args.impl == "auto" else args.impl,
            "action": "osc" if args.action == "position" else args.action,
            **more,
        },
    )


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
    except (ValueError, LookupError, RuntimeError) as error:
        # What these say is meant for users; anything else is a defect and keeps its traceback.
        if not type(error).__module__.startswith(("vecenv", __name__)):
            raise
        command.error(str(error))


def _train(command: argparse.ArgumentParser, argv: Sequence[str] | None) -> None:
    """Train on one task."""
    args = command.parse_args(argv)
    if args.resume:
        command.set_defaults(**settings(args.out))
        args = command.parse_args(argv)
    config = PPOConfig(**{field.name: _frozen(getattr(args, field.name)) for field in dataclasses.fields(PPOConfig)})
    env = make_env(args)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / SETTINGS).write_text(json.dumps({**vars(args), "out": str(args.out)}, indent=1))
    trained = train(acting(env, args.action), config, args.out, resume=args.resume)
    result = _result(env, config, trained)
    (args.out / "result.json").write_text(json.dumps(result, indent=1))
    print(json.dumps(result))
    if not plot(args.out / "curve.png", trained.rows, f"{args.suite} {args.task}: {args.objective} {env.target}"):
        print("no curve.png: matplotlib is not installed")


def acting(env: functional.FunctionalLibero, action: str) -> Environment:
    """The environment, acted on as ``--action`` says."""
    return Upright(env) if action == "position" else env


def settings(out: Path) -> dict[str, Any]:
    """Options of the run that is resumed."""
    try:
        found = json.loads((out / SETTINGS).read_text())
    except OSError as error:
        raise RunError(f"{out} holds no run to resume: {error}") from error
    return {name: value for name, value in found.items() if name not in ("out", "resume", "steps")}


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


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
