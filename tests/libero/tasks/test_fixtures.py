"""Fixture poses are upstream's distribution, made an explicit input."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from support import upstream

from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.scene.bddl import Problem, load_problem
from vecenv.libero.scene.scene import Scene, compile_scene
from vecenv.libero.tasks import fixtures
from vecenv.libero.tasks.fixtures import FixtureError, check, placements, poses

SCENE = "libero_goal-0"
KEY = (0, "libero_goal", 0, 0)


@functools.cache
def scene_of(scene_id: str) -> tuple[Problem, Scene]:
    problem = upstream.tasks_of(scene_id)[0].problem()
    return problem, compile_scene(problem)


def stand(mode: Any, *, keys: list[tuple[int, str, int, int]] | None = None, slots: list[int] | None = None) -> Any:
    """Positions and quaternions by fixture name, [n, 3] and [n, 4]."""
    problem, scene = scene_of(SCENE)
    slots = [0] if slots is None else slots
    bodies, pos, quat = poses(problem, scene, mode, keys=keys or [KEY] * len(slots), slots=slots)
    roots = {scene.model.body(entity.root_body).id: entity.name for entity in scene.fixtures}
    return {roots[body]: (pos[:, i], quat[:, i]) for i, body in enumerate(bodies)}


def draw(sampler: Any, u: tuple[float, float, float], rectangle: int) -> tuple[np.ndarray, np.ndarray]:
    """What upstream's sampler gives when its random numbers are (x, y, yaw) fractions and a rectangle's index."""
    fractions = iter(u)

    def uniform(low: float, high: float) -> float:
        return low + next(fractions) * (high - low)

    with mock.patch("numpy.random.uniform", uniform), mock.patch("numpy.random.randint", return_value=rectangle):
        ((pos, quat, _),) = sampler.sample(fixtures={}).values()
    return np.array(pos), np.array(quat)


def assert_draws_as_upstream(problem: Problem, scene: Scene, peer: Any) -> None:
    """Position, height included, and orientation, for the same random numbers, of every fixture."""
    samplers = {
        sampler.mujoco_objects[0].name: sampler
        for sampler in peer.env.placement_initializer.samplers.values()
        if peer.env.is_fixture(sampler.mujoco_objects[0].name)
    }
    ours = placements(problem, scene)
    assert set(ours) == set(samplers)
    for name, placement in ours.items():
        assert len(placement.ranges) == samplers[name].num_ranges
        for rectangle in range(len(placement.ranges)):
            for u in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.25, 0.5, 0.75)):
                pos, quat = draw(samplers[name], u, rectangle)
                mine = placement.pose(np.array(u), rectangle)
                np.testing.assert_allclose(mine[0], pos, atol=1e-12)
                np.testing.assert_allclose(mine[1], quat, atol=1e-12)


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_poses_are_those_upstreams_sampler_draws(scene_id: str) -> None:
    problem, scene = scene_of(scene_id)
    assert_draws_as_upstream(problem, scene, upstream.peer_of(upstream.tasks_of(scene_id)[0].bddl_path))


@pytest.mark.parametrize("problem_name", sorted(ARENAS))
def test_a_cabinet_stands_in_any_workspace_where_upstream_puts_it(problem_name: str, tmp_path: Path) -> None:
    """The suites place no fixture on the floor and none on the coffee table."""
    path = tmp_path / "task.bddl"
    path.write_text(upstream.task_text(problem_name))
    problem = load_problem(path)
    scene = compile_scene(problem)
    assert len(placements(problem, scene)) == 1
    assert_draws_as_upstream(problem, scene, upstream.bare_peer(path))


def test_upstreams_reset_puts_fixtures_where_ours_may_be() -> None:
    problem, scene = scene_of(SCENE)
    model = upstream.model_of(upstream.bare_peer(upstream.tasks_of(SCENE)[0].bddl_path))
    for name, placement in placements(problem, scene).items():
        pos = model.body(scene.entities[name].root_body).pos
        corners = np.array([placement.pose(np.full(3, u))[0] for u in (0.0, 1.0)])
        assert (pos >= corners.min(axis=0) - 1e-12).all()
        assert (pos <= corners.max(axis=0) + 1e-12).all()


def test_all_twelve_fixture_categories_are_covered() -> None:
    assert len({f.category for scene_id in upstream.scene_ids() for f in scene_of(scene_id)[0].fixtures}) == 12


def test_center_is_the_regions_centre_at_the_middle_of_its_yaw() -> None:
    problem, scene = scene_of(SCENE)
    regions = tuple(dataclasses.replace(region, yaw=(0.2, 1.0)) for region in problem.regions)
    turned = dataclasses.replace(problem, regions=regions)
    bodies, pos, quat = poses(turned, scene, "center", keys=[KEY], slots=[0])
    placed = {p.args[0]: p.args[1] for p in problem.init if p.args[0] in stand("center")}
    assert len(placed) == len(bodies) > 1
    for name, region_name in placed.items():
        column = list(bodies).index(scene.model.body(scene.entities[name].root_body).id)
        x0, y0, x1, y1 = next(region for region in regions if region.name == region_name).ranges[0]
        centre = np.array([x0 + x1, y0 + y1]) / 2 + scene.arena.workspace_offset[:2]
        np.testing.assert_allclose(pos[0, column, :2], centre)
        np.testing.assert_allclose(quat[0, column], [np.cos(0.3), 0, 0, np.sin(0.3)], atol=1e-12)


def test_a_draw_depends_on_seed_suite_task_and_episode_and_on_nothing_else() -> None:
    keys = [KEY, (1, *KEY[1:]), (0, "libero_10", 0, 0), (0, "libero_goal", 1, 0), (0, "libero_goal", 0, 1)]
    together = stand("sampled", keys=keys, slots=[4, 0, 1, 2, 3])
    for name, (pos, quat) in together.items():
        assert len({tuple(row) for row in pos}) == len(keys)
        for row, key in enumerate(keys):
            alone = stand("sampled", keys=[key], slots=[7])[name]
            np.testing.assert_array_equal(alone[0][0], pos[row])
            np.testing.assert_array_equal(alone[1][0], quat[row])


def test_draws_fill_the_region_and_stay_in_it() -> None:
    problem, scene = scene_of(SCENE)
    keys = [(0, "libero_goal", 0, episode) for episode in range(300)]
    drawn = stand("sampled", keys=keys, slots=list(range(300)))
    for name, placement in placements(problem, scene).items():
        pos, quat = drawn[name]
        x0, y0, x1, y1 = placement.ranges[0]
        fraction = (pos - placement.origin)[:, :2] - [x0, y0]
        size = np.array([x1 - x0, y1 - y0])
        assert (fraction >= -1e-12).all()
        assert (fraction <= size + 1e-12).all()
        assert (np.ptp(fraction, axis=0) >= 0.9 * size).all()
        assert (pos[:, 2] == placement.origin[2]).all()
        yaw = 2 * np.arctan2(quat[:, 3], quat[:, 0])
        assert yaw.min() >= min(placement.yaw) - 1e-12
        assert yaw.max() <= max(placement.yaw) + 1e-12


def test_draws_use_every_rectangle_of_a_region() -> None:
    problem, scene = scene_of(SCENE)
    name, placement = next(iter(placements(problem, scene).items()))
    two = dataclasses.replace(placement, ranges=((0.0, 0.0, 0.1, 0.1), (0.5, 0.5, 0.6, 0.6)))
    drawn = [fixtures._sample(two, name, (0, "libero_goal", 0, episode))[0][0] for episode in range(50)]
    near = [x - placement.origin[0] < 0.3 for x in drawn]
    assert 10 < sum(near) < 40


def test_given_poses_replace_the_centre_of_the_fixtures_they_name() -> None:
    name, other = list(stand("center"))[:2]
    pose = ([0.1, 0.2, 0.9], [2.0, 0.0, 0.0, 0.0])
    mixed = stand({name: pose}, slots=[3, 1])
    np.testing.assert_array_equal(mixed[name][0], [[0.1, 0.2, 0.9]] * 2)
    np.testing.assert_array_equal(mixed[name][1], [[1.0, 0.0, 0.0, 0.0]] * 2)
    np.testing.assert_array_equal(mixed[other][0], stand("center", slots=[0, 0])[other][0])


def test_given_poses_may_differ_by_slot() -> None:
    name = next(iter(stand("center")))
    pos = np.arange(12.0).reshape(4, 3)
    quat = np.eye(4)
    ours = stand({name: (pos, quat)}, slots=[3, 1])[name]
    np.testing.assert_array_equal(ours[0], pos[[3, 1]])
    np.testing.assert_array_equal(ours[1], quat[[3, 1]])


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (([0, 0, 0],), "expected"),
        (7, "expected"),
        ((["a", "b", "c"], [1, 0, 0, 0]), "expected"),
        (([0, 0], [1, 0, 0, 0]), r"pos: expected finite \[3\]"),
        (([0, 0, np.nan], [1, 0, 0, 0]), "pos: expected finite"),
        (([0, 0, 0], [1, 0, 0]), r"quat: expected finite \[4\]"),
        (([0, 0, 0], [0, 0, 0, 0]), "quat: zero length"),
        (([[0, 0, 0]] * 2, [1, 0, 0, 0]), "pos: 2 rows, but slot 3 needs one"),
        ((np.zeros((1, 1, 3)), [1, 0, 0, 0]), "pos: expected finite"),
    ],
)
def test_what_is_no_pose_is_refused_by_the_fixtures_name(pose: Any, message: str) -> None:
    name = next(iter(stand("center")))
    with pytest.raises(FixtureError, match=rf"fixtures\['{name}'\].*{message}"):
        stand({name: pose}, slots=[3, 1])


@pytest.mark.parametrize("mode", ["centre", None, ["center"], 3])
def test_unknown_modes_are_refused(mode: Any) -> None:
    with pytest.raises(FixtureError, match="expected 'center', 'sampled', 'upstream' or a mapping"):
        stand(mode)
    with pytest.raises(FixtureError, match="expected 'center', 'sampled', 'upstream' or a mapping"):
        check(mode, [scene_of(SCENE)[1]], 1)


def test_names_that_no_scene_has_are_refused() -> None:
    scene = scene_of(SCENE)[1]
    check("center", [scene], 1)
    check({scene.fixtures[0].name: ([0, 0, 0], [1, 0, 0, 0])}, [scene], 1)
    with pytest.raises(FixtureError, match=rf"'teapot_1'.*{scene.fixtures[0].name}"):
        check({"teapot_1": ()}, [scene], 1)
    with pytest.raises(FixtureError, match=scene.objects[0].name):
        check({scene.objects[0].name: ()}, [scene], 1)


def test_a_region_without_a_rectangle_holds_no_fixture() -> None:
    problem, scene = scene_of(SCENE)
    bare = tuple(dataclasses.replace(region, ranges=()) for region in problem.regions)
    with pytest.raises(FixtureError, match="no rectangle"):
        placements(dataclasses.replace(problem, regions=bare), scene)
