"""The SIMPLER environment: every task in a batch, the rules of the contract, cameras, states, grippers, poses, plans.

Everything runs on generated assets; with upstream's own too, where the archive lies beside the repository.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from vecenv.observations import ImagesUnavailable
from vecenv.simpler.control.rotations import rotation_from_quat
from vecenv.simpler.task_spec import BRIDGE, GOOGLE
from vecenv.simpler.tasks import TASKS, list_tasks

pytest.importorskip("sapien")
pytest.importorskip("ruckig")

from support.simpler_batches import CARROT, COKE, PLACE, STAY, batch, moved, objects

from vecenv import make
from vecenv.simpler import workers
from vecenv.simpler.env import SimplerEnv, SimplerError
from vecenv.simpler.physics import hulls, scenes, spec

# -- every task ------------------------------------------------------------


@pytest.mark.parametrize(("suite", "width"), [(BRIDGE, 23), (GOOGLE, 29)])
def test_every_task_of_a_suite_runs_in_one_batch(tree: Path, suite: str, width: int) -> None:
    env = make(suite, episodes=[3], assets=tree, num_threads=1)
    info = env.reset()
    control = env.step_continuous(np.tile(STAY, (env.num_envs, 1)))
    names = [task.name for task in list_tasks(suite)]
    assert info.episode_id == tuple(f"{suite}/{name}/3" for name in names)
    assert info.max_steps.tolist() == [TASKS[name].max_steps for name in names]
    assert control.info["fault"] == ("",) * len(names)
    assert control.step_index.tolist() == [1] * len(names)
    assert env.observe_egocentric().state.shape == (len(names), width)
    for snapshot, name in zip(env.observe_objects().snapshot, names, strict=True):
        assert snapshot is not None
        assert len(snapshot.scene.points) > 100, name
        assert set(snapshot.parts) == (
            {f"{d}_drawer" for d in ("top", "middle", "bottom")} if "drawer" in name else set()
        )
    env.close()


def test_collision_meshes_are_split_by_object_and_by_what_hangs_together(tmp_path: Path) -> None:
    """Two triangles that touch are one part, unless the file says that they are two objects."""
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nv 5 0 0\nv 6 0 0\nv 5 1 0\n"
    first, touching, apart = "f 1/1/1 2/2/1 3/3/1\n", "f 4 5 6\n", "f -3 -2 -1\n"
    mesh = tmp_path / "mesh.obj"
    mesh.write_text(corners + "o a\n" + first + touching + apart)
    assert [len(part) for part in hulls.read_parts(mesh)] == [4, 3]
    mesh.write_text(corners + "o a\n" + first + "o b\n" + touching + apart)
    assert [len(part) for part in hulls.read_parts(mesh)] == [3, 3, 3]
    mesh.write_text(corners)
    with pytest.raises(hulls.MeshError, match=r"mesh\.obj: no faces"):
        hulls.read_parts(mesh)


def test_a_spoon_weighs_what_it_weighs_upstream(original: Path) -> None:
    """Upstream's SAPIEN 2 takes its mesh for four hulls, 43.06 g together."""
    env = batch(original, "widowx_spoon_on_towel", [0])
    body = env.slots._scenes[0]._bodies[0]  # type: ignore[union-attr]
    assert len(body.collision_shapes) == 4
    assert body.mass == pytest.approx(0.043058, rel=1e-3)
    env.close()


def test_missing_stages_are_named(carrot: SimplerEnv) -> None:
    control = carrot.step_continuous(np.zeros((2, 7)))
    assert any("bridge_table_1_v1.glb is missing" in note for note in control.info["stand_ins"][0])


def test_no_renderer_torch_or_maniskill_is_loaded(small: Path) -> None:
    program = (
        "import sys; from vecenv import make\n"
        f"env = make('simpler/bridge', task='{CARROT}', episodes=[0], num_threads=1); env.reset(); env.close()\n"
        "print([name for name in ('torch', 'mani_skill') if name in sys.modules])"
    )
    environment = {**os.environ, "VECENV_SIMPLER_ASSETS": str(small)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# -- the verbs' rules ------------------------------------------------------------


def test_reset_leaves_live_slots_alone_and_rearms_finished_ones(small: Path) -> None:
    env = batch(small, CARROT, [0, 0], max_steps=2)
    env.step_continuous(np.zeros((2, 7)))
    env.reset()
    assert env.evaluate().num_steps.tolist() == [1, 1]
    begun = objects(env)
    assert env.step_continuous(np.zeros((2, 7))).truncated.all()
    env.reset()
    assert env.evaluate().num_steps.tolist() == [0, 0]
    np.testing.assert_allclose(objects(env), begun, atol=1e-4)
    env.close()


def test_a_chunk_stops_at_the_budget_and_finished_slots_ignore_steps(small: Path) -> None:
    env = batch(small, CARROT, [0], max_steps=3)
    control = env.step_continuous(np.zeros((1, 5, 7)))
    assert (control.step_index[0], control.info["ticks"][0], control.truncated[0]) == (3, 3, True)
    after = env.step_continuous(np.full((1, 7), 0.1))
    assert (after.step_index[0], after.reward[0], after.truncated[0]) == (3, 0.0, True)
    env.close()


@pytest.mark.parametrize("task", [CARROT, COKE])
def test_an_episode_repeats_exactly_whatever_ran_before_or_beside_it(tree: Path, task: str) -> None:
    actions = np.random.default_rng(0).normal(0, 0.03, (3, 6, 7))
    actions[..., 6] = np.sign(actions[..., 6])
    together, alone = batch(tree, task, range(3)), batch(tree, task, [2])
    first = [
        env.step_continuous(part) and env.state().qpos for env, part in ((together, actions), (alone, actions[2:]))
    ]
    np.testing.assert_array_equal(first[0][2], first[1][0])
    together.set_episodes(episodes=[2, 1, 0])
    together.reset()
    together.step_continuous(actions[::-1])
    np.testing.assert_array_equal(together.state().qpos[::-1], first[0])
    together.close()
    alone.close()


def test_bad_numbers_are_sanitized_and_reported(carrot: SimplerEnv) -> None:
    actions = np.zeros((2, 7))
    actions[1] = [np.nan, np.inf, 0, 0, 0, 2.0, 0]
    assert carrot.step_continuous(actions).info["sanitized"].tolist() == [False, True]


def test_rotations_up_to_a_quarter_turn_are_not_clipped(carrot: SimplerEnv) -> None:
    actions = np.zeros((2, 7))
    actions[0, 3] = 1.5
    assert not carrot.step_continuous(actions).info["sanitized"].any()


def test_actions_may_be_json(carrot: SimplerEnv) -> None:
    assert carrot.step_continuous(json.dumps([[0.0] * 7] * 2)).step_index.tolist() == [1, 1]


def test_a_broken_slot_is_quarantined_alone(carrot: SimplerEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    measure = scenes.Scene.measure
    broken = carrot.slots._scenes[1]  # type: ignore[union-attr]
    monkeypatch.setattr(scenes.Scene, "measure", lambda self, row: "bad" if self is broken else measure(self, row))
    control = carrot.step_continuous(np.zeros((2, 7)))
    assert control.info["fault"] == ("", "bad")
    assert control.truncated.tolist() == [False, True]
    assert carrot.observe_objects().snapshot[1] is None


def test_steps_before_reset_and_after_close_are_refused(small: Path) -> None:
    env = make(BRIDGE, task=CARROT, episodes=[0], assets=small, num_threads=1)
    with pytest.raises(SimplerError, match="reset"):
        env.step_continuous(np.zeros((1, 7)))
    env.close()
    with pytest.raises(SimplerError, match="closed"):
        env.reset()


def test_unknown_options_are_named(small: Path) -> None:
    with pytest.raises(SimplerError, match="gripper='soft'"):
        make(BRIDGE, task=CARROT, episodes=[0], assets=small, gripper="soft")


def test_tasks_can_be_changed_without_closing(carrot: SimplerEnv) -> None:
    carrot.set_episodes(tasks="widowx_stack_cube", episodes=[4, 5])
    info = carrot.reset()
    assert info.instruction == ("stack the green block on the yellow block",) * 2
    assert info.episode_id[1] == "simpler/bridge/widowx_stack_cube/5"


def test_there_is_no_wrist_camera(carrot: SimplerEnv) -> None:
    seen = carrot.observe_egocentric()
    assert seen.wrist_image is None
    with pytest.raises(ImagesUnavailable, match="'wrist'"):
        seen.points_from_pixels("wrist", np.zeros((1, 2)))


def test_cameras_see_what_is_in_front_of_them(tree: Path) -> None:
    for task in (CARROT, COKE):
        env = batch(tree, task, [0])
        view = env.observe_egocentric().views["agentview"]
        centre = env.slots.facts["centres"][0, 0]
        x, y, depth = view.mat[0].T @ (centre - view.pos[0])
        column, row = view.intrinsics[0, :2, :2] @ [x / depth, y / depth] + view.intrinsics[0, :2, 2]
        camera = TASKS[task].camera
        assert 0 < depth < 1
        assert 0 <= column < camera.width
        assert 0 <= row < camera.height
        env.close()


def drawable() -> bool:
    from vecenv.simpler import overlay

    try:
        overlay.check_renderer()
    except overlay.RendererMissing:
        return False
    return True


def test_a_missing_driver_is_named(carrot: SimplerEnv) -> None:
    from vecenv.simpler.overlay import RendererMissing

    if drawable():
        pytest.skip("there is a Vulkan driver")
    with pytest.raises(RendererMissing, match="mesa-vulkan-drivers"):
        _ = carrot.observe_egocentric().rgb


@pytest.mark.heavy  # a CPU compiles shaders for a quarter of a minute
@pytest.mark.parametrize("suite", [BRIDGE, GOOGLE])
def test_every_task_is_drawn_on_its_photograph(small: Path, suite: str) -> None:
    if not drawable():
        pytest.skip("no Vulkan driver")
    env = make(suite, episodes=[0], assets=small, num_threads=1)
    assert isinstance(env, SimplerEnv)
    env.reset()
    seen = env.observe_egocentric()
    camera = env.tasks[0].camera
    assert seen.rgb.shape == (env.num_envs, camera.height, camera.width, 3)
    assert seen.observation[0] is seen.rgb
    for slot, (rgb, shown) in enumerate(zip(seen.rgb, seen.segmentation, strict=True)):
        # The generated photographs have one colour.
        assert (rgb[shown == 0] == (90, 120, 150)).all()
        assert (shown == 1).any(), "the robot is in the picture"
        source = env._episodes[slot].roles.source
        assert source < 0 or (shown == 2 + source).any(), env.tasks[slot].name
    env.close()


def test_a_driver_missing_in_workers_is_named_and_physics_goes_on(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vecenv.simpler.overlay import RendererMissing

    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, str(small / "no_such_driver.json"))
    env = make(BRIDGE, task=CARROT, episodes=range(2), assets=small, num_threads=2)
    env.reset()
    for _ in range(2):
        with pytest.raises(RendererMissing, match="mesa-vulkan-drivers"):
            _ = env.observe_egocentric().rgb
        assert env.step_continuous(np.zeros((2, 7))).info["fault"] == ("", "")
    env.close()


@pytest.mark.heavy
def test_worker_processes_draw_what_one_process_draws(small: Path) -> None:
    if not drawable():
        pytest.skip("no Vulkan driver")
    images = []
    for count in (1, 2):
        env = make(BRIDGE, task=CARROT, episodes=range(3), assets=small, num_threads=count)
        assert isinstance(env, SimplerEnv)
        env.reset()
        env._states.fault[1] = "bad"
        before = env.observe_egocentric()
        env.step_continuous(np.tile([0.05, 0, 0, 0, 0, 0, 1.0], (3, 1)))
        # Drawn when read, of the moment of the observation; the arrays stay when others are drawn, and after close.
        after = env.observe_egocentric()
        images.append([after.rgb, before.rgb, before.depth, before.segmentation])
        env.close()
    (after, before, depth, shown), others = images
    for one, other in zip(images[0], others, strict=True):
        np.testing.assert_array_equal(one, other)
    assert (after[0] != before[0]).any()
    assert not any(array[1].any() for array in (before, shown, depth))
    assert depth[[0, 2]].max() > 0.3


@pytest.mark.heavy
def test_pixels_lead_back_to_the_object(small: Path) -> None:
    if not drawable():
        pytest.skip("no Vulkan driver")
    env = batch(small, CARROT, [0])
    seen = env.observe_egocentric()
    rows, columns = np.nonzero(seen.segmentation[0] == 2)
    points = seen.points_from_pixels("agentview", np.stack([columns, rows], axis=1))[0]
    centre = env.slots.facts["objects"][0, 0, :3]
    # A cube of 28 mm.
    assert np.linalg.norm(points - centre, axis=1).max() < 0.03
    env.close()


def test_state_comes_back_as_it_was_set(tree: Path) -> None:
    env = batch(tree, PLACE, [0, 1])
    before = env.state()
    env.step_continuous(np.tile([0.02, 0, -0.02, 0, 0, 0.1, 1.0], (2, 1)))
    env.set_state(before)
    after = env.state()
    np.testing.assert_allclose(after.qpos, before.qpos, atol=1e-6)
    np.testing.assert_allclose(after.qvel, before.qvel, atol=1e-6)
    env.close()


def test_states_that_are_not_finite_are_refused(carrot: SimplerEnv) -> None:
    state = carrot.state()
    state.qpos[1, 0] = np.nan
    with pytest.raises(SimplerError, match="slot 1"):
        carrot.set_state(state)


def test_worker_processes_do_what_one_process_does(small: Path) -> None:
    actions = np.random.RandomState(0).uniform(-1, 1, (3, 4, 7)) * [0.02, 0.02, 0.02, 0.1, 0.1, 0.1, 1.0]
    ends = []
    for count in (1, 2):
        env = make(BRIDGE, task=CARROT, episodes=range(3), assets=small, num_threads=count)
        env.reset()
        env.step_continuous(actions)
        ends.append(env.state().qpos)
        env.close()
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-6)


def test_a_failing_worker_says_why(small: Path) -> None:
    env = make(BRIDGE, task=CARROT, episodes=range(2), assets=small, num_threads=2)
    assert isinstance(env, SimplerEnv)
    job = env._job(0)
    robot = dataclasses.replace(job.spec.robot, joints=())
    bad = dataclasses.replace(job, spec=dataclasses.replace(job.spec, robot=robot))
    with pytest.raises(workers.WorkerError, match="active joints"):
        env.slots.begin([bad])
    env.reset()
    assert env.step_continuous(np.zeros((2, 7))).step_index.tolist() == [1, 1]
    env.close()


# -- gripper ------------------------------------------------------------


@pytest.mark.parametrize(("gripper", "opening", "closing"), [("native", 1.0, -1.0), ("binary", 0.0, 1.0)])
def test_widowx_opens_and_closes(small: Path, gripper: str, opening: float, closing: float) -> None:
    env = batch(small, CARROT, [0, 0], gripper=gripper)
    env.step_continuous(np.tile(np.array([[*STAY[:6], opening], [*STAY[:6], closing]])[:, None], (1, 4, 1)))
    fingers = env.observe_egocentric().state[:, 6:8]
    np.testing.assert_allclose(fingers, [[0.037] * 2, [0.015] * 2], atol=1e-3)
    env.close()


@pytest.mark.parametrize(("gripper", "opening", "closing"), [("native", -1.0, 1.0), ("binary", 0.0, 1.0)])
def test_google_robot_opens_and_closes(tree: Path, gripper: str, opening: float, closing: float) -> None:
    env = batch(tree, COKE, [0, 0], gripper=gripper)
    env.step_continuous(np.tile(np.array([[*STAY[:6], opening], [*STAY[:6], closing]])[:, None], (1, 6, 1)))
    fingers = env.observe_egocentric().state[:, 7:9]
    np.testing.assert_allclose(fingers[0], 0.0, atol=2e-3)
    # Closed fingers stop at each other.
    np.testing.assert_allclose(fingers[1], spec.GOOGLE_FINGER_STOP / 2, atol=5e-3)
    env.close()


@pytest.mark.parametrize(("variant", "tilt"), [(None, 0.785), ({"camera": "lower"}, 0.935)])
def test_the_head_stays_where_the_episode_has_it(small: Path, variant: dict[str, str] | None, tilt: float) -> None:
    env = make("simpler/google_robot", task=COKE, episodes=[0], assets=small, num_threads=1, variant=variant)
    env.reset()
    before = env.observe_egocentric().state[0, 9:11]
    env.step_continuous(np.tile([0.02, 0.02, -0.03, 0.1, 0.2, 0.3, 1.0], (1, 5, 1)))
    after = env.observe_egocentric().state[0]
    assert after[10] == pytest.approx(tilt, abs=1e-3)
    assert after[9:11].tolist() == before.tolist()
    assert after[20:22].tolist() == [0, 0]
    env.close()


def test_closed_empty_fingers_do_not_move_the_arm(tree: Path) -> None:
    env = batch(tree, COKE, [0])
    before = env.observe_egocentric().state[0, :7]
    env.step_continuous(np.tile([*STAY[:6], 1.0], (1, 10, 1)))
    np.testing.assert_allclose(env.observe_egocentric().state[0, :7], before, atol=1e-3)
    env.close()


CLOSING = {CARROT: np.linspace(1.0, -1.0, 21), COKE: [0.42, 0.0, 0.0, *[0.02] * 20]}


@pytest.mark.parametrize(("task", "part"), [(CARROT, "is_src_obj_grasped"), (COKE, "is_grasped")])
def test_closing_on_the_object_grasps_it(tree: Path, task: str, part: str) -> None:
    env = batch(tree, task, [0])
    tool = env.step_ee_pose([]).final_pose[0]
    forward = rotation_from_quat(tool[None, 3:7])[0][:, 0 if task == CARROT else 2]
    held = []
    while not any(held):
        # Nothing but the fingers will hold it, so it is put back until they are there.
        env.set_state(moved(env, 0, tool[:3] - 0.005 * forward))
        control = env.step_continuous([[*STAY[:6], CLOSING[task][len(held)]]])
        held.append(control.info["parts"][0][part])
    assert len(held) > 1
    env.close()


# -- poses and plans ------------------------------------------------------------


@pytest.mark.parametrize("task", [CARROT, COKE])
def test_step_ee_pose_reaches_a_pose(tree: Path, task: str) -> None:
    env = batch(tree, task, [0, 1])
    tool = env.step_ee_pose([]).final_pose
    targets = np.concatenate([tool, np.zeros((2, 1))], axis=1)
    targets[:, :3] += [[-0.03, 0.02, 0.03], [0.02, -0.03, -0.02]]
    control = env.step_ee_pose(targets)
    assert control.converged.all()
    assert (control.step_count < 20).all()
    np.testing.assert_allclose(control.final_pose[:, :3], targets[:, :3], atol=0.011)
    env.close()


def test_step_ee_pose_holds_and_refuses_bad_poses(carrot: SimplerEnv) -> None:
    tool = carrot.step_ee_pose([]).final_pose
    targets = np.concatenate([tool, np.ones((2, 1))], axis=1)
    targets[1, 0] = np.nan
    control = carrot.step_ee_pose(targets, hold_steps=3)
    assert control.step_count.tolist() == [3, 0]
    assert control.error == ("", "pose is not finite")
    np.testing.assert_allclose(carrot.observe_egocentric().state[0, 6:8], 0.015, atol=1e-3)


def test_a_slot_that_waits_for_others_stays_where_it_is(carrot: SimplerEnv) -> None:
    tool = carrot.step_ee_pose([]).final_pose
    poses = np.zeros((2, 8, 7))
    poses[..., 3] = 1.0
    poses[:, 0] = tool
    poses[1] = tool[1] + np.linspace(0, 0.1, 8)[:, None] * [0, 0, 1, 0, 0, 0, 0]
    valid = np.array([[True] + [False] * 7, [True] * 8])
    plan = {"poses": poses, "grip": np.zeros((2, 8)), "hold": np.zeros((2, 8), int), "valid": valid}
    before = carrot.step_waypoints(plan).final_pose[0]
    after = carrot.step_ee_pose(np.concatenate([tool, np.zeros((2, 1))], axis=1), hold_steps=3).final_pose[0]
    np.testing.assert_allclose(after[:3], before[:3], atol=1e-3)


def test_step_waypoints_follows_a_plan_of_unequal_lengths(carrot: SimplerEnv) -> None:
    tool = carrot.step_ee_pose([]).final_pose
    poses = np.repeat(tool[:, None], 3, axis=1)
    poses[:, 0, 2] += 0.03
    poses[:, 1, 1] += 0.03
    plan = {
        "poses": poses,
        "grip": np.zeros((2, 3)),
        "hold": np.array([[0, 0, 2], [0, 0, 0]]),
        "valid": np.array([[True, True, True], [False, True, False]]),
    }
    control = carrot.step_waypoints(plan)
    assert control.converged.tolist() == [[True, True, False], [False, True, False]]
    assert control.waypoint_ticks[0, 2] == 2
    assert (control.waypoint_ticks[1] > 0).tolist() == [False, True, False]
    assert control.step_index.tolist() == control.waypoint_ticks.sum(axis=1).tolist()
