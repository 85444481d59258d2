"""A batch of environments that is driven live: built, played, paused, stepped, reset, and watched.

What runs is what ``vecenv eval`` runs (``vecenv_eval.loop``), on one thread of the session's own, because simulators
and GL contexts belong to the thread that made them. Before every control tick that thread waits until the tick is
allowed, and meanwhile draws the images that were asked for (``frames``). Everybody else calls :class:`Session`'s
methods, from any thread.

Every episode that ends is written to a results folder at once, as ``vecenv eval`` does: one folder a run below ``out``,
from the first tick after the episodes were placed until all have ended or the run is stopped or reset. What had not
ended then has no row.

::

    with Session(EvalConfig(suite="libero_object", tasks="0", episodes="4")) as session:
        session.wait_until("ready")
        session.act("play")
        session.wait_until("finished")
"""

from __future__ import annotations

import logging
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol, Self

import vecenv
from vecenv.contract import BatchEnv
from vecenv.errors import VecenvError
from vecenv_eval.config import SCRIPTED, EvalConfig, default_policy
from vecenv_eval.panel import catalog
from vecenv_eval.panel.batch import LiveBatch
from vecenv_eval.panel.frames import FrameHub
from vecenv_eval.panel.monitor import Monitor
from vecenv_eval.panel.state import (
    Fields,
    History,
    OutOfTurn,
    SessionClosed,
    SessionError,
    SessionState,
    StateName,
    UnknownSlot,
)
from vecenv_eval.policies import raised
from vecenv_eval.results import Progress
from vecenv_eval.runner import check
from vecenv_eval.simulator import Simulator, vecenv_simulator
from voxposer.planned import PlannedMotion

_log = logging.getLogger(__name__)
Action = Literal["play", "pause", "step", "stop", "reset"]
Signal = Literal["episode_reset", "run_start"]
# Seconds that a call waits for the thread of the environment, which may be in the middle of a decision of the policy.
_PATIENCE_S = 3.0
_STEP_PATIENCE_S = 60.0
# Seconds that the thread is given to end when the session is closed.
_CLOSE_S = 30.0
# What can be acted on.
_BUILT: frozenset[StateName] = frozenset({"ready", "playing", "paused", "finished"})


class RunStopped(KeyboardInterrupt):
    """Raised inside the episode loop, on the session's thread, to end a run as Ctrl-C ends one."""


class Observer(Protocol):
    """Sees the environment on its own thread, as the 3-D view does; what it raises is logged and ends nothing."""

    def placed(self, env: BatchEnv) -> None:
        """Episodes stand at their start, perhaps in another environment."""
        ...

    def tick(self, env: BatchEnv) -> None:
        """A tick has happened, or the environment waits; called often, so be quick."""
        ...

    def planned(self, motion: PlannedMotion) -> None:
        """VoxPoser has planned a motion."""
        ...

    def lost(self) -> None:
        """The environment is closed."""
        ...


def check_live(config: EvalConfig, simulator: Simulator | None = None) -> None:
    """Check a config of a session without building anything; raises what :meth:`Session.build` raises."""
    if len(config.suites) != 1 or config.seeds is not None:
        raise SessionError("a session runs one suite with one seed")
    if config.engine != "local":
        raise SessionError("a session runs in this process: leave out the engine")
    check(config, simulator or vecenv_simulator())


class Session:
    """A live session.

    Args:
        config: what is built at once; None builds nothing yet. Later builds take from it what they do not say.
        out: where results folders are made; None keeps no results.
        max_slots: most episodes at once where the config does not say.
        simulator: where environments come from, ``vecenv`` when not given.
        play: play as soon as the first build is ready.

    Attributes:
        frames: images.
    """

    def __init__(
        self,
        config: EvalConfig | None = None,
        *,
        out: Path | None = None,
        max_slots: int = 64,
        simulator: Simulator | None = None,
        play: bool = False,
    ) -> None:
        self._simulator, self._out, self._max_slots = simulator or vecenv_simulator(), out, max_slots
        self._cond = threading.Condition()
        self._name: StateName = "idle"
        self._error: str | None = None
        self._version = 0
        self._speed: float | None = None
        self._next_tick = 0.0
        # What was asked for and the thread has not done yet.
        self._order: EvalConfig | None = config
        self._playing, self._budget = play, 0
        self._stop = self._reset = self._closing = self._ending = False
        self._jobs: list[tuple[Callable[[BatchEnv], Any], Future[Any]]] = []
        self._waiting = self._started = False
        self._base = self._config = config
        self._fields = Fields()
        self._counts = (0, 0, 0, 0)
        self._batch: LiveBatch | None = None
        self._observers: list[Observer] = []
        self._temporary = tempfile.TemporaryDirectory(prefix="vecenv-session-")
        self._monitor = Monitor(self._before_tick, self._after_end, self._shown)
        self.frames = FrameHub(self._monitor, self._notify)
        if config is not None:
            self._select(config)
            self._name = "building"
        self._thread = threading.Thread(target=self._main, name="vecenv-session", daemon=True)
        self._thread.start()

    # -- for callers, on any thread ------------------------------------------------------------------------------------

    @property
    def base(self) -> EvalConfig | None:
        """What the session was made with, from which later builds take what they do not say."""
        return self._base

    @property
    def version(self) -> tuple[int, int]:
        """Changes whenever :meth:`state` or an image would."""
        return self._version, self._monitor.revision

    def state(self, slot: int = 0) -> SessionState:
        """The session as it is now; ``planning`` is of ``slot``."""
        with self._cond:
            building = self._name == "building"
            batch, config = None if building else self._batch, self._config
            slots = () if building else self._monitor.slots()
            planned, finished, successes, errors = self._counts
            return SessionState(
                state=self._name,
                suite=None if config is None else config.suite,
                task=slots[0].task if slots else self._fields.task,
                episode=slots[0].episode if slots else self._fields.episode,
                num_slots=len(slots),
                slots=slots,
                policy=None if config is None else batch.policy_name if batch else config.policy_name,
                tick=self._monitor.tick,
                ticks_per_second=self._speed,
                step_budget=max((each.max_steps for each in slots), default=0),
                planned=planned,
                finished=finished,
                successes=successes,
                errors=errors,
                error=self._error,
                fields=self._fields,
                planning=batch.plans.of(slot, self._monitor.instruction(slot)) if batch and slots else None,
                cameras=self.frames.cameras,
                image_size=self.frames.image_size,
                preparing_images=self.frames.preparing,
                results=batch.results if batch else None,
                revision=sum(self.version),
            )

    def history(self, slot: int = 0) -> History:
        """The columns of the episode that a slot runs, or ran last.

        Raises:
            UnknownSlot: there is no such slot.
        """
        found = self._monitor.history(slot)
        if found is None:
            raise UnknownSlot(f"there is no slot {slot} in this session")
        return found

    def build(self, config: EvalConfig) -> None:
        """Build a batch and a policy; what runs is stopped. Returns once the config was checked.

        Raises:
            ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
            SessionError: it is not one suite with one seed in this process.
            SessionClosed: the session was closed.
        """
        check_live(config, self._simulator)
        with self._cond:
            self._check_open()
            self._order, self._playing, self._budget = config, False, 0
            self._config, self._counts = config, (0, 0, 0, 0)
            self._select(config)
            self._set("building", None)

    def set_field(self, name: str, value: int | str) -> Fields:
        """Choose a suite, a task or an episode: it is placed in one slot, and what is below it in the cascade is 0.

        Args:
            name: ``"suite"`` or ``"split"``; ``"task"`` or ``"task_id"``; ``"episode"`` or ``"episode_index"``.
            value: a suite's name; a task's index or name; an episode's number.

        Raises:
            SessionError: there is no such field, suite, task or episode, or no suite was chosen yet.
        """
        fields = self._chosen({"split": "suite", "task_id": "task", "episode_index": "episode"}.get(name, name), value)
        assert fields.suite is not None
        assert fields.task is not None
        index = catalog.task_index(fields.suite, fields.task)
        self.build(self.config_of(fields.suite, tasks=str(index), episodes=f"{fields.episode}-{fields.episode}"))
        return fields

    def config_of(self, suite: str, **changes: Any) -> EvalConfig:
        """A config for a suite: what the session was made with or runs now, with changes.

        What is made for one family of suites (policy, options of images and of the environment) is dropped for another.

        Raises:
            ConfigError: a value cannot be used.
        """
        catalog.check_suite(suite)
        before = self._config or self._base
        if before is None:
            return EvalConfig.from_dict({"suite": suite, **changes})
        values = {**before.to_dict(), "suite": suite, "num_envs": None}
        if vecenv.family(suite) != vecenv.family(before.suites[0]):
            for name in ("image_size", "lod", "colors", "max_steps", "seed", "cameras"):
                values[name] = None
            values["env_args"] = {}
            if before.policy_name in SCRIPTED.values():
                values |= {"policy": default_policy(suite), "policy_args": {}}
        return EvalConfig.from_dict({**values, **changes})

    def act(self, action: Action, ticks: int = 1) -> Signal | None:
        """Play, pause, step, stop or reset.

        All but ``play`` return when they have taken effect, which they cannot while the policy decides, or after a few
        seconds; ``step`` after a minute.

        Args:
            action: what to do.
            ticks: control ticks of a step.

        Returns:
            ``"run_start"`` if a run began, ``"episode_reset"`` if the episodes were put back to their start.

        Raises:
            OutOfTurn: nothing is built.
            SessionClosed: the session was closed.
        """
        with self._cond:
            self._check_open()
            if self._name not in _BUILT:
                why = {"building": "it is being built", "error": f"it failed: {self._error}"}.get(self._name)
                raise OutOfTurn(f"the session cannot {action}: {why or 'nothing is built yet'}")
            begins = self._name in ("ready", "finished") and action in ("play", "step")
            if action == "play":
                self._playing, self._budget = True, 0
                self._next_tick = 0.0
            elif action == "pause":
                self._playing, self._budget = False, 0
            elif action == "step":
                self._playing, self._budget = False, self._budget + ticks
            elif action == "stop":
                self._playing, self._budget, self._stop = False, 0, True
            else:
                self._playing, self._budget, self._reset = False, 0, True
            self._waiting = False
            if begins:
                self._set("playing", None)
            self._cond.notify_all()
            self._cond.wait_for(lambda: self._is_done(action), _STEP_PATIENCE_S if action == "step" else _PATIENCE_S)
        return "run_start" if begins else "episode_reset" if action == "reset" else None

    def set_speed(self, ticks_per_second: float | None) -> None:
        """Limit the speed; None for as fast as it goes."""
        with self._cond:
            self._speed, self._next_tick = ticks_per_second, 0.0
            self._set(self._name, self._error)

    def call(self, function: Callable[[BatchEnv], Any]) -> Future[Any]:
        """Call a function with the environment on its thread, between two ticks; fails while there is none."""
        future: Future[Any] = Future()
        with self._cond:
            self._check_open()
            self._jobs.append((function, future))
            self._cond.notify_all()
        return future

    def observe(self, observer: Observer) -> None:
        """Let an observer see the environment from now on."""
        self._observers.append(observer)
        with suppress(SessionClosed):
            self.call(observer.placed)

    def wait_until(self, *names: StateName, timeout: float | None = None) -> SessionState:
        """Wait for one of some states.

        Raises:
            TimeoutError: it took longer.
            SessionError: the session is in the state "error" instead.
        """
        with self._cond:
            reached = self._cond.wait_for(lambda: self._name in (*names, "error") or self._closing, timeout)
            if not reached:
                raise TimeoutError(f"the session is {self._name!r} after {timeout} s")
            if self._name not in names:
                raise SessionError(self._error or f"the session is {self._name!r}")
        return self.state()

    def shut(self) -> None:
        """Have the run end and every call that waits return; :meth:`close` waits until that has happened."""
        with self._cond:
            self._closing = True
            self._playing, self._budget = False, 0
            self._cond.notify_all()

    def close(self) -> None:
        """Stop, write what is left to write, and release everything; closing twice is harmless."""
        self.shut()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            _log.warning("the policy has not answered for %.0f s: its episode is given up", _CLOSE_S)
            return
        self.frames.close()
        self._temporary.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- shared --------------------------------------------------------------------------------------------------------

    def _check_open(self) -> None:
        if self._closing:
            raise SessionClosed("the session was closed")

    def _set(self, name: StateName, error: str | None) -> None:
        """Change the state; the caller has the lock."""
        self._name, self._error = name, error
        self._version += 1
        self._cond.notify_all()

    def _notify(self) -> None:
        with self._cond:
            self._cond.notify_all()

    def _is_done(self, action: Action) -> bool:
        """Whether an action has taken effect."""
        if self._closing or self._name == "error":
            return True
        if action in ("stop", "reset"):
            return not (self._stop or self._reset) and self._name != "building"
        if action == "step":
            return self._budget == 0 and (self._waiting or self._name == "finished")
        return action == "play" or self._waiting or self._name in ("ready", "finished")

    def _chosen(self, field: str, value: int | str) -> Fields:
        """The fields with one of them chosen."""
        now = self._fields
        if field == "suite":
            catalog.check_suite(str(value))
            return Fields(suite=str(value), task=catalog.tasks(str(value))[0].task, episode=0)
        if field not in ("task", "episode"):
            raise SessionError(f"there is no field {field!r}: suite, task or episode")
        if now.suite is None:
            raise OutOfTurn("choose a suite first")
        rows = catalog.tasks(now.suite)
        if field == "task":
            return Fields(suite=now.suite, task=rows[catalog.task_index(now.suite, value)].task, episode=0)
        index = catalog.task_index(now.suite, rows[0].task if now.task is None else now.task)
        text = str(value)
        if not (text.isascii() and text.isdecimal() and len(text) < 10 and int(text) < rows[index].num_episodes):
            raise SessionError(
                f"task {rows[index].task} of {now.suite} has episodes 0 to {rows[index].num_episodes - 1}, no {text!r}"
            )
        return Fields(suite=now.suite, task=rows[index].task, episode=int(text))

    def _select(self, config: EvalConfig) -> None:
        """Show what a config runs in the panel's fields: its first task and episode."""
        with suppress(VecenvError):
            suite, tasks, episodes = check(config, self._simulator)
            named = suite.tasks and config.suite.startswith("simpler/")
            task = suite.tasks[tasks[0]] if named else tasks[0]
            self._fields = Fields(suite=suite.name, task=task, episode=episodes[tasks[0]][0])

    # -- on the session's thread ---------------------------------------------------------------------------------------

    def _main(self) -> None:
        try:
            while not self._closing:
                self._turn()
        finally:
            self._drop_batch()
            self._fail_jobs(SessionClosed("the session was closed"))

    def _turn(self) -> None:
        """Do what was asked for: build, run, reset; or wait."""
        with self._cond:
            order, self._order, self._stop = self._order, None, False
            reset = self._reset
        try:
            if order is not None:
                self._build(order)
            elif reset and self._batch is not None:
                self._place(self._batch)
            elif self._wait(in_run=False) and self._batch is not None:
                self._run(self._batch)
        except Exception as error:  # whatever a simulator or a policy raises
            _log.info("the session failed", exc_info=error)
            known = isinstance(error, VecenvError)
            with self._cond:
                self._playing, self._budget = False, 0
                self._set("error", str(error) if known else raised(error))
            self._drop_batch()
        if reset:
            with self._cond:
                self._reset = False
                self._cond.notify_all()

    def _build(self, config: EvalConfig) -> None:
        self._drop_batch()
        with self._cond:
            self._set("building", None)
        limit = config.num_envs or self._max_slots
        self._batch = LiveBatch(replace(config, num_envs=limit), self._simulator)
        self._batch.plans.on_motion = lambda motion: self._tell("planned", motion)
        self._place(self._batch)

    def _place(self, batch: LiveBatch) -> None:
        """Put the first episodes at their start."""
        placed = batch.place()
        self._monitor.placed(placed.env, placed.slots)
        with self._cond:
            self._counts = (len(batch.planned), 0, 0, 0)
            self._started = False
            self._set("playing" if self._playing or self._budget else "ready", None)

    def _shown(self, env: BatchEnv) -> None:
        """Another environment, or the same one placed anew, is there to be seen."""
        self.frames.placed(env)
        self._tell("placed", env)

    def _run(self, batch: LiveBatch) -> None:
        """Run every episode, until the end or until stopped."""
        if self._started:
            self._place(batch)
        with self._cond:
            self._started, self._ending = True, False
            self._set("playing", None)
        folder = self._out or Path(self._temporary.name)
        causes = batch.run(folder, kept=self._out is not None, monitor=self._monitor, on_progress=self._progressed)
        with self._cond:
            self._playing, self._budget = False, 0
            self._set("finished", causes[-1] if causes else None)

    def _progressed(self, progress: Progress) -> None:
        """The policy was called, or an environment is being placed."""
        self._monitor.failed([record for record in progress.ended if record.error])
        with self._cond:
            self._counts = (
                progress.total,
                progress.done + progress.errors,
                progress.successes,
                progress.errors,
            )
            self._version += 1
        env = self._monitor.env
        if progress.setting_up or env is None:
            return
        try:
            self._monitor.settled(env)
        except VecenvError:  # it failed and was closed; another one follows, or none
            return
        self._tell("tick", env)
        if not self._ending and not env.done.all():
            self._wait(in_run=True)

    def _before_tick(self, env: BatchEnv) -> None:
        """Wait until a tick is allowed; called by the episode loop."""
        self._tell("tick", env)
        self._wait(in_run=True)
        with self._cond:
            if self._budget:
                self._budget -= 1
            elif self._speed:
                self._next_tick = max(self._next_tick + 1 / self._speed, time.monotonic())
        if self._batch is not None:
            self._batch.plans.at(self._monitor.tick)

    def _after_end(self, env: BatchEnv, slots: Sequence[int]) -> None:
        self.frames.draw_ended(env, slots)

    def _wait(self, *, in_run: bool) -> bool:
        """Draw and do jobs until the run may go on; False when something else is to be done.

        Raises:
            RunStopped: inside a run, when it is to end.
        """
        while True:
            with self._cond:
                if self._closing or self._order is not None or self._reset or self._stop:
                    if in_run:
                        self._ending = True
                        raise RunStopped
                    return False
                goes = self._playing or self._budget > 0
                jobs, self._jobs = self._jobs, []
                draw = self._monitor.env is not None and self.frames.is_due(goes and not self._speed)
                if not jobs and not draw:
                    left = self._next_tick - time.monotonic() if self._speed and self._playing else 0.0
                    if goes and left <= 0:
                        self._waiting = False
                        if in_run and self._name != "playing":
                            self._set("playing", self._error)
                        return True
                    self._hold(in_run, goes)
                    self._cond.wait(left if goes else None)
                    continue
            self._do(jobs, draw, goes)

    def _hold(self, in_run: bool, goes: bool) -> None:
        """Say that the run waits; the caller has the lock."""
        if goes:
            return
        if in_run and self._name != "paused":
            self._set("paused", self._error)
        if not self._waiting:
            self._waiting = True
            self._cond.notify_all()

    def _do(self, jobs: list[tuple[Callable[[BatchEnv], Any], Future[Any]]], draw: bool, playing: bool) -> None:
        env = self._monitor.env
        for function, future in jobs:
            if env is None:
                future.set_exception(SessionError("nothing is built yet"))
                continue
            try:
                future.set_result(function(env))
            except Exception as error:  # of whoever asked
                future.set_exception(error)
        if draw and env is not None:
            self.frames.draw(env, playing=playing)

    def _tell(self, what: str, *arguments: Any) -> None:
        """Call a method of every observer."""
        for observer in tuple(self._observers):
            try:
                getattr(observer, what)(*arguments)
            except Exception as error:  # who only watches ends nothing
                _log.warning("%s: %s", type(observer).__name__, raised(error))

    def _drop_batch(self) -> None:
        batch, self._batch = self._batch, None
        self._monitor.lost()
        self.frames.lost()
        if batch is not None:
            self._tell("lost")
            batch.close()

    def _fail_jobs(self, error: Exception) -> None:
        with self._cond:
            jobs, self._jobs = self._jobs, []
        for _, future in jobs:
            future.set_exception(error)
