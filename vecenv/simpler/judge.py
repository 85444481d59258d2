"""When a SIMPLER task is solved: upstream's success criteria on what was measured after a control tick.

In: a row of ``physics.spec.facts_dtype`` after the objects settled, then one after every tick. Out: ``Verdict``,
success and its parts. Thresholds are the task's (``task_spec.py``); impulses count when they are at least, or above,
1e-6 N s, as upstream has it. One ``Judge`` is one episode of one slot.

Two oddities are upstream's and kept: an object's bounding box is turned as if its size were a vector, so extents can be
negative; and what counts as lifted is remembered until the grasp is lost, not until the object is put down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vecenv.simpler.control.rotations import rotation_from_quat
from vecenv.simpler.task_spec import (
    DrawerSuccess,
    MoveNearSuccess,
    PickSuccess,
    PlaceSuccess,
    PutOnSuccess,
    SimplerTask,
)

# Steps in a row that make a grasp a firm one.
_FIRM = 5


@dataclass(frozen=True)
class Verdict:
    """Whether the task is solved after a tick, and upstream's intermediate results by name."""

    success: bool
    parts: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Roles:
    """Indices into the objects of a scene, and into the drawers; -1 for none. ``sizes``: bounding boxes [n, 3]."""

    source: int = -1
    target: int = -1
    drawer: int = -1
    loose: tuple[int, ...] = ()
    sizes: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


class Judge:
    """Judges one episode.

    Args:
        task: the task.
        roles: of the objects.
        settled: facts before the first tick.
    """

    def __init__(self, task: SimplerTask, roles: Roles, settled: np.void) -> None:
        self.task, self.roles = task, roles
        self._begin = settled["objects"].copy()
        self._grasped = self._lifted_long = self._touches = 0
        self._lifted = False
        self._advanced = False
        self._sizes = _turned(roles.sizes, self._begin)
        rules: dict[type, Callable[[Any, np.void, int], Verdict]] = {
            PickSuccess: self._pick,
            MoveNearSuccess: self._move_near,
            DrawerSuccess: self._drawer,
            PlaceSuccess: self._place,
            PutOnSuccess: self._put_on,
        }
        self._rule = rules[type(task.success)]

    def after(self, facts: np.void, tick: int) -> Verdict:
        """Verdict after control tick number ``tick``, counted from 1."""
        return self._rule(self.task.success, facts, tick)

    def advance(self) -> None:
        """Of a task in two halves: the policy says that the first is done."""
        self._advanced = True

    def second_half(self, tick: int) -> bool:
        """Whether tick number ``tick`` belongs to the second half."""
        success = self.task.success
        return isinstance(success, PlaceSuccess) and (self._advanced or tick - 1 >= success.second_half)

    # -- grasps --------------------------------------------------------------------------------------------------------

    def _count_grasp(self, facts: np.void, impulse: float, degrees: float) -> bool:
        held = grasped(facts["grip"], self._sides(), impulse, np.deg2rad(degrees))
        self._grasped = self._grasped + 1 if held else 0
        return held

    def _sides(self) -> Sequence[int]:
        return [side for side, finger in enumerate(self.task.robot.fingers) for _ in finger.links]

    # -- families ------------------------------------------------------------------------------------------------------

    def _pick(self, rule: PickSuccess, facts: np.void, tick: int) -> Verdict:
        source = self.roles.source
        held = self._count_grasp(facts, rule.impulse, rule.grasp_angle)
        rise = facts["objects"][source, 2] - self._begin[source, 2]
        free = facts["support"][0] <= rule.impulse
        self._lifted = (self._lifted and held) or bool(free and rise > rule.lift)
        significantly = self._lifted and bool(rise > rule.significant_lift)
        self._lifted_long += significantly
        return Verdict(
            self._lifted or self._lifted_long >= rule.significant_steps,
            {
                "is_grasped": held,
                "consecutive_grasp": self._grasped >= _FIRM,
                "lifted_object": self._lifted,
                "lifted_object_significantly": significantly,
            },
        )

    def _move_near(self, rule: MoveNearSuccess, facts: np.void, tick: int) -> Verdict:
        roles, poses, centres = self.roles, facts["objects"], facts["centres"]
        source, target, others = roles.source, roles.target, [i for i in roles.loose if i != roles.source]
        moved = np.linalg.norm(poses[:, :2] - self._begin[:, :2], axis=1)
        sunk = centres[[source, target], 2] - self._begin[[source, target], 2]
        bystanders = [i for i in others if i != target]
        kept = bool((poses[bystanders, 2] - self._begin[bystanders, 2] > -rule.other_drop).all())
        kept = kept and bool((sunk > -rule.drop).all())
        correct = bool(moved[source] > rule.moved and (moved[others] < moved[source]).all())
        reach = sum(np.linalg.norm(self._sizes[i, :2]) / 2 for i in (source, target)) + rule.gap
        distance = np.linalg.norm(centres[source, :2] - centres[target, :2])
        rivals = np.linalg.norm(centres[source, :2] - poses[others, :2], axis=1)
        near, closest = bool(distance < reach), bool((distance < rivals + rule.closest).all())
        return Verdict(
            kept and correct and near and closest,
            {
                "all_obj_keep_height": kept,
                "moved_correct_obj": correct,
                "moved_wrong_obj": self._moved_wrong(moved, rule.moved),
                "near_tgt_obj": near,
                "is_closest_to_tgt": closest,
            },
        )

    def _moved_wrong(self, moved: np.ndarray, least: float) -> bool:
        others = [i for i in self.roles.loose if i != self.roles.source]
        return bool((moved[others] > least).any() and (moved[others] > moved[self.roles.source]).any())

    def _put_on(self, rule: PutOnSuccess, facts: np.void, tick: int) -> Verdict:
        source, target, centres = self.roles.source, self.roles.target, facts["centres"]
        held = self._count_grasp(facts, rule.impulse, self.task.robot.grasp_angle)
        offset, half = centres[source] - centres[target], self._sizes / 2
        above = offset[2] > 0 and offset[2] - half[target, 2] - half[source, 2] <= rule.z_slack
        on = bool(above and np.linalg.norm(offset[:2]) <= np.linalg.norm(half[target, :2]) + rule.xy_slack)
        if rule.clear:
            on = on and bool(facts["support"][1] <= rule.impulse)
        moved = np.linalg.norm(facts["objects"][:, :2] - self._begin[:, :2], axis=1)
        # Upstream measures the source's way from its origin to its present centre of mass.
        moved[source] = np.linalg.norm(centres[source, :2] - self._begin[source, :2])
        others = [i for i in self.roles.loose if i != source]
        return Verdict(
            on,
            {
                "moved_correct_obj": bool(moved[source] > 0.03 and (moved[others] < moved[source]).all()),
                "moved_wrong_obj": self._moved_wrong(moved, 0.03),
                "is_src_obj_grasped": held,
                "consecutive_grasp": self._grasped >= _FIRM,
                "src_on_target": on,
            },
        )

    def _drawer(self, rule: DrawerSuccess, facts: np.void, tick: int) -> Verdict:
        opened = float(facts["drawers"][self.roles.drawer])
        return Verdict(bool(rule.reached(opened)), {"qpos": opened})

    def _place(self, rule: PlaceSuccess, facts: np.void, tick: int) -> Verdict:
        opened = float(facts["drawers"][self.roles.drawer])
        self._touches += bool(facts["floor"] > rule.impulse)
        success = self.second_half(tick) and opened >= rule.open and self._touches >= 1
        return Verdict(success, {"qpos": opened, "has_contact": self._touches})


def grasped(grip: np.ndarray, sides: Sequence[int], impulse: float, angle: float) -> bool:
    """Whether both sides of a gripper press on an object.

    Args:
        grip: impulse on each finger link and its angle to the opening direction, [>= n, 2], N s and radians.
        sides: side of each link, [n].
        impulse: least impulse, N s. angle: largest angle, radians.
    """
    rows = [[grip[i] for i, side in enumerate(sides) if side == which] for which in (0, 1)]
    return all(max(row[0] for row in links) >= impulse and min(row[1] for row in links) <= angle for links in rows)


def _turned(sizes: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Sizes [n, 3], rotated as vectors by the poses of the objects, [n, 3]."""
    return np.einsum("nij,nj->ni", rotation_from_quat(poses[: len(sizes), 3:7]), sizes)
