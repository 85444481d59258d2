"""The watched process: runs programs one after the other and says when each begins and how it ends.

Standard input: a line of JSON, ``{"world", "limits", "sources"}``, then an empty line for each program that is to
begin, so that whoever watches can look first. Standard output: ``ready``, then a line of JSON for each program that has
ended: ``rule`` ("" for a program that ran to its end), ``line``, ``reason``; ``other`` in their place is an exception
that is no sandbox error.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

from voxposer.sandbox.guard import Limits
from voxposer.sandbox.interpreter import parse
from voxposer.sandbox.syntax import SandboxError

Run = Callable[[str], None]


def main() -> None:
    """Run what standard input names."""
    given = json.loads(sys.stdin.readline())
    run = WORLDS[given["world"]](Limits(**given["limits"]))
    print("ready", flush=True)
    for source in given["sources"]:
        sys.stdin.readline()
        print(json.dumps(_ended(run, source)), flush=True)


def _ended(run: Run, source: str) -> dict[str, Any]:
    try:
        run(source)
    except SandboxError as error:
        return {"rule": error.rule, "line": error.line, "reason": str(error)}
    except Exception as error:
        if type(error).__name__ != "LmpError":
            return {"other": f"{type(error).__name__}: {error}"[:500]}
        return {"reason": str(error), **{name: getattr(error, name) for name in ("rule", "line", "lmp")}}
    return {"rule": "", "line": 0, "reason": ""}


def _things(limits: Limits) -> Run:
    """A few functions, and nothing else imported."""
    from support.sandbox_runs import FUNCTIONS

    def run(source: str) -> None:
        parse(source, limits=limits).run(FUNCTIONS, returns="ret_val")

    return run


def _robot(limits: Limits) -> Run:
    """The composer of a robot on its real perception, whose maps are written by programs of ``NESTED``."""
    from support.hostile.robot import Robot

    return Robot(limits).run


WORLDS: dict[str, Callable[[Limits], Run]] = {"things": _things, "robot": _robot}
