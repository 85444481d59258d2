"""``lod="fast"``: fewer triangles, the same corners, and pictures close to upstream's."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from pictures import needs_gl, psnr, ssim

import vecenv
from vecenv.libero.scene import compile_scene
from vecenv.render import lod
from vecenv.render.options import RenderConfig

# What the project promises of each image.
LEAST_PSNR, LEAST_SSIM = 32.0, 0.95


def corner_rows(model: mujoco.MjModel, index: int) -> set[bytes]:
    """Position and texture coordinate of every corner of a mesh."""
    mesh = lod.Mesh.of(model, index)
    columns = [mesh.vert[mesh.face.ravel()]]
    if len(mesh.texcoord):
        columns.append(mesh.texcoord[mesh.face_texcoord.ravel()])
    return {row.tobytes() for row in np.concatenate(columns, axis=1)}


def test_meshes_lose_triangles_but_keep_their_corners() -> None:
    problem = vecenv.list_tasks("libero_object")[0].problem()
    model = compile_scene(problem, visual=True).model
    drawn = list(lod.drawn_meshes(model))
    before, original = model.mesh_facenum.copy(), {index: corner_rows(model, index) for index in drawn}
    others = np.setdiff1d(np.arange(model.nmesh), drawn)
    left = lod.simplify(model)
    assert left == model.mesh_facenum[drawn].sum() < 0.25 * before[drawn].sum()
    np.testing.assert_array_equal(model.mesh_facenum[others], before[others])
    for index in drawn:
        assert corner_rows(model, index) <= original[index]
        normals = lod.Mesh.of(model, index).normal[lod.Mesh.of(model, index).face_normal.ravel()]
        assert (np.linalg.norm(normals, axis=1) < 1 + 1e-6).all()


def test_an_unknown_mesh_stays_as_it_is() -> None:
    model = mujoco.MjModel.from_xml_string("""<mujoco><asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
        <worldbody><geom type="mesh" mesh="m" group="1"/></worldbody></mujoco>""")
    face = model.mesh_face.copy()
    assert lod.simplify(model) == len(face)
    np.testing.assert_array_equal(model.mesh_face, face)


def compare(suite: str, task: int, episodes: list[int]) -> None:
    actions = np.random.default_rng(task).uniform(-1, 1, (10, len(episodes), 7))
    pictures = []
    for level in ("exact", "fast"):
        env = vecenv.make(suite, task=task, episodes=episodes, render=RenderConfig(lod=level))
        env.reset()
        for tick in actions:
            env.step_continuous(tick)
        pictures.append(np.concatenate(env.observe_egocentric().observation))
        env.close()
    for exact, fast in zip(*pictures, strict=True):
        assert psnr(exact, fast) > LEAST_PSNR
        assert ssim(exact, fast) > LEAST_SSIM


@needs_gl
def test_fast_pictures_are_close_to_exact_ones() -> None:
    compare("libero_object", 0, [0, 7])


@needs_gl
@pytest.mark.heavy
@pytest.mark.parametrize(
    ("suite", "task"),
    [("libero_spatial", 0), ("libero_object", 5), ("libero_goal", 0), ("libero_10", 0), ("libero_10", 8)]
    + [("libero_90", task) for task in (10, 40, 60, 80)],
)
def test_fast_pictures_are_close_in_many_scenes(suite: str, task: int) -> None:
    compare(suite, task, [0, 7, 14, 21, 28, 35])
