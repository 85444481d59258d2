"""What servers mean by the gripper column, turned into LIBERO's: -1 opens, +1 closes. NaN stays NaN.

=====================  =============================================================================================
``as_is``              passed on unchanged; the environment goes by the sign (openpi)
``sign``               negative opens, everything else closes (vla-evaluation-harness's LIBERO benchmark)
``open_above_half``    above one half opens, everything else closes (StarVLA, GR00T: 1 is open and 0 closed)
=====================  =============================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from vecenv.actions import GRIPPER


def _as_is(column: np.ndarray) -> np.ndarray:
    return column


def _sign(column: np.ndarray) -> np.ndarray:
    return _commands(column < 0, column)


def _open_above_half(column: np.ndarray) -> np.ndarray:
    return _commands(column > 0.5, column)


def _commands(opens: np.ndarray, column: np.ndarray) -> np.ndarray:
    robot = GRIPPER["libero"]
    return np.where(np.isnan(column), np.nan, np.where(opens, robot.open, robot.closed))


GRIPPERS: Mapping[str, Callable[[np.ndarray], np.ndarray]] = MappingProxyType(
    {"as_is": _as_is, "sign": _sign, "open_above_half": _open_above_half}
)
"""Conversions by name; each takes and gives a gripper column of any shape."""


def convert(actions: np.ndarray, gripper: str) -> np.ndarray:
    """Actions [..., 7] with the last column converted by one of ``GRIPPERS``; a copy."""
    converted = np.array(actions, dtype=np.float64)
    converted[..., -1] = GRIPPERS[gripper](converted[..., -1])
    return converted
