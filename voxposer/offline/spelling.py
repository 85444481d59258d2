"""Typing errors of one letter: "the tomatto sauce", "opne the drawer".

The tokens of a sentence and the names of the scene come in; the tokens go out with such words corrected, and what was
corrected. A word is corrected if it is neither an English word nor one that the writer knows, and if exactly one known
word is one letter away from it. An English word stays as it is: "the saucer" is no sauce, and "the clock" no block.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from voxposer.offline.lexicon import KNOWN
from voxposer.offline.names import KINDS, Name

if TYPE_CHECKING:
    from spellchecker import SpellChecker

# Shorter words are close to too many others, and a wrong letter (rather than one too many, too few or swapped with its
# neighbour) is told from another word only in longer ones.
_SHORTEST, _SHORTEST_REPLACED = 4, 6


def corrected(tokens: Sequence[str], names: Sequence[Name]) -> tuple[list[str], tuple[tuple[str, str], ...]]:
    """The tokens with typing errors corrected, and pairs of what was written and what it is taken for."""
    tokens, changed = _joined(tokens, names)
    known = KNOWN | KINDS | {form for name in names for word in name.senses for form in (word, f"{word}s")}
    known |= {name.text.lower() for name in names}
    for token in dict.fromkeys(tokens):
        if token in known or not (token.isascii() and token.isalpha()):
            continue
        meant = _meant(token, known)
        if meant:
            changed[token] = meant
    return [changed.get(token, token) for token in tokens], tuple(changed.items())


def _joined(tokens: Sequence[str], names: Sequence[Name]) -> tuple[list[str], dict[str, str]]:
    """The tokens with names that were written apart joined, "egg plant", and what was joined."""
    words = {form for name in names for word in name.senses for form in (word, f"{word}s") if len(word) > _SHORTEST}
    joined: list[str] = []
    changed: dict[str, str] = {}
    for token in tokens:
        if joined and joined[-1] + token in words and joined[-1] not in KNOWN:
            changed[f"{joined[-1]} {token}"] = joined[-1] + token
            joined[-1] += token
        else:
            joined.append(token)
    return joined, changed


def _meant(token: str, known: Collection[str]) -> str:
    """The known word that a word is a misspelling of; "" if it is none, or could be of several."""
    dictionary = _dictionary() if len(token) >= _SHORTEST - 1 else None
    if dictionary is None or dictionary.known([token]):
        return ""
    near = {word for word in dictionary.edit_distance_1(token) if word in known and _is_slip(token, word)}
    near = {word for word in near if not (word.endswith("s") and word[:-1] in near)}
    return near.pop() if len(near) == 1 else ""


def _is_slip(written: str, word: str) -> bool:
    """Whether one word, a letter away from the other, is long enough to be taken for it."""
    if len(written) == len(word):
        swapped = sorted(written) == sorted(word)
        return swapped or len(word) >= _SHORTEST_REPLACED
    return min(len(written), len(word)) >= _SHORTEST - 1 and max(len(written), len(word)) >= _SHORTEST


@functools.cache
def _dictionary() -> SpellChecker | None:
    """English words; None without pyspellchecker, which the rule base can do without: such words are refused then."""
    # Loading the dictionary takes a tenth of a second, which sentences without unknown words need not wait for.
    try:
        from spellchecker import SpellChecker
    except ImportError:
        return None
    return SpellChecker(language="en", distance=1)
