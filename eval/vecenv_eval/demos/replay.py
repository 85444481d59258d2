"""Recorded actions, executed again: does the simulation here come to the verdicts on record?

Demonstrations come in (``vecenv_eval.demos.demos``); those that can share a batch are placed as their file says,
stepped tick by tick with their own actions, and judged at or before their own last one. A :class:`ReplayReport` goes
out: both verdicts of each demonstration, how far its state ended from the one on record, and how often the verdicts
agree.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

import vecenv
from vecenv.assets import AssetsMissing
from vecenv.contract import ACTION_DIM, Control
from vecenv.errors import InvalidInput
from vecenv_eval.demos.demos import SUFFIXES, Demo, DemoError, MadeStart, StoredStart, Unreadable, read_demos
from vecenv_eval.demos.record import flat_state
from vecenv_eval.report import CONFIDENCE, wilson

NO_FIXTURES = "no model_file: fixtures at their centres"


class ReplayError(InvalidInput):
    """There is nothing to replay; the message says what was looked for."""


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """How to replay.

    Attributes:
        backend: physics backend; None for the one on record, ``native`` where there is none.
        num_envs: most demonstrations that run at once.
        num_threads: threads of the physics, None for the backend's own choice.
        contacts: ``"published"`` or ``"current"``; None for those on record, published where there are none.
    """

    backend: str | None = None
    contacts: str | None = None
    num_envs: int = 256
    num_threads: int | None = None


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How one demonstration went.

    Attributes:
        path, name: the file, and the demonstration's name in it.
        suite, task: what it is a demonstration of.
        recorded: the verdict on record, None where there is none.
        replayed: the verdict of the replay, at or before the last action.
        length: actions on record.
        ticks: control ticks executed; fewer than ``length`` when it was solved before.
        qpos_error, qvel_error: largest difference from the state on record (metres and radians; per second) after
            ``ticks``, or before the last action where the file has no later one; None where it has none.
        fault: why the physics failed, "" when it did not.
        note: what a reader should know about the comparison.
    """

    path: Path
    name: str
    suite: str
    task: int
    recorded: bool | None
    replayed: bool
    length: int
    ticks: int
    qpos_error: float | None
    qvel_error: float | None
    fault: str = ""
    note: str = ""

    @property
    def agrees(self) -> bool | None:
        """Whether the verdicts are the same; None without one on record."""
        return None if self.recorded is None else self.recorded == self.replayed


@dataclass(frozen=True, kw_only=True)
class ReplayReport:
    """Every outcome, and what could not be replayed."""

    outcomes: tuple[Outcome, ...]
    problems: tuple[Unreadable, ...]

    @property
    def compared(self) -> int:
        """Demonstrations with a verdict on record."""
        return sum(outcome.recorded is not None for outcome in self.outcomes)

    @property
    def agreeing(self) -> int:
        """Those whose replay came to the same."""
        return sum(outcome.agrees is True for outcome in self.outcomes)

    @property
    def ok(self) -> bool:
        """Every demonstration was replayed, and verdicts were compared and agree."""
        return not self.problems and 0 < self.compared == self.agreeing

    def to_dict(self) -> dict[str, Any]:
        """Plain types, ready for JSON."""
        low, high = wilson(self.agreeing, self.compared) if self.compared else (None, None)
        return {
            "compared": self.compared,
            "agreeing": self.agreeing,
            "low": low,
            "high": high,
            "interval": f"wilson {CONFIDENCE}",
            "ok": self.ok,
            "demos": [{**vars(o), "path": str(o.path), "agrees": o.agrees} for o in self.outcomes],
            "problems": [{**vars(p), "path": str(p.path)} for p in self.problems],
        }


def find_files(paths: Iterable[Path]) -> list[Path]:
    """The files among the paths, and the HDF5 files in the folders among them, at any depth, sorted.

    Raises:
        ReplayError: a path does not exist, or a folder holds no HDF5 file.
    """
    files: list[Path] = []
    for path in paths:
        found = sorted(p for p in path.rglob("*") if p.suffix in SUFFIXES) if path.is_dir() else [path]
        if not path.exists() or not found:
            raise ReplayError(f"{path}: {'no HDF5 file in this folder' if path.is_dir() else 'no such file'}")
        files += found
    return list(dict.fromkeys(files))


def read_files(
    files: Iterable[Path], *, suite: str | None = None, task: int | None = None
) -> tuple[list[Demo], list[Unreadable]]:
    """Every demonstration of the files, and what cannot be used; see ``vecenv_eval.demos.demos.read_demos``."""
    demos: list[Demo] = []
    problems: list[Unreadable] = []
    for path in files:
        try:
            good, bad = read_demos(path, suite=suite, task=task)
        except DemoError as error:
            good, bad = [], [Unreadable(path=path, name="", reason=str(error).removeprefix(f"{path}: "))]
        demos += good
        problems += bad
    return demos, problems


def replay(
    demos: Sequence[Demo],
    config: ReplayConfig | None = None,
    *,
    on_batch: Callable[[str], None] = lambda text: None,
) -> ReplayReport:
    """Execute demonstrations again, in as few batches as their starts allow.

    Args:
        demos: what to replay.
        config: how.
        on_batch: told in a line what each batch is, before it runs.

    Returns:
        Outcomes in the order of ``demos``. What the simulator refuses to place is a problem of that batch alone.
    """
    config = config or ReplayConfig()
    outcomes: dict[int, Outcome] = {}
    problems: list[Unreadable] = []
    batches = list(_batches(demos, config))
    for number, batch in enumerate(batches, start=1):
        longest = max(len(demos[i]) for i in batch)
        on_batch(f"batch {number}/{len(batches)}: {len(batch)} demonstrations of up to {longest} ticks")
        chosen = [demos[i] for i in batch]
        try:
            outcomes.update(zip(batch, _replay_batch(chosen, config), strict=True))
        except AssetsMissing:
            raise
        except (ValueError, KeyError, IndexError, TypeError, RuntimeError) as error:
            reason = f"cannot be replayed: {type(error).__name__}: {' '.join(str(error).split())}"
            problems += [Unreadable(path=demo.path, name=demo.name, reason=reason) for demo in chosen]
    return ReplayReport(outcomes=tuple(outcomes[i] for i in sorted(outcomes)), problems=tuple(problems))


def table(report: ReplayReport) -> Table:
    """The outcomes as a table for the screen; with file names where a task has several files."""
    named = {outcome.path: (outcome.suite, outcome.task) for outcome in report.outcomes}
    several = len(set(named.values())) < len(named)
    result = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    result.collapse_padding = True
    for column in ("task", "demo", "recorded", "replayed", "ticks", "max |dq|", *(["file"] if several else []), "note"):
        free = column in ("file", "note")
        result.add_column(column, justify="left" if free or column == "task" else "right", no_wrap=not free)
    for outcome in report.outcomes:
        result.add_row(*map(Text, _cells(outcome, several)), style="red" if outcome.agrees is False else None)
    return result


def _cells(outcome: Outcome, named: bool) -> list[str]:
    return [
        f"{outcome.suite}/{outcome.task}",
        outcome.name,
        _verdict(outcome.recorded),
        _verdict(outcome.replayed),
        f"{outcome.ticks}/{outcome.length}",
        "-" if outcome.qpos_error is None else f"{outcome.qpos_error:.1e}",
        *([outcome.path.name] if named else []),
        "; ".join(filter(None, (outcome.fault, outcome.note))),
    ]


def closing_line(report: ReplayReport) -> str:
    """How often the verdicts agree, in a sentence."""
    without = len(report.outcomes) - report.compared
    rest = "".join(
        f", {count} {what}"
        for count, what in ((without, "without a verdict on record"), (len(report.problems), "not replayed"))
        if count
    )
    if not report.compared:
        return f"no verdicts to compare{rest}"
    low, high = wilson(report.agreeing, report.compared)
    return f"verdicts agree: {report.agreeing}/{report.compared} (95 % interval {low:.1%}-{high:.1%}){rest}"


def _verdict(success: bool | None) -> str:
    return "?" if success is None else "solved" if success else "failed"


# -- batches -----------------------------------------------------------------------------------------------------------


def _batches(demos: Sequence[Demo], config: ReplayConfig) -> Iterator[list[int]]:
    """Indices of the demonstrations that run together: started alike, at most ``num_envs``, task by task."""
    groups: dict[Hashable, list[int]] = {}
    for index, demo in enumerate(demos):
        groups.setdefault((demo.suite, _start_key(demo.start)), []).append(index)
    for group in groups.values():
        # Of like length, so that no slot waits long for the others; within a batch in the order `vecenv.make` uses.
        group.sort(key=lambda i: len(demos[i]))
        for batch in np.array_split(group, -(-len(group) // config.num_envs)):
            yield sorted(batch.tolist(), key=lambda i: demos[i].task)


def _start_key(start: StoredStart | MadeStart) -> Hashable:
    if isinstance(start, MadeStart):
        return json.dumps({**start.options, "max_steps": 0}, sort_keys=True)
    return None if start.fixtures is None else frozenset(start.fixtures)


def _make(demos: Sequence[Demo], config: ReplayConfig) -> Any:
    """The environment with one slot a demonstration, reset and in the start states."""
    stored = [demo.start for demo in demos if isinstance(demo.start, StoredStart)]
    made = [demo.start for demo in demos if isinstance(demo.start, MadeStart)]  # one list is empty: see _start_key
    options = _stored_options(stored) if stored else dict(made[0].options)
    episodes: dict[int, list[int]] = {}
    for demo in demos:
        episodes.setdefault(demo.task, []).append(demo.start.episode if isinstance(demo.start, MadeStart) else 0)
    options |= {"max_steps": max(map(len, demos)), "num_threads": config.num_threads}
    for name in ("backend", "contacts"):
        if getattr(config, name) is not None:
            options[name] = getattr(config, name)
    env: Any = vecenv.make(demos[0].suite, tasks=list(episodes), episodes=episodes, **options)
    try:
        env.reset()
        if stored:
            _load(env, stored)
    except BaseException:
        env.close()
        raise
    return env


def _stored_options(starts: Sequence[StoredStart]) -> dict[str, Any]:
    """Options under which nothing but the stored states and fixture poses decides the start."""
    options: dict[str, Any] = {"start": "raw", "settle_steps": 0, "fixtures": "center"}
    poses = [start.fixtures for start in starts if start.fixtures is not None]
    if poses:
        options["fixtures"] = {
            name: tuple(np.stack([pose[name][part] for pose in poses]) for part in (0, 1)) for name in poses[0]
        }
    return options


def _load(env: Any, starts: Sequence[StoredStart]) -> None:
    """Put each slot into its stored state; the controller keeps its memory of the reset, as upstream's does."""
    state = env.state()
    qpos, qvel, time = state.qpos.copy(), state.qvel.copy(), state.time.copy()
    for slot, start in enumerate(starts):
        nq, nv = state.nq[slot], state.nv[slot]
        time[slot], qpos[slot, :nq], qvel[slot, :nv] = start.state[0], start.state[1 : 1 + nq], start.state[1 + nq :]
    env.set_state(qpos=qpos, qvel=qvel, time=time)


# -- stepping ----------------------------------------------------------------------------------------------------------


def _replay_batch(demos: Sequence[Demo], config: ReplayConfig) -> list[Outcome]:
    env = _make(demos, config)
    try:
        return _step_through(env, demos)
    finally:
        env.close()


def _step_through(env: Any, demos: Sequence[Demo]) -> list[Outcome]:
    """Step until every demonstration has been judged; one that is through idles beside the others."""
    lengths = np.array([len(demo) for demo in demos])
    outcomes: list[Outcome | None] = [None] * len(demos)
    nq = env.state().nq
    before: dict[int, np.ndarray] = {}  # states before the last action, what LIBERO's files record last
    for tick in range(int(lengths.max())):
        waiting = np.array([outcome is None for outcome in outcomes])
        if not waiting.any():
            break
        before |= _states(env, waiting & (lengths == tick + 1))
        control = env.step_continuous(_actions(demos, tick))
        judged = waiting & (control.done | (lengths == tick + 1))
        for slot, after in _states(env, judged).items():
            outcomes[slot] = _outcome(demos[slot], control, slot, nq[slot], before.pop(slot, None), after)
    return [outcome for outcome in outcomes if outcome is not None]


def _states(env: Any, chosen: np.ndarray) -> dict[int, np.ndarray]:
    if not chosen.any():
        return {}
    state = env.state()
    return {slot: flat_state(state, slot) for slot in np.flatnonzero(chosen).tolist()}


def _actions(demos: Sequence[Demo], tick: int) -> np.ndarray:
    """Each demonstration's action, [B, 7]; beyond its last one no motion, the gripper as it was."""
    actions = np.zeros((len(demos), ACTION_DIM))
    for slot, demo in enumerate(demos):
        if tick < len(demo):
            actions[slot] = demo.actions[tick]
        else:
            actions[slot, -1] = demo.actions[-1, -1]
    return actions


def _outcome(demo: Demo, control: Control, slot: int, nq: int, before: np.ndarray | None, after: np.ndarray) -> Outcome:
    """What became of a slot that has just been judged, with its states before and after its last action."""
    ticks = int(control.step_index[slot])
    notes = [NO_FIXTURES] if isinstance(demo.start, StoredStart) and demo.start.fixtures is None else []
    try:
        difference = _difference(demo, ticks, before, after)
    except DemoError as error:
        difference = None
        notes.append(str(error).removeprefix(f"{demo.path}: {demo.name}: "))
    return Outcome(
        path=demo.path,
        name=demo.name,
        suite=demo.suite,
        task=demo.task,
        recorded=demo.success,
        replayed=bool(control.success[slot]),
        length=len(demo),
        ticks=ticks,
        qpos_error=None if difference is None else float(difference[1 : 1 + nq].max()),
        qvel_error=None if difference is None else float(difference[1 + nq :].max()),
        fault=control.info["fault"][slot],
        note="; ".join(notes),
    )


def _difference(demo: Demo, ticks: int, before: np.ndarray | None, after: np.ndarray) -> np.ndarray | None:
    """|state here - state on record|, [1 + nq + nv], at the last moment of which both are known; None without one.

    Raises:
        DemoError: the state on record cannot be used.
    """
    theirs, ours = demo.recorded_state(ticks), after
    if theirs is None and before is not None:
        theirs, ours = demo.recorded_state(len(demo) - 1), before
    if theirs is None:
        return None
    if theirs.shape != ours.shape:
        raise DemoError(f"the state on record has {theirs.size} numbers, the scene has {ours.size}")
    return np.abs(theirs - ours)
