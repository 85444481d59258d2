"""SIMPLER's robots: kinematics, and set-points equal to upstream's recorded ones."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.simpler_files import GOOGLE_ROLLOUTS, WIDOWX_ROLLOUTS, rollouts, small_files

from vecenv.simpler.control.chain import Chain, Clik, KinematicsError
from vecenv.simpler.control.controllers import Controller, GoogleController, SetPoints, WidowXController
from vecenv.simpler.control.robots import GOOGLE_ROBOT, ROBOTS, WIDOWX, Robot, RobotError
from vecenv.simpler.control.rotations import (
    quat_from_rotation,
    rotation_from_quat,
    rotation_from_rotvec,
    rotation_from_rpy,
    rotvec_from_rotation,
)
from vecenv.simpler.control.urdf import read_urdf

ROLLOUTS = {WIDOWX.name: WIDOWX_ROLLOUTS, GOOGLE_ROBOT.name: GOOGLE_ROLLOUTS}
EVERYONE = np.ones(2, bool)
AXES = {"widowx": "zyyxyx", "google_robot": "zyzyzyz"}
# Bent, so that the arm can move in all directions.
POSTURE = {"widowx": [0.1, -0.3, 0.5, 0.2, 0.7, -0.1], "google_robot": [-0.3, 0.1, 0.5, 1.2, 0.1, 1.4, -1.0]}


def urdf(robot: Robot) -> str:
    """A made-up arm with a robot's joint names and directions of axes, its links 0.2 m long."""
    tip, joints, parent = robot.tool, [], robot.root
    arm = [robot.joints[i] for i in robot.arm if "head" not in robot.joints[i]]
    for i, name in enumerate(arm):
        axis = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}[AXES[robot.name][i]]
        joints.append(joint(name, "revolute", parent, f"link{i}", f'xyz="0.02 0 0.2" rpy="0 0 {0.1 * i}"', axis))
        parent = f"link{i}"
    joints.append(joint("tip", "fixed", parent, tip, 'xyz="0.1 0 0.05" rpy="0.3 -0.2 0.1"'))
    kind = "prismatic" if robot is WIDOWX else "revolute"
    joints += [joint(robot.joints[i], kind, parent, f"finger{i}", 'xyz="0 0 0.1"', "0 1 0") for i in robot.gripper]
    head = [name for name in robot.joints if "head" in name]
    joints += [joint(name, "revolute", robot.root, f"{name}_link", "", "0 0 1") for name in head]
    links = dict.fromkeys([robot.root, *re.findall('child link="(.*?)"', "".join(joints))])
    return f'<robot name="made_up">{"".join(f"<link name={name!r}/>" for name in links)}{"".join(joints)}</robot>'


def joint(name: str, kind: str, parent: str, child: str, origin: str, axis: str = "1 0 0") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin {origin}/>'
        f'<axis xyz="{axis}"/><limit lower="-3" upper="3"/></joint>'
    )


@pytest.fixture(scope="module", params=list(ROBOTS.values()), ids=list(ROBOTS))
def robot(request: pytest.FixtureRequest) -> Robot:
    return request.param


def made_up_chain(robot: Robot, folder: Path) -> Chain:
    (folder / "robot.urdf").write_text(urdf(robot))
    return robot.chain(folder / "robot.urdf")


def start(robot: Robot, count: int = 2) -> np.ndarray:
    qpos = np.zeros((count, robot.dof))
    qpos[:, : len(POSTURE[robot.name])] = POSTURE[robot.name]
    qpos[:, list(robot.gripper)] = 0.03
    return qpos


def made_up_controller(robot: Robot, folder: Path) -> Controller:
    if robot is WIDOWX:
        made: Controller = WidowXController(made_up_chain(robot, folder), 2)
    else:
        pytest.importorskip("ruckig")
        made = GoogleController(made_up_chain(robot, folder), 2)
    made.reset(EVERYONE, start(robot))
    return made


@pytest.fixture
def controller(robot: Robot, tmp_path: Path) -> Controller:
    return made_up_controller(robot, tmp_path)


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_files(tmp_path_factory.mktemp("tree"))


def act(controller: Controller, action: Sequence[float], qpos: np.ndarray, qvel: np.ndarray | None = None) -> SetPoints:
    """Both slots take one action."""
    return controller.set_action([action, action], qpos, np.zeros_like(qpos) if qvel is None else qvel)


def close_pose(found: np.ndarray, wanted: np.ndarray, tolerance: float) -> None:
    np.testing.assert_allclose(found[:, :3], wanted[:, :3], atol=tolerance)
    np.testing.assert_allclose(rotation_from_quat(found[:, 3:]), rotation_from_quat(wanted[:, 3:]), atol=tolerance)


# Kinematics


def test_a_planar_arm_is_where_trigonometry_says(tmp_path: Path) -> None:
    links = [
        joint("a", "revolute", "base", "upper", 'xyz="0 0 1"', "0 0 2"),
        joint("b", "prismatic", "upper", "lower", 'xyz="0.5 0 0"', "1 0 0"),
        joint("c", "fixed", "lower", "tool", 'xyz="0.25 0 0" rpy="0 0 1.5707963267948966"'),
    ]
    (tmp_path / "arm.urdf").write_text(f'<robot name="planar">{"".join(links)}</robot>')
    position, rotation = read_urdf(tmp_path / "arm.urdf").chain("tool", ["a", "b"]).pose([[0.3, 0.1], [-0.7, 0.0]])
    reach, angle = np.array([0.85, 0.75]), np.array([0.3, -0.7])
    np.testing.assert_allclose(position, np.stack([reach * np.cos(angle), reach * np.sin(angle), [1, 1]], axis=1))
    np.testing.assert_allclose(rotation[:, 0, 0], -np.sin(angle), atol=1e-12)


def test_the_jacobian_is_the_derivative_of_the_pose(robot: Robot, tmp_path: Path) -> None:
    chain, qpos, step = made_up_chain(robot, tmp_path), start(robot, 1), 1e-6
    moved = qpos + step * np.vstack([np.eye(robot.dof), -np.eye(robot.dof)])
    position, rotation = chain.pose(moved)
    linear = (position[: robot.dof] - position[robot.dof :]) / (2 * step)
    turned = rotvec_from_rotation(rotation[: robot.dof] @ rotation[robot.dof :].swapaxes(1, 2)) / (2 * step)
    np.testing.assert_allclose(chain.jacobian(qpos)[0].T, np.concatenate([linear, turned], axis=1), atol=1e-6)


def test_inverse_kinematics_reaches_poses(robot: Robot, tmp_path: Path) -> None:
    chain, rng = made_up_chain(robot, tmp_path), np.random.default_rng(0)
    away = start(robot, 50)
    qpos = away + rng.uniform(-0.15, 0.15, away.shape)
    wanted = chain.pose(away)
    found, solved = chain.solve(qpos, *wanted)
    assert solved.all()
    position, rotation = chain.pose(found)
    np.testing.assert_allclose(position, wanted[0], atol=1e-4)
    np.testing.assert_allclose(rotation, wanted[1], atol=1e-4)
    off_chain = np.setdiff1d(np.arange(robot.dof), chain.columns)
    np.testing.assert_array_equal(found[:, off_chain], qpos[:, off_chain])


def test_inverse_kinematics_is_sapiens(robot: Robot, tmp_path: Path) -> None:
    sapien: Any = pytest.importorskip("sapien")
    chain = made_up_chain(robot, tmp_path)
    loader = sapien.Scene([sapien.physx.PhysxCpuSystem()]).create_urdf_loader()
    loader.fix_root_link = True
    articulation = loader.load(str(tmp_path / "robot.urdf"))
    order = [robot.joints.index(part.name) for part in articulation.get_active_joints()]
    tool = [link.name for link in articulation.get_links()].index(robot.tool)
    model, used = articulation.create_pinocchio_model(), np.isin(order, robot.arm)
    qpos = start(robot, 20) + np.random.default_rng(0).uniform(-0.1, 0.1, (20, robot.dof))
    position, rotation = chain.pose(start(robot, 20))
    found, solved = chain.solve(qpos, position, rotation)
    for i in range(20):
        pose = sapien.Pose(position[i], quat_from_rotation(rotation[i]))
        theirs, success, _ = model.compute_inverse_kinematics(tool, pose, qpos[i, order], used, max_iterations=100)
        assert (solved[i], success) == (True, True)
        np.testing.assert_allclose(found[i, order][used], theirs[used], atol=1e-5)


def test_a_tighter_tolerance_gets_nearer(robot: Robot, tmp_path: Path) -> None:
    chain = made_up_chain(robot, tmp_path)
    wanted, qpos = chain.pose(start(robot)), start(robot) + 0.05
    errors = [
        np.abs(chain.pose(chain.solve(qpos, *wanted, Clik(tolerance=t, max_iterations=400))[0])[0] - wanted[0]).max()
        for t in (1e-3, 1e-9)
    ]
    assert errors[1] < 1e-8 < errors[0]


def test_what_cannot_be_reached_leaves_the_joints_alone(robot: Robot, tmp_path: Path) -> None:
    chain, qpos = made_up_chain(robot, tmp_path), start(robot)
    position, rotation = chain.pose(qpos)
    position[1] += [0, 0, 9]
    found, solved = chain.solve(qpos, position, rotation)
    assert solved.tolist() == [True, False]
    np.testing.assert_array_equal(found, qpos)


def test_an_arm_that_is_not_finite_disturbs_no_other(robot: Robot, tmp_path: Path) -> None:
    chain = made_up_chain(robot, tmp_path)
    wanted, qpos = chain.pose(start(robot)), start(robot) + 0.02
    alone, _ = chain.solve(qpos, *wanted)
    qpos[0] = np.nan
    found, solved = chain.solve(qpos, *wanted)
    assert solved.tolist() == [False, True]
    np.testing.assert_array_equal(found[1], alone[1])


def test_rotations_convert_back_and_forth() -> None:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(100, 3))
    vectors *= rng.uniform(0, np.pi, (100, 1)) / np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors[:4] = 0, 0, 0
    vectors[1] = np.pi, 0, 0
    vectors[2] = 1e-9, 0, 0
    rotations = rotation_from_rotvec(vectors)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (100, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(rotation_from_quat(quat_from_rotation(rotations)), rotations, atol=1e-12)
    np.testing.assert_allclose(rotvec_from_rotation(rotations), vectors, atol=1e-9)


def test_rpy_turns_about_fixed_axes_in_order() -> None:
    roll, pitch, yaw = 0.3, -0.4, 1.1
    parts = [rotation_from_rotvec(np.eye(3)[i] * angle) for i, angle in enumerate((roll, pitch, yaw))]
    np.testing.assert_allclose(rotation_from_rpy(np.array([roll, pitch, yaw])), parts[2] @ parts[1] @ parts[0])


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("<robot", "not XML"),
        ("<mujoco/>", "<mujoco>, not <robot>"),
        ('<robot><joint name="a" type="ball"/></robot>', "'a' is 'ball'"),
        ('<robot><joint name="a" type="fixed"/></robot>', "'a' names no parent"),
        ("<robot>" + joint("a", "fixed", "b", "c", 'xyz="1 2"') + "</robot>", "xyz has 2 numbers"),
        ("<robot>" + joint("a", "revolute", "b", "c", "", "0 0 0") + "</robot>", "axis without direction"),
        ("<robot>" + joint("a", "fixed", "b", "c", 'xyz="0 x 0"') + "</robot>", "could not convert"),
    ],
)
def test_a_damaged_urdf_file_is_named(text: str, problem: str, tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(text)
    with pytest.raises(KinematicsError, match=rf"robot\.urdf.*{problem}"):
        read_urdf(tmp_path / "robot.urdf")


def test_a_chain_needs_its_link_and_its_joints(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(urdf(WIDOWX))
    robot = read_urdf(tmp_path / "robot.urdf")
    with pytest.raises(KinematicsError, match="no link 'hand'"):
        robot.chain("hand", WIDOWX.joints)
    with pytest.raises(KinematicsError, match="'waist'"):
        robot.chain(WIDOWX.tool, WIDOWX.joints[1:])
    with pytest.raises(KinematicsError, match="no joint moves link 'base_link'"):
        robot.chain("base_link", WIDOWX.joints)


def test_joints_in_a_circle_are_noticed(tmp_path: Path) -> None:
    circle = joint("a", "fixed", "x", "y", "") + joint("b", "fixed", "y", "x", "")
    (tmp_path / "robot.urdf").write_text(f'<robot name="ring">{circle}</robot>')
    with pytest.raises(KinematicsError, match="circle"):
        read_urdf(tmp_path / "robot.urdf").path("x")


# Both controllers


def test_no_action_leaves_the_robot_where_it_is(controller: Controller) -> None:
    qpos = start(controller.robot)
    points = act(controller, [0] * 7, qpos)
    arm = list(controller.robot.arm)
    assert points.solved.all()
    assert points.position.shape == (2, controller.robot.substeps, controller.robot.dof)
    np.testing.assert_allclose(
        points.position[:, :, arm], np.broadcast_to(qpos[:, None, arm], (2, controller.robot.substeps, len(arm)))
    )


def test_an_action_moves_the_tool_by_it(controller: Controller) -> None:
    qpos, step = start(controller.robot), [0.003, -0.002, 0.004, 0.01, -0.02, 0.015, 0]
    before = controller.tool(qpos)
    after = controller.tool(act(controller, step, qpos).position[:, -1])
    turned = rotation_from_rotvec(step[3:6]) @ rotation_from_quat(before[:, 3:])
    np.testing.assert_allclose(after[:, :3], before[:, :3] + step[:3], atol=2e-4)
    np.testing.assert_allclose(rotation_from_quat(after[:, 3:]), turned, atol=2e-4)


def test_towards_a_pose_makes_it_the_target(controller: Controller) -> None:
    qpos = start(controller.robot)
    act(controller, [0.01, 0, -0.01, 0.02, 0, 0.01, 0], qpos)  # WidowX now has a target apart from where it is
    goal = controller.tool(qpos + 0.02)
    for _ in range(10):
        action = np.concatenate([controller.towards(goal, qpos), np.zeros((2, 1))], axis=1)
        qpos = controller.set_action(action, qpos, np.zeros_like(qpos)).position[:, -1]
    close_pose(controller.tool(qpos), goal, 3e-4)


def test_what_cannot_be_reached_keeps_the_arm_where_it_is(controller: Controller) -> None:
    qpos, arm = start(controller.robot), list(controller.robot.arm)
    points = controller.set_action([[5, 0, 0, 0, 0, 0, 0], [0] * 7], qpos, np.zeros_like(qpos))
    assert points.solved.tolist() == [False, True]
    np.testing.assert_allclose(points.position[0, -1, arm], qpos[0, arm])


def test_a_slot_that_is_not_active_holds_and_remembers_nothing_new(controller: Controller) -> None:
    qpos, step = start(controller.robot), [0.01, 0, 0, 0, 0, 0, 0.5]
    before = act(controller, step, qpos).position[:, -1]
    remembered = controller.memory()
    other = [0, 0.01, 0, 0, 0, 0, -0.5]
    points = controller.set_action([other, other], qpos, np.zeros_like(qpos), active=np.array([False, True]))
    assert (points.position[0] == before[0]).all()
    assert not points.velocity[0].any()
    assert np.abs(points.position[1, -1] - before[1]).max() > 1e-4
    for name, values in controller.memory().items():
        np.testing.assert_array_equal(values[0], remembered[name][0])


def test_restored_memory_repeats_what_came_after(controller: Controller) -> None:
    qpos, step = start(controller.robot), [0.01, 0, 0.005, 0, 0.02, 0, 0.4]
    act(controller, step, qpos)
    remembered = controller.memory()
    first = act(controller, step, qpos)
    assert any((controller.memory()[name] != values).any() for name, values in remembered.items())
    controller.restore(remembered)
    again = act(controller, step, qpos)
    np.testing.assert_array_equal(first.position, again.position)


def test_a_reset_slot_begins_anew_and_the_other_does_not(controller: Controller) -> None:
    qpos, step = start(controller.robot), [0.01, 0, 0.005, 0, 0.02, 0, 0.4]
    fresh = act(controller, step, qpos).position
    controller.reset(np.array([True, False]), qpos)
    points = act(controller, step, qpos).position
    np.testing.assert_array_equal(points[0], fresh[0])
    assert np.abs(points[1] - fresh[1]).max() > 1e-4


def test_a_broken_slot_disturbs_no_other(controller: Controller, robot: Robot, tmp_path: Path) -> None:
    qpos, step = start(robot), [0.01, 0, 0.005, 0, 0.02, 0, 0.4]
    other = made_up_controller(robot, tmp_path)
    healthy = act(other, step, qpos).position
    broken = qpos.copy()
    broken[0] = np.nan
    np.testing.assert_array_equal(act(controller, step, broken).position[1], healthy[1])


def test_shapes_are_checked(controller: Controller) -> None:
    dof, qpos = controller.robot.dof, start(controller.robot)
    with pytest.raises(RobotError, match=r"action must have shape \[2, 7\], got \[2, 8\]"):
        controller.set_action(np.zeros((2, 8)), qpos, qpos)
    with pytest.raises(RobotError, match=rf"qpos must have shape \[2, {dof}\]"):
        controller.set_action(np.zeros((2, 7)), qpos[:1], qpos)
    with pytest.raises(RobotError, match="mask must be bool"):
        controller.reset(np.ones(2), qpos)
    with pytest.raises(RobotError, match="memory has"):
        controller.restore({})


def test_a_controller_wants_its_own_robots_kinematics(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="8 joints; google_robot has 11"):
        GoogleController(made_up_chain(WIDOWX, tmp_path), 1)


# WidowX


def test_widowx_gripper_opens_at_plus_one_and_closes_at_minus_one(tmp_path: Path) -> None:
    controller, qpos = made_up_controller(WIDOWX, tmp_path), start(WIDOWX)
    for value, width in ((1, 0.038), (-1, 0.014), (0, 0.026), (7, 0.038)):
        fingers = act(controller, [0] * 6 + [value], qpos).position[:, :, list(WIDOWX.gripper)]
        np.testing.assert_allclose(fingers, width)


def test_widowx_adds_actions_up_however_far_the_robot_lags(tmp_path: Path) -> None:
    controller, qpos = made_up_controller(WIDOWX, tmp_path), start(WIDOWX)
    before = controller.tool(qpos)[:, :3]
    for _ in range(5):
        end = act(controller, [0.004, 0, -0.002, 0, 0, 0, 0], qpos).position[:, -1]  # the robot does not move at all
    np.testing.assert_allclose(controller.tool(end)[:, :3], before + 5 * np.array([0.004, 0, -0.002]), atol=1e-4)


def test_widowx_turns_its_target_about_the_measured_tool(tmp_path: Path) -> None:
    controller, qpos = made_up_controller(WIDOWX, tmp_path), start(WIDOWX)
    here = controller.tool(qpos)[:, :3]
    act(controller, [0.02, 0, 0, 0, 0, 0, 0], qpos)
    end = act(controller, [0, 0, 0, 0, 0, 0.2, 0], qpos).position[:, -1]
    np.testing.assert_allclose(
        controller.tool(end)[:, :3] - here, [[0.02 * np.cos(0.2), 0.02 * np.sin(0.2), 0]] * 2, atol=1e-4
    )


# Google Robot


def test_google_paths_join_smoothly(tmp_path: Path) -> None:
    controller, qpos = made_up_controller(GOOGLE_ROBOT, tmp_path), start(GOOGLE_ROBOT)
    arm, dt = list(GOOGLE_ROBOT.arm), 1 / GOOGLE_ROBOT.sim_hz
    steps = [act(controller, [0.03, 0.01, -0.03, 0.1, 0.1, -0.1, 0], qpos).position[0][:, arm] for _ in range(4)]
    path = np.concatenate(steps)
    speed = np.diff(path, axis=0) / dt
    assert np.abs(speed).max() > 0.2
    assert np.abs(speed).max() <= 1.5 + 1e-6
    # Acceleration starts anew from 0 with each path, and is bounded within.
    assert np.abs(np.diff(speed, axis=0) / dt).max() <= 2.0 + 1e-4


def test_google_begins_where_it_is_measured_after_a_reset(tmp_path: Path) -> None:
    controller, qpos = made_up_controller(GOOGLE_ROBOT, tmp_path), start(GOOGLE_ROBOT)
    arm, qvel = list(GOOGLE_ROBOT.arm), np.full_like(qpos, 0.2)
    act(controller, [0] * 7, qpos)
    controller.reset(EVERYONE, qpos)
    first = act(controller, [0] * 7, qpos + 0.01, qvel).position[:, 0]
    np.testing.assert_allclose(first[:, arm], (qpos + 0.01 + qvel / GOOGLE_ROBOT.sim_hz)[:, arm], atol=2e-5)


def test_google_covers_at_most_a_tenth_of_a_radian_from_rest(tmp_path: Path) -> None:
    controller, qpos = made_up_controller(GOOGLE_ROBOT, tmp_path), start(GOOGLE_ROBOT)
    moved = act(controller, [0.1, 0.0, -0.1, 0.0, 0.0, 0.3, 0], qpos).position[:, -1] - qpos
    assert 0.09 < np.abs(moved[:, list(GOOGLE_ROBOT.arm)]).max() <= 0.0984


def test_google_gripper_closes_at_plus_one_relative_to_its_set_point(tmp_path: Path) -> None:
    controller, qpos = made_up_controller(GOOGLE_ROBOT, tmp_path), start(GOOGLE_ROBOT)
    fingers = list(GOOGLE_ROBOT.gripper)
    widths = []
    for value in (0.3, 0.3, -0.3):
        points = act(controller, [0] * 6 + [value], qpos)
        qpos[:, fingers] = points.position[:, -1, fingers]
        widths.append(qpos[0, fingers[0]])
    assert 0.03 < widths[0] < widths[1]
    assert widths[2] < widths[1]


def test_google_gripper_keeps_its_target_without_an_action(tmp_path: Path) -> None:
    controller, qpos = made_up_controller(GOOGLE_ROBOT, tmp_path), start(GOOGLE_ROBOT)
    fingers, qvel = list(GOOGLE_ROBOT.gripper), np.zeros((2, GOOGLE_ROBOT.dof))
    for value in (1, *[0] * 6):
        points = act(controller, [0] * 6 + [value], qpos, qvel)
        qpos[:, fingers], qvel[:, fingers] = points.position[:, -1, fingers], points.velocity[:, -1, fingers]
    np.testing.assert_allclose(qpos[:, fingers], 1.31)  # beyond the joint's range: it presses


def test_google_gripper_is_given_its_velocity_and_the_arm_none(tmp_path: Path) -> None:
    controller, qpos = made_up_controller(GOOGLE_ROBOT, tmp_path), start(GOOGLE_ROBOT)
    points = act(controller, [0.03, 0, 0, 0, 0, 0.3, 1], qpos)
    fingers, dt = list(GOOGLE_ROBOT.gripper), 1 / GOOGLE_ROBOT.sim_hz
    measured = np.diff(points.position[:, :, fingers], axis=1) / dt
    np.testing.assert_allclose(measured, points.velocity[:, 1:, fingers], atol=0.02)
    assert not points.velocity[:, :, list(GOOGLE_ROBOT.arm)].any()


# Constants


def test_urdf_versions_are_files_beside_the_plain_one() -> None:
    path = GOOGLE_ROBOT.urdf_path("recolor_cabinet_visual_matching_1")
    assert path.parent == GOOGLE_ROBOT.urdf_path().parent
    assert path.name.endswith("fix_fingertip_recolor_cabinet_visual_matching_1.urdf")
    with pytest.raises(RobotError, match="no URDF version 'red'"):
        GOOGLE_ROBOT.urdf_path("red")


def test_descriptions_fit_the_urdf_files(tree: Path, robot: Robot) -> None:
    for version in robot.versions:
        description = read_urdf(tree / robot.urdf_path(version))
        assert description.moving == robot.joints
        links = {part.child for part in description.joints.values()} | {robot.root}
        assert set(robot.materials) | {link for finger in robot.fingers for link in finger.links} <= links
        assert {link for pair in robot.never_touch for link in pair} <= links
        low, high = description.limits([robot.joints[i] for i in robot.gripper]).T
        assert robot.gripper_range[0] < low.min()
        assert high.max() < robot.gripper_range[1]


# Against recorded rollouts


def test_the_tool_is_where_upstream_recorded_it(tree: Path, robot: Robot) -> None:
    chain, name = robot.chain(tree / robot.urdf), ROLLOUTS[robot.name]
    qpos, tool, base = (rollouts(name, key) for key in ("qpos", "tcp", "base_pose"))
    for i in range(len(base)):
        position, rotation = chain.pose(qpos[i])
        turn = rotation_from_quat(base[i, 3:])
        np.testing.assert_allclose(position @ turn.T + base[i, :3], tool[i, :, :3], atol=1e-6)
        np.testing.assert_allclose(turn @ rotation, rotation_from_quat(tool[i, :, 3:]), atol=2e-6)


def test_inverse_kinematics_finds_what_upstreams_found(tree: Path, robot: Robot) -> None:
    chain, name, arm = robot.chain(tree / robot.urdf), ROLLOUTS[robot.name], list(robot.arm)
    before = np.concatenate([rollouts(name, "qpos0")[:, None], rollouts(name, "qpos")[:, :-1]], axis=1)
    targets, recorded = rollouts(name, "arm_target_pose"), rollouts(name, "arm_target_qpos")
    for i in range(len(before)):
        found, solved = chain.solve(before[i], targets[i, :, :3], rotation_from_quat(targets[i, :, 3:]))
        assert solved.all()
        np.testing.assert_allclose(found[:, arm], recorded[i], atol=1e-4)


def test_every_substeps_set_point_is_upstreams(tree: Path, robot: Robot) -> None:
    name = ROLLOUTS[robot.name]
    actions, recorded = rollouts(name, "actions"), rollouts(name, "sub_drive_target")
    qpos, qvel = rollouts(name, "qpos0"), rollouts(name, "qvel0")
    kinematics = robot.chain(tree / robot.urdf)
    kind = WidowXController if robot is WIDOWX else GoogleController
    controller = kind(kinematics, len(qpos))
    controller.reset(np.ones(len(qpos), bool), qpos)
    for step in range(actions.shape[1]):
        points = controller.set_action(actions[:, step], qpos, qvel)
        assert points.solved.all()
        np.testing.assert_allclose(points.position, recorded[:, step], atol=1e-4)
        qpos, qvel = rollouts(name, "qpos")[:, step], rollouts(name, "qvel")[:, step]
