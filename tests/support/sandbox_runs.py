"""Runs of programs in the sandbox, with a few functions and small limits."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from voxposer.sandbox.guard import Limits, Record
from voxposer.sandbox.interpreter import Outcome, parse
from voxposer.sandbox.syntax import SandboxError

LIMITS = Limits(steps=60_000, calls=100, memory_bytes=160 * 2**20)


class Thing(Record):
    """An observation with a few fields."""

    def __init__(self, **fields: Any) -> None:
        self._fields = fields

    def fields(self) -> list[str]:
        return list(self._fields)

    def __getitem__(self, name: str, /) -> Any:
        value = self._fields[name]
        return value.copy() if isinstance(value, np.ndarray) else value

    def __str__(self) -> str:
        return self._fields["name"]


BOWL = Thing(name="bowl", position=np.array([20, 30, 40]), aabb=np.array([[15, 25, 38], [25, 35, 44]]), held=False)


def detect(name: str) -> Thing:
    if name != "bowl":
        raise KeyError(f"no {name!r}")
    return BOWL


FUNCTIONS = MappingProxyType(
    {
        "detect": detect,
        "get_map": lambda: np.zeros((100, 100, 100)),
        "get_quats": lambda: np.zeros((100, 100, 100, 4)),
        "cm2index": lambda cm, axis: int(cm / 2),
    }
)


def run(source: str, **options: Any) -> Outcome:
    return parse(source, limits=options.pop("limits", LIMITS)).run(FUNCTIONS, **options)


def variables(source: str, **options: Any) -> Mapping[str, Any]:
    return run(source, **options).variables


def refusal(source: str, **options: Any) -> SandboxError:
    with pytest.raises(SandboxError) as caught:
        run(source, **options)
    return caught.value
