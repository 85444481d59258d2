"""Names and values that a user got wrong: what to say, and which known names come close."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Collection

# Characters of a name in a message; a file may hold any.
_MOST_SHOWN = 100


def shown(value: object) -> str:
    """A value in an error message: short, on one line, whatever its ``repr`` does."""
    try:
        return " ".join(reprlib.repr(value).split())
    except Exception:
        return f"a {type(value).__name__}"


def unknown(what: str, given: str, known: Collection[str]) -> str:
    """Say that a name is not known, and which known names come close (all of them when none does).

    Args:
        what: kind of name, such as ``"suite"``.
        given: the name that is not known.
        known: the names that are.
    """
    given = given[:_MOST_SHOWN]
    close = difflib.get_close_matches(given, known, n=3) or known
    return f"unknown {what} {given!r}: did you mean {', '.join(close)}?"
