"""What must not be done, what must be left alone or avoided, and questions, which are refused."""

from __future__ import annotations

from voxposer.offline.clause import Clause
from voxposer.offline.determiners import read_length
from voxposer.offline.groups import read_groups
from voxposer.offline.lexicon import GERUNDS, QUESTIONS, STATES, VERBS
from voxposer.offline.names import NotUnderstood
from voxposer.offline.nouns import read_noun_phrase
from voxposer.offline.orders import imperative
from voxposer.offline.tokens import Cursor


def question(cursor: Cursor) -> Clause | None:
    """Refuse "is the stove on"; other sentences are left to other readers."""
    if cursor.peek() not in QUESTIONS or cursor.sees("do not", "do the same"):
        return None
    if cursor.peek() == "do" and cursor.peek(1) not in {"you", "we", "i", "they", "not"}:
        return None
    raise NotUnderstood(f"{cursor.rest!r} asks a question; only orders are understood")


def forbidden(cursor: Cursor) -> Clause | None:
    """ "don't ...", "never ..."."""
    cursor.take("please")
    if not cursor.take(
        "do not", "don't", "dont", "never", "must not", "should not", "you must not", "you should not", "not"
    ):
        return None
    cursor.take("ever", "you dare", "even")
    start = cursor.at
    if constraint(cursor) is not None:
        raise NotUnderstood(f"'not {' '.join(cursor.tokens[start : cursor.at])}' does not say what is wanted")
    cursor.at = start
    touched = _touching(cursor)
    if touched is not None:
        return touched
    clause = imperative(False)(cursor)
    if clause is None:
        raise NotUnderstood(f"what must not be done in {cursor.rest!r}?")
    clause.forbidden = True
    return clause


def _touching(cursor: Cursor) -> Clause | None:
    """ "touching the butter", "bump into the bottle": what motions must keep away from."""
    start = cursor.at
    verb = cursor.next()
    base = verb if verb in VERBS else GERUNDS.get(verb, "")
    comes = verb in {"go", "going", "come", "coming", "get", "getting"} and cursor.sees("near", "close to")
    if VERBS.get(base) not in {"touch", "avoid"} and not comes:
        cursor.at = start
        return None
    cursor.take("into", "against", "over", "near to", "near", "close to", "with")
    if cursor.take(*_REST):
        return Clause("avoid")
    return Clause("avoid", read_groups(cursor))


def constraint(cursor: Cursor) -> Clause | None:
    """ "without touching X", "avoiding X", "keep 10 cm away from X", "leave X where it is", "keep X closed"."""
    cursor.take("while", "but", "and")
    if cursor.take("without"):
        return _without(cursor)
    word = cursor.next()
    base = word if word in VERBS or word in {"stay", "steer"} else GERUNDS.get(word, word.removesuffix("ing"))
    if base == "avoid":
        cursor.take_any(GERUNDS)
        return Clause("avoid", read_groups(cursor))
    if base in {"keep", "stay", "steer"}:
        cm = read_length(cursor)
        cursor.take("a distance of")
        cm = read_length(cursor) if cm is None else cm
        cursor.take("well", "far")
        if cursor.take("away from", "clear of", "from", "off", "out of the way of"):
            clause = Clause("avoid", read_groups(cursor), cm=cm)
            cursor.take("at all times", "all the time", "at any time")
            return clause
    if base in {"leave", "keep"}:
        return _left(cursor)
    return None


def _without(cursor: Cursor) -> Clause:
    touched = _touching(cursor)
    if touched is not None:
        return touched
    clause = imperative(False)(cursor)
    if clause is None:
        raise NotUnderstood(f"'without {cursor.rest}' is not understood")
    if clause.verb == "put" and not any(phrases for _, phrases in clause.groups) and not clause.cm:
        return Clause("avoid", clause.groups)
    clause.forbidden = True
    return clause


AS_IT_IS = (
    "where it is", "where they are", "as it is", "as they are", "alone", "untouched", "in place", "there", "here",
    "in its place", "in their places", "on the table", "where it was", "where they were", "be", "on the counter",
    "in peace",
)  # fmt: skip


# What nothing is done with anyway.
_REST = (
    "everything else", "anything else", "all else", "all the rest", "the rest", "all the others", "all others",
    "the others", "all other things", "all other objects", "the other things", "the other objects",
    "any other thing", "any other object",
)  # fmt: skip


def _left(cursor: Cursor) -> Clause | None:
    """ "the bowls where they are", "it open"."""
    if cursor.take(*_REST) and cursor.take(*AS_IT_IS):
        return Clause("untouched")
    noun = read_noun_phrase(cursor)
    if noun is None:
        return None
    if cursor.take(*AS_IT_IS):
        return Clause("untouched", [(noun, [])])
    cursor.take("turned", "switched")
    state = STATES.get(cursor.peek())
    if state and not (state in {"on", "off"} and cursor.peek(1) not in {"", ",", ".", "and", "but", "then"}):
        cursor.next()
        return Clause(f"keep_{state}", [(noun, [])])
    return None
