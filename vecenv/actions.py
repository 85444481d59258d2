"""Validation of actions, and the table of every action convention.

``step_continuous`` takes 7-vectors: a translation, a rotation as axis-angle vector, a gripper command. Units and
frames depend on the suite:

====================  =============  ===========  ==========================  =======================================
suite                 translation    rotation     relative to                 gripper
====================  =============  ===========  ==========================  =======================================
LIBERO                1 is 0.05 m    1 is 0.5     current pose, world axes    +1 closes, -1 opens; by its sign
simpler/bridge        metres         radians      last target, base axes      +1 open, -1 closed; absolute
simpler/google_robot  metres         radians      measured pose, base axes    added: +1 closes, -1 opens, 0 stays
====================  =============  ===========  ==========================  =======================================

Values are clipped: LIBERO's to 1, SIMPLER's to 1 m, pi/2 and 1. ``vecenv.make(..., gripper="binary")`` makes the
gripper column of both SIMPLER suites 1 closed and 0 open (threshold 0.5). ``GRIPPER`` is the column as data.
``step_ee_pose`` and ``step_waypoints`` have one convention in all suites: xyz in metres and wxyz, absolute, world
frame, grip 1 closed and 0 open.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from vecenv.contract import ACTION_DIM, EE_POSE_DIM
from vecenv.controllers.waypoint import Pose, WaypointPlan
from vecenv.errors import InvalidInput
from vecenv.util import inputs

_NO_LENGTH = 1e-6


@dataclass(frozen=True, kw_only=True)
class GripperColumn:
    """Meaning of the last column of a 7-vector.

    Attributes:
        closed, open: values that close and open the gripper.
        relative: values are added to the last command, so that 0 leaves it as it is.
    """

    closed: float
    open: float
    relative: bool = False


GRIPPER: Mapping[str, GripperColumn] = MappingProxyType(
    {
        "libero": GripperColumn(closed=1.0, open=-1.0),
        "simpler/bridge": GripperColumn(closed=-1.0, open=1.0),
        "simpler/google_robot": GripperColumn(closed=1.0, open=-1.0, relative=True),
        "binary": GripperColumn(closed=1.0, open=0.0),
    }
)
"""The gripper column of LIBERO's suites, of each of SIMPLER's, and of SIMPLER's option ``gripper="binary"``."""


class ActionError(InvalidInput):
    """An action has the wrong type or shape; the message states the given and the expected one."""


def _array(
    value: object,
    what: str,
    right: str,
    fits: Callable[[tuple[int, ...]], bool],
    kinds: str = "iuf",
) -> np.ndarray:
    """A float64 array of one of the shapes that fit, from an array, nested lists or JSON text."""
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except (ValueError, RecursionError) as error:
            raise ActionError(f"{what}: not JSON ({error}); expected {right}") from error
    return inputs.floats(value, what, right, ActionError, kinds=kinds, fits=fits)


def continuous(value: object, num_envs: int, limits: npt.ArrayLike = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Validate the input of ``step_continuous``.

    Args:
        value: [B, 7] or a chunk [B, K, 7], as an array, nested lists or JSON text; with B = 1 also [7].
        num_envs: B.
        limits: largest absolute values, one number or [7].

    Returns:
        float64 actions [B, K, 7], finite and within the limits; and which slots had to be sanitized, bool [B].

    Raises:
        ActionError: the wrong shape or not numbers.
    """
    right = f"[{num_envs}, {ACTION_DIM}] or [{num_envs}, K, {ACTION_DIM}]"

    def fits(shape: tuple[int, ...]) -> bool:
        if num_envs == 1 and shape == (ACTION_DIM,):
            return True
        return len(shape) in (2, 3) and (shape[0], shape[-1]) == (num_envs, ACTION_DIM)

    array = _array(value, "actions", right, fits)
    if array.ndim < 3:
        array = array.reshape(num_envs, 1, ACTION_DIM)
    most = np.asarray(limits, float)
    sanitized = np.clip(np.nan_to_num(array, nan=0.0, posinf=0.0, neginf=0.0), -most, most)
    return sanitized, (sanitized != array).any(axis=(1, 2))


def ee_poses(value: object, num_envs: int) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Validate the input of ``step_ee_pose``.

    Args:
        value: [B, 8] poses (xyz, wxyz, grip), as an array, nested lists or JSON text; with B = 1 also [8]. An empty
            sequence, or None, is a no-op for every slot.
        num_envs: B.

    Returns:
        float64 poses [B, 8] with unit quaternions (arbitrary where invalid), which slots are to move, bool [B], and
        why a slot is not to move, B strings, empty for the no-op.

    Raises:
        ActionError: the wrong shape or not numbers.
    """
    right = f"[{num_envs}, {EE_POSE_DIM}] or an empty sequence"

    def fits(shape: tuple[int, ...]) -> bool:
        return shape == (num_envs, EE_POSE_DIM) or 0 in shape or (num_envs == 1 and shape == (EE_POSE_DIM,))

    array = _array([] if value is None else value, "poses", right, fits)
    if array.size == 0:
        return np.zeros((num_envs, EE_POSE_DIM)), np.zeros(num_envs, bool), ("",) * num_envs
    array = array.reshape(num_envs, EE_POSE_DIM)
    finite = np.asarray(np.isfinite(array).all(axis=1))
    clean = np.where(np.isfinite(array), array, 0.0)
    largest = np.abs(clean[:, 3:7]).max(axis=1, keepdims=True)
    unit = largest[:, 0] > _NO_LENGTH
    # Scaled first, because the square of a huge number overflows.
    quat = np.where(unit[:, None], clean[:, 3:7] / np.maximum(largest, _NO_LENGTH), [1.0, 0.0, 0.0, 0.0])
    clean[:, 3:7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    errors = tuple(
        "" if ok and turn else ("pose is not finite" if not ok else "quaternion has no length")
        for ok, turn in zip(finite, unit, strict=True)
    )
    return clean, finite & unit, errors


# Keys of an action of ``step_ee_pose`` that is a mapping.
_EE_POSE_KEYS = ("pose", "hold_steps", "carry", "slots")
# Attributes or keys of a plan of ``step_waypoints``.
_PLAN_FIELDS = ("poses", "grip", "hold", "valid")


def ee_pose_fields(value: object) -> Mapping[str, object]:
    """The arguments that an action of ``step_ee_pose`` gives: those of a mapping, or the poses alone.

    Raises:
        ActionError: a mapping with another key, or without ``pose``.
    """
    if not isinstance(value, Mapping):
        return {"pose": value}
    _check_keys(value, "poses", _EE_POSE_KEYS)
    if "pose" not in value:
        raise ActionError(f"poses: a mapping without 'pose'; expected {', '.join(_EE_POSE_KEYS)}, all but it optional")
    return value


def _check_keys(value: Mapping[Any, object], what: str, known: Sequence[str]) -> None:
    if unknown := [key for key in value if key not in known]:
        raise ActionError(f"{what}: unknown key {inputs.shown(unknown[0])}; expected {', '.join(known)}")


def flags(value: object, num_envs: int, name: str) -> np.ndarray:
    """Validate one true or false, or one a slot; returns bool [B].

    Raises:
        ActionError: anything else.
    """
    return inputs.bools(value, name, num_envs, ActionError)


def plan(value: object, num_envs: int) -> tuple[WaypointPlan, tuple[str, ...]]:
    """Validate the input of ``step_waypoints``.

    Args:
        value: a plan with the attributes, or a mapping with the keys, ``poses`` [B, T, 7] (xyz, wxyz), ``grip`` [B, T],
            ``hold`` [B, T] and ``valid`` [B, T], whose entries are bools, or 0 and 1.
        num_envs: B.

    Returns:
        The plan with unit quaternions, bad waypoints marked invalid; and what was wrong in each slot, B strings.

    Raises:
        ActionError: the wrong shape or not numbers, or another key.
    """
    if isinstance(value, Mapping):
        _check_keys(value, "plan", _PLAN_FIELDS)
    poses = _plan_field(value, "poses", num_envs, (7,))
    shape = poses.shape[:2]
    grip, hold, valid = (_plan_field(value, name, num_envs, (), shape[1]) for name in _PLAN_FIELDS[1:])
    if not np.isin(valid, (0, 1)).all():
        raise ActionError("plan.valid: expected bools, or 0 and 1")
    rows = np.concatenate([poses, grip[..., None]], axis=-1).reshape(-1, EE_POSE_DIM)
    clean, usable, problems = ee_poses(rows, len(rows))
    clean, wanted = clean.reshape(*shape, EE_POSE_DIM), valid != 0
    holds = hold_steps(hold.reshape(-1), len(rows)).reshape(shape)
    reasons = np.where(wanted, np.array(problems, object).reshape(shape), "")
    errors = tuple("; ".join(f"waypoint {t}: {reason}" for t, reason in enumerate(row) if reason) for row in reasons)
    pose = Pose(clean[..., :3], clean[..., 3:7])
    return WaypointPlan(pose, clean[..., 7], holds, wanted & usable.reshape(shape)), errors


def _plan_field(value: object, name: str, num_envs: int, tail: tuple[int, ...], count: int | None = None) -> np.ndarray:
    found = value.get(name) if isinstance(value, Mapping) else getattr(value, name, None)
    right = f"[{', '.join(map(str, (num_envs, 'T' if count is None else count, *tail)))}]"

    def fits(shape: tuple[int, ...]) -> bool:
        whole = len(shape) == 2 + len(tail) and shape[0] == num_envs and shape[2:] == tail and shape[1] > 0
        return whole and count in (None, shape[1])

    kinds = "biuf" if name in ("grip", "valid") else "iuf"
    return _array([] if found is None else found, f"plan.{name}", right, fits, kinds)


def hold_steps(value: object, num_envs: int) -> np.ndarray:
    """Validate ``hold_steps``: one non-negative whole number (2.0 is one), or one a slot; returns int [B].

    Raises:
        ActionError: anything else.
    """
    right = f"a non-negative integer or {num_envs} of them"
    array = _array(value, "hold_steps", right, lambda shape: shape in ((), (num_envs,)))
    whole = (array >= 0) & (array <= inputs.MOST_COUNT) & (array == np.floor(array))
    if not whole.all():
        raise ActionError(f"hold_steps: got {inputs.shown(value)}; expected {right}")
    return np.broadcast_to(array.astype(int), num_envs).copy()
