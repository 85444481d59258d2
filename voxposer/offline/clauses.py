"""Clauses: what is asked for, in words, clause by clause.

A sentence comes in as tokens; :class:`~voxposer.offline.clause.Clause` s go out in the order in which they are said,
each with its place in the order in which they are to be done ("before you ...", "after ..."). Imperatives, gerunds,
passives and statements of what should be ("the bowl belongs on the plate") become the same clauses. What pronouns stand
for is not decided here.
"""

from __future__ import annotations

from collections.abc import Sequence

from voxposer.offline.clause import Clause, Spoken
from voxposer.offline.conditions import OTHERWISE, read_condition
from voxposer.offline.corrections import corrected_speech, without_indifference
from voxposer.offline.lexicon import AFTER, BEFORE, EXCEPTIONS, FILLERS, GERUNDS, POLITE, SPEEDS, THEN, VERBS
from voxposer.offline.limits import constraint, forbidden, question
from voxposer.offline.names import NotUnderstood
from voxposer.offline.nouns import read_noun_phrase, read_phrase
from voxposer.offline.orders import at_clause_end, fronted, imperative, same
from voxposer.offline.statements import elliptic, statement, wish
from voxposer.offline.tokens import Cursor


def read_clauses(tokens: Sequence[str]) -> tuple[list[Clause], float | None]:
    """The clauses of an instruction in the order said, and the speed it asks for.

    Raises:
        NotUnderstood: words that are part of no clause; the message quotes them.
    """
    said, indifferent = without_indifference(tokens)
    words, speed = _without_manner(corrected_speech(said))
    return _Sentence(Cursor(words, indifferent=indifferent)).read(), speed


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
        # Where the clauses of the present sentence begin, and the condition that is in force.
        self._sentence = 0
        self._condition: Spoken | None = None

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
                fresh, self._condition, self._sentence = True, None, len(self._clauses)
            elif cursor.take(",", "and", "&") or self._polite():
                continue
            elif not (order := self._order_word()):
                return fresh, first
            elif self._condition is not None:
                then = f"{' '.join(order)} {cursor.rest}"
                raise NotUnderstood(f"does the condition hold for {then!r} too? Say it in a sentence of its own")
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
        if self._begins_condition():
            self._main(first, last)
            return
        if self._clauses and cursor.take(
            "before that", "before this", "beforehand", "before doing that", "before doing so"
        ):
            self._separator()
            self._clause(self._clauses[-1].when - 0.5)
            return
        if cursor.take(*BEFORE):
            if self._clauses and self._clauses[-1].forbidden and not fresh:
                raise NotUnderstood(f"not {self._clauses[-1].said!r} before something else? Say what to do, in order")
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

    def _begins_condition(self) -> bool:
        """Read "if the drawer is open," or "otherwise", which hold up to the end of the sentence."""
        cursor = self._cursor
        if cursor.take(*OTHERWISE):
            before = self._clauses[-1].condition if self._clauses else None
            if before is None:
                raise NotUnderstood(f"'otherwise' has no condition before it in {' '.join(cursor.tokens)!r}")
            self._condition = before.opposite
        elif (found := read_condition(cursor)) is not None:
            self._condition = found
        else:
            return False
        cursor.take(",")
        cursor.take("then")
        return True

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
        self._conditioned(clause)
        if cursor.peek() == "first" and at_clause_end(cursor, 1):
            cursor.next()
            if sum(bool(phrases) for _, phrases in clause.groups) > 1:
                raise NotUnderstood(f"which part of {clause.said!r} is to be first? Say it as two sentences")
            clause.when = self._clauses[-2].when - 0.5 if len(self._clauses) > 1 else when
        return clause

    def _conditioned(self, clause: Clause) -> None:
        """Note the condition of a clause: the one before it, or the one behind it, "..., if it is open"."""
        cursor, clause.condition = self._cursor, self._condition
        start = cursor.at
        cursor.take(",")
        found = read_condition(cursor)
        if found is None:
            cursor.at = start
        elif clause.condition is not None or len(self._clauses) - self._sentence > 1:
            raise NotUnderstood(f"which part of {' '.join(cursor.tokens)!r} has the condition? Say it as two sentences")
        else:
            clause.condition = found
            clause.trails = True

    def _ruled_out(self, clause: Clause) -> None:
        """ ", not on the left plate", ", but not the top one"."""
        cursor = self._cursor
        while (
            cursor.take(
                ", rather than",
                "rather than",
                ", instead of",
                "instead of",
                ", but not",
                "but not",
                ", not",
                "not",
                ", and not",
                "and not",
            )
            or self._exception()
        ):
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


def _read_clause(cursor: Cursor, *, past: bool, follows: bool) -> Clause:
    start = cursor.at
    for reader in (question, forbidden, constraint, same, imperative(past), fronted, wish, statement(past)):
        clause = reader(cursor)
        if clause is not None:
            return clause
        cursor.at = start
    if follows and (clause := elliptic(cursor)) is not None:
        return clause
    cursor.at = start
    raise NotUnderstood(f"no known verb at the beginning of {cursor.rest!r}")
