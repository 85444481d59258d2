"""The state of one slot, as frozen values and a table of the transitions between its phases.

In: events of a round (a program asked for motions, a path was planned, an object arrived, an error). Out: a
:class:`Slot` whose phase, progress, grip and counts are each replaced by a new frozen value. Nothing here looks at the
scene or plans; ``voxposer.runtime`` and ``voxposer.motions`` decide which event happened.

A slot is *ready* until the program of its next subtask asks for motions, then *moving* while some of them are not yet
planned. A motion of an object makes it *pushing*, one push a round, until the object has arrived; the other motions of
the subtask wait. *Stopped* is final; *unanswered* is stopped because the language model could not be asked.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from vecenv.observations import ObjectsSnapshot
from voxposer.interface import Interface
from voxposer.language.lmp import Lmps
from voxposer.pushing import PushTask
from voxposer.requests import MotionRequest

# Why a slot stops that has done all that it was told.
FOLLOWED = "followed to the end without success"


@dataclass(frozen=True)
class Ready:
    """No motion is pending; the program of the next subtask runs in the next round."""


@dataclass(frozen=True)
class Moving:
    """A program has asked for motions that are not planned yet: ``requests``, at least one, in order.

    The first of them was planned ``iterations`` times; it is planned again until the hand has reached its targets.
    """

    requests: tuple[MotionRequest, ...]
    iterations: int = 0


@dataclass(frozen=True)
class Pushing:
    """An object is pushed along its way (``task``); ``requests`` are planned after it has arrived."""

    task: PushTask
    requests: tuple[MotionRequest, ...] = ()


@dataclass(frozen=True)
class Stopped:
    """Nothing more is tried, for the reason ``cause``."""

    cause: str


@dataclass(frozen=True)
class Unanswered(Stopped):
    """The language model could not be asked, for the reason ``cause``: the episode ends without a verdict."""


Phase = Ready | Moving | Pushing | Stopped

# Phase -> phases that may follow it.
TRANSITIONS: Mapping[type, tuple[type, ...]] = MappingProxyType(
    {
        # A program asked for motions; or an error, no snapshot, no subtask left.
        Ready: (Moving, Stopped, Unanswered),
        # A motion was planned, others wait or none is left; an object is to be pushed; there is no path; abandoned.
        Moving: (Moving, Ready, Pushing, Stopped),
        # The object has arrived, other motions wait or none is left; or there is no room to push it.
        Pushing: (Moving, Ready, Stopped),
        Stopped: (),
        Unanswered: (),
    }
)


def pending(requests: tuple[MotionRequest, ...]) -> Ready | Moving:
    """The phase of a slot that pushes nothing and has these motions left to plan."""
    return Moving(requests) if requests else Ready()


@dataclass(frozen=True)
class Progress:
    """How far a slot is with its instruction.

    Attributes:
        subtasks: what the planner split the instruction into, latest pass.
        first: the same of the first pass.
        cursor: index of the next subtask.
        passes: how often the instruction was planned.
        begun: subtasks begun in all passes.
        text: the latest subtask.
        unfinished: index of a subtask of which something is left to plan, None for none.
    """

    subtasks: tuple[str, ...] = ()
    first: tuple[str, ...] = ()
    cursor: int = 0
    passes: int = 0
    begun: int = 0
    text: str = ""
    unfinished: int | None = None

    @property
    def has_next(self) -> bool:
        """Whether a subtask of this pass is left."""
        return self.cursor < len(self.subtasks)

    @property
    def number(self) -> int:
        """Number of the latest subtask, from 0, counted over all passes."""
        return self.begun - 1

    def advanced(self) -> Progress:
        """With the next subtask begun."""
        return replace(self, text=self.subtasks[self.cursor], cursor=self.cursor + 1, begun=self.begun + 1)

    def at(self, subtasks: tuple[str, ...], index: int) -> Progress:
        """With ``index`` as the next subtask; past it, where it is the unfinished one."""
        cursor = self.cursor if index == self.unfinished else index
        return replace(self, subtasks=subtasks, cursor=cursor, unfinished=None)


@dataclass(frozen=True)
class Grasp:
    """A grasp that a plan ends with: the object, and the position [3] relative to its origin, world axes, metres."""

    name: str
    offset: np.ndarray


@dataclass(frozen=True)
class Grip:
    """What a slot knows about its grip.

    Attributes:
        closed: the last command.
        grasp: the grasp that the latest plan ended with, until it is checked.
        failed: by object, offsets of grasps that did not hold.
    """

    closed: bool = False
    grasp: Grasp | None = None
    failed: Mapping[str, tuple[np.ndarray, ...]] = field(default_factory=lambda: MappingProxyType({}))

    def checked(self, *, held: bool) -> Grip:
        """After the latest grasp, if there was one, turned out to hold or not."""
        if self.grasp is None or held:
            return replace(self, grasp=None)
        tried = (*self.failed.get(self.grasp.name, ()), self.grasp.offset)
        return replace(self, grasp=None, failed=MappingProxyType({**self.failed, self.grasp.name: tried}))


@dataclass(frozen=True)
class Counts:
    """Counts of an episode: ``waypoints`` planned, ``missed`` waypoints, ``empty_grasps`` that did not hold."""

    waypoints: int = 0
    missed: int = 0
    empty_grasps: int = 0


@dataclass(frozen=True)
class Latest:
    """The subtask that was planned last.

    Attributes:
        movable: what its last motion moves.
        object_centric: whether that is an object, to be pushed.
        calls: its questions to the model, as a range of the trace.
    """

    movable: str = ""
    object_centric: bool = False
    calls: range = range(0)


@dataclass(eq=False)
class Slot:
    """One slot: its language programs, and its present state.

    Attributes:
        instruction: the task in words.
        lmps: its language programs.
        interface: the functions that they call.
        home: pose of the hand when the episode began, xyz + wxyz, [7].
        phase: what happens next; changed by :meth:`enter` alone.
        progress: how far it is with its instruction.
        grip: what it knows about its grip.
        counts: what the episode took so far.
        latest: the subtask that was planned last.
        snapshot: the latest one, None where there is none.
        missing: what the latest look did not find, in a sentence; "" for nothing.
    """

    instruction: str
    lmps: Lmps
    interface: Interface
    home: np.ndarray
    phase: Phase = field(default_factory=Ready)
    progress: Progress = field(default_factory=Progress)
    grip: Grip = field(default_factory=Grip)
    counts: Counts = field(default_factory=Counts)
    latest: Latest = field(default_factory=Latest)
    snapshot: ObjectsSnapshot | None = None
    missing: str = ""

    @property
    def cause(self) -> str:
        """Why nothing more is tried, "" while something is."""
        return self.phase.cause if isinstance(self.phase, Stopped) else ""

    @property
    def error(self) -> str:
        """Why the episode has no verdict: the language model could not be asked; "" while it could."""
        return self.phase.cause if isinstance(self.phase, Unanswered) else ""

    @property
    def requests(self) -> tuple[MotionRequest, ...]:
        """Motions that are asked for and not planned yet."""
        return self.phase.requests if isinstance(self.phase, Moving | Pushing) else ()

    def enter(self, phase: Phase) -> None:
        """Go over to a phase that :data:`TRANSITIONS` allows."""
        assert type(phase) in TRANSITIONS[type(self.phase)], f"{self.phase} -> {phase}"
        self.phase = phase

    def stop(self, cause: str) -> None:
        """Try nothing more."""
        self.enter(Stopped(cause))

    def give_up(self, cause: str) -> None:
        """End without a verdict: the language model could not be asked."""
        self.enter(Unanswered(cause))

    def resume(self, subtasks: tuple[str, ...], index: int) -> None:
        """Go on with a subtask: the one under way if ``index`` is its, else that one is abandoned."""
        if index != self.progress.unfinished and not isinstance(self.phase, Ready):
            self.enter(Ready())
        self.progress = self.progress.at(subtasks, index)

    def close_grip(self, closed: bool) -> None:
        """Record the last grip command of a plan."""
        self.grip = replace(self.grip, closed=closed)
