"""Dishes are held by their rims, and what an arm cannot reach gives way: grasps, places and goals of motions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.voxposer_world import HOME, box, snapshot
from vecenv_eval.config import EvalConfig
from vecenv_eval.runner import evaluate

from vecenv.manipulation.grasps import Gripper, find_grasps
from vecenv.manipulation.placing import Target, choose_grasp, put_down
from vecenv.manipulation.reach import PandaArm
from vecenv.manipulation.rims import RimConfig, find_rim_grasps
from vecenv.manipulation.routes import RouteConfig, Stop
from vecenv.manipulation.world import HOME_ROTATION, Margins, SceneGeometry, leaning
from vecenv.observations import ObjectsSnapshot, PointCloud
from voxposer.mapped import OutOfReach, plan_mapped
from voxposer.perception.config import HandState
from voxposer.perception.view import Perception
from voxposer.planning.config import PlannerConfig
from voxposer.quaternions import quaternion

BASE = np.array([-0.6, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
PINCHERS = Gripper(wrist=0.14)


def dish(centre: tuple[float, float] = (0.0, 0.0), rise: float = 0.014, corners: int = 0) -> PointCloud:
    """A plate of 13 cm, 5 mm thick: flat to half its radius, then rising; with corners, its outline is a polygon."""
    angle, share = (grid.ravel() for grid in np.meshgrid(np.arange(96) * np.pi / 48, np.linspace(0.0, 1.0, 14)))
    outline = np.full_like(angle, 0.066)
    if corners:
        outline = 0.066 / np.cos((angle + np.pi / corners) % (2 * np.pi / corners) - np.pi / corners)
    radius, slope = share * outline, rise / 0.033
    height = np.maximum(share - 0.5, 0.0) * 2 * rise
    sloping = (share > 0.5) * slope
    inward = np.stack([-np.cos(angle), -np.sin(angle)], axis=1)
    up = np.concatenate([inward * sloping[:, None], np.ones((len(angle), 1))], axis=1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    under = np.stack([radius * np.cos(angle) + centre[0], radius * np.sin(angle) + centre[1], height], axis=1)
    return PointCloud(np.concatenate([under, under + [0.0, 0.0, 0.005]]), np.concatenate([-up, up]))


def geometry(seen: ObjectsSnapshot) -> SceneGeometry:
    return SceneGeometry(seen, Margins(gripper=PINCHERS), BASE[:2])


# -- rims --------------------------------------------------------------------------------------------------------------


def test_a_dish_has_no_faces_to_hold_but_a_rim_all_around() -> None:
    plate = dish()
    assert not len(find_grasps(plate.points, plate.normals, PINCHERS))
    config = RimConfig()
    grasps = find_rim_grasps(plate.points, PINCHERS, config)
    assert len(grasps) == config.headings * len(config.tilts)
    closing, ahead = grasps.rotation[:, :, 1], grasps.rotation[:, :, 2]
    outward = grasps.pos * [1.0, 1.0, 0.0] / np.linalg.norm(grasps.pos[:, :2], axis=1)[:, None]
    # The fingers lead inwards, and they close in the plane of their lean.
    np.testing.assert_allclose(np.einsum("ij,ij->i", ahead, outward), -np.sin(grasps.tilt), atol=1e-6)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", closing, outward)), np.cos(grasps.tilt), atol=1e-6)


def test_the_outer_finger_comes_down_beside_the_rim_to_just_above_what_the_dish_lies_on() -> None:
    plate, config = dish(), RimConfig()
    grasps = find_rim_grasps(plate.points, PINCHERS, config)
    for pos, rotation in zip(grasps.pos, grasps.rotation, strict=True):
        outer = min((rotation[:, 1], -rotation[:, 1]), key=lambda y: -float(y @ pos))
        tip = pos + PINCHERS.tip * rotation[:, 2] + (PINCHERS.half_opening + config.fingertip) * outer
        assert tip[2] == pytest.approx(config.floor, abs=1e-6)
        inside = pos + PINCHERS.tip * rotation[:, 2] + PINCHERS.half_opening * outer
        assert np.linalg.norm(inside[:2]) > 0.0665


def test_what_is_flat_or_steep_has_no_rim() -> None:
    assert not len(find_rim_grasps(dish(rise=0.0).points, PINCHERS))
    assert not len(find_rim_grasps(dish(rise=0.06).points, PINCHERS))  # a bowl: the rim is over the pads


def test_a_rim_is_held_where_the_outline_stands_out_and_neighbours_leave_room() -> None:
    plate = dish((0.05, 0.0), corners=4)
    alone = choose_grasp(geometry(snapshot({"plate_1": plate}, panda_base=BASE)), "plate_1")
    assert alone is not None
    angle = np.degrees(np.arctan2(*(alone.pos[:2] - [0.05, 0.0])[::-1]))
    assert abs((angle + 45) % 90 - 45 - np.sign(((angle + 45) % 90) - 45) * 45) < 10  # at a corner
    tall = box((0.02, 0.02, 0.06), (*(np.array([0.05, 0.0]) + 1.1 * (alone.pos[:2] - [0.05, 0.0])), 0.06))
    crowded = geometry(snapshot({"plate_1": plate, "can_1": tall}, panda_base=BASE))
    beside = choose_grasp(crowded, "plate_1")
    assert beside is not None
    assert np.linalg.norm(beside.pos - alone.pos) > 0.05


def test_a_rim_that_did_not_hold_is_left_for_another() -> None:
    plate = dish((0.05, 0.0))
    world = geometry(snapshot({"plate_1": plate}, panda_base=BASE))
    first = choose_grasp(world, "plate_1")
    assert first is not None
    again = choose_grasp(world, "plate_1", [first.pos - world.snapshot.poses["plate_1"][:3]])
    assert again is not None
    assert np.linalg.norm(again.pos - first.pos) > world.config.retry_radius


# -- reach -------------------------------------------------------------------------------------------------------------


def test_a_grasp_that_the_arm_can_take_comes_before_a_better_one_that_it_cannot() -> None:
    """A long bar whose middle is covered towards the robot, and beyond out of reach."""
    bar = box((0.15, 0.015, 0.02), (0.20, 0.0, 0.02), 500)
    lid = box((0.06, 0.05, 0.02), (0.19, 0.0, 0.09), 800)
    seen = snapshot({"bar_1": bar, "lid_1": lid}, fixed=("lid_1",))
    free = choose_grasp(SceneGeometry(seen, Margins(gripper=PINCHERS)), "bar_1")
    assert free is not None
    arm = PandaArm(BASE)
    assert not arm.reaches(free.pos[None], free.rotation[None])[0]
    bound = choose_grasp(geometry(replace(seen, panda_base=BASE)), "bar_1")
    assert bound is not None
    assert arm.reaches(bound.pos[None], bound.rotation[None])[0]


def test_a_hand_leans_to_put_down_what_an_upright_one_would_not_reach() -> None:
    can = box((0.02, 0.02, 0.06), (0.0, 0.0, 0.06))
    held = replace(
        snapshot({"can_1": can}, panda_base=BASE),
        ee_pose=np.array([0.0, 0.0, 0.10, *HOME[3:]]),
        gripper=np.array([0.02, -0.02]),
    )
    for far, leans in ((0.05, False), (0.24, True)):
        target = Target(np.array([[far, 0.0]]), np.zeros(1), floor=0.0)
        pos, rotation = put_down(geometry(held), "can_1", target)
        assert PandaArm(BASE).reaches(pos[None], rotation[None])[0]
        assert bool(rotation[2, 2] > -0.99) is leans
        below = (can.points - held.ee_pose[:3]) @ (rotation @ np.diag([1.0, -1.0, -1.0])).T + pos
        assert 0.0 < below[:, 2].min() < 0.01
    assert rotation[0, 2] > 0.1  # away from the robot


def test_a_hand_that_leans_keeps_reach_to_spare() -> None:
    """Stretched out, the elbow of a Panda swings past straight, and its controller does not fold it again."""
    can = box((0.02, 0.02, 0.06), (0.0, 0.0, 0.06))
    held = replace(
        snapshot({"can_1": can}, panda_base=BASE),
        ee_pose=np.array([0.0, 0.0, 0.10, *HOME[3:]]),
        gripper=np.array([0.02, -0.02]),
    )
    target, farther = Target(np.array([[0.24, 0.0]]), np.zeros(1), floor=0.0), np.array([[0.04, 0.0, 0.0]])
    careless = SceneGeometry(held, Margins(gripper=PINCHERS, spare_reach=0.0), BASE[:2])
    for world, spared in ((geometry(held), True), (careless, False)):
        pos, rotation = put_down(world, "can_1", target)
        assert PandaArm(BASE).reaches(pos[None], rotation[None])[0]
        assert PandaArm(BASE).reaches(pos + farther, rotation[None])[0] == spared


def look(seen: ObjectsSnapshot, at: tuple[float, float, float], *, closed: bool = False) -> Perception:
    pose = np.array([*at, *HOME[3:]])
    gripper = np.array([0.02, -0.02]) if closed else seen.gripper
    return Perception(replace(seen, ee_pose=pose, gripper=gripper), HandState(pose, HOME, closed))


def goal_of(view: Perception, to: tuple[float, float, float], *, exact: bool, closed: bool) -> np.ndarray:
    stop = Stop(np.array(to), HOME[3:], closed)
    options = {"avoidance": None, "planner": PlannerConfig(), "route": RouteConfig()}
    found = plan_mapped(view, stop, closed=closed, exact=exact, **options)  # pyright: ignore[reportArgumentType]
    return view.grid.world(found.path)[-1]


def test_a_goal_in_the_air_gives_way_to_the_arms_reach_and_a_grasp_does_not() -> None:
    view, far = look(snapshot({}, panda_base=BASE), (-0.1, 0.0, 0.25)), (0.28, 0.0, 0.2)
    with pytest.raises(OutOfReach):
        goal_of(view, far, exact=True, closed=False)
    end = goal_of(view, far, exact=False, closed=False)
    assert 0.0 < np.linalg.norm(end - far) < RouteConfig().nearer + 1e-6
    assert PandaArm(BASE).reaches(end[None], np.diag([1.0, -1.0, -1.0])[None])[0]


def test_a_place_out_of_reach_gives_way_on_its_level() -> None:
    can = {"can_1": box((0.02, 0.02, 0.04), (0.0, 0.0, 0.10))}
    view = look(snapshot(can, panda_base=BASE), (0.0, 0.0, 0.12), closed=True)
    assert view.held == "can_1"
    row = np.array([[x, 0.0, 0.12] for x in np.arange(0.0, 0.3, 0.005)])
    reach = float(row[PandaArm(BASE).reaches(row, np.tile(np.diag([1.0, -1.0, -1.0]), (len(row), 1, 1))), 0].max())
    end = goal_of(view, (reach + 0.04, 0.0, 0.12), exact=True, closed=True)
    assert end[2] == pytest.approx(0.12, abs=1e-6)
    assert 0.005 < reach + 0.04 - end[0] < RouteConfig().aside + 1e-6
    with pytest.raises(OutOfReach):
        goal_of(view, (reach + 0.12, 0.0, 0.12), exact=True, closed=True)


def test_a_hand_turns_where_the_arm_can_take_its_rotation() -> None:
    """From upright near the robot to leaning at the end of the reach, and back."""
    far, near, arm = (0.22, 0.0, 0.2), (-0.1, 0.0, 0.25), PandaArm(BASE)
    lean = leaning(0.5) @ HOME_ROTATION
    assert arm.reaches(np.array([far]), lean[None])[0]
    assert not arm.reaches(np.array([far]), HOME_ROTATION[None])[0]
    options = {"avoidance": None, "planner": PlannerConfig(), "route": RouteConfig()}
    for start, first, end, last in ((near, HOME_ROTATION, far, lean), (far, lean, near, HOME_ROTATION)):
        seen = snapshot({}, panda_base=BASE, ee_pose=np.array([*start, *quaternion(first)]))
        view = Perception(seen, HandState(seen.ee_pose, HOME, closed=False))
        goal = Stop(np.array(end), quaternion(last), False)
        found = plan_mapped(view, goal, closed=False, **options)  # pyright: ignore[reportArgumentType]
        way = view.grid.world(found.path)
        turned = np.where((np.arange(len(way)) < found.turn)[:, None, None], first, last)
        assert arm.reaches(way, turned).all()


# -- in LIBERO-PRO -----------------------------------------------------------------------------------------------------


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("suite", "task"),
    [
        ("libero_goal_task", 1),  # a plate, by its rim
        ("libero_10_swap", 0),  # over a can next to the robot's base
        ("libero_10_swap", 8),  # two pots on the halves of a burner at the end of the reach
        ("libero_spatial_task", 0),  # "not between"
        ("libero_10_object", 7),  # a larger can and a box in one basket
        ("libero_10_task", 3),  # a bottle that has to lie in a drawer
        ("libero_10_task", 7),  # a bottle and a box in one basket
        ("libero_10_task", 9),  # a mug into a microwave whose opening is narrower than the palm
    ],
)
def test_tasks_that_need_these_rules_are_solved(suite: str, task: int, tmp_path: Path) -> None:
    config = EvalConfig(suite=suite, policy="voxposer", tasks=str(task), episodes="0-0")
    (record,) = evaluate(config, tmp_path / "run").records
    assert record.success, record.extras
