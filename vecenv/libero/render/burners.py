"""Stoves' burners, which upstream shows while the stove is on: which sites they are, and which knobs turn them on."""

from __future__ import annotations

from collections.abc import Callable

import mujoco

from vecenv.libero.scene import catalog
from vecenv.libero.scene.scene import Entity, Scene


def burners(model: mujoco.MjModel, scene: Scene) -> list[tuple[int, list[int], Callable[[float], bool]]]:
    """Sites that glow while their stove is on: site, addresses of its knobs in qpos, and the test for being on."""
    found = []
    for entity in scene.entities.values():
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, f"{entity.name}_burner")
        turn_on = catalog.articulation(entity.category).turn_on
        if site >= 0 and turn_on is not None:
            found.append((site, hinges(model, entity), _passes(turn_on)))
    return found


def hinges(model: mujoco.MjModel, entity: Entity) -> list[int]:
    """Addresses in qpos of the hinges of an entity."""
    joints = [model.joint(name) for name in entity.joints]
    return [int(joint.qposadr[0]) for joint in joints if joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE]


def _passes(test: catalog.JointTest) -> Callable[[float], bool]:
    sign, bound, inclusive = test.sign_form()
    return lambda qpos: sign * qpos >= bound if inclusive else sign * qpos > bound
