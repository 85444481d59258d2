"""Whether MJX plays LIBERO as native MuJoCo does: settling, replayed and closed-loop verdicts, scene by scene.

Three stages, so that the GPU machine needs no LIBERO packages and no native physics. ``record`` runs `pick_place` on
the native backend with upstream's geometry and writes one file a suite: starts, what moves in 50 idle ticks, actions,
verdicts, where objects end. ``compare`` gives every backend and geometry the same starts and actions: one batch a
scene, in which every episode is there once idle and twice replayed (the second tells how far MJX repeats itself).
``table`` puts what ``compare`` wrote into Markdown. The backend ``nudged`` is the yardstick: native once more, every
action moved by what single precision rounds away; what that changes, no float32 backend can be asked to keep.

Scenes are compiled and run by worker processes; a scene that fails or hangs is reported and the others go on. Results
are written after every scene, and a second run does what is missing.

    python benchmarks/mjx_fidelity.py record --out recordings
    vecenv compile --out scenes --suite libero_object ... --geometry exact --geometry lean
    python benchmarks/mjx_fidelity.py compare recordings --scenes scenes --workers 6
    python benchmarks/mjx_fidelity.py table
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import json
import multiprocessing
import os
import queue
import re
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from common import RESULTS, ROOT

import vecenv
from vecenv.libero.env import SETTLE_ACTION, LiberoEnv
from vecenv.libero.scene.contacts import CONTACTS, Contacts
from vecenv.libero.scene.scene import Scene
from vecenv.libero.tasks.export import exported_tasks
from vecenv.libero.tasks.sources import Task, installed_tasks

# In the order in which they are compared: what is asked most strictly comes first.
SUITES = ("libero_object", "libero_spatial", "libero_goal", "libero_10", "libero_90")
EPISODES = {"libero_object": 50}
IDLE_TICKS = 50
CAP = 400
# Ticks of holding still after the recorded end: time for a verdict that is late, kept of what a failure ends with.
GRACE = 20
# Positions of starts that differ by more than this are other starts (float32 keeps 1e-7), metres.
SAME_START = 1e-5
# Standard deviation of what is added to the actions of the backend "nudged": an ulp of a float32 near 1.
NUDGE = 1e-7
DOC = ROOT / "docs" / "mjx_fidelity_table.md"
NAME = "mjx_fidelity"
# Contacts of recordings and rows from before there was a choice.
EARLIER = "current"

Row: TypeAlias = dict[str, Any]


class RecordingError(RuntimeError):
    """A recording is missing, or does not belong to the scenes it is compared with."""


# -- recordings --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What native MuJoCo did in N episodes of a suite; positions are those of movable objects, metres, world frame.

    Attributes:
        suite: the suite.
        task, episode: which start, int [N].
        length: control ticks of the episode, int [N].
        success: whether it ended solved, bool [N].
        actions: the actions of all episodes, one episode after the other, float32 [sum of lengths, 7].
        start: positions at the start, [N, M, 3], NaN past a scene's last object.
        settled: after 50 idle ticks from the start, likewise.
        end: at the end of the episode, likewise.
        notes: how it was recorded.
    """

    suite: str
    task: np.ndarray
    episode: np.ndarray
    length: np.ndarray
    success: np.ndarray
    actions: np.ndarray
    start: np.ndarray
    settled: np.ndarray
    end: np.ndarray
    notes: Mapping[str, Any] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write it, compressed."""
        arrays = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        text = json.dumps({"suite": self.suite, "notes": self.notes})
        np.savez_compressed(path, about=np.array(text), **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, folder: Path, suite: str) -> Recording:
        """Read the recording of a suite; raises `RecordingError`."""
        path = recording_path(folder, suite)
        if not path.is_file():
            raise RecordingError(f"{path}: no such file; `{Path(__file__).name} record --suite {suite}` writes it")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays.pop("about")))
        return cls(suite=about["suite"], notes=about["notes"], **arrays)

    def played(self, row: int) -> np.ndarray:
        """Actions of one episode, [K, 7]."""
        first = int(self.length[:row].sum())
        return self.actions[first : first + self.length[row]]

    def within(self, ticks: int) -> Recording:
        """The same episodes, ended after so many ticks at most: what was solved later is not solved."""
        late = self.length > ticks
        return replace(
            self,
            length=np.minimum(self.length, ticks),
            success=self.success & ~late,
            actions=np.concatenate([self.played(row)[:ticks] for row in range(len(self.task))]),
            end=np.where(late[:, None, None], np.nan, self.end),
        )

    def rows(self, tasks: Sequence[int], limit: int | None = None) -> np.ndarray:
        """Rows of these tasks, task by task, at most so many each."""
        return np.concatenate([np.flatnonzero(self.task == task)[:limit] for task in tasks])


def recording_path(folder: Path, suite: str) -> Path:
    """Where a suite's recording lies."""
    return folder / f"{suite}.npz"


def joined(parts: Sequence[Recording]) -> Recording:
    """The recordings of a suite's scenes as one."""
    widest = max(part.start.shape[1] for part in parts)

    def join(name: str) -> np.ndarray:
        arrays = [getattr(part, name) for part in parts]
        return np.concatenate([widened(a, widest) if a.ndim == 3 else a for a in arrays])

    names = [name for name, value in vars(parts[0]).items() if isinstance(value, np.ndarray)]
    return Recording(suite=parts[0].suite, notes=parts[0].notes, **{name: join(name) for name in names})


def widened(positions: np.ndarray, objects: int) -> np.ndarray:
    """Positions [N, m, 3] with NaN up to so many objects."""
    missing = objects - positions.shape[1]
    return np.pad(positions, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)


def kept_length(actions: np.ndarray, grace: int = GRACE) -> int:
    """How many of the actions [K, 7] of a failed episode to keep: not the same last one again and again."""
    differs = np.flatnonzero((actions != actions[-1]).any(axis=1))
    first_of_last = 0 if not len(differs) else int(differs[-1]) + 1
    return min(len(actions), first_of_last + grace)


# -- environments ------------------------------------------------------------------------------------------------------


def tasks_of(suite: str, scenes: str | None) -> Sequence[Task]:
    """The tasks of a suite, installed or exported."""
    return installed_tasks(suite) if scenes is None else exported_tasks(scenes, suite)


def by_scene(tasks: Sequence[Task]) -> list[list[int]]:
    """Task indices, those of one scene together, in upstream's order."""
    sharing: dict[Any, list[int]] = {}
    for index, task in enumerate(tasks):
        sharing.setdefault(task.problem().scene_key(), []).append(index)
    return list(sharing.values())


def scene_name(suite: str, tasks: Sequence[int], names: Sequence[str]) -> str:
    """A short name: suite, first task, and the scene's name where the tasks' names have it."""
    found = re.match(r"[A-Z_]+_SCENE\d+", names[0])
    return f"{suite}/{tasks[0]}" + (f" {found[0].lower()}" if found else "")


def make(suite: str, **options: Any) -> LiberoEnv:
    """A live batch whose slots share a scene."""
    env = vecenv.make(suite, **options)
    assert isinstance(env, LiberoEnv)
    env.reset()
    return env


def begin_again(env: LiberoEnv) -> None:
    """Every slot at its start."""
    env.set_episodes()
    env.reset()


def object_columns(scene: Scene) -> np.ndarray:
    """Columns of qpos with the positions of the movable objects, int [M, 3]."""
    first = [scene.model.joint(entity.joints[0]).qposadr[0] for entity in scene.objects]
    return np.array(first)[:, None] + np.arange(3)


class Ended(NamedTuple):
    """A batch after a run: positions of joints [B, nq] and objects [B, M, 3], ticks taken, verdicts, faults by slot."""

    qpos: np.ndarray
    objects: np.ndarray
    ticks: np.ndarray
    success: np.ndarray
    faults: Mapping[int, str]

    @property
    def healthy(self) -> np.ndarray:
        """Slots without a fault, bool [B]."""
        mask = np.ones(len(self.ticks), bool)
        mask[list(self.faults)] = False
        return mask


def ended(env: LiberoEnv, ticks: np.ndarray, success: np.ndarray) -> Ended:
    """What the batch is like now. Positions of objects are read off qpos, so nothing has to be computed anew."""
    (group,) = env.physics.groups
    qpos = np.array(group.qpos)
    return Ended(qpos, qpos[:, object_columns(group.scene)], ticks, success, dict(env.physics.faults))


def run(env: LiberoEnv, chunk: np.ndarray, limit: np.ndarray) -> Ended:
    """Give every slot its actions [B, K, 7], up to its own limit [B], in one call."""
    ran = env.physics.run(chunk, np.ones(env.num_envs, bool), limit)
    return ended(env, ran.ticks, ran.success)


def play(env: LiberoEnv) -> tuple[np.ndarray, Ended]:
    """Let `pick_place` act until all slots are finished or given up; actions [B, K, 7], rounded to 32 bits."""
    from vecenv_eval.policies.pick_place.policy import PickPlacePolicy

    policy = PickPlacePolicy()
    policy.reset(env, env.reset())
    actions: list[np.ndarray] = []
    resting = 0
    while resting < GRACE:
        actions.append(np.clip(policy.act(env), -1, 1).astype(np.float32))
        control = env.step_continuous(actions[-1])
        idle = control.done.copy()
        idle[[slot for slot, _ in policy.unsupported]] = True
        resting = GRACE if control.done.all() else (resting + 1 if idle.all() else 0)
    return np.stack(actions, axis=1), ended(env, control.step_index, control.success)


# -- record ------------------------------------------------------------------------------------------------------------


def record(options: argparse.Namespace) -> None:
    """Write the recordings of the suites asked for; a suite's file is complete up to the last scene named."""
    options.out.mkdir(parents=True, exist_ok=True)
    for suite in options.suite:
        tasks, parts, started = tasks_of(suite, options.scenes), [], time.perf_counter()
        episodes = options.episodes or EPISODES.get(suite, 10)
        for chosen in by_scene(tasks):
            parts.append(record_scene(suite, chosen, episodes, options))
            whole = joined(parts)
            whole.save(recording_path(options.out, suite))
            name = scene_name(suite, chosen, [tasks[i].name for i in chosen])
            solved, seconds = parts[-1].success, time.perf_counter() - started
            text = f"{name}: {solved.sum()}/{len(solved)} solved, at most {parts[-1].length.max()} ticks"
            print(f"{text}, {seconds:.0f} s", flush=True)
        size = recording_path(options.out, suite).stat().st_size
        print(f"{suite}: {whole.success.sum()}/{len(whole.task)} solved, {size / 1e6:.2f} MB", flush=True)


def record_scene(suite: str, tasks: Sequence[int], episodes: int, options: argparse.Namespace) -> Recording:
    """Idle and played episodes of one scene on the native backend."""
    options_of_scene = {"max_steps": options.cap, "scenes": options.scenes, "contacts": options.contacts}
    env = make(suite, tasks=tasks, episodes=range(episodes), **options_of_scene)
    b = env.num_envs
    start = ended(env, np.zeros(b, int), np.zeros(b, bool)).objects
    settled = run(env, np.tile(SETTLE_ACTION, (b, IDLE_TICKS, 1)), np.full(b, IDLE_TICKS)).objects
    begin_again(env)
    actions, end = play(env)
    env.close()
    if end.faults:
        raise RecordingError(f"{suite} tasks {tasks}: native physics failed in slots {sorted(end.faults)}")
    played = [row[:ticks] for row, ticks in zip(actions, end.ticks, strict=True)]
    played = [row if solved else row[: kept_length(row)] for row, solved in zip(played, end.success, strict=True)]
    return Recording(
        suite=suite,
        task=np.repeat(tasks, episodes),
        episode=np.tile(np.arange(episodes), len(tasks)),
        length=np.array([len(row) for row in played]),
        success=end.success,
        actions=np.concatenate(played),
        start=start,
        settled=settled,
        end=end.objects,
        notes={"policy": "pick_place", "cap": options.cap, "contacts": options.contacts, **conditions()},
    )


# -- compare -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Job:
    """One scene on one backend with one geometry; ``kind`` is ``"replay"`` (settling too) or ``"closed"`` loop."""

    kind: str
    scene: str
    suite: str
    tasks: tuple[int, ...]
    backend: str
    geometry: str

    @property
    def key(self) -> tuple[str, ...]:
        """What tells it from every other job."""
        return (self.kind, self.scene, self.backend, self.geometry)


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What all jobs share.

    Attributes:
        recordings: folder of the recordings.
        contacts: of the recordings and of every backend, see `vecenv.make`.
        scenes: folder of the exported scenes, None for the installed packages.
        episodes: of each task at most, None for all.
        ticks: of each replayed episode at most, None for all.
        again: suites whose replay is run a second time.
    """

    recordings: Path
    contacts: Contacts = "published"
    scenes: str | None = None
    episodes: int | None = None
    ticks: int | None = None
    again: tuple[str, ...] = ()


def perform(job: Job, setup: Setup) -> Row:
    """Do a job; its row."""
    recording = Recording.load(setup.recordings, job.suite)
    missing = sorted(set(job.tasks) - set(recording.task.tolist()))
    if missing:
        raise RecordingError(f"{recording_path(setup.recordings, job.suite)}: has no task {missing[0]}; record again")
    if (recorded := recording.notes.get("contacts", EARLIER)) != setup.contacts:
        raise RecordingError(f"{job.suite}: recorded with contacts={recorded}, not {setup.contacts}; record again")
    rows = recording.rows(job.tasks, setup.episodes)
    measured = (replayed if job.kind == "replay" else closed_loop)(job, setup, recording, rows)
    return {**asdict(job), "tasks": list(job.tasks), "episodes": len(rows), "device": device(job.backend), **measured}


def open_job(job: Job, setup: Setup, recording: Recording, rows: np.ndarray, **options: Any) -> LiberoEnv:
    """The batch of a job with a slot for each of the rows, which come task by task."""
    episodes = {task: recording.episode[rows[recording.task[rows] == task]].tolist() for task in job.tasks}
    env = make(
        job.suite,
        tasks=list(job.tasks),
        episodes=episodes,
        backend=physics_of(job.backend),
        geometry=job.geometry,
        contacts=setup.contacts,
        scenes=setup.scenes,
        **options,
    )
    b = env.num_envs
    there = ended(env, np.zeros(b, int), np.zeros(b, bool)).objects
    apart = np.abs(there - recording.start[rows, : there.shape[1]]).max()
    if not apart < SAME_START:
        raise RecordingError(f"{job.scene}: starts are {apart:.2g} m from those recorded; record again")
    return env


def physics_of(backend: str) -> str:
    """What steps a job of this backend."""
    return "native" if backend == "nudged" else backend


IDLE, FIRST, SECOND = range(3)


def slots_of(task: np.ndarray, rows: np.ndarray, roles: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Row and role of each slot: task by task, all rows of a task in each role.

    Args:
        task: of every row of the recording, int [N].
        rows: rows to place, task by task.
        roles: what each row is there for.
    """
    own = [rows[task[rows] == index] for index in dict.fromkeys(task[rows].tolist())]
    placed = [(row, role) for chosen in own for role in roles for row in chosen]
    return np.array([row for row, _ in placed]), np.array([role for _, role in placed])


def commands(recording: Recording, rows: np.ndarray, roles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Actions [B, K, 7] and limit [B] of each slot.

    Idle slots hold still with an opening gripper. Replaying ones get what was recorded and then hold still, fingers as
    commanded last: 20 ticks where native had solved the task, none where it had not, so that native itself agrees.
    """
    pairs = zip(rows.tolist(), roles.tolist(), strict=True)
    played = [SETTLE_ACTION[None] if role == IDLE else recording.played(row) for row, role in pairs]
    extra = np.where(recording.success[rows], GRACE, 0)
    limit = np.where(roles == IDLE, IDLE_TICKS, recording.length[rows] + extra)
    chunk = np.zeros((len(rows), int(limit.max()), 7))
    for own, actions in zip(chunk, played, strict=True):
        own[: len(actions)], own[len(actions) :, 6] = actions, actions[-1, 6]
    return chunk, limit


def replayed(job: Job, setup: Setup, recording: Recording, rows: np.ndarray) -> Row:
    """Settle and replay; everything in one batch and one call."""
    recording = recording if setup.ticks is None else recording.within(setup.ticks)
    roles = (IDLE, FIRST) if physics_of(job.backend) == "native" else (IDLE, FIRST, SECOND)
    slots, role = slots_of(recording.task, rows, roles)
    chunk, limit = commands(recording, slots, role)
    if job.backend == "nudged":
        chunk[..., :6] += np.random.default_rng(0).normal(scale=NUDGE, size=chunk[..., :6].shape)
    clock = Clock()
    env = open_job(job, setup, recording, slots)
    clock.lap("ready")
    run(env, chunk, np.ones_like(limit))
    clock.lap("first")
    begin_again(env)
    start = ended(env, limit, role > 0).objects
    clock.lap("placed")
    end = run(env, chunk, limit)
    clock.lap("run")
    scene = env.physics.groups[0].scene
    names = [entity.name for entity in scene.objects]
    again = None
    if job.suite in setup.again and physics_of(job.backend) != "native":
        begin_again(env)
        again = spread_of_runs(part(end, role == FIRST), part(run(env, chunk, limit), role == FIRST))
    env.close()
    twins = spread_of_runs(part(end, role == FIRST), part(end, role == SECOND)) if SECOND in roles else None
    return {
        "seconds": clock.laps,
        "ticks": int(end.ticks.max()),
        "settle": settling(recording, slots[role == IDLE], start[role == IDLE], part(end, role == IDLE), names),
        "replay": verdicts(recording, slots[role == FIRST], part(end, role == FIRST), names),
        "twins": twins,
        "again": again,
    }


def closed_loop(job: Job, setup: Setup, recording: Recording, rows: np.ndarray) -> Row:
    """Let the policy play, with the recording's cap."""
    clock = Clock()
    env = open_job(job, setup, recording, rows, max_steps=recording.notes["cap"])
    clock.lap("ready")
    _, end = play(env)
    clock.lap("run")
    names = [entity.name for entity in env.physics.groups[0].scene.objects]
    env.close()
    found = verdicts(recording, rows, end, names)
    return {"seconds": clock.laps, "ticks": int(end.ticks.max()), "closed": found}


class Clock:
    """Seconds from lap to lap."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """The time since the last lap belongs to this name."""
        now = time.perf_counter()
        self.laps[name], self._last = round(now - self._last, 2), now


def part(end: Ended, mask: np.ndarray) -> Ended:
    """Some of the slots, bool [B]."""
    chosen = np.flatnonzero(mask).tolist()
    faults = {chosen.index(slot): text for slot, text in end.faults.items() if slot in chosen}
    return Ended(end.qpos[mask], end.objects[mask], end.ticks[mask], end.success[mask], faults)


def settling(recording: Recording, rows: np.ndarray, start: np.ndarray, end: Ended, names: Sequence[str]) -> Row:
    """How far objects move in 50 idle ticks, here and in native, and how far apart they end; metres."""
    objects, healthy = start.shape[1], end.healthy
    native = recording.settled[rows, :objects]
    moved = np.linalg.norm(end.objects - start, axis=-1)
    apart = np.linalg.norm(end.objects - native, axis=-1)
    worst = np.unravel_index(np.argmax(np.where(healthy[:, None], apart, -1)), apart.shape)
    row, thing = map(int, worst)
    return {
        "native": spread(np.linalg.norm(native - recording.start[rows, :objects], axis=-1)),
        "here": spread(moved[healthy]),
        "apart": spread(apart[healthy]),
        "objects": int(apart[healthy].size),
        "over 5 mm": int((apart[healthy] > 0.005).sum()),
        "worst": {**episode_of(recording, rows[row]), "object": names[thing]},
        "faults": dict(Counter(end.faults.values())),
    }


def verdicts(recording: Recording, rows: np.ndarray, end: Ended, names: Sequence[str]) -> Row:
    """Verdicts against native's; of those that differ, which object ends farthest from where native left it."""
    native = recording.success[rows]
    apart = np.linalg.norm(end.objects - recording.end[rows, : end.objects.shape[1]], axis=-1)
    differ = []
    for i in np.flatnonzero(native != end.success):
        differ.append(
            {
                **episode_of(recording, rows[i]),
                "native": bool(native[i]),
                "fault": end.faults.get(int(i), ""),
                **farthest(apart[i], names),
            }
        )
    return {
        "native": int(native.sum()),
        "here": int(end.success.sum()),
        "only native": int((native & ~end.success).sum()),
        "only here": int((~native & end.success).sum()),
        "faults": dict(Counter(end.faults.values())),
        "differ": differ,
    }


def farthest(apart: np.ndarray, names: Sequence[str]) -> Row:
    """Which object is farthest away, and how far; nothing where that is not known."""
    if not np.isfinite(apart).all():
        return {"object": "", "metres": None}
    return {"object": names[int(apart.argmax())], "metres": float(f"{apart.max():.3g}")}


def episode_of(recording: Recording, row: int) -> dict[str, int]:
    """Task and episode of a row."""
    return {"task": int(recording.task[row]), "episode": int(recording.episode[row])}


def spread_of_runs(one: Ended, other: Ended) -> Row:
    """Two runs of the same episodes: verdicts that differ, and max |dqpos| at the end of those that took as long."""
    same = (one.ticks == other.ticks) & one.healthy & other.healthy
    return {
        "episodes": len(same),
        "verdicts differ": int((one.success != other.success).sum()),
        "ticks differ": int((one.ticks != other.ticks).sum()),
        "dqpos": spread(np.abs(one.qpos - other.qpos)[same].max(axis=1, initial=0)),
    }


def spread(values: np.ndarray) -> list[float]:
    """Median, 90th percentile and largest; empty when there is nothing."""
    if not values.size:
        return []
    return [float(f"{x:.3g}") for x in (*np.quantile(values, [0.5, 0.9]), values.max())]


def device(backend: str) -> str:
    """What the physics ran on."""
    if physics_of(backend) == "native":
        return "cpu"
    import jax

    return jax.devices()[0].device_kind


# -- worker processes --------------------------------------------------------------------------------------------------


class Worker:
    """A process that calls a function again and again; when it dies or hangs, the next call starts another.

    Args:
        function: importable by name; takes and returns what can be pickled.
        gpu: the only GPU it sees; None leaves that alone.
    """

    def __init__(self, function: Callable[..., Row], gpu: int | None = None) -> None:
        self._function, self._gpu = function, gpu
        self._process: Any = None
        self._pipe: Connection | None = None

    def call(self, arguments: tuple[Any, ...], seconds: float) -> Row:
        """The function's result, or a row with ``error``: what it raised, how it died, or that time ran out."""
        pipe = self._running()
        try:
            pipe.send(arguments)
            if pipe.poll(max(seconds, 0)):
                return pipe.recv()
            reason = f"no result after {seconds:.0f} s"
        except (EOFError, OSError):
            self._process.join()
            reason = f"the process died with exit code {self._process.exitcode}"
        self.close()
        return {"error": reason}

    def _running(self) -> Connection:
        if self._pipe is None:
            context = multiprocessing.get_context("spawn")
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=serve, args=(self._function, theirs, self._gpu), daemon=True)
            self._process.start()
            theirs.close()
        return self._pipe

    def close(self) -> None:
        """End the process."""
        if self._pipe is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
        self._pipe = None


def serve(function: Callable[..., Row], pipe: Connection, gpu: int | None) -> None:
    """Answer calls until the other end is gone."""
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # several processes share a GPU
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = str(gpu)
    if importlib.util.find_spec("warp") is not None:
        import warp

        warp.config.log_level = warp.LOG_WARNING  # or it prints a line for each of its hundreds of kernels
    while True:
        try:
            arguments = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send(function(*arguments))
        except Exception as error:  # whatever a scene raises concerns this scene only
            traceback.print_exc()
            pipe.send({"error": f"{type(error).__name__}: {error}".splitlines()[0]})


def shared_out(jobs: Sequence[Job], setup: Setup, options: argparse.Namespace) -> Iterator[tuple[Job, Row]]:
    """Rows of the jobs as they come, from all workers; after ``--limit-seconds`` what still runs is cut off."""
    deadline = time.monotonic() + options.limit_seconds
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    done: queue.SimpleQueue[tuple[Job, Row] | None] = queue.SimpleQueue()
    for job in jobs:
        waiting.put(job)

    def work(gpu: int | None) -> None:
        worker = Worker(perform, gpu)
        while time.monotonic() < deadline:
            try:
                job = waiting.get_nowait()
            except queue.Empty:
                break
            row = worker.call((job, setup), min(options.job_seconds, deadline - time.monotonic()))
            if "error" not in row or time.monotonic() < deadline:  # what was cut off has not failed
                done.put((job, row))
        worker.close()
        done.put(None)

    gpus = [i % options.gpus if options.gpus > 1 else None for i in range(options.workers)]
    threads = [threading.Thread(target=work, args=(gpu,)) for gpu in gpus]
    for thread in threads:
        thread.start()
    for _ in threads:
        yield from iter(done.get, None)


# -- the program -------------------------------------------------------------------------------------------------------


def jobs_of(options: argparse.Namespace) -> list[Job]:
    """What is to be done, the most important first: replays of all suites, then closed loops."""
    jobs = []
    for kind, suites in (("replay", options.suite), ("closed", options.closed_loop)):
        for suite in sorted(suites, key=SUITES.index):
            tasks = tasks_of(suite, options.scenes)
            for sharing in by_scene(tasks):
                chosen = [task for task in sharing if options.task is None or task in options.task]
                if not chosen:
                    continue
                name = scene_name(suite, chosen, [tasks[i].name for i in chosen])
                for geometry in options.geometry:
                    shared = {"suite": suite, "scene": name, "tasks": tuple(chosen), "geometry": geometry}
                    jobs += [Job(kind=kind, backend=backend, **shared) for backend in options.backend]
    return jobs


def compare(options: argparse.Namespace) -> None:
    """Do the jobs that the results file does not have yet; print a line a job."""
    setup = Setup(
        recordings=options.recordings,
        contacts=options.contacts,
        scenes=options.scenes,
        episodes=options.episodes,
        ticks=options.ticks,
        again=tuple(options.again),
    )
    path = options.out / f"{NAME}.json"
    rows = {key_of(row): row for row in ([] if options.anew else read_rows([path])) if "error" not in row}
    if other := contacts_of(list(rows.values())) - {options.contacts}:
        raise SystemExit(f"{path} has rows with contacts={', '.join(other)}: another --out, or --anew to forget them")
    jobs = [job for job in jobs_of(options) if job.key not in rows]
    print(f"{len(jobs)} jobs, {len(rows)} rows are there already", flush=True)
    started = time.monotonic()
    for job, row in shared_out(jobs, setup, options):
        rows[job.key] = {
            **asdict(job),
            "contacts": options.contacts,
            "workers": options.workers,
            "gpus": options.gpus,
            "at most": options.ticks,
            **row,
        }
        write_rows(path, list(rows.values()))
        print(f"{time.monotonic() - started:4.0f} s {line(rows[job.key])}", flush=True)
    missing = sum(job.key not in rows for job in jobs)
    failed = sum("error" in rows[job.key] for job in jobs if job.key in rows)
    print(f"rows in {path}; {failed} jobs failed, {missing} were not reached")


def key_of(row: Row) -> tuple[str, ...]:
    """``Job.key`` of a row."""
    return (row["kind"], row["scene"], row["backend"], row["geometry"])


def contacts_of(rows: Sequence[Row]) -> set[str]:
    """The contacts that rows were measured with."""
    return {row.get("contacts", EARLIER) for row in rows}


def line(row: Row) -> str:
    """A row in short."""
    head = " ".join((row["kind"], row["scene"], row["backend"], row["geometry"]))
    if "error" in row:
        return f"{head}: {row['error']}"
    found = row["replay" if row["kind"] == "replay" else "closed"]
    text = f"{head}: native {found['native']}, here {found['here']} of {row['episodes']}"
    text += f", only native {found['only native']}, only here {found['only here']}"
    if row["kind"] == "replay":
        text += f", settle apart {row['settle']['apart']}"
    return f"{text}, faults {sum(found['faults'].values())}, {row['ticks']} ticks, {row['seconds']}"


def read_rows(paths: Sequence[Path]) -> list[Row]:
    """The rows of results files; a file that is not there has none, and a later one's row takes an earlier one's place.

    A row with an error takes no other's place.
    """
    rows: dict[tuple[str, ...], Row] = {}
    for path in paths:
        for row in json.loads(path.read_text())["rows"] if path.is_file() else ():
            if "error" not in row or key_of(row) not in rows:
                rows[key_of(row)] = row
    return list(rows.values())


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a results file, all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"benchmark": NAME, **conditions(), "rows": list(rows)}
    half = path.with_suffix(".part")
    half.write_text(json.dumps(content, indent=1) + "\n")
    half.replace(path)


@functools.cache
def conditions() -> dict[str, Any]:
    """Command, date, machine and versions."""
    from vecenv.doctor import machine, versions

    command = " ".join(["python", *sys.argv])
    return {
        "command": command,
        "date": datetime.now(UTC).date().isoformat(),
        "machine": machine(),
        "versions": versions(),
    }


# -- tables ------------------------------------------------------------------------------------------------------------


def table(options: argparse.Namespace) -> None:
    """Merge results files and write the Markdown."""
    rows = read_rows(options.results)
    if not rows:
        raise SystemExit(f"no rows in {', '.join(map(str, options.results))}")
    if len(contacts_of(rows)) > 1:
        raise SystemExit(f"rows with different contacts ({', '.join(sorted(contacts_of(rows)))}) do not make one table")
    options.out.write_text(markdown(rows))
    print(f"{len(rows)} rows in {options.out}")


def markdown(rows: Sequence[Row]) -> str:
    """All tables."""
    good = [row for row in rows if "error" not in row]
    order = sorted(good, key=lambda row: (SUITES.index(row["suite"]), row["tasks"][0], row["backend"], row["geometry"]))
    replays = [row for row in order if row["kind"] == "replay"]
    failed = [f"* {' '.join(key_of(row))}: {row['error']}" for row in rows if "error" in row]
    sections = {
        "Suites": grid([suite_cells(*group) for group in grouped(order)]),
        "Scenes": grid([scene_cells(row) for row in replays]),
        "Objects that end elsewhere when verdicts differ": grid(culprits(order)),
        "Not compared": "\n".join(failed),
    }
    texts = [f"## {title}\n\n{text}" for title, text in sections.items() if text]
    contacts = f"Contacts on both sides: {', '.join(sorted(contacts_of(rows)))}."
    return "\n\n".join(["# Fidelity of MJX by suite and scene", INTRODUCTION, contacts, *texts]) + "\n"


INTRODUCTION = f"""Written by `python benchmarks/mjx_fidelity.py table`; all rows: `benchmarks/results/{NAME}.json`.
Native MuJoCo with upstream's geometry is the reference. "Replay": `pick_place`'s actions on native, given to the other
side without looking; "closed loop": the policy looks. Points are percentage points of success against native on the
same episodes; "only native" and "only here" count the episodes with differing verdicts both ways. "Apart": how far
movable objects end from where native leaves them after {IDLE_TICKS} idle ticks, median / 90 % / largest, in mm."""


def grouped(rows: Sequence[Row]) -> list[tuple[tuple[str, str, str], list[Row]]]:
    """Rows by suite, backend and geometry."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["suite"], row["backend"], row["geometry"]), []).append(row)
    return list(groups.items())


def suite_cells(key: tuple[str, str, str], rows: Sequence[Row]) -> dict[str, str]:
    """A row of the first table."""
    replays = [row for row in rows if row["kind"] == "replay"]
    closed = [row for row in rows if row["kind"] == "closed"]
    twins = [row["twins"] for row in replays if row["twins"]]
    again = [row["again"] for row in replays if row["again"]]
    return {
        **dict(zip(("suite", "backend", "geometry"), key, strict=True)),
        "scenes": str(len({row["scene"] for row in rows})),
        **agreement_cells("replay", [(row["episodes"], row["replay"]) for row in replays]),
        **agreement_cells("closed loop", [(row["episodes"], row["closed"]) for row in closed]),
        "objects > 5 mm apart": f"{sum(row['settle']['over 5 mm'] for row in replays)}"
        f" of {sum(row['settle']['objects'] for row in replays)}",
        "twins: verdicts differ": shares(twins),
        "second run: verdicts differ": shares(again),
        "faults": str(sum(sum(row[row["kind"]]["faults"].values()) for row in rows)),
    }


def agreement_cells(name: str, found: Sequence[tuple[int, Row]]) -> dict[str, str]:
    """Success on both sides, the difference in points, and differing verdicts both ways; of episodes and verdicts."""
    total = sum(episodes for episodes, _ in found)
    native, here, lost, won = (
        sum(row[column] for _, row in found) for column in ("native", "here", "only native", "only here")
    )
    if not total:
        return {f"{name}: native → here": "", f"{name}: points": "", f"{name}: only native / here": ""}
    return {
        f"{name}: native → here": f"{native} → {here} of {total}",
        f"{name}: points": f"{100 * (here - native) / total:+.1f}",
        f"{name}: only native / here": f"{lost} / {won}",
    }


def shares(found: Sequence[Row]) -> str:
    """Differing verdicts among pairs of runs."""
    return f"{sum(f['verdicts differ'] for f in found)} of {sum(f['episodes'] for f in found)}" if found else ""


def scene_cells(row: Row) -> dict[str, str]:
    """A row of the second table."""
    settle, replay, worst = row["settle"], row["replay"], row["settle"]["worst"]
    return {
        "scene": row["scene"],
        "backend": row["backend"],
        "geometry": row["geometry"],
        "native moves": millimetres(settle["native"]),
        "moves": millimetres(settle["here"]),
        "apart": millimetres(settle["apart"]),
        "farthest apart": f"{worst['object']}, {worst['task']}/{worst['episode']}",
        **agreement_cells("replay", [(row["episodes"], replay)]),
        "twins: dqpos": " / ".join(f"{x:.0e}" for x in row["twins"]["dqpos"]) if row["twins"] else "",
        "faults": str(sum(replay["faults"].values())),
        "first result, s": f"{row['seconds']['ready'] + row['seconds']['first']:.0f}",
    }


def millimetres(metres: Sequence[float]) -> str:
    """Median / 90 % / largest."""
    return " / ".join("<0.001" if 0 < x < 1e-6 else f"{1000 * x:.2g}" if x < 0.1 else f"{1000 * x:.0f}" for x in metres)


def culprits(rows: Sequence[Row]) -> list[dict[str, str]]:
    """Which object ends farthest from where native left it, counted over the episodes whose verdicts differ."""
    counted: Counter[tuple[str, ...]] = Counter()
    for row in rows:
        for case in row[row["kind"]]["differ"]:
            why = "fault" if case["fault"] else "only native" if case["native"] else "only here"
            thing = re.sub(r"_\d+$", "", case["object"])
            counted[row["suite"], row["kind"], row["backend"], row["geometry"], why, thing] += 1
    columns = ("suite", "kind", "backend", "geometry", "verdict", "object")
    return [{**dict(zip(columns, key, strict=True)), "episodes": str(n)} for key, n in counted.most_common()]


def grid(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows as a Markdown table, without the columns that are empty throughout."""
    columns = [name for name in (rows[0] if rows else ()) if any(row[name] for row in rows)]
    lines = [columns, ["---"] * len(columns), *([row[name] for name in columns] for row in rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines) if columns else ""


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    stages = parser.add_subparsers(required=True, metavar="record | compare | table")
    both = argparse.ArgumentParser(add_help=False)
    both.add_argument("--suite", nargs="+", choices=SUITES, default=list(SUITES))
    both.add_argument("--scenes", help="folder that `vecenv compile` wrote; the installed packages otherwise")
    both.add_argument("--episodes", type=int, help="of each task, at most; all that are recorded, or 10 (50) to record")
    both.add_argument("--contacts", choices=CONTACTS, default="published", help="of native and of all backends")

    stage = stages.add_parser("record", parents=[both], help="run pick_place on native MuJoCo")
    stage.add_argument("--out", type=Path, required=True, help="folder for the recordings")
    stage.add_argument("--cap", type=int, default=CAP, help="control ticks of an episode at most")
    stage.set_defaults(stage=record)

    stage = stages.add_parser("compare", parents=[both], help="give MJX the same starts and actions")
    stage.add_argument("recordings", type=Path, help="folder of the recordings")
    stage.add_argument("--task", nargs="+", type=int, help="only these tasks of each suite, to look into something")
    stage.add_argument("--ticks", type=int, help="end every replayed episode after this many, on both sides")
    stage.add_argument("--backend", nargs="+", default=["warp"], choices=("warp", "jax", "native", "nudged"))
    stage.add_argument("--geometry", nargs="+", default=["exact", "lean"], choices=("exact", "lean"))
    stage.add_argument("--closed-loop", nargs="+", choices=SUITES, default=[], help="suites to play closed-loop too")
    stage.add_argument(
        "--again", nargs="*", default=["libero_spatial"], help="suites whose replay is run a second time"
    )
    stage.add_argument("--workers", type=int, default=1, help="processes; compiling is what takes long")
    stage.add_argument("--gpus", type=int, default=1, help="GPUs that the workers spread over")
    stage.add_argument("--limit-seconds", type=float, default=3600.0, help="stop after this long")
    stage.add_argument("--job-seconds", type=float, default=300.0, help="give a scene up after this long")
    stage.add_argument("--out", type=Path, default=RESULTS, help="folder for the results file")
    stage.add_argument("--anew", action="store_true", help="forget the rows that are in it")
    stage.set_defaults(stage=compare)

    stage = stages.add_parser("table", help="write the Markdown")
    stage.add_argument("results", nargs="*", type=Path, default=[RESULTS / f"{NAME}.json"], help="results files")
    stage.add_argument("--out", type=Path, default=DOC)
    stage.set_defaults(stage=table)
    return parser.parse_args(given)


if __name__ == "__main__":
    options = arguments()
    options.stage(options)
