"""Who sees the environment of a live session on its own thread, as the 3-D view does."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Protocol

from vecenv.contract import BatchEnv
from vecenv_eval.policies import raised
from voxposer.planned import PlannedMotion

_log = logging.getLogger(__name__)


class Observer(Protocol):
    """Sees the environment; what it raises is logged and ends nothing."""

    def placed(self, env: BatchEnv) -> None:
        """Episodes stand at their start, perhaps in another environment."""
        ...

    def tick(self, env: BatchEnv) -> None:
        """A tick is about to happen, or a call of the policy has ended; called often, so be quick."""
        ...

    def planned(self, motion: PlannedMotion) -> None:
        """VoxPoser has planned a motion."""
        ...

    def lost(self) -> None:
        """The environment is about to be closed."""
        ...


class Observers:
    """Several observers, told one after the other."""

    def __init__(self) -> None:
        self._all: list[Observer] = []

    def add(self, observer: Observer) -> None:
        """Tell one more from now on."""
        self._all.append(observer)

    def placed(self, env: BatchEnv) -> None:
        """Tell all."""
        self._tell(lambda each: each.placed(env))

    def tick(self, env: BatchEnv) -> None:
        """Tell all."""
        self._tell(lambda each: each.tick(env))

    def planned(self, motion: PlannedMotion) -> None:
        """Tell all."""
        self._tell(lambda each: each.planned(motion))

    def lost(self) -> None:
        """Tell all."""
        self._tell(lambda each: each.lost())

    def _tell(self, what: Callable[[Observer], None]) -> None:
        for observer in tuple(self._all):
            try:
                what(observer)
            except Exception as error:  # who only watches ends nothing
                _log.warning("%s: %s", type(observer).__name__, raised(error))
