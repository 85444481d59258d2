"""Perception from depth images: points, normals, what is completed, remembered and named, and what is never read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.depth_scenes import block, can, floor, view
from support.images import needs_gl
from vecenv_eval.policies import make_policy

import vecenv
from vecenv.errors import InvalidInput
from vecenv.manipulation.grasps import find_grasps
from vecenv.manipulation.world import matrix
from vecenv.observations import Egocentric, ImagesUnavailable, Objects, PointCloud
from voxposer.agent import Agent, AgentConfig, PlannedMotion
from voxposer.language.llm import Llm, LlmConfig
from voxposer.perception import geometry, points
from voxposer.perception.cameras import DepthView
from voxposer.perception.config import CameraConfig, PerceptionConfig
from voxposer.perception.seen import LabelledView, NotSeen, Proprioception, SceneMemory, table_height
from voxposer.perception.seen_parts import parts_of
from voxposer.perception.segments import with_color
from voxposer.perception.sight import CameraSight
from voxposer.simpler_scene import hands

EYE = (0.9, 0.0, 0.65)
CAMERA = PerceptionConfig(source="camera")
OPEN = Proprioception(np.array([-0.2, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0]), np.array([0.04, -0.04]), closed=False)


def cloud(seen: DepthView, label: int) -> PointCloud:
    rows = seen.valid & (seen.labels == label)
    return PointCloud(seen.points[rows], seen.normals[rows])


def memory() -> SceneMemory:
    return SceneMemory(CAMERA, np.array([-0.6, 0.0]))


def labelled(seen: DepthView, *names: str | None) -> list[LabelledView]:
    return [LabelledView(seen, seen.labels, names)]


# -- one image ---------------------------------------------------------------------------------------------------------


def test_normals_are_those_of_the_surface_up_to_its_edges() -> None:
    low, high = (-0.05, -0.05, 0.0), (0.05, 0.05, 0.1)
    seen = view(EYE, (0, 0, 0), [floor(), block(low, high)])
    # Pixels between the box and its shadow have no neighbour on the floor.
    assert (cloud(seen, 0).normals[:, 2] > 0.999).mean() > 0.999
    box = cloud(seen, 1)
    faces = {1: np.array([1, 0, 0]), 2: np.array([0, 0, 1])}
    face = np.where(np.abs(box.points[:, 2] - high[2]) < 1e-6, 2, 1)
    expected = np.stack([faces[i] for i in face])
    # At the edge between the two faces a pixel's neighbours are on either.
    assert ((box.normals * expected).sum(axis=1) > 0.99).mean() > 0.9


def test_a_point_is_seen_through_hidden_shown_or_out_of_view() -> None:
    seen = view(EYE, (0, 0, 0), [floor(), block((-0.05, -0.05, 0.0), (0.05, 0.05, 0.1))])
    before, on, behind, beside = [0.2, 0.0, 0.1], [0.0, 0.0, 0.1], [-0.06, 0.0, 0.02], [0.0, 5.0, 0.0]
    rows = np.array([before, on, behind, beside])
    assert seen.sees_through(rows, 0.008).tolist() == [True, False, False, False]
    assert seen.shows(rows, 0.008).tolist() == [True, True, False, False]


# -- fusing and completing ---------------------------------------------------------------------------------------------


def test_thinning_keeps_the_two_faces_of_a_thin_wall_apart() -> None:
    rng = np.random.default_rng(0)
    flat = rng.uniform(0, 0.05, (500, 3)) * [1, 0, 1]
    wall = PointCloud(
        np.concatenate([flat, flat + [0, 0.002, 0]]), np.repeat([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]], 500, axis=0)
    )
    thin = points.thinned(wall, 0.004)
    assert np.allclose(np.abs(thin.normals[:, 1]), 1)
    assert len(points.thinned(wall, 0.004, most=50).points) <= 50


def test_outliers_are_small_clusters_apart_from_the_largest() -> None:
    rng = np.random.default_rng(0)
    body, stray = rng.uniform(0, 0.05, (300, 3)), rng.uniform(0, 0.005, (4, 3)) + 0.3
    both = PointCloud(np.concatenate([body, stray]), np.tile([0.0, 0.0, 1.0], (304, 1)))
    assert len(points.without_outliers(both, 0.02, 0.1).points) == 300


@pytest.mark.parametrize("where", [(0.0, 0.0), (-0.1, 0.2), (0.15, -0.25)])
def test_the_unseen_side_of_a_can_is_completed_and_can_be_grasped(where: tuple[float, float]) -> None:
    seen = view(EYE, (0, 0, 0), [floor(), can(*where, 0.03, 0.0, 0.08)], side=256)
    near = cloud(seen, 1)
    whole = points.completed(near, 0.0, [seen], 0.008)
    out = np.linalg.norm(whole.points[:, :2] - where, axis=1)
    side = (np.abs(whole.normals[:, 2]) < 0.5) & (whole.points[:, 2] < 0.07)
    assert np.abs(out[side] - 0.03).max() < 0.008
    away = (near.points[:, :2] - where) @ (np.array(EYE[:2]) - where)
    assert away[near.points[:, 2] < 0.07].min() > -0.01  # the far side is not seen ...
    away = (whole.points[:, :2] - where) @ (np.array(EYE[:2]) - where)
    assert away.min() < -0.02  # ... but completed
    small = points.thinned(whole, 0.004, 600)
    assert len(find_grasps(small.points, small.normals))


def test_what_a_camera_sees_to_be_free_is_not_completed() -> None:
    # An L from above: half a turn would fill the corner that the camera sees to be empty.
    parts = [block((-0.06, -0.06, 0.0), (0.06, -0.02, 0.06)), block((-0.06, -0.02, 0.0), (-0.02, 0.06, 0.06))]
    seen = view((0.5, 0.4, 0.9), (0, 0, 0), [floor(), *parts], side=256)
    whole = points.completed(points.joined([cloud(seen, 1), cloud(seen, 2)]), 0.0, [seen], 0.008)
    corner = (whole.points[:, 0] > 0.0) & (whole.points[:, 1] > 0.0) & (whole.points[:, 2] > 0.02)
    assert not corner.any()


def test_what_carries_an_object_is_what_is_seen_under_or_around_it() -> None:
    thing = block((-0.03, -0.03, 0.05), (0.03, 0.03, 0.1))
    shelf = block((-0.1, -0.1, 0.0), (0.1, 0.1, 0.05))
    seen = view(EYE, (0, 0, 0), [floor(), thing, shelf])
    own, rest = cloud(seen, 1), points.joined([cloud(seen, 0), cloud(seen, 2)])
    assert points.support_under(own.points, rest, 0.0) == pytest.approx(0.05, abs=0.002)
    assert points.support_under(own.points, cloud(seen, 0), 0.0) == pytest.approx(0.0, abs=0.002)


# -- one slot over time ------------------------------------------------------------------------------------------------


def test_the_table_is_the_largest_level_surface() -> None:
    seen = view(EYE, (0, 0, 0.4), [floor(0.4), block((-0.1, -0.1, 0.4), (0.1, 0.1, 0.5)), floor(-0.2)])
    assert table_height(points.joined([cloud(seen, 0), cloud(seen, 1)])) == pytest.approx(0.4, abs=1e-3)
    with pytest.raises(NotSeen, match="no table"):
        table_height(points.NO_POINTS)


def test_an_object_is_remembered_while_hidden_and_forgotten_when_it_is_gone() -> None:
    scene = memory()
    thing, screen = can(-0.1, 0.0, 0.03, 0.0, 0.08), block((0.2, -0.1, 0.0), (0.25, 0.1, 0.4))
    first = scene.look(labelled(view(EYE, (0, 0, 0), [floor(), thing]), "", "can_1"), OPEN)
    assert first.names == ("can_1",)
    hidden = view(EYE, (0, 0, 0), [floor(), thing, screen])
    second = scene.look(labelled(hidden, "", "can_1", None), OPEN)
    np.testing.assert_allclose(second.poses["can_1"], first.poses["can_1"], atol=0.003)
    third = scene.look(labelled(view(EYE, (0, 0, 0), [floor()]), ""), OPEN)
    assert third.names == ()
    moved = view(EYE, (0, 0, 0), [floor(), can(-0.07, 0.1, 0.03, 0.0, 0.08)])
    fourth = scene.look(labelled(moved, "", "can_1"), OPEN)
    np.testing.assert_allclose(fourth.poses["can_1"][:2], [-0.07, 0.1], atol=0.004)


def test_an_object_that_moves_a_little_leaves_no_ghost() -> None:
    scene = memory()
    for x in (0.0, 0.015, 0.03):
        last = scene.look(
            labelled(view(EYE, (0, 0, 0), [floor(), can(x, 0, 0.03, 0, 0.08)], side=256), "", "can_1"), OPEN
        )
    extent = np.ptp(last.objects["can_1"].points[:, :2], axis=0)
    np.testing.assert_allclose(extent, 0.06, atol=0.008)


def test_what_is_between_closed_pads_moves_with_the_hand() -> None:
    scene = memory()
    seen = view(EYE, (0, 0, 0), [floor(), can(0.0, 0.0, 0.03, 0.0, 0.08)], side=256)
    before = scene.look(labelled(seen, "", "can_1"), OPEN)
    hand = np.array([0.0, 0.0, 0.06, 0.0, 1.0, 0.0, 0.0])
    closed = Proprioception(hand, np.array([0.03, -0.03]), closed=True)
    scene.look(labelled(seen, "", "can_1"), closed)
    assert scene.held is not None
    assert scene.held[0] == "can_1"
    # The hand, with the can, is taken out of the image.
    lifted = replace(closed, ee_pose=hand + [0, 0, 0.2, 0, 0, 0, 0])
    far = view(EYE, (0, 0, 0), [floor(), block((0.3, -0.2, 0.0), (0.32, 0.2, 0.6))])
    after = scene.look(labelled(far, "", None), lifted)
    shift = after.objects["can_1"].points.mean(axis=0) - before.objects["can_1"].points.mean(axis=0)
    np.testing.assert_allclose(shift, [0, 0, 0.2], atol=0.005)
    scene.look(labelled(view(EYE, (0, 0, 0), [floor()]), ""), replace(lifted, closed=False))
    assert scene.held is None


# -- parts -------------------------------------------------------------------------------------------------------------


def basket(half: float = 0.08, depth: float = 0.12, wall: float = 0.01) -> list[Any]:
    sides = [
        block((-half, -half, 0), (half, -half + wall, depth)),
        block((-half, half - wall, 0), (half, half, depth)),
        block((-half, -half, 0), (-half + wall, half, depth)),
        block((half - wall, -half, 0), (half, half, depth)),
    ]
    return [*sides, block((-half, -half, 0), (half, half, wall))]


def test_the_inside_of_a_container_is_found_by_its_walls() -> None:
    shapes = basket()
    seen = view(EYE, (0, 0, 0), [floor(), *shapes], side=256)
    found = memory().look(labelled(seen, "", *["basket_1"] * len(shapes)), OPEN)
    inside = found.parts["basket_1_inside"].box
    assert inside is not None
    np.testing.assert_allclose(inside.pos[:2], [0, 0], atol=0.012)
    np.testing.assert_allclose(np.sort(inside.half_extents), [0.055, 0.07, 0.07], atol=0.012)
    full = memory().look(
        labelled(view(EYE, (0, 0, 0), [floor(), block((-0.08,) * 2 + (0,), (0.08, 0.08, 0.12))]), "", "box_1"), OPEN
    )
    assert not full.parts


def test_a_fixture_has_a_top_and_an_open_drawer_by_its_level() -> None:
    body = block((-0.15, -0.15, 0.0), (0.15, 0.15, 0.3))
    drawer = [block((0.15, -0.12, 0.22), (0.3, -0.11, 0.28)), block((0.15, 0.11, 0.22), (0.3, 0.12, 0.28))]
    drawer += [block((0.29, -0.12, 0.22), (0.3, 0.12, 0.28)), block((0.15, -0.12, 0.22), (0.3, 0.12, 0.23))]
    seen = view((1.0, 0.3, 1.0), (0, 0, 0), [floor(), body, *drawer], side=256)
    found = memory().look(labelled(seen, "", *["cabinet_1"] * 5), OPEN)
    assert found.movable == ()
    assert set(found.parts) == {"cabinet_1_top", "cabinet_1_top_drawer"}
    top, out = found.parts["cabinet_1_top"].box, found.parts["cabinet_1_top_drawer"].box
    assert top is not None
    assert out is not None
    assert top.pos[2] == pytest.approx(0.3, abs=0.003)
    np.testing.assert_allclose(out.pos[:2], [0.23, 0.0], atol=0.03)
    shut = memory().look(labelled(view((1.0, 0.3, 1.0), (0, 0, 0), [floor(), body], side=256), "", "cabinet_1"), OPEN)
    assert set(shut.parts) == {"cabinet_1_top"}


def test_parts_need_points() -> None:
    few = PointCloud(np.zeros((3, 3)), np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert parts_of("thing_1", few, fixed=True, table=0.0, config=CAMERA) == {}
    assert parts_of("thing_1", few, fixed=False, table=0.0, config=CAMERA) == {}


# -- names -------------------------------------------------------------------------------------------------------------


def colored(seen: DepthView, *colors: Sequence[int]) -> DepthView:
    return replace(seen, colors=np.array(colors, np.uint8)[seen.labels], labels=np.zeros_like(seen.labels))


def test_an_object_without_a_mask_is_found_by_the_colour_in_its_name() -> None:
    seen = view(EYE, (0, 0, 0), [floor(), can(0, 0, 0.03, 0, 0.08)])
    shown = LabelledView(colored(seen, (90, 90, 90), (230, 210, 60)), np.zeros_like(seen.labels), ("", "yellow_basket"))
    found = with_color(shown, "yellow_basket")
    assert (found.labels == (seen.labels == 1)).all()
    assert not with_color(replace(shown, names=("", "red_basket")), "red_basket").labels.any()
    assert not with_color(replace(shown, names=("", "basket")), "basket").labels.any()


def test_clusters_get_the_names_that_fit_and_what_fits_none_is_not_found(monkeypatch: pytest.MonkeyPatch) -> None:
    red, blue, grey = (200, 20, 20), (20, 40, 200), (90, 90, 90)
    shapes = [can(0.0, 0.2, 0.03, 0, 0.08), can(0.0, -0.2, 0.03, 0, 0.08)]
    seen = colored(view(EYE, (0, 0, 0), [floor(), *shapes]), grey, red, blue)
    size = np.array([0.06, 0.055, 0.08])
    known = {
        name: geometry.Appearance(size * scale, geometry.histogram(np.array([color], np.uint8)))
        for name, color, scale in (("soup", red, 1), ("tuna", blue, 1), ("cake", blue, 3))
    }
    monkeypatch.setattr(geometry, "catalogue", lambda: known)
    scene, names = memory(), ("", "robot", "tuna_1", "soup_1", "cake_1", "unknown_1")
    found = scene.look(geometry.GeometrySegments().label([seen], names, scene, OPEN), OPEN)
    assert set(found.names) == {"soup_1", "tuna_1"}
    assert found.poses["soup_1"][1] == pytest.approx(0.2, abs=0.004)
    assert found.poses["tuna_1"][1] == pytest.approx(-0.2, abs=0.004)
    # Later what stands where something was is that thing, whatever its colour.
    swapped = replace(seen, colors=seen.colors[:, ::-1] if seen.colors is not None else None)
    again = scene.look(geometry.GeometrySegments().label([swapped], names, scene, OPEN), OPEN)
    assert again.poses["soup_1"][1] == pytest.approx(0.2, abs=0.004)


# -- a batch -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    render = vecenv.RenderConfig(height=160, width=160, lod="fast")
    with vecenv.make("libero_object", task=0, episodes=[0], render=render, num_threads=1) as made:
        made.reset()
        yield made


class Blindfolded:
    """An environment that answers with camera images alone, and keeps the first plan."""

    def __init__(self, env: Any, objects: Any) -> None:
        self._env, self._objects = env, objects
        self.num_envs = env.num_envs
        self.plans: list[Any] = []

    def observe_egocentric(self, slots: Any = None) -> Egocentric:
        return self._env.observe_egocentric(slots)

    def observe_objects(self, points: str = "surface", slots: Any = None) -> Objects:
        return self._objects(slots)

    def step_waypoints(self, plan: Any, max_misses: int | None = None) -> Any:
        self.plans.append(plan)
        raise Planned


class Planned(Exception):
    """The plan is there."""


def first_plan(env: Any, objects: Any, sight: PerceptionConfig = CAMERA) -> tuple[np.ndarray, list[PlannedMotion]]:
    blind, motions = Blindfolded(env, objects), []
    llm = Llm(LlmConfig(model="offline/libero"))
    agent = Agent(blind, env.instructions(), llm, AgentConfig(perception=sight), None, motions.append)  # type: ignore[arg-type]
    with pytest.raises(Planned):
        agent.step()
    return np.asarray(blind.plans[0].poses), motions


@needs_gl
def test_the_plan_depends_on_images_alone(env: Any) -> None:
    def refused(slots: Any) -> Objects:
        raise AssertionError("ground truth was read")

    def garbage(slots: Any) -> Objects:
        seen = env.observe_objects(slots=slots)
        (snapshot,) = seen.snapshot
        junk = {name: PointCloud(c.points * 0 + 7, c.normals * 0) for name, c in snapshot.objects.items()}
        poses = {name: np.full(7, np.nan) for name in snapshot.poses}
        changed = replace(snapshot, objects=junk, poses=poses, parts={}, regions={}, goal=(), movable=(), targets=())
        return replace(seen, snapshot=(changed,))

    (poses, motions), (others, _) = (first_plan(env, objects) for objects in (refused, garbage))
    assert motions
    np.testing.assert_array_equal(poses, others)
    with pytest.raises(AssertionError, match="ground truth was read"):
        first_plan(env, refused, PerceptionConfig())


@needs_gl
@pytest.mark.parametrize("segmentation", ["renderer", "geometry"])
def test_seen_objects_are_where_they_are(env: Any, segmentation: str) -> None:
    config = replace(CAMERA, camera=CameraConfig(segmentation=segmentation))
    sight = CameraSight(env, config)
    sight.begin([0])
    found = sight.look([0], [False])
    (seen,), (true,) = found.snapshot, env.observe_objects().snapshot
    assert seen is not None
    assert not found.error[0]
    assert not sight.unseen(0)
    assert set(seen.names) == set(true.names)
    np.testing.assert_allclose(seen.ee_pose[:3], true.ee_pose[:3], atol=1e-4)
    for name in true.names:
        middle = [(c.points.min(axis=0) + c.points.max(axis=0)) / 2 for c in (seen.objects[name], true.objects[name])]
        np.testing.assert_allclose(middle[0], middle[1], atol=0.012, err_msg=name)
    ours, theirs = (each.parts["basket_1_inside"].box for each in (seen, true))
    assert ours is not None
    assert theirs is not None
    np.testing.assert_allclose(ours.pos, theirs.pos, atol=0.02)


@needs_gl
def test_cameras_that_there_are_not_are_named(env: Any) -> None:
    sight = CameraSight(env, replace(CAMERA, camera=CameraConfig(cameras=("agentview", "ceiling"))))
    sight.begin([0])
    with pytest.raises(ImagesUnavailable, match=r"needs ceiling; there are: .*agentview"):
        sight.look([0], [False])


@needs_gl
def test_an_object_that_is_not_found_is_named_in_the_cause(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    there = {name: look for name, look in geometry.catalogue().items() if name != "alphabet_soup"}
    monkeypatch.setattr(geometry, "catalogue", lambda: there)
    agent = Agent(
        env,
        env.instructions(),
        Llm(LlmConfig(model="offline/libero")),
        AgentConfig(perception=replace(CAMERA, camera=CameraConfig(segmentation="geometry")), idle_ticks=1),
    )
    agent.step()
    assert agent.slots[0].cause.startswith("not found by geometry: alphabet_soup_1 (LmpError")


def test_widowx_says_where_its_hand_is_by_its_joints(small: Path) -> None:
    pytest.importorskip("sapien")
    with vecenv.make("simpler/bridge", episodes=[0], assets=small, num_threads=1) as made:
        made.reset()
        hand, config = hands(made, "simpler/bridge", AgentConfig(perception=CAMERA))
        assert config.perception.source == "camera"
        assert config.perception.margins.gripper.half_opening < 0.03
        poses, fingers = CameraSight(hand, config.perception).hands()
        assert "yellow_basket" in hand.observe_egocentric().instances[3]
        for snapshot, pose, finger in zip(hand.observe_objects().snapshot, poses, fingers, strict=True):
            assert snapshot is not None
            np.testing.assert_allclose(pose[:3], snapshot.ee_pose[:3], atol=1e-5)
            np.testing.assert_allclose(matrix(pose[3:]), matrix(snapshot.ee_pose[3:]), atol=1e-4)
            np.testing.assert_allclose(finger, snapshot.gripper, atol=1e-6)


# -- the policy --------------------------------------------------------------------------------------------------------


def test_results_name_the_perception() -> None:
    assert make_policy("voxposer").name == "voxposer (offline/libero, rule-based; perception: ground truth)"
    seeing: Any = make_policy("voxposer", perception="camera")
    assert seeing.name == "voxposer (offline/libero, rule-based; perception: camera, renderer masks)"
    assert seeing.needed_cameras() == ("agentview",)
    other: Any = make_policy("voxposer", perception="camera", segmentation="geometry", cameras="agentview,frontview")
    assert "segmented by geometry" in other.name
    assert other.needed_cameras() == ("agentview", "frontview")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"perception": "lidar"}, "perception='lidar': expected one of ground_truth, camera"),
        ({"perception": "camera", "segmentation": "guess"}, "segmentation='guess': expected one of renderer, geometry"),
        ({"perception": "camera", "cameras": "agentview,"}, "cameras="),
        ({"segmentation": "geometry"}, "options of perception=camera"),
        ({"cameras": "agentview"}, "options of perception=camera"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], says: str) -> None:
    with pytest.raises(InvalidInput, match=says):
        make_policy("voxposer", **options)


@needs_gl
@pytest.mark.heavy
@pytest.mark.parametrize(("suite", "task"), [("libero_object", 0), ("libero_spatial", 0), ("libero_spatial", 4)])
def test_a_task_is_solved_from_images(suite: str, task: int) -> None:
    with vecenv.make(suite, task=task, episodes=[0, 1]) as env:
        info = env.reset()
        agent = Agent(env, info.instruction, Llm(LlmConfig(model="offline/libero")), AgentConfig(perception=CAMERA))
        control = agent.step()
        while not control.done.all():
            control = agent.step()
        assert control.success.all()
        assert agent.perception == "camera, renderer masks, agentview and wrist"
