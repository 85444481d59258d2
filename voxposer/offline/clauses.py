"""Clauses: what is asked for, in words, clause by clause.

A sentence comes in as tokens; :class:`Clause` s go out in the order in which they are said, each with its place in the
order in which they are to be done ("before you ...", "after ..."). Imperatives, gerunds, passives and statements of what
should be ("the bowl belongs on the plate") become the same clauses. What pronouns stand for is not decided here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from voxposer.offline.lexicon import (
    AFTER,
    ARTICLES,
    BEFORE,
    EXCEPTIONS,
    FILLERS,
    GERUNDS,
    GOES,
    MODALS,
    NUMBERS,
    PARTICIPLES,
    POLITE,
    QUESTIONS,
    SIDE_WORDS,
    SIZES,
    SPEEDS,
    STATES,
    THEN,
    VERBS,
)
from voxposer.offline.meaning import Noun
from voxposer.offline.names import COLOURS, NotUnderstood
from voxposer.offline.nouns import Phrase, read_length, read_noun_phrase, read_phrase, read_phrases
from voxposer.offline.tokens import Cursor

Group = tuple[Noun | None, list[Phrase]]


@dataclass
class Clause:
    """A clause.

    Attributes:
        verb: put, pick, stack, push, open, close, turn_on, turn_off, or again (the last verb, which is left out), same
            (the last action with another object); avoid, untouched, keep_open, keep_close, keep_on, keep_off; or "".
        groups: the objects, each with the prepositional phrases behind it.
        forbidden: it must not be done.
        when: place in the order of doing.
        cm: a distance to keep, or how far to move something.
        way: where to move it: left, right, front, back.
        ruled_out: phrases after "not": the order says that it is not these.
        said: its words.
    """

    verb: str
    groups: list[Group] = field(default_factory=list)
    forbidden: bool = False
    when: float = 0.0
    cm: float | None = None
    way: str = ""
    ruled_out: list[Phrase | Noun] = field(default_factory=list)
    said: str = ""


def read_clauses(tokens: Sequence[str]) -> tuple[list[Clause], float | None]:
    """The clauses of an instruction in the order said, and the speed it asks for.

    Raises:
        NotUnderstood: words that are part of no clause; the message quotes them.
    """
    words, speed = _without_manner(list(tokens))
    return _Sentence(Cursor(words)).read(), speed


def _without_manner(tokens: list[str]) -> tuple[list[str], float | None]:
    """The tokens without fillers and words for speed, and the speed."""
    cursor, kept, speed = Cursor(tokens), [], None
    while not cursor.at_end:
        found = _speed(cursor)
        if found is not None:
            if speed is not None and found != speed:
                raise NotUnderstood("two different speeds are asked for")
            speed = found
        elif kept and kept[-1] not in {"the", "a"} and not cursor.sees("instead of") and cursor.take_longest(FILLERS):
            continue
        elif not (cursor.peek() in {",", "."} and (not kept or kept[-1] in {",", "."})):
            kept.append(cursor.next())
        else:
            cursor.next()
    while kept and kept[-1] in {",", "."}:
        kept.pop()
    return kept, speed


def _speed(cursor: Cursor) -> float | None:
    start = cursor.at
    cursor.take("and") if cursor.peek(1) in SPEEDS else None
    cursor.take("very", "more", "as", "quite", "really")
    if cursor.peek() in SPEEDS:
        speed = SPEEDS[cursor.next()]
        cursor.take("as possible", "as you can")
        return speed
    if cursor.take("with care", "at half speed", "at half the speed", "in slow motion"):
        return 0.5
    cursor.at = start
    if cursor.take("at"):
        number = cursor.next()
        if number[:1].isdigit():
            times, joined = number.removesuffix("x"), number.endswith("x")
            if cursor.take("speed") if joined else cursor.take("x speed", "times speed", "times the speed"):
                try:
                    return float(times)
                except ValueError:
                    raise NotUnderstood(f"{number!r} is not a speed") from None
    cursor.at = start
    return None


class _Sentence:
    """Reads clauses one after the other."""

    def __init__(self, cursor: Cursor) -> None:
        self._cursor = cursor
        self._clauses: list[Clause] = []
        self._after: float | None = None

    def read(self) -> list[Clause]:
        while True:
            fresh, first = self._separator()
            if self._cursor.at_end:
                return self._clauses
            self._add(fresh, first)

    def _separator(self) -> tuple[bool, bool]:
        """Skip what joins clauses; whether a new sentence or an order word comes, and whether the latter is "first"."""
        cursor = self._cursor
        fresh = not self._clauses
        first = False
        while True:
            if cursor.take(".", ";", ":"):
                fresh = True
            elif cursor.take(",", "and", "&") or self._polite():
                continue
            elif not (order := self._order_word()):
                return fresh, first
            else:
                fresh = True
                first |= "first" in order and bool(self._clauses)

    def _polite(self) -> bool:
        """Skip a phrase of politeness, unless the words that follow are needed to understand it."""
        start = self._cursor.at
        found = self._cursor.take_longest(POLITE)
        if found and self._cursor.peek() in {"not", "be", "the"} and found[0] in {"can", "could", "will", "would"}:
            self._cursor.at = start
            return False
        return bool(found)

    def _order_word(self) -> tuple[str, ...]:
        start = self._cursor.at
        found = self._cursor.take_longest(THEN)
        if found == ("next",) and self._cursor.peek() == "to":
            self._cursor.at = start
            return ()
        return found

    def _add(self, fresh: bool, first: bool) -> None:
        """Read a clause, and put it where it belongs in the order."""
        cursor = self._cursor
        last = max((clause.when for clause in self._clauses), default=0.0)
        if self._clauses and cursor.take("before that", "before this", "beforehand", "before doing that", "before doing so"):
            self._separator()
            self._clause(self._clauses[-1].when - 0.5)
            return
        if cursor.take(*BEFORE):
            later = self._subordinate(last + 1)
            if fresh:
                self._separator()
                self._clause(later.when - 0.5)
            return
        leading = fresh
        joined, self._after = self._after, None
        if joined is not None and not fresh and cursor.tokens[cursor.at - 1] == "and" and not self._starts_order():
            self._after = joined + 0.05
            self._subordinate(self._after)
        elif leading and self._clauses and cursor.take("after doing that", "after doing so", "once done with that"):
            self._separator()
            self._main(first, last)
        elif self._takes_after():
            before = self._clauses[-1].when - 0.25 if self._clauses and not leading else last + 1
            self._subordinate(before)
            self._after = before if not leading else None
        else:
            self._main(first, last)

    def _starts_order(self) -> bool:
        """Whether an imperative comes next."""
        return self._cursor.peek() in VERBS

    def _main(self, first: bool, last: float) -> None:
        self._clause(self._clauses[-1].when - 0.5 if first and self._clauses else last + 1)

    def _takes_after(self) -> bool:
        return self._cursor.take(*sorted(AFTER, key=len, reverse=True))

    def _subordinate(self, when: float) -> Clause:
        """A clause after "before" or "after": a gerund, "you have put ...", or a statement."""
        cursor = self._cursor
        if cursor.take("you", "we", "i"):
            cursor.take("have", "had")
        return self._clause(when, past=True)

    def _clause(self, when: float, *, past: bool = False) -> Clause:
        cursor, start = self._cursor, self._cursor.at
        clause = _read_clause(cursor, past=past, follows=bool(self._clauses))
        clause.when, clause.said = when, " ".join(cursor.tokens[start : cursor.at])
        self._clauses.append(clause)
        self._ruled_out(clause)
        if len(self._clauses) > 1 and cursor.peek() == "first" and _at_clause_end(cursor, 1):
            cursor.next()
            clause.when = self._clauses[-2].when - 0.5
        return clause

    def _ruled_out(self, clause: Clause) -> None:
        """ ", not on the left plate", ", but not the top one"."""
        cursor = self._cursor
        while cursor.take(", rather than", "rather than", ", instead of", "instead of", ", but not", "but not", ", not", "not", ", and not", "and not") or self._exception():
            cursor.take_any(GERUNDS)
            phrase = read_phrase(cursor)
            noun = read_noun_phrase(cursor) if phrase is None else None
            if phrase is None and noun is None:
                raise NotUnderstood(f"what must not be in {cursor.rest!r}?")
            clause.ruled_out.append(phrase or noun)  # type: ignore[arg-type]
            if cursor.peek() == "," and cursor.peek(1) in {"and", "then"}:
                cursor.next()


    def _exception(self) -> bool:
        """ "put all cans in the basket except the red one"."""
        start = self._cursor.at
        self._cursor.take(",")
        if self._cursor.take(*(phrase for phrase in EXCEPTIONS if phrase != "but")):
            return True
        self._cursor.at = start
        return False


# -- one clause --------------------------------------------------------------------------------------------------------


def _read_clause(cursor: Cursor, *, past: bool, follows: bool) -> Clause:
    start = cursor.at
    for reader in (_question, _forbidden, _constraint, _same, _imperative(past), _fronted, _wish, _statement(past)):
        clause = reader(cursor)
        if clause is not None:
            return clause
        cursor.at = start
    if follows and (clause := _elliptic(cursor)) is not None:
        return clause
    cursor.at = start
    raise NotUnderstood(f"no known verb at the beginning of {cursor.rest!r}")


def _question(cursor: Cursor) -> Clause | None:
    if cursor.peek() not in QUESTIONS or cursor.sees("do not", "do the same"):
        return None
    if cursor.peek() == "do" and cursor.peek(1) not in {"you", "we", "i", "they", "not"}:
        return None
    raise NotUnderstood(f"{cursor.rest!r} asks a question; only orders are understood")


def _forbidden(cursor: Cursor) -> Clause | None:
    """ "don't ...", "never ..."."""
    cursor.take("please")
    if not cursor.take("do not", "don't", "dont", "never", "must not", "should not", "you must not", "you should not", "not"):
        return None
    cursor.take("ever", "you dare", "even")
    start = cursor.at
    if _constraint(cursor) is not None:
        raise NotUnderstood(f"'not {' '.join(cursor.tokens[start : cursor.at])}' does not say what is wanted")
    cursor.at = start
    touched = _touching(cursor)
    if touched is not None:
        return touched
    clause = _imperative(False)(cursor)
    if clause is None:
        raise NotUnderstood(f"what must not be done in {cursor.rest!r}?")
    clause.forbidden = True
    return clause


def _touching(cursor: Cursor) -> Clause | None:
    """ "touching the butter", "bump into the bottle": what motions must keep away from."""
    start = cursor.at
    verb = cursor.next()
    base = verb if verb in VERBS else GERUNDS.get(verb, "")
    if VERBS.get(base) not in {"touch", "avoid"}:
        if not cursor.sees("near", "close to") or verb not in {"go", "going", "come", "coming", "get", "getting"}:
            cursor.at = start
            return None
    cursor.take("into", "against", "over", "near to", "near", "close to", "with")
    return Clause("avoid", _groups(cursor))


def _constraint(cursor: Cursor) -> Clause | None:
    """ "without touching X", "avoiding X", "keep 10 cm away from X", "leave X where it is", "keep X closed"."""
    cursor.take("while", "but", "and")
    if cursor.take("without"):
        return _without(cursor)
    word = cursor.next()
    base = word if word in VERBS or word in {"stay", "steer"} else GERUNDS.get(word, word.removesuffix("ing"))
    if base == "avoid":
        cursor.take_any(GERUNDS)
        return Clause("avoid", _groups(cursor))
    if base in {"keep", "stay", "steer"}:
        cm = read_length(cursor)
        cursor.take("a distance of")
        cm = read_length(cursor) if cm is None else cm
        cursor.take("well", "far")
        if cursor.take("away from", "clear of", "from", "off", "out of the way of"):
            clause = Clause("avoid", _groups(cursor), cm=cm)
            cursor.take("at all times", "all the time", "at any time")
            return clause
    if base in {"leave", "keep"}:
        return _left(cursor)
    return None


def _without(cursor: Cursor) -> Clause:
    touched = _touching(cursor)
    if touched is not None:
        return touched
    clause = _imperative(False)(cursor)
    if clause is None:
        raise NotUnderstood(f"'without {cursor.rest}' is not understood")
    if clause.verb == "put" and not any(phrases for _, phrases in clause.groups) and not clause.cm:
        return Clause("avoid", clause.groups)
    clause.forbidden = True
    return clause


_AS_IT_IS = (
    "where it is", "where they are", "as it is", "as they are", "alone", "untouched", "in place", "there", "here",
    "in its place", "in their places", "on the table", "where it was", "where they were", "be", "on the counter", "in peace",
)  # fmt: skip


def _left(cursor: Cursor) -> Clause | None:
    """ "the bowls where they are", "it open"."""
    noun = read_noun_phrase(cursor)
    if noun is None:
        return None
    if cursor.take(*_AS_IT_IS):
        return Clause("untouched", [(noun, [])])
    cursor.take("turned", "switched")
    state = STATES.get(cursor.peek())
    if state and not (state in {"on", "off"} and cursor.peek(1) not in {"", ",", ".", "and", "but", "then"}):
        cursor.next()
        return Clause(f"keep_{state}", [(noun, [])])
    return None


def _same(cursor: Cursor) -> Clause | None:
    """ "do the same with the right one"."""
    if not cursor.take("do the same with", "do the same for", "do the same to", "do likewise with", "likewise for", "repeat this with", "repeat that with", "repeat this for", "repeat it with", "the same for", "the same with", "do that with", "same for"):
        return None
    return Clause("same", _groups(cursor))


def _imperative(past: bool) -> Callable[[Cursor], Clause | None]:
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
    state = ""
    if action in {"turn", "push", "pull", "open", "close"}:
        state = _state(cursor) if action == "turn" or cursor.peek() not in {"on"} else ""
    particle = cursor.take_any({"up", "down", "over", "out", "away", "back"} - ({"back"} if _is_noun_next(cursor) else set()))
    moved = _shift(cursor)
    groups = _groups(cursor)
    state = state or _state(cursor)
    cursor.take("up", "down", "back")
    return _meant(cursor, action, groups, state, particle, moved)


def _is_noun_next(cursor: Cursor) -> bool:
    """Whether "back" is a part of a name: "back bowl", not "back the bowl"."""
    return cursor.peek(1) not in {"the", "a", "it", "them", "on", "in", "to", "into", "onto", "both", "all"}


def _state(cursor: Cursor) -> str:
    state = STATES.get(cursor.peek(), "")
    after = cursor.peek(1)
    if state == "on" and after not in {"the", "both", "", "and", ",", ".", "it", "then", "before", "after", "with", "all", "a", "again", "but", "every", "stove", "stovetop", "hob", "flat", "that", "this", "once", "while", "without", "not", "stove's"}:
        return ""
    if state:
        cursor.next()
    return state


def _shift(cursor: Cursor) -> tuple[str, float] | None:
    """ "10 cm to the left" with no object behind it."""
    start = cursor.at
    cm = read_length(cursor)
    side = {"left": "left", "right": "right", "forward": "front", "forwards": "front", "back": "back", "backward": "back", "backwards": "back", "front": "front"}
    if cm is None and not cursor.sees("to the", "towards the", "forward", "forwards", "backward", "backwards"):
        return None
    cursor.take("further", "more")
    cursor.take("to the", "towards the", "to its", "to")
    way = side.get(cursor.peek(), "")
    if way and cursor.peek(1) not in {"of", "side", "hand"} and _at_clause_end(cursor, 1):
        cursor.next()
        if cm is None:
            cm = read_length(cursor)
        return way, cm or 0.0
    cursor.at = start
    return None


def _at_clause_end(cursor: Cursor, ahead: int) -> bool:
    token = cursor.peek(ahead)
    return token in {"", ",", ".", ";", "and", "then", "but", "before", "after", "without", "while", "by"}


def _meant(
    cursor: Cursor, action: str, groups: list[Group], state: str, particle: str, moved: tuple[str, float] | None
) -> Clause:
    moved = moved or _shift_of(cursor, groups)
    if moved is None and groups and groups[-1][0] is not None:
        moved = _shift(cursor)
    if action == "turn" and not state and groups[-1][1] and groups[-1][1][-1].said == "on" and not groups[-1][1][-1].thing:
        state = "on"
        groups[-1][1].pop()
    if action == "turn":
        if state not in {"on", "off"}:
            raise NotUnderstood("turn it on or off? 'turn' alone is not understood")
        return Clause(f"turn_{state}", groups)
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


_GOALS = frozenset(["to", "into", "onto", "over to", "up to", "in to", "on to", "to the top of", "onto the top of"])


def _shift_of(cursor: Cursor, groups: list[Group]) -> tuple[str, float] | None:
    """A phrase that turned out to have no object, "to the right": a direction. It is taken off the groups."""
    del cursor
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


def _fronted(cursor: Cursor) -> Clause | None:
    """ "On the plate, put the bowl"."""
    phrase = read_phrase(cursor)
    if phrase is None or not (cursor.take(",") or cursor.peek() in VERBS):
        return None
    clause = _imperative(False)(cursor)
    if clause is None or not clause.groups:
        return None
    noun, phrases = clause.groups[-1]
    clause.groups[-1] = (noun, [*phrases, phrase])
    return clause


def _wish(cursor: Cursor) -> Clause | None:
    """ "I want the bowl on the plate"."""
    if not cursor.take("i want", "i need", "i would like", "we want", "we need", "i would love", "i wish for", "i prefer"):
        return None
    cursor.take("to have", "to see")
    groups = _groups(cursor)
    if cursor.take("to be", "to go", "to get"):
        return _predicate(cursor, groups)
    if cursor.peek() in PARTICIPLES:
        return _predicate(cursor, groups)
    return Clause("put" if any(phrases for _, phrases in groups) else "pick", groups)


def _statement(past: bool) -> Callable[[Cursor], Clause | None]:
    """A reader of "the bowl should be put on the plate", "the bowl belongs on the plate", and of such questions.

    What is, or was done, is an order in the past only: "after the bowl has been put on the plate".
    """

    def read(cursor: Cursor) -> Clause | None:
        if cursor.take("could", "can", "should", "would", "will", "must", "may", "shall"):
            return _asked(cursor)
        start = cursor.at
        groups = _groups(cursor, subject=True)
        if not groups or groups[0][0] is None:
            return None
        ordered = bool(_modals(cursor)) or cursor.tokens[max(start - 1, 0)] in _ASSURED
        linked = cursor.take_any(_LINKS) != ""
        while cursor.take_any(_LINKS):
            continue
        if cursor.take("stay", "stays", "remain", "remains"):
            return _staying(cursor, groups)
        if cursor.take_any(GOES):
            cursor.take("up")
            return _predicate(cursor, groups)
        if not (ordered or linked):
            return None
        done = past and cursor.peek() in PARTICIPLES
        if not (ordered or done or cursor.sees("to be", "not to be", "to go")):
            raise NotUnderstood(f"{' '.join(cursor.tokens[start:])!r} says what is, not what to do")
        return _predicate(cursor, groups)

    return read


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
    groups = _groups(subject, subject=True)
    if not subject.at_end or groups[0][0] is None:
        return None
    cursor.at = ends[0]
    cursor.take("please")
    cursor.take("go")
    return _predicate(cursor, groups)


def _staying(cursor: Cursor, groups: list[Group]) -> Clause | None:
    if cursor.take(*_AS_IT_IS):
        return Clause("untouched", groups)
    state = STATES.get(cursor.peek(), "")
    if state:
        cursor.next()
        return Clause(f"keep_{state}", groups)
    return None


def _predicate(cursor: Cursor, groups: list[Group]) -> Clause | None:
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
        state = _state(cursor) if action in {"turn", "push", "pull"} else ""
        particle = cursor.take_any({"up", "down", "out", "back", "away"})
        moved = _shift(cursor)
        noun, phrases = groups[-1]
        if action == "leave" and cursor.take(*_AS_IT_IS):
            return Clause("untouched", groups)
        groups[-1] = (noun, [*_bound(phrases), *read_phrases(cursor)])
        clause = _meant(cursor, action, groups, state, particle, moved)
    elif word in STATES and word not in {"on", "off"} or (word in {"on", "off"} and _at_clause_end(cursor, 1)):
        cursor.next()
        state = STATES[word]
        clause = Clause(f"turn_{state}" if state in {"on", "off"} else state, groups)
    else:
        cursor.take("somewhere", "placed")
        phrases = read_phrases(cursor)
        if not phrases:
            return None
        groups[-1] = (groups[-1][0], [*_bound(groups[-1][1]), *phrases])
        clause = Clause("put", groups)
    clause.forbidden = negated
    if negated and clause.verb == "put" and not clause.groups[-1][1]:
        return Clause("untouched", groups)
    return clause


def _bound(phrases: list[Phrase]) -> list[Phrase]:
    return phrases


def _elliptic(cursor: Cursor) -> Clause | None:
    """A clause without a verb behind one that has it: "then the cream cheese", "then off"."""
    if cursor.peek() in STATES and _at_clause_end(cursor, 1):
        state = STATES[cursor.next()]
        return Clause(f"turn_{state}" if state in {"on", "off"} else state, [(None, [])])
    start = cursor.at
    groups = _groups(cursor)
    if groups and groups[0][0] is not None and not groups[0][0].is_pronoun and cursor.at > start:
        return Clause("again", groups)
    return None


# -- groups ------------------------------------------------------------------------------------------------------------


def _groups(cursor: Cursor, *, subject: bool = False) -> list[Group]:
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
    state = cursor.at
    if cursor.peek() in {"up", "down", "back", "out", "away", "over"} and not (
        cursor.peek() == "out" and cursor.peek(1) == "of" or cursor.peek() == "over" and cursor.peek(1) == "to"
    ):
        cursor.next()
    if cursor.at > state and cursor.at_end:
        return noun, []
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
        stops = {"then", "but", "not", "without", "while", "after", "before", "once", "you", "please", "finally", "next",
                 "first", "lastly", "", ".", "avoiding", "keeping", "staying", "do", "never", "when", "so", "i", "also",
                 "which", "who", "having", "afterwards", "later", "leaving", "nor", "stay", "steer", "with", "don't",
                 "instead", "if", "until", "is", "are", "finally", "turn_on"}  # fmt: skip
        if ahead not in stops and ahead not in GERUNDS and (subject or not _states_something(cursor)):
            cursor.at = both
            return True
    cursor.at = start
    return False


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
