"""The record of an episode, and its plain form: what a line of ``episodes.jsonl`` or a row of the database holds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from vecenv.errors import InvalidFile
from vecenv_eval.episodes import Episode

# Fields of a record that may differ when an episode is run again.
CIRCUMSTANCES = frozenset({"run", "batch", "setup_s", "wall_s", "policy_s", "physics_s", "images_s"})


class StoreError(InvalidFile):
    """A results folder cannot be made, read or resumed; the message names the file."""


class StoreWriteError(StoreError):
    """Rows cannot be written, to a full disk for example; what was written before is kept."""


@dataclass(frozen=True, kw_only=True)
class Record:
    """One row of a results folder: how one episode went.

    Attributes:
        suite, task, episode: which episode.
        instruction: its language instruction.
        success: the task was solved, in the sense of the protocol: one of the next two.
        success_first: the goal held after one of the ticks.
        success_final: the goal held after the last one.
        num_steps: control ticks executed.
        reward: sum of rewards, None when it was not finite.
        fault: why the slot was quarantined, "" when it was healthy. Such an episode counts as a failure.
        error: why the episode has no verdict (an exception while it ran), "" when it has one.
        sanitized: calls of the policy whose actions held non-finite values or values out of range.
        sanitized_first: the control tick of the first of them, None when there was none.
        run: which run on this folder, 0 for the first, one more at each resume.
        batch: which stream of episodes of that run.
        setup_s: seconds it took to place the episode (building or re-placing the environment, and reset).
        wall_s: seconds from then until this episode ended, the policy's included.
        policy_s, physics_s, images_s: its share of what its stream spent in the policy, in physics and in rendering.
        extras: what the policy reports about the episode, numbers and texts by name.
        stand_ins: a sentence for each file that was missing and what was used instead.
        parts: SIMPLER's intermediate results of the success check after the last tick, by upstream's names: true or
            false, or a number. LIBERO has none.
    """

    suite: str
    task: int
    episode: int
    instruction: str
    success: bool
    num_steps: int
    reward: float | None
    fault: str = ""
    error: str = ""
    sanitized: int = 0
    sanitized_first: int | None = None
    run: int = 0
    batch: int = 0
    setup_s: float = 0.0
    wall_s: float = 0.0
    policy_s: float = 0.0
    physics_s: float = 0.0
    images_s: float = 0.0
    extras: Mapping[str, Any] = field(default_factory=dict)
    stand_ins: tuple[str, ...] = ()
    success_first: bool = False
    success_final: bool = False
    parts: Mapping[str, bool | float] = field(default_factory=dict)

    @classmethod
    def of_error(cls, episode: Episode, instruction: str, cause: str, *, run: int, batch: int) -> Record:
        """The record of an episode without a verdict, because of what ``cause`` says."""
        return cls(
            suite=episode.suite,
            task=episode.task,
            episode=episode.episode,
            instruction=instruction,
            success=False,
            num_steps=0,
            reward=0.0,
            error=cause,
            run=run,
            batch=batch,
        )

    @property
    def verdict(self) -> dict[str, Any]:
        """What belongs to the episode alone: everything but when, where and how fast it ran."""
        return {name: value for name, value in asdict(self).items() if name not in CIRCUMSTANCES}

    @property
    def key(self) -> Episode:
        """Which episode this is about."""
        return Episode(self.suite, self.task, self.episode)

    def replaces(self, earlier: Record | None) -> bool:
        """Whether this record counts instead of an earlier one: the latest does, but no error replaces a verdict."""
        return earlier is None or not self.error or bool(earlier.error)


def to_plain(record: Record) -> dict[str, Any]:
    """A record as JSON has it: no NaN or infinity, which become null."""
    return _finite(asdict(record))


def from_plain(values: Mapping[str, Any]) -> Record:
    """A record from its plain form; fields that are not known are passed over.

    Raises:
        KeyError, TypeError, AttributeError: it is none.
    """
    known = {f.name for f in fields(Record)}
    values = {key: value for key, value in values.items() if key in known}
    # Older files have one verdict, which is both.
    both = {name: values.get(name, values["success"]) for name in ("success_first", "success_final")}
    return Record(**{**values, **both, "stand_ins": tuple(values.get("stand_ins", ()))})


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {name: _finite(each) for name, each in value.items()}
    return [_finite(each) for each in value] if isinstance(value, list | tuple) else value
