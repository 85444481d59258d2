"""Where something is to be put down, and what every kind of putting down asks: reach, and the height of rest.

A :class:`Target` holds candidate positions for an object's origin. :func:`rest_move` brings an object's points to rest,
:func:`can_take` says whether the arm can take the hand there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vecenv.manipulation.reach import PandaArm
from vecenv.manipulation.world import Margins, SceneGeometry


@dataclass(frozen=True)
class Target:
    """Candidates for an object's origin.

    Attributes:
        xy: candidates, world frame, [M, 2].
        cost: what each costs, ascending, [M].
        floor: height that carries it whatever the points say, metres.
        ignored: objects whose points are no obstacle.
        centre, half: a box to fit in, horizontally, [2] each; None where there is none.
        entry: the way out of a space that is entered from a side, horizontal unit vector [3]; None for one that is
            entered from above.
        roof: height of the underside of what covers such a space, or a drawer that is shut, metres.
    """

    xy: np.ndarray
    cost: np.ndarray
    floor: float
    ignored: tuple[str, ...] = ()
    centre: np.ndarray | None = None
    half: np.ndarray | None = None
    entry: np.ndarray | None = None
    roof: float = np.inf


def can_take(world: SceneGeometry, pos: np.ndarray, rotation: np.ndarray, spare: float = 0.0) -> bool:
    """Whether the arm can take a pose, and one farther out by ``spare`` metres; True for an arm that is not known."""
    base = world.snapshot.panda_base
    if base is None:
        return True
    out = np.append(pos[:2] - base[:2], 0.0)
    farther = pos + spare * out / max(float(np.linalg.norm(out)), 1e-9)
    return bool(PandaArm(base).reaches(np.stack([pos, farther]), np.stack([rotation, rotation])).all())


def rest_move(points: np.ndarray, obstacles: np.ndarray, floor: float, config: Margins) -> float:
    """Vertical move that brings points to rest on obstacles or on the floor, nearly touching."""
    lift = floor - points[:, 2].min()
    low, high = points[:, :2].min(axis=0) - config.support_radius, points[:, :2].max(axis=0) + config.support_radius
    obstacles = obstacles[((obstacles[:, :2] > low) & (obstacles[:, :2] < high)).all(axis=1)]
    if len(obstacles):
        apart = np.linalg.norm(points[:, None, :2] - obstacles[None, :, :2], axis=2)
        under = np.where(apart < config.support_radius, points[:, None, 2], np.inf).min(axis=0)
        lift = max(lift, float((obstacles[:, 2] - under).max()))
    return lift + config.touchdown
