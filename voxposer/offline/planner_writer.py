"""Programs of the planner: an instruction becomes sentences for the composer.

An instruction and entity names come in; the planner's program goes out, one ``composer("...")`` call per subtask. A
phrase that fits one name becomes that name; a phrase that fits several stays a phrase, and parse_query_obj resolves it
by comparing positions when the subtask runs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from voxposer.offline.grammar import Action, Noun, Place, Relation, read_instruction, read_noun, split_side
from voxposer.offline.names import Name, NotUnderstood, matching, read_names

# Distances named in subtasks, centimetres: over a target before the last descent; before a target that is entered
# from a side; after grasping and releasing; the way of a drawer, which stops at its end by itself; a step of a door;
# room kept from what is to be avoided.
ABOVE, BEFORE, LIFT, DRAWER, SHUT, DOOR, AVOID = 10, 20, 10, 18, 22, 10, 15
# Steps that take a door through its range.
DOOR_STEPS = 6
_SPEEDS = {"slowly": 0.5, "carefully": 0.5, "gently": 0.5, "quickly": 1.5, "fast": 1.5}
_AVOIDING = re.compile(
    r",?(?: and| while| but)? (?:avoid(?:ing)?|(?:keep(?:ing)?|stay(?:ing)?)(?: at least)?(?: (?P<cm>\d+) ?cm)?"
    r"(?: away)? from) (?P<what>.+?)(?: at all times?)?$"
)
_SPEED = re.compile(rf",? (?:at (?P<times>[\d.]+)x speed|(?P<how>{'|'.join(_SPEEDS)}))\b")


@dataclass(frozen=True)
class Found:
    """The names a noun can mean, and what picks one of several: a side or a relation of the noun."""

    noun: Noun
    names: tuple[Name, ...]

    @property
    def is_settled(self) -> bool:
        """Whether it is one object, independent of positions."""
        return len(self.names) == 1 or self.noun.indefinite

    @property
    def text(self) -> str:
        """Words for it in a subtask: its name if it is settled."""
        return f"the {self.names[0].text}" if self.is_settled else str(self.noun)


def ground(noun: Noun, names: Sequence[Name]) -> Found:
    """The names a noun can mean; words like "left" become its side where no name has them.

    Raises:
        NotUnderstood: no name fits, or several do and the noun does not say which.
    """
    words, side = split_side(noun.words)
    for option in (noun, replace(noun, words=words, side=side) if side and not noun.side else noun):
        found = matching(option.words, names)
        if found:
            return _unambiguous(Found(option, found))
    raise NotUnderstood(f"{str(noun)!r} fits none of {', '.join(name.text for name in names) or 'no objects'}")


def _unambiguous(found: Found) -> Found:
    noun = found.noun
    if not (found.is_settled or noun.side or noun.relation or noun.plural):
        raise NotUnderstood(f"{str(noun)!r} could be any of {', '.join(name.text for name in found.names)}")
    return found


def write_planner(instruction: str, objects: Sequence[str]) -> str:
    """The planner's program for an instruction.

    Raises:
        NotUnderstood: the message says what is not understood.
    """
    text, extras = _extras(instruction, read_names(objects))
    sentences = _Planner(read_names(objects)).plan(read_instruction(text))
    return "\n".join([*(f'composer("{_with(sentence, extras)}")' for sentence in sentences), "# done"])


def _extras(instruction: str, names: Sequence[Name]) -> tuple[str, str]:
    """The instruction without its global qualifiers (speed, objects to avoid), and these in the composer's words."""
    text, extras = instruction.lower().strip().rstrip("."), ""
    avoiding = _AVOIDING.search(text)
    if avoiding:
        text, what = text[: avoiding.start()], ground(read_noun(avoiding["what"]), names).text
        extras += f" while keeping at least {avoiding['cm'] or AVOID}cm away from {what}"
    speed = _SPEED.search(text)
    if speed:
        text = text[: speed.start()] + text[speed.end() :]
        extras += f", at {speed['times'] or _SPEEDS[speed['how']]}x speed"
    return text, extras


def _with(sentence: str, extras: str) -> str:
    return sentence if sentence.endswith(("default pose", "gripper")) else sentence + extras


class _Planner:
    """Writes subtasks and tracks what was moved: positions no longer distinguish moved objects from equal ones."""

    def __init__(self, names: Sequence[Name]) -> None:
        self._names = names
        self._moved: list[tuple[Found, Place]] = []
        self._arrivals: dict[Place, int] = {}
        self._arrived: dict[Place, int] = {}

    def plan(self, actions: Sequence[Action]) -> list[str]:
        """The subtasks of actions, in order."""
        for action in actions:
            if action.verb == "put" and action.place is not None:
                coming = len(self._things(action.thing))
                self._arrivals[action.place] = self._arrivals.get(action.place, 0) + coming
        verbs: dict[str, Callable[[Action], list[str]]] = {
            "pick": self._pick,
            "put": self._put,
            "push": self._push,
            "open": self._open,
            "close": self._close,
            "turn_on": self._turn,
            "turn_off": self._turn,
        }
        return [sentence for action in actions for sentence in verbs[action.verb](action)]

    # -- what is meant -------------------------------------------------------------------------------------------------

    def _things(self, noun: Noun) -> list[str]:
        """Phrases for a movable object; several where all of several are meant."""
        found = ground(noun, self._names)
        self._check_refs(found.noun)
        if found.noun.plural and not (found.noun.side or found.noun.relation):
            return [f"the {name.text}" for name in found.names]
        return [self._since_moved(found).text]

    def _check_refs(self, noun: Noun) -> None:
        for ref in noun.relation.refs if noun.relation else ():
            if ref.words != ("table",):
                ground(ref, self._names)

    def _since_moved(self, found: Found) -> Found:
        """The object identified by where it, or an equal one, was put, if its side or relation held before that."""
        for moved, place in reversed(self._moved):
            if not found.is_settled and moved.names == found.names:
                kind = place.relation if moved.noun == found.noun else "outside"
                relation = Relation(kind=kind, refs=(place.thing,))
                return replace(found, noun=replace(found.noun, side=None, relation=relation))
        return found

    def _place(self, place: Place) -> str:
        """The destination: the part of the object that the relation refers to."""
        if place.relation in {"near", "left_of", "right_of", "front_of", "back_of"} or place.thing.words == ("table",):
            return _place_thing(place, self._names).text
        found = self._since_moved(_place_thing(place, self._names))
        part = holder(place.relation, found.names[0], self._names) if found.is_settled else None
        return f"the {part.text}" if part else found.text

    def _half(self, place: Place) -> str:
        """The half of a flat place for the next object, where two are to stand on it."""
        if self._arrivals[place] != 2 or place.relation not in {"on", "top_of"}:
            return ""
        self._arrived[place] = self._arrived.get(place, 0) + 1
        return f"the {'left' if self._arrived[place] == 1 else 'right'} side of "

    def _operated(self, noun: Noun, part: str) -> str:
        """The handle or knob of what is to be opened, closed or turned."""
        words = (*(word for word in noun.words if word not in {"drawer", "door", part}), part)
        try:
            return ground(replace(noun, words=words), self._names).text
        except NotUnderstood as error:
            raise NotUnderstood(f"no {part} to {noun} is known: {error}") from None

    # -- subtasks ------------------------------------------------------------------------------------------------------

    def _pick(self, action: Action) -> list[str]:
        things = self._things(action.thing)
        if len(things) > 1:
            raise NotUnderstood(f"{action.thing} are several things for one hand")
        return _lifted(things[0])

    def _put(self, action: Action) -> list[str]:
        assert action.place is not None
        sentences: list[str] = []
        for thing in self._things(action.thing):
            half = self._half(action.place)
            sentences += [*_lifted(thing), *_lowered(action.place.relation, half + self._place(action.place))]
        self._moved.append((ground(action.thing, self._names), action.place))
        return sentences

    def _push(self, action: Action) -> list[str]:
        assert action.place is not None
        (thing,), place = self._things(action.thing), self._place(action.place)
        goal = _SIDES_SAID.get(action.place.relation, "towards")
        return [f"push {thing} {goal} {place}", "back to default pose"]

    def _open(self, action: Action) -> list[str]:
        handle = self._operated(action.thing, "handle")
        pulls = (
            [f"pull {handle} by {DOOR}cm"] * DOOR_STEPS if self._is_door(handle) else [f"pull {handle} by {DRAWER}cm"]
        )
        return [f"grasp {handle}", *pulls, "open gripper", *_back_from(handle)]

    def _close(self, action: Action) -> list[str]:
        handle = self._operated(action.thing, "handle")
        if not self._is_door(handle):
            return [f"push close {handle} by {SHUT}cm", *_back_from(handle)]
        steps = [f"push {handle} by {DOOR}cm"] * (DOOR_STEPS - 1)
        return [f"push close {handle} by {DOOR}cm", *steps, *_back_from(handle)]

    def _is_door(self, handle: str) -> bool:
        """A handle that belongs to no drawer."""
        named = next(name for name in self._names if f"the {name.text}" == handle)
        drawers = {name.whole for name in self._names if "drawer" in name.words}
        return named.whole not in drawers and not {"drawer", "cabinet"} & set(named.words)

    def _turn(self, action: Action) -> list[str]:
        knob = self._operated(action.thing, "knob")
        switch = action.verb.removeprefix("turn_")
        return [f"grasp {knob}", f"turn {switch} {knob}", "open gripper", *_LEAVE]


_LEAVE = [f"move up by {LIFT}cm", "back to default pose"]
_SIDES_SAID = {
    "near": "next to",
    "left_of": "to the left of",
    "right_of": "to the right of",
    "front_of": "to the front of",
    "back_of": "to the back of",
}


def _lifted(thing: str) -> list[str]:
    return [f"grasp {thing}", f"move up by {LIFT}cm", f"grasp {thing} again if nothing is held"]


def _lowered(relation: str, place: str) -> list[str]:
    if relation in _SIDES_SAID:
        goal = f"{_SIDES_SAID[relation]} {place}"
        return [f"move to {ABOVE}cm above the table {goal}", f"place it {goal}", *_LEAVE]
    word = "in" if relation == "in" else "on"
    if place.endswith(("_inside", "_level")):
        return [f"move to {BEFORE}cm in front of {place}", f"place it {word} {place}", *_back_from(place, BEFORE)]
    return [f"move to {ABOVE}cm above {place}", f"place it {word} {place}", *_LEAVE]


def _back_from(handle: str, cm: int = ABOVE) -> list[str]:
    return [f"move back from {handle} by {cm}cm", "back to default pose"]


def _place_thing(place: Place, names: Sequence[Name]) -> Found:
    if place.thing.words == ("table",):
        return Found(place.thing, (Name(text="table", whole="table", words=("table",)),))
    drawers = matching(place.thing.words, names) if place.relation == "top_of" else ()
    if drawers and all("drawer" in name.words for name in drawers) and len({name.whole for name in drawers}) == 1:
        # The top of a drawer, whichever, is the top of what it is in.
        return Found(place.thing, drawers[:1])
    return ground(place.thing, names)


def holder(relation: str, name: Name, names: Sequence[Name]) -> Name | None:
    """The part of a thing that holds what is on, in, on top of or under it; None for the thing itself.

    Raises:
        NotUnderstood: it goes into one of several drawers and none is named.
    """
    if name.is_part:
        return _part_of(name.whole, names, ({"top"},)) if relation == "top_of" and "drawer" in name.words else None
    inside = ({"inside"},) if _part_of(name.text, names, ({"handle"}, {"door"})) else ()
    upper, lower, top = {"upper", "level"}, {"lower", "level"}, {"top"}
    wanted: dict[str, tuple[set[str], ...]] = {
        "in": (*inside, upper),
        "on": ({"burner"}, {"slot"}, upper, top),
        "top_of": ({"burner"}, {"slot"}, top),
        "under": (lower,),
    }
    found = _part_of(name.text, names, wanted.get(relation, ()))
    drawers = [part.text for part in names if part.whole == name.text and "drawer" in part.part_words]
    if found is None and relation in {"in", "under"} and drawers:
        raise NotUnderstood(f"in which of {', '.join(drawers)}?")
    return found


def _part_of(whole: str, names: Sequence[Name], wanted: Sequence[set[str]]) -> Name | None:
    """The first part of a thing with exactly the wanted words, in order of preference."""
    parts = [name for name in names if name.whole == whole and name.is_part]
    return next((part for words in wanted for part in parts if set(part.part_words) == words), None)
