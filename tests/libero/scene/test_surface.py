"""Surface samples lie on the collision geometry, face outwards and are always the same."""

from __future__ import annotations

import functools

import mujoco
import numpy as np
import pytest
from support import upstream

from vecenv.libero.scene import surface
from vecenv.libero.scene.scene import Scene, compile_scene
from vecenv.libero.scene.surface import BodyPoints

STEP = 1e-4


@functools.cache
def scene_of(scene_id: str) -> Scene:
    return compile_scene(upstream.tasks_of(scene_id)[0].problem())


@functools.cache
def categories() -> dict[str, tuple[str, str]]:
    """A scene and an entity of each category of the 130 tasks."""
    found: dict[str, tuple[str, str]] = {}
    for scene_id in upstream.scene_ids():
        problem = upstream.tasks_of(scene_id)[0].problem()
        for thing in (*problem.objects, *problem.fixtures):
            found.setdefault(thing.category, (scene_id, thing.name))
    workspaces = {"table", "kitchen_table", "living_room_table", "study_table", "floor"}
    return {category: where for category, where in found.items() if category not in workspaces}


def ray(model: mujoco.MjModel, geom: int, pos: np.ndarray, direction: np.ndarray) -> float:
    """Distance along a ray, body frame, to a primitive geom's surface; negative when it misses."""
    mat = np.zeros(9)
    mujoco.mju_quat2Mat(mat, model.geom_quat[geom])
    kind = int(model.geom_type[geom])
    return mujoco.mju_rayGeom(model.geom_pos[geom], mat, model.geom_size[geom], pos, direction, kind)


def on_outer_surface(model: mujoco.MjModel, geoms: list[int], pos: np.ndarray, normal: np.ndarray) -> bool:
    """A ray back from just outside meets the surface at the point, and one outwards meets the same geom never again."""
    start = pos + STEP * normal
    return any(abs(ray(model, g, start, -normal) - STEP) < 1e-9 and ray(model, g, start, normal) < 0 for g in geoms)


def depth(model: mujoco.MjModel, geom: int, pos: np.ndarray) -> float:
    """How far inside a convex geom a point is, along the axes of its body; 0 outside."""
    hits = [ray(model, geom, pos, sign * axis) for axis in np.eye(3) for sign in (-1.0, 1.0)]
    return max(min(hits), 0.0)


def geoms_of(model: mujoco.MjModel, body: int) -> list[int]:
    return [
        g
        for g in range(model.ngeom)
        if model.geom_bodyid[g] == body and (model.geom_contype[g] or model.geom_conaffinity[g])
    ]


def test_the_suites_hold_26_objects_and_7_fixtures_besides_the_5_workspaces() -> None:
    assert len(categories()) == 26 + 7


@pytest.mark.parametrize("category", sorted(categories()))
def test_points_lie_on_the_outer_surface_of_every_category(category: str) -> None:
    scene_id, name = categories()[category]
    scene = scene_of(scene_id)
    model, points = scene.model, surface.entity_points(scene, name)
    assert len(points.pos) >= surface.MIN_POINTS
    np.testing.assert_allclose(np.linalg.norm(points.normal, axis=1), 1, atol=1e-12)
    root = model.body(scene.entities[name].root_body).id
    for body, pos, normal in zip(points.body, points.pos, points.normal, strict=True):
        assert model.body_rootid[body] == model.body_rootid[root]
        geoms = geoms_of(model, body)
        assert on_outer_surface(model, geoms, pos, normal)
        assert max(depth(model, g, pos) for g in geoms) < 2e-4


@pytest.mark.parametrize("scene_id", ["libero_object-0", "libero_spatial-0", "libero_10-5"])
def test_points_are_the_same_in_every_process_and_scene_build(scene_id: str) -> None:
    again = compile_scene(upstream.tasks_of(scene_id)[0].problem())
    for name in again.entities:
        first, second = surface.entity_points(scene_of(scene_id), name), surface.entity_points(again, name)
        for a, b in zip((first.body, first.pos, first.normal), (second.body, second.pos, second.normal), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("scene_id", ["libero_object-0", "libero_spatial-0", "libero_10-5"])
def test_corners_bound_every_point_of_an_entity(scene_id: str) -> None:
    scene = scene_of(scene_id)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = upstream.tasks_of(scene_id)[0].init_states()[0, 1 : 1 + scene.model.nq]
    mujoco.mj_kinematics(scene.model, data)
    for name in scene.entities:
        points, _ = surface.entity_points(scene, name).world(data.xpos[None], data.xmat[None])
        corners, _ = surface.entity_corners(scene, name).world(data.xpos[None], data.xmat[None])
        assert (points.min(axis=1) >= corners.min(axis=1) - 1e-9).all()
        assert (points.max(axis=1) <= corners.max(axis=1) + 1e-9).all()
        slack = np.maximum(points.min(axis=1) - corners.min(axis=1), corners.max(axis=1) - points.max(axis=1))
        assert slack.max() < 0.04


@pytest.mark.parametrize(
    "scene_id", ["libero_object-0", "libero_spatial-0", "libero_10-0", "libero_10-2", "libero_10-5"]
)
def test_scenery_is_what_neither_moves_nor_has_a_name(scene_id: str) -> None:
    scene = scene_of(scene_id)
    model, points = scene.model, surface.scenery_points(scene, half_size=0.7)
    named = {model.body(entity.root_body).id for entity in scene.entities.values()} | {model.body("robot0_base").id}
    assert len(points.pos) >= surface.MIN_POINTS
    assert not named & {ancestor for body in set(points.body) for ancestor in ancestry(model, int(body))}
    np.testing.assert_allclose(np.linalg.norm(points.normal, axis=1), 1, atol=1e-12)
    flat = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE]
    floor = np.isin(points.body, model.geom_bodyid[flat]) & (points.pos[:, 2] == model.geom_pos[flat[0], 2])
    assert floor.any()
    assert np.abs(points.pos[floor, :2] - model.geom_pos[flat[0], :2]).max() <= 0.7
    assert (points.normal[floor] == [0, 0, 1]).all()


def ancestry(model: mujoco.MjModel, body: int) -> list[int]:
    chain = [body]
    while chain[-1]:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain


def test_points_follow_their_bodies() -> None:
    local = BodyPoints(np.array([1, 0]), np.array([[1.0, 0, 0], [0, 2.0, 0]]), np.array([[0.0, 1, 0], [1.0, 0, 0]]))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    xmat = np.stack([np.stack([np.eye(3).ravel(), quarter.ravel()]), np.tile(np.eye(3).ravel(), (2, 1))])
    xpos = np.zeros((2, 2, 3))
    xpos[:, 1] = [5.0, 0, 0]
    pos, normal = local.world(xpos, xmat)
    np.testing.assert_allclose(pos, [[[5, 1, 0], [0, 2, 0]], [[6, 0, 0], [0, 2, 0]]])
    np.testing.assert_allclose(normal, [[[-1, 0, 0], [1, 0, 0]], [[0, 1, 0], [1, 0, 0]]])


# -- bounding boxes ----------------------------------------------------------------------------------------------------


def test_box_samples_cover_all_six_faces_and_nothing_else() -> None:
    low, high = np.array([[0.0, 0, 0], [-1, 2, 3]]), np.array([[1.0, 2, 3], [-0.5, 2.5, 4]])
    points, normals = surface.box_samples(low, high)
    assert points.shape == normals.shape == (2, 294, 3)
    for box in range(2):
        for axis in range(3):
            for side, sign in ((low, -1), (high, 1)):
                face = normals[box, :, axis] == sign
                assert face.sum() == 49
                np.testing.assert_array_equal(points[box, face, axis], side[box, axis])
        assert (np.abs(normals[box]).sum(axis=1) == 1).all()
        assert (points[box] >= low[box]).all()
        assert (points[box] <= high[box]).all()


# -- shapes that are made here -----------------------------------------------------------------------------------------

CUBE = "0 0 0  1 0 0  0 1 0  1 1 0  0 0 1  1 0 1  0 1 1  1 1 1"


def sample(geoms: str, count: int = 4000) -> tuple[mujoco.MjModel, BodyPoints]:
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><asset><mesh name='cube' vertex='{CUBE}'/></asset>"
        f"<worldbody><body>{geoms}</body></worldbody></mujoco>"
    )
    return model, surface.sample_geoms(model, range(model.ngeom), count)


def share(chosen: np.ndarray) -> float:
    return float(chosen.mean())


def test_points_are_spread_by_area() -> None:
    _, points = sample("<geom type='box' size='1 2 3'/>")
    for axis, area in enumerate((6, 3, 2)):
        for sign in (-1, 1):
            assert share(points.normal[:, axis] == sign) == pytest.approx(area / 22, rel=0.15)
    assert share(points.pos[:, 2] > 1.5) == pytest.approx((2 + 9 * 0.5) / 22, rel=0.15)


def test_big_and_small_geoms_get_points_by_their_area() -> None:
    _, points = sample("<geom type='box' size='1 1 1'/><geom type='box' size='.5 .5 .5' pos='5 0 0'/>")
    assert share(points.pos[:, 0] > 3) == pytest.approx(1 / 5, rel=0.15)


@pytest.mark.parametrize(
    ("geom", "radius", "half", "end_share"),
    [
        ("<geom type='sphere' size='0.5'/>", 0.5, 0.0, 1.0),
        ("<geom type='capsule' size='0.5 1'/>", 0.5, 1.0, 1 / 3),
        ("<geom type='cylinder' size='0.5 1'/>", 0.5, 1.0, 1 / 5),
    ],
)
def test_round_shapes(geom: str, radius: float, half: float, end_share: float) -> None:
    model, points = sample(geom)
    assert all(on_outer_surface(model, [0], p, n) for p, n in zip(points.pos, points.normal, strict=True))
    side = np.isclose(np.linalg.norm(points.pos[:, :2], axis=1), radius) & (np.abs(points.pos[:, 2]) < half)
    assert 1 - share(side) == pytest.approx(end_share, rel=0.15)
    np.testing.assert_allclose(points.pos.mean(axis=0), 0, atol=0.06)


def test_meshes() -> None:
    _, points = sample("<geom type='mesh' mesh='cube'/>")
    local = points.pos - points.pos.min(axis=0)
    axis = np.abs(points.normal).argmax(axis=1)
    outward = np.sign(points.normal[np.arange(len(axis)), axis])
    np.testing.assert_allclose(local[np.arange(len(axis)), axis], (outward + 1) / 2, atol=1e-6)
    for k in range(3):
        assert share(axis == k) == pytest.approx(1 / 3, rel=0.15)


def test_what_lies_inside_another_geom_of_the_body_is_no_surface() -> None:
    inner = "<geom type='sphere' size='0.1'/><geom type='capsule' size='0.1 0.2' pos='0 0 0.3'/>"
    _, points = sample(f"<geom type='box' size='1 1 1'/>{inner}<geom type='cylinder' size='.2 2'/>")
    assert (np.abs(points.pos).max(axis=1) > 1 - 1e-9).all()
    on_top = (points.pos[:, 2] == 1) & (points.normal[:, 2] == 1)
    assert on_top.any()
    assert np.linalg.norm(points.pos[on_top, :2], axis=1).min() >= 0.2 - 1e-4


def test_tilted_geoms_are_sampled_in_the_bodys_frame() -> None:
    model, points = sample("<geom type='box' size='.1 .2 .3' pos='1 2 3' euler='30 40 50'/>", count=300)
    assert all(on_outer_surface(model, [0], p, n) for p, n in zip(points.pos, points.normal, strict=True))


def test_a_shape_it_cannot_sample_is_named() -> None:
    with pytest.raises(ValueError, match=r"geom 'egg'.*type 4"):
        sample("<geom name='egg' type='ellipsoid' size='1 2 3'/>")
