"""Two things for one container: the first goes into a corner, the second where it has room or tips over into it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.voxposer_world import HOME, box, snapshot

from vecenv.manipulation.grasps import Gripper
from vecenv.manipulation.placing import Target, put_down, put_in_corner
from vecenv.manipulation.world import Margins, SceneGeometry, matrix
from vecenv.observations import ObjectsSnapshot, Part, RegionBox
from voxposer.offline.map_writer import write_affordance, write_rotation
from voxposer.offline.planner_writer import write_planner
from voxposer.perception.config import HandState
from voxposer.perception.view import Perception

BASE = np.array([-0.6, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
CENTRE, HALF = np.array([0.0, 0.2]), np.array([0.06, 0.06])
DOWN = matrix(HOME[3:])


def carrying(half: tuple[float, float, float], **others: object) -> ObjectsSnapshot:
    """A block in the hand at 0, 0, between closed pads."""
    held = box(half, (0.0, 0.0, 0.3))
    seen = snapshot({"held_1": held, **others}, panda_base=BASE)  # pyright: ignore[reportArgumentType]
    pose, width = np.array([0.0, 0.0, 0.3, *HOME[3:]]), half[1]
    return replace(seen, ee_pose=pose, gripper=np.array([width, -width]))


def scene(seen: ObjectsSnapshot) -> SceneGeometry:
    return SceneGeometry(seen, Margins(gripper=Gripper(wrist=0.14)), BASE[:2])


def inside() -> Target:
    return Target(CENTRE[None], np.zeros(1), floor=0.0, centre=CENTRE, half=HALF)


def test_a_corner_is_as_far_from_the_middle_as_the_object_fits() -> None:
    world = scene(carrying((0.03, 0.02, 0.05)))
    middle, rotation = put_down(world, "held_1", inside())
    np.testing.assert_allclose(middle[:2], CENTRE, atol=1e-3)
    at = put_in_corner(world, "held_1", inside(), middle, rotation)
    np.testing.assert_allclose(np.abs(at[:2] - CENTRE), HALF - [0.03, 0.02], atol=0.006)
    assert (np.abs(at[:2] - CENTRE) + [0.03, 0.02] <= HALF).all()
    assert (at[:2] > CENTRE).all()  # the corner farthest from the robot
    assert at[2] == pytest.approx(middle[2], abs=1e-6)


def test_what_is_too_wide_for_a_corner_stays_in_the_middle() -> None:
    world = scene(carrying((0.03, 0.02, 0.05)))
    narrow = replace(inside(), half=np.array([0.02, 0.06]))
    middle = np.array([0.0, 0.2, 0.1])
    assert put_in_corner(world, "held_1", narrow, middle, DOWN) is middle
    on_top = Target(CENTRE[None], np.zeros(1), floor=0.0)
    assert put_in_corner(world, "held_1", on_top, middle, DOWN) is middle


def test_the_second_object_stands_beside_one_in_a_corner() -> None:
    first = box((0.03, 0.03, 0.03), (0.03, 0.23, 0.03))
    world = scene(carrying((0.025, 0.02, 0.05), first_1=first))
    pos, _ = put_down(world, "held_1", inside())
    free = np.abs(pos[:2] - [0.03, 0.23]) - [0.055, 0.05]
    assert free.max() > -0.002  # apart along an axis
    assert pos[2] - 0.05 < 0.02  # on the floor


def test_an_object_without_room_on_the_floor_goes_where_it_tips_over() -> None:
    """Most of the floor is taken: in the middle it would stand on the other, at the side it falls in."""
    first = box((0.045, 0.045, 0.05), (0.014, 0.214, 0.05), 2000)
    world = scene(carrying((0.03, 0.02, 0.01), first_1=first))
    pos, _ = put_down(world, "held_1", inside())
    over = np.abs(pos[:2] - [0.014, 0.214]) - 0.045
    assert over.max() > 0.0  # its middle is not above the other


def drawer(wide: float, shut: float) -> Target:
    """The space of a drawer 24 cm long that is shut at a height; without its walls."""
    return Target(CENTRE[None], np.zeros(1), floor=0.0, centre=CENTRE, half=np.array([0.12, wide]), roof=shut)


def test_what_is_too_tall_for_a_drawer_leans_so_that_it_tips_over_and_lies_in_it() -> None:
    world = scene(carrying((0.02, 0.02, 0.08)))
    pos, rotation = put_down(world, "held_1", drawer(wide=0.05, shut=0.06))
    turn = rotation @ DOWN.T
    standing = (world.points("held_1") - world.hand) @ turn.T + pos
    way = turn @ np.array([0.0, 0.0, 1.0])  # of its top
    assert np.arccos(way[2]) > np.arctan2(0.02, 0.08) + 0.2
    assert abs(way[1]) < 1e-6  # along the drawer, and not across the fingers, which close along y
    base = standing[standing[:, 2] < standing[:, 2].min() + 0.03].mean(axis=0)
    lying = base[:2] + way[:2] / np.linalg.norm(way[:2]) * 0.08
    np.testing.assert_allclose(lying, CENTRE, atol=0.04)
    assert standing[:, 2].min() < 0.09


def test_what_may_stand_or_does_not_tip_over_or_cannot_lie_is_put_down_upright() -> None:
    slim, wide = carrying((0.02, 0.02, 0.08)), carrying((0.04, 0.03, 0.06))
    for seen, space in (
        (slim, drawer(wide=0.05, shut=np.inf)),
        (slim, drawer(wide=0.01, shut=0.06)),
        (wide, drawer(wide=0.05, shut=0.06)),
    ):
        _, rotation = put_down(scene(seen), "held_1", space)
        assert rotation[2, 2] < -0.99


def test_the_corner_is_a_field_of_a_container() -> None:
    basket = box((0.07, 0.07, 0.004), (0.0, 0.2, 0.004))
    region = RegionBox(np.array([0.0, 0.2, 0.05]), np.eye(3), np.array([0.06, 0.06, 0.05]), "basket_1")
    parts = {"basket_1_inside": Part("basket_1", "space", basket, region)}
    seen = replace(carrying((0.03, 0.02, 0.05), basket_1=basket), parts=parts)
    view = Perception(seen, HandState(seen.ee_pose, HOME, closed=True))
    assert view.held == "held_1"
    seen_basket = view.detect("basket_1")
    corner = view.position_of(seen_basket.corner_position)
    place = view.position_of(seen_basket.place_position)
    assert np.abs(corner[:2] - place[:2]).min() > 0.02
    table = view.detect("table")
    assert (table.corner_position == table.place_position).all()


def on_a_stove(at: float) -> Perception:
    """A view with a block in the hand, a stove 20 cm wide, and another block on it at a y of ``at``."""
    first, burner = box((0.03, 0.03, 0.03), (0.0, at, 0.05)), box((0.1, 0.1, 0.01), (0.0, 0.2, 0.01), 1200)
    region = RegionBox(np.array([0.0, 0.2, 0.01]), np.eye(3), np.array([0.1, 0.1, 0.01]), "stove_1")
    seen = carrying((0.025, 0.02, 0.05), first_1=first, stove_1=burner)
    seen = replace(seen, parts={"stove_1_burner": Part("stove_1", "top", burner, region)})
    return Perception(seen, HandState(seen.ee_pose, HOME, closed=True))


def test_each_half_of_a_top_is_a_place_of_its_own() -> None:
    """What stands on the left half is no reason to let go higher over the right half, as it is over the middle."""
    view = on_a_stove(at=0.15)
    burner = view.detect("stove_1_burner")
    left, right = (view.position_of(burner[f"{side}_position"]) for side in ("left", "right"))
    assert right[2] - 0.05 == pytest.approx(0.02, abs=0.01)  # its underside is on the burner
    assert 0.22 <= right[1] <= 0.28
    assert left[1] < 0.2 < right[1]
    assert left[2] > right[2] + 0.04
    np.testing.assert_allclose(matrix(burner.right_quat), DOWN, atol=1e-6)


def test_halves_of_a_place_are_beside_each_other_with_an_empty_hand() -> None:
    seen = replace(on_a_stove(at=0.15).snapshot, gripper=np.array([0.04, -0.04]))
    burner = Perception(seen, HandState(seen.ee_pose, HOME)).detect("stove_1_burner")
    assert burner.left_position[1] < burner.place_position[1] < burner.right_position[1]
    assert burner.left_position[2] == burner.right_position[2] == burner.place_position[2]


@pytest.mark.parametrize("side", ["left", "right"])
def test_map_programs_know_the_halves(side: str) -> None:
    half = f"the {side} side of the flat_stove_1_burner"
    assert f"burner.{side}_position" in write_affordance(f"the place position of {half}")
    assert f"burner.{side}_quat" in write_rotation(f"the placing orientation of {half}")


def test_the_first_of_two_things_is_put_into_the_corner() -> None:
    names = ["soup_1", "sauce_1", "basket_1", "basket_1_inside"]
    program = write_planner("put both the soup and the sauce in the basket", names)
    placed = [line for line in program.splitlines() if "place it" in line]
    assert ["corner of" in line for line in placed] == [True, False]
    single = write_planner("put the soup in the basket", names)
    assert "corner" not in single


def test_map_programs_know_the_corner() -> None:
    asked = "a point 10cm above the place position of the corner of the basket_1"
    assert "basket.corner_position" in write_affordance(asked)
    assert "basket.place_position" in write_affordance(asked.replace("the corner of ", ""))
    assert "basket.place_quat" in write_rotation("the placing orientation of the corner of the basket_1")
