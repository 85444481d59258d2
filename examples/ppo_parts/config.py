"""Settings of a training, and what it asks of an environment."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import jax


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

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> PPOConfig:
        """The settings among the options of a run; lists, as JSON has them, become tuples."""
        names = [field.name for field in dataclasses.fields(cls) if field.name in options]
        given = {name: options[name] for name in names}
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in given.items()})

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
