"""Trajectories are upstream's: same start, fixtures and actions give the same states, observations and verdicts.

The peer of current contacts is LIBERO on robosuite 1.4.0 under the installed MuJoCo, without images. The peer of
published contacts is the same under MuJoCo 3.3.0, whose rollouts are on record (``scripts/record_rollouts.py``).
"""

from __future__ import annotations

import functools
import json
from typing import Any

import numpy as np
import pytest
from support import upstream
from support.paths import DATA

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.tasks.suites import task as task_spec

SETTLE = 10
RECORDED = DATA / "rollouts_mujoco_3_3_0.npz"
# One task of each workspace, articulated fixtures and the densest contacts among them, and where fixtures are absent.
TASKS = [
    ("libero_object", 0),
    ("libero_spatial", 5),
    ("libero_goal", 3),
    ("libero_10", 2),
    ("libero_10", 5),
    ("libero_10", 9),
    ("libero_90", 60),
]


def random_actions(seed: int, ticks: int) -> np.ndarray:
    """Settling ticks, then piecewise constant actions, some without rotation, with gripper flips, [ticks, 7]."""
    rng = np.random.default_rng(seed)
    actions = [np.array([0, 0, 0, 0, 0, 0, -1.0])] * SETTLE
    while len(actions) < ticks:
        action = rng.uniform(-1, 1, 7)
        action[3:6] *= rng.random() < 0.7
        action[6] = rng.choice([-1.0, 1.0])
        actions += [action] * int(rng.integers(1, 8))
    return np.array(actions[:ticks])


def fixtures_of(peer: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    model = upstream.model_of(peer)
    bodies = {name: model.body(fixture.root_body) for name, fixture in peer.env.fixtures_dict.items()}
    return {name: (body.pos.copy(), body.quat.copy()) for name, body in bodies.items()}


def pair(suite: str, task: int, episode: int) -> tuple[Any, LiberoEnv]:
    """Upstream right after ``set_init_state``, and ours in the same start with the same fixture poses."""
    spec = task_spec(suite, task)
    peer = upstream.bare_peer(spec.bddl_path)
    peer.seed(episode)
    with upstream.silence():
        peer.reset()
    peer.set_init_state(spec.init_states()[episode])
    options = {"start": "raw", "settle_steps": 0, "contacts": "current"}
    env = vecenv.make(suite, task=task, episodes=[episode], fixtures=fixtures_of(peer), **options)  # type: ignore[arg-type]
    assert isinstance(env, LiberoEnv)
    env.reset()
    return peer, env


@pytest.mark.parametrize(("suite", "task"), TASKS)
def test_a_rollout_is_upstreams(suite: str, task: int) -> None:
    peer, env = pair(suite, task, episode=3)
    for tick, action in enumerate(random_actions(task, ticks=40)):
        theirs, _, done, _ = peer.step(action)
        control = env.step_continuous(action[None])
        np.testing.assert_allclose(env.state().qpos[0], upstream.data_of(peer).qpos, atol=1e-6, err_msg=f"tick {tick}")
        proprioception = np.concatenate(
            [
                theirs["robot0_eef_pos"],
                upstream.rotation_vector(theirs["robot0_eef_quat"]),
                theirs["robot0_gripper_qpos"],
            ]
        )
        # Ours is float32, as policies take it.
        np.testing.assert_allclose(env.observe_egocentric().state[0], proprioception, atol=1e-6, err_msg=f"tick {tick}")
        assert bool(control.success[0]) == bool(done)


def test_the_first_tick_starts_from_the_reset_pose() -> None:
    """Upstream's controller has not seen the stored start yet; a current one would miss by millimetres."""
    peer, env = pair("libero_object", 0, episode=1)
    start = env.observe_egocentric().state[0, :3]
    action = np.array([0.3, -0.2, 0.1, 0.0, 0.0, 0.0, -1.0])
    peer.step(action)
    env.step_continuous(action[None])
    np.testing.assert_allclose(env.state().qpos[0], upstream.data_of(peer).qpos, atol=1e-12)
    controller = peer.env.robots[0].controller
    aimed_from = controller.goal_pos - 0.05 * action[:3]
    np.testing.assert_allclose(aimed_from, controller.initial_ee_pos, atol=1e-12)
    assert np.linalg.norm(aimed_from - start) > 0.004


# -- published contacts ------------------------------------------------------------------------------------------------


@functools.cache
def recorded() -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Jobs, and arrays named by the number of the job."""
    with np.load(RECORDED, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return json.loads(str(arrays.pop("jobs"))), arrays


def apart_from_record(number: int, contacts: str) -> tuple[np.ndarray, np.ndarray]:
    """Largest difference of joint positions after each tick, [T], and whether the robot has touched anything, [T]."""
    jobs, arrays = recorded()
    job = jobs[number]
    names, pos, quat, actions, qpos, touched, success = (
        arrays[f"{number}/{name}"]
        for name in ("fixtures", "fixture_pos", "fixture_quat", "actions", "qpos", "touched", "success")
    )
    env = vecenv.make(
        job["suite"],
        task=job["task"],
        episodes=[job["episode"]],
        fixtures={str(name): (pos[i], quat[i]) for i, name in enumerate(names)},
        start="raw",
        settle_steps=0,
        contacts=contacts,
    )
    assert isinstance(env, LiberoEnv)
    env.reset()
    apart = []
    for tick, action in enumerate(actions):
        control = env.step_continuous(action[None])
        apart.append(np.abs(env.state().qpos[0] - qpos[tick]).max())
        assert bool(control.success[0]) == bool(success[tick])
    env.close()
    return np.array(apart), touched


@pytest.mark.parametrize("number", range(6))
def test_published_contacts_give_the_rollouts_of_mujoco_3_3_0(number: int) -> None:
    apart, touched = apart_from_record(number, "published")
    assert apart[~touched].max(initial=0) <= 1e-5
    assert apart[touched].max(initial=0) <= 1e-3


@pytest.mark.parametrize("number", [0, 1])
def test_current_contacts_move_what_published_ones_leave_where_it_is(number: int) -> None:
    """The bowl falls off its ramekin, and objects leave their places: what a wrong version of MuJoCo does to LIBERO."""
    apart, _ = apart_from_record(number, "current")
    assert apart.max() > 0.02
