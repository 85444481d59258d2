"""Programs measured from outside: a child process runs them, and this one watches its memory, CPU time and wall time.

In: sources and limits. Out: how each program ended and what the child used meanwhile. Nothing that the child counts
itself is used. A child that does not come back is killed.
"""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil

from support.paths import REPOSITORY, TESTS
from voxposer.sandbox.guard import Limits

# What a run may take beyond its limits.
SPARE_SECONDS, SPARE_MB = 2.0, 300.0
# Seconds between two looks at a child, and how much longer than its CPU time a program may take on a busy machine.
_LOOK_S, _BUSY = 0.01, 20


@dataclass(frozen=True)
class Used:
    """How a program ended, and what its process used.

    Attributes:
        source: the program.
        ended: what the child said; empty if it was killed or had died.
        seconds: CPU time.
        wall: seconds.
        megabytes: most memory beyond that of the idle process.
    """

    source: str
    ended: dict[str, Any]
    seconds: float
    wall: float
    megabytes: float

    def breach(self, limits: Limits) -> str:
        """What was broken, "" for nothing."""
        if "rule" not in self.ended:
            return f"{self.ended.get('other', 'the process died or was killed')}: {self.source[:200]!r}"
        if self.seconds > limits.seconds + SPARE_SECONDS:
            return f"{self.seconds:.1f} s of CPU time: {self.source[:200]!r}"
        if self.megabytes > limits.memory_bytes / 2**20 + SPARE_MB:
            return f"{self.megabytes:.0f} MB: {self.source[:200]!r}"
        return ""


def watched(world: str, sources: Sequence[str], limits: Limits, folder: Path) -> Iterator[Used]:
    """Run programs in a child process, in an empty folder and without the right to write a byte.

    A child that dies is followed by another for the programs that are left.
    """
    done = 0
    while done < len(sources):
        for used in _one_child(world, sources[done:], limits, folder):
            done += 1
            yield used


def _one_child(world: str, sources: Sequence[str], limits: Limits, folder: Path) -> Iterator[Used]:
    path = os.pathsep.join((str(REPOSITORY), str(TESTS)))
    command = [sys.executable, "-B", "-W", "error", "-c", "from support.hostile.child import main; main()"]
    environment = {**os.environ, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu", "OPENBLAS_NUM_THREADS": "1"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "cwd": folder}
    with subprocess.Popen(command, env=environment, preexec_fn=_without_files, **pipes) as child:
        try:
            _say(child, json.dumps({"world": world, "limits": asdict(limits), "sources": list(sources)}))
            process = psutil.Process(child.pid)
            if not _heard(child, 120, process)[0].startswith("ready"):
                raise RuntimeError(f"the child of {world} did not start: exit status {child.wait()}")
            idle = process.memory_info().rss
            for source in sources:
                used = _watched_run(child, process, source, idle, limits)
                yield used
                if not used.ended:
                    return
        finally:
            child.kill()


def _watched_run(child: subprocess.Popen[str], process: psutil.Process, source: str, idle: int, limits: Limits) -> Used:
    _forget_peak(child.pid)
    times, began = process.cpu_times(), time.monotonic()
    _say(child, "")
    line, peak, after = _heard(child, _BUSY * (limits.seconds + SPARE_SECONDS), process)
    seconds = after.user + after.system - times.user - times.system
    return Used(source, json.loads(line) if line else {}, seconds, time.monotonic() - began, (peak - idle) / 2**20)


def _heard(child: subprocess.Popen[str], most: float, process: psutil.Process) -> tuple[str, int, Any]:
    """The next line of a child ("" if it says none in time or dies), its largest memory until then, its CPU times."""
    assert child.stdout is not None
    peak, times, until = 0, process.cpu_times(), time.monotonic() + most
    with selectors.DefaultSelector() as ready:
        ready.register(child.stdout, selectors.EVENT_READ)
        while time.monotonic() < until:
            said = ready.select(_LOOK_S)
            try:
                peak, times = max(peak, process.memory_info().rss, _peak(child.pid)), process.cpu_times()
            except psutil.Error:
                return "", peak, times
            if said:
                return child.stdout.readline().strip(), peak, times
    return "", peak, times


def _say(child: subprocess.Popen[str], line: str) -> None:
    assert child.stdin is not None
    child.stdin.write(line + "\n")
    child.stdin.flush()


def _without_files() -> None:
    """In the child: no file may grow, and no other process start."""
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))


def _peak(pid: int) -> int:
    """The largest memory since ``_forget_peak``, which no look between can miss; 0 where the system does not say."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    lines = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")]
    return int(lines[0]) * 1024 if lines else 0


def _forget_peak(pid: int) -> None:
    try:
        Path(f"/proc/{pid}/clear_refs").write_text("5")
    except OSError:
        return
