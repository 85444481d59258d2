"""Programs of the planner: an instruction becomes sentences for the composer.

An instruction and entity names come in; the planner's program goes out, one ``composer("...")`` call per subtask. A
phrase that fits one name becomes that name; a phrase that fits several stays a phrase, and parse_query_obj resolves it
by comparing positions when the subtask runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from voxposer.offline.grammar import read_noun, understand
from voxposer.offline.grounding import Found, ground, holder, is_fixture, is_table, refs_of
from voxposer.offline.lexicon import GENERIC, words
from voxposer.offline.meaning import BESIDE, Action, Avoidance, Instruction, Noun, Place, Ranking
from voxposer.offline.names import Name, NotUnderstood, matching, read_names
from voxposer.offline.query_writer import write_query
from voxposer.offline.references import Moves

# Distances named in subtasks, centimetres: over a target before the last descent; before a target that is entered
# from a side; after grasping and releasing; the way of a drawer, which stops at its end by itself; a step of a door;
# room kept from what is to be avoided; the longest distance that fits on a table.
ABOVE, BEFORE, LIFT, DRAWER, SHUT, DOOR, AVOID, FARTHEST = 10, 20, 10, 18, 22, 10, 15, 100
# How far fingers sink that let go of something in a space: tipped over onto them, it would come out with them.
SINK = 4
# Steps that take a door through its range.
DOOR_STEPS = 6
# Objects that "to" puts things into, and those it puts things next to: all that are not supports.
_CONTAINERS = frozenset(words("basket tray drawer microwave caddy compartment bowl bin box mug"))
_SUPPORTS = frozenset(words("plate stove cabinet shelf rack towel cloth table burner level top ramekin"))
# More things than this that go to one place are written as a loop, so that the program stays short.
_LOOP = 3
# What orders by size, which stays the same while an object is carried.
_SIZES = frozenset(["large", "small", "tall", "short", "long"])


@dataclass(frozen=True)
class Block:
    """Sentences that do one thing with one object; ``thing`` is its words in them, "" where they are not repeated."""

    sentences: tuple[str, ...]
    thing: str = ""


def write_planner(instruction: str, objects: Sequence[str]) -> str:
    """The planner's program for an instruction.

    Raises:
        NotUnderstood: the message says what is not understood.
    """
    names = read_names(objects)
    try:
        meant = understand(instruction, objects)
        blocks = _Planner(names).plan(meant)
    except RecursionError:
        raise NotUnderstood(f"{instruction.strip()[:80]!r} describes objects by one another without an end") from None
    extras = _extras(meant, names)
    said = [Block(tuple(_with(sentence, extras) for sentence in block.sentences), block.thing) for block in blocks]
    return "\n".join([*_program(said), "# done"])


def _program(blocks: Sequence[Block]) -> list[str]:
    """A line for each sentence, and a loop where several objects are treated alike."""
    lines: list[str] = []
    at = 0
    while at < len(blocks):
        alike = [blocks[at]]
        while (
            blocks[at].thing
            and at + len(alike) < len(blocks)
            and _pattern(blocks[at + len(alike)]) == _pattern(blocks[at])
        ):
            alike.append(blocks[at + len(alike)])
        if len(alike) < _LOOP:
            alike = alike[:1]
            lines += [f'composer("{sentence}")' for sentence in blocks[at].sentences]
        else:
            lines.append(f"for thing in [{', '.join(repr(block.thing) for block in alike)}]:")
            lines += [f'    composer(f"{sentence}")' for sentence in _pattern(blocks[at])]
        at += len(alike)
    return lines


def _pattern(block: Block) -> tuple[str, ...]:
    if not block.thing:
        return block.sentences
    grasp = f"grasp {block.thing}"
    return tuple(sentence.replace(grasp, "grasp {thing}", 1) for sentence in block.sentences)


def _extras(meant: Instruction, names: Sequence[Name]) -> str:
    """What holds for every motion, in the composer's words: what to keep away from, and the speed."""
    kept = [
        f"{round(max(avoidance.cm or AVOID, 1))}cm{'' if index else ' away'} from {thing}"
        for index, (avoidance, thing) in enumerate(
            (avoidance, thing) for avoidance in meant.avoid for thing in _avoided(avoidance, names)
        )
    ]
    text = f" while keeping at least {' and '.join(kept)}" if kept else ""
    return text + (f", at {meant.speed:g}x speed" if meant.speed is not None else "")


def _avoided(avoidance: Avoidance, names: Sequence[Name]) -> list[str]:
    found = ground(avoidance.thing, names)
    if found.is_settled or not found.noun.plural:
        return [found.text]
    if found.noun.ranking or found.noun.relation or found.noun.excluded:
        raise NotUnderstood(f"how many are {str(avoidance.thing)!r}?")
    return [f"the {name.text}" for name in found.names]


def _with(sentence: str, extras: str) -> str:
    return sentence if sentence.endswith(("default pose", "gripper")) else sentence + extras


class _Planner:
    """Writes subtasks and tracks what was moved: positions no longer distinguish moved objects from equal ones."""

    def __init__(self, names: Sequence[Name]) -> None:
        self._names = names
        self._objects = [name.text for name in names]
        self._moves = Moves(names)
        self._arrivals: dict[Place, int] = {}
        self._arrived: dict[Place, int] = {}

    def plan(self, meant: Instruction) -> list[Block]:
        """The subtasks, in order."""
        actions = [one for action in meant.actions for one in self._expanded(action)]
        if sum(action.verb == "pick" for action in actions) > 1:
            raise NotUnderstood("several things are to be held by one hand")
        for action in actions:
            if action.verb == "put" and action.place is not None:
                coming = self._moves.count(action.thing, action.place)
                self._arrivals[action.place] = self._arrivals.get(action.place, 0) + coming
        self._check(meant, actions)
        verbs: dict[str, Callable[[Action], list[Block]]] = {
            "pick": self._pick,
            "put": self._put,
            "push": self._push,
            "shift": self._shift,
            "open": self._open,
            "close": self._close,
            "turn_on": self._turn,
            "turn_off": self._turn,
        }
        return [block for action in actions for block in verbs[action.verb](action)]

    # -- what is meant -------------------------------------------------------------------------------------------------

    def _expanded(self, action: Action) -> list[Action]:
        """ "Stack the two bowls" and "put them next to each other": one of two things goes to the other."""
        place = action.place
        to_each_other = place is not None and place.thing.words == ("each other",)
        if action.verb != "stack" and not to_each_other:
            return [action]
        found = ground(action.thing, self._names)
        if len(found.names) != 2 or not found.noun.plural:
            raise NotUnderstood(f"{str(action.thing)!r}: just two things can be put on or next to each other")
        first, second = (Noun(words=(name.text,)) for name in found.names)
        relation = place.relation if place is not None and place.relation in BESIDE else "on"
        return [Action(verb="put", thing=first, place=Place(relation=relation, thing=second))]

    def _check(self, meant: Instruction, actions: Sequence[Action]) -> None:
        """Refuse orders that contradict each other."""
        acted = {self._key(action.thing) for action in actions}
        for noun in (*meant.untouched, *(avoidance.thing for avoidance in meant.avoid)):
            if acted & self._key_parts(noun):
                raise NotUnderstood(f"{str(noun)!r} is to be left alone, and to be acted on")
        places = {self._key(action.place.thing) for action in actions if action.place is not None}
        for avoidance in meant.avoid:
            if places & self._key_parts(avoidance.thing):
                raise NotUnderstood(f"{str(avoidance.thing)!r} is to be kept away from, and to be put something at")
        for action in meant.forbidden:
            if any(self._is_same(action, other) for other in actions):
                raise NotUnderstood(
                    f"{action.verb.replace('_', ' ')} {action.thing} is asked for, and ruled out with 'not'"
                )
        for state, noun in meant.kept:
            last = [action.verb for action in actions if self._key(action.thing) == self._key(noun)]
            wanted = f"turn_{state}" if state in {"on", "off"} else state
            if last and last[-1] != wanted:
                raise NotUnderstood(f"{last[-1].replace('_', ' ')} {noun}, and keep it {state}: both cannot be")
        self._check_stacks(actions)
        self._check_repeats(actions)

    def _check_repeats(self, actions: Sequence[Action]) -> None:
        """Refuse to put an object where it was put before, without anything between that moves it."""
        at: dict[str, tuple[str, str]] = {}
        for action in actions:
            if action.verb not in {"put", "shift"}:
                continue
            place = (action.place.relation, self._key(action.place.thing)) if action.place else ("", "")
            keys, could_be = self._key_parts(action.thing), ground(action.thing, self._names).names
            again = any(at.get(key) == place for key in keys) or all(at.get(f"the {n.text}") == place for n in could_be)
            if action.place and again:
                raise NotUnderstood(f"{action.thing} is to be put {place[0].replace('_', ' ')} {place[1]} twice")
            at |= dict.fromkeys(keys, place)

    def _check_stacks(self, actions: Sequence[Action]) -> None:
        below: dict[str, str] = {}
        beside: dict[str, str] = {}
        for action in actions:
            if action.verb not in {"put", "push"} or action.place is None or is_table(action.place.thing):
                continue
            thing, place = self._key(action.thing), self._key(action.place.thing)
            if thing == place or self._is_among(action.place, action.thing):
                raise NotUnderstood(f"{action.thing} cannot be put on, in or next to itself")
            if action.place.relation in BESIDE or action.place.relation in {"between", "towards"}:
                if beside.get(place) == thing:
                    raise NotUnderstood(
                        f"{action.thing} and {action.place.thing} are each to be put where the other one is"
                    )
                below.pop(thing, None)
                beside[thing] = place
                continue
            if below.get(place) == thing:
                raise NotUnderstood(
                    f"{action.thing} is to be on {action.place.thing}, which is to be on {action.thing}"
                )
            below[thing] = place

    def _is_among(self, place: Place, things: Noun) -> bool:
        """Whether a place is one of the things that are to be put there."""
        there, moved = _place_thing(place, self._names), ground(things, self._names)
        if moved.noun.words[-1] in GENERIC:
            return False
        several = moved.noun.plural and moved.noun.number in {None, len(moved.names)} and not moved.noun.relation
        return several and set(there.names) <= set(moved.names) and not (moved.noun.excluded and not there.is_settled)

    def _key(self, noun: Noun) -> str:
        """The same text for the same object."""
        if is_table(noun):
            return "table"
        try:
            return ground(noun, self._names).text
        except NotUnderstood:
            return str(noun)

    def _key_parts(self, noun: Noun) -> set[str]:
        found = ground(noun, self._names)
        plain = found.noun.plural and not (found.noun.ranking or found.noun.relation)
        return {f"the {name.text}" for name in found.names} if plain else {found.text}

    def _is_same(self, one: Action, other: Action) -> bool:
        if (one.verb, self._key(one.thing)) != (other.verb, self._key(other.thing)):
            return False
        places = [action.place for action in (one, other) if action.place is not None]
        return len({(place.relation, self._key(place.thing)) for place in places}) <= 1

    def _things(self, noun: Noun, place: Place | None = None) -> list[str]:
        """Phrases for objects that are to be moved."""
        phrases = self._moves.phrases(noun, place)
        for phrase in phrases:
            write_query(phrase, self._objects)
        for name in ground(noun, self._names).names:
            if is_fixture(name, self._names):
                raise NotUnderstood(f"{noun} ({name.text}) is fixed, or a part, and cannot be moved")
        return phrases

    def _place(self, place: Place, thing: Noun) -> str:
        """The destination of a thing: the part of the object that the relation refers to."""
        if is_table(place.thing):
            return "the table"
        found = self._moves.while_held(self._moves.since_moved(_place_thing(place, self._names)), thing)
        if place.relation in BESIDE | {"to", "towards"}:
            return self._single(found)
        part = holder(_holding(place.relation), found.names[0], self._names) if found.is_settled else None
        if place.relation == "under" and part is None and not (found.is_settled and found.names[0].is_part):
            raise NotUnderstood(f"nothing can be put under {place.thing}")
        return f"the {part.text}" if part else self._single(found)

    def _arrived_at(self, place: Place, thing: Noun, words: str) -> str:
        """The destination once the hand with the thing is above it, where it is described by that thing."""
        if is_table(place.thing):
            return words
        found = _place_thing(place, self._names)
        keys = [self._key(ref) for ref in refs_of(found.noun) if not is_table(ref)]
        if found.is_settled or self._key(thing) not in keys:
            return words
        held = ground(thing, self._names)
        if not held.is_settled and not (held.noun.ranking and held.noun.ranking.key in _SIZES):
            raise NotUnderstood(f"once {thing} is carried, {str(found.noun)!r} cannot be told any more")
        nearest = Ranking(key="near", ref=Noun(words=(held.names[0].text,)) if held.is_settled else held.noun)
        return f"{words.removesuffix(found.text)}{replace(found.noun, relation=None, ranking=nearest)}"

    def _single(self, found: Found) -> str:
        if found.noun.plural and not found.is_settled:
            listed = ", ".join(name.text for name in found.names)
            raise NotUnderstood(f"{str(found.noun)!r} are several places: {listed}; say which")
        # What parse_query_obj would not understand is refused now, before anything moves.
        write_query(found.text, self._objects)
        return found.text

    def _operated(self, noun: Noun, part: str) -> list[str]:
        """The handles or knobs of what is to be opened, closed or turned."""
        words = (*(word for word in noun.words if word not in {"drawer", "door", part}), part)
        if noun.words == ("drawer",) and noun.ranking is None and noun.plural:
            words = ("handle",)
        try:
            found = ground(_with_words(noun, words, self._names), self._names)
        except NotUnderstood as error:
            raise NotUnderstood(f"no {part} to {noun} is known: {error}") from None
        if found.noun.plural and not found.is_settled:
            return [f"the {name.text}" for name in found.names]
        return [found.text]

    # -- subtasks ------------------------------------------------------------------------------------------------------

    def _pick(self, action: Action) -> list[Block]:
        things = self._things(action.thing)
        if len(things) > 1:
            raise NotUnderstood(f"{action.thing} are several things for one hand")
        return [Block(tuple(_lifted(things[0])))]

    def _put(self, action: Action) -> list[Block]:
        assert action.place is not None
        place = self._settled(action.place, action.thing)
        blocks = []
        for thing in self._things(action.thing, place):
            if place.relation == "between":
                goal = _goal(place, self._between(place))
            else:
                where = self._place(place, action.thing)
                words = self._half(action.place, place.relation, where) + where
                goal = _goal(place, words, self._arrived_at(place, action.thing, words))
            blocks.append(Block((*_lifted(thing), *goal), thing))
        self._moves.add(ground(action.thing, self._names), place)
        return blocks

    def _settled(self, place: Place, thing: Noun) -> Place:
        """A place with "to" made "in", "on" or "next to", and checked."""
        if is_table(place.thing):
            if place.relation not in {"on", "to", "center", "top_of"}:
                raise NotUnderstood(f"'{place.relation.replace('_', ' ')} the table' is no place on it")
            return Place(relation="center", thing=place.thing)
        if place.cm is not None and not 0 <= place.cm <= FARTHEST:
            raise NotUnderstood(f"{place.cm:g} cm is farther than the table is wide")
        if place.cm is not None and place.relation not in BESIDE:
            raise NotUnderstood(f"a distance and '{place.relation.replace('_', ' ')}' do not go together")
        relation = place.relation
        if relation == "center":
            relation = "on"
        if relation in {"to", "towards"}:
            words = {
                word for name in _place_thing(place, self._names).names for word in (*name.part_words, *name.words)
            }
            relation = "in" if words & _CONTAINERS else "on" if words & _SUPPORTS else "near"
        return Place(relation=relation, thing=place.thing, second=place.second, cm=place.cm)

    def _between(self, place: Place) -> str:
        """The two objects of "between"."""
        nouns = [place.thing] if place.second is None else [place.thing, place.second]
        found = [self._moves.since_moved(ground(noun, self._names)) for noun in nouns]
        if len(found) == 1:
            if len(found[0].names) != 2 or found[0].noun.ranking or found[0].noun.relation:
                raise NotUnderstood(
                    f"between which two? {str(place.thing)!r} are {', '.join(n.text for n in found[0].names)}"
                )
            return " and ".join(f"the {name.text}" for name in found[0].names)
        if found[0].text == found[1].text:
            raise NotUnderstood(f"between {found[0].text} and itself is no place")
        return " and ".join(self._single(one) for one in found)

    def _half(self, place: Place, relation: str, words: str) -> str:
        """The half of a flat place for the next object, where two are to stand on it; a corner for the first of two
        that are to be in something.

        Args:
            place: as it was said.
            relation: as it is meant.
            words: for the place.
        """
        inside = relation == "in" and not words.endswith(("_inside", "_level"))
        if self._arrivals[place] != 2 or not (inside or place.relation in {"on", "top_of"}):
            return ""
        self._arrived[place] = self._arrived.get(place, 0) + 1
        first = self._arrived[place] == 1
        if inside:
            return "the corner of " if first else ""
        return f"the {'left' if first else 'right'} side of "

    def _push(self, action: Action) -> list[Block]:
        assert action.place is not None
        things, place = self._things(action.thing), self._place(action.place, action.thing)
        if len(things) > 1 or action.place.cm is not None or action.place.relation == "between":
            raise NotUnderstood(f"pushing {action.thing} there is not understood; 'move' is")
        goal = _SIDES_SAID.get(action.place.relation, "towards")
        return [Block((f"push {things[0]} {goal} {place}", "back to default pose"))]

    def _shift(self, action: Action) -> list[Block]:
        if not 0 < action.cm <= FARTHEST:
            raise NotUnderstood(f"{action.cm:g} cm is farther than the table is wide, or no way at all")
        things = self._things(action.thing)
        if len(things) > 1:
            raise NotUnderstood(f"{action.thing} are several things to move")
        way = {"front": "forward", "back": "backward"}.get(action.way, action.way)
        there = [f"move {way} by {action.cm:g}cm", f"move down by {LIFT}cm", "open gripper", *_LEAVE]
        return [Block((*_lifted(things[0]), *there))]

    def _open(self, action: Action) -> list[Block]:
        return [Block(tuple(self._opened(handle))) for handle in self._operated(action.thing, "handle")]

    def _opened(self, handle: str) -> list[str]:
        pulls = (
            [f"pull {handle} by {DOOR}cm"] * DOOR_STEPS if self._is_door(handle) else [f"pull {handle} by {DRAWER}cm"]
        )
        return [f"grasp {handle}", *pulls, "open gripper", *_back_from(handle)]

    def _close(self, action: Action) -> list[Block]:
        return [Block(tuple(self._closed(handle))) for handle in self._operated(action.thing, "handle")]

    def _closed(self, handle: str) -> list[str]:
        if not self._is_door(handle):
            return [f"push close {handle} by {SHUT}cm", *_back_from(handle)]
        steps = [f"push {handle} by {DOOR}cm"] * (DOOR_STEPS - 1)
        return [f"push close {handle} by {DOOR}cm", *steps, *_back_from(handle)]

    def _is_door(self, handle: str) -> bool:
        """A handle that belongs to no drawer."""
        found = ground(read_noun(handle), self._names)
        drawers = {name.whole for name in self._names if "drawer" in name.words}
        return not any(name.whole in drawers or {"drawer", "cabinet"} & set(name.words) for name in found.names)

    def _turn(self, action: Action) -> list[Block]:
        switch = action.verb.removeprefix("turn_")
        knobs = self._operated(action.thing, "knob")
        return [Block((f"grasp {knob}", f"turn {switch} {knob}", "open gripper", *_LEAVE)) for knob in knobs]


_LEAVE = [f"move up by {LIFT}cm", "back to default pose"]
_SIDES_SAID = {
    "near": "next to",
    "left_of": "to the left of",
    "right_of": "to the right of",
    "front_of": "to the front of",
    "back_of": "to the back of",
    "between": "between",
    "center": "at the center of",
}


def _lifted(thing: str) -> list[str]:
    return [f"grasp {thing}", f"move up by {LIFT}cm", f"grasp {thing} again if nothing is held"]


def _goal(place: Place, words: str, arrived: str = "") -> list[str]:
    """The sentences that bring what is held to a place; ``arrived`` are words for it once the hand is there."""
    arrived = arrived or words
    if place.relation in _SIDES_SAID:
        gap = f"{place.cm:g}cm " if place.cm is not None else ""
        goal = f"{gap}{_SIDES_SAID[place.relation]}"
        return [f"move to {ABOVE}cm above the table {goal} {words}", f"place it {goal} {arrived}", *_LEAVE]
    word = "in" if place.relation == "in" else "on"
    if words.endswith(("_inside", "_level")):
        there = [f"move to {BEFORE}cm in front of {words}", f"place it {word} {words}"]
        return [*there, f"move down by {SINK}cm", *_back_from(words, BEFORE)]
    return [f"move to {ABOVE}cm above {words}", f"place it {word} {arrived}", *_LEAVE]


def _back_from(handle: str, cm: int = ABOVE) -> list[str]:
    return [f"move back from {handle} by {cm}cm", "back to default pose"]


def _holding(relation: str) -> str:
    return "on" if relation in {"to", "towards", "center"} else relation


def _with_words(noun: Noun, words: tuple[str, ...], names: Sequence[Name]) -> Noun:
    """The noun with other words; a name itself stays, so that its own part is found."""
    whole = [name for name in names if name.text in noun.words]
    words = tuple(
        part for word in words for part in ((word.split("_")) if whole and word == whole[0].text else (word,))
    )
    return Noun(
        words=tuple(word for word in words if not word.isdigit()),
        ranking=noun.ranking,
        relation=noun.relation,
        plural=noun.plural,
        number=noun.number,
        exact=noun.exact,
        excluded=tuple(_handle_of(excluded) for excluded in noun.excluded),
        indefinite=noun.indefinite,
    )


def _handle_of(noun: Noun) -> Noun:
    words = (*(word for word in noun.words if word not in {"drawer", "door"}), "handle")
    return Noun(words=words, ranking=noun.ranking, relation=noun.relation)


def _place_thing(place: Place, names: Sequence[Name]) -> Found:
    if is_table(place.thing):
        return Found(place.thing, (Name(text="table", whole="table", words=("table",)),))
    drawers = matching(place.thing.words, names) if place.relation == "top_of" else ()
    if drawers and all("drawer" in name.words for name in drawers) and len({name.whole for name in drawers}) == 1:
        # The top of a drawer, whichever, is the top of what it is in.
        return Found(place.thing, drawers[:1])
    return ground(place.thing, names)
