"""LIBERO slots that change to any task of a suite while the others continue.

A LIBERO batch lets a slot change to tasks of its own scene. Here a slot that needs another scene moves into another
batch, and its old row rests; when all slots begin together they are one batch again. So the order in which slots change
costs speed (several small batches instead of one), never exactness: no running episode is touched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

import vecenv
from vecenv.contract import ACTION_DIM
from vecenv.libero.env import LiberoEnv
from vecenv.libero.tasks.suites import list_tasks
from vecenv.observations import Egocentric, Rendered


class _Part:
    """A batch and which slot each of its rows is; -1 for a row that rests."""

    def __init__(self, env: LiberoEnv, slots: np.ndarray) -> None:
        self.env, self.slots = env, slots

    @property
    def rows(self) -> np.ndarray:
        """The rows in use."""
        return np.flatnonzero(self.slots >= 0)

    def begin(self) -> None:
        """Begin what was placed; resting rows rest on."""
        self.env.reset()
        self.env.end_episodes(self.slots < 0)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One tick with the actions [B, 7] of all slots; returns success and failure of each row in use."""
        given = np.zeros((len(self.slots), ACTION_DIM))
        given[self.rows] = actions[self.slots[self.rows]]
        control = self.env.step_continuous(given)
        return control.success[self.rows], control.truncated[self.rows]


class ScatteredBatch:
    """LIBERO slots that change to any task of a suite while the others continue.

    Args:
        suite: a LIBERO suite.
        num_envs: slots, B.
        fields: options of ``vecenv.make``; the budget must not end episodes.
    """

    def __init__(self, suite: str, num_envs: int, fields: Mapping[str, object]) -> None:
        self.suite, self.num_envs, self._fields = suite, num_envs, dict(fields)
        vecenv.make_config(suite, self._fields)
        self._tasks = list_tasks(suite)
        self._parts: list[_Part] = []
        self._instructions = [""] * num_envs

    @property
    def num_batches(self) -> int:
        """How many batches the slots are in at present."""
        return len(self._parts)

    def instructions(self) -> tuple[str, ...]:
        """What each slot's policy is told."""
        return tuple(self._instructions)

    def begin(self, slots: np.ndarray, tasks: np.ndarray, episodes: np.ndarray) -> None:
        """Begin episodes of any tasks in some slots, int [n] each; the others continue."""
        order = np.argsort(slots)
        slots, tasks, episodes = slots[order], tasks[order], episodes[order]
        moving = np.ones(len(slots), bool)
        if len(slots) < self.num_envs:
            for part in self._parts:
                moving &= ~self._begin_in_place(part, slots, tasks, episodes)
        elif len(self._parts) == 1 and len(self._parts[0].slots) == self.num_envs:
            moving[:] = False
            self._parts[0].env.set_episodes(tasks=tasks.tolist(), episodes=episodes.tolist())
            self._parts[0].slots = slots
            self._parts[0].begin()
        if moving.any():
            self._move(slots[moving], tasks[moving], episodes[moving])
        for slot, task in zip(slots.tolist(), tasks.tolist(), strict=True):
            self._instructions[slot] = self._tasks[task].instruction

    def _begin_in_place(self, part: _Part, slots: np.ndarray, tasks: np.ndarray, episodes: np.ndarray) -> np.ndarray:
        """Begin in a part what fits into its rows' scenes; returns which of ``slots`` that were, bool [n]."""
        begun = np.zeros(len(slots), bool)
        rows = []
        for row in part.rows.tolist():
            (at,) = np.flatnonzero(slots == part.slots[row])[:1] if part.slots[row] in slots else (None,)
            if at is not None and self._scene(int(part.env.placement.task[row])) == self._scene(int(tasks[at])):
                begun[at] = True
                rows.append((row, int(tasks[at]), int(episodes[at])))
        if rows:
            chosen, new_tasks, new_episodes = (list(column) for column in zip(*rows, strict=True))
            part.env.set_episodes(tasks=new_tasks, episodes=new_episodes, slots=chosen)
            part.begin()
        return begun

    def _scene(self, task: int) -> object:
        return self._tasks[task].problem().scene_key()

    def _move(self, slots: np.ndarray, tasks: np.ndarray, episodes: np.ndarray) -> None:
        """Begin in a batch of its own, and let the old rows rest."""
        for part in self._parts:
            part.slots = np.where(np.isin(part.slots, slots), -1, part.slots)
            if len(part.rows):
                part.env.end_episodes(part.slots < 0)
            else:
                part.env.close()
        self._parts = [part for part in self._parts if len(part.rows)]
        fields: dict[str, Any] = dict(self._fields)
        env = vecenv.make(self.suite, tasks=[int(tasks[0])], episodes=[0] * len(slots), **fields)
        assert isinstance(env, LiberoEnv)
        env.set_episodes(tasks=tasks.tolist(), episodes=episodes.tolist())
        self._parts.append(_Part(env, slots.copy()))
        self._parts[-1].begin()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One tick with actions [B, 7].

        Returns:
            Whether each slot's goal holds, and whether its physics failed, bool [B] each.
        """
        success, failed = np.zeros((2, self.num_envs), bool)
        if len(self._parts) > 1:
            with ThreadPoolExecutor(len(self._parts)) as pool:
                results = list(pool.map(lambda part: part.step(actions), self._parts))
        else:
            results = [part.step(actions) for part in self._parts]
        for part, (solved, broken) in zip(self._parts, results, strict=True):
            slots = part.slots[part.rows]
            success[slots], failed[slots] = solved, broken
        return success, failed

    def observe(self) -> Egocentric:
        """Proprioception and images of every slot; images are rendered when they are read."""
        seen = [part.env.observe_egocentric(slots=part.rows) for part in self._parts]
        state = self._joined([each.state for each in seen])

        def draw(names: Sequence[str]) -> dict[str, np.ndarray]:
            for each in seen:
                assert isinstance(each.images, Rendered)
                each.images.prepare(*names)
            return {name: self._joined([each.images[name] for each in seen]) for name in names}

        return Egocentric(state=state, images=Rendered(list(seen[0].images), draw))

    def _joined(self, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Rows of all parts in the order of the slots."""
        out = np.zeros((self.num_envs, *arrays[0].shape[1:]), arrays[0].dtype)
        for part, array in zip(self._parts, arrays, strict=True):
            out[part.slots[part.rows]] = array[part.rows]
        return out

    def close(self) -> None:
        """Release all batches; closing twice is harmless."""
        for part in self._parts:
            part.env.close()
        self._parts = []
