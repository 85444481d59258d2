"""A small world for live sessions: the fake environment with ticks that can be watched and images that can be drawn.

An image of a slot is of one colour, which tells slot and tick apart, or noise, of which JPEG files are large.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from vecenv_eval.config import EvalConfig
from vecenv_eval.panel.session import Session

from support.fakes import FakeEnv, FakeWorld
from vecenv.contract import Watcher
from vecenv.observations import Egocentric, Rendered

CAMERAS = ("agentview", "wrist")
SIDE = 64


class LiveEnv(FakeEnv):
    """Calls watchers before ticks, and draws."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.watchers: list[Watcher] = []
        self.drawn: list[tuple[int, str]] = []
        self.broken: Exception | None = None
        self.noise: np.ndarray | None = None

    @contextmanager
    def watched(self, watcher: Watcher) -> Iterator[None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        self.watchers.append(watcher)
        try:
            yield
        finally:
            self.watchers.remove(watcher)

    def _tick(self) -> None:
        if not self.done.all():
            for watcher in self.watchers:
                watcher(self.actions[-1], ~self.done)
        super()._tick()

    def observe_egocentric(self, slots: Any = None) -> Egocentric:
        chosen = np.arange(self.num_envs) if slots is None else np.arange(self.num_envs)[np.asarray(slots)]
        return Egocentric(
            state=np.zeros((self.num_envs, 8), np.float32),
            images=Rendered(CAMERAS, lambda names: self._draw(chosen.tolist(), names)),
        )

    def _draw(self, slots: Sequence[int], names: Sequence[str]) -> Mapping[str, np.ndarray]:
        if self.broken:
            raise self.broken
        self.drawn += [(slot, name) for slot in slots for name in names]
        if self.noise is not None:
            return dict.fromkeys(names, np.broadcast_to(self.noise, (self.num_envs, *self.noise.shape)))
        images = np.zeros((self.num_envs, SIDE, SIDE, 3), np.uint8)
        for slot in slots:
            images[slot] = color(slot, int(self.ticks[slot]))
        return dict.fromkeys(names, images)


def color(slot: int, tick: int) -> tuple[int, int, int]:
    """What an image of a slot shows."""
    return 40 + 20 * (slot % 10), 10 * (tick % 20), 100


class LiveWorld(FakeWorld):
    """Makes such environments."""

    @property
    def last(self) -> LiveEnv:
        """The environment that was made last."""
        env = self.envs[-1]
        assert isinstance(env, LiveEnv)
        return env

    def make(self, suite: str, **options: Any) -> LiveEnv:
        made = FakeWorld.make(self, suite, **options)
        env = LiveEnv(
            made.tasks[:1].tolist(), {int(made.tasks[0]): made.episodes[:1].tolist()}, max_steps=made.max_steps
        )
        env.tasks, env.episodes, env.num_envs = made.tasks, made.episodes, made.num_envs
        env.faults, env.raise_in = made.faults, made.raise_in
        env._clear()
        self.envs[-1] = env
        return env


def config(**settings: Any) -> EvalConfig:
    """Tasks 0 and 1, three episodes each, six slots; task 0 solves itself, task 1 ends after ten ticks."""
    return EvalConfig.from_dict({"suite": "fake_suite", "policy": "zero", "tasks": "0-1", "episodes": "3", **settings})


def session(world: LiveWorld | None = None, **options: Any) -> Session:
    """A session in such a world, with :func:`config` unless another is given."""
    world = world or LiveWorld()
    given = options.pop("config", config())
    return Session(given, simulator=world.simulator, **options)
