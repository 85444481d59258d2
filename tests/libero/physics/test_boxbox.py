"""Our colliders against contacts that MuJoCo 3.3.0 recorded, as plain functions."""

from __future__ import annotations

import numpy as np
import pytest
from support.paths import DATA

from vecenv.libero.physics.colliders.boxbox import box_box
from vecenv.libero.physics.colliders.boxbox_numba import MOST

RECORDED = DATA / "box_contacts_mujoco_3_3_0.npz"


@pytest.fixture(scope="module")
def recorded() -> tuple[np.ndarray, list[np.ndarray]]:
    """Pairs [n, 31] (centre, rotation and half size of either box, margin) and the contacts of each, [k, 7]."""
    with np.load(RECORDED, allow_pickle=False) as file:
        poses, rows = file["poses"], file["contacts"]
    return poses, [rows[rows[:, 0] == pair, 1:] for pair in range(len(poses))]


def ours(pose: np.ndarray) -> np.ndarray:
    first, second, margin = pose[:15], pose[15:30], pose[30]
    return box_box(first[:3], first[3:12], first[12:], second[:3], second[3:12], second[12:], margin)


def test_count_position_normal_and_depth_are_those_of_mujoco_3_3_0(
    recorded: tuple[np.ndarray, list[np.ndarray]],
) -> None:
    poses, contacts = recorded
    for number, (pose, wanted) in enumerate(zip(poses, contacts, strict=True)):
        found = ours(pose)
        # Nine in four of the pairs: MuJoCo 3.17 has room for eight.
        assert len(found) == min(len(wanted), MOST), f"pair {number}"
        np.testing.assert_allclose(found, wanted[: len(found)], rtol=0, atol=1e-9, err_msg=f"pair {number}")


def test_the_recording_has_every_number_of_contacts(recorded: tuple[np.ndarray, list[np.ndarray]]) -> None:
    assert {len(wanted) for wanted in recorded[1]} >= set(range(MOST + 1))


def test_a_face_contact_is_half_as_deep_as_the_boxes_overlap() -> None:
    turn = np.eye(3)
    found = box_box([0, 0, 0], turn, [0.1, 0.1, 0.1], [0, 0, 0.14], turn, [0.05, 0.05, 0.05])  # type: ignore[arg-type]
    assert len(found) == 4
    np.testing.assert_allclose(found[:, 0], -0.005)
    np.testing.assert_allclose(found[:, 3], 0.095)
    np.testing.assert_allclose(found[:, 4:], [[0, 0, 1]] * 4)


def test_an_edge_contact_is_as_deep_as_the_boxes_overlap() -> None:
    def about(axis: int) -> np.ndarray:
        """A box that stands on an edge parallel to a horizontal axis."""
        c, s = np.sqrt([0.5, 0.5])
        return np.array([[1, 0, 0], [0, c, -s], [0, s, c]] if axis == 0 else [[c, 0, s], [0, 1, 0], [-s, 0, c]])

    side, overlap = 0.05, 0.01
    height = 2 * side * np.sqrt(2) - overlap
    found = box_box(np.zeros(3), about(0), np.full(3, side), np.array([0, 0, height]), about(1), np.full(3, side))
    assert found[:, 0].min() == pytest.approx(-overlap)


def test_boxes_apart_touch_only_within_the_margin() -> None:
    boxes = np.zeros(3), np.eye(3), np.full(3, 0.1), np.array([0, 0, 0.205]), np.eye(3), np.full(3, 0.1)
    assert len(box_box(*boxes)) == 0
    near = box_box(*boxes, margin=0.01)
    assert len(near) == 4
    assert (near[:, 0] > 0).all()
