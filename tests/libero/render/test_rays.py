"""Ray-traced images of batches: on the device, in NumPy, of some slots, of several scenes; verbs in JAX arrays."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
from support.images import needs_gl, psnr

import vecenv
from vecenv.libero.config import LiberoError
from vecenv.libero.render.gl import GlError
from vecenv.libero.render.options import RenderConfig, RenderError
from vecenv.libero.render.ray_poses import BodyPoses
from vecenv.libero.tasks.sources import installed_tasks
from vecenv.observations import UnknownCamera

pytest.importorskip("warp")
pytestmark = pytest.mark.usefixtures("quick_compilation")

RAYS = RenderConfig(height=24, width=32, lod="fast", engine="raytrace")
IDLE = np.array([0, 0, 0, 0, 0, 0, -1.0])


def batch(suite: str = "libero_spatial", **options: Any) -> Any:
    env = vecenv.make(suite, **{"tasks": [0], "episodes": [0, 1, 2], "render": RAYS, **options})
    env.reset()
    return env


@pytest.mark.parametrize(
    ("suite", "task"), [("libero_spatial", 0), ("libero_10", 2), ("libero_10", 3), ("libero_90", 40)]
)
def test_poses_are_those_of_mujoco(suite: str, task: int) -> None:
    model = installed_tasks(suite)[task].scene(()).model
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    own = copy.copy(model)
    poses = jax.jit(BodyPoses(model))
    for _ in range(3):
        qpos = rng.normal(size=model.nq)
        pos = model.body_pos + rng.normal(scale=0.1, size=model.body_pos.shape)
        quat = rng.normal(size=model.body_quat.shape)
        quat /= np.linalg.norm(quat, axis=1, keepdims=True)
        own.body_pos[:], own.body_quat[:], data.qpos[:] = pos, quat, qpos
        mujoco.mj_kinematics(own, data)
        found_pos, found_quat = poses(*(np.asarray(array, np.float32) for array in (qpos, pos, quat)))
        np.testing.assert_allclose(found_pos, data.xpos, atol=2e-5)
        np.testing.assert_allclose(found_quat, data.xquat, atol=2e-5)


def test_mocap_bodies_are_refused() -> None:
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body mocap='true'/></worldbody></mujoco>")
    with pytest.raises(RenderError, match="mocap"):
        BodyPoses(model)


def test_images_on_the_device_are_those_in_numpy_and_do_not_change() -> None:
    env = batch()
    seen = env.observe_egocentric()
    for images in (seen.images_device, seen.segmentations_device):
        images.prepare("agentview", "wrist")
    before = {name: np.array(seen.images_device[name]) for name in ("agentview", "wrist")}
    for name, image in before.items():
        assert isinstance(seen.images_device[name], jax.Array)
        np.testing.assert_array_equal(seen.images[name], image)
        np.testing.assert_array_equal(seen.segmentations_device[name], seen.segmentations[name])
    late = env.observe_egocentric()  # not read yet
    seen.images["agentview"][:] = 0  # NumPy arrays are the caller's
    env.step_continuous(np.tile([1.0, -1, 1, 0, 0, 0, -1], (3, 4, 1)))
    now = env.observe_egocentric().images
    now.prepare("agentview", "wrist")
    late.images.prepare("agentview", "wrist")
    for name, image in before.items():
        np.testing.assert_array_equal(late.images[name], image)  # an image shows when its observation was made
        assert (now[name] != image).any()
    env.close()


def test_images_go_to_torch_without_a_copy() -> None:
    torch = pytest.importorskip("torch")
    env = batch()
    image = env.observe_egocentric().images_device["agentview"]
    there = torch.from_dlpack(image)
    assert there.data_ptr() == image.unsafe_buffer_pointer()
    np.testing.assert_array_equal(there.numpy(), np.asarray(image))
    env.close()


def test_only_the_slots_that_are_asked_for_are_drawn() -> None:
    env = batch(episodes=range(6))
    every, some = env.observe_egocentric().images, env.observe_egocentric(slots=[4, 1, 2]).images
    for images in (every, some):
        images.prepare("agentview", "wrist")
    for name in ("agentview", "wrist"):
        # Another number of worlds is another program, whose sums may differ in their last bit.
        assert psnr(some[name][[1, 2, 4]], every[name][[1, 2, 4]]) > 50
        assert not some[name][[0, 3, 5]].any()
    assert not env.observe_egocentric(slots=[]).images["agentview"].any()
    env.close()


@pytest.mark.heavy
def test_slots_of_several_scenes_show_their_own() -> None:
    env = batch("libero_goal_object", tasks=[0, 1], episodes=[0, 1])
    env.set_episodes(tasks=[0, 1, 0, 1], episodes=[0, 1, 2, 3])
    env.reset()
    seen = env.observe_egocentric().images
    seen.prepare("agentview", "wrist")
    assert len(env.mj_models) == 2
    for task, slots in ((0, [0, 2]), (1, [1, 3])):
        alone = batch("libero_goal_object", tasks=[task], episodes=slots)
        theirs = alone.observe_egocentric().images
        for name in ("agentview", "wrist"):
            np.testing.assert_array_equal(seen[name][slots], theirs[name])
        alone.close()
    env.close()


@needs_gl
def test_images_of_gl_are_not_on_a_device() -> None:
    env = batch(render=RenderConfig(height=24, width=32, lod="fast"))
    seen = env.observe_egocentric()
    with pytest.raises(GlError, match="engine='raytrace'"):
        seen.images_device["agentview"]
    with pytest.raises(UnknownCamera, match="sideview_2"):
        seen.images_device["sideview_2"]
    env.close()


# -- verbs in JAX arrays -----------------------------------------------------------------------------------------------


def arrays_of(result: Any) -> dict[str, Any]:
    fields = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
    fields |= {f"info.{name}": value for name, value in fields.pop("info", {}).items()}
    return {name: value for name, value in fields.items() if isinstance(value, np.ndarray | jax.Array)}


def require_equal(ours: Any, theirs: Any) -> None:
    """The same numbers in JAX arrays as in NumPy's."""
    found, expected = arrays_of(ours), arrays_of(theirs)
    assert found.keys() == expected.keys()
    for name, array in found.items():
        assert isinstance(array, jax.Array), name
        np.testing.assert_allclose(np.asarray(array), expected[name], rtol=1e-6, atol=1e-6, err_msg=name)


def test_verbs_take_and_return_jax_arrays() -> None:
    ours, theirs = batch(arrays="jax"), batch()
    rng = np.random.default_rng(0)
    require_equal(ours.reset(), theirs.reset())
    for shape in ((3, 7), (3, 4, 7)):
        actions = rng.uniform(-1.2, 1.2, shape).astype(np.float32)
        require_equal(ours.step_continuous(jax.numpy.asarray(actions)), theirs.step_continuous(actions))
    pose = np.tile([0.0, 0, 1.1, 0, 1, 0, 0, 0], (3, 1)).astype(np.float32)
    require_equal(ours.step_ee_pose(jax.numpy.asarray(pose)), theirs.step_ee_pose(pose))
    require_equal(ours.evaluate(), theirs.evaluate())
    require_equal(ours.state(), theirs.state())
    seen, expected = ours.observe_egocentric(), theirs.observe_egocentric()
    require_equal(seen, expected)
    for each in (seen, expected):
        each.images.prepare("agentview", "wrist")
    for name in ("agentview", "wrist"):
        assert isinstance(seen.images[name], jax.Array)
        np.testing.assert_array_equal(np.asarray(seen.images[name]), expected.images[name])
    assert isinstance(seen.observation[1], jax.Array)
    ours.close()
    theirs.close()


def test_a_state_in_jax_arrays_is_taken_back() -> None:
    env = batch(arrays="jax")
    before = env.state()
    env.step_continuous(np.tile(IDLE, (3, 1)) + 0.5)
    assert (np.asarray(env.state().qpos) != np.asarray(before.qpos)).any()
    env.set_state(before)
    require_equal(
        env.state(),
        dataclasses.replace(
            before,
            qpos=np.asarray(before.qpos),
            **{name: np.asarray(getattr(before, name)) for name in ("qvel", "time", "nq", "nv")},
        ),
    )
    with pytest.raises(LiberoError, match="slot 1 is not finite"):
        env.set_state(qpos=before.qpos.at[1, 3].set(np.nan))
    env.close()


def test_arrays_of_another_kind_are_refused() -> None:
    with pytest.raises(LiberoError, match="arrays='torch' is not available; available: numpy, jax"):
        vecenv.make("libero_spatial", task=0, arrays="torch")
