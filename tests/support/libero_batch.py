"""Small batches of LIBERO, actions for them, and a way to make a slot succeed."""

from __future__ import annotations

from typing import Any

import numpy as np

import vecenv
from vecenv.libero.env import LiberoEnv

STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])


def make(suite: str = "libero_object", **options: Any) -> LiberoEnv:
    options = {"task": 1, "episodes": range(3), "start": "raw", "settle_steps": 0, **options}
    if "tasks" in options:
        del options["task"]
    env = vecenv.make(suite, **options)
    assert isinstance(env, LiberoEnv)
    return env


def still(env: LiberoEnv) -> np.ndarray:
    return np.tile(STILL, (env.num_envs, 1))


def wiggle(env: LiberoEnv, seed: int = 0, ticks: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (env.num_envs, ticks, 7))


def put_target_in_basket(env: LiberoEnv, slots: list[int]) -> None:
    """Overwrite the state so that the target object floats just above the floor of the basket."""
    state = env.state()
    snapshots = env.observe_objects().snapshot
    for slot in slots:
        snapshot = snapshots[slot]
        assert snapshot is not None
        _, target, region = snapshot.goal[0]
        model = env.mj_models[env.scene_index[slot]]
        address = model.joint(f"{target}_joint0").qposadr[0]
        state.qpos[slot, address : address + 3] = snapshot.regions[region].pos
    env.set_state(state)
