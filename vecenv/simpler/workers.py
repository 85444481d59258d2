"""The physics of a batch: scenes in this process, or spread over worker processes.

In: which scene and start a slot gets, and set-points of all slots, [B, substeps, dof]. Out: ``facts``, one row of
``physics.spec.facts_dtype`` a slot, ``faults``, and images. A PhysX step in SAPIEN holds Python's lock, so several
processes and not threads use several cores. Set-points and facts lie in shared memory, so a message is a few bytes a
tick. Each process renders its own slots, into shared memory that is allocated for the images. Workers are started as a
module, so the caller's script is not imported again.
"""

from __future__ import annotations

import mmap
import os
import socket
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import reduction
from multiprocessing.connection import Connection
from typing import Any, Protocol, TypeAlias

import numpy as np

from vecenv.errors import SimulationError
from vecenv.simpler.overlay import ImageBuffer, Images, Renderer, RendererMissing, RenderStyle, RenderSubject
from vecenv.simpler.physics.scenes import Scene
from vecenv.simpler.physics.spec import SceneSpec, Start, facts_dtype

# Slot -> what to render, and a row of facts.
Orders: TypeAlias = Mapping[int, tuple[RenderSubject, np.void]]

# Unused scenes that are kept for later episodes.
_SPARE = 8


class WorkerError(SimulationError):
    """A worker process failed or went away; the message carries its traceback."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """A slot begins an episode: its scene, and where it starts."""

    slot: int
    spec: SceneSpec
    start: Start


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of the shared arrays: B slots, substeps per tick, joints, objects."""

    slots: int
    substeps: int
    dof: int
    objects: int

    @property
    def bytes(self) -> int:
        """Size of all arrays together, bytes."""
        return self.slots * (facts_dtype(self.dof, self.objects).itemsize + 2 * 8 * self.substeps * self.dof)

    def arrays(self, memory: mmap.mmap | bytearray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Facts [B], set-points of positions and of velocities [B, S, N], over a buffer."""
        dtype, count = facts_dtype(self.dof, self.objects), self.slots * self.substeps * self.dof
        shape, begin = (self.slots, self.substeps, self.dof), self.slots * dtype.itemsize
        facts = np.frombuffer(memory, dtype, self.slots)
        position = np.frombuffer(memory, float, count, begin).reshape(shape)
        return facts, position, np.frombuffer(memory, float, count, begin + 8 * count).reshape(shape)


class Slots(Protocol):
    """Physics of a batch, in this process or in workers."""

    facts: np.ndarray
    faults: list[str]

    def begin(self, jobs: Sequence[Job]) -> dict[int, np.ndarray]:
        """Start episodes; returns slot -> settled objects [n, 13]."""
        ...

    def run(self, active: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> None:
        """One control tick of the slots in ``active`` (bool [B]); ``facts`` and ``faults`` then hold the results."""
        ...

    def draw(self, style: RenderStyle, buffer: ImageBuffer, orders: Orders) -> Images:
        """Images of the slots in ``orders``, each of a subject in a state (a row of facts); the others are 0.

        Raises:
            RendererMissing: no Vulkan driver.
        """
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
        memory: buffer that they lie in; None for new memory.
    """

    def __init__(self, sizes: Sizes, memory: mmap.mmap | None = None) -> None:
        self.facts, self._position, self._velocity = sizes.arrays(bytearray(sizes.bytes) if memory is None else memory)
        self.faults = [""] * sizes.slots
        self._scenes: dict[int, Scene] = {}
        self._spare: list[Scene] = []
        self._renderer: Renderer | None = None

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

    def draw(self, style: RenderStyle, buffer: ImageBuffer, orders: Orders) -> Images:
        """See ``Slots``."""
        return self.draw_into(mmap.mmap(-1, buffer.bytes), style, buffer, orders)

    def draw_into(self, memory: mmap.mmap, style: RenderStyle, buffer: ImageBuffer, orders: Orders) -> Images:
        """``draw`` over a buffer."""
        if self._renderer is None or self._renderer.style != style:
            self._renderer = Renderer(style)
        images = buffer.images(memory)
        for slot, (subject, facts) in orders.items():
            self._renderer.render(subject, facts, images.of(slot))
        return images

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
        if self._renderer is not None:
            self._renderer.close()


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
        count = min(workers, sizes.slots)
        self._workers = [_Worker(sizes, self._handle, _environment(count)) for _ in range(count)]

    def _owner(self, slot: int) -> int:
        return slot % len(self._workers)

    def _share(self, slots: Sequence[int]) -> dict[int, list[int]]:
        shares: dict[int, list[int]] = {}
        for slot in slots:
            shares.setdefault(self._owner(int(slot)), []).append(int(slot))
        return shares

    def _ask(self, asked: Mapping[int, tuple[str, object]], handle: int | None = None) -> dict[int, Any]:
        """Send every worker its request, with a file handle if given; then collect every answer."""
        for index, request in asked.items():
            self._workers[index].send(request, handle)
        received = {index: self._workers[index].receive() for index in asked}
        failed = [answer for worked, answer in received.values() if not worked]
        if failed:
            raise (
                failed[0] if isinstance(failed[0], Exception) else WorkerError(f"a SIMPLER worker failed:\n{failed[0]}")
            )
        answers = {index: answer for index, (_, answer) in received.items()}
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

    def draw(self, style: RenderStyle, buffer: ImageBuffer, orders: Orders) -> Images:
        """See ``Slots``."""
        handle = os.memfd_create("vecenv-simpler-images")
        try:
            os.ftruncate(handle, buffer.bytes)
            memory = mmap.mmap(handle, buffer.bytes)
            shares = self._share(list(orders))
            asked = {
                i: ("draw", (style, buffer, {slot: orders[slot] for slot in slots})) for i, slots in shares.items()
            }
            self._ask(asked, handle)
        finally:
            os.close(handle)
        return buffer.images(memory)

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
    """A worker process and the pipe to it."""

    def __init__(self, sizes: Sizes, memory: int, environment: dict[str, str]) -> None:
        mine, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(  # nosec B603 # this module again, in this Python
                [sys.executable, "-m", "vecenv.simpler.workers", str(theirs.fileno()), str(memory)],
                pass_fds=(theirs.fileno(), memory),
                env=environment,
            )
        self._pipe = Connection(mine.detach())
        self.send(sizes)

    def send(self, message: object, handle: int | None = None) -> None:
        try:
            self._pipe.send(message)
            if handle is not None:
                reduction.send_handle(self._pipe, handle, self._process.pid)
        except OSError as error:
            raise self._gone() from error

    def receive(self) -> tuple[bool, Any]:
        """Whether the request succeeded, and its answer, or the error as ``_sendable`` returns it."""
        try:
            return self._pipe.recv()
        except (EOFError, OSError) as error:
            raise self._gone() from error

    def _gone(self) -> WorkerError:
        return WorkerError(f"a SIMPLER worker ended unexpectedly (exit status {self._process.poll()})")

    def close(self) -> None:
        self._pipe.close()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _environment(workers: int) -> dict[str, str]:
    """A worker's environment: this process's module path, one thread for numerics, its share of the cores for Mesa."""
    paths = [path for path in sys.path if path]
    cores = max(1, len(os.sched_getaffinity(0)) // workers)
    own = {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    return {"LP_NUM_THREADS": str(cores), **os.environ, **own}


def make_slots(sizes: Sizes, workers: int) -> LocalSlots | ProcessSlots:
    """Slots in this process for one worker, over several processes for more."""
    return LocalSlots(sizes) if min(workers, sizes.slots) <= 1 else ProcessSlots(sizes, workers)


def _serve(pipe: Connection, memory: int) -> None:
    """A worker's main loop: answer requests until the pipe closes."""
    sizes: Sizes = pipe.recv()
    local = LocalSlots(sizes, mmap.mmap(memory, sizes.bytes))
    calls = {
        "begin": local.begin,
        "run": local.run_shared,
        "draw": lambda asked: _draw(local, pipe, *asked),
        "state": lambda _: local.state(),
        "restore": local.restore,
    }
    known: dict[int, str] = {}
    while True:
        try:
            name, argument = pipe.recv()
        except EOFError:
            return
        try:
            answer = calls[name](argument)
        except Exception as error:
            pipe.send((False, _sendable(error)))
            continue
        changed = {slot: fault for slot, fault in enumerate(local.faults) if known.get(slot, "") != fault}
        known.update(changed)
        pipe.send((True, (changed, answer)))


def _draw(local: LocalSlots, pipe: Connection, style: RenderStyle, buffer: ImageBuffer, orders: Orders) -> None:
    """Draw into the memory whose handle follows the request."""
    handle = reduction.recv_handle(pipe)
    try:
        local.draw_into(mmap.mmap(handle, buffer.bytes), style, buffer, orders)
    finally:
        os.close(handle)


def _sendable(error: Exception) -> Exception | str:
    """An error as it is sent to the caller: ``RendererMissing`` itself, else the traceback."""
    return error if isinstance(error, RendererMissing) else traceback.format_exc()


if __name__ == "__main__":
    _serve(Connection(int(sys.argv[1])), int(sys.argv[2]))
