"""A slot whose physics is broken on purpose is quarantined with its cause, and its neighbours do not notice."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.physics.mjx.backend import MjxGroup
from vecenv.libero.physics.native import Group

B, BROKEN, TICKS = 4, 2, 4
OTHERS = [slot for slot in range(B) if slot != BROKEN]


def make(episodes: list[int], **options: Any) -> LiberoEnv:
    env = vecenv.make("libero_object", task=0, episodes=episodes, **options)
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def inject(env: LiberoEnv, field: str, value: float) -> None:
    """Write a number into the simulator's memory, past all checks."""
    (group,) = env.physics.groups
    if isinstance(group, Group):
        row = BROKEN
        for block in group.blocks:
            if row < block.batch.nsim:
                block.batch.bind(field)[row, 3] = value
                return
            row -= block.batch.nsim
    assert isinstance(group, MjxGroup)
    data = group.worlds.data
    changed = jnp.asarray(getattr(data, field)).at[BROKEN, 3].set(value)
    group.replace(group.worlds._replace(data=data.replace(**{field: changed})))


def rollout(env: LiberoEnv, slots: list[int], *, broken: tuple[str, float] | None = None) -> list[np.ndarray]:
    """States and flags of the slots after every tick of the same actions."""
    rng, seen = np.random.default_rng(0), []
    for tick in range(TICKS):
        if broken is not None and tick == 1:
            inject(env, *broken)
        actions = rng.uniform(-1, 1, (B, 7))
        control = env.step_continuous(actions if env.num_envs == B else actions[OTHERS])
        rows = slots if env.num_envs == B else list(range(len(slots)))
        state = env.state()
        seen += [state.qpos[rows], state.qvel[rows], state.time[rows], control.step_index[rows], control.done[rows]]
        seen.append(env.observe_egocentric().state[rows])
    return seen


BREAKS = [("qvel", np.nan), ("qvel", np.inf), ("qvel", 1e30), ("qpos", np.nan), ("qpos", -np.inf), ("qvel", -1e12)]


@pytest.mark.parametrize("broken", BREAKS)
@pytest.mark.parametrize("num_threads", [1, 2])
def test_native_neighbours_have_the_bits_of_a_batch_without_it(broken: tuple[str, float], num_threads: int) -> None:
    with make(list(range(B)), num_threads=num_threads) as env, make(OTHERS, num_threads=num_threads) as without:
        for mine, theirs in zip(rollout(env, OTHERS, broken=broken), rollout(without, OTHERS), strict=True):
            np.testing.assert_array_equal(mine, theirs)
        assert_quarantined(env)
        env.reset()  # begins again, healthy
        assert env.step_continuous(np.zeros((B, 7))).info["fault"] == ("",) * B


@pytest.mark.heavy
@pytest.mark.parametrize("broken", BREAKS[:3])
def test_mjx_neighbours_have_the_bits_of_the_same_batch_unbroken(broken: tuple[str, float]) -> None:
    options: dict[str, Any] = {"backend": "jax", "geometry": "lean"}
    with make(list(range(B)), **options) as env:
        expected = rollout(env, OTHERS)
        env.end_episodes(np.ones(B, bool))
        env.reset()
        for mine, theirs in zip(rollout(env, OTHERS, broken=broken), expected, strict=True):
            np.testing.assert_array_equal(mine, theirs)
        assert_quarantined(env)


def assert_quarantined(env: LiberoEnv) -> None:
    control = env.step_continuous(np.zeros((B, 7)))
    fault = control.info["fault"]
    assert [bool(reason) for reason in fault] == [slot == BROKEN for slot in range(B)]
    assert any(word in fault[BROKEN] for word in ("finite", "huge")), fault
    assert control.truncated.tolist() == [slot == BROKEN for slot in range(B)]
    assert not control.success[BROKEN]
    seen = env.observe_objects()
    assert seen.snapshot[BROKEN] is None
    assert fault[BROKEN] in seen.error[BROKEN]
