"""Published evaluation protocols as data: what an evaluation script does around a policy, with its source.

Plain frozen dataclasses; nothing here knows a simulator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

# What NumPy's legacy generator takes as a seed.
MAX_SEED = 2**32 - 1


class ProtocolError(ValueError):
    """A protocol, or a value in one, that does not exist; the message names what does."""


@dataclass(frozen=True, kw_only=True)
class ResetLoop:
    """How an evaluation script seeds and resets upstream LIBERO environments.

    Upstream's reset draws from NumPy's global generator where fixtures stand, so what an episode's scene looks like
    depends on the last ``env.seed(s)`` and on the number of resets since. The defaults are the loop of OpenVLA and
    openpi: an environment a task, seeded once, then one reset an episode.

    Attributes:
        seed_per_episode, seed_per_task: what is added to the seed for each episode and task. When both are 0 the
            environment is seeded once, before the first episode; otherwise again before every reset.
        spare_resets: resets between the construction of an environment and its first seeding.
        fresh: every episode has an environment of its own, rather than one a task.
    """

    seed_per_episode: int = 0
    seed_per_task: int = 0
    spare_resets: int = 0
    fresh: bool = False

    def __post_init__(self) -> None:
        for name in ("seed_per_episode", "seed_per_task", "spare_resets"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise ProtocolError(f"ResetLoop: {name}={value!r}: expected an integer of at least 0")
        if not isinstance(self.fresh, bool):
            raise ProtocolError(f"ResetLoop: fresh={self.fresh!r}: expected True or False")

    def at(self, seed: int, task: int, episode: int) -> ResetPoint:
        """Where an episode stands in the loop.

        Raises:
            ProtocolError: a seed that NumPy's legacy generator does not take.
        """
        if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed <= MAX_SEED:
            raise ProtocolError(f"seed={seed!r}: upstream's generator takes integers from 0 to {MAX_SEED}")
        reseeded = bool(self.seed_per_episode or self.seed_per_task)
        before = 0 if self.fresh else episode
        return ResetPoint(
            seed=(seed + self.seed_per_task * task + self.seed_per_episode * episode) % (MAX_SEED + 1),
            unseeded=self.spare_resets + (before if reseeded else 0),
            resets=1 if reseeded else before + 1,
        )


@dataclass(frozen=True, kw_only=True)
class ResetPoint:
    """The resets of one upstream environment up to the one that an episode begins with.

    Attributes:
        seed: the last seed it was given.
        unseeded: resets between its construction and that seed.
        resets: resets since that seed, the episode's own included, at least 1.
    """

    seed: int
    unseeded: int
    resets: int


def reset_loop(given: ResetLoop | Mapping[str, Any] | None) -> ResetLoop:
    """A loop from itself, from a mapping of its fields, or the default one from None.

    Raises:
        ProtocolError: a field that a loop does not have, or something else.
    """
    if given is None or isinstance(given, ResetLoop):
        return given or ResetLoop()
    known = [field.name for field in fields(ResetLoop)]
    if not isinstance(given, Mapping):
        raise ProtocolError(f"reset_loop={given!r}: expected a ResetLoop or a mapping of {', '.join(known)}")
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ProtocolError(f"reset_loop has no field {unknown[0]!r}; it has {', '.join(known)}")
    return ResetLoop(**given)
