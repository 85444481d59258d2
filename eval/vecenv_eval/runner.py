"""Run a policy over a suite, batch by batch, and keep every verdict as soon as it is there.

An :class:`EvalConfig` and an open results folder come in; :class:`Evaluation` places batches, lets the policy act until
every slot has finished, writes each episode when it ends, and returns an :class:`EvalResult`. A batch that raises costs
its own unfinished episodes only: they are written as errors with the cause, and the next batch runs.
"""

from __future__ import annotations

import inspect
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from vecenv import family, protocols
from vecenv.assets import AssetsMissing
from vecenv.cli import unknown
from vecenv.contract import BatchEnv, Control, Metrics, ResetInfo
from vecenv.errors import InvalidInput
from vecenv.placement import episode_indices
from vecenv_eval.conditions import conditions
from vecenv_eval.episodes import ALL, MAX_SLOTS, Batch, Episode, Suite, parse_tasks, plan
from vecenv_eval.policies import Policy, extras_of, make_policy
from vecenv_eval.report import Summary, markdown, summarise
from vecenv_eval.store import CONFIG, Record, ResultStore, StoreError

# Called with which slots have just finished, bool [B], with the verdicts, bool [B], and with the faults, B strings.
_Finish: TypeAlias = Callable[[np.ndarray, np.ndarray, Sequence[str]], None]
_SIMPLER = "simpler"
# Policies that know a benchmark's scenes, each of another.
_SCRIPTED = ("pick_place", "simpler_scripted")
# A slot of SIMPLER is a PhysX scene of its own.
_SIMPLER_SLOTS = 50
# Calls of a policy in a row that may leave every live slot where it was, before it counts as stuck.
MAX_IDLE_CALLS = 100


class ConfigError(InvalidInput):
    """The evaluation was asked for something that does not exist or does not fit together."""


class PolicyStuck(RuntimeError):
    """The policy keeps returning without a step being taken in any live slot."""


@dataclass(frozen=True, kw_only=True)
class EvalConfig:
    """What to evaluate, and how.

    Attributes:
        suite: name of the suite.
        policy: name of the policy, see ``vecenv_eval.policies.make_policy``.
        policy_args: constructor arguments of the policy.
        tasks: ``"all"``, or indices, ranges and names such as ``"0,3,5-7"`` or ``"widowx_stack_cube"``.
        episodes: ``"all"``, those of the protocol; a bare number for that many from the first on; indices and ranges.
        protocol: the evaluation protocol, see ``vecenv.protocols``; what is given besides goes before it.
        backend: physics backend.
        num_envs: most episodes that run at once, None for what suits the suite.
        num_threads: threads of the physics, None for the backend's own choice.
        max_steps: step budget of an episode in control ticks, None for the protocol's.
        seed: seed of the environment, and of the policy if it takes one; None for the protocol's.
        env_args: further keyword arguments of ``vecenv.make``.
        fail_fast: stop at the first batch that raises.
        record: keep what is executed in ``demos/``, for ``vecenv replay``.
        record_states: keep the physics state before every tick too (implies ``record``).
    """

    suite: str
    policy: str = "pick_place"
    policy_args: Mapping[str, Any] = field(default_factory=dict)
    tasks: str = "all"
    episodes: str | Sequence[int] = "all"
    protocol: str = protocols.DEFAULT
    backend: str = "native"
    num_envs: int | None = None
    num_threads: int | None = None
    max_steps: int | None = None
    seed: int | None = None
    env_args: Mapping[str, Any] = field(default_factory=dict)
    fail_fast: bool = False
    record: bool = False
    record_states: bool = False


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Where an evaluation stands; handed to ``on_progress`` after every call of the policy.

    Attributes:
        total: episodes asked for.
        done: episodes with a verdict, those of earlier runs included.
        successes, faults, errors: among the episodes so far.
        steps: control ticks executed in this run, summed over slots.
        seconds: seconds this run has spent running episodes.
        batch, num_batches: which batch is running.
        setting_up: the batch is being placed.
    """

    total: int
    done: int
    successes: int
    faults: int
    errors: int
    steps: int
    seconds: float
    batch: int
    num_batches: int
    setting_up: bool


@dataclass(frozen=True, kw_only=True)
class EvalResult:
    """How an evaluation ended.

    Attributes:
        summary: the numbers, also in ``summary.json``.
        records: the record of each episode that ran.
        folder: the results folder.
        interrupted: it was stopped from the keyboard.
        causes: what the failed batches of this run raised, without repetition.
    """

    summary: Summary
    records: tuple[Record, ...]
    folder: Path
    interrupted: bool
    causes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Every episode has a verdict."""
        return self.summary.complete and not self.interrupted


@dataclass(frozen=True)
class Simulator:
    """The two functions the runner needs from a library of environments.

    Attributes:
        suite: describes a suite under a protocol, both by name, or raises ``ConfigError``.
        make: builds an environment, as ``vecenv.make`` does: ``tasks`` times ``episodes`` slots.
    """

    suite: Callable[[str, str], Suite]
    make: Callable[..., BatchEnv]


def vecenv_simulator() -> Simulator:
    """``vecenv`` itself."""
    import vecenv

    return Simulator(describe_suite, vecenv.make)


def describe_suite(name: str, protocol: str = protocols.DEFAULT) -> Suite:
    """Describe one of ``vecenv``'s suites under a protocol.

    Raises:
        ConfigError: there is no suite or protocol of that name, or they do not go together.
    """
    import vecenv

    suites = tuple(vecenv.list_suites())
    if name not in suites:
        raise ConfigError(unknown("suite", name, suites))
    try:
        per_task = vecenv.eval_metadata(name, protocol)["episodes_per_task"]
    except ValueError as error:
        raise ConfigError(str(error)) from error
    tasks = vecenv.list_tasks(name)
    simpler = vecenv.family(name) == _SIMPLER
    return Suite(
        name=name,
        instructions=tuple(task.instruction for task in tasks),
        # SIMPLER exchanges scenes by itself, so its environments need no new one for other tasks.
        scenes=tuple("" if simpler else task.problem().scene_key() for task in tasks),
        # LIBERO has 50 starts of every task, whatever a protocol runs of them.
        num_episodes=per_task if simpler else max(per_task, vecenv.eval_metadata(name)["episodes_per_task"]),
        every=None if simpler else per_task,
        tasks=tuple(task.name for task in tasks),
        max_slots=_SIMPLER_SLOTS if simpler else MAX_SLOTS,
    )


def begin(config: EvalConfig, folder: Path) -> ResultStore:
    """Open a new results folder for a config.

    Raises:
        StoreError: something is in the way.
    """
    return ResultStore.create(folder, {"config": asdict(config), "runs": []})


def go_on(folder: Path, **changes: Any) -> tuple[EvalConfig, ResultStore]:
    """Open an existing results folder, to run what is missing.

    Args:
        folder: the results folder.
        **changes: fields of ``EvalConfig`` to replace for this run; those that are None are left as they were.

    Raises:
        StoreError: it is not a results folder, or it was written by something else.
    """
    store = ResultStore.open(folder)
    try:
        config = EvalConfig(**store.config()["config"])
    except (KeyError, TypeError) as error:
        raise StoreError(f"{folder / CONFIG} does not hold an evaluation: {error}") from None
    return replace(config, **{key: value for key, value in changes.items() if value is not None}), store


def evaluate(
    config: EvalConfig,
    store: ResultStore,
    *,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    simulator: Simulator | None = None,
) -> EvalResult:
    """Run what the config asks for and the store does not have yet: ``Evaluation(config).run(store)``."""
    return Evaluation(config, simulator).run(store, on_progress)


class Evaluation:
    """A config that makes sense: its suite, its episodes and its policy are there.

    Args:
        config: what to evaluate, and how.
        simulator: where environments come from, ``vecenv`` when not given.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
    """

    def __init__(self, config: EvalConfig, simulator: Simulator | None = None) -> None:
        self.config = config
        self.simulator = simulator or vecenv_simulator()
        self.suite = self.simulator.suite(config.suite, config.protocol)
        self.tasks, self.episodes = _wanted(config, self.suite)
        _check_make(self.simulator, config)
        _check_record(config)
        _check_policy(config)
        self.policy = make_policy(config.policy, seed=_seed(config), **config.policy_args)

    @property
    def planned(self) -> tuple[Episode, ...]:
        """Every episode asked for, task by task."""
        return tuple(Episode(self.suite.name, task, e) for task in self.tasks for e in self.episodes[task])

    def batches(self, done: Collection[Episode] = ()) -> list[Batch]:
        """The batches that run every planned episode but those in ``done``."""
        most = self.suite.max_slots if self.config.num_envs is None else self.config.num_envs
        return plan(self.suite, self.tasks, self.episodes, num_envs=most, done=done)

    def run(self, store: ResultStore, on_progress: Callable[[Progress], None] = lambda progress: None) -> EvalResult:
        """Run what the store does not have yet.

        Ctrl-C ends the run early with what was computed so far; it does not raise.

        Raises:
            ConfigError: the environment refuses a setting; a results folder without episodes is removed.
        """
        content = store.config()
        store.write_config({**content, "runs": [*content["runs"], run_conditions()]})
        run = _Run(self, store, on_progress, index=len(content["runs"]))
        try:
            interrupted = run.run_all()
        except ConfigError:
            store.discard()
            raise
        records = store.records()
        planned = self.planned
        summary = summarise(
            records.values(),
            planned,
            suite=self.suite.name,
            policy=self.policy.name,
            instructions=self.suite.instructions,
            conditions=store.config().get("conditions", {}),
        )
        store.write_summary(summary.to_dict(), markdown(summary))
        return EvalResult(
            summary=summary,
            records=tuple(records[key] for key in planned if key in records),
            folder=store.folder,
            interrupted=interrupted,
            causes=tuple(run.causes),
        )


def run_conditions() -> dict[str, Any]:
    """When, with what and on which machine a run happens."""
    from vecenv import doctor

    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "arguments": sys.argv[1:],
        "commit": git_commit(),
        "versions": doctor.versions(),
        "machine": doctor.machine(),
    }


def git_commit() -> str:
    """Commit of the clone this package runs from, with ``+changes`` when files differ from it; "" outside a clone."""
    here = Path(__file__).parent
    try:
        commit = _git("rev-parse", "HEAD", cwd=here)
        return commit + ("+changes" if _git("status", "--porcelain", "--untracked-files=no", cwd=here) else "")
    except (OSError, subprocess.CalledProcessError):
        return ""


@dataclass(frozen=True)
class _Placed:
    """A batch that sits in an environment: its number, the episode and instruction of each slot, seconds it took."""

    batch: int
    slots: Sequence[Episode]
    instructions: Sequence[str]
    setup_s: float


class _Run:
    """One pass over the batches: the environment in use, and the counts for the progress bar."""

    def __init__(
        self, evaluation: Evaluation, store: ResultStore, on_progress: Callable[[Progress], None], index: int
    ) -> None:
        self.config, self.suite, self.policy = evaluation.config, evaluation.suite, evaluation.policy
        self.store, self.on_progress, self.simulator = store, on_progress, evaluation.simulator
        self.batches = evaluation.batches(store.done())
        self.causes: dict[str, None] = {}
        self._index = index
        planned = frozenset(evaluation.planned)
        self._total = len(planned)
        self._records = {key: r for key, r in store.records().items() if key in planned and not r.error}
        self._counts = _count(self._records.values())
        self._env: BatchEnv | None = None
        self._layout: tuple[Any, ...] = ()
        self._steps, self._seconds = 0, 0.0

    def run_all(self) -> bool:
        """Run every batch; True when stopped from the keyboard."""
        try:
            for number, batch in enumerate(self.batches):
                if not self._survive(number, batch) and self.config.fail_fast:
                    break
        except KeyboardInterrupt:
            return True
        finally:
            self._close()
        return False

    def _survive(self, number: int, batch: Batch) -> bool:
        """Run one batch; an exception is written down for its unfinished episodes, and False is returned."""
        try:
            self._run(number, batch)
        except ConfigError:
            raise
        except Exception as error:  # whatever a policy or a simulator raises concerns this batch only
            self._write_errors(number, batch, error)
            self._close()
            return False
        return True

    def _run(self, number: int, batch: Batch) -> None:
        self._report(number, setting_up=True)
        started = time.perf_counter()
        env, info = self._place(batch)
        placed = _Placed(number, _slots(info, batch), info.instruction, time.perf_counter() - started)
        with self._recording(env, placed) as finish:
            self._drive(env, info, placed, finish)

    def _drive(self, env: BatchEnv, info: ResetInfo, placed: _Placed, finish: _Finish) -> None:
        """Let the policy act until every slot has finished."""
        started, before = time.perf_counter(), (self._steps, self._seconds)
        self.policy.reset(env, info)
        for control, finished in drive(env, self.policy):
            wall_s = time.perf_counter() - started
            if finished.any():
                metrics, slots = env.evaluate(), np.flatnonzero(finished).tolist()
                finish(finished, metrics.success, control.info["fault"])
                self._write([self._verdict(placed, i, metrics, control, wall_s) for i in slots])
            self._steps, self._seconds = before[0] + int(control.step_index.sum()), before[1] + wall_s
            self._report(placed.batch)

    @contextmanager
    def _recording(self, env: BatchEnv, placed: _Placed) -> Iterator[_Finish]:
        """Record the batch when asked to; gives what to call with the slots that finish."""
        if not (self.config.record or self.config.record_states):
            yield lambda finished, success, faults: None
            return
        from vecenv_eval.demos.demos import make_options, write_demos
        from vecenv_eval.demos.record import Recorder

        options = make_options(self.simulator.make, suite=self.suite.name, **_make_arguments(self.config))
        episodes = [slot.episode for slot in placed.slots]
        recorder = Recorder(env, episodes, options, states=self.config.record_states)
        try:
            with recorder.listening():
                yield recorder.finish
        finally:  # also of a batch that raises: what has a verdict is not run again
            recordings = recorder.recordings()
            for key in dict.fromkeys((slot.suite, slot.task) for slot in placed.slots):
                chosen = [r for i, r in recordings.items() if (placed.slots[i].suite, placed.slots[i].task) == key]
                if chosen:
                    write_demos(self.store.demos_path(*key), *key, self.suite.instructions[key[1]], chosen)

    def _verdict(self, placed: _Placed, slot: int, metrics: Metrics, control: Control, wall_s: float) -> Record:
        """The record of a slot that has just finished."""
        episode = placed.slots[slot]
        return Record(
            suite=episode.suite,
            task=episode.task,
            episode=episode.episode,
            instruction=placed.instructions[slot],
            success=bool(metrics.success[slot]),
            success_first=bool(metrics.success_first[slot]),
            success_final=bool(metrics.success_final[slot]),
            num_steps=int(metrics.num_steps[slot]),
            reward=float(metrics.cumulative_reward[slot]),
            fault=control.info["fault"][slot],
            run=self._index,
            batch=placed.batch,
            setup_s=placed.setup_s,
            wall_s=wall_s,
            extras=extras_of(self.policy, slot),
            stand_ins=tuple(control.info["stand_ins"][slot]) if "stand_ins" in control.info else (),
        )

    def _place(self, batch: Batch) -> tuple[BatchEnv, ResetInfo]:
        """Re-place the environment in use when every slot keeps its scene, else build one."""
        layout = tuple(self.suite.scenes[slot.task] for slot in batch.slots)
        if self._env is not None and layout == self._layout:
            self._env.set_episodes(tasks=[s.task for s in batch.slots], episodes=[s.episode for s in batch.slots])
        else:
            self._close()
            self._env, self._layout = self._make(batch), layout
            self.store.write_config({**self.store.config(), "conditions": conditions(self._env, self.config)})
        return self._env, self._env.reset()

    def _make(self, batch: Batch) -> BatchEnv:
        """Build an environment. A value it refuses is the config's fault, and no batch would fare better."""
        arguments = {"tasks": list(batch.tasks), "episodes": list(batch.episodes), **_make_arguments(self.config)}
        try:
            return self.simulator.make(batch.suite, **arguments)
        except AssetsMissing as error:
            raise ConfigError(str(error)) from error
        except (ValueError, KeyError, ImportError) as error:
            # A plain one is an accident; a library that means it raises its own kind.
            if type(error) in (KeyError, ImportError, ModuleNotFoundError):
                raise
            raise ConfigError(f"{type(error).__name__}: {error}") from error

    def _write(self, records: Sequence[Record]) -> None:
        self.store.append(records)
        self._records.update({record.key: record for record in records})
        self._counts = _count(self._records.values())

    def _write_errors(self, number: int, batch: Batch, error: Exception) -> None:
        cause = f"{type(error).__name__}: {error}".splitlines()[0]
        self.causes[cause] = None
        self.store.log_error(f"run {self._index} batch {number} ({len(batch)} episodes)\n{traceback.format_exc()}")
        failed = [
            Record(
                suite=slot.suite,
                task=slot.task,
                episode=slot.episode,
                instruction=self.suite.instructions[slot.task],
                success=False,
                num_steps=0,
                reward=0.0,
                error=cause,
                run=self._index,
                batch=number,
            )
            for slot in batch.slots
            if slot not in self._records
        ]
        self._write(failed)
        self._report(number)

    def _report(self, number: int, setting_up: bool = False) -> None:
        self.on_progress(
            Progress(
                total=self._total,
                **self._counts,
                steps=self._steps,
                seconds=self._seconds,
                batch=number,
                num_batches=len(self.batches),
                setting_up=setting_up,
            )
        )

    def _close(self) -> None:
        env, self._env, self._layout = self._env, None, ()
        if env is not None:
            env.close()


def drive(env: BatchEnv, policy: Policy) -> Iterator[tuple[Control, np.ndarray]]:
    """Let a policy act on a batch that was just reset, until every slot has finished.

    Yields:
        Each control as it comes, and which slots it finished, bool [B].

    Raises:
        PolicyStuck: 100 calls of ``act`` in a row took no step in any live slot.
    """
    done = np.zeros(env.num_envs, bool)
    steps = np.zeros(env.num_envs, int)
    idle = 0
    while not done.all():
        decision = policy.act(env)
        control = decision if isinstance(decision, Control) else env.step_continuous(decision)
        finished = control.done & ~done
        moved = finished.any() or (control.step_index[~done] > steps[~done]).any()
        idle = 0 if moved else idle + 1
        if idle >= MAX_IDLE_CALLS:
            raise PolicyStuck(f"policy {policy.name!r}: {idle} calls of act() in a row took no step in any live slot")
        done, steps = done | finished, control.step_index
        yield control, finished


def _count(records: Iterable[Record]) -> dict[str, int]:
    """The counts of :class:`Progress` among records."""
    records = list(records)
    errors = sum(bool(r.error) for r in records)
    return {
        "done": len(records) - errors,
        "successes": sum(r.success for r in records),
        "faults": sum(bool(r.fault) for r in records),
        "errors": errors,
    }


def _slots(info: ResetInfo, batch: Batch) -> list[Episode]:
    """The episode in each slot, as the environment says; it must be the batch that was asked for."""
    numbers = [int(text.rsplit("/", 1)[1]) for text in info.episode_id]
    slots = [Episode(info.suite, int(task), number) for task, number in zip(info.task_id, numbers, strict=True)]
    if sorted(slots) != sorted(batch.slots):
        raise RuntimeError(f"the environment placed {len(slots)} other episodes than the {len(batch)} asked for")
    return slots


def _make_arguments(config: EvalConfig) -> dict[str, Any]:
    arguments = {"backend": config.backend, "num_threads": config.num_threads, **config.env_args}
    given: dict[str, Any] = {"seed": config.seed, "max_steps": config.max_steps}
    if config.protocol != protocols.DEFAULT:
        given["protocol"] = config.protocol
    return {**arguments, **{name: value for name, value in given.items() if value is not None}}


def _seed(config: EvalConfig) -> int:
    """The seed of the policy: as given, else the environment's under the protocol, 0 where it has none."""
    if config.seed is not None:
        return config.seed
    return protocols.protocol(config.protocol, family(config.suite)).seed or 0


def _wanted(config: EvalConfig, suite: Suite) -> tuple[tuple[int, ...], dict[int, tuple[int, ...]]]:
    """The tasks, and which episodes of each."""
    tasks = parse_tasks(config.tasks, len(suite.instructions), suite.tasks)
    if config.tasks.strip() == ALL:
        tasks = tuple(task for task in tasks if suite.episodes_of(task))
    missing = [task for task in tasks if not suite.episodes_of(task)]
    if missing:
        raise ConfigError(f"protocol {config.protocol!r} has no episodes of task {missing[0]} of {suite.name}")
    return tasks, {task: episode_indices(config.episodes, suite.episodes_of(task), suite.every) for task in tasks}


def _check_make(simulator: Simulator, config: EvalConfig) -> None:
    """Fail before the first batch when ``make`` does not know an argument."""
    try:
        inspect.signature(simulator.make).bind(config.suite, tasks=[], episodes=[], **_make_arguments(config))
    except TypeError as error:
        raise ConfigError(f"environment arguments: {error}") from None


def default_policy(suite: str) -> str:
    """The scripted policy that is made for a suite."""
    return "simpler_scripted" if suite.split("/")[0] == _SIMPLER else "pick_place"


def _check_policy(config: EvalConfig) -> None:
    """The built-in policies that are made for certain suites do not run on others, where they could only fail."""
    if config.policy in _SCRIPTED and config.policy != default_policy(config.suite):
        ours = default_policy(config.suite)
        raise ConfigError(
            f"policy {config.policy!r} is not made for {config.suite}; the scripted one there is {ours!r}"
        )
    if config.policy == "voxposer" and config.suite == "simpler/google_robot":
        raise ConfigError("policy 'voxposer' knows Panda's and WidowX's hands, not the Google Robot's")


def _check_record(config: EvalConfig) -> None:
    """Recordings are LIBERO's HDF5 files: they hold MuJoCo states and begin from LIBERO's init states."""
    if (config.record or config.record_states) and config.suite.split("/")[0] == _SIMPLER:
        raise ConfigError(f"{config.suite} cannot be recorded: recordings are in LIBERO's layout, for LIBERO's suites")


def _git(*arguments: str, cwd: Path) -> str:
    done = subprocess.run(["git", *arguments], cwd=cwd, capture_output=True, text=True, check=True)
    return done.stdout.strip()
