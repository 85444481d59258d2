"""Evaluation harness: which episodes, which policy, how it went.

``vecenv_eval.evaluate(vecenv_eval.EvalConfig(suite="libero_object"))`` is ``vecenv eval --suite libero_object``. Both
names are imported when they are first used, so that ``vecenv --help`` loads no simulator.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vecenv_eval.config import EvalConfig
    from vecenv_eval.runner import evaluate

__all__ = ["EvalConfig", "evaluate"]


def __getattr__(name: str) -> object:
    if name == "EvalConfig":
        from vecenv_eval.config import EvalConfig

        return EvalConfig
    if name == "evaluate":
        from vecenv_eval.runner import evaluate

        return evaluate
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
