"""Corrections, "put the milk, sorry, the butter in the basket", and alternatives of which any will do.

Tokens come in; tokens go out as if the speaker had said it right at once. What a correction replaces is the phrase of
the same kind just before it: an object, a place, or the whole order. Where that is not clear, it is refused.
"""

from __future__ import annotations

from collections.abc import Sequence

from voxposer.offline.lexicon import CORRECTIONS, INDIFFERENT, PREPOSITIONS, VERBS
from voxposer.offline.names import NotUnderstood
from voxposer.offline.nouns import PLACES
from voxposer.offline.tokens import Cursor


def without_indifference(tokens: Sequence[str]) -> tuple[list[str], bool]:
    """The tokens without "I don't care which" at a clause's end, and whether that was said."""
    cursor, kept, said = Cursor(tokens), [], False
    while not cursor.at_end:
        start = cursor.at
        if cursor.take(",", ".", "and", "(") and cursor.take_longest(INDIFFERENT):
            cursor.take("which one", "which", "at all")
            if cursor.at_end or cursor.peek() in {",", "."}:
                said = True
                continue
        cursor.at = start
        kept.append(cursor.next())
    return kept, said


def corrected_speech(tokens: Sequence[str]) -> list[str]:
    """The tokens with what was taken back replaced by what was said instead.

    Raises:
        NotUnderstood: it is not clear what a correction replaces.
    """
    cursor, kept = Cursor(tokens), []
    while not cursor.at_end:
        start = cursor.at
        if kept and cursor.take(",", ".") and _correction(cursor):
            _take_back(kept, cursor)
            continue
        cursor.at = start
        kept.append(cursor.next())
    return kept


def _correction(cursor: Cursor) -> bool:
    """Take the words of a correction, of which there may be several: "no, wait, I mean"."""
    found = cursor.take_longest(CORRECTIONS)
    if not found:
        return False
    while cursor.take(",") and cursor.take_longest(CORRECTIONS):
        continue
    comma = cursor.tokens[cursor.at - 1] == ","
    return not cursor.at_end and (comma or len(found) > 1 or cursor.peek() in {"the", "a", "an"} or _is_place(cursor))


def _is_place(cursor: Cursor) -> bool:
    start = cursor.at
    kind = cursor.take_meaning(PREPOSITIONS)
    cursor.at = start
    return kind in PLACES


def _take_back(kept: list[str], cursor: Cursor) -> None:
    """Remove from what was said what the next words replace."""
    begin = max((index + 1 for index, token in enumerate(kept) if token in {".", "then"}), default=0)
    verbs = [index for index in range(begin, len(kept)) if kept[index] in VERBS]
    places = [index for index in range(begin, len(kept)) if _is_place(Cursor(kept[index:]))]
    places = [index for index in places if index - 1 not in places]
    said = f"{' '.join(kept)} , ... {cursor.rest}"
    if cursor.peek() in VERBS:
        # "..., wait, turn on the stove first" takes nothing back.
        rest = cursor.tokens[cursor.at :]
        added = {"first", "before", "too", "also"} & set(rest[: rest.index(".") if "." in rest else len(rest)])
        if len(verbs) != 1 or added:
            raise NotUnderstood(f"which order is taken back in {said!r}? Say only what is to be done")
        del kept[verbs[0] :]
    elif _is_place(cursor):
        if not places:
            raise NotUnderstood(f"which place is taken back in {said!r}? Say only what is to be done")
        del kept[places[-1] :]
    elif len(verbs) == 1 and not [index for index in places if index > verbs[0]] and verbs[0] + 1 < len(kept):
        del kept[verbs[0] + 1 :]
    else:
        raise NotUnderstood(f"what is taken back in {said!r}? Say only what is to be done")
