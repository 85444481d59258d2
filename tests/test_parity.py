"""Trajectories are upstream's: same start, fixtures and actions give the same states, observations and verdicts.

The peer is LIBERO on robosuite 1.4.0 under the installed MuJoCo, without images.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import upstream

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.suites import task as task_spec

SETTLE = 10
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
    env = vecenv.make(suite, task=task, episodes=[episode], fixtures=fixtures_of(peer), start="raw", settle_steps=0)
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
