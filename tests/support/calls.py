"""Values that no argument of an environment takes, the verbs to give them to, and what a batch says about itself."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class NoArray:
    """Converts itself to nothing."""

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        raise RuntimeError("it cannot be converted")

    def __repr__(self) -> str:
        raise RuntimeError("it cannot be shown")


# Nothing that any argument takes. Functions, because generators are read once.
NEVER: dict[str, Callable[[], Any]] = {
    "object": object,
    "NoArray": NoArray,
    "complex": lambda: 1j,
    "text": lambda: "\x00up",
    "bytes": lambda: b"01",
    "set": lambda: {0.5, 1},
    "mapping": lambda: {"a": 1},
    "objects": lambda: np.array([None, 1], object),
    "date": lambda: np.datetime64("2020-01-01"),
    "ragged": lambda: [[0, 1], [2]],
    "cube": lambda: np.zeros((2, 2, 2)),
    "not a number": lambda: float("nan"),
    "infinite": lambda: [np.inf, 0.0],
    "huge": lambda: np.broadcast_to(0.0, (10**6, 10**6)),
    "endless": lambda: itertools.repeat(0.5),
    "masked": lambda: np.ma.masked_array([0, 1], mask=[True, False]),
    "type": lambda: float,
    "too large": lambda: 2**64,
    "very negative": lambda: -(2**70),
    "float index": lambda: 1.5,
    "mixed": lambda: [True, 1],
}


class Call(NamedTuple):
    """A call of a verb with a value in the place of one argument."""

    verb: Callable[[Any, Any], object]
    # What of ``NEVER`` it takes after all, or what is something else for it.
    takes: frozenset[str] = frozenset()


def plan(env: Any, name: str = "valid", value: object = False) -> dict[str, object]:
    """A plan of one waypoint a slot that nothing follows, with one of its fields replaced or added."""
    fields = {
        "poses": np.tile([0.0, 0, 1, 1, 0, 0, 0], (env.num_envs, 1, 1)),
        "grip": np.zeros((env.num_envs, 1)),
        "hold": np.zeros((env.num_envs, 1), int),
        "valid": np.zeros((env.num_envs, 1), bool),
    }
    return {**fields, name: np.full((env.num_envs, 1), False) if value is False else value}


VERBS: dict[str, Call] = {
    "end_episodes(slots)": Call(lambda env, value: env.end_episodes(value)),
    "observe_egocentric(slots)": Call(lambda env, value: env.observe_egocentric(slots=value)),
    "observe_objects(slots)": Call(lambda env, value: env.observe_objects(slots=value)),
    "observe_objects(points)": Call(lambda env, value: env.observe_objects(value)),
    "set_episodes(tasks)": Call(lambda env, value: env.set_episodes(tasks=value)),
    "set_episodes(episodes)": Call(lambda env, value: env.set_episodes(episodes=value)),
    "set_episodes(slots)": Call(lambda env, value: env.set_episodes(episodes=1, slots=value)),
    "set_episodes(tasks of a slot)": Call(lambda env, value: env.set_episodes(tasks=value, slots=[0])),
    "set_episodes(episodes of a slot)": Call(lambda env, value: env.set_episodes(episodes=value, slots=[0])),
    "step_continuous": Call(lambda env, value: env.step_continuous(value)),
    "step_ee_pose(poses)": Call(lambda env, value: env.step_ee_pose(value)),
    "step_ee_pose(hold_steps)": Call(lambda env, value: env.step_ee_pose([], hold_steps=value)),
    "step_ee_pose(carry)": Call(lambda env, value: env.step_ee_pose([], carry=value)),
    "step_ee_pose(slots)": Call(lambda env, value: env.step_ee_pose([], slots=value)),
    "step_waypoints(plan)": Call(lambda env, value: env.step_waypoints(value)),
    "step_waypoints(max_misses)": Call(lambda env, value: env.step_waypoints(plan(env), value)),
    **{
        f"step_waypoints({name})": Call(lambda env, value, name=name: env.step_waypoints(plan(env, name, value)))
        for name in ("poses", "grip", "hold", "valid", "unknown")
    },
    "set_state": Call(lambda env, value: env.set_state(value)),
    **{
        f"set_state({name})": Call(
            lambda env, value, name=name: env.set_state(dataclasses.replace(env.state(), **{name: value}))
        )
        for name in ("qpos", "qvel", "time", "nq", "nv")
    },
    "watched": Call(lambda env, value: env.watched(value).__enter__(), frozenset({"type"})),
}


def told(env: Any) -> list[Any]:
    """All that a batch says about itself."""
    state, metrics = env.state(), env.evaluate()
    placed = env.placement
    arrays = [state.qpos, state.qvel, state.time, placed.task, placed.episode, env.done]
    arrays += [metrics.num_steps, metrics.success, metrics.cumulative_reward]
    return [array.tolist() for array in arrays]
