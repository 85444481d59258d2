"""A parser of the BDDL dialect that LIBERO's task files are written in: text in, a frozen `Problem` out.

Reads as upstream does (`libero.libero.envs.bddl_utils.robosuite_parse_problem` over `bddl.parsing.scan_tokens`): the
whole file is lower-cased, ``;`` starts a comment, a region's full name is ``{target}_{region}``, instances keep the
order of the file. Where upstream would drop, ignore or evaluate what it does not expect, this raises `BDDLError` with
file, line, column and what was expected there. Nothing in a file is executed; size and nesting are bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from vecenv.libero.scene.bddl_syntax import (
    MAX_CHARS,
    Atom,
    Group,
    Node,
    Place,
    as_atom,
    as_group,
    describe,
    head_of,
    lines_of,
    only_item,
    read_angle,
    read_define,
    read_number,
    read_numbers,
    single_word,
    sole,
    too_long,
)

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
        raise too_long(str(path))
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = lines_of(error.object[: error.start].decode("utf-8", "replace"))
        place = Place(str(path), len(before), len(before[-1]) + 1)
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
    sections = _sections(read_define(text, source))
    declared: dict[str, Atom] = {}
    fixtures = _instances(sections[":fixtures"], declared)
    objects = _instances(sections[":objects"], declared)
    regions = _regions(sections[":regions"], declared) if ":regions" in sections else ()
    known = frozenset(declared) | {region.name for region in regions if region.target in declared}
    interest = sections.get(":obj_of_interest")
    return Problem(
        name=single_word(sections["problem"], "a problem name"),
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


def _sections(root: Group) -> dict[str, Group]:
    """Sections by name; all required ones are there and none twice."""
    sections: dict[str, Group] = {}
    for node in root.items[1:]:
        group = as_group(node, "a section '(...)'")
        head = head_of(group, "a section name")
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


def _domain(section: Group) -> str:
    domain = as_atom(only_item(section, repr(_DOMAIN)), repr(_DOMAIN))
    if domain.text != _DOMAIN:
        raise domain.at.error(f"found {domain}", repr(_DOMAIN))
    return domain.text


def _language(section: Group) -> str:
    if len(section.items) < 2:
        raise section.end.error("found ')'", "an instruction")
    return " ".join(as_atom(node, "a word of the instruction").text for node in section.items[1:])


def _declare(name: Atom, declared: dict[str, Atom]) -> None:
    first = declared.setdefault(name.text, name)
    if first is not name:
        raise name.at.error(f"{name} was already declared at {first.at.line}:{first.at.column}", "an unused name")


def _instances(section: Group, declared: dict[str, Atom]) -> tuple[Instance, ...]:
    """``name name - category`` runs. Upstream keys them by category, so a repeated category would lose instances."""
    instances: list[Instance] = []
    categories: dict[str, Atom] = {}
    pending: list[Atom] = []
    words = iter(as_atom(node, "an instance name") for node in section.items[1:])
    for word in words:
        if word.text != "-":
            _declare(word, declared)
            pending.append(word)
            continue
        if not pending:
            raise word.at.error("found '-'", "an instance name")
        category = next(words, None)
        if category is None or category.text == "-":
            raise (category.at if category else section.end).error(f"found {describe(category)}", "a category")
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


def _regions(section: Group, declared: dict[str, Atom]) -> tuple[Region, ...]:
    names = dict(declared)
    return tuple(_region(as_group(node, "a region '(name ...)'"), names) for node in section.items[1:])


def _region(group: Group, names: dict[str, Atom]) -> Region:
    local = head_of(group, "a region name")
    values = _attributes(group)
    if ":target" not in values:
        raise group.end.error(f"region {local} has no target", "'(:target ...)'")
    target = single_word(values[":target"], "the name of an instance")
    name = f"{target}_{local.text}"
    _declare(Atom(name, local.at), names)
    ranges, yaw, rgba = (values.get(key) for key in (":ranges", ":yaw_rotation", ":rgba"))
    return Region(
        name=name,
        target=target,
        ranges=_ranges(ranges) if ranges else Region.ranges,
        yaw=_yaw(yaw) if yaw else Region.yaw,
        rgba=_rgba(rgba) if rgba else Region.rgba,
    )


def _attributes(region: Group) -> dict[str, Group]:
    values: dict[str, Group] = {}
    for node in region.items[1:]:
        attribute = as_group(node, "a region attribute '(:name ...)'")
        head = head_of(attribute, "a region attribute")
        if head.text not in _REGION_ATTRIBUTES:
            raise head.at.error(f"unknown attribute {head}", f"one of {', '.join(_REGION_ATTRIBUTES)}")
        if head.text in values:
            raise head.at.error(f"{head} is given twice", "each attribute once")
        values[head.text] = attribute
    return values


def _ranges(attribute: Group) -> tuple[_Rectangle, ...]:
    expected = "a list of rectangles '((x0 y0 x1 y1) ...)'"
    rectangles = as_group(only_item(attribute, expected), expected)
    if not rectangles.items:
        raise rectangles.end.error("found ')'", "a rectangle '(x0 y0 x1 y1)'")
    return tuple(_rectangle(node) for node in rectangles.items)


def _rectangle(node: Node) -> _Rectangle:
    group = as_group(node, "a rectangle '(x0 y0 x1 y1)'")
    x0, y0, x1, y1 = read_numbers(group, 4, read_number)
    _check_order(x0, x1, group.items[2].at, "x")
    _check_order(y0, y1, group.items[3].at, "y")
    return (x0, y0, x1, y1)


def _yaw(attribute: Group) -> tuple[float, float]:
    expected = "a list of one pair '((low high))'"
    pairs = as_group(only_item(attribute, expected), expected)
    groups = tuple(as_group(node, expected) for node in pairs.items)
    pair = as_group(sole(groups, pairs.end, expected), expected)
    low, high = read_numbers(pair, 2, read_angle)
    _check_order(low, high, pair.items[1].at, "yaw")
    return (low, high)


def _rgba(attribute: Group) -> tuple[float, float, float, float]:
    expected = "a colour '(r g b a)'"
    group = as_group(only_item(attribute, expected), expected)
    red, green, blue, alpha = values = read_numbers(group, 4, read_number)
    for value, node in zip(values, group.items, strict=True):
        if not 0 <= value <= 1:
            raise node.at.error(f"found {describe(node)}", "a value from 0 to 1")
    return (red, green, blue, alpha)


def _check_order(low: float, high: float, at: Place, axis: str) -> None:
    if low > high:
        raise at.error(f"{axis} runs from {low:g} to {high:g}", "an upper bound not below the lower one")


# ------------------------------------------------------------------------------------------------------- predicates


def _known_name(node: Node, known: frozenset[str]) -> str:
    word = as_atom(node, "the name of an object, fixture or region")
    if word.text not in known:
        raise word.at.error(f"{word} is not declared", "the name of an object, fixture or region")
    return word.text


def _predicate(node: Node, known: frozenset[str]) -> Predicate:
    expected = "a predicate '(name argument ...)'"
    group = as_group(node, expected)
    head = head_of(group, expected)
    if head.text in _CONNECTIVES:
        raise head.at.error(f"nested {head} is not supported", "a predicate over names")
    if head.text not in PREDICATE_ARITY:
        raise head.at.error(f"unknown predicate {head}", f"one of {', '.join(PREDICATE_ARITY)}")
    count, allowed = len(group.items) - 1, PREDICATE_ARITY[head.text]
    if count not in allowed:
        numbers = " or ".join(map(str, allowed))
        raise head.at.error(f"{head} has {count}", f"{numbers} argument{'s' * (allowed != (1,))}")
    return Predicate(head.text, tuple(_known_name(argument, known) for argument in group.items[1:]))


def _goal(section: Group, known: frozenset[str]) -> tuple[Predicate, ...]:
    """A conjunction of predicates, or a single one without ``And``."""
    expected = "one goal '(And ...)'"
    goal = as_group(only_item(section, expected), expected)
    if head_of(goal, expected).text != "and":
        return (_predicate(goal, known),)
    if len(goal.items) < 2:
        raise goal.end.error("found ')'", "a predicate '(name argument ...)'")
    return tuple(_predicate(node, known) for node in goal.items[1:])
