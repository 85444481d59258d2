"""LIBERO tasks as environments to train on, as the options of ``examples/ppo.py`` say."""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp

from ppo_parts.config import Environment, RunError
from vecenv.libero import functional
from vecenv.libero.tasks.suites import NUM_EPISODES


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


def acting(env: functional.FunctionalLibero, action: str) -> Environment:
    """The environment, acted on as ``--action`` says."""
    return Upright(env) if action == "position" else env


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
