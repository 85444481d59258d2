"""Options, faults and the neighbourhood of the path planner, shared by its JAX and numba engines."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Numbers of the planner, by upstream's names; lengths are in hundredths of the grid's side.

    Attributes:
        stop_threshold: the descent ends where no neighbour costs less than this much more than the voxel it is at.
        savgol_polyorder: degree of the polynomials that smooth the path.
        savgol_window_size: waypoints such a polynomial is fitted to; shorter paths take what they have.
        obstacle_map_weight: weight of the blurred obstacle map, itself scaled to [0, 1].
        max_steps: steps of the descent at most.
        obstacle_map_gaussian_sigma: standard deviation of the blur, in voxels.
        target_map_weight: weight of the distance to the nearest target, itself scaled to [0, 1].
        stop_criteria: the only one there is.
        target_spacing: inner waypoints that lie closer are thinned out.
        max_curvature: the path is cut before the first sharper bend, 1/voxel.
        pushing_skip_per_k: where an object is moved, every how many waypoints are kept.
        method: ``"greedy"``, upstream's descent; or ``"straight"``, a straight line to the nearest target whatever is
            in between, against which the planner's part in a result can be measured.

    Raises:
        ValueError: naming the field that is out of range.
    """

    stop_threshold: float = 0.001
    savgol_polyorder: int = 3
    savgol_window_size: int = 20
    obstacle_map_weight: float = 1
    max_steps: int = 300
    obstacle_map_gaussian_sigma: float = 10
    target_map_weight: float = 2
    stop_criteria: Literal["no_nearby_equal"] = "no_nearby_equal"
    target_spacing: float = 1
    max_curvature: float = 3
    pushing_skip_per_k: int = 5
    method: Literal["greedy", "straight"] = "greedy"

    def __post_init__(self) -> None:
        if self.method not in ("greedy", "straight"):
            raise ValueError(f"method must be 'greedy' or 'straight', got {self.method!r}")
        if self.stop_criteria != "no_nearby_equal":
            raise ValueError(f"stop_criteria must be 'no_nearby_equal', got {self.stop_criteria!r}")
        for name in ("savgol_window_size", "max_steps", "pushing_skip_per_k"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("savgol_polyorder", "obstacle_map_gaussian_sigma", "target_spacing"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")


class Fault(enum.IntEnum):
    """Why a slot has no path."""

    NONE = 0
    NO_TARGET = 1
    """No voxel of the target map equals 1."""
    NOT_FINITE = 2
    """NaN or infinity in a map or in the start."""


def reach(size: int) -> int:
    """How many voxels a step may go along each axis."""
    return int(2 * size / 100)


def neighbour_offsets(size: int) -> np.ndarray:
    """Offsets of a voxel's surroundings, itself included, in the order of ``np.unique``, [K, 3]."""
    steps = np.arange(-reach(size), reach(size) + 1)
    return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
