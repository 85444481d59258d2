"""The panel of a node set: which episode runs, in cascaded fields, and play, pause, stop and reset.

A change of a field sets the fields below it to their first values, places the episode, and emits the signal
``episode_reset`` with a snapshot of the cascade. ``reset`` puts the same episode back to its start and emits it too.
``play`` places the selected episode again and asks for the run to start; after ``pause`` it goes on where it was. A
response carries at most one side effect, the signal or the start of a run; ``pause`` and ``stop`` change the state.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from vecenv.errors import VecenvError
from vecenv.interop.nodes.catalog import Selection
from vecenv.interop.nodes.manager import EnvManager
from vecenv.interop.nodes.tool import described

ACTIONS = ("play", "pause", "stop", "reset")
EPISODE_RESET: Literal["episode_reset"] = "episode_reset"
State = Literal["idle", "playing", "paused"]
Listener = Callable[[str, dict[str, str | int]], None]
_log = logging.getLogger(__name__)


class Option(BaseModel):
    """A value that a field offers, with what people read."""

    model_config = ConfigDict(frozen=True)

    value: str | int
    label: str


class Field(BaseModel):
    """A select field of the panel, with the value that it has and those that it offers."""

    model_config = ConfigDict(frozen=True)

    name: str
    value: str | int
    default: str | int
    options: list[Option]


class PanelResponse(BaseModel):
    """What a change or an action answers.

    Attributes:
        state: of the panel.
        fields: name -> value, after it.
        signal_name: ``episode_reset``, or None.
        snapshot: the cascade that goes with the signal, or None.
        run_start: the run is to start.
        step_budget: of the selected episode, control ticks; None where it is not known before it is placed.
        error: why nothing was changed; empty if it was.
    """

    model_config = ConfigDict(frozen=True)

    state: State
    fields: dict[str, str | int]
    signal_name: Literal["episode_reset"] | None = None
    snapshot: dict[str, str | int] | None = None
    run_start: bool = False
    step_budget: int | None = None
    error: str = ""


class EnvPanel:
    """The panel of the environment of a manager; several threads may use it.

    Args:
        manager: places the episodes, and knows which is selected.
        step_budget: control ticks of an episode before any is placed.
    """

    def __init__(self, manager: EnvManager, step_budget: Callable[[Selection], int | None]) -> None:
        self._manager, self._catalog = manager, manager.catalog
        self._budget = step_budget
        self._lock = threading.RLock()
        self._state: State = "idle"
        self._listeners: list[Listener] = []

    @property
    def state(self) -> State:
        """``idle``, ``playing`` or ``paused``."""
        return self._state

    @property
    def values(self) -> dict[str, str | int]:
        """The selected episode, by the names of the fields."""
        return self._catalog.snapshot(self._manager.selection)

    @property
    def step_budget(self) -> int | None:
        """Control ticks of the selected episode."""
        episode, selection = self._manager.episode, self._manager.selection
        if episode is not None and episode.selection == selection:
            return episode.max_steps
        return self._budget(selection)

    def fields(self) -> list[Field]:
        """The fields from the top of the cascade to its end."""
        selection = self._manager.selection
        values = self._catalog.snapshot(selection)
        default = self._catalog.beginning(selection.head)
        tops = (self._catalog.first().head, default.task, default.episode)
        return [
            Field(
                name=name,
                value=values[name],
                default=tops[level],
                options=[Option(value=value, label=label) for value, label in self._catalog.choices(level, selection)],
            )
            for level, name in enumerate(self._catalog.fields)
        ]

    def subscribe(self, listener: Listener) -> None:
        """Call a function with every signal and its snapshot, such as ``on_signal`` of another node set."""
        self._listeners.append(listener)

    def set_field(self, name: str, value: Any) -> PanelResponse:
        """Select a value; the fields below begin anew, the episode is placed, and ``episode_reset`` is emitted.

        LIBERO's ``suite`` is also known as ``split``. A number may come as text. Nothing is raised: ``error`` says what
        is wrong, and the selection stays what it was.
        """
        with self._lock:
            return self._placed(lambda: self._catalog.changed(self._manager.selection, name, value), "idle")

    def action(self, name: str) -> PanelResponse:
        """``play``, ``pause``, ``stop`` or ``reset``; nothing is raised, ``error`` says what is wrong."""
        with self._lock:
            if name not in ACTIONS:
                return self._response(error=f"action {str(name)[:80]!r} does not exist; there are {', '.join(ACTIONS)}")
            if name == "reset":
                return self._placed(lambda: self._manager.selection, "idle")
            if name == "play":
                return self._played()
            if name == "pause" and self._state != "playing":
                return self._response(error=f"nothing is playing: the panel is {self._state}")
            self._state = "paused" if name == "pause" else "idle"
            return self._response()

    def _played(self) -> PanelResponse:
        if self._state == "paused":
            self._state = "playing"
            return self._response()
        if error := self._seat(lambda: self._manager.selection):
            return self._response(error=error)
        self._state = "playing"
        return self._response(run_start=True)

    def _placed(self, choose: Callable[[], Selection], state: State) -> PanelResponse:
        if error := self._seat(choose):
            return self._response(error=error)
        self._state = state
        for listener in self._listeners:
            try:
                listener(EPISODE_RESET, self.values)
            except Exception:
                _log.exception("%s: a listener of the panel failed", self._manager.name)
        return self._response(signal_name=EPISODE_RESET, snapshot=self.values)

    def _seat(self, choose: Callable[[], Selection]) -> str:
        """Place an episode; the text of what went wrong."""
        try:
            self._manager.set_episode(choose())
        except Exception as error:
            if not isinstance(error, VecenvError):
                _log.warning("%s: an episode cannot be placed", self._manager.name, exc_info=True)
            return described(error)
        return ""

    def _response(self, **fields: Any) -> PanelResponse:
        return PanelResponse(state=self._state, fields=self.values, step_budget=self.step_budget, **fields)
