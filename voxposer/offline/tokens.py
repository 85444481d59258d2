"""Words of a sentence, and a cursor over them.

Any text comes in; lower-case words, numbers and punctuation come out. What is written together or apart, curly or
straight, British or American is made the same here, so that the grammar sees one form.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TypeVar

from voxposer.offline.lexicon import NUMBERS, UNITS, words

T = TypeVar("T")
# A name of the scene (bowl_1), a number with its decimals, a word with its apostrophes, or one sign.
_TOKEN = re.compile(r"\d+(?:[.,]\d+)?(?![\w_])|[^\W_]+(?:_\w+)+|[^\W\d_]+(?:'[^\W\d_]+)*|\w+|[^\w\s]")
_ENDS = frozenset(".;:!?\n")
_SPELLINGS = (
    (r"(?:^|(?<=[\s.;:,!?]))(?:step\s+)?\d+\s?[.):](?=\s|$)", " . "),
    (r"[()]", ","),
    (r"[\u2018\u2019\u02bc`\u00b4]", "'"),
    (r"[\u2010-\u2015\u2212]", "-"),
    (rf"(?<![\w.])(\d+(?:\.\d+)?)({'|'.join(sorted(UNITS, key=len, reverse=True))})\b", r"\1 \2"),
    (r'(\d)\s*(?:"|\u201d|\u2033)(?=\W|$)', r"\1 inch"),
    (r"\b(left|right|front|back|top|bottom|upper|lower|rear|middle)[- ]most\b", r"\1most"),
    (r"\b(left|right)[- ]?hand\b", r"\1"),
    (r"(?<=\w)-(?=\w)", " "),
    (r"\b(that|which|it|there|who|what)'s\b", r"\1 is"),
    (r"\b(i|we|you)'d like\b", r"\1 would like"),
    (r"\b(is|are|was|were|does|do|should|must|need)n'?t\b", r"\1 not"),
    (r"\b(?:cannot|can't)\b", "can not"),
    (r"\blet's\b", "let us"),
    (r"\bwon't\b", "will not"),
    (r"\b(\w+)'s (left|right|front|back|rear)(?: hand)?(?: side)?(?=\s*(?:$|[.,;!?]|and\b|then\b))", r"\2 of the \1"),
    (
        r"\b(?:its|their) (left|right|front|back|rear)(?: hand)?(?: side)?(?=\s*(?:$|[.,;!?]|and\b|then\b))",
        r"the \1 of it",
    ),
    (r"(?<=\w)'s\b|(?<=s)'(?=\s)", " "),
    (r"\bfrying pan(s?)\b", r"frypan\1"),
    (r"\b(?:layer|level) of (?:the )?drawers?\b", "drawer"),
    (r"\b(?:the )?table (?:center|centre|middle)\b", "the center of the table"),
    (r"\b(?:whichever|whatever) ((?:[a-z]+ ){1,3}?)(is|are)\b", r"the \1that \2"),
    (r"&", " and "),
)


def tokenize(text: str) -> list[str]:
    """The words, numbers and signs of a text, in order; full stops and the like are ``.``."""
    text = unicodedata.normalize("NFKC", text).lower()
    for pattern, replacement in _SPELLINGS:
        text = re.sub(pattern, replacement, text)
    found = ["." if token in _ENDS else token for token in _TOKEN.findall(text)]
    return [token for token in found if token not in {'"', "'", "*", "\u201c", "\u201d"}]


class Cursor:
    """A place in a list of tokens.

    Attributes:
        at: index of the next token.
        indifferent: whether it was said that of alternatives ("or") any will do.
    """

    def __init__(self, tokens: Iterable[str], *, indifferent: bool = False) -> None:
        self.tokens, self.at, self.indifferent = list(tokens), 0, indifferent

    @property
    def at_end(self) -> bool:
        """Whether no token is left."""
        return self.at >= len(self.tokens)

    @property
    def rest(self) -> str:
        """The tokens that are left, as text."""
        return " ".join(self.tokens[self.at :])

    def peek(self, ahead: int = 0) -> str:
        """A token ahead, "" beyond the end."""
        return self.tokens[self.at + ahead] if self.at + ahead < len(self.tokens) else ""

    def next(self) -> str:
        """The next token, which is taken."""
        token = self.peek()
        self.at += 1
        return token

    def take(self, *phrases: str) -> bool:
        """Take the first of these phrases that comes next."""
        for phrase in phrases:
            words = phrase.split()
            if self.tokens[self.at : self.at + len(words)] == words:
                self.at += len(words)
                return True
        return False

    def sees(self, *phrases: str) -> bool:
        """Whether one of these phrases comes next."""
        at = self.at
        found = self.take(*phrases)
        self.at = at
        return found

    def take_any(self, words: Collection[str]) -> str:
        """Take the next token if it is one of these; else ""."""
        return self.next() if self.peek() and self.peek() in words else ""

    def take_longest(self, phrases: Collection[Sequence[str]]) -> tuple[str, ...]:
        """Take the longest of these phrases that comes next; else ()."""
        for length in range(min(6, len(self.tokens) - self.at), 0, -1):
            ahead = tuple(self.tokens[self.at : self.at + length])
            if ahead in phrases:
                self.at += length
                return ahead
        return ()

    def take_meaning(self, table: Mapping[tuple[str, ...], T]) -> T | None:
        """What the longest phrase of a table that comes next means; the phrase is taken."""
        found = self.take_longest(table)
        return table[found] if found else None


def is_side_end(cursor: Cursor) -> bool:
    """Whether a side ("on the left") ends here: no noun and no "of" follows."""
    token = cursor.peek()
    counted = (token[:1].isdigit() or token in NUMBERS or token in {"a", "an"}) and cursor.peek(1) in UNITS
    return cursor.at_end or token in _AFTER_SIDE or counted or cursor.sees("half a", "a bit", "a little")


_AFTER_SIDE = frozenset(
    words(
        """and then on onto in into at to next near beside between from under inside behind not but before after once
        without while except besides which that should must needs need has have is are goes go belongs belong , . or )
        could will upon over with instead towards toward where as"""
    )
)
