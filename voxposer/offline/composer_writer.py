"""Programs of the composer: calls that ask for maps in words, and the motions that execute them.

A sentence such as "place it on the plate_1" comes in; its program goes out. The composer sees no entity names: phrases
for objects are passed on unchanged to the map writers and parse_query_obj.
"""

from __future__ import annotations

import re

from voxposer.offline.rules import BESIDE, CM, GAP, SIDES, THING, Groups, Rules, choose, get

# Room left before and after a push, centimetres; a pushed part is released while it slides.
PUSH_ROOM, PUSH_RUN = 5, 8
# Degrees that a knob is turned to switch on, and to switch off, where its stop ends the motion.
SWITCH_ON, SWITCH_OFF = 90, -120

_DIRECTIONS = {
    "up": "above",
    "down": "below",
    "left": "to the left of",
    "right": "to the right of",
    "forward": "in front of",
    "forwards": "in front of",
    "backward": "behind",
    "backwards": "behind",
}


def write_composer(query: str) -> str:
    """The composer's program for a subtask.

    Raises:
        NotUnderstood: the message quotes the subtask.
    """
    text, speed, avoided = _without_extras(" ".join(query.strip().rstrip(".").split()))
    program = choose(_COMPOSER, text, "composer")
    maps = {"avoidance": avoided, "velocity": speed} if "execute(" in program else {}
    extras = [f"{kind}_map = get_{kind}_map({asked!r})" for kind, asked in maps.items() if asked]
    arguments = "".join(f", {kind}_map={kind}_map" for kind, asked in maps.items() if asked)
    first, *rest = re.sub(r"(execute\(.*)\)$", rf"\1{arguments})", program, flags=re.MULTILINE).splitlines()
    return "\n".join([first, *extras, *rest])


_SPEED = re.compile(
    r",? at (?P<speed>[\d.]+x speed|half speed|a quarter of the speed)(?P<near> when within .+?)?(?=,|$)"
)
_AVOID = re.compile(
    r",?(?: while| and)? (?:keeping|keep|staying|stay)(?: at least)? (?P<cm>\d+) ?cm(?: away)? from (?P<what>[^,]+)"
)


def _without_extras(text: str) -> tuple[str, str, str]:
    """A subtask without speed and clearance, the velocity query and the avoidance query."""
    speed, avoid = _SPEED.search(text), _AVOID.search(text)
    spoken = f"{speed['speed']}{speed['near'] or ''}" if speed else ""
    text = _AVOID.sub("", _SPEED.sub("", text))
    return text, spoken, f"{avoid['cm']}cm from {_SPEED.sub('', avoid['what'])}" if avoid else ""


def _run(movable: str = "movable", **maps: str) -> list[str]:
    """Lines that get maps by query and execute with them."""
    lines = [f"{kind}_map = get_{kind}_map({query!r})" for kind, query in maps.items()]
    arguments = "".join(f", {kind}_map={kind}_map" for kind in maps)
    return [*lines, f"execute({movable}{arguments})"]


_GRIPPER = "movable = parse_query_obj('gripper')"


def _grasp(match: Groups) -> list[str]:
    grasp = f"grasp position of {match['thing']}"
    return [
        _GRIPPER,
        *_run(
            affordance=f"the {grasp}",
            rotation=f"the grasp orientation of {match['thing']}",
            gripper=f"open everywhere except 1cm around the {grasp}",
        ),
    ]


def _grasp_again(match: Groups) -> list[str]:
    lift = _run(affordance=f"a point 10cm above the grasp position of {match['thing']}", gripper="close everywhere")
    lines = [*_grasp(match), *lift]
    return [get("held object", "held"), "if not held.held:", *(f"    {line}" for line in lines)]


def _hover(match: Groups) -> list[str]:
    where = "in front of" if match["where"] == "in front of" else "above"
    return [
        _GRIPPER,
        *_run(
            affordance=f"a point {match['cm']}cm {where} the place position of {match['thing']}",
            rotation=f"the placing orientation of {match['thing']}",
        ),
    ]


def _place(match: Groups) -> list[str]:
    thing = match["thing"]
    down = _run(affordance=f"the place position of {thing}", rotation=f"the placing orientation of {thing}")
    return [_GRIPPER, *down, *_run(gripper="open everywhere")]


def _hover_beside(match: Groups) -> list[str]:
    spot = f"a point {match['cm']}cm above the table {_side(match)} {match['thing']} for the held object"
    return [_GRIPPER, *_run(affordance=spot)]


def _side(match: Groups) -> str:
    """Where beside something, with the gap if one is said."""
    return f"{match['room']}cm {match['side']}" if match["room"] else match["side"]


def _place_beside(match: Groups) -> list[str]:
    spot = f"a point on the table {_side(match)} {match['thing']} for the held object"
    return [_GRIPPER, *_run(affordance=spot), *_run(gripper="open everywhere")]


def _move_by(match: Groups) -> list[str]:
    spot = f"a point {match['cm']}cm {_DIRECTIONS[match['direction'].lower()]} the gripper"
    return [_GRIPPER, *_run(affordance=spot)]


def _move_to(match: Groups) -> list[str]:
    return [_GRIPPER, *_run(affordance=f"a point {match['cm'] or '10'}cm {match['side']} {match['thing']}")]


def _back_off(match: Groups) -> list[str]:
    spot = f"a point {match['cm']}cm from the gripper along the normal of {match['thing']}"
    return [_GRIPPER, *_run(affordance=spot, gripper="open everywhere" if not match["closed"] else "close everywhere")]


def _pull(match: Groups) -> list[str]:
    spot = f"a point {match['cm']}cm from the gripper along the opening axis of {match['thing']}"
    return [_GRIPPER, *_run(affordance=spot, gripper="close everywhere")]


def _push_part(match: Groups) -> list[str]:
    thing = match["thing"]
    spot = f"a point {match['cm']}cm from {thing} against the opening axis of {thing}"
    return [
        _GRIPPER,
        *_run(affordance=spot, rotation=f"the pushing orientation of {thing}", gripper="close everywhere"),
    ]


def _push_close(match: Groups) -> list[str]:
    thing = match["thing"]
    before = _run(
        affordance=f"a point {PUSH_RUN}cm from {thing} along the opening axis of {thing}",
        rotation=f"the pushing orientation of {thing}",
        gripper="close everywhere",
    )
    _, *push = _push_part(match)
    return [_GRIPPER, *before, *(line for line in push if not line.startswith(("rotation", "gripper")))]


def _switch(match: Groups) -> list[str]:
    degrees = SWITCH_ON if match["state"].lower() == "on" else SWITCH_OFF
    thing = match["thing"]
    return [
        _GRIPPER,
        *_run(
            affordance=f"the grasp position of {thing}",
            rotation=f"{thing} turned by {degrees} degrees",
            gripper="close everywhere",
        ),
    ]


def _push_object(match: Groups) -> list[str]:
    side = match["side"]
    spot = f"a point {PUSH_ROOM}cm {side} {match['goal']} for {match['thing']}"
    return [get(match["thing"], "movable"), *_run(affordance=spot)]


def _turn(match: Groups) -> list[str]:
    return [_GRIPPER, *_run(rotation=f"turn {match['way']} by {match['degrees']} degrees")]


def _face(match: Groups) -> list[str]:
    return [_GRIPPER, *_run(rotation=f"face {match['thing']}")]


def _grip(match: Groups) -> list[str]:
    return [_GRIPPER, *_run(gripper=f"{match['state'].lower()} everywhere")]


_AT = f"{BESIDE}|between|at the center of"
_COMPOSER: Rules = (
    (rf"(?:grasp|grab|pick up) {THING} again if nothing is held", _grasp_again),
    (rf"(?:grasp|grab|pick up) {THING}", _grasp),
    (r"(?:go )?back to (?:the )?default(?: pose)?|go back to default", lambda _: ["reset_to_default_pose()"]),
    (r"(?P<state>open|close)(?: the)? gripper", _grip),
    (rf"move (?P<direction>{'|'.join(_DIRECTIONS)}) (?:by|for) {CM}", _move_by),
    (rf"move to {CM} above the table {GAP}(?P<side>{_AT}) {THING}", _hover_beside),
    (rf"move to {CM} (?P<where>above|on top of) {THING}", _hover),
    (rf"move to {CM} (?P<where>in front of) (?P<thing>(?:the )?\S+_(?:inside|level))", _hover),
    (rf"move to (?:{CM} )?(?P<side>{'|'.join(SIDES)}) {THING}", _move_to),
    (rf"place it {GAP}(?P<side>{_AT}) {THING}", _place_beside),
    (rf"place it (?:on|in|under|inside) {THING}", _place),
    (rf"move back from {THING} by {CM}(?P<closed> with the gripper closed)?", _back_off),
    (rf"pull {THING} by {CM}", _pull),
    (rf"push close {THING} by {CM}", _push_close),
    (rf"push {THING} by {CM}", _push_part),
    (rf"turn (?P<state>on|off) {THING}", _switch),
    (rf"push {THING} (?P<side>{BESIDE}|towards) (?P<goal>.+)", _push_object),
    (r"turn (?P<way>clockwise|counter-clockwise) by (?P<degrees>\d+) degrees", _turn),
    (rf"face {THING}", _face),
)
