"""Episodes on actors of a Ray cluster, or of a Ray instance that is started on this machine.

Each actor keeps a policy and an environment (``vecenv_eval.engines.ray_actor``). This process, the driver, gives them
units of a scene's episodes (``vecenv_eval.engines.work``) and is the only one that writes the results folder: a record
is appended as soon as it arrives. Nothing is kept in Ray, so a driver that was killed is resumed like any other run.
Episodes whose actor was lost run again; if both attempts reported a verdict, the first one stays.

Runs within ``RayEngine.shared()`` keep the Ray instance and the actors: a process that has loaded JAX and its kernels
begins the next suite in seconds.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import replace
from typing import Any, ClassVar

import ray
from ray.exceptions import RayError, RayTaskError

import vecenv
from vecenv.util.cores import usable_cores
from vecenv_eval.config import ConfigError, EvalConfig, from_values
from vecenv_eval.engine import EngineError, Outcome
from vecenv_eval.engines.crew import Crew, Seat
from vecenv_eval.engines.ledger import Ledger
from vecenv_eval.engines.ray_actor import ActorInfo, Assignment, Report
from vecenv_eval.engines.ray_options import RayOptions, on_cpu, resources, room
from vecenv_eval.engines.work import WorkQueue
from vecenv_eval.episodes import Episode
from vecenv_eval.results import Progress
from vecenv_eval.runner import Evaluation
from vecenv_eval.store import ResultStore

# Seconds after which a driver looks around although nothing has arrived.
_LOOK_S = 1.0
# Seconds in which a cluster has to answer.
_CONNECT_S = 10.0
# Seconds for reports that are on their way when a run is interrupted.
_LAST_REPORTS_S = 2.0


class _Kept:
    """What runs share: a connection to Ray, and the actors of the last run.

    Args:
        stack: closes the connection.
    """

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._options: RayOptions | None = None
        self._crew: Crew | None = None

    def connect(self, options: RayOptions, wanted: dict[str, float]) -> None:
        """Be connected as the options say."""
        if self._options is not None and (self._options.address, self._options.runtime_env) == (
            options.address,
            options.runtime_env,
        ):
            return
        self.close()
        self._stack.close()
        self._stack.enter_context(_connected(options, wanted))
        self._options = options

    def crew(self, size: int, assignment: Assignment, wanted: dict[str, float]) -> Crew:
        """Actors for a run: those of the last one, if they take the same resources."""
        crew, self._crew = self._crew, None
        if crew is not None and crew.resources == wanted:
            crew.assign(size, assignment)
            return crew
        if crew is not None:
            crew.close()
        return Crew(size, assignment, wanted)

    def keep(self, crew: Crew) -> None:
        """Leave the actors of a run that went to its end to the next one."""
        self._crew = crew

    def close(self) -> None:
        """End the actors."""
        if self._crew is not None:
            self._crew.close()
        self._crew = None


_KEPT: ContextVar[_Kept | None] = ContextVar("vecenv_ray_kept", default=None)


class RayEngine:
    """Runs episodes on Ray actors; the arguments are the fields of :class:`RayOptions`.

    Args:
        config: what is evaluated, with the engine's arguments.

    Raises:
        ConfigError: an argument does not exist or does not fit.
    """

    in_process: ClassVar[bool] = False

    def __init__(self, config: EvalConfig) -> None:
        self._options = from_values(RayOptions, config.engine_args, "argument of engine 'ray'")
        if config.record_lerobot:
            raise ConfigError(
                "engine 'ray' cannot write a LeRobot dataset, which has one writer: leave out --record-lerobot"
            )

    def run(
        self, evaluation: Evaluation, store: ResultStore, index: int, on_progress: Callable[[Progress], None]
    ) -> Outcome:
        """Run what has no verdict; see :class:`vecenv_eval.engine.Engine`."""
        ledger = Ledger(store, evaluation)
        if not ledger.missing:
            return Outcome(interrupted=False, causes=())
        interrupted = False
        driver = _Driver(evaluation, ledger, self._options, on_progress)
        try:
            with ExitStack() as stack:
                kept = _KEPT.get()
                if kept is None:
                    kept = _Kept(stack.enter_context(ExitStack()))
                    stack.callback(kept.close)
                self._drive(kept, driver, evaluation, index, len(ledger.missing))
        except KeyboardInterrupt:
            interrupted = True
        return Outcome(interrupted=interrupted, causes=tuple(ledger.causes))

    @classmethod
    @contextmanager
    def shared(cls) -> Iterator[None]:
        """Within it, runs keep the Ray instance and the actors of the one before."""
        with ExitStack() as stack:
            kept = _Kept(stack.enter_context(ExitStack()))
            stack.callback(kept.close)
            token = _KEPT.set(kept)
            stack.callback(_KEPT.reset, token)
            yield

    def _drive(self, kept: _Kept, driver: _Driver, evaluation: Evaluation, index: int, missing: int) -> None:
        wanted = resources(self._options, evaluation.config)
        kept.connect(self._options, wanted)
        crew = kept.crew(self._size(wanted, missing), _assignment(evaluation, wanted, index), wanted)
        try:
            driver.run(crew, index)
        except BaseException:
            crew.close()
            raise
        kept.keep(crew)

    def _size(self, wanted: dict[str, float], episodes: int) -> int:
        """How many actors to start.

        Raises:
            ConfigError: the cluster has no room for one.
        """
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        most = room(wanted, nodes)
        if not most and self._options.actors is None:
            raise ConfigError(
                f"no node of the Ray cluster has {wanted['CPU']:g} CPUs and {wanted['GPU']:g} GPUs, which an actor "
                "takes: give --engine-arg cpus=, gpus=, or actors= to wait for such a node"
            )
        return min(self._options.actors or most, episodes)


class _Driver:
    """Hands out episodes and writes down what comes back.

    Args:
        evaluation: what is evaluated.
        ledger: keeps the results folder.
        options: the engine's arguments.
        on_progress: called as reports arrive.
    """

    def __init__(
        self, evaluation: Evaluation, ledger: Ledger, options: RayOptions, on_progress: Callable[[Progress], None]
    ) -> None:
        self._evaluation, self._ledger, self._options = evaluation, ledger, options
        self._on_progress = on_progress
        self._lost: Counter[Episode] = Counter()
        self._units = self._finished = self._reports = 0
        self._alive, self._began = time.monotonic(), 0.0

    def run(self, crew: Crew, index: int) -> None:
        """Run everything that is missing; episodes that end in an error run again as often as the config says.

        Raises:
            ConfigError: the environment refuses a setting.
            EngineError: no actor can start, and no episode of this run has a verdict.
        """
        self._crew, self._index = crew, index
        try:
            wanted: Collection[Episode] = self._ledger.missing
            for _ in range(1 + self._evaluation.config.retries):
                if not self._run_all(wanted):
                    break
                wanted = [each for each in self._ledger.missing if self._lost[each] < self._options.attempts]
                if not wanted:
                    break
        except KeyboardInterrupt:
            self._take_last_reports()
            raise
        except EngineError as error:
            if not self._ledger.verdicts:
                raise
            self._ledger.note(str(error))  # what there is makes a result

    def _run_all(self, episodes: Collection[Episode]) -> bool:
        """Run episodes until each has a record; False when to stop for good."""
        self._queue = WorkQueue(
            self._evaluation.suite,
            episodes,
            workers=len(self._crew.active),
            unit=self._options.unit,
            shrink=on_cpu(self._evaluation.config),
        )
        while len(self._queue) or any(seat.unit for seat in self._crew.seats):
            self._hand_out()
            self._report()
            for seat in self._crew.ready(_LOOK_S):
                self._hear(seat)
            self._check_alive()
            if self._hopeless:
                return False
        self._report()
        return True

    def _hand_out(self) -> None:
        for seat in self._crew.seats:
            if seat.idle and len(self._queue):
                held = [other.scene for other in self._crew.seats if other is not seat and other.unit]
                unit = self._queue.take(seat.scene, held)
                seat.give(self._units, unit, self._queue.scene_of(unit[0]))
                self._units += 1

    def _hear(self, seat: Seat) -> None:
        """Take what Ray has for a seat."""
        try:
            if seat.info is None:
                self._welcome(seat, seat.take_info())
            else:
                self._receive(seat, seat.take_report())
        except StopIteration:
            self._finished += 1
            left, seat.unit, seat.waits_for = seat.unit, {}, None
            self._return(list(left), "the actor did not run it")
        except RayError as error:
            self._lose(seat, error)

    def _welcome(self, seat: Seat, info: ActorInfo) -> None:
        if info.version != vecenv.__version__:
            seat.retire()
            self._ledger.note(f"{info.host} has vecenv {info.version}, this machine {vecenv.__version__}")
            return
        seat.info, seat.waits_for, seat.failed_starts = info, None, 0
        self._began = self._began or time.monotonic()
        self._ledger.note_policy(info.policy)

    def _receive(self, seat: Seat, report: Report) -> None:
        if report.refused:
            raise ConfigError(report.refused)
        self._ledger.receive(report)
        if report.steps is not None:
            seat.steps = report.steps
        for record in report.records:
            seat.unit.pop(record.key, None)

    def _lose(self, seat: Seat, error: RayError) -> None:
        """An actor is gone, or could not be made: what it had not finished runs elsewhere."""
        cause = getattr(error, "cause", error)
        line = f"{type(cause).__name__}: {cause}".strip().splitlines()[0]
        left, starting = list(seat.unit), seat.info is None
        host = f" on {seat.info.host}" if seat.info else ""
        self._ledger.log_error(f"run {self._index}: an actor{host} was lost with {len(left)} episodes\n{error}")
        raised = isinstance(error, RayTaskError)
        seat.failed_starts += starting
        if starting and (raised or seat.failed_starts >= self._options.attempts):
            self._ledger.note(f"an actor could not start: {line}")
            seat.retire()
        else:
            self._crew.replace(seat)
        self._return(left, f"the actor{host} was lost: {line}")

    def _return(self, episodes: Sequence[Episode], cause: str) -> None:
        """Episodes of a unit that have no record: they wait again, alone before the last attempt, or have failed."""
        again = []
        for episode in episodes:
            self._lost[episode] += 1
            left = self._options.attempts - self._lost[episode]
            if left <= 0:
                self._ledger.fail(episode, f"{cause} ({self._lost[episode]} attempts)", self._index, self._units)
            elif left == 1:
                self._queue.put_alone(episode)
            else:
                again.append(episode)
        self._queue.put_back(again)

    def _check_alive(self) -> None:
        """Raise when no actor is there and none will come."""
        now = time.monotonic()
        if any(seat.info is not None for seat in self._crew.seats):
            self._alive = now
        if not self._crew.active:
            raise EngineError(f"no actor could start: {'; '.join(self._ledger.causes)}")
        if now - self._alive > self._options.start_timeout_s:
            raise EngineError(
                f"no actor was there for {self._options.start_timeout_s:g} s: the Ray cluster has no room for one"
            )

    @property
    def _hopeless(self) -> bool:
        """Whether the config says to stop at an error, or nothing but errors comes back."""
        errors = self._ledger.error_batches
        if self._evaluation.config.fail_fast:
            return errors > 0
        return not self._ledger.verdicts and errors > max(1, len(self._crew.active))

    def _take_last_reports(self) -> None:
        """What has arrived already, after an interrupt."""
        with suppress(RayError, ConfigError):
            until = time.monotonic() + _LAST_REPORTS_S
            while time.monotonic() < until:
                seats = [seat for seat in self._crew.ready(0) if seat.info is not None]
                if not seats:
                    return
                for seat in seats:
                    with suppress(StopIteration):
                        self._receive(seat, seat.take_report())
                        continue
                    seat.waits_for = None

    def _report(self) -> None:
        self._on_progress(
            Progress(
                **self._ledger.counts,
                steps=sum(seat.steps for seat in self._crew.seats),
                seconds=time.monotonic() - self._began if self._began else 0.0,
                batch=self._finished,
                num_batches=self._units + self._queue.units,
                setting_up=self._reports == 0,
                ended=self._ledger.take_ended(),
                conditions=self._ledger.conditions,
            )
        )
        self._reports += 1


def _assignment(evaluation: Evaluation, wanted: dict[str, float], index: int) -> Assignment:
    config = evaluation.config
    if on_cpu(config) and config.num_threads is None:
        config = replace(config, num_threads=int(wanted["CPU"]))
    return Assignment(
        config=config,
        suite=evaluation.suite,
        simulator=evaluation.simulator,
        policy_seed=evaluation.policy_seed,
        index=index,
    )


def _check_address(address: str | None) -> None:
    """Raise at once where nothing answers at an address: Ray itself would try for minutes."""
    host, colon, port = (address or "").rpartition(":")
    if not colon:
        return
    try:
        socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()
    except (OSError, ValueError, OverflowError) as error:
        raise EngineError(f"no Ray cluster at {address}: {error}") from None


def connect(**settings: Any) -> None:
    """``ray.init``, but for the handler of SIGTERM, which it replaces by one that ends the process at once."""
    usual = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(**settings)
    finally:
        if usual is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, usual)


@contextmanager
def _connected(options: RayOptions, wanted: dict[str, float]) -> Iterator[None]:
    """Connected to a cluster, or with an instance of this process's own, which ends with it.

    Raises:
        EngineError: there is no cluster at the address, or no instance can be started.
    """
    if ray.is_initialized():
        if options.address is not None or options.runtime_env is not None:
            raise EngineError("this process is connected to Ray already: leave out address and runtime_env")
        yield
        return
    _check_address(options.address)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "runtime_env": options.runtime_env}
    if options.address is None:
        settings |= {
            "address": "local",
            "num_cpus": int((options.actors or 0) * wanted["CPU"]) or max(usable_cores(), int(wanted["CPU"])),
            "object_store_memory": options.object_store_mb * 10**6,
            "include_dashboard": False,
        }
    try:
        connect(**(settings if options.address is None else {**settings, "address": options.address}))
    except (RayError, ConnectionError, ValueError, RuntimeError, OSError) as error:
        where = "here" if options.address is None else f"at {options.address}"
        raise EngineError(f"no Ray instance {where}: {' '.join(str(error).split())}") from error
    try:
        yield
    finally:
        ray.shutdown()
