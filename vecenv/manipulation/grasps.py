"""Top-down grasps for a parallel gripper, found on surface points.

Points and outward normals of one object come in, z up; a table of grasps goes out, best first. A grasp is a pair of
faces that look away from each other with material in between, narrow enough for the gripper: two sides of a box, or
the two sides of a bowl's rim, so that one sampler does both. The hand points straight down. What a grasp needs besides
contact is room: the open fingers and the palm must not touch the object itself on the way down (checked here), nor its
neighbours (:func:`clearance`). Only geometry happens here; no environment and no randomness.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """A parallel gripper around its grip site, which lies between the pads. Metres.

    Defaults are the Panda gripper of robosuite, measured on its collision meshes in the hand's frame.

    Attributes:
        half_opening: from the centre to the inside of an open pad.
        half_reach: from the centre to the outside of an open finger.
        finger_half_width: half of a finger's width across the closing direction.
        tip: how far the fingertips reach below the grip site.
        pad: lower and upper edge of the pads, relative to the grip site.
        palm: height of the palm's underside above the grip site.
        palm_half: half extents of the palm along and across the closing direction.
        wrist: height of the wrist's underside above the grip site; infinite leaves the wrist out of account.
        wrist_half: half extents of the wrist along and across the closing direction.
    """

    half_opening: float = 0.0385
    half_reach: float = 0.0655
    finger_half_width: float = 0.0105
    tip: float = 0.0095
    pad: tuple[float, float] = (-0.0044, 0.0116)
    palm: float = 0.031
    palm_half: tuple[float, float] = (0.104, 0.032)
    wrist: float = np.inf
    wrist_half: tuple[float, float] = (0.060, 0.100)

    def narrowed(self, half_opening: float) -> Gripper:
        """The same gripper with its fingers partly closed."""
        return replace(self, half_opening=half_opening, half_reach=self.half_reach - self.half_opening + half_opening)


@dataclass(frozen=True, kw_only=True)
class GraspConfig:
    """How grasps are sampled and ranked. Metres unless noted.

    Attributes:
        slack: room to leave between the object and an open pad, on each side.
        steepest: largest vertical component of the normal of a face to hold on to.
        opposed: smallest cosine between a face's normal and the closing direction.
        lateral: how far two opposite points may lie from one line, sideways and in height.
        floor: fingertips stay this far above the object's underside.
        own_margin: fingers stay this far from the object's own points on the way down.
        offsets: places of the object between the open pads; the hand is centred at 0.
        kept: grasps kept for each object.
        far_scale: distance from the centroid that costs one point of score.
        tilt_scale: distance of the contact from the pads' centre that costs one point.
        width_scale: width that costs one point.
    """

    slack: float = 0.004
    steepest: float = 0.45
    opposed: float = 0.88
    lateral: float = 0.010
    floor: float = 0.003
    own_margin: float = 0.0015
    offsets: tuple[float, ...] = (0.0, -0.012, 0.012, -0.022, 0.022)
    kept: int = 240
    far_scale: float = 0.04
    tilt_scale: float = 0.02
    width_scale: float = 0.2


@dataclass(frozen=True)
class Grasps:
    """K grasps of one object.

    Attributes:
        pos: where the grip site goes, [K, 3].
        axis: closing direction, horizontal unit vectors, [K, 3]; the opposite direction is the same grasp.
        width: thickness of what is held, [K].
        score: quality without regard to surroundings, higher is better, [K].
    """

    pos: np.ndarray
    axis: np.ndarray
    width: np.ndarray
    score: np.ndarray

    def __len__(self) -> int:
        return len(self.score)

    def take(self, rows: np.ndarray) -> Grasps:
        """The grasps ``rows`` (indices or a mask)."""
        return Grasps(self.pos[rows], self.axis[rows], self.width[rows], self.score[rows])


NO_GRASPS = Grasps(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))


def find_grasps(
    points: np.ndarray,
    normals: np.ndarray,
    gripper: Gripper = Gripper(),
    config: GraspConfig = GraspConfig(),
) -> Grasps:
    """Grasps of an object that stands alone.

    Args:
        points: surface samples [N, 3], metres, z up.
        normals: outward unit normals [N, 3].
        gripper: the gripper.
        config: sampling and ranking.

    Returns:
        Up to ``config.kept`` grasps in the frame of the points, best first; none when nothing can be held.
    """
    pairs = _opposite_faces(points, normals, gripper, config)
    if not len(pairs):
        return NO_GRASPS
    grasps = _descend(pairs, points, gripper, config)
    grasps = _with_offsets(grasps, gripper, config)
    room = clearance(grasps, points, gripper) > config.own_margin
    grasps = grasps.take(room)
    return grasps.take(_spread(grasps, config.kept))


def _opposite_faces(points: np.ndarray, normals: np.ndarray, gripper: Gripper, config: GraspConfig) -> Grasps:
    """Contacts, not yet hand poses: ``pos`` is the middle of the material between two opposite points."""
    side = np.flatnonzero(np.abs(normals[:, 2]) < config.steepest)
    if not len(side):
        return NO_GRASPS
    p, n = points[side], normals[side]
    axis = n * [1.0, 1.0, 0.0]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    gap = p[:, None] - p[None]
    width = np.einsum("ijk,ik->ij", gap, axis)
    across = np.einsum("ijk,ik->ij", gap, axis[:, [1, 0, 2]] * [-1.0, 1.0, 0.0])
    facing = axis @ n.T
    widest = 2 * (gripper.half_opening - config.slack)
    fits = (facing < -config.opposed) & (width > 1e-3) & (width < widest)
    fits &= (np.abs(across) < config.lateral) & (np.abs(gap[:, :, 2]) < config.lateral)
    return _nearest_and_farthest(p, axis, width, fits, points)


def _nearest_and_farthest(
    p: np.ndarray, axis: np.ndarray, width: np.ndarray, fits: np.ndarray, points: np.ndarray
) -> Grasps:
    """Of the points opposite to each point, the nearest (a wall of something hollow) and the farthest (all of it)."""
    found = np.flatnonzero(fits.any(axis=1))
    near = np.where(fits, width, np.inf)[found].min(axis=1)
    far = np.where(fits, width, -np.inf)[found].max(axis=1)
    rows, widths = np.concatenate([found, found]), np.concatenate([near, far])
    keep = np.concatenate([np.ones(len(found), bool), far > near + 0.01])
    rows, widths = rows[keep], widths[keep]
    middle = p[rows] - axis[rows] * widths[:, None] / 2
    contacts = Grasps(middle, axis[rows], widths, np.zeros(len(rows)))
    centred = _centred(contacts, points)
    return Grasps(
        np.concatenate([contacts.pos, centred.pos]),
        np.concatenate([contacts.axis, centred.axis]),
        np.concatenate([contacts.width, centred.width]),
        np.concatenate([contacts.score, centred.score]),
    )


def _centred(contacts: Grasps, points: np.ndarray) -> Grasps:
    """The contacts slid sideways level with the centroid, by at most 2 cm: a face seldom ends between two samples."""
    sideways = contacts.axis[:, [1, 0, 2]] * [-1.0, 1.0, 0.0]
    slide = np.einsum("ij,ij->i", points.mean(axis=0) - contacts.pos, sideways)
    near = np.flatnonzero(np.abs(slide) < 0.02)
    pos = contacts.pos[near] + sideways[near] * slide[near, None]
    return Grasps(pos, contacts.axis[near], contacts.width[near], contacts.score[near])


def _descend(contacts: Grasps, points: np.ndarray, gripper: Gripper, config: GraspConfig) -> Grasps:
    """Hand poses for the contacts, as deep as the palm and the ground allow; scored."""
    centroid = points.mean(axis=0)
    u, v, _ = _in_grasp_frames(contacts, points)
    under_palm = (np.abs(u) < gripper.palm_half[0]) & (np.abs(v) < gripper.palm_half[1])
    top = np.where(under_palm, points[:, 2], -np.inf).max(axis=1)
    lowest = np.maximum(top - gripper.palm + 0.004, points[:, 2].min() + gripper.tip + config.floor)
    pad_middle = sum(gripper.pad) / 2
    height = np.maximum(contacts.pos[:, 2] - pad_middle, lowest)
    off_pad = np.abs(height + pad_middle - contacts.pos[:, 2])
    holds = off_pad < (gripper.pad[1] - gripper.pad[0]) / 2 - 0.001
    far = np.linalg.norm((contacts.pos - centroid)[:, :2], axis=1)
    score = -far / config.far_scale - off_pad / config.tilt_scale - contacts.width / config.width_scale
    pos = np.concatenate([contacts.pos[:, :2], height[:, None]], axis=1)
    return Grasps(pos, contacts.axis, contacts.width, score).take(holds)


def _with_offsets(grasps: Grasps, gripper: Gripper, config: GraspConfig) -> Grasps:
    """Each grasp with the object at several places between the pads, those off the centre at a price."""
    parts = []
    for offset in config.offsets:
        fits = abs(offset) + grasps.width / 2 < gripper.half_opening - config.slack
        moved = grasps.take(fits)
        parts.append(Grasps(moved.pos + offset * moved.axis, moved.axis, moved.width, moved.score - 8 * abs(offset)))
    return Grasps(*(np.concatenate([getattr(part, f) for part in parts]) for f in ("pos", "axis", "width", "score")))


def _spread(grasps: Grasps, count: int) -> np.ndarray:
    """Rows of up to ``count`` grasps, best first, at most one for each cell of 5 mm and 10 degrees."""
    order = np.argsort(-grasps.score, kind="stable")
    angle = np.arctan2(grasps.axis[:, 1], grasps.axis[:, 0]) % np.pi
    cells = np.concatenate([np.round(grasps.pos / 0.005), np.round(angle / np.radians(10))[:, None] % 18], axis=1)
    _, first = np.unique(cells[order], axis=0, return_index=True)
    return order[np.sort(first)][:count]


def _in_grasp_frames(grasps: Grasps, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points along the closing direction, across it, and above the grip site of each grasp, [K, N] each."""
    axis = grasps.axis[:, :2]
    sideways = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
    u = axis @ points[:, :2].T - np.einsum("ij,ij->i", axis, grasps.pos[:, :2])[:, None]
    v = sideways @ points[:, :2].T - np.einsum("ij,ij->i", sideways, grasps.pos[:, :2])[:, None]
    return u, v, points[None, :, 2] - grasps.pos[:, 2:]


def clearance(grasps: Grasps, obstacles: np.ndarray, gripper: Gripper = Gripper()) -> np.ndarray:
    """Room around the open hand as it comes straight down from above to each grasp.

    Args:
        grasps: where the hand goes, K of them.
        obstacles: points it must not touch, [N, 3].
        gripper: the gripper.

    Returns:
        Smallest distance (largest coordinate difference) of an obstacle from the space that the open fingers, the palm
        and the wrist sweep, metres, negative inside, [K]; infinite without obstacles.
    """
    if not len(obstacles) or not len(grasps):
        return np.full(len(grasps), np.inf)
    u, v, h = _in_grasp_frames(grasps, obstacles)
    along, across = np.abs(u), np.abs(v)
    middle, half = (gripper.half_reach + gripper.half_opening) / 2, (gripper.half_reach - gripper.half_opening) / 2
    finger = np.maximum(np.abs(along - middle) - half, across - gripper.finger_half_width)
    finger = np.maximum(finger, -gripper.tip - h)
    palm = np.maximum(along - gripper.palm_half[0], across - gripper.palm_half[1])
    palm = np.maximum(palm, gripper.palm - h)
    wrist = np.maximum(along - gripper.wrist_half[0], across - gripper.wrist_half[1])
    wrist = np.maximum(wrist, gripper.wrist - h)
    return np.minimum(np.minimum(finger, palm), wrist).min(axis=1)


def room_around(
    pos: np.ndarray, rotation: np.ndarray, obstacles: np.ndarray, gripper: Gripper = Gripper(), *, reach: float = 0.28
) -> float:
    """Room around the open hand where it is, whichever way it points.

    Args:
        pos: of the grip site, [3].
        rotation: of the hand, [3, 3]: the second column is the closing direction, the third points out of the palm.
        obstacles: points it must not touch, [N, 3].
        gripper: the gripper.
        reach: of the hand and wrist behind the grip site, metres.

    Returns:
        Smallest distance (largest coordinate difference) of an obstacle from fingers, palm and wrist, metres, negative
        inside; infinite without obstacles.
    """
    if not len(obstacles):
        return np.inf
    local = (obstacles - pos) @ rotation
    across, along, back = np.abs(local[:, 0]), np.abs(local[:, 1]), -local[:, 2]
    boxes = (
        (gripper.half_reach, gripper.finger_half_width, -gripper.tip, gripper.palm),
        (*gripper.palm_half, gripper.palm, min(gripper.wrist, reach)),
        (*gripper.wrist_half, gripper.wrist, reach),
    )
    apart = [
        np.maximum.reduce([along - half, across - side, low - back, back - high]) for half, side, low, high in boxes
    ]
    return float(np.min(apart))
