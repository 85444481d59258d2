"""Fits of boxes and capsules keep the extents, areas and openings of the solids that they replace."""

from __future__ import annotations

import numpy as np
import pytest

from vecenv.libero.scene.lean import boxes, capsules, vessels
from vecenv.libero.scene.lean import solids as shapes
from vecenv.libero.scene.lean.solids import FitError, Solid, box


def upright(pos: tuple[float, float, float], size: tuple[float, float, float], angle: float = 0.0) -> Solid:
    c, s = np.cos(angle), np.sin(angle)
    return box(np.array(pos), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array(size))


def ring(count: int, radius: float = 0.05) -> list[Solid]:
    walls = []
    for k in range(count):
        angle = 2 * np.pi * k / count
        at = (radius * np.cos(angle), radius * np.sin(angle), 0.03)
        walls.append(upright(at, (0.002, radius * np.tan(np.pi / count), 0.03), angle))
    return walls


def test_merging_the_halves_of_a_box_gives_the_box() -> None:
    halves = [upright((-0.01, 0, 0), (0.01, 0.02, 0.03)), upright((0.01, 0, 0), (0.01, 0.02, 0.03))]
    (made,) = boxes.merge(halves, 1, up=2)
    np.testing.assert_allclose(made.pos, 0, atol=1e-12)
    np.testing.assert_allclose(np.sort(made.size), [0.02, 0.02, 0.03], atol=1e-9)


def test_merging_joins_what_lies_together() -> None:
    left = [upright((0, 0, z), (0.01, 0.01, 0.01)) for z in (0.01, 0.03)]
    right = [upright((0.3, 0, z), (0.01, 0.01, 0.01)) for z in (0.01, 0.03)]
    made = boxes.merge([left[0], right[0], left[1], right[1]], 2, up=2)
    assert sorted(round(float(solid.pos[0]), 6) for solid in made) == [0.0, 0.3]


def test_a_vessel_is_found_and_made_again_with_fewer_walls() -> None:
    floor = upright((0, 0, 0.002), (0.03, 0.03, 0.002))
    handle = upright((0.08, 0, 0.03), (0.004, 0.004, 0.02))
    found = vessels.find_vessel([floor, *ring(16), handle])
    assert (len(found.floor), len(found.wall), found.rest) == (1, 16, (handle,))
    np.testing.assert_allclose(found.centre, 0, atol=1e-9)
    assert found.inner == pytest.approx(0.004)
    made = vessels.vessel([floor, *ring(16), handle], walls=6, handles=1)
    assert len(made) == 8
    assert made[0].extreme_points()[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    radii = [np.linalg.norm(wall.pos[:2]) for wall in made[1:7]]
    # A hexagon whose outline is at the ring's radius on average over all directions.
    np.testing.assert_allclose(radii, 0.05 * (np.pi / 6) / np.log(np.tan(np.pi / 12 + np.pi / 4)), rtol=1e-6)


def test_what_has_no_walls_is_no_vessel() -> None:
    with pytest.raises(FitError, match="no vessel"):
        vessels.find_vessel([upright((0, 0, 0), (0.05, 0.05, 0.002))])
    with pytest.raises(FitError, match="handle"):
        vessels.vessel([upright((0, 0, 0.002), (0.03, 0.03, 0.002)), *ring(12)], walls=4, handles=1)


def test_a_column_has_the_height_and_outline_area_of_what_it_replaces() -> None:
    cylinder = Solid(shapes.CYLINDER, np.zeros(3), np.eye(3), np.array([0.03, 0.05, 0.0]))
    made = boxes.column([cylinder], up=2)
    corners = np.concatenate([solid.extreme_points() for solid in made])
    np.testing.assert_allclose(np.abs(corners[:, 2]), 0.05)
    radii = np.linalg.norm(corners[:, :2], axis=1)
    np.testing.assert_allclose(radii, radii[0])
    assert 0.03 < radii[0] < 0.033


def test_an_end_capsule_is_flush_with_the_end_and_stays_within_the_sides() -> None:
    finger = upright((0, 0.01, 0.03), (0.008, 0.006, 0.03))
    made = capsules.end_capsule([finger], np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]))
    points = made.extreme_points()
    assert points[:, 2].max() == pytest.approx(0.06)
    assert points[:, 1].min() == pytest.approx(0.004, abs=2e-4)
    palm = upright((0, 0, 0.03), (0.1, 0.02, 0.03))
    across = capsules.end_capsule([palm], np.array([0.0, 0.0, 1.0]))
    assert abs(across.mat[0, 2]) == pytest.approx(1.0)
    assert across.size[0] == pytest.approx(0.02)
    assert across.extreme_points()[:, 2].max() == pytest.approx(0.06, abs=1e-3)


def test_distances_are_signed_and_gaps_vanish_for_the_same_shape() -> None:
    cube = upright((0, 0, 0), (0.01, 0.01, 0.01))
    at = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0, 0], [0.02, 0.02, 0]])
    np.testing.assert_allclose(cube.distance(at), [-0.01, 0, 0.01, 0.01 * np.sqrt(2)], atol=1e-12)
    rod = shapes.capsule(np.zeros(3), np.array([0.0, 0.0, 0.1]), 0.01)
    np.testing.assert_allclose(rod.distance(np.array([[0.02, 0, 0.05], [0, 0, 0.12]])), 0.01, atol=1e-12)
    assert shapes.gaps([cube], [cube]).max() < 1e-12
