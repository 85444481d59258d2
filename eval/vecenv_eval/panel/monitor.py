"""The table of a live batch: what each slot runs, how far it is, and the columns of its episode.

An episode recorder (``vecenv_eval.watch``) that the episode loop calls on the thread of the environment; any other
thread reads copies. :attr:`Monitor.revisions` says which slots have changed since an image of them was drawn.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence

import numpy as np

import vecenv
from vecenv.contract import BatchEnv
from vecenv.slots import SlotBatch
from vecenv_eval.episodes import Episode
from vecenv_eval.panel.state import History, SlotState
from vecenv_eval.store import Record
from vecenv_eval.watch import Observable

# Rows of a history that are kept: the longest budget of an episode, and more than enough for a plot.
MOST_ROWS = 5000
# Columns of a row: position of the hand, opening of the gripper, reward, action.
_WIDTH = 3 + 1 + 1 + 7
_GRIPPER, _REWARD, _ACTION = 3, 4, 5
_DECIMALS = 5


class Monitor:
    """Sees a batch run.

    Args:
        on_tick: called on the thread of the environment before every tick.
        on_end: called there with the slots whose episodes have ended, in the environment as it shows their end.
        on_placed: called there when another environment, or the same one placed anew, is seen.
    """

    def __init__(
        self,
        on_tick: Callable[[BatchEnv], None],
        on_end: Callable[[BatchEnv, Sequence[int]], None],
        on_placed: Callable[[BatchEnv], None],
    ) -> None:
        self._on_tick, self._on_end, self._on_placed = on_tick, on_end, on_placed
        self._lock = threading.Lock()
        self.env: BatchEnv | None = None
        self.tick = 0
        self._revision = 0
        self._clear(0)

    def _clear(self, count: int) -> None:
        self.revisions = np.zeros(count, int)
        self._episodes: list[Episode | None] = [None] * count
        self._labels: list[int | str] = [0] * count
        self._instructions = [""] * count
        self._faults: list[str | None] = [None] * count
        self._steps, self._budgets = np.zeros(count, int), np.zeros(count, int)
        self._reward = np.zeros(count)
        self._success, self._ended = np.zeros(count, bool), np.zeros(count, bool)
        self._rows: list[np.ndarray] = [np.zeros((0, _WIDTH), np.float32)] * count
        self._count = np.zeros(count, int)

    # -- on the thread of the environment ------------------------------------------------------------------------------

    def placed(self, env: BatchEnv, episodes: Sequence[Episode]) -> None:
        """An environment stands at the start of its first episodes."""
        with self._lock:
            self.env, self.tick = None, 0
        self.begin(env, dict(enumerate(episodes)))

    def lost(self) -> None:
        """There is no environment any more."""
        with self._lock:
            self.env = None
            self._clear(0)

    def begin(self, env: BatchEnv, episodes: Mapping[int, Episode]) -> None:
        """Episodes have begun in some slots."""
        if env is not self.env:
            with self._lock:
                self.env = env
                self._clear(env.num_envs)
            self._on_placed(env)
        instructions = env.instructions()
        budgets = env.max_steps if isinstance(env, SlotBatch) else np.zeros(env.num_envs, int)
        with self._lock:
            for slot, episode in episodes.items():
                self._episodes[slot], self._labels[slot] = episode, _label(episode)
                self._instructions[slot], self._faults[slot] = instructions[slot], None
                self._count[slot] = 0
            slots = list(episodes)
            self._budgets[slots] = budgets[slots]
            self._steps[slots] = self._reward[slots] = 0
            self._success[slots] = self._ended[slots] = False
            self._changed(slots)

    def observe(self, env: Observable, slots: Sequence[int], actions: np.ndarray) -> None:
        """A tick is about to happen: wait for it to be allowed, then note it."""
        del env
        assert self.env is not None
        self._on_tick(self.env)
        self._note(self.env, slots, actions)

    def finish(self, env: BatchEnv, records: Mapping[int, Record]) -> None:
        """Episodes have ended; the environment still shows their end."""
        rows = self._look(env)
        with self._lock:
            for slot, record in records.items():
                self._end(slot, record)
                self._append(slot, rows[slot])
            self._changed(list(records))
        self._on_end(env, list(records))

    def failed(self, records: Sequence[Record]) -> None:
        """Episodes have ended without a verdict."""
        with self._lock:
            for record in records:
                for slot, episode in enumerate(self._episodes):
                    if episode == record.key and not self._ended[slot]:
                        self._end(slot, record)
                        self._changed([slot])

    def settled(self, env: BatchEnv) -> None:
        """A call of the policy has ended: what it did is to be seen."""
        reward = np.asarray(env.evaluate().cumulative_reward)
        with self._lock:
            live = ~self._ended
            self._reward[live] = reward[live]
            self._changed(np.flatnonzero(live).tolist())

    def close(self) -> None:
        """The run is over; its table stays."""

    def _end(self, slot: int, record: Record) -> None:
        self._ended[slot], self._success[slot] = True, record.success
        self._faults[slot] = record.error or record.fault or None
        if not record.error:
            self._steps[slot], self._reward[slot] = record.num_steps, record.reward or 0.0

    def _note(self, env: BatchEnv, slots: Sequence[int], actions: np.ndarray) -> None:
        rows = self._look(env)
        rows[:, _ACTION:] = actions
        with self._lock:
            self.tick += 1
            for slot in slots:
                self._append(slot, rows[slot])
            self._steps[list(slots)] += 1
            self._reward[list(slots)] = rows[list(slots), _REWARD]
            self._changed(slots)

    @staticmethod
    def _look(env: BatchEnv) -> np.ndarray:
        """A row of every slot as it is now, without an action."""
        rows = np.full((env.num_envs, _WIDTH), np.nan, np.float32)
        if isinstance(env, SlotBatch):
            rows[:, :3] = env.ee_poses[:, :3]
        rows[:, _GRIPPER], rows[:, _REWARD] = _opening(env), env.evaluate().cumulative_reward
        return rows

    def _append(self, slot: int, row: np.ndarray) -> None:
        count = self._count[slot]
        if count >= MOST_ROWS:
            return
        if count >= len(self._rows[slot]):
            grown = np.zeros((min(MOST_ROWS, max(64, 2 * count)), _WIDTH), np.float32)
            grown[:count] = self._rows[slot][:count]
            self._rows[slot] = grown
        self._rows[slot][count] = row
        self._count[slot] += 1

    def _changed(self, slots: Sequence[int]) -> None:
        self._revision += 1
        self.revisions[list(slots)] = self._revision

    # -- on any thread -------------------------------------------------------------------------------------------------

    @property
    def revision(self) -> int:
        """Larger whenever something has changed."""
        return self._revision

    def slots(self) -> tuple[SlotState, ...]:
        """Every slot."""
        with self._lock:
            return tuple(self._slot(slot) for slot, episode in enumerate(self._episodes) if episode is not None)

    def instruction(self, slot: int) -> str:
        """What a slot follows; "" for a slot that does not exist."""
        with self._lock:
            return self._instructions[slot] if slot < len(self._instructions) else ""

    def is_ended(self, slot: int) -> bool:
        """Whether the episode in a slot has ended."""
        with self._lock:
            return slot < len(self._ended) and bool(self._ended[slot])

    def history(self, slot: int) -> History | None:
        """The columns of a slot's episode; None for a slot that does not exist."""
        with self._lock:
            if slot >= len(self._episodes) or self._episodes[slot] is None:
                return None
            rows = self._rows[slot][: self._count[slot]].copy()
            episode = self._id(slot)
        known = np.atleast_1d(np.isfinite(rows[:, :_ACTION]).all(axis=0))
        rounded = np.round(rows.astype(float), _DECIMALS)
        return History(
            slot=slot,
            episode_id=episode,
            step=tuple(range(len(rows))),
            eef_pos=tuple(map(tuple, rounded[:, :3].tolist())) if known[:3].all() else (),
            gripper=tuple(rounded[:, _GRIPPER].tolist()) if known[_GRIPPER] else (),
            reward=tuple(rounded[:, _REWARD].tolist()),
            action=tuple(map(tuple, rounded[~np.isnan(rows[:, _ACTION:]).all(axis=1), _ACTION:].tolist())),
        )

    def _slot(self, slot: int) -> SlotState:
        episode = self._episodes[slot]
        assert episode is not None
        success, ended = bool(self._success[slot]), bool(self._ended[slot])
        return SlotState(
            slot=slot,
            task=self._labels[slot],
            episode=episode.episode,
            episode_id=self._id(slot),
            instruction=self._instructions[slot],
            step=int(self._steps[slot]),
            max_steps=int(self._budgets[slot]),
            reward=float(self._reward[slot]),
            success=success,
            terminated=ended and success,
            truncated=ended and not success,
            fault=self._faults[slot],
        )

    def _id(self, slot: int) -> str:
        episode = self._episodes[slot]
        assert episode is not None
        return f"{episode.suite}/{self._labels[slot]}/{episode.episode}"


def _label(episode: Episode) -> int | str:
    """How the catalogue names a task: by index, in SIMPLER by name."""
    if not episode.suite.startswith("simpler/"):
        return episode.task
    return vecenv.list_tasks(episode.suite)[episode.task].name


def _opening(env: BatchEnv) -> np.ndarray | float:
    """Opening of the grippers, metres, [B]; NaN where proprioception does not have it."""
    state = np.asarray(env.observe_egocentric(np.zeros(env.num_envs, bool)).state)
    if env.suite.startswith("simpler/"):
        return state[:, 6] + state[:, 7] if state.shape[1] == 23 else float("nan")  # WidowX: fingers after six joints
    return state[:, 6] - state[:, 7]
