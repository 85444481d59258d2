"""VoxPoser's view of SIMPLER's WidowX scenes: its hand, its names, and that it solves a task."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vecenv
from vecenv.manipulation.world import HOME_ROTATION, SceneGeometry, matrix
from voxposer import simpler_scene
from voxposer.agent import AgentConfig
from voxposer.offline.planner_writer import write_planner
from voxposer.simpler_scene import NoHandView, hand_poses, hands, tool_poses

pytest.importorskip("sapien")
BRIDGE = "simpler/bridge"


@pytest.fixture
def seen(small: Path) -> Iterator[Any]:
    env = vecenv.make(BRIDGE, episodes=[0], assets=small, num_threads=1)
    env.reset()
    view, _ = hands(env, BRIDGE, AgentConfig())
    yield view
    env.close()


def test_hand_and_tool_are_turned_into_one_another() -> None:
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(2, 3, 7))
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    back = tool_poses(hand_poses(poses))
    np.testing.assert_allclose(back[..., :3], poses[..., :3])
    np.testing.assert_allclose(np.abs((back[..., 3:] * poses[..., 3:]).sum(-1)), 1.0)
    # The tool points along its x and opens along its y.
    hand = matrix(hand_poses(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))[3:])
    np.testing.assert_allclose(hand[:, 2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(hand[:, 1], [0, 1, 0], atol=1e-12)


def test_the_hand_begins_as_a_pandas_does(seen: Any) -> None:
    for snapshot in seen.observe_objects().snapshot:
        np.testing.assert_allclose(matrix(snapshot.ee_pose[3:]), HOME_ROTATION, atol=0.08)
        np.testing.assert_allclose(snapshot.gripper, [0.026, -0.026], atol=1e-3)


def test_instructions_are_understood_by_the_names_of_the_scene(seen: Any) -> None:
    wanted = [("spoon", "towel"), ("carrot", "plate"), ("green_block", "yellow_block"), ("eggplant", "yellow_basket")]
    for snapshot, instruction, (thing, place) in zip(
        seen.observe_objects().snapshot, seen.reset().instruction, wanted, strict=True
    ):
        program = write_planner(instruction, snapshot.names)
        assert f'composer("grasp the {thing}")' in program
        assert f"the {place}" in program
        assert set(snapshot.movable) <= set(snapshot.objects) == set(snapshot.poses)


def test_table_samples_are_added_to_a_scene_without_them(seen: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Upstream's own stages are meshes, of which a snapshot has no points."""
    snapshot = seen.env.observe_objects().snapshot[1]
    clouds = list(snapshot.objects.values())
    bare = type(snapshot.scene)(*(np.concatenate([getattr(c, part) for c in clouds]) for part in ("points", "normals")))
    shown = simpler_scene.view(replace(snapshot, scene=bare))
    low = min(cloud.points[:, 2].min() for cloud in clouds)
    assert SceneGeometry(shown, AgentConfig().perception.margins).ground(np.array([-0.16, 0.0])) == pytest.approx(low)


def test_a_hand_moves_to_its_target(seen: Any) -> None:
    start = np.stack([snapshot.ee_pose for snapshot in seen.observe_objects().snapshot])
    targets = np.concatenate([start, np.zeros((4, 1))], axis=1)
    targets[:, :3] += [-0.02, 0.02, 0.03]
    control = seen.step_ee_pose(targets)
    assert control.converged.all()
    np.testing.assert_allclose(control.final_pose[:, :3], targets[:, :3], atol=0.011)


@pytest.mark.parametrize(("sign", "gap"), [(1.0, 0.008), (-1.0, 0.052)])
def test_waiting_keeps_the_grip_in_liberos_sign(seen: Any, sign: float, gap: float) -> None:
    actions = np.zeros((4, 4, 7))
    actions[..., 6] = sign
    seen.step_continuous(actions)
    for snapshot in seen.observe_objects().snapshot:
        assert snapshot.gripper[0] - snapshot.gripper[1] == pytest.approx(gap, abs=2e-3)


def test_other_environments_pass_through_and_other_robots_are_refused() -> None:
    env, config = object(), AgentConfig()
    assert hands(env, "libero_goal", config) == (env, config)  # type: ignore[arg-type]
    with pytest.raises(NoHandView, match="simpler/bridge of SIMPLER's suites, not simpler/google_robot"):
        hands(env, "simpler/google_robot", config)  # type: ignore[arg-type]


@pytest.mark.heavy
@pytest.mark.parametrize("task", range(4))
def test_the_rule_based_model_solves_an_episode_of_every_task(task: int, original: Path) -> None:
    from vecenv_eval.drive import drive
    from vecenv_eval.policies import make_policy

    env = vecenv.make(BRIDGE, task=task, episodes=[0, 2], assets=original, num_threads=1)
    policy = make_policy("voxposer")
    policy.reset(env, env.reset())
    for _ in drive(env, policy):
        pass
    assert env.evaluate().success.any()
    env.close()
