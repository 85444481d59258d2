"""Tables of rules, and the variables of generated programs: shared by the composer and map writers.

A writer is a table of sentence patterns and functions; :func:`choose` runs the function of the first pattern that
matches a whole query. Objects are named by phrases that parse_query_obj understands; :func:`get` writes that call.
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Callable, Sequence

from voxposer.offline.names import NotUnderstood, name_words

Groups = dict[str, str]
Writer = Callable[[Groups], list[str]]
Rules = Sequence[tuple[str, Writer]]

THING = r"(?P<thing>.+)"
CM = r"(?P<cm>\d+(?:\.\d+)?) ?cm"
# Axis and sign of each direction: x back to front, y left to right, z up.
SIDES = {
    "to the right of": ("y", 1),
    "to the left of": ("y", -1),
    "to the front of": ("x", 1),
    "in front of": ("x", 1),
    "to the back of": ("x", -1),
    "behind": ("x", -1),
    "above": ("z", 1),
    "on top of": ("z", 1),
    "below": ("z", -1),
}
# Before a side: the gap to leave, where it is not the usual one.
GAP = r"(?:(?P<room>\d+(?:\.\d+)?) ?cm )?"
BESIDE = "to the right of|to the left of|to the front of|in front of|to the back of|behind|next to"
_QUALIFIED = re.compile(
    r"\s(?:on|in|at|to|next|between|behind|under|not|from|outside|besides|except|nearest|farthest)\b"
)
_TAKEN = frozenset(
    [
        "held",
        "moved",
        "beside",
        "excluded",
        "candidate",
        "first",
        "second",
        "movable",
        "thing",
        "turn",
        "half",
        "x",
        "y",
        "z",
    ]
)


def choose(rules: Rules, query: str, lmp: str) -> str:
    """The program of the first rule that matches the whole query.

    Raises:
        NotUnderstood: no rule matches; the message names the LMP and quotes the query.
    """
    text = " ".join(query.strip().rstrip(".").split())
    for pattern, writer in rules:
        found = re.fullmatch(pattern, text, re.IGNORECASE)
        if found:
            return "\n".join(writer({key: value or "" for key, value in found.groupdict().items()}))
    raise NotUnderstood(f"{text!r} is not among the sentences that {lmp} knows")


def variable(phrase: str) -> str:
    """A variable for an object: its noun, "the black bowl next to the plate" -> ``bowl``."""
    words = name_words(re.sub(r"[^\w\s]", " ", _QUALIFIED.split(phrase)[0])) or ("thing",)
    return (
        words[-1] if words[-1].isidentifier() and not keyword.iskeyword(words[-1]) and words[-1] not in _TAKEN else "it"
    )


def get(phrase: str, name: str = "") -> str:
    """The line that looks an object up."""
    return f"{name or variable(phrase)} = parse_query_obj({phrase!r})"
