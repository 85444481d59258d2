"""Levels of detail: fewer triangles, the same corners, and images close to those of all triangles, upstream's."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from support import upstream
from support.images import needs_gl, psnr, ssim

import vecenv
from vecenv.libero.render import lod
from vecenv.libero.render.options import RenderConfig
from vecenv.libero.scene.scene import compile_scene
from vecenv.libero.tasks.suites import list_tasks

# What the project promises of each image.
LEAST = {"exact": (45.0, 0.99), "fast": (32.0, 0.95)}


def corner_rows(model: mujoco.MjModel, index: int) -> set[bytes]:
    """Position and texture coordinate of every corner of a mesh."""
    mesh = lod.Mesh.of(model, index)
    columns = [mesh.vert[mesh.face.ravel()]]
    if len(mesh.texcoord):
        columns.append(mesh.texcoord[mesh.face_texcoord.ravel()])
    return {row.tobytes() for row in np.concatenate(columns, axis=1)}


@pytest.mark.parametrize(("level", "share"), [("original", 1.0), ("exact", 0.9), ("fast", 0.25)])
def test_meshes_lose_triangles_but_keep_their_corners(level: str, share: float) -> None:
    problem = list_tasks("libero_object")[0].problem()
    model = compile_scene(problem, visual=True).model
    drawn = list(lod.drawn_meshes(model))
    before, original = model.mesh_facenum.copy(), {index: corner_rows(model, index) for index in drawn}
    others = np.setdiff1d(np.arange(model.nmesh), drawn)
    left = lod.simplify(model, level)
    assert left == model.mesh_facenum[drawn].sum() <= share * before[drawn].sum()
    np.testing.assert_array_equal(model.mesh_facenum[others], before[others])
    for index in drawn:
        assert corner_rows(model, index) <= original[index]
        normals = lod.Mesh.of(model, index).normal[lod.Mesh.of(model, index).face_normal.ravel()]
        assert (np.linalg.norm(normals, axis=1) < 1 + 1e-6).all()


def test_triangles_that_stay_keep_their_normals() -> None:
    model = compile_scene(list_tasks("libero_object")[0].problem(), visual=True).model
    index = next(i for i in lod.drawn_meshes(model) if model.mesh(i).name.startswith("milk_1"))
    mesh = lod.Mesh.of(model, index)
    before, kept = mesh.normal[mesh.face_normal], lod.simplified("exact")[mesh.key].kept
    lod.simplify(model, "exact")
    mesh = lod.Mesh.of(model, index)
    assert 0 < len(kept) < len(mesh.face) < len(before)
    np.testing.assert_array_equal(mesh.normal[mesh.face_normal[: len(kept)]], before[kept])


def test_an_unknown_mesh_stays_as_it_is() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
        <worldbody><geom type="mesh" mesh="m" group="1"/></worldbody></mujoco>""")
    face = model.mesh_face.copy()
    assert lod.simplify(model) == len(face)
    np.testing.assert_array_equal(model.mesh_face, face)


def images_of(level: str, suite: str, task: int, episodes: list[int]) -> np.ndarray:
    """Both cameras after ten random actions, uint8 [2 * episodes, 256, 256, 3]."""
    env = vecenv.make(suite, task=task, episodes=episodes, render=RenderConfig(lod=level))
    env.reset()
    for tick in np.random.default_rng(task).uniform(-1, 1, (10, len(episodes), 7)):
        env.step_continuous(tick)
    images = np.concatenate(env.observe_egocentric().observation)
    env.close()
    return images


def compare(suite: str, task: int, episodes: list[int]) -> None:
    whole = images_of("original", suite, task, episodes)
    for level, (least_psnr, least_ssim) in LEAST.items():
        found = images_of(level, suite, task, episodes)
        ratios = [psnr(a, b) for a, b in zip(whole, found, strict=True)]
        likeness = [ssim(a, b) for a, b in zip(whole, found, strict=True)]
        print(f"{suite} {task} {level}: at least {min(ratios):.1f} dB, SSIM {min(likeness):.3f}")
        assert min(ratios) > least_psnr
        assert min(likeness) > least_ssim


@needs_gl
def test_simplified_images_are_close_to_upstreams() -> None:
    compare("libero_object", 0, [7])


@needs_gl
@pytest.mark.heavy
@pytest.mark.parametrize("scene_id", upstream.scene_ids())
def test_simplified_images_are_close_in_every_scene(scene_id: str) -> None:
    suite, task = scene_id.rsplit("-", 1)
    compare(suite, int(task), [0, 14, 28])
