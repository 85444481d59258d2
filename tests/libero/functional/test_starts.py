"""Episodes begin in stored starts, or in starts whose things were moved within their regions and stay there."""

from __future__ import annotations

from functools import cache, partial

import jax
import numpy as np
import pytest

from vecenv.libero.functional.starts import Begin, StartError, Starts
from vecenv.libero.physics.base import Start
from vecenv.libero.physics.native import NativePhysics
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks import fixtures
from vecenv.libero.tasks.settled import SettledStarts
from vecenv.libero.tasks.sources import installed_tasks

DRAWS = 24
# Bowls in a tight row with a plate; bowls on a cabinet and on a stove.
TASKS = (("libero_spatial", 0), ("libero_spatial", 9))
pytestmark = pytest.mark.usefixtures("no_rank_promotion")
compiled = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


@cache
def task(suite: str, index: int) -> tuple[Scene, Problem, SettledStarts]:
    source = installed_tasks(suite)[index]
    problem = source.problem()
    return source.scene(goals.contact_pairs([problem])), problem, source.settled()


@cache
def drawn(suite: str, index: int) -> Begin:
    starts = Starts(*task(suite, index))
    return jax.device_get(compiled(jax.vmap(starts.regions))(jax.random.split(jax.random.key(1), DRAWS)))


def place(scene: Scene, name: str, begin: Begin) -> np.ndarray:
    """Positions of a thing, [n, 3]."""
    entity = scene.entities[name]
    if entity.fixture:
        return np.asarray(begin.body_pos)[:, scene.model.body(entity.root_body).id]
    at = scene.model.joint(entity.joints[0]).qposadr[0]
    return np.asarray(begin.qpos)[:, at : at + 3]


def test_stored_starts_rotate_through_all_episodes() -> None:
    starts = Starts(*task(*TASKS[0]))
    begin = jax.vmap(starts.stored)(jax.random.split(jax.random.key(0), 400))
    episodes = np.asarray(begin.episode)
    assert set(episodes) == set(range(50))
    settled = task(*TASKS[0])[2]
    np.testing.assert_allclose(begin.qpos, settled.qpos[episodes], atol=1e-6)
    np.testing.assert_allclose(begin.qvel, settled.qvel[episodes], atol=1e-6)


def test_starts_can_be_held_back() -> None:
    starts = Starts(*task(*TASKS[0]), episodes=(3, 41))
    begin = jax.vmap(starts.stored)(jax.random.split(jax.random.key(0), 40))
    assert set(np.asarray(begin.episode)) == {3, 41}


@pytest.mark.parametrize("episodes", [(), (50,), (-1,)])
def test_episodes_that_do_not_exist_are_refused(episodes: tuple[int, ...]) -> None:
    with pytest.raises(StartError, match="0 to 49"):
        Starts(*task(*TASKS[0]), episodes=episodes)


def test_starts_of_another_scene_are_refused() -> None:
    scene, problem, _ = task(*TASKS[0])
    with pytest.raises(StartError, match="positions"):
        Starts(scene, problem, task("libero_object", 0)[2])


@pytest.mark.parametrize(("suite", "index"), TASKS)
def test_things_are_drawn_within_their_regions(suite: str, index: int) -> None:
    scene, problem, _ = task(suite, index)
    regions = {region.name: region for region in problem.regions}
    checked = 0
    for predicate in problem.init:
        region = regions.get(predicate.args[-1])
        if region is None or not region.ranges or predicate.name != "on":
            continue
        spots = place(scene, predicate.args[0], drawn(suite, index))[:, :2] - scene.arena.workspace_offset[:2]
        low, high = np.array(region.ranges[0]).reshape(2, 2)
        assert (spots > low - 1e-6).all()
        assert (spots < high + 1e-6).all()
        assert (np.ptp(spots, axis=0) > 0.4 * (high - low)).all(), predicate
        checked += 1
    assert checked >= 4


@pytest.mark.parametrize(("suite", "index"), TASKS)
def test_fixtures_turn_within_their_range_and_keep_their_height(suite: str, index: int) -> None:
    scene, problem, _ = task(suite, index)
    begin = drawn(suite, index)
    for name, placement in fixtures.placements(problem, scene).items():
        quat = begin.body_quat[:, placement.body]
        yaw = 2 * np.arctan2(quat[:, 3], quat[:, 0])
        low, high = sorted(placement.yaw)
        assert ((yaw > low - 1e-5) & (yaw < high + 1e-5)).all(), name
        np.testing.assert_allclose(place(scene, name, begin)[:, 2], placement.origin[2], atol=1e-6)


def test_what_stands_on_a_fixture_moves_with_it() -> None:
    scene, problem, settled = task(*TASKS[1])
    begin = drawn(*TASKS[1])
    placement = fixtures.placements(problem, scene)["wooden_cabinet_1"]
    central, _ = placement.pose(np.full(3, 0.5))
    at = scene.model.joint(scene.entities["akita_black_bowl_1"].joints[0]).qposadr[0]
    before = settled.qpos[begin.episode, at : at + 3] - central
    after = begin.qpos[:, at : at + 3] - place(scene, "wooden_cabinet_1", begin)
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), np.linalg.norm(before, axis=1), atol=1e-5)
    np.testing.assert_allclose(after[:, 2], before[:, 2], atol=1e-6)
    assert np.abs(after[:, :2] - before[:, :2]).max() > 1e-4


@pytest.mark.parametrize(("suite", "index"), TASKS)
def test_what_was_moved_stays_where_it_is(suite: str, index: int) -> None:
    scene = task(suite, index)[0]
    begin = drawn(suite, index)
    physics = NativePhysics([scene], np.zeros(DRAWS, int))
    group, bodies = physics.groups[0], np.arange(1, scene.model.nbody)
    start = Start(
        qpos=np.asarray(begin.qpos),
        qvel=np.asarray(begin.qvel),
        bodies=bodies,
        body_pos=np.asarray(begin.body_pos)[:, bodies],
        body_quat=np.asarray(begin.body_quat)[:, bodies],
        settled=True,
    )
    physics.place(group, np.arange(DRAWS), start)
    for _ in range(10):
        physics.control_step(np.tile([0, 0, 0, 0, 0, 0, -1.0], (DRAWS, 1)), np.ones(DRAWS, bool))
    for entity in scene.objects:
        at = scene.model.joint(entity.joints[0]).qposadr[0]
        moved = np.linalg.norm(group.qpos[:, at : at + 3] - begin.qpos[:, at : at + 3], axis=1)
        assert moved.max() < 2e-3, entity.name
    physics.close()
