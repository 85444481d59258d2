"""Actions as JSON text: what ``step_continuous`` and ``step_ee_pose`` read.

In: text that may hold anything. Out: numbers of the right shape, or one sentence that says what is wrong.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np

from vecenv.contract import ACTION_DIM, EE_POSE_DIM
from vecenv.interop.nodes.ports import NodeError

_CHUNK = f"{ACTION_DIM} numbers, or a list of such lists"
_POSE = f'{EE_POSE_DIM} numbers, or {{"pose": [{EE_POSE_DIM} numbers], "hold_steps": N}}'
_KEYS = ("pose", "hold_steps", "carry")
# More ticks than any episode has.
_MOST_TICKS = 1_000_000


class EePoseText(NamedTuple):
    """A waypoint: ``pose`` [8] (xyz in metres, wxyz, grip) or None for a no-op, ``hold_steps``, ``carry``."""

    pose: np.ndarray | None
    hold_steps: int = 0
    carry: bool = False


def read_chunk(text: str, most: int = 0) -> np.ndarray:
    """Actions of ``step_continuous``, [K, 7]; none of ``[]``. NaN and infinities pass, the environment replaces them.

    Args:
        text: JSON of a 7-vector or of a list of them.
        most: rows that are kept, the first ones; 0 for all.

    Raises:
        NodeError: it is something else.
    """
    value = _json(text, _CHUNK)
    if not isinstance(value, list):
        raise NodeError(f"action: got {_named(value)}; expected {_CHUNK}")
    if not value:
        return np.zeros((0, ACTION_DIM))
    rows = value if isinstance(value[0], list) else [value]
    kept = rows[:most] if most else rows
    return np.array([_numbers(row, ACTION_DIM, _CHUNK) for row in kept])


def read_ee_pose(text: str) -> EePoseText:
    """The waypoint of ``step_ee_pose``; ``[]`` is a no-op.

    Raises:
        NodeError: it is something else, or has a number that is not finite.
    """
    value = _json(text, _POSE)
    given = value if isinstance(value, dict) else {"pose": value}
    if unknown := [key for key in given if key not in _KEYS]:
        raise NodeError(f"action: unknown key {unknown[0][:80]!r}; expected {', '.join(_KEYS)}")
    if "pose" not in given:
        raise NodeError(f"action: 'pose' is missing; expected {_POSE}")
    pose, hold, carry = given["pose"], given.get("hold_steps", 0), given.get("carry", False)
    if isinstance(hold, bool) or not isinstance(hold, int) or not 0 <= hold <= _MOST_TICKS:
        raise NodeError(f"action: hold_steps={str(hold)[:80]}; expected a whole number from 0 to {_MOST_TICKS}")
    if not isinstance(carry, bool):
        raise NodeError(f"action: carry={str(carry)[:80]}; expected true or false")
    if pose == []:
        return EePoseText(None)
    return EePoseText(_finite(_numbers(pose, EE_POSE_DIM, _POSE)), hold, carry)


def _json(text: str, right: str) -> Any:
    try:
        return json.loads(text)
    except RecursionError:
        raise NodeError(f"action: nested too deeply; expected {right}") from None
    except ValueError as error:
        raise NodeError(f"action: not JSON ({str(error)[:200]}); expected {right}") from None


def _numbers(value: Any, count: int, right: str) -> np.ndarray:
    if not isinstance(value, list):
        raise NodeError(f"action: got {_named(value)}; expected {right}")
    if len(value) != count:
        raise NodeError(f"action: got {len(value)} numbers; expected {right}")
    for each in value:
        if isinstance(each, bool) or not isinstance(each, int | float):
            raise NodeError(f"action: got {_named(each)} among the numbers; expected {right}")
    try:
        return np.array([float(each) for each in value])
    except OverflowError:
        raise NodeError(f"action: a whole number is too large; expected {right}") from None


def _finite(pose: np.ndarray) -> np.ndarray:
    if not np.isfinite(pose).all():
        raise NodeError("action: the pose is not finite")
    return pose


def _named(value: Any) -> str:
    names = {dict: "an object", list: "a list", str: "a text", bool: "true or false", type(None): "null"}
    return names.get(type(value), "a number")
