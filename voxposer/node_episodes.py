"""Episodes that VoxPoser's tools have open, by the handle on the wire, and the thread that they are planned on.

In: the first snapshot of an episode and options of ``voxposer.settings``. Out: a handle, behind which
``voxposer.runtime`` keeps the episode. Episodes with the same options share a model.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from vecenv.interop.nodes import NodeError, snapshot_from_dict
from vecenv.interop.nodes.worker import Worker
from voxposer.language.llm import Llm
from voxposer.runtime import HandleError, Runtimes
from voxposer.settings import Settings

NAME = "voxposer"
# Episodes that are open at once; the one that was used longest ago is released for another.
MOST_EPISODES = 64
# Configurations that are kept although no episode is open.
_MOST_CONFIGS = 8
# Options of the batched agent that a graph decides itself, and where.
_DECIDED_BY_GRAPHS = {
    **dict.fromkeys(("max_subtasks", "passes", "wait", "idle_ticks"), "the graph's outer loop decides it"),
    "max_waypoints": "it is an option of voxposer__expand_for_settle",
    "plan": "voxposer__expand_for_settle has such options",
    "max_misses": "it is an option of voxposer__dispense_waypoint",
    "follow": "a graph follows one waypoint a call",
    "perception.source": "tools plan on the snapshot that is wired",
    "perception.camera": "tools plan on the snapshot that is wired",
}


@dataclass
class _Open:
    """The episodes of one configuration, and the model that they ask."""

    runtimes: Runtimes
    llm: Llm


class RuntimeManager:
    """Open episodes by handle, and the thread that plans them.

    Attributes:
        worker: the thread.
    """

    _shared: ClassVar[RuntimeManager | None] = None
    _sharing: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self) -> None:
        self.worker = Worker(NAME)
        self._usual: dict[str, Any] = {}
        self._opened: OrderedDict[str, _Open] = OrderedDict()
        self._handles: OrderedDict[str, _Open] = OrderedDict()

    @classmethod
    def shared(cls) -> RuntimeManager:
        """The one of this process."""
        with cls._sharing:
            cls._shared = cls._shared or cls()
            return cls._shared

    def initialize(self, **options: Any) -> None:
        """Take options for the episodes to come; those of ``voxposer__init`` come on top.

        Raises:
            InvalidInput: there is no such option, or a value cannot be used.
        """
        _settings(options)
        self.worker.open()
        self._usual = dict(options)

    def shutdown(self) -> None:
        """Release all episodes and end the thread; a question to a model ends with its present attempt."""
        for opened in list(self._opened.values()):
            opened.llm.close()
        self.worker.shutdown(self._release_all)

    def init(self, snapshot: object, options: Mapping[str, Any], episode: str) -> str:
        """Open an episode on its first snapshot, with options as ``Settings.of`` takes them; returns its handle."""
        first = snapshot_from_dict(snapshot)
        opened = self._with({**self._usual, **options})
        (handle,) = opened.runtimes.init([first], [episode] if episode else ())
        self._handles[handle] = opened
        while len(self._handles) > MOST_EPISODES:
            old, where = self._handles.popitem(last=False)
            where.runtimes.release([old])
        return handle

    def runtimes(self, handle: str) -> Runtimes:
        """Where an episode is.

        Raises:
            HandleError: no open episode has the handle.
        """
        if handle not in self._handles:
            raise HandleError(
                f"no open episode has the handle {handle[:40]!r}: it is of another process, or was released, as the "
                f"oldest is when there are more than {MOST_EPISODES}, and all are at shutdown"
            )
        self._handles.move_to_end(handle)
        return self._handles[handle].runtimes

    def _with(self, options: Mapping[str, Any]) -> _Open:
        """The episodes of one configuration; a model that no open episode uses is closed before long."""
        key = json.dumps(options, sort_keys=True, default=repr)
        if key not in self._opened:
            settings = _settings(options)
            llm = settings.open_llm()
            runtimes = Runtimes(llm, settings.agent_config(), prompts_dir=settings.prompts_dir)
            self._opened[key] = _Open(runtimes, llm)
        self._opened.move_to_end(key)
        unused = [each for each, opened in self._opened.items() if not len(opened.runtimes) and each != key]
        for each in unused[: max(0, len(self._opened) - _MOST_CONFIGS)]:
            self._opened.pop(each).llm.close()
        return self._opened[key]

    def _release_all(self) -> None:
        for handle, opened in self._handles.items():
            opened.runtimes.release([handle])
        self._handles.clear()
        self._opened.clear()


def _settings(options: Mapping[str, Any]) -> Settings:
    """Settings of options, without those that would have no effect.

    Raises:
        InvalidInput: there is no such option, a value cannot be used, or a graph decides it itself.
    """
    settings = Settings.of(options)
    for name, instead in _DECIDED_BY_GRAPHS.items():
        above, _, last = name.rpartition(".")
        if last in (settings.agent.get(above, {}) if above else settings.agent):
            raise NodeError(f"option {name} has no effect here: {instead}")
    return settings
