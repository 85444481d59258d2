"""Episodes in jobs of a scheduler: every job runs a shard, this process merges their folders.

The jobs are submitted with submitit, to Slurm or as processes of this machine. Each writes ``DIR/shards/I-of-N``, an
ordinary results folder; while they run, this process merges what there is into ``DIR`` (``vecenv_eval.merge``). Jobs
and this process need the folder in common. When the process is ended and the command is repeated, finished shards are
not submitted again, and shards that a job is still writing are waited for.
"""

from __future__ import annotations

import re
import sys
import time
import uuid
import warnings
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import submitit
from submitit.core.utils import FailedJobError

from vecenv.util.names import unknown
from vecenv_eval.config import NO_TRACKER, ConfigError, EvalConfig, from_values
from vecenv_eval.engine import EngineError, Outcome
from vecenv_eval.engines.ray_options import needs_gpu
from vecenv_eval.engines.shard_job import ShardJob, ShardOutcome
from vecenv_eval.episodes import Episode
from vecenv_eval.merge import merge
from vecenv_eval.results import Progress, count
from vecenv_eval.runner import Evaluation, chosen_episodes
from vecenv_eval.store import CONFIG, ResultStore, StoreError

SHARDS, JOBS = "shards", "jobs"
EXECUTORS = ("auto", "slurm", "local", "debug")
# Seconds between two questions to the scheduler; submitit's own are 10 minutes apart.
_ASK_S = 30.0
# Seconds that jobs have to stop after Ctrl-C.
_STOP_S = 30.0
# Parameters with which a job would run its shard several times.
_ONE_TASK = ("nodes", "tasks_per_node", "ntasks_per_node")
# submitit's own limit is 5 minutes.
_TIMEOUT_MIN = 24 * 60


@dataclass(frozen=True, kw_only=True)
class SubmititOptions:
    """Arguments of the engine that are not the executor's.

    Attributes:
        shards: how many jobs share the episodes; may be left out where a folder is continued.
        executor: ``"slurm"``, ``"local"`` (processes of this machine), ``"debug"`` (this process, with a debugger), or
            ``"auto"``: Slurm where there is one, else local.
        attempts: how often a shard is submitted whose job died, the first time included.
        poll_s: seconds between two looks at the jobs, each with a merge.
    """

    shards: int | None = None
    executor: str = "auto"
    attempts: int = 3
    poll_s: float = 5.0

    def __post_init__(self) -> None:
        for name in ("shards", "attempts"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"engine argument {name} must be at least 1, not {value}")
        if self.poll_s <= 0:
            raise ConfigError(f"engine argument poll_s must be above 0, not {self.poll_s}")
        if self.executor not in EXECUTORS:
            raise ConfigError(f"engine argument executor={self.executor!r}: expected one of {', '.join(EXECUTORS)}")


class SubmititEngine:
    """Runs shards in jobs; the arguments are the fields of :class:`SubmititOptions`, and parameters of the executor.

    Args:
        config: what is evaluated, with the engine's arguments.

    Raises:
        ConfigError: an argument does not exist or does not fit.
    """

    in_process: ClassVar[bool] = False

    def __init__(self, config: EvalConfig) -> None:
        own = SubmititOptions.__dataclass_fields__
        given = {name: value for name, value in config.engine_args.items() if name in own}
        self._options = from_values(SubmititOptions, given, "argument of engine 'submitit'")
        if config.shard is not None:
            raise ConfigError("engine 'submitit' makes the shards itself: leave out --shard")
        self._parameters = _parameters(
            config, {name: value for name, value in config.engine_args.items() if name not in own}
        )

    @classmethod
    def shared(cls) -> AbstractContextManager[None]:
        """Nothing is shared."""
        return nullcontext()

    def run(
        self, evaluation: Evaluation, store: ResultStore, index: int, on_progress: Callable[[Progress], None]
    ) -> Outcome:
        """Run what has no verdict; see :class:`vecenv_eval.engine.Engine`."""
        if set(evaluation.planned) <= store.done():
            return Outcome(interrupted=False, causes=())
        folder = store.folder.resolve()
        shards = self._shards(evaluation, folder)
        store.close()
        executor = self._executor(folder / SHARDS / JOBS)
        return _Driver(evaluation, shards, executor, self._options, folder, on_progress).run()

    def _shards(self, evaluation: Evaluation, folder: Path) -> list[Shard]:
        """The shards, as many as there were before.

        Raises:
            ConfigError: no number is given, or not that of the folder.
        """
        there = _numbers_of(folder / SHARDS)
        wanted = self._options.shards
        if wanted is None and not there:
            raise ConfigError("engine 'submitit' needs the number of jobs: --engine-arg shards=4")
        number = min(wanted or max(there), len(evaluation.planned))
        if there - {number}:
            raise ConfigError(
                f"{folder / SHARDS} holds {max(there)} shards, not {number}: leave out --engine-arg shards"
            )
        made = [_shard(evaluation, folder, part, number) for part in range(1, number + 1)]
        strangers = ResultStore(folder).done() - {key for shard in made for key in shard.done}
        if strangers & set(evaluation.planned):
            raise ConfigError(
                f"{folder} holds {len(strangers)} verdicts that are in none of its shards, so another engine began it: "
                "continue it with --engine local or ray"
            )
        return made

    def _executor(self, logs: Path) -> submitit.AutoExecutor:
        """The executor, with its parameters.

        Raises:
            ConfigError: it does not take a parameter.
            EngineError: it is not available here.
        """
        cluster = None if self._options.executor == "auto" else self._options.executor
        # submitit unpickles what it finds under the names of its jobs: only what this run puts there is read.
        own = logs / uuid.uuid4().hex
        own.mkdir(parents=True)
        try:
            executor = submitit.AutoExecutor(folder=own, cluster=cluster)
        except (RuntimeError, ValueError, OSError) as error:
            raise EngineError(f"no executor {self._options.executor!r} here: {' '.join(str(error).split())}") from error
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                executor.update_parameters(**self._parameters)
        except (NameError, AssertionError, TypeError, ValueError) as error:
            raise ConfigError(f"engine 'submitit': {' '.join(str(error).split())}") from error
        return executor


class Shard:
    """A part of the episodes, and the job that runs it.

    Attributes:
        number: which part, from 1.
        folder: its results folder.
        planned: its episodes.
        task: what its job does.
        job: submitit's job while one runs, else None.
        submitted: how often one was submitted.
        given_up: its jobs died too often, or one said that it cannot run.
    """

    def __init__(self, number: int, folder: Path, planned: Collection[Episode], task: ShardJob) -> None:
        self.number, self.folder, self.planned, self.task = number, folder, frozenset(planned), task
        self.job: Any = None
        self.submitted = 0
        self.finished = self.given_up = False

    @property
    def there(self) -> bool:
        """A job has begun it."""
        return (self.folder / CONFIG).is_file()

    @property
    def done(self) -> frozenset[Episode]:
        """Its episodes that have a verdict."""
        return ResultStore(self.folder).done() & self.planned if self.there else frozenset()

    @property
    def in_use(self) -> bool:
        """Some job writes its folder, one of an earlier run on it for example."""
        if not self.folder.is_dir():
            return False
        try:
            with ResultStore(self.folder).writing():
                return False
        except StoreError:
            return True


class _Driver:
    """Submits jobs, merges what they write, and submits again what died.

    Args:
        evaluation: what is evaluated.
        shards: its parts.
        executor: submits jobs.
        options: the engine's arguments.
        folder: the results folder that the shards are merged into.
        on_progress: called after every look at the jobs.
    """

    def __init__(
        self,
        evaluation: Evaluation,
        shards: list[Shard],
        executor: submitit.AutoExecutor,
        options: SubmititOptions,
        folder: Path,
        on_progress: Callable[[Progress], None],
    ) -> None:
        self._evaluation, self._shards, self._executor, self._options = evaluation, shards, executor, options
        self._folder, self._on_progress = folder, on_progress
        self._causes: dict[str, None] = {}
        self._refused = self._unsubmitted = ""
        self._began = self._asked = time.monotonic()
        self._seen = ResultStore(folder).records()
        self._before = sum(record.num_steps for record in self._seen.values())
        self._merged, self._reports = -1, 0

    def run(self) -> Outcome:
        """Run all shards.

        Raises:
            ConfigError: the jobs say that they cannot run.
            EngineError: no job can be submitted.
            StoreError: the shards cannot be merged.
        """
        interrupted = False
        for shard in self._shards:
            shard.finished = shard.done == shard.planned
        try:
            while self._waiting:
                self._submit()
                self._look()
                self._merge()
                if self._waiting:
                    time.sleep(self._options.poll_s)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            self._stop()
        self._merge()
        if not any(shard.there for shard in self._shards):
            if self._refused:
                raise ConfigError(self._refused)
            if self._unsubmitted:
                raise EngineError(self._unsubmitted)
        return Outcome(interrupted=interrupted, causes=tuple(self._causes))

    @property
    def _waiting(self) -> list[Shard]:
        return [shard for shard in self._shards if not (shard.finished or shard.given_up)]

    def _submit(self) -> None:
        ready = [shard for shard in self._waiting if shard.job is None and not shard.in_use]
        if not ready:
            return
        try:
            with self._executor.batch():  # an array of jobs
                jobs = [self._executor.submit(shard.task) for shard in ready]
        except (FailedJobError, OSError) as error:
            self._unsubmitted = f"jobs cannot be submitted: {' '.join(str(error).split())}"
            jobs = [None] * len(ready)
        for shard, job in zip(ready, jobs, strict=True):
            shard.job = job
            shard.submitted += 1
            if job is None and shard.submitted >= self._options.attempts:
                shard.given_up = True
                self._causes[f"shard {shard.number}: {self._unsubmitted}"] = None

    def _look(self) -> None:
        """See which jobs have ended, and how; a job that leaves no result is seen when the scheduler is asked."""
        ask = time.monotonic() - self._asked >= _ASK_S
        for shard in [shard for shard in self._waiting if shard.job is not None]:
            if shard.job.done(force_check=ask):
                job, shard.job = shard.job, None
                self._end(shard, job)
            if ask:  # which tells the state of all jobs
                ask, self._asked = False, time.monotonic()

    def _end(self, shard: Shard, job: Any) -> None:
        outcome = _outcome_of(job)
        self._causes.update(dict.fromkeys(outcome.causes))
        cause = outcome.refused or outcome.failed or ("it was stopped by a signal" if outcome.interrupted else "")
        if not cause or shard.done == shard.planned:
            shard.finished = True
        elif shard.in_use:  # a job of an earlier run has it
            shard.submitted -= 1
        else:
            self._refused = self._refused or outcome.refused
            shard.given_up = bool(outcome.refused) or shard.submitted >= self._options.attempts
            line = f"shard {shard.number}, job {job.job_id}: {cause}"
            if shard.given_up:
                self._causes[line] = None
            ResultStore(self._folder).log_error(f"{line}\n{outcome.traceback}")

    def _merge(self) -> None:
        """Bring the results folder up to date, and say how it stands."""
        there = [shard for shard in self._shards if shard.there]
        rows = sum(len(ResultStore(shard.folder).records()) for shard in there)
        if there and rows != self._merged:
            merge(self._folder, [shard.folder for shard in there], simulator=self._evaluation.simulator)
            self._merged = rows
        self._report()

    def _report(self) -> None:
        store = ResultStore(self._folder)
        records = store.records()
        ended = tuple(record for key, record in records.items() if self._seen.get(key) != record)
        self._seen = records
        self._on_progress(
            Progress(
                total=len(self._evaluation.planned),
                **count(records.values()),
                steps=sum(record.num_steps for record in records.values()) - self._before,
                seconds=time.monotonic() - self._began,
                batch=sum(shard.finished for shard in self._shards),
                num_batches=len(self._shards),
                setting_up=self._reports == 0,
                ended=ended,
                conditions=store.config().get("conditions", {}),
            )
        )
        self._reports += 1

    def _stop(self) -> None:
        """Cancel the jobs that are left, and wait until they have written what they have."""
        jobs = [shard.job for shard in self._shards if shard.job is not None]
        for job in jobs:
            job.cancel(check=False)
        until = time.monotonic() + _STOP_S
        while any(shard.in_use for shard in self._shards if shard.job) and time.monotonic() < until:
            time.sleep(0.2)


def _shard(evaluation: Evaluation, folder: Path, part: int, parts: int) -> Shard:
    config = replace(evaluation.config, shard=f"{part}/{parts}", engine="local", engine_args={}, track=NO_TRACKER)
    tasks, episodes = chosen_episodes(config, evaluation.suite)
    planned = [Episode(evaluation.suite.name, task, each) for task in tasks for each in episodes[task]]
    place = folder / SHARDS / f"{part}-of-{parts}"
    return Shard(part, place, planned, ShardJob(config, place, evaluation.simulator, sys.path))


def _numbers_of(folder: Path) -> set[int]:
    """Of how many shards the results folders in a folder are parts; {} without any."""
    found = [re.fullmatch(r"\d+-of-(\d+)", path.name) for path in folder.iterdir()] if folder.is_dir() else []
    return {int(match[1]) for match in found if match}


def _parameters(config: EvalConfig, given: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of submitit's executor: Slurm's own may be given without their prefix.

    Raises:
        ConfigError: it has no such parameter.
    """
    shared = submitit.AutoExecutor._valid_parameters()
    slurm = submitit.SlurmExecutor._valid_parameters()
    parameters: dict[str, Any] = {"timeout_min": _TIMEOUT_MIN, "name": "vecenv"}
    if config.num_threads is not None:
        parameters["cpus_per_task"] = config.num_threads
    if needs_gpu(config):
        parameters["gpus_per_node"] = 1
    for name, value in given.items():
        plain = name.removeprefix("slurm_")
        if plain in _ONE_TASK and value != 1:
            raise ConfigError(f"engine argument {name}={value}: a shard is one task on one node; give more shards")
        if name in shared:
            parameters[name] = value
        elif plain in slurm or plain in shared:
            parameters[f"slurm_{plain}"] = value
        elif name.startswith("local_"):
            parameters[name] = value
        else:
            known = [*SubmititOptions.__dataclass_fields__, *shared, *slurm]
            raise ConfigError(unknown("argument of engine 'submitit'", name, known))
    return parameters


def _outcome_of(job: Any) -> ShardOutcome:
    """What a job returned, or that it died."""
    try:
        return job.result()
    except Exception as error:  # whatever submitit raises says that there is no result
        return ShardOutcome(failed="it ended without a result", traceback=str(error))
