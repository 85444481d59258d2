"""Rendering batches: threads, cameras, images and visual options, on a scene of a few boxes.

`test_render_libero.py` has the real scenes, `test_render_failures.py` what happens when GL is missing or fails.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np
import pytest
from support.box_scene import SIZE, rgb, shot, tiny_scene
from support.images import needs_gl

from vecenv.libero.render.drawing import Pose, Stage
from vecenv.libero.render.gl import GlRenderer, Shot, Wanted
from vecenv.libero.render.options import (
    CameraShift,
    RenderConfig,
    RenderError,
    UserCamera,
    VisualOptions,
    VisualVariation,
)

pytestmark = needs_gl

ALL = Wanted(rgb=True, depth=True, segmentation=True)


def test_every_slot_and_camera_gets_its_images(renderer: GlRenderer, stage: Stage) -> None:
    shots = [shot(stage, box=(x, 0.1)) for x in (0.0, 0.2, 0.4)]
    frames = renderer.render(shots, ["agentview", "side"], ALL)
    for camera in ("agentview", "side"):
        assert frames.rgb[camera].shape == (3, SIZE, SIZE, 3)
        assert frames.rgb[camera].dtype == np.uint8
        assert frames.depth[camera].shape == frames.segmentation[camera].shape == (3, SIZE, SIZE)
    masks = frames.segmentation["agentview"] == stage.instances.index("box_1")
    columns = [np.flatnonzero(mask.any(axis=0)).mean() for mask in masks]
    # The image is mirrored: what lies to the camera's right is on the left.
    assert columns[0] > columns[1] > columns[2]


def test_images_do_not_depend_on_threads_or_neighbours(renderer: GlRenderer, stage: Stage) -> None:
    shots = [shot(stage, box=(0.1 * i, 0.0)) for i in range(5)]
    together = rgb(renderer, *shots)
    alone = GlRenderer([stage], height=SIZE, width=SIZE, num_threads=1)
    try:
        for slot, one in enumerate(shots):
            np.testing.assert_array_equal(rgb(alone, one)[0], together[slot])
    finally:
        alone.close()


def test_images_have_any_shape(stage: Stage) -> None:
    wide = GlRenderer([stage], height=24, width=96, num_threads=1)
    try:
        frames = wide.render([shot(stage)], ["agentview"], ALL)
        assert frames.rgb["agentview"].shape == (1, 24, 96, 3)
        assert frames.views["agentview"].intrinsics[0, :2, 2].tolist() == [47.5, 11.5]
    finally:
        wide.close()


def test_given_arrays_are_filled(renderer: GlRenderer, stage: Stage) -> None:
    out = np.zeros((1, SIZE, SIZE, 3), np.uint8)
    frames = renderer.render([shot(stage)], ["agentview"], out={"agentview": out})
    assert frames.rgb["agentview"] is out
    np.testing.assert_array_equal(out, rgb(renderer, shot(stage)))
    with pytest.raises(RenderError, match="expected uint8"):
        renderer.render([shot(stage)], ["agentview"], out={"agentview": out.astype(float)})


def test_depth_is_metres_from_the_cameras_plane(renderer: GlRenderer, stage: Stage) -> None:
    depth = renderer.render([shot(stage)], ["agentview"], ALL).depth["agentview"][0]
    assert depth.max() == pytest.approx(2.0, abs=1e-3)
    assert depth.min() == pytest.approx(1.8, abs=1e-2)
    # The floor is everywhere two metres from the plane, although its corners are farther away.
    assert depth[0, 0] == pytest.approx(2.0, abs=1e-3)


def test_segmentation_tells_instances_apart(renderer: GlRenderer, stage: Stage) -> None:
    found = renderer.render([shot(stage)], ["agentview"], ALL).segmentation["agentview"][0]
    assert stage.instances == ("", "robot", "box_1", "ball_1")
    assert set(np.unique(found)) == {0, 1, 2, 3}


def test_views_project_points_to_the_pixels_that_show_them(renderer: GlRenderer, stage: Stage) -> None:
    for camera in ("agentview", "side"):
        frames = renderer.render([shot(stage)], [camera], ALL)
        view, found = frames.views[camera], frames.segmentation[camera][0]
        for name, center in (("box_1", [0.3, 0.1, 0.1]), ("ball_1", [-0.3, -0.2, 0.1])):
            x, y, z = view.intrinsics[0] @ view.mat[0].T @ (np.array(center) - view.pos[0])
            assert found[round(y / z), round(x / z)] == stage.instances.index(name)


def test_collision_geoms_are_not_drawn(renderer: GlRenderer, stage: Stage) -> None:
    mask = renderer.render([shot(stage)], ["agentview"], ALL).segmentation["agentview"][0] == 2
    assert mask.sum() < 80  # the collision box would cover nine times as much


def test_what_no_camera_sees_is_left_out_and_nothing_else(stage: Stage) -> None:
    """Culling: wherever the box goes, its image is the one with everything drawn."""
    rng = np.random.default_rng(0)
    poses = [shot(stage, box=tuple(rng.uniform(-1.2, 1.2, 2))) for _ in range(40)]
    culled, whole = GlRenderer([stage], height=SIZE, width=SIZE), GlRenderer([stage], height=SIZE, width=SIZE)
    try:
        images = rgb(culled, *poses)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(stage, "_always", np.ones(stage.model.ngeom, bool))
            np.testing.assert_array_equal(rgb(whole, *poses), images)
        assert len(np.unique(images.reshape(40, -1), axis=0)) > 10
    finally:
        culled.close()
        whole.close()


MIRRORED = """
<mujoco>
  <asset>
    <material name="mirror" rgba="0.2 0.2 0.2 1" reflectance="0.8"/>
    <mesh name="cube" vertex="-1 -1 -1 1 -1 -1 -1 1 -1 1 1 -1 -1 -1 1 1 -1 1 -1 1 1 1 1 1" scale="0.1 0.1 0.1"/>
  </asset>
  <worldbody>
    <light pos="0 0 5" castshadow="false"/>
    <camera name="agentview" pos="0 -1 1" xyaxes="1 0 0 0 0.7 0.7" fovy="40"/>
    <geom name="plate" type="{kind}" size="{size}" pos="0 0 0.02" material="mirror" group="1"/>
    <body name="box_1_main" pos="0 0.5 1.5">
      <freejoint/>
      <geom name="box_1_g0" type="mesh" mesh="cube" rgba="0.8 0.1 0.1 1" group="1"/>
    </body>
    <body name="ball_1_main" pos="-0.3 -0.2 5"><freejoint/><geom type="sphere" size="0.1" group="1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(("kind", "size"), [("plane", "0.4 0.4 0.1"), ("plane", "0 0 0.1"), ("box", "0.4 0.4 0.02")])
def test_a_mirror_shows_what_the_image_does_not(kind: str, size: str) -> None:
    scene = dataclasses.replace(
        tiny_scene(), model=mujoco.MjModel.from_xml_string(MIRRORED.format(kind=kind, size=size))
    )
    stage, rng = Stage(scene), np.random.default_rng(1)
    model = stage.model
    shots = []
    for place in [(0, 0.5, 1.5), (0, 3, 0.5), *rng.uniform((-1, -1, 0.2), (1, 2, 2.5), (30, 3))]:
        qpos = model.qpos0.copy()
        qpos[:3] = place
        shots.append(Shot(0, Pose(qpos, model.body_pos.copy(), model.body_quat.copy())))
    culled, whole = GlRenderer([stage], height=SIZE, width=SIZE), GlRenderer([stage], height=SIZE, width=SIZE)
    try:
        images = rgb(culled, *shots)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(stage, "_always", np.ones(model.ngeom, bool))
            np.testing.assert_array_equal(rgb(whole, *shots), images)
        with pytest.MonkeyPatch.context() as patch:
            # The first is in the mirror only.
            patch.setattr(stage._mirrors, "cones", lambda *_: iter(()))
            assert (rgb(whole, shots[0]) != images[0]).any()
    finally:
        culled.close()
        whole.close()


def test_the_sky_is_left_out_only_where_the_floor_hides_it(stage: Stage) -> None:
    pose = shot(stage).pose
    down, level = (stage.view(name, pose, VisualOptions(), 0) for name in ("agentview", "side"))
    assert stage._walls.fill(stage._data, down, 1.0)
    assert not stage._walls.fill(stage._data, level, 1.0)
    assert not stage._walls.fill(stage._data, down, 3.0)  # so wide an image shows what is beside the floor
    below = UserCamera.looking_at("below", eye=[0, 0, -2], target=[0, 0, 0], up=[1, 0, 0])
    assert not stage._walls.fill(stage._data, stage.view(below, pose, VisualOptions(), 0), 1.0)


def test_a_user_camera_in_a_cameras_place_sees_the_same(renderer: GlRenderer, stage: Stage) -> None:
    model = stage.model
    camera = model.camera("side")
    same = UserCamera(name="mine", pos=camera.pos, quat=camera.quat, fovy=camera.fovy[0])
    np.testing.assert_array_equal(rgb(renderer, shot(stage), camera=same), rgb(renderer, shot(stage), camera="side"))


def test_user_cameras_differ_between_slots(renderer: GlRenderer, stage: Stage) -> None:
    two = UserCamera(name="two", pos=[[0, 0, 2], [0.3, 0.1, 1]], quat=[1, 0, 0, 0], fovy=[45, 20])
    frames = renderer.render([shot(stage)] * 2, [two], ALL)
    box = frames.segmentation["two"] == stage.instances.index("box_1")
    assert box[1].mean() > 4 * box[0].mean()
    assert frames.views["two"].pos.tolist() == [[0, 0, 2], [0.3, 0.1, 1]]


def test_a_camera_can_look_at_a_point(renderer: GlRenderer, stage: Stage) -> None:
    camera = UserCamera.looking_at("mine", eye=[1.0, -1.0, 1.0], target=[0.3, 0.1, 0.1], fovy=30)
    found = renderer.render([shot(stage)], [camera], ALL).segmentation["mine"][0]
    assert found[SIZE // 2, SIZE // 2] == stage.instances.index("box_1")


@pytest.mark.parametrize(
    "wrong",
    [
        {"pos": [0, 0], "quat": [1, 0, 0, 0]},
        {"pos": [0, 0, 0], "quat": [0, 0, 0, 0]},
        {"pos": [0, 0, np.nan], "quat": [1, 0, 0, 0]},
        {"pos": [0, 0, 0], "quat": [1, 0, 0, 0], "fovy": 180},
    ],
)
def test_impossible_cameras_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(RenderError, match="mine"):
        UserCamera(name="mine", **wrong)


def test_unknown_names_are_refused(renderer: GlRenderer, stage: Stage) -> None:
    with pytest.raises(RenderError, match=r"no camera 'front'.*agentview, side"):
        renderer.render([shot(stage)], ["front"])
    for options, message in (
        (VisualOptions(colors={"cup": (1, 0, 0)}), "no instance or material 'cup'"),
        (VisualOptions(textures={"cloth": "wood"}), "no texture 'wood'.*checks"),
        (VisualOptions(textures={"silk": "plain"}), "no material 'silk'.*cloth"),
        (VisualOptions(cameras={"front": CameraShift()}), "no camera 'front'"),
    ):
        with pytest.raises(RenderError, match=message):
            renderer.render([shot(stage, options=options)], ["agentview"])


@pytest.mark.parametrize(
    "options", [{"height": 0}, {"width": 5000}, {"lod": "best"}, {"num_threads": 0}, {"colors": "dark"}]
)
def test_impossible_configurations_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(RenderError):
        RenderConfig(**options)


def test_light_scales(renderer: GlRenderer, stage: Stage) -> None:
    bright, dim = rgb(renderer, shot(stage), shot(stage, options=VisualOptions(light=0.5)))
    assert dim.mean() == pytest.approx(bright.mean() / 2, rel=0.05)
    red = rgb(renderer, shot(stage, options=VisualOptions(light_color=(1.0, 0.0, 0.0))))[0]
    assert red[..., 0].mean() == pytest.approx(bright[..., 0].mean(), rel=0.01)
    assert red[..., 1:].max() == 0


def test_lamps_move(renderer: GlRenderer, stage: Stage) -> None:
    moved = VisualOptions(light_shift=(2.0, 0.0, 0.0))
    assert (rgb(renderer, shot(stage, options=moved)) != rgb(renderer, shot(stage))).any()


def test_colours_change_one_instance(renderer: GlRenderer, stage: Stage) -> None:
    plain = renderer.render([shot(stage)], ["agentview"], ALL)
    for name in ("box_1", "ball_1"):
        options = VisualOptions(colors={name: (1.0, 0.0, 1.0)})
        changed = (rgb(renderer, shot(stage, options=options)) != plain.rgb["agentview"]).any(axis=-1)[0]
        mask = plain.segmentation["agentview"][0] == stage.instances.index(name)
        assert changed.sum() > 0.5 * mask.sum()
        assert (changed & ~_grown(mask)).sum() == 0


def _grown(mask: np.ndarray) -> np.ndarray:
    """With the pixels around it, which antialiasing blends."""
    padded = np.pad(mask, 1)
    return np.max([np.roll(padded, (i, j), (0, 1))[1:-1, 1:-1] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)


def test_textures_are_swapped_in_one_slot_only(renderer: GlRenderer, stage: Stage) -> None:
    swapped = shot(stage, options=VisualOptions(textures={"cloth": "checks"}))
    plain = shot(stage)
    images = rgb(renderer, plain, swapped, plain, swapped, plain)
    np.testing.assert_array_equal(images[0], images[2])
    np.testing.assert_array_equal(images[0], images[4])
    assert (images[1] != images[0]).any()


def test_cameras_are_shifted_in_their_own_frame(renderer: GlRenderer, stage: Stage) -> None:
    closer = VisualOptions(cameras={"agentview": CameraShift(pos=(0.0, 0.0, -1.0), fovy=5.0)})
    frames = renderer.render([shot(stage), shot(stage, options=closer)], ["agentview"], ALL)
    assert frames.views["agentview"].pos[1].tolist() == [0, 0, 1]
    assert frames.depth["agentview"][1].max() == pytest.approx(1.0, abs=1e-3)
    assert frames.views["agentview"].intrinsics[1, 1, 1] < frames.views["agentview"].intrinsics[0, 1, 1]


def test_options_leave_no_trace(renderer: GlRenderer, stage: Stage) -> None:
    before = rgb(renderer, shot(stage))
    wild = VisualVariation(
        light=0.5, light_color=0.5, light_shift=1.0, camera_pos=0.3, camera_turn=0.2, camera_fovy=5.0, color=0.9,
        instances=("box_1", "ball_1", "robot"), textures={"cloth": ["checks"]},
    )  # fmt: skip
    drawn = [shot(stage, options=wild.draw((7, episode))) for episode in range(8)]
    assert len(np.unique(rgb(renderer, *drawn).reshape(8, -1), axis=0)) == 8
    np.testing.assert_array_equal(rgb(renderer, shot(stage)), before)


def test_variation_depends_on_the_seed_alone() -> None:
    variation = VisualVariation(light=0.2, camera_pos=0.1, color=0.5, instances=("box_1",))
    assert variation.draw((3, 1)) == variation.draw((3, 1))
    assert variation.draw((3, 1)) != variation.draw((3, 2))
    assert VisualVariation(cameras=()).draw(0) == VisualOptions()
