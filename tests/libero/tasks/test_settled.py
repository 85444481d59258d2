"""Settled starts: they ship with the package, belong to the installed init states, and are at rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.tasks import settled
from vecenv.libero.tasks.suites import TaskSpec, list_suites, list_tasks, task

IDLE = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])


def make(suite: str, **options: Any) -> LiberoEnv:
    env = vecenv.make(suite, **options)
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def idle(env: LiberoEnv, ticks: int) -> np.ndarray:
    return np.tile(IDLE, (env.num_envs, ticks, 1))


@pytest.mark.parametrize("suite", list_suites())
def test_every_task_has_settled_starts_of_its_own_init_states(suite: str) -> None:
    for spec in list_tasks(suite):
        starts, states = settled.load(spec), spec.init_states()
        assert starts.qpos.shape[0] == starts.qvel.shape[0] == len(states)
        assert starts.qpos.shape[1] + starts.qvel.shape[1] + 1 == states.shape[1]
        assert np.isfinite(starts.qpos).all()
        # The robot has hardly moved (its controller first aims at the pose of the reset) and has opened its hand.
        np.testing.assert_allclose(starts.qpos[:, :7], states[:, 1:8], atol=0.25)
        assert (starts.qpos[:, 7] > 0.03).all()


def test_settled_is_the_default_and_half_a_second_in() -> None:
    env = make("libero_object", task=0, episodes=[0, 1])
    np.testing.assert_array_equal(env.state().time, settled.TIME)
    np.testing.assert_array_equal(env.state().qpos, settled.load(task("libero_object", 0)).qpos[:2])
    assert env.evaluate().num_steps.tolist() == [0, 0]


def test_the_bowl_stays_on_the_ramekin() -> None:
    """Settled live under MuJoCo 3.4 or later it slides off: this is what settled starts are for."""
    env = make("libero_spatial", task=5, episodes=range(8))

    def gap() -> np.ndarray:
        snapshots = [snapshot for snapshot in env.observe_objects().snapshot if snapshot is not None]
        assert len(snapshots) == 8
        bowl = np.array([s.poses["akita_black_bowl_1"][:3] for s in snapshots])
        return bowl - np.array([s.poses["glazed_rim_porcelain_ramekin_1"][:3] for s in snapshots])

    before = gap()
    assert (np.linalg.norm(before[:, :2], axis=1) < 0.03).all()
    assert (before[:, 2] > 0.02).all()
    env.step_continuous(idle(env, 20))
    assert np.abs(gap() - before).max() < 1e-3


def test_where_versions_agree_settling_live_gives_the_same_rollout() -> None:
    shipped = make("libero_object", task=5, episodes=[0, 1])
    live = make("libero_object", task=5, episodes=[0, 1], start="raw", settle_steps=10)
    np.testing.assert_allclose(shipped.state().qpos, live.state().qpos, atol=1e-3)
    np.testing.assert_allclose(shipped.state().time, live.state().time)
    rng = np.random.default_rng(0)
    # No rotation: the goal keeps the orientation of the reset, which both controllers must remember.
    actions = np.concatenate([rng.uniform(-1, 1, (2, 8, 3)), np.zeros((2, 8, 3)), -np.ones((2, 8, 1))], axis=2)
    shipped.step_continuous(actions)
    live.step_continuous(actions)
    np.testing.assert_allclose(shipped.observe_egocentric().state, live.observe_egocentric().state, atol=1e-4)


def test_fixtures_elsewhere_settle_elsewhere() -> None:
    central, sampled = (make("libero_goal", task=0, episodes=[0], fixtures=kind) for kind in ("center", "sampled"))
    places = [env.physics.groups[0].expand("body_pos") for env in (central, sampled)]
    assert np.abs(places[0] - places[1]).max() > 1e-3
    assert (central.state().qpos != sampled.state().qpos).any()
    np.testing.assert_array_equal(central.state().time, sampled.state().time)


def altered(spec: TaskSpec) -> TaskSpec:
    """The same task with another task's init states."""
    other = list_tasks(spec.suite)[spec.index + 1]
    return TaskSpec(spec.suite, spec.index, spec.name, spec.bddl_path, other.init_states_path)


def test_starts_of_other_init_states_are_refused() -> None:
    with pytest.raises(settled.SettledStartsError, match="other init states"):
        settled.load(altered(task("libero_object", 0)))


def test_missing_and_damaged_files_are_named(tmp_path: Path) -> None:
    spec = task("libero_object", 0)
    with pytest.raises(settled.SettledStartsError, match=r"libero_object\.npz: no such file"):
        settled.read(tmp_path, spec)
    (tmp_path / "libero_object.npz").write_bytes(b"PK\x03\x04 not a zip file")
    with pytest.raises(settled.SettledStartsError, match=r"libero_object\.npz: damaged"):
        settled.read(tmp_path / ".." / tmp_path.name, spec)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    spec = task("libero_object", 3)
    starts = settled.load(spec)
    settled.write(tmp_path, "libero_object", [spec], [(starts.qpos, starts.qvel)])
    np.testing.assert_array_equal(settled.read(tmp_path, spec).qpos, starts.qpos)
    with pytest.raises(settled.SettledStartsError, match="task 4"):
        settled.read(tmp_path, task("libero_object", 4))
