"""Policy and value function: layers, how observations are normalised and seen, and the distribution of actions.

In: observations of an environment, as :func:`packed` has them. Out: :class:`Actions` and values. Images go through
convolutions that both share.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ppo_parts.config import Environment, PPOConfig, RunError

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


def init_layers(rng: jax.Array, widths: Sequence[int], last_scale: float) -> Layers:
    """Normal weights that keep the size of what goes through (LeCun), the last layer's scaled; biases of 0."""
    scales = [1.0] * (len(widths) - 2) + [last_scale]
    keys = jax.random.split(rng, len(scales))
    return [
        {"weight": scale / math.sqrt(n) * jax.random.normal(key, (n, m)), "bias": jnp.zeros(m)}
        for key, scale, n, m in zip(keys, scales, widths[:-1], widths[1:], strict=True)
    ]


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
