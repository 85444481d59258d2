"""Plan how one object is picked up and where it is put down, as waypoints, from one snapshot of ground truth.

A pick goes above the chosen grasp, straight down, closes, and lifts clear of everything between here and the target. A
place goes above the target, lowers until the object rests (or as far as the open hand has room), opens and backs off.
Which grasp and where exactly is worked out by ``vecenv.manipulation.placing``.
"""

from __future__ import annotations

import numpy as np

from vecenv.manipulation.placing import Grasped, Target, carry_height, put_down
from vecenv.manipulation.world import SceneGeometry, upright
from vecenv_eval.policies.pick_place.motion import CLOSE, HOLD, OPEN, Waypoint


def pick(world: SceneGeometry, name: str, grasp: Grasped, towards: np.ndarray) -> list[Waypoint]:
    """Waypoints that take hold of an object and lift it for a transfer.

    Args:
        world: the scene.
        name: the object.
        grasp: how to hold it.
        towards: where it will go, [2] or [3].
    """
    config, rotation = world.config, grasp.rotation
    over = world.tallest(world.hand, grasp.pos) + config.gripper.tip + config.over_obstacles
    over = max(over, grasp.pos[2] + config.above)
    height = carry_height(world, name, grasp.pos, grasp.pos, towards)
    above = _at(grasp.pos, over)
    halfway = [Waypoint(above, rotation, CLOSE, ticks=config.narrow_ticks)] if grasp.narrow else []
    grip = HOLD if grasp.narrow else OPEN
    return [
        *_rise(world, over, OPEN),
        Waypoint(above, rotation, OPEN, tolerance=0.012, turn_tolerance=0.12),
        *halfway,
        Waypoint(grasp.pos, rotation, grip, tolerance=0.004, turn_tolerance=0.06),
        Waypoint(grasp.pos, rotation, CLOSE, fingers=True),
        Waypoint(_at(grasp.pos, max(height, grasp.pos[2] + config.least_lift)), rotation, CLOSE, tolerance=0.025),
    ]


def place(world: SceneGeometry, name: str, target: Target) -> list[Waypoint]:
    """Waypoints that put down an object that is in the hand.

    Args:
        world: the scene, the object held.
        name: the object.
        target: where its origin may go.
    """
    config = world.config
    end, rotation = put_down(world, name, target)
    over = max(carry_height(world, name, world.hand, world.hand, end), end[2] + 0.02)
    return [
        *_rise(world, over, CLOSE),
        Waypoint(_at(end, over), rotation, CLOSE, tolerance=0.012, turn_tolerance=0.12),
        Waypoint(end, rotation, CLOSE, tolerance=0.005, speed=0.8),
        Waypoint(end, rotation, OPEN, fingers=True),
        Waypoint(_at(end, end[2] + config.retreat), rotation, OPEN, tolerance=0.03),
    ]


def _rise(world: SceneGeometry, height: float, grip: float) -> list[Waypoint]:
    """Straight up first, where the hand is well below the height at which it will travel."""
    if world.hand[2] > height - 0.04:
        return []
    return [Waypoint(_at(world.hand, height), upright(world.hand_rotation), grip, tolerance=0.03, turn_tolerance=0.5)]


def _at(pos: np.ndarray, height: float) -> np.ndarray:
    """The same place at another height."""
    return np.array([pos[0], pos[1], height])
