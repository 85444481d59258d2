"""The scripted policy for SIMPLER: what an arm can follow, how things are held, and that tasks are solved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sapien")
pytest.importorskip("ruckig")

from vecenv_eval.policies import make_policy
from vecenv_eval.policies.simpler import drawers
from vecenv_eval.policies.simpler.grasps import choose
from vecenv_eval.policies.simpler.reach import HANDS, Arm

from vecenv import make
from vecenv.contract import Control
from vecenv.observations import Part, PartJoint, PointCloud
from vecenv.simpler.control.controllers import controller
from vecenv.simpler.control.robots import GOOGLE_ROBOT, WIDOWX
from vecenv.simpler.control.rotations import rotation_from_rotvec
from vecenv.simpler.control.servo import Servo, ServoConfig
from vecenv.simpler.tasks import TASKS

QPOS = np.array([-0.01840777, 0.0398835, 0.22242722, -0.00460194, 1.36524296, 0.00153398, 0.037, 0.037])
BASE = np.array([0.147, 0.028, 0.87, 0, 0, 0, 1.0])


@pytest.fixture(scope="module")
def arm(small: Path) -> Arm:
    return Arm(WIDOWX, small)


def box_cloud(half: tuple[float, float, float], centre: tuple[float, float, float]) -> PointCloud:
    """A grid on every face of a box."""
    ticks = np.linspace(-1, 1, 9)
    u, v = (grid.ravel() for grid in np.meshgrid(ticks, ticks))
    faces, normals = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            faces.append(np.insert(np.stack([u, v], axis=1), axis, side, axis=1) * half + centre)
            normals.append(np.tile(np.eye(3)[axis] * side, (len(u), 1)))
    return PointCloud(np.concatenate(faces), np.concatenate(normals))


def solved(root: Path, task: str, episodes: int) -> np.ndarray:
    """Which episodes of a task the policy solves."""
    env = make(TASKS[task].suite, task=task, episodes=range(episodes), assets=root, num_threads=1)
    policy, info = make_policy("simpler_scripted"), env.reset()
    policy.reset(env, info)
    done = np.zeros(episodes, bool)
    while not done.all():
        control = policy.act(env)
        assert isinstance(control, Control)
        done = control.done
    success = env.evaluate().success
    env.close()
    return success


@pytest.mark.parametrize("robot", [WIDOWX, GOOGLE_ROBOT], ids=lambda robot: robot.name)
def test_a_hands_axes_are_where_it_points_and_where_it_opens_to(robot) -> None:
    hand = HANDS[robot.name]
    turn = hand.rotation(np.array([[0.0, 0.6, -0.8]]), np.array([[1.0, 0.0, 0.0]]))[0]
    assert np.linalg.det(turn) == pytest.approx(1.0)
    assert turn[:, hand.approach] == pytest.approx([0, 0.6, -0.8])
    assert turn[:, hand.opening] == pytest.approx([1, 0, 0])


def test_a_rehearsal_arrives_and_has_less_room_the_further_it_reaches(arm: Arm) -> None:
    here, turn = arm.tool(QPOS, BASE)
    stops = here + np.array([[[0, 0, 0.0], [0, 0, -0.05]], [[0, 0, 0.0], [-0.6, 0, 0.4]]])
    room, joints = arm.rehearse(QPOS, BASE, stops, np.tile(turn, (2, 2, 1, 1)))
    reached, _ = arm.tool(joints[0, 1], BASE)
    assert reached == pytest.approx(stops[0, 1], abs=2e-3)
    assert room[0] > 0.1 > 0 > room[1]


def test_turning_a_wrist_beyond_its_limit_leaves_no_room(arm: Arm) -> None:
    here, turn = arm.tool(QPOS, BASE)
    axis = turn[:, arm.hand.approach]
    turns = [[rotation_from_rotvec(axis * angle * k) @ turn for k in (1, 2, 3)] for angle in (0.3, 1.3)]
    room, _ = arm.rehearse(QPOS, BASE, np.tile(here, (2, 3, 1)), np.array(turns))
    assert room[0] > 0 > room[1] > -2


def test_following_a_way_tells_how_far_the_arm_gets(arm: Arm) -> None:
    here, turn = arm.tool(QPOS, BASE)
    steps = np.array([[[0, 0, 0.0], [0, 0.05, 0.05]], [[0, 0, 0.0], [-0.9, 0, 0.4]]])
    room, reached = arm.follow(QPOS, BASE, here + steps, np.tile(turn, (2, 2, 1, 1)))
    assert reached.tolist() == [2, 1]
    assert room[0] > 0.1


def test_drives_lag_in_a_rehearsal_as_they_do_in_physics(small: Path) -> None:
    env = make("simpler/google_robot", task="google_robot_pick_coke_can", episodes=[0], assets=small)
    env.reset()
    arm = Arm(GOOGLE_ROBOT, small)
    begin = qpos = env.observe_egocentric().state[:, :11].astype(float)
    planned = controller(arm._coarse, small / GOOGLE_ROBOT.urdf_path(), 1)
    planned.reset(np.ones(1, bool), qpos)
    action = np.array([[0.0, 0.03, -0.04, 0.0, 0.1, 0.2, 0.0]])
    for _ in range(5):
        qpos = arm._dragged(qpos, planned.set_action(action, qpos, np.zeros_like(qpos)).position)
        env.step_continuous(action)
    real = env.observe_egocentric().state[0, :7]
    assert np.abs(real - begin[0, :7]).max() > 0.1
    np.testing.assert_allclose(qpos[0, :7], real, atol=0.01)
    env.close()


def test_a_box_is_held_across_its_narrow_side(arm: Arm) -> None:
    cloud = box_cloud((0.015, 0.06, 0.015), (-0.16, 0.0, 0.885))

    def course(position, rotation, approach):
        return np.stack([position - 0.08 * approach, position], 1), np.repeat(rotation[:, None], 2, axis=1)

    grasp = choose(arm, QPOS, BASE, cloud, 0.87, course)
    assert grasp is not None
    assert grasp.room > 0
    assert abs(grasp.rotation[0, arm.hand.opening]) > 0.95
    assert grasp.position[:2] == pytest.approx([-0.16, 0.0], abs=0.01)
    assert grasp.position[2] + arm.hand.tip * grasp.approach[2] > 0.87


def test_what_is_wider_than_the_hand_offers_no_grasp(arm: Arm) -> None:
    cloud = box_cloud((0.06, 0.06, 0.06), (-0.16, 0.0, 0.93))
    assert choose(arm, QPOS, BASE, cloud, 0.87, lambda p, r, a: (p[:, None], r[:, None])) is None


def test_a_drawer_is_open_where_it_is_out_and_contains_what_lies_in_it() -> None:
    cloud = box_cloud((0.3, 0.3, 0.07), (0.0, 0.0, 0.7))
    front = box_cloud((0.007, 0.3, 0.07), (0.3, 0.0, 0.72))
    joined = PointCloud(*(np.concatenate([getattr(c, n) for c in (cloud, front)]) for n in ("points", "normals")))
    axis = np.array([1.0, 0.0, 0.0])
    joint = PartJoint(kind="slide", axis=axis, anchor=np.zeros(3), travel=0.5, opened=0.2)
    middle = drawers.opening(Part(parent="cabinet", kind="drawer", cloud=joined, joint=joint))
    assert middle == pytest.approx([0.293 - 0.1, 0.0, 0.79])


def test_a_tool_that_comes_no_nearer_is_stuck_and_one_that_does_is_not(small: Path) -> None:
    servo = Servo(controller(WIDOWX, small / WIDOWX.urdf_path(), 2), ServoConfig.of(WIDOWX))
    targets, tool = np.tile([0.3, 0, 0, 1, 0, 0, 0, 0.0], (2, 1)), np.tile([0.0, 0, 0, 1, 0, 0, 0], (2, 1))
    driving = np.ones(2, bool)
    for _ in range(servo.config.stuck_after):
        assert not servo.stuck(targets, tool, driving).any()
        tool[1, 0] += 0.01
    assert servo.stuck(targets, tool, driving).tolist() == [True, False]
    targets[0, 0] = 0.2
    assert not servo.stuck(targets, tool, driving).any()


def test_it_works_on_simplers_environments_only() -> None:
    class Other:
        num_envs = 1

    class Info:
        suite = "libero_spatial"

    with pytest.raises(TypeError, match="libero_spatial"):
        make_policy("simpler_scripted").reset(Other(), Info())  # type: ignore[arg-type]


@pytest.mark.parametrize("task", ["widowx_stack_cube", "google_robot_close_top_drawer"])
def test_it_solves_tasks_of_generated_assets(small: Path, task: str) -> None:
    assert solved(small, task, 1).all()


def test_an_episode_that_cannot_be_solved_ends_with_its_budget(small: Path) -> None:
    env = make("simpler/bridge", task="widowx_stack_cube", episodes=[0], assets=small, max_steps=5)
    policy, info = make_policy("simpler_scripted"), env.reset()
    policy.reset(env, info)
    control = policy.act(env)
    assert isinstance(control, Control)
    assert control.truncated.all()
    assert control.step_index.tolist() == [5]
    env.close()


@pytest.mark.heavy
@pytest.mark.parametrize(
    "task",
    [
        "widowx_spoon_on_towel",
        "widowx_carrot_on_plate",
        "widowx_stack_cube",
        "widowx_put_eggplant_in_basket",
        "google_robot_pick_coke_can",
        "google_robot_move_near",
        "google_robot_open_drawer",
        "google_robot_close_drawer",
        "google_robot_place_apple_in_closed_top_drawer",
    ],
)
def test_it_solves_most_episodes_of_every_family(original: Path, task: str) -> None:
    assert solved(original, task, 5).mean() >= 0.8
