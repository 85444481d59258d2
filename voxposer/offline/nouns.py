"""Noun phrases: "the second bowl from the left", "all cans except the red one", "the mug that is closest to it".

A cursor comes in; a :class:`~voxposer.offline.meaning.Noun` goes out, and the prepositional phrases behind it as
:class:`Phrase` s: whether such a phrase describes the object or says where to put it is for the clause to decide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from voxposer.offline.determiners import LINKS, Determiner, is_word, read_determiner, read_length
from voxposer.offline.lexicon import (
    ALL,
    ARTICLES,
    EXCEPTIONS,
    FARTHEST,
    GERUNDS,
    INDEFINITE,
    NEAREST,
    OPENED,
    ORDERS,
    ORDINALS,
    PARTICIPLES,
    PREPOSITIONS,
    SIDE_WORDS,
    STATES,
    VERBS,
    words,
)
from voxposer.offline.meaning import Noun, Ranking, Relation
from voxposer.offline.names import COLOURS, NotUnderstood, singular
from voxposer.offline.tokens import Cursor, is_side_end

# What "back" is a particle of the verb before: "put the book back on the shelf".
_BEFORE_PLACES = frozenset(["", ",", ".", "and", "then", *(phrase[0] for phrase in PREPOSITIONS if phrase[0] != "of")])
_RELATIVES = ("that", "which", "who")
_PARTITIVES = frozenset(["piece", "stick", "pat", "slice", "bit", "unit", "item", "kind"])
# Words before a preposition that change nothing here.
_NEARLY = ("halfway", "midway", "half way", "exactly", "precisely", "somewhere", "right", "immediately")
_MODIFIERS = frozenset(["from", "outside", "center", "between"])
_SIDED = frozenset(words("left_of right_of front_of back_of"))
PLACES = frozenset(words("on in top_of under near left_of right_of front_of back_of between center to towards"))


@dataclass(frozen=True, kw_only=True)
class Phrase:
    """A prepositional phrase.

    Attributes:
        kind: the relation.
        thing: the object, None where it is implied ("put the bowl inside").
        second: for between, the other object.
        negated: "not in the basket".
        cm: "10 cm to the left of the basket", or None.
        said: the preposition as it was said.
    """

    kind: str
    thing: Noun | None = None
    second: Noun | None = None
    negated: bool = False
    cm: float | None = None
    said: str = ""


def read_noun_phrase(cursor: Cursor, *, inner: bool = False, described: bool = False) -> Noun | None:
    """A noun phrase without the prepositional phrases behind it; None if there is none here.

    Args:
        cursor: where to read.
        inner: inside another noun phrase, to which "besides" belongs.
        described: behind a preposition; an exception is then one of the object before it, unless this is a plural.
    """
    start = cursor.at
    noun = _head(cursor)
    if noun is None:
        cursor.at = start
        return None
    return _with_modifiers(cursor, noun, inner, described or inner)


def read_phrases(cursor: Cursor, *, inner: bool = False) -> list[Phrase]:
    """The prepositional phrases that come next."""
    found = []
    while (phrase := read_phrase(cursor, inner=inner)) is not None:
        found.append(phrase)
    return found


def read_phrase(cursor: Cursor, *, inner: bool = False) -> Phrase | None:
    """The prepositional phrase that comes next, None if there is none."""
    start = cursor.at
    if cursor.take("side by side"):
        return Phrase(kind="near", thing=Noun(words=("each other",)), said="side by side")
    negated = cursor.take("not")
    cm = read_length(cursor)
    cursor.take("away", "further", "farther")
    if cm is not None:
        cursor.take("and")
    said = cursor.rest
    kind = cursor.take_meaning(PREPOSITIONS)
    while kind is None and cursor.take(*_NEARLY):
        said = cursor.rest
        kind = cursor.take_meaning(PREPOSITIONS)
    if kind is None or (cm is not None and kind not in PLACES | {"from"}) or _ends_bare(cursor, kind):
        cursor.at = start
        return None
    words = said[: len(said) - len(cursor.rest)].strip()
    if kind in {"to", "towards"} and (side := _bare_side(cursor)):
        return Phrase(kind=f"{side}_of", cm=cm, negated=negated, said=f"{words} the {side}")
    if cm is not None and kind == "from":
        kind = "near"
    thing = read_noun_phrase(cursor, inner=inner, described=True)
    second = None
    if kind == "between":
        second = read_noun_phrase(cursor, inner=inner, described=True) if cursor.take("and") else None
        if second is None and not (thing and (thing.plural or thing.words == ("them",))):
            raise NotUnderstood("'between' needs two objects")
    if kind == "center" and thing is not None and thing.words[-1] == "workspace":
        thing = Noun(words=("table",))
    cm = _gap_behind(cursor) if cm is None and kind in _SIDED and thing is not None else cm
    return Phrase(kind=kind, thing=thing, second=second, negated=negated, cm=cm, said=words)


def _gap_behind(cursor: Cursor) -> float | None:
    """ "to the left of the plate, 5 cm away from it", "... with a gap of 5 cm"."""
    start = cursor.at
    cursor.take(",")
    gap = cursor.take("with a gap of", "at a distance of", "with a distance of", "leaving a gap of", "leaving")
    cm = read_length(cursor)
    if cm is not None and (cursor.take("away", "apart", "from it", "of space", "between them") or gap):
        cursor.take("from it", "from that", "between them", "in between")
        return cm
    cursor.at = start
    return None


def _bare_side(cursor: Cursor) -> str:
    """A side with nothing behind it, "to the right"; "" if there is none here."""
    start = cursor.at
    cursor.take("the")
    side = SIDE_WORDS.get(cursor.next(), "")
    cursor.take("hand side", "side")
    if side in {"left", "right", "front", "back"} and is_side_end(cursor):
        return side
    cursor.at = start
    return ""


def _ends_bare(cursor: Cursor, kind: str) -> bool:
    """A preposition with nothing behind it that can do without only at some places: "put it in" but not "between"."""
    if kind == "to" and cursor.peek() in {"be", "go", "get", "have", "stay"}:
        return True
    return kind in {"to", "from", "towards"} and cursor.at_end


# -- the noun itself ---------------------------------------------------------------------------------------------------


def _head(cursor: Cursor) -> Noun | None:
    """Determiner, words and "of ..."."""
    start = cursor.at
    if cursor.take("each other", "one another"):
        return Noun(words=("each other",))
    found = read_determiner(cursor)
    words, excluded = _words(cursor)
    among = not words and bool(found.key or found.ordinal) and found.number is None
    if not words and (pronoun := _lone(cursor, found, start)) is not None:
        return pronoun
    number, exact, plural = found.number, found.exact, found.plural
    while cursor.peek() == "of" or (not words and found.key and cursor.sees("one of")):
        cursor.take("one")
        cursor.next()
        inner = read_determiner(cursor)
        more, others = _words(cursor)
        if not more:
            raise NotUnderstood(f"what is {' '.join(cursor.tokens[start : cursor.at])!r} of?")
        partitive = bool(words) and all(singular(word) in _PARTITIVES for word in words)
        words = more if partitive or not words else [*more, *words]
        excluded += others
        number = number if inner.number is None else inner.number
        exact |= inner.number is not None
    if not words:
        return None
    plural |= words[-1] != singular(words[-1]) or words[-1] in {"everything", "them", "they"}
    plural &= not among
    return _noun(found, words, excluded, plural=plural, number=number, exact=exact)


def _noun(
    found: Determiner, words: list[str], excluded: list[str], *, plural: bool, number: int | None, exact: bool
) -> Noun:
    key, ordinal = found.key, found.ordinal
    ranking = Ranking(key=key, rank=ordinal or 1) if key else None
    if ordinal is not None and not key:
        ranking = Ranking(key="", rank=ordinal)
    many = plural and not (found.indefinite and not found.number)
    single = number == 1 and not exact
    return Noun(
        words=tuple(map(singular, words)),
        ranking=ranking,
        plural=many and not single,
        indefinite=(found.indefinite and not (many and found.number)) or single,
        number=number,
        exact=exact,
        excluded=tuple(Noun(words=(word,)) for word in excluded),
        other=found.other,
        said=found.said,
    )


def _lone(cursor: Cursor, found: Determiner, start: int) -> Noun | None:
    """Determiners that stand alone: "both", "all", "that", "the other", "the second"."""
    if found.key or found.ordinal is not None:
        if cursor.sees("of", "one of"):
            return None
        return Noun(words=("one",), ranking=Ranking(key=found.key, rank=found.ordinal or 1), number=found.number)
    if found.other:
        return Noun(words=("one",), other=True, plural=found.plural)
    if found.number is not None and found.plural:
        return Noun(words=("them",), plural=True, number=found.number, exact=True)
    if found.plural:
        return Noun(words=("them",), plural=True)
    token = cursor.tokens[start] if start < len(cursor.tokens) else ""
    if found.said and cursor.at == start + 1:
        return Noun(words=(token,), plural=token in {"these", "those"})
    if token == "the" and cursor.at == start + 1 and cursor.sees(*NEAREST, *FARTHEST):
        return Noun(words=("one",))
    return None


def _words(cursor: Cursor) -> tuple[list[str], list[str]]:
    """Words of a name, and those that it must not have ("non-red")."""
    words: list[str] = []
    excluded: list[str] = []
    while True:
        token = cursor.peek()
        if token in {"non", "not"} and not words and cursor.peek(1) in COLOURS:
            excluded.append(cursor.peek(1))
            cursor.at += 2
        elif token == "and" and words and words[-1] in COLOURS and cursor.peek(1) in COLOURS:
            cursor.next()
        elif not is_word(token) or (words and _ends_words(cursor, words[-1])):
            return words, excluded
        else:
            words.append(cursor.next())


def _ends_words(cursor: Cursor, last: str) -> bool:
    """Whether a word that could be part of a name is none here, after the word ``last``."""
    token, after = cursor.peek(), cursor.peek(1)
    return (
        last in {"it", "them", "itself", "there", "they"}
        or (token in STATES and not is_word(after))
        or (token in SIDE_WORDS and after == "of")
        or (token in {"left", "right"} and after == "from")
        or (token == "left" and after == "to")
        or (token == "right" and after in _BEFORE_PLACES - {"", ",", ".", "and", "then", "to"})
        or _starts_length(cursor)
        or (token in {"can", "will", "may", "might", "could"} and after in {"be", "go", "not"})
        or (token == "back" and after in _BEFORE_PLACES)
        or (token == "side" and after == "by")
        or (token in PARTICIPLES and token not in SIDE_WORDS and after in _BEFORE_PLACES - {"", ",", "."})
        or (token in ORDINALS and after in {"", ",", ".", "and", "then"})
        or token in GERUNDS
        or _is_verb(cursor)
    )


def _starts_length(cursor: Cursor) -> bool:
    start = cursor.at
    found = read_length(cursor) is not None
    cursor.at = start
    return found


def _is_verb(cursor: Cursor) -> bool:
    """Whether the next word is a verb with its object, where a comma was left out."""
    return cursor.peek() in VERBS and cursor.peek(1) in ARTICLES | INDEFINITE | ALL | {"it", "them", "both"}


# -- what stands behind the noun ---------------------------------------------------------------------------------------


def _with_modifiers(cursor: Cursor, noun: Noun, inner: bool, described: bool) -> Noun:
    """A noun with what describes it behind it, prepositional phrases aside."""
    while True:
        start = cursor.at
        changed = (
            _relative(cursor, noun)
            or _ranked_from(cursor, noun)
            or _side(cursor, noun)
            or _distance(cursor, noun)
            or _exclusion(cursor, noun, described)
            or (None if inner else _moved(cursor, noun))
        )
        if changed is None:
            cursor.at = start
            return noun
        noun = changed


def _relative(cursor: Cursor, noun: Noun) -> Noun | None:
    """ "that is ...", "which is not red", between commas or not."""
    comma = cursor.peek() == "," and cursor.peek(1) in _RELATIVES
    if comma:
        cursor.next()
    if not (cursor.take_any(_RELATIVES) and cursor.take_any(LINKS)):
        return None
    cursor.take("located", "placed", "standing", "lying", "sitting", "currently", "the one")
    negated = cursor.take("not")
    if negated and cursor.peek() in OPENED and not is_word(cursor.peek(1)):
        changed = replace(noun, words=("closed" if OPENED[cursor.next()] == "open" else "open", *noun.words))
    elif negated:
        changed = _excluding(cursor, noun)
    else:
        changed = _side(cursor, noun) or _distance(cursor, noun) or _adjective(cursor, noun)
    if changed is None:
        phrase = read_phrase(cursor, inner=True)
        if phrase is None:
            raise NotUnderstood(f"{cursor.rest!r} does not describe {noun}")
        changed = qualified(noun, [replace(phrase, negated=phrase.negated or negated)])
    if comma:
        cursor.take(",")
    return changed


def _adjective(cursor: Cursor, noun: Noun) -> Noun | None:
    """ "that is red", "that is the largest"."""
    start = cursor.at
    cursor.take("the")
    if cursor.peek() in ORDERS:
        return replace(noun, ranking=Ranking(key=ORDERS[cursor.next()]))
    if cursor.peek() in COLOURS:
        return replace(noun, words=(cursor.next(), *noun.words))
    if cursor.peek() in OPENED and not is_word(cursor.peek(1)):
        return replace(noun, words=(OPENED[cursor.next()], *noun.words))
    cursor.at = start
    return None


def _excluding(cursor: Cursor, noun: Noun) -> Noun | None:
    """ "not red", "not the left one": what is excluded."""
    start = cursor.at
    if cursor.peek() in COLOURS and not is_word(cursor.peek(1)):
        return replace(noun, excluded=(*noun.excluded, Noun(words=(cursor.next(),))))
    ranked = replace(noun, ranking=None, excluded=(), plural=False, number=None)
    side = _side(cursor, ranked) or _distance(cursor, ranked)
    if side is not None:
        return replace(noun, excluded=(*noun.excluded, side))
    cursor.at = start
    other = read_noun_phrase(cursor, inner=True) if cursor.peek() in ARTICLES else None
    if other is not None:
        return replace(noun, excluded=(*noun.excluded, other))
    cursor.at = start
    return None


def _ranked_from(cursor: Cursor, noun: Noun) -> Noun | None:
    """ "the second bowl from the left": where the counting starts."""
    ranking = noun.ranking
    if ranking is None or ranking.key:
        return None
    start = cursor.at
    side = SIDE_WORDS.get(cursor.next()) if cursor.take("from the", "counting from the", "counted from the") else None
    if side is None or cursor.peek() == "of":
        cursor.at = start
        return None
    cursor.take("side")
    return replace(noun, ranking=replace(ranking, key=side))


def _side(cursor: Cursor, noun: Noun) -> Noun | None:
    """ "on the left": the side that tells one of several."""
    start = cursor.at
    hand = cursor.take("on the", "at the", "in the", "from the", "on your", "on my") or cursor.sees(
        "in front", "in back"
    )
    cursor.take("in") if cursor.peek(1) in {"front", "back"} else None
    cursor.take("far", "very", "left hand", "right hand") if hand else None
    side = SIDE_WORDS.get(cursor.peek()) if hand else None
    if side is None:
        cursor.at = start
        return None
    cursor.next()
    cursor.take("hand")
    cursor.take("side")
    if not is_side_end(cursor) or (noun.ranking is not None and noun.ranking.key):
        cursor.at = start
        return None
    return replace(noun, ranking=Ranking(key=side, rank=noun.ranking.rank if noun.ranking else 1))


def _distance(cursor: Cursor, noun: Noun) -> Noun | None:
    """ "nearest to the plate", "further back", "the furthest to the right"."""
    start = cursor.at
    cursor.take("the")
    word = cursor.take_any(NEAREST | FARTHEST)
    key = "near" if word in NEAREST else "far"
    if not word:
        if noun.ranking is None or noun.ranking.key not in {"near", "far"} or noun.ranking.ref is not None:
            cursor.at = start
            return None
        key = noun.ranking.key
    rank = noun.ranking.rank if noun.ranking else 1
    cursor.take("away")
    side_at = cursor.at
    cursor.take("to the", "on the", "at the", "towards the", "in the")
    side = SIDE_WORDS.get(cursor.peek())
    if word and side:
        cursor.next()
        cursor.take("side")
        if is_side_end(cursor):
            return replace(noun, ranking=Ranking(key=side, rank=rank))
    cursor.at = side_at
    linked = cursor.take("to", "from") or (word and cursor.peek() in ARTICLES)
    ref = read_noun_phrase(cursor, inner=True) if linked else None
    if ref is None:
        cursor.at = start
        return None
    return replace(noun, ranking=Ranking(key=key, rank=rank, ref=ref))


def _exclusion(cursor: Cursor, noun: Noun, described: bool) -> Noun | None:
    """ "except the red one", "all but the left one", "not red", "without yellow"."""
    start = cursor.at
    cursor.take(",")
    many = noun.plural or noun.indefinite
    for phrase in EXCEPTIONS:
        if (
            cursor.sees(phrase)
            and (many or not (described or phrase == "but"))
            and not (phrase == "besides" and _sees_moved(cursor))
        ):
            cursor.take(phrase)
            return _all_excluded(cursor, _excluding(cursor, noun))
    if cursor.take("without", "not") and cursor.peek() in COLOURS:
        return _excluding(cursor, noun)
    cursor.at = start
    return None


def _all_excluded(cursor: Cursor, noun: Noun | None) -> Noun | None:
    """ "except the front one and the back one": further exclusions of the same kind."""
    while noun is not None:
        start = cursor.at
        cursor.take(",")
        cursor.take("and", "or")
        more = read_noun_phrase(cursor, inner=True) if cursor.at > start and cursor.peek() in ARTICLES else None
        if more is None or more.words[-1] not in {"one", noun.words[-1]}:
            cursor.at = start
            return noun
        noun = replace(noun, excluded=(*noun.excluded, more))
    return None


def _sees_moved(cursor: Cursor) -> bool:
    return cursor.sees("besides the") and cursor.peek(2).isdecimal()


def _moved(cursor: Cursor, noun: Noun) -> Noun | None:
    """ "besides the 1 on the plate": how the planner says which are done already."""
    if not _sees_moved(cursor):
        return None
    cursor.at += 2
    count = int(cursor.next())
    phrase = read_phrase(cursor, inner=True)
    if phrase is None:
        return None
    relation = qualified(noun, [phrase]).relation
    assert relation is not None
    return replace(noun, moved=(*noun.moved, (count, relation)))


def qualified(noun: Noun, phrases: list[Phrase]) -> Noun:
    """A noun with its prepositional phrases nested as its relation: each describes the noun before it."""
    if not phrases:
        return noun
    first, *rest = phrases
    if first.thing is None:
        raise NotUnderstood(f"'{first.said}' has no object")
    if first.kind not in PLACES | _MODIFIERS or first.kind in {"to", "towards"}:
        raise NotUnderstood(f"'{first.said} {first.thing}' does not describe an object")
    if noun.relation is not None:
        raise NotUnderstood(f"{noun} has two descriptions of its place; say one")
    thing = qualified(first.thing, rest)
    refs = (thing,) if first.second is None else (first.thing, qualified(first.second, rest))
    return replace(noun, relation=Relation(kind=first.kind, refs=refs, negated=first.negated))
