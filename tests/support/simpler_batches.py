"""Small SIMPLER batches on an asset tree, and where their objects are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from vecenv import make
from vecenv.contract import State
from vecenv.simpler.env import SimplerEnv
from vecenv.simpler.tasks import TASKS

CARROT, OPEN_TOP, COKE = "widowx_carrot_on_plate", "google_robot_open_top_drawer", "google_robot_pick_coke_can"
PLACE = "google_robot_place_apple_in_closed_top_drawer"
STAY = np.zeros(7)


def batch(root: Path, task: str, episodes: object, **options: Any) -> SimplerEnv:
    env = make(TASKS[task].suite, task=task, episodes=episodes, assets=root, num_threads=1, **options)
    assert isinstance(env, SimplerEnv)
    env.reset()
    return env


def moved(env: SimplerEnv, index: int, position: npt.ArrayLike, slot: int = 0) -> State:
    """The environment's state with one object elsewhere, at rest."""
    state = env.state()
    begin = env.robot.dof + (3 if env._episodes[slot].spec.cabinet else 0)
    state.qpos[slot, begin + 7 * index : begin + 7 * index + 3] = position
    state.qvel[slot, begin + 6 * index : begin + 6 * index + 6] = 0
    return state


def objects(env: SimplerEnv, slot: int = 0) -> np.ndarray:
    snapshot = env.observe_objects().snapshot[slot]
    assert snapshot is not None
    return np.array([snapshot.poses[name] for name in (body.name for body in env._episodes[slot].spec.objects)])
