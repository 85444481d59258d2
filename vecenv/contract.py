"""The methods that every vecenv environment has, the values they return, and the rules they follow.

Read this page first. An environment is a *batch* of ``B = num_envs`` slots; each slot holds one episode of one task.
``reset`` makes every slot live and returns metadata, ``step_*`` advances and returns control signals, ``observe_*``
reads without advancing, ``evaluate`` reports the verdict. All arrays are NumPy, the first axis is the slot, lengths are
metres, angles radians, poses are in the world frame, quaternions are wxyz. What ``observe_*`` return is in
``vecenv.observations``.

Rules that hold for every environment:

* ``reset`` is idempotent: live slots are not changed, finished ones start their episode again. ``set_episodes`` decides
  which episode a slot has, ``reset`` never does.
* ``observe_*`` never advances a slot and changes nothing; on a finished slot it reads the terminal state.
* An argument that cannot be used is a ``vecenv.errors.VecenvError`` that says what would be right, and a call that
  raises one has changed nothing. Integers are Python's or NumPy's, never bools; slots are bool [B] or indices; lists
  may be generators, which are read once.
* ``terminated`` means success, ``truncated`` means the step budget ran out (or the slot was quarantined). A finished
  slot ignores further steps: reward 0, flags kept.
* What success means is an option. ``"first"``: an episode ends when its goal first holds. ``"final"``: it runs to
  the end of its budget, and the verdict is read there. ``evaluate`` reports both. The reward is 1 at the tick at which
  the goal first holds, else 0.
* A chunk of K actions stops at a slot's own terminal step; the other slots continue.
* NaN and infinities in actions are set to 0 and values are clipped to the action range; ``info["sanitized"]`` marks the
  slots.
* A slot whose physics fails (non-finite state, exhausted contact memory) is quarantined: ``info["fault"][i]`` names the
  cause, the slot ends truncated and unsuccessful, and no other slot is affected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Protocol, Self, TypeAlias, runtime_checkable

import numpy as np
import numpy.typing as npt

from vecenv.observations import Egocentric, Objects
from vecenv.placement import Placement

# Called before a tick: actions [B, 7], and which slots they are for, bool [B].
Watcher: TypeAlias = Callable[[np.ndarray, np.ndarray], None]
# When a successful episode ends: when its goal first holds, or at the end of its budget.
FIRST, FINAL = SUCCESS_MODES = ("first", "final")
# Columns of the 7-vector taken by ``step_continuous``.
ACTION_DIM = 7
# Columns of the 8-vector taken by ``step_ee_pose``: x, y, z, qw, qx, qy, qz, grip (1 closed, 0 open).
EE_POSE_DIM = 8


@dataclass(frozen=True)
class ResetInfo:
    """What ``reset`` returns: episode metadata, no observation.

    Attributes:
        instruction: language instruction of each slot, length B.
        episode_id: ``"{suite}/{task}/{episode}"`` of each slot, length B; the task is its index in LIBERO, its name in
            SIMPLER.
        suite: suite name of the environment.
        task_id: task index of each slot, int [B].
        max_steps: step budget of each slot in control ticks, int [B].
    """

    instruction: tuple[str, ...]
    episode_id: tuple[str, ...]
    suite: str
    task_id: np.ndarray
    max_steps: np.ndarray


@dataclass(frozen=True)
class Control:
    """What every ``step_*`` returns: control signals, no observation.

    Attributes:
        reward: sum of the rewards over the ticks of this call, float64 [B].
        terminated: the task is solved, bool [B].
        truncated: the budget ran out or the slot was quarantined, bool [B].
        success: verdict of each slot at its last executed tick, bool [B].
        step_index: control ticks executed in the episode so far, int [B].
        info: diagnostics. Always has ``sanitized`` (bool [B], an action held NaN, infinities or values out of range),
            ``fault`` (tuple of B strings, empty when healthy) and ``ticks`` (int [B], ticks executed in this call);
            SIMPLER adds ``parts`` (upstream's intermediate results of the success check, one mapping per slot) and
            ``stand_ins`` (notes about missing files, one tuple per slot).
    """

    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    success: np.ndarray
    step_index: np.ndarray
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def done(self) -> np.ndarray:
        """Slots that are finished, bool [B]."""
        return self.terminated | self.truncated


@dataclass(frozen=True)
class EePoseControl(Control):
    """``step_ee_pose``'s return: control signals and the result of the motion.

    Attributes:
        converged: position and rotation both within tolerance, bool [B].
        final_pose: end-effector pose when the call ended, xyz + wxyz, [B, 7].
        step_count: control ticks used by this call, int [B].
        error: why a slot did not move ("" if it did), B strings.
    """

    converged: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    final_pose: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    step_count: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    error: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlanControl(Control):
    """``step_waypoints``' return: control signals and the result of each waypoint.

    Attributes:
        converged: within tolerance when the waypoint was left, bool [B, T].
        waypoint_ticks: control ticks spent on each waypoint, int [B, T].
        final_pose: end-effector pose when the call ended, xyz + wxyz, [B, 7].
        error: which waypoints of a slot were skipped and why ("" if none), B strings.
    """

    converged: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))
    waypoint_ticks: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), int))
    final_pose: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    error: tuple[str, ...] = ()


@dataclass(frozen=True)
class Metrics:
    """``evaluate``'s return: the verdict of each slot as of its last executed tick.

    Attributes:
        success: bool [B].
        num_steps: control ticks executed, int [B].
        suite: suite name.
        task_id: int [B].
        cumulative_reward: sum of rewards since the episode began, float64 [B].
        success_first: the goal held after one of the ticks, bool [B].
        success_final: the goal held after the last executed tick, bool [B]; ``success`` is this.
    """

    success: np.ndarray
    num_steps: np.ndarray
    suite: str
    task_id: np.ndarray
    cumulative_reward: np.ndarray
    success_first: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    success_final: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        # With success="first" both are equal.
        for name in ("success_first", "success_final"):
            if len(getattr(self, name)) != len(self.success):
                object.__setattr__(self, name, self.success.copy())


@dataclass(frozen=True)
class Timings:
    """Time that an environment has spent since it was made, seconds of wall clock.

    Attributes:
        physics_s: stepping and resetting.
        images_s: rendering images.
    """

    physics_s: float = 0.0
    images_s: float = 0.0


@dataclass(frozen=True)
class State:
    """Physics state of every slot.

    Scenes differ in size, so rows are padded with zeros up to the widest scene of the batch; ``nq[i]`` and ``nv[i]``
    say how much of row i is used.

    Attributes:
        qpos: [B, max nq].
        qvel: [B, max nv].
        time: simulated seconds, [B].
        nq: int [B].
        nv: int [B].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    time: np.ndarray
    nq: np.ndarray
    nv: np.ndarray


@runtime_checkable
class BatchEnv(Protocol):
    """A batch of episodes; ``vecenv.make`` returns one, whatever the simulator."""

    suite: str
    num_envs: int

    @property
    def config(self) -> object:
        """The family's config, including the values that the protocol decided."""
        ...

    @property
    def control_hz(self) -> float:
        """Control ticks per second."""
        ...

    @property
    def placement(self) -> Placement:
        """Task and episode of each slot."""
        ...

    @property
    def done(self) -> np.ndarray:
        """Slots that have finished their episode, bool [B]; the others are live, or wait for ``reset``."""
        ...

    @property
    def timings(self) -> Timings:
        """Seconds spent so far in physics and in rendering images."""
        ...

    def instructions(self) -> tuple[str, ...]:
        """The current instruction of each slot; some SIMPLER tasks have two, one after the other."""
        ...

    def reset(self) -> ResetInfo:
        """Make every slot live; live slots are not changed. A slot whose physics fails in it is done at once."""
        ...

    def step_continuous(self, actions: npt.ArrayLike) -> Control:
        """Advance by one tick, [B, 7], or a chunk, [B, K, 7]; K = 0 moves nothing and says how the slots stand."""
        ...

    def step_ee_pose(
        self,
        poses: npt.ArrayLike | Mapping[str, object] | None,
        hold_steps: npt.ArrayLike = 0,
        *,
        carry: npt.ArrayLike = False,
        slots: npt.ArrayLike | None = None,
    ) -> EePoseControl:
        """Drive the end effectors to absolute poses, [B, 8]; of ``slots`` only, if given.

        ``carry`` goes on with the motion of the last such call without slowing down.
        """
        ...

    def step_waypoints(self, plan: object, max_misses: int | None = None) -> PlanControl:
        """Follow a plan, waypoints [B, T]."""
        ...

    def observe_egocentric(self, slots: npt.ArrayLike | None = None) -> Egocentric:
        """Cameras and proprioception; images of ``slots`` only (bool [B] or indices), if given."""
        ...

    def observe_objects(self, points: str = "surface", slots: npt.ArrayLike | None = None) -> Objects:
        """Ground truth; of ``slots`` only, if given."""
        ...

    def evaluate(self) -> Metrics:
        """Verdicts."""
        ...

    def end_episodes(self, slots: npt.ArrayLike) -> None:
        """End the episodes of some slots: truncated, they ignore further steps until ``reset``."""
        ...

    def state(self) -> State:
        """Physics state of every slot, a copy."""
        ...

    def set_state(self, state: State) -> None:
        """Overwrite the physics state of every slot; step counts and verdicts stay."""
        ...

    def watched(self, watcher: Watcher) -> AbstractContextManager[None]:
        """While inside, ``watcher`` is called before every tick of an episode."""
        ...

    def set_episodes(
        self, *, tasks: object = None, episodes: object = None, slots: npt.ArrayLike | None = None
    ) -> None:
        """Choose what each slot runs next, or some slots while the others continue; then call ``reset``."""
        ...

    def close(self) -> None:
        """Release the simulator, once, at the end."""
        ...

    def __enter__(self) -> Self:
        """``with vecenv.make(...) as env``: the environment is closed at the end of the block."""
        ...

    def __exit__(self, *_: object) -> None:
        """Close."""
        ...
