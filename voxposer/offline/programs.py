"""The text of the planner's program: blocks of sentences for the composer become its lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from voxposer.offline.meaning import Place

# Distances named in subtasks, centimetres: over a target before the last descent; before a target that is entered
# from a side; after grasping and releasing; the way of a drawer, which stops at its end by itself; a step of a door;
# room kept from what is to be avoided; the longest distance that fits on a table.
ABOVE, BEFORE, LIFT, DRAWER, SHUT, DOOR, AVOID, FARTHEST = 10, 20, 10, 18, 22, 10, 15, 100
# How far fingers sink that let go of something in a space: tipped over onto them, it would come out with them.
SINK = 4
# More things than this that go to one place are written as a loop, so that the program stays short.
_LOOP = 3


@dataclass(frozen=True)
class Block:
    """Sentences that do one thing with one object; ``thing`` is its words in them, "" where they are not repeated."""

    sentences: tuple[str, ...]
    thing: str = ""


def program(blocks: Sequence[Block]) -> list[str]:
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


def in_one_line(lines: Sequence[str]) -> list[str]:
    """The same lines with subtasks that follow one another in one: where lines are indented, that is much shorter."""
    joined: list[str] = []
    sentences: list[str] = []
    for line in [*lines, ""]:
        if line.startswith('composer("'):
            sentences.append(line.removeprefix("composer(").removesuffix(")"))
            continue
        if sentences:
            joined.append(f"for each in [{', '.join(sentences)}]: composer(each)")
            sentences = []
        joined.append(line)
    return joined[:-1]


def _pattern(block: Block) -> tuple[str, ...]:
    if not block.thing:
        return block.sentences
    grasp = f"grasp {block.thing}"
    return tuple(sentence.replace(grasp, "grasp {thing}", 1) for sentence in block.sentences)


LEAVE = [f"move up by {LIFT}cm", "back to default pose"]
SIDES_SAID = {
    "near": "next to",
    "left_of": "to the left of",
    "right_of": "to the right of",
    "front_of": "to the front of",
    "back_of": "to the back of",
    "between": "between",
    "center": "at the center of",
}


def lifted(thing: str) -> list[str]:
    """The sentences that grasp and lift a thing."""
    return [f"grasp {thing}", f"move up by {LIFT}cm", f"grasp {thing} again if nothing is held"]


def goal_of(place: Place, words: str, arrived: str = "") -> list[str]:
    """The sentences that bring what is held to a place; ``arrived`` are words for it once the hand is there."""
    arrived = arrived or words
    if place.relation in SIDES_SAID:
        gap = f"{place.cm:g}cm " if place.cm is not None else ""
        goal = f"{gap}{SIDES_SAID[place.relation]}"
        return [f"move to {ABOVE}cm above the table {goal} {words}", f"place it {goal} {arrived}", *LEAVE]
    word = "in" if place.relation == "in" else "on"
    if words.endswith(("_inside", "_level")):
        there = [f"move to {BEFORE}cm in front of {words}", f"place it {word} {words}"]
        return [*there, f"move down by {SINK}cm", *back_from(words, BEFORE)]
    return [f"move to {ABOVE}cm above {words}", f"place it {word} {arrived}", *LEAVE]


def back_from(handle: str, cm: int = ABOVE) -> list[str]:
    """The sentences that take the hand away from a part or a space."""
    return [f"move back from {handle} by {cm}cm", "back to default pose"]
