"""Lean scenes differ from exact ones in their collision geoms only: few, and shaped like what they replace."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import pytest
from support import upstream

from vecenv import make
from vecenv.libero.env import LiberoEnv
from vecenv.libero.scene import goals
from vecenv.libero.scene.lean import detail, fits, geometry, recipes
from vecenv.libero.scene.lean import solids as shapes
from vecenv.libero.scene.lean.solids import Solid
from vecenv.libero.scene.scene import Entity, Scene, SceneError, SceneSource, contact_sensor_name, scene_source
from vecenv.libero.tasks import settled

PLANE, CAPSULE, BOX = (
    int(mujoco.mjtGeom.mjGEOM_PLANE),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE),
    int(mujoco.mjtGeom.mjGEOM_BOX),
)
# What describes geoms or counts them; everything else in a model must not change. `dof_length` is the size of what
# turns with a joint, read off its geoms; only MuJoCo's sleeping, which is off, uses it.
MADE_ANEW = ("_", "geom_", "mesh_", "bvh_", "name_", "names_", "nmesh")
COUNTED = {"ngeom", "nbvh", "nbvhstatic", "nnames", "nnames_map", "npaths", "npolygonmax", "nbuffer", "signature"}
OF_GEOMS = {
    "body_geomadr",
    "body_geomnum",
    "body_bvhadr",
    "body_bvhnum",
    "body_contype",
    "body_conaffinity",
    "dof_length",
}
DRAWERS = {f"{what}:{drawer}_region" for what in ("filled", "worked") for drawer in ("top", "middle", "bottom")}
ALL_OF_IT = frozenset({"held", "bears", "worked:", *DRAWERS})


@functools.cache
def source_of(scene_id: str) -> SceneSource:
    problems = [task.problem() for task in upstream.tasks_of(scene_id)]
    return scene_source(problems[0], contact_pairs=goals.contact_pairs(problems))


@functools.cache
def exact_of(scene_id: str) -> Scene:
    return source_of(scene_id).compile()


def asked_of(scene_id: str) -> geometry.Demands:
    return geometry.demands(task.problem() for task in upstream.tasks_of(scene_id))


@functools.cache
def lean_of(scene_id: str) -> Scene:
    return geometry.lean_scene(source_of(scene_id), asked_of(scene_id), exact_of(scene_id))


@functools.cache
def categories() -> dict[str, tuple[str, str]]:
    """A scene and an entity of each category of the 130 tasks."""
    found: dict[str, tuple[str, str]] = {}
    for scene_id in upstream.scene_ids():
        for entity in exact_of(scene_id).entities.values():
            found.setdefault(entity.category, (scene_id, entity.name))
    return found


def colliding(model: mujoco.MjModel) -> list[int]:
    return [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]


def in_root_frame(scene: Scene, name: str, body: int, solid: Solid) -> Solid:
    """A solid of one of a thing's bodies in the frame of its root body, joints at their reference."""
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    root = scene.model.body(scene.entities[name].root_body).id
    frame = data.xmat[root].reshape(3, 3)
    turn = frame.T @ data.xmat[body].reshape(3, 3)
    pos = frame.T @ (data.xpos[body] - data.xpos[root]) + turn @ solid.pos
    return Solid(solid.kind, pos, turn @ solid.mat, solid.size)


def solids_of(scene: Scene, entity: Entity) -> list[Solid]:
    """A thing's collision geoms in the frame of its root body."""
    model = scene.model
    return [
        in_root_frame(scene, entity.name, int(model.geom_bodyid[geom]), geometry.solid_of(model, geom))
        for geom in geometry.entity_geoms(model, entity)
    ]


def fitted(category: str, asked: frozenset[str], *, finest: bool = False) -> tuple[list[Solid], list[Solid]]:
    """Exact and lean solids of a category, at the level that is needed or at the finest, root frame."""
    scene_id, name = categories()[category]
    scene = exact_of(scene_id)
    exact = solids_of(scene, scene.entities[name])
    modules = recipes.recipe(category, len(exact)).modules(asked)
    parts = [part for module in modules for part in module.levels[-1 if finest else module.wanted]]
    lean = []
    for part in parts:
        made = geometry.fit_part(scene, name, part)
        lean += [in_root_frame(scene, name, made.body, solid) for solid in made.solids]
    return exact, lean


MOVABLE = sorted(
    {
        *("akita_black_bowl", "alphabet_soup", "basket", "bbq_sauce", "black_book", "butter", "chefmate_8_frypan"),
        *(
            "chocolate_pudding",
            "cookies",
            "cream_cheese",
            "glazed_rim_porcelain_ramekin",
            "ketchup",
            "milk",
            "moka_pot",
        ),
        *("new_salad_dressing", "orange_juice", "plate", "porcelain_mug", "red_coffee_mug", "salad_dressing"),
        *("tomato_sauce", "white_bowl", "white_yellow_mug", "wine_bottle", "wooden_tray", "yellow_book"),
    }
)
FIXTURES = (
    "desk_caddy",
    "flat_stove",
    "microwave",
    "white_cabinet",
    "wine_rack",
    "wooden_cabinet",
    "wooden_two_layer_shelf",
)
Y_UP = {
    "alphabet_soup",
    "ketchup",
    "milk",
    "new_salad_dressing",
    "orange_juice",
    "salad_dressing",
    "tomato_sauce",
}


def test_the_lists_above_are_all_the_categories() -> None:
    assert sorted(categories()) == sorted([*MOVABLE, *FIXTURES])


# -- whole scenes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_a_scene_has_at_most_24_collision_geoms_of_kinds_that_mjx_has_pairs_for(scene_id: str) -> None:
    model = lean_of(scene_id).model
    geoms = colliding(model)
    assert len(geoms) <= geometry.MAX_GEOMS < len(colliding(exact_of(scene_id).model))
    assert {int(model.geom_type[g]) for g in geoms} <= {PLANE, CAPSULE, BOX}
    assert model.nmesh == 0


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_everything_but_the_collision_geoms_is_the_same_bit_for_bit(scene_id: str) -> None:
    exact, lean = exact_of(scene_id).model, lean_of(scene_id).model
    compared = 0
    for field in dir(exact):
        value = getattr(exact, field)
        if not isinstance(value, np.ndarray | int) or field.startswith(MADE_ANEW) or field in COUNTED | OF_GEOMS:
            continue
        np.testing.assert_array_equal(getattr(lean, field), value, err_msg=field)
        compared += 1
    assert compared > 200
    for kind, number in (("body", exact.nbody), ("joint", exact.njnt), ("site", exact.nsite), ("actuator", exact.nu)):
        names = [[getattr(model, kind)(i).name for i in range(number)] for model in (exact, lean)]
        assert names[0] == names[1]
    for part in ("timestep", "impratio", "iterations", "cone", "solver", "density", "viscosity"):
        assert getattr(exact.opt, part) == getattr(lean.opt, part)


def may_collide(model: mujoco.MjModel, first: int, second: int) -> bool:
    match = model.geom_contype[first] & model.geom_conaffinity[second]
    match |= model.geom_contype[second] & model.geom_conaffinity[first]
    return bool(match) and model.body_weldid[model.geom_bodyid[first]] != model.body_weldid[model.geom_bodyid[second]]


def kind_of(scene: Scene, geom: int) -> str:
    model = scene.model
    body = model.body(model.geom_bodyid[geom]).name
    if body.startswith("gripper0_"):
        return "pad" if body.endswith("_tip") else "hand"
    if body.startswith("robot0_"):
        return "arm"
    movable = {model.body(entity.root_body).id for entity in scene.objects}
    return "object" if model.body_rootid[model.geom_bodyid[geom]] in movable else "scenery"


@pytest.mark.parametrize("scene_id", ["libero_goal-0", "libero_10-9", "libero_object-0"])
def test_only_pairs_that_can_matter_collide(scene_id: str) -> None:
    scene = lean_of(scene_id)
    geoms = colliding(scene.model)
    met = {
        frozenset((kind_of(scene, a), kind_of(scene, b)))
        for i, a in enumerate(geoms)
        for b in geoms[:i]
        if may_collide(scene.model, a, b)
    }
    always = {("object",), ("object", "scenery"), ("object", "hand"), ("object", "pad"), ("hand", "scenery"), ("pad",)}
    assert {frozenset(pair) for pair in always} <= met
    assert met <= {frozenset(pair) for pair in {*always, ("arm", "scenery"), ("pad", "scenery"), ("scenery",)}}


def test_a_drawer_comes_to_rest_where_the_frame_stops_it_in_the_exact_scene() -> None:
    rest = []
    for scene in (exact_of("libero_spatial-0"), lean_of("libero_spatial-0")):
        model = scene.model
        free = model.body("wooden_cabinet_1_main").id
        before = model.body_pos[free].copy()
        model.body_pos[free] = (3.0, 3.0, 2.0)
        data, joint = mujoco.MjData(model), model.joint("wooden_cabinet_1_top_level")
        data.qpos[joint.qposadr[0]] = -0.02
        for _ in range(700):
            data.qfrc_applied[joint.dofadr[0]] = 10.0
            mujoco.mj_step(model, data)
        rest.append(float(data.qpos[joint.qposadr[0]]))
        model.body_pos[free] = before
    assert rest[0] < 0.005 < model.joint("wooden_cabinet_1_top_level").range[1]
    assert rest[1] == pytest.approx(rest[0], abs=2e-4)


def test_the_table_is_the_plane_of_its_top() -> None:
    for scene_id in ("libero_goal-0", "libero_10-0", "libero_90-77", "libero_object-0"):
        heights = []
        for scene in (exact_of(scene_id), lean_of(scene_id)):
            data = mujoco.MjData(scene.model)
            mujoco.mj_kinematics(scene.model, data)
            mujoco.mj_comPos(scene.model, data)
            hit = np.zeros(1, np.int32)
            start = np.array([0.45, -0.35, 3.0]) if "90-" not in scene_id else np.array([-0.45, -0.6, 3.0])
            flags = np.array([1, 0, 0, 0, 0, 0], np.uint8)
            down = mujoco.mj_ray(scene.model, data, start, np.array([0.0, 0.0, -1.0]), flags, 1, -1, hit)
            heights.append(3.0 - down if scene_id != "libero_object-0" else 0.0)
        assert heights[0] == pytest.approx(heights[1], abs=1e-9)


def test_contact_sensors_see_what_they_saw() -> None:
    task = upstream.tasks_of("libero_spatial-0")[3]
    pair = ("akita_black_bowl_1", "cookies_1")
    source = scene_source(task.problem(), contact_pairs=[pair])
    scene = geometry.lean_scene(source, asked_of("libero_spatial-0"))
    data = mujoco.MjData(scene.model)
    data.qpos[:] = settled.load(task).qpos[0]
    mujoco.mj_forward(scene.model, data)
    assert data.sensor(contact_sensor_name(*pair)).data[0] > 0
    data.qpos[scene.model.joint("akita_black_bowl_1_joint0").qposadr[0] + 2] += 0.05
    mujoco.mj_forward(scene.model, data)
    assert data.sensor(contact_sensor_name(*pair)).data[0] == 0


def test_a_lean_scene_is_a_pure_function_of_source_and_demands() -> None:
    scene_id = "libero_goal-0"
    again = geometry.lean_scene(source_of(scene_id), asked_of(scene_id))
    buffers = []
    for model in (lean_of(scene_id).model, again.model):
        buffers.append(np.zeros(mujoco.mj_sizeModel(model), np.uint8))
        mujoco.mj_saveModel(model, None, buffers[-1])
    np.testing.assert_array_equal(buffers[0], buffers[1])
    assert geometry.lean_key(asked_of(scene_id)) == geometry.lean_key(
        dict(sorted(asked_of(scene_id).items(), reverse=True))
    )
    assert geometry.lean_key(asked_of(scene_id)) != geometry.lean_key({"plate_1": frozenset({"held"})})


def test_contact_parameters_are_those_of_what_is_replaced() -> None:
    for scene_id in ("libero_goal-0", "libero_10-9"):
        exact, lean = exact_of(scene_id), lean_of(scene_id)
        for name in lean.entities:
            old, new = (
                [
                    tuple(np.concatenate([m.geom_friction[g], m.geom_solref[g], m.geom_solimp[g], [m.geom_margin[g]]]))
                    for g in geometry.entity_geoms(m, s.entities[name])
                ]
                for s, m in ((exact, exact.model), (lean, lean.model))
            )
            assert set(new) <= set(old)


def test_lean_things_name_their_contact_geoms() -> None:
    scene = lean_of("libero_goal-0")
    for entity in scene.entities.values():
        named = [scene.model.geom(name).id for name in entity.contact_geoms]
        assert sorted(named) == geometry.entity_geoms(scene.model, entity)


# -- what tasks ask, and what it buys ----------------------------------------------------------------------------------


def test_demands_say_what_tasks_do_with_things() -> None:
    asked = asked_of("libero_goal-0")
    assert asked["wine_bottle_1"] == {"held"}
    assert asked["akita_black_bowl_1"] == {"held", "bears"}
    assert asked["flat_stove_1"] == {"bears", "worked:"}
    assert asked["wooden_cabinet_1"] == {
        *("bears", "filled:top_region", "worked:top_region", "worked:middle_region"),
    }
    spatial = asked_of("libero_spatial-0")
    assert spatial["wooden_cabinet_1"] >= {"filled:top_region", "open:top_region"}
    assert "akita_black_bowl_2" not in spatial
    assert asked_of("libero_object-0")["basket_1"] == {"filled:contain_region"}


def test_what_is_needed_comes_before_bystanders_and_detail() -> None:
    exact = exact_of("libero_spatial-0")
    plan = geometry.plan(exact, asked_of("libero_spatial-0"))
    sizes = {name: detail.count(parts) for name, parts in plan.parts.items()}
    assert not plan.short
    assert sizes["akita_black_bowl_1"] >= 5 > sizes["akita_black_bowl_2"] == sizes["cookies_1"] == 1
    assert sum(sizes.values()) + 1 == plan.count <= geometry.MAX_GEOMS
    roomy = geometry.plan(exact, asked_of("libero_spatial-0"), budget=60)
    assert detail.count(roomy.parts["akita_black_bowl_1"]) == 9
    assert detail.count(roomy.parts["akita_black_bowl_2"]) == 1


def test_a_budget_that_cannot_be_kept_is_an_error() -> None:
    with pytest.raises(SceneError, match="the budget is 10"):
        geometry.plan(exact_of("libero_spatial-0"), {}, budget=10)


def test_a_tight_budget_says_what_falls_short() -> None:
    plan = geometry.plan(exact_of("libero_goal-0"), asked_of("libero_goal-0"), budget=20)
    assert "akita_black_bowl_1" in plan.short


def test_an_unknown_category_is_made_of_its_own_boxes_or_merged_ones() -> None:
    few = recipes.recipe("teapot", 3).modules(frozenset({"held"}))[0]
    assert [detail.count(level) for level in few.levels] == [1, 2, 3]
    many = recipes.recipe("teapot", 40).modules(frozenset())[0]
    assert [detail.count(level) for level in many.levels] == [1, 2, 3, 5, 8]


def test_a_recipe_that_does_not_fit_the_file_names_thing_and_geom(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = detail.Recipe(((detail.Part(fits.Around(), ("g99",)),),))
    monkeypatch.setattr(recipes, "RECIPES", {"plate": wrong})
    with pytest.raises(SceneError, match="plate_1 has no collision geom 'g99'"):
        geometry.lean_scene(source_of("libero_goal-0"), {}, exact_of("libero_goal-0"))


# -- how well shapes are met -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("asked", [ALL_OF_IT, frozenset()], ids=["needed", "bystander"])
@pytest.mark.parametrize("category", MOVABLE)
def test_a_thing_stands_at_the_height_it_stood_at(category: str, asked: frozenset[str]) -> None:
    exact, lean = fitted(category, asked)
    up = 1 if category in Y_UP else 2
    bottoms = [min(solid.extreme_points()[:, up].min() for solid in solids) for solids in (exact, lean)]
    assert bottoms[1] == pytest.approx(bottoms[0], abs=1e-3)


# Mean distance of the exact surface from the lean one or back, whichever is larger, millimetres: of the finest level
# and of the one that is needed, where it is more than 3.5.
LARGEST_GAP = {"moka_pot": (4.4, 5.1), "porcelain_mug": (4.0, 6.1), "red_coffee_mug": (3.5, 4.6), "plate": (3.5, 5.3)}
LARGEST_GAP |= {"white_yellow_mug": (3.5, 5.4), "glazed_rim_porcelain_ramekin": (3.5, 4.8), "wine_rack": (3.5, 115.0)}
LARGEST_GAP |= {"wooden_cabinet": (3.5, 12.0), "white_cabinet": (3.5, 12.0)}


@pytest.mark.parametrize("category", [*MOVABLE, *FIXTURES])
def test_needed_things_keep_their_surface(category: str) -> None:
    for finest, largest in zip((True, False), LARGEST_GAP.get(category, (3.5, 3.5)), strict=True):
        exact, lean = fitted(category, ALL_OF_IT, finest=finest)
        gap = max(shapes.gaps(exact, lean, 0.004).mean(), shapes.gaps(lean, exact, 0.004).mean())
        assert 1e3 * gap < largest


HOLLOW = {
    # Category, what is asked, and a box within it that must stay free: lower and upper corner, root frame.
    "basket": ("filled:contain_region", (-0.05, -0.05, 0.03), (0.05, 0.05, 0.2)),
    "wooden_tray": ("filled:contain_region", (-0.12, -0.07, 0.012), (0.13, 0.06, 0.1)),
    "akita_black_bowl": ("held", (-0.022, -0.022, 0.013), (0.022, 0.022, 0.2)),
    "white_bowl": ("held", (-0.018, -0.018, 0.007), (0.018, 0.018, 0.2)),
    "porcelain_mug": ("held", (-0.001, -0.016, 0.02), (0.03, 0.014, 0.2)),
    "red_coffee_mug": ("held", (-0.026, -0.013, 0.012), (-0.004, 0.007, 0.2)),
    "white_yellow_mug": ("held", (-0.034, -0.016, 0.012), (-0.002, 0.016, 0.2)),
    "chefmate_8_frypan": ("held", (-0.045, -0.045, 0.015), (0.055, 0.045, 0.2)),
    "microwave": ("filled:heating_region", (-0.13, -0.06, 0.03), (0.05, 0.07, 0.16)),
    "wooden_two_layer_shelf": ("filled:top_region", (-0.14, -0.07, 0.08), (0.15, 0.1, 0.2)),
    "desk_caddy": ("filled:back_contain_region", (0.006, -0.055, 0.02), (0.06, 0.055, 0.2)),
    "wooden_cabinet": ("filled:top_region", (-0.095, -0.06, 0.165), (0.1, 0.085, 0.215)),
    "white_cabinet": ("filled:bottom_region", (-0.095, -0.06, 0.03), (0.1, 0.085, 0.075)),
}


@pytest.mark.parametrize("category", sorted(HOLLOW))
def test_hollow_things_stay_hollow(category: str) -> None:
    asked, low, high = HOLLOW[category]
    exact, lean = fitted(category, frozenset({asked}))
    ticks = [np.linspace(a, b, 9) for a, b in zip(low, high, strict=True)]
    space = np.stack(np.meshgrid(*ticks), axis=-1).reshape(-1, 3)
    assert shapes.union_distance(exact, space).min() > -1e-9, "the box is not free in the exact thing either"
    assert shapes.union_distance(lean, space).min() > -1e-9


# -- with a policy -----------------------------------------------------------------------------------------------------


def test_things_stay_where_they_are_while_nobody_touches_them() -> None:
    moved = []
    for profile in geometry.PROFILES:
        env = make("libero_goal", tasks=[0, 6], episodes=[0, 1], geometry=profile)
        assert isinstance(env, LiberoEnv)
        env.reset()
        group = env.physics.groups[0]
        bodies = [group.scene.model.body(entity.root_body).id for entity in group.scene.objects]
        before = np.array(group.xpos[:, bodies])
        env.step_continuous(np.tile([0.0, 0, 0, 0, 0, 0, -1], (4, 10, 1)))
        moved.append(float(np.linalg.norm(group.xpos[:, bodies] - before, axis=-1).max()))
        env.close()
    assert max(moved) < 1e-3


@pytest.mark.heavy
def test_a_policy_solves_as_many_tasks_with_lean_geometry() -> None:
    from vecenv_eval.policies import make_policy

    solved = []
    for profile in geometry.PROFILES:
        env = make("libero_object", episodes=[0, 1], max_steps=300, geometry=profile)
        policy, info = make_policy("pick_place"), env.reset()
        policy.reset(env, info)
        while not (env.evaluate().success | (env.evaluate().num_steps >= 300)).all():
            actions = policy.act(env)
            assert isinstance(actions, np.ndarray)
            env.step_continuous(actions)
        solved.append(env.evaluate().success.mean())
        env.close()
    assert abs(solved[1] - solved[0]) <= 0.05
