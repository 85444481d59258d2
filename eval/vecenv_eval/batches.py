"""One run over the batches of an evaluation: every verdict is written when its episode ends.

A batch that raises costs its own unfinished episodes only: they are written as errors with the cause, and the next
batch runs.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeAlias

import numpy as np

from vecenv.contract import BatchEnv, Control, Metrics
from vecenv_eval.conditions import conditions
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.drive import drive
from vecenv_eval.environments import Environments, Placed, make_arguments
from vecenv_eval.episodes import Batch, Episode, Suite
from vecenv_eval.policies import Policy, extras_of
from vecenv_eval.results import Progress, count
from vecenv_eval.simulator import Simulator
from vecenv_eval.store import Record, ResultStore

# Called with which slots have just finished, bool [B], with the verdicts, bool [B], and with the faults, B strings.
_Finish: TypeAlias = Callable[[np.ndarray, np.ndarray, Sequence[str]], None]


class BatchLoop:
    """Runs batches one after the other.

    Args:
        config: what is evaluated, and how.
        suite: the suite.
        policy: acts for every batch.
        simulator: builds environments.
        store: the results folder.
        planned: every episode of the evaluation, those done before included.
        on_progress: called after every call of the policy.
        index: number of this run on the folder, from 0.

    Attributes:
        causes: what failed batches raised, one line each, without repetition.
    """

    def __init__(
        self,
        config: EvalConfig,
        suite: Suite,
        policy: Policy,
        simulator: Simulator,
        store: ResultStore,
        *,
        planned: Collection[Episode],
        on_progress: Callable[[Progress], None],
        index: int,
    ) -> None:
        self.causes: dict[str, None] = {}
        self._config, self._suite, self._policy, self._simulator = config, suite, policy, simulator
        self._store, self._index = store, index
        wanted = frozenset(planned)
        self._records = {key: r for key, r in store.records().items() if key in wanted and not r.error}
        self._progress = _ProgressReports(on_progress, len(wanted), self._records)
        self._environments = Environments(simulator, suite, config, self._write_conditions)

    def run(self, batches: Sequence[Batch]) -> bool:
        """Run every batch; True when stopped from the keyboard.

        Raises:
            ConfigError: the environment refuses a setting.
        """
        self._progress.num_batches = len(batches)
        try:
            for number, batch in enumerate(batches):
                if not self._run_safely(number, batch) and self._config.fail_fast:
                    break
        except KeyboardInterrupt:
            return True
        finally:
            self._environments.close()
        return False

    def _run_safely(self, number: int, batch: Batch) -> bool:
        """Run one batch; an exception is recorded for its unfinished episodes, and False is returned."""
        try:
            self._progress.report(number, setting_up=True)
            placed = self._environments.place(batch)
            with self._recording(placed) as finish:
                self._run_placed(number, placed, finish)
        except ConfigError:
            raise
        except Exception as error:  # whatever a policy or a simulator raises concerns this batch only
            self._write_errors(number, batch, error)
            self._environments.close()
            return False
        return True

    def _run_placed(self, number: int, placed: Placed, finish: _Finish) -> None:
        """Let the policy act until every slot has finished."""
        env, progress = placed.env, self._progress
        started, before = time.perf_counter(), (progress.steps, progress.seconds)
        self._policy.reset(env, placed.info)
        for control, finished in drive(env, self._policy):
            wall_s = time.perf_counter() - started
            if finished.any():
                metrics, slots = env.evaluate(), np.flatnonzero(finished).tolist()
                finish(finished, metrics.success, control.info["fault"])
                self._write([self._record(number, placed, i, metrics, control, wall_s) for i in slots])
            progress.steps, progress.seconds = before[0] + int(control.step_index.sum()), before[1] + wall_s
            progress.report(number)

    @contextmanager
    def _recording(self, placed: Placed) -> Iterator[_Finish]:
        """Record the batch when asked to; gives what to call with the slots that finish."""
        if not self._config.records:
            yield lambda finished, success, faults: None
            return
        from vecenv_eval.demos.options import make_options
        from vecenv_eval.demos.record import Recorder
        from vecenv_eval.demos.write import write_demos

        options = make_options(self._simulator.make, suite=self._suite.name, **make_arguments(self._config))
        episodes = [slot.episode for slot in placed.slots]
        recorder = Recorder(placed.env, episodes, options, states=self._config.record_states)
        try:
            with recorder.listening():
                yield recorder.finish
        finally:  # also of a batch that raises: what has a verdict is not run again
            recordings = recorder.recordings()
            for key in dict.fromkeys((slot.suite, slot.task) for slot in placed.slots):
                chosen = [r for i, r in recordings.items() if (placed.slots[i].suite, placed.slots[i].task) == key]
                if chosen:
                    write_demos(self._store.demos_path(*key), *key, self._suite.instructions[key[1]], chosen)

    def _record(
        self, number: int, placed: Placed, slot: int, metrics: Metrics, control: Control, wall_s: float
    ) -> Record:
        """The record of a slot that has just finished."""
        episode = placed.slots[slot]
        return Record(
            suite=episode.suite,
            task=episode.task,
            episode=episode.episode,
            instruction=placed.info.instruction[slot],
            success=bool(metrics.success[slot]),
            success_first=bool(metrics.success_first[slot]),
            success_final=bool(metrics.success_final[slot]),
            num_steps=int(metrics.num_steps[slot]),
            reward=float(metrics.cumulative_reward[slot]),
            fault=control.info["fault"][slot],
            run=self._index,
            batch=number,
            setup_s=placed.setup_s,
            wall_s=wall_s,
            extras=extras_of(self._policy, slot),
            stand_ins=tuple(control.info["stand_ins"][slot]) if "stand_ins" in control.info else (),
        )

    def _write_errors(self, number: int, batch: Batch, error: Exception) -> None:
        cause = f"{type(error).__name__}: {error}".splitlines()[0]
        self.causes[cause] = None
        self._store.log_error(f"run {self._index} batch {number} ({len(batch)} episodes)\n{traceback.format_exc()}")
        failed = [
            Record(
                suite=slot.suite,
                task=slot.task,
                episode=slot.episode,
                instruction=self._suite.instructions[slot.task],
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
        self._progress.report(number)

    def _write(self, records: Sequence[Record]) -> None:
        self._store.append(records)
        self._records.update({record.key: record for record in records})
        self._progress.count(self._records)

    def _write_conditions(self, env: BatchEnv) -> None:
        self._store.write_config({**self._store.config(), "conditions": conditions(env, self._config)})


class _ProgressReports:
    """The numbers of :class:`Progress` while they change, and whom to tell."""

    def __init__(self, on_progress: Callable[[Progress], None], total: int, records: dict[Episode, Record]) -> None:
        self.steps, self.seconds, self.num_batches = 0, 0.0, 0
        self._on_progress, self._total = on_progress, total
        self.count(records)

    def count(self, records: dict[Episode, Record]) -> None:
        """Count the records there are now."""
        self._counts = count(records.values())

    def report(self, batch: int, setting_up: bool = False) -> None:
        """Call ``on_progress``."""
        self._on_progress(
            Progress(
                total=self._total,
                **self._counts,
                steps=self.steps,
                seconds=self.seconds,
                batch=batch,
                num_batches=self.num_batches,
                setting_up=setting_up,
            )
        )
