"""The syntax of BDDL files: a text becomes nested groups of words that know where they stand.

In: a text. Out: its one ``(define ...)`` group, as :class:`Group` and :class:`Atom`; helpers that take groups apart and
read numbers, and that raise :class:`BDDLError` with line, column and what was expected. What the groups mean is
``vecenv.libero.scene.bddl``'s. Nothing in a text is executed; size and nesting are bounded.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias

from vecenv.errors import InvalidInput

MAX_CHARS = 1 << 18
"""Longest accepted text; the longest real file has 4,396 characters."""
MAX_DEPTH = 64
"""Deepest accepted nesting of parentheses; real files reach 6."""

_TOKEN = re.compile(r";.*|[()]|[^\s();]+")
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?")
_TERM = re.compile(r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?|np\.pi|pi|[-+*/]")
_SHOWN_CHARS = 40


class BDDLError(InvalidInput):
    """A task file that is not well-formed LIBERO BDDL.

    Attributes:
        source: file name, or the name that the caller gave the text.
        line: line of the offending place, from 1.
        column: column of the offending place in characters, from 1.
        message: what was found instead.
        expected: what should be there.
    """

    def __init__(self, source: str, line: int, column: int, message: str, expected: str) -> None:
        super().__init__(source, line, column, message, expected)
        self.source = source
        self.line = line
        self.column = column
        self.message = message
        self.expected = expected

    def __str__(self) -> str:
        return f"{self.source}:{self.line}:{self.column}: expected {self.expected}: {self.message}"


class Place(NamedTuple):
    """Where something stands: source, line and column from 1."""

    source: str
    line: int
    column: int

    def error(self, message: str, expected: str) -> BDDLError:
        """The error to raise about this place."""
        return BDDLError(self.source, self.line, self.column, message, expected)


class Atom(NamedTuple):
    """A word, lower-cased; single parentheses are words too while a text is read."""

    text: str
    at: Place

    def __str__(self) -> str:
        shown = self.text if len(self.text) <= _SHOWN_CHARS else self.text[:_SHOWN_CHARS] + "…"
        return repr(shown)


class Group(NamedTuple):
    """A parenthesised list: what is in it, its opening and its closing parenthesis."""

    items: tuple[Node, ...]
    at: Place
    end: Place


Node: TypeAlias = Atom | Group


def lines_of(text: str) -> list[str]:
    """Lines, their ends read as upstream's text-mode `open` reads them."""
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def too_long(source: str) -> BDDLError:
    """The error for a text above `MAX_CHARS`."""
    return Place(source, 1, 1).error("the text is longer", f"at most {MAX_CHARS} characters")


def _tokens(lines: list[str], source: str) -> Iterator[Atom]:
    for number, line in enumerate(lines, start=1):
        for match in _TOKEN.finditer(line):
            if match[0][0] != ";":
                yield Atom(match[0].lower(), Place(source, number, match.start() + 1))


def read_define(text: str, source: str) -> Group:
    """The one ``(define ...)`` group of a text, read with an explicit stack, so depth costs no recursion."""
    if len(text) > MAX_CHARS:
        raise too_long(source)
    lines = lines_of(text)
    tokens = _tokens(lines, source)
    end = Place(source, len(lines), len(lines[-1]) + 1)
    root = _read_group(tokens, end)
    for extra in tokens:
        raise extra.at.error(f"found {extra} after the end of (define ...)", "end of file")
    head = root.items[0] if root.items else None
    if not (isinstance(head, Atom) and head.text == "define"):
        raise (head.at if head else root.end).error(f"found {describe(head)}", "'define'")
    return root


def _read_group(tokens: Iterator[Atom], end: Place) -> Group:
    first = next(tokens, None)
    if first is None or first.text != "(":
        raise (first.at if first else end).error(f"found {first or 'end of file'}", "'('")
    open_at: list[Place] = [first.at]
    items: list[list[Node]] = [[]]
    for token in tokens:
        if token.text == "(":
            if len(open_at) == MAX_DEPTH:
                raise token.at.error("one more level opens here", f"at most {MAX_DEPTH} levels of parentheses")
            open_at.append(token.at)
            items.append([])
        elif token.text == ")":
            group = Group(tuple(items.pop()), open_at.pop(), token.at)
            if not items:
                return group
            items[-1].append(group)
        else:
            items[-1].append(token)
    opened = open_at[-1]
    raise end.error(f"the file ends inside the group opened at {opened.line}:{opened.column}", "')'")


def describe(node: Node | None) -> str:
    """What an error message calls a node; None is the closing parenthesis."""
    if node is None:
        return "')'"
    if isinstance(node, Atom):
        return str(node)
    head = node.items[0] if node.items else None
    return f"a group ({head.text} ...)" if isinstance(head, Atom) else "a group"


def as_atom(node: Node, expected: str) -> Atom:
    """The node as a word; raises where it is a group."""
    if isinstance(node, Group):
        raise node.at.error(f"found {describe(node)}", expected)
    return node


def as_group(node: Node, expected: str) -> Group:
    """The node as a group; raises where it is a word."""
    if isinstance(node, Atom):
        raise node.at.error(f"found {node}", expected)
    return node


def head_of(group: Group, expected: str) -> Atom:
    """The first item of a group, which must be a word."""
    if not group.items:
        raise group.end.error("found ')'", expected)
    return as_atom(group.items[0], expected)


def sole(nodes: tuple[Node, ...], end: Place, expected: str) -> Node:
    """The only one of ``nodes``, which end at ``end``."""
    if not nodes:
        raise end.error("found ')'", expected)
    first, *rest = nodes
    if rest:
        raise rest[0].at.error(f"found {describe(rest[0])} after {describe(first)}", "')'")
    return first


def only_item(group: Group, expected: str) -> Node:
    """The single item after a group's head."""
    return sole(group.items[1:], group.end, expected)


def single_word(group: Group, expected: str) -> str:
    """The single word after a group's head."""
    return as_atom(only_item(group, expected), expected).text


def read_numbers(group: Group, count: int, read: Callable[[Atom], float]) -> tuple[float, ...]:
    """The items of a group that holds exactly ``count`` numbers, each read by ``read``."""
    expected = f"{count} numbers"
    if len(group.items) < count:
        raise group.end.error(f"found {len(group.items)}", expected)
    if len(group.items) > count:
        raise group.items[count].at.error(f"found {len(group.items)}", expected)
    return tuple(read(as_atom(node, "a number")) for node in group.items)


def read_number(word: Atom) -> float:
    """A finite number."""
    value = float(word.text) if _NUMBER.fullmatch(word.text) else math.nan
    if not math.isfinite(value):
        raise word.at.error(f"found {word}", "a finite number")
    return value


def read_angle(word: Atom) -> float:
    """A number, or sums, products and quotients of numbers and ``pi`` (upstream hands the word to `eval`)."""
    terms = _TERM.findall(word.text)[::-1]
    try:
        value = _sum(terms) if "".join(terms[::-1]) == word.text else math.nan
    except (ValueError, ZeroDivisionError):
        value = math.nan
    if terms or not math.isfinite(value):
        raise word.at.error(f"found {word}", "a finite number or arithmetic with pi, e.g. -pi/2")
    return value


def _sum(terms: list[str]) -> float:
    """Value of the terms up to the first that cannot belong to it; consumes them from the end of the list."""
    value = _product(terms)
    while terms and terms[-1] in "+-":
        plus = terms.pop() == "+"
        value = value + _product(terms) if plus else value - _product(terms)
    return value


def _product(terms: list[str]) -> float:
    value = _factor(terms)
    while terms and terms[-1] in "*/":
        times = terms.pop() == "*"
        value = value * _factor(terms) if times else value / _factor(terms)
    return value


def _factor(terms: list[str]) -> float:
    sign = 1.0
    while terms and terms[-1] in "+-":
        sign = -sign if terms.pop() == "-" else sign
    if not terms:
        raise ValueError("nothing left")
    word = terms.pop()
    return sign * (math.pi if word in ("pi", "np.pi") else float(word))
