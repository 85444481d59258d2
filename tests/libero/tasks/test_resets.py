"""Upstream's resets replayed: its poses from a file recorded under MuJoCo 3.3.0, and from upstream itself."""

from __future__ import annotations

import functools
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import upstream
from support.paths import DATA

import vecenv
from vecenv.libero.config import LiberoConfig, LiberoError
from vecenv.libero.scene import catalog
from vecenv.libero.scene.bddl import Problem, load_problem, parse_problem
from vecenv.libero.scene.scene import Scene, compile_scene
from vecenv.libero.tasks import resets
from vecenv.libero.tasks.fixtures import placements, poses
from vecenv.libero.tasks.resets import ResetError, Resets, placed_at
from vecenv.libero.tasks.suites import TaskSpec, list_suites, list_tasks
from vecenv.protocols import MAX_SEED, ProtocolError, ResetLoop, ResetPoint, reset_loop
from vecenv.registry import OptionError

ONCE = ResetLoop()
RECORDED = json.loads((DATA / "upstream_resets.json").read_text())["resets"]
RECORDED_TASKS = sorted({(row["suite"], row["task"]) for row in RECORDED})


@functools.cache
def scene_of(suite: str, task: int) -> tuple[Problem, Scene]:
    problem = list_tasks(suite)[task].problem()
    return problem, compile_scene(problem)


@functools.cache
def unlike_tasks() -> tuple[TaskSpec, ...]:
    """One task of each kind of ``:init`` that does more than place things on the table, of all 21 suites."""
    found: dict[Any, TaskSpec] = {}
    for suite in list_suites():
        for spec in list_tasks(suite):
            problem = spec.problem()
            on_table = {region.name for region in problem.regions if region.ranges}
            if any(p.name != "on" or p.args[1] not in on_table for p in problem.init):
                found.setdefault((problem.scene_key(), problem.init), spec)
    return tuple(found.values())


def assert_resets_as_upstream(spec: TaskSpec, *, seed: int, resets: int, unseeded: int = 0) -> None:
    """Fixtures and objects stand where upstream puts them, and the generators stay in step, reset by reset."""
    problem = spec.problem()
    scene = compile_scene(problem)
    peer = upstream.bare_peer(spec.bddl_path)
    with upstream.silence():
        for _ in range(unseeded):
            peer.reset()
        peer.seed(seed)
        for placed in itertools.islice(Resets(problem, scene, seed, unseeded=unseeded), resets):
            peer.reset()
            assert set(placed) >= set(placements(problem, scene))
            for name, (pos, quat) in placed.items():
                theirs = pose_of(peer, scene, name)
                np.testing.assert_allclose(np.concatenate([pos, quat]), theirs, rtol=0, atol=1e-12)


def pose_of(peer: Any, scene: Scene, name: str) -> np.ndarray:
    """Where upstream has just put a fixture or an object, position and wxyz, [7]."""
    entity = scene.entities[name]
    if not entity.fixture:
        return upstream.data_of(peer).joint(entity.joints[-1]).qpos.copy()
    body = upstream.model_of(peer).body(entity.root_body)
    return np.concatenate([body.pos, body.quat])


# -- against the record ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suite", "task"), RECORDED_TASKS)
def test_fixtures_stand_where_upstream_was_recorded_to_put_them(suite: str, task: int) -> None:
    problem, scene = scene_of(suite, task)
    rows = [row for row in RECORDED if (row["suite"], row["task"]) == (suite, task)]
    points = [ResetPoint(seed=r["seed"], unseeded=r["unseeded"], resets=r["resets"]) for r in rows]
    for row, placed in zip(rows, placed_at(problem, scene, points), strict=True):
        for name in placements(problem, scene):
            np.testing.assert_allclose(np.concatenate(placed[name]), row["fixtures"][name], rtol=0, atol=1e-12)


def test_the_record_has_fixtures_of_every_seed_and_number_of_resets_elsewhere() -> None:
    row = next(r for r in RECORDED if r["fixtures"])
    same = [r for r in RECORDED if (r["suite"], r["task"]) == (row["suite"], row["task"])]
    name = next(iter(placements(*scene_of(row["suite"], row["task"]))))
    assert len({(r["seed"], r["resets"]) for r in same}) == len({tuple(r["fixtures"][name]) for r in same}) > 3


@pytest.mark.parametrize("suite", ["libero_spatial", "libero_goal", "libero_10"])
def test_a_batch_puts_each_episodes_fixtures_where_openpis_loop_does(suite: str) -> None:
    """Episode e begins with reset number e + 1 after the seed, whatever else is in the batch."""
    task = {"libero_spatial": 3, "libero_goal": 0, "libero_10": 8}[suite]
    recorded = {
        r["resets"]: r["fixtures"]
        for r in RECORDED
        if (r["suite"], r["task"], r["seed"], r["unseeded"]) == (suite, task, 7, 0)
    }
    episodes = [number - 1 for number in recorded][::-1]
    env = vecenv.make(
        suite, task=task, episodes=episodes, fixtures="upstream", seed=7, start="raw", settle_steps=0, num_threads=1
    )
    env.reset()
    snapshots = env.observe_objects().snapshot
    for episode, snapshot in zip(episodes, snapshots, strict=True):
        assert snapshot is not None
        for name in placements(*scene_of(suite, task)):
            np.testing.assert_allclose(snapshot.poses[name], recorded[episode + 1][name], rtol=0, atol=1e-9)
    env.close()


def test_starts_settle_with_upstreams_fixtures_too() -> None:
    env = vecenv.make("libero_goal", task="bowl_on_the_plate", episodes=[0], fixtures="upstream", num_threads=1)
    task = int(env.reset().task_id[0])
    (snapshot,) = env.observe_objects().snapshot
    (placed,) = placed_at(*scene_of("libero_goal", task), [ONCE.at(0, task, 0)])
    assert snapshot is not None
    for name in placements(*scene_of("libero_goal", task)):
        np.testing.assert_allclose(snapshot.poses[name][:3], placed[name][0], rtol=0, atol=1e-9)
    env.close()


# -- against upstream --------------------------------------------------------------------------------------------------


def test_a_few_resets_are_upstreams_objects_included() -> None:
    assert_resets_as_upstream(list_tasks("libero_spatial")[4], seed=3, resets=3, unseeded=1)


def test_the_turns_of_all_categories_are_upstreams() -> None:
    with upstream.silence():
        upstream._classes()
        from libero.libero.envs.objects import get_object_dict

        for category, turns in catalog.TURNS.items():
            thing = get_object_dict()[category](name="thing_1")
            axes = thing.rotation if isinstance(thing.rotation, dict) else {thing.rotation_axis: thing.rotation}
            assert turns == tuple((axis, min(bounds), max(bounds)) for axis, bounds in axes.items())


def test_every_object_that_a_task_places_has_turns() -> None:
    categories = {o.category for s in list_suites() for spec in list_tasks(s) for o in spec.problem().objects}
    assert categories <= set(catalog.TURNS)


@pytest.mark.heavy
@pytest.mark.parametrize("scene_id", upstream.scene_ids())
@pytest.mark.parametrize("seed", [0, 7])
def test_sixty_resets_in_a_row_are_upstreams(scene_id: str, seed: int) -> None:
    assert_resets_as_upstream(upstream.tasks_of(scene_id)[0], seed=seed, resets=60)


@pytest.mark.heavy
@pytest.mark.parametrize("spec", unlike_tasks(), ids=lambda spec: f"{spec.suite}-{spec.index}")
def test_every_kind_of_init_is_reset_as_upstream_does(spec: TaskSpec) -> None:
    assert_resets_as_upstream(spec, seed=123456789, resets=4, unseeded=2)


@pytest.mark.heavy
@pytest.mark.parametrize("problem_name", ["libero_floor_manipulation", "libero_coffee_table_manipulation"])
def test_a_task_of_no_suite_is_reset_as_upstream_does(problem_name: str, tmp_path: Path) -> None:
    path = tmp_path / "task.bddl"
    path.write_text(upstream.task_text(problem_name))
    problem = load_problem(path)
    scene = compile_scene(problem)
    peer = upstream.bare_peer(path)
    with upstream.silence():
        peer.seed(5)
        for placed in itertools.islice(Resets(problem, scene, 5), 4):
            peer.reset()
            for name, pose in placed.items():
                np.testing.assert_allclose(np.concatenate(pose), pose_of(peer, scene, name), rtol=0, atol=1e-12)


# -- loops -------------------------------------------------------------------------------------------------------------


def test_seeded_once_episode_e_has_e_plus_one_resets() -> None:
    assert ONCE.at(7, 3, 0) == ResetPoint(seed=7, unseeded=0, resets=1)
    assert ONCE.at(7, 3, 49) == ResetPoint(seed=7, unseeded=0, resets=50)


def test_seeded_every_episode_earlier_resets_are_before_the_seed() -> None:
    loop = ResetLoop(seed_per_episode=1, spare_resets=1)
    assert loop.at(1000, 3, 4) == ResetPoint(seed=1004, unseeded=5, resets=1)


def test_an_environment_an_episode_has_no_earlier_resets() -> None:
    loop = ResetLoop(seed_per_episode=10, seed_per_task=1, fresh=True)
    assert loop.at(0, 3, 4) == ResetPoint(seed=43, unseeded=0, resets=1)
    assert ResetLoop(fresh=True).at(0, 3, 4) == ResetPoint(seed=0, unseeded=0, resets=1)


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1, True, 1.5, "7", None])
def test_seeds_that_upstream_does_not_take_are_refused(seed: Any) -> None:
    with pytest.raises(ProtocolError, match=f"integers from 0 to {MAX_SEED}"):
        ONCE.at(seed, 0, 0)


@pytest.mark.parametrize(("protocol", "seed"), [("seed", 0), ("openpi", 7)])
def test_without_a_seed_fixtures_stand_as_the_protocols_seed_has_them(protocol: str, seed: int) -> None:
    def poses_of(**options: Any) -> list[np.ndarray]:
        common = {"fixtures": "upstream", "start": "raw", "settle_steps": 0, "protocol": protocol, "num_threads": 1}
        with vecenv.make("libero_goal", task=0, episodes=[0, 3], **common, **options) as env:
            env.reset()
            return [snapshot.poses[name] for snapshot in env.observe_objects().snapshot if snapshot for name in names]

    names = placements(*scene_of("libero_goal", 0))
    assert LiberoConfig(protocol=protocol, seed=None).rules("libero_goal").seed == seed
    without, same, other = poses_of(seed=None), poses_of(seed=seed), poses_of(seed=seed + 1)
    np.testing.assert_array_equal(without, same)
    assert not np.array_equal(without, other)


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1, True, 1.5, "7"])
def test_a_configuration_with_such_a_seed_is_refused_before_anything_is_built(seed: Any) -> None:
    with pytest.raises((LiberoError, ProtocolError), match=rf"seed={seed!r}|integers from 0 to {MAX_SEED}"):
        LiberoConfig(fixtures="upstream", start="raw", seed=seed).rules("libero_goal")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"seed_per_epsode": 1}, "no field 'seed_per_epsode'; it has seed_per_episode"),
        ({"spare_resets": -1}, "spare_resets=-1: expected an integer of at least 0"),
        ({"seed_per_task": 1.0}, "seed_per_task=1.0: expected an integer"),
        ({"fresh": 1}, "fresh=1: expected True or False"),
        ("once", "expected a ResetLoop or a mapping of"),
    ],
)
def test_what_is_no_loop_is_refused(given: Any, message: str) -> None:
    with pytest.raises(ProtocolError, match=message):
        reset_loop(given)
    # `make` checks the types of options first.
    error, expected = (OptionError, 'can not match type "str"') if given == "once" else (ProtocolError, message)
    with pytest.raises(error, match=expected):
        vecenv.make("libero_goal", task=0, episodes=[0], fixtures="upstream", start="raw", reset_loop=given)


def test_a_loop_decides_what_upstream_fixtures_are() -> None:
    problem, scene = scene_of("libero_spatial", 0)
    keys = [(7, "libero_spatial", 0, 2)]
    once = poses(problem, scene, "upstream", keys=keys, slots=[0])
    again = poses(problem, scene, "upstream", keys=keys, slots=[0], loop=ResetLoop(seed_per_episode=1))
    third = list(itertools.islice(Resets(problem, scene, 7), 3))[2]
    first = next(Resets(problem, scene, 9, unseeded=2))
    for got, placed in ((once, third), (again, first)):
        for column, name in enumerate(placements(problem, scene)):
            np.testing.assert_array_equal(got[1][0, column], placed[name][0])
            np.testing.assert_array_equal(got[2][0, column], placed[name][1])


# -- the generator, and what cannot be reset ---------------------------------------------------------------------------


def test_the_global_generator_is_neither_read_nor_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, scene = scene_of("libero_spatial", 4)
    for name in ("seed", "uniform", "randn", "randint", "random", "normal"):
        monkeypatch.setattr(np.random, name, lambda *_, **__: pytest.fail("the global generator was used"))
    next(Resets(problem, scene, 7))


def test_a_reset_without_room_is_given_up_and_the_next_one_goes_on() -> None:
    text = upstream.task_text("libero_tabletop_manipulation")
    crowded = text.replace("bowl_1 - akita_black_bowl", "bowl_1 bowl_2 - akita_black_bowl")
    crowded = crowded.replace("(:init ", "(:init (On bowl_2 main_table_bowl_region) ")
    small = crowded.replace("((-0.05 0.1 0.0 0.2))", "((0.0 0.0 0.01 0.01))")
    problem = parse_problem(small)
    with pytest.raises(ResetError, match="20 resets in a row found no room"):
        next(Resets(problem, compile_scene(problem), 0))


def test_what_stands_on_a_thing_that_is_not_placed_is_refused() -> None:
    text = upstream.task_text("libero_tabletop_manipulation")
    text = text.replace("bowl_1 - akita_black_bowl", "bowl_1 plate_1 - akita_black_bowl")
    problem = parse_problem(text.replace("(On bowl_1 main_table_bowl_region) ", "(On bowl_1 plate_1) "))
    with pytest.raises(ResetError, match="bowl_1 on plate_1, which is not placed"):
        next(Resets(problem, compile_scene(problem), 0))


def test_a_category_without_turns_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, scene = scene_of("libero_spatial", 0)
    monkeypatch.setattr(resets.catalog, "TURNS", {"plate": ()})
    with pytest.raises(ResetError, match="how upstream turns 'akita_black_bowl' is not known; known: plate"):
        Resets(problem, scene, 0)
