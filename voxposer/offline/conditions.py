"""Conditions: "if the drawer is open, ...", "..., unless the stove is on", and "otherwise"."""

from __future__ import annotations

from voxposer.offline.clause import Spoken
from voxposer.offline.lexicon import STATES
from voxposer.offline.names import NotUnderstood
from voxposer.offline.nouns import read_noun_phrase, read_phrase
from voxposer.offline.orders import at_clause_end
from voxposer.offline.tokens import Cursor

IF = ("only if", "but only if", "in case", "provided that", "if")
UNLESS = ("unless",)
OTHERWISE = ("otherwise", "or else", "else", "if not")
# Relations that a condition can be about.
_RESTING = frozenset(["on", "in", "top_of"])
_ADVERBS = ("already", "still", "currently", "now", "yet", "really", "standing", "lying", "sitting")


def read_condition(cursor: Cursor) -> Spoken | None:
    """The condition that comes next, from its "if" or "unless" on; None if there is none here.

    Raises:
        NotUnderstood: it is about something else than what is open, on, or somewhere.
    """
    start = cursor.at
    unless = cursor.take(*UNLESS)
    if not unless and not cursor.take(*IF):
        return None
    said = " ".join(cursor.tokens[start:])
    noun = read_noun_phrase(cursor)
    if noun is None or not cursor.take("is", "are"):
        raise NotUnderstood(f"the condition in {said!r} is not understood")
    negated = cursor.take("not")
    cursor.take(*_ADVERBS)
    cursor.take("turned", "switched")
    state = STATES.get(cursor.peek(), "")
    place = None
    if state and (state not in {"on", "off"} or _is_end(cursor)):
        cursor.next()
    else:
        state, place = "", read_phrase(cursor, inner=True)
        if place is None or place.kind not in _RESTING or place.thing is None:
            raise NotUnderstood(f"the condition in {said!r} is not understood")
        negated = negated != place.negated
    cursor.take(*_ADVERBS)
    if not _is_end(cursor, 0):
        raise NotUnderstood(f"the condition in {said!r} is not understood")
    return Spoken(thing=noun, state=state, place=place, negated=negated != unless)


def _is_end(cursor: Cursor, ahead: int = 1) -> bool:
    return at_clause_end(cursor, ahead) or cursor.peek(ahead) in {*_ADVERBS, "otherwise", "else"}
