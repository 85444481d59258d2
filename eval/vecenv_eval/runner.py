"""Evaluate a policy on a suite: check the config, run what has no verdict yet, summarise.

An :class:`~vecenv_eval.config.EvalConfig` and a results folder come in; :class:`Evaluation` refuses what cannot run
before anything is built, plans the batches, runs them (``vecenv_eval.loop``) and returns an
:class:`~vecenv_eval.results.EvalResult`.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Callable, Collection
from functools import cached_property
from pathlib import Path

from vecenv import family, protocols
from vecenv.errors import VecenvError
from vecenv.placement import episode_indices
from vecenv_eval.config import SCRIPTED, ConfigError, EvalConfig, default_policy
from vecenv_eval.environments import make_arguments
from vecenv_eval.episodes import ALL, Episode, Stream, Suite, parse_tasks, plan, streams
from vecenv_eval.loop import EpisodeLoop
from vecenv_eval.memory import SlotChoice, choose_slots
from vecenv_eval.policies import Closing, Refillable, check_policy, make_policy
from vecenv_eval.provenance import run_conditions
from vecenv_eval.report import markdown, summarise
from vecenv_eval.results import EvalResult, Progress, begin
from vecenv_eval.simulator import Simulator, vecenv_simulator
from vecenv_eval.store import RESULTS, ResultStore, default_folder

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
        store: an open results folder, or where to make one; None for ``results/TIME_SUITE_POLICY``.
        on_progress: called after every call of the policy.
        simulator: where environments come from, ``vecenv`` when not given.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
        StoreError: the folder cannot be made.
    """
    try:
        evaluation = Evaluation(config, simulator)
    except ConfigError:
        if isinstance(store, ResultStore):
            store.discard()  # a folder without episodes
        raise
    if not isinstance(store, ResultStore):
        store = begin(config, store or default_folder(RESULTS, config.suite, config.policy_name))
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
        self.policy = make_policy(config.policy_name, seed=_policy_seed(config), **config.policy_args)

    @property
    def planned(self) -> tuple[Episode, ...]:
        """Every episode asked for, task by task."""
        return tuple(Episode(self.suite.name, task, e) for task in self.tasks for e in self.episodes[task])

    @cached_property
    def slots(self) -> SlotChoice:
        """How many slots run at once; chosen once, before environments take memory."""
        return choose_slots(self.config, self.suite, self.tasks, self.simulator)

    def streams(self, done: Collection[Episode] = ()) -> list[Stream]:
        """What runs the planned episodes but those in ``done``; batches, if the policy cannot begin single slots."""
        most = self.slots.num_envs
        if isinstance(self.policy, Refillable):
            return streams(self.suite, self.tasks, self.episodes, num_envs=most, done=done)
        return [Stream.of(b) for b in plan(self.suite, self.tasks, self.episodes, num_envs=most, done=done)]

    def run(self, store: ResultStore, on_progress: Callable[[Progress], None] = lambda progress: None) -> EvalResult:
        """Run what the store does not have yet.

        Ctrl-C ends the run early with what was computed so far; it does not raise.

        Raises:
            ConfigError: the environment refuses a setting; a results folder without episodes is removed.
        """
        content = store.config()
        _log.info("at most %d slots: %s", self.slots.num_envs, self.slots.reason)
        slots = {"num_envs": self.slots.num_envs, "num_envs_reason": self.slots.reason}
        store.write_config({**content, "runs": [*content["runs"], run_conditions() | slots]})
        loop = EpisodeLoop(
            self.config,
            self.suite,
            self.policy,
            self.simulator,
            store,
            planned=self.planned,
            on_progress=on_progress,
            index=len(content["runs"]),
        )
        try:
            interrupted = loop.run(self.streams(store.done()), self._again)
        except ConfigError:
            store.discard()
            raise
        finally:
            if isinstance(self.policy, Closing):
                self.policy.close()
        return self._summarise(store, interrupted, tuple(loop.causes))

    def _again(self, episodes: Collection[Episode]) -> list[Stream]:
        """Streams of these episodes alone."""
        return self.streams(done=frozenset(self.planned) - frozenset(episodes))

    def _summarise(self, store: ResultStore, interrupted: bool, causes: tuple[str, ...]) -> EvalResult:
        """Write the summary of all records in the folder, and return it with them."""
        records, planned = store.records(), self.planned
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
            causes=causes,
        )


def check(config: EvalConfig, simulator: Simulator) -> tuple[Suite, tuple[int, ...], dict[int, tuple[int, ...]]]:
    """Check a config without making its policy; gives the suite, the tasks, and the episodes of each.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
    """
    suite = simulator.suite(config.suite, config.protocol)
    tasks, episodes = _chosen_episodes(config, suite)
    _check_make(simulator, config)
    _check_record(config)
    _check_policy(config)
    check_policy(config.policy_name, **config.policy_args)
    return suite, tasks, episodes


def _policy_seed(config: EvalConfig) -> int:
    """The seed of the policy: as given, else the environment's under the protocol, 0 where it has none."""
    if config.seed is not None:
        return config.seed
    return protocols.protocol(config.protocol, family(config.suite)).seed or 0


def _chosen_episodes(config: EvalConfig, suite: Suite) -> tuple[tuple[int, ...], dict[int, tuple[int, ...]]]:
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


def _check_record(config: EvalConfig) -> None:
    """Recordings are LIBERO's HDF5 files: they hold MuJoCo states and begin from LIBERO's init states."""
    if config.records and family(config.suite) == protocols.SIMPLER:
        raise ConfigError(f"{config.suite} cannot be recorded: recordings are in LIBERO's layout, for LIBERO's suites")
