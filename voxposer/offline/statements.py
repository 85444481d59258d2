"""Statements of what should be, "the bowl belongs on the plate", and clauses that leave out their verb."""

from __future__ import annotations

from collections.abc import Callable

from voxposer.offline.clause import Clause, Group
from voxposer.offline.groups import read_groups
from voxposer.offline.lexicon import GOES, MODALS, PARTICIPLES, STATES, VERBS
from voxposer.offline.limits import AS_IT_IS
from voxposer.offline.names import NotUnderstood
from voxposer.offline.nouns import qualified, read_phrases
from voxposer.offline.orders import at_clause_end, imperative, meant, read_shift, take_state
from voxposer.offline.tokens import Cursor


def wish(cursor: Cursor) -> Clause | None:
    """ "I want the bowl on the plate"."""
    if not cursor.take(
        "i want", "i need", "i would like", "we want", "we need", "i would love", "i wish for", "i prefer"
    ):
        return None
    cursor.take("to have", "to see")
    groups = read_groups(cursor)
    if cursor.take("to be", "to go", "to get"):
        return predicate(cursor, groups)
    if cursor.peek() in PARTICIPLES:
        return predicate(cursor, groups)
    return Clause("put" if any(phrases for _, phrases in groups) else "pick", groups)


def statement(past: bool) -> Callable[[Cursor], Clause | None]:
    """A reader of "the bowl should be put on the plate", "the bowl belongs on the plate", and of such questions.

    What is, or was done, is an order in the past only: "after the bowl has been put on the plate".
    """

    def read(cursor: Cursor) -> Clause | None:
        if cursor.take("could", "can", "should", "would", "will", "must", "may", "shall"):
            return _asked(cursor)
        start = cursor.at
        groups = read_groups(cursor, subject=True)
        if not groups or groups[0][0] is None:
            return None
        if cursor.peek() == "," and cursor.peek(1) in VERBS:
            return _named_first(cursor, groups)
        ordered = bool(_modals(cursor)) or cursor.tokens[max(start - 1, 0)] in _ASSURED
        linked = cursor.take_any(_LINKS) != ""
        while cursor.take_any(_LINKS):
            continue
        if cursor.take("stay", "stays", "remain", "remains"):
            return _staying(cursor, groups)
        if cursor.take_any(GOES):
            cursor.take("up")
            return predicate(cursor, groups)
        if not (ordered or linked):
            return None
        # "When the pot is on the stove" may be a condition.
        placed = cursor.sees(*_WHERE) and cursor.tokens[max(start - 1, 0)] != "when"
        done = past and (cursor.peek() in PARTICIPLES or placed)
        if not (ordered or done or cursor.sees("to be", "not to be", "to go")):
            raise NotUnderstood(f"{' '.join(cursor.tokens[start:])!r} says what is, not what to do")
        return predicate(cursor, groups)

    return read


def _named_first(cursor: Cursor, groups: list[Group]) -> Clause | None:
    """ "The milk, put it in the basket": the pronoun is the object that was named first."""
    cursor.next()
    clause = imperative(False)(cursor)
    if clause is None or not clause.groups:
        return None
    pronoun, phrases = clause.groups[0]
    if pronoun is None or pronoun.words not in {("it",), ("them",), ("they",)} or not pronoun.is_pronoun:
        return None
    things: list[Group] = [(noun and qualified(noun, described), []) for noun, described in groups]
    things[-1] = (things[-1][0], phrases)
    clause.groups[:1] = things
    return clause


# What begins a place: "once the pot is (standing) on the stove" is an order to put it there.
_WHERE = ("standing", "lying", "sitting", "on", "in", "inside", "next to", "beside", "behind", "between", "under")
_LINKS = frozenset(["has", "have", "is", "are", "gets", "get", "was", "were", "been", "being"])
# The last words of "make sure that", "see to it that" and the like.
_ASSURED = frozenset(["sure", "that"])


def _modals(cursor: Cursor) -> int:
    """Take "should", "needs to" and the like; how many."""
    count = 0
    while cursor.take_longest(MODALS):
        count += 1
    return count


def _asked(cursor: Cursor) -> Clause | None:
    """ "could the mug be put on the plate": up to "be" it is the subject."""
    ends = [index for index in range(cursor.at, len(cursor.tokens)) if cursor.tokens[index] in {"be", "go", "please"}]
    if not ends:
        return None
    subject = Cursor(cursor.tokens[cursor.at : ends[0]])
    groups = read_groups(subject, subject=True)
    if not subject.at_end or groups[0][0] is None:
        return None
    cursor.at = ends[0]
    cursor.take("please")
    cursor.take("go")
    return predicate(cursor, groups)


def _staying(cursor: Cursor, groups: list[Group]) -> Clause | None:
    if cursor.take(*AS_IT_IS):
        return Clause("untouched", groups)
    state = STATES.get(cursor.peek(), "")
    if state:
        cursor.next()
        return Clause(f"keep_{state}", groups)
    return None


def predicate(cursor: Cursor, groups: list[Group]) -> Clause | None:
    """What is to become of a subject: "not", "be", a participle and its phrases, or a place."""
    negated = cursor.take("not")
    while cursor.take("be", "been", "to be", "get", "have been", "being", "now"):
        continue
    negated = cursor.take("not") or negated
    word = cursor.peek()
    if word in PARTICIPLES:
        cursor.next()
        base = PARTICIPLES[word]
        if VERBS[base] in {"touch", "avoid"}:
            return Clause("avoid", groups) if negated or VERBS[base] == "avoid" else None
        action = VERBS[base]
        state = take_state(cursor, switched=action == "turn") if action in {"turn", "push", "pull"} else ""
        particle = cursor.take_any({"up", "down", "out", "back", "away"})
        moved = read_shift(cursor)
        noun, phrases = groups[-1]
        if action == "leave" and cursor.take(*AS_IT_IS):
            return Clause("untouched", groups)
        groups[-1] = (noun, [*phrases, *read_phrases(cursor)])
        clause = meant(cursor, action, groups, state, particle, moved)
    elif (word in STATES and word not in {"on", "off"}) or (word in {"on", "off"} and at_clause_end(cursor, 1)):
        cursor.next()
        state = STATES[word]
        clause = Clause(f"turn_{state}" if state in {"on", "off"} else state, groups)
    else:
        cursor.take("somewhere", "placed", "standing", "lying", "sitting")
        phrases = read_phrases(cursor)
        if not phrases:
            return None
        if negated and cursor.take(", but rather", ", but", "but rather", "but") and (instead := read_phrases(cursor)):
            negated, phrases = False, instead
        groups[-1] = (groups[-1][0], [*groups[-1][1], *phrases])
        clause = Clause("put", groups)
    clause.forbidden = negated
    if negated and clause.verb == "put" and not clause.groups[-1][1]:
        return Clause("untouched", groups)
    return clause


def elliptic(cursor: Cursor) -> Clause | None:
    """A clause without a verb behind one that has it: "then the cream cheese", "then off"."""
    if cursor.peek() in STATES and at_clause_end(cursor, 1):
        state = STATES[cursor.next()]
        return Clause(f"turn_{state}" if state in {"on", "off"} else state, [(None, [])])
    start = cursor.at
    groups = read_groups(cursor)
    if groups and groups[0][0] is not None and not groups[0][0].is_pronoun and cursor.at > start:
        return Clause("again", groups)
    return None
