"""Ray-traced images: what they show is what GL shows, for any batch, and through the functional environment."""

from __future__ import annotations

import dataclasses
import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from support.images import needs_gl, psnr
from support.small_scenery import look, small, small_drawn, small_look, small_seen

import vecenv
from vecenv.libero.functional import FunctionalConfig, FunctionalLibero
from vecenv.libero.physics.budgets import Budget
from vecenv.libero.physics.mjx.options import compiler_options
from vecenv.libero.render import ray_kernel as raykernel
from vecenv.libero.render.options import (
    POLICY_CAMERAS,
    CameraShift,
    RenderConfig,
    RenderError,
    UserCamera,
    VisualOptions,
)
from vecenv.libero.render.rays import style_of
from vecenv.libero.render.raytrace import RayTracer, poses
from vecenv.libero.render.scenery import Scenery, installed_scenery
from vecenv.libero.tasks.sources import installed_tasks
from vecenv.libero.tasks.suites import list_tasks
from vecenv.observations import Egocentric

pytest.importorskip("warp")

# What the project promises of each image, and of the masks of each instance.
LEAST_PSNR, LEAST_IOU = 24.0, 0.97
# At the edge of a thing of fewer pixels, one pixel is much.
LEAST_PIXELS = 500
# LLVM's optimisation off: programs compile several times faster.
OPTIONS: dict[str, Any] = {**compiler_options(), "xla_backend_optimization_level": 0}


@cache
def scenery(suite: str = "libero_spatial", task: int = 0) -> Scenery:
    return installed_scenery(list_tasks(suite)[task].problem())


@cache
def start(suite: str = "libero_spatial", task: int = 0, count: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Body positions, orientations and joints of the first episodes of a task."""
    env = vecenv.make(suite, task=task, episodes=range(count))
    env.reset()
    found = posed(env)
    env.close()
    return found


def posed(env: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    (group,) = env.physics.groups
    qpos = group.seen_qpos.astype(np.float32)
    return (*poses(group.scene.model, group.seen_qpos, group.expand("body_pos"), group.expand("body_quat")), qpos)


def tracer(**options: Any) -> RayTracer:
    return RayTracer(scenery(), **{"height": 24, "width": 32, "depth": True, "segmentation": True, **options})


# -- the scenery -------------------------------------------------------------------------------------------------------


def test_a_scenery_has_the_bodies_of_the_physics_and_nothing_that_is_not_seen() -> None:
    physics = installed_tasks("libero_spatial")[0].scene(()).model
    model = scenery().model
    scenery().check(physics)
    assert (model.nq, model.nbody) == (0, physics.nbody)
    assert (model.body_parentid == 0).all()
    assert set(model.geom_group) == {1}
    assert set(model.geom_dataid[model.geom_dataid >= 0]) == set(range(model.nmesh))


def test_a_scenery_of_another_scene_is_refused() -> None:
    physics = installed_tasks("libero_object")[0].scene(()).model
    with pytest.raises(RenderError, match="not of the same scene"):
        scenery().check(physics)


def test_a_scenery_is_read_as_it_was_written(tmp_path: Path) -> None:
    scenery().save(tmp_path / "scenery.npz")
    read = Scenery.load(tmp_path / "scenery.npz")
    assert (read.instances, read.burners) == (scenery().instances, scenery().burners)
    np.testing.assert_array_equal(read.instance_of_geom, scenery().instance_of_geom)
    for field in ("mesh_vert", "mesh_face", "tex_data", "geom_pos", "mat_rgba"):
        np.testing.assert_array_equal(getattr(read.model, field), getattr(scenery().model, field))


def test_a_file_that_is_no_scenery_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", something=np.zeros(3))
    with pytest.raises(RenderError, match=r"other\.npz"):
        Scenery.load(tmp_path / "other.npz")


# -- looking -----------------------------------------------------------------------------------------------------------


def test_each_world_sees_its_own_state_however_it_is_mapped() -> None:
    states, rays = start(), tracer()
    together = look(rays, states)
    assert together.rgb.shape == (3, len(POLICY_CAMERAS), 24, 32, 3)
    assert (together.rgb.dtype, together.depth.dtype, together.segmentation.dtype) == ("uint8", "float32", "int16")
    alone = jax.jit(rays.look)(*(array[1] for array in states))
    nested = jax.jit(jax.vmap(jax.vmap(rays.look)))(*(array[None, 1:] for array in states))
    for one, two, all_of_them in zip(alone, nested, together, strict=True):
        np.testing.assert_array_equal(one, all_of_them[1])
        np.testing.assert_array_equal(two[0], all_of_them[1:])
    assert (together.rgb[0] != together.rgb[1]).any()


def test_the_order_of_rays_changes_no_pixel() -> None:
    states = tuple(array[:1] for array in start())
    tiled, row_by_row = look(tracer(), states), look(tracer(tile=(1, 1)), states)
    for one, other in zip(tiled, row_by_row, strict=True):
        np.testing.assert_array_equal(one, other)


def test_images_follow_a_loop_inside_one_program() -> None:
    xpos, xquat, qpos = (jnp.asarray(array[:1]) for array in start())
    rays = tracer(depth=False, segmentation=False)

    def tick(moved: jax.Array, _: None) -> tuple[jax.Array, Any]:
        return moved + 0.02, jax.vmap(rays.look)(moved, xquat, qpos).rgb

    in_loop = jax.jit(lambda start: jax.lax.scan(tick, start, None, 3)[1])(xpos)
    for step, images in enumerate(in_loop):
        alone = look(rays, (xpos + 0.02 * step, xquat, qpos)).rgb
        assert psnr(np.asarray(images), alone) > 50  # sums of floats differ in their last bit


def test_a_burner_is_seen_while_its_stove_is_on() -> None:
    (burner,) = scenery().burners
    states = tuple(np.repeat(array[:1], 2, axis=0) for array in start())
    states[2][:, list(burner.knobs)] = [[0.0], [burner.sign * (burner.bound + 1.0)]]
    off, on = look(tracer(height=64, width=64, segmentation=False), states).rgb[:, 1].astype(int)
    redder = (on[..., 0] - on[..., 1]) - (off[..., 0] - off[..., 1])
    assert (redder > 50).sum() > 3


def test_files_of_another_version_are_named(tmp_path: Path) -> None:
    small().save(tmp_path / "old.npz")
    with np.load(tmp_path / "old.npz") as file:
        arrays = dict(file)
    about = json.loads(str(arrays["about"]))
    np.savez(tmp_path / "old.npz", **{**arrays, "about": np.array(json.dumps({**about, "version": 1}))})
    with pytest.raises(RenderError, match=r"old\.npz.*anew"):
        Scenery.load(tmp_path / "old.npz")


def test_a_camera_that_is_not_there_is_named() -> None:
    with pytest.raises(RenderError, match=r"no camera 'sky'; this scene has .*agentview"):
        tracer(cameras=("sky",))


def test_no_gl_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("a GL context was made")

    monkeypatch.setattr(mujoco, "MjrContext", refuse)
    assert look(tracer(), tuple(array[:1] for array in start())).rgb.any()


# -- light and shapes: a small scene of every shape, against MuJoCo's own GL -------------------------------------------


@needs_gl
@pytest.mark.parametrize("reflectance", [{}, {"plate": 0.6}, {"floor": 0.3}])
@pytest.mark.parametrize(("samples", "least"), [(1, 34), (2, 30.5)])
def test_shapes_light_panes_and_mirrors_are_those_of_gl(
    reflectance: dict[str, float], samples: int, least: float
) -> None:
    found = small(**reflectance)
    for ours, theirs in zip(small_seen(found, samples=samples).rgb, small_drawn(found), strict=True):
        assert psnr(ours, theirs) > least


def test_a_pane_is_a_thing_with_something_behind_it() -> None:
    found, pane = small(), 6
    found.instance_of_geom[pane] = 0
    with_pane = small_seen(found, depth=True, segmentation=True)
    found.model.geom_rgba[pane, 3] = 0
    without = small_seen(found, depth=True, segmentation=True)
    of_pane = (with_pane.segmentation == 0) & (without.segmentation == 1)
    assert of_pane.sum() > 100
    assert (with_pane.depth[of_pane] < without.depth[of_pane]).all()
    # Still to be seen: what is bright behind it is brighter than what is dark.
    through, clear = (seen.rgb[of_pane].mean(-1) for seen in (with_pane, without))
    assert np.corrcoef(through, clear)[0, 1] > 0.5


def test_rays_may_see_faces_from_behind() -> None:
    inside = small()
    inside.model.cam_pos[:] = 0.6, 0.2, 0.05  # in the wedge
    facing, all_faces = (small_seen(inside, depth=True, culling=culling).depth for culling in (True, False))
    seen = facing > 0
    assert (facing[seen] > all_faces[seen] - 1e-4).all()
    assert (facing[seen] > all_faces[seen] + 0.01).mean() > 0.2


def test_a_renderer_with_other_arguments_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    made = raykernel.warp_render._build_megakernel

    def other(*arguments: Any) -> Any:
        return SimpleNamespace(adj=SimpleNamespace(args=made(*arguments).adj.args[1:]))

    monkeypatch.setattr(raykernel.warp_render, "_build_megakernel", other)
    with pytest.raises(RenderError, match="other arguments"):
        small_seen(small())


# -- the functional environment ----------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_functional_observations_have_the_views_that_playground_expects() -> None:
    config = FunctionalConfig(
        impl="warp",
        budget=Budget(contacts=500, rows=1500, pairs=1, candidates=500),
        obs=("proprio", "pixels"),
        image_size=32,
    )
    env = FunctionalLibero("libero_spatial", task=0, config=config)
    assert env.observation_size == {"state": (25,), "pixels/view_0": (32, 32, 3), "pixels/view_1": (32, 32, 3)}
    keys = jax.random.split(jax.random.key(0), 2)
    # Waited for: Python 3.11 cannot parse Warp's kernels in two threads at once.
    state = jax.block_until_ready(jax.jit(jax.vmap(env.reset), compiler_options=OPTIONS)(keys))
    assert {name: array.shape[1:] for name, array in state.obs.items()} == env.observation_size
    rays = RayTracer(scenery(), height=32, width=32)
    rgb = look(rays, (state.data.xpos, state.data.xquat, state.data.qpos)).rgb
    for view in (0, 1):
        np.testing.assert_allclose(state.obs[f"pixels/view_{view}"], rgb[:, view] / 255, atol=1e-6)


def test_functional_images_have_the_colours_that_are_asked_for(tmp_path: Path) -> None:
    installed_scenery(list_tasks("libero_spatial")[0].problem(), colors="current").save(tmp_path / "dark.npz")
    config = FunctionalConfig(
        impl="warp",
        budget=Budget(contacts=500, rows=1500, pairs=1, candidates=500),
        obs=("proprio", "pixels"),
        scenery=str(tmp_path / "dark.npz"),
    )
    with pytest.raises(RenderError, match="made with colors='current' but colors='published' is requested"):
        FunctionalLibero("libero_spatial", task=0, config=config)
    FunctionalLibero("libero_spatial", task=0, config=dataclasses.replace(config, colors="current"))


# -- the batched environment -------------------------------------------------------------------------------------------


def test_an_environment_that_is_told_to_traces_rays() -> None:
    render = RenderConfig(height=24, width=32, lod="fast", engine="raytrace")
    env = vecenv.make("libero_spatial", task=0, episodes=[0, 1], render=render)
    env.reset()
    seen, states = env.observe_egocentric(), posed(env)
    assert isinstance(seen, Egocentric)
    for shown in (seen.images_device, seen.depths_device, seen.segmentations_device):
        shown.prepare(*POLICY_CAMERAS)  # type: ignore[attr-defined]
    rays = look(tracer(), states)
    for view, camera in enumerate(POLICY_CAMERAS):
        # Poses in single precision: a pixel at an edge may differ.
        same = seen.segmentations[camera] == rays.segmentation[:, view]
        assert same.mean() > 0.998
        assert psnr(seen.images[camera], rays.rgb[:, view]) > 40
        np.testing.assert_allclose(seen.depths[camera][same], rays.depth[:, view][same], rtol=1e-3)
    env.close()


def test_an_engine_that_is_not_there_is_refused() -> None:
    with pytest.raises(RenderError, match="engine"):
        RenderConfig(engine="radiosity")


# -- styles ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (VisualOptions(textures={"floor": "squares"}), "cannot swap textures"),
        (VisualOptions(colors={"floor": (1, 0, 0)}), "'floor' is none; instances: all"),
    ],
)
def test_what_rays_cannot_show_is_refused(options: VisualOptions, problem: str) -> None:
    rays = RayTracer(small(), height=8, width=8, cameras=("front",))
    with pytest.raises(RenderError, match=problem):
        style_of(rays, options, ["front"], 0)


def test_a_free_camera_sees_what_one_of_the_scene_sees_from_there() -> None:
    found = small()
    own = UserCamera(name="own", pos=found.model.cam_pos[1], quat=found.model.cam_quat[1], fovy=50)
    rays = RayTracer(found, height=64, width=64, cameras=("low", None))
    low, free = small_look(rays, style_of(rays, VisualOptions(), ["low", own], 0)).rgb
    assert (np.abs(low.astype(int) - free) > 1).mean() < 1e-3


def test_light_is_scaled_for_each_world() -> None:
    # Without antialiasing: which pixels get more rays depends on all channels.
    rays = RayTracer(small(), height=32, width=32, cameras=("front",), antialias=False)
    dark, red, bright = (
        small_look(rays, style_of(rays, options, ["front"], 0)).rgb.mean((0, 1, 2))
        for options in (VisualOptions(light=0.5), VisualOptions(light_color=(1, 0, 0)), VisualOptions())
    )
    assert (dark < 0.8 * bright).all()
    assert red[0] == bright[0]
    assert (red[1:] < 0.1 * bright[1:]).all()


@needs_gl
@pytest.mark.heavy
def test_options_and_own_cameras_look_as_in_gl() -> None:
    above = UserCamera.looking_at("above", [0.9, 0.5, 1.8], [0, 0, 0.9], fovy=55)
    options = [
        VisualOptions(
            light=0.6,
            light_color=(1.0, 0.8, 0.9),
            light_shift=(0.5, -0.5, 0),
            colors={"plate_1": (0.3, 1, 0.3), "robot": (1, 0.4, 0.4)},
            cameras={"agentview": CameraShift(pos=(0.05, 0, -0.1), turn=(0.05, 0.1, -0.1), fovy=8)},
        ),
        VisualOptions(),
    ]
    images = []
    for engine, lod in (("gl", "original"), ("raytrace", "fast")):
        render = RenderConfig(engine=engine, lod=lod, cameras=[above])
        env: Any = vecenv.make("libero_spatial", task=0, episodes=[0, 1], render=render)
        env.set_visuals(options)
        env.reset()
        seen = env.observe_egocentric()
        assert isinstance(seen, Egocentric)
        images.append({name: seen.images[name] for name in ("above", "agentview", "wrist")})
        env.close()
    for name, drawn in images[0].items():
        for ours, theirs in zip(images[1][name], drawn, strict=True):
            assert psnr(ours, theirs) > LEAST_PSNR, name


# -- against GL --------------------------------------------------------------------------------------------------------


def compare(suite: str, task: int, size: int, episodes: list[int]) -> None:
    env = vecenv.make(suite, task=task, episodes=episodes, render=RenderConfig(height=size, width=size, lod="original"))
    env.reset()
    for tick in np.random.default_rng(task).uniform(-1, 1, (8, len(episodes), 7)):
        env.step_continuous(tick)
    seen, states = env.observe_egocentric(), posed(env)
    assert isinstance(seen, Egocentric)
    for shown in (seen.images_device, seen.depths_device, seen.segmentations_device):
        shown.prepare(*POLICY_CAMERAS)  # type: ignore[attr-defined]
    found = scenery(suite, task)
    assert found.instances == seen.instances[0]
    rays = look(RayTracer(found, height=size, width=size, depth=True, segmentation=True), states)
    masks: list[tuple[np.ndarray, np.ndarray]] = []
    for view, camera in enumerate(POLICY_CAMERAS):
        for slot in range(len(episodes)):
            assert psnr(rays.rgb[slot, view], seen.images[camera][slot]) > LEAST_PSNR, (camera, slot)
        masks.append((rays.segmentation[:, view], seen.segmentations[camera]))
        error = np.abs(rays.depth[:, view] - seen.depths[camera])
        assert np.median(error) < 1e-3
        assert (error < 0.01).mean() > 0.99
    check_masks(*(np.stack(each) for each in zip(*masks, strict=True)))
    env.close()


def check_masks(ours: np.ndarray, theirs: np.ndarray) -> None:
    """Each instance's mask, over all images together."""
    counts = np.bincount(theirs.ravel())
    for instance in np.flatnonzero(counts >= LEAST_PIXELS):
        a, b = ours == instance, theirs == instance
        assert (a & b).sum() / (a | b).sum() > LEAST_IOU, instance


@needs_gl
@pytest.mark.heavy
@pytest.mark.parametrize(
    ("suite", "task"),
    [
        ("libero_object", 0),
        ("libero_spatial", 0),
        ("libero_goal", 0),
        ("libero_10", 0),
        ("libero_10", 9),
        ("libero_90", 20),
    ],
)
def test_images_are_those_of_gl(suite: str, task: int) -> None:
    compare(suite, task, 256, [0, 7])
