"""Evaluate a policy on a suite: check the config, run what has no verdict yet, summarise.

An :class:`~vecenv_eval.config.EvalConfig` and a results folder come in; :class:`Evaluation` refuses what cannot run
before anything is built, plans the streams of episodes, has an engine run them (``vecenv_eval.engine``) and returns an
:class:`~vecenv_eval.results.EvalResult`.
"""

from __future__ import annotations

import functools
import inspect
import logging
from collections.abc import Callable, Collection, Mapping
from functools import cached_property
from pathlib import Path

from vecenv import family, protocols
from vecenv.errors import VecenvError
from vecenv.observations import UnknownCamera, choose_cameras
from vecenv.placement import episode_indices
from vecenv.util.extras import how_to_install, is_installed
from vecenv_eval.config import SCRIPTED, VIDEO_CHOICES, ConfigError, EvalConfig, default_policy, parse_shard
from vecenv_eval.engine import EngineError, make_engine
from vecenv_eval.environments import make_arguments
from vecenv_eval.episodes import ALL, Episode, Stream, Suite, parse_tasks, shard
from vecenv_eval.live import cleared
from vecenv_eval.loop import make_streams
from vecenv_eval.memory import SlotChoice, choose_slots
from vecenv_eval.policies import Closing, Policy, Seeing, check_policy, make_policy, raised
from vecenv_eval.provenance import run_conditions
from vecenv_eval.results import POLICY_NAME, EvalResult, Progress, open_or_begin, write_results
from vecenv_eval.simulator import Simulator, vecenv_simulator
from vecenv_eval.store import RESULTS, ResultStore, default_folder
from vecenv_eval.trackers import Tracking
from vecenv_eval.trackers import require as require_trackers

_log = logging.getLogger(__name__)


def evaluate(
    config: EvalConfig,
    store: ResultStore | Path | None = None,
    *,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    simulator: Simulator | None = None,
) -> EvalResult:
    """Run what the config asks for and the results folder does not have yet.

    Args:
        config: what to evaluate, and how.
        store: an open results folder, or where one is or is to be made; None for ``results/TIME_SUITE_POLICY``.
        on_progress: called after every call of the policy.
        simulator: where environments come from, ``vecenv`` when not given.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
        StoreError: the folder cannot be made, or holds another evaluation.
    """
    try:
        evaluation = Evaluation(config, simulator)
    except ConfigError:
        if isinstance(store, ResultStore):
            store.discard()  # a folder without episodes
        raise
    if not isinstance(store, ResultStore):
        store = open_or_begin(config, store or default_folder(RESULTS, config.suite, config.policy_name))
    return evaluation.run(store, on_progress)


class Evaluation:
    """A config that was checked: its suite, its episodes and its policy exist.

    Args:
        config: what to evaluate, and how.
        simulator: where environments come from, ``vecenv`` when not given.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
    """

    def __init__(self, config: EvalConfig, simulator: Simulator | None = None) -> None:
        self.config = config
        self.simulator = simulator or vecenv_simulator()
        self.suite, self.tasks, self.episodes = check(config, self.simulator)
        self._engine = make_engine(config)
        if self._engine.in_process:
            _ = self.policy  # what it raises is a mistake in the config

    @cached_property
    def policy(self) -> Policy:
        """The policy in this process, made when it is first asked for.

        Raises:
            ConfigError: it reads a camera that it would not get.
        """
        policy = make_policy(self.config.policy_name, self.config.policy_args, seed=self.policy_seed)
        if isinstance(policy, Seeing):
            _check_cameras_of(policy, self.config, self.suite, self.tasks)
        return policy

    @property
    def policy_seed(self) -> int:
        """The seed of the policy: as given, else the environment's under the protocol, 0 where it has none."""
        if self.config.seed is not None:
            return self.config.seed
        return protocols.protocol(self.config.protocol, family(self.config.suite)).seed or 0

    @property
    def planned(self) -> tuple[Episode, ...]:
        """Every episode asked for, task by task."""
        return tuple(Episode(self.suite.name, task, e) for task in self.tasks for e in self.episodes[task])

    @cached_property
    def slots(self) -> SlotChoice:
        """How many slots run at once; chosen once, before environments take memory."""
        return choose_slots(self.config, self.suite, self.tasks, self.simulator)

    def streams(self, done: Collection[Episode] = ()) -> list[Stream]:
        """What runs the planned episodes but those in ``done``.

        Nothing follows in a slot if the policy cannot begin single slots.
        """
        return make_streams(self.policy, self.suite, self.tasks, self.episodes, num_envs=self.slots.num_envs, done=done)

    def run(self, store: ResultStore, on_progress: Callable[[Progress], None] = lambda progress: None) -> EvalResult:
        """Run what the store does not have yet.

        Ctrl-C ends the run early with what was computed so far; it does not raise.

        Raises:
            ConfigError: the environment refuses a setting; a results folder without episodes is removed.
            EngineError: the engine cannot run anything.
            StoreError: another process writes to the results folder, or it cannot be written.
        """
        if self._engine.in_process:
            _warn_without_gpu(self.config.backend)
        try:
            with store.writing(), Tracking(self.config, store) as tracking:

                def report(progress: Progress) -> None:
                    on_progress(progress)
                    tracking.progress(progress)

                result = self._run(store, report)
                tracking.end(result)
            return result
        finally:
            store.close()
            self._close_policy()

    def _close_policy(self) -> None:
        """Let the policy release what it holds; what it raises then costs no result."""
        if not self._engine.in_process or not isinstance(self.policy, Closing):
            return
        try:
            self.policy.close()
        except Exception as error:
            _log.warning("policy %r could not be closed: %s", self.policy.name, raised(error))

    def _run(self, store: ResultStore, on_progress: Callable[[Progress], None]) -> EvalResult:
        store.tidy()
        content = store.config()
        runs = content.get("runs", [])
        name = {POLICY_NAME: self.policy.name} if self._engine.in_process else {}
        run = {**run_conditions(), "engine": self.config.engine}
        if self._engine.in_process:
            _log.info("at most %d slots: %s", self.slots.num_envs, self.slots.reason)
            run |= {"num_envs": self.slots.num_envs, "num_envs_reason": self.slots.reason}
        store.write_config({**content, **name, "runs": [*runs, run]})
        try:
            with cleared(store.folder):
                outcome = self._engine.run(self, store, len(runs), on_progress)
        except (ConfigError, EngineError):
            store.discard()
            raise
        name = store.config().get(POLICY_NAME) or self.config.policy_name
        return write_results(
            store, self.suite, self.planned, name, interrupted=outcome.interrupted, causes=outcome.causes
        )


def check(config: EvalConfig, simulator: Simulator) -> tuple[Suite, tuple[int, ...], dict[int, tuple[int, ...]]]:
    """Check a config without making its policy; gives the suite, the tasks, and the episodes of each.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
    """
    suite = simulator.suite_of(config)
    tasks, episodes = chosen_episodes(config, suite)
    _check_make(simulator, config)
    check_cameras(config, suite, tasks)
    _check_packages(config)
    _check_policy(config)
    check_policy(config.policy_name, config.policy_args)
    make_engine(config)
    return suite, tasks, episodes


def chosen_episodes(config: EvalConfig, suite: Suite) -> tuple[tuple[int, ...], dict[int, tuple[int, ...]]]:
    """The tasks to run, and which episodes of each; of a shard, its own.

    Raises:
        ConfigError, SpecError: there are no such tasks or episodes.
    """
    tasks = parse_tasks(config.tasks, len(suite.instructions), suite.tasks)
    if config.tasks.strip() == ALL:
        tasks = tuple(task for task in tasks if suite.episodes_of(task))
    missing = [task for task in tasks if not suite.episodes_of(task)]
    if missing:
        raise ConfigError(f"protocol {config.protocol!r} has no episodes of task {missing[0]} of {suite.name}")
    episodes = {task: episode_indices(config.episodes, suite.episodes_of(task), suite.every) for task in tasks}
    own = shard(suite, tasks, episodes, *parse_shard(config.shard))
    return tuple(own), own


def _check_make(simulator: Simulator, config: EvalConfig) -> None:
    """Fail before the first episode when ``make`` does not know an argument."""
    try:
        inspect.signature(simulator.make).bind(config.suite, tasks=[], episodes=[], **make_arguments(config))
        simulator.check(config.suite, make_arguments(config))
    except (TypeError, VecenvError) as error:
        raise ConfigError(f"environment arguments: {error}") from None


def _check_policy(config: EvalConfig) -> None:
    """Refuse the built-in policies that are made for certain suites on others, where they can only fail."""
    name, scripted = config.policy_name, default_policy(config.suite)
    if name in SCRIPTED.values() and name != scripted:
        raise ConfigError(f"policy {name!r} is not made for {config.suite}; the scripted one there is {scripted!r}")
    if name == "voxposer" and config.suite == "simpler/google_robot":
        raise ConfigError("policy 'voxposer' knows Panda's and WidowX's hands, not the Google Robot's")


def check_cameras(config: EvalConfig, suite: Suite, tasks: Collection[int]) -> None:
    """Refuse cameras that the scene of a task does not have.

    Raises:
        ConfigError: there is no such camera; the message names it and those that there are.
    """
    for task in tasks if config.camera_names and suite.cameras else ():
        try:
            choose_cameras(config.camera_names, _cameras_of(config, suite, task))
        except VecenvError as error:
            raise ConfigError(f"{suite.name} task {task}: {error}") from None


def _check_cameras_of(policy: Seeing, config: EvalConfig, suite: Suite, tasks: Collection[int]) -> None:
    """Refuse a policy that reads the images of a camera that it would not get."""
    for task in tasks if suite.cameras else ():
        there = _cameras_of(config, suite, task)
        if config.camera_names:
            there = choose_cameras(config.camera_names, there)
        for name in policy.needed_cameras():
            try:
                choose_cameras([name], there)
            except UnknownCamera:
                what = f"policy {config.policy_name!r} reads camera {name!r}"
                raise ConfigError(f"{what}; {suite.name} task {task} has {', '.join(there)} here") from None


def _cameras_of(config: EvalConfig, suite: Suite, task: int) -> tuple[str, ...]:
    """The cameras of a task's scene, and those that ``--env-arg render=...`` adds."""
    render = config.env_args.get("render")
    added = render.get("cameras", ()) if isinstance(render, Mapping) else ()
    names = [str(each.get("name")) if isinstance(each, Mapping) else str(getattr(each, "name", "")) for each in added]
    return (*suite.cameras[task], *names)


def _check_packages(config: EvalConfig) -> None:
    """Refuse what needs a package that is not installed, before the first episode would fail for want of it."""
    require_trackers(config.trackers)
    needs = {
        "--record": ("h5py",) if config.records else (),
        f"--video {config.video}": ("av",) if config.video != VIDEO_CHOICES[0] else (),
        "--live": ("PIL",) if config.live else (),
        "--record-lerobot": ("pyarrow", "av") if config.record_lerobot else (),
    }
    for option, modules in needs.items():
        for module in modules:
            if not is_installed(module):
                raise ConfigError(f"{option}: {how_to_install(module)}")


@functools.cache
def _warn_without_gpu(backend: str) -> None:
    """Say once that MuJoCo Warp runs on the CPU, where there is no other device."""
    if backend != "warp":
        return
    import jax

    if jax.default_backend() not in ("gpu", "cuda"):
        _log.warning(
            "--backend warp: no CUDA device: this runs on the CPU and is slow (--backend native is fast there)"
        )
