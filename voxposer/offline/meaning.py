"""What a sentence means: actions on descriptions of objects.

The parser makes these values, the planner's writer resolves them. ``str`` of a description is a phrase that the parser
reads as the same description: it is how the planner hands a description on to parse_query_obj.
"""

from __future__ import annotations

from dataclasses import dataclass

from voxposer.offline.lexicon import words

PRONOUNS = frozenset(["each other", *words("it them they one that this those these there itself themselves here")])
BESIDE = frozenset(["near", "left_of", "right_of", "front_of", "back_of"])


@dataclass(frozen=True, kw_only=True)
class Relation:
    """Relation of an object to others.

    Attributes:
        kind: on, in, top_of, under, near, between, from, outside, center, or left_of, right_of, front_of, back_of.
        refs: the other objects; two for between, or one in the plural.
        negated: whether the relation must not hold.
    """

    kind: str
    refs: tuple[Noun, ...] = ()
    negated: bool = False

    def __str__(self) -> str:
        refs = " and ".join(map(str, self.refs))
        return f"{'not ' if self.negated else ''}{_RELATION_WORDS.get(self.kind, self.kind)} {refs}"


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """Which of several objects, by their order.

    Attributes:
        key: left, right, front, back, top, bottom (where they are), middle, large, small, tall, short, long (bounding
            boxes), near or far (distance from ``ref``).
        rank: 1 for the first in that order, -1 for the last.
        ref: for near and far, the other object.
    """

    key: str
    rank: int = 1
    ref: Noun | None = None


@dataclass(frozen=True, kw_only=True)
class Noun:
    """A description of an object.

    Attributes:
        words: content words, singular, the noun itself last; what it is a part of comes first.
        ranking: which of several, by their order.
        relation: to other objects.
        plural: all that fit are meant.
        indefinite: any that fits will do.
        number: how many are said to be meant.
        exact: whether there must be just that many: "both", "the three".
        excluded: descriptions of objects that are not meant.
        other: "the other", what was said before is not meant.
        said: "that bowl": what was said before is meant.
        moved: of the objects that fit, those already moved: how many, and where they are.
    """

    words: tuple[str, ...]
    ranking: Ranking | None = None
    relation: Relation | None = None
    plural: bool = False
    indefinite: bool = False
    number: int | None = None
    exact: bool = False
    excluded: tuple[Noun, ...] = ()
    other: bool = False
    said: bool = False
    moved: tuple[tuple[int, Relation], ...] = ()

    @property
    def is_pronoun(self) -> bool:
        """Whether it stands for an object named before, and has no words of its own."""
        return len(self.words) == 1 and self.words[0] in PRONOUNS and self.is_bare

    @property
    def is_named(self) -> bool:
        """Whether it is a name of the scene."""
        return len(self.words) == 1 and "_" in self.words[0]

    @property
    def is_bare(self) -> bool:
        """Whether words alone describe it."""
        return not (self.ranking or self.relation or self.excluded or self.other)

    def _article(self) -> str:
        if self.number is None or self.number == 1:
            return "any" if self.indefinite else "all" if self.plural else "the"
        number = NUMBER_WORDS.get(self.number, str(self.number))
        if not self.exact:
            return number
        return f"the {number}" if self.ranking or not self.plural else "both" if self.number == 2 else f"all {number}"

    def __str__(self) -> str:
        ranking, before, after = self.ranking, "", ""
        if ranking and ranking.key in _SIDES:
            before = _ordinal(ranking.rank)
            after = f" from the {ranking.key}" if ranking.rank != 1 else f" {_SIDES[ranking.key]}"
        elif ranking and ranking.ref is not None:
            before = _ordinal(ranking.rank)
            after = f" {'nearest to' if ranking.key == 'near' else 'farthest from'} {ranking.ref}"
        elif ranking and not ranking.key:
            before = _ordinal(ranking.rank) or "first "
        elif ranking:
            before = f"{_ordinal(ranking.rank)}{_SIZES.get(ranking.key, ranking.key)} "
        article = self._article()
        after += f" {self.relation}" if self.relation else ""
        after += "".join(f" except {noun}" for noun in self.excluded)
        after += "".join(f" besides the {count} {relation}" for count, relation in self.moved)
        return f"{article} {before}{'other ' if self.other else ''}{' '.join(self.words)}{after}"


@dataclass(frozen=True, kw_only=True)
class Place:
    """A destination.

    Attributes:
        relation: on, in, top_of, under, near, left_of, right_of, front_of, back_of, between, center, to or towards.
        thing: the object it is relative to.
        second: for between, the other object.
        cm: the gap to leave beside the object, None for the usual one.
    """

    relation: str
    thing: Noun
    second: Noun | None = None
    cm: float | None = None


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What must be so before anything moves, for an action to be done.

    Attributes:
        thing: what it is about.
        state: open, close, on or off; "" where it is about a place.
        relation: where the thing is.
        negated: whether it must not be so.
    """

    thing: Noun
    state: str = ""
    relation: Relation | None = None
    negated: bool = False


@dataclass(frozen=True, kw_only=True)
class Action:
    """One action.

    Attributes:
        verb: pick, put, stack, push, shift, open, close, turn_on or turn_off.
        thing: what is acted on.
        place: where to, for put and push.
        way: left, right, front or back, for shift.
        cm: how far, for shift.
        condition: it is done only where this is so.
    """

    verb: str
    thing: Noun
    place: Place | None = None
    way: str = ""
    cm: float = 0.0
    condition: Condition | None = None


@dataclass(frozen=True, kw_only=True)
class Avoidance:
    """Something that every motion keeps away from; ``cm`` is None for the usual distance."""

    thing: Noun
    cm: float | None = None


@dataclass(frozen=True, kw_only=True)
class Instruction:
    """What an instruction means.

    Attributes:
        actions: in the order in which they are to be done.
        avoid: what motions keep away from.
        speed: a factor on the usual speed.
        untouched: what must not be acted on.
        kept: what must be "open" or "close" in the end, or "on" or "off".
        forbidden: actions that are ruled out.
        slips: words with typing errors, and what each is taken for.
    """

    actions: tuple[Action, ...]
    avoid: tuple[Avoidance, ...] = ()
    speed: float | None = None
    untouched: tuple[Noun, ...] = ()
    kept: tuple[tuple[str, Noun], ...] = ()
    forbidden: tuple[Action, ...] = ()
    slips: tuple[tuple[str, str], ...] = ()


NUMBER_WORDS = {2: "two", 3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight", 9: "nine", 10: "ten"}
_SIDES = {
    "left": "on the left",
    "right": "on the right",
    "front": "at the front",
    "back": "at the back",
    "middle": "in the middle",
    "top": "at the top",
    "bottom": "at the bottom",
}
_SIZES = {"large": "largest", "small": "smallest", "tall": "tallest", "short": "shortest", "long": "longest"}
_RELATION_WORDS = {
    "near": "next to",
    "top_of": "on top of",
    "left_of": "to the left of",
    "right_of": "to the right of",
    "front_of": "in front of",
    "back_of": "behind",
    "center": "at the center of",
}
_ORDINALS = {-1: "last", 2: "second", 3: "third", 4: "fourth", 5: "fifth", 6: "sixth", 7: "seventh", 8: "eighth"}


def _ordinal(rank: int) -> str:
    word = _ORDINALS.get(rank, "")
    return f"{word} " if word else ""
