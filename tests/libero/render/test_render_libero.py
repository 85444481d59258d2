"""What ``observe_egocentric`` shows of a LIBERO batch: which images, of which moment, and where their pixels lie."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from support.images import needs_gl

import vecenv
from vecenv.libero.env import LiberoEnv
from vecenv.libero.render import contexts, gl
from vecenv.libero.render.gl import GlError
from vecenv.libero.render.options import CameraShift, RenderConfig, RenderError, UserCamera, VisualOptions
from vecenv.observations import Egocentric, ImagesUnavailable

pytestmark = needs_gl

OVERHEAD = UserCamera.looking_at("overhead", eye=[0.0, 0.0, 1.5], target=[0.0, 0.0, 0.0], up=[1, 0, 0])


@pytest.fixture(scope="module")
def batch() -> Iterator[LiberoEnv]:
    env = vecenv.make(
        "libero_object", task=0, episodes=[0, 1], max_steps=2, render=RenderConfig(cameras=[OVERHEAD], num_threads=2)
    )
    assert isinstance(env, LiberoEnv)
    yield env
    env.close()


@pytest.fixture
def env(batch: LiberoEnv) -> LiberoEnv:
    """Two episodes at their start."""
    batch.set_episodes(episodes=[0, 1])
    batch.set_visuals(VisualOptions())
    batch.reset()
    return batch


def moved(env: LiberoEnv) -> None:
    env.step_continuous(np.tile([0.5, 0.5, -0.5, 0.0, 0.0, 0.0, 1.0], (env.num_envs, 1)))


def test_policies_get_their_two_images(env: LiberoEnv) -> None:
    seen = env.observe_egocentric()
    first, second = seen.observation
    assert first.shape == second.shape == (2, 256, 256, 3)
    assert first.dtype == np.uint8
    assert first is seen.rgb is seen.agentview_image
    assert second is seen.wrist_image
    np.testing.assert_array_equal(second, seen.images["robot0_eye_in_hand"])
    assert (first[0] != first[1]).any()


def test_the_image_is_upright(env: LiberoEnv) -> None:
    """The robot stands at the far end of the floor, so its base is seen in the upper half."""
    seen = env.observe_egocentric()
    rows = np.nonzero(seen.segmentation[0] == seen.instances[0].index("robot"))[0]
    assert rows.mean() < 100


def test_only_what_is_read_is_rendered(env: LiberoEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    render = gl.GlRenderer.render

    def spy(self: gl.GlRenderer, shots: list, cameras: list, wanted: gl.Wanted) -> gl.Frames:
        asked.append((list(cameras), wanted))
        return render(self, shots, cameras, wanted)

    monkeypatch.setattr(gl.GlRenderer, "render", spy)
    seen = env.observe_egocentric()
    assert not asked
    for _ in range(2):
        assert seen.rgb.any()
    assert asked == [(["agentview"], gl.Wanted(rgb=True))]
    assert seen.depth.any()
    assert asked[1:] == [(["agentview"], gl.Wanted(rgb=False, depth=True))]
    assert len(env.observe_egocentric().observation) == 2
    assert asked[2:] == [(["agentview", "wrist"], gl.Wanted(rgb=True))]


def test_images_stay_those_of_their_moment(env: LiberoEnv) -> None:
    early, again = env.observe_egocentric(), env.observe_egocentric()
    image = early.rgb
    moved(env)
    np.testing.assert_array_equal(again.rgb, image)
    assert (env.observe_egocentric().rgb != image).any()


def test_a_finished_slot_shows_its_last_frame(env: LiberoEnv) -> None:
    for _ in range(2):
        moved(env)
    last = env.observe_egocentric().observation
    moved(env)
    after = env.observe_egocentric().observation
    for a, b in zip(last, after, strict=True):
        np.testing.assert_array_equal(a, b)
    env.reset()
    assert (env.observe_egocentric().rgb != last[0]).any()


def test_pixels_of_a_thing_lie_on_it(env: LiberoEnv) -> None:
    """Masks, depths and poses agree with the ground truth of ``observe_objects``, in both cameras."""
    seen, truth = env.observe_egocentric(), env.observe_objects()
    checked = 0
    for camera in ("agentview", "wrist", "overhead"):
        masks = seen.segmentations[camera]
        for slot, snapshot in enumerate(truth.snapshot):
            assert snapshot is not None
            for name in snapshot.names:
                ys, xs = np.nonzero(masks[slot] == seen.instances[slot].index(name))
                if len(xs) < 30:
                    continue
                points = seen.points_from_pixels(camera, np.stack([xs, ys], axis=1))[slot]
                cloud = snapshot.objects[name].points
                low, high = cloud.min(axis=0) - 0.02, cloud.max(axis=0) + 0.02
                assert ((points > low) & (points < high)).all(axis=1).mean() > 0.97, (camera, slot, name)
                checked += 1
    assert checked > 20


def test_pixels_outside_the_image_are_refused(env: LiberoEnv) -> None:
    with pytest.raises(IndexError, match="256"):
        env.observe_egocentric().points_from_pixels("agentview", np.array([[256, 0]]))


def test_there_are_all_cameras_of_the_scene_and_ones_own(env: LiberoEnv) -> None:
    seen = env.observe_egocentric()
    assert {"agentview", "wrist", "robot0_eye_in_hand", "frontview", "birdview", "overhead"} <= set(seen.images)
    assert seen.images["overhead"].any()
    with pytest.raises(ImagesUnavailable, match=r"no depth image of camera 'sky': available: .*agentview"):
        seen.points_from_pixels("sky", np.zeros((1, 2)))


def test_intrinsics_are_the_third_person_cameras(env: LiberoEnv) -> None:
    seen = env.observe_egocentric()
    assert seen.intrinsics is not None
    focal = 128 / np.tan(np.deg2rad(env.mj_model.camera("agentview").fovy[0]) / 2)
    np.testing.assert_allclose(seen.intrinsics[0], [[-focal, 0, 127.5], [0, focal, 127.5], [0, 0, 1]])


def test_visual_options_change_their_slot_only(env: LiberoEnv) -> None:
    before, state = env.observe_egocentric(), env.state().qpos.copy()
    env.set_visuals([VisualOptions(), VisualOptions(light=0.4, cameras={"wrist": CameraShift(pos=(0.02, 0.0, 0.0))})])
    after = env.observe_egocentric()
    np.testing.assert_array_equal(after.rgb[0], before.rgb[0])
    assert after.rgb[1].mean() < 0.7 * before.rgb[1].mean()
    assert np.linalg.norm(after.views["wrist"].pos[1] - before.views["wrist"].pos[1]) == pytest.approx(0.02)
    np.testing.assert_array_equal(env.state().qpos, state)
    with pytest.raises(RenderError, match="3 visual options for 2 slots"):
        env.set_visuals([VisualOptions()] * 3)


def test_a_camera_of_a_taken_name_is_refused() -> None:
    render = RenderConfig(cameras=[UserCamera(name="agentview", pos=[0, 0, 1], quat=[1, 0, 0, 0])])
    env = vecenv.make("libero_object", task=0, episodes=[0], render=render)
    try:
        env.reset()
        with pytest.raises(RenderError, match="already has a camera 'agentview'"):
            env.observe_egocentric()
    finally:
        env.close()


def test_physics_needs_no_gl(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(contexts, "_loads", lambda library: False)
    env = vecenv.make("libero_object", task=0, episodes=[0])
    try:
        env.reset()
        seen = env.observe_egocentric()
        assert seen.state.shape == (1, 8)
        with pytest.raises(GlError, match="libegl1"):
            _ = seen.rgb
        assert env.step_continuous(np.zeros((1, 7))).step_index[0] == 1
    finally:
        env.close()


def test_after_closing_only_what_was_read_is_there() -> None:
    env = vecenv.make("libero_object", task=0, episodes=[0])
    env.reset()
    seen: Egocentric = env.observe_egocentric()
    image = seen.rgb
    env.close()
    assert seen.rgb is image
    with pytest.raises(GlError, match="closed"):
        _ = seen.wrist_image
