"""Recorded actions, executed again: does the simulation here come to the verdicts on record?

Demonstrations come in (``vecenv_eval.demos.schema``); those that can share a batch are placed as their file says,
stepped tick by tick with their own actions, and judged at or before their own last one. A
:class:`~vecenv_eval.demos.outcomes.ReplayReport` goes out.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import vecenv
from vecenv.assets import AssetsMissing
from vecenv.contract import ACTION_DIM, BatchEnv, Control
from vecenv_eval.demos.files import ReplayError
from vecenv_eval.demos.hdf5 import DemoError, Unreadable
from vecenv_eval.demos.outcomes import Outcome, ReplayReport
from vecenv_eval.demos.record import flat_state, second_halves
from vecenv_eval.demos.schema import Demo, MadeStart, StoredStart
from vecenv_eval.store import Record
from vecenv_eval.watch import EpisodeRecorder, watching

NO_FIXTURES = "no model_file: fixtures at their centres"
OTHER_FILES = "other asset files are missing here than on record"
# Options of ``vecenv.make`` that the demonstrations themselves decide.
_NOT_REPLACED = frozenset({"tasks", "episodes", "max_steps", "gripper"})
_NOT_REPLACED_BECAUSE = "a demonstration decides which episode it is, how long it is, and how its gripper is commanded"


@dataclass(frozen=True, kw_only=True)
class ReplayConfig:
    """How to replay.

    Attributes:
        backend: physics backend; None for the one on record, ``native`` where there is none.
        options: further options of ``vecenv.make``, in place of those on record.
        num_envs: most demonstrations that run at once.
        num_threads: threads of the physics, None for the backend's own choice.
        contacts: ``"published"`` or ``"current"``; None for those on record, published where there are none.
    """

    backend: str | None = None
    contacts: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    num_envs: int = 256
    num_threads: int | None = None

    def __post_init__(self) -> None:
        for name in _NOT_REPLACED & self.options.keys():
            raise ReplayError(f"option {name}={self.options[name]!r}: {_NOT_REPLACED_BECAUSE}")

    @property
    def replacing(self) -> dict[str, Any]:
        """The options that hold in place of those on record.

        Raises:
            OptionError: see ``check_suite``.
        """
        own = {name: getattr(self, name) for name in ("backend", "contacts", "num_threads")}
        return {**self.options, **{name: value for name, value in own.items() if value is not None}}

    def check_suite(self, suite: str) -> None:
        """Refuse options that demonstrations of a suite cannot be replayed with.

        Raises:
            OptionError: the suite does not have the option, or not this value; other ``VecenvError`` likewise.
        """
        vecenv.make_config(suite, self.replacing)


def replay(
    demos: Sequence[Demo],
    config: ReplayConfig | None = None,
    *,
    on_batch: Callable[[str], None] = lambda text: None,
    recorders: Sequence[EpisodeRecorder] = (),
) -> ReplayReport:
    """Execute demonstrations again, in as few batches as their starts allow.

    Args:
        demos: what to replay.
        config: how.
        on_batch: called with one line about each batch, before it runs.
        recorders: see the demonstrations as episodes that run; whoever made them closes them.

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
            outcomes.update(zip(batch, _replay_batch(chosen, config, recorders), strict=True))
        except AssetsMissing:
            raise
        except (ValueError, KeyError, IndexError, TypeError, RuntimeError) as error:
            reason = f"cannot be replayed: {type(error).__name__}: {' '.join(str(error).split())}"
            problems += [Unreadable(path=demo.path, name=demo.name, reason=reason) for demo in chosen]
    return ReplayReport(outcomes=tuple(outcomes[i] for i in sorted(outcomes)), problems=tuple(problems))


def place(demo: Demo, config: ReplayConfig | None = None) -> BatchEnv:
    """An environment with one slot, in which a demonstration begins; for a look at its recorded states.

    Raises:
        VecenvError, ValueError: the simulator refuses to place it.
    """
    return _make([demo], config or ReplayConfig())


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


def _make(demos: Sequence[Demo], config: ReplayConfig) -> BatchEnv:
    """The environment with one slot a demonstration, reset and in the start states."""
    stored = [demo.start for demo in demos if isinstance(demo.start, StoredStart)]
    made = [demo.start for demo in demos if isinstance(demo.start, MadeStart)]  # one list is empty: see _start_key
    options = _stored_options(stored) if stored else dict(made[0].options)
    episodes: dict[int, list[int]] = {}
    for demo in demos:
        episodes.setdefault(demo.task, []).append(demo.start.episode if isinstance(demo.start, MadeStart) else 0)
    options |= {**config.replacing, "max_steps": max(map(len, demos))}
    env = vecenv.make(demos[0].suite, tasks=list(episodes), episodes=episodes, **options)
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


def _load(env: BatchEnv, starts: Sequence[StoredStart]) -> None:
    """Put each slot into its stored state; the controller keeps its memory of the reset, as upstream's does."""
    state = env.state()
    qpos, qvel, time = state.qpos.copy(), state.qvel.copy(), state.time.copy()
    for slot, start in enumerate(starts):
        nq, nv = state.nq[slot], state.nv[slot]
        time[slot], qpos[slot, :nq], qvel[slot, :nv] = start.state[0], start.state[1 : 1 + nq], start.state[1 + nq :]
    env.set_state(replace(state, qpos=qpos, qvel=qvel, time=time))


# -- stepping ----------------------------------------------------------------------------------------------------------


def _replay_batch(demos: Sequence[Demo], config: ReplayConfig, recorders: Sequence[EpisodeRecorder]) -> list[Outcome]:
    env = _make(demos, config)
    try:
        for recorder in recorders:
            recorder.begin(env, {slot: demo.key for slot, demo in enumerate(demos)})
        with watching(env, recorders):
            return _step_through(env, demos, recorders)
    finally:
        env.close()


def _step_through(env: BatchEnv, demos: Sequence[Demo], recorders: Sequence[EpisodeRecorder]) -> list[Outcome]:
    """Step until every demonstration has been judged; a slot that was judged does not move any more."""
    lengths = np.array([len(demo) for demo in demos])
    outcomes: list[Outcome | None] = [None] * len(demos)
    nq = env.state().nq
    before: dict[int, np.ndarray] = {}  # states before the last action, what LIBERO's files record last
    for tick in range(int(lengths.max())):
        waiting = np.array([outcome is None for outcome in outcomes])
        if not waiting.any():
            break
        before |= _states(env, waiting & (lengths == tick + 1))
        _begin_second_halves(env, demos, tick)
        control = env.step_continuous(_actions(demos, tick))
        judged = waiting & (control.done | (lengths == tick + 1))
        for slot, after in _states(env, judged).items():
            outcomes[slot] = _outcome(demos[slot], control, slot, nq[slot], before.pop(slot, None), after)
        if judged.any():
            records = {slot: _record(env, demos[slot], control, slot) for slot in np.flatnonzero(judged).tolist()}
            for recorder in recorders:
                recorder.finish(env, records)
            env.end_episodes(judged)
    return [outcome for outcome in outcomes if outcome is not None]


def _begin_second_halves(env: BatchEnv, demos: Sequence[Demo], tick: int) -> None:
    """Begin the second half of a SIMPLER task at the tick at which it began on record."""
    begins = [demo.second_half is not None and tick < len(demo) and bool(demo.second_half[tick]) for demo in demos]
    begun = second_halves(env) if any(begins) else None
    if begun is not None and (begins & ~begun).any():
        from vecenv.simpler.env import SimplerEnv

        assert isinstance(env, SimplerEnv)  # only its tasks have halves
        env.advance_subtask(begins & ~begun)


def _states(env: BatchEnv, chosen: np.ndarray) -> dict[int, np.ndarray]:
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
    """The outcome of a slot that has just been judged, with its states before and after its last action."""
    ticks = int(control.step_index[slot])
    notes = [NO_FIXTURES] if isinstance(demo.start, StoredStart) and demo.start.fixtures is None else []
    missing = control.info["stand_ins"][slot] if "stand_ins" in control.info else ()
    if demo.stand_ins is not None and set(demo.stand_ins) != set(missing):
        notes.append(OTHER_FILES)
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


def _record(env: BatchEnv, demo: Demo, control: Control, slot: int) -> Record:
    """How the demonstration in a slot went, for recorders."""
    metrics = env.evaluate()
    return Record(
        suite=demo.suite,
        task=demo.task,
        episode=demo.number,
        instruction=env.instructions()[slot],
        success=bool(control.success[slot]),
        success_first=bool(metrics.success_first[slot]),
        success_final=bool(metrics.success_final[slot]),
        num_steps=int(control.step_index[slot]),
        reward=float(metrics.cumulative_reward[slot]),
        fault=control.info["fault"][slot],
        parts=dict(control.info["parts"][slot]) if "parts" in control.info else {},
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
