"""Imperatives: "put X on Y", "move X 10 cm to the left", "turn X on", "I want X on Y"."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from voxposer.offline.clause import Clause, Group
from voxposer.offline.determiners import read_length
from voxposer.offline.groups import read_groups, share_head
from voxposer.offline.lexicon import GERUNDS, PARTICIPLES, STATES, VERBS
from voxposer.offline.meaning import Noun
from voxposer.offline.names import NotUnderstood
from voxposer.offline.nouns import Phrase, read_noun_phrase, read_phrase, read_phrases
from voxposer.offline.tokens import Cursor

_SAME = tuple(
    f"{verb} {preposition}"
    for verb in (
        "do the same",
        "do the same thing",
        "do likewise",
        "likewise",
        "the same",
        "same",
        "repeat this",
        "repeat that",
    )
    for preposition in ("with", "for", "to")
)


def same(cursor: Cursor) -> Clause | None:
    """ "do the same with the right one"."""
    if not cursor.take(*_SAME):
        return None
    return Clause("same", read_groups(cursor))


def imperative(past: bool) -> Callable[[Cursor], Clause | None]:
    """A reader of "put ...", "putting ...", and in the past also "placed ..."."""

    def read(cursor: Cursor) -> Clause | None:
        word = cursor.next()
        base = word if word in VERBS else GERUNDS.get(word, "")
        if past and not base:
            base = PARTICIPLES.get(word, "")
        if not base or VERBS[base] in {"touch", "avoid", "keep"}:
            return None
        if past and cursor.peek() == "been":
            return None
        return _verb_phrase(cursor, base)

    return read


def _verb_phrase(cursor: Cursor, base: str) -> Clause:
    """A verb's objects and phrases; its particles and states decide what it means."""
    action = VERBS[base]
    stated, switched = action in {"turn", "push", "pull", "open", "close"}, action == "turn"
    state = take_state(cursor, switched=switched) if stated else ""
    particle = cursor.take_any(
        {"up", "down", "over", "out", "away", "back"} - ({"back"} if _is_noun_next(cursor) else set())
    )
    cursor.take("on to", "onto") if base == "hold" else None
    if cursor.peek() == "and" and cursor.peek(1) in VERBS and (shared := _shared(cursor, action, state)) is not None:
        return shared
    moved = read_shift(cursor)
    groups, out = _not_but(cursor) if cursor.peek() in {"neither", "not"} else (read_groups(cursor), [])
    state = state or take_state(cursor, switched=switched)
    cursor.take("up", "down", "back")
    clause = meant(cursor, action, groups, state, particle, moved)
    clause.ruled_out += out
    return clause


def _shared(cursor: Cursor, action: str, state: str) -> Clause | None:
    """ "Open and close the drawer", "pick up and place the bowl on the plate": the object stands behind both verbs."""
    start = cursor.at
    cursor.next()
    clause = imperative(False)(cursor)
    if clause is None or not clause.groups or clause.groups[0][0] is None or clause.groups[0][0].is_pronoun:
        cursor.at = start
        return None
    if action == "pick" and clause.verb == "put":
        return clause
    cursor.at = start
    if action not in {"open", "close"} or clause.verb not in {"open", "close"} or state:
        return None
    return Clause(action, [(noun, list(phrases)) for noun, phrases in clause.groups])


def _not_but(cursor: Cursor) -> tuple[list[Group], list[Phrase | Noun]]:
    """ "neither the milk nor the butter in the basket, only the soup", "not the left one but the right one"."""
    start = cursor.at
    cursor.next()
    out: list[Group] = []
    while not out or cursor.take("nor", ", nor", "or", "and"):
        noun = read_noun_phrase(cursor)
        if noun is None:
            raise NotUnderstood(f"what must not be in {' '.join(cursor.tokens[start:])!r}?")
        out.append((noun, []))
    share_head(out)
    phrases = read_phrases(cursor)
    cursor.take(",")
    if not cursor.take("but only", "but just", "but rather", "but", "only", "just"):
        raise NotUnderstood(f"{' '.join(cursor.tokens[start:])!r} says only what not to do")
    groups = read_groups(cursor)
    last, head = groups[-1], out[-1][0]
    assert head is not None
    for index, (noun, own) in enumerate(groups):
        if noun is not None and noun.words[-1] == "one":
            groups[index] = (replace(noun, words=(*noun.words[:-1], head.words[-1])), own)
    groups[-1] = (groups[-1][0], last[1] or phrases)
    return groups, [noun for noun, _ in out if noun is not None]


def _is_noun_next(cursor: Cursor) -> bool:
    """Whether "back" is a part of a name: "back bowl", not "back the bowl"."""
    return cursor.peek(1) not in {"the", "a", "it", "them", "on", "in", "to", "into", "onto", "both", "all"}


def take_state(cursor: Cursor, *, switched: bool) -> str:
    """Take "open", "shut" and the like; "on" and "off" only of what is switched, else "on" says where."""
    state = STATES.get(cursor.peek(), "")
    if not state or (state in {"on", "off"} and not switched):
        return ""
    cursor.next()
    return state


# Words that say where something is moved to without an object.
_WAYS = {
    **{"left": "left", "right": "right", "front": "front", "back": "back"},
    **{"forward": "front", "forwards": "front", "backward": "back", "backwards": "back"},
}


def read_shift(cursor: Cursor) -> tuple[str, float] | None:
    """ "10 cm to the left" with no object behind it."""
    start = cursor.at
    cm = read_length(cursor)
    if cm is None and cursor.peek() in _WAYS and _has_length(cursor, 1):
        way = _WAYS[cursor.next()]
        return way, read_length(cursor) or 0.0
    if cm is None and not cursor.sees("to the", "towards the", "forward", "forwards", "backward", "backwards"):
        return None
    cursor.take("further", "more")
    cursor.take("to the", "towards the", "to its", "to")
    way = _WAYS.get(cursor.peek(), "")
    if way and cursor.peek(1) not in {"of", "side", "hand"} and at_clause_end(cursor, 1):
        cursor.next()
        if cm is None:
            cm = read_length(cursor)
        return way, cm or 0.0
    cursor.at = start
    return None


def _has_length(cursor: Cursor, ahead: int) -> bool:
    """Whether a length comes after some more tokens."""
    return read_length(Cursor(cursor.tokens[cursor.at + ahead :])) is not None


def at_clause_end(cursor: Cursor, ahead: int) -> bool:
    """Whether a clause ends before a token ahead."""
    token = cursor.peek(ahead)
    return token in {"", ",", ".", ";", "and", "then", "but", "before", "after", "without", "while", "by"}


def meant(
    cursor: Cursor, action: str, groups: list[Group], state: str, particle: str, moved: tuple[str, float] | None
) -> Clause:
    """What a verb with its objects, its state ("on", "open"), its particle and its way ("10 cm to the left") means."""
    moved = moved or _shift_of(groups)
    if moved is None and groups and groups[-1][0] is not None:
        moved = read_shift(cursor)
    if action == "turn":
        return _turned(groups, state)
    if action in {"turn_on", "turn_off"}:
        return Clause(action, groups)
    if action in {"push", "pull", "close", "open"} and state in {"open", "close"}:
        return Clause(state, groups)
    if action in {"open", "close"}:
        return Clause(action, groups)
    if action == "pull":
        if not any(phrases for _, phrases in groups) and (particle == "out" or _names_part(groups)):
            return Clause("open", groups)
        raise NotUnderstood("'pull' is understood of drawers and doors only")
    if action == "leave":
        action = "put"
    if action == "pick" and groups and groups[-1][1] and groups[-1][1][-1].said in _GOALS:
        action = "put"
    if moved is not None:
        return Clause("put", groups, way=moved[0], cm=moved[1])
    return Clause(action, groups)


def _turned(groups: list[Group], state: str) -> Clause:
    """ "Turn X on", where "on" was read as a preposition without an object, or "turn on X"."""
    noun, phrases = groups[-1]
    if not state and phrases and phrases[-1].said in {"on", "off"} and phrases[-1].thing is None:
        state, groups[-1] = phrases[-1].said, (noun, phrases[:-1])
    if state not in {"on", "off"}:
        raise NotUnderstood("turn it on or off? 'turn' alone is not understood")
    return Clause(f"turn_{state}", groups)


# Prepositions of a goal: "take X to Y" is to put it there, "take X on Y" is to take the one that is there.
_GOALS = frozenset(["to", "into", "onto", "over to", "up to", "in to", "on to", "to the top of", "onto the top of"])


def _shift_of(groups: list[Group]) -> tuple[str, float] | None:
    """A phrase that turned out to have no object, "to the right": a direction. It is taken off the groups."""
    if not groups or not groups[-1][1]:
        return None
    last = groups[-1][1][-1]
    ways = {"left_of": "left", "right_of": "right", "front_of": "front", "back_of": "back"}
    if last.kind in ways and last.thing is None and last.cm is not None:
        groups[-1][1].pop()
        return ways[last.kind], last.cm
    return None


def _names_part(groups: list[Group]) -> bool:
    return bool(groups) and groups[0][0] is not None and bool({"drawer", "door", "handle"} & set(groups[0][0].words))


def fronted(cursor: Cursor) -> Clause | None:
    """ "On the plate, put the bowl"."""
    phrase = read_phrase(cursor)
    if phrase is None or not (cursor.take(",") or cursor.peek() in VERBS):
        return None
    clause = imperative(False)(cursor)
    if clause is None or not clause.groups:
        return None
    noun, phrases = clause.groups[-1]
    clause.groups[-1] = (noun, [*phrases, phrase])
    return clause
