"""A table with things on it for VoxPoser's tests, without physics: snapshots, and an environment that obeys plans."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from vecenv.contract import Control, EePoseControl, Metrics, PlanControl, ResetInfo
from vecenv.observations import Egocentric, Objects, ObjectsSnapshot, Part, PartJoint, PointCloud, RegionBox

HOME = np.array([0.0, 0.0, 0.4, 0.0, 1.0, 0.0, 0.0])


def box(half: Any, centre: Any, count: int = 600) -> PointCloud:
    """Points on a box."""
    rng = np.random.default_rng(0)
    size = np.array(half, float)
    areas = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = rng.choice(3, count, p=areas / areas.sum())
    sign = rng.choice([-1.0, 1.0], count)
    points = rng.uniform(-1, 1, (count, 3)) * size
    points[np.arange(count), axis] = sign * size[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = sign
    return PointCloud(points + np.array(centre), normals)


def snapshot(things: dict[str, PointCloud], fixed: tuple[str, ...] = (), **changes: Any) -> ObjectsSnapshot:
    """Things on a table at z = 0, the open hand at ``HOME``."""
    floor = np.array([[x, y, 0.0] for x in np.linspace(-1, 1, 41) for y in np.linspace(-1, 1, 41)])
    table = PointCloud(floor, np.tile([0.0, 0.0, 1.0], (len(floor), 1)))
    clouds = [*things.values(), table]
    values: dict[str, Any] = {
        "names": tuple(things),
        "objects": things,
        "poses": {n: np.array([*c.points.mean(axis=0), 1.0, 0.0, 0.0, 0.0]) for n, c in things.items()},
        "regions": {},
        "goal": (),
        "scene": PointCloud(*(np.concatenate([getattr(c, f) for c in clouds]) for f in ("points", "normals"))),
        "ee_pose": HOME.copy(),
        "gripper": np.array([0.04, -0.04]),
        "workspace": np.array([[-0.5, -0.5, -0.1], [0.5, 0.5, 0.5]]),
        "movable": tuple(name for name in things if name not in fixed),
    }
    return ObjectsSnapshot(**{**values, **changes})


def handle(opened: float = 0.0) -> Part:
    """A drawer's handle: a bar along x, 8 cm long, that slides out towards +y."""
    cloud = box((0.04, 0.008, 0.008), (0.2, 0.1 + opened, 0.2), 240)
    joint = PartJoint("slide", np.array([0.0, 1.0, 0.0]), np.array([0.2, 0.0, 0.2]), 0.16, opened)
    return Part("cabinet_1", "handle", cloud, joint=joint)


def space(centre: Any, half: Any, parent: str = "basket_1") -> Part:
    """A space to put things in."""
    return Part(parent, "space", box(half, centre, 240), RegionBox(np.array(centre), np.eye(3), np.array(half), parent))


class Obedient:
    """An environment of B copies of a snapshot in which the hand is always where the plan ends.

    Attributes:
        plans: every plan it was given.
        waypoints: every action of ``step_ee_pose`` it was given.
        ticks: control ticks of each slot.
    """

    def __init__(self, *snapshots: ObjectsSnapshot, budget: int = 100_000, solved_after: int | None = None) -> None:
        self.snapshots, self.num_envs = list(snapshots), len(snapshots)
        self.ticks = np.zeros(self.num_envs, int)
        self.plans: list[Any] = []
        self.waypoints: list[Any] = []
        self.ended = np.zeros(self.num_envs, bool)
        self._budget, self._solved_after = budget, solved_after

    def reset(self) -> ResetInfo:
        b = self.num_envs
        return ResetInfo(("",) * b, ("s/0/0",) * b, "s", np.zeros(b, int), np.full(b, self._budget))

    def observe_objects(self, points: str = "surface", slots: Any = None) -> Objects:
        del points
        return Objects(tuple(self.snapshots), ("",) * self.num_envs)

    def observe_egocentric(self, slots: Any = None) -> Egocentric:
        return Egocentric(np.zeros((self.num_envs, 8), np.float32))

    def step_waypoints(self, plan: Any, max_misses: int | None = None) -> PlanControl:
        del max_misses
        self.plans.append(plan)
        for slot in range(self.num_envs):
            for t in np.flatnonzero(plan.valid[slot]):
                gap = 0.0 if plan.grip[slot, t] else 0.04
                here = self.snapshots[slot].ee_pose if plan.hold[slot, t] else plan.poses[slot, t].copy()
                self.snapshots[slot] = replace(self.snapshots[slot], ee_pose=here, gripper=np.array([gap, -gap]))
        spent = np.where(plan.valid, np.maximum(plan.hold, 1), 0)
        self.ticks += spent.sum(axis=1)
        return PlanControl(**self._flags(), converged=plan.valid.copy(), waypoint_ticks=spent, error=("",))

    def step_continuous(self, actions: Any) -> Control:
        self.ticks += np.shape(actions)[1] if np.ndim(actions) == 3 else 1
        return Control(**self._flags())

    def _flags(self) -> dict[str, Any]:
        solved = np.zeros(self.num_envs, bool)
        if self._solved_after is not None:
            solved |= len(self.plans) >= self._solved_after
        return {
            "reward": solved.astype(float),
            "terminated": solved,
            "truncated": ~solved & ((self.ticks >= self._budget) | self.ended),
            "success": solved,
            "step_index": self.ticks.copy(),
            "info": {"sanitized": solved, "fault": ("",) * self.num_envs, "ticks": self.ticks.copy()},
        }

    def step_ee_pose(self, poses: Any) -> EePoseControl:
        """One waypoint of each of the named slots, given as a mapping."""
        before = self.ticks.copy()
        for slot in np.flatnonzero(poses["slots"] & ~self._flags()["truncated"]):
            gap = 0.0 if poses["pose"][slot, 7] else 0.04
            hold = poses["hold_steps"][slot]
            here = self.snapshots[slot].ee_pose if hold else poses["pose"][slot, :7].copy()
            self.snapshots[slot] = replace(self.snapshots[slot], ee_pose=here, gripper=np.array([gap, -gap]))
            self.ticks[slot] += max(hold, 1)
        self.waypoints.append(poses)
        spent = self.ticks - before
        return EePoseControl(**self._flags(), converged=spent > 0, step_count=spent, error=("",) * self.num_envs)

    @property
    def done(self) -> np.ndarray:
        flags = self._flags()
        return flags["terminated"] | flags["truncated"]

    def end_episodes(self, slots: Any) -> None:
        self.ended[slots] = True

    def evaluate(self) -> Metrics:
        flags = self._flags()
        return Metrics(flags["success"], self.ticks, "s", np.zeros(self.num_envs, int), flags["reward"])

    def set_episodes(self, *, tasks: Any = None, episodes: Any = None) -> None: ...

    def close(self) -> None: ...
