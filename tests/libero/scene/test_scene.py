"""A compiled scene equals the model upstream builds from the same task file."""

from __future__ import annotations

import functools
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
from support import upstream

from vecenv.libero.scene import contacts
from vecenv.libero.scene import scene as scenes
from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.scene.bddl import Problem, parse_problem
from vecenv.libero.scene.scene import Scene, SceneError, compile_scene, contact_sensor_name, zone_site
from vecenv.libero.tasks import suites
from vecenv.libero.tasks.fixtures import placements

# One scene of each workspace, and the largest.
WHOLE = ("libero_spatial-0", "libero_object-0", "libero_goal-0", "libero_10-0", "libero_10-2", "libero_10-5")

JOINTS = ("jnt_type", "jnt_qposadr", "jnt_dofadr", "jnt_bodyid", "jnt_limited", "jnt_pos", "jnt_axis", "jnt_stiffness")
JOINTS += ("jnt_range", "jnt_margin", "jnt_solref", "jnt_solimp", "qpos0", "qpos_spring")
DOFS = ("dof_bodyid", "dof_jntid", "dof_parentid", "dof_damping", "dof_armature", "dof_frictionloss")
DOFS += ("dof_solref", "dof_solimp", "dof_invweight0", "dof_M0")
BODIES = ("body_parentid", "body_rootid", "body_weldid", "body_jntnum", "body_jntadr", "body_dofnum", "body_dofadr")
BODIES += ("body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_iquat", "body_gravcomp", "body_margin")
BODIES += ("body_contype", "body_conaffinity", "body_invweight0")
BODY_POSES = ("body_pos", "body_quat")
GEOMS = (
    "geom_type",
    "geom_bodyid",
    "geom_size",
    "geom_pos",
    "geom_quat",
    "geom_friction",
    "geom_solref",
    "geom_solimp",
)
GEOMS += ("geom_solmix", "geom_margin", "geom_gap", "geom_condim", "geom_contype", "geom_conaffinity", "geom_priority")
GEOMS += ("geom_rbound", "geom_aabb", "geom_group")
ACTUATORS = ("actuator_trntype", "actuator_trnid", "actuator_gaintype", "actuator_gainprm", "actuator_biastype")
ACTUATORS += ("actuator_biasprm", "actuator_dyntype", "actuator_dynprm", "actuator_gear", "actuator_ctrllimited")
ACTUATORS += ("actuator_ctrlrange", "actuator_forcelimited", "actuator_forcerange")
SITES = ("site_type", "site_bodyid", "site_pos", "site_quat", "site_size")
CAMERAS = ("cam_bodyid", "cam_mode", "cam_pos", "cam_quat", "cam_fovy")
COUNTS = ("nq", "nv", "nu", "na", "njnt", "nbody", "nsite", "ncam", "neq", "ntendon", "npair", "nexclude", "nmocap")


@functools.cache
def scene_of(scene_id: str) -> Scene:
    return compile_scene(upstream.tasks_of(scene_id)[0].problem(), contacts="current")


def names(model: mujoco.MjModel, kind: mujoco.mjtObj, ids: Sequence[int]) -> list[str | None]:
    return [mujoco.mj_id2name(model, int(kind), i) for i in ids]


def colliding(model: mujoco.MjModel) -> np.ndarray:
    return np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0))


def assert_equal_arrays(
    ours: mujoco.MjModel,
    theirs: mujoco.MjModel,
    fields: Sequence[str],
    rows: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    for field in fields:
        a, b = np.asarray(getattr(ours, field), float), np.asarray(getattr(theirs, field), float)
        if rows is not None:
            a, b = a[rows[0]], b[rows[1]]
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9, err_msg=field)


def assert_same_physics(problem: Problem, scene: Scene, theirs: mujoco.MjModel) -> None:
    """Everything that decides how a model moves, collides and is looked at is equal; fixture poses are left out."""
    ours = scene.model
    assert {count: getattr(ours, count) for count in COUNTS} == {count: getattr(theirs, count) for count in COUNTS}
    for kind, count in (("JOINT", ours.njnt), ("BODY", ours.nbody), ("SITE", ours.nsite), ("CAMERA", ours.ncam)):
        obj = getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
        assert names(ours, obj, range(count)) == names(theirs, obj, range(count))
    actuator = mujoco.mjtObj.mjOBJ_ACTUATOR
    assert names(ours, actuator, range(ours.nu)) == names(theirs, actuator, range(ours.nu))
    assert_equal_arrays(ours, theirs, JOINTS + DOFS + BODIES + ACTUATORS + SITES + CAMERAS)
    drawn = [placement.body for placement in placements(problem, scene).values()]
    fixed = np.setdiff1d(np.arange(ours.nbody), drawn)
    assert_equal_arrays(ours, theirs, BODY_POSES, (fixed, fixed))
    assert_same_collisions(ours, theirs)
    assert_same_options(ours, theirs)


def assert_same_collisions(ours: mujoco.MjModel, theirs: mujoco.MjModel) -> None:
    mine, peers = colliding(ours), colliding(theirs)
    geom, mesh = mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_MESH
    assert names(ours, geom, list(mine)) == names(theirs, geom, list(peers))
    assert_equal_arrays(ours, theirs, GEOMS, (mine, peers))
    meshes = [
        (a, b) for a, b in zip(ours.geom_dataid[mine], theirs.geom_dataid[peers], strict=True) if a >= 0 or b >= 0
    ]
    assert names(ours, mesh, [a for a, _ in meshes]) == names(theirs, mesh, [b for _, b in meshes])
    for a, b in meshes:
        np.testing.assert_array_equal(vertices(ours, a), vertices(theirs, b))


def vertices(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    return model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]


def assert_same_options(ours: mujoco.MjModel, theirs: mujoco.MjModel) -> None:
    fields = [name for name in dir(ours.opt) if not name.startswith("_") and not callable(getattr(ours.opt, name))]
    assert "timestep" in fields
    for field in fields:
        np.testing.assert_array_equal(getattr(ours.opt, field), getattr(theirs.opt, field), err_msg=field)
    np.testing.assert_allclose(ours.stat.meaninertia, theirs.stat.meaninertia, rtol=1e-9)


def assert_looks_the_same(ours: mujoco.MjModel, theirs: mujoco.MjModel) -> None:
    for kind, count in (
        ("GEOM", theirs.ngeom),
        ("MESH", theirs.nmesh),
        ("MATERIAL", theirs.nmat),
        ("TEXTURE", theirs.ntex),
    ):
        obj = getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
        assert sorted(map(str, names(ours, obj, range(count)))) == sorted(map(str, names(theirs, obj, range(count))))
    everything = np.arange(theirs.ngeom)
    assert_equal_arrays(ours, theirs, GEOMS, (everything, everything))
    # robosuite paints collision geoms, which no camera shows.
    shown = np.flatnonzero(theirs.geom_group != 0)
    assert_equal_arrays(ours, theirs, ("geom_rgba",), (shown, shown))


def test_the_130_tasks_share_32_scenes() -> None:
    assert len(upstream.scene_tasks()) == 32
    assert sum(map(len, upstream.scene_tasks().values())) == 130


def test_published_contacts_are_solver_options_and_a_mark() -> None:
    problem = upstream.tasks_of("libero_object-0")[0].problem()
    published, current = compile_scene(problem), compile_scene(problem, contacts="current")
    assert (published.contacts, current.contacts) == ("published", "current")
    contacts.mark(published.model, "current")
    assert_same_options(published.model, current.model)
    np.testing.assert_array_equal(published.model.numeric_data, current.model.numeric_data)
    contacts.mark(current.model, "published")
    assert_same_options(current.model, compile_scene(problem).model)


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_a_scene_equals_upstreams_model(scene_id: str) -> None:
    task = upstream.tasks_of(scene_id)[0]
    peer = upstream.peer_of(task.bddl_path)
    assert_same_physics(task.problem(), scene_of(scene_id), upstream.model_of(peer))


@pytest.mark.parametrize("scene_id", WHOLE)
def test_upstreams_visual_geoms_change_nothing(scene_id: str) -> None:
    task = upstream.tasks_of(scene_id)[0]
    theirs = upstream.model_of(upstream.whole_peer(task.bddl_path))
    assert theirs.ngeom > len(colliding(theirs)) + 10
    assert_same_physics(task.problem(), scene_of(scene_id), theirs)
    visual = compile_scene(task.problem(), visual=True, contacts="current")
    assert_same_physics(task.problem(), visual, theirs)
    assert_looks_the_same(visual.model, theirs)


@pytest.mark.heavy
@pytest.mark.parametrize("scene_id", sorted(set(upstream.scene_ids()) - set(WHOLE)))
def test_upstreams_visual_geoms_change_nothing_in_the_other_scenes(scene_id: str) -> None:
    task = upstream.tasks_of(scene_id)[0]
    theirs = upstream.model_of(upstream.whole_peer(task.bddl_path))
    assert_same_physics(task.problem(), scene_of(scene_id), theirs)


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_every_task_of_a_scene_finds_its_own_things_there(scene_id: str) -> None:
    scene = scene_of(scene_id)
    for task in upstream.tasks_of(scene_id):
        problem = task.problem()
        fixtures = [f for f in problem.fixtures if f.name != scene.arena.workspace]
        assert [(e.name, e.category) for e in scene.objects] == [(o.name, o.category) for o in problem.objects]
        assert [(e.name, e.category) for e in scene.fixtures] == [(f.name, f.category) for f in fixtures]
        zones = [region for region in problem.regions if scene.arena.workspace in region.name]
        assert {zone.name: zone_site(zone, scene.arena) for zone in zones} == {
            name: region for name, region in scene.regions.items() if region.parent is None
        }
        assert {r.name for r in problem.regions if r.target in scene.entities} == {
            region.name for region in scene.regions.values() if region.parent is not None
        }


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_every_stored_start_state_loads(scene_id: str) -> None:
    model = scene_of(scene_id).model
    for task in upstream.tasks_of(scene_id):
        assert task.init_states().shape == (suites.NUM_EPISODES, 1 + model.nq + model.nv)


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_entities_and_regions_are_described_as_upstream_describes_them(scene_id: str) -> None:
    task, scene = upstream.tasks_of(scene_id)[0], scene_of(scene_id)
    env = upstream.peer_of(task.bddl_path).env
    objects = {**env.objects_dict, **env.fixtures_dict}
    assert list(scene.entities) == list(objects)
    for name, entity in scene.entities.items():
        assert entity.root_body == objects[name].root_body
        assert list(entity.joints) == objects[name].joints
        assert list(entity.contact_geoms) == objects[name].contact_geoms
        assert entity.bottom_z == objects[name].bottom_offset[2]
    assert set(scene.regions) == set(env.object_sites_dict)
    for name, region in scene.regions.items():
        theirs = env.object_sites_dict[name]
        assert region.parent == theirs.parent_name
        assert list(region.joints) == (theirs.joints or [])
        np.testing.assert_array_equal(region.size, theirs.size)
        site = upstream.model_of(upstream.peer_of(task.bddl_path)).site(name)
        assert region.body == upstream.model_of(upstream.peer_of(task.bddl_path)).body(site.bodyid[0]).name
        np.testing.assert_allclose(region.pos, site.pos, atol=1e-12)


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_what_collides_below_an_entity_is_what_upstream_tests_for_contact(scene_id: str) -> None:
    """Contact sensors watch whole subtrees, upstream lists of geoms; they agree only because of this."""
    task, model = upstream.tasks_of(scene_id)[0], scene_of(scene_id).model
    env = upstream.peer_of(task.bddl_path).env
    for entity in scene_of(scene_id).entities.values():
        listed = env.get_object(entity.name).contact_geoms
        root = model.body(entity.root_body).id
        below = [g for g in colliding(model) if root in ancestry(model, model.geom_bodyid[g])]
        assert set(listed) <= {model.geom(g).name for g in below}
        shapes = [shape(model, model.geom(name).id) for name in listed]
        for geom in below:
            # A stove's visual base collides too, and lies exactly in its collision base.
            assert model.geom(geom).name in listed or shape(model, geom) in shapes


def shape(model: mujoco.MjModel, geom: int) -> tuple[float, ...]:
    fields = (model.geom_bodyid, model.geom_type, model.geom_size, model.geom_pos, model.geom_quat, model.geom_margin)
    return tuple(float(x) for field in fields for x in np.atleast_1d(field[geom]))


def ancestry(model: mujoco.MjModel, body: int) -> list[int]:
    chain = [body]
    while chain[-1]:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_the_physics_model_carries_nothing_that_only_shows(scene_id: str) -> None:
    model = scene_of(scene_id).model
    assert len(colliding(model)) == model.ngeom
    assert model.ntex == model.nmat == 0
    assert set(model.geom_dataid) - {-1} == set(range(model.nmesh))


def test_names_resolve_to_ids() -> None:
    scene = scene_of("libero_object-0")
    model = scene.model
    assert [model.joint(int(np.flatnonzero(model.jnt_qposadr == a)[0])).name for a in scene.arm_qpos] == [
        f"robot0_joint{i}" for i in range(1, 8)
    ]
    assert list(scene.finger_qpos) == [7, 8]
    assert model.site(scene.grip_site).name == "gripper0_grip_site"
    assert model.body(scene.hand_body).name == "robot0_right_hand"


@pytest.mark.parametrize(
    ("scene_id", "base_z"), [("libero_object-0", 0.0), ("libero_spatial-0", 0.912), ("libero_10-0", 0.42)]
)
def test_the_workspace_follows_the_robots_base(scene_id: str, base_z: float) -> None:
    scene = scene_of(scene_id)
    assert scene.base_z == base_z
    np.testing.assert_allclose(scene.workspace_bounds, [[-0.7, -0.4, base_z - 0.1], [0.3, 0.5, base_z + 0.35]])


def test_contact_sensors_are_named_and_placed_for_each_pair_once() -> None:
    problem = upstream.tasks_of("libero_object-0")[0].problem()
    first, second = "basket_1", problem.objects[0].name
    scene = compile_scene(problem, contact_pairs=[(first, second), (second, first)])
    assert scene.model.nsensor == 1
    assert scene.model.sensor(0).name == contact_sensor_name(first, second) == contact_sensor_name(second, first)


def test_a_sensor_for_something_that_is_not_there_is_refused() -> None:
    problem = upstream.tasks_of("libero_object-0")[0].problem()
    with pytest.raises(SceneError, match="'teapot_1'"):
        compile_scene(problem, contact_pairs=[("basket_1", "teapot_1")])


def test_a_region_is_looked_for_up_to_the_first_part_without_sites() -> None:
    """The innermost part that the loop reaches lends its joints; upstream's loop ends at a part without sites."""
    tree = ET.fromstring(
        "<body name='a_main'><site name='a_default_site'/><joint name='a_joint0'/>"
        "<body name='a_door'><joint name='a_hinge'/><body name='a_shelf'><joint name='a_slide'/>"
        "<site name='a_in' size='1 2 3' pos='0 0 1'/></body></body>"
        "<body name='a_plain'/><body name='a_late'><site name='a_out' size='1 2 3'/></body></body>"
    )
    found = scenes._find_region_site(tree, "a_in", "a")
    assert found == scenes.RegionSite(
        name="a_in", parent="a", joints=("a_slide",), size=(1, 2, 3), pos=(0, 0, 1), body="a_shelf"
    )
    late = scenes._find_region_site(tree, "a_out", "a")
    assert late is not None
    assert (late.body, late.joints) == ("a_main", ())


# -- task files that the suites do not hold ----------------------------------------------------------------------------


@pytest.mark.parametrize("problem_name", sorted(ARENAS))
def test_a_new_task_in_any_workspace_equals_upstreams_model(problem_name: str, tmp_path: Path) -> None:
    """All six workspaces, among them the coffee table that no suite uses."""
    path = tmp_path / "task.bddl"
    path.write_text(upstream.task_text(problem_name))
    problem = parse_problem(path.read_text(), str(path))
    assert_same_physics(
        problem, compile_scene(problem, contacts="current"), upstream.model_of(upstream.bare_peer(path))
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (upstream.task_text("libero_moon_manipulation"), r"libero_moon_manipulation.*libero_floor_manipulation"),
        (upstream.task_text("libero_floor_manipulation", category="teapot"), r"'teapot' has no asset file"),
        (upstream.task_text("libero_floor_manipulation", fixture="teapot"), r"'teapot' has no asset file"),
        (
            re.sub(r" \(:ranges \(\(0\.1.*", ")", upstream.task_text("libero_floor_manipulation")),
            r"'floor_goal_region'.*:ranges",
        ),
    ],
)
def test_a_task_that_has_no_model_is_refused_by_name(text: str, message: str) -> None:
    with pytest.raises(SceneError, match=f"moon.bddl.*{message}"):
        compile_scene(parse_problem(text, "moon.bddl"))


def test_a_scene_that_mujoco_rejects_names_the_task(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vecenv.libero.scene.elements.ARENA_MEMORY", "plenty")
    with pytest.raises(SceneError, match=r"moon\.bddl: MuJoCo rejects"):
        compile_scene(parse_problem(upstream.task_text("libero_floor_manipulation"), "moon.bddl"))


@pytest.mark.heavy
@pytest.mark.parametrize("suite", suites.PRO_SUITES)
def test_scenes_of_the_pro_suites_equal_upstreams_models(suite: str) -> None:
    known = set(upstream.scene_tasks())
    for task in suites.list_tasks(suite):
        problem = task.problem()
        if problem.scene_key() not in known:
            known.add(problem.scene_key())
            assert_same_physics(
                problem,
                compile_scene(problem, contacts="current"),
                upstream.model_of(upstream.bare_peer(task.bddl_path)),
            )
