"""Caches filled ahead: what an environment compiles before its first step, for many scenes, in several processes.

In: suites and the options that environments will be made with. Out: for each scene, whether it is ready and after how
long. A scene is warmed by what uses it later: an environment is made, reset and stepped once, and reads its images if
that is asked for. That fills the cache of compiled scenes, of contact memory, of XLA's programs and of Warp's kernels,
all in vecenv's cache folder (``vecenv.util.caching``), and numba's cache.

The first scene is done alone, because nearly all of Warp's kernels are those of every scene; then others side by side,
each in a process of its own, because XLA compiles a program for each. What fails is tried once more, alone: side by
side, scenes may run out of memory.
"""

from __future__ import annotations

import logging
import logging.handlers
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from typing import Any

from vecenv import placement
from vecenv.errors import InvalidInput, VecenvError
from vecenv.libero.tasks.export import exported_tasks
from vecenv.libero.tasks.sources import Task, installed_tasks
from vecenv.libero.tasks.suites import NUM_EPISODES
from vecenv.util import logs
from vecenv.util.cores import usable_cores

# What a process of its own takes at most, bytes, and the cores that it keeps busy.
_MEMORY, _CORES = 6 << 30, 4


class WarmupError(InvalidInput):
    """Something that cannot be warmed; the message says why."""


@dataclass(frozen=True, kw_only=True)
class Warmup:
    """What to make ready.

    Attributes:
        suite: the suite.
        task: a task; every task of its scene is then ready.
        options: of ``vecenv.make``: ``backend``, ``geometry``, ``contacts``, ``scenes``, ``render``, ...
        num_envs: numbers of slots of this scene in a batch; XLA's programs are compiled for each.
        chunks: numbers of actions that ``step_continuous`` gets at once; likewise.
        images: whether images are read.
    """

    suite: str
    task: int
    options: Mapping[str, Any] = field(default_factory=dict)
    num_envs: tuple[int, ...] = (1,)
    chunks: tuple[int, ...] = (1,)
    images: bool = False

    def __post_init__(self) -> None:
        for name in ("num_envs", "chunks"):
            values = getattr(self, name)
            if not values or min(values) < 1:
                raise WarmupError(f"{name}={values}: need numbers of at least 1")

    @property
    def name(self) -> str:
        """The scene as people read it."""
        return f"{self.suite} {self.task}"


@dataclass(frozen=True, kw_only=True)
class Warmed:
    """A scene that was made ready, or was not.

    Attributes:
        what: the scene.
        seconds: how long it took.
        error: why it is not ready; empty if it is.
    """

    what: Warmup
    seconds: float
    error: str = ""


def scenes_of(suite: str, tasks: str | None = None, scenes: str | None = None) -> tuple[int, ...]:
    """The first task of every scene of a suite.

    Args:
        suite: the suite.
        tasks: only the scenes of these, such as ``"0,3,5-7"``.
        scenes: a folder that ``vecenv compile`` wrote; None for the installed packages.

    Raises:
        PlacementError: there is no such task.
        UnknownSuite, AssetsMissing, ExportError: see ``vecenv.make``.
    """
    sources: Sequence[Task] = installed_tasks(suite) if scenes is None else exported_tasks(scenes, suite)
    chosen = placement.task_indices(tasks, [source.name for source in sources])
    first: dict[object, int] = {}
    for index in chosen:
        first.setdefault(sources[index].problem().scene_key(), index)
    return tuple(first.values())


def usual_jobs() -> int:
    """How many processes work at once where nobody says: as many as cores and memory allow."""
    pages = os.sysconf("SC_AVPHYS_PAGES") if "SC_AVPHYS_PAGES" in os.sysconf_names else 0
    memory = pages * os.sysconf("SC_PAGE_SIZE") if pages else _MEMORY
    return max(1, min(usable_cores() // _CORES, memory // _MEMORY))


def warm(
    wanted: Sequence[Warmup],
    *,
    jobs: int | None = None,
    say: Callable[[str], object] = logs.to_stderr,
) -> Iterator[Warmed]:
    """Make scenes ready, each in a process that ends afterwards; results come in the order of completion.

    Args:
        wanted: the scenes.
        jobs: processes that work at once; None for ``usual_jobs``.
        say: gets a line for whatever is compiled, named after its scene.
    """
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    listener = logging.handlers.QueueListener(queue, logs.Saying(say))
    listener.start()
    try:
        yield from _rounds(wanted, jobs or usual_jobs(), context, queue)
    finally:
        listener.stop()


def _rounds(wanted: Sequence[Warmup], jobs: int, context: Any, queue: Any) -> Iterator[Warmed]:
    failed: list[Warmup] = []
    for several, count in ((wanted[:1], 1), (wanted[1:], jobs)):
        for done in _round(several, count, context, queue):
            if done.error and count > 1:
                failed.append(done.what)
            else:
                yield done
    for what in failed:
        yield from _round([what], 1, context, queue)


def _round(wanted: Sequence[Warmup], jobs: int, context: Any, queue: Any) -> Iterator[Warmed]:
    """Make scenes ready, so many at once."""
    if not wanted:
        return
    started = time.monotonic()
    # A process for each: what Warp, XLA and MuJoCo hold is only given back when it ends.
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_begin, initargs=(queue,), max_tasks_per_child=1)
    try:
        running = {pool.submit(_warm, what): what for what in wanted}
        for future in as_completed(running):
            try:
                yield future.result()
            except BrokenProcessPool:
                message = "its process was ended, perhaps for want of memory"
                yield Warmed(what=running[future], seconds=time.monotonic() - started, error=message)
    finally:
        pool.shutdown(cancel_futures=True)


def _begin(queue: Any) -> None:
    """Prepare a process: its reports go to the one that started it, and it takes no more GPU memory than it needs."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    logger = logging.getLogger(logs.ROOT)
    logger.setLevel(logging.INFO)
    logger.addHandler(logging.handlers.QueueHandler(queue))
    logger.propagate = False


def _warm(what: Warmup) -> Warmed:
    """Make a scene ready in this process."""
    started = time.monotonic()
    for handler in logging.getLogger(logs.ROOT).handlers:
        handler.setFormatter(logging.Formatter(f"{what.name}: %(message)s"))
    error = ""
    try:
        for num_envs in what.num_envs:
            _use(what, num_envs)
    except Exception as problem:  # whatever it is: the other scenes are made ready, and this one is named at the end
        ours = isinstance(problem, VecenvError)
        error = " ".join(str(problem).split()) if ours else f"{type(problem).__name__}: {problem}"
    return Warmed(what=what, seconds=time.monotonic() - started, error=error)


def _use(what: Warmup, num_envs: int) -> None:
    """Make a batch, and do with it once what is done with it later."""
    import numpy as np

    import vecenv

    episodes = [slot % NUM_EPISODES for slot in range(num_envs)]
    env = vecenv.make(what.suite, task=what.task, episodes=episodes, **what.options)
    try:
        env.reset()
        for chunk in what.chunks:
            env.step_continuous(np.zeros((num_envs, chunk, 7)))
        if what.images:
            _ = env.observe_egocentric().observation
        env.reset()
    finally:
        env.close()
