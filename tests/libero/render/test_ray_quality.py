"""Edges, curved meshes and textures in ray-traced images: they come close to GL's, and masks and depths stay exact."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from support.images import needs_gl, psnr
from support.small_scenery import look, small, small_drawn, small_seen

from vecenv.libero.render.ray_passes import CONTRAST
from vecenv.libero.render.raytrace import RayTracer
from vecenv.libero.render.scenery import Scenery

pytest.importorskip("warp")


def one_thing(assets: str, thing: str, camera: str = 'pos="0 -1 0" xyaxes="1 0 0 0 0 1" fovy="40"') -> Scenery:
    """A scenery of a single geom, seen by the two cameras that ``small`` has, which here are the same."""
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <visual><headlight ambient=".2 .2 .2" diffuse=".6 .6 .6" specular="0 0 0"/><map znear="0.01" zfar="50"/></visual>
  <statistic extent="1"/>
  <asset>{assets}</asset>
  <worldbody>
    <light pos="1 -1 1" dir="-1 1 -1" diffuse=".4 .4 .4" specular="0 0 0"/>
    <geom {thing} group="1"/>
    <camera name="front" {camera}/> <camera name="low" {camera}/>
  </worldbody>
</mujoco>""")
    return Scenery(model=model, instances=("", "all"), instance_of_geom=np.ones(model.ngeom, np.int16))


def test_masks_and_depths_are_those_of_one_ray_through_the_middle() -> None:
    with_more, alone = (small_seen(small(), depth=True, segmentation=True, antialias=on) for on in (True, False))
    np.testing.assert_array_equal(with_more.depth, alone.depth)
    np.testing.assert_array_equal(with_more.segmentation, alone.segmentation)
    assert (with_more.rgb != alone.rgb).any()


@pytest.mark.parametrize("tile", [(8, 8), (4, 16), (1, 1)])
def test_only_pixels_that_differ_from_their_neighbours_get_more_rays(tile: tuple[int, int]) -> None:
    with_more, alone = (small_seen(small(), antialias=on, tile=tile).rgb.astype(int) for on in (True, False))
    padded = np.pad(alone, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    middle = padded[:, 1:-1, 1:-1]
    across = np.abs(padded[:, 1:-1, 2:] + padded[:, 1:-1, :-2] - 2 * middle)
    down = np.abs(padded[:, 2:, 1:-1] + padded[:, :-2, 1:-1] - 2 * middle)
    contrast = np.maximum(across, down).max(-1)
    changed = (with_more != alone).any(-1)
    # What is compared is not yet rounded: half a unit in each of two neighbours, and one in twice the pixel.
    assert not changed[contrast < CONTRAST - 2].any()
    assert changed[contrast > CONTRAST + 2].mean() > 0.5


def test_pixels_at_an_edge_show_the_mean_of_four_points() -> None:
    """A white pane on black, its edge a little right of the middle of a pixel: two of GL's four points are beyond."""
    side, fovy = 32, 40.0
    half = np.tan(np.deg2rad(fovy) / 2)
    edge = (4.5 / 8 / side) * 2 * half  # of the pixel right of the middle, 1 m away
    assets = '<material name="white" emission="1" specular="0"/>'
    found = one_thing(assets, f'type="box" size="1 .5 2" pos="{edge - 1} .5 0" rgba="1 1 1 1" material="white"')
    rgb = small_seen(found, height=side, width=side).rgb[0].astype(int)
    column = rgb[side // 2, :, 0][::-1]  # as the camera sees it, left to right
    assert (rgb == rgb[:1]).all()
    assert (column[: side // 2] == 255).all()
    assert (column[side // 2 + 1 :] == 0).all()
    assert abs(column[side // 2] - 255 / 2) <= 1


def ball(count: int) -> tuple[str, str]:
    """A sphere of triangles, in circles of ``count``, with the normals of a sphere."""
    turns, rises = np.linspace(0, 2 * np.pi, count, endpoint=False), np.linspace(-np.pi / 2, np.pi / 2, count // 2 + 1)
    rows = [[np.cos(b) * np.cos(a), np.cos(b) * np.sin(a), np.sin(b)] for b in rises for a in turns]
    faces = []
    for ring in range(len(rises) - 1):
        for column in range(count):
            a, b = ring * count + column, ring * count + (column + 1) % count
            faces += [[a, b, b + count], [a, b + count, a + count]]
    points = np.round(np.array(rows), 6)
    corners = [points[face] for face in faces]
    solid = [
        f for f, c in zip(faces, corners, strict=True) if np.linalg.norm(np.cross(c[1] - c[0], c[2] - c[0])) > 1e-6
    ]

    def text(array: Any) -> str:
        return " ".join(str(x) for x in np.asarray(array).ravel())

    mesh = f'<mesh name="ball" scale=".3 .3 .3" vertex="{text(points)}" normal="{text(points)}" face="{text(solid)}"/>'
    return mesh, 'type="mesh" mesh="ball" rgba=".7 .6 .5 1"'


@needs_gl
def test_curved_meshes_are_shaded_by_blended_normals() -> None:
    found = one_thing(*ball(24))
    seen, drawn = small_seen(found).rgb[0], small_drawn(found)[0]
    inside = (slice(44, 84), slice(44, 84))
    assert psnr(seen[inside], drawn[inside]) > 40
    found.model.mesh_normal[:] = 0  # nothing to blend: each triangle has its own
    assert psnr(small_seen(found).rgb[0][inside], drawn[inside]) < 36


@needs_gl
@pytest.mark.parametrize(
    "thing",
    [
        'type="plane" size="4 8 1" pos="0 0 -.3"',
        'type="box" size="4 8 .1" pos="0 6 -.4"',
    ],
)
@pytest.mark.parametrize("side", [256, 255])
def test_textures_far_away_are_averaged_as_in_gl(thing: str, side: int) -> None:
    assets = (
        f'<texture name="squares" type="2d" builtin="checker" width="{side}" height="{side}" '
        'rgb1=".9 .9 .5" rgb2=".3 .5 .9"/>'
        '<material name="floor" texture="squares" texrepeat="16 32" specular="0" emission="1"/>'
    )
    found = one_thing(assets, f'{thing} material="floor"')
    seen, drawn = small_seen(found, antialias=False).rgb[0], small_drawn(found)[0]
    below = slice(72, None)  # the horizon, and where the box ends
    assert psnr(seen[below], drawn[below]) > 38  # 15 to 20 without mipmaps


def test_samples_for_every_pixel_are_not_antialiased_again() -> None:
    full = RayTracer(small(), height=8, width=8, cameras=("front",), samples=2)
    depth_only = RayTracer(small(), height=8, width=8, cameras=("front",), rgb=False, depth=True)
    state = np.zeros((1, 1, 3), np.float32), np.array([[[1, 0, 0, 0]]], np.float32), np.zeros((1, 0), np.float32)
    assert look(full, state).rgb.shape == (1, 1, 8, 8, 3)
    assert (look(depth_only, state).depth > 0).any()
