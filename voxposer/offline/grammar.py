"""Grammar of the offline writer: from an instruction to actions on noun phrases.

English as in LIBERO and SIMPLER ("take the black bowl from the top drawer and put it on the plate") comes in;
:class:`Action` s go out in order, with pronouns resolved and implicit objects filled in. No entity names and no
positions are known here: a :class:`Noun` holds words and relations to other objects.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from voxposer.offline.names import COLOURS, SIDES, NotUnderstood, singular


@dataclass(frozen=True, kw_only=True)
class Relation:
    """Relation of an object to others.

    Attributes:
        kind: on, in, top_of, under, near, between, from, outside, center, or left_of, right_of, front_of, back_of.
        refs: the other objects; two for between.
        negated: whether the relation must not hold.
    """

    kind: str
    refs: tuple[Noun, ...] = ()
    negated: bool = False


@dataclass(frozen=True, kw_only=True)
class Noun:
    """A noun phrase.

    Attributes:
        words: content words, singular, the noun itself last; what it is a part of comes first.
        side: which of several equal objects: left, right, front, back, middle, top or bottom.
        relation: to other objects.
        plural: the phrase is in the plural, or has "both" or "all".
        indefinite: the phrase has "a" or "any": every matching object will do.
    """

    words: tuple[str, ...]
    side: str | None = None
    relation: Relation | None = None
    plural: bool = False
    indefinite: bool = False

    @property
    def is_pronoun(self) -> bool:
        """Whether it refers to an object named before."""
        return self.words in {("it",), ("them",), ("one",)}

    def __str__(self) -> str:
        """The phrase in words, which this grammar parses to the same noun."""
        article = "any" if self.indefinite else "the"
        side = f" {_SIDE_WORDS[self.side]}" if self.side else ""
        relation = f" {_relation_text(self.relation)}" if self.relation else ""
        return f"{article} {' '.join(self.words)}{side}{relation}"


@dataclass(frozen=True, kw_only=True)
class Place:
    """A destination: ``relation`` on, in, top_of, under, near, left_of, right_of, front_of, back_of an object."""

    relation: str
    thing: Noun


@dataclass(frozen=True, kw_only=True)
class Action:
    """One action: ``verb`` is pick, put, push, open, close, turn_on or turn_off."""

    verb: str
    thing: Noun
    place: Place | None = None


_SIDE_WORDS = {
    "left": "on the left",
    "right": "on the right",
    "front": "at the front",
    "back": "at the back",
    "middle": "in the middle",
    "top": "at the top",
    "bottom": "at the bottom",
}
_RELATION_WORDS = {
    "near": "next to",
    "top_of": "on top of",
    "left_of": "to the left of",
    "right_of": "to the right of",
    "front_of": "in front of",
    "back_of": "behind",
    "center": "at the center of",
}
_SIDE = r"(left|right|front|back|rear|middle|center|centre|top|bottom)"
_SAME_SIDE = {"rear": "back", "center": "middle", "centre": "middle", "upper": "top", "lower": "bottom"}
_ENDS = r"(?=\s+(?:and|then|on|onto|in|into|at|to|next|near|beside|between|from|under|inside|behind|not)\b|\s*,|\s*$)"

# Normalisation of spelling before parsing: pattern, replacement.
_SPELLINGS = (
    (r"[\u2018\u2019\u02bc]", "'"),
    (r"-", " "),
    (r"\b(?:please|kindly)\b|\b(?:can|could|would|will) you\b|[.?!]+$", ""),
    (r"\bthe ((?:\w+ ){0,2}\w+)'s ((?:\w+ )?\w+)", r"the \2 of the \1"),
    (r"\b(\w+)'s ((?:\w+ )?\w+)", r"the \2 of the \1"),
    (r"\bfrying pan(s?)\b", r"frypan\1"),
    (r"\b(?:layer|level) of (?:the )?drawers?\b", "drawer"),
    (rf"\b({'|'.join(sorted(COLOURS))}) (?:and|&) (?=(?:{'|'.join(sorted(COLOURS))})\b)", r"\1 "),
)
# Prepositions, the longest first, as one token each.
_PREPOSITIONS = (
    (
        r"\b(?:from|at|in|on) (?:the )?(?:(?:center|centre|middle) of the table|table (?:center|centre))\b",
        "CENTER table",
    ),
    (r"\bat the center of\b", "CENTER"),
    (r"\bon (?:the )?top of\b|\bto (?:the )?top of\b|\bonto (?:the )?top of\b", "TOP_OF"),
    (r"\b(?:to|on|at|in) (?:the )?(left|right|front|back)(?: hand)?(?: side)? of\b|\b(left|right) of\b", r"\1\2_OF"),
    (rf"\b(?:on|at|in|from) the {_SIDE}(?: side)?\b{_ENDS}", r"AT_\1"),
    (rf"\bto (?:the )?(left|right|front|back)(?: side)?\b{_ENDS}", r"\1_OF"),
    (r"\bin front of\b", "front_OF"),
    (r"\bbehind\b", "back_OF"),
    (r"\b(?:next to|adjacent to|close to|near to|beside|alongside|near|by)\b", "NEAR"),
    (r"\boutside(?: of)?\b", "OUTSIDE"),
    (r"\b(?:inside of|inside|into|within|in)\b", "IN"),
    (r"\b(?:onto|upon|on)\b", "ON"),
    (r"\b(?:underneath|under|below|beneath)\b", "UNDER"),
    (r"\bbetween\b", "BETWEEN"),
    (r"\b(?:from|out of|off)\b", "FROM"),
    (r"\bof\b", "OF"),
    (r"\b(?:and|&)\b|,", " AND "),
    (r"\bnot\b", "NOT"),
)
_VERBS = (
    ("turn_on", r"(?:turn|switch)(?: it)? on|turn_on"),
    ("turn_off", r"(?:turn|switch)(?: it)? off|turn_off"),
    ("open", r"(?:slide |pull )?open"),
    ("close", r"(?:push |slide )?closed?|(?:push )?shut"),
    ("pick", r"pick(?: up)?|grab|grasp|lift(?: up)?|take|get|fetch"),
    ("stack", r"stack"),
    ("push", r"push|slide"),
    ("put", r"put(?: down)?|place|set(?: down)?|drop|deposit|move|bring|transfer"),
)
_ANY_VERB = "|".join(pattern for _, pattern in _VERBS)
_CLAUSES = re.compile(rf"(?:\s*,\s*|\s+)(?:and then|then|and)\s+(?=(?:{_ANY_VERB})\b)|\s*[,;]\s*(?=(?:{_ANY_VERB})\b)")
# "turn the stove on" becomes "turn_on the stove".
_SPLIT_VERB = re.compile(r"\b(?:turn|switch) ((?:the )?\w+(?: \w+)?) (on|off)\b(?=\s+(?:and|then)\b|\s*,|\s*$)")
_DETERMINERS = frozenset(["the", "a", "an", "any", "both", "all", "two", "that", "this", "some"])


def read_instruction(text: str) -> tuple[Action, ...]:
    """The actions of an instruction, in order.

    Raises:
        NotUnderstood: a clause without a known verb, or with words left over.
    """
    return _Reader().read([_clause(part) for part in _CLAUSES.split(spell(text))])


def read_noun(text: str) -> Noun:
    """A noun phrase with its qualifiers: "the black bowl between the plate and the ramekin"."""
    tokens = _Tokens(_tokens(spell(text)))
    noun, phrases = tokens.group()
    if noun is None or not tokens.at_end:
        raise NotUnderstood(f"{text!r} cannot be parsed as a description of an object")
    return _qualified(noun, phrases)


def spell(text: str) -> str:
    """An instruction in lower case, with spellings, possessives and colour pairs normalised."""
    text = text.lower()
    for pattern, replacement in _SPELLINGS:
        text = re.sub(pattern, replacement, text)
    return _SPLIT_VERB.sub(r"turn_\2 \1", " ".join(text.split()))


def _relation_text(relation: Relation | None) -> str:
    if relation is None:
        return ""
    refs = " and ".join(map(str, relation.refs))
    return ("not " if relation.negated else "") + f"{_RELATION_WORDS.get(relation.kind, relation.kind)} {refs}"


def _tokens(text: str) -> list[str]:
    for pattern, replacement in _PREPOSITIONS:
        text = re.sub(pattern, replacement, text)
    return text.split()


def _clause(text: str) -> tuple[str, list[str]]:
    for verb, pattern in _VERBS:
        found = re.match(rf"(?:{pattern})\b", text)
        if found:
            return verb, _tokens(text[found.end() :])
    raise NotUnderstood(f"no known verb at the beginning of {text!r}")


@dataclass(frozen=True)
class _Phrase:
    """A prepositional phrase; ``thing`` is None where the object is implied."""

    kind: str
    thing: Noun | None = None
    second: Noun | None = None
    negated: bool = False


class _Tokens:
    """A cursor over tokens. Lower-case tokens are words, the others prepositions and conjunctions."""

    def __init__(self, tokens: Sequence[str]) -> None:
        self._tokens, self._at = list(tokens), 0

    @property
    def at_end(self) -> bool:
        return self._at == len(self._tokens)

    def _next(self) -> str:
        return "" if self.at_end else self._tokens[self._at]

    def take(self, token: str) -> bool:
        """Skip the next token if it is this one."""
        found = self._next() == token
        self._at += found
        return found

    def groups(self) -> list[tuple[Noun | None, list[_Phrase]]]:
        """Noun phrases joined by "and", each with the prepositional phrases after it."""
        found = [self.group()]
        while self.take("AND"):
            found.append(self.group())
        if not self.at_end:
            raise NotUnderstood(f"{' '.join(self._tokens[self._at :])!r} is not understood")
        return found

    def group(self) -> tuple[Noun | None, list[_Phrase]]:
        """A noun phrase and the prepositional phrases after it."""
        noun, phrases = self.noun(), []
        while self._next() and self._next() not in {"AND", "OF"} and not self._next().islower():
            phrases.append(self._phrase())
        return noun, phrases

    def noun(self) -> Noun | None:
        """Parse determiner, words and "of ..."; None if there are no words."""
        determiners, words = self._words(_DETERMINERS), self._words(None)
        while self.take("OF"):
            self._words(_DETERMINERS)
            words = [*self._words(None), *words]
        if not words:
            return None
        noun = Noun(
            words=tuple(map(singular, words)),
            plural=bool({"both", "all", "two"} & set(determiners))
            or words[-1] == "them"
            or words[-1] != singular(words[-1]),
            indefinite=bool({"a", "an", "any", "some"} & set(determiners)),
        )
        return replace(noun, side=self._side())

    def _words(self, only: frozenset[str] | None) -> list[str]:
        found = []
        while self._next() and self._next().islower() and (only is None or self._next() in only):
            found.append(self._next())
            self._at += 1
        return found

    def _side(self) -> str | None:
        if not self._next().startswith("AT_"):
            return None
        side = self._next().removeprefix("AT_")
        self._at += 1
        return _SAME_SIDE.get(side, side)

    def _phrase(self) -> _Phrase:
        negated = self.take("NOT")
        kind = self._next().lower()
        self._at += 1
        if kind not in {"between", *_PLACES, *_MODIFIERS}:
            raise NotUnderstood(f"{kind!r} is not expected here")
        thing = self.noun()
        second = self.noun() if kind == "between" and self.take("AND") else None
        if kind == "between" and second is None and not (thing and thing.plural):
            raise NotUnderstood("'between' needs two objects")
        return _Phrase(kind, thing, second, negated)


_PLACES = frozenset(["on", "in", "top_of", "under", "near", "left_of", "right_of", "front_of", "back_of"])
_MODIFIERS = frozenset(["from", "outside", "center", "between"])


def _qualified(noun: Noun, phrases: Sequence[_Phrase]) -> Noun:
    """A noun with its prepositional phrases nested as its relation."""
    if not phrases:
        return noun
    first, *rest = phrases
    if first.thing is None:
        raise NotUnderstood(f"'{first.kind}' has no object")
    thing = _qualified(first.thing, rest)
    refs = (thing,) if first.second is None else (first.thing, _qualified(first.second, rest))
    return replace(noun, relation=Relation(kind=first.kind, refs=refs, negated=first.negated))


class _Reader:
    """Turns clauses into actions; keeps the objects that pronouns and omitted objects can refer to."""

    def __init__(self) -> None:
        self._picked: list[Noun] = []
        self._moved: list[Noun] = []
        self._fixture: Noun | None = None
        self._stacked: Action | None = None
        self.actions: list[Action] = []

    def read(self, clauses: Sequence[tuple[str, list[str]]]) -> tuple[Action, ...]:
        for verb, tokens in clauses:
            groups = _Tokens(tokens).groups()
            if verb in {"put", "stack", "push"}:
                self._put(verb, groups)
            elif verb == "pick":
                self._leave_picked()
                self._picked = [_qualified(self._thing(noun), phrases) for noun, phrases in groups]
            else:
                self._operate(verb, groups)
        self._leave_picked()
        return tuple(self.actions)

    def _leave_picked(self) -> None:
        """Objects picked up and not put anywhere stay in the hand."""
        self.actions += [Action(verb="pick", thing=noun) for noun in self._picked]
        self._picked = []

    def _thing(self, noun: Noun | None) -> Noun:
        if noun is not None and not noun.is_pronoun:
            return noun
        if self._fixture is None:
            raise NotUnderstood(f"{'the pronoun' if noun else 'the omitted object'} refers to nothing")
        return self._fixture

    def _operate(self, verb: str, groups: Sequence[tuple[Noun | None, list[_Phrase]]]) -> None:
        for noun, phrases in groups:
            self._fixture = _qualified(self._thing(noun), phrases)
            self.actions.append(Action(verb=verb, thing=self._fixture))

    def _put(self, verb: str, groups: Sequence[tuple[Noun | None, list[_Phrase]]]) -> None:
        placed: list[Action] = []
        for noun, phrases in reversed(groups):
            nouns, place = self._moving(noun), self._place(phrases, placed)
            for one in reversed(nouns):
                thing = _qualified(one, phrases[:-1]) if place is not None else _qualified(one, phrases)
                placed.insert(0, Action(verb="push" if verb == "push" else "put", thing=thing, place=place))
        self._add([self._completed(action, placed, index) for index, action in enumerate(placed)], verb)

    def _moving(self, noun: Noun | None) -> list[Noun]:
        """The objects to put: the noun's, else those picked up, else those put somewhere before."""
        if noun is not None and not noun.is_pronoun:
            return [noun]
        moving = self._picked or self._moved
        if not moving:
            raise NotUnderstood("the object to put there is missing")
        self._picked = []
        return moving

    def _place(self, phrases: Sequence[_Phrase], later: Sequence[Action]) -> Place | None:
        """The last phrase, or the destination of the next object ("put A and B in the basket")."""
        if not phrases:
            return later[0].place if later else None
        last = phrases[-1]
        if last.kind not in _PLACES or last.negated:
            raise NotUnderstood(f"'{last.kind}' is not a destination")
        omitted = Noun(words=("it",))
        return Place(relation=last.kind, thing=last.thing or omitted)

    def _completed(self, action: Action, placed: Sequence[Action], index: int) -> Action:
        """The action with a pronoun or omitted object in its destination resolved."""
        place = action.place
        if place is None:
            raise NotUnderstood(f"the destination of {action.thing} is missing")
        if not place.thing.is_pronoun:
            return action
        before = placed[index - 1].place if index else None
        return replace(action, place=replace(place, thing=before.thing if before else self._thing(None)))

    def _add(self, actions: Sequence[Action], verb: str) -> None:
        if self._stacked and [action.thing for action in actions] == self._moved:
            actions = self._carried_stack(self._stacked, actions[0])
            self.actions.remove(self._stacked)
        self._stacked = actions[0] if verb == "stack" else None
        self._moved = [action.thing for action in actions]
        self._fixture = actions[-1].place.thing if actions[-1].place else self._fixture
        self.actions += actions

    @staticmethod
    def _carried_stack(stack: Action, carry: Action) -> list[Action]:
        """ "Stack A on B and put them in C": B goes to C first, then A onto B; a stack is not carried."""
        assert stack.place is not None
        return [replace(carry, thing=stack.place.thing), stack]


def split_side(words: Sequence[str]) -> tuple[tuple[str, ...], str | None]:
    """Words without the one that selects among equals, and that word: ("middle", "bowl") -> ("bowl",), "middle"."""
    for word in words:
        if word in SIDES and len(words) > 1:
            return tuple(other for other in words if other != word), _SAME_SIDE.get(word, word)
    return tuple(words), None
