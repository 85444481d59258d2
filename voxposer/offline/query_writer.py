"""Programs of parse_query_obj: a phrase for an object becomes a program that detects it.

A phrase and the entity names of the scene come in; the program goes out. An object that the words determine is looked
up by name; otherwise ("the black bowl between the plate and the ramekin") the program compares positions at run time.
The writer itself never sees a position.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from voxposer.offline.grammar import read_noun
from voxposer.offline.grounding import Found, ground, holder, is_table, refs_of
from voxposer.offline.meaning import Noun, Ranking, Relation
from voxposer.offline.names import Name, NotUnderstood, read_names
from voxposer.offline.rules import variable

_HANDS = frozenset(["gripper", "hand", "ee", "end effector", "end_effector", "endeffector"])
_TABLES = frozenset(["table", "workspace", "work space", "desk", "floor"])
_HELD = frozenset(["held object", "object in the gripper", "it"])
# The extreme of which value is meant: whether the least, and the value.
_VALUES = {
    "left": (True, "thing.position[1]"),
    "right": (False, "thing.position[1]"),
    "back": (True, "thing.position[0]"),
    "front": (False, "thing.position[0]"),
    "bottom": (True, "thing.position[2]"),
    "top": (False, "thing.position[2]"),
    "small": (True, "np.prod((thing.aabb[1] - thing.aabb[0] + 1) * cm)"),
    "large": (False, "np.prod((thing.aabb[1] - thing.aabb[0] + 1) * cm)"),
    "short": (True, "thing.aabb[1][2] - thing.aabb[0][2]"),
    "tall": (False, "thing.aabb[1][2] - thing.aabb[0][2]"),
    "long": (False, "np.max((thing.aabb[1] - thing.aabb[0]) * cm)"),
}
_CONTAINERS = frozenset(["drawer", "compartment", "inside", "basket", "tray", "microwave", "caddy"])
SIDES_OF = {"left_of": ("<", 1), "right_of": (">", 1), "back_of": ("<", 0), "front_of": (">", 0)}
# Relations that do not depend on height: they also hold for a lifted object.
_FLAT = frozenset(["near", "between", "center", "outside"])
# Voxels are not cubes: centimetres of one along each axis.
SCALE = "cm = np.array([index2cm(1, 'x'), index2cm(1, 'y'), index2cm(1, 'z')])"


def write_query(query: str, objects: Sequence[str]) -> str:
    """The program that detects what a phrase means.

    Raises:
        NotUnderstood: no name fits the phrase, or it does not say which of several.
    """
    text = " ".join(query.strip().rstrip(".").split())
    bare = re.sub(r"^(?:the|a|an) ", "", text.lower())
    names = read_names(objects)
    for alias, known in (("gripper", _HANDS), ("table", _TABLES), ("held object", _HELD)):
        if bare in known and not any(name.text.lower() == bare for name in names):
            return f"ret_val = detect({alias!r})"
    try:
        lines, found = Locator(names).locate(read_noun(text))
    except RecursionError:
        raise NotUnderstood(f"{text[:80]!r} describes objects by one another without an end") from None
    return "\n".join([*lines, f"ret_val = {found}"])


class Locator:
    """Writes the lines that find a noun and the objects that describe it."""

    def __init__(self, names: Sequence[Name]) -> None:
        self._names = names
        self._scaled = False
        self._used: set[str] = {
            "cm",
            "distances",
            "face",
            "name",
            "objects",
            "other",
            "rests",
            "np",
            "i",
            "foot",
            "gap",
            "high",
            "low",
            "middle",
            "offset",
            "share",
            "start",
            "thing",
            "way",
        }

    def locate(self, noun: Noun, inside: str = "") -> tuple[list[str], str]:
        """Lines, and the expression that holds the object after them.

        Args:
            noun: what to find.
            inside: a relation; the part of the object that holds its contents is meant.
        """
        if is_table(noun):
            return [], "detect('table')"
        found = ground(noun, self._names)
        if found.is_settled:
            name = found.names[0]
            return [], f"detect({((inside and holder(inside, name, self._names)) or name).text!r})"
        listed = ", ".join(repr(name.text) for name in found.names)
        chosen = found.noun.ranking or found.noun.relation or found.noun.excluded or found.noun.moved
        if found.noun.plural and not chosen:
            return [], f"[detect(name) for name in [{listed}]]"
        several = self._name(variable(" ".join(found.noun.words)) + "s")
        lines = [f"{several} = [detect(name) for name in [{listed}]]"]
        more, expression = self._choose(found, several)
        return [*lines, *more], expression

    def _name(self, wish: str) -> str:
        name = next(name for name in (wish, *(f"{wish}_{i}" for i in range(2, 99))) if name not in self._used)
        self._used.add(name)
        return name

    def _scale(self) -> list[str]:
        """The line that says how large voxels are, the first time it is needed."""
        needed, self._scaled = not self._scaled, True
        return [SCALE] if needed else []

    def _choose(self, found: Found, several: str) -> tuple[list[str], str]:
        noun = found.noun
        lines, left = [], len(found.names)
        for count, relation in noun.moved:
            lines += self._without_moved(count, relation, several)
            left -= count
        for excluded in noun.excluded:
            lines += self._without(excluded, several)
            left -= 1
        for ref in refs_of(noun):
            if not is_table(ref) and _could_be(ground(ref, self._names), found):
                lines += self._without(replace(ref, plural=False), several)
        if noun.relation and noun.ranking and noun.relation.kind not in SIDES_OF:
            raise NotUnderstood(f"{str(noun)!r} says both an order and a place; say one")
        if noun.relation and noun.ranking:
            more, several = self._beyond(noun.relation, several)
            lines += more
        elif noun.relation:
            more, expression = self._by_relation(noun.relation, several)
            return [*lines, *more], expression
        if noun.ranking:
            more, expression = self._ranked(noun.ranking, several)
            return [*lines, *more], expression
        if left != 1 and not noun.indefinite:
            raise NotUnderstood(f"{str(noun)!r} could be any of {left}")
        return lines, f"{several}[0]"

    def _ranked(self, ranking: Ranking, several: str) -> tuple[list[str], str]:
        """The one at a rank of an order."""
        if ranking.key == "middle":
            if ranking.rank != 1:
                raise NotUnderstood("only one is in the middle")
            lines = [*self._scale(), f"middle = sum([thing.position for thing in {several}]) / len({several})"]
            return [*lines, _distances(several, "middle")], f"{several}[np.argmin(distances)]"
        if ranking.key in {"near", "far"}:
            assert ranking.ref is not None
            lines, goal = self._goal(Relation(kind="near", refs=(ranking.ref,)))
            lines += [*self._scale(), _distances(several, goal, flat=True)]
            return lines, f"{several}[{_at('distances', ranking.key == 'near', ranking.rank)}]"
        least, value = _VALUES[ranking.key]
        values = f"[{value} for thing in {several}]"
        return (self._scale() if "cm" in value else []), f"{several}[{_at(values, least, ranking.rank)}]"

    def _without_moved(self, count: int, relation: Relation, several: str) -> list[str]:
        """Lines that leave out those that are where others were put."""
        if relation.refs[0].words == ("hand",):
            return [f"{several} = [thing for thing in {several} if not thing.held]"]
        lines, goal = self._goal(relation)
        flat = relation.kind not in {"on", "in", "top_of", "under"}
        lines += [*self._scale(), _distances(several, goal, flat=flat)]
        return [*lines, f"{several} = [{several}[i] for i in np.argsort(distances)[{count}:]]"]

    def _without(self, excluded: Noun, several: str) -> list[str]:
        """Lines that leave out one that is described."""
        lines, expression = self.locate(excluded)
        name = self._name("excluded")
        kept = f"[thing for thing in {several} if thing.name != {name}.name]"
        return [*lines, f"{name} = {expression}", f"{several} = {kept}"]

    def _by_relation(self, relation: Relation, several: str) -> tuple[list[str], str]:
        if relation.kind in SIDES_OF:
            return self._beside(relation, several)
        away = relation.negated != (relation.kind == "outside")
        if relation.kind == "between" and len(relation.refs) == 2:
            lines, ends = self._ends(relation)
            lines += [*self._scale(), *_from_line(several, *ends)]
            return lines, f"{several}[np.{'argmax' if away else 'argmin'}(distances)]"
        lines, goal = self._goal(relation)
        if is_on(relation):
            lines += [*self._scale(), *_gaps(several, goal.removesuffix(".position"))]
        else:
            lines += [*self._scale(), _distances(several, goal, flat=relation.kind in _FLAT)]
        return lines, f"{several}[np.{'argmax' if away else 'argmin'}(distances)]"

    def _goal(self, relation: Relation) -> tuple[list[str], str]:
        """The point that the wanted object is closest to: the other object, or the middle of two."""
        lines, points = self._ends(relation)
        if relation.kind == "between" and len(points) == 1:
            name = points[0].removesuffix(".position")
            return [*lines, f"middle = sum([thing.position for thing in {name}]) / len({name})"], "middle"
        if len(points) == 2:
            return [*lines, f"middle = ({points[0]} + {points[1]}) / 2"], "middle"
        return lines, points[0]

    def _ends(self, relation: Relation) -> tuple[list[str], list[str]]:
        """The positions of the other objects."""
        lines, points = [], []
        for ref in relation.refs:
            more, expression = self.locate(ref, "on" if relation.kind == "from" else relation.kind)
            name = self._name(variable(" ".join(ref.words)))
            lines += [*more, f"{name} = {expression}"]
            points.append(f"{name}.position")
        return lines, points

    def _beside(self, relation: Relation, several: str) -> tuple[list[str], str]:
        """The closest one on one side of an object."""
        lines, goal = self._goal(relation)
        lines, candidates = self._filtered(relation, several, lines, goal)
        lines += [*self._scale(), _distances(candidates, goal)]
        return lines, f"{candidates}[np.argmin(distances)] if len({candidates}) > 0 else None"

    def _beyond(self, relation: Relation, several: str) -> tuple[list[str], str]:
        """Those on one side of an object."""
        lines, goal = self._goal(relation)
        return self._filtered(relation, several, lines, goal)

    def _filtered(self, relation: Relation, several: str, lines: list[str], goal: str) -> tuple[list[str], str]:
        sign, axis = SIDES_OF[relation.kind]
        condition = f"thing.position[{axis}] {sign} {goal}[{axis}]"
        chosen = f"[thing for thing in {several} if {'not ' if relation.negated else ''}{condition}]"
        candidates = self._name("candidates")
        return [*lines, f"{candidates} = {chosen}"], candidates


def _could_be(ref: Found, found: Found) -> bool:
    """Whether an object that describes another could be that one, so that it must be left out when the program runs."""
    return not ref.is_settled and not ref.noun.plural and bool(set(ref.names) & set(found.names))


def _at(values: str, least: bool, rank: int) -> str:
    """The index of the element at a rank, counted from the least or the greatest value."""
    if abs(rank) == 1:
        return f"np.{'argmin' if least == (rank > 0) else 'argmax'}({values})"
    place = rank - 1 if (rank > 0) == least else -rank
    return f"np.argsort({values})[{place}]"


def is_on(relation: Relation) -> bool:
    """Whether the phrase says that an object stands on another; "from" a container means that it was in it."""
    said = {part for word in relation.refs[0].words for part in word.split("_")}
    inside = relation.kind == "from" and bool(_CONTAINERS & said)
    return relation.kind in {"on", "top_of", "from"} and not inside


def _gaps(several: str, support: str) -> list[str]:
    """Distance of the underside of each object from the upper face of another."""
    return [
        f"low, high = {support}.aabb",
        "face = np.array([low[0], low[1], high[2]])",
        "distances = []",
        f"for thing in {several}:",
        "    foot = (thing.aabb[0] + thing.aabb[1]) / 2",
        "    foot[2] = thing.aabb[0][2]",
        "    gap = np.maximum(np.maximum(face - foot, foot - high), 0)",
        "    distances.append(np.linalg.norm(gap * cm))",
    ]


def _from_line(several: str, first: str, second: str) -> list[str]:
    """Distance of each object from the line between two positions: what is beside one end is nearly between them."""
    return [
        f"start, way = ({first} * cm)[:2], (({second} - {first}) * cm)[:2]",
        "distances = []",
        f"for thing in {several}:",
        "    offset = (thing.position * cm)[:2] - start",
        "    share = np.clip(np.dot(offset, way) / np.maximum(np.dot(way, way), 1e-6), 0, 1)",
        "    distances.append(np.linalg.norm(offset - share * way))",
    ]


def _distances(several: str, goal: str, flat: bool = False) -> str:
    offset = f"((thing.position - {goal}) * cm)[:2]" if flat else f"(thing.position - {goal}) * cm"
    return f"distances = [np.linalg.norm({offset}) for thing in {several}]"
