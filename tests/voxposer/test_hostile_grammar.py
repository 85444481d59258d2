"""Random programs over the whole grammar of the sandbox: a value or a sandbox error, and nothing else in the host."""

from __future__ import annotations

import gc
import time
import types
from collections.abc import Iterator
from typing import Any

import numpy as np
from hypothesis import HealthCheck, given, settings
from support.hostile.generated import PROGRAMS
from support.sandbox_runs import BOWL, FUNCTIONS

from voxposer.sandbox.guard import Limits, kind_of
from voxposer.sandbox.interpreter import parse
from voxposer.sandbox.syntax import RULES, SandboxError

LIMITS = Limits(steps=5_000, calls=30, memory_bytes=64 * 2**20, seconds=0.3)
SHARED = np.arange(27.0).reshape(3, 3, 3)


def state() -> list[Any]:
    fields = {name: np.array(BOWL[name]).tolist() for name in BOWL.fields()}
    return [fields, sorted(FUNCTIONS), SHARED.tolist(), np.geterr(), np.get_printoptions()]


def held(value: object) -> Iterator[object]:
    """What a value consists of."""
    pending, seen = [value], set()
    while pending:
        item = pending.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        yield item
        if isinstance(item, dict):
            pending += [*item.keys(), *item.values()]
        elif isinstance(item, (list, tuple, set)):
            pending += item


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(PROGRAMS)
def test_a_random_program_gives_a_value_or_a_sandbox_error_and_changes_nothing(source: str) -> None:
    before, began = state(), time.process_time()
    try:
        outcome = parse(source, limits=LIMITS).run({**FUNCTIONS, "get_map": lambda: SHARED.copy()}, returns="ret_val")
    except SandboxError as error:
        assert error.rule in RULES  # noqa: PT017
        assert len(str(error).splitlines()) == 1, source  # noqa: PT017
        assert len(str(error)) < 1000, source  # noqa: PT017
        assert " at 0x" not in str(error), source  # noqa: PT017
    else:
        for value in outcome.variables.values():
            for item in held(value):
                assert not isinstance(item, (types.ModuleType, types.FunctionType, types.FrameType, type)), source
                assert type(item).__module__ in ("builtins", "numpy", *OURS), source
            kind_of(value)
    assert time.process_time() - began < LIMITS.seconds + 2, source
    assert state() == before, source
    assert gc.isenabled()


OURS = ("voxposer.sandbox.objects", "support.sandbox_runs")
