"""MJX physics: a drop-in for the native backend, one compiled call for chunks and plans, faults of single slots."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vecenv
from vecenv.contract import BatchEnv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.physics.budgets import Budget, BudgetError
from vecenv.libero.physics.mjx import backend as mjx_physics
from vecenv.libero.physics.mjx.options import MjxError, resolve_impl
from vecenv.libero.physics.mjx.step import fault_text

pytest.importorskip("warp", reason="MuJoCo Warp is an extra: pip install 'vecenv[warp]'")

pytestmark = pytest.mark.usefixtures("quick_compilation")

SLOTS = 3
# Ticks of most calls: a call of another length is another program, which takes longer to compile than to run.
TICKS = 3


def libero(backend: str, task: int = 0, episodes: int = SLOTS, **options: Any) -> LiberoEnv:
    """Some episodes of a task, live."""
    env = vecenv.make("libero_object", task=task, episodes=range(episodes), backend=backend, **options)
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


@pytest.fixture(scope="module")
def warp() -> Iterator[LiberoEnv]:
    env = libero("warp")
    yield env
    env.close()


@pytest.fixture(scope="module")
def native() -> Iterator[LiberoEnv]:
    env = libero("native")
    yield env
    env.close()


@pytest.fixture
def both(warp: LiberoEnv, native: LiberoEnv) -> tuple[LiberoEnv, LiberoEnv]:
    """Both backends at the start of their episodes."""
    for env in (warp, native):
        env.set_episodes(tasks=0, episodes=range(SLOTS))
        env.reset()
    return warp, native


def chunk(ticks: int = TICKS) -> np.ndarray:
    """Actions that keep the hand in free space."""
    half = np.random.default_rng(0).uniform(-0.5, 0.5, (SLOTS, ticks, 7))
    half[..., 2] = np.abs(half[..., 2])
    return half


def test_it_speaks_every_verb(warp: LiberoEnv) -> None:
    assert isinstance(warp, BatchEnv)


def test_a_chunk_ends_where_native_physics_ends(both: tuple[LiberoEnv, LiberoEnv]) -> None:
    actions = chunk()
    controls = [env.step_continuous(actions) for env in both]
    ours, theirs = (env.state() for env in both)
    assert np.abs(ours.qpos - theirs.qpos).max() < 1e-4
    assert np.abs(both[0].observe_egocentric().state - both[1].observe_egocentric().state).max() < 1e-5
    for name in ("reward", "terminated", "truncated", "success", "step_index"):
        np.testing.assert_array_equal(getattr(controls[0], name), getattr(controls[1], name))


def test_images_show_the_moment_that_native_physics_shows(both: tuple[LiberoEnv, LiberoEnv]) -> None:
    seen, now = [], []
    for env in both:
        (group,) = env.physics.groups
        np.testing.assert_array_equal(group.seen_qpos, group.qpos)
        env.step_continuous(chunk())
        seen.append(group.seen_qpos.copy())
        now.append(group.qpos.copy())
    # The hand is on its way: the end of the tick, two substeps later, is elsewhere.
    arm = np.s_[:, :7]
    assert np.abs(now[1] - seen[1])[arm].max() > 3e-4
    np.testing.assert_allclose(seen[0][arm], seen[1][arm], atol=3e-5)


def test_a_chunk_is_the_same_as_its_ticks(warp: LiberoEnv) -> None:
    actions = chunk()
    warp.set_episodes(tasks=0, episodes=range(SLOTS))
    warp.reset()
    warp.step_continuous(actions)
    whole = warp.state().qpos
    warp.set_episodes(tasks=0, episodes=range(SLOTS))
    warp.reset()
    for k in range(TICKS):
        warp.step_continuous(actions[:, k])
    assert np.abs(warp.state().qpos - whole).max() < 1e-5


def test_a_pose_is_reached_in_as_many_ticks_as_on_native_physics(both: tuple[LiberoEnv, LiberoEnv]) -> None:
    targets = np.stack([np.r_[s.ee_pose[:3] + [0.03, 0.02, 0.02], s.ee_pose[3:], 0] for s in snapshots(both[1])])
    controls = [env.step_ee_pose(targets) for env in both]
    assert all(control.converged.all() for control in controls)
    assert np.abs(controls[0].step_count - controls[1].step_count).max() <= 1
    assert np.abs(controls[0].final_pose - controls[1].final_pose).max() < 2e-3


def test_a_plan_is_followed_as_on_native_physics(both: tuple[LiberoEnv, LiberoEnv]) -> None:
    start = np.stack([s.ee_pose for s in snapshots(both[1])])
    poses = np.stack([start, start], axis=1)
    poses[:, 0, 2] += 0.03
    plan = {
        "poses": poses,
        "grip": np.array([[0, 1]] * SLOTS),
        "hold": np.array([[0, 3]] * SLOTS),
        "valid": np.array([[True, True], [True, True], [False, False]]),
    }
    ours, theirs = (env.step_waypoints(plan) for env in both)
    np.testing.assert_array_equal(ours.converged[:, 0], [True, True, False])
    np.testing.assert_array_equal(ours.waypoint_ticks[:, 1], [3, 3, 0])
    np.testing.assert_array_equal(theirs.waypoint_ticks[:, 1], [3, 3, 0])
    assert np.abs(ours.waypoint_ticks - theirs.waypoint_ticks).max() <= 1
    assert ours.step_index[2] == theirs.step_index[2]


def test_a_motion_is_carried_on_in_the_next_call(warp: LiberoEnv) -> None:
    ticks = []
    for carry in (None, True, False):
        warp.set_episodes(tasks=0, episodes=range(SLOTS))
        warp.reset()
        poses = np.repeat(np.stack([s.ee_pose for s in snapshots(warp)])[:, None], 2, axis=1)
        poses[:, :, 0] += [0.04, 0.08]
        flat = {"grip": np.zeros((SLOTS, 2)), "hold": np.zeros((SLOTS, 2), int), "valid": np.ones((SLOTS, 2), bool)}
        if carry is None:
            ticks.append(warp.step_waypoints({"poses": poses, **flat}).waypoint_ticks.sum(axis=1))
            continue
        targets = np.concatenate([poses, np.zeros((SLOTS, 2, 1))], axis=2)
        spent = [warp.step_ee_pose(targets[:, t], carry=carry and t > 0).step_count for t in range(2)]
        ticks.append(np.sum(spent, axis=0))
    assert np.abs(ticks[1] - ticks[0]).max() <= 1
    assert (ticks[2] > ticks[0] + 1).all()


def test_watchers_hear_of_every_tick_of_a_compiled_call(warp: LiberoEnv) -> None:
    warp.set_episodes(tasks=0, episodes=range(SLOTS))
    warp.reset()
    actions, seen = chunk(), []
    with warp.watched(lambda action, active: seen.append((action.copy(), active.copy()))):
        warp.step_continuous(actions)
    assert len(seen) == TICKS
    for k, (action, active) in enumerate(seen):
        np.testing.assert_allclose(action, actions[:, k])
        assert active.all()


def test_a_finished_slot_stands_still(warp: LiberoEnv) -> None:
    warp.set_episodes(tasks=0, episodes=range(SLOTS))
    warp.reset()
    before = warp.state().qpos
    ran = warp.physics.run(chunk(), np.array([True, False, True]), np.full(SLOTS, 9))
    after = warp.state().qpos
    np.testing.assert_array_equal(ran.ticks, [TICKS, 0, TICKS])
    np.testing.assert_array_equal(after[1], before[1])
    assert (after[0] != before[0]).any()


def test_a_state_that_is_not_finite_is_a_fault_of_its_slot_alone(warp: LiberoEnv) -> None:
    warp.set_episodes(tasks=0, episodes=range(SLOTS))
    warp.reset()
    group = warp.physics.groups[0]
    qvel = group.worlds.data.qvel.at[1, 12].set(jnp.nan)
    group.replace(group.worlds._replace(data=group.worlds.data.replace(qvel=qvel)))
    control = warp.step_continuous(chunk())
    assert control.info["fault"][1] == "non-finite or huge state"
    np.testing.assert_array_equal(control.truncated, [False, True, False])
    assert control.info["fault"][0] == control.info["fault"][2] == ""
    np.testing.assert_array_equal(control.info["ticks"], [TICKS, 1, TICKS])


def test_too_few_constraint_rows_are_a_fault(warp: LiberoEnv) -> None:
    rows = int(np.asarray(warp.physics.groups[0].worlds.data._impl.nefc).max())  # type: ignore[attr-defined]
    budget = replace(warp.physics.groups[0].built.budget, rows=rows // 2)
    env = libero("warp", budget=budget)
    assert all("njmax" in fault for fault in env.step_continuous(chunk(1)).info["fault"])
    env.close()


def test_budgets_name_what_is_wrong() -> None:
    with pytest.raises(BudgetError, match="rows=0"):
        Budget(contacts=1, rows=0, pairs=1, candidates=1)


def test_a_measured_budget_has_room_for_the_starts(warp: LiberoEnv) -> None:
    (group,) = warp.physics.groups
    data = group.worlds.data._impl
    assert int(np.asarray(data.nefc).max()) < group.built.budget.rows  # type: ignore[attr-defined]
    assert int(np.asarray(data.nacon).max()) < SLOTS * group.built.budget.contacts  # type: ignore[attr-defined]


@pytest.mark.heavy
def test_episodes_of_a_published_protocol_begin_healthy() -> None:
    """Raw starts of libero_object have things in the floor, which is more contacts than they ever have again."""
    env = vecenv.make("libero_object", task=0, episodes=range(4), backend="warp", protocol="openpi")
    assert isinstance(env, LiberoEnv)
    env.reset()
    assert (env.physics.faults, env.done.any()) == ({}, False)
    standing = env.step_continuous(np.zeros((4, 0, 7)))
    assert (standing.info["ticks"].tolist(), standing.info["fault"]) == ([0] * 4, ("",) * 4)
    env.close()


def test_worlds_share_contact_memory_when_the_share_is_known() -> None:
    budget = Budget(contacts=100, rows=30, pairs=1, candidates=120)
    assert budget.warp_sizes(3) == {"naconmax": 360, "njmax": 30}
    assert replace(budget, share=40).warp_sizes(3)["naconmax"] == 120 + 2 * 40
    assert replace(budget, share=400).warp_sizes(3)["naconmax"] == 360


def test_fault_text_names_every_bit() -> None:
    assert fault_text(1 | 1 << 30) == "more constraint rows than the budget njmax; non-finite or huge state"


@pytest.mark.heavy
def test_pure_jax_stays_with_native_physics() -> None:
    """In float32 MJX's own solver throws objects about within a tick; see ``vecenv.libero.physics.newton``."""
    ours, theirs = (libero(backend, episodes=4, geometry="lean") for backend in ("jax", "native"))
    (group,) = theirs.physics.groups
    first = np.array([group.scene.model.joint(entity.joints[0]).qposadr[0] for entity in group.scene.objects])
    rng = np.random.default_rng(0)
    for _ in range(4):
        actions = np.repeat(rng.uniform(-1, 1, (4, 1, 7)), 5, axis=1)
        actions[..., 2] = np.abs(actions[..., 2])
        faults = [env.step_continuous(actions).info["fault"] for env in (ours, theirs)]
        assert faults == [("",) * 4] * 2
        apart = np.abs(ours.state().qpos - theirs.state().qpos)
        assert apart[:, first[:, None] + np.arange(3)].max() < 1e-4
        assert apart[:, :9].max() < 1e-3


def test_unknown_implementations_are_refused() -> None:
    with pytest.raises(MjxError, match="'jax' or 'warp'"):
        resolve_impl("cpp")
    with pytest.raises(MjxError, match="JAX sees"):
        mjx_physics._mesh(len(jax.devices()) + 1)


SHARDED = """
import numpy as np, vecenv
actions = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 2, 7))
ends = []
for devices in (1, 2):
    env = vecenv.make("libero_object", task=0, episodes=range(3), backend="jax", geometry="lean", num_devices=devices)
    env.reset()
    assert env.step_continuous(actions).info["ticks"].tolist() == [2, 2, 2]
    ends.append(env.state().qpos)
    shards = env.physics.groups[0].worlds.data.qpos.sharding.num_devices
    assert shards == devices, shards
assert np.abs(ends[0] - ends[1]).max() < 1e-5, np.abs(ends[0] - ends[1]).max()
"""


@pytest.mark.heavy
def test_slots_spread_over_devices_end_where_they_would_on_one() -> None:
    flags = {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", SHARDED], env={**os.environ, **flags}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def snapshots(env: LiberoEnv) -> list[Any]:
    """Ground truth of the slots."""
    found = [snapshot for snapshot in env.observe_objects().snapshot if snapshot is not None]
    assert len(found) == SLOTS
    return found
