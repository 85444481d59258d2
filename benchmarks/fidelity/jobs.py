"""One scene on one backend with one geometry, given the recorded starts and actions, or played closed-loop.

A :class:`Job` and the :class:`Setup` that all jobs share come in; a row of results goes out.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fidelity.measures import Row, settling, spread_of_runs, verdicts
from fidelity.recordings import GRACE, Recording, RecordingError, recording_path
from fidelity.scenes import begin_again, ended, make, part, play, run
from vecenv.libero.env import SETTLE_ACTION, LiberoEnv
from vecenv.libero.scene.contacts import Contacts

IDLE_TICKS = 50
# Positions of starts that differ by more than this are other starts (float32 keeps 1e-7), metres.
SAME_START = 1e-5
# Standard deviation of what is added to the actions of the backend "nudged": an ulp of a float32 near 1.
NUDGE = 1e-7
# Contacts of recordings and rows from before there was a choice.
EARLIER = "current"
# What a slot of a replay is there for: to hold still, to be replayed, and to be replayed beside the first.
IDLE, FIRST, SECOND = range(3)


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


def device(backend: str) -> str:
    """What the physics ran on."""
    if physics_of(backend) == "native":
        return "cpu"
    import jax

    return jax.devices()[0].device_kind
