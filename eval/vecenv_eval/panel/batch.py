"""What a session has built: a checked config, its policy, its environment, and one run of its episodes after another.

Built and called on the session's thread only. A run is ``vecenv_eval.loop``'s, and ends in a results folder.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vecenv_eval.conditions import conditions
from vecenv_eval.config import EvalConfig
from vecenv_eval.environments import Environments, Placed
from vecenv_eval.episodes import Episode
from vecenv_eval.loop import EpisodeLoop
from vecenv_eval.panel.monitor import Monitor
from vecenv_eval.panel.planning import Plans
from vecenv_eval.policies import Closing, raised
from vecenv_eval.provenance import run_conditions
from vecenv_eval.results import POLICY_NAME, Progress, begin, write_results
from vecenv_eval.runner import Evaluation
from vecenv_eval.simulator import Simulator
from vecenv_eval.sink import FolderSink
from vecenv_eval.store import ResultStore, default_folder

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Open:
    """A results folder that is written to, and whether it stays."""

    store: ResultStore
    kept: bool


class LiveBatch:
    """A policy and an environment for the episodes of a config.

    Args:
        config: what runs.
        simulator: where environments come from.

    Attributes:
        planned: the episodes.
        plans: what the policy has planned.
        results: name of the results folder of the latest run, None without one.

    Raises:
        ConfigError, SpecError, PolicyError: something in the config does not exist or does not fit.
    """

    def __init__(self, config: EvalConfig, simulator: Simulator) -> None:
        self._evaluation = Evaluation(config, simulator)
        self._environments = Environments(simulator, self._evaluation.suite, config, on_make=lambda env: None)
        self.planned: tuple[Episode, ...] = self._evaluation.planned
        self.plans = Plans(self._evaluation.policy)
        self.results: str | None = None

    @property
    def policy_name(self) -> str:
        """The policy as results have it."""
        return self._evaluation.policy.name

    def place(self) -> Placed:
        """Put the first episodes at their start.

        Raises:
            ConfigError: the environment refuses a setting, or assets are missing.
        """
        return self._environments.place(self._evaluation.streams()[0])

    def run(
        self, out: Path, *, kept: bool, monitor: Monitor, on_progress: Callable[[Progress], None]
    ) -> tuple[str, ...]:
        """Run every episode; what ends is on the disk at once.

        Args:
            out: where the results folder is made.
            kept: the folder stays; otherwise it is a temporary one.
            monitor: sees the run, and ends it with ``RunStopped``.
            on_progress: called after every call of the policy.

        Returns:
            What failed, one line each.

        Raises:
            StoreError: the folder cannot be written.
        """
        evaluation, config = self._evaluation, self._evaluation.config
        store = begin(config, default_folder(out, evaluation.suite.name, config.policy_name))
        self.results = store.folder.name if kept else None
        try:
            with store.writing():
                return self._run(store, monitor, on_progress)
        finally:
            store.discard()  # a folder without an episode
            store.close()
            if not store.folder.is_dir():
                self.results = None

    def close(self) -> None:
        """Release environment and policy."""
        for what in (self._environments, self._evaluation.policy):
            if not isinstance(what, Closing):
                continue
            try:
                what.close()
            except Exception as error:  # costs no result
                _log.warning("%s could not be closed: %s", type(what).__name__, raised(error))

    def _run(self, store: ResultStore, monitor: Monitor, on_progress: Callable[[Progress], None]) -> tuple[str, ...]:
        evaluation, config = self._evaluation, self._evaluation.config
        run = {**run_conditions(), "engine": config.engine, "num_envs": config.num_envs, "driven": "vecenv serve"}
        store.write_config({**store.config(), POLICY_NAME: self.policy_name, "runs": [run]})
        sink = FolderSink(store, config)
        if monitor.env is not None:
            sink.write_conditions(conditions(monitor.env, config))
        loop = EpisodeLoop(
            config,
            evaluation.suite,
            evaluation.policy,
            evaluation.simulator,
            sink,
            planned=self.planned,
            on_progress=on_progress,
            index=0,
            environments=self._environments,
            recorders=(monitor,),
        )
        planned = frozenset(self.planned)
        interrupted = loop.run(evaluation.streams(), lambda failed: evaluation.streams(planned - frozenset(failed)))
        causes = tuple(loop.causes)
        if store.records():
            suite = evaluation.suite
            write_results(store, suite, self.planned, self.policy_name, interrupted=interrupted, causes=causes)
        return causes
