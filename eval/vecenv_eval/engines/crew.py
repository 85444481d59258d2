"""The actors of a run on Ray: starting them, replacing those that are lost, and what each is doing.

Assignments come in; the driver (``vecenv_eval.engines.ray_engine``) asks each :class:`Seat` for what it waits for. A
seat outlives its actors: when one is lost, the seat gets another as soon as the cluster has room for it.
"""

from __future__ import annotations

import sys
from collections.abc import Hashable, Mapping, Sequence
from contextlib import suppress
from typing import Any, cast

import ray
from ray.cloudpickle import cloudpickle
from ray.exceptions import RayError

from vecenv_eval.engines.ray_actor import ActorInfo, Assignment, EpisodeActor, Report
from vecenv_eval.episodes import Episode

# Seconds that actors have to close their environments and policies.
_CLOSE_S = 10.0


class Seat:
    """The place of one actor.

    Attributes:
        info: of its actor, None until that is ready.
        waits_for: what Ray will deliver next: the actor's info or reports, None while it has nothing to do.
        unit: the episodes that it was given and that have no record yet, in order.
        scene: the scene of its environment, None before the first.
        failed_starts: actors of this seat that were lost before they were ready, since the last that was.
        steps: control ticks of its actors.
    """

    def __init__(self) -> None:
        self.info: ActorInfo | None = None
        self.waits_for: Any = None
        self.unit: dict[Episode, None] = {}
        self.scene: Hashable | None = None
        self.failed_starts = 0
        self._steps = self._steps_before = 0
        self._actor: Any = None

    @property
    def steps(self) -> int:
        """Control ticks of its actors, together."""
        return self._steps_before + self._steps

    @steps.setter
    def steps(self, of_this_actor: int) -> None:
        self._steps = of_this_actor

    @property
    def retired(self) -> bool:
        """No actor is here, and none will be."""
        return self._actor is None

    @property
    def idle(self) -> bool:
        """Its actor is ready and has nothing to do."""
        return self.info is not None and self.waits_for is None

    def start(self, assignment: bytes, resources: Mapping[str, float]) -> None:
        """Ask Ray for an actor; it begins once a node has room for it."""
        kind: Any = ray.remote(EpisodeActor)
        self._actor = kind.options(
            num_cpus=resources["CPU"], num_gpus=resources["GPU"], max_restarts=0, max_concurrency=2
        ).remote(assignment, sys.path)
        self.info, self.waits_for = None, self._actor.prepare.remote()

    def assign(self, assignment: bytes, resources: Mapping[str, float]) -> None:
        """Let the actor begin another run once it has finished; one that has episodes left, or none, is replaced."""
        if self.unit:
            self.retire()
        self._steps = self._steps_before = self.failed_starts = 0
        self.scene = None
        if self._actor is None:
            self.start(assignment, resources)
        else:
            self.info, self.waits_for = None, self._actor.assign.remote(assignment)

    def give(self, number: int, episodes: Sequence[Episode], scene: Hashable) -> None:
        """Let the actor run a unit."""
        self.unit, self.scene = dict.fromkeys(episodes), scene
        self.waits_for = self._actor.run.options(num_returns="streaming").remote(number, tuple(episodes))

    def take_info(self) -> ActorInfo:
        """What the actor that starts here says about itself.

        Raises:
            RayError: it is lost, or its policy cannot be made.
        """
        return cast(ActorInfo, ray.get(self.waits_for))

    def take_report(self) -> Report:
        """The next report about the unit.

        Raises:
            StopIteration: the actor has finished the unit.
            RayError: it is lost.
        """
        return cast(Report, ray.get(next(self.waits_for)))

    def retire(self) -> None:
        """Give the actor up."""
        if self._actor is not None:
            with suppress(RayError):
                ray.kill(self._actor)
        self._actor = self.info = self.waits_for = self.scene = None
        self._steps_before, self._steps, self.unit = self.steps, 0, {}

    def close(self) -> Any:
        """Ask the actor to close; what Ray delivers when it has, None without a ready actor."""
        return self._actor.close.remote() if self.info is not None else None


class Crew:
    """The seats of a run.

    Args:
        size: how many there are.
        assignment: what every actor is told.
        resources: what every actor takes of its node.

    Attributes:
        resources: likewise.
        seats: the seats.
    """

    def __init__(self, size: int, assignment: Assignment, resources: Mapping[str, float]) -> None:
        self.resources = resources
        self._assignment = cloudpickle.dumps(assignment)
        self.seats = [Seat() for _ in range(size)]
        for seat in self.seats:
            seat.start(self._assignment, resources)

    def assign(self, size: int, assignment: Assignment) -> None:
        """Begin another run with the same actors, and with more where they are too few.

        Args:
            size: how many it needs.
            assignment: what every actor is told.
        """
        self._assignment = cloudpickle.dumps(assignment)
        self.seats += [Seat() for _ in range(size - len(self.seats))]
        for seat in self.seats:
            seat.assign(self._assignment, self.resources)

    @property
    def active(self) -> list[Seat]:
        """The seats that have an actor or wait for one."""
        return [seat for seat in self.seats if not seat.retired]

    def replace(self, seat: Seat) -> None:
        """Give a seat another actor."""
        seat.retire()
        seat.start(self._assignment, self.resources)

    def ready(self, timeout_s: float) -> list[Seat]:
        """The seats for which Ray has something; waits until there is one, or for so many seconds."""
        waiting = {id(seat.waits_for): seat for seat in self.seats if seat.waits_for is not None}
        expected = [seat.waits_for for seat in waiting.values()]
        if not expected:
            return []
        ready, _ = ray.wait(expected, num_returns=1, timeout=timeout_s, fetch_local=False)
        if ready:  # and all others that have something too: none may starve
            ready, _ = ray.wait(expected, num_returns=len(expected), timeout=0, fetch_local=False)
        return [waiting[id(each)] for each in ready if id(each) in waiting]

    def close(self) -> None:
        """Close environments and policies as far as that takes seconds, then end the actors."""
        closing = []
        for seat in self.active:
            with suppress(RayError):
                closing += [reference for reference in [seat.close()] if reference is not None]
        if closing:
            with suppress(RayError):
                ray.wait(closing, num_returns=len(closing), timeout=_CLOSE_S, fetch_local=False)
        for seat in self.seats:
            seat.retire()
