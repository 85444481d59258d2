"""What programs see: names, parts, grasps and places, all from one frozen snapshot's geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.voxposer_world import HOME, box, handle, snapshot, space

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.manipulation.grasps import Gripper, room_around
from vecenv.manipulation.placing import Target, put_in
from vecenv.manipulation.world import Margins, SceneGeometry, matrix
from vecenv.observations import ObjectsSnapshot, Part, PartJoint, PointCloud, RegionBox
from voxposer.perception.config import HandState
from voxposer.perception.grid import VoxelGrid
from voxposer.perception.observation import PerceptionError
from voxposer.perception.parts import opening_direction
from voxposer.perception.view import Perception
from voxposer.quaternions import qmult, quaternion


def see(seen: ObjectsSnapshot, *, closed: bool = False, **options: object) -> Perception:
    return Perception(seen, HandState(seen.ee_pose, HOME, closed), **options)  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def kitchen() -> LiberoEnv:
    env = vecenv.make("libero_goal", task=0, episodes=[0])
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def look(env: LiberoEnv) -> ObjectsSnapshot:
    found = env.observe_objects().snapshot[0]
    assert found is not None
    return found


# -- names and parts ---------------------------------------------------------------------------------------------------


def test_parts_of_fixtures_can_be_named(kitchen: LiberoEnv) -> None:
    names = see(look(kitchen)).names
    for level in ("top", "middle", "bottom"):
        assert {f"wooden_cabinet_1_{level}_{what}" for what in ("drawer", "handle")} <= set(names)
    assert {"wooden_cabinet_1_top", "flat_stove_1_knob", "flat_stove_1_burner", "wine_rack_1_slot"} <= set(names)


def test_lean_geometry_has_the_parts_of_exact_geometry(kitchen: LiberoEnv) -> None:
    """Also drawers whose collision geoms lean geometry leaves out: what is seen does not depend on what collides."""
    names = []
    for geometry in ("exact", "lean"):
        env = vecenv.make("libero_spatial", task=0, episodes=[0], geometry=geometry)
        assert isinstance(env, LiberoEnv)
        env.reset()
        names.append(set(look(env).parts))
        env.close()
    assert names[0] == names[1]
    assert "wooden_cabinet_1_bottom_drawer" in names[1]


def test_a_drawer_takes_its_handle_along_when_it_opens(kitchen: LiberoEnv) -> None:
    before = look(kitchen)
    joint = kitchen.mj_model.joint("wooden_cabinet_1_top_level")
    shut = kitchen.state().qpos
    wide = shut.copy()
    wide[:, joint.qposadr[0]] += 0.1 * np.sign(joint.range.sum())
    kitchen.set_state(qpos=wide)
    after = look(kitchen)
    kitchen.set_state(qpos=shut)
    for name in ("wooden_cabinet_1_top_handle", "wooden_cabinet_1_top_drawer"):
        old, new = before.parts[name], after.parts[name]
        assert old.joint is not None
        assert new.joint is not None
        way = new.cloud.points.mean(axis=0) - old.cloud.points.mean(axis=0)
        np.testing.assert_allclose(way, 0.1 * old.joint.axis, atol=1e-6)
        assert new.joint.opened - old.joint.opened == pytest.approx(0.1)
    still = "wooden_cabinet_1_middle_handle"
    np.testing.assert_allclose(before.parts[still].cloud.points, after.parts[still].cloud.points)


def test_a_handle_is_in_front_of_its_drawer_and_smaller(kitchen: LiberoEnv) -> None:
    parts = look(kitchen).parts
    drawer, bar = parts["wooden_cabinet_1_top_drawer"], parts["wooden_cabinet_1_top_handle"]
    out = opening_direction(bar)
    assert (bar.cloud.points @ out).mean() > (drawer.cloud.points @ out).max() - 0.005
    assert np.ptp(bar.cloud.points, axis=0).max() < 0.5 * np.ptp(drawer.cloud.points, axis=0).max()


def test_parts_are_the_same_with_lean_geometry(kitchen: LiberoEnv) -> None:
    lean = vecenv.make("libero_goal", task=0, episodes=[0], geometry="lean")
    assert isinstance(lean, LiberoEnv)
    lean.reset()
    lean.set_state(kitchen.state())
    wanted, found = look(kitchen).parts, look(lean).parts
    lean.close()
    assert list(found) == list(wanted)
    for name, part in found.items():
        np.testing.assert_array_equal(part.cloud.points, wanted[name].cloud.points)
        np.testing.assert_array_equal(part.cloud.normals, wanted[name].cloud.normals)


def test_an_unknown_name_is_reported_with_similar_names(kitchen: LiberoEnv) -> None:
    with pytest.raises(PerceptionError, match="akita_black_bowl_1"):
        see(look(kitchen)).detect("akita_black_bowl_2")


@pytest.mark.parametrize("alias", ["gripper", "hand", "EE", "end effector"])
def test_the_hand_goes_by_many_names(alias: str) -> None:
    world = see(snapshot({"cube_1": box((0.02, 0.02, 0.02), (0.1, 0, 0.02))}))
    seen = world.detect(alias)
    np.testing.assert_array_equal(seen.position, world.grid.voxel(HOME[:3]))
    assert seen.name == alias


def test_the_table_is_flat_and_faces_up() -> None:
    world = see(snapshot({"cube_1": box((0.02, 0.02, 0.02), (0.1, 0, 0.02))}))
    table = world.detect("table")
    assert table.aabb[0, 2] == table.aabb[1, 2] == table.position[2] == world.grid.voxel(np.zeros(3))[2]
    np.testing.assert_allclose(table.normal, [0, 0, 1])


# -- frozen ------------------------------------------------------------------------------------------------------------


def test_snapshots_are_read_only_while_planned_on() -> None:
    seen = snapshot({"cube_1": box((0.02, 0.02, 0.02), (0.1, 0, 0.02))}, parts={"cabinet_1_handle": handle()})
    see(seen)
    for array in (seen.objects["cube_1"].points, seen.ee_pose, seen.parts["cabinet_1_handle"].cloud.normals):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_changes_to_an_observation_stay_with_the_program() -> None:
    world = see(snapshot({"cube_1": box((0.02, 0.02, 0.02), (0.1, 0, 0.02))}))
    position = world.detect("cube_1").position
    position += 7
    np.testing.assert_array_equal(world.detect("cube_1").position, position - 7)


# -- grasping ----------------------------------------------------------------------------------------------------------


def test_a_grasp_voxel_keeps_its_exact_position() -> None:
    world = see(snapshot({"cube_1": box((0.02, 0.03, 0.02), (0.1037, 0.0213, 0.02))}))
    voxel = world.detect("cube_1").grasp_position
    exact = world.position_of(voxel)
    np.testing.assert_array_equal(world.grid.voxel(exact), voxel)
    np.testing.assert_allclose(exact[:2], [0.1037, 0.0213], atol=0.012)
    assert np.abs(exact - world.grid.world(voxel)).max() > 1e-4
    neighbour = voxel + 1
    np.testing.assert_allclose(world.position_of(neighbour), world.grid.world(neighbour))


def test_a_bowl_is_held_by_its_rim(kitchen: LiberoEnv) -> None:
    seen = look(kitchen)
    world = see(seen)
    bowl = world.detect("akita_black_bowl_1")
    off_centre = world.position_of(bowl.grasp_position)[:2] - seen.poses["akita_black_bowl_1"][:2]
    assert 0.03 < np.linalg.norm(off_centre) < 0.07
    assert matrix(bowl.grasp_quat)[2, 2] < -0.99


def test_a_handle_is_pinched_across_its_bar_from_outside() -> None:
    world = see(
        snapshot({"cabinet_1": box((0.1, 0.1, 0.11), (0.2, -0.02, 0.11))}, ("cabinet_1",), parts={"h": handle()})
    )
    seen = world.detect("h")
    hand = matrix(seen.grasp_quat)
    assert hand[:, 2] @ np.array([0.0, 1.0, 0.0]) < -0.5  # the fingers lead against the way it opens
    assert abs(hand[:, 1] @ np.array([1.0, 0.0, 0.0])) < 1e-6  # and close across the bar, which lies along x
    np.testing.assert_allclose(world.position_of(seen.grasp_position), [0.2, 0.1, 0.2], atol=0.003)
    np.testing.assert_allclose(seen.axis, [0, 1, 0])
    assert matrix(seen.push_quat)[:, 1] @ np.array([0.0, 0.0, 1.0]) == pytest.approx(0, abs=1e-6)


def test_a_handle_reports_whether_it_is_open() -> None:
    cabinet = {"cabinet_1": box((0.1, 0.1, 0.11), (0.2, -0.02, 0.11))}
    shut, wide = (see(snapshot(cabinet, ("cabinet_1",), parts={"h": handle(x)})).detect("h") for x in (0.0, 0.15))
    assert not shut.is_open
    assert wide.is_open


def test_a_fixture_is_held_by_its_parts_only() -> None:
    world = see(
        snapshot({"cabinet_1": box((0.1, 0.1, 0.11), (0.2, -0.02, 0.11))}, ("cabinet_1",), parts={"h": handle()})
    )
    with pytest.raises(PerceptionError, match="grasp one of its parts: h"):
        _ = world.detect("cabinet_1").grasp_position


def test_objects_that_are_too_wide_have_no_grasp() -> None:
    world = see(snapshot({"crate_1": box((0.06, 0.06, 0.05), (0.1, 0, 0.05))}))
    with pytest.raises(PerceptionError, match="crate_1 offers nothing to hold"):
        _ = world.detect("crate_1").grasp_quat


def test_a_failed_grasp_is_not_chosen_again_first() -> None:
    seen = snapshot({"can_1": box((0.02, 0.035, 0.04), (0.1, 0, 0.04))})
    first = see(seen)
    at = first.position_of(first.detect("can_1").grasp_position)
    again = see(seen, failed={"can_1": [at - seen.poses["can_1"][:3]]})
    other = again.position_of(again.detect("can_1").grasp_position)
    assert np.linalg.norm(other - at) > 0.01


# -- holding and placing -----------------------------------------------------------------------------------------------


def holding(centre: tuple[float, float, float] = (0.0, 0.0, 0.385)) -> ObjectsSnapshot:
    """A small box between the closed fingers, a plate and a basket on the table."""
    things = {
        "cube_1": box((0.02, 0.015, 0.02), centre),
        "plate_1": box((0.07, 0.07, 0.005), (0.25, 0.1, 0.005)),
        "basket_1": box((0.08, 0.08, 0.005), (0.2, -0.25, 0.005)),
    }
    inside = space((0.2, -0.25, 0.06), (0.06, 0.06, 0.05))
    return snapshot(things, parts={"basket_1_inside": inside}, gripper=np.array([0.0155, -0.0155]))


def test_the_object_between_the_closed_fingers_is_held() -> None:
    assert see(holding(), closed=True).held == "cube_1"
    assert see(holding(), closed=False).held == ""
    assert see(replace(holding(), gripper=np.array([0.0005, -0.0005])), closed=True).held == ""
    assert see(holding((0.2, 0.2, 0.02)), closed=True).held == ""


def test_the_held_object_comes_to_rest_on_what_it_is_placed_on() -> None:
    world = see(holding(), closed=True)
    hand = world.position_of(world.detect("plate_1").place_position)
    moved = holding().objects["cube_1"].points + hand - HOME[:3]
    np.testing.assert_allclose(moved.mean(axis=0)[:2], [0.25, 0.1], atol=0.005)
    assert 0.009 < moved[:, 2].min() < 0.03


def test_placing_in_an_object_with_one_space_uses_that_space() -> None:
    world = see(holding(), closed=True)
    whole, inside = (world.detect(name).place_position for name in ("basket_1", "basket_1_inside"))
    np.testing.assert_array_equal(whole, inside)
    assert (np.abs(world.position_of(inside)[:2] - [0.2, -0.25]) < 0.06).all()


def test_with_an_empty_hand_a_place_is_above_the_object() -> None:
    world = see(snapshot({"plate_1": box((0.07, 0.07, 0.005), (0.25, 0.1, 0.005))}))
    np.testing.assert_allclose(world.position_of(world.detect("plate_1").place_position), [0.25, 0.1, 0.11], atol=0.003)


def test_a_held_object_moves_with_the_hand() -> None:
    world = see(holding(), closed=True)
    before = world.detect("held object")
    offset = before.hand_offset
    world.move_hand(HOME[:3] + [0.1, 0.2, 0.05], matrix(HOME[3:]))
    after = world.detect("held object")
    np.testing.assert_allclose(after["_position_world"] - before["_position_world"], [0.1, 0.2, 0.05], atol=1e-9)
    np.testing.assert_allclose(after.hand_offset, offset, atol=1)
    np.testing.assert_array_equal(world.detect("gripper").position, world.grid.voxel(HOME[:3] + [0.1, 0.2, 0.05]))


# -- spaces entered from a side ----------------------------------------------------------------------------------------

OVEN = np.array([0.15, 0.3, 0.13])


def oven(**parts: Part) -> ObjectsSnapshot:
    """A cube in the hand, and an oven of five walls that is open towards -y, with a space in it."""
    walls = [
        box(half, OVEN + shift, 400)
        for half, shift in [
            ((0.14, 0.11, 0.01), (0, 0, -0.1)),
            ((0.14, 0.11, 0.01), (0, 0, 0.1)),
            ((0.01, 0.11, 0.1), (-0.13, 0, 0)),
            ((0.01, 0.11, 0.1), (0.13, 0, 0)),
            ((0.14, 0.01, 0.1), (0, 0.1, 0)),
        ]
    ]
    shell = PointCloud(*(np.concatenate([getattr(wall, f) for wall in walls]) for f in ("points", "normals")))
    inside = Part("oven_1", "space", shell, RegionBox(OVEN, np.eye(3), np.array([0.12, 0.09, 0.09]), "oven_1"))
    things = {"cube_1": box((0.02, 0.015, 0.02), (0.0, 0.0, 0.385)), "oven_1": shell}
    return snapshot(things, ("oven_1",), parts={"oven_1_inside": inside, **parts}, gripper=np.array([0.0155, -0.0155]))


def test_the_way_out_of_a_roofed_space_is_its_open_side() -> None:
    np.testing.assert_allclose(see(oven()).detect("oven_1_inside").normal, [0, -1, 0])


def test_where_there_is_a_door_the_way_out_is_through_it() -> None:
    hinge = PartJoint("hinge", np.array([0.0, 0.0, 1.0]), OVEN + [0.14, 0.11, 0], 2.0, np.pi / 2)
    ajar = Part("oven_1", "door", box((0.11, 0.01, 0.09), OVEN + [0.25, 0.11, 0], 240), joint=hinge)
    np.testing.assert_allclose(see(oven(oven_1_door=ajar)).detect("oven_1_inside").normal, [1, 0, 0], atol=1e-9)


def test_a_space_with_a_roof_is_entered_with_the_fingers_ahead() -> None:
    world = see(oven(), closed=True)
    seen = world.detect("oven_1_inside")
    pos, hand = world.position_of(seen.place_position), matrix(seen.place_quat)
    assert hand[:, 2] @ np.array([0.0, 1.0, 0.0]) > 0.6
    carried = (oven().objects["cube_1"].points - HOME[:3]) @ (hand @ matrix(HOME[3:]).T).T + pos
    assert (np.abs(carried - OVEN) < [0.12, 0.09, 0.09]).all()
    shell = oven().objects["oven_1"].points
    assert all(room_around(pos + [0, -back, 0], hand, shell) > 0 for back in (0.0, 0.1))


def test_a_hand_whose_palm_is_wider_than_an_opening_stops_short() -> None:
    walls = [
        box((0.01, 0.09, 0.09), OVEN + [-0.08, 0.0, 0.0], 900),
        box((0.01, 0.09, 0.09), OVEN + [0.08, 0.0, 0.0], 900),
        box((0.09, 0.09, 0.01), OVEN + [0.0, 0.0, 0.1], 900),
        box((0.09, 0.09, 0.01), OVEN + [0.0, 0.0, -0.1], 900),
        box((0.09, 0.01, 0.09), OVEN + [0.0, 0.1, 0.0], 900),
    ]
    shell = PointCloud(*(np.concatenate([getattr(wall, f) for wall in walls]) for f in ("points", "normals")))
    seen = replace(oven(), objects={"cube_1": oven().objects["cube_1"], "oven_1": shell})
    gripper = Gripper(wrist=0.14)
    target = Target(
        OVEN[None, :2], np.zeros(1), OVEN[2] - 0.09, centre=OVEN[:2], half=np.array([0.07, 0.09]), roof=OVEN[2] + 0.09
    )
    out = np.array([0.0, -1.0, 0.0])
    pos, hand = put_in(SceneGeometry(seen, Margins(gripper=gripper)), "cube_1", target, out)
    carried = (seen.objects["cube_1"].points - HOME[:3]) @ (hand @ matrix(HOME[3:]).T).T + pos
    middle = float(carried[:, 1].mean())
    assert OVEN[1] - 0.09 < middle < OVEN[1] - 0.02  # before the middle of the space, but inside
    rooms = [room_around(pos + back * out, hand, shell.points, gripper) for back in np.arange(-0.06, 0.11, 0.02)]
    assert min(rooms[3:]) > -0.002
    assert rooms[0] < -0.01


def test_room_is_measured_around_fingers_palm_and_wrist() -> None:
    gripper = Gripper(wrist=0.14)
    for point, room in [((0.2, 0, 0), 0.14), ((0, 0.08, 0), 0.0145), ((0.05, 0, 0.2), -0.05), ((0, 0, -0.1), 0.0905)]:
        there = np.array(point, float) + HOME[:3]
        assert room_around(HOME[:3], matrix(HOME[3:]), there[None], gripper) == pytest.approx(room, abs=1e-6)
    assert room_around(HOME[:3], matrix(HOME[3:]), np.zeros((0, 3)), gripper) == np.inf


def test_a_hand_leans_to_grasp_under_an_overhang() -> None:
    plank = box((0.1, 0.1, 0.01), (0.1, 0.11, 0.17), 2000)
    world = see(snapshot({"cube_1": box((0.02, 0.02, 0.025), (0.1, 0, 0.025)), "plank_1": plank}, ("plank_1",)))
    seen = world.detect("cube_1")
    pos, hand = world.position_of(seen.grasp_position), matrix(seen.grasp_quat)
    assert -0.97 < hand[2, 2] < -0.7
    assert hand[1, 2] > 0.2  # fingers ahead under the plank, the wrist outside
    assert room_around(pos, hand, plank.points, Gripper(wrist=0.14)) > 0
    alone = see(snapshot({"cube_1": box((0.02, 0.02, 0.025), (0.1, 0, 0.025))}))
    assert matrix(alone.detect("cube_1").grasp_quat)[2, 2] < -0.99


@pytest.mark.parametrize(("x", "leans"), [(0.3, np.pi / 4), (-0.05, 0.0)])
def test_the_hand_that_pushes_a_part_shut_leans_as_far_as_the_robot_leaves_room(x: float, leans: float) -> None:
    joint = PartJoint("slide", np.array([-1.0, 0.0, 0.0]), np.array([x, 0, 0.2]), 0.16, 0.1)
    bar = Part("cabinet_1", "handle", box((0.008, 0.04, 0.008), (x, 0, 0.2), 240), joint=joint)
    cabinet = {"cabinet_1": box((0.1, 0.1, 0.11), (x + 0.2, 0, 0.11))}
    hand = matrix(see(snapshot(cabinet, ("cabinet_1",), parts={"h": bar})).detect("h").push_quat)
    assert np.arccos(-hand[2, 2]) == pytest.approx(leans, abs=1e-6)


# -- numbers -----------------------------------------------------------------------------------------------------------


@given(st.tuples(*[st.integers(0, 99)] * 3))
def test_a_voxels_middle_is_in_it(voxel: tuple[int, int, int]) -> None:
    grid = VoxelGrid(np.array([-0.7, -0.4, 0.81]), np.array([0.3, 0.5, 1.26]))
    np.testing.assert_array_equal(grid.voxel(grid.world(np.array(voxel))), voxel)


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternions_and_matrices_agree(raw: tuple[float, float, float, float]) -> None:
    quat = np.array(raw) / np.linalg.norm(raw)
    again = quaternion(matrix(quat))
    assert abs(again @ quat) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(qmult(again, [1, 0, 0, 0]), again)
