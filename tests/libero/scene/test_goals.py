"""Our verdicts are upstream's, predicate by predicate, on both sides of every border."""

from __future__ import annotations

import dataclasses
import functools
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import upstream
from support.goal_states import GoalStates, Simulation

from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import PREDICATE_ARITY, Predicate, Problem, parse_problem
from vecenv.libero.scene.scene import Scene, compile_scene
from vecenv.libero.tasks import fixtures
from vecenv.libero.tasks.suites import TaskSpec


@functools.cache
def scene_of(scene_id: str) -> Scene:
    """The scene with the contact sensors of all its tasks, as an environment compiles it."""
    problems = [task.problem() for task in upstream.tasks_of(scene_id)]
    return compile_scene(problems[0], contact_pairs=goals.contact_pairs(problems), contacts="current")


def distinct_goals(scene_id: str) -> list[TaskSpec]:
    return list({task.problem().goal: task for task in upstream.tasks_of(scene_id)}.values())


def both_sides(scene_id: str, task: TaskSpec, rng: np.random.Generator) -> tuple[Simulation, Any]:
    """Our simulation and upstream's with the task's fixtures in the same, randomly turned, poses."""
    scene, peer = scene_of(scene_id), upstream.peer_of(upstream.tasks_of(scene_id)[0].bddl_path)
    key = (int(rng.integers(1000)), task.suite, task.index, 0)
    bodies, pos, quat = fixtures.poses(task.problem(), scene, "sampled", keys=[key], slots=[0])
    quat = np.array([turned(q, rng.uniform(-0.6, 0.6)) for q in quat[0]]).reshape(-1, 4)
    simulation = Simulation(scene)
    simulation.stand(list(bodies), pos[0], quat)
    upstream.set_fixtures(peer, bodies, pos[0], quat)
    return simulation, peer


def turned(quat: np.ndarray, angle: float) -> np.ndarray:
    """A rotation about z [w, 0, 0, z], turned further."""
    half = np.arctan2(quat[3], quat[0]) + angle / 2
    return np.array([np.cos(half), 0.0, 0.0, np.sin(half)])


def states_around(task: TaskSpec, simulation: Simulation, rng: np.random.Generator, scattered: int) -> list[np.ndarray]:
    nq = simulation.model.nq
    starts = task.init_states()[rng.integers(0, 50, 4), 1 : 1 + nq]
    builder = GoalStates(task.problem(), simulation, starts[0], rng)
    return [*starts, *builder.edges(), *builder.scattered(scattered)]


def ours(problem: Problem, simulation: Simulation, states: list[np.ndarray]) -> np.ndarray:
    """Each predicate in each state, bool [n, P]."""
    table = goals.build_table([problem], simulation.scene, [0] * len(states))
    return goals.predicates(table, **simulation.reads(states))


def theirs(goal: tuple[Predicate, ...], peer: Any, states: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Upstream's verdict on each predicate [n, P] and on the goal [n]."""
    parts, whole = [], []
    for state in states:
        upstream.set_state(peer, state, np.zeros(upstream.model_of(peer).nv))
        parts.append([upstream.verdict(peer, [predicate]) for predicate in goal])
        whole.append(upstream.verdict(peer, goal))
    return np.array(parts), np.array(whole)


def compare(scene_id: str, task: TaskSpec, *, seed: int, scattered: int) -> int:
    """Assert equal verdicts around a task's goal; returns on how many states."""
    rng = np.random.default_rng([seed, task.index])
    simulation, peer = both_sides(scene_id, task, rng)
    states = states_around(task, simulation, rng, scattered)
    problem = task.problem()
    mine = ours(problem, simulation, states)
    parts, whole = theirs(problem.goal, peer, states)
    np.testing.assert_array_equal(mine, parts, err_msg=f"{task.suite} {task.index} {problem.goal}")
    np.testing.assert_array_equal(mine.all(axis=1), whole)
    assert parts.any(axis=0).all(), "a predicate never held"
    assert not parts.all(axis=0).any(), "a predicate always held"
    assert whole.any()
    return len(states)


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_verdicts_are_upstreams_around_every_goal(scene_id: str) -> None:
    """Every distinct goal of the 130 tasks, in every scene."""
    for task in distinct_goals(scene_id):
        assert compare(scene_id, task, seed=0, scattered=4) > 30


def test_every_predicate_kind_of_the_suites_is_among_those_compared() -> None:
    used = {p.name for tasks in upstream.scene_tasks().values() for task in tasks for p in task.problem().goal}
    assert used == {"in", "on", "open", "close", "turnon", "turnoff"}


@pytest.mark.heavy
def test_verdicts_are_upstreams_on_20000_states() -> None:
    """All 130 tasks, at least 160 states each."""
    for scene_id in upstream.scene_ids():
        for task in upstream.tasks_of(scene_id):
            count, seed = 0, 1
            while count < 160:
                count += compare(scene_id, task, seed=seed, scattered=40)
                seed += 1


@pytest.mark.parametrize(
    "scene_id", ["libero_object-0", "libero_spatial-0", "libero_10-2", "libero_10-8", "libero_90-28"]
)
def test_jax_gives_numpys_verdicts_under_jit(scene_id: str) -> None:
    task = max(distinct_goals(scene_id), key=lambda task: len(task.problem().goal))
    simulation, _ = both_sides(scene_id, task, np.random.default_rng(0))
    states = states_around(task, simulation, np.random.default_rng(0), 4)
    table = goals.build_table([task.problem()], simulation.scene, [0] * len(states))
    reads = simulation.reads(states)
    expected = goals.evaluate(table, **reads)
    with jax.enable_x64(True):
        verdicts = jax.jit(functools.partial(goals.evaluate, xp=jnp))(
            jax.tree.map(jnp.asarray, table), **jax.tree.map(jnp.asarray, reads)
        )
        np.testing.assert_array_equal(np.asarray(verdicts), expected)
    assert 0 < expected.sum() < len(states)


# -- contacts ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scene_id", ["libero_object-0", "libero_spatial-0", "libero_goal-0", "libero_10-9", "libero_90-6"]
)
def test_contact_sensors_see_what_upstreams_contact_test_sees(scene_id: str) -> None:
    """Every pair of things, in stored starts and with everything thrown together."""
    task = upstream.tasks_of(scene_id)[0]
    names = list(scene_of(scene_id).entities)
    pairs = [(a, b) for i, a in enumerate(names) for b in names[:i]]
    simulation = Simulation(compile_scene(task.problem(), contact_pairs=pairs, contacts="current"))
    peer = upstream.peer_of(task.bddl_path)
    bodies, pos, quat = fixtures.poses(task.problem(), simulation.scene, "center", keys=[(0, "", 0, 0)], slots=[0])
    simulation.stand(list(bodies), pos[0], quat[0])
    upstream.set_fixtures(peer, bodies, pos[0], quat[0])
    seen, apart = [], 0
    for state in crowded(task, simulation, count=25):
        simulation.load(state)
        apart += int((simulation.data.contact.dist > 0).sum())
        upstream.set_state(peer, state, np.zeros(simulation.model.nv))
        for first, second in pairs:
            counted = simulation.data.sensordata[sensor(simulation, first, second)] > 0
            touching = peer.env.check_contact(peer.env.get_object(first), peer.env.get_object(second))
            assert counted == touching, (first, second)
            seen.append(counted)
    assert 0 < sum(seen) < len(seen)
    assert (apart > 0) == ("microwave_1" in names), "only microwaves have a margin, whose contacts begin apart"


def crowded(task: TaskSpec, simulation: Simulation, count: int) -> list[np.ndarray]:
    """Start states with every object moved towards one thing of the scene."""
    rng, model = np.random.default_rng(0), simulation.model
    states = list(task.init_states()[:5, 1 : 1 + model.nq])
    for _ in range(count):
        state = states[int(rng.integers(5))].copy()
        simulation.load(state)
        centre = simulation.data.xpos[model.body(rng.choice(list(simulation.scene.entities)) + "_main").id]
        for entity in simulation.scene.objects:
            address = int(model.joint(entity.joints[-1]).qposadr[0])
            state[address : address + 3] = centre + rng.normal(scale=0.12, size=3)
        states.append(state)
    return states


def sensor(simulation: Simulation, first: str, second: str) -> int:
    row = goals.build_table([on(simulation.scene, first, second)], simulation.scene, [0])
    return int(row.touch[0, 0])


def on(scene: Scene, first: str, second: str) -> Problem:
    return with_goal(PLAIN, Predicate("on", (first, second)))


def with_goal(problem: Problem, *predicates: Predicate) -> Problem:
    return dataclasses.replace(problem, goal=predicates)


PLAIN = upstream.tasks_of("libero_90-6")[0].problem()


@pytest.mark.parametrize(
    ("scene_id", "name", "target"),
    [
        ("libero_90-35", "white_bowl_1", "microwave_1"),
        ("libero_10-2", "moka_pot_1", "flat_stove_1_cook_region"),
        ("libero_goal-0", "akita_black_bowl_1", "wooden_cabinet_1_top_side"),
    ],
)
def test_resting_on_a_fixture_counts_and_a_millimetre_above_does_not(scene_id: str, name: str, target: str) -> None:
    """Microwaves have a contact margin of 1 mm, so there contact begins before anything touches."""
    task, fixture = upstream.tasks_of(scene_id)[0], target.split("_1")[0] + "_1"
    problem = with_goal(task.problem(), Predicate("on", (name, target)))
    simulation = Simulation(compile_scene(problem, contact_pairs=goals.contact_pairs([problem]), contacts="current"))
    peer = upstream.peer_of(upstream.tasks_of(scene_id)[0].bddl_path)
    bodies, pos, quat = fixtures.poses(problem, simulation.scene, "center", keys=[(0, "", 0, 0)], slots=[0])
    simulation.stand(list(bodies), pos[0], quat[0])
    upstream.set_fixtures(peer, bodies, pos[0], quat[0])
    start = task.init_states()[0, 1 : 1 + simulation.model.nq]
    resting = GoalStates(problem, simulation, start, np.random.default_rng(0)).solve()
    address = int(simulation.model.joint(simulation.scene.entities[name].joints[-1]).qposadr[0])
    lifted = [resting.copy() for _ in range(4)]
    for state, height in zip(lifted, (0.0, 1e-6, 1e-4, 1e-3), strict=True):
        state[address + 2] += height
    mine = ours(problem, simulation, lifted)[:, 0]
    np.testing.assert_array_equal(mine, theirs(problem.goal, peer, lifted)[1])
    assert list(mine) == [True, False, False, False]
    simulation.load(resting)
    margin = max(contact.dist for contact in contacts_with(simulation, fixture, name))
    assert (margin > 5e-4) == (fixture == "microwave_1")


def contacts_with(simulation: Simulation, first: str, second: str) -> list[Any]:
    geoms = [set(simulation.scene.entities[name].contact_geoms) for name in (first, second)]
    pairs = [
        ({simulation.model.geom(g).name for g in contact.geom}, contact)
        for contact in simulation.data.contact[: simulation.data.ncon]
    ]
    return [contact for pair, contact in pairs if pair & geoms[0] and pair & geoms[1]]


# -- predicates that no suite uses -------------------------------------------------------------------------------------


def verdicts_on(goal: tuple[Predicate, ...], heights: tuple[float, ...]) -> tuple[list[bool], list[bool]]:
    """Ours and upstream's on a goal with the first object at some heights."""
    task = upstream.tasks_of("libero_90-6")[0]
    problem = with_goal(task.problem(), *goal)
    simulation = Simulation(compile_scene(problem, contact_pairs=goals.contact_pairs([problem]), contacts="current"))
    states = []
    for height in heights:
        state = task.init_states()[0, 1 : 1 + simulation.model.nq].copy()
        joint = simulation.scene.objects[0].joints[-1]
        state[int(simulation.model.joint(joint).qposadr[0]) + 2] = height
        states.append(state)
    whole = theirs(goal, upstream.peer_of(task.bddl_path), states)[1]
    return [bool(row.all()) for row in ours(problem, simulation, states)], [bool(row) for row in whole]


@pytest.mark.parametrize("name", ["open", "close"])
def test_a_cabinet_is_open_by_one_drawer_and_closed_by_all(name: str) -> None:
    """The suites only ask for single drawers."""
    task = upstream.tasks_of("libero_90-6")[0]
    problem = with_goal(task.problem(), Predicate(name, ("wooden_cabinet_1",)))
    simulation, peer = both_sides("libero_90-6", task, np.random.default_rng(0))
    start = task.init_states()[0, 1 : 1 + simulation.model.nq]
    states = GoalStates(problem, simulation, start, np.random.default_rng(0)).edges()
    mine = ours(problem, simulation, states)[:, 0]
    np.testing.assert_array_equal(mine, theirs(problem.goal, peer, states)[1])
    assert 0 < mine.sum() < len(states)


def test_up_means_a_metre_above_the_world() -> None:
    name = PLAIN.objects[0].name
    mine, expected = verdicts_on((Predicate("up", (name,)),), (0.5, 1 - 1e-7, 1.0, 1 + 1e-7))
    assert mine == expected == [False, False, True, True]


@pytest.mark.parametrize(("region", "expected"), [("bottom_region", False), ("top_side", True)])
def test_up_also_asks_about_regions(region: str, expected: bool) -> None:
    """The cabinet stands at 0.9 m: its bottom drawer is below a metre, its top above."""
    task = upstream.tasks_of("libero_90-6")[0]
    problem = with_goal(task.problem(), Predicate("up", (f"wooden_cabinet_1_{region}",)))
    simulation, peer = both_sides("libero_90-6", task, np.random.default_rng(0))
    start = task.init_states()[0, 1 : 1 + simulation.model.nq]
    assert ours(problem, simulation, [start]).tolist() == [[expected]]
    assert theirs(problem.goal, peer, [start])[1].tolist() == [expected]


@pytest.mark.parametrize(("predicate", "expected"), [("true", True), ("false", False), ("printjointstate", True)])
def test_constant_predicates(predicate: str, expected: bool) -> None:
    assert verdicts_on((Predicate(predicate, ("wooden_cabinet_1",)),), (0.9,)) == ([expected], [expected])


def test_true_and_false_also_take_two_arguments() -> None:
    names = PLAIN.objects[0].name, PLAIN.objects[1].name
    both = (Predicate("true", names), Predicate("false", names))
    assert verdicts_on(both[:1], (0.9,)) == ([True], [True])
    assert verdicts_on(both, (0.9,)) == ([False], [False])


def test_every_predicate_that_upstream_registers_is_known() -> None:
    upstream.peer_of(upstream.tasks_of("libero_90-6")[0].bddl_path)
    from libero.libero.envs.predicates import get_predicate_fn_dict

    assert set(get_predicate_fn_dict()) == set(PREDICATE_ARITY)
    for name in PREDICATE_ARITY:
        assert "is not a LIBERO predicate" not in refusal(Predicate(name, ()))
    assert "is not a LIBERO predicate" in refusal(Predicate("incontact", ()))


def refusal(predicate: Predicate) -> str:
    """Why a goal is refused, empty when it is not."""
    try:
        goals.build_table([with_goal(PLAIN, predicate)], scene_of("libero_90-6"), [0])
    except goals.GoalError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("predicate", "message"),
    [
        (Predicate("in", ("{object}", "{other}")), "needs a region"),
        (Predicate("turnon", ("{region}",)), "for fixtures, not for their regions"),
        (Predicate("open", ("{object}",)), "not defined for a"),
        (Predicate("turnoff", ("microwave_1",)), "not defined for a microwave"),
        (Predicate("on", ("{object}", "{other}")), "compile the scene with that pair"),
        (Predicate("on", ("{object}", "nowhere")), "'nowhere'"),
        (Predicate("in", ("nobody", "{region}")), "'nobody'"),
        (Predicate("up", ("nothing",)), "no object or fixture"),
        (Predicate("on", ("{object}",)), r"takes 2 argument\(s\), got 1"),
        (Predicate("melt", ("{object}",)), "not a LIBERO predicate"),
    ],
)
def test_a_goal_without_meaning_is_refused_by_name(predicate: Predicate, message: str) -> None:
    task = upstream.tasks_of("libero_90-40")[0] if "microwave_1" not in predicate.args else microwave_task()
    problem = task.problem()
    scene = compile_scene(problem)
    names = {"object": problem.objects[0].name, "other": problem.objects[-1].name}
    names["region"] = next(region.name for region in scene.regions.values() if region.parent)
    args = tuple(arg.format(**names) for arg in predicate.args)
    text = re.escape(f"({predicate.name} {' '.join(args)})")
    with pytest.raises(goals.GoalError, match=f"{re.escape(task.bddl_path.name)}: goal {text}.*{message}"):
        goals.build_table([with_goal(problem, Predicate(predicate.name, args))], scene, [0])


def test_a_movable_microwave_is_neither_open_nor_closed() -> None:
    """Its free joint would take part; upstream fails on it too."""
    problem = parse_problem(upstream.task_text("libero_floor_manipulation", category="microwave"))
    goal = with_goal(problem, Predicate("open", ("bowl_1",)))
    with pytest.raises(goals.GoalError, match=r"\(open bowl_1\) .*not for movable objects"):
        goals.build_table([goal], compile_scene(problem), [0])


def microwave_task() -> TaskSpec:
    return next(
        task
        for tasks in upstream.scene_tasks().values()
        for task in tasks
        if upstream.contains(task.problem(), "microwave_1")
    )


# -- tables ------------------------------------------------------------------------------------------------------------


def test_slots_of_one_table_keep_their_own_goals() -> None:
    """Goals of different length and kind side by side, in any order, give what each gives alone."""
    tasks = distinct_goals("libero_10-2")
    problems = [task.problem() for task in tasks]
    assert len({len(problem.goal) for problem in problems}) > 1
    simulation, _ = both_sides("libero_10-2", tasks[0], np.random.default_rng(0))
    states = [s for task in tasks for s in states_around(task, simulation, np.random.default_rng(1), 2)]
    slots = np.random.default_rng(2).integers(0, len(problems), len(states))
    reads = simulation.reads(states)
    together = goals.evaluate(goals.build_table(problems, simulation.scene, list(slots)), **reads)
    alone = np.stack([ours(problem, simulation, states).all(axis=1) for problem in problems])
    np.testing.assert_array_equal(together, alone[slots, np.arange(len(states))])
    assert 0 < together.sum() < len(states)


def test_a_state_that_is_not_finite_is_no_success() -> None:
    task = upstream.tasks_of("libero_object-0")[0]
    simulation, _ = both_sides("libero_object-0", task, np.random.default_rng(0))
    solved = GoalStates(
        task.problem(), simulation, task.init_states()[0, 1 : 1 + simulation.model.nq], np.random.default_rng(0)
    ).solve()
    table = goals.build_table([task.problem()], simulation.scene, [0])
    reads = simulation.reads([solved])
    assert goals.evaluate(table, **reads)[0]
    assert not goals.evaluate(table, **{name: np.full_like(value, np.nan) for name, value in reads.items()})[0]


def test_only_contacts_between_things_are_asked_for() -> None:
    """Zones on the table have no contacts; a region stands for the thing it belongs to; pairs come once."""
    problem = upstream.tasks_of("libero_90-40")[0].problem()
    first, second = problem.objects[0].name, problem.objects[1].name
    region = next(r for r in problem.regions if r.target in {f.name for f in problem.fixtures} - {workspace(problem)})
    zone = next(r for r in problem.regions if r.target == workspace(problem))
    goal = (
        Predicate("on", (second, first)),
        Predicate("on", (first, second)),
        Predicate("on", (first, region.name)),
        Predicate("on", (first, zone.name)),
        Predicate("in", (second, region.name)),
    )
    expected = {tuple(sorted((first, second))), tuple(sorted((first, region.target)))}
    assert goals.contact_pairs([with_goal(problem, *goal)] * 2) == tuple(sorted(expected))


def workspace(problem: Problem) -> str:
    return next(f.name for f in problem.fixtures if f.category.endswith("table") or f.category == "floor")


def test_a_problem_of_an_unknown_class_asks_for_no_contacts_of_its_workspace() -> None:
    """The scene compiler is the one to refuse it."""
    assert goals.contact_pairs([dataclasses.replace(PLAIN, name="libero_moon_manipulation")]) == ()
