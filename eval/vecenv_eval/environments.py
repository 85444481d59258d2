"""The environment that runs streams of episodes: built once, re-placed while scenes stay the same, closed at the end.

A :class:`~vecenv_eval.episodes.Stream` comes in; :class:`Placed` goes out: its first episodes after their reset, and
which of them is in each slot.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vecenv import family, protocols
from vecenv.assets import AssetsMissing
from vecenv.contract import BatchEnv, ResetInfo
from vecenv.errors import VecenvError
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.episodes import Episode, Stream, Suite
from vecenv_eval.simulator import Simulator


@dataclass(frozen=True)
class Placed:
    """The first episodes of a stream in their environment, just reset.

    Attributes:
        env: the environment.
        info: what its reset returned.
        slots: the episode in each slot.
        setup_s: seconds that building, placing and resetting took.
    """

    env: BatchEnv
    info: ResetInfo
    slots: Sequence[Episode]
    setup_s: float


class Environments:
    """Builds and re-places the environment of one run.

    Args:
        simulator: builds environments.
        suite: the suite, for which tasks share a scene.
        config: what ``make`` is called with.
        on_make: called with each environment that was built.
    """

    def __init__(
        self, simulator: Simulator, suite: Suite, config: EvalConfig, on_make: Callable[[BatchEnv], None]
    ) -> None:
        self._simulator, self._suite, self._config, self._on_make = simulator, suite, config, on_make
        self._env: BatchEnv | None = None
        self._layout: tuple[Hashable, ...] = ()

    def place(self, stream: Stream) -> Placed:
        """Place a stream's first episodes and reset; an environment is built only when a slot needs another scene.

        Raises:
            ConfigError: the environment refuses a setting, or assets are missing.
            RuntimeError: it placed other episodes than were asked for.
        """
        started = time.perf_counter()
        layout = tuple(self._suite.scenes[slot.task] for slot in stream.first)
        if self._env is not None and layout == self._layout:
            self._env.set_episodes(tasks=[s.task for s in stream.first], episodes=[s.episode for s in stream.first])
        else:
            self.close()
            self._env, self._layout = self._make(stream), layout
            self._on_make(self._env)
        info = self._env.reset()
        return Placed(self._env, info, slots_of(info, stream.first), time.perf_counter() - started)

    def close(self) -> None:
        """Close the environment in use, if there is one."""
        env, self._env, self._layout = self._env, None, ()
        if env is not None:
            env.close()

    def _make(self, stream: Stream) -> BatchEnv:
        """Build an environment. A value it refuses is the config's fault: no other stream would fare better."""
        episodes = {t: [slot.episode for slot in stream.first if slot.task == t] for t in stream.tasks}
        arguments = {"tasks": list(stream.tasks), "episodes": episodes, **make_arguments(self._config)}
        try:
            return self._simulator.make(stream.suite, **arguments)
        except AssetsMissing as error:
            raise ConfigError(str(error)) from error
        except (VecenvError, ValueError) as error:
            raise ConfigError(f"{type(error).__name__}: {error}") from error


def make_arguments(config: EvalConfig) -> dict[str, Any]:
    """Keyword arguments of ``make`` for every stream, without tasks and episodes."""
    arguments = {"backend": config.backend, "num_threads": config.num_threads, **config.env_args}
    given: dict[str, Any] = {"max_steps": config.max_steps}
    if family(config.suite) == protocols.LIBERO:  # SIMPLER's episodes depend on their number alone
        given["seed"] = config.seed
    given |= image_arguments(config)
    if config.protocol != protocols.DEFAULT:
        given["protocol"] = config.protocol
    return {**arguments, **{name: value for name, value in given.items() if value is not None}}


def image_arguments(config: EvalConfig) -> dict[str, Any]:
    """Keyword arguments of ``make`` that decide images: ``render`` and ``cameras``, as far as they are given.

    Raises:
        ConfigError: SIMPLER's images do not have the option.
    """
    images = {"height": config.image_size, "width": config.image_size, "lod": config.lod, "colors": config.colors}
    wanted = {name: value for name, value in images.items() if value is not None}
    arguments: dict[str, Any] = {"cameras": config.camera_names} if config.camera_names else {}
    if not wanted:
        return arguments
    if family(config.suite) != protocols.LIBERO:
        given = [option for option in ("image_size", "lod", "colors") if getattr(config, option) is not None]
        options = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise ConfigError(f"{config.suite} does not take {options}: SIMPLER's images are fixed")
    return {**arguments, "render": {**_render_of(config.env_args), **wanted}}


def _render_of(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """What ``--env-arg render=...`` says, to which the other options are added."""
    given = arguments.get("render", {})
    if not isinstance(given, Mapping):
        raise ConfigError(f"render={given!r}: expected a mapping of RenderConfig's fields")
    return given


def slots_of(info: ResetInfo, expected: Sequence[Episode]) -> list[Episode]:
    """The episode in each slot, as the environment reports it; together they must be those asked for."""
    numbers = [int(text.rsplit("/", 1)[1]) for text in info.episode_id]
    slots = [Episode(info.suite, int(task), number) for task, number in zip(info.task_id, numbers, strict=True)]
    if sorted(slots) != sorted(expected):
        raise RuntimeError(f"the environment placed {len(slots)} other episodes than the {len(expected)} asked for")
    return slots
