"""Whatever a caller calls an action becomes a validated array; every convention about actions is on this page.

========  =========================================================  =======================================
space     one action                                                 gripper
========  =========================================================  =======================================
7-vector  dx dy dz, axis-angle rotation, gripper, each in [-1, 1]    +1 closes, -1 opens (LIBERO)
8-vector  x y z in metres, qw qx qy qz, grip: absolute world pose    1 closed, 0 open
========  =========================================================  =======================================

For LIBERO a translation of 1 is 0.05 m and a rotation of 1 is 0.5 rad, relative to the current pose, world frame.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from vecenv.contract import ACTION_DIM, EE_POSE_DIM

_NO_LENGTH = 1e-6
_MOST_STEPS = 2**31 - 1


class ActionError(ValueError):
    """An action has the wrong type or shape; the message says what arrived and what would be right."""


def _array(value: Any, what: str, right: str) -> np.ndarray:
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except (ValueError, RecursionError) as error:
            raise ActionError(f"{what}: not JSON ({error}); expected {right}") from error
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise ActionError(f"{what}: not numeric or ragged ({error}); expected {right}") from error
    if array.dtype.kind not in "biuf":
        raise ActionError(f"{what}: got {array.dtype} values, not numbers; expected {right}")
    return array.astype(np.float64)


def continuous(value: Any, num_envs: int) -> tuple[np.ndarray, np.ndarray]:
    """Validate the input of ``step_continuous``.

    Args:
        value: [B, 7] or a chunk [B, K, 7], as an array, nested lists or JSON text; with B = 1 also [7].
        num_envs: B.

    Returns:
        float64 actions [B, K, 7], finite and within [-1, 1]; and which slots had to be mended, bool [B].

    Raises:
        ActionError: the wrong shape or not numbers.
    """
    right = f"[{num_envs}, {ACTION_DIM}] or [{num_envs}, K, {ACTION_DIM}]"
    array = _array(value, "actions", right)
    shape = array.shape
    if num_envs == 1 and array.shape == (ACTION_DIM,):
        array = array[None]
    if array.ndim == 2:
        array = array[:, None]
    if array.ndim != 3 or array.shape[0] != num_envs or array.shape[2] != ACTION_DIM:
        raise ActionError(f"actions: got shape {shape}; expected {right}")
    mended = np.clip(np.nan_to_num(array, nan=0.0, posinf=0.0, neginf=0.0), -1.0, 1.0)
    return mended, (mended != array).any(axis=(1, 2))


def ee_poses(value: Any, num_envs: int) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
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
    array = _array([] if value is None else value, "poses", right)
    if array.size == 0:
        return np.zeros((num_envs, EE_POSE_DIM)), np.zeros(num_envs, bool), ("",) * num_envs
    if num_envs == 1 and array.shape == (EE_POSE_DIM,):
        array = array[None]
    if array.shape != (num_envs, EE_POSE_DIM):
        raise ActionError(f"poses: got shape {array.shape}; expected {right}")
    finite = np.asarray(np.isfinite(array).all(axis=1))
    clean = np.where(np.isfinite(array), array, 0.0)
    largest = np.abs(clean[:, 3:7]).max(axis=1, keepdims=True)
    unit = largest[:, 0] > _NO_LENGTH
    # Scaled first, because the square of a huge number is not finite.
    quat = np.where(unit[:, None], clean[:, 3:7] / np.maximum(largest, _NO_LENGTH), [1.0, 0.0, 0.0, 0.0])
    clean[:, 3:7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    errors = tuple(
        "" if ok and turn else ("pose is not finite" if not ok else "quaternion has no length")
        for ok, turn in zip(finite, unit, strict=True)
    )
    return clean, finite & unit, errors


def hold_steps(value: Any, num_envs: int) -> np.ndarray:
    """Validate ``hold_steps``: one non-negative integer, or one a slot; returns int [B].

    Raises:
        ActionError: anything else.
    """
    right = f"a non-negative integer or {num_envs} of them"
    array = _array(value, "hold_steps", right)
    whole = (array >= 0) & (array <= _MOST_STEPS) & (array == np.floor(array))
    if array.shape not in ((), (num_envs,)) or not whole.all():
        raise ActionError(f"hold_steps: got {value!r}; expected {right}")
    return np.broadcast_to(array.astype(int), num_envs).copy()
