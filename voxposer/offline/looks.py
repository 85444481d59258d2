"""Lines of the planner's program that look at the scene before anything moves: conditions, and what is presupposed.

Actions on descriptions come in; lines of Python go out. "The bottle on the rack" presupposes that a bottle is there,
and the program raises an error where none is: the description would otherwise be taken for the nearest bottle, or for
the only one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from voxposer.offline.grounding import Found, ground, is_table, refs_of
from voxposer.offline.meaning import Action, Noun, Relation
from voxposer.offline.names import Name, NotUnderstood
from voxposer.offline.query_writer import SIDES_OF, Locator, is_on

# Centimetres that the underside of a thing may be off the bounds of what it stands on, or is in: drawers are one above
# the other.
_OFF_ON, _OFF_IN = 4, 1.5
_LOOKED_AT = frozenset(["on", "in", "top_of", "from"])
RESTS = [
    "cm = np.array([index2cm(1, axis) for axis in 'xyz'])",
    "foot = lambda box: (box[0] + box[1] * np.array([1, 1, 0])) / np.array([2, 2, 1])",
    "off = lambda foot, box: np.linalg.norm(np.maximum(np.maximum(box[0] - foot, foot - box[1]), 0) * cm)",
    "rests = lambda name, at, most: off(foot(detect(name).aabb), at.aabb) < most",
]


def presupposed(actions: Sequence[Action], names: Sequence[Name]) -> list[str]:
    """Lines that raise an error where a description of something that nothing moved before fits nothing."""
    premises: list[str] = []
    moved: set[str] = set()
    for action in actions:
        for noun in _described(action):
            found = _known(noun, names)
            if found is None or noun.relation is None or moved & _names_in(noun, names):
                continue
            premises.append(_premise(found, noun, noun.relation, names))
        if action.verb not in {"open", "close", "turn_on", "turn_off"}:
            found = _known(action.thing, names)
            moved |= {name.text for name in found.names} if found else set()
    return [line for premise in dict.fromkeys(premises) for line in premise.splitlines()]


def _described(action: Action) -> Iterator[Noun]:
    """The objects of an action, and those that describe them."""
    places = [action.place.thing, action.place.second] if action.place is not None else []
    for noun in (action.thing, *places):
        if noun is not None:
            yield from _with_refs(noun)


def _with_refs(noun: Noun) -> Iterator[Noun]:
    for ref in refs_of(noun):
        yield from _with_refs(ref)
    yield noun


def _known(noun: Noun, names: Sequence[Name]) -> Found | None:
    """What a description can mean; None for the table, and where the planner says itself what is wrong."""
    if is_table(noun):
        return None
    try:
        return ground(noun, names)
    except NotUnderstood:
        return None


def _names_in(noun: Noun, names: Sequence[Name]) -> set[str]:
    found = [_known(part, names) for part in _with_refs(noun)]
    return {name.text for one in found if one is not None for name in one.names}


def _premise(found: Found, noun: Noun, relation: Relation, names: Sequence[Name]) -> str:
    """Lines that check one description; none for relations that are a matter of degree."""
    (ref, *others), several = relation.refs, noun.number or 1
    if others or is_table(ref) or ref.plural or relation.kind not in _LOOKED_AT | set(SIDES_OF):
        return ""
    looked = looked_at(ref, relation, names)
    if looked is None:
        return ""
    lines, test = looked
    listed = ", ".join(repr(name.text) for name in found.names)
    count = f"sum([{'not ' if relation.negated else ''}{test} for name in [{listed}]])"
    least = several if noun.plural or noun.indefinite or not relation.negated else 1
    wrong = f"{count} != 1" if relation.negated and not (noun.plural or noun.indefinite) else f"{count} < {least}"
    return "\n".join([*lines, f"if {wrong}: raise ValueError({f'no such object: {noun}'!r})"])


def looked_at(ref: Noun, relation: Relation, names: Sequence[Name]) -> tuple[list[str], str] | None:
    """Lines that find what a thing is related to, and the test of the thing called ``name``; None if it is unknown."""
    try:
        lines, expression = Locator(names).locate(ref, "in" if relation.kind == "in" else "")
    except NotUnderstood:
        return None
    lines = [*lines, f"other = {expression}"]
    if relation.kind in SIDES_OF:
        sign, axis = SIDES_OF[relation.kind]
        return lines, f"detect(name).position[{axis}] {sign} other.position[{axis}]"
    return lines, f"rests(name, other, {_OFF_ON if is_on(relation) else _OFF_IN})"
