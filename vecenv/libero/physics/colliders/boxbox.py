"""Contacts of two boxes as MuJoCo 2.3 to 3.3 computed them, compiled by numba.

In: centres, rotations and half sizes of two boxes, and a margin. Out: up to eight contacts, each with distance,
position and normal, in MuJoCo's order. Everything is float64, in the world frame, metres; the normal points from the
first box to the second, a negative distance is a penetration. The compiled function is in ``boxbox_numba``.

The method is the one of MuJoCo 3.3.0 (``mjc_BoxBox`` and the clean-up in ``mj_collideGeoms``); 3.4.0 changed the depth
of face contacts and 3.12.0 replaced the collider. Fifteen separating axes are tried: the axis of least overlap decides.

* A face axis: the lowest vertex, edge or face of the other box is clipped against the rectangle of the reference face.
  Positions lie half-way between the two surfaces, and **the distance is half the depth**, which is what distinguishes
  these contacts from those of MuJoCo 3.4 and later.
* An edge axis: a face next to the second box's edge is projected along the axis onto a face next to the first box's
  edge, and clipped there. Distances are whole.

Sums are taken in MuJoCo's order, because a tie between two axes (boxes stacked squarely) is decided by rounding.
``tests/libero/physics/test_boxbox.py`` compares the results with recordings of MuJoCo 3.3.0.
"""

from __future__ import annotations

import numpy as np

from vecenv.libero.physics.colliders.boxbox_numba import COLUMNS, MOST, compiled


def box_box(
    pos1: np.ndarray,
    mat1: np.ndarray,
    size1: np.ndarray,
    pos2: np.ndarray,
    mat2: np.ndarray,
    size2: np.ndarray,
    margin: float = 0.0,
) -> np.ndarray:
    """Contacts of two boxes, a row each: distance, position [3], normal [3]; [n, 7] with n from 0 to 8.

    Args:
        pos1, pos2: centres, metres, world frame, [3].
        mat1, mat2: rotations to the world frame, [3, 3].
        size1, size2: half sizes, metres, [3].
        margin: contacts up to this distance are reported, metres.
    """
    rows = np.zeros((MOST, COLUMNS))
    boxes = [np.ascontiguousarray(value, float) for value in (pos1, mat1, size1, pos2, mat2, size2)]
    count = compiled().ctypes(*(box.ctypes.data for box in boxes), float(margin), rows.ctypes.data)
    return rows[:count, :7]
