"""Programs of parse_query_obj: a phrase for an object becomes a program that detects it.

A phrase and the entity names of the scene come in; the program goes out. An object that the words determine is looked
up by name; otherwise ("the black bowl between the plate and the ramekin") the program compares positions at run time.
The writer itself never sees a position.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from voxposer.offline.grammar import Noun, Relation, read_noun
from voxposer.offline.names import Name, NotUnderstood, read_names
from voxposer.offline.planner_writer import Found, ground, holder
from voxposer.offline.rules import variable

_HANDS = frozenset(["gripper", "hand", "ee", "end effector", "end_effector", "endeffector"])
_TABLES = frozenset(["table", "workspace", "work space", "desk", "floor"])
_HELD = frozenset(["held object", "object in the gripper", "it"])
# Which candidate a side means: the extreme of which coordinate.
_SIDES = {
    "left": ("argmin", 1),
    "right": ("argmax", 1),
    "back": ("argmin", 0),
    "front": ("argmax", 0),
    "bottom": ("argmin", 2),
    "top": ("argmax", 2),
}
_CONTAINERS = frozenset(["drawer", "compartment", "inside", "basket", "tray", "microwave", "caddy"])
_BESIDE = {"left_of": ("<", 1), "right_of": (">", 1), "back_of": ("<", 0), "front_of": (">", 0)}
# Relations that do not depend on height: they also hold for a lifted object.
_FLAT = frozenset(["near", "between", "center", "outside"])
# Voxels are not cubes: centimetres of one along each axis.
_SCALE = "cm = np.array([index2cm(1, 'x'), index2cm(1, 'y'), index2cm(1, 'z')])"


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
    lines, found = _Locator(names).locate(read_noun(text))
    return "\n".join([*lines, f"ret_val = {found}"])


class _Locator:
    """Writes the lines that find a noun and the objects that describe it."""

    def __init__(self, names: Sequence[Name]) -> None:
        self._names = names
        self._used: set[str] = {"cm", "distances", "face", "foot", "gap", "high", "low", "middle", "thing"}

    def locate(self, noun: Noun, inside: str = "") -> tuple[list[str], str]:
        """Lines, and the expression that holds the object after them.

        Args:
            noun: what to find.
            inside: a relation; the part of the object that holds its contents is meant.
        """
        if noun.words == ("table",):
            return [], "detect('table')"
        found = ground(noun, self._names)
        if found.is_settled:
            name = found.names[0]
            return [], f"detect({((inside and holder(inside, name, self._names)) or name).text!r})"
        listed = ", ".join(repr(name.text) for name in found.names)
        if found.noun.plural and not (found.noun.side or found.noun.relation):
            return [], f"[detect(name) for name in [{listed}]]"
        several = self._name(variable(" ".join(found.noun.words)) + "s")
        lines = [f"{several} = [detect(name) for name in [{listed}]]"]
        more, chosen = self._choose(found, several)
        return [*lines, *more], chosen

    def _name(self, wish: str) -> str:
        name = next(name for name in (wish, *(f"{wish}_{i}" for i in range(2, 99))) if name not in self._used)
        self._used.add(name)
        return name

    def _choose(self, found: Found, several: str) -> tuple[list[str], str]:
        noun = found.noun
        if noun.side and noun.relation:
            raise NotUnderstood(f"{str(noun)!r} says both a side and a relation; say one")
        if noun.relation:
            return self._by_relation(noun.relation, several)
        if noun.side == "middle":
            lines = [_SCALE, f"middle = sum([thing.position for thing in {several}]) / len({several})"]
            return [*lines, _distances(several, "middle")], f"{several}[np.argmin(distances)]"
        function, axis = _SIDES[noun.side or ""]
        return [], f"{several}[np.{function}([thing.position[{axis}] for thing in {several}])]"

    def _by_relation(self, relation: Relation, several: str) -> tuple[list[str], str]:
        if relation.kind in _BESIDE:
            return self._beside(relation, several)
        lines, goal = self._goal(relation)
        away = relation.negated != (relation.kind == "outside")
        if _is_on(relation):
            lines += [_SCALE, *_gaps(several, goal.removesuffix(".position"))]
        else:
            lines += [_SCALE, _distances(several, goal, flat=relation.kind in _FLAT)]
        return lines, f"{several}[np.{'argmax' if away else 'argmin'}(distances)]"

    def _goal(self, relation: Relation) -> tuple[list[str], str]:
        """The point that the wanted object is closest to: the other object, or the middle of two."""
        lines, points = [], []
        for ref in relation.refs:
            more, expression = self.locate(ref, "on" if relation.kind == "from" else relation.kind)
            name = self._name(variable(" ".join(ref.words)))
            lines += [*more, f"{name} = {expression}"]
            points.append(f"{name}.position")
        if relation.kind == "between" and len(points) == 1:
            name = points[0].removesuffix(".position")
            return [*lines, f"middle = sum([thing.position for thing in {name}]) / len({name})"], "middle"
        if len(points) == 2:
            return [*lines, f"middle = ({points[0]} + {points[1]}) / 2"], "middle"
        return lines, points[0]

    def _beside(self, relation: Relation, several: str) -> tuple[list[str], str]:
        """The closest one on one side of an object."""
        lines, goal = self._goal(relation)
        sign, axis = _BESIDE[relation.kind]
        condition = f"thing.position[{axis}] {sign} {goal}[{axis}]"
        chosen = f"[thing for thing in {several} if {'not ' if relation.negated else ''}{condition}]"
        candidates = self._name("candidates")
        lines += [f"{candidates} = {chosen}", _SCALE, _distances(candidates, goal)]
        return lines, f"{candidates}[np.argmin(distances)]"


def _is_on(relation: Relation) -> bool:
    """Whether the phrase says that an object stands on another; "from" a container means that it was in it."""
    inside = relation.kind == "from" and bool(_CONTAINERS.intersection(relation.refs[0].words))
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


def _distances(several: str, goal: str, flat: bool = False) -> str:
    offset = f"((thing.position - {goal}) * cm)[:2]" if flat else f"(thing.position - {goal}) * cm"
    return f"distances = [np.linalg.norm({offset}) for thing in {several}]"
