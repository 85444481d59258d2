"""A clause as it was said, before pronouns are resolved."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from voxposer.offline.meaning import Noun
from voxposer.offline.nouns import Phrase

Group = tuple[Noun | None, list[Phrase]]


@dataclass(frozen=True, kw_only=True)
class Spoken:
    """A condition as it was said.

    Attributes:
        thing: what it is about.
        state: open, close, on or off; "" for a place.
        place: where the thing is, for a condition about a place.
        negated: whether it must not be so.
    """

    thing: Noun
    state: str = ""
    place: Phrase | None = None
    negated: bool = False

    @property
    def opposite(self) -> Spoken:
        """The condition that holds where this one does not."""
        return replace(self, negated=not self.negated)


@dataclass
class Clause:
    """A clause.

    Attributes:
        verb: put, pick, stack, push, open, close, turn_on, turn_off, or again (the last verb, which is left out), same
            (the last action with another object); avoid, untouched, keep_open, keep_close, keep_on, keep_off; or "".
        groups: the objects, each with the prepositional phrases behind it.
        forbidden: it must not be done.
        when: place in the order of doing.
        cm: a distance to keep, or how far to move something.
        way: where to move it: left, right, front, back.
        ruled_out: phrases after "not": the order says that it is not these.
        said: its words.
        condition: it is done only where this is so.
        trails: whether the condition was said behind it.
    """

    verb: str
    groups: list[Group] = field(default_factory=list)
    forbidden: bool = False
    when: float = 0.0
    cm: float | None = None
    way: str = ""
    ruled_out: list[Phrase | Noun] = field(default_factory=list)
    said: str = ""
    condition: Spoken | None = None
    trails: bool = False
