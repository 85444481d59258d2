"""Colours are those LIBERO was published with, unless told otherwise.

``upstream_images/`` holds upstream's own images under MuJoCo 3.3.0, drawn by Mesa's software GL, and the states they
show; `make parity` compares every scene at full size. They were written with
``python benchmarks/images_peer.py --mujoco 3.3.0 --size 64 --moments 1 --out tests/upstream_images SCENES``.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from support.images import Reference, agreement, needs_gl
from support.paths import DATA

import vecenv
from vecenv.libero.functional import FunctionalConfig, FunctionalError
from vecenv.libero.render import cameras, colors
from vecenv.libero.render.gl import choose, open_context
from vecenv.libero.render.options import RenderConfig, RenderError, VisualOptions
from vecenv.libero.render.scenery import Scenery, installed_scenery
from vecenv.libero.tasks.sources import installed_tasks
from vecenv.libero.tasks.suites import list_tasks

FOLDER = DATA / "upstream_images"
# Its floor and a bottle's map are PNG files with an sRGB chunk.
DECODED = "libero_object-0"
# It has none; it has walls whose texture begins elsewhere since MuJoCo 3.12, and a stove.
PLAIN = "libero_10-2"
# Other drivers than the one that drew the files draw edges otherwise: a test of colours is what any of them passes.
SAME_DRIVER, ANY_DRIVER = 40.0, 28.0
SIZE = 64


@cache
def reference(scene: str) -> Reference:
    return Reference.load(FOLDER, scene)


@cache
def drawn(scene: str, **options: Any) -> np.ndarray:
    return reference(scene).drawn(RenderConfig(height=SIZE, width=SIZE, **options))


@cache
def enough() -> float:
    """What is asked of images here, dB."""
    context = open_context(choose(), SIZE, SIZE)
    from OpenGL import GL  # after MuJoCo has said which GL it shall load

    name = GL.glGetString(GL.GL_RENDERER) or b""
    context.free()
    return SAME_DRIVER if b"llvmpipe" in name else ANY_DRIVER


def problem(scene: str) -> Any:
    suite, task = scene.rsplit("-", 1)
    return list_tasks(suite)[int(task)].problem()


@needs_gl
@pytest.mark.parametrize("scene", [DECODED, PLAIN])
def test_images_are_those_that_libero_was_published_with(scene: str) -> None:
    assert agreement(drawn(scene), reference(scene).images).min() > enough()


@needs_gl
def test_fast_images_have_the_published_colours_too() -> None:
    assert agreement(drawn(DECODED, lod="fast"), reference(DECODED).images).min() > min(enough(), 30.0)


@needs_gl
def test_current_colours_are_darker_where_files_say_srgb() -> None:
    dark, published = drawn(DECODED, colors="current"), drawn(DECODED)
    assert agreement(dark, reference(DECODED).images).max() < 18.0
    assert dark.mean() < published.mean() - 25
    # The floor, which the third-person image shows in its lower left corner.
    assert (dark[0, 0, -8:, :8].mean() < published[0, 0, -8:, :8].mean() - 40).all()


@needs_gl
def test_textures_of_boxes_lie_where_they_lay() -> None:
    """Without decoded files, walls, the stove's sides and its burner are all that differs."""
    if enough() < SAME_DRIVER:
        pytest.skip("this driver's edges differ more than walls do")
    theirs = reference(PLAIN).images
    both = [drawn(PLAIN, lod="original", colors=each) for each in ("published", "current")]
    published, current = (agreement(images, theirs) for images in both)
    assert (published > current + 2.0).all()


@needs_gl
def test_a_texture_that_walls_are_given_is_seen_on_them() -> None:
    """Also one of the six sides of a cube, which no mesh can wear."""
    suite, task, swapped, seen = "libero_10", 0, [], []
    for asked in ("published", "current"):
        env = vecenv.make(suite, task=task, episodes=[0], render=RenderConfig(height=SIZE, width=SIZE, colors=asked))
        env.reset()
        seen.append(env.observe_egocentric().images["agentview"])
        env.set_visuals(VisualOptions(textures={"walls_mat": "tex-table"}))  # type: ignore[attr-defined]
        swapped.append(env.observe_egocentric().images["agentview"])
        env.set_visuals(VisualOptions())  # type: ignore[attr-defined]
        np.testing.assert_array_equal(env.observe_egocentric().images["agentview"], seen[-1])
        env.close()
    assert (seen[0] != seen[1]).any()
    np.testing.assert_array_equal(*swapped)
    assert np.abs(swapped[0].astype(int) - seen[0]).max() > 20


def test_colours_that_there_are_none_of_are_refused(tmp_path: Path) -> None:
    for refused in ("linear", "Published", "", None):
        with pytest.raises(RenderError, match=r"colors=.*: expected (one of published, current|str)"):
            RenderConfig(colors=refused)  # type: ignore[arg-type]
    with pytest.raises(FunctionalError, match="colors='srgb': expected one of published, current"):
        FunctionalConfig(colors="srgb")
    with pytest.raises(RenderError, match="expected one of published, current"):
        installed_scenery(problem(DECODED), colors="srgb")


def test_scenes_of_different_colours_are_kept_apart() -> None:
    physics = installed_tasks("libero_object")[0].scene(()).model
    stages = {each: cameras.stage_of(problem(DECODED), physics, "fast", each) for each in ("published", "current")}
    assert cameras.stage_of(problem(DECODED), physics, "fast", "current") is stages["current"]
    srgb = int(mujoco.mjtColorSpace.mjCOLORSPACE_SRGB)
    assert (stages["current"].model.tex_colorspace == srgb).sum() == 2
    assert not (stages["published"].model.tex_colorspace == srgb).any()


def test_skins_are_worn_by_boxes_with_flat_textures_and_weigh_nothing() -> None:
    published, current = (colors.visual_scene(problem(PLAIN), each).model for each in ("published", "current"))
    skins = {published.geom(geom).name for geom in range(published.ngeom)} - {
        current.geom(geom).name for geom in range(current.ngeom)
    }
    walls = {f"{colors.SKIN}wall_{side}_visual" for side in ("left", "right", "rear", "front")}
    assert skins == {*walls, f"{colors.SKIN}flat_stove_1_base_vis"}
    for name in skins:
        skin, box = published.geom(name), published.geom(name.removeprefix(colors.SKIN))
        assert (skin.contype[0], skin.conaffinity[0], skin.group[0]) == (0, 0, 1)
        assert (skin.bodyid[0], skin.matid[0]) == (box.bodyid[0], box.matid[0])
    np.testing.assert_array_equal(published.body_mass, current.body_mass)
    assert (published.nq, published.nbody) == (current.nq, current.nbody)


def test_sceneries_have_colours_and_say_which(tmp_path: Path) -> None:
    made = {each: installed_scenery(problem(DECODED), colors=each) for each in ("published", "current")}
    # Brightness of all textures, which for rays are decoded beforehand.
    brightness = {each: float(scenery.model.tex_data.mean()) for each, scenery in made.items()}
    assert brightness["published"] > brightness["current"] + 1
    for each, scenery in made.items():
        assert installed_scenery(problem(DECODED), colors=each) is scenery
        scenery.save(tmp_path / f"{each}.npz")
        read = Scenery.load(tmp_path / f"{each}.npz")
        assert read.colors == scenery.colors == each
        np.testing.assert_array_equal(read.model.tex_data, scenery.model.tex_data)


def test_a_scenery_of_other_colours_is_refused() -> None:
    physics = installed_tasks("libero_object")[0].scene(()).model
    scenery = installed_scenery(problem(DECODED), colors="current")
    scenery.check(physics, "current")
    with pytest.raises(RenderError, match=r"made with colors='current' but colors='published' is requested"):
        scenery.check(physics, "published")


@pytest.mark.heavy
def test_rays_have_the_published_colours() -> None:
    pytest.importorskip("warp")
    theirs = reference(DECODED).images
    assert agreement(drawn(DECODED, engine="raytrace", lod="fast"), theirs).min() > 22.0
    assert agreement(drawn(DECODED, engine="raytrace", lod="fast", colors="current"), theirs).max() < 18.0
