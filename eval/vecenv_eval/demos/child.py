"""The process that reads HDF5 files for ``vecenv_eval.demos.reader``: requests on standard input, answers on output.

It holds nothing that is worth anything, has a limited memory, and ends by itself when a request takes too long or
nobody is there to ask.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vecenv.assets import AssetsMissing
from vecenv_eval.demos.copy import copy_here
from vecenv_eval.demos.hdf5 import DAMAGE, DemoError
from vecenv_eval.demos.read import check_here, read_here, state_here
from vecenv_eval.demos.reader import pack
from vecenv_eval.demos.schema import Demo, StoredStart

# Bytes of memory beyond what the process has at its start.
_MEMORY = 4 << 30


class _Arrays(list[np.ndarray]):
    """The arrays of an answer."""

    def put(self, array: np.ndarray | None) -> int | None:
        """Add an array; gives its position."""
        if array is None:
            return None
        self.append(array)
        return len(self) - 1


def _read(path: Path, request: Mapping[str, Any], arrays: _Arrays) -> dict[str, Any]:
    demos, bad = read_here(path, suite=request["suite"], task=request["task"])
    return {"demos": [_plain(demo, arrays) for demo in demos], "bad": [[each.name, each.reason] for each in bad]}


def _plain(demo: Demo, arrays: _Arrays) -> dict[str, Any]:
    start = demo.start
    if isinstance(start, StoredStart):
        poses = start.fixtures
        fixtures = None if poses is None else {name: [*map(arrays.put, pose)] for name, pose in poses.items()}
        begins: dict[str, Any] = {"state": arrays.put(start.state), "fixtures": fixtures}
    else:
        begins = {"episode": start.episode, "options": dict(start.options)}
    return {
        "name": demo.name,
        "suite": demo.suite,
        "task": demo.task,
        "start": begins,
        "actions": arrays.put(demo.actions),
        "success": demo.success,
        "second_half": arrays.put(demo.second_half),
        "stand_ins": demo.stand_ins,
    }


def _state(path: Path, request: Mapping[str, Any], arrays: _Arrays) -> dict[str, Any]:
    return {"state": arrays.put(state_here(path, request["name"], request["ticks"], request["length"]))}


def _check(path: Path, request: Mapping[str, Any], arrays: _Arrays) -> dict[str, Any]:
    check_here(path)
    return {}


def _copy(path: Path, request: Mapping[str, Any], arrays: _Arrays) -> dict[str, Any]:
    return {"copied": copy_here(path, Path(request["target"]), Path(request["out"]), request["names"])}


_REQUESTS: dict[str, Callable[[Path, Mapping[str, Any], _Arrays], dict[str, Any]]] = {
    "read": _read,
    "state": _state,
    "check": _check,
    "copy": _copy,
}


def answer(line: bytes) -> bytes:
    """The answer to one request."""
    request = json.loads(line)
    path, shown, arrays = Path(request["path"]), request["shown"], _Arrays()
    try:
        return pack(_REQUESTS[request["what"]](path, request, arrays), arrays)
    except AssetsMissing as error:
        return pack({"missing": [error.name, error.problem, error.how_to_get]}, [])
    except DemoError as error:
        return pack({"error": str(error).replace(str(path), shown, 1)}, [])
    except DAMAGE as error:
        return pack({"error": f"{shown}: {type(error).__name__}: {' '.join(str(error).split())}"}, [])


def main() -> None:
    """Answer until nobody asks."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    _limit()
    output.write(pack({"ready": True}, []))
    output.flush()
    for line in sys.stdin.buffer:
        seconds = json.loads(line)["seconds"]
        if hasattr(signal, "alarm"):
            signal.alarm(seconds)  # ends this process if the one that asked is gone
        output.write(answer(line))
        output.flush()
        if hasattr(signal, "alarm"):
            signal.alarm(0)


def _limit() -> None:
    """Limit the memory, and leave no core files."""
    try:
        import resource
    except ImportError:  # not on POSIX
        return
    try:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (OSError, ValueError):
        used = 0
    for limit, most in ((resource.RLIMIT_AS, used + _MEMORY), (resource.RLIMIT_CORE, 0)):
        _, hard = resource.getrlimit(limit)
        if hard == resource.RLIM_INFINITY or most < hard:
            resource.setrlimit(limit, (most, hard))


if __name__ == "__main__":
    main()
