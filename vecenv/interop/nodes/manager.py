"""The environment behind a node set: one slot, on one thread, with the episode that the panel selected.

A :class:`EnvManager` makes the environment when it is first needed, places episodes, and keeps what an episode knows
about itself. Whatever touches the simulator is a job for :meth:`EnvManager.run`, which calls it with the environment on
the manager's thread; jobs of several tools take turns.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self, TypeVar, cast

import numpy as np

import vecenv
from vecenv.contract import BatchEnv, Control, ResetInfo
from vecenv.interop.nodes.catalog import Catalog, Selection
from vecenv.interop.nodes.ports import NodeError
from vecenv.interop.nodes.worker import Worker
from vecenv.slots import SlotBatch

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class EpisodeInfo:
    """What an episode says of itself when it begins.

    Attributes:
        selection: which it is.
        instruction: what a policy is told.
        max_steps: its budget, control ticks.
        home: pose of the hand at its start, xyz + wxyz, [7].
    """

    selection: Selection
    instruction: str
    max_steps: int
    home: np.ndarray


@dataclass(frozen=True)
class Flags:
    """The control signals after the latest step; what tools report after an error."""

    terminated: bool = False
    truncated: bool = False
    success: bool = False
    step_index: int = 0

    @classmethod
    def of(cls, control: Control) -> Self:
        """Those of the only slot of a batch."""
        names = ("terminated", "truncated", "success", "step_index")
        return cls(**{name: getattr(control, name)[0].item() for name in names})


class EnvManager:
    """Owner of the environment of a node set; see the module.

    Args:
        name: of the node set.
        catalog: which episodes there are.
        options: of ``vecenv.make``.
        keep: environments of other suites stay open until :meth:`shutdown`, because closing one is not safe while the
            process goes on (SAPIEN).

    Attributes:
        catalog: which episodes there are.
        worker: the thread.
        closed_grip: whether the gripper was last told to close.
    """

    _shared: ClassVar[dict[str, EnvManager]] = {}
    _sharing: ClassVar[threading.Lock] = threading.Lock()

    def __init__(
        self, name: str, catalog: Catalog, options: Mapping[str, Any] | None = None, *, keep: bool = False
    ) -> None:
        self.name, self.catalog = name, catalog
        self.worker = Worker(name)
        self.closed_grip = False
        self._usual, self._keep = dict(options or {}), keep
        self._options = dict(self._usual)
        self._selection = catalog.first()
        self._envs: dict[str, BatchEnv] = {}
        self._episode: EpisodeInfo | None = None
        self._flags = Flags()

    @classmethod
    def shared(cls, name: str, make: Callable[[], EnvManager]) -> EnvManager:
        """The one manager of this process that has a name; made when it is first asked for."""
        with cls._sharing:
            if name not in cls._shared:
                cls._shared[name] = make()
            return cls._shared[name]

    # -- lifecycle -----------------------------------------------------------------------------------------------------

    def initialize(self, **options: Any) -> None:
        """Take options of ``vecenv.make`` for the environments to come; one that is open with others is closed.

        Raises:
            OptionError: an option that suites of this kind do not have, or a value of a wrong type.
        """
        wanted = {**self._usual, **options}
        vecenv.make_config(self.catalog.suite(self.catalog.heads[0]), wanted)
        self.worker.open()
        if wanted != self._options:
            self.worker.call(self._close)
            self._options = wanted

    def shutdown(self) -> None:
        """Close the environments and end the thread; :meth:`initialize` begins again."""
        self.worker.shutdown(self._close)

    def _close(self) -> None:
        for env in self._envs.values():
            env.close()
        self._envs, self._episode, self._flags = {}, None, Flags()

    # -- episodes ------------------------------------------------------------------------------------------------------

    @property
    def options(self) -> Mapping[str, Any]:
        """Options of ``vecenv.make`` that were given."""
        return self._options

    @property
    def selection(self) -> Selection:
        """The episode that is selected; it is placed when it is first needed."""
        return self._selection

    @property
    def episode(self) -> EpisodeInfo | None:
        """The episode that is placed, None before the first."""
        return self._episode

    @property
    def flags(self) -> Flags:
        """Control signals after the latest step."""
        return self._flags

    def set_episode(self, selection: Selection) -> EpisodeInfo:
        """Place an episode at its start.

        Raises:
            VecenvError: it cannot be made; the selection stays what it was.
        """
        return self.worker.call(lambda: self._place(selection))

    def ensure_live(self) -> EpisodeInfo:
        """The live episode as it is; a finished one begins again; before the first, the selected one is placed."""

        def job() -> EpisodeInfo:
            if self._episode is None:
                return self._place(self._selection)
            env = self._env(self._episode.selection)
            if env.done[0]:
                self._begin(env, self._episode.selection)
            # An instruction may have changed on the way, in tasks of two halves.
            return replace(self._episode, instruction=env.instructions()[0])

        return self.worker.call(job)

    def run(self, job: Callable[[BatchEnv, EpisodeInfo], _Result]) -> _Result:
        """Call a job with the environment and its episode, on the manager's thread.

        Raises:
            NodeError: no episode is placed.
        """

        def with_env() -> _Result:
            if self._episode is None:
                raise NodeError(f"no episode is placed yet: run {self.name}__reset, or choose one in the panel")
            return job(self._env(self._episode.selection), self._episode)

        return self.worker.call(with_env)

    def stepped(self, control: Control, grip: bool | None = None) -> Control:
        """Remember the signals of a step, and whether it closed the gripper; a job calls it after each."""
        self._flags = Flags.of(control)
        if grip is not None and int(control.info["ticks"][0]):
            self.closed_grip = grip
        return control

    def _env(self, selection: Selection) -> BatchEnv:
        return self._envs[self.catalog.suite(selection.head)]

    def _place(self, selection: Selection) -> EpisodeInfo:
        suite, task = self.catalog.suite(selection.head), self.catalog.task_index(selection)
        try:
            if suite not in self._envs:
                self._drop([] if self._keep else list(self._envs))
                self._envs[suite] = vecenv.make(suite, task=task, episodes=[selection.episode], **self._options)
            else:
                self._envs[suite].set_episodes(tasks=[task], episodes=[selection.episode])
            info = self._begin(self._envs[suite], selection)
        except Exception:
            # Half placed: the next one begins with a new environment.
            self._episode = None
            self._drop([suite])
            raise
        self._selection = selection
        return info

    def _drop(self, suites: list[str]) -> None:
        for suite in suites:
            env = self._envs.pop(suite, None)
            if env is not None:
                env.close()

    def _begin(self, env: BatchEnv, selection: Selection) -> EpisodeInfo:
        info: ResetInfo = env.reset()
        home = cast(SlotBatch, env).ee_poses[0]
        # Physics that fails at the start ends the episode before its first tick.
        self.closed_grip, self._flags = False, Flags(truncated=bool(env.done[0]))
        self._episode = EpisodeInfo(selection, info.instruction[0], int(info.max_steps[0]), home)
        return self._episode
