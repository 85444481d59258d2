"""Configs from keyword arguments: every field by name and type."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from vecenv.util import configs


@dataclass(frozen=True, kw_only=True)
class Size:
    width: int = 4
    name: str = "small"


@dataclass(frozen=True, kw_only=True)
class Options:
    steps: int | None = None
    scale: float = 1.0
    flag: bool = False
    size: Size = field(default_factory=Size)
    either: Mapping[str, Any] | Size | None = None


def build(base: Options | None = None, **fields: object) -> Options:
    return configs.build(Options, fields, base, what="it", error=ValueError)


def test_fields_replace_those_of_the_base_and_nested_configs_may_be_mappings() -> None:
    base = build(steps=3, size={"width": 9})
    assert base == Options(steps=3, size=Size(width=9))
    assert build(base, flag=True) == Options(steps=3, size=Size(width=9), flag=True)
    assert build(base, steps=None).steps is None


def test_a_mapping_stays_one_where_the_field_says_so() -> None:
    assert build(either={"width": 1}).either == {"width": 1}
    assert build(either=Size()).either == Size()


def test_numpy_scalars_are_numbers() -> None:
    assert build(steps=np.int64(3), scale=np.float64(0.5), flag=np.bool_(True)) == Options(
        steps=3, scale=0.5, flag=True
    )


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"stps": 3}, r"it has no option stps=3; did you mean steps\?; its own: steps, scale, flag, size, either"),
        ({"steps": "3"}, "steps.*int"),
        ({"steps": True}, "steps=True.*not a bool"),
        ({"size": {"depth": 1}}, "depth"),
        ({"size": {"width": "wide"}}, "width"),
        ({"either": True}, "either"),
        ({"flag": 1}, "flag.*bool"),
    ],
)
def test_other_names_and_types_are_refused_with_what_is_right(fields: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        build(**fields)
