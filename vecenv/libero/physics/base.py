"""What every physics backend offers the environment, and the loops that all of them share.

In: scenes, which scene each slot runs, start states, goals, and actions or plans. Out: the state of every slot, its
verdict, and the cause of its fault if it has one. ``NativePhysics`` steps MuJoCo on CPU threads;
``MjxPhysics`` runs MJX under ``jax.jit`` and replaces the loops here by compiled ones.
"""

from __future__ import annotations

import dataclasses
import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh

from vecenv.controllers import waypoint
from vecenv.libero.scene import goals
from vecenv.libero.scene.scene import Scene
from vecenv.util.arrays import AnyArray

SUBSTEPS = 25
# Substeps after which robosuite's observables have read the kinematics and the finger joints.
OBSERVED_POSE = 23
OBSERVED_FINGERS = 24

# The action (no motion, gripper open) and the ticks of LIBERO's evaluations while objects settle after a reset.
SETTLE_ACTION = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
SETTLE_TICKS = 10

Watcher = Callable[[np.ndarray, np.ndarray], None]


@dataclass(frozen=True, kw_only=True)
class Start:
    """Start states of n slots of one scene.

    Attributes:
        qpos: [n, nq].
        qvel: [n, nv].
        bodies: ids of the bodies whose poses are given, [F].
        body_pos: their positions in metres, world frame, [n, F, 3].
        body_quat: their orientations wxyz, [n, F, 4].
        time: simulated seconds the starts have run for.
        settled: whether the starts have already been stepped with an idle arm and an opening gripper. The controller
            then sees them as they are; otherwise its first substep uses the pose of the reset.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    bodies: np.ndarray
    body_pos: np.ndarray
    body_quat: np.ndarray
    time: float = 0.0
    settled: bool = False

    def select(self, chosen: np.ndarray) -> Start:
        """The starts of the chosen slots, indices or bool [n]."""
        given = {"qpos": self.qpos, "qvel": self.qvel, "body_pos": self.body_pos, "body_quat": self.body_quat}
        return dataclasses.replace(self, **{name: array[chosen] for name, array in given.items()})


class Shown(NamedTuple):
    """What camera images show of the slots of one scene: copies, on the device where the physics is.

    Attributes:
        slots: their indices in the batch, int [n].
        qpos: positions, [N, nq]; the first n rows are the slots', in their order.
        body_pos: positions of the bodies in their parents, metres, [N, nbody, 3].
        body_quat: orientations likewise, wxyz, [N, nbody, 4].
        mesh: the devices over which the rows are split evenly; None for one device, or the host.
    """

    slots: np.ndarray
    qpos: AnyArray
    body_pos: AnyArray
    body_quat: AnyArray
    mesh: Mesh | None = None


class Group(Protocol):
    """The slots of one scene; arrays are read-only and as of the last call, poses in the world frame.

    Attributes:
        scene: the scene they share.
        slots: their indices in the batch, int [n].
    """

    scene: Scene
    slots: np.ndarray

    @property
    def qpos(self) -> np.ndarray:
        """Positions, [n, nq]."""
        ...

    @property
    def seen_qpos(self) -> np.ndarray:
        """Positions as camera images show them, [n, nq]."""
        ...

    def shown(self) -> Shown:
        """What camera images show now."""
        ...

    @property
    def qvel(self) -> np.ndarray:
        """Velocities, [n, nv]."""
        ...

    @property
    def time(self) -> np.ndarray:
        """Simulated seconds, [n]."""
        ...

    @property
    def xpos(self) -> np.ndarray:
        """Body positions, metres, [n, nbody, 3]."""
        ...

    @property
    def xquat(self) -> np.ndarray:
        """Body orientations wxyz, [n, nbody, 4]."""
        ...

    @property
    def xmat(self) -> np.ndarray:
        """Body rotations, [n, nbody, 9]."""
        ...

    @property
    def site_xpos(self) -> np.ndarray:
        """Site positions, metres, [n, nsite, 3]."""
        ...

    @property
    def site_xmat(self) -> np.ndarray:
        """Site rotations, [n, nsite, 9]."""
        ...

    @property
    def touch(self) -> np.ndarray:
        """Contact sensors as of the last full step, [n, nsensordata]."""
        ...

    def expand(self, field: str) -> np.ndarray:
        """``body_pos`` or ``body_quat`` of every slot, a copy, [n, nbody, ...]."""
        ...

    def refresh_kinematics(self) -> None:
        """Compute the kinematics of the current state."""
        ...

    def refresh_all(self) -> None:
        """Compute kinematics, contacts and contact sensors of the current state."""
        ...

    def refreshed(self, *, contacts: bool = False) -> AbstractContextManager[None]:
        """Inside, kinematics (and contacts) are those of the current state; afterwards all is as it was.

        After a control step they are those that goals are judged on, and a servo that starts reads them: to observe
        must not change what happens next.
        """
        ...


G = TypeVar("G", bound=Group)


@dataclass(frozen=True)
class RunResult:
    """The result of ``run``.

    Attributes:
        ticks: control steps each slot took, int [B].
        success: slots whose goal held after their last tick, bool [B].
        solved: slots whose goal held after one of their ticks, bool [B].
    """

    ticks: np.ndarray
    success: np.ndarray
    solved: np.ndarray


@dataclass(frozen=True, kw_only=True)
class FollowResult(RunResult):
    """The result of ``follow``.

    Attributes:
        converged: within tolerance when the waypoint was left, bool [B, T].
        waypoint_ticks: control steps spent on each waypoint, int [B, T].
        reference: where the servo's references ended, xyz + wxyz, [B, 7].
    """

    converged: np.ndarray
    waypoint_ticks: np.ndarray
    reference: np.ndarray


class Physics(ABC, Generic[G]):
    """A batch of simulations with their controllers and goals.

    Attributes:
        num_envs: slots, B.
        faults: cause of each faulty slot, by slot; empty when all are healthy.
    """

    num_envs: int
    faults: dict[int, str]
    _goals: list[goals.GoalTable]

    @property
    @abstractmethod
    def groups(self) -> Sequence[G]:
        """The slots by scene."""

    @property
    @abstractmethod
    def eef_pos(self) -> np.ndarray:
        """End-effector position as robosuite's observables report it, metres, [B, 3]."""
        ...

    @property
    @abstractmethod
    def eef_quat(self) -> np.ndarray:
        """Hand orientation likewise, wxyz, [B, 4]."""
        ...

    @property
    @abstractmethod
    def fingers(self) -> np.ndarray:
        """The two finger positions likewise, metres, [B, 2]."""
        ...

    @abstractmethod
    def place(self, group: G, slots: np.ndarray, start: Start) -> None:
        """Begin an episode in ``slots``, which belong to ``group``: physics state, fixture poses, controller memory."""

    @abstractmethod
    def write_state(self, group: G, qpos: np.ndarray, qvel: np.ndarray, time: np.ndarray) -> None:
        """Overwrite the physics state of a group ([n, nq], [n, nv], seconds [n]); the controller keeps its memory."""

    @abstractmethod
    def control_step(self, actions: np.ndarray, active: np.ndarray) -> None:
        """Advance the active slots by one control step: 25 substeps, 50 ms.

        Args:
            actions: finite actions within [-1, 1], [B, 7].
            active: slots to advance, bool [B]; the others keep their state.
        """

    @abstractmethod
    def close(self) -> None:
        """Release threads and memory."""

    def serves(self, scenes: Sequence[Scene], scene_of_slot: np.ndarray) -> bool:
        """Whether this batch already runs these scenes in these slots."""
        if len(scene_of_slot) != self.num_envs:
            return False
        wanted = [scenes[int(index)] for index in scene_of_slot]
        return all(wanted[slot] is group.scene for group in self.groups for slot in group.slots)

    def set_goals(self, tables: Sequence[goals.GoalTable]) -> None:
        """Set the goals of the slots: one table a group, rows in the order of its slots."""
        self._goals = list(tables)

    def judge(self) -> np.ndarray:
        """Whether the goals hold for the kinematics and contacts of the last call, bool [B]."""
        verdict = np.zeros(self.num_envs, bool)
        for group, table in zip(self.groups, self._goals, strict=True):
            verdict[group.slots] = goals.evaluate(
                table,
                xpos=group.xpos,
                site_xpos=group.site_xpos,
                site_xmat=group.site_xmat,
                qpos=group.qpos,
                touch=group.touch,
            )
        return verdict

    def eef(self) -> waypoint.Pose:
        """End-effector position [B, 3] and hand orientation [B, 4], world frame, as of the last call."""
        pos: Any = np.zeros((self.num_envs, 3))
        quat: Any = np.zeros((self.num_envs, 4))
        for group in self.groups:
            pos[group.slots] = group.site_xpos[:, group.scene.grip_site]
            quat[group.slots] = group.xquat[:, group.scene.hand_body]
        return waypoint.Pose(pos, quat)

    def run(
        self,
        chunk: np.ndarray,
        active: np.ndarray,
        limit: np.ndarray,
        watchers: Sequence[Watcher] = (),
        *,
        until_success: bool = True,
    ) -> RunResult:
        """Execute a chunk of actions; each slot stops at its own success, fault or limit.

        Args:
            chunk: finite actions within [-1, 1], [B, K, 7].
            active: slots that move, bool [B].
            limit: control steps each slot may still take, int [B].
            watchers: called with the actions [B, 7] and the active slots, bool [B], before every tick.
            until_success: whether a slot stops at success.
        """
        loop = _HostLoop(self, active, limit, watchers, until_success)
        for k in range(chunk.shape[1]):
            if not loop.tick(chunk[:, k]).any():
                break
        return RunResult(ticks=loop.ticks, success=loop.success, solved=loop.solved)

    def follow(
        self,
        plan: waypoint.WaypointPlan,
        active: np.ndarray,
        limit: np.ndarray,
        config: waypoint.WaypointConfig,
        *,
        max_misses: int | None = None,
        watchers: Sequence[Watcher] = (),
        until_success: bool = True,
        reference: np.ndarray | None = None,
    ) -> FollowResult:
        """Follow plans; a slot stops at the end of its plan and at its own success, fault or limit.

        Args:
            plan: waypoints, T a slot.
            active: slots that move, bool [B].
            limit: control steps each slot may still take, int [B].
            config: tolerances and speeds.
            max_misses: stop a slot after this many waypoints in a row that ran out of ticks; None for no limit.
            watchers, until_success: as for ``run``.
            reference: where the servo's references start, [B, 7]; at the end effectors in rows of NaN, and without it.
        """
        follower = _follower(config)
        loop = _HostLoop(self, active, limit, watchers, until_success)
        carried = np.full((self.num_envs, 7), np.nan) if reference is None else reference
        progress = follower.begin(plan, self.eef(), carried)
        while True:
            going = np.asarray(progress.index) < plan.valid.shape[1]
            if max_misses is not None:
                going &= np.asarray(progress.misses) < max_misses
            going &= loop.going
            if not going.any():
                break
            actions, progress = follower.action(plan, progress, self.eef(), going)
            moved = loop.tick(np.asarray(actions), going)
            progress = follower.advance(plan, progress, self.eef(), moved)
        return FollowResult(
            ticks=loop.ticks,
            success=loop.success,
            solved=loop.solved,
            converged=np.asarray(progress.converged),
            waypoint_ticks=np.asarray(progress.ticks),
            reference=np.concatenate([np.asarray(part) for part in progress.reference], axis=1),
        )


class _HostLoop:
    """Ticks of a batch whose slots stop one by one."""

    def __init__(
        self,
        physics: Physics,
        active: np.ndarray,
        limit: np.ndarray,
        watchers: Sequence[Watcher],
        until_success: bool,
    ) -> None:
        self._physics, self._watchers = physics, watchers
        self._limit, self._until_success = limit, until_success
        self.going = active & (limit > 0)
        self.ticks = np.zeros(len(active), int)
        self.success = np.zeros(len(active), bool)
        self.solved = np.zeros(len(active), bool)

    def tick(self, actions: np.ndarray, also: np.ndarray | None = None) -> np.ndarray:
        """One control step of the slots that are still going (and in ``also``); returns which slots moved."""
        moved = self.going if also is None else self.going & also
        if not moved.any():
            return moved
        for watcher in self._watchers:
            watcher(actions, moved)
        self._physics.control_step(actions, moved)
        self.ticks[moved] += 1
        healthy = moved.copy()
        healthy[list(self._physics.faults)] = False
        self.success[moved] = (self._physics.judge() & healthy)[moved]
        self.solved |= self.success
        self.going = self.going & (self.ticks < self._limit)
        if self._until_success:
            self.going &= ~self.solved
        self.going[list(self._physics.faults)] = False
        return moved


class _Follower(NamedTuple):
    """The compiled plan functions, float64 on the CPU."""

    begin: Callable[..., waypoint.Progress]
    action: Callable[..., tuple[jax.Array, waypoint.Progress]]
    advance: Callable[..., waypoint.Progress]


@functools.lru_cache(maxsize=8)
def _follower(config: waypoint.WaypointConfig) -> _Follower:
    functions = (_begin, waypoint.plan_action, waypoint.plan_advance)
    options = ({}, {"config": config}, {"config": config})
    return _Follower(*(_on_cpu(functools.partial(f, **o)) for f, o in zip(functions, options, strict=True)))


def _begin(plan: waypoint.WaypointPlan, current: waypoint.Pose, carried: jax.Array) -> waypoint.Progress:
    return waypoint.begin_plan(plan, waypoint.start_reference(current, carried))


def _on_cpu(function: Callable[..., Any]) -> Callable[..., Any]:
    jitted, cpu = jax.jit(function), jax.devices("cpu")[0]

    def call(*args: object) -> Any:
        with jax.enable_x64(True), jax.default_device(cpu):
            return jitted(*args)

    return call
