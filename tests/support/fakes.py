"""A small environment that keeps the contract without any physics, for tests of what is built on the verbs.

Episode ``e`` of an even task solves itself after ``e + 2`` ticks; odd tasks run into their budget.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, Self

import numpy as np
from vecenv_eval.config import ConfigError
from vecenv_eval.episodes import Suite
from vecenv_eval.simulator import Simulator

from vecenv.contract import Control, EePoseControl, Metrics, PlanControl, ResetInfo, State, Timings, Watcher
from vecenv.observations import Egocentric, Objects
from vecenv.placement import Placement

SUITE = "fake_suite"


class FakeEnv:
    """The verbs over a table of ticks: ``tasks`` times ``episodes`` slots."""

    suite = SUITE
    config: object = None
    control_hz = 20.0
    timings = Timings()

    def __init__(
        self,
        tasks: Sequence[int],
        episodes: Sequence[int] | Mapping[int, Sequence[int]],
        *,
        max_steps: int = 10,
        faults: Mapping[tuple[int, int], str] | None = None,
        raise_in: Mapping[int, BaseException] | None = None,
        faults_in_reset: bool = False,
    ) -> None:
        by_task = episodes if isinstance(episodes, Mapping) else dict.fromkeys(tasks, episodes)
        pairs = [(task, episode) for task in tasks for episode in by_task[task]]
        self.tasks, self.episodes = [np.array(column) for column in zip(*pairs, strict=True)]
        self.num_envs = len(self.tasks)
        self.max_steps, self.faults, self.raise_in = max_steps, faults or {}, raise_in or {}
        self.faults_in_reset, self.closed, self.placements = faults_in_reset, False, 1
        self.actions: list[np.ndarray] = []
        self._clear()

    def _clear(self) -> None:
        self.ticks = np.zeros(self.num_envs, int)
        self.terminated, self.truncated = np.zeros((2, self.num_envs), bool)

    def reset(self) -> ResetInfo:
        done = self.done & (self.ticks > 0)
        self.ticks[done], self.terminated[done], self.truncated[done] = 0, False, False
        if self.faults_in_reset:
            self.truncated |= [bool(name) for name in self._fault_names()]
        pairs = list(zip(self.tasks.tolist(), self.episodes.tolist(), strict=True))
        return ResetInfo(
            instruction=tuple(f"do thing {task}" for task, _ in pairs),
            episode_id=tuple(f"{SUITE}/{task}/{episode}" for task, episode in pairs),
            suite=SUITE,
            task_id=self.tasks,
            max_steps=np.full(self.num_envs, self.max_steps),
        )

    def set_episodes(self, *, tasks: Any = None, episodes: Any = None, slots: Any = None) -> None:
        if slots is not None:
            self.tasks[slots], self.episodes[slots] = tasks, episodes
            self.ticks[slots], self.terminated[slots], self.truncated[slots] = 0, False, False
            return
        assert len(tasks) == len(episodes) == self.num_envs
        self.tasks, self.episodes = np.array(tasks), np.array(episodes)
        self.placements += 1
        self._clear()

    def step_continuous(self, actions: Any) -> Control:
        actions = np.asarray(actions, float)
        chunk = actions[:, None] if actions.ndim == 2 else actions
        assert chunk.shape == (self.num_envs, chunk.shape[1], 7)
        before = self.ticks.copy()
        for k in range(chunk.shape[1]):
            self.actions.append(chunk[:, k])
            self._tick()
        return Control(
            reward=self.terminated.astype(float),
            terminated=self.terminated.copy(),
            truncated=self.truncated.copy(),
            success=self.terminated.copy(),
            step_index=self.ticks.copy(),
            info={
                "sanitized": np.zeros(self.num_envs, bool),
                "fault": self._fault_names(),
                "ticks": self.ticks - before,
            },
        )

    def _tick(self) -> None:
        live = ~(self.terminated | self.truncated)
        self.ticks += live
        for task, error in self.raise_in.items():
            if (live & (self.tasks == task) & (self.ticks == 3)).any():
                raise error
        faulted = np.array([bool(name) for name in self._fault_names()])
        self.terminated |= live & (self.tasks % 2 == 0) & (self.ticks >= self.episodes + 2) & ~faulted
        self.truncated |= live & ~self.terminated & ((self.ticks >= self.max_steps) | faulted)

    def _fault_names(self) -> tuple[str, ...]:
        pairs = zip(self.tasks.tolist(), self.episodes.tolist(), strict=True)
        return tuple(self.faults.get(pair, "") for pair in pairs)

    def evaluate(self) -> Metrics:
        return Metrics(
            success=self.terminated.copy(),
            num_steps=self.ticks.copy(),
            suite=SUITE,
            task_id=self.tasks,
            cumulative_reward=self.terminated.astype(float),
        )

    def step_ee_pose(self, poses: Any, hold_steps: Any = 0, *, carry: Any = False, slots: Any = None) -> EePoseControl:
        control = self.step_continuous(np.zeros((self.num_envs, 7)))
        return EePoseControl(**vars(control), error=("",) * self.num_envs)

    def step_waypoints(self, plan: Any, max_misses: int | None = None) -> PlanControl:
        control = self.step_continuous(np.zeros((self.num_envs, 7)))
        return PlanControl(**vars(control), error=("",) * self.num_envs)

    def observe_egocentric(self, slots: Any = None) -> Egocentric:
        return Egocentric(state=np.zeros((self.num_envs, 8), np.float32))

    def observe_objects(self, points: str = "surface", slots: Any = None) -> Objects:
        return Objects(snapshot=(None,) * self.num_envs, error=("a fake has no objects",) * self.num_envs)

    @property
    def placement(self) -> Placement:
        return Placement(self.tasks.copy(), self.episodes.copy())

    @property
    def done(self) -> np.ndarray:
        return self.terminated | self.truncated

    def instructions(self) -> tuple[str, ...]:
        return tuple(f"do thing {task}" for task in self.tasks.tolist())

    def end_episodes(self, slots: Any) -> None:
        self.truncated[slots] |= ~self.terminated[slots]

    def state(self) -> State:
        raise AttributeError("a fake has no physics")

    def set_state(self, state: State) -> None:
        raise AttributeError("a fake has no physics")

    def watched(self, watcher: Watcher) -> AbstractContextManager[None]:
        raise AttributeError("a fake has no ticks to watch")

    def close(self) -> None:
        self.closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class FakeWorld:
    """A suite of four tasks in two scenes (0 and 2, 1 and 3), five episodes each, and every environment made of it."""

    def __init__(
        self,
        faults: Mapping[tuple[int, int], str] | None = None,
        raise_in: Mapping[int, BaseException] | None = None,
        faults_in_reset: bool = False,
    ) -> None:
        self.faults, self.raise_in, self.faults_in_reset = faults, raise_in, faults_in_reset
        self.refuse: Exception | None = None
        self.envs: list[FakeEnv] = []
        self.suite = Suite(SUITE, tuple(f"do thing {t}" for t in range(4)), ("kitchen", "study") * 2, 5)

    def make(
        self,
        suite: str,
        *,
        tasks: Sequence[int],
        episodes: Sequence[int],
        backend: str = "native",
        seed: int = 0,
        num_threads: int | None = None,
        max_steps: int = 10,
    ) -> FakeEnv:
        assert suite == SUITE
        if self.refuse:
            raise self.refuse
        del backend, seed, num_threads
        given = {"faults": self.faults, "raise_in": self.raise_in, "faults_in_reset": self.faults_in_reset}
        self.envs.append(FakeEnv(tasks, episodes, max_steps=max_steps, **given))
        return self.envs[-1]

    @property
    def simulator(self) -> Simulator:
        return Simulator(lambda name, protocol: self.suite, self.make)


class Worlds:
    """Two suites: in the second one, the odd tasks alone are planned, which nobody solves."""

    def __init__(self) -> None:
        self.world = FakeWorld()
        self.made: list[tuple[str, int | None]] = []

    def suite(self, name: str, protocol: str) -> Suite:
        if name not in ("libero_goal", "libero_10"):
            raise ConfigError(f"unknown suite {name!r}")
        return replace(self.world.suite, name=name)

    def make(self, suite: str, *, seed: int | None = None, **arguments: Any) -> FakeEnv:
        self.made.append((suite, seed))
        env = self.world.make("fake_suite", **arguments)
        reset = env.reset

        def renamed() -> Any:
            info = reset()
            ids = tuple(text.replace("fake_suite", suite) for text in info.episode_id)
            return replace(info, suite=suite, episode_id=ids)

        env.reset = renamed  # type: ignore[method-assign]
        return env

    @property
    def simulator(self) -> Simulator:
        return Simulator(self.suite, self.make)
