"""What stands before the words of a noun, "the second largest", and lengths, "10 cm"."""

from __future__ import annotations

from dataclasses import dataclass

from voxposer.offline.lexicon import (
    ALL,
    ARTICLES,
    FARTHEST,
    INDEFINITE,
    MODALS,
    NEAREST,
    NUMBERS,
    ORDERS,
    ORDINALS,
    PARTICLES,
    PREPOSITIONS,
    SIDE_WORDS,
    UNITS,
    words,
)
from voxposer.offline.tokens import Cursor

# Words that end the words of a noun phrase.
_STOPS = (
    frozenset(phrase[0] for phrase in PREPOSITIONS if phrase[0] not in SIDE_WORDS)
    | frozenset(phrase[0] for phrase in MODALS if phrase[0] not in {"can", "will", "may", "might"})
    | NEAREST
    | FARTHEST
    | (PARTICLES - {"back"})
    | frozenset(
        words(
            """and or but then not that which who whose except excluding without before after once while when as is are
            was were be been goes go belongs belong of , . ( ) where than so if until unless nor neither besides apart
            other others again at you we i has have had need needs there here ends sits stands lies forward forwards
            backward backwards alone untouched halfway midway somewhere immediately otherwise else exactly precisely
            only"""
        )
    )
)
# Verbs of a relative clause that says where something is.
LINKS = ("is", "are", "was", "were", "lies", "lie", "sits", "sit", "stands", "stand", "lay", "stood", "rests")


def is_word(token: str) -> bool:
    """Whether a token can be a word of a name."""
    return bool(token) and (token[0].isalnum()) and token not in _STOPS


def read_length(cursor: Cursor) -> float | None:
    """A length in centimetres: "10 cm", "two inches", "half a foot", "a little"; None if there is none here."""
    start = cursor.at
    cursor.take("about", "around", "roughly", "approximately", "exactly", "by", "at least", "some", "for")
    cursor.take("about", "around", "roughly", "approximately", "exactly", "at least")
    if cursor.take("a little bit", "a little", "a bit", "slightly", "a tad") and not is_word(cursor.peek()):
        return 5.0
    half = cursor.take("half a", "half an")
    token = cursor.next()
    number = 0.5 if half else _number(token)
    if half:
        cursor.at -= 1
    elif number is not None and cursor.take("and a half"):
        number += 0.5
    unit = UNITS.get(cursor.peek())
    if number is None or unit is None:
        cursor.at = start
        return None
    cursor.next()
    if cursor.take("and a half"):
        number += 0.5
    return number * unit


def _number(token: str) -> float | None:
    if token in {"a", "an"}:
        return 1.0
    if token in NUMBERS:
        return float(NUMBERS[token])
    try:
        return float(token.replace(",", ".")) if token[:1].isdigit() and token.isascii() else None
    except ValueError:
        return None


@dataclass
class Determiner:
    """What stands before the words of a noun."""

    given: bool = False
    definite: bool = False
    said: bool = False
    plural: bool = False
    indefinite: bool = False
    number: int | None = None
    exact: bool = False
    other: bool = False
    ordinal: int | None = None
    key: str = ""


def read_determiner(cursor: Cursor) -> Determiner:
    """Everything before the words of a noun."""
    found = Determiner()
    while True:
        token, after = cursor.peek(), cursor.peek(1)
        if token in {"one", "any", "each", "all", "both", "either"} and after == "of":
            cursor.at += 2
            found.indefinite |= token in {"one", "any", "either"}
            found.plural |= token in {"each", "all", "both"}
            found.number, found.exact = (2, True) if token == "both" else (found.number, found.exact)
        elif token in ARTICLES and not (token == "that" and after in LINKS):
            found.definite, found.said = True, token in {"that", "this", "these", "those"}
            cursor.next()
        elif token == "only" and found.definite:
            cursor.next()
        elif token in INDEFINITE:
            found.indefinite = True
            found.other |= token == "another"
            cursor.next()
        elif token == "both":
            found.plural, found.number, found.exact = True, 2, True
            cursor.next()
        elif token in ALL:
            found.plural = True
            cursor.next()
        elif (token in NUMBERS or token.isdecimal()) and (found.plural or _counts(cursor)):
            found.number = NUMBERS[token] if token in NUMBERS else int(token)
            found.exact |= found.definite or found.plural
            cursor.next()
        elif token in {"other", "remaining", "others"}:
            found.other = True
            found.plural |= token == "others"
            cursor.next()
        elif not _take_order(cursor, found):
            return found
        found.given = True


def _counts(cursor: Cursor) -> bool:
    """Whether a number counts things: a word of a name, or of their order, follows."""
    after = cursor.peek(1)
    known = is_word(after) and after not in UNITS
    return known or after in NEAREST | FARTHEST | {"other"} or (cursor.peek() != "one" and after == "of")


def _take_order(cursor: Cursor, found: Determiner) -> bool:
    """An ordinal or a superlative."""
    token = cursor.peek()
    if token in ORDINALS and found.ordinal is None and cursor.peek(1) not in {",", ".", ""}:
        found.ordinal = ORDINALS[token]
    elif token in ORDERS and not found.key:
        found.key = ORDERS[token]
    elif token in NEAREST | FARTHEST and not found.key and found.given:
        found.key = "near" if token in NEAREST else "far"
    else:
        return False
    cursor.next()
    return True
