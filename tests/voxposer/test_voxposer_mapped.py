"""Configuration-space maps: room around hand and load, costs to go, and the planner's path followed as it is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation
from support.voxposer_world import HOME, box, snapshot

from vecenv.manipulation import rooms
from vecenv.manipulation.grasps import Gripper
from vecenv.manipulation.rooms import Lattice
from vecenv.manipulation.routes import RouteConfig, Stop
from vecenv.manipulation.world import HOME_ROTATION, matrix
from vecenv.observations import ObjectsSnapshot, PointCloud
from voxposer.interface import Interface
from voxposer.mapped import MappedPath, OutOfReach, plan_mapped
from voxposer.paths import plan_paths
from voxposer.perception.config import HandState, PerceptionConfig
from voxposer.perception.view import Perception
from voxposer.planning.config import PlannerConfig
from voxposer.planning.cost_to_go import cost_to_go, flood
from voxposer.requests import InterfaceError, MotionRequest
from voxposer.stops import stops_of, travel

DOWN = HOME[3:]
MAP = RouteConfig(mode="map")
# A wall across the way from -0.25 to 0.25, lower than the workspace.
WALL = {"wall_1": box((0.02, 0.3, 0.10), (0.0, 0.0, 0.10), 1500)}


def look(seen: ObjectsSnapshot, at: tuple[float, float, float], *, closed: bool = False) -> Perception:
    pose = np.array([*at, *DOWN])
    gripper = np.array([0.02, -0.02]) if closed else seen.gripper
    return Perception(replace(seen, ee_pose=pose, gripper=gripper), HandState(pose, HOME, closed))


def plan(view: Perception, to: tuple[float, float, float], **options: object) -> MappedPath:
    given = {"closed": view.closed, "avoidance": None, "planner": PlannerConfig(), "route": MAP, **options}
    return plan_mapped(view, Stop(np.array(to), DOWN, view.closed), **given)  # pyright: ignore[reportArgumentType]


def way(view: Perception, found: MappedPath) -> np.ndarray:
    return view.grid.world(found.path)


def room(points: np.ndarray, solids: list[rooms.Solid], at: np.ndarray, rotation: np.ndarray) -> float:
    found = []
    for solid in solids:
        local = (points - at - rotation @ solid.centre) @ (rotation @ solid.axes)
        found.append(float((np.abs(local) - solid.half).max(axis=1).min()))
    return min(found)


# -- room --------------------------------------------------------------------------------------------------------------


def test_room_maps_hold_the_distance_from_the_nearest_obstacle() -> None:
    rng = np.random.default_rng(1)
    lattice = Lattice(np.array([-0.1, -0.1, 0.0]), np.array([0.02, 0.018, 0.01]), (11, 12, 20))
    fingers = rooms.hand_solids(Gripper())[:2]
    for rotation in (HOME_ROTATION, Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()):
        points = rng.uniform(-0.15, 0.15, (60, 3))
        found = rooms.room_map(lattice, fingers, rotation, points, 0.03)
        for node in rng.integers(0, lattice.shape, (200, 3)):
            at = lattice.origin + node * lattice.step
            expected = min(room(points, fingers, at, rotation), 0.03)
            assert found[tuple(node)] == pytest.approx(expected, abs=1e-6)


def test_slices_of_a_load_enclose_it_and_are_smaller_than_its_box() -> None:
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), np.zeros(200)], axis=1) + [0.1, 0.2, 0.3]
    hand, rotation = np.array([0.1, 0.2, 0.35]), Rotation.from_euler("x", np.pi + 0.3).as_matrix()
    slices = rooms.load_solids(ring, Rotation.from_euler("z", 0.4).as_matrix(), hand, rotation)
    inside = [~rooms.outside(ring, [solid], hand, rotation, 1e-6) for solid in slices]
    assert np.any(inside, axis=0).all()
    assert sum(4 * solid.half[0] * solid.half[1] for solid in slices) < 0.97 * 0.1**2


def test_sparse_surfaces_are_filled_between_their_samples_but_not_across_openings() -> None:
    ticks = np.arange(-0.15, 0.151, 0.03)
    x, y = (grid.ravel() for grid in np.meshgrid(ticks, ticks))
    frame = (np.abs(x) > 0.10) | (np.abs(y) > 0.10)
    points = np.stack([x, y, np.zeros(len(x))], axis=1)[frame]
    filled = rooms.dense_surface(PointCloud(points, np.tile([0.0, 0.0, 1.0], (len(points), 1))))
    assert len(filled) > 2 * len(points)
    assert not (np.abs(filled[:, :2]).max(axis=1) < 0.08).any()
    assert np.abs(filled).max() <= 0.15 + 1e-9


# -- cost to go --------------------------------------------------------------------------------------------------------


def exact_costs(price: np.ndarray, step: np.ndarray, goal: tuple[int, int, int]) -> np.ndarray:
    nodes = np.stack(np.meshgrid(*map(np.arange, price.shape), indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(price.size).reshape(price.shape)
    rows, columns, costs = [], [], []
    for offset in np.ndindex(3, 3, 3):
        move = np.array(offset) - 1
        there = nodes + move
        inside = ((there >= 0) & (there < price.shape)).all(axis=1)
        if not move.any():
            continue
        a, b = nodes[inside], there[inside]
        rows.append(number[tuple(a.T)])
        columns.append(number[tuple(b.T)])
        costs.append(np.linalg.norm(move * step) * (price[tuple(a.T)] + price[tuple(b.T)]) / 2)
    graph = coo_matrix((np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))))
    return dijkstra(graph.tocsr(), indices=number[goal]).reshape(price.shape)


def test_costs_to_go_are_those_of_the_cheapest_ways() -> None:
    rng = np.random.default_rng(3)
    price = rng.choice([1.0, 3.0, 40.0], (9, 8, 7)).astype(np.float32)
    step, goal, start = np.array([0.01, 0.009, 0.005]), (7, 1, 2), (0, 6, 5)
    expected = exact_costs(price.astype(float), step, goal)
    found = cost_to_go(price, step, goal, start)
    settled = np.isfinite(found)
    np.testing.assert_allclose(found[settled], expected[settled], rtol=1e-5)
    assert settled[start]
    everywhere, cheapest = flood(price, step, goal, np.zeros(price.shape, bool))
    np.testing.assert_allclose(everywhere, expected, rtol=1e-5)
    assert cheapest == np.inf


def test_a_flood_ends_at_the_cheapest_end() -> None:
    price = np.ones((5, 5, 5), np.float32)
    ends = np.zeros((5, 5, 5), bool)
    ends[0, 0, 3] = ends[4, 0, 0] = True
    costs, cheapest = flood(price, np.ones(3), (0, 0, 0), ends)
    assert cheapest == pytest.approx(3)
    assert not np.isfinite(costs[4, 4, 4])


# -- paths -------------------------------------------------------------------------------------------------------------


def test_the_planners_path_keeps_the_hand_out_of_a_wall_that_a_straight_line_meets() -> None:
    view = look(snapshot(WALL, fixed=("wall_1",)), (-0.2, 0.0, 0.12))
    found = plan(view, (0.2, 0.0, 0.12))
    wall, hand = view.snapshot.objects["wall_1"].points, rooms.hand_solids(view.config.margins.gripper)
    straight = np.linspace(way(view, found)[0], way(view, found)[-1], 30)
    assert min(room(wall, hand, at, HOME_ROTATION) for at in straight) < -0.01
    assert min(room(wall, hand, at, HOME_ROTATION) for at in way(view, found)) > 0.005
    np.testing.assert_allclose(way(view, found)[[0, -1]], [[-0.2, 0, 0.12], [0.2, 0, 0.12]], atol=1e-6)


def test_a_hand_that_carries_something_passes_higher_by_what_hangs_below_it() -> None:
    load = {"can_1": box((0.02, 0.02, 0.04), (-0.2, 0.0, 0.10))}
    heights = []
    for closed in (False, True):
        view = look(snapshot({**WALL, **load}, fixed=("wall_1",)), (-0.2, 0.0, 0.12), closed=closed)
        assert view.held == ("can_1" if closed else "")
        path = way(view, plan(view, (0.2, 0.0, 0.12)))
        heights.append(float(path[np.abs(path[:, 0]) < 0.02, 2].min()))
    assert heights[1] > heights[0] + 0.03


def test_a_grasp_is_approached_from_above_with_the_fingers_on_both_sides() -> None:
    view = look(snapshot({"can_1": box((0.025, 0.025, 0.05), (0.2, 0.1, 0.05))}), (-0.1, -0.1, 0.25))
    path = way(view, plan(view, (0.2, 0.1, 0.08)))
    low = path[path[:, 2] < 0.11]
    assert len(low) > 3
    np.testing.assert_allclose(low[:, :2], [[0.2, 0.1]] * len(low), atol=0.006)


def test_what_the_program_avoids_is_left_aside() -> None:
    view = look(snapshot({}), (-0.2, 0.0, 0.2))
    avoidance = np.zeros((100, 100, 100), np.float32)
    avoidance[45:56, 40:61] = 1
    path = plan(view, (0.2, 0.0, 0.2), avoidance=avoidance).path
    between = path[(path[:, 0] > 46) & (path[:, 0] < 54)]
    assert len(between) > 2
    assert (np.abs(between[:, 1] - 49.5) > 9).all()


def test_a_point_inside_something_gives_way_and_a_grasp_does_not() -> None:
    view = look(snapshot({"block_1": box((0.05, 0.05, 0.05), (0.2, 0.0, 0.05), 2000)}), (-0.2, 0.0, 0.2))
    np.testing.assert_allclose(way(view, plan(view, (0.2, 0.0, 0.06), exact=True))[-1], [0.2, 0, 0.06], atol=1e-6)
    assert way(view, plan(view, (0.2, 0.0, 0.06), exact=False))[-1, 2] > 0.10


def test_the_hand_turns_where_it_has_room() -> None:
    """Between two walls, 7 cm from each, only a hand whose palm lies along them fits: it rises before it turns."""
    walls = {f"wall_{i}": box((0.3, 0.01, 0.08), (0.0, y, 0.08), 1500) for i, y in enumerate((-0.07, 0.07))}
    along = Rotation.from_euler("z", np.pi / 2).as_matrix() @ HOME_ROTATION
    pose = np.array([0.0, 0.0, 0.05, *_wxyz(along)])
    view = Perception(replace(snapshot(walls), ee_pose=pose), HandState(pose, HOME, False))
    found = plan(view, (0.0, 0.0, 0.3))
    assert found.turn > 0
    assert way(view, found)[found.turn, 2] > 0.10


def _wxyz(rotation: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


# -- reach -------------------------------------------------------------------------------------------------------------

BASE = np.array([-0.6, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def test_a_goal_out_of_the_arms_reach_is_refused() -> None:
    view = look(snapshot({}, panda_base=BASE), (-0.1, 0.0, 0.25))
    with pytest.raises(OutOfReach, match=r"the hand at 0\.45, 0\.45, 0\.10"):
        plan(view, (0.45, 0.45, 0.10))
    assert len(plan(view, (0.0, 0.1, 0.10)).path) > 3


# -- from requests to stops --------------------------------------------------------------------------------------------


def ask(view: Perception, to: tuple[float, float, float]) -> tuple[Interface, MotionRequest]:
    interface = Interface()
    interface.begin(view)
    targets = np.zeros((100, 100, 100))
    targets[tuple(view.grid.voxel(np.array(to)))] = 1
    interface.execute(interface.detect("gripper"), targets)
    view.move_hand(view.snapshot.ee_pose[:3], matrix(view.snapshot.ee_pose[3:]))
    return interface, interface.requests[0]


def followed(mode: RouteConfig, planner: PlannerConfig, view: Perception) -> tuple[np.ndarray, np.ndarray]:
    """The planned path and the stops that follow it, in metres."""
    interface, request = ask(view, (0.2, 0.0, 0.12))
    (path,) = plan_paths([(interface, request)], planner, mode)
    assert not isinstance(path, InterfaceError)
    stops = stops_of(request, path, view, mode, closed=False)
    return view.grid.world(path), np.array([stop.pos for stop in stops])


@pytest.mark.parametrize("mode", ["planned", "map"])
def test_a_path_is_followed_as_it_was_planned(mode: str) -> None:
    view = look(snapshot(WALL, fixed=("wall_1",)), (-0.2, 0.0, 0.12))
    path, stops = followed(RouteConfig(mode=mode), PlannerConfig(), view)  # pyright: ignore[reportArgumentType]
    whole = np.concatenate([path[:1], stops])
    for at in path:
        way, rest = np.diff(whole, axis=0), at - whole[:-1]
        share = np.clip((way * rest).sum(1) / np.maximum((way**2).sum(1), 1e-12), 0, 1)
        assert np.linalg.norm(rest - share[:, None] * way, axis=1).min() < 0.0031 + 0.007 * (at is path[-1])


def test_a_rerouted_hand_passes_over_the_wall_whatever_the_planner_found() -> None:
    view = look(snapshot(WALL, fixed=("wall_1",)), (-0.2, 0.0, 0.12))
    _, stops = followed(RouteConfig(mode="raised"), PlannerConfig(method="straight"), view)
    assert stops[:, 2].max() > 0.22


def test_straight_lines_go_to_the_nearest_target() -> None:
    view = look(snapshot(WALL, fixed=("wall_1",)), (-0.2, 0.0, 0.12))
    path, stops = followed(RouteConfig(mode="planned"), PlannerConfig(method="straight"), view)
    assert np.ptp(path[:, 1:], axis=0).max() < 0.011
    assert len(stops) <= 2  # the hand is not at the middle of a voxel


def test_a_hand_without_a_program_takes_the_maps_way_too() -> None:
    view = look(snapshot(WALL, fixed=("wall_1",)), (-0.2, 0.0, 0.12))
    stops = travel([Stop(view.ee.pos, DOWN, False), Stop(np.array([0.2, 0, 0.12]), DOWN, False)], view, MAP)
    hand, wall = rooms.hand_solids(view.config.margins.gripper), view.snapshot.objects["wall_1"].points
    assert min(room(wall, hand, stop.pos, HOME_ROTATION) for stop in stops) > 0.005


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: cast(Any, RouteConfig)(mode="bent"), "mode must be one of raised, planned, map, got 'bent'"),
        (lambda: cast(Any, PerceptionConfig)(fields="none"), "fields must be 'geometry' or 'centroid', got 'none'"),
    ],
)
def test_options_that_do_not_exist_are_refused(make: object, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make()  # pyright: ignore[reportCallIssue, reportGeneralTypeIssues]


def test_without_geometry_a_grasp_is_the_centroid_and_a_place_the_top() -> None:
    cans = {"can_1": box((0.02, 0.02, 0.04), (0.2, 0.1, 0.04)), "can_2": box((0.02, 0.02, 0.04), (-0.2, 0.0, 0.10))}
    pose = np.array([-0.2, 0.0, 0.12, *DOWN])
    seen = replace(snapshot(cans), ee_pose=pose, gripper=np.array([0.02, -0.02]))
    view = Perception(seen, HandState(pose, HOME, True), PerceptionConfig(fields="centroid"))
    observed = view.detect("can_1")
    middle = view.position_of(observed["grasp_position"])
    np.testing.assert_allclose(middle, seen.objects["can_1"].points.mean(axis=0))
    np.testing.assert_allclose(matrix(observed["grasp_quat"])[:, 2], [0, 0, -1], atol=1e-9)
    # The held can's underside, 6 cm below the hand, comes to the top of the other one.
    np.testing.assert_allclose(view.position_of(observed["place_position"]), [0.2, 0.1, 0.14], atol=0.002)
