"""What the routes of runs answer with; the schema of the API is made of these models."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal

from pydantic import BaseModel

from vecenv_eval.report.summary import Row
from vecenv_eval.store import Record
from vecenv_eval.store.record import to_plain
from vecenv_eval.web.runs import Leg, Snapshot, episode_key

Verdict = Literal["success", "failure", "fault", "error"]
State = Literal["running", "complete", "stopped", "empty"]
# Longest text that is sent of what files hold.
_LONGEST = 4000


class RunRow(BaseModel):
    """A run that was opened."""

    run: str
    folder: str
    state: State


class RunList(BaseModel):
    """The runs that were opened, in the order in which they were named; ``drives``: the server drives a session too."""

    runs: list[RunRow]
    drives: bool


class Counts(BaseModel):
    """Counts and success rate with its Wilson 95 % interval.

    ``planned`` is null where the folder does not say it; ``episodes`` have a verdict, faults included.
    """

    planned: int | None
    episodes: int
    successes: int
    faults: int
    errors: int
    missing: int
    rate: float | None
    low: float | None
    high: float | None
    steps_to_solve: float | None


class TaskCounts(Counts):
    """The same of one task."""

    leg: str
    suite: str
    task: int
    instruction: str


class LegInfo(BaseModel):
    """One evaluation of a suite: conditions as a sentence, counts, and what was recorded how often."""

    leg: str
    folders: list[str]
    suite: str
    policy: str
    seed: int | None
    conditions: str
    counts: Counts
    writing: bool
    changed: float | None


class RunInfo(BaseModel):
    """How a run stands. ``version`` grows with every change."""

    run: str
    folder: str
    state: State
    version: int
    counts: Counts
    legs: list[LegInfo]
    tasks: list[TaskCounts]
    problems: list[str]


class EpisodeRow(BaseModel):
    """One episode in a list. ``number`` counts episodes of the run in the order in which they were stored."""

    key: str
    leg: str
    suite: str
    task: int
    episode: int
    instruction: str
    verdict: Verdict
    num_steps: int
    reward: float | None
    wall_s: float
    sanitized: int
    reason: str
    number: int


class EpisodeList(BaseModel):
    """Some of the episodes that fit a filter; ``total`` fit."""

    total: int
    offset: int
    version: int
    rows: list[EpisodeRow]


class VideoInfo(BaseModel):
    """A recorded video: frame i shows the state before tick i, the last one the end."""

    frames: int
    fps: float
    width: int
    height: int
    cameras: list[str]


class RecordedInfo(BaseModel):
    """What there is of an episode. ``frames``: where the images of its ticks come from, null for none.

    ``problems`` has a sentence for each recording that cannot be used.
    """

    frames: Literal["video", "states"] | None
    ticks: int
    cameras: list[str]
    video: VideoInfo | None
    actions: bool
    states: bool
    log: bool
    problems: list[str]


class EpisodeDetail(BaseModel):
    """An episode: its row, everything that is stored about it, and what was recorded."""

    row: EpisodeRow
    record: dict[str, Any]
    recorded: RecordedInfo


class Curves(BaseModel):
    """Curves over ticks by name: executed actions, and the robot's joint positions where states were recorded."""

    ticks: list[int]
    actions: dict[str, list[float]]
    joints: dict[str, list[float]]


class Log(BaseModel):
    """What a policy noted about an episode, and whether that is all of it."""

    lines: list[Any]
    complete: bool


class ComparedRow(BaseModel):
    """An episode in two runs: null where one has no row. ``change`` is null unless both have a verdict."""

    suite: str
    task: int
    episode: int
    instruction: str
    first: EpisodeRow | None
    second: EpisodeRow | None
    change: Literal["lost", "won", "both", "neither"] | None


class Compared(BaseModel):
    """Two runs on the same episodes: ``lost`` were solved by the first alone, ``won`` by the second alone.

    ``p_value`` is of McNemar's exact test, two-sided.
    """

    first: str
    second: str
    lost: int
    won: int
    both: int
    neither: int
    unpaired: int
    p_value: float
    total: int
    offset: int
    rows: list[ComparedRow]


def verdict_of(record: Record) -> Verdict:
    """How an episode ended, in a word."""
    if record.error:
        return "error"
    return "fault" if record.fault else "success" if record.success else "failure"


def counts_of(row: Row, planned: int | None) -> Counts:
    """The counts of a row of a summary."""
    return Counts(planned=planned, **_counted(row))


def _counted(row: Row) -> dict[str, Any]:
    names = ("episodes", "successes", "faults", "errors", "missing", "rate", "low", "high", "steps_to_solve")
    return {name: getattr(row, name) for name in names}


def run_info(run: Snapshot, state: State) -> RunInfo:
    """How a run stands."""
    known = [len(leg.planned) for leg in run.legs if leg.planned is not None]
    planned = sum(known) if len(known) == len(run.legs) else None
    return RunInfo(
        run=run.name,
        folder=clean(str(run.folder)),
        state=state,
        version=run.version,
        counts=counts_of(run.total, planned),
        legs=[_leg_info(leg) for leg in run.legs],
        tasks=[
            TaskCounts(
                leg=leg.name,
                suite=clean(leg.suite),
                task=int(row.task),
                instruction=clean(row.instruction),
                planned=None if leg.planned is None else row.episodes + row.errors + row.missing,
                **_counted(row),
            )
            for leg in run.legs
            for row in leg.tasks
        ],
        problems=[clean(problem) for problem in run.problems[:100]],
    )


def _leg_info(leg: Leg) -> LegInfo:
    return LegInfo(
        leg=leg.name,
        folders=[clean(str(folder)) for folder in leg.folders],
        suite=clean(leg.suite),
        policy=clean(leg.policy),
        seed=leg.seed,
        conditions=clean(leg.conditions),
        counts=counts_of(leg.total, None if leg.planned is None else len(leg.planned)),
        writing=leg.writing,
        changed=leg.changed,
    )


def episode_row(leg: Leg, record: Record, number: int) -> EpisodeRow:
    """An episode in a list."""
    plain = to_plain(record)
    return EpisodeRow(
        key=episode_key(leg, record.key),
        leg=leg.name,
        suite=clean(record.suite),
        task=record.task,
        episode=record.episode,
        instruction=clean(record.instruction),
        verdict=verdict_of(record),
        num_steps=record.num_steps,
        reward=plain["reward"],
        wall_s=plain["wall_s"] or 0.0,
        sanitized=record.sanitized,
        reason=clean(record.error or record.fault),
        number=number,
    )


def clean(value: Any) -> Any:
    """A value from a file as JSON can be sent: text without surrogates and of a bearable length."""
    if isinstance(value, str):
        text = value if len(value) <= _LONGEST else value[:_LONGEST] + "..."
        return text.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, Mapping):
        return {clean(str(name)): clean(each) for name, each in value.items()}
    if isinstance(value, Iterable) and not isinstance(value, bytes):
        return [clean(each) for each in value]
    return value
