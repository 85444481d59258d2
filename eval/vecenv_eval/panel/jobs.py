"""Functions that are to be called with the environment, on its thread, and what they return."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, TypeAlias

from vecenv.contract import BatchEnv
from vecenv_eval.panel.state import OutOfTurn

Job: TypeAlias = tuple[Callable[[BatchEnv], Any], "Future[Any]"]


def do(jobs: Sequence[Job], env: BatchEnv | None) -> None:
    """Call functions and hand over what they return or raise; without an environment each fails."""
    for function, future in jobs:
        if env is None:
            future.set_exception(OutOfTurn("nothing is built yet"))
            continue
        try:
            future.set_result(function(env))
        except Exception as error:  # of whoever asked
            future.set_exception(error)


def fail(jobs: Sequence[Job], error: Exception) -> None:
    """Let functions that were not called fail."""
    for _, future in jobs:
        future.set_exception(error)
