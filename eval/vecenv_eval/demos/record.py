"""Recording what an evaluation executes, so that ``vecenv replay`` can do it again.

:class:`DemoRecorder` is an episode recorder (``vecenv_eval.watch``): every control tick is noted, whichever verb the
policy used: which slots moved, and with which actions. Each episode that ends becomes a
:class:`~vecenv_eval.demos.schema.Recording`, which is kept at once (``vecenv_eval.sink``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from vecenv.contract import BatchEnv, State
from vecenv.errors import InvalidFile
from vecenv_eval.demos.schema import Recording
from vecenv_eval.episodes import Episode
from vecenv_eval.store import Record


class RecordError(InvalidFile):
    """An environment whose executed actions cannot be seen."""


@dataclass
class _Rollout:
    """What a slot has executed so far; a second half is a task's, where SIMPLER's tasks have two."""

    start: np.ndarray
    actions: list[np.ndarray] = field(default_factory=list)
    states: list[np.ndarray] = field(default_factory=list)
    second_half: list[bool] = field(default_factory=list)


class DemoRecorder:
    """Writes what every episode executes.

    Memory grows by 56 bytes a slot and tick, with states by 8 (1 + nq + nv) more, until the episode ends.

    Args:
        keep: called with suite, task, instruction and episodes of it, which it has written when it returns.
        instructions: of each task of the suite.
        options: what ``vecenv.make`` was called with, see ``vecenv_eval.demos.options.make_options``.
        states: also keep the state before every tick.
    """

    def __init__(
        self,
        keep: Callable[[str, int, str, Sequence[Recording]], None],
        instructions: Sequence[str],
        options: Mapping[str, Any],
        *,
        states: bool = False,
    ) -> None:
        self._keep, self._instructions, self._options, self._with_states = keep, instructions, options, states
        self._env: BatchEnv | None = None
        self._rollouts: dict[int, _Rollout] = {}

    def begin(self, env: BatchEnv, episodes: Mapping[int, Episode]) -> None:
        """Note the state that episodes begin in; what was noted of these slots before is dropped.

        Raises:
            RecordError: the environment does not show what it executes.
        """
        if env is not self._env:
            self._env, self._rollouts = env, {}
        try:
            state = env.state()
        except AttributeError as error:
            what = f"{type(env).__name__} does not show the actions it executes, so it cannot be recorded"
            raise RecordError(what) from error
        self._rollouts |= {slot: _Rollout(flat_state(state, slot)) for slot in episodes}

    def observe(self, env: object, slots: Sequence[int], actions: np.ndarray) -> None:
        """Note one tick of each slot, before it happens; slots whose beginning was not seen are passed over."""
        del env  # what is shared with other recorders has images, and no states
        assert self._env is not None, "call begin() first"
        state = self._env.state() if self._with_states else None
        halves = second_halves(self._env)
        for slot in self._rollouts.keys() & set(slots):
            rollout = self._rollouts[slot]
            rollout.actions.append(np.array(actions[slot], float))
            if state is not None:
                rollout.states.append(flat_state(state, slot))
            if halves is not None:
                rollout.second_half.append(bool(halves[slot]))

    def finish(self, env: BatchEnv, records: Mapping[int, Record]) -> None:
        """Write the episodes that ended; one whose physics failed before its first tick has nothing to record."""
        state = env.state()
        by_task: dict[tuple[str, int], list[Recording]] = {}
        for slot, record in records.items():
            rollout = self._rollouts.pop(slot, None)
            if rollout is not None and rollout.actions and not record.error:
                recording = self._recording(env, slot, rollout, record, flat_state(state, slot))
                by_task.setdefault((record.suite, record.task), []).append(recording)
        for (suite, task), recordings in by_task.items():
            self._keep(suite, task, self._instructions[task], recordings)

    def close(self) -> None:
        """Drop the episodes that have not finished."""
        self._env, self._rollouts = None, {}

    def _recording(
        self, env: BatchEnv, slot: int, rollout: _Rollout, record: Record, final_state: np.ndarray
    ) -> Recording:
        return Recording(
            episode=record.episode,
            success=record.success,
            fault=record.fault,
            actions=np.stack(rollout.actions),
            init_state=rollout.start,
            final_state=final_state,
            states=np.array(rollout.states) if self._with_states else None,
            second_half=np.array(rollout.second_half) if any(rollout.second_half) else None,
            options=_of_slot(self._options, slot),
            instruction=record.instruction,
            labels=_labels(env, slot),
            stand_ins=record.stand_ins,
        )


def flat_state(state: State, slot: int) -> np.ndarray:
    """A slot's time, qpos and qvel in one row, [1 + nq + nv]."""
    return np.concatenate([state.time[[slot]], state.qpos[slot, : state.nq[slot]], state.qvel[slot, : state.nv[slot]]])


def second_halves(env: BatchEnv) -> np.ndarray | None:
    """Which slots are in the second half of a task that has two, bool [B]; None where no task has halves."""
    return getattr(env, "second_half", None)


def _labels(env: BatchEnv, slot: int) -> dict[str, str | int]:
    """What identifies an episode for a reader, beyond its number; a replay needs none of it."""
    specs = getattr(env, "specs", None)  # SIMPLER's environments have the rows of the published lists
    if specs is None:
        protocol = getattr(env.config, "protocol", None)
        return {} if protocol is None else {"protocol": protocol}
    spec = specs[slot]
    return {"protocol": spec.protocol, "task_name": spec.task, "setting": spec.setting, "seed": spec.seed}


def _of_slot(options: Mapping[str, Any], slot: int) -> dict[str, Any]:
    """Options as this slot sees them: of fixture poses that differ between slots, its own."""
    fixtures = options.get("fixtures")
    if not isinstance(fixtures, Mapping):
        return dict(options)
    own = {name: [_row(part, slot) for part in pose] for name, pose in fixtures.items()}
    return {**options, "fixtures": own}


def _row(values: npt.ArrayLike, slot: int) -> list[float]:
    array = np.asarray(values, float)
    return (array if array.ndim == 1 else array[slot]).tolist()
