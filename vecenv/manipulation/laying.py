"""Laying something down in a space that is too low for it to stand, such as a bottle in a drawer.

A scene whose hand holds an object and a :class:`~vecenv.manipulation.targets.Target` come in; the pose of the hand at
the release comes out, from which the object tips over by itself (:func:`laid_down`), or None.
"""

from __future__ import annotations

import numpy as np

from vecenv.manipulation.grasps import room_around
from vecenv.manipulation.targets import Target, can_take, rest_move
from vecenv.manipulation.world import SceneGeometry, around, leaning, spun, upright, yaw


def laid_down(world: SceneGeometry, name: str, target: Target) -> tuple[np.ndarray, np.ndarray] | None:
    """Pose of the hand, position [3] and rotation [3, 3], from which an object tips over and lies down in a space.

    The object leans with its base ahead, so far that its middle is not above its base, in a plane that the fingers do
    not close across. None for what may stand in the space, does not tip over by itself or has no room to lie; and
    where the arm or the scene leave the hand no room.

    Args:
        world: the scene.
        name: the held object, which stands where an upright hand holds it.
        target: a space that is open to above.
    """
    config, rotation = world.config, upright(world.hand_rotation)
    erect = rotation @ world.hand_rotation.T
    points = (world.points(name) - world.hand) @ erect.T
    size, bottom = np.ptp(points, axis=0), points[:, 2].min()
    if target.half is None or target.centre is None or size[2] < target.roof - target.floor + config.too_tall:
        return None
    wide = float(np.ptp(points[points[:, 2] < bottom + config.touchdown], axis=0)[:2].max())
    tilt = float(np.arctan2(wide / 2, points[:, 2].mean() - bottom)) + config.tipped
    if tilt > max(config.place_tilts):
        return None
    origin = erect @ (world.snapshot.poses[name][:3] - world.hand)
    best, most = None, -np.inf
    for angle in (0.0, np.pi / 2, -np.pi / 2):
        hand = spun(rotation, angle)
        for ahead in (hand[:, 0], -hand[:, 0]) if abs(float(yaw(hand))) < config.widest_turn else ():
            lying = (np.abs(ahead[:2]) * size[2] + np.abs(ahead[[1, 0]]) * wide) / 2
            spare = target.half - lying
            if (spare < 0).any():
                continue
            heading = float(np.arctan2(ahead[1], ahead[0]))
            turn = spun(leaning(tilt), heading) @ spun(np.eye(3), angle - heading)
            for aside in np.linspace(-1, 1, 5):
                base = target.centre + ahead[:2] * size[2] / 2 + aside * np.abs(ahead[[1, 0]]) * spare
                over = base - (turn @ origin)[:2]
                for score, pos in _over_a_floor(world, name, target, over, points @ turn.T, turn @ rotation):
                    if score > most and can_take(world, pos, turn @ rotation):
                        best, most = (pos, turn @ rotation), score
    return best


def _over_a_floor(
    world: SceneGeometry, name: str, target: Target, over: np.ndarray, held: np.ndarray, rotation: np.ndarray
) -> list[tuple[float, np.ndarray]]:
    """Positions [3] of a hand over a place [2] from which what it holds falls on the floor of a space, and scores.

    Args:
        world: the scene.
        name: the held object.
        target: the space.
        over: where the hand is, horizontally.
        held: points of the object relative to the hand, turned as at the release, [N, 3].
        rotation: of the hand, [3, 3].
    """
    config = world.config
    obstacles = around(over, np.concatenate([world.others(name), world.walls]), 2 * config.neighbours)
    at = np.append(over, target.floor)
    at[2] += rest_move(held + at, obstacles, target.floor, config)
    if at[2] + held[:, 2].min() > target.floor + config.stacked:
        return []
    found = []
    for lift in np.arange(0.0, config.highest_drop + 0.005, 0.01):
        pos = at + [0.0, 0.0, lift]
        room = room_around(pos, rotation, obstacles, config.gripper)
        if room > 0:
            found.append((min(room, config.ample_room) / config.room_scale - config.drop_cost * lift, pos))
    return found
