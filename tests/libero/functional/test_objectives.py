"""Objectives judge as the package does elsewhere, and their potentials rise towards success."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from vecenv.libero.functional.objectives import Objective, ObjectiveError, View, body_box, default_target
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks.sources import installed_tasks

pytestmark = pytest.mark.usefixtures("no_rank_promotion")
compiled = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
SOUP = "alphabet_soup_1"
OPEN = np.array([1.0, -1.0])


@cache
def task(suite: str = "libero_object", index: int = 0) -> tuple[Scene, Problem]:
    source = installed_tasks(suite)[index]
    problem = source.problem()
    return source.scene(goals.contact_pairs([problem])), problem


def start(suite: str = "libero_object", index: int = 0) -> mujoco.MjData:
    scene, _ = task(suite, index)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = installed_tasks(suite)[index].settled().qpos[0]
    mujoco.mj_forward(scene.model, data)
    return data


def view(data: mujoco.MjData, gripper: np.ndarray = OPEN, start_height: float = 0.0) -> View:
    arrays = (data.qpos, data.xpos, data.xquat, data.site_xpos, data.site_xmat.reshape(-1, 3, 3), data.sensordata)
    return View(*(jnp.asarray(array) for array in (*arrays, gripper, start_height)))


def potential(objective: Objective, seen: View) -> float:
    return float(compiled(objective.potential)(seen))


def success(objective: Objective, seen: View) -> bool:
    return bool(compiled(objective.success)(seen))


def put_soup(data: mujoco.MjData, pos: np.ndarray) -> None:
    model = task()[0].model
    at = model.joint(f"{SOUP}_joint0").qposadr[0]
    data.qpos[at : at + 3] = pos
    mujoco.mj_forward(model, data)


def soup(data: mujoco.MjData) -> np.ndarray:
    return data.body(task()[0].entities[SOUP].root_body).xpos.copy()


def test_the_box_of_a_thing_encloses_its_collision_geometry() -> None:
    model = task()[0].model
    box = body_box(model, model.body(task()[0].entities[SOUP].root_body).id)
    geom = next(g for g in range(model.ngeom) if model.geom_bodyid[g] == box.body and model.geom_contype[g])
    assert (np.abs(model.geom_pos[geom] - box.centre) <= box.half).all()
    np.testing.assert_allclose(np.sort(box.half), [0.0312, 0.0312, 0.0381], atol=5e-4)


def test_reach_succeeds_within_its_distance_of_the_box() -> None:
    scene, problem = task()
    reach = Objective(scene, problem, "reach", reach_distance=0.02)
    data, grip = start(), scene.grip_site
    potentials = []
    for height, expected in ((0.2, False), (0.1, False), (0.06, False), (0.05, True), (0.0, True)):
        put_soup(data, data.site_xpos[grip] - [0, 0, height])
        potentials.append(float(reach.potential(view(data))))
        assert bool(reach.success(view(data))) is expected, height
    assert potentials == sorted(potentials)
    assert potentials[-1] == pytest.approx(1.0)


def test_lift_succeeds_at_its_height_above_the_start() -> None:
    scene, problem = task()
    lift = Objective(scene, problem, "lift", lift_height=0.05)
    data = start()
    pos = soup(data)
    for gained, expected in ((0.0, False), (0.049, False), (0.051, True)):
        put_soup(data, pos + [0, 0, gained])
        assert bool(lift.success(view(data, start_height=pos[2]))) is expected, gained


def test_lifting_pays_for_nearing_closing_and_raising() -> None:
    scene, problem = task()
    lift = Objective(scene, problem, "lift")
    data, grip = start(), scene.grip_site
    pos = soup(data)
    far = lift.potential(view(data, start_height=pos[2]))
    put_soup(data, data.site_xpos[grip].copy())
    height = soup(data)[2]
    near = lift.potential(view(data, start_height=height))
    closed = lift.potential(view(data, -OPEN, start_height=height))
    raised = lift.potential(view(data, -OPEN, start_height=height - 0.05))
    assert far < near < closed < raised <= 1


@pytest.mark.parametrize(("suite", "index"), [("libero_object", 0), ("libero_goal", 0), ("libero_10", 2)])
def test_the_goal_is_judged_as_elsewhere_and_unfinished_goals_are_worth_less_than_one(suite: str, index: int) -> None:
    scene, problem = task(suite, index)
    goal = Objective(scene, problem, "goal")
    data = start(suite, index)
    table = goals.build_table([problem], scene, [0])
    reads = {"xpos": data.xpos, "site_xpos": data.site_xpos, "site_xmat": data.site_xmat, "qpos": data.qpos}
    held = goals.evaluate(table, **{k: v[None] for k, v in reads.items()}, touch=data.sensordata[None])[0]
    assert success(goal, view(data)) is bool(held) is False
    assert 0 < potential(goal, view(data)) < 0.9


def test_the_goal_is_reached_with_the_soup_in_the_basket() -> None:
    scene, problem = task()
    goal = Objective(scene, problem, "goal")
    data = start()
    before = potential(goal, view(data))
    basket = data.site("basket_1_contain_region").xpos
    put_soup(data, 0.5 * (soup(data) + basket))
    assert potential(goal, view(data)) > before
    put_soup(data, basket.copy())
    assert success(goal, view(data))
    assert potential(goal, view(data)) == pytest.approx(1.0)


def test_carrying_to_a_place_pays_for_every_stage() -> None:
    scene, problem = task()
    goal = Objective(scene, problem, "goal")
    data, grip = start(), scene.grip_site
    pos, basket = soup(data), data.site("basket_1_contain_region").xpos.copy()
    hand = data.site_xpos[grip].copy()
    potentials = {}

    def at(stage: str, place: np.ndarray, gripper: np.ndarray = OPEN, held: bool = False) -> None:
        put_soup(data, place)
        if held:
            data.site_xpos[grip] = place
        potentials[stage] = potential(goal, view(data, gripper))
        data.site_xpos[grip] = hand

    at("hand away", pos)
    at("hand at it", pos, held=True)
    at("closed", pos, -OPEN, held=True)
    at("raised", pos + [0, 0, 0.05], -OPEN, held=True)
    at("above the rim", pos + [0, 0, 0.25], -OPEN, held=True)
    at("above the basket", basket + [0, 0, 0.2], -OPEN, held=True)
    at("lowered", basket + [0, 0, 0.1], -OPEN, held=True)
    assert list(potentials.values()) == sorted(set(potentials.values())), potentials
    # Letting go there pays as well: what remains is to fall.
    at("let go", basket + [0, 0, 0.1], OPEN)
    assert potentials["let go"] > potentials["lowered"]
    # Nor does it pay to push the thing against the basket on the ground.
    at("pushed", np.array([*(basket[:2] + 0.6 * (pos - basket)[:2]), pos[2]]), held=True)
    assert potentials["pushed"] < potentials["raised"]
    assert max(potentials.values()) < 1


def test_opening_a_drawer_counts_by_how_far_it_is_open() -> None:
    scene, problem = task("libero_goal", 0)
    assert problem.goal[0].name == "open"
    goal = Objective(scene, problem, "goal")
    data = start("libero_goal", 0)
    table = goals.build_table([problem], scene, [0])
    potentials = []
    for opened in (0.0, 0.05, 0.1, 0.15):
        data.qpos[table.joint[0, 0, 0]] = -opened
        mujoco.mj_forward(scene.model, data)
        potentials.append(potential(goal, view(data)))
    assert potentials == sorted(potentials)
    assert success(goal, view(data))


def test_potentials_have_finite_gradients_where_distances_vanish() -> None:
    scene, problem = task()
    data = start()
    put_soup(data, data.site_xpos[scene.grip_site].copy())
    for kind in ("reach", "lift", "goal"):
        objective = Objective(scene, problem, kind)
        gradient = compiled(jax.grad(objective.potential))(view(data))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient)), kind


def test_the_target_is_the_first_object_the_task_is_about() -> None:
    assert default_target(*task(), movable=True) == SOUP
    assert default_target(*task("libero_goal", 0), movable=False) == "wooden_cabinet_1"


def test_targets_that_do_not_fit_are_refused() -> None:
    scene, problem = task("libero_goal", 0)
    with pytest.raises(ObjectiveError, match="no movable object"):
        Objective(scene, problem, "lift")
    with pytest.raises(ObjectiveError, match="fixed to the world"):
        Objective(scene, problem, "lift", target="wooden_cabinet_1")
    with pytest.raises(ObjectiveError, match="this scene has"):
        Objective(scene, problem, "reach", target="teapot_1")
    with pytest.raises(ObjectiveError, match="goal, reach, lift"):
        Objective(scene, problem, "push")
