"""A parser of the BDDL dialect that LIBERO's task files are written in: text in, a frozen `Problem` out.

Reads as upstream does (`libero.libero.envs.bddl_utils.robosuite_parse_problem` over `bddl.parsing.scan_tokens`): the
whole file is lower-cased, ``;`` starts a comment, a region's full name is ``{target}_{region}``, instances keep the
order of the file. Where upstream would drop, ignore or evaluate what it does not expect, this raises `BDDLError` with
file, line, column and what was expected there. Nothing in a file is executed; size and nesting are bounded.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

from vecenv.errors import InvalidInput

MAX_CHARS = 1 << 18
"""Longest accepted text; the longest real file has 4,396 characters."""
MAX_DEPTH = 64
"""Deepest accepted nesting of parentheses; real files reach 6."""
_MAX_BYTES = 4 * MAX_CHARS

PREDICATE_ARITY: dict[str, tuple[int, ...]] = {
    "in": (2,),
    "on": (2,),
    "open": (1,),
    "close": (1,),
    "turnon": (1,),
    "turnoff": (1,),
    "up": (1,),
    "printjointstate": (1,),
    "true": (1, 2),
    "false": (1, 2),
}
"""Every predicate upstream evaluates (`VALIDATE_PREDICATE_FN_DICT`) and how many arguments it takes."""

_CONNECTIVES = frozenset({"and", "or", "not", "imply", "forall", "exists", "forn", "forpairs", "fornpairs"})
_DOMAIN = "robosuite"
_REQUIRED = ("problem", ":domain", ":language", ":fixtures", ":objects", ":init", ":goal")
_OPTIONAL = (":requirements", ":regions", ":obj_of_interest")
_REGION_ATTRIBUTES = (":target", ":ranges", ":yaw_rotation", ":rgba")
_TOKEN = re.compile(r";.*|[()]|[^\s();]+")
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?")
_TERM = re.compile(r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?|np\.pi|pi|[-+*/]")
_SHOWN_CHARS = 40


class BDDLError(InvalidInput):
    """A task file that is not well-formed LIBERO BDDL.

    Attributes:
        source: file name, or whatever the caller called the text.
        line: line of the offending place, from 1.
        column: column of the offending place in characters, from 1.
        message: what is there instead.
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


@dataclass(frozen=True)
class Region:
    """A named place: rectangles on a table or floor, or a site of a fixture or object.

    Attributes:
        name: full name, ``{target}_{region}``.
        target: instance it belongs to; a few files of libero_goal name one that is not declared.
        ranges: rectangles (x0, y0, x1, y1) in metres, in the frame of the workspace; empty for sites.
        yaw: lower and upper bound of the yaw of what is placed there, radians.
        rgba: colour of the site that shows the region.
    """

    name: str
    target: str
    ranges: tuple[tuple[float, float, float, float], ...] = ()
    yaw: tuple[float, float] = (0.0, 0.0)
    rgba: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Instance:
    """One fixture or object: its name in the scene and the category that says which model it is."""

    name: str
    category: str


@dataclass(frozen=True)
class Predicate:
    """A predicate over named instances and regions, e.g. ``on plate_1 main_table_plate_region``; all lower case."""

    name: str
    args: tuple[str, ...]


_Rectangle: TypeAlias = tuple[float, float, float, float]
SceneKey: TypeAlias = tuple[str, tuple[Instance, ...], tuple[Instance, ...]]


@dataclass(frozen=True)
class Problem:
    """One task file.

    Attributes:
        name: problem class in lower case, e.g. ``libero_tabletop_manipulation``.
        domain: always ``robosuite``.
        language: the file's own instruction, lower case, words joined by single spaces.
        regions: in file order, names unique.
        fixtures: in file order, which is upstream's.
        objects: in file order, which is upstream's; names are unique across fixtures and objects.
        obj_of_interest: names the task is about.
        init: predicates that place things and set joints before the episode.
        goal: predicates that must all hold.
        source: where the text came from; not part of equality.
    """

    name: str
    domain: str
    language: str
    regions: tuple[Region, ...]
    fixtures: tuple[Instance, ...]
    objects: tuple[Instance, ...]
    obj_of_interest: tuple[str, ...]
    init: tuple[Predicate, ...]
    goal: tuple[Predicate, ...]
    source: str = field(default="<string>", compare=False)

    def scene_key(self) -> SceneKey:
        """What decides the compiled model: problem class, fixtures and objects, each in order.

        Regions are left out because they add nothing: in all 21 suites (290 tasks, 62 keys) tasks of one key have the
        same regions in the same order, ranges included.
        """
        return (self.name, self.fixtures, self.objects)


def load_problem(path: str | Path) -> Problem:
    """Parse a task file; its path becomes ``Problem.source``.

    Raises:
        BDDLError: the file is not UTF-8 or not well-formed LIBERO BDDL.
        OSError: it cannot be read.
    """
    path = Path(path)
    with path.open("rb") as file:
        data = file.read(_MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        raise _too_long(str(path))
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = _lines(error.object[: error.start].decode("utf-8", "replace"))
        place = _Place(str(path), len(before), len(before[-1]) + 1)
        raise place.error(f"found byte 0x{error.object[error.start]:02x}", "UTF-8 text") from None
    return parse_problem(text, str(path))


def parse_problem(text: str, source: str = "<string>") -> Problem:
    """Parse the text of a task file.

    Args:
        text: at most `MAX_CHARS` characters.
        source: what errors and ``Problem.source`` call it.

    Raises:
        BDDLError: the text is not well-formed LIBERO BDDL.
    """
    sections = _sections(_read_define(text, source))
    declared: dict[str, _Atom] = {}
    fixtures = _instances(sections[":fixtures"], declared)
    objects = _instances(sections[":objects"], declared)
    regions = _regions(sections[":regions"], declared) if ":regions" in sections else ()
    known = frozenset(declared) | {region.name for region in regions if region.target in declared}
    interest = sections.get(":obj_of_interest")
    return Problem(
        name=_single_word(sections["problem"], "a problem name"),
        domain=_domain(sections[":domain"]),
        language=_language(sections[":language"]),
        regions=regions,
        fixtures=fixtures,
        objects=objects,
        obj_of_interest=tuple(_known_name(node, known) for node in interest.items[1:]) if interest else (),
        init=tuple(_predicate(node, known) for node in sections[":init"].items[1:]),
        goal=_goal(sections[":goal"], known),
        source=source,
    )


# ---------------------------------------------------------------------------------------------- text -> nested groups


class _Place(NamedTuple):
    """Where something stands: source, line and column from 1."""

    source: str
    line: int
    column: int

    def error(self, message: str, expected: str) -> BDDLError:
        return BDDLError(self.source, self.line, self.column, message, expected)


class _Atom(NamedTuple):
    """A word, lower-cased; `_read_define` also uses it for single parentheses."""

    text: str
    at: _Place

    def __str__(self) -> str:
        shown = self.text if len(self.text) <= _SHOWN_CHARS else self.text[:_SHOWN_CHARS] + "…"
        return repr(shown)


class _Group(NamedTuple):
    """A parenthesised list: what is in it, its opening and its closing parenthesis."""

    items: tuple[_Node, ...]
    at: _Place
    end: _Place


_Node: TypeAlias = _Atom | _Group


def _lines(text: str) -> list[str]:
    """Lines, their ends read as upstream's text-mode `open` reads them."""
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def _too_long(source: str) -> BDDLError:
    return _Place(source, 1, 1).error("the text is longer", f"at most {MAX_CHARS} characters")


def _tokens(lines: list[str], source: str) -> Iterator[_Atom]:
    for number, line in enumerate(lines, start=1):
        for match in _TOKEN.finditer(line):
            if match[0][0] != ";":
                yield _Atom(match[0].lower(), _Place(source, number, match.start() + 1))


def _read_define(text: str, source: str) -> _Group:
    """The one ``(define ...)`` group of a text, read with an explicit stack, so depth costs no recursion."""
    if len(text) > MAX_CHARS:
        raise _too_long(source)
    lines = _lines(text)
    tokens = _tokens(lines, source)
    end = _Place(source, len(lines), len(lines[-1]) + 1)
    root = _read_group(tokens, end)
    for extra in tokens:
        raise extra.at.error(f"found {extra} after the end of (define ...)", "end of file")
    head = root.items[0] if root.items else None
    if not (isinstance(head, _Atom) and head.text == "define"):
        raise (head.at if head else root.end).error(f"found {_describe(head)}", "'define'")
    return root


def _read_group(tokens: Iterator[_Atom], end: _Place) -> _Group:
    first = next(tokens, None)
    if first is None or first.text != "(":
        raise (first.at if first else end).error(f"found {first or 'end of file'}", "'('")
    open_at: list[_Place] = [first.at]
    items: list[list[_Node]] = [[]]
    for token in tokens:
        if token.text == "(":
            if len(open_at) == MAX_DEPTH:
                raise token.at.error("one more level opens here", f"at most {MAX_DEPTH} levels of parentheses")
            open_at.append(token.at)
            items.append([])
        elif token.text == ")":
            group = _Group(tuple(items.pop()), open_at.pop(), token.at)
            if not items:
                return group
            items[-1].append(group)
        else:
            items[-1].append(token)
    opened = open_at[-1]
    raise end.error(f"the file ends inside the group opened at {opened.line}:{opened.column}", "')'")


# ------------------------------------------------------------------------------------------------- groups -> sections


def _describe(node: _Node | None) -> str:
    if node is None:
        return "')'"
    if isinstance(node, _Atom):
        return str(node)
    head = node.items[0] if node.items else None
    return f"a group ({head.text} ...)" if isinstance(head, _Atom) else "a group"


def _as_atom(node: _Node, expected: str) -> _Atom:
    if isinstance(node, _Group):
        raise node.at.error(f"found {_describe(node)}", expected)
    return node


def _as_group(node: _Node, expected: str) -> _Group:
    if isinstance(node, _Atom):
        raise node.at.error(f"found {node}", expected)
    return node


def _head(group: _Group, expected: str) -> _Atom:
    if not group.items:
        raise group.end.error("found ')'", expected)
    return _as_atom(group.items[0], expected)


def _sole(nodes: tuple[_Node, ...], end: _Place, expected: str) -> _Node:
    """The only one of ``nodes``, which end at ``end``."""
    if not nodes:
        raise end.error("found ')'", expected)
    first, *rest = nodes
    if rest:
        raise rest[0].at.error(f"found {_describe(rest[0])} after {_describe(first)}", "')'")
    return first


def _only_item(group: _Group, expected: str) -> _Node:
    """The single item after a group's head."""
    return _sole(group.items[1:], group.end, expected)


def _single_word(group: _Group, expected: str) -> str:
    return _as_atom(_only_item(group, expected), expected).text


def _sections(root: _Group) -> dict[str, _Group]:
    """Sections by name; all required ones are there and none twice."""
    sections: dict[str, _Group] = {}
    for node in root.items[1:]:
        group = _as_group(node, "a section '(...)'")
        head = _head(group, "a section name")
        if head.text not in _REQUIRED + _OPTIONAL:
            raise head.at.error(f"unknown section {head}", f"one of {', '.join(_REQUIRED + _OPTIONAL)}")
        if head.text in sections:
            first = sections[head.text].at
            raise head.at.error(f"{head} was already given at {first.line}:{first.column}", "each section once")
        sections[head.text] = group
    for name in _REQUIRED:
        if name not in sections:
            raise root.end.error(f"the problem has no {name!r} section", f"'({name} ...)'")
    return sections


def _domain(section: _Group) -> str:
    domain = _as_atom(_only_item(section, repr(_DOMAIN)), repr(_DOMAIN))
    if domain.text != _DOMAIN:
        raise domain.at.error(f"found {domain}", repr(_DOMAIN))
    return domain.text


def _language(section: _Group) -> str:
    if len(section.items) < 2:
        raise section.end.error("found ')'", "an instruction")
    return " ".join(_as_atom(node, "a word of the instruction").text for node in section.items[1:])


def _declare(name: _Atom, declared: dict[str, _Atom]) -> None:
    first = declared.setdefault(name.text, name)
    if first is not name:
        raise name.at.error(f"{name} was already declared at {first.at.line}:{first.at.column}", "an unused name")


def _instances(section: _Group, declared: dict[str, _Atom]) -> tuple[Instance, ...]:
    """``name name - category`` runs. Upstream keys them by category, so a repeated category would lose instances."""
    instances: list[Instance] = []
    categories: dict[str, _Atom] = {}
    pending: list[_Atom] = []
    words = iter(_as_atom(node, "an instance name") for node in section.items[1:])
    for word in words:
        if word.text != "-":
            _declare(word, declared)
            pending.append(word)
            continue
        if not pending:
            raise word.at.error("found '-'", "an instance name")
        category = next(words, None)
        if category is None or category.text == "-":
            raise (category.at if category else section.end).error(f"found {_describe(category)}", "a category")
        first = categories.setdefault(category.text, category)
        if first is not category:
            raise category.at.error(
                f"category {category} was already used at {first.at.line}:{first.at.column}",
                "all instances of a category in one run",
            )
        instances += [Instance(name.text, category.text) for name in pending]
        pending = []
    if pending:
        raise section.end.error(f"{pending[-1]} has no category", "'- category'")
    return tuple(instances)


# --------------------------------------------------------------------------------------------------------- regions


def _regions(section: _Group, declared: dict[str, _Atom]) -> tuple[Region, ...]:
    names = dict(declared)
    return tuple(_region(_as_group(node, "a region '(name ...)'"), names) for node in section.items[1:])


def _region(group: _Group, names: dict[str, _Atom]) -> Region:
    local = _head(group, "a region name")
    values = _attributes(group)
    if ":target" not in values:
        raise group.end.error(f"region {local} has no target", "'(:target ...)'")
    target = _single_word(values[":target"], "the name of an instance")
    name = f"{target}_{local.text}"
    _declare(_Atom(name, local.at), names)
    ranges, yaw, rgba = (values.get(key) for key in (":ranges", ":yaw_rotation", ":rgba"))
    return Region(
        name=name,
        target=target,
        ranges=_ranges(ranges) if ranges else Region.ranges,
        yaw=_yaw(yaw) if yaw else Region.yaw,
        rgba=_rgba(rgba) if rgba else Region.rgba,
    )


def _attributes(region: _Group) -> dict[str, _Group]:
    values: dict[str, _Group] = {}
    for node in region.items[1:]:
        attribute = _as_group(node, "a region attribute '(:name ...)'")
        head = _head(attribute, "a region attribute")
        if head.text not in _REGION_ATTRIBUTES:
            raise head.at.error(f"unknown attribute {head}", f"one of {', '.join(_REGION_ATTRIBUTES)}")
        if head.text in values:
            raise head.at.error(f"{head} is given twice", "each attribute once")
        values[head.text] = attribute
    return values


def _ranges(attribute: _Group) -> tuple[_Rectangle, ...]:
    expected = "a list of rectangles '((x0 y0 x1 y1) ...)'"
    rectangles = _as_group(_only_item(attribute, expected), expected)
    if not rectangles.items:
        raise rectangles.end.error("found ')'", "a rectangle '(x0 y0 x1 y1)'")
    return tuple(_rectangle(node) for node in rectangles.items)


def _rectangle(node: _Node) -> _Rectangle:
    group = _as_group(node, "a rectangle '(x0 y0 x1 y1)'")
    x0, y0, x1, y1 = _numbers(group, 4, _number)
    _check_order(x0, x1, group.items[2].at, "x")
    _check_order(y0, y1, group.items[3].at, "y")
    return (x0, y0, x1, y1)


def _yaw(attribute: _Group) -> tuple[float, float]:
    expected = "a list of one pair '((low high))'"
    pairs = _as_group(_only_item(attribute, expected), expected)
    groups = tuple(_as_group(node, expected) for node in pairs.items)
    pair = _as_group(_sole(groups, pairs.end, expected), expected)
    low, high = _numbers(pair, 2, _angle)
    _check_order(low, high, pair.items[1].at, "yaw")
    return (low, high)


def _rgba(attribute: _Group) -> tuple[float, float, float, float]:
    expected = "a colour '(r g b a)'"
    group = _as_group(_only_item(attribute, expected), expected)
    red, green, blue, alpha = values = _numbers(group, 4, _number)
    for value, node in zip(values, group.items, strict=True):
        if not 0 <= value <= 1:
            raise node.at.error(f"found {_describe(node)}", "a value from 0 to 1")
    return (red, green, blue, alpha)


def _check_order(low: float, high: float, at: _Place, axis: str) -> None:
    if low > high:
        raise at.error(f"{axis} runs from {low:g} to {high:g}", "an upper bound not below the lower one")


def _numbers(group: _Group, count: int, read: Callable[[_Atom], float]) -> tuple[float, ...]:
    expected = f"{count} numbers"
    if len(group.items) < count:
        raise group.end.error(f"found {len(group.items)}", expected)
    if len(group.items) > count:
        raise group.items[count].at.error(f"found {len(group.items)}", expected)
    return tuple(read(_as_atom(node, "a number")) for node in group.items)


def _number(word: _Atom) -> float:
    value = float(word.text) if _NUMBER.fullmatch(word.text) else math.nan
    if not math.isfinite(value):
        raise word.at.error(f"found {word}", "a finite number")
    return value


def _angle(word: _Atom) -> float:
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


# ------------------------------------------------------------------------------------------------------- predicates


def _known_name(node: _Node, known: frozenset[str]) -> str:
    word = _as_atom(node, "the name of an object, fixture or region")
    if word.text not in known:
        raise word.at.error(f"{word} is not declared", "the name of an object, fixture or region")
    return word.text


def _predicate(node: _Node, known: frozenset[str]) -> Predicate:
    expected = "a predicate '(name argument ...)'"
    group = _as_group(node, expected)
    head = _head(group, expected)
    if head.text in _CONNECTIVES:
        raise head.at.error(f"nested {head} is not supported", "a predicate over names")
    if head.text not in PREDICATE_ARITY:
        raise head.at.error(f"unknown predicate {head}", f"one of {', '.join(PREDICATE_ARITY)}")
    count, allowed = len(group.items) - 1, PREDICATE_ARITY[head.text]
    if count not in allowed:
        numbers = " or ".join(map(str, allowed))
        raise head.at.error(f"{head} has {count}", f"{numbers} argument{'s' * (allowed != (1,))}")
    return Predicate(head.text, tuple(_known_name(argument, known) for argument in group.items[1:]))


def _goal(section: _Group, known: frozenset[str]) -> tuple[Predicate, ...]:
    """A conjunction of predicates, or a single one without ``And``."""
    expected = "one goal '(And ...)'"
    goal = _as_group(_only_item(section, expected), expected)
    if _head(goal, expected).text != "and":
        return (_predicate(goal, known),)
    if len(goal.items) < 2:
        raise goal.end.error("found ')'", "a predicate '(name argument ...)'")
    return tuple(_predicate(node, known) for node in goal.items[1:])
