"""Recording what an evaluation executes, so that ``vecenv replay`` can do it again.

A freshly reset batch comes in; while :class:`Recorder` listens, every control tick is noted: which slots moved and with
which actions, whatever verb the policy used. When the batch ends, each finished slot becomes a
:class:`~vecenv_eval.demos.schema.Recording`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from vecenv.contract import BatchEnv, State
from vecenv.errors import InvalidFile
from vecenv_eval.demos.schema import Recording


class RecordError(InvalidFile):
    """An environment whose executed actions cannot be seen."""


class Recorder:
    """Notes what a batch executes; memory grows by 56 bytes a slot and tick, with states by 8 (1 + nq + nv) more.

    Args:
        env: the batch, just reset.
        episodes: episode index of each slot.
        options: what ``vecenv.make`` was called with, see ``vecenv_eval.demos.options.make_options``.
        states: also keep the state before every tick.

    Raises:
        RecordError: the environment does not show what it executes.
    """

    def __init__(
        self, env: BatchEnv, episodes: Sequence[int], options: Mapping[str, Any], *, states: bool = False
    ) -> None:
        self._env, self._options, self._with_states = env, options, states
        self._episodes = list(episodes)
        count = len(self._episodes)
        self._actions: list[list[np.ndarray]] = [[] for _ in range(count)]
        self._states: list[list[np.ndarray]] = [[] for _ in range(count)]
        try:
            state = env.state()
        except AttributeError as error:
            what = f"{type(env).__name__} does not show the actions it executes, so it cannot be recorded"
            raise RecordError(what) from error
        self._start = [flat_state(state, slot) for slot in range(count)]
        self._ended: dict[int, tuple[bool, str, np.ndarray]] = {}

    @contextmanager
    def listening(self) -> Iterator[None]:
        """While inside, control ticks are noted."""
        with self._env.watched(self._note):
            yield

    def _note(self, actions: np.ndarray, active: np.ndarray) -> None:
        state = self._env.state() if self._with_states else None
        for slot in np.flatnonzero(active).tolist():
            self._actions[slot].append(np.array(actions[slot], float))
            if state is not None:
                self._states[slot].append(flat_state(state, slot))

    def begin(self, slots: Sequence[int], episodes: Sequence[int]) -> None:
        """Other episodes have begun in some slots, which were just reset; what they had recorded is dropped."""
        state = self._env.state()
        for slot, episode in zip(slots, episodes, strict=True):
            self._episodes[slot], self._start[slot] = episode, flat_state(state, slot)
            self._actions[slot], self._states[slot] = [], []
            self._ended.pop(slot, None)

    def finish(self, finished: np.ndarray, success: np.ndarray, faults: Sequence[str]) -> None:
        """Note the verdicts of the slots that the last call finished: bool [B], bool [B], B strings."""
        state = self._env.state()
        for slot in np.flatnonzero(finished).tolist():
            self._ended[slot] = (bool(success[slot]), faults[slot], flat_state(state, slot))

    def recordings(self) -> dict[int, Recording]:
        """The slots that have finished; one whose physics failed before its first tick has nothing to record."""
        return {
            slot: Recording(
                episode=self._episodes[slot],
                success=success,
                fault=fault,
                actions=np.stack(self._actions[slot]),
                init_state=self._start[slot],
                final_state=final,
                states=np.array(self._states[slot]) if self._with_states else None,
                options=_of_slot(self._options, slot),
            )
            for slot, (success, fault, final) in self._ended.items()
            if self._actions[slot]
        }

    def take(self) -> dict[int, Recording]:
        """``recordings``, which are then forgotten."""
        taken = self.recordings()
        self._ended.clear()
        return taken


def flat_state(state: State, slot: int) -> np.ndarray:
    """A slot's time, qpos and qvel in one row, [1 + nq + nv]."""
    return np.concatenate([state.time[[slot]], state.qpos[slot, : state.nq[slot]], state.qvel[slot, : state.nv[slot]]])


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
