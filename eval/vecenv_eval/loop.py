"""One run over the episodes of an evaluation: every verdict is written when its episode ends.

Episodes come as streams (``vecenv_eval.episodes.Stream``): those that the slots of an environment begin with, and those
that follow as slots end. A policy that can begin single slots (``vecenv_eval.policies.Refillable``) gets the next
episode of a scene in a slot as soon as the one before has ended; any other policy gets batches, one after the other.

An exception costs the episodes that were running: they are written as errors with the cause, and the others still run.
A policy that could not act in one episode (``vecenv_eval.policies.Failing``) costs that episode; one that can act in
none (``PolicyUnavailable``) ends the run.
"""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from typing import Any

import numpy as np

from vecenv.contract import BatchEnv, Control, Metrics
from vecenv_eval.clocks import EpisodeClocks
from vecenv_eval.conditions import conditions
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.drive import drive
from vecenv_eval.environments import Environments, Placed, slots_of
from vecenv_eval.episodes import Episode, Stream, Suite, plan, streams
from vecenv_eval.policies import Ending, Logging, Policy, PolicyUnavailable, Refillable, error_of, extras_of, in_words
from vecenv_eval.recorders import make_recorders
from vecenv_eval.results import Progress, count
from vecenv_eval.simulator import Simulator
from vecenv_eval.sink import Sink
from vecenv_eval.store import Record, StoreError, write_log
from vecenv_eval.watch import EpisodeRecorder, watching

# On a GPU a reset of a few slots costs as much as of all: slots wait until this share of them can begin together.
_SHARE_TO_REFILL = {"native": 0.0, "physx_cpu": 0.0}
_GPU_SHARE = 1 / 16


def make_streams(
    policy: Policy,
    suite: Suite,
    tasks: Sequence[int],
    episodes: Mapping[int, Sequence[int]],
    *,
    num_envs: int,
    done: Collection[Episode] = (),
) -> list[Stream]:
    """What runs the episodes of tasks but those in ``done``; batches, if the policy cannot begin single slots.

    Args:
        policy: what runs them.
        suite: the suite.
        tasks: task indices.
        episodes: episode indices by task.
        num_envs: most episodes that run at once.
        done: episodes to leave out.
    """
    if isinstance(policy, Refillable):
        return streams(suite, tasks, episodes, num_envs=num_envs, done=done)
    return [Stream.of(b) for b in plan(suite, tasks, episodes, num_envs=num_envs, done=done)]


class EpisodeLoop:
    """Runs streams one after the other.

    Args:
        config: what is evaluated, and how.
        suite: the suite.
        policy: acts for every environment.
        simulator: builds environments.
        store: where the records go.
        planned: every episode of the evaluation, those done before included.
        on_progress: called after every call of the policy.
        index: number of this run on the folder, from 0.
        environments: builds environments and keeps the one in use when the run ends; None for one of the loop's own,
            which is closed then.
        recorders: episode recorders beside those that the config asks for.

    Attributes:
        causes: what failed, one line each, without repetition.
    """

    def __init__(
        self,
        config: EvalConfig,
        suite: Suite,
        policy: Policy,
        simulator: Simulator,
        store: Sink,
        *,
        planned: Collection[Episode],
        on_progress: Callable[[Progress], None],
        index: int,
        environments: Environments | None = None,
        recorders: Sequence[EpisodeRecorder] = (),
    ) -> None:
        self.causes: dict[str, None] = {}
        self._config, self._suite, self._policy, self._simulator = config, suite, policy, simulator
        self._store, self._index = store, index
        wanted = frozenset(planned)
        self._records = {key: r for key, r in store.records().items() if key in wanted and not r.error}
        self._progress = _ProgressReports(on_progress, len(wanted), self._records)
        self._owns_environments = environments is None
        self._environments = environments or Environments(simulator, suite, config, self._write_conditions)
        self._recorders = [*make_recorders(config, suite, simulator, store), *recorders]
        self._number = self._failures = self._verdicts = self._errors_in_a_row = 0
        self._refill_share = _SHARE_TO_REFILL.get(config.backend, _GPU_SHARE)

    def run(self, streams: Sequence[Stream], plan: Callable[[Collection[Episode]], Sequence[Stream]]) -> bool:
        """Run every stream; True when stopped from the keyboard.

        Episodes that end in an error run again, as often as the config says. When two streams have failed and no
        episode of this run has a verdict, the rest is not tried; nor is it when the policy is unavailable, or could not
        act in twice as many episodes in a row as there are slots.

        Args:
            streams: what to run.
            plan: makes streams of the episodes that are to run again.

        Raises:
            ConfigError: the environment refuses a setting.
        """
        try:
            queue = deque(streams)
            for _ in range(1 + self._config.retries):
                if not self._run_all(queue):
                    break
                queue = deque(plan(self._failed))
        except KeyboardInterrupt:
            return True
        except PolicyUnavailable:  # the running episodes have it as their error
            return False
        finally:
            self._progress.report_rest()
            self.close()
        return False

    def run_stream(self, number: int, stream: Stream) -> None:
        """Run one stream; what an exception leaves of it runs afterwards, unless the config says to stop.

        The environment stays, and is placed anew for the next stream of the same scenes; call :meth:`close` at the end.

        Args:
            number: what records name it by.
            stream: what to run.

        Raises:
            ConfigError: the environment refuses a setting.
            PolicyUnavailable: the policy can act in no episode.
        """
        rest: Stream | None = stream
        while rest is not None and len(rest):
            rest = self._run_safely(number, rest)
            if rest is not None and self._config.fail_fast:
                return

    def close(self) -> None:
        """Close the environment, if it is the loop's own, and whatever watches it, all of them even if one raises."""
        with ExitStack() as stack:
            for recorder in reversed(self._recorders):
                stack.callback(recorder.close)
            if self._owns_environments:
                stack.callback(self._environments.close)

    def _run_all(self, queue: deque[Stream]) -> bool:
        """Run streams until none is left; False when to stop for good."""
        while queue:
            self._progress.num_batches = self._number + len(queue)
            rest = self._run_safely(self._number, queue.popleft())
            self._number += 1
            if rest is not None:
                self._failures += 1
                if self._config.fail_fast or (self._failures > 1 and not self._verdicts):
                    return False
                queue.extendleft([rest] if len(rest) else [])
        return True

    @property
    def _failed(self) -> frozenset[Episode]:
        """Episodes that ended in an error."""
        return frozenset(key for key, record in self._records.items() if record.error)

    def _run_safely(self, number: int, stream: Stream) -> Stream | None:
        """Run one stream; an exception is recorded for the episodes it cost, and what had not begun is returned."""
        try:
            self._progress.report(number, setting_up=True)
            placed = self._environments.place(stream)
        except (ConfigError, StoreError):
            raise
        except Exception as error:  # a simulator that cannot place these episodes may place others
            self._write_errors(number, stream.episodes, error)
            self._environments.close()
            return Stream(stream.suite, ())
        running = _Running(self._suite, placed, stream)
        try:
            self._begin_recording(running, range(len(running.slots)))
            with watching(placed.env, self._recorders):
                self._run_placed(number, running)
        except StoreError:
            raise  # what cannot be stored need not run
        except PolicyUnavailable as error:
            left = [slot for slot, episode in enumerate(running.slots) if episode not in running.ended]
            self._write_logs(running, left)
            self._write_error(number, [running.slots[slot] for slot in left], str(error), traceback.format_exc())
            raise
        except Exception as error:  # whatever a policy or a simulator raises concerns the running episodes only
            self._write_errors(number, running.slots, error)
            self._environments.close()
            return running.rest(len(placed.slots))
        return None

    def _run_placed(self, number: int, running: _Running) -> None:
        """Let the policy act until every slot has finished and nothing waits."""
        env, progress = running.placed.env, self._progress
        clocks = EpisodeClocks(env, running.placed.setup_s)
        before = progress.steps, progress.seconds
        ended = 0

        def refill(done: np.ndarray) -> np.ndarray:
            rows = running.slots_to_refill(done, self._refill_share)
            if len(rows):
                began = clocks.now()
                running.refill(rows, done)
                assert isinstance(self._policy, Refillable)
                self._policy.reset_slots(env, running.info, rows)
                self._begin_recording(running, rows.tolist())
                clocks.begin(rows, clocks.now() - began)
            return rows

        self._policy.reset(env, running.info)
        refillable = isinstance(self._policy, Refillable)
        for control, finished in drive(env, self._policy, refill if refillable else None):
            clocks.tick(control)
            if finished.any():
                metrics = env.evaluate()
                ended += int(metrics.num_steps[finished].sum())
                errors = {slot: error_of(self._policy, slot) for slot in np.flatnonzero(finished).tolist()}
                slots = [slot for slot, error in errors.items() if not error]
                running.ended |= {running.slots[slot] for slot in errors}
                records = {slot: self._record(number, running, slot, metrics, control, clocks) for slot in slots}
                for recorder in self._recorders:
                    recorder.finish(env, records)
                self._write_logs(running, list(errors))
                self._write(list(records.values()))
                self._verdicts += len(slots)
                self._tell_policy(running, slots)
                self._errors_in_a_row = 0 if slots else self._errors_in_a_row
                self._note_errors(number, running, {slot: error for slot, error in errors.items() if error})
            progress.steps, progress.seconds = (
                before[0] + ended + int(control.step_index[~control.done].sum()),
                before[1] + clocks.now(),
            )
            progress.report(number)

    def _begin_recording(self, running: _Running, slots: Iterable[int]) -> None:
        for recorder in self._recorders:
            recorder.begin(running.placed.env, {slot: running.slots[slot] for slot in slots})

    def _note_errors(self, number: int, running: _Running, errors: Mapping[int, str]) -> None:
        """Record episodes in which the policy could not act.

        Raises:
            PolicyUnavailable: there are too many in a row, or the config says to stop at the first.
        """
        for cause in dict.fromkeys(errors.values()):
            self._write_error(number, [running.slots[slot] for slot in errors if errors[slot] == cause], cause, cause)
        self._errors_in_a_row += len(errors)
        most = 1 if self._config.fail_fast else 2 * len(running.slots)
        if errors and self._errors_in_a_row >= most:
            count = f"{self._errors_in_a_row} episodes in a row ended in an error"
            raise PolicyUnavailable(f"the run was ended: {count}, the last with {list(errors.values())[-1]}")

    def _write_logs(self, running: _Running, slots: Iterable[int]) -> None:
        """Store what the policy notes about episodes; on the disk before their records are."""
        if isinstance(self._policy, Logging):
            for slot in slots:
                write_log(self._store.folder, running.slots[slot], self._policy.episode_log(slot))

    def _tell_policy(self, running: _Running, slots: Sequence[int]) -> None:
        if isinstance(self._policy, Ending):
            for slot in slots:
                self._policy.episode_end(slot, asdict(self._records[running.slots[slot]]))

    def _record(
        self, number: int, running: _Running, slot: int, metrics: Metrics, control: Control, clocks: EpisodeClocks
    ) -> Record:
        """The record of a slot that has just finished."""
        episode, seconds = running.slots[slot], clocks.seconds_of(slot)
        return Record(
            suite=episode.suite,
            task=episode.task,
            episode=episode.episode,
            instruction=running.info.instruction[slot],
            success=bool(metrics.success[slot]),
            success_first=bool(metrics.success_first[slot]),
            success_final=bool(metrics.success_final[slot]),
            num_steps=int(metrics.num_steps[slot]),
            reward=float(metrics.cumulative_reward[slot]),
            fault=control.info["fault"][slot],
            sanitized=int(clocks.sanitized[slot]),
            sanitized_first=None if clocks.sanitized[slot] == 0 else int(clocks.sanitized_first[slot]),
            run=self._index,
            batch=number,
            setup_s=seconds["setup_s"],
            wall_s=seconds["wall_s"],
            policy_s=seconds["policy_s"],
            physics_s=seconds["physics_s"],
            images_s=seconds["images_s"],
            extras=extras_of(self._policy, slot),
            stand_ins=tuple(control.info["stand_ins"][slot]) if "stand_ins" in control.info else (),
            parts=dict(control.info["parts"][slot]) if "parts" in control.info else {},
        )

    def _write_errors(self, number: int, episodes: Sequence[Episode], error: Exception) -> None:
        """Record an exception as the error of the episodes that it cost."""
        cause = in_words(error).splitlines()[0]
        self._write_error(number, episodes, cause, traceback.format_exc())

    def _write_error(self, number: int, episodes: Sequence[Episode], cause: str, details: str) -> None:
        """Record an error of episodes; those that have a verdict keep it."""
        self.causes[cause] = None
        self._store.log_error(f"run {self._index} stream {number} ({len(episodes)} episodes)\n{details}")
        failed = [
            Record.of_error(episode, self._suite.instructions[episode.task], cause, run=self._index, batch=number)
            for episode in episodes
            if episode not in self._records or self._records[episode].error
        ]
        self._write(failed)
        self._progress.report(number)

    def _write(self, records: Sequence[Record]) -> None:
        self._store.append(records)
        self._records.update({record.key: record for record in records})
        self._progress.note(records, self._records)

    def _write_conditions(self, env: BatchEnv) -> None:
        self._progress.conditions = conditions(env, self._config)
        self._store.write_conditions(self._progress.conditions)


class _Running:
    """A stream in its environment: which episode is in each slot now, and which still wait.

    Attributes:
        placed: the environment and its first episodes.
        slots: the episode in each slot.
        info: what the last reset returned.
        ended: the episodes that have ended.
    """

    def __init__(self, suite: Suite, placed: Placed, stream: Stream) -> None:
        self.ended: set[Episode] = set()
        self.placed, self.slots, self.info = placed, list(placed.slots), placed.info
        self._suite = suite
        self._waiting: dict[Hashable, deque[Episode]] = {scene: deque(e) for scene, e in stream.waiting.items()}

    def slots_to_refill(self, done: np.ndarray, share: float) -> np.ndarray:
        """Finished slots for whose scene an episode waits; none before they are a share of all, unless all are done."""
        rows = []
        left = {scene: len(episodes) for scene, episodes in self._waiting.items()}
        for row in np.flatnonzero(done).tolist():
            scene = self._suite.scenes[self.slots[row].task]
            if left.get(scene, 0):
                left[scene] -= 1
                rows.append(row)
        enough = len(rows) >= share * len(done) or done.all()
        return np.array(rows if enough else [], int)

    def refill(self, rows: np.ndarray, done: np.ndarray) -> None:
        """Place the next episode of their scene in finished slots, and reset them.

        Args:
            rows: the slots.
            done: every slot that has finished, bool [B]; those without a next episode stay finished.
        """
        for row in rows.tolist():
            self.slots[row] = self._waiting[self._suite.scenes[self.slots[row].task]].popleft()
        chosen = [self.slots[row] for row in rows.tolist()]
        env = self.placed.env
        env.set_episodes(tasks=[e.task for e in chosen], episodes=[e.episode for e in chosen], slots=rows)
        self.info = env.reset()
        slots_of(self.info, self.slots)
        # A reset begins the episodes of all finished slots again, of those too for which nothing waits.
        env.end_episodes(np.setdiff1d(np.flatnonzero(done), rows))

    def rest(self, num_slots: int) -> Stream:
        """The episodes that have not begun, for as many slots."""
        waiting = {scene: tuple(episodes) for scene, episodes in self._waiting.items() if episodes}
        first, rest = [], {}
        for scene, episodes in waiting.items():
            count = max(1, num_slots // len(waiting))
            first += episodes[:count]
            rest[scene] = episodes[count:]
        return Stream(self._suite.name, tuple(first), rest)


class _ProgressReports:
    """The numbers of :class:`Progress` while they change, and whom to tell."""

    def __init__(self, on_progress: Callable[[Progress], None], total: int, records: dict[Episode, Record]) -> None:
        self.steps, self.seconds, self.num_batches = 0, 0.0, 0
        self.conditions: Mapping[str, Any] = {}
        self._on_progress, self._total, self._batch = on_progress, total, 0
        self._ended: list[Record] = []
        self.note([], records)

    def note(self, ended: Sequence[Record], records: dict[Episode, Record]) -> None:
        """Some episodes have ended; ``records`` are all there are now."""
        self._ended += ended
        self._counts = count(records.values())

    def report_rest(self) -> None:
        """Call ``on_progress`` if episodes have ended since it was called."""
        if self._ended:
            self.report(self._batch)

    def report(self, batch: int, setting_up: bool = False) -> None:
        """Call ``on_progress``."""
        self._batch, ended, self._ended = batch, tuple(self._ended), []
        self._on_progress(
            Progress(
                total=self._total,
                **self._counts,
                steps=self.steps,
                seconds=self.seconds,
                batch=batch,
                num_batches=self.num_batches,
                setting_up=setting_up,
                ended=ended,
                conditions=self.conditions,
            )
        )
