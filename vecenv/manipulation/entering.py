"""Putting something into a space that is entered from a side: a microwave, a level of a shelf.

A scene whose hand holds an object and a :class:`~vecenv.manipulation.targets.Target` with an entry come in; the pose of
the hand at the release comes out (:func:`put_in`). The fingers lead, and the object turns along.
"""

from __future__ import annotations

import numpy as np

from vecenv.manipulation.grasps import room_around
from vecenv.manipulation.targets import Target, can_take
from vecenv.manipulation.world import Margins, SceneGeometry


def put_in(world: SceneGeometry, name: str, target: Target, out: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`put_down`, into a space that is entered from a side: the fingers lead, and the object turns along.

    Args:
        world: the scene.
        name: the held object.
        target: a space with a box to fit in.
        out: direction out of it, horizontal unit vector [3].
    """
    config = world.config
    obstacles = np.concatenate([world.others(name), world.walls])
    obstacles = obstacles[np.linalg.norm(obstacles[:, :2] - target.xy[0], axis=1) < 2 * config.neighbours]
    options = []
    for rotation in _entering(out, config):
        pos, room = _put_in_at(world, name, target, rotation, obstacles)
        short, free = _stopping_short(pos, rotation, out, obstacles, target, config)
        turned = np.arccos(np.clip((np.trace(rotation @ world.hand_rotation.T) - 1) / 2, -1, 1))
        score = min(room, free, config.ample_room) / config.room_scale - turned / config.turn_scale
        tips = np.pi / 2 - np.arccos(np.clip(-rotation[2, 2], -1, 1))  # how far it turns when it is let go of
        options.append((score - (short + config.tipping * tips) / config.short_scale, pos + short * out, rotation))
    options.sort(key=lambda option: -option[0])
    reached = (option[1:] for option in options if can_take(world, *option[1:]))
    return next(reached, options[0][1:])


def _stopping_short(
    pos: np.ndarray, rotation: np.ndarray, out: np.ndarray, obstacles: np.ndarray, target: Target, config: Margins
) -> tuple[float, float]:
    """How far before a place in a space a hand stops, metres, and the room that it has there and on its way in.

    None if it has room all the way; else the least with which it has, up to where the middle of what it holds is still
    inside the space: the palm may be wider than the opening.
    """
    step, way = 0.01, 10
    depth = 0.0 if target.half is None else float(np.abs(out[:2]) @ target.half)
    count = int(max(depth - config.edge_inside, 0.0) / step) + 1
    places = [pos + i * step * out for i in range(count + way)]
    rooms = np.array([room_around(place, rotation, obstacles, config.gripper) for place in places])
    free = np.array([rooms[i : i + way + 1].min() for i in range(count)])
    enough = np.flatnonzero(free > 0.0)
    i = int(enough[0]) if len(enough) else int(free.argmax())
    return i * step, float(free[i])


def _entering(out: np.ndarray, config: Margins) -> list[np.ndarray]:
    """Hands that lead with their fingers against ``out``: how level they are, and the four turns about their axis."""
    side = np.cross([0.0, 0.0, 1.0], out)
    hands = []
    for tilt in config.entry_tilts:
        z = -np.sin(tilt) * out - np.cos(tilt) * np.array([0.0, 0.0, 1.0])
        across = np.cross(z, side)
        hands += [np.stack([np.cross(y, z), y, z], axis=1) for y in (side, -side, across, -across)]
    return hands


def _put_in_at(
    world: SceneGeometry, name: str, target: Target, rotation: np.ndarray, obstacles: np.ndarray
) -> tuple[np.ndarray, float]:
    """Position [3] at which a hand so rotated stands the object in the middle of a space; and the room above it.

    The hand may need more height than the object.
    """
    config = world.config
    hung = (world.points(name) - world.hand) @ (rotation @ world.hand_rotation.T).T
    low, high = hung.min(axis=0), hung.max(axis=0)
    height = target.floor + config.touchdown - low[2]
    pos = np.append(target.xy[0] - (low + high)[:2] / 2, height)
    lifts = np.arange(0.0, max(target.roof - high[2] - height, 0.0) + 0.005, 0.01)
    rooms = [room_around(pos + [0.0, 0.0, lift], rotation, obstacles, config.gripper) for lift in lifts]
    enough = np.flatnonzero(np.array(rooms) > config.least_room)
    lift = float(lifts[int(enough[0]) if len(enough) else int(np.argmax(rooms))])
    return pos + [0.0, 0.0, lift], target.roof - (height + lift + float(high[2]))
