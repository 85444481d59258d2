"""Success of SIMPLER's tasks, and agreement of states and verdicts with upstream's recorded rollouts.

Everything runs on generated assets; with upstream's own too, where the archive lies beside the repository.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.simpler_files import GOOGLE_ROLLOUTS, SEEDS, WIDOWX_ROLLOUTS, rollouts

from vecenv.simpler.layouts import episode_layout
from vecenv.simpler.task_spec import GOOGLE
from vecenv.simpler.tasks import TASKS, find_task

pytest.importorskip("sapien")
pytest.importorskip("ruckig")

from support.simpler_batches import CARROT, COKE, OPEN_TOP, PLACE, batch, moved, objects

from vecenv.simpler import episodes as preparing
from vecenv.simpler import judge as judging
from vecenv.simpler.env import SimplerEnv
from vecenv.simpler.physics import scenes, spec

# -- success ------------------------------------------------------------


def solved(env: SimplerEnv, ticks: int = 1) -> bool:
    control = env.step_continuous(np.zeros((env.num_envs, ticks, 7)))
    assert control.terminated[0] == control.success[0] == (control.reward[0] == 1.0)
    return bool(control.success[0])


def test_the_carrot_on_the_plate_is_success_and_beside_it_is_not(tree: Path) -> None:
    env = batch(tree, CARROT, [0])
    assert not solved(env)
    plate = objects(env)[1, :3]
    env.set_state(moved(env, 0, plate + [0, 0, 0.03]))
    assert solved(env, 5)
    env.close()


@pytest.mark.parametrize(("task", "opened", "expected"), [(OPEN_TOP, 0.16, True), (OPEN_TOP, 0.14, False)])
def test_an_open_drawer_is_success(tree: Path, task: str, opened: float, expected: bool) -> None:
    env = batch(tree, task, [0])
    state = env.state()
    state.qpos[0, env.robot.dof] = opened
    env.set_state(state)
    assert solved(env) == expected
    env.close()


def test_a_closed_drawer_is_success_and_it_starts_open(tree: Path) -> None:
    env = batch(tree, "google_robot_close_bottom_drawer", [0])
    state = env.state()
    assert state.qpos[0, env.robot.dof + 2] == pytest.approx(0.2)
    assert not solved(env)
    state.qpos[0, env.robot.dof + 2] = 0.04
    env.set_state(state)
    assert solved(env)
    env.close()


def test_near_the_target_is_success_unless_a_bystander_fell(tree: Path) -> None:
    env = batch(tree, "google_robot_move_near", [0])
    roles, poses = env._episodes[0].roles, objects(env)
    away = poses[roles.target, :3] + [0.0, 0.1, 0.0]
    away[2] = poses[roles.source, 2]
    assert not solved(env)
    env.set_state(moved(env, roles.source, away))
    assert solved(env)
    env.close()


def test_an_object_on_the_floor_of_the_open_drawer_is_success_in_the_second_half(tree: Path) -> None:
    env = batch(tree, PLACE, [0])
    state = moved(env, 0, [-0.295 + 0.25 + 0.12, 0.0, 0.017 + 0.668])
    state.qpos[0, env.robot.dof] = 0.25
    env.set_state(state)
    assert not solved(env, 3)
    assert env.instructions()[0] == "open top drawer"
    env.advance_subtask()
    assert env.instructions()[0] == "place apple into top drawer"
    assert solved(env)
    env.close()


def test_the_second_half_begins_by_itself(small: Path) -> None:
    env = batch(small, PLACE, [0])
    judge = env._judges[0]
    assert judge is not None
    assert [judge.second_half(tick) for tick in (100, 101)] == [False, True]
    env.close()


def test_a_lifted_object_counts_until_the_grasp_is_lost() -> None:
    task = find_task(GOOGLE, COKE)
    rows = np.zeros(1, spec.facts_dtype(11, 1))
    rows["objects"][0, 0, 3] = 1.0
    roles = judging.Roles(source=0, loose=(0,), sizes=np.ones((1, 3)))
    judge = judging.Judge(task, roles, rows[0])
    rows["grip"][0, :, 0], rows["grip"][0, :, 1] = 1.0, 0.1
    rows["objects"][0, 0, 2], rows["support"][0] = 0.015, 1.0
    assert not judge.after(rows[0], 1).success  # still supported
    rows["support"][0] = 0.0
    assert judge.after(rows[0], 2).success
    rows["support"][0] = 1.0
    assert judge.after(rows[0], 3).success  # remembered
    rows["grip"][0, :, 0] = 0.0
    assert not judge.after(rows[0], 4).success  # grasp lost


# -- agreement with upstream ------------------------------------------------------------


def replay(root: Path, name: str, seed: int) -> tuple[scenes.Scene, np.ndarray, object, preparing.Episode]:
    """A scene at the start of a recorded rollout, a row of facts, the robot's controller, and the episode."""
    from vecenv.simpler.control.controllers import controller

    task = TASKS[name]
    episode = preparing.prepare(task, episode_layout(task, seed), root)
    scene = scenes.Scene(episode.spec)
    scene.begin(episode.start)
    rows = np.zeros(1, spec.facts_dtype(task.robot.dof, len(episode.spec.objects)))
    scene.measure(rows[0])
    control = controller(task.robot, root / task.robot.urdf_path(), 1)
    control.reset(np.ones(1, bool), rows["qpos"])
    return scene, rows, control, episode


@pytest.mark.parametrize("name", [WIDOWX_ROLLOUTS, GOOGLE_ROLLOUTS])
def test_recorded_actions_lead_to_the_recorded_states(original: Path, name: str) -> None:
    full = name if name in TASKS else f"widowx_{name}"
    actions, qpos, tcp = (rollouts(name, key) for key in ("actions", "qpos", "tcp"))
    poses, start = rollouts(name, "obj_pose"), rollouts(name, "obj_pose0")
    arm, fingers = (list(getattr(TASKS[full].robot, part)) for part in ("arm", "gripper"))
    for row, seed in enumerate(SEEDS):
        scene, facts, control, _ = replay(original, full, seed)
        np.testing.assert_allclose(facts["objects"][0, :, :3], start[row, :, :3], atol=5e-4)
        for tick, action in enumerate(actions[row]):
            points = control.set_action(action[None], facts["qpos"], facts["qvel"])  # type: ignore[attr-defined]
            scene.advance(points.position[0], points.velocity[0])
            scene.measure(facts[0])
            np.testing.assert_allclose(facts["qpos"][0, arm], qpos[row, tick, arm], atol=1e-3)
            # Pressed on each other, upstream's own fingers wander by 0.02 rad.
            np.testing.assert_allclose(facts["qpos"][0, fingers], qpos[row, tick, fingers], atol=0.03)
            np.testing.assert_allclose(facts["tcp"][0, :3], tcp[row, tick, :3], atol=2e-4)
            np.testing.assert_allclose(facts["objects"][0, :, :3], poses[row, tick, :, :3], atol=6e-4)


def test_recorded_verdicts_are_reproduced(original: Path) -> None:
    keys = ("success", "info_moved_correct_obj", "info_is_src_obj_grasped", "info_src_on_target")
    recorded = {key.removeprefix("info_"): rollouts(WIDOWX_ROLLOUTS, key) for key in keys}
    poses = rollouts(WIDOWX_ROLLOUTS, "obj_pose")
    for row, seed in enumerate(SEEDS):
        scene, facts, _, episode = replay(original, WIDOWX_ROLLOUTS, seed)
        judge = judging.Judge(episode.task, episode.roles, facts[0])
        for tick in range(poses.shape[1]):
            scene.measure(facts[0])
            verdict = judge.after(facts[0], tick + 1)
            assert verdict.success == recorded["success"][row, tick]
            for part in ("moved_correct_obj", "is_src_obj_grasped", "src_on_target"):
                assert verdict.parts[part] == bool(recorded[part][row, tick])
