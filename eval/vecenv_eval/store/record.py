"""The record of an episode, and its plain form: what a line of ``episodes.jsonl`` or a row of the database holds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from vecenv.errors import InvalidFile
from vecenv_eval.episodes import Episode

# Fields of a record that may differ when an episode is run again.
CIRCUMSTANCES = frozenset({"run", "batch", "setup_s", "wall_s", "policy_s", "physics_s", "images_s"})
# The largest whole number that fits into databases and tables.
LARGEST = 2**63 - 1
# Far beyond any suite; tables are made of rows up to the largest task.
MOST_EPISODES = 1_000_000
_MOST_SECONDS = 1e10
# Levels of what a policy reports; what is deeper is stored as text.
_MOST_LEVELS = 16
# What a stored row must have, and the types of its fields.
_NEEDED = frozenset({"suite", "task", "episode", "instruction", "success", "num_steps", "reward"})
_FLAGS = frozenset({"success", "success_first", "success_final"})
_COUNTS = frozenset({"task", "episode", "num_steps", "sanitized", "run", "batch"})
_NUMBERS = frozenset({"reward", "setup_s", "wall_s", "policy_s", "physics_s", "images_s"})
_TEXTS = frozenset({"suite", "instruction", "fault", "error"})


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
    """A record as JSON has it: no NaN or infinity, which become null, and no text without a form in UTF-8."""
    return {each.name: _storable(getattr(record, each.name)) for each in fields(record)}


def from_plain(values: object) -> Record:
    """A record from its plain form; fields that are not known are passed over.

    Raises:
        ValueError: it is none; the message names the field.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"it is {type(values).__name__}, not a JSON object")
    known = {f.name: values[f.name] for f in fields(Record) if f.name in values}
    if missing := [f.name for f in fields(Record) if f.name in _NEEDED and f.name not in known]:
        raise ValueError(f"it has no {', '.join(missing)}")
    # Older files have one verdict, which is both.
    for name in ("success_first", "success_final"):
        known.setdefault(name, known["success"])
    for name, value in known.items():
        _check(name, value)
    known = _storable(known)
    return Record(**{**known, "stand_ins": tuple(known.get("stand_ins", ()))})


def _check(name: str, value: object) -> None:
    """Refuse a value that the field of this name cannot have."""
    if name in _FLAGS:
        fits, what = isinstance(value, bool), "true or false"
    elif name in _COUNTS or name == "sanitized_first":
        whole = isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= LARGEST
        fits, what = whole or (value is None and name not in _COUNTS), "a whole number from 0"
    elif name in _NUMBERS:
        fits, what = _is_number(value), "a number"
        if name == "reward":
            fits = fits or value is None
        elif fits:  # seconds: NaN is none
            fits, what = 0 <= value <= _MOST_SECONDS, f"seconds, from 0 to {_MOST_SECONDS:g}"  # pyright: ignore[reportOperatorIssue]
    elif name in _TEXTS:
        fits, what = isinstance(value, str), "text"
    elif name == "parts":
        fits, what = isinstance(value, Mapping) and all(_is_part(each) for each in value.values()), "names and numbers"
    elif name == "stand_ins":
        fits = isinstance(value, Sequence) and not isinstance(value, str) and all(isinstance(e, str) for e in value)
        what = "a list of texts"
    else:
        fits, what = isinstance(value, Mapping), "a JSON object"
    if not fits:
        raise ValueError(f"{name} is {value!r:.50}, not {what}")
    if name in ("task", "episode") and value > MOST_EPISODES:  # pyright: ignore[reportOperatorIssue]
        raise ValueError(f"{name} is {value!r:.50}, more than {MOST_EPISODES:,}")


def _is_number(value: object) -> bool:
    return isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool))


def _is_part(value: object) -> bool:
    return value is None or isinstance(value, bool) or _is_number(value)


def _storable(value: Any, levels: int = _MOST_LEVELS) -> Any:
    """Plain values that every store takes and every reader understands: finite numbers, Unicode, few levels."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return unicode(value)
    if isinstance(value, int):
        return int(value) if abs(value) <= LARGEST else _text(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping | list | tuple) and levels:
        if isinstance(value, Mapping):
            return {_storable(str(name)): _storable(each, levels - 1) for name, each in value.items()}
        return [_storable(each, levels - 1) for each in value]
    to_list = getattr(value, "tolist", None)  # of NumPy's numbers and arrays
    if callable(to_list) and levels:
        return _storable(to_list(), levels - 1)
    return _text(value)


def unicode(text: str) -> str:
    """A text as UTF-8 can hold it: surrogates, which file names of other encodings may have, are written as escapes."""
    return text.encode("utf-8", "backslashreplace").decode()


def _text(value: object) -> str:
    """Something that has no form of its own in a store."""
    try:
        return _storable(f"{value!r:.1000}")
    except Exception:  # whatever a __repr__ raises, or a number with too many digits
        return type(value).__name__
