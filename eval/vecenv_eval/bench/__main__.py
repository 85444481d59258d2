"""One measurement in a process of its own: the side and its arguments as JSON come in, the rates as JSON go out."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from typing import Any

from vecenv_eval.bench.physics import measure_upstream, measure_vecenv
from vecenv_eval.bench.suite import execute_upstream


def measure(side: str, arguments: Mapping[str, Any]) -> dict[str, float]:
    """Run one side of a benchmark."""
    if side == "upstream":
        return {"upstream": measure_upstream(**arguments)}
    if side == "vecenv":
        return measure_vecenv(**arguments)
    if side == "suite":
        return execute_upstream(**arguments)
    raise ValueError(f"no side called {side!r}")


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], json.loads(sys.argv[2]))))
