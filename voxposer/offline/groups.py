"""Noun phrases joined by "and" or commas, each with the prepositional phrases behind it."""

from __future__ import annotations

from dataclasses import replace

from voxposer.offline.clause import Group
from voxposer.offline.determiners import read_length
from voxposer.offline.lexicon import ARTICLES, GERUNDS, GOES, MODALS, NUMBERS, SIDE_WORDS, SIZES, VERBS, words
from voxposer.offline.meaning import Noun
from voxposer.offline.names import COLOURS, NotUnderstood
from voxposer.offline.nouns import Phrase, read_noun_phrase, read_phrase, read_phrases
from voxposer.offline.tokens import Cursor


def read_groups(cursor: Cursor, *, subject: bool = False) -> list[Group]:
    """Noun phrases joined by "and" or commas, each with the prepositional phrases behind it.

    Args:
        cursor: where to read.
        subject: whether they are the subject of a statement, so that what follows an "and" may be one too.
    """
    cursor.take("both") if _is_pair(cursor) else None
    found = [_group(cursor)]
    while _joins(cursor, subject) or _chosen(cursor, found):
        found.append(_group(cursor))
    share_head(found)
    if cursor.sees("or", ", or", "and or", "nor"):
        raise NotUnderstood(f"'or' leaves open which: {' '.join(cursor.tokens)!r}")
    return found


def _chosen(cursor: Cursor, found: list[Group]) -> bool:
    """Skip "or ..." where the sentence says that it does not matter which; what is said first is done."""
    if not (cursor.indifferent and cursor.take(", or", "or")):
        return False
    _, phrases = _group(cursor)
    noun, own = found[-1]
    found[-1] = (noun, own or phrases)
    return _joins(cursor, False) or _chosen(cursor, found)


def share_head(groups: list[Group]) -> None:
    """ "The left and the right bowl": the noun of the last one is that of those before."""
    for index in range(len(groups) - 2, -1, -1):
        (noun, phrases), (after, later) = groups[index], groups[index + 1]
        if noun is None or after is None or phrases or not set(noun.words) <= _ADJECTIVES or noun.is_pronoun:
            continue
        if noun.words == ("one",) and noun.ranking is None:
            continue
        words = tuple(word for word in noun.words if word != "one")
        groups[index] = (replace(noun, words=(*words, after.words[-1]), plural=False), phrases)
        groups[index + 1] = (replace(after, plural=False) if after.number is None else after, later)


_ADJECTIVES = frozenset([*SIDE_WORDS, *COLOURS, *SIZES, "one"])


def _is_pair(cursor: Cursor) -> bool:
    """ "both the soup and the butter", where "both" belongs to no noun; "both bowls" is another thing."""
    if cursor.peek() != "both" or cursor.peek(1) == "of":
        return False
    start = cursor.at
    cursor.next()
    first = read_noun_phrase(cursor)
    named = cursor.tokens[start + 1 : start + 2] != [] and cursor.tokens[start + 1] in ARTICLES
    pair = first is not None and (named or not first.plural) and cursor.sees("and")
    cursor.at = start
    return pair


def _group(cursor: Cursor) -> Group:
    cursor.take("only", "just")
    noun = read_noun_phrase(cursor)
    if noun is not None and noun.is_pronoun:
        cursor.take("both", "all", "each")
    noun = _without_another(cursor, noun)
    if noun is None and cursor.take("neither", "nor"):
        raise NotUnderstood("'neither' is not understood")
    back = cursor.peek() == "back"
    if not cursor.sees("out of", "over to", "up to") and not (back and _is_length(cursor)):
        cursor.take("up", "down", "back", "out", "away", "over")
    cursor.take(*_SO_THAT) if noun is not None else None
    phrases = read_phrases(cursor)
    if back and not phrases and (cursor.at_end or cursor.peek() in {",", ".", "and", "then"}):
        raise NotUnderstood(f"'back' to where? Where {noun or 'it'} was before is not remembered")
    if cursor.take("there", "in there", "over there"):
        phrases.append(Phrase(kind="there", said="there"))
    if noun is None and len(phrases) == 1 and cursor.peek() in {"the", "a", "an", "both", "all"}:
        noun = read_noun_phrase(cursor)
    return noun, phrases


# "Move the cup so that it is in front of the plate" is "move the cup in front of the plate".
_SO_THAT = tuple(
    f"{so} {it}"
    for so in ("so that", "such that", "so", ", so that", ", such that", ", so")
    for it in ("it is", "they are", "it stands", "they stand", "it lies", "they lie", "it sits", "it ends up")
)


def _without_another(cursor: Cursor, noun: Noun | None) -> Noun | None:
    """ "the bowl, not the bottle, on the plate": the other one is not meant."""
    start = cursor.at
    cursor.take(",")
    if noun is not None and not noun.is_pronoun and cursor.take("and not", "but not", "not", "rather than"):
        other = read_noun_phrase(cursor) if cursor.peek() in ARTICLES else None
        if other is not None and cursor.take(",") and read_phrase(Cursor(cursor.tokens[cursor.at :])) is not None:
            return replace(noun, excluded=(*noun.excluded, other))
    cursor.at = start
    return noun


def _is_length(cursor: Cursor) -> bool:
    """Whether a length comes after the next token."""
    return read_length(Cursor(cursor.tokens[cursor.at + 1 :])) is not None


def _joins(cursor: Cursor, subject: bool) -> bool:
    """Take "and", a comma or both, if another noun phrase of the same clause follows."""
    start = cursor.at
    if not cursor.take(", and", ", as well as", "as well as", "and also", "and", ",", "along with", "together with"):
        return False
    both = cursor.at
    if cursor.peek() in NUMBERS or cursor.peek() not in VERBS:
        ahead = cursor.peek()
        if ahead not in _STARTS and ahead not in GERUNDS and (subject or not _states_something(cursor)):
            cursor.at = both
            return True
    cursor.at = start
    return False


# Words that start another clause, or end one.
_STARTS = frozenset(
    words(
        """then but not without while after before once you please finally next first lastly . avoiding keeping staying
        do never when so i also which who having afterwards later leaving nor stay steer with don't instead if until is
        are unless otherwise else"""
    )
) | {""}


def _states_something(cursor: Cursor) -> bool:
    """Whether what follows is a statement of its own: "and the bowl should be ..."."""
    start = cursor.at
    try:
        noun = read_noun_phrase(cursor)
        if noun is None and read_phrase(cursor) is None:
            return True
        read_phrases(cursor)
        stated = cursor.peek() in GOES or bool(cursor.take_longest(MODALS)) or cursor.peek() in {"is", "are"}
    except NotUnderstood:
        return False
    finally:
        cursor.at = start
    return stated
