"""What a live session publishes: its state, its slots, the columns of an episode, and what is planned.

Every value is frozen: the thread that owns the environment makes a new one, and any other thread may read it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vecenv.errors import InvalidInput, NotFound, SimulationError

# "idle": nothing was built. "building": an environment and a policy are made, or episodes are placed. "ready": episodes
# are at their start. "playing", "paused": a run goes on, or waits. "finished": it has ended or was stopped. "error":
# something failed; ``SessionState.error`` says what.
StateName = Literal["idle", "building", "ready", "playing", "paused", "finished", "error"]
# What tiles of the wall are framed for.
Verdict = Literal["live", "success", "failure", "fault"]


class SessionError(InvalidInput):
    """A live session was asked for something that does not exist or that it cannot do; the message says why."""


class OutOfTurn(SessionError):
    """It cannot do that in its present state."""


class UnknownSlot(NotFound):
    """There is no such slot."""


class SessionClosed(SimulationError):
    """The session was closed."""


@dataclass(frozen=True, kw_only=True)
class SlotState:
    """One slot.

    Attributes:
        slot: its index.
        task: index of its task; the name in SIMPLER.
        episode: number of its episode.
        episode_id: ``"{suite}/{task}/{episode}"``.
        instruction: what the policy is told.
        step: control ticks executed in the episode.
        max_steps: its step budget, control ticks.
        reward: sum of rewards.
        success: the task is solved.
        terminated: the episode ended because the task was solved.
        truncated: it ended because the budget ran out or the physics failed.
        fault: why the physics failed, or why the policy could not act; None while all is well.
    """

    slot: int
    task: int | str
    episode: int
    episode_id: str
    instruction: str
    step: int
    max_steps: int
    reward: float
    success: bool
    terminated: bool
    truncated: bool
    fault: str | None = None

    @property
    def verdict(self) -> Verdict:
        """What is known about the episode."""
        if self.fault:
            return "fault"
        if self.terminated or (self.truncated and self.success):
            return "success"
        return "failure" if self.truncated else "live"


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """A stop of the hand: position (xyz, metres) and rotation (wxyz), world frame; whether the grip is closed there."""

    # Lengths are not in the types: OpenAPI's schemas of tuples of a fixed length are not read by every tool.
    pos: tuple[float, ...]
    quat: tuple[float, ...]
    closed: bool


@dataclass(frozen=True, kw_only=True)
class Planning:
    """What VoxPoser last planned in a slot.

    Attributes:
        slot: the slot.
        instruction: what it follows.
        subtasks: what the instruction was split into.
        subtask: number of the present subtask, from 0, counted over all passes.
        text: its words.
        path: the planned way, xyz in metres, world frame; at most 64 points.
        waypoints: the stops of the hand along it; at most 64.
        cause: why nothing more is tried, "" while something is.
        tick: the session's tick at which it was planned.
    """

    slot: int
    instruction: str
    subtasks: tuple[str, ...]
    subtask: int
    text: str
    path: tuple[tuple[float, ...], ...]
    waypoints: tuple[Waypoint, ...]
    cause: str
    tick: int


@dataclass(frozen=True, kw_only=True)
class Fields:
    """What the panel has selected; None where nothing is."""

    suite: str | None = None
    task: int | str | None = None
    episode: int | None = None


@dataclass(frozen=True, kw_only=True)
class SessionState:
    """A session as it is now.

    Attributes:
        state: see ``StateName``.
        suite: the suite of the batch.
        task, episode: of the first slot.
        num_slots: slots, B.
        slots: their states.
        policy: name of the policy as results have it.
        tick: control ticks executed since the run began.
        ticks_per_second: the speed limit; None for as fast as it goes.
        step_budget: the largest step budget of a slot, control ticks.
        planned: episodes of the run.
        finished: episodes of the run that have ended.
        successes: of these, those that were solved.
        errors: of these, those without a verdict, because the policy or the simulator failed.
        error: why the state is "error", or the last thing that went wrong in a run; None if nothing did.
        fields: what the panel has selected.
        writer: whoever reads this is the client that may change the session.
        writer_held: some client is.
        url_3d: address of the 3-D view; None without one.
        planning: of the slot that is looked at; None where the policy plans nothing.
        cameras: names of the cameras that can be watched; empty where nothing is drawn.
        image_size: height and width of their images, pixels; None before the first was drawn.
        preparing_images: the first image of a scene is being drawn: nothing else happens for some seconds.
        results: name of the results folder that the run is written to; None without one.
        revision: larger whenever something in the scene or here has changed.
    """

    state: StateName = "idle"
    suite: str | None = None
    task: int | str | None = None
    episode: int | None = None
    num_slots: int = 0
    slots: tuple[SlotState, ...] = ()
    policy: str | None = None
    tick: int = 0
    ticks_per_second: float | None = None
    step_budget: int = 0
    planned: int = 0
    finished: int = 0
    successes: int = 0
    errors: int = 0
    error: str | None = None
    fields: Fields = Fields()
    writer: bool = False
    writer_held: bool = False
    url_3d: str | None = None
    planning: Planning | None = None
    cameras: tuple[str, ...] = ()
    image_size: tuple[int, ...] | None = None
    preparing_images: bool = False
    results: str | None = None
    revision: int = 0


@dataclass(frozen=True, kw_only=True)
class History:
    """Columns of the episode that a slot runs, or ran last; one row a control tick, taken before the tick.

    An episode that has ended has one more, which is where it ended, and no action.

    Attributes:
        slot: the slot.
        episode_id: the episode.
        step: number of the tick, from 0.
        eef_pos: position of the end effector, xyz in metres, world frame; empty where the environment does not say.
        gripper: opening of the gripper, metres; empty where the environment does not say.
        reward: sum of rewards so far.
        action: what was executed, 7 numbers; none for the last row of an episode that has ended.
    """

    slot: int
    episode_id: str
    step: tuple[int, ...] = ()
    eef_pos: tuple[tuple[float, ...], ...] = ()
    gripper: tuple[float, ...] = ()
    reward: tuple[float, ...] = ()
    action: tuple[tuple[float, ...], ...] = ()
