"""Jerk-limited joint paths: where a drive is to be at every physics substep on its way to a target.

In: start positions and velocities and target positions of a batch of arms, [B, D]; velocity, acceleration and jerk
limits. Out: ``Profiles``, piecewise cubic paths whose dofs all arrive at the same time, at rest; sampled at any times
they give positions and velocities, and after arrival they hold. The phases (seven of constant jerk a dof, at most two
of braking before them) come from the ``ruckig`` package, one slot after another at a few microseconds each (Berscheid
and Kröger 2021); their evaluation is vectorised over slots, substeps and dofs.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from vecenv.errors import InvalidInput

# A profile that starts outside the limits brakes in up to two phases; then come seven, then rest.
NUM_PHASES = 2 + 7 + 1


class InterpolationError(InvalidInput):
    """Limits or shapes that no path can be planned with; the message says which."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Bounds of a path, the same for each dof and both directions.

    Attributes:
        velocity: rad/s.
        acceleration: rad/s².
        jerk: rad/s³.
    """

    velocity: float
    acceleration: float
    jerk: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise InterpolationError(f"{name} limit must be positive and finite, got {value}")


@dataclass(frozen=True)
class Profiles:
    """Paths of B slots with D dofs, each a row of phases with constant jerk.

    Attributes:
        begin: when each phase begins, seconds since the start of the path, [B, D, 10].
        position: at the beginning of the phase, radians, [B, D, 10].
        velocity: likewise, rad/s.
        acceleration: likewise, rad/s².
        jerk: during the phase, rad/s³.
        duration: when the slowest dof arrives and with it all of them, seconds, [B].
        planned: whether there is a path; without one the slot stays where it starts, bool [B].
    """

    begin: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    duration: np.ndarray
    planned: np.ndarray

    def sample(self, times: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Positions (radians) and velocities (rad/s), [B, S, D] each; what comes after arrival is the arrival.

        Args:
            times: seconds since the start of the path, [S].
        """
        clock = np.minimum(np.asarray(times, np.float64), self.duration[:, None])[:, None, :]
        phase = np.zeros((*self.begin.shape[:2], clock.shape[-1]), np.intp)
        for index in range(1, NUM_PHASES):
            phase += clock >= self.begin[:, :, index, None]
        t = clock - np.take_along_axis(self.begin, phase, axis=2)
        p, v, a, j = (
            np.take_along_axis(values, phase, axis=2)
            for values in (self.position, self.velocity, self.acceleration, self.jerk)
        )
        position = p + t * (v + t * (a / 2 + t * j / 6))
        velocity = v + t * (a + t * j / 2)
        return position.swapaxes(1, 2), velocity.swapaxes(1, 2)


class Planner:
    """Plans time-synchronised paths with ``ruckig``'s position interface.

    Args:
        dofs: D.
        limits: the bounds of every dof.

    Raises:
        ImportError: ``ruckig`` is not installed; the message says how to get it.
    """

    def __init__(self, dofs: int, limits: Limits) -> None:
        ruckig = _ruckig()
        self.dofs = dofs
        self.limits = limits
        self._solver = ruckig.Ruckig(dofs)
        self._trajectory = ruckig.Trajectory(dofs)
        self._input = ruckig.InputParameter(dofs)
        self._input.max_velocity = [limits.velocity] * dofs
        self._input.max_acceleration = [limits.acceleration] * dofs
        self._input.max_jerk = [limits.jerk] * dofs
        self._ok = (ruckig.Result.Working, ruckig.Result.Finished)
        self._error = ruckig.RuckigError

    def plan(self, start: npt.ArrayLike, velocity: npt.ArrayLike, target: npt.ArrayLike) -> Profiles:
        """Paths that begin without acceleration and end at rest.

        Args:
            start: positions, radians, [B, D].
            velocity: velocities at the start, rad/s, [B, D]; above the limit, the path brakes first.
            target: positions at the end, radians, [B, D].

        Returns:
            The paths. A slot without one (values that are not finite) is not ``planned`` and stays at ``start``.

        Raises:
            InterpolationError: a shape does not match.
        """
        rows = [_rows(name, value, self.dofs) for name, value in (("start", start), ("target", target))]
        rows.insert(1, _rows("velocity", velocity, self.dofs))
        if len({len(row) for row in rows}) != 1:
            raise InterpolationError(f"start, velocity and target differ in length: {[len(row) for row in rows]}")
        return self._collect(*rows)

    def _collect(self, start: np.ndarray, velocity: np.ndarray, target: np.ndarray) -> Profiles:
        count = len(start)
        begin, position, *others = np.zeros((5, count, self.dofs, NUM_PHASES))
        position[:] = start[..., None]
        duration, planned = np.zeros(count), np.zeros(count, bool)
        for i in range(count):
            planned[i] = self._solve(start[i], velocity[i], target[i])
            if planned[i]:
                duration[i] = self._trajectory.duration
                phases = [_phases(profile) for profile in self._trajectory.profiles[0]]
                begin[i], position[i], others[0][i], others[1][i], others[2][i] = np.swapaxes(phases, 0, 1)
        return Profiles(begin, position, others[0], others[1], others[2], duration, planned)

    def _solve(self, start: np.ndarray, velocity: np.ndarray, target: np.ndarray) -> bool:
        self._input.current_position = start.tolist()
        self._input.current_velocity = velocity.tolist()
        self._input.target_position = target.tolist()
        try:
            return self._solver.calculate(self._input, self._trajectory) in self._ok
        except self._error:
            return False


@runtime_checkable
class _Phases(Protocol):
    """Consecutive phases of one dof, as ``ruckig`` gives them: durations, and the values at their beginnings."""

    t: Sequence[float]
    p: Sequence[float]
    v: Sequence[float]
    a: Sequence[float]
    j: Sequence[float]


@runtime_checkable
class _Brake(_Phases, Protocol):
    """The braking phases, which are all unused if their ``duration`` is 0."""

    duration: float


@runtime_checkable
class _DofProfile(_Phases, Protocol):
    """The path of one dof: seven phases, and the braking phases before them."""

    brake: _Brake


def _phases(profile: _DofProfile) -> list[list[float]]:
    """Begin, position, velocity, acceleration and jerk of the phases of one dof, [5][10]."""
    brake = profile.brake
    begin = [0.0, *itertools.accumulate((*brake.t, *profile.t))]
    if not brake.duration:  # the two braking phases take no time and hold nothing
        brake_p, brake_v, brake_a, brake_j = [profile.p[0]] * 2, [profile.v[0]] * 2, [profile.a[0]] * 2, [0.0] * 2
    else:
        brake_p, brake_v, brake_a, brake_j = brake.p, brake.v, brake.a, brake.j
    return [
        begin,
        [*brake_p, *profile.p],
        [*brake_v, *profile.v],
        [*brake_a, *profile.a],
        [*brake_j, *profile.j, 0.0],
    ]


def _rows(name: str, value: npt.ArrayLike, dofs: int) -> np.ndarray:
    rows = np.asarray(value, np.float64)
    if rows.ndim != 2 or rows.shape[1] != dofs:
        raise InterpolationError(f"{name} must have shape [B, {dofs}], got {list(rows.shape)}")
    return rows


def _ruckig() -> Any:
    try:
        import ruckig
    except ImportError as error:
        raise ImportError("jerk-limited paths need the package 'ruckig': pip install 'vecenv[simpler]'") from error
    return ruckig
