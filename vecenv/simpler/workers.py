"""Many slots: scenes side by side in this process, or spread over worker processes.

In: which scene and start a slot gets, and set-points of all slots, [B, substeps, dof]. Out: ``facts``, one row of
``scenes.facts_dtype`` a slot, and ``faults``. A PhysX step in SAPIEN holds Python's lock, so threads would not help:
several processes are what uses several cores. Set-points and facts lie in memory that all of them share; what is sent
is a few bytes a tick. Workers are started as a module, so the caller's script is not imported again.
"""

from __future__ import annotations

import mmap
import os
import socket
import subprocess
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Protocol

import numpy as np

from vecenv.simpler.scenes import Scene, SceneSpec, Start, facts_dtype

# Scenes that no slot uses at present, kept for when one is wanted again.
_SPARE = 8


class WorkerError(RuntimeError):
    """A worker process failed or went away; the message carries its traceback."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """A slot begins an episode: its scene, and where it starts."""

    slot: int
    spec: SceneSpec
    start: Start


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How large the shared arrays are: B slots, substeps a tick, joints, objects."""

    slots: int
    substeps: int
    dof: int
    objects: int

    @property
    def bytes(self) -> int:
        """Of all arrays together."""
        return self.slots * (facts_dtype(self.dof, self.objects).itemsize + 2 * 8 * self.substeps * self.dof)

    def arrays(self, memory: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Facts [B], set-points of positions and of velocities [B, S, N], over a buffer."""
        dtype, count = facts_dtype(self.dof, self.objects), self.slots * self.substeps * self.dof
        shape, begin = (self.slots, self.substeps, self.dof), self.slots * dtype.itemsize
        facts = np.frombuffer(memory, dtype, self.slots)
        position = np.frombuffer(memory, float, count, begin).reshape(shape)
        return facts, position, np.frombuffer(memory, float, count, begin + 8 * count).reshape(shape)


class Slots(Protocol):
    """What both ways of running slots offer."""

    facts: np.ndarray
    faults: list[str]

    def begin(self, jobs: Sequence[Job]) -> dict[int, np.ndarray]:
        """Start episodes; returns slot -> settled objects [n, 13]."""
        ...

    def run(self, active: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> None:
        """One control tick of the slots in ``active`` (bool [B]); ``facts`` and ``faults`` then hold what came out."""
        ...

    def state(self) -> list[np.ndarray]:
        """Physics state of every slot."""
        ...

    def restore(self, states: dict[int, np.ndarray]) -> None:
        """Overwrite the physics state of some slots."""
        ...

    def close(self) -> None:
        """Release everything."""
        ...


class LocalSlots:
    """Slots of this process.

    Args:
        sizes: of the arrays.
        memory: buffer that they lie in; None for memory of their own.
    """

    def __init__(self, sizes: Sizes, memory: Any = None) -> None:
        self.facts, self._position, self._velocity = sizes.arrays(bytearray(sizes.bytes) if memory is None else memory)
        self.faults = [""] * sizes.slots
        self._scenes: dict[int, Scene] = {}
        self._spare: list[Scene] = []

    def begin(self, jobs: Sequence[Job]) -> dict[int, np.ndarray]:
        """See ``Slots``."""
        settled = {}
        for job in jobs:
            scene = self._scene(job.slot, job.spec)
            settled[job.slot] = scene.begin(job.start)
            self.faults[job.slot] = scene.measure(self.facts[job.slot])
        return settled

    def _scene(self, slot: int, spec: SceneSpec) -> Scene:
        current = self._scenes.get(slot)
        if current is not None and current.spec == spec:
            return current
        if current is not None:
            self._spare = [current, *self._spare][:_SPARE]
        found = next((scene for scene in self._spare if scene.spec == spec), None)
        if found is not None:
            self._spare.remove(found)
        self._scenes[slot] = found or Scene(spec)
        return self._scenes[slot]

    def run(self, active: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> None:
        """See ``Slots``."""
        moves = bool(velocity.any())
        for slot in np.flatnonzero(active):
            scene = self._scenes[int(slot)]
            scene.advance(position[slot], velocity[slot] if moves else None)
            self.faults[slot] = scene.measure(self.facts[slot])

    def run_shared(self, slots: Sequence[int]) -> None:
        """``run`` with the set-points that lie in shared memory."""
        active = np.zeros(len(self.facts), bool)
        active[list(slots)] = True
        self.run(active, self._position, self._velocity)

    def state(self) -> list[np.ndarray]:
        """See ``Slots``."""
        return [scene.state() for _, scene in sorted(self._scenes.items())]

    def restore(self, states: dict[int, np.ndarray]) -> None:
        """See ``Slots``."""
        for slot, state in states.items():
            self._scenes[slot].restore(state)
            self.faults[slot] = self._scenes[slot].measure(self.facts[slot])

    def close(self) -> None:
        """See ``Slots``."""
        self._scenes.clear()
        self._spare.clear()


class ProcessSlots:
    """Slots spread over worker processes, slot i in process i modulo their number.

    Args:
        sizes: of the arrays.
        workers: how many processes.
    """

    def __init__(self, sizes: Sizes, workers: int) -> None:
        self._handle = os.memfd_create("vecenv-simpler")
        os.ftruncate(self._handle, sizes.bytes)
        self._memory = mmap.mmap(self._handle, sizes.bytes)
        self.facts, self._position, self._velocity = sizes.arrays(self._memory)
        self.faults = [""] * sizes.slots
        self._workers = [_Worker(sizes, self._handle) for _ in range(min(workers, sizes.slots))]

    def _owner(self, slot: int) -> int:
        return slot % len(self._workers)

    def _share(self, slots: Sequence[int]) -> dict[int, list[int]]:
        shares: dict[int, list[int]] = {}
        for slot in slots:
            shares.setdefault(self._owner(int(slot)), []).append(int(slot))
        return shares

    def _ask(self, asked: dict[int, tuple[str, Any]]) -> dict[int, Any]:
        """Send every worker its request, then collect every answer."""
        for index, request in asked.items():
            self._workers[index].send(request)
        answers = {index: self._workers[index].receive() for index in asked}
        for index in asked:
            faults, answers[index] = answers[index]
            for slot, fault in faults.items():
                self.faults[slot] = fault
        return answers

    def begin(self, jobs: Sequence[Job]) -> dict[int, np.ndarray]:
        """See ``Slots``."""
        by_slot = {job.slot: job for job in jobs}
        shares = self._share(list(by_slot))
        answers = self._ask({i: ("begin", [by_slot[slot] for slot in slots]) for i, slots in shares.items()})
        return {slot: state for answer in answers.values() for slot, state in answer.items()}

    def run(self, active: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> None:
        """See ``Slots``."""
        self._position[active], self._velocity[active] = position[active], velocity[active]
        shares = self._share(np.flatnonzero(active).tolist())
        self._ask({i: ("run", slots) for i, slots in shares.items()})

    def state(self) -> list[np.ndarray]:
        """See ``Slots``."""
        answers = self._ask(dict.fromkeys(range(len(self._workers)), ("state", None)))
        rows: list[Any] = [None] * len(self.facts)
        for index, states in answers.items():
            rows[index :: len(self._workers)] = states
        return rows

    def restore(self, states: dict[int, np.ndarray]) -> None:
        """See ``Slots``."""
        shares = self._share(list(states))
        self._ask({i: ("restore", {slot: states[slot] for slot in slots}) for i, slots in shares.items()})

    def close(self) -> None:
        """See ``Slots``."""
        for worker in self._workers:
            worker.close()
        self._workers.clear()
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


class _Worker:
    """One process, and the pipe to it."""

    def __init__(self, sizes: Sizes, memory: int) -> None:
        mine, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "vecenv.simpler.workers", str(theirs.fileno()), str(memory)],
                pass_fds=(theirs.fileno(), memory),
                env=_single_threaded(),
            )
        self._pipe = Connection(mine.detach())
        self.send(sizes)

    def send(self, message: Any) -> None:
        try:
            self._pipe.send(message)
        except OSError as error:
            raise self._gone() from error

    def receive(self) -> Any:
        try:
            worked, answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise self._gone() from error
        if not worked:
            raise WorkerError(f"a SIMPLER worker failed:\n{answer}")
        return answer

    def _gone(self) -> WorkerError:
        return WorkerError(f"a SIMPLER worker ended unexpectedly (exit status {self._process.poll()})")

    def close(self) -> None:
        self._pipe.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _single_threaded() -> dict[str, str]:
    """This process' environment, with the module search path of this process and one thread for numerics."""
    paths = [path for path in sys.path if path]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}


def make_slots(sizes: Sizes, workers: int) -> LocalSlots | ProcessSlots:
    """Slots in this process for one worker, over several processes for more."""
    return LocalSlots(sizes) if min(workers, sizes.slots) <= 1 else ProcessSlots(sizes, workers)


def _serve(pipe: Connection, memory: int) -> None:
    """A worker's life: requests until the pipe closes."""
    sizes: Sizes = pipe.recv()
    local = LocalSlots(sizes, mmap.mmap(memory, sizes.bytes))
    calls = {"begin": local.begin, "run": local.run_shared, "state": lambda _: local.state(), "restore": local.restore}
    known: dict[int, str] = {}
    while True:
        try:
            name, argument = pipe.recv()
        except EOFError:
            return
        try:
            answer = calls[name](argument)
        except Exception:
            pipe.send((False, traceback.format_exc()))
            continue
        changed = {slot: fault for slot, fault in enumerate(local.faults) if known.get(slot, "") != fault}
        known.update(changed)
        pipe.send((True, (changed, answer)))


if __name__ == "__main__":
    _serve(Connection(int(sys.argv[1])), int(sys.argv[2]))
