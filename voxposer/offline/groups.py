"""Noun phrases joined by "and" or commas, each with the prepositional phrases behind it."""

from __future__ import annotations

from dataclasses import replace

from voxposer.offline.clause import Group
from voxposer.offline.lexicon import ARTICLES, GERUNDS, GOES, MODALS, NUMBERS, SIDE_WORDS, SIZES, VERBS, words
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
    while _joins(cursor, subject):
        found.append(_group(cursor))
    _share_head(found)
    if cursor.sees("or", ", or", "and or", "nor"):
        raise NotUnderstood(f"'or' leaves open which: {' '.join(cursor.tokens)!r}")
    return found


def _share_head(groups: list[Group]) -> None:
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
    noun = read_noun_phrase(cursor)
    if noun is not None and noun.is_pronoun:
        cursor.take("both", "all", "each")
    if noun is None and cursor.take("neither", "nor"):
        raise NotUnderstood("'neither' is not understood")
    if not cursor.sees("out of", "over to", "up to"):
        cursor.take("up", "down", "back", "out", "away", "over")
    phrases = read_phrases(cursor)
    if cursor.take("there", "in there", "over there"):
        phrases.append(Phrase(kind="there", said="there"))
    if noun is None and len(phrases) == 1 and cursor.peek() in {"the", "a", "an", "both", "all"}:
        noun = read_noun_phrase(cursor)
    return noun, phrases


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
